"""Surface patches between upper edges, and their levels from the heights of the steps.

Upper edges that no detector's band marks (the shadowed side of an oblique beam) leave gaps between patches. The gaps
are closed by short lines: heights with the measured jumps across the edges, and further jumps where these let all
other differences vanish, by iteratively reweighted least squares with a falling tolerance.

Source: graduated non-convexity: Blake and Zisserman, Visual Reconstruction, MIT Press (1987).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from helio_jax.inverse.edges import neighbour_links, ranked
from helio_jax.inverse.mask_edges import Edge

_WEIGHTS = 1.0, 1.0, 0.5
"""Weight of a link along x, along y, and diagonal."""
_ITERATIONS = 20
_TOLERANCES = 0.3, 0.005
"""Difference of neighbouring pixels from which on it counts as a jump: first and last value, in the smallest step."""
_EXTENSION = 0.8
"""By how much edges are extended at both ends, to close corners [pixels]."""
_JOINED = 0.3
"""Largest difference of neighbouring pixels of one patch, in the smallest step."""
_SMALLEST = 9
"""Smallest patch [pixels]."""
_AVERAGED = 4.0 * np.pi
"""Pixels in whose mean the noise is that after a Gaussian filter of one pixel."""
_CHANGE = 4.0
"""Mean square change between neighbours at which a jump costs half [standard deviations squared]."""
_BESIDE = 2
"""Pixels beside a masked one whose signals the mask explains, too."""
_BORDER = 0.2
"""Weight of the links of the border to one common level."""
COMMON_STD = 0.006
"""Standard deviation of all levels in common, from what the model of a wall neglects, as a fraction."""


def _links(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the two pixels of every link to a neighbour, and its weight [link]."""
    first, second, way = neighbour_links(shape)
    return first, second, np.array(_WEIGHTS)[way]


def likeness(signal: np.ndarray, variance: np.ndarray, is_dark: np.ndarray) -> np.ndarray:
    """Return how alike the signals at the ends of every link of `_links` are, from near 0 to 1.

    Args:
        signal, variance: [detector, y, x]; NaN where not observed.
        is_dark: masked in some detector [y, x]: the mask explains a change of signals in and beside it.
    """
    known = np.isfinite(signal)
    smooth, noise = (
        np.asarray(gaussian_filter(np.where(known, field, 0.0), (0.0, 1.0, 1.0))) for field in (signal, variance)
    )
    noise = noise / _AVERAGED
    level, spread = (a.reshape(len(signal), -1) for a in (smooth, noise))
    first, second, _ = _links(signal.shape[1:])
    change = (level[:, first] - level[:, second]) ** 2 / np.maximum(spread[:, first] + spread[:, second], 1e-30)
    is_explained: np.ndarray = np.asarray(binary_dilation(is_dark, iterations=_BESIDE), bool).ravel()
    return np.where(
        np.logical_or(is_explained[first], is_explained[second]), 1.0, 1.0 / (1.0 + np.mean(change, 0) / _CHANGE)
    )


def _jumps(edges: Sequence[Edge], heights: np.ndarray, place: np.ndarray, side: float) -> np.ndarray:
    """Return the height of the second pixel of every link above the first, where the link crosses an edge; else 0."""
    first, second, _ = _links(place.shape[:2])
    jump, points = np.zeros(first.size), place.reshape(-1, 2)
    for edge, height in zip(edges, heights, strict=True):
        rel = points - edge.middle
        u, w = rel @ edge.normal, rel @ edge.along
        crosses = (u[first] < 0) != (u[second] < 0)
        share = np.abs(u[first]) / np.maximum(np.abs(u[first]) + np.abs(u[second]), 1e-12)
        at = w[first] + share * (w[second] - w[first])
        crosses &= np.abs(at) <= 0.5 * edge.length + _EXTENSION * side
        new = np.where(u[first] < 0, -height, height)  # down where the first one is above
        jump = np.where(crosses & (np.abs(new) > np.abs(jump)), new, jump)
    return jump


def patch_heights(
    edges: Sequence[Edge], heights: np.ndarray, place: np.ndarray, side: float, alike: np.ndarray | None = None
) -> np.ndarray:
    """Compute heights with given jumps at the edges and few other jumps [y, x], um.

    Args:
        edges: upper edges.
        heights: jump at each edge [edge], um.
        place: beam positions [y, x, 2], um.
        side: of a pixel [um].
        alike: from `likeness`; default: 1. Other jumps are preferred where signals differ, and avoided at the border.
    """
    shape = place.shape[:2]
    first, second, weight = _links(shape)
    jump = _jumps(edges, heights, place, side)
    n, scale = shape[0] * shape[1], max(float(np.min(heights)), 1e-9)
    # one more node is linked to the whole border: the surface around the steps is mostly one level
    pixel = np.arange(n).reshape(shape)
    border = np.unique(np.concatenate([pixel[0], pixel[-1], pixel[:, 0], pixel[:, -1]]))
    weight = np.where(jump == 0.0, weight * (1.0 if alike is None else alike), weight)
    weight = np.concatenate([weight, np.full(border.size, _BORDER)])
    first, second = np.concatenate([first, border]), np.concatenate([second, np.full(border.size, n)])
    jump = np.concatenate([jump, np.zeros(border.size)])
    row, value = np.tile(np.arange(first.size), 2), np.repeat([-1.0, 1.0], first.size)
    slope = csr_matrix((value, (row, np.concatenate([first, second]))), (first.size, n + 1))
    pinned = csr_matrix(([1e-6], ([n], [n])), (n + 1, n + 1))
    height, strength = np.zeros(n + 1), weight.copy()
    for tolerance in scale * np.geomspace(*_TOLERANCES, _ITERATIONS):
        normal = csc_matrix(slope.T @ diags_array(strength) @ slope + pinned)
        height = np.asarray(spsolve(normal, slope.T @ (strength * jump)))
        rest = slope @ height - jump
        strength = weight * tolerance**2 / (rest**2 + tolerance**2) + 1e-7
    return height[:n].reshape(shape)


