"""Views of a scan: the same beam positions at another distance, or with rotated sample or detectors.

Each view gives one `MicrographStack`, several views a `MicrographSet`. Rotations are counter-clockwise seen from above
(about the beam: seen from the source). Rotating the sample by +a at normal incidence equals rotating the apertures by
-a, except for the orientation of the sample in the image (docs/conventions.md).
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
        label: distance and rotation in words; "" for the only view.
        instrument: with the distance and the apertures of this view.
        rotation: rotation matrix of the sample [3, 3], or None.
        axis: point (x, y) in the plane z = 0 on the axis of that rotation [um].
        sample_rotation: angle of that rotation, about the plate normal or the beam [rad].
        description: distance and rotation as in the scene file, JSON-compatible.
    """

    label: str
    instrument: Instrument
    rotation: np.ndarray | None
    axis: tuple[float, float]
    sample_rotation: float
    description: dict[str, float | str]

    def rotated_body(self, body: Body) -> Body:
        """Return the sample as it is placed in this view.

        Raises:
            SceneError: it touches the plate.
        """
        if self.rotation is not None:
            there = (*self.axis, 0.0)
            body = body.moved((-there[0], -there[1], 0.0)).transformed(self.rotation, 1.0, there)
        if body.max_height >= self.instrument.sample_distance:
            raise SceneError(
                f"scan: in the view {self.label!r} the sample's top at {body.max_height:g} um touches the plate, which "
                f"is {self.instrument.sample_distance:g} um above the substrate: remove this view"
            )
        return body


def views_of(scan: Scan, instrument: Instrument) -> tuple[View, ...]:
    """Construct all views of a scan, distances varying fastest."""
    distances = scan.sample_distances_um
    if isinstance(scan, Line) and scan.along == "beam":
        distances = tuple((instrument.sample_distance + scan.steps).tolist())
    return tuple(_view(scan, instrument, a, d) for a in scan.rotations_deg or (None,) for d in distances or (None,))


def _view(scan: Scan, instrument: Instrument, angle_deg: float | None, distance: float | None) -> View:
    """Construct one view; None: unchanged."""
    description: dict[str, float | str] = {}
    words, matrix, angle = [], None, 0.0
    if angle_deg is not None:
        words.append(f"{scan.rotate} at {angle_deg:g} deg")
        description |= {"rotation_deg": angle_deg, "rotated": scan.rotate, "axis": scan.about}
    if angle_deg is not None and scan.rotate == "detectors":
        rotated = tuple(_rotate_detector(d, angle_deg) for d in instrument.detector)
        instrument = instrument.model_copy(update={"detector": rotated})
    elif angle_deg is not None:
        angle = math.radians(angle_deg)
        axis = -instrument.beam_direction if scan.about == "beam" else np.array([0.0, 0.0, 1.0])
        matrix = _rotation_about(axis, angle)
    if distance is not None:
        words.append(f"{distance:g} um")
        description["sample_distance_um"] = distance
        instrument = instrument.at_distance(distance)
    return View(", ".join(words), instrument, matrix, scan.axis_um, angle, description)


def _rotate_detector(detector: Detector, angle_deg: float) -> Detector:
    """Rotate a detector's aperture about the point of the plate above the nominal spot."""
    if detector.center_um is None:
        return detector.model_copy(update={"azimuth_deg": _wrapped((detector.azimuth_deg or 0.0) + angle_deg)})
    (x, y), a = detector.center_um, math.radians(angle_deg)
    center = (math.cos(a) * x - math.sin(a) * y, math.sin(a) * x + math.cos(a) * y)
    rotation = _wrapped((detector.rotation_deg or 0.0) + angle_deg)
    return detector.model_copy(update={"center_um": center, "rotation_deg": rotation})


def _wrapped(angle_deg: float) -> float:
    """Return the equivalent angle within -180 to 180 deg."""
    return math.remainder(angle_deg, 360.0)


def _rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Compute the matrix of a right-handed rotation about a unit axis [3, 3] (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
