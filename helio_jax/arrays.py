"""Array conventions of the package, and the checks that enforce them. See also docs/conventions.md.

* Lengths are micrometres, angles radians, numbers float64. Names with a suffix (`_deg`, `_nm`) hold other units.
* Images are `[detector, y, x]`; x increases with the column, y with the row; pictures have their origin lower left.
* Pixel (i, j) has beam position (x[j], y[i]): where the beam axis meets the substrate plane z = 0. A surface point of
  height h lies at (x - h tan t, y, h) in the sample frame. Height increases upwards, towards the plate.
* Slopes in the beam frame: a = dh/dX, b = dh/dY (per um of raster), for a beam azimuth of zero
  a = p / (1 + p tan t), b = q / (1 + p tan t), with p = dz/dx, q = dz/dy in the sample frame.
* Surface normals point up: n ~ (-p, -q, 1).
* The name of a mask states the meaning of True: `is_observed`, `is_valid`.
* Scattering orders: index 0 is single scattering (order 1); the last index holds its order and all above.

tests/unit/test_conventions.py tests each sentence.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from helio_jax.errors import HelioError

WALL_PITCHES = 5.0
"""A height difference of neighbouring pixels (beam-frame raster) above this many pitches counts as a wall."""
BORDER_WIDTH = 0.06
"""Width of an image's border, as a fraction of each side, of which `substrate_level` takes the lowest part."""
SUBSTRATE_QUANTILE = 0.05
"""Quantile of the border's heights that is taken as the substrate."""
LEAST_SIGNAL = 1e-3
"""Least typical signal of an image, over that of the brightest one."""
_STD_OVER_MEDIAN = 1.4826
"""Standard deviation of normal noise divided by the median of its absolute value."""


def as_float_array(name: str, value: Any, shape: tuple[int | None, ...], error: type[HelioError]) -> np.ndarray:
    """Convert `value` to a float64 array of `shape` (None: any length).

    Raises:
        error: not numeric, or another shape.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise error(f"{name} must be numbers, got {type(value).__name__}: {e}") from None
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        expected = " x ".join("any" if n is None else str(n) for n in shape)
        raise error(f"{name} must have the shape {expected}, got {' x '.join(map(str, array.shape)) or 'a scalar'}")
    return array


def set_float_arrays(record: Any, shapes: Mapping[str, tuple[int | None, ...]], error: type[HelioError]) -> None:
    """Convert fields of a frozen record by `as_float_array`, each to its shape; None stays None."""
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is not None:
            object.__setattr__(record, name, as_float_array(name, value, shape, error))


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
    """Estimate the standard deviation of normal noise about 0 from the median absolute value; NaN is ignored.

    Args:
        residuals: up to half of them may be outliers.
        axes: reduced axes, kept with length 1; None: all axes, scalar result.
    """
    return _STD_OVER_MEDIAN * np.nanmedian(np.abs(residuals), axis=axes, keepdims=axes is not None)


def typical_signals(images: np.ndarray) -> np.ndarray:
    """Return the median of every image's finite values [image], of images [image, y, x].

    The mean stands for a median that is not positive. None is below `LEAST_SIGNAL` of the largest, so that an image of
    background alone has a size, too; all are 1 where none has any signal.
    """
    found = np.zeros(len(images))
    for k, image in enumerate(images):
        known = image[np.isfinite(image)]
        of_size = (float(f(known)) for f in (np.median, np.mean) if known.size)
        found[k] = next((size for size in of_size if size > 0.0), 0.0)
    largest = found.max(initial=0.0)
    return np.maximum(found, LEAST_SIGNAL * largest) if largest > 0.0 else np.ones(len(images))


def pitch(axis: np.ndarray) -> float:
    """Return the pitch of a regular axis [um]; 1 um for a single position."""
    return float((axis[-1] - axis[0]) / (axis.size - 1)) if axis.size > 1 else 1.0


def nearest_known(is_known: np.ndarray, sides: tuple[float, float] = (1.0, 1.0)) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest known pixel of every pixel: its row [y, x] and its column [y, x].

    Args:
        is_known: True for at least one pixel [y, x].
        sides: of a pixel along y and x.
    """
    from scipy.ndimage import distance_transform_edt

    rows, columns = np.asarray(
        distance_transform_edt(~is_known, sampling=sides, return_distances=False, return_indices=True)
    )
    return rows, columns


