"""Plateaus: regions that depth jumps part from the ground, found in the images.

Slopes say nothing about the height of a floor behind a wall that the beam does not see: a least-squares fit bridges the
wall by slopes that the images contradict. The images show the wall, though: across a mask's edge one detector changes,
across a wall two or more do. `find_plateaus` parts the image along such lines; `levels` puts each region to the level
that it asks for.
"""

import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_erosion,
    find_objects,
    gaussian_filter,
    gaussian_filter1d,
    label,
    maximum_filter,
    uniform_filter,
)
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from helio_jax.reconstruct.edges import along, ranked

WALL = 25.0
"""Change across an edge (chi-square without the detector that changes most) from which on it may be a wall: noise alone
reaches it in fewer than one edge of 250 000."""
_HALF_LENGTHS = (3, 7)
"""Pixels to both sides, along the edge, over which its change is averaged: short for corners, long for weak steps."""
_SHEARS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Directions of averaging: pixels by which a wall moves across the edge for each one along it."""
_BLUR, _SWEEP = 1.0, 3.0
"""Widths of the Gaussians under which the direction of walls is found: of the data, and of their gradients' products
[pixels]."""
_SIDE = 5
"""Side of the squares of which the parts on both sides of a border are compared [pixels]."""
_SEED = 12
"""Smallest area without a strong change that a region may grow from [pixels]."""
MIN_REGION = 50
"""Smallest region that is looked for [pixels]."""
UNEXPLAINED = 2.0
"""Mean square residual, within a region or along its border, in those of the ground, from which on levels are tried."""
_LARGEST = 25.0
"""A datum counts with this square at most."""
_UNKNOWN = 1e6
"""Variance of data that were not observed, in those of the worst ones: finite, for running means."""
_REACH, _ROUNDS = 3, 6
"""Half width of the square within which borders are straightened [pixels], and how often: by a pixel at most each."""
_BAND = 3
"""Half width of a region's border [pixels]."""


def _mean_along(field: np.ndarray, axis: int, half: int, shear: float) -> np.ndarray:
    """Return the means of 2 half + 1 pixels across `axis`, on a line that moves along it by `shear` [..., y, x]."""
    fields = np.moveaxis(field, 1 + axis, 2)
    room = np.pad(fields, ((0, 0), (half, half), (half, half)), mode="edge")
    rows, columns = fields.shape[1:]
    lines = ((half + i, half + round(shear * i)) for i in range(-half, half + 1))
    mean = sum(room[:, i : i + rows, j : j + columns] for i, j in lines) / (2 * half + 1)
    return np.moveaxis(np.asarray(mean), 2, 1 + axis)


def wall_strength(signal: np.ndarray, variance: np.ndarray, axis: int, half: int, shear: float = 0.0) -> np.ndarray:
    """Return the change across every edge, in chi-square without the detector that changes most.

    Two pixels on each side are compared, averaged over 2 half + 1 pixels along a wall, which may be oblique.

    Args:
        signal, variance: data [detector, y, x].
        axis: 0 (y) or 1 (x).
        half: pixels to both sides.
        shear: pixels by which the wall moves along `axis` for each one across it.
    """
    mean, spread = (_mean_along(field, axis, half, shear) for field in (signal, variance))
    spread = spread / (2 * half + 1)
    n = signal.shape[1 + axis] - 1

    def at(field: np.ndarray, offset: int) -> np.ndarray:
        return np.take(field, np.clip(np.arange(n) + offset, 0, n), 1 + axis)

    change = 0.5 * (at(mean, 1) + at(mean, 2) - at(mean, 0) - at(mean, -1))
    return _without_strongest(change**2 / (0.25 * sum(at(spread, i) for i in (-1, 0, 1, 2))))


def _without_strongest(square: np.ndarray) -> np.ndarray:
    """Return the sum over the detectors [detector, ...] without the largest."""
    return square.sum(0) - square.max(0)


def _structure(data: np.ndarray) -> np.ndarray:
    """Return the structure tensor (yy, xx, xy) of data [detector, y, x] in their deviations [3, y, x].

    Source: Di Zenzo, CVGIP 33 (1986) 116, for several channels; averaged: Bigun and Granlund, ICCV (1987) 433.
    """
    y, x = (gaussian_filter1d(gaussian_filter1d(data, _BLUR, axis, 1), _BLUR, 3 - axis) for axis in (1, 2))
    return gaussian_filter(np.stack([y * y, x * x, x * y]).sum(1), _SWEEP, axes=(1, 2))


