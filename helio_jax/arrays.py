"""Conventions of every array in the package, and the checks that keep them.

* Lengths are micrometres, angles radians, numbers float64. User units appear only in names that say so.
* Images are `[detector, y, x]`; x grows with the column, y with the row; pictures are drawn origin lower.
* Pixel (i, j) has beam position (x[j], y[i]): where the beam axis meets the sample's plane z = 0. Its surface
  point of height h lies at (x - h tan t, y, h) in the sample frame: height goes up, towards the plate.
* Slopes in the beam frame: a = dh/dX, b = dh/dY (per um of raster), for a beam azimuth of zero
  a = p / (1 + p tan t), b = q / (1 + p tan t) with the surface's own p = dz/dx, q = dz/dy.
* Surface normals point up: n ~ (-p, -q, 1).
* Masks say what True means: `is_observed`, `is_valid`.
* Scattering orders: index 0 is single scattering (order 1); the last index holds that order and above.

tests/unit/test_conventions.py pins each sentence.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from helio_jax.errors import HelioError

WALL_PITCHES = 5.0
"""A rise between two neighbouring pixels of a beam-frame raster of more than this many pitches is a wall."""
_NORMAL = 1.4826
"""Standard deviation of normal noise over the median of its absolute value."""


def as_float_array(name: str, value: Any, shape: tuple[int | None, ...], error: type[HelioError]) -> np.ndarray:
    """Return `value` as a float64 array of `shape` (None: any length).

    Raises:
        error: not numeric, or another shape; the message names the quantity, its shape and the expected one.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise error(f"{name} must be numbers, got {type(value).__name__}: {e}") from None
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("any" if n is None else str(n) for n in shape)
        raise error(f"{name} must have the shape {wanted}, got {' x '.join(map(str, array.shape)) or 'a scalar'}")
    return array


def check_axis(name: str, values: np.ndarray, error: type[HelioError]) -> None:
    """Check that a raster axis is finite, increasing and equally spaced (to 1e-6 of its pitch)."""
    if not np.all(np.isfinite(values)):
        raise error(f"{name} must be finite, got {int(np.sum(~np.isfinite(values)))} non-finite beam positions")
    if values.size > 1:
        step = np.diff(values)
        if step.min() <= 0 or np.ptp(step) > 1e-6 * step.mean():
            raise error(
                f"{name} must increase in equal steps, got steps of {step.min():g} to {step.max():g} um: "
                "resample the scan onto a regular raster"
            )


def robust_std(residuals: np.ndarray, axes: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the standard deviation of normal noise about 0, from the median of its absolute value; NaN not counted.

    Args:
        residuals: outliers up to a half do no harm.
        axes: over which; they are kept with length 1. None: over all, as a scalar.
    """
    return _NORMAL * np.nanmedian(np.abs(residuals), axis=axes, keepdims=axes is not None)


def pitch(axis: np.ndarray) -> float:
    """Return the step of a regular axis [um]; 1 um for a single position."""
    return float((axis[-1] - axis[0]) / (axis.size - 1)) if axis.size > 1 else 1.0


def nearest_known(is_known: np.ndarray, sides: tuple[float, float] = (1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of the known pixel that is nearest to every pixel [y, x] each.

    Args:
        is_known: at least one of them [y, x].
        sides: of a pixel along y and x.
    """
    from scipy.ndimage import distance_transform_edt

    rows, columns = np.asarray(
        distance_transform_edt(~is_known, sampling=sides, return_distances=False, return_indices=True)
    )
    return rows, columns


def as_json(value: Any) -> Any:
    """Return nested mappings, sequences and arrays as JSON values; numbers that are not finite are None: not known."""
    if isinstance(value, Mapping):
        return {key: as_json(v) for key, v in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return as_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def undirected_deg(line: np.ndarray) -> float:
    """Return the angle of a line along a vector (x, y) from +x, counter-clockwise, -90 (included) to 90 [deg]."""
    return (math.degrees(math.atan2(line[1], line[0])) + 90.0) % 180.0 - 90.0


def border_mask(shape: tuple[int, int], fraction: float) -> np.ndarray:
    """Return True in the frame along the image's border whose width is `fraction` of each side [y, x]."""
    ny, nx = (max(1, round(fraction * n)) for n in shape)
    frame = np.ones(shape, bool)
    frame[ny:-ny, nx:-nx] = False
    return frame
