"""Multiple scattering from known first points, with guided first bounces.

Most atoms escape at once: 95 of 100 from a level substrate about a ball, and none of them adds to its multiple
scattering. So a pilot shoots one ray through each cell of the unit square from which first bounces are drawn, and the
paths take the cells by how much of them meets the surface. Weights keep the estimate unbiased, whatever the pilot saw.
A second pilot, of other rays from other pixels, says how many fewer paths have the noise of plain ones: an eighth about
a pyramid, almost all in a trench. The first one would not do: where little is met, as on a level surface with noise,
its guide knows just what it met itself. Only atoms that leave by the cosine law are guided; those of lobes draw their
directions otherwise.

Source: guiding in the space of random numbers: Guo, Bauszat, Bikker and Eisemann, Eurographics Symposium on Rendering
(2018) 27; densities in proportion to the root of the second moment: Rath et al., ACM Trans. Graph. 39 (2020) 151.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from helio_jax.kernel import kernel
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.intersect import MISS, Hits
from helio_jax.trace.random import low_discrepancy_points
from helio_jax.trace.run import RAYS_PER_BLOCK, by_blocks, check_rays
from helio_jax.trace.source import PILOT, Sampling, bounce_number, first_bounce_shift, shifted
from helio_jax.trace.tally import FATES, LOST, STOPPED, Tally
from helio_jax.trace.transport import follow, launch_paths, scatter

AZIMUTHS, ELEVATIONS = 16, 8
"""Cells of a pilot along both random numbers of a bounce: equal in azimuth and in the sine of the elevation above the
surface, so that what lies low above a level substrate has cells of its own."""
UNGUIDED = 0.35
"""Share of the paths that take all cells alike: where the pilot met nothing, weights are up to 1 / UNGUIDED. With 0.2,
an eighth fewer paths would do, but the noise of the worst pixel is 1.5 times as large."""
MOST_PILOT = 0.25
"""Largest number of rays of the pilot, per plain path: it leaves out pixels where it would have more."""
TEST_STRIDE = 2
"""Every so many pixels of the pilot along both axes, the second pilot has one, half-way to the next ones."""
MOST_GAIN = 10.0
"""So many times fewer paths than plain ones at most: what both pilots missed would stand out in single pixels."""
LEAST_PER_PIXEL = 8
"""Paths of each pixel at least: with 2 of them single pixels of a 351 x 304 raster were off by 80 % of the signal."""
SECOND_PILOT = PILOT | 1 << 61
"""Offset of the pixel numbers for the second pilot, as `PILOT`."""
NEIGHBOURS = 0.6, 0.4
"""Gaussian width over which the cells met are averaged: in pixels of the pilot, and in cells."""
AREA = np.tile((2.0 * np.arange(ELEVATIONS) + 1.0) / (ELEVATIONS**2 * AZIMUTHS), (AZIMUTHS, 1))
"""Area of each cell of the unit square [azimuth, elevation]."""


@dataclass(frozen=True)
class Guide:
    """How paths are guided.

    Attributes:
        shares: probability that a path takes a cell [guide, azimuth, elevation].
        of_pixel: number of each pixel's guide [pixel].
        gain: variance of plain paths over that of as many guided ones, mean of the raster, by second moments of what
            the second pilot met; 1 to `MOST_GAIN`.
    """

    shares: np.ndarray
    of_pixel: np.ndarray
    gain: float


def trace_multiple(
    experiment: Experiment,
    first: Hits,
    x: np.ndarray,
    y: np.ndarray,
    n_paths: int,
    workers: int | None = None,
    max_lost: float = 1e-4,
) -> np.ndarray:
    """Compute the probability of detection after two or more scatterings [detector, y, x].

    Args:
        experiment: sample, instrument, laws and seed, of the expected estimator; the numbers of its rays are not used.
        first: first scattering points and the normals there, pixels in the order of the raster [y * x].
        x, y: beam positions at which the points are illuminated [y, x] [um].
        n_paths: plain paths, of all pixels together, whose noise is wanted. Guided ones are so many times fewer as the
            pilot finds, but each pixel has `LEAST_PER_PIXEL` at least, and 65536 at most.
        workers: number of threads; default: one per CPU.
        max_lost: largest share of atoms that may meet the surface from behind.

    Raises:
        GuardError: rays are unaccounted for, or a larger share than `max_lost` was lost.
    """
    flat = np.ascontiguousarray(x.ravel()), np.ascontiguousarray(y.ravel())
    guide = make_guide(experiment, first, *flat, x.shape, n_paths / x.size, workers)
    of_each = min(max(LEAST_PER_PIXEL, round(n_paths / x.size / guide.gain)), RAYS_PER_BLOCK)
    e = replace(experiment, sampling=Sampling.make(1, of_each, 1, experiment.sampling.seed), n_orders=2)
    ids, points = np.arange(x.size), low_discrepancy_points(of_each, 4)

    def trace(part: slice) -> tuple[np.ndarray, float, int]:
        tally = _trace_block(e, ids[part], flat[0][part], flat[1][part], first.take(part), guide, points)
        return tally.sums[1:].sum((0, 1)), tally.lost.sum(), int(np.abs(tally.fates.sum(0) - of_each).sum())

    found, lost, n_unaccounted = zip(*by_blocks(e, x.size, trace, workers), strict=True)
    fates = np.zeros(len(FATES))
    fates[LOST] = sum(lost)  # by weight: of as many plain paths
    check_rays(fates, sum(n_unaccounted), of_each * x.size, max_lost)
    return np.concatenate(found, -1).reshape(-1, *x.shape)


def make_guide(
    experiment: Experiment,
    first: Hits,
    x: np.ndarray,
    y: np.ndarray,
    shape: tuple[int, int],
    of_each: float,
    workers: int | None = None,
) -> Guide:
    """Shoot both pilots; arguments as those of `trace_multiple`, `of_each`: plain paths of each pixel."""
    stride = math.ceil(math.sqrt(AREA.size / (MOST_PILOT * max(of_each, LEAST_PER_PIXEL))))
    places = [np.arange(min(stride // 2, n - 1), n, stride) for n in shape]
    numbers = np.arange(x.size).reshape(shape)
    e = replace(experiment, sampling=Sampling.make(1, AREA.size, 1, experiment.sampling.seed))
    met, _ = _shoot(e, first, x, y, numbers[np.ix_(*places)].ravel(), PILOT, workers)
    shares = _shares(met.reshape(*(at.size for at in places), AZIMUTHS, ELEVATIONS))
    y_guide, x_guide = (np.minimum(np.arange(n) // stride, at.size - 1) for n, at in zip(shape, places, strict=True))
    of_pixel = (y_guide[:, None] * places[1].size + x_guide).ravel()
    others = [np.minimum(at[::TEST_STRIDE] + stride // 2, n - 1) for n, at in zip(shape, places, strict=True)]
    chosen = numbers[np.ix_(*others)].ravel()
    gain = _gain(shares[of_pixel[chosen]], *_shoot(e, first, x, y, chosen, SECOND_PILOT, workers))
    if gain < 1.0:
        return Guide(AREA[None], np.zeros(x.size, int), 1.0)
    return Guide(shares, of_pixel, min(gain, MOST_GAIN))


def _shoot(
    e: Experiment, first: Hits, x: np.ndarray, y: np.ndarray, chosen: np.ndarray, key: int, workers: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Shoot one ray through each cell of some pixels.

    Returns:
        Which of those that can be guided scatter again, and which of those of lobes [pixel, azimuth, elevation].
    """

    def shoot(part: slice) -> tuple[np.ndarray, np.ndarray]:
        at = chosen[part]
        ids = at + key
        paths, u = launch_paths(e, ids, x[at], y[at]), _cell_numbers(ids, e.sampling.seed)
        paths = scatter(e, 0, ids, first.take(at), paths, np.zeros(at.size, np.int64), u)
        hits = e.intersector.nearest(paths.origin, paths.direction, paths.skip)
        is_met, is_met_by_lobe = np.zeros((2, at.size, AREA.size), np.float32)
        is_scattered = (hits.surface != MISS) | (e.plate is not None)  # a plate sends atoms back
        is_guided = paths.density == 0.0
        is_met[paths.pixel, paths.path] = is_scattered & is_guided
        is_met_by_lobe[paths.pixel, paths.path] = is_scattered & ~is_guided
        return is_met, is_met_by_lobe

    parts = zip(*by_blocks(e, chosen.size, shoot, workers), strict=True)
    met, met_by_lobe = (np.concatenate(of_kind).reshape(-1, AZIMUTHS, ELEVATIONS) for of_kind in parts)
    return met, met_by_lobe


