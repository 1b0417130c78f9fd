"""Ray-surface intersection: triangles by Embree (float32), spheres analytically (float64).

The geometry is recentred and scaled to about unit size for Embree; hit points are taken from the barycentric
coordinates on the float64 triangle (about 7x more accurate than o + t d). Rays that start on a triangle are first moved
off it by `RESTART` of the scene size; a ray that leaves a convex sphere skips that sphere. An exhaustive float64 engine
replaces Embree where embreex has no wheel and is the independent check in the tests. Only this module imports embreex.
"""

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np

from helio_jax.errors import GuardError, SceneError
from helio_jax.kernel import kernel
from helio_jax.scene.body import Body

RESTART = 1e-6
"""Offset of the start of a ray from its triangle, in scene half-sizes."""
MISS = np.int32(-1)
"""`Hits.surface` of a ray without a hit; >= 0: triangle; <= -2: sphere number -2 - surface."""


@dataclass(frozen=True)
class Hits:
    """First hits of a batch of rays.

    Attributes:
        point: hit points [n, 3] [um] (undefined for misses).
        normal: unit normals, outward [n, 3].
        surface: surface hit [n] (see `MISS`).
        is_back: True where a one-sided surface was hit from inside: a hole in the mesh, or inverted normals [n].
    """

    point: np.ndarray
    normal: np.ndarray
    surface: np.ndarray
    is_back: np.ndarray

    def take(self, keep: np.ndarray | slice) -> "Hits":
        """Select hits."""
        return Hits(self.point[keep], self.normal[keep], self.surface[keep], self.is_back[keep])

    @classmethod
    def on_mesh(cls, point: np.ndarray, normal: np.ndarray) -> "Hits":
        """Make hits from known points [n, 3] of a triangle mesh and the normals to scatter by [n, 3]."""
        return cls(point, normal, np.zeros(len(point), np.int32), np.zeros(len(point), bool))


@kernel
def _nearest_sphere(origins, directions, i, spheres, skip):
    """Return (distance, index) of the nearest sphere on ray `i`, or (inf, -1)."""
    best, which = np.inf, -1
    for s in range(spheres.shape[0]):
        if s == skip:
            continue
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        x, y, z = origins[i, 0] - spheres[s, 0], origins[i, 1] - spheres[s, 1], origins[i, 2] - spheres[s, 2]
        along = x * dx + y * dy + z * dz
        ax, ay, az = x - along * dx, y - along * dy, z - along * dz
        disc = spheres[s, 3] ** 2 - (ax * ax + ay * ay + az * az)
        if disc >= 0.0:
            t = -along - np.sqrt(disc)
            if 0.0 < t < best:
                best, which = t, s
    return best, which


@kernel
def _scale_rays(origins, directions, center, inverse_size, o32, d32):
    """Write float32 Embree rays; return the number of rays that are not finite or not of unit direction."""
    n_bad = 0
    for i in range(origins.shape[0]):
        total = 0.0
        length = 0.0
        for a in range(3):
            o32[i, a] = np.float32((origins[i, a] - center[a]) * inverse_size)
            d32[i, a] = np.float32(directions[i, a])
            total += abs(origins[i, a]) + abs(directions[i, a])
            length += directions[i, a] ** 2
        if not (total < np.inf and abs(length - 1.0) < 1e-6):
            n_bad += 1
    return n_bad


@kernel
def resolve_hit(origins, directions, i, skip, face, u, v, facets, spheres, points, normals, j):
    """Find the nearest of triangle `face` (or -1) and the spheres on ray `i`; return `surface` and `is_back`.

    Writes point and normal to row `j`. `facets` [triangle, 13] holds corners, normals, and 1 where atoms scatter from
    both sides: then the normal of a face that is hit from behind is reversed. Arguments are whole arrays
    and indices because numba counts the references of each row that is passed, which took a third of the time.
    """
    t_face, surface = np.inf, -1
    if face >= 0:
        t_face, surface = 0.0, face
        b, c = np.float64(u), np.float64(v)
        a = 1.0 - b - c
        for k in range(3):
            points[j, k] = a * facets[face, k] + b * facets[face, 3 + k] + c * facets[face, 6 + k]
            t_face += (points[j, k] - origins[i, k]) * directions[i, k]
            normals[j, k] = facets[face, 9 + k]
    t, s = _nearest_sphere(origins, directions, i, spheres, skip)
    if s >= 0 and t < t_face:
        surface = -2 - s
        for k in range(3):
            points[j, k] = origins[i, k] + t * directions[i, k]
            normals[j, k] = (points[j, k] - spheres[s, k]) / spheres[s, 3]
    cosine = normals[j, 0] * directions[i, 0] + normals[j, 1] * directions[i, 1] + normals[j, 2] * directions[i, 2]
    is_back = surface != -1 and cosine > 0.0
    if is_back and surface >= 0 and facets[surface, 12] > 0.0:
        is_back = False
        for k in range(3):
            normals[j, k] = -normals[j, k]
    return surface, is_back


