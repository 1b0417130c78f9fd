"""Holes of a triangle mesh: where they are, and small ones closed.

An edge that one face uses is open. Open edges that share vertices form a hole, or the outer border of a sheet. trimesh
closes holes of three and four edges only, and knows no largest size.
"""

from dataclasses import dataclass

import numpy as np

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
class Hole:
    """A hole of a mesh.

    Attributes:
        center: middle of its border [3].
        size: largest extent of its border along an axis, in the unit of the vertices.
        edges: its open edges, as indices into those given to `find_holes` [n].
        is_loop: its border is one closed line, so that a fan of triangles closes it; not where neighbouring faces are
            wound in opposite senses.
    """

    center: np.ndarray
    size: float
    edges: np.ndarray
    is_loop: bool


def find_edges(faces: np.ndarray) -> Edges:
    """Find the edges of faces [m, 3]."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    key = ends.min(1) * (int(faces.max(initial=0)) + 1) + ends.max(1)
    _, first, n_uses = np.unique(key, return_index=True, return_counts=True)
    return Edges(ends[first], first // 3, n_uses)


def find_holes(vertices: np.ndarray, ends: np.ndarray) -> list[Hole]:
    """Group open edges to holes, the largest first; holes that touch at a vertex are parted.

    Args:
        vertices: positions [n, 3].
        ends: the two vertices of each open edge, in the order of its face [k, 2].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(ends):
        return []
    used, index = np.unique(ends, return_inverse=True)
    index = index.reshape(ends.shape)
    size = len(used)
    joined = coo_array((np.ones(len(ends)), (index[:, 0], index[:, 1])), shape=(size, size))
    n_holes, of_vertex = connected_components(joined, directed=False)
    n_out, n_in = np.bincount(index[:, 0], minlength=size), np.bincount(index[:, 1], minlength=size)
    is_balanced, is_simple = (
        np.bincount(of_vertex[bad], minlength=n_holes) == 0 for bad in (n_out != n_in, n_out != 1)
    )
    group = of_vertex[index[:, 0]]
    order = np.argsort(group, kind="stable")
    holes = []
    for hole, edges in enumerate(np.split(order, np.searchsorted(group[order], np.arange(1, n_holes)))):
        parted = [edges] if is_simple[hole] or not is_balanced[hole] else [edges[k] for k in _loops(index[edges])]
        for border in parted:
            points = vertices[np.unique(ends[border])]
            size_of = float(np.ptp(points, axis=0).max())
            holes.append(Hole(points.mean(0), size_of, border, bool(is_balanced[hole])))
    return sorted(holes, key=lambda hole: -hole.size)


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


def faces_up(vertices: np.ndarray, border: np.ndarray, up: np.ndarray) -> bool:
    """Whether the sheet within a border faces up; False of a hole in such a sheet and of the rim of an open cup.

    The vector area of the border, half the sum of a x b over its edges, then points up.

    Args:
        vertices: positions [n, 3].
        border: the two vertices of each edge, in the order of its face [k, 2].
        up: unit vector away from the substrate [3].
    """
    a, b = np.moveaxis(vertices[border], 1, 0)
    middle = a.mean(0)
    area = 0.5 * np.cross(a - middle, b - middle).sum(0)
    return float(area @ up) > 1e-6 * float(np.ptp(a, axis=0).max()) ** 2


def is_wide(vertices: np.ndarray, border: np.ndarray, across: np.ndarray) -> bool:
    """Whether a border [k, 2] is nearly as wide as the mesh, `across` [3], along two axes."""
    return int(np.sum(np.ptp(vertices[border[:, 0]], axis=0) >= BORDER_SHARE * across)) >= 2


def close_holes(
    vertices: np.ndarray, faces: np.ndarray, parts: np.ndarray, largest: float, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Hole]]:
    """Close holes by a fan of triangles about the middle of each.

    Where a flat face is missing, the fan is that face. The true surface in a hole is unknown: the fan is right to about
    the size of the hole. The outer border of a sheet stays open, and so does a hole whose border is no closed line.

    Args:
        vertices, faces, parts: the mesh [n, 3], [m, 3], and the part of each face [m].
        largest: size of the largest hole to close, in the unit of the vertices.
        up: unit vector away from the substrate, in the frame of the vertices [3].

    Returns:
        The same with one vertex for each closed hole and one face for each of its edges, which belongs to the part of
        the face beside it; and the closed holes.
    """
    edges = find_edges(faces)
    ends, beside = edges.ends[edges.is_open], edges.face[edges.is_open]
    across = np.ptp(vertices[faces].reshape(-1, 3), axis=0)
    closed, new_faces, new_parts = [], [faces], [parts]
    for hole in find_holes(vertices, ends):
        border = ends[hole.edges]
        is_outer = is_wide(vertices, border, across) and faces_up(vertices, border, up)
        if hole.size > largest or not hole.is_loop or is_outer:
            continue
        middle = np.full(len(border), len(vertices) + len(closed))
        new_faces.append(np.column_stack([border[:, ::-1], middle]))
        new_parts.append(parts[beside[hole.edges]])
        closed.append(hole)
    middles = [hole.center[None] for hole in closed]
    return np.concatenate([vertices, *middles]), np.concatenate(new_faces), np.concatenate(new_parts), closed