def _strongest(data: np.ndarray, spread: np.ndarray, tensor: np.ndarray, axis: int) -> np.ndarray:
    """Return the change across every edge along an axis, averaged along the wall that may run there.

    Averages in all directions would find walls beside a strong one, too, where they cross it.

    Args:
        data, spread: [detector, y, x].
        tensor: from `_structure`.
        axis: 0 (y) or 1 (x).
    """
    yy, xx, xy = (0.5 * sum(along(part, axis)) for part in tensor)
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)  # of the steepest change, from x; the wall runs square to it
    y, x = np.cos(turn), -np.sin(turn)
    way, across = (x, y) if axis == 1 else (y, x)
    shear = np.clip(way / np.where(np.abs(across) < 1e-3, 1e-3, across), -1.0, 1.0)
    nearest = np.abs(np.subtract.outer(_SHEARS, shear)).argmin(0)
    found = [
        np.maximum.reduce([wall_strength(data, spread, axis, half, shear) for half in _HALF_LENGTHS])
        for shear in _SHEARS
    ]
    return np.choose(nearest, found)


def _crests(strength: np.ndarray, axis: int) -> np.ndarray:
    """Return the strength of the edges [y, x] that are stronger than the edges before and after them, 0 elsewhere."""
    size = [1, 1]
    size[axis] = 3
    return np.where(strength >= maximum_filter(strength, size), strength, 0.0)


def _numbered(mask: np.ndarray) -> np.ndarray:
    """Return the numbers, from 1, of the connected areas of a mask [y, x]; 0 outside."""
    return np.asarray(label(mask)[0])  # type: ignore[index]  # SciPy's stubs take the result for a number


def grown(mask: np.ndarray) -> np.ndarray:
    """Return a mask [y, x] grown by `_BAND` pixels."""
    return np.asarray(binary_dilation(mask, iterations=_BAND))


