"""What catches atoms: apertures in the plate, and cones of directions at infinity.

A detector of a scene is one of the two; its `opening` is what the tracer and the reconstruction work with.
Frames and units: instrument.py. Does not know the beam, any sample or ray.
"""

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field, model_validator

from helio_jax.settings import Settings


@dataclass(frozen=True)
class Aperture:
    """A detector aperture resolved to its ellipse on the plate (lab frame, um, radians, SEMI-axes)."""

    center: tuple[float, float]
    semi_axes: tuple[float, float]
    rotation: float

    def rim(self, n_points: int) -> np.ndarray:
        """Return `n_points` rim points and tangents, equally spaced in the ellipse's parameter.

        Returns:
            Array [2, n_points, 2]: positions (x, y) on the plate [um] and derivatives with respect to the
            parameter [um/rad], counter-clockwise seen from above.
        """
        s = 2 * np.pi * np.arange(n_points) / n_points
        (a, b), c, d = self.semi_axes, math.cos(self.rotation), math.sin(self.rotation)
        turn = np.array([[c, -d], [d, c]])
        points = np.stack([a * np.cos(s), b * np.sin(s)], -1) @ turn.T + np.asarray(self.center)
        tangents = np.stack([-a * np.sin(s), b * np.cos(s)], -1) @ turn.T
        return np.stack([points, tangents])


@dataclass(frozen=True)
class Cone:
    """A detector at infinity: all directions within `half_angle` [rad] of a unit vector (lab frame, z up)."""

    axis: tuple[float, float, float]
    half_angle: float

    @property
    def solid_angle(self) -> float:
        """Of the cone [sr]."""
        return 4.0 * math.pi * math.sin(0.5 * self.half_angle) ** 2


