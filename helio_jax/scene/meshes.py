"""Read triangle meshes (STL, OBJ, PLY, GLB) in a limited child process. The only import of trimesh's readers.

Meshes are untrusted: file, triangles and parts are limited, contents are checked, every failure names the file.
"""

import hashlib
import io
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.child import call_in_child
from helio_jax.errors import InputFileError
from helio_jax.scene.files import check_file
from helio_jax.texts import parse_json

KINDS = (".stl", ".obj", ".ply", ".glb")
MAX_FACES = 5_000_000
MAX_PARTS = 1000
"""Largest number of named parts of an OBJ, and of nodes of a GLB (trimesh takes 1 ms for each)."""

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices [n, 3], faces [m, 3] and the part of each face [m]."""


def load_mesh(
    path: Path, max_mb: float, names: tuple[str, ...] = (), own: tuple[str, ...] = (), *, flip: bool = False
) -> Mesh:
    """Read a mesh in file units; equal vertices are merged, a closed mesh must not be inside out.

    Args:
        path: STL, OBJ, PLY or GLB file.
        max_mb: largest file [MB].
        names: parts that the file must contain.
        own: materials of an OBJ (usemtl) to find among its other parts.
        flip: reverse all faces.

    Returns:
        Vertices [n, 3], faces [m, 3], and 1 + the index of each face's part in (*names, *own), 0: another part [m].

    Raises:
        InputFileError: the file is unreadable, holds no valid mesh, has too many triangles or parts, or lacks a part.
    """
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise InputFileError(f"{path}: a mesh must be .stl, .obj, .ply or .glb, got {path.suffix or 'no suffix'!r}")
    check_file(path, max_mb)
    if len(names) + len(own) > MAX_PARTS:
        n = len(names) + len(own)
        raise InputFileError(f"{path}: has {n} parts with laws, the limit is {MAX_PARTS}: give fewer parts laws")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return _parse_once(digest, path, names, own, flip)


@lru_cache(maxsize=2)  # a command reads its mesh several times, a child process takes half a second
def _parse_once(digest: str, path: Path, names: tuple[str, ...], own: tuple[str, ...], flip: bool) -> Mesh:
    """Parse the mesh of that hash; the arrays are shared, so they are read-only."""
    arrays = call_in_child("helio_jax.scene.meshes:parse_mesh", path, names, own, flip)
    for array in arrays:
        array.setflags(write=False)
    return tuple(arrays)


def parse_mesh(path: Path, names: list[str], own: list[str], flip: bool) -> Mesh:
    """Parse the mesh for `load_mesh`; runs in a child process."""
    import trimesh

    kind, data, known = path.suffix.lower().lstrip("."), path.read_bytes(), [*names, *own]
    if kind == "glb":
        _check_nodes(path, data)
    try:
        pieces = _pieces(_with_sections(data, names, own) if kind == "obj" else data, kind)
    except (InputFileError, MemoryError):
        raise
    except Exception as e:  # trimesh's readers raise anything on corrupt files
        raise InputFileError(f"{path}: cannot be read as a {kind.upper()} mesh ({type(e).__name__}: {e})") from e
    first = np.cumsum([0, *(len(vertices) for vertices, _, _ in pieces)])
    vertices = np.concatenate([np.zeros((0, 3)), *(v for v, _, _ in pieces)])
    faces = np.concatenate([np.zeros((0, 3), np.int64), *(f + n for (_, f, _), n in zip(pieces, first, strict=False))])
    index = {name: i for i, name in reversed(list(enumerate(known, 1)))}
    parts = np.repeat([index.get(p, 0) for _, _, p in pieces], [len(f) for _, f, _ in pieces])
    if not len(faces):
        raise InputFileError(f"{path}: the mesh has no triangles: export a surface, not points or lines")
    _check_number(path, len(faces))
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputFileError(f"{path}: faces point to vertices that do not exist: the file is corrupt")
    if not np.all(np.isfinite(vertices[faces])):
        raise InputFileError(f"{path}: the mesh has non-finite coordinates: the file is corrupt")
    if missing := [name for i, name in enumerate(names) if not np.any(parts == i + 1)]:
        raise InputFileError(f"{path}: has no part {missing[0]!r}, which the scene names: correct the name")
    clean = trimesh.Trimesh(vertices, faces[:, ::-1] if flip else faces, process=False)
    clean.merge_vertices(merge_tex=True, merge_norm=True)
    has_area = clean.nondegenerate_faces(height=0.0)
    clean.update_faces(has_area)
    if not len(clean.faces):
        raise InputFileError(f"{path}: no triangle of the mesh has an area: the file is corrupt or its unit is wrong")
    check_outside(path, clean.vertices, clean.faces, flip=flip)
    return np.asarray(clean.vertices, np.float64), np.asarray(clean.faces, np.int64), parts[has_area]


def check_outside(path: Path, vertices: np.ndarray, faces: np.ndarray, *, flip: bool) -> None:
    """Refuse a closed mesh (vertices [n, 3], faces [m, 3]) that is inside out.

    Raises:
        InputFileError: its volume is negative.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.is_watertight and mesh.volume < 0:
        raise InputFileError(
            f"{path}: the mesh is inside out (volume < 0): set sample.flip_normals = {'false' if flip else 'true'}, or "
            "flip its normals in the program that made it"
        )