def _shares(met: np.ndarray) -> np.ndarray:
    """Return the shares of the cells by what was met in them [y, x, azimuth, elevation], as [guide, ...]."""
    pixels, cells = NEIGHBOURS
    beyond: Any = ("nearest", "nearest", "wrap", "nearest")
    met = gaussian_filter(met, (pixels, pixels, cells, cells), mode=beyond)
    wanted = AREA * np.sqrt(np.maximum(met.reshape(-1, AZIMUTHS, ELEVATIONS), 0.0))
    total = wanted.sum((1, 2), keepdims=True)
    wanted = np.where(total > 0.0, wanted / np.where(total > 0.0, total, 1.0), AREA)
    return (1.0 - UNGUIDED) * wanted + UNGUIDED * AREA


def _gain(shares: np.ndarray, met: np.ndarray, met_by_lobe: np.ndarray) -> float:
    """Return the second moment of plain paths over that of guided ones, of rays that did not make the guide.

    One more ray is counted as met in a cell that only unguided paths take: rays that meet something are few on an
    almost level surface. Where none is met there is no noise to speak of. All arrays: [pixel, azimuth, elevation].
    """
    if not (met.any() or met_by_lobe.any()):
        return MOST_GAIN
    by_lobes = float((AREA * met_by_lobe).sum())
    plain, guided = (float((AREA * met * weight).sum()) + by_lobes for weight in (1.0, AREA / shares))
    unseen = 1.0 / AREA.size if met.any() else 0.0
    return (plain + unseen) / (guided + unseen / UNGUIDED)


