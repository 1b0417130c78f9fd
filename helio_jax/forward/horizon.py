"""Horizon search (numba): which crossing of a march each point of a surface sees steepest.

The search only chooses; nothing of it is differentiated, so it need not be written in JAX: every point marches alone
and stops where nothing farther away could matter, which is at once for most of them. `masking` evaluates the chosen
crossing, differentiably. Crossings are encoded as integers, so that the result depends on no table of this module.
Source: horizons of height fields: Max, Vis. Comput. 4 (1988) 109.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from helio_jax.arrays import WALL_PITCHES
from helio_jax.cpus import n_cpus
from helio_jax.kernel import kernel

OUTSIDE, IS_SAMPLE = -1e9, -1e8
"""Height outside of the raster, which masks nothing, and least height of a sample [um]."""
TINY = 1e-12
"""Steps per um below which a ray counts as parallel to the grid lines."""
BETWEEN, ACROSS, BESIDE, BEFORE = range(4)
"""Where the horizon stands: at the crossing; at a wall half-way between its two pixels, or half a step before both; at
the crossing before."""
_THREADED = 100_000
"""Fewer points, of all slices together, are searched without threads, whose start takes as long."""
_RING = 1.5
"""Ratio of the distances between which the steepest possible slope is taken of the highest surface there."""
_LEAST_DISTANCE = 1e-9
"""Of a wall that may stand at the point itself [um]."""
_PARTS = 4
"""Parts per thread, so that threads end at about the same time."""


class March(NamedTuple):
    """Where the ray of one azimuth crosses the grid lines of the raster, by growing distance, as far as it is inside.

    `line` [step] is 2 n + axis of the n-th row (axis 0) or column (axis 1) that the ray meets. `first` and `second`
    [step, 2] are the raster positions (row, column), relative to the point, between which the height is interpolated.
    `share` [step, 2] is that of the second one, as it is and rounded. `distance` [step, 4, um] is for each of the
    places `BETWEEN` to `BEFORE`.
    """

    line: np.ndarray
    first: np.ndarray
    second: np.ndarray
    share: np.ndarray
    distance: np.ndarray


def steps_per_um(direction: Any, dx: Any, dy: Any) -> tuple[Any, Any]:
    """Compute rows and columns per um along an azimuth (x, y) [..., 2]; never 0, so that distances stay finite."""
    rows, columns = direction[..., 1] / dy, direction[..., 0] / dx
    xp = rows.__array_namespace__()
    return tuple(xp.where(abs(s) < TINY, TINY, s) for s in (rows, columns))


@kernel
def _plan_march(x, y, ny, nx, dx, dy):
    """Compute the crossings of a ray with all grid lines, where the surface is linear between two pixels.

    True of a triangulated and of a bilinear surface; what they do between the lines is where they differ. Arguments:
    azimuth (x, y), unit; shape of the raster; its pitch, um.
    """
    per_um = y / dy, x / dx  # as `steps_per_um`
    step = np.array([TINY if abs(v) < TINY else v for v in per_um])
    shape, number, n = (ny, nx), np.array([1, 1]), ny + nx - 2
    line, first, second = np.empty(n, np.int32), np.empty((n, 2), np.int32), np.empty((n, 2), np.int32)
    share, distance = np.empty((n, 2)), np.empty((n, 4))
    ahead = np.empty(2)
    before = 0.0
    for s in range(n):
        for axis in range(2):
            at = number[axis] / abs(step[axis])
            is_inside = number[axis] < shape[axis] and abs(at * step[1 - axis]) <= shape[1 - axis] - 1
            ahead[axis] = at if is_inside else np.inf
        axis = 0 if ahead[0] <= ahead[1] else 1
        at, own, other = ahead[axis], abs(step[axis]), abs(step[1 - axis])
        if at == np.inf:
            return line[:s], first[:s], second[:s], share[:s], distance[:s]
        across = at * step[1 - axis]
        low = np.floor(across)
        line[s] = 2 * number[axis] + axis
        first[s, axis], first[s, 1 - axis] = np.rint(at * step[axis]), low
        second[s, axis], second[s, 1 - axis] = first[s, axis], first[s, 1 - axis] + 1
        share[s, 0], share[s, 1] = across - low, np.rint(across - low)
        distance[s, BETWEEN], distance[s, BEFORE] = at, before
        distance[s, ACROSS] = at - abs(share[s, 0] - 0.5) / other
        distance[s, BESIDE] = at - 0.5 / own
        before = at
        number[axis] += 1
    return line, first, second, share, distance


@kernel
def _search(height, top, steepest, plate, far, rise, tail, line, first, second, share, distance, tall, beyond, found):
    """Write the code of the crossing that each point sees steepest: 8 line + 2 place + (1 if rounded), 0: none."""
    ny, nx = height.shape
    for i in range(ny):
        for j in range(nx):
            here = before = height[i, j]
            best, sight = -np.inf, (plate - here) / far + rise - tail
            if steepest[i, j] <= sight:
                continue
            for s in range(distance.shape[0]):
                ahead, least = distance[s, BETWEEN], max(best, sight)
                if s > 0 and least > 0.0 and top[i, j] - here < least * (ahead - beyond):
                    break
                i1, j1, i2, j2 = i + first[s, 0], j + first[s, 1], i + second[s, 0], j + second[s, 1]
                is_first_in, is_second_in = 0 <= i1 < ny and 0 <= j1 < nx, 0 <= i2 < ny and 0 <= j2 < nx
                if s > 0 and not (is_first_in or is_second_in):
                    break
                one = height[i1, j1] if is_first_in else OUTSIDE
                two = height[i2, j2] if is_second_in else OUTSIDE
                rounded = 1 if abs(two - one) > tall else 0  # within a wall the nearer of its two pixels counts
                there = one + share[s, rounded] * (two - one)
                place = BETWEEN
                if there - before > tall:
                    is_across = rounded == 1 and distance[s, ACROSS] > distance[s, BEFORE]
                    place = ACROSS if is_across else BESIDE
                    if distance[s, place] < distance[s, BEFORE]:
                        place = BEFORE
                slope = (there - here) / distance[s, place]
                if slope > best and there > IS_SAMPLE:
                    best = slope
                    found[i, j] = 8 * line[s] + 2 * place + rounded
                before = there


@kernel
def _search_slices(height, top, steepest, slices, tail, pitch, tall, beyond, found, start, stop):
    """Search the slices `start` to `stop` of all images, counted through: arrays as in `find_horizons`."""
    n_slices, (ny, nx) = slices.shape[1], height.shape[1:]
    for number in range(start, stop):
        i, s = number // n_slices, number % n_slices
        x, y, plate, far, rise = slices[i, s]
        march = _plan_march(x, y, ny, nx, pitch[i, 1], pitch[i, 0])
        _search(height[i], top[i], steepest[i], plate, far, rise, tail, *march, tall[i], beyond[i], found[i, s])


def find_horizons(height: np.ndarray, slices: np.ndarray, tail: float, pitch: np.ndarray) -> np.ndarray:
    """Choose the crossing that each point sees steepest, for `masking` [image, slice, y, x].

    What is seen below the aperture masks nothing: a crossing there may be any.

    Args:
        height: heights [image, y, x], um.
        slices: of every slice: azimuth (x, y); height of the plate's plane above the point's own azimuthal centre, um;
            how far the aperture reaches, um; slope of the plane along the slice [image, slice, 5].
        tail: how much below the aperture's far end a crossing still counts, in slope of sight.
        pitch: dy, dx of the rasters [image, 2], um.
    """
    n_images, n_slices = slices.shape[:2]
    found = np.zeros((n_images, n_slices, *height.shape[1:]), np.int32)
    tall, beyond = WALL_PITCHES * pitch.max(1), np.hypot(*pitch.T)
    bounds = [_bound_horizons(*image, tail) for image in zip(height, slices, pitch, strict=True)]
    top, steepest = (np.stack(bound) for bound in zip(*bounds, strict=True))

    def search(start: int, stop: int) -> None:
        _search_slices(height, top, steepest, slices, tail, pitch, tall, beyond, found, start, stop)

    n, n_threads = n_images * n_slices, n_cpus()
    if found.size < _THREADED or n_threads == 1:
        search(0, n)
        return found
    ends = np.linspace(0, n, min(n, _PARTS * n_threads) + 1).astype(int)
    with ThreadPoolExecutor(n_threads) as pool:
        list(pool.map(search, ends[:-1], ends[1:]))
    return found


def _bound_horizons(
    height: np.ndarray, slices: np.ndarray, pitch: np.ndarray, tail: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bound what a point can see, so that a search may end: two fields [y, x].

    Returns:
        Highest surface within the distance from which anything can mask a point, um, and the largest possible slope up
        to it: of the highest surface within each ring of distances, at the inner edge of the ring. Walls may stand up
        to a cell's diagonal nearer than the crossing behind them.
    """
    if not np.isfinite(height).all():
        unbounded = np.full(height.shape, np.inf)
        return unbounded, unbounded
    plate, far, rise = slices[:, 2:].T
    sight = float(((plate - height.max()) / far + rise).min()) - tail
    diagonal, tall = math.hypot(*pitch), WALL_PITCHES * max(pitch)
    reach = min(np.ptp(height) / max(sight, 1e-9) + diagonal, math.hypot(*(pitch * height.shape)))
    inner, steepest = min(pitch), np.zeros(height.shape)
    while True:
        outer = inner * _RING
        size = [2 * int(min(math.ceil(outer / d), n)) + 1 for d, n in zip(pitch, height.shape, strict=True)]
        top = maximum_filter(height, size)
        has_walls = top - minimum_filter(height, size) > tall
        nearest = np.where(has_walls, inner - diagonal, inner)
        slope = (top - height) / np.maximum(nearest, _LEAST_DISTANCE)
        steepest = np.maximum(steepest, slope)
        if outer >= reach:
            return top, steepest * (1.0 + 1e-9)
        inner = outer