def find_plateaus(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the number of every pixel's region [y, x], 0 being the largest: the ground.

    Seeds are the connected areas without a strong change; they grow by a minimum spanning forest over the edges, so
    that their borders lie on the strongest edges between them. Then regions without a wall between them are merged, and
    borders are straightened.

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
    tensor = _structure(data / np.sqrt(spread))
    strength = [_strongest(data, spread, tensor, axis) for axis in (0, 1)]
    is_calm = np.ones(shape, bool)
    for axis, change in enumerate(strength):
        for end in along(is_calm, axis):
            end &= _crests(change, axis) <= WALL
    seed = _numbered(is_calm).ravel()
    seed[np.bincount(seed)[seed] < _SEED] = 0
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
    parts = ranked(connected_components(links, directed=False)[1][: seed.size]).reshape(shape)
    return _straightened(_merged(parts, data, spread), data, spread)


def _straightened(region: np.ndarray, data: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the regions [y, x] with the pixels at their borders given to the one that is locally more like them.

    Averages along walls cut corners. Like is whose mean within a square about the pixel is closer to the data about it.

    Source: localised region competition: Lankton and Tannenbaum, IEEE Trans. Image Process. 17 (2008) 2029.
    """
    for _ in range(_ROUNDS):
        nearest, best = region.copy(), np.full(region.shape, np.inf)
        for number in range(int(region.max()) + 1):
            inside = region == number
            if not inside.any():
                continue
            room = tuple(slice(max(i.min() - _REACH, 0), i.max() + _REACH + 1) for i in np.nonzero(inside))
            mean = _mean_within(inside[room], data[:, *room], 2 * _REACH + 1)
            misfit = uniform_filter(((data[:, *room] - mean) ** 2 / spread[:, *room]).sum(0), 3)
            is_better = np.asarray(binary_dilation(inside[room]), bool) & (misfit < best[room])
            best[room] = np.where(is_better, misfit, best[room])
            nearest[room] = np.where(is_better, number, nearest[room])
        region = nearest
    return ranked(region.ravel()).reshape(region.shape)


def _mean_within(inside: np.ndarray, field: np.ndarray, side: int) -> np.ndarray:
    """Return the mean of a field [..., y, x] over the part of a square about every pixel that is inside [y, x]."""
    n = uniform_filter(inside.astype(float), side, mode="constant")
    return uniform_filter(inside * field, side, mode="constant", axes=(-2, -1)) / np.maximum(n, 1e-9)


def _border_strength(first: np.ndarray, second: np.ndarray, data: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the change across the common border of two areas [y, x], up to `WALL`, for every pixel beside it [pixel].

    The parts of a square about the pixel that lie in one and in the other area are compared, so that it does not matter
    how the border runs, nor what is beyond its ends.
    """
    at_border = (first & np.asarray(binary_dilation(second))) | (second & np.asarray(binary_dilation(first)))
    means, variances = [], []
    for area in (first, second):
        n = _SIDE**2 * uniform_filter(area.astype(float), _SIDE, mode="constant")
        means.append(_mean_within(area, data, _SIDE))
        variances.append(_mean_within(area, spread, _SIDE) / np.maximum(n, 1e-9))
    square = (means[1] - means[0]) ** 2 / np.maximum(variances[0] + variances[1], 1e-300)
    return np.minimum(_without_strongest(square), WALL)[at_border]


def _borders(region: np.ndarray, data: np.ndarray, spread: np.ndarray) -> dict[frozenset[int], np.ndarray]:
    """Return the `_border_strength` of every two regions that touch [pixel], by their numbers."""
    ends = [np.stack([end.ravel() for end in along(region, axis)]) for axis in (0, 1)]
    pairs = np.unique(np.sort(np.concatenate(ends, 1), axis=0), axis=1).T
    rooms = find_objects(region + 1)
    found = {}
    for a, b in pairs[pairs[:, 0] != pairs[:, 1]].tolist():
        room = tuple(
            slice(max(i.start, j.start, _SIDE) - _SIDE, min(i.stop, j.stop) + _SIDE)
            for i, j in zip(rooms[a], rooms[b], strict=True)
        )
        part = region[room]
        found[frozenset((a, b))] = _border_strength(part == a, part == b, data[:, *room], spread[:, *room])
    return found


def _merged(region: np.ndarray, data: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the regions [y, x] with those merged, weakest border first, between which there is no wall, or too small.

    Averages along a wall reach beyond its end, up to the image's border, and would part the ground there.
    """
    border, size, into = _borders(region, data, spread), np.bincount(region.ravel()), np.arange(region.max() + 1)
    while True:
        mean = {pair: float(found.mean()) for pair, found in border.items()}
        weak = [pair for pair in border if mean[pair] < 0.5 * WALL or min(size[list(pair)]) < MIN_REGION]
        if not weak:
            return ranked(into[region].ravel()).reshape(region.shape)
        kept, gone = sorted(min(weak, key=mean.__getitem__))
        into[into == gone] = kept
        size[kept] += size[gone]
        del border[frozenset((kept, gone))]
        for pair in [pair for pair in border if gone in pair]:
            other = pair - {gone} | {kept}
            border[other] = np.concatenate([border.pop(pair), border.get(other, np.zeros(0))])


def unexplained(region: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the regions with 0 put for those whose images the fit explains, and for what makes but thin rims [y, x].

    Args:
        region: from `find_plateaus` [y, x].
        residuals: of the fit, in standard deviations [detector, y, x].
    """
    square = np.minimum(np.nan_to_num(residuals) ** 2, _LARGEST).mean(0)
    limit = UNEXPLAINED * square[region == 0].mean()
    left = region.copy()
    for number in range(1, int(region.max()) + 1):
        inside = region == number
        band = grown(inside) & grown(~inside)
        if max(square[inside].mean(), square[band].mean()) <= limit:
            left[inside] = 0
    whole = joined(left)
    is_thick = np.asarray(binary_erosion(whole > 0, np.ones((2 * _BAND + 1,) * 2), border_value=1), bool)
    return np.where(np.isin(whole, whole[is_thick]), left, 0)


def joined(region: np.ndarray) -> np.ndarray:
    """Return the regions with those that (nearly) touch made one, gaps between them included [y, x].

    Inside a plateau masks may end along strong edges, too.
    """
    room = np.pad(region > 0, _BAND, mode="edge")
    return _numbered(np.asarray(binary_closing(room, np.ones((2 * _BAND + 1,) * 2))))[_BAND:-_BAND, _BAND:-_BAND]
