"""Write all layers as a NetCDF file, version 3 with 64-bit offsets, with attributes after the CF conventions.

Lengths are um, y increases with the row. The kind of missing value is NaN. Masks are bytes with named flags.
"""

from pathlib import Path

import numpy as np

from helio_jax.formats.layers import Layers
from helio_jax.reconstruction import REASONS

_FLAGS = {"reason": REASONS}
_NO_YES = ("no", "yes")


def write_netcdf(layers: Layers, path: Path) -> None:
    """Write a variable for each layer and coordinates for its axes."""
    from scipy.io import netcdf_file

    with netcdf_file(path, "w", version=2) as file:
        for name, value in {
            "Conventions": "CF-1.8",
            "title": layers.title,
            "source": "helio_jax",
            **layers.about,
        }.items():
            setattr(file, name, value.encode() or b"-")
        for layer in layers.layers:
            for axis, n in zip(layer.axes, layer.values.shape, strict=True):
                if axis not in file.dimensions:
                    file.createDimension(axis, n)
        for axis, values in (("x", layers.x), ("y", layers.y)):
            if not layers.is_list:
                about = {"units": "um", "long_name": f"position {axis} of the pixel", "axis": axis.upper()}
                _put(file, axis, values, (axis,), about)
        if layers.is_list or layers.distance_beside:
            for axis, values in (("x", layers.point_x), ("y", layers.point_y)):
                _put(
                    file,
                    f"point_{axis}",
                    values,
                    ("y", "x"),
                    {"units": "um", "long_name": f"position {axis} of the point"},
                )
        _put_detectors(file, layers)
        for layer in layers.layers:
            about = {"long_name": layer.meaning, "units": "1" if layer.unit in ("", "counts") else layer.unit}
            names = _FLAGS.get(layer.name, _NO_YES)
            if layer.values.dtype.kind in "bu":
                about |= {"flag_values": np.arange(len(names), dtype=np.int8)}
                about |= {"flag_meanings": " ".join(name.replace(" ", "_") for name in names)}
                _put(file, layer.name, layer.values.astype(np.int8), layer.axes, about)
            else:
                about |= {"_FillValue": np.float64(np.nan)}
                _put(file, layer.name, layer.values.astype(np.float64), layer.axes, about)


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