def find_patches(
    edges: Sequence[Edge], heights: np.ndarray, place: np.ndarray, side: float, alike: np.ndarray | None = None
) -> np.ndarray:
    """Return the number of every pixel's patch [y, x]; 0: the largest one. Arguments as of `patch_heights`."""
    shape = place.shape[:2]
    if not len(edges):
        return np.zeros(shape, int)
    level = patch_heights(edges, heights, place, side, alike).ravel()
    first, second, weight = _links(shape)
    near = (weight == 1.0) & (np.abs(level[second] - level[first]) <= _JOINED * float(np.min(heights)))
    graph = coo_matrix((np.ones(near.sum()), (first[near], second[near])), (level.size,) * 2)
    group = connected_components(graph, directed=False)[1]
    return _without_small(group, level, first, second).reshape(shape)


def _without_small(group: np.ndarray, level: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Give the pixels of small patches to the neighbour of the nearest level; renumber by falling size [pixel].

    Small, too, is a strip without a pixel all of whose neighbours belong to it: the edge beside it was not closed.
    """
    is_inside = np.ones(group.size, bool)
    is_inside[np.concatenate([ends[group[first] != group[second]] for ends in (first, second)])] = False
    is_big = ((np.bincount(group) >= _SMALLEST) & (np.bincount(group, is_inside) > 0))[group]
    while not is_big.all():
        gap, best, owner = np.abs(level[first] - level[second]), np.full(level.size, np.inf), group.copy()
        for of, to in ((first, second), (second, first)):
            use = is_big[of] & ~is_big[to]
            order = np.argsort(-gap[use], kind="stable")  # the nearest last, so that it stays
            a, b, cost = of[use][order], to[use][order], gap[use][order]
            is_better = cost < best[b]
            owner[b[is_better]] = group[a[is_better]]
            best[b[is_better]] = cost[is_better]
        is_new = np.isfinite(best)
        if not is_new.any():
            break
        group, is_big = np.where(is_new, owner, group), is_big | is_new
    return ranked(np.unique(group, return_inverse=True)[1])


def sides_of(edge: Edge, patch: np.ndarray, place: np.ndarray, side: float) -> tuple[int, int]:
    """Return the patches above and below an edge: the most frequent ones a pixel beside it."""
    rel = place - edge.middle
    u, w = rel @ edge.normal, rel @ edge.along
    near = (np.abs(w) <= 0.5 * edge.length) & (np.abs(u) > 0.5 * side) & (np.abs(u) < 1.8 * side)
    out = [np.bincount(patch[near & is_side]) for is_side in (u < 0, u > 0)]
    return tuple(int(np.argmax(count)) if count.size else 0 for count in out)  # type: ignore[return-value]


@dataclass(frozen=True)
class PatchLevels:
    """Levels of patches above patch 0 [patch], um.

    Attributes:
        level, std: NaN where no step ties a patch to patch 0.
        chi2, dof: of the steps' agreement.
    """

    level: np.ndarray
    std: np.ndarray
    chi2: float
    dof: int


def solve_levels(n: int, above: np.ndarray, below: np.ndarray, height: np.ndarray, std: np.ndarray) -> PatchLevels:
    """Compute the levels of patches by weighted least squares; robust: steps beyond 3 deviations lose weight.

    Args:
        n: number of patches.
        above, below: patches of each step [step].
        height, std: of each step [step], um.
    """
    level, error = np.full(n, np.nan), np.full(n, np.nan)
    level[0] = error[0] = 0.0
    graph = coo_matrix((np.ones(len(above)), (above, below)), (n, n))
    group = connected_components(graph, directed=False)[1]
    tied = np.flatnonzero(group == group[0])
    free = tied[tied != 0]
    use = np.isin(above, tied) & (above != below)
    dof = int(use.sum()) - free.size
    if not free.size or not use.any():
        return PatchLevels(level, error, 0.0, 0)
    design = np.zeros((int(use.sum()), n))
    rows = np.arange(len(design))
    design[rows, above[use]] += 1.0
    design[rows, below[use]] -= 1.0
    a, b, sigma = design[:, free], height[use], std[use].copy()
    solution = np.zeros(free.size)
    for _ in range(20):
        solution = np.linalg.lstsq(a / sigma[:, None], b / sigma, rcond=None)[0]
        rest = np.abs(b - a @ solution) / std[use]
        sigma = std[use] * np.maximum(1.0, rest / 3.0)
    chi2 = float(np.sum(((b - a @ solution) / std[use]) ** 2))
    robust = float(np.sum(((b - a @ solution) / sigma) ** 2))
    birge = max(1.0, robust / dof) if dof > 0 else 1.0
    cov = np.linalg.pinv((a / sigma[:, None]).T @ (a / sigma[:, None])) * birge
    level[free], error[free] = solution, np.sqrt(np.diag(cov) + (COMMON_STD * solution) ** 2)
    return PatchLevels(level, error, chi2, dof)
