"""Generate the mesh of a pinhole plate: a watertight solid with a channel for each aperture and the pinhole.

The only import of manifold3d. Plate frame: scene/plates.py. Parts of the result: the solid, and one detecting surface
at the upper end of every channel.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.detector import Aperture
from helio_jax.errors import MissingDependencyError, SceneError
from helio_jax.instrument import Instrument
from helio_jax.scene.meshes import stl_bytes
from helio_jax.settings import UNITS_UM

SEGMENTS = 128
"""Sides of the polygon, of equal area, that represents an ellipse or a disc."""
STL_UNIT = "mm"
"""Unit of an STL file, which states none itself."""
SOLID_NAME = "plate_solid"
"""Part of the OBJ file that scatters."""
_RADIUS_RATIO = 1.25
"""Default radius of the plate over the distance of the farthest channel edge from its centre."""
_ROUNDING = 1e-9
"""Overlap volume of two channels, over the volume of the plate, that counts as rounding error."""


@dataclass(frozen=True, eq=False)
class DrilledPlate:
    """The mesh of a plate (plate frame, um).

    Attributes:
        vertices, faces: of the solid, watertight [n, 3], [m, 3].
        ends: rim of the upper end of every detector's channel, counter-clockwise from above [SEGMENTS, 3].
        openings: the ellipse of each of these rims.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ends: dict[str, np.ndarray]
    openings: Mapping[str, Aperture]

    def obj(self, comment: str = "") -> str:
        """Format as an OBJ file: the solid, and for each detector a part of its name."""
        lines = [f"# {line}" for line in comment.splitlines()]
        start = 1
        rims = [(name, rim, _fan(len(rim))) for name, rim in self.ends.items()]
        for name, vertices, faces in [(SOLID_NAME, self.vertices, self.faces), *rims]:
            lines += [f"o {name}", *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices)]
            lines += [f"f {a} {b} {c}" for a, b, c in faces + start]
            start += len(vertices)
        return "\n".join(lines) + "\n"

    def stl(self) -> bytes:
        """Format the solid as a binary STL file in mm, the unit of programs that print or mill it; without the ends."""
        return stl_bytes(self.vertices / UNITS_UM[STL_UNIT], self.faces)

    def tables_of_stl(self, file: str) -> str:
        """Format the tables of a scene that uses the STL file: ellipses at the upper ends count the atoms."""
        text, top = (
            [f'[plate]\nkind = "mesh"\nfile = {json.dumps(file)}\nunit = "{STL_UNIT}"'],
            self.vertices[:, 2].max(),
        )
        for name, a in self.openings.items():
            (x, y), (first, second) = a.center, a.semi_axes
            text.append(
                f"[[detector]]\nname = {json.dumps(name)}\ncenter_um = [{x:.9g}, {y:.9g}]\n"
                f"axes_um = [{2.0 * first:.9g}, {2.0 * second:.9g}]\nrotation_deg = {math.degrees(a.rotation):.9g}\n"
                f"height_um = {top:.9g}"
            )
        return "\n\n".join([*text, '[trace]\nestimator = "analog"'])

    def tables(self, file: str) -> str:
        """Format the tables of a scene that uses the OBJ file."""
        text = [f'[plate]\nkind = "mesh"\nfile = {json.dumps(file)}\nunit = "um"\npart = "{SOLID_NAME}"']
        text += [f"[[detector]]\nname = {json.dumps(name)}\npart = {json.dumps(name)}" for name in self.ends]
        return "\n\n".join([*text, '[trace]\nestimator = "analog"'])