def axis_frame(axis: np.ndarray) -> np.ndarray:
    """Return an orthonormal frame [3, 3] whose last row is the unit vector `axis`."""
    side = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(side, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def cone_ellipse(polar: float, azimuth: float, half_angle: float, distance: float) -> Aperture:
    """Cut a circular cone with the plate: the exact ellipse seen under `half_angle` from the nominal spot.

    Valid for polar + half_angle < pi/2.

    Args:
        polar: angle of the cone's axis to the plate normal [rad].
        azimuth: azimuth of the axis [rad].
        half_angle: half-angle of the cone [rad].
        distance: from the nominal spot to the plate [um].

    Returns:
        The ellipse, major axis along the azimuth.

    Source: own derivation (plane section of a cone), tests/unit/test_instrument.py.
    """
    near, far = distance * math.tan(polar - half_angle), distance * math.tan(polar + half_angle)
    minor = distance * math.sin(half_angle) / math.sqrt(math.cos(polar) ** 2 - math.sin(half_angle) ** 2)
    r = 0.5 * (near + far)
    return Aperture((r * math.cos(azimuth), r * math.sin(azimuth)), (0.5 * (far - near), minor), azimuth)


_KINDS = (
    (("center_um", "axes_um"), ("rotation_deg", "height_um")),
    (("polar_deg", "half_angle_deg"), ("azimuth_deg", "at_infinity")),
    (("part",), ()),
)
"""Keys that a detector of each kind needs, and those that it may have."""


class Detector(Settings):
    """One detector: an ellipse on the plate, the cone it fills seen from the nominal spot, a cone at infinity, or a
    part of the plate's mesh.

    Where detectors overlap, the first one in the list has what both would catch. Under a mesh plate an atom is caught
    by the first surface that it meets (of two ellipses in one plane, the first in the list), and by cones at last.
    """

    name: str = Field(min_length=1, max_length=64)
    """Name shown in figures and files."""
    center_um: tuple[float, float] | None = None
    """Centre (x, y) of the ellipse on the plate, lab frame [um]."""
    axes_um: tuple[float, float] | None = None
    """FULL axes of the ellipse; the first one along x before rotation [um]."""
    rotation_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    """Rotation of the ellipse, counter-clockwise seen from above (default 0) [deg]."""
    height_um: float | None = Field(default=None, ge=0.0, le=1e7)
    """Height of the ellipse above the underside of a plate of kind "mesh": a surface that counts, behind a channel say
    (default 0) [um]."""
    polar_deg: float | None = Field(default=None, ge=0.0, lt=90.0)
    """Angle between the cone's axis and the plate normal, seen from the nominal spot [deg]."""
    azimuth_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    """Azimuth of the cone's axis, counter-clockwise from +x (default 0) [deg]."""
    half_angle_deg: float | None = Field(default=None, gt=0.0, le=90.0)
    """Half-angle of the cone [deg]."""
    at_infinity: bool = False
    """The cone is one of directions, wherever an atom comes from: it catches those that hit nothing any more and fly in
    a direction within the cone (not with a flat scattering plate)."""
    part: str | None = Field(default=None, min_length=1, max_length=200)
    """Part of the mesh of a plate of kind "mesh" that counts what hits it: OBJ: its material (usemtl), group or object;
    GLB: its geometry."""
    channel: int | None = Field(default=None, ge=1, le=1000)
    """Channel of a measured file that this aperture feeds (1-based); only used on import."""

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> "Detector":
        keys = {key for needed, optional in _KINDS for key in (*needed, *optional)}
        given = {key for key in keys if not any(getattr(self, key) is empty for empty in (None, False))}
        if not any({*needed} <= given <= {*needed, *optional} for needed, optional in _KINDS):
            raise ValueError(
                f"detector {self.name!r} must be given either by center_um and axes_um (and rotation_deg, height_um) "
                "or by polar_deg and half_angle_deg (and azimuth_deg, at_infinity) or by part, not by a mixture: "
                "remove the other keys"
            )
        if self.axes_um is not None and min(self.axes_um) <= 0:
            raise ValueError(f"detector {self.name!r}: axes_um must be > 0 um, got {list(self.axes_um)}")
        if self.polar_deg is not None and self.half_angle_deg is not None:
            self._check_cone(self.polar_deg, self.half_angle_deg)
        return self

    def _check_cone(self, polar: float, half_angle: float) -> None:
        """Refuse cones that leave the half space above the sample, or that the plate does not cut in an ellipse."""
        if self.at_infinity and polar + half_angle > 90.0:
            raise ValueError(
                f"detector {self.name!r}: polar_deg + half_angle_deg must be <= 90 deg so that the cone stays above "
                f"the sample's plane, got {polar} + {half_angle}: make the cone narrower or steeper"
            )
        if not self.at_infinity and polar + half_angle >= 89.0:
            raise ValueError(
                f"detector {self.name!r}: polar_deg + half_angle_deg must be < 89 deg so that the cone meets the "
                f"plate in an ellipse, got {polar} + {half_angle}: make it narrower, or set at_infinity = true"
            )

    @property
    def needs_mesh(self) -> bool:
        """Whether it makes sense with a plate of kind "mesh" only."""
        return self.part is not None or self.height_um is not None

    def opening(self, working_distance: float) -> Aperture | Cone | None:
        """Return the ellipse on a plate `working_distance` [um] high, the cone at infinity; None: a mesh's part."""
        if self.part is not None:
            return None
        if self.center_um is not None and self.axes_um is not None:
            semi = (0.5 * self.axes_um[0], 0.5 * self.axes_um[1])
            return Aperture(self.center_um, semi, math.radians(self.rotation_deg or 0.0))
        assert self.polar_deg is not None and self.half_angle_deg is not None  # by the validator above
        polar, azimuth, half = map(math.radians, (self.polar_deg, self.azimuth_deg or 0.0, self.half_angle_deg))
        if not self.at_infinity:
            return cone_ellipse(polar, azimuth, half, working_distance)
        s = math.sin(polar)
        return Cone((s * math.cos(azimuth), s * math.sin(azimuth), math.cos(polar)), half)
