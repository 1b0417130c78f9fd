"""Upper edges of walls, found in the micrographs by the mask bands that begin at them.

A detector's mask band begins at the image of an upper edge and runs along -v (`wall_signal`): the edge, where the
signal falls along -v, is abrupt, the other end is a penumbra. Places where a signal falls below `SHADED` in
that direction are joined over all detectors and split into straight edges. Edges have any orientation; whether
one is a wall is decided in `band_fit`. Source of the splitting: Ramer, Comput. Graph. Image Process. 1 (1972) 244.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, label
from scipy.spatial import KDTree
from scipy.special import ndtr

from helio_jax.arrays import nearest_known, robust_std, typical_signals

MIN_LENGTH = 4.0
"""Shortest edge [pixels]."""
_NEAR = 1.7
"""Largest distance of neighbouring points of an edge [pixels]."""
_SMOOTH = 2.0
"""Distance over which normals are averaged [pixels]."""
_COS_TURN = np.cos(np.radians(22.5))
"""Cosine of the largest angle between a point's normal and the mean of its edge."""
_COS_SAME = np.cos(np.radians(20.0))
"""Cosine of the largest angle between two edges of which one lies on the other."""
_STRAIGHT = 0.6
"""Largest distance of the points of an edge from its line [pixels]."""
_ACROSS = 0.25
"""Least cosine of the angle between an edge's normal and a detector's -v."""
HALF, SHADED = 0.5, 0.7
"""Signal, in that of the level surface, below which a pixel counts as masked, and below which edges are looked for:
in pits multiple scattering fills the masks."""
_SEEN = 0.2
"""Least fraction of a dark region in which another detector has signal."""
_MIN_DARK = 3
"""Smallest dark region [pixels]."""


@dataclass(frozen=True)
class SignalLevels:
    """Signal of every detector where nothing masks it, and where everything does [detector]; fraction masked.

    Attributes:
        lit: signal of the level surface.
        floor, floor_std: signal without direct detection: the pedestal; 0 where the background is known.
        fraction: signal above the floor, in that of the level surface [detector, y, x]; NaN where not observed.
        is_dark: below `HALF` [detector, y, x].
        is_shaded: below `SHADED`, where edges are looked for [detector, y, x].
        probability: that the expected signal is below `HALF` [detector, y, x].
    """

    lit: np.ndarray
    floor: np.ndarray
    floor_std: np.ndarray
    fraction: np.ndarray
    is_dark: np.ndarray
    is_shaded: np.ndarray
    probability: np.ndarray


def find_levels(signal: np.ndarray, variance: np.ndarray, floor_known: bool) -> SignalLevels:
    """Find the masked pixels of every detector: near the floor, while another detector has signal.

    Args:
        signal: without background if that is known; NaN where not observed [detector, y, x].
        variance: of the signal [detector, y, x].
        floor_known: whether the signal is zero where no atom is detected. Otherwise the floor lies between zero and the
            darkest pixels, which multiple scattering fills.
    """
    lit = typical_signals(signal)
    floor, std = np.zeros_like(lit), np.zeros_like(lit)
    if not floor_known:
        dark = np.nanquantile(signal, 0.005, axis=(1, 2))
        floor = np.where(dark < 0.6 * lit, np.minimum(0.85 * dark, dark), 0.0)
        std = np.where(dark < 0.6 * lit, 0.15 * np.abs(dark), 0.1 * np.abs(lit))
    scale = np.maximum(lit - floor, 1e-12 * np.abs(lit) + 1e-300)[:, None, None]
    fraction = (signal - floor[:, None, None]) / scale
    noise = np.sqrt(np.maximum(variance, 0.0)) / scale
    with np.errstate(invalid="ignore"):
        probability = np.nan_to_num(ndtr((HALF - fraction) / np.maximum(noise, 1e-9)))
        is_dark, is_shaded = (_regions(fraction < limit, np.any(fraction >= limit, axis=0)) for limit in (HALF, SHADED))
    return SignalLevels(lit, floor, std, fraction, is_dark, is_shaded, probability * is_dark)