@dataclass(frozen=True)
class _Bore:
    """A straight channel.

    Attributes:
        name: of its detector; "": the pinhole's.
        opening: its ellipse in the underside.
        outline: that ellipse as a polygon [n, 2].
        lean: lateral shift (x, y) per um of height.
        growth: of the ellipse's size per um of height, relative.
    """

    name: str
    opening: Aperture
    outline: np.ndarray
    lean: tuple[float, float]
    growth: float = 0.0

    def outline_at(self, z: float) -> np.ndarray:
        """Return the outline at a height [n, 3], um."""
        center = np.asarray(self.opening.center)
        at = center + (self.outline - center) * (1.0 + z * self.growth) + z * np.asarray(self.lean)
        return np.column_stack([at, np.full(len(at), z)])

    def opening_at(self, z: float) -> Aperture:
        """Return the ellipse at a height."""
        (x, y), size = self.opening.center, 1.0 + z * self.growth
        axes = self.opening.semi_axes[0] * size, self.opening.semi_axes[1] * size
        return Aperture((x + z * self.lean[0], y + z * self.lean[1]), axes, self.opening.rotation)


def drill_plate(
    instrument: Instrument,
    thickness: float,
    radius: float | None = None,
    angle: float | None = None,
    *,
    is_conical: bool = False,
) -> DrilledPlate:
    """Generate a plate with channels for an instrument's apertures and pinhole.

    The cross-section of a channel parallel to the plate is its aperture at all heights; of a conical one it is the
    section of the cone from the nominal spot through its aperture, so that it cuts off nothing of what that spot sends.
    Its axis leans radially away from the point above the nominal spot; the pinhole's channel follows the beam and is
    never conical.

    Args:
        instrument: apertures, pinhole and, for a flat scattering plate, its outline.
        thickness: of the plate, um.
        radius: of the disc, um; default: the outline of a scattering plate, or a disc that contains all channels.
        angle: between channels and plate normal, rad; default: each channel points at the nominal spot.
        is_conical: whether the channels of the detectors are cones.

    Raises:
        SceneError: thickness or angle out of range; an angle of conical channels; a channel leaves the plate sideways
            or meets another one; a detector is no aperture in a flat plate, or its name cannot name a mesh part.
        MissingDependencyError: manifold3d is not installed.
    """
    if not 0.0 < thickness <= 1e6:
        raise SceneError(f"the plate's thickness must be > 0 um and <= 1e6 um, got {thickness:g}")
    if angle is not None and not 0.0 <= angle < math.radians(80.0):
        raise SceneError(f"the channels' angle must be >= 0 deg and < 80 deg, got {math.degrees(angle):g}")
    if is_conical and angle is not None:
        raise SceneError("conical channels point at the nominal spot: leave out the channels' angle")
    if is_conical and thickness >= instrument.working_distance:
        raise SceneError(
            f"a plate with conical channels must be thinner than the working distance of "
            f"{instrument.working_distance:g} um, got {thickness:g} um: reduce the thickness"
        )
    try:
        import manifold3d
    except ImportError:
        raise MissingDependencyError("helio plate needs manifold3d: pip install 'helio-jax[plates]'") from None
    bores = _bores(instrument, angle, is_conical)
    block = manifold3d.CrossSection([_outline(instrument, bores, thickness, radius)]).extrude(thickness)
    tools = [_tool(manifold3d, bore, -0.5 * thickness, 1.5 * thickness) for bore in bores]
    _check(manifold3d, bores, tools, block, thickness)
    solid = block - manifold3d.Manifold.batch_boolean(tools, manifold3d.OpType.Add)
    mesh = solid.to_mesh64()
    names = set(instrument.detector_names)
    of_detectors = [b for b in bores if b.name in names]
    ends = {b.name: b.outline_at(thickness) for b in of_detectors}
    openings = {b.name: b.opening_at(thickness) for b in of_detectors}
    return DrilledPlate(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, np.int64), ends, openings)


