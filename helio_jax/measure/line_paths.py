"""Linking of line responses to paths, and operations on paths: extend, cut, shift.

Local maxima of the score across the line are located to subpixel accuracy by a parabola and linked to neighbours along
the line; the longest of all shortest paths through a connected component is the line. Source: as in `lines`.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from helio_jax.measure.lines import Found, LineSettings

_LOBE, _LOBE_SHARE = 5.0, 0.6
"""Side lobes of the filters: their distance from a line [pixels], and their score over the line's, at most."""
_SMOOTH = 2.5
"""Standard deviation of the smoothing along a path [points, about a pixel apart]."""
_SIDE = 0.7
"""Largest component across the line of the distance between linked maxima more than a pixel apart."""
_REACH = 2.3
"""Largest distance of linked maxima [pixels]."""
_LOW = 0.6
"""Lower threshold, down to which a line is continued, over the upper one."""


@dataclass(frozen=True)
class Path:
    """A line: points (x, y) along it, about a pixel apart [n, 2], in pixels, and the largest score on it."""

    points: np.ndarray
    score: float

    @property
    def places(self) -> np.ndarray:
        """Length from the first point to each one [n], pixels."""
        return np.r_[0.0, np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))]

    @property
    def length(self) -> float:
        """Length [pixels]."""
        return float(self.places[-1])

    @property
    def tangents(self) -> np.ndarray:
        """Unit tangents [n, 2]."""
        tangent = np.gradient(self.points, axis=0)
        return tangent / np.hypot(*tangent.T)[:, None]

    @property
    def normals(self) -> np.ndarray:
        """Unit normals, to the left [n, 2]."""
        tangent = self.tangents
        return np.stack([-tangent[:, 1], tangent[:, 0]], -1)

    def sampled(self, n: int, start: float = 0.0, end: float | None = None) -> tuple[np.ndarray, "Path"]:
        """Sample n equally spaced places along the path [pixels]; return the places and the path through them."""
        places = self.places
        at = np.linspace(start, places[-1] if end is None else end, n)
        return at, Path(np.stack([np.interp(at, places, c) for c in self.points.T], -1), self.score)

    def extended(self, by: float) -> "Path":
        """Extend both ends straight, in the directions of the last few pixels."""
        n = min(len(self.points) - 1, 5)
        ends = []
        for here, inner in ((self.points[0], self.points[n]), (self.points[-1], self.points[-1 - n])):
            ends.append(here + by * (here - inner) / math.dist(here, inner))
        return Path(np.concatenate([ends[:1], self.points, ends[1:]]), self.score)

    def between(self, start: float, end: float) -> "Path":
        """Return the part between two places along the path [pixels], with points about a pixel apart."""
        return self.sampled(max(round(end - start), 2) + 1, start, end)[1]

    def within(self, inside: np.ndarray) -> "Path":
        """Return the part around the middle whose pixels are all inside [y, x]."""
        at, fine = self.sampled(max(round(4.0 * self.length), 8))
        x, y = np.round(fine.points.T).astype(int)
        on = (x >= 0) & (y >= 0) & (x < inside.shape[1]) & (y < inside.shape[0])
        on[on] = inside[y[on], x[on]]
        off, middle = np.flatnonzero(~on), at.size // 2
        first = max((i + 1 for i in off if i < middle), default=0)
        last = min((i - 1 for i in off if i > middle), default=at.size - 1)
        return self.between(at[first], at[last])

    def moved(self, aside: float) -> "Path":
        """Shift the path along its normals, to the left."""
        return Path(self.points + aside * self.normals, self.score)


