"""Where along a march each point of a surface sees it steepest (numba): the search within `visibility`.

The search only chooses, and nothing of it is differentiated, so it need not be written in JAX: every point marches
alone and stops where nothing farther away could matter, which is at once for most of them. `visibility` evaluates the
chosen crossing, differentiably.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from helio_jax.arrays import WALL_PITCHES
from helio_jax.kernel import kernel

OUTSIDE = -1e9
"""Height outside of the raster [um]: hides nothing."""
_BETWEEN, _ACROSS, _BESIDE, _BEFORE = range(4)


class March(NamedTuple):
    """Where the ray of one azimuth crosses the grid lines of the raster, by growing distance, static.

    `first` and `second` [step, 2] are the raster positions (row, column), relative to the point, between which the
    height is interpolated. `share` [step, 2] is that of the second one, as it is and rounded. `distance` [step, 4, um],
    infinite off the raster, is that of the crossing; of a wall half-way between two pixels, if it separates those two
    or if it runs beside both; and of the crossing before.
    """

    first: np.ndarray
    second: np.ndarray
    share: np.ndarray
    distance: np.ndarray


def plan_march(direction: np.ndarray, shape: tuple[int, int], dx: float, dy: float) -> March:
    """Return the crossings of a ray with all grid lines, where the surface is linear between two pixels.

    True of a triangulated and of a bilinear surface; what they do between the lines is where they differ.

    Args:
        direction: azimuth (x, y), unit.
        shape: of the raster (y, x).
        dx, dy: its pitch, um.
    """
    step = direction[::-1] / (dy, dx)  # (rows, columns) per um
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    parts = []
    for axis in (0, 1):
        distance = np.arange(1, shape[axis]) / np.abs(step[axis])
        across = distance * step[1 - axis]
        low = np.floor(across)
        is_inside = np.abs(across) <= shape[1 - axis] - 1
        first = np.stack([distance * step[axis], low], -1)[:, :: 1 - 2 * axis]
        first = np.where(is_inside[:, None], np.rint(first), 0.0).astype(np.int32)
        second = first + np.array([axis, 1 - axis], np.int32)
        distance = np.where(is_inside, distance, np.inf)
        share = np.stack([across - low, np.rint(across - low)], -1)
        wall = distance - np.abs(share[:, 0] - 0.5) / np.abs(step[1 - axis]), distance - 0.5 / np.abs(step[axis])
        parts.append((first, second, share, np.stack([distance, *wall, distance], -1)))
    first, second, share, distance = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(distance[:, _BETWEEN])
    distance = distance[order]
    distance[:, _BEFORE] = np.concatenate([[0.0], distance[:-1, _BETWEEN]])
    return March(first[order], second[order], share[order], distance)


@kernel
def _search(height, top, plate, far, tail, first, second, share, distance, tall, beyond, found):
    """Write what every point sees steepest [y, x] as 8 step + 2 place + (1 if the share is rounded)."""
    ny, nx = height.shape
    for i in range(ny):
        for j in range(nx):
            here = before = height[i, j]
            best, sight = -np.inf, (plate - here) / far - tail
            for s in range(distance.shape[0]):
                ahead, least = distance[s, _BETWEEN], max(best, sight)
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
                place = _BETWEEN
                if there - before > tall:
                    is_across = rounded == 1 and distance[s, _ACROSS] > distance[s, _BEFORE]
                    place = _ACROSS if is_across else _BESIDE
                    if distance[s, place] < distance[s, _BEFORE]:
                        place = _BEFORE
                slope = (there - here) / distance[s, place]
                if slope > best:
                    best = slope
                    found[i, j] = 8 * s + 2 * place + rounded
                before = there


def find_horizons(
    height: np.ndarray, plate: float, far: np.ndarray, tail: float, marches: March, dx: float, dy: float
) -> np.ndarray:
    """Return which crossing each point sees steepest, for `at_horizon` [slice, y, x].

    What is seen below the aperture hides nothing: a crossing there may be any.

    Args:
        height: heights [y, x], um.
        plate: height of the plate, um.
        far: how far the aperture reaches in each azimuth [slice], um.
        tail: how much below the aperture's far end a crossing still counts, in slope of sight.
        marches: of the azimuths, with a new first axis.
        dx, dy: raster pitch, um.
    """
    found = np.zeros((far.size, *height.shape), np.int32)
    tall, beyond = WALL_PITCHES * max(dx, dy), math.hypot(dx, dy)
    sight = (plate - height.max()) / far.max() - tail
    reach = np.ptp(height) / max(sight, 1e-9) + beyond
    rows, columns = (min(math.ceil(reach / d), n) for d, n in zip((dy, dx), height.shape, strict=True))
    top = maximum_filter(height, [2 * rows + 1, 2 * columns + 1])

    def search(s: int) -> None:
        first, second, share, distance = (column[s] for column in marches)
        _search(height, top, plate, far[s], tail, first, second, share, distance, tall, beyond, found[s])

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(search, range(far.size)))
    return found


def at_horizon(march: March, found: Any) -> tuple[Any, Any, Any]:
    """Return step, share of the second pixel and distance [um] of the chosen crossings [y, x]; JAX or NumPy arrays."""
    step = found >> 3
    return step, march.share[step, found & 1], march.distance[step, (found >> 1) & 3]
