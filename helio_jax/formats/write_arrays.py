"""Write all layers as named arrays: MAT (MATLAB level 5), NPZ (NumPy), CSV (a row for each pixel).

Lengths are um. Row 0 of an array is the lowest y. In MATLAB several images are cells, counts{detector} or
by_order{order}{detector}; elsewhere the arrays are [detector, y, x].
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.formats.columns import write_columns
from helio_jax.formats.layers import Layers

_MAT_HEADER_BYTES = 116


def cells(images: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Convert images to a MATLAB cell array of one row; those of two indices to cells of cells."""
    out = np.empty((1, len(images)), dtype=object)
    for i, image in enumerate(images):
        out[0, i] = image if np.ndim(image) <= 2 else cells(image)
    return out


def save_mat(path: Path, tree: dict[str, Any]) -> None:
    """Write variables to a MATLAB file without the date that SciPy puts in its header: equal data, equal bytes."""
    from scipy.io import savemat

    savemat(path, tree, do_compression=True)
    with path.open("r+b") as file:
        file.write(b"MATLAB 5.0 MAT-file, written by helio_jax".ljust(_MAT_HEADER_BYTES))


def _axes_of(layers: Layers) -> dict[str, np.ndarray]:
    """Return the arrays of the positions: of columns and rows, and of points where these are elsewhere."""
    axes = {} if layers.is_list else {"x": layers.x, "y": layers.y}
    if layers.is_list or layers.distance_beside:
        axes |= {"point_x": layers.point_x, "point_y": layers.point_y}
    return axes


def _texts(layers: Layers) -> dict[str, Any]:
    """Return units, names of detectors, and what else is known as text."""
    units = dict.fromkeys(_axes_of(layers), "um") | {layer.name: layer.unit for layer in layers.layers}
    return {"title": layers.title, "units": units, "detectors": list(layers.detectors), "about": dict(layers.about)}


def write_npz(layers: Layers, path: Path) -> None:
    """Write compressed arrays; units as `unit_NAME`."""
    texts = _texts(layers)
    arrays = _axes_of(layers) | {layer.name: layer.values for layer in layers.layers}
    arrays |= {f"unit_{name}": np.array(unit) for name, unit in texts["units"].items()}
    arrays |= {name: np.array(text) for name, text in {"title": layers.title, **layers.about}.items()}
    if layers.detectors:
        arrays["detectors"] = np.array(layers.detectors)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def write_mat(layers: Layers, path: Path) -> None:
    """Write compressed arrays and the structs `units` and `about`."""
    texts = _texts(layers)
    texts["detectors"] = np.array(layers.detectors, dtype=object)
    arrays = {name: values.reshape(1, -1) if values.ndim == 1 else values for name, values in _axes_of(layers).items()}
    arrays |= {layer.name: layer.values if layer.values.ndim == 2 else cells(layer.values) for layer in layers.layers}
    save_mat(path, arrays | texts)


def write_csv(layers: Layers, path: Path) -> None:
    """Write a row for each pixel: row and column, position, values; lengths end in _um."""
    ny, nx = layers.x.size and layers.y.size, layers.x.size
    row, column = np.indices((ny, nx))
    columns: dict[str, np.ndarray] = {} if layers.is_list else {"row": row.ravel(), "column": column.ravel()}
    x, y = (layers.point_x, layers.point_y) if layers.is_list else np.meshgrid(layers.x, layers.y)
    columns |= {"x_um": x.ravel(), "y_um": y.ravel()}
    if not layers.is_list and layers.distance_beside:
        columns |= {"point_x_um": layers.point_x.ravel(), "point_y_um": layers.point_y.ravel()}
    for layer in layers.layers:
        is_whole = layer.values.dtype.kind in "bu"
        for image in layers.images([layer]):
            name = image.name if image.unit in ("", "counts") else f"{image.name}_{image.unit}"
            columns[name] = (image.values.astype(np.int64) if is_whole else image.values).ravel()
    write_columns(path, columns)