def _regions(dark: np.ndarray, is_seen: np.ndarray) -> np.ndarray:
    """Return the dark pixels [detector, y, x] in connected regions of which another detector sees a part."""
    out = np.zeros_like(dark)
    for k, image in enumerate(dark):
        number = np.asarray(label(image, np.ones((3, 3)))[0], np.intp)  # type: ignore[index]  # SciPy's stubs
        size, seen = np.bincount(number.ravel()), np.bincount(number.ravel(), is_seen.ravel())
        is_mask = (size >= _MIN_DARK) & (seen >= _SEEN * size)
        out[k] = image & is_mask[number]
    return out


def variance_of(counts: np.ndarray, variance: np.ndarray | None) -> np.ndarray:
    """Return the variance of counts [detector, y, x], where it is not given from second differences along the rows."""
    if variance is not None:
        return variance
    second = counts[..., 2:] - 2.0 * counts[..., 1:-1] + counts[..., :-2]
    return np.broadcast_to(robust_std(second, (1, 2)) ** 2 / 6.0, counts.shape)


@dataclass(frozen=True)
class Edge:
    """A straight upper edge in the raster, or a flat arc of a curved one.

    Attributes:
        start, end: beam positions (x, y) of the ends [2], um; the lower side lies to the right of start -> end.
        detectors: numbers of the detectors whose bands begin there.
        curvature: 1 / radius, positive where the upper side is convex, 1/um; the line is the mean of the arc.
    """

    start: np.ndarray
    end: np.ndarray
    detectors: tuple[int, ...]
    curvature: float = 0.0

    @property
    def middle(self) -> np.ndarray:
        """Middle of the edge [2]."""
        return 0.5 * (self.start + self.end)

    @property
    def length(self) -> float:
        """Length of the edge [um]."""
        return float(np.hypot(*(self.end - self.start)))

    @property
    def along(self) -> np.ndarray:
        """Unit vector from start to end [2]."""
        return (self.end - self.start) / self.length

    @property
    def normal(self) -> np.ndarray:
        """Unit normal towards the lower side [2]."""
        return np.array([self.along[1], -self.along[0]])


def is_on(a: Edge, b: Edge, side: float) -> bool:
    """Return whether edge a lies on edge b; `side`: of a pixel [um]."""
    if a.normal @ b.normal < _COS_SAME:
        return False
    rel = np.stack([a.start, a.middle, a.end]) - b.middle
    away, along = np.abs(rel @ b.normal), np.abs(rel @ b.along)
    return bool(away[1] < 1.5 * side and along[1] < 0.5 * b.length)


