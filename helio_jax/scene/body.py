"""Geometry of a sample: triangles and exact spheres, each with the name of its material.

Sample frame: z up, z = 0 on the substrate, micrometres. The scene maps material names to scattering laws
(scattering.py); surfaces.py builds the geometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from helio_jax.arrays import set_float_arrays
from helio_jax.errors import SceneError

COSINE = "cosine"
"""Name of the default material: re-emission by the cosine law."""


@dataclass(frozen=True)
class Body:
    """Triangles and exact spheres of a sample, sample frame (frozen, checked when made).

    Attributes:
        vertices: positions [n, 3], um.
        faces: vertex indices [m, 3], counter-clockwise seen from the vacuum.
        spheres: x, y, z of the centre and radius [s, 4], um; intersected analytically.
        materials: names of the materials.
        face_material, sphere_material: index into `materials` of each face [m] and sphere [s]; default: the first.
        is_two_sided: True where atoms scatter from both sides of a face [m]; default: nowhere.
    """

    vertices: np.ndarray
    faces: np.ndarray
    spheres: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    materials: tuple[str, ...] = (COSINE,)
    face_material: np.ndarray = field(default=None)  # type: ignore[assignment]
    sphere_material: np.ndarray = field(default=None)  # type: ignore[assignment]
    is_two_sided: np.ndarray = field(default=None)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        set_float_arrays(self, {"vertices": (None, 3), "spheres": (None, 4)}, SceneError)
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise SceneError(f"faces must be integers of the shape any x 3, got {faces.dtype} {faces.shape}")
        if faces.size and (faces.min() < 0 or faces.max() >= len(self.vertices)):
            raise SceneError(f"faces must index the {len(self.vertices)} vertices, got {faces.min()} to {faces.max()}")
        object.__setattr__(self, "faces", faces.astype(np.int64))
        for name in ("vertices", "spheres"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise SceneError(f"{name} must be finite, got NaN or infinity: check the sample's file and settings")
        if np.any(self.spheres[:, 3] <= 0):
            raise SceneError(f"sphere radius must be > 0 um, got {self.spheres[:, 3].min():g}")
        for name, n in (("face_material", len(self.faces)), ("sphere_material", len(self.spheres))):
            given = getattr(self, name)
            index = np.zeros(n, np.int64) if given is None else np.asarray(given, np.int64)
            if index.shape != (n,) or (n and not 0 <= index.min() <= index.max() < len(self.materials)):
                raise SceneError(f"{name} must be {n} indices of the {len(self.materials)} materials, got {index!r}")
            object.__setattr__(self, name, index)
        both = np.zeros(len(self.faces), bool) if self.is_two_sided is None else np.asarray(self.is_two_sided, bool)
        if both.shape != (len(self.faces),):
            raise SceneError(f"is_two_sided must be one of each of the {len(self.faces)} faces, got {both.shape}")
        object.__setattr__(self, "is_two_sided", both)

    def with_faces(self, keep: np.ndarray) -> "Body":
        """Return the body with those faces only (mask or indices), with all its vertices and spheres."""
        kept = {name: getattr(self, name)[keep] for name in ("faces", "face_material", "is_two_sided")}
        return replace(self, **kept)

    def with_material(self, face: str, sphere: Sequence[str] = ()) -> "Body":
        """Return the body with one material on all faces, and one per sphere (default: that of the faces)."""
        names = tuple(dict.fromkeys((face, *sphere)))
        index = np.array([names.index(name) for name in sphere], np.int64) if sphere else None
        return replace(self, materials=names, face_material=None, sphere_material=index)

    def transformed(self, rotation: np.ndarray, scale: float, shift: tuple[float, float, float]) -> "Body":
        """Return the body scaled about the origin, rotated by a matrix [3, 3], then shifted [um]."""
        vertices = rotation.dot((self.vertices * scale).T).T + np.asarray(shift)
        centers = rotation.dot((self.spheres[:, :3] * scale).T).T + np.asarray(shift)
        return replace(self, vertices=vertices, spheres=np.column_stack([centers, self.spheres[:, 3] * scale]))

    def moved(self, shift: tuple[float, float, float]) -> "Body":
        """Return the body shifted [um]."""
        spheres = self.spheres + np.array([*shift, 0.0])
        return replace(self, vertices=self.vertices + np.asarray(shift), spheres=spheres)

    @classmethod
    def join(cls, bodies: Sequence["Body"]) -> "Body":
        """Join several bodies into one."""
        names = tuple(dict.fromkeys(name for body in bodies for name in body.materials))
        maps = [np.array([names.index(name) for name in body.materials]) for body in bodies]
        first = np.cumsum([0, *(len(body.vertices) for body in bodies)])
        return cls(
            np.concatenate([body.vertices for body in bodies]),
            np.concatenate([body.faces + start for body, start in zip(bodies, first[:-1], strict=True)]),
            np.concatenate([body.spheres for body in bodies]),
            names,
            np.concatenate([m[body.face_material] for m, body in zip(maps, bodies, strict=True)]),
            np.concatenate([m[body.sphere_material] for m, body in zip(maps, bodies, strict=True)]),
            np.concatenate([body.is_two_sided for body in bodies]),
        )

    @property
    def triangles(self) -> np.ndarray:
        """Corner positions of every face [m, 3, 3], um."""
        return self.vertices[self.faces]

    @property
    def normals(self) -> np.ndarray:
        """Unit outward normal of every face [m, 3]; zero for a face without area."""
        t = self.triangles
        n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return np.divide(n, length, out=np.zeros_like(n), where=length > 0)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest x, y, z of triangles and spheres [2, 3], um."""
        low = np.concatenate([self.triangles.reshape(-1, 3), self.spheres[:, :3] - self.spheres[:, 3:]])
        high = np.concatenate([self.triangles.reshape(-1, 3), self.spheres[:, :3] + self.spheres[:, 3:]])
        if not len(low):
            raise SceneError("the sample is empty: it has neither faces nor spheres")
        return np.stack([low.min(0), high.max(0)])

    @property
    def max_height(self) -> float:
        """Height of the highest point above the substrate [um]."""
        return float(self.bounds[1, 2])
