"""Holes of a triangle mesh: where they are, and small ones closed.

An edge that one face uses is open. Open edges that share vertices form a hole, or the outer border of a sheet. trimesh
closes holes of three and four edges only, and knows no largest size.
"""

from dataclasses import dataclass

import numpy as np

MAX_TANGLED = 200_000
"""Largest number of edges of holes that touch, which are parted one by one."""
BORDER_SHARE = 0.9
"""Smallest extent of a sheet's outer border, as a share of that of the mesh."""


@dataclass(frozen=True)
class Edges:
    """Edges of a mesh, each once.

    Attributes:
        ends: vertices of each edge, in the order of a face that uses it [n, 2].
        face: that face [n].
        n_uses: number of faces that use it [n].
    """

    ends: np.ndarray
    face: np.ndarray
    n_uses: np.ndarray

    @property
    def is_open(self) -> np.ndarray:
        """True where one face alone uses the edge [n]."""
        return self.n_uses == 1


@dataclass(frozen=True)
class Holes:
    """Holes of a mesh, the largest first, in the unit of its vertices.

    Attributes:
        of_edge: hole of each open edge given to `find_holes` [k].
        n_edges: number of edges of each hole [h].
        center: middle of its border [h, 3].
        extent: of its border along each axis [h, 3].
        area: vector area of its border, half the sum of a x b over its edges [h, 3].
        is_loop: its border is one closed line, so that a fan of triangles closes it [h].
    """

    of_edge: np.ndarray
    n_edges: np.ndarray
    center: np.ndarray
    extent: np.ndarray
    area: np.ndarray
    is_loop: np.ndarray

    @property
    def size(self) -> np.ndarray:
        """Largest extent of each hole along an axis [h]."""
        return self.extent.max(1)

    def face_up(self, up: np.ndarray) -> np.ndarray:
        """Whether the sheet within the border faces up; False of holes in such a sheet, of the rim of an open cup [h].

        Args:
            up: unit vector away from the substrate [3].
        """
        return self.area @ up > 1e-6 * self.size**2

    def are_wide(self, across: np.ndarray) -> np.ndarray:
        """Whether a border is nearly as wide as the mesh, `across` [3], along two axes [h]."""
        return np.sum(self.extent >= BORDER_SHARE * across, axis=1) >= 2


def find_edges(faces: np.ndarray) -> Edges:
    """Find the edges of faces [m, 3]."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    key = ends.min(1) * (int(faces.max(initial=0)) + 1) + ends.max(1)
    _, first, n_uses = np.unique(key, return_index=True, return_counts=True)
    return Edges(ends[first], first // 3, n_uses)


def find_holes(vertices: np.ndarray, ends: np.ndarray) -> Holes:
    """Group open edges to holes; holes that touch at a vertex are parted.

    Args:
        vertices: positions [n, 3].
        ends: the two vertices of each open edge, in the order of its face [k, 2].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(ends):
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 3))
        return Holes(none, none, nowhere, nowhere, nowhere, np.zeros(0, bool))
    used, index = np.unique(ends, return_inverse=True)
    index = index.reshape(ends.shape)
    size = len(used)
    joined = coo_array((np.ones(len(ends)), (index[:, 0], index[:, 1])), shape=(size, size))
    n_holes, of_vertex = connected_components(joined, directed=False)
    n_out, n_in = np.bincount(index[:, 0], minlength=size), np.bincount(index[:, 1], minlength=size)
    balanced, simple = (np.bincount(of_vertex[bad], minlength=n_holes) == 0 for bad in (n_out != n_in, n_out != 1))
    of_edge = of_vertex[index[:, 0]]
    tangled = np.flatnonzero((balanced & ~simple)[of_edge])
    if len(tangled) <= MAX_TANGLED:
        for k, loop in enumerate(_loops(index[tangled])):
            of_edge[tangled[loop]] = n_holes + k
        balanced = np.append(balanced, np.ones(len(tangled), bool))
    else:
        balanced &= simple
    kept, of_edge = np.unique(of_edge, return_inverse=True)
    return _measure(vertices[ends], of_edge.reshape(-1), balanced[kept])


def _measure(places: np.ndarray, of_edge: np.ndarray, is_loop: np.ndarray) -> Holes:
    """Compute extent, middle and area of holes from the ends of their edges [k, 2, 3]; sort the holes by size."""
    order = np.argsort(of_edge, kind="stable")
    first = np.searchsorted(of_edge[order], np.arange(len(is_loop)))
    a, b = places[order, 0], places[order, 1]
    n_edges = np.diff(first, append=len(order))
    extent = np.maximum.reduceat(np.maximum(a, b), first) - np.minimum.reduceat(np.minimum(a, b), first)
    center = np.add.reduceat(0.5 * (a + b), first) / n_edges[:, None]
    middle = np.repeat(center, n_edges, axis=0)
    area = 0.5 * np.add.reduceat(np.cross(a - middle, b - middle), first)
    by_size = np.argsort(-extent.max(1), kind="stable")
    rank = np.argsort(by_size)
    return Holes(rank[of_edge], *(v[by_size] for v in (n_edges, center, extent, area, is_loop)))


def _loops(ends: np.ndarray) -> list[np.ndarray]:
    """Part directed edges [k, 2], of which as many leave each vertex as enter it, into closed lines."""
    leaving: dict[int, list[int]] = {}
    for k, start in enumerate(ends[:, 0].tolist()):
        leaving.setdefault(start, []).append(k)
    loops = []
    for first in list(leaving):
        path: list[int] = []
        at, visited = first, {first: 0}
        while leaving[at]:
            path.append(leaving[at].pop())
            at = int(ends[path[-1], 1])
            if at in visited:  # a closed line ends here: take it from the path
                loop = path[visited[at] :]
                del path[visited[at] :]
                for k in loop[:-1]:
                    del visited[int(ends[k, 1])]
                loops.append(np.array(loop))
            else:
                visited[at] = len(path)
    return loops


def close_holes(
    vertices: np.ndarray, faces: np.ndarray, parts: np.ndarray, largest: float, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Close holes by a fan of triangles about the middle of each.

    Where a flat face is missing, the fan is that face. The true surface in a hole is unknown: the fan is right to about
    the size of the hole. The outer border of a sheet stays open, and so does a hole whose border is no closed line.

    Args:
        vertices, faces, parts: the mesh [n, 3], [m, 3], and the part of each face [m].
        largest: size of the largest hole to close, in the unit of the vertices.
        up: unit vector away from the substrate, in the frame of the vertices [3].

    Returns:
        The same with one vertex for each closed hole and one face for each of its edges, which belongs to the part of
        the face beside it; and the sizes of the closed holes, the largest first [c].
    """
    edges = find_edges(faces)
    ends, beside = edges.ends[edges.is_open], edges.face[edges.is_open]
    holes = find_holes(vertices, ends)
    is_outer = holes.are_wide(np.ptp(vertices[faces].reshape(-1, 3), axis=0)) & holes.face_up(up)
    closed = holes.is_loop & (holes.size <= largest) & ~is_outer
    use = closed[holes.of_edge]
    middle = len(vertices) + np.cumsum(closed) - 1
    fans = np.column_stack([ends[use][:, ::-1], middle[holes.of_edge[use]]])
    return (
        np.concatenate([vertices, holes.center[closed]]),
        np.concatenate([faces, fans]),
        np.concatenate([parts, parts[beside[use]]]),
        holes.size[closed],
    )