def _trace_block(
    e: Experiment, ids: np.ndarray, x: np.ndarray, y: np.ndarray, first: Hits, guide: Guide, points: np.ndarray
) -> Tally:
    """Trace the paths of some pixels from their second scattering on; `points`: low-discrepancy points [path, 4]."""
    s = e.sampling
    u, weights = _guided_numbers(ids, points, s.seed, guide.shares, guide.of_pixel[ids])
    tally = Tally.zeros(e.n_orders, len(e.apertures), len(ids), 1, s.n_rays, s.n_branches, weights)
    paths = scatter(e, 0, ids, first, launch_paths(e, ids, x, y), tally.fates[STOPPED], u)
    by_lobe = paths.density != 0.0
    weights[paths.pixel[by_lobe], paths.path[by_lobe]] = 1.0
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)
    follow(e, 1, ids, paths, offset, tally)
    return tally


@kernel
def _cell_numbers(ids, seed):
    """Compute the random numbers of one bounce through each cell of each pixel [pixels * cells, 4]."""
    n_cells = AZIMUTHS * ELEVATIONS
    out = np.zeros((ids.size * n_cells, 4))
    for row in range(out.shape[0]):
        cell = row % n_cells
        a, b, _, _ = bounce_number(seed, ids[row // n_cells], cell, 0)
        out[row, 0], out[row, 1] = _in_cell(cell // ELEVATIONS, cell % ELEVATIONS, a, b)
    return out


@kernel
def _in_cell(azimuth, elevation, a, b):
    """Return the point of the unit square that divides a cell so."""
    square = elevation**2 + a * (2 * elevation + 1)
    return 1.0 - square / ELEVATIONS**2, (azimuth + b) / AZIMUTHS


@kernel
def _guided_numbers(ids, points, seed, shares, of_pixel):
    """Compute the random numbers of the first bounces [pixels * paths, 4] and their weights [pixels, paths]."""
    n_paths, of_bounce, of_aperture = points.shape[0], points[:, :2], points[:, 2:]
    out, weights = np.empty((ids.size * n_paths, 4)), np.empty((ids.size, n_paths))
    by_azimuth, up_to = np.empty(AZIMUTHS), np.empty(AZIMUTHS)
    for p in range(ids.size):
        share = shares[of_pixel[p]]
        total = 0.0
        for i in range(AZIMUTHS):
            by_azimuth[i] = 0.0
            for j in range(ELEVATIONS):
                by_azimuth[i] += share[i, j]
            total += by_azimuth[i]
            up_to[i] = total
        shift_a, shift_b, shift_c, shift_d = first_bounce_shift(seed, ids[p], 0)
        for path in range(n_paths):
            a, b = shifted(shift_a, shift_b, of_bounce, path)
            c, d = shifted(shift_c, shift_d, of_aperture, path)
            b *= total
            i = 0
            while i < AZIMUTHS - 1 and b >= up_to[i]:
                i += 1
            b = min(max((b - up_to[i] + by_azimuth[i]) / by_azimuth[i], 0.0), 1.0 - 1e-15)
            a *= by_azimuth[i]
            j = 0
            while j < ELEVATIONS - 1 and a >= share[i, j]:
                a -= share[i, j]
                j += 1
            a = min(a / share[i, j], 1.0 - 1e-15)
            row = p * n_paths + path
            out[row, 0], out[row, 1] = _in_cell(i, j, a, b)
            out[row, 2], out[row, 3] = c, d
            weights[p, path] = (2 * j + 1) / (ELEVATIONS**2 * AZIMUTHS * share[i, j])
    return out, weights
