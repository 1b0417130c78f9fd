"""Plateaus: regions that depth jumps part from the substrate, found in the images.

Slopes say nothing about the height of a floor behind a wall that the beam does not see: a least-squares fit bridges the
wall by slopes that the images contradict. The images show the wall, though: across a mask's edge one detector changes,
across a wall two or more do. `find_plateaus` parts the image along such lines; `levels` puts each region to the level
that it asks for.
"""

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation, label, maximum_filter, uniform_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from helio_jax.forward.surface import along
from helio_jax.inverse.edges import ranked
from helio_jax.inverse.quality import squares

WALL = 25.0
"""Change across an edge (chi-square without the detector that changes most) from which on it may be a wall: noise alone
reaches it in fewer than one edge of 250 000."""
_HALF_LENGTHS = (3, 7)
"""Pixels to both sides, along the edge, over which its change is averaged: short for corners, long for weak steps."""
MIN_REGION = 50
"""Smallest region that is looked for [pixels]."""
UNEXPLAINED = 2.0
"""Mean square residual, in a region or along its border, in those of the substrate, above which levels are tried."""
_UNKNOWN = 1e6
"""Variance of data that were not observed, in those of the worst ones: finite, for running means."""
_BAND = 3
"""Half width of a region's border [pixels]."""


def wall_strength(signal: np.ndarray, variance: np.ndarray, axis: int, half: int) -> np.ndarray:
    """Compute the change across every edge, in chi-square without the detector that changes most.

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
    """Keep the strength of the edges [y, x] that are stronger than the edges before and after them, 0 elsewhere."""
    size = [1, 1]
    size[axis] = 3
    return np.where(strength >= maximum_filter(strength, size), strength, 0.0)


def _numbered(mask: np.ndarray) -> np.ndarray:
    """Number, from 1, the connected areas of a mask [y, x]; 0 outside."""
    return np.asarray(label(mask)[0])  # type: ignore[index]  # SciPy's stubs take the result for a number


def grown(mask: np.ndarray) -> np.ndarray:
    """Grow a mask [y, x] by `_BAND` pixels."""
    return np.asarray(binary_dilation(mask, iterations=_BAND))


def find_plateaus(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Find the number of every pixel's region [y, x], 0 being the largest: the substrate.

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
    # every seed hangs together and on the root by the cheapest links; all else joins by the rest of 1 + strength
    cost = np.concatenate([*(1.0 + s.ravel() for s in strength), np.full(inside.size, 1e-3), np.full(seed.max(), 1e-6)])
    tree = minimum_spanning_tree(coo_matrix((cost, (start, end)), shape=(tip, tip)).tocsr()).tocoo()
    kept = (tree.row != root) & (tree.col != root)
    links = coo_matrix((tree.data[kept], (tree.row[kept], tree.col[kept])), shape=(tip, tip))
    return ranked(connected_components(links, directed=False)[1][: seed.size]).reshape(shape)


def unexplained(region: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Set regions whose images the fit explains to 0 [y, x].

    Args:
        region: from `find_plateaus` [y, x].
        residuals: of the fit, in standard deviations [detector, y, x].
    """
    square = squares(residuals).mean(0)
    limit = UNEXPLAINED * square[region == 0].mean()
    left = region.copy()
    for number in range(1, int(region.max()) + 1):
        inside = region == number
        band = grown(inside) & grown(~inside)
        if max(square[inside].mean(), square[band].mean()) <= limit:
            left[inside] = 0
    return left


def joined(region: np.ndarray) -> np.ndarray:
    """Join regions that (nearly) touch, with the gaps between them [y, x].

    Inside a plateau masks may end along strong edges, too.
    """
    room = np.pad(region > 0, _BAND, mode="edge")
    return _numbered(np.asarray(binary_closing(room, np.ones((2 * _BAND + 1,) * 2))))[_BAND:-_BAND, _BAND:-_BAND]
