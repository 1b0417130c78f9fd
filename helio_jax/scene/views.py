"""Views of a scan: the same beam positions at another distance, or with sample or detectors turned.

Each view becomes one `MicrographStack`; several make a `MicrographSet`. Rotations are counter-clockwise seen from above
(about the beam: seen from the source), so turning the sample by +a at normal incidence shows what turning the apertures
by -a does, apart from where the sample then lies (DESIGN.md section 1).
"""

import math
from dataclasses import dataclass

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.instrument import Detector, Instrument
from helio_jax.scene.body import Body
from helio_jax.scene.scan import Line, Scan


@dataclass(frozen=True, eq=False)
class View:
    """One view of a scan.

    Attributes:
        label: what tells it from the others; "" for the only one.
        instrument: with the distance and the apertures of this view.
        turn: rotation matrix of the sample [3, 3], or None.
        axis: where the axis of that rotation meets the plane z = 0 [um].
        sample_rotation: of the sample about the plate normal [rad]; about an oblique beam: about that.
        about: the same for people, JSON-compatible.
    """

    label: str
    instrument: Instrument
    turn: np.ndarray | None
    axis: tuple[float, float]
    sample_rotation: float
    about: dict[str, float | str]

    def turned(self, body: Body) -> Body:
        """Return the sample as it stands in this view.

        Raises:
            SceneError: it touches the plate.
        """
        if self.turn is not None:
            there = (*self.axis, 0.0)
            body = body.moved((-there[0], -there[1], 0.0)).transformed(self.turn, 1.0, there)
        if body.max_height >= self.instrument.sample_distance:
            raise SceneError(
                f"scan: in the view {self.label!r} the sample's top at {body.max_height:g} um touches the plate, which "
                f"is {self.instrument.sample_distance:g} um above the reference plane: leave out this view"
            )
        return body


def views_of(scan: Scan, instrument: Instrument) -> tuple[View, ...]:
    """Return all views of a scan, distances running fastest."""
    distances = scan.sample_distances_um
    if isinstance(scan, Line) and scan.along == "beam":
        distances = tuple((instrument.sample_distance + scan.steps).tolist())
    return tuple(_view(scan, instrument, a, d) for a in scan.rotations_deg or (None,) for d in distances or (None,))


def _view(scan: Scan, instrument: Instrument, angle_deg: float | None, distance: float | None) -> View:
    """Return one view; None: as the instrument and the sample are."""
    about: dict[str, float | str] = {}
    words, turn, rotation = [], None, 0.0
    if angle_deg is not None:
        words.append(f"{scan.rotate} at {angle_deg:g} deg")
        about |= {"rotation_deg": angle_deg, "rotated": scan.rotate, "axis": scan.about}
    if angle_deg is not None and scan.rotate == "detectors":
        turned = tuple(_turned(d, angle_deg) for d in instrument.detector)
        instrument = instrument.model_copy(update={"detector": turned})
    elif angle_deg is not None:
        rotation = math.radians(angle_deg)
        turn = _about(-instrument.beam_direction if scan.about == "beam" else np.array([0.0, 0.0, 1.0]), rotation)
    if distance is not None:
        words.append(f"{distance:g} um")
        about["sample_distance_um"] = distance
        instrument = instrument.at_distance(distance)
    return View(", ".join(words), instrument, turn, scan.axis_um, rotation, about)


def _turned(detector: Detector, angle_deg: float) -> Detector:
    """Return a detector whose aperture is turned about the point of the plate above the nominal spot."""
    if detector.center_um is None:
        return detector.model_copy(update={"azimuth_deg": _wrapped((detector.azimuth_deg or 0.0) + angle_deg)})
    (x, y), a = detector.center_um, math.radians(angle_deg)
    center = (math.cos(a) * x - math.sin(a) * y, math.sin(a) * x + math.cos(a) * y)
    rotation = _wrapped((detector.rotation_deg or 0.0) + angle_deg)
    return detector.model_copy(update={"center_um": center, "rotation_deg": rotation})


def _wrapped(angle_deg: float) -> float:
    """Return the same direction within -180 to 180 deg."""
    return math.remainder(angle_deg, 360.0)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the matrix of a right-handed rotation about a unit axis [3, 3] (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