def _bores(instrument: Instrument, angle: float | None, is_conical: bool) -> list[_Bore]:
    """Construct the channels of all detectors and of the pinhole."""
    out = []
    for detector, a in zip(instrument.detector, instrument.apertures(), strict=True):
        if detector.name == SOLID_NAME or not detector.name.isprintable() or detector.name != detector.name.strip():
            raise SceneError(f"detector {detector.name!r}: cannot name a part of a mesh: rename it")
        x, y = a.center
        far = math.hypot(x, y)
        slope = far / instrument.working_distance if angle is None else math.tan(angle)
        lean = (slope * x / far, slope * y / far) if far > 0.0 else (0.0, 0.0)
        growth = 1.0 / instrument.working_distance if is_conical else 0.0
        out.append(_Bore(detector.name, a, _polygon(a), lean, growth))
    if (r := instrument.beam.pinhole_radius_um) > 0.0:
        (x, y, _), (tx, ty) = instrument.pinhole_center, instrument.beam_shift
        opening = Aperture((x, y), (r, r), 0.0)
        out.append(_Bore("", opening, _polygon(opening), (-tx, -ty)))
    return out


def _polygon(aperture: Aperture, n: int = SEGMENTS) -> np.ndarray:
    """Approximate an ellipse by a polygon of equal area [n, 2], counter-clockwise."""
    points, center = aperture.rim(n)[0], np.asarray(aperture.center)
    return center + (points - center) * math.sqrt(2.0 * math.pi / n / math.sin(2.0 * math.pi / n))


def _outline(instrument: Instrument, bores: list[_Bore], thickness: float, radius: float | None) -> np.ndarray:
    """Return the outline of the plate [n, 2]."""
    plate = instrument.plate
    if radius is None and plate.kind == "scattering":
        (x, y), (a, b) = plate.outline
        if plate.radius_um is None:
            return np.array([[x - a, y - b], [x + a, y - b], [x + a, y + b], [x - a, y + b]])
        return _polygon(Aperture((x, y), (a, b), 0.0))
    if radius is None:
        rims = (b.outline_at(z)[:, :2] for b in bores for z in (0.0, thickness))
        radius = _RADIUS_RATIO * max(float(np.hypot(*rim.T).max()) for rim in rims)
    return _polygon(Aperture((0.0, 0.0), (radius, radius), 0.0))


def _tool(manifold3d: Any, bore: _Bore, low: float, high: float) -> Any:
    """Construct a channel between two heights: a sheared prism, or cone, whose section at z = 0 is the outline."""
    (x, y), (lean_x, lean_y) = bore.opening.center, bore.lean
    at_low, at_high = (1.0 + z * bore.growth for z in (low, high))
    section = manifold3d.CrossSection([(bore.outline - np.array([x, y])) * at_low])
    upright = section.extrude(high - low, scale_top=(at_high / at_low,) * 2).translate([0.0, 0.0, low])
    return upright.transform(np.array([[1.0, 0.0, lean_x, x], [0.0, 1.0, lean_y, y], [0.0, 0.0, 1.0, 0.0]]))


def _check(manifold3d: Any, bores: list[_Bore], tools: list[Any], block: Any, thickness: float) -> None:
    """Refuse channels that leave the plate sideways or meet one another."""
    for i, (bore, tool) in enumerate(zip(bores, tools, strict=True)):
        what = f"the channel of {bore.name!r}" if bore.name else "the pinhole's channel"
        slab = tool.trim_by_plane([0.0, 0.0, 1.0], 0.0).trim_by_plane([0.0, 0.0, -1.0], -thickness)
        if (slab - block).volume() > _ROUNDING * block.volume():
            raise SceneError(f"{what} leaves the plate at its rim: enlarge the radius, or make the plate thinner")
        for other, second in zip(bores[:i], tools[:i], strict=True):
            if (slab ^ second).volume() > _ROUNDING * block.volume():
                with_what = f"that of {other.name!r}" if other.name else "the pinhole's"
                raise SceneError(
                    f"{what} meets {with_what} within the plate: make the plate thinner, or change the channels' angle"
                )


def _fan(n: int) -> np.ndarray:
    """Triangulate a convex polygon of `n` corners [n - 2, 3], keeping its orientation."""
    k = np.arange(1, n - 1)
    return np.stack([np.zeros_like(k), k, k + 1], 1)
