"""Horizon search (numba): which crossing of a march each point of a surface sees steepest.

The search only chooses; nothing of it is differentiated, so it need not be written in JAX: every point marches alone
and stops where nothing farther away could matter, which is at once for most of them. `masking` evaluates the chosen
crossing, differentiably. Crossings are encoded as integers, so that the result depends on no table of this module.
Source: horizons of height fields: Max, Vis. Comput. 4 (1988) 109.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from helio_jax.arrays import WALL_PITCHES
from helio_jax.kernel import kernel

OUTSIDE, IS_SAMPLE = -1e9, -1e8
"""Height outside of the raster, which masks nothing, and least height of a sample [um]."""
TINY = 1e-12
"""Steps per um below which a ray counts as parallel to the grid lines."""
BETWEEN, ACROSS, BESIDE, BEFORE = range(4)
"""Where the horizon stands: at the crossing; at a wall half-way between its two pixels, or half a step before both; at
the crossing before."""


class March(NamedTuple):
    """Where the ray of one azimuth crosses the grid lines of the raster, by growing distance.

    `line` [step] is 2 n + axis of the n-th row (axis 0) or column (axis 1) that the ray meets. `first` and `second`
    [step, 2] are the raster positions (row, column), relative to the point, between which the height is interpolated.
    `share` [step, 2] is that of the second one, as it is and rounded. `distance` [step, 4, um], infinite off the
    raster, is for each of the places `BETWEEN` to `BEFORE`.
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


def plan_march(direction: np.ndarray, shape: tuple[int, int], dx: float, dy: float) -> March:
    """Compute the crossings of a ray with all grid lines, where the surface is linear between two pixels.

    True of a triangulated and of a bilinear surface; what they do between the lines is where they differ.

    Args:
        direction: azimuth (x, y), unit.
        shape: of the raster (y, x).
        dx, dy: its pitch, um.
    """
    step = np.array(steps_per_um(direction, dx, dy))
    parts = []
    for axis in (0, 1):
        number = np.arange(1, shape[axis])
        distance = number / np.abs(step[axis])
        across = distance * step[1 - axis]
        low = np.floor(across)
        is_inside = np.abs(across) <= shape[1 - axis] - 1
        first = np.stack([distance * step[axis], low], -1)[:, :: 1 - 2 * axis]
        first = np.where(is_inside[:, None], np.rint(first), 0.0).astype(np.int32)
        second = first + np.array([axis, 1 - axis], np.int32)
        distance = np.where(is_inside, distance, np.inf)
        share = np.stack([across - low, np.rint(across - low)], -1)
        wall = distance - np.abs(share[:, 0] - 0.5) / np.abs(step[1 - axis]), distance - 0.5 / np.abs(step[axis])
        parts.append((2 * number + axis, first, second, share, np.stack([distance, *wall, distance], -1)))
    line, first, second, share, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(distance[:, BETWEEN])
    distance = distance[order]
    distance[:, BEFORE] = np.concatenate([[0.0], distance[:-1, BETWEEN]])
    return March(line[order], first[order], second[order], share[order], distance)


@kernel
def _search(height, top, plate, far, rise, tail, line, first, second, share, distance, tall, beyond, found):
    """Write the code of the crossing that each point sees steepest: 8 line + 2 place + (1 if rounded), 0: none."""
    ny, nx = height.shape
    for i in range(ny):
        for j in range(nx):
            here = before = height[i, j]
            best, sight = -np.inf, (plate - here) / far + rise - tail
            for s in range(distance.shape[0]):
                ahead, least = distance[s, BETWEEN], max(best, sight)
                if ahead == np.inf or (s > 0 and least > 0.0 and top[i, j] - here < least * (ahead - beyond)):
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


def find_horizons(height: np.ndarray, slices: np.ndarray, tail: float, dx: float, dy: float) -> np.ndarray:
    """Choose the crossing that each point sees steepest, for `masking` [slice, y, x].

    What is seen below the aperture masks nothing: a crossing there may be any.

    Args:
        height: heights [y, x], um.
        slices: of every slice: azimuth (x, y); height of the plate's plane above the point's own azimuthal centre, um;
            how far the aperture reaches, um; slope of the plane along the slice [slice, 5].
        tail: how much below the aperture's far end a crossing still counts, in slope of sight.
        dx, dy: raster pitch, um.
    """
    found = np.zeros((len(slices), *height.shape), np.int32)
    tall, beyond = WALL_PITCHES * max(dx, dy), math.hypot(dx, dy)
    plate, far, rise = slices[:, 2:].T
    sight = float(((plate - height.max()) / far + rise).min()) - tail
    reach = np.ptp(height) / max(sight, 1e-9) + beyond
    rows, columns = (int(min(math.ceil(reach / d), n)) for d, n in zip((dy, dx), height.shape, strict=True))
    top = maximum_filter(height, [2 * rows + 1, 2 * columns + 1])

    def search(s: int) -> None:
        march = plan_march(slices[s, :2], height.shape, dx, dy)
        _search(height, top, plate[s], far[s], rise[s], tail, *march, tall, beyond, found[s])

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(search, range(len(slices))))
    return found
