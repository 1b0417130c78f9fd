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


def _positions(layers: Layers) -> dict[str, np.ndarray]:
    """Return the positions of columns and rows, and those of the points where these are elsewhere."""
    axes = {} if layers.is_list else {"x": layers.x, "y": layers.y}
    return axes | layers.points


def _units(layers: Layers) -> dict[str, str]:
    """Return the unit of every array."""
    return dict.fromkeys(_positions(layers), "um") | {layer.name: layer.unit for layer in layers.layers}


def write_npz(layers: Layers, path: Path) -> None:
    """Write compressed arrays; units as `unit_NAME`."""
    arrays = _positions(layers) | {layer.name: layer.values for layer in layers.layers}
    texts = {f"unit_{name}": unit for name, unit in _units(layers).items()} | {"title": layers.title, **layers.about}
    arrays |= {name: np.array(text) for name, text in texts.items()}
    if layers.detectors:
        arrays["detectors"] = np.array(layers.detectors)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def write_mat(layers: Layers, path: Path) -> None:
    """Write compressed arrays, and the structs `units` and `about`."""
    tree: dict[str, Any] = {name: np.atleast_2d(values) for name, values in _positions(layers).items()}
    tree |= {layer.name: layer.values if layer.values.ndim == 2 else cells(layer.values) for layer in layers.layers}
    tree |= {"title": layers.title, "units": _units(layers), "about": dict(layers.about)}
    save_mat(path, tree | {"detectors": np.array(layers.detectors, dtype=object)})


def write_csv(layers: Layers, path: Path) -> None:
    """Write a row for each pixel: row and column, positions, values; names of lengths end in _um."""
    if layers.is_list:
        columns = {"x_um": layers.point_x, "y_um": layers.point_y}
    else:
        row, column = np.indices((layers.y.size, layers.x.size))
        x, y = np.meshgrid(layers.x, layers.y)
        columns = {"row": row, "column": column, "x_um": x, "y_um": y}
        columns |= {f"{name}_um": values for name, values in layers.points.items()}
    for layer in layers.layers:
        is_whole = layer.values.dtype.kind in "bu"
        for image in layers.images([layer]):
            name = image.name if image.unit in ("", "counts") else f"{image.name}_{image.unit}"
            columns[name] = image.values.astype(np.int64) if is_whole else image.values
    write_columns(path, {name: values.ravel() for name, values in columns.items()})
