"""Sample models, the table `[sample]`, selected by `kind`; mesh samples, and the check of a body by trimesh.

Parametric samples are in shapes.py and rough.py, height maps in maps.py, readers of meshes in meshes.py.
`build(base_dir)` of each gives a `Body`: sample frame, z up, z = 0 on the substrate, um. Files are untrusted: size and
number of faces are limited, contents are checked, every failure is an `InputFileError` that names the file.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.errors import InputFileError
from helio_jax.scene import surfaces
from helio_jax.scene.body import Body
from helio_jax.scene.files import read_bytes
from helio_jax.scene.holes import close_holes, find_edges, find_holes
from helio_jax.scene.maps import HeightMapSample, ReconstructionSample
from helio_jax.scene.meshes import check_outside, load_mesh
from helio_jax.scene.mtl import FileLaw, mtl_files, used_laws
from helio_jax.scene.placement import PlaceableSample, rotation_matrix
from helio_jax.scene.rough import RoughSample
from helio_jax.scene.shapes import (
    FlatSample,
    Length,
    MaterialSample,
    PyramidSample,
    SpheresSample,
    StepSample,
    TrenchSample,
)
from helio_jax.settings import UNITS_UM, Settings, Unit

MAX_PLACES = 5
"""Largest number of holes whose places are listed."""
MESH_EXTENT_UM = (1e-2, 1e6)
"""Smallest and largest plausible extent of a mesh [um]."""


class MeshSample(MaterialSample):
    """A triangle mesh from a file."""

    kind: Literal["mesh"] = "mesh"
    file: str = Field(min_length=1, max_length=4096)
    """STL, OBJ, PLY or GLB file, relative to the scene file. (GLB has its y axis up: rotate_deg = [90, 0, 0].)"""
    unit: Unit
    """Unit of the file's coordinates (STL and OBJ do not state it; GLB is in m)."""
    flat_size_um: Length | None = None
    """Side of a substrate added at z = 0 under the placed mesh; the mesh's faces in that plane are removed [um]."""
    flip_normals: bool = False
    """Reverse all faces: for a mesh that is inside out."""
    two_sided: bool = False
    """Atoms scatter from both sides of every face: for sheets without thickness. In a solid it hides leaks."""
    close_holes_um: Length | None = None
    """Largest extent of holes that are closed, after scaling [um]; none are by default. The true surface there is
    unknown, so repair large holes in the program that made the mesh."""
    mirror: Literal["none", "x", "y", "z"] = "none"
    """Axis of the file whose coordinates change their sign, for files of a left-handed program; faces stay outside."""
    max_file_mb: float = Field(default=200.0, gt=0.0, le=10_000.0)
    """Larger files are refused [MB]."""
    materials: dict[str, str] = Field(default={}, max_length=1000)
    """Material by the name of a part (OBJ material, group or object; GLB geometry). Other parts of an OBJ take their
    laws from the .mtl file beside it (helio_law ...), if it defines any."""

    @property
    def material_names(self) -> tuple[str, ...]:
        return (self.material, *self.materials.values())

    def build_shape(self, base_dir: Path = Path()) -> Body:
        """Read and check the mesh, in the file's unit (errors as `load_mesh`)."""
        laws = self.file_laws(base_dir)
        own = tuple(law.name for law in laws.values())
        vertices, faces, parts, _ = self._read(base_dir, own)
        by_part = (*self.material_names, *laws)
        names = tuple(dict.fromkeys(by_part))
        index = np.array([names.index(name) for name in by_part])[parts]
        two_sided = np.full(len(faces), self.two_sided)
        return Body(vertices, faces, materials=names, face_material=index, is_two_sided=two_sided)

    def _read(self, base_dir: Path, own: tuple[str, ...] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Read the mesh, mirror it, close holes; return the mesh as `load_mesh`, and the sizes of closed holes."""
        path, flip = base_dir / self.file, self.flip_normals
        vertices, faces, parts = load_mesh(path, self.max_file_mb, tuple(self.materials), own, flip=flip)
        if self.mirror != "none":  # which turns the outside of every face in
            vertices, faces = vertices * np.where(np.array(["x", "y", "z"]) == self.mirror, -1.0, 1.0), faces[:, ::-1]
        if self.close_holes_um is None:
            return vertices, faces, parts, np.zeros(0)
        up = rotation_matrix(self.rotate_deg)[2]
        vertices, faces, parts, closed = close_holes(vertices, faces, parts, self.close_holes_um / self._unit_um, up)
        check_outside(path, vertices, faces, flip=flip)
        return vertices, faces, parts, closed

    @property
    def _unit_um(self) -> float:
        """Length of the file's unit after scaling [um]."""
        return UNITS_UM[self.unit] * self.scale

    def file_laws(self, base_dir: Path = Path()) -> dict[str, FileLaw]:
        """Read the laws of parts that `materials` does not name from the .mtl beside an OBJ, by "NAME (FILE)".

        Raises:
            InputFileError: the mesh or the .mtl is missing or wrong.
        """
        path = base_dir / self.file
        if path.suffix.lower() != ".obj":
            return {}
        laws = used_laws(path, read_bytes(path, self.max_file_mb))
        return {f"{name} ({self.file})": law for name, law in laws.items() if name not in self.materials}

    def warnings(self, base_dir: Path = Path()) -> list[str]:
        """List .mtl files that the OBJ names and that do not exist, and holes that are closed."""
        path = base_dir / self.file
        missing = mtl_files(path, read_bytes(path, self.max_file_mb))[1] if path.suffix.lower() == ".obj" else []
        out = [
            f"{path.name} names {name}, which is not beside it: its laws are unknown, all parts except those in "
            "sample.materials have sample.material"
            for name in missing
        ]
        if self.close_holes_um is not None:
            closed = self._read(base_dir)[-1]
            sizes = f"; the largest is {closed[0] * self._unit_um:.4g} um across" if len(closed) else ""
            what = "1 hole is closed" if len(closed) == 1 else f"{len(closed)} holes are closed"
            out.append(f"{path.name}: {what} (sample.close_holes_um){sizes}")
        return out

    def build(self, base_dir: Path = Path()) -> Body:
        """Read, check and place the mesh, and add the substrate (errors as `load_mesh`, or an implausible size)."""
        mesh = self.place_body(self.build_shape(base_dir), UNITS_UM[self.unit])
        extent, (low, high) = float(np.ptp(mesh.triangles.reshape(-1, 3), axis=0).max()), MESH_EXTENT_UM
        if not low <= extent <= high:
            raise InputFileError(
                f"{base_dir / self.file}: the mesh is {extent:g} um across, plausible are {low:g} to {high:g} um: "
                f"check sample.unit (now {self.unit!r}) and sample.scale (now {self.scale:g})"
            )
        if self.flat_size_um is None:
            return mesh
        is_free = np.any(np.abs(mesh.triangles[..., 2]) > 1e-6 * extent, axis=1)
        mesh = mesh.with_faces(is_free)
        return Body.join([mesh, surfaces.flat_body(self.flat_size_um).with_material(self.material)])


Single = (
    FlatSample
    | SpheresSample
    | StepSample
    | TrenchSample
    | PyramidSample
    | RoughSample
    | HeightMapSample
    | ReconstructionSample
    | MeshSample
)
"""Any single sample."""


class PlacedSample(Settings):
    """A sample among several."""

    sample: Annotated[Single, Field(discriminator="kind")]
    """The sample, with its own placement, substrate and materials."""
    shift_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Further shift of the sample [um]."""


class SeveralSamples(PlaceableSample):
    """Several samples at once; their substrates should not overlap: the highest surface covers the others."""

    kind: Literal["several"] = "several"
    parts: tuple[PlacedSample, ...] = Field(min_length=1, max_length=1000)
    """The samples and their shifts."""

    @model_validator(mode="after")
    def _is_placed_as_a_whole(self) -> "SeveralSamples":
        for i, part in enumerate(self.parts):
            if part.sample.place != "as-given":
                raise ValueError(
                    f"parts[{i}].sample.place must be 'as-given', got {part.sample.place!r}: only all samples together "
                    "can be placed relative to the plate: move the key to [sample]"
                )
        return self

    @property
    def material_names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.sample.material_names)

    @property
    def shape_top(self) -> float | None:
        tops = [part.sample.top + part.shift_um[2] for part in self.parts if part.sample.top is not None]
        return max(tops, default=None)

    def file_laws(self, base_dir: Path = Path()) -> dict[str, FileLaw]:
        return {name: law for part in self.parts for name, law in part.sample.file_laws(base_dir).items()}

    def warnings(self, base_dir: Path = Path()) -> list[str]:
        return [text for part in self.parts for text in part.sample.warnings(base_dir)]

    def build_shape(self, base_dir: Path = Path()) -> Body:
        return Body.join([part.sample.build(base_dir).moved(part.shift_um) for part in self.parts])


Sample = Annotated[Single | SeveralSamples, Field(discriminator="kind")]
"""Any sample, selected by `kind`."""


def check_body(body: Body, untilted: Body | None = None, *, has_substrate: bool = False) -> dict[str, Any]:
    """Report on a body's triangles, for `helio validate` (JSON-compatible).

    An open sheet that faces up is allowed: a substrate with structure is open along its outer border, which lies on the
    sides of the bounding box or is a line around all of it. `n_inner_open_edges` counts the other open edges of
    one-sided faces, where rays would leak; `n_holes` the holes that they form, `holes` the largest of these: middle
    [um], size [um], number of edges.

    Args:
        body: after placement.
        untilted: the body before a tilt, whose outer border lies on the sides of its bounding box.
        has_substrate: a substrate lies at z = 0, and no ray leaks where a mesh stands on it.
    """
    import trimesh

    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    edges = find_edges(body.faces)
    ends, beside = edges.ends[edges.is_open], edges.face[edges.is_open]
    upright = body if untilted is None else untilted
    places = upright.vertices[ends]
    low, high = upright.triangles.reshape(-1, 3).min(0), upright.triangles.reshape(-1, 3).max(0)
    near = 1e-6 * float(np.ptp([low, high], axis=0).max())
    on_side = np.zeros(len(places), bool)
    for axis in (0, 1):
        for side in (low, high):
            on_side |= np.all(np.abs(places[..., axis] - side[axis]) <= near, axis=1)
    borders, across = find_holes(body.vertices, ends), np.ptp(body.triangles.reshape(-1, 3), axis=0)
    is_up, is_wide = borders.face_up(np.array([0.0, 0.0, 1.0])), borders.are_wide(across)
    is_border = is_up[borders.of_edge] & (on_side | is_wide[borders.of_edge])
    stands = np.all(np.abs(places[..., 2]) <= near, axis=1) & has_substrate
    leaks = ends[~(is_border | stands | body.is_two_sided[beside])]
    holes = find_holes(body.vertices, leaks)
    sorted_faces = np.unique(np.sort(body.faces, axis=1), axis=0)
    return {
        "n_faces": len(body.faces),
        "n_vertices": len(body.vertices),
        "n_spheres": len(body.spheres),
        "bounds_um": body.bounds.tolist(),
        "is_watertight": bool(mesh.is_watertight),
        "is_winding_consistent": bool(mesh.is_winding_consistent),
        "is_inside_out": bool(mesh.is_watertight and mesh.volume < 0),
        "n_two_sided_faces": int(np.sum(body.is_two_sided)),
        "n_open_edges": len(ends),
        "n_inner_open_edges": len(leaks),
        "n_holes": len(holes.size),
        "holes": [
            {"middle_um": middle, "size_um": size, "n_edges": n_edges}
            for middle, size, n_edges in zip(
                holes.center[:MAX_PLACES].round(4).tolist(),
                holes.size[:MAX_PLACES].round(4).tolist(),
                holes.n_edges[:MAX_PLACES].tolist(),
                strict=True,
            )
        ],
        "n_edges_of_three_faces": int(np.sum(edges.n_uses > 2)),
        "n_faces_without_area": int(np.sum(~np.any(body.normals, axis=1))),
        "n_duplicate_faces": len(body.faces) - len(sorted_faces),
    }
