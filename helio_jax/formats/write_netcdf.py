"""Write all layers as a NetCDF file, version 3 with 64-bit offsets, with attributes after the CF conventions.

Lengths are um, y increases with the row. The kind of missing value is NaN. Masks are bytes with named flags.
"""

from pathlib import Path

import numpy as np

from helio_jax.formats.layers import Layer, Layers
from helio_jax.reconstruction import REASONS


def write_netcdf(layers: Layers, path: Path) -> None:
    """Write a variable for each layer and coordinates for its axes."""
    from scipy.io import netcdf_file

    with netcdf_file(path, "w", version=2) as file:
        about = {"Conventions": "CF-1.8", "title": layers.title, "source": "helio_jax", **layers.about}
        for name, text in about.items():
            setattr(file, name, text.encode() or b"-")
        for layer in layers.layers:
            for axis, n in zip(layer.axes, layer.values.shape, strict=True):
                if axis not in file.dimensions:
                    file.createDimension(axis, n)
        _put_positions(file, layers)
        _put_detectors(file, layers)
        for layer in layers.layers:
            _put_layer(file, layer)


def _put_layer(file, layer: Layer) -> None:
    """Write one layer; whole numbers are flags."""
    about: dict = {"long_name": layer.meaning, "units": "1" if layer.unit in ("", "counts") else layer.unit}
    if layer.values.dtype.kind not in "bu":
        _put(file, layer.name, layer.values.astype(np.float64), layer.axes, about | {"_FillValue": np.float64(np.nan)})
        return
    names = REASONS if layer.name == "reason" else ("no", "yes")
    about["flag_values"] = np.arange(len(names), dtype=np.int8)
    about["flag_meanings"] = " ".join(name.replace(" ", "_") for name in names)
    _put(file, layer.name, layer.values.astype(np.int8), layer.axes, about)


def _put_positions(file, layers: Layers) -> None:
    """Write the positions of columns and rows, and those of the points where these are elsewhere."""
    if not layers.is_list:
        for axis, values in (("x", layers.x), ("y", layers.y)):
            about = {"units": "um", "long_name": f"position {axis} of the pixel", "axis": axis.upper()}
            _put(file, axis, values, (axis,), about)
    for name, values in layers.points.items():
        _put(file, name, values, ("y", "x"), {"units": "um", "long_name": f"position {name[-1]} of the point"})


def _put(file, name: str, values: np.ndarray, axes: tuple[str, ...], about: dict) -> None:
    """Write one variable with its attributes."""
    variable = file.createVariable(name, values.dtype, axes)
    variable[:] = values
    for key, value in about.items():
        setattr(variable, key, value.encode() if isinstance(value, str) else value)


def _put_detectors(file, layers: Layers) -> None:
    """Write the names of the detectors as a table of characters."""
    if "detector" in file.dimensions:
        names = np.array([name.encode() for name in layers.detectors])
        file.createDimension("letter", names.dtype.itemsize)
        _put(file, "detector_name", names.view("S1").reshape(len(names), -1), ("detector", "letter"), {})