def trace_lines(found: Found, s: LineSettings) -> list[Path]:
    """Link maxima across lines to paths, the strongest first.

    A path ends where its amplitude falls to half of its median: there half of the filter is beyond the line's end.
    """
    y, x = np.mgrid[: found.score.shape[0], : found.score.shape[1]].astype(float)
    u = np.stack([np.cos(found.angle), np.sin(found.angle)])
    beside = [
        ndimage.map_coordinates(found.score, [y + side * u[1], x + side * u[0]], order=1, mode="nearest")
        for side in (-1.0, 1.0, -2.0, 2.0)
    ]
    is_top = (
        (found.score >= _LOW * found.threshold)
        & (found.score >= np.max(beside[::2], 0))
        & (found.score > np.max(beside[1::2], 0))
    )
    rows, columns = np.nonzero(is_top)
    if rows.size < 2:
        return []
    before, here, after = beside[0][is_top], found.score[is_top], beside[1][is_top]
    shift = np.clip(0.5 * (before - after) / np.minimum(before - 2.0 * here + after, -1e-9), -0.5, 0.5)
    points = np.stack([columns + shift * u[0][is_top], rows + shift * u[1][is_top]], -1)
    pairs = cKDTree(points).query_pairs(_REACH, output_type="ndarray")
    bend = np.abs(found.angle[is_top][pairs[:, 0]] - found.angle[is_top][pairs[:, 1]])
    pairs = pairs[np.minimum(bend, np.pi - bend) <= np.pi / 4.0]
    apart = points[pairs[:, 0]] - points[pairs[:, 1]]
    distance = np.hypot(*apart.T)
    sideways = np.abs(np.sum(apart * np.stack([v[is_top] for v in u], -1)[pairs[:, 0]], -1))
    pairs, distance = (v[sideways <= np.maximum(_SIDE * distance, 1.0)] for v in (pairs, distance))
    graph = coo_matrix((distance**1.5 + 1e-6, (pairs[:, 0], pairs[:, 1])), shape=(rows.size,) * 2).tocsr()
    is_free = np.ones(rows.size, bool)
    paths = []
    while True:
        _, piece = connected_components(graph, directed=False)
        strongest = np.where(is_free, here, 0.0)
        start = int(np.argmax(strongest))
        if strongest[start] < found.threshold:
            break
        members = np.flatnonzero((piece == piece[start]) & is_free)
        order = _longest(graph, members)
        path = _trimmed(points[order], here[order], found.amplitude[is_top][order])
        if path is not None and path.length >= s.min_length_px and path.score >= found.threshold:
            paths.append(path)
        away, nearest = cKDTree(points[order]).query(points)
        is_free[away <= _REACH] = False
        is_free[(away <= _LOBE) & (here < _LOBE_SHARE * here[order][nearest])] = False
        keep = is_free.astype(float)
        graph = graph.multiply(keep[:, None]).multiply(keep[None, :]).tocsr()
        graph.eliminate_zeros()
    return paths


def _longest(graph, members: np.ndarray) -> np.ndarray:
    """Return the points along the longest of all shortest paths within a connected component, in order."""
    if members.size == 1:
        return members
    part = graph[members][:, members]
    start, far = 0, 0
    for _ in range(2):  # the farthest point from the farthest point
        start = far
        distance, previous = dijkstra(part, directed=False, indices=start, return_predecessors=True)
        far = int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
    order = [far]
    while order[-1] != start and previous[order[-1]] >= 0:
        order.append(int(previous[order[-1]]))
    return members[np.array(order)]


def _trimmed(points: np.ndarray, score: np.ndarray, amplitude: np.ndarray) -> Path | None:
    """Smooth a path and cut its ends at half of the amplitude; None where fewer than three points remain."""
    strong = np.flatnonzero(amplitude >= 0.5 * np.median(amplitude))
    if strong.size < 3 or strong[-1] - strong[0] < 2:
        return None
    kept = slice(int(strong[0]), int(strong[-1]) + 1)
    points = points[kept]
    around = np.concatenate([2.0 * points[0] - points[:0:-1], points, 2.0 * points[-1] - points[-2::-1]])
    smooth = ndimage.gaussian_filter1d(around, _SMOOTH, axis=0)[len(points) - 1 :][: len(points)]
    return Path(smooth, float(score[kept].max()))
