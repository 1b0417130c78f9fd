"""The surface that is measured: heights on a regular grid of the sample frame, with their errors and flags.

At normal incidence without a requested pitch the grid is the raster, unchanged. The raster of an oblique beam is
resampled (`sample_grid`). Posterior samples of the heights follow to the grid, so that errors keep their correlation.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.measure.sample_grid import resample_heights
from helio_jax.reconstruction import REASONS, Reconstruction

FLAGS = (*REASONS, "not seen by the beam")
"""Meaning of the integers of `SampleSurface.flag`."""
_UNSEEN = FLAGS.index("not seen by the beam")
_MISSING = FLAGS.index("outside the data")


@dataclass(frozen=True)
class SampleSurface:
    """Heights on a regular grid of the sample frame.

    Attributes:
        height: above the substrate [y, x], um; NaN where not valid.
        x, y: positions in the sample frame [um].
        flag: index into `FLAGS` [y, x].
        height_std: standard deviation of each height [y, x], um; None: unknown.
        height_samples: joint posterior deviations of the heights [sample, y, x], um; None: unknown.
        how: one sentence on how the heights came onto the grid.
    """

    height: np.ndarray
    x: np.ndarray
    y: np.ndarray
    flag: np.ndarray
    height_std: np.ndarray | None
    height_samples: np.ndarray | None
    how: str

    @property
    def steps(self) -> tuple[float, float]:
        """Pitch along y and x [um]."""
        return pitch(self.y), pitch(self.x)

    def read(self, field: np.ndarray, x: np.ndarray, y: np.ndarray, order: int = 1) -> np.ndarray:
        """Interpolate a field [y, x] at positions x, y [um]; bilinear, or the nearest pixel's value (`order=0`).

        An unknown corner makes the result NaN, unless its weight is 0.
        """
        dy, dx = self.steps
        at = np.stack([(y - self.y[0]) / dy, (x - self.x[0]) / dx])
        at = np.where(np.abs(at - np.round(at)) < 1e-9, np.round(at), at)
        if order == 0:
            return ndimage.map_coordinates(field, np.floor(at + 0.5), order=0, mode="nearest")
        known = ndimage.map_coordinates(np.isfinite(field).astype(float), at, order=1, mode="nearest") > 1.0 - 1e-9
        value = ndimage.map_coordinates(np.nan_to_num(field), at, order=1, mode="nearest")
        return np.where(known, value, np.nan)


def sample_surface(
    heights: Reconstruction | HeightMap, *, region: np.ndarray | None = None, grid_um: float | None = None
) -> SampleSurface:
    """Bring heights onto a regular grid of the sample frame; what is not valid becomes NaN, with a flag.

    Args:
        heights: a reconstruction, or a height map (all of whose finite heights are valid).
        region: True for the pixels of the raster that count [y, x]; default: all.
        grid_um: pitch of the grid [um]; default: the raster at normal incidence, else the raster's smaller pitch.

    Raises:
        SceneError: the region has another shape, or a height map is to be resampled.
        GuardError: no height is valid.
    """
    if region is not None and region.shape != heights.height.shape:
        raise SceneError(f"region must have the shape {heights.height.shape} of the heights, got {region.shape}")
    inside = np.ones(heights.height.shape, bool) if region is None else region.astype(bool)
    if isinstance(heights, HeightMap):
        if grid_um is not None:
            raise SceneError(f"a height map has its grid already: leave the pitch of {grid_um:g} um out")
        is_known = np.isfinite(heights.height) & inside
        return SampleSurface(
            height=np.where(is_known, heights.height, np.nan),
            x=heights.x,
            y=heights.y,
            flag=np.where(is_known, 0, _MISSING),
            height_std=heights.height_std,
            height_samples=None,
            how="the grid of the height map, not resampled",
        )
    rec, shift = heights, heights.instrument.beam_shift
    if grid_um is None and max(map(abs, shift)) < 1e-9:
        is_known = rec.is_valid & np.isfinite(rec.height) & inside
        return SampleSurface(
            height=np.where(is_known, rec.height, np.nan),
            x=rec.raster_x,
            y=rec.raster_y,
            flag=np.where(is_known, 0, _flags(rec)),
            height_std=rec.height_std,
            height_samples=rec.height_samples,
            how="the raster, which at normal incidence is a regular grid of the sample frame; not resampled",
        )
    step = grid_um or min(pitch(rec.raster_x), pitch(rec.raster_y))
    use = rec.replace(is_valid=rec.is_valid & inside)
    grid = resample_heights(use, step)
    samples = None if rec.height_samples is None else _samples_on(use, grid)
    return SampleSurface(
        height=grid.height,
        x=grid.x,
        y=grid.y,
        flag=_flags_on(rec, grid),
        height_std=grid.height_std if samples is None else np.sqrt(np.mean(samples**2, axis=0)),
        height_samples=samples,
        how=f"resampled bilinearly onto a grid of {step:g} um in the sample frame",
    )


def _flags(rec: Reconstruction) -> np.ndarray:
    """Return why each pixel of the raster is not valid [y, x]; a missing height without a reason: outside the data."""
    is_known = rec.is_valid & np.isfinite(rec.height)
    return np.where(is_known | (rec.reason > 0), rec.reason, _MISSING)


def _seen_from(rec: Reconstruction, grid: HeightMap, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column of the raster [pixels] at which the beam meets each point of a grid [y, x]."""
    tx, ty = rec.instrument.beam_shift
    row = (grid.y[:, None] + height * ty - rec.raster_y[0]) / pitch(rec.raster_y)
    column = (grid.x[None, :] + height * tx - rec.raster_x[0]) / pitch(rec.raster_x)
    return row, column