def fill_gaps(values: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Interpolate unknown values [y, x] linearly; outside the hull of the known ones take the nearest."""
    from scipy.interpolate import griddata

    known, unknown = np.argwhere(is_known), np.argwhere(~is_known)
    out = values.copy()
    try:
        inside = griddata(known, values[is_known], unknown, method="linear")
    except ValueError:  # scipy's QhullError: all known pixels lie on one line
        inside = np.full(len(unknown), np.nan)
    nearest = griddata(known, values[is_known], unknown, method="nearest")
    out[~is_known] = np.where(np.isfinite(inside), inside, nearest)
    return out


def as_json(value: Any) -> Any:
    """Convert nested mappings, sequences and arrays to JSON values; non-finite numbers become None."""
    if isinstance(value, Mapping):
        return {key: as_json(v) for key, v in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return as_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def line_angle_deg(line: np.ndarray) -> float:
    """Return the angle of an undirected line along (x, y), counter-clockwise from +x, in [-90, 90) [deg]."""
    return (math.degrees(math.atan2(line[1], line[0])) + 90.0) % 180.0 - 90.0


def border_mask(shape: tuple[int, int], fraction: float) -> np.ndarray:
    """Return True in the border of an image [y, x]; its width is `fraction` of each side."""
    ny, nx = (max(1, round(fraction * n)) for n in shape)
    frame = np.ones(shape, bool)
    frame[ny:-ny, nx:-nx] = False
    return frame


def substrate_level(height: np.ndarray) -> float:
    """Estimate the height of the substrate from the lowest part of the border of heights [y, x], um."""
    return float(np.quantile(height[border_mask(height.shape, BORDER_WIDTH)], SUBSTRATE_QUANTILE))


def substrate_mask(height: np.ndarray) -> np.ndarray:
    """Return True in the border's pixels at or below `substrate_level` of heights [y, x]."""
    return border_mask(height.shape, BORDER_WIDTH) & (height <= substrate_level(height))


def check_correlation(n: int, std: Sequence[float], correlation: Sequence[Sequence[float]]) -> None:
    """Check standard deviations and a correlation matrix, rounded as in a file.

    Raises:
        ValueError: not of n numbers, a negative deviation, or no correlation matrix.
    """
    if len(std) != n or [len(row) for row in correlation] != [n] * n:
        raise ValueError(f"std and correlation must be of {n} numbers: one each, and a square table")
    matrix = np.array(correlation)
    if min(std) < 0.0 or not np.allclose(matrix, matrix.T, atol=1e-3) or not np.allclose(np.diag(matrix), 1.0):
        raise ValueError("std must be >= 0, correlation symmetric with a diagonal of ones: calibrate anew")
    if np.linalg.eigvalsh(matrix).min() < -0.01:
        raise ValueError("correlation must not have negative eigenvalues: calibrate anew")


def distance_to_end(inside: np.ndarray, way: tuple[float, float], pitch: tuple[float, float]) -> np.ndarray:
    """Compute the distance from every pixel of a region to its end in a direction (x, y) [y, x], um; 0 outside.

    A region that reaches the image's border does not end there.
    """
    step = min(pitch)
    room = np.pad(inside, 1, mode="edge")
    row, column = (index + 1.0 for index in np.nonzero(inside))
    left, is_in = np.zeros(row.size), np.ones(row.size, bool)
    for n in range(1, int(math.hypot(*(np.array(inside.shape) * pitch)) / step) + 2):
        at_row = np.clip(np.rint(row + n * step * way[1] / pitch[0]), 0, room.shape[0] - 1).astype(int)
        at_column = np.clip(np.rint(column + n * step * way[0] / pitch[1]), 0, room.shape[1] - 1).astype(int)
        is_in &= room[at_row, at_column]
        if not is_in.any():
            break
        left[is_in] = n * step
    distance = np.zeros(inside.shape)
    distance[inside] = left + 0.5 * step
    return distance
