"""Micrographs and heights as an xarray.Dataset: the layers of the exports with named axes. The only door to xarray."""

from typing import Any, Literal

import numpy as np

from helio_jax.errors import MissingDependencyError
from helio_jax.formats.layers import layers_of
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS, Reconstruction


def to_xarray(
    obj: MicrographStack | Reconstruction | HeightMap, invalid: Literal["nan", "keep", "fill"] = "nan"
) -> Any:
    """Convert a record to an xarray.Dataset: each array with named axes, units and meaning; positions as coordinates.

    Args:
        obj: a stack, a reconstruction or a height map.
        invalid: what becomes of heights that are not valid and counts that were not observed: "nan", "keep", "fill".

    Returns:
        xarray.Dataset with the axes y, x (um), detector (names), order (from 1; the last one holds all above),
        component (x, y, z), sample (of the posterior). `point_x`, `point_y` are the positions of the surface points
        at oblique incidence.

    Raises:
        MissingDependencyError: xarray is not installed.
        SceneError: another treatment of missing values.
    """
    try:
        import xarray
    except ImportError:
        raise MissingDependencyError("to_xarray needs xarray: pip install 'helio-jax[xarray]'") from None
    layers = layers_of(obj, invalid)
    data = {
        layer.name: (layer.axes, layer.values, {"units": layer.unit, "long_name": layer.meaning})
        for layer in layers.layers
    }
    if isinstance(obj, Reconstruction):
        data["reason"][2]["flag_meanings"] = ", ".join(REASONS)
        if obj.height_samples is not None:
            about = {"units": "um", "long_name": "joint posterior deviations of the heights"}
            data["height_samples"] = (("sample", "y", "x"), obj.height_samples, about)
    sizes = {axis: n for axes, values, _ in data.values() for axis, n in zip(axes, values.shape, strict=True)}
    um = {"units": "um"}
    positions = {} if layers.is_list else {"x": ("x", layers.x, um), "y": ("y", layers.y, um)}
    names = {
        "detector": np.array(layers.detectors),
        "component": np.array(["x", "y", "z"]),
        "order": np.arange(1, sizes.get("order", 0) + 1),
    }
    coordinates = positions | {axis: values for axis, values in names.items() if axis in sizes}
    coordinates |= {name: (("y", "x"), values, um) for name, values in layers.points.items()}
    return xarray.Dataset(data, coordinates, {"title": layers.title, **layers.about})
