"""Data that the printed panel and the interactive report draw: ranges, fractions, surface cells, profiles.

Raster images stay in the beam frame; profiles are cut in the sample frame, and surface cells use the surface points'
own positions, so that shapes are true and occluded parts show as gaps. Draws nothing.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.measure.sample_grid import heights_at
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.validity import MIN_IMAGES

REASON_COLORS = ("#d9d9d9", "#4477aa", "#ee6677", "#ccbb44", "#222222", "#aa3377", "#66ccee")
"""One colour per entry of `REASONS` (Tol's bright scheme, distinct for the colour-blind)."""
DETECTOR_COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#999999")
"""One colour per detector, repeated (Tol's bright scheme)."""
_LEAST_LEAN = 0.2
"""Least 1 - tx dh/dX - ty dh/dY: the error at a fixed x, y is enlarged by up to 5."""
_LONGEST_EDGE = 6.0
"""Longer edges between neighbouring surface points are gaps [pitches]."""


def is_checkable(rec: Reconstruction) -> bool:
    """Return whether residuals test anything: a photometric method fits its three unknowns to three images exactly."""
    if rec.residuals is None:
        return False
    return rec.method == "refine" or bool((np.isfinite(rec.residuals).sum(0) > MIN_IMAGES).any())


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


@dataclass(frozen=True)
class Profile:
    """Heights along a line of the sample frame through a point.

    Attributes:
        along: "x" or "y".
        place: of the line, e.g. "y = 40 µm".
        at: positions along it [um].
        height: valid heights there [um]; NaN: not valid, or not seen by the beam.
        height_std: standard deviation of the height at a fixed x, y [um], or None.
        truth: true heights [um], or None.
    """

    along: str
    place: str
    at: np.ndarray
    height: np.ndarray
    height_std: np.ndarray | None
    truth: np.ndarray | None


def profiles(rec: Reconstruction, true_height: np.ndarray | None = None, level: float = 0.0) -> list[Profile]:
    """Cut the surface along x and along y through the highest valid point; empty where no height is valid.

    Where the beam shifts points along the line only, the heights are those of the file, pixel by pixel. An error h of a
    height shifts its point, too: at a fixed x, y it is h / (1 - tx dh/dX - ty dh/dY), with the beam's shifts tx, ty per
    height (docs/conventions.md, Slopes and normals).

    Args:
        rec: the heights.
        true_height: true heights of the same raster [y, x], um.
        level: subtracted from the reconstructed heights [um].
    """
    top = highest_valid(rec)
    if top is None:
        return []
    tx, ty = rec.instrument.beam_shift
    down, along = (
        np.gradient(rec.height, pitch(axis), axis=k) if axis.size > 1 else np.zeros(rec.height.shape)
        for k, axis in enumerate((rec.raster_y, rec.raster_x))
    )
    leaning = 1.0 / np.clip(1.0 - tx * along - ty * down, _LEAST_LEAN, None)
    upright = rec if rec.height_std is None else rec.replace(height_std=rec.height_std * leaning)
    true = None if true_height is None else rec.replace(height=true_height, height_std=None)
    out = []
    for name, shift_across in (("x", ty), ("y", tx)):
        cut = _raster_line if abs(shift_across) < 1e-9 else _searched_line
        at, height, std = cut(upright, name, top)
        across = float((rec.y if name == "x" else rec.x)[top])
        truth = None
        if true is not None:
            line = (at, np.array([across])) if name == "x" else (np.array([across]), at)
            truth = heights_at(true, *line, np.isfinite(true.height))[0].ravel()
        place = f"{'y' if name == 'x' else 'x'} = {across + 0.0:.0f} µm".replace("-", "−")
        out.append(Profile(name, place, at, height - level, std, truth))
    return out


def _raster_line(rec: Reconstruction, along: str, top: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, Any]:
    """Return the valid heights of the raster line through a pixel, where the beam shifts points along it only."""
    line = (top[0], slice(None)) if along == "x" else (slice(None), top[1])
    at, step = (rec.x, pitch(rec.raster_x)) if along == "x" else (rec.y, pitch(rec.raster_y))
    at = at[line]
    gap = np.flatnonzero(np.diff(at) > _LONGEST_EDGE * step) + 1  # not seen by the beam
    height = np.where(rec.is_valid, rec.height, np.nan)[line]
    std = (
        None if rec.height_std is None else np.insert(np.where(rec.is_valid, rec.height_std, np.nan)[line], gap, np.nan)
    )
    return np.insert(at, gap, 0.5 * (at[gap - 1] + at[gap])), np.insert(height, gap, np.nan), std


def _searched_line(rec: Reconstruction, along: str, top: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, Any]:
    """Search the valid heights along a line of the sample frame through a pixel, a pitch apart."""
    points, axis = (rec.x, rec.raster_x) if along == "x" else (rec.y, rec.raster_y)
    use, step, middle = rec.is_valid & np.isfinite(rec.height), pitch(axis), float(points[top])
    low, high = np.ceil((points[use].min() - middle) / step), np.floor((points[use].max() - middle) / step)
    at, across = middle + step * np.arange(low, high + 1), np.array([float((rec.y if along == "x" else rec.x)[top])])
    line = (at, across) if along == "x" else (across, at)
    height, std = (found.ravel() for found in heights_at(rec, *line, use))
    height[int(-low)] = rec.height[top]  # exact, also beside pixels that are not valid
    if rec.height_std is None:
        return at, height, None
    std[int(-low)] = rec.height_std[top]
    return at, height, std