@kernel
def _resolve_hits(origins, directions, skip, faces, u, v, facets, spheres):
    n = origins.shape[0]
    point = np.zeros((n, 3))
    normal = np.zeros((n, 3))
    surface = np.full(n, -1, np.int32)
    is_back = np.zeros(n, np.bool_)
    for i in range(n):
        surface[i], is_back[i] = resolve_hit(
            origins, directions, i, skip[i], faces[i], u[i], v[i], facets, spheres, point, normal, i
        )
    return point, normal, surface, is_back


@kernel
def _mark_sphere_occlusion(origins, directions, skip, spheres, is_occluded):
    for i in range(origins.shape[0]):
        if not is_occluded[i]:
            _, s = _nearest_sphere(origins, directions, i, spheres, skip[i])
            is_occluded[i] = s >= 0


@kernel
def _exhaustive_faces(origins, directions, vertices, triangles):
    """Test every ray against every triangle in float64 (Moeller and Trumbore, J. Graphics Tools 2 (1997) 21)."""
    n = origins.shape[0]
    face, u_out, v_out = np.full(n, -1, np.int32), np.zeros(n), np.zeros(n)
    for i in range(n):
        o, d, best = origins[i], directions[i], np.inf
        for f in range(triangles.shape[0]):
            p = vertices[triangles[f, 0]]
            e1, e2 = vertices[triangles[f, 1]] - p, vertices[triangles[f, 2]] - p
            cross = np.cross(d, e2)
            det = np.dot(e1, cross)
            if det == 0.0:
                continue
            s = o - p
            u = np.dot(s, cross) / det
            q = np.cross(s, e1)
            v = np.dot(d, q) / det
            t = np.dot(e2, q) / det
            if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and 0.0 < t < best:
                best, face[i], u_out[i], v_out[i] = t, f, u, v
    return face, u_out, v_out


