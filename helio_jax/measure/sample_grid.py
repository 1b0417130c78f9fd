"""Heights of an oblique beam on a regular grid of the sample frame. `Reconstruction` in, `HeightMap` out.

The raster of an oblique beam is a sheared view of the surface. At each grid point the topmost height is searched at
which the vertical line meets the surface seen by the beam. Where the beam saw no surface (a region behind a depth
jump), the height is unknown.
"""

import math

import numpy as np

from helio_jax.arrays import WALL_PITCHES, pitch
from helio_jax.errors import GuardError, SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.reconstruction import Reconstruction

MAX_PIXELS = 16_000_000
"""Largest grid."""
_STEP = 0.5
"""Step of the search in the raster, in pitches: no cell of the raster is passed over."""


def resample_heights(rec: Reconstruction, grid_pitch: float, *, use_all: bool = False) -> HeightMap:
    """Interpolate heights and their standard deviations onto a regular grid of the sample frame.

    Bilinear between four pixels; a cell whose corners differ by more than `WALL_PITCHES` pitches is a depth jump, in
    which nothing is interpolated. At normal incidence and the raster's own pitch the heights are unchanged.

    Args:
        rec: heights in the beam frame.
        grid_pitch: of the grid in x and y [um].
        use_all: also use heights that are not valid.

    Raises:
        SceneError: the pitch is not > 0, or the grid would have more than `MAX_PIXELS` pixels.
        GuardError: no height is valid.
    """
    if not (math.isfinite(grid_pitch) and grid_pitch > 0):
        raise SceneError(f"grid pitch must be > 0 um, got {grid_pitch:g}")
    is_known = np.isfinite(rec.height) & (rec.is_valid | use_all)
    if not is_known.any():
        raise GuardError("no height is valid, so that none can be resampled: use --invalid keep")
    x, y = (_axis(np.broadcast_to(at, rec.height.shape)[is_known], grid_pitch) for at in (rec.x, rec.y))
    if x.size * y.size > MAX_PIXELS:
        raise SceneError(
            f"a grid of {grid_pitch:g} um has {x.size} x {y.size} pixels, at most {MAX_PIXELS / 1e6:g} million can be: "
            "choose a larger pitch"
        )
    height, std = heights_at(rec, x, y, is_known)
    return HeightMap(
        height=height,
        x=x,
        y=y,
        height_std=None if rec.height_std is None else std,
        status=rec.status,
        provenance={**rec.provenance},
    )


def heights_at(
    rec: Reconstruction, x: np.ndarray, y: np.ndarray, is_known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the topmost height at every x, y of the sample frame [um], and its standard deviation [y, x]; NaN: unknown.

    Args:
        rec: heights; its standard deviations, if it has any, are interpolated as they are.
        x, y: positions; a line has one x or one y.
        is_known: which heights are used [y, x], at least one.
    """
    cells = _Cells(rec, is_known)
    height, std = np.full((y.size, x.size), np.nan), np.full((y.size, x.size), np.nan)
    level_above, gap_above = 0.0, np.full(height.shape, np.nan)
    is_open = np.ones(height.shape, bool)  # no surface was met above
    for level in _levels(rec, rec.height[is_known]):
        found, found_std = cells.at(x + level * rec.instrument.beam_shift[0], y, level * rec.instrument.beam_shift[1])
        gap = found - level  # negative above the surface
        meets = is_open & (gap >= 0)
        share = np.where(gap_above < 0, gap / (gap - gap_above), np.where(gap == 0, 0.0, np.nan))
        height = np.where(meets, level + share * (level_above - level), height)
        std = np.where(meets & np.isfinite(height), found_std, std)
        is_open &= ~meets
        level_above, gap_above = level, gap
    return height, std


def _axis(values: np.ndarray, step: float) -> np.ndarray:
    """Return grid positions from the lowest to the highest value."""
    low, high = float(values.min()), float(values.max())
    return low + step * np.arange(math.floor((high - low) / step + 1e-6) + 1)


def _levels(rec: Reconstruction, known: np.ndarray) -> np.ndarray:
    """Return the levels of the search, downwards, so dense that the raster position moves by `_STEP` pitches."""
    low, high = float(known.min()), float(known.max())
    steps = (pitch(rec.raster_x), pitch(rec.raster_y))
    moved = max(abs(t) * (high - low) / step for t, step in zip(rec.instrument.beam_shift, steps, strict=True))
    n = math.ceil(moved / _STEP) + 2
    margin = 1e-6 * (high - low) + 1e-9
    return np.linspace(high + margin, low - margin, n)


class _Cells:
    """Bilinear interpolation between the pixels of a reconstruction."""

    def __init__(self, rec: Reconstruction, is_known: np.ndarray) -> None:
        self.rec, self.is_known = rec, is_known
        self.std = rec.height if rec.height_std is None else rec.height_std
        self.max_difference = WALL_PITCHES * max(pitch(rec.raster_x), pitch(rec.raster_y))

    def at(self, x: np.ndarray, y: np.ndarray, shift_y: float) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate height and standard deviation at beam positions x, y + shift_y [y, x]; NaN: unknown."""
        first, weight_x = _places(x, self.rec.raster_x)
        row, weight_y = _places(y + shift_y, self.rec.raster_y)
        total, total_std, highest, lowest = 0.0, 0.0, -np.inf, np.inf
        for i, wy in ((row, 1 - weight_y), (np.minimum(row + 1, self.rec.raster_y.size - 1), weight_y)):
            for j, wx in ((first, 1 - weight_x), (np.minimum(first + 1, self.rec.raster_x.size - 1), weight_x)):
                weight, place = wy[:, None] * wx[None, :], np.ix_(i, j)
                is_used = weight != 0.0
                height = np.where(self.is_known[place], self.rec.height[place], np.nan)
                total = total + np.where(is_used, weight * height, 0.0)
                total_std = total_std + np.where(is_used, weight * self.std[place], 0.0)
                highest = np.maximum(highest, np.where(is_used, height, -np.inf))
                lowest = np.minimum(lowest, np.where(is_used, height, np.inf))
        is_cell = (highest - lowest <= self.max_difference) & np.isfinite(highest)
        return np.where(is_cell, total, np.nan), np.where(is_cell, total_std, np.nan)


def _places(values: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of two pixels for each value and the weight of the second; NaN beyond the outermost pixels."""
    at = (values - axis[0]) / pitch(axis)
    at = np.where(np.abs(at - np.round(at)) < 1e-9, np.round(at), at)
    is_inside = (at >= -_STEP) & (at <= axis.size - 1 + _STEP)  # the search steps over the edge of the raster
    first = np.clip(np.floor(at), 0, max(axis.size - 2, 0))
    return first.astype(int), np.where(is_inside, at - first, np.nan)
