"""Write heights as a triangle mesh: STL, PLY, OBJ. Lengths are um, z is the height.

A vertex is a surface point at its own x, y, so that an oblique beam needs no grid. Triangles face up. A missing height
leaves a hole.
"""

from pathlib import Path

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.formats.layers import Layers

_UNIT = "helio_jax heights, lengths in um"
_PLY_TYPES = {"<f8": "double", "|u1": "uchar"}


def _mesh(layers: Layers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [n, 3], triangles [n, 3], and of which pixel each vertex is."""
    height = layers.main.values
    is_known = np.isfinite(height)
    index = np.arange(height.size).reshape(height.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]  # counter-clockwise from above
    is_other = ~(is_known[:-1, :-1] & is_known[1:, 1:])  # the diagonal a-c lacks an end: take b-d
    first = np.stack([a, b, np.where(is_other, d, c)], -1).reshape(-1, 3)
    second = np.stack([np.where(is_other, b, a), c, d], -1).reshape(-1, 3)
    triangles = np.concatenate([first, second])
    triangles = triangles[is_known.ravel()[triangles].all(1)]
    if not len(triangles):
        raise SceneError("no three neighbouring pixels have a valid height: try --invalid keep or fill")
    used, renumbered = np.unique(triangles, return_inverse=True)
    points = np.stack([layers.point_x, layers.point_y, height], -1).reshape(-1, 3)
    return points[used], renumbered.reshape(-1, 3), used


def write_stl(layers: Layers, path: Path) -> None:
    """Write a binary STL file in single precision."""
    vertices, triangles, _ = _mesh(layers)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    records = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"], records["corners"] = normals, corners
    with path.open("wb") as file:
        file.write(_UNIT.encode().ljust(80))
        file.write(np.uint32(len(triangles)).astype("<u4").tobytes())
        file.write(records.tobytes())


def write_ply(layers: Layers, path: Path) -> None:
    """Write a binary PLY file; the vertices have the error and the mask, where known, as properties."""
    vertices, triangles, used = _mesh(layers)
    more = [(layer, "|u1" if layer.values.dtype == bool else "<f8") for layer in layers.layers[1 : layers.n_core]]
    kinds = [*((axis, "<f8") for axis in "xyz"), *((layer.name, kind) for layer, kind in more)]
    points = np.zeros(len(vertices), kinds)
    for axis, column in zip("xyz", vertices.T, strict=True):
        points[axis] = column
    for layer, _ in more:
        points[layer.name] = layer.values.ravel()[used]
    faces = np.zeros(len(triangles), [("n", "|u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, triangles
    header = [
        *("ply", "format binary_little_endian 1.0", f"comment {_UNIT}", f"comment {layers.comment}"),
        f"element vertex {len(points)}",
        *(f"property {_PLY_TYPES[kind]} {name}" for name, kind in kinds),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"),
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode())
        file.write(points.tobytes())
        file.write(faces.tobytes())


def write_obj(layers: Layers, path: Path) -> None:
    """Write a Wavefront OBJ file."""
    vertices, triangles, _ = _mesh(layers)
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# {_UNIT}\n# {layers.comment}\n")
        file.writelines("v " + " ".join(row) + "\n" for row in vertices.astype(str))
        file.writelines("f " + " ".join(row) + "\n" for row in (triangles + 1).astype(str))