def _samples_on(rec: Reconstruction, grid: HeightMap) -> np.ndarray:
    """Bring posterior deviations to a grid, to first order [sample, y, x]; NaN where the height is unknown.

    Where the height seen at (X, Y) changes by d, the surface over a fixed (x, y) changes by d / (1 - a tx - b ty) with
    the beam-frame slopes a, b: the point moves along the beam.

    Source: own derivation, tests/unit/test_texture.py.
    """
    assert rec.height_samples is not None  # the caller checks
    is_known = np.isfinite(grid.height)
    at = np.stack([a[is_known] for a in _seen_from(rec, grid, grid.height)])
    known = rec.is_valid & np.isfinite(rec.height)
    height = np.where(known, rec.height, 0.0)
    low = np.floor(np.clip(at, 0, np.array([[n - 1.000001] for n in height.shape]))).astype(int)
    (i, j), (u, v) = low, at - low
    near, right, up, both = height[i, j], height[i, j + 1], height[i + 1, j], height[i + 1, j + 1]
    whole = known[i, j] & known[i, j + 1] & known[i + 1, j] & known[i + 1, j + 1]
    tx, ty = rec.instrument.beam_shift
    along = ((1 - u) * (right - near) + u * (both - up)) / pitch(rec.raster_x)
    across = ((1 - v) * (up - near) + v * (both - right)) / pitch(rec.raster_y)
    factor = np.where(whole, 1.0 / np.maximum(1.0 - along * tx - across * ty, 1e-3), 1.0)
    out = np.full((len(rec.height_samples), *grid.height.shape), np.nan)
    for own, deviation in zip(out, rec.height_samples, strict=True):
        own[is_known] = factor * ndimage.map_coordinates(np.where(known, deviation, 0.0), at, order=1, mode="nearest")
    return out


def _flags_on(rec: Reconstruction, grid: HeightMap) -> np.ndarray:
    """Return the flags of the points of a grid [y, x]: those of the pixels that show them, were all heights valid.

    Where a height is unknown between valid pixels, there is a depth jump between them.
    """
    is_known = np.isfinite(grid.height)
    everything = resample_heights(rec, pitch(grid.x), use_all=True)
    dx, dy = (round((own[0] - all_[0]) / pitch(own)) for own, all_ in ((grid.x, everything.x), (grid.y, everything.y)))
    rows, columns = (np.arange(n) + d for n, d in ((grid.y.size, dy), (grid.x.size, dx)))
    inside = ((rows >= 0) & (rows < everything.y.size))[:, None] & ((columns >= 0) & (columns < everything.x.size))
    place = np.ix_(np.clip(rows, 0, everything.y.size - 1), np.clip(columns, 0, everything.x.size - 1))
    height = np.where(inside, everything.height[place], np.nan)
    row, column = (np.nan_to_num(np.round(a, 9)) for a in _seen_from(rec, grid, height))
    seen, flags = np.zeros(height.shape, int), _flags(rec)
    for near_y in (np.round, np.floor, np.ceil):  # the nearest pixel's flag, else one of the other three's
        for near_x in (np.round, np.floor, np.ceil):
            i, j = (
                np.clip(f(a), 0, n - 1).astype(int)
                for f, a, n in zip((near_y, near_x), (row, column), flags.shape, strict=True)
            )
            seen = np.where(seen == 0, flags[i, j], seen)
    flag = np.where(np.isfinite(height), np.where(seen > 0, seen, FLAGS.index("depth jump")), _UNSEEN)
    return np.where(is_known, 0, flag)


def check_line(surface: SampleSurface, start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the length of a line between two points of the surface's field [um].

    Raises:
        SceneError: a point outside the field, or equal points.
    """
    for name, (x, y) in (("start", start), ("end", end)):
        if not (surface.x[0] <= x <= surface.x[-1] and surface.y[0] <= y <= surface.y[-1]):
            raise SceneError(
                f"profile {name} ({x:g}, {y:g}) um must lie in the field, x {surface.x[0]:g} to {surface.x[-1]:g}, "
                f"y {surface.y[0]:g} to {surface.y[-1]:g} um in the sample frame"
            )
    length = math.dist(start, end)
    if length == 0.0:
        raise SceneError(f"profile start and end must differ, got ({start[0]:g}, {start[1]:g}) um twice")
    return length
