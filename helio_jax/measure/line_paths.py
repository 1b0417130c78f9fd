"""Maxima across lines joined to paths, which can be extended, cut and moved aside.

Pixels whose score is the largest across the line are placed between the pixels by a parabola and joined to their
neighbours along the line; the longest way through what hangs together is the line. Source: as in `lines`.
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
"""The filters' side lobes are within so many pixels of a line, and answer with less than this share of its score."""
_SMOOTH = 2.5
"""Standard deviation by which a line's course is smoothed [points, about a pixel apart]."""
_SIDE = 0.7
"""Maxima more than a pixel apart lie along the line: this share of their distance across it at most."""
_REACH = 2.3
"""Maxima at most so far apart belong to one line [pixels]."""


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
        """Return n places along the path in equal steps [pixels], and the path through the points there."""
        places = self.places
        at = np.linspace(start, places[-1] if end is None else end, n)
        return at, Path(np.stack([np.interp(at, places, c) for c in self.points.T], -1), self.score)

    def extended(self, by: float) -> "Path":
        """Return the path with both ends continued straight on, in the directions of the last few pixels."""
        n = min(len(self.points) - 1, 5)
        ends = []
        for here, inner in ((self.points[0], self.points[n]), (self.points[-1], self.points[-1 - n])):
            ends.append(here + by * (here - inner) / math.dist(here, inner))
        return Path(np.concatenate([ends[:1], self.points, ends[1:]]), self.score)

    def between(self, start: float, end: float) -> "Path":
        """Return the piece between two places along the path [pixels], with points about a pixel apart."""
        return self.sampled(max(round(end - start), 2) + 1, start, end)[1]

    def within(self, inside: np.ndarray) -> "Path":
        """Return the piece about the middle whose pixels are all inside [y, x]."""
        at, fine = self.sampled(max(round(4.0 * self.length), 8))
        x, y = np.round(fine.points.T).astype(int)
        on = (x >= 0) & (y >= 0) & (x < inside.shape[1]) & (y < inside.shape[0])
        on[on] = inside[y[on], x[on]]
        off, middle = np.flatnonzero(~on), at.size // 2
        first = max((i + 1 for i in off if i < middle), default=0)
        last = min((i - 1 for i in off if i > middle), default=at.size - 1)
        return self.between(at[first], at[last])

    def moved(self, aside: float) -> "Path":
        """Return the path moved along its normals, to the left."""
        return Path(self.points + aside * self.normals, self.score)


def trace_lines(found: Found, s: LineSettings) -> list[Path]:
    """Join maxima across a line to paths; the strongest first.

    A path ends where its amplitude has fallen to half of its median: there the filter is half over the line's end.
    """
    y, x = np.mgrid[: found.score.shape[0], : found.score.shape[1]].astype(float)
    u = np.stack([np.cos(found.angle), np.sin(found.angle)])
    beside = [
        ndimage.map_coordinates(found.score, [y + side * u[1], x + side * u[0]], order=1, mode="nearest")
        for side in (-1.0, 1.0, -2.0, 2.0)
    ]
    low = s.low_share * found.threshold
    is_top = (found.score >= low) & (found.score >= np.max(beside[::2], 0)) & (found.score > np.max(beside[1::2], 0))
    rows, columns = np.nonzero(is_top)
    if rows.size < 2:
        return []
    # the parabola through three scores across the line: where between the pixels it lies
    before, here, after = beside[0][is_top], found.score[is_top], beside[1][is_top]
    shift = np.clip(0.5 * (before - after) / np.minimum(before - 2.0 * here + after, -1e-9), -0.5, 0.5)
    points = np.stack([columns + shift * u[0][is_top], rows + shift * u[1][is_top]], -1)
    pairs = cKDTree(points).query_pairs(_REACH, output_type="ndarray")
    turn = np.abs(found.angle[is_top][pairs[:, 0]] - found.angle[is_top][pairs[:, 1]])
    pairs = pairs[np.minimum(turn, np.pi - turn) <= np.pi / 4.0]
    apart = points[pairs[:, 0]] - points[pairs[:, 1]]
    distance = np.hypot(*apart.T)
    sideways = np.abs(np.sum(apart * np.stack([v[is_top] for v in u], -1)[pairs[:, 0]], -1))
    pairs, distance = (v[sideways <= np.maximum(_SIDE * distance, 1.0)] for v in (pairs, distance))
    graph = coo_matrix((distance**1.5 + 1e-6, (pairs[:, 0], pairs[:, 1])), shape=(rows.size,) * 2).tocsr()
    left = np.ones(rows.size, bool)
    paths = []
    while True:
        _, piece = connected_components(graph, directed=False)
        strongest = np.where(left, here, 0.0)
        start = int(np.argmax(strongest))
        if strongest[start] < found.threshold:
            break
        members = np.flatnonzero((piece == piece[start]) & left)
        order = _longest(graph, members)
        path = _trimmed(points[order], here[order], found.amplitude[is_top][order])
        if path is not None and path.length >= s.min_length_px and path.score >= found.threshold:
            paths.append(path)
        away, nearest = cKDTree(points[order]).query(points)
        left[away <= _REACH] = False
        left[(away <= _LOBE) & (here < _LOBE_SHARE * here[order][nearest])] = False
        keep = left.astype(float)
        graph = graph.multiply(keep[:, None]).multiply(keep[None, :]).tocsr()
        graph.eliminate_zeros()
    return paths


def _longest(graph, members: np.ndarray) -> np.ndarray:
    """Return the points along the longest of all shortest ways within a connected piece, in order."""
    if members.size == 1:
        return members
    part = graph[members][:, members]
    start, far = 0, 0
    for _ in range(2):  # the farthest from the farthest
        start = far
        distance, previous = dijkstra(part, directed=False, indices=start, return_predecessors=True)
        far = int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
    way = [far]
    while way[-1] != start and previous[way[-1]] >= 0:
        way.append(int(previous[way[-1]]))
    return members[np.array(way)]


def _trimmed(points: np.ndarray, score: np.ndarray, amplitude: np.ndarray) -> Path | None:
    """Return the smoothed path without its ends beyond half of the amplitude; None where little is left."""
    strong = np.flatnonzero(amplitude >= 0.5 * np.median(amplitude))
    if strong.size < 3 or strong[-1] - strong[0] < 2:
        return None
    kept = slice(int(strong[0]), int(strong[-1]) + 1)
    points = points[kept]
    around = np.concatenate([2.0 * points[0] - points[:0:-1], points, 2.0 * points[-1] - points[-2::-1]])
    smooth = ndimage.gaussian_filter1d(around, _SMOOTH, axis=0)[len(points) - 1 :][: len(points)]
    return Path(smooth, float(score[kept].max()))
