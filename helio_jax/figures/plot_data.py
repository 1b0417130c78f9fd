"""Data that the printed panel and the interactive report draw: ranges, fractions, surface cells, profiles.

Raster images stay in the beam frame; profiles and surface cells use the surface points' own positions, so that shapes
are true and occluded parts show as gaps. Draws nothing.
"""

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

REASON_COLORS = ("#d9d9d9", "#4477aa", "#ee6677", "#ccbb44", "#222222", "#aa3377", "#66ccee")
"""One colour per entry of `REASONS` (Tol's bright scheme, distinct for the colour-blind)."""
DETECTOR_COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#999999")
"""One colour per detector, repeated (Tol's bright scheme)."""
_LONGEST_EDGE = 6.0
"""Longer edges between neighbouring surface points are gaps [pitches]."""


def surface_cells(rec: Reconstruction) -> np.ndarray:
    """Find the raster cells (between 2 x 2 pixels) that are one piece of surface, True there [y-1, x-1].

    A cell is cut where a height is missing or where an edge between the surface points' own positions is longer than
    6 pitches: an occlusion edge, or a high step up.

    Source: own choice; 6 pitches is a slope of 83 % of the shadowing limit, sphere A's gap is 11 pitches.
    """
    x, y = rec.x, rec.y
    along = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1)) / pitch(rec.raster_x)
    up = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)) / pitch(rec.raster_y)
    along, up = along <= _LONGEST_EDGE, up <= _LONGEST_EDGE  # False where a height is NaN
    return along[:-1] & along[1:] & up[:, :-1] & up[:, 1:] & np.isfinite(rec.height[1:, 1:] + rec.height[:-1, :-1])


def cell_corners(rec: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface points' own positions x, y [y, x], um; the raster's where a height is missing."""
    is_hole = ~np.isfinite(rec.height)
    x = np.where(is_hole, np.broadcast_to(rec.raster_x, rec.height.shape), rec.x)
    return x, np.where(is_hole, np.broadcast_to(rec.raster_y[:, None], rec.height.shape), rec.y)


def cell_means(values: np.ndarray) -> np.ndarray:
    """Average values [y, x, ...] over the four corners of each raster cell [y-1, x-1, ...]."""
    return 0.25 * (values[1:, 1:] + values[1:, :-1] + values[:-1, 1:] + values[:-1, :-1])


def apex_pixel(height: np.ndarray) -> tuple[int, int]:
    """Find the pixel (row, column) farthest above or below the median height; NaN is ignored."""
    away = np.abs(height - np.nanmedian(height)) if np.isfinite(height).any() else np.zeros(height.shape)
    row, column = np.unravel_index(np.argmax(np.where(np.isfinite(away), away, -1.0)), height.shape)
    return int(row), int(column)


def highest_valid(rec: Reconstruction) -> tuple[int, int] | None:
    """Find the pixel (row, column) of the highest valid height; None: no height is valid."""
    use = rec.is_valid & np.isfinite(rec.height)
    if not use.any():
        return None
    row, column = np.unravel_index(np.argmax(np.where(use, rec.height, -np.inf)), use.shape)
    return int(row), int(column)


def robust_range(values: np.ndarray, percent: float = 0.2) -> tuple[float, float]:
    """Compute the range of the finite values without `percent` at either end; (0, 1) where there are none."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [percent, 100 - percent]) if finite.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def symmetric_range(values: np.ndarray) -> tuple[float, float]:
    """Compute limits (-m, m) that hold 99.6 % of the values, for diverging colours."""
    m = max(map(abs, robust_range(values)))
    return -m, m


def observed_counts(stack: MicrographStack) -> np.ndarray:
    """Return the counts, NaN where none were recorded [detector, y, x]."""
    return np.where(stack.is_observed, stack.counts, np.nan)


def multiple_fraction(stack: MicrographStack) -> np.ndarray | None:
    """Compute the multiply scattered fraction of the counts [detector, y, x]; None if orders are unknown."""
    if stack.by_order is None or stack.multiple is None:
        return None
    total = stack.by_order.sum(0)
    return np.divide(stack.multiple, total, out=np.full_like(total, np.nan), where=total > 0)


def residual_rms(residuals: np.ndarray) -> np.ndarray:
    """Compute the root mean square over the detectors that have data [y, x]; NaN where none has."""
    has_data = np.isfinite(residuals)
    total, n = np.where(has_data, residuals, 0.0), has_data.sum(0)
    return np.sqrt(np.divide((total**2).sum(0), n, out=np.full(n.shape, np.nan), where=n > 0))


def profile_line(
    rec: Reconstruction, height: np.ndarray, along: str, pixel: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read one raster line of `height` through `pixel`, at the surface points' own positions.

    Returns:
        Positions along "x" or "y" [um], heights [um], and the indices before which the beam leaves a gap.
    """
    line = (pixel[0], slice(None)) if along == "x" else (slice(None), pixel[1])
    points = rec.instrument.surface_position(rec.raster_x[None, :], rec.raster_y[:, None], height)
    at = points[0 if along == "x" else 1] + np.zeros_like(height)
    step = pitch(rec.raster_x if along == "x" else rec.raster_y)
    return at[line], height[line], np.flatnonzero(np.abs(np.diff(at[line])) > _LONGEST_EDGE * step) + 1


def profile_band(
    rec: Reconstruction, height: np.ndarray, along: str, pixel: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Outline height +- height_std along one raster line: positions and heights [um], without missing points."""
    assert rec.height_std is not None  # callers check
    low, high = (profile_line(rec, height + s * rec.height_std, along, pixel) for s in (-1, 1))
    use = np.isfinite(low[1]) & np.isfinite(high[1])
    return tuple(np.concatenate([low[k][use], high[k][use][::-1]]) for k in (0, 1))  # type: ignore[return-value]


def profile_place(rec: Reconstruction, along: str, pixel: tuple[int, int]) -> str:
    """Name the raster line of a profile through `pixel`, e.g. "Y = 40 µm"."""
    row, column = pixel
    return f"Y = {rec.raster_y[row]:.0f} µm" if along == "x" else f"X = {rec.raster_x[column]:.0f} µm"