class Intersector:
    """Ray queries against one body; safe to share between threads.

    Args:
        body: triangles and spheres, sample frame [um].
        engine: "embree", or "exhaustive" (every triangle, float64); None: Embree if installed, else "exhaustive" with
            a warning.

    Raises:
        SceneError: the body has no surface, or embreex is not installed.
    """

    def __init__(self, body: Body, engine: Literal["embree", "exhaustive"] | None = None) -> None:
        self.vertices = np.ascontiguousarray(body.vertices, np.float64).reshape(-1, 3)
        self.triangles = np.ascontiguousarray(body.faces, np.int32).reshape(-1, 3)
        self.spheres = np.ascontiguousarray(body.spheres, np.float64).reshape(-1, 4)
        if self.triangles.size == 0 and self.spheres.size == 0:
            raise SceneError("the sample must have at least one surface, got 0 triangles and 0 spheres")
        corners = self.vertices[self.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(cross, axis=1)
        has_area = length > 0
        self.triangles = np.ascontiguousarray(self.triangles[has_area])
        self.normals = cross[has_area] / length[has_area, None]
        both = body.is_two_sided[has_area]
        self.facets = np.concatenate([corners[has_area].reshape(-1, 9), self.normals, both[:, None]], 1)
        self.materials, self._sphere_material = body.materials, body.sphere_material
        self._face_material = body.face_material[has_area]
        self._set_scale()
        self._embree = self._build_embree() if engine in (None, "embree") and self.triangles.size else None
        if engine == "embree" and self._embree is None and self.triangles.size:
            raise SceneError("engine = 'embree' needs the package embreex, which is not installed here")

    @property
    def has_embree(self) -> bool:
        """Whether the triangles are traced by Embree."""
        return self._embree is not None

    def material_of(self, surface: np.ndarray) -> np.ndarray:
        """Return the index into `materials` of each hit surface (`Hits.surface`, no misses) [n]."""
        out = np.empty(surface.shape, np.int64)
        is_face = surface >= 0
        out[is_face] = self._face_material[surface[is_face]]
        out[~is_face] = self._sphere_material[-2 - surface[~is_face]]
        return out

    def by_surface(self, of_material: np.ndarray) -> np.ndarray:
        """Return a number of every surface's material, with `Hits.surface` as index: that of spheres is negative."""
        of = np.concatenate([self._face_material, self._sphere_material[::-1]]).astype(np.int64)
        return np.append(of_material[of], np.nan)

    def _set_scale(self) -> None:
        is_used = np.zeros(len(self.vertices), bool)
        is_used[self.triangles] = True
        center, radius = self.spheres[:, :3], self.spheres[:, 3:]
        corners = np.concatenate([self.vertices[is_used], center - radius, center + radius])
        low, self.high = corners.min(0), corners.max(0)
        self.center = 0.5 * (low + self.high)
        self.half_size = 0.5 * float((self.high - low).max())
        self.restart = RESTART * self.half_size

    def _build_embree(self):
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            warnings.warn(
                "embreex is not installed: rays are tested against every triangle, which is slow", stacklevel=3
            )
            return None
        scene = EmbreeScene(robust=True)
        scaled = ((self.vertices - self.center) / self.half_size).astype(np.float32)
        self._mesh = TriangleMesh(scene, scaled, self.triangles)
        one = np.array([[0.0, 0.0, 9.0]], np.float32)
        scene.run(one, -one / 9)  # commits the scene before threads share it
        return scene

    def scaled(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert rays [n, 3] to Embree's frame and precision.

        Raises:
            GuardError: a ray is not finite or has no unit direction.
        """
        if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
            raise ValueError(f"origins and directions must both be [n, 3], got {origins.shape}, {directions.shape}")
        o32, d32 = np.empty(origins.shape, np.float32), np.empty(origins.shape, np.float32)
        n_bad = _scale_rays(origins, directions, self.center, 1.0 / self.half_size, o32, d32)
        if n_bad:
            raise GuardError(
                f"{n_bad} of {len(origins)} rays are not finite or not of unit direction: please report this"
            )
        return o32, d32

    def nearest(self, origins: np.ndarray, directions: np.ndarray, skip: np.ndarray) -> Hits:
        """Find the first surface along each ray.

        Args:
            origins: ray origins [n, 3] [um].
            directions: unit vectors [n, 3].
            skip: sphere that the ray starts from, or -1 [n].

        Raises:
            GuardError: a ray is not finite or has no unit direction.
        """
        o32, d32 = self.scaled(origins, directions)
        if self.triangles.size == 0:
            n = len(origins)
            face, u, v = np.full(n, -1, np.int32), np.zeros(n), np.zeros(n)
        elif self._embree is not None:
            face, u, v = self.shoot(o32, d32)
        else:
            face, u, v = _exhaustive_faces(origins, directions, self.vertices, self.triangles)
        return Hits(*_resolve_hits(origins, directions, skip, face, u, v, self.facets, self.spheres))

    def shoot(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the triangle (or -1) that Embree finds on rays from `scaled` and barycentric u, v [n]."""
        assert self._embree is not None
        found = self._embree.run(origins, directions, output=True)
        return found["primID"], found["u"], found["v"]

    def is_occluded(self, origins: np.ndarray, directions: np.ndarray, skip: np.ndarray) -> np.ndarray:
        """Return True where a ray hits any surface [n] (arguments as in `nearest`)."""
        o32, d32 = self.scaled(origins, directions)
        if self.triangles.size == 0:
            occluded = np.zeros(len(origins), bool)
        elif self._embree is not None:
            occluded = self._embree.run(o32, d32, query="OCCLUDED") >= 0
        else:
            occluded = _exhaustive_faces(origins, directions, self.vertices, self.triangles)[0] >= 0
        if self.spheres.size:
            _mark_sphere_occlusion(origins, directions, skip, self.spheres, occluded)
        return occluded