def _check_number(path: Path, n_faces: int) -> None:
    if n_faces > MAX_FACES:
        raise InputFileError(f"{path}: the mesh has {n_faces} triangles, the limit is {MAX_FACES}: decimate it")


def _check_nodes(path: Path, data: bytes) -> None:
    """Refuse a GLB file with more nodes than `MAX_PARTS`, or more triangles in all its nodes than `MAX_FACES`.

    Source: Khronos glTF 2.0, sec. 4.4 (header of 12 bytes, then the JSON chunk: length, type, text).
    """
    try:
        tree = parse_json(data[20 : 20 + int.from_bytes(data[12:16], "little")].decode("utf-8"))
        nodes, meshes, accessors = (tree.get(key, []) for key in ("nodes", "meshes", "accessors"))
        n_nodes = len(nodes)
        sizes = [
            sum(accessors[p.get("indices", p["attributes"]["POSITION"])]["count"] for p in mesh["primitives"]) // 3
            for mesh in meshes
        ]
        n_faces = sum(sizes[node["mesh"]] for node in nodes[:MAX_PARTS] if "mesh" in node)
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as e:
        raise InputFileError(f"{path}: cannot be read as a GLB mesh ({type(e).__name__}: {e})") from None
    if n_nodes > MAX_PARTS:
        raise InputFileError(f"{path}: has {n_nodes} nodes, the limit is {MAX_PARTS}: join them into one mesh")
    _check_number(path, n_faces)


def _with_sections(data: bytes, names: list[str], own: list[str]) -> bytes:
    """Rewrite an OBJ text with one section `o NAME` for each known part, and one for all other faces."""
    if not (names or own):
        return re.sub(rb"(?m)^[ \t]*(usemtl|mtllib|g|o|s)\b.*$", b"", data)
    rest: list[bytes] = []
    faces: dict[str, list[bytes]] = {}
    current: dict[bytes, str] = {}
    known, mine = set(names), set(own)
    for line in data.replace(b"\\\n", b" ").splitlines():
        word, _, value = line.strip().partition(b" ")
        if word in (b"usemtl", b"g", b"o"):
            current[word] = value.strip().decode("utf-8", "replace")
        elif word == b"f":
            found = [current[w] for w in (b"usemtl", b"g", b"o") if current.get(w) in known]
            found += [current[b"usemtl"]] if current.get(b"usemtl") in mine else []
            faces.setdefault(found[0] if found else "", []).append(line)
        elif word in (b"v", b"vn", b"vt"):
            rest.append(line)
    for name, lines in faces.items():
        rest += [b"o " + name.encode("utf-8"), *lines]
    return b"\n".join(rest)


def _pieces(data: bytes, kind: str) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Read vertices, faces and name of every geometry of a file, in its scene."""
    import trimesh

    options: dict[str, Any] = {"skip_materials": True, "split_objects": True} if kind == "obj" else {}
    loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, **options)
    out = []
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        mesh = loaded.geometry[name].copy()
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        mesh.apply_transform(matrix)
        out.append((np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64), str(name)))
    return out


def stl_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Format triangles as a binary STL file, in the unit of the vertices [n, 3], single precision."""
    import trimesh

    found = trimesh.Trimesh(vertices, faces, process=False).export(file_type="stl")
    assert isinstance(found, bytes)  # as trimesh gives for this format
    return found
