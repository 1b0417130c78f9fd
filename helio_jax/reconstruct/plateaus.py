"""Plateaus: regions that depth jumps part from the ground, found in the images and set to the level they ask for.

Slopes say nothing about the height of a floor behind a wall that the beam does not see: a least-squares fit bridges the
wall by slopes that the images contradict. The images show the wall, though: across a mask's edge one detector changes,
across a wall two or more do. `find_plateaus` parts the image along such lines; `search_levels` tries each region at a
number of levels, flat and with the wall that the beam would see, all physics predicted anew, and keeps what explains the
images best. The level is then fitted like every other height, and its error bar says whether masks or the near field
fix it; a region that something else explains about as well is undecided.
"""

import math
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    distance_transform_edt,
    label,
    maximum_filter,
    uniform_filter1d,
)
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from helio_jax.errors import GuardError
from helio_jax.reconstruct.edges import along, ranked
from helio_jax.reconstruct.model import Surface
from helio_jax.reconstruct.validity import FLOATING

WALL = 25.0
"""Change across an edge (chi-square without the detector that changes most) from which on it may be a wall: noise alone
reaches it in fewer than one edge of 250 000."""
_HALF_LENGTHS = (3, 7)
"""Pixels to both sides, along the edge, over which its change is averaged: short for corners, long for weak steps."""
MIN_REGION = 50
"""Smallest region that is looked for [pixels]."""
UNEXPLAINED = 2.0
"""Mean square residual, within a region or along its border, in those of the ground, from which on levels are tried."""
_LARGEST = 25.0
"""A datum counts with this square at most."""
_UNKNOWN = 1e6
"""Variance of data that were not observed, in those of the worst ones: finite, for running means."""
_BAND = 3
"""Half width of a region's border [pixels]."""
_LEVELS = (0.0625, 0.125, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Levels that are tried, up and down, in widths of the region."""
GAIN = 30.0
"""By how much another level must lower the misfit [half chi-square] to be kept; what explains the images less than that
worse may be true as well."""
_LEVEL_STEPS = 8
"""Evaluations by which the best level is refined."""

Misfit = Callable[[Surface], tuple[float, Surface]]
"""Half the robust chi-square of a surface after its slopes have been fitted, and that surface."""


class Levels(NamedTuple):
    """What a search found: the surface, the regions that it moved, and those that other levels explain as well."""

    surface: Surface
    moved: list[int]
    undecided: list[int]


def wall_strength(signal: np.ndarray, variance: np.ndarray, axis: int, half: int) -> np.ndarray:
    """Return the change across every edge, in chi-square without the detector that changes most.

    Two pixels on each side are compared, averaged over 2 half + 1 pixels along the edge.
    """
    length = 2 * half + 1
    mean, spread = (np.asarray(uniform_filter1d(f, length, 2 - axis, mode="nearest")) for f in (signal, variance))
    spread = spread / length
    n = signal.shape[1 + axis] - 1

    def at(field: np.ndarray, offset: int) -> np.ndarray:
        return np.take(field, np.clip(np.arange(n) + offset, 0, n), 1 + axis)

    change = 0.5 * (at(mean, 1) + at(mean, 2) - at(mean, 0) - at(mean, -1))
    square = change**2 / (0.25 * sum(at(spread, i) for i in (-1, 0, 1, 2)))
    return square.sum(0) - square.max(0)


def _crests(strength: np.ndarray, axis: int) -> np.ndarray:
    """Return the strength of the edges [y, x] that are stronger than the edges before and after them, 0 elsewhere."""
    size = [1, 1]
    size[axis] = 3
    return np.where(strength >= maximum_filter(strength, size), strength, 0.0)


def _numbered(mask: np.ndarray) -> np.ndarray:
    """Return the numbers, from 1, of the connected areas of a mask [y, x]; 0 outside."""
    return np.asarray(label(mask)[0])  # type: ignore[index]  # SciPy's stubs take the result for a number


def _grown(mask: np.ndarray) -> np.ndarray:
    """Return a mask [y, x] grown by `_BAND` pixels."""
    return np.asarray(binary_dilation(mask, iterations=_BAND))


def find_plateaus(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the number of every pixel's region [y, x], 0 being the largest: the ground.

    Seeds are the connected areas without a strong change; they grow by a minimum spanning forest over the edges, so
    that their borders lie on the strongest edges between them.

    Args:
        signal, variance: data [detector, y, x]; NaN where not observed.

    Source: watershed cuts: Cousty, Bertrand, Najman, Couprie, IEEE PAMI 31 (2009) 1362, theorem 14.
    """
    shape = signal.shape[1:]
    is_known = np.isfinite(signal) & (variance > 0)
    if not is_known.any():
        return np.zeros(shape, int)
    data = np.where(is_known, signal, 0.0)
    spread = np.where(is_known, variance, _UNKNOWN * variance[is_known].max())
    strength = [
        _crests(np.maximum(*(wall_strength(data, spread, axis, half) for half in _HALF_LENGTHS)), axis)
        for axis in (0, 1)
    ]
    is_calm = np.ones(shape, bool)
    for axis, change in enumerate(strength):
        for end in along(is_calm, axis):
            end &= change <= WALL
    seed = _numbered(is_calm).ravel()
    seed[np.bincount(seed)[seed] < MIN_REGION] = 0
    inside = np.flatnonzero(seed)
    if inside.size == 0:
        return np.zeros(shape, int)
    pixel = np.arange(seed.size).reshape(shape)
    ends = [along(pixel, axis) for axis in (0, 1)]
    root, tip = seed.size, seed.size + seed.max() + 1  # nodes: pixels, the root, one for each seed
    start = np.concatenate([*(a.ravel() for a, _ in ends), inside, np.full(seed.max(), root)])
    end = np.concatenate([*(b.ravel() for _, b in ends), root + seed[inside], np.arange(root + 1, tip)])
    # every seed hangs together and on the root by the cheapest links; all else joins by what is left of 1 + strength
    cost = np.concatenate([*(1.0 + s.ravel() for s in strength), np.full(inside.size, 1e-3), np.full(seed.max(), 1e-6)])
    tree = minimum_spanning_tree(coo_matrix((cost, (start, end)), shape=(tip, tip)).tocsr()).tocoo()
    kept = (tree.row != root) & (tree.col != root)
    links = coo_matrix((tree.data[kept], (tree.row[kept], tree.col[kept])), shape=(tip, tip))
    return ranked(connected_components(links, directed=False)[1][: seed.size]).reshape(shape)


def unexplained(region: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the regions with 0 put for those whose images the fit explains [y, x].

    Args:
        region: from `find_plateaus` [y, x].
        residuals: of the fit, in standard deviations [detector, y, x].
    """
    square = np.minimum(np.nan_to_num(residuals) ** 2, _LARGEST).mean(0)
    limit = UNEXPLAINED * square[region == 0].mean()
    left = region.copy()
    for number in range(1, int(region.max()) + 1):
        inside = region == number
        band = _grown(inside) & _grown(~inside)
        if max(square[inside].mean(), square[band].mean()) <= limit:
            left[inside] = 0
    return left


def joined(region: np.ndarray) -> np.ndarray:
    """Return the regions with those that (nearly) touch made one, gaps between them included [y, x].

    Inside a plateau masks may end along strong edges, too.
    """
    room = np.pad(region > 0, _BAND, mode="edge")
    return _numbered(np.asarray(binary_closing(room, np.ones((2 * _BAND + 1,) * 2))))[_BAND:-_BAND, _BAND:-_BAND]


def _way_out(inside: np.ndarray, way: tuple[float, float], pitch: tuple[float, float]) -> np.ndarray:
    """Return how far it is from every pixel of a region to its end in a direction (x, y) [y, x], um; 0 outside.

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


def at_level(
    inside: np.ndarray,
    surface: Surface,
    level: float,
    ground: float,
    pitch: tuple[float, float],
    beam_shift: tuple[float, float] | None,
) -> Surface:
    """Return a surface with a region flat at a level above the ground, and with the wall that the beam sees, if any.

    The beam sees the wall that faces it: at the far side of a hollow, at the near side of a plateau. In the beam frame
    a vertical wall rises by the cotangent of the incidence along the beam. Deeper than the beam reaches, there is
    nothing but that wall.

    Args:
        inside: the region [y, x].
        surface: to begin with.
        level: above the ground, um.
        ground: height of the ground, um.
        pitch: dy, dx, um.
        beam_shift: `Instrument.beam_shift`; None: no wall, as where the region ends undercut.
    """
    flat = Surface(*(np.full(inside.shape, value) for value in (ground + level, 0.0, 0.0)))
    if beam_shift is not None:
        along, sign = math.hypot(*beam_shift), np.sign(level)
        x, y = (-sign * shift / along for shift in beam_shift)
        height = _way_out(inside, (x, y), pitch) / along
        is_wall = height < abs(level)
        values = (ground + sign * height, -sign * x / along, -sign * y / along)
        flat = Surface(*(np.where(is_wall, wall, field) for wall, field in zip(values, flat, strict=True)))
    return Surface(*(np.where(inside, new, field) for new, field in zip(flat, surface, strict=True)))


def search_levels(
    region: np.ndarray,
    surface: Surface,
    pitch: tuple[float, float],
    max_width: float,
    misfit: Misfit,
    beam_shift: tuple[float, float] = (0.0, 0.0),
    report: Callable[[str], None] = lambda said: None,
) -> Levels:
    """Return the surface with all regions at the levels that explain the images best.

    A moved region starts flat; its own relief is the fit's matter.

    Args:
        region: number of the region of every pixel, 0: none [y, x].
        surface: to begin with.
        pitch: dy, dx, um.
        max_width: levels up to twice the width of a region are tried, and of this width at most, um.
        misfit: see `Misfit`.
        beam_shift: `Instrument.beam_shift`: where it is not 0, levels are tried with and without the wall it sees.
        report: called with what is tried next.
    """
    best, found = misfit(surface)
    moved, undecided = [], []
    for number in np.unique(region[region > 0]):
        inside = region == number
        around = _grown(inside) & ~inside
        ground = float(np.median(found.height[around]))
        room = np.pad(inside, 1, mode="edge")
        width = min(2.0 * float(np.max(np.asarray(distance_transform_edt(room, sampling=pitch)))), max_width)
        tried: dict[bytes, tuple[float, Surface]] = {}

        def at(level: float, has_wall: bool, number=number, inside=inside, base=found, tried=tried, ground=ground):
            said = " and a wall" if has_wall else ""
            report(f"region {number} of {inside.sum()} pixels: trying the level {level:+.0f} um{said}")
            trial = at_level(inside, base, level, ground, pitch, beam_shift if has_wall else None)
            key = trial.height.tobytes()  # deeper than the beam reaches, levels are one surface
            if key not in tried:
                try:
                    tried[key] = misfit(trial)
                except GuardError:  # no level of a wall that nothing can be predicted of
                    tried[key] = np.inf, trial
            return tried[key][0]

        levels = sorted(sign * width * share for share in _LEVELS for sign in (-1.0, 1.0))
        kinds = (False, True) if any(beam_shift) else (False,)
        has_wall, i = min(product(kinds, range(len(levels))), key=lambda trial: at(levels[trial[1]], trial[0]))
        bracket = levels[max(i - 1, 0)], levels[min(i + 1, len(levels) - 1)]
        minimize_scalar(at, bounds=bracket, args=(has_wall,), method="bounded", options={"maxiter": _LEVEL_STEPS})
        explanations = [(best, found), *tried.values()]
        value, better = min(tried.values(), key=lambda entry: entry[0])
        if value < best - GAIN:
            best, found = value, better
            moved.append(int(number))
        if any(_differ(found, other, inside, ground) for value, other in explanations if value < best + GAIN):
            undecided.append(int(number))
    return Levels(found, moved, undecided)


def _differ(surface: Surface, other: Surface, inside: np.ndarray, ground: float) -> bool:
    """Return whether two surfaces' heights in a region differ by a large share of its step to the ground."""
    heights, others = surface.height[inside], other.height[inside]
    step = max(abs(float(np.median(h)) - ground) for h in (heights, others))
    return float(np.median(np.abs(heights - others))) > FLOATING * step