def edge_points(fraction: np.ndarray, x: np.ndarray, y: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where a signal falls through `SHADED` along -v.

    Args:
        fraction: from `SignalLevels` of one detector, dark regions that are to be ignored filled [y, x].
        x, y: beam positions [um].
        v: direction of the detector plus beam shift [2].

    Returns:
        Beam positions [n, 2] um and unit normals towards the dark side [n, 2].
    """
    known = np.isfinite(fraction)
    filled = fraction[nearest_known(known)] if known.any() else np.ones(fraction.shape)
    slope = [
        gaussian_filter1d(gaussian_filter1d(filled, 1.0, axis, order=1), 1.0, 1 - axis) / (at[1] - at[0])
        for axis, at in ((1, x), (0, y))
    ]
    found = []
    for axis in (0, 1):
        first, second = (
            np.take(filled, i, axis) for i in (range(filled.shape[axis] - 1), range(1, filled.shape[axis]))
        )
        i, j = np.nonzero((first < SHADED) != (second < SHADED))
        t = (SHADED - first[i, j]) / (second[i, j] - first[i, j])
        step = (t * (axis == 0), t * (axis == 1))
        row, column = i + step[0], j + step[1]
        place = np.stack([np.interp(column, np.arange(x.size), x), np.interp(row, np.arange(y.size), y)], -1)
        i2, j2 = i + (axis == 0), j + (axis == 1)
        steep = np.stack([(1 - t) * g[i, j] + t * g[i2, j2] for g in slope], -1)
        found.append(np.concatenate([place, steep], 1))
    points = np.concatenate(found)
    size = np.hypot(points[:, 2], points[:, 3])
    points = points[size > 0]
    normal = -points[:, 2:] / size[size > 0, None]
    falls = normal @ v <= -_ACROSS * np.hypot(*v)
    return points[falls, :2], normal[falls]


def straight_edges(points: np.ndarray, normals: np.ndarray, detector: np.ndarray, side: float) -> list[Edge]:
    """Join points to edges and split these into straight ones.

    Args:
        points: beam positions [n, 2], um.
        normals: unit normals towards the lower side [n, 2].
        detector: number of the detector of each point [n].
        side: of a pixel [um].
    """
    if len(points) < 2:
        return []
    edges = []
    for inside in _grown(points, normals, side):
        for piece in _split(points, inside, side):
            edge = _edge(points[piece], normals[piece], detector[piece])
            if edge is not None and edge.length >= (MIN_LENGTH - 1.0) * side:
                edges.append(edge)
    return edges


def _grown(points: np.ndarray, normals: np.ndarray, side: float) -> list[np.ndarray]:
    """Grow chains of neighbouring points whose normals have nearly one direction [indices of the points of each].

    Normals are averaged over neighbours first; the mean direction of a chain is updated after every ring of neighbours.
    Source: von Gioi et al., IEEE PAMI 32 (2010) 722.
    """
    tree = KDTree(points)
    normals = np.stack([np.mean(normals[near], 0) for near in tree.query_ball_point(points, _SMOOTH * side)])
    normals /= np.maximum(np.hypot(normals[:, 0], normals[:, 1]), 1e-12)[:, None]
    neighbours = [np.array(near) for near in tree.query_ball_point(points, _NEAR * side)]
    is_free, chains = np.ones(len(points), bool), []
    for seed in range(len(points)):
        if not is_free[seed]:
            continue
        chain = ring = np.array([seed])
        is_free[seed] = False
        while ring.size:
            mean = normals[chain].sum(0)
            mean /= max(float(np.hypot(mean[0], mean[1])), 1e-12)
            near = np.unique(np.concatenate([neighbours[i] for i in ring]))
            ring = near[is_free[near] & (normals[near] @ mean >= _COS_TURN)]
            is_free[ring] = False
            chain = np.concatenate([chain, ring])
        chains.append(chain)
    return chains


def _split(points: np.ndarray, inside: np.ndarray, side: float) -> list[np.ndarray]:
    """Split a chain of points until every part lies along a line [indices of the points of each part]."""
    if len(inside) < 3:
        return [inside]
    offset = points[inside] - points[inside].mean(0)
    along = np.linalg.svd(offset, full_matrices=False)[2][0]
    u, away = offset @ along, offset @ [along[1], -along[0]]
    limit = _STRAIGHT * side
    # single points beyond the limit are noise: the median of three neighbours decides
    order = np.argsort(u)
    smooth = np.abs(np.convolve(np.pad(away[order], 2, mode="edge"), np.ones(5) / 5, mode="valid"))
    if smooth.max() <= limit or np.ptp(u) < 2.0 * MIN_LENGTH * side:
        return [inside]
    # the chain's ends span the chord; the point farthest from it is the corner
    a, b = offset[order[:3]].mean(0), offset[order[-3:]].mean(0)
    chord = (b - a) / max(np.hypot(*(b - a)), 1e-12)
    bulge = np.abs((offset[order] - a) @ [chord[1], -chord[0]])
    corner = int(np.argmax(bulge))
    if not 2 < corner < len(order) - 3:
        return [inside]
    parts = inside[order[:corner]], inside[order[corner:]]
    return [p for part in parts for p in _split(points, part, side)]


def _edge(points: np.ndarray, normals: np.ndarray, detector: np.ndarray) -> Edge | None:
    """Lay a line through the points of an edge."""
    if len(points) < 3:
        return None
    middle = points.mean(0)
    along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    if np.array([along[1], -along[0]]) @ normals.mean(0) < 0:
        along = -along
    u = (points - middle) @ along
    return Edge(middle + u.min() * along, middle + u.max() * along, tuple(sorted(set(detector.tolist()))))
