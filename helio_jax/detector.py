"""Detectors: elliptical apertures in the plate, cones of directions at infinity, or parts of the plate's mesh.

`Detector` holds the settings; tracer and reconstruction use the resolved `Aperture` or `Cone`. Frames: instrument.py.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from helio_jax.settings import Settings

BeamAngle = Annotated[float, Field(ge=-360.0, le=360.0)]


@dataclass(frozen=True)
class Aperture:
    """An ellipse on the plate (lab frame): centre and semi-axes [um], rotation [rad]."""

    center: tuple[float, float]
    semi_axes: tuple[float, float]
    rotation: float

    def rim(self, n_points: int) -> np.ndarray:
        """Compute rim points and tangents, equally spaced in the ellipse's parameter, counter-clockwise from above.

        Returns:
            Positions (x, y) on the plate [um] and their derivatives by the parameter [um/rad], [2, n_points, 2].
        """
        s = 2 * np.pi * np.arange(n_points) / n_points
        (a, b), c, d = self.semi_axes, math.cos(self.rotation), math.sin(self.rotation)
        rotation = np.array([[c, -d], [d, c]])
        points = np.stack([a * np.cos(s), b * np.sin(s)], -1) @ rotation.T + np.asarray(self.center)
        tangents = np.stack([-a * np.sin(s), b * np.cos(s)], -1) @ rotation.T
        return np.stack([points, tangents])


@dataclass(frozen=True)
class Cone:
    """A detector at infinity: all directions within `half_angle` [rad] of a unit vector (lab frame, z up)."""

    axis: tuple[float, float, float]
    half_angle: float

    @property
    def solid_angle(self) -> float:
        """Solid angle of the cone [sr]."""
        return 4.0 * math.pi * math.sin(0.5 * self.half_angle) ** 2


def axis_frame(axis: np.ndarray) -> np.ndarray:
    """Construct an orthonormal frame [3, 3] whose last row is the unit vector `axis`."""
    side = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(side, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def cone_ellipse(polar: float, azimuth: float, half_angle: float, distance: float) -> Aperture:
    """Intersect a circular cone about the nominal spot with the plate; the major axis lies along the azimuth.

    Valid for polar + half_angle < pi/2.

    Args:
        polar, azimuth: direction of the cone's axis, `polar` from the plate normal [rad].
        half_angle: half-angle of the cone [rad].
        distance: from the nominal spot to the plate [um].

    Source: own derivation (plane section of a cone), tests/unit/test_instrument.py.
    """
    near, far = distance * math.tan(polar - half_angle), distance * math.tan(polar + half_angle)
    minor = distance * math.sin(half_angle) / math.sqrt(math.cos(polar) ** 2 - math.sin(half_angle) ** 2)
    r = 0.5 * (near + far)
    return Aperture((r * math.cos(azimuth), r * math.sin(azimuth)), (0.5 * (far - near), minor), azimuth)


MAX_NAME = 64
"""Most characters of the name of a detector."""
_KINDS = (
    (("center_um", "axes_um"), ("rotation_deg", "height_um")),
    (("polar_deg", "half_angle_deg"), ("azimuth_deg", "at_infinity")),
    (("part",), ()),
)
"""Required and optional keys of each kind of detector."""


class Detector(Settings):
    """One detector: an ellipse on the plate, a cone about the nominal spot, a cone at infinity, or a mesh part.

    Where detectors overlap, the first one in the list counts the atoms. With a plate of kind "mesh" the first surface
    that an atom hits counts it (of two ellipses in one plane: the first in the list); cones at infinity come last.
    """

    name: str = Field(min_length=1, max_length=MAX_NAME)
    """Name shown in figures and files."""
    center_um: tuple[float, float] | None = None
    """Centre (x, y) of the ellipse on the plate, lab frame [um]."""
    axes_um: tuple[float, float] | None = None
    """FULL axes of the ellipse; the first one along x before rotation [um]."""
    rotation_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    """Rotation of the ellipse, counter-clockwise seen from above (default 0) [deg]."""
    height_um: float | None = Field(default=None, ge=0.0, le=1e7)
    """Height of the ellipse above the underside of a plate of kind "mesh", for example at the end of a channel
    (default 0) [um]."""
    polar_deg: float | None = Field(default=None, ge=0.0, lt=90.0)
    """Angle between the cone's axis and the plate normal, seen from the nominal spot [deg]."""
    azimuth_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    """Azimuth of the cone's axis, counter-clockwise from +x (default 0) [deg]."""
    half_angle_deg: float | None = Field(default=None, gt=0.0, le=90.0)
    """Half-angle of the cone [deg]."""
    at_infinity: bool = False
    """The cone is a range of directions: it counts atoms from any point that leave within the cone and hit nothing
    else (not with a flat scattering plate)."""
    part: str | None = Field(default=None, min_length=1, max_length=200)
    """Part of the mesh of a plate of kind "mesh" that counts the atoms that hit it: name of an OBJ material (usemtl),
    group or object, or of a GLB geometry."""
    channel: int | None = Field(default=None, ge=1, le=1000)
    """Channel of this aperture in a measured file (1-based); only used on import."""
    beam_deg: tuple[BeamAngle, BeamAngle] | None = None
    """Incidence and azimuth of the beam of this detector's scan, where a stack joins scans of several beams (default:
    those of [beam]); such an instrument cannot be simulated, its scans can [deg]."""

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
        """Refuse cones that reach below the sample's plane, or whose section with the plate is no ellipse."""
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
        """Whether it requires a plate of kind "mesh"."""
        return self.part is not None or self.height_um is not None

    def aim(self, working_distance: float) -> tuple[float, float] | None:
        """Return polar angle and azimuth, seen from the nominal spot [rad]; None: a mesh part.

        Of a cone its axis as stated, of an ellipse its centre on a plate at `working_distance` [um].
        """
        if self.polar_deg is not None:
            return math.radians(self.polar_deg), math.radians(self.azimuth_deg or 0.0)
        if self.center_um is None:
            return None
        x, y = self.center_um
        return math.atan2(math.hypot(x, y), working_distance), math.atan2(y, x)

    def opening(self, working_distance: float) -> Aperture | Cone | None:
        """Resolve to the ellipse on a plate at `working_distance` [um], or the cone at infinity; None: a mesh part."""
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
