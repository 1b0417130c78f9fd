"""Read apertures, beam and counts of the reference simulator's file.

Its frame: plate in the plane y = 0, apertures given as (x, z) in mm, full axes. Conversion to the lab frame: x = x,
y = -z, um. Its scan moves the sample, so its columns run against x. It does not store the rotation of the apertures.
"""

import math
from typing import Any

import numpy as np
from pydantic import ValidationError

from helio_jax.detector import Aperture
from helio_jax.errors import InputFileError
from helio_jax.formats.tables import get_array, get_list, get_number, get_table
from helio_jax.instrument import Instrument
from helio_jax.settings import in_one_line

_SOURCES = {"Uniform": "uniform", "Gaussian": "gaussian", "Infinite": "pencil"}
_LENGTH_TOLERANCE_UM = 1.0
_RELATIVE_TOLERANCE = 1e-3


def read_counts(path: str, tree: dict[str, Any], order: list[int]) -> np.ndarray:
    """Read counts of single and multiple scattering [2, detector, y, x], columns reversed.

    Args:
        path: for messages.
        tree: contents of the file.
        order: index in the file of each detector of the instrument.

    Raises:
        InputFileError: images missing or of different sizes.
    """
    im = get_table(path, tree, "im")
    orders = []
    for name in ("single", "multiple"):
        images = get_list(path, im, name, len(order))
        orders.append([get_array(path, images[k], f"im.{name}{{{k + 1}}}", 2)[:, ::-1] for k in order])
    shapes = {image.shape for images in orders for image in images}
    if len(shapes) != 1:
        raise InputFileError(f"{path}: im.single and im.multiple must all have one size, got {sorted(shapes)}")
    return np.array(orders)


def complete_instrument(path: str, tree: dict[str, Any], instrument: Instrument) -> tuple[Instrument, list[int]]:
    """Combine the file's instrument with the names and aperture rotations of the given one.

    Returns:
        The instrument in the given detector order, and the index in the file of each detector.

    Raises:
        InputFileError: file and instrument contradict each other.
    """
    beam, plate = _file_beam(path, tree), _file_plate(path, tree, instrument)
    _compare(path, "beam", beam, {k: getattr(instrument.beam, k) for k in instrument.beam.model_fields_set})
    _compare(path, "plate", plate, {k: getattr(instrument.plate, k) for k in instrument.plate.model_fields_set})
    ellipses = _file_ellipses(path, tree)
    order = _match_apertures(path, ellipses, instrument)
    detectors = []
    for ours, aperture, k in zip(instrument.detector, instrument.apertures(), order, strict=True):
        center, axes = ellipses[k]
        rotation = ours.rotation_deg if ours.center_um is not None else math.degrees(aperture.rotation)
        detectors.append(
            {"name": ours.name, "center_um": center, "axes_um": axes, "rotation_deg": rotation or 0.0}
            | ({} if ours.channel is None else {"channel": ours.channel})
        )
    parts = {
        "beam": instrument.beam.model_dump(exclude_unset=True) | beam,
        "plate": instrument.plate.model_dump(exclude_unset=True) | plate,
        "detector": detectors,
    }
    try:
        return Instrument.model_validate(parts), order
    except ValidationError as e:
        why = in_one_line(e, Instrument)
        raise InputFileError(f"{path}: its instrument is impossible, the file is corrupt: {why}") from None


def _file_beam(path: str, tree: dict[str, Any]) -> dict[str, Any]:
    """Read the beam as settings."""
    beam = get_table(path, tree, "beam_param")
    model = beam.get("source_model")
    if not isinstance(model, str) or model not in _SOURCES:
        raise InputFileError(f"{path}: source_model must be one of {', '.join(_SOURCES)}, got {model!r}")
    return {
        "incidence_deg": get_number(path, beam, "init_angle"),
        "azimuth_deg": 0.0,
        "pinhole_radius_um": _um(get_number(path, beam, "pinhole_r")),
        "source": _SOURCES[model],
        "source_size_mrad": _um(get_number(path, beam, "source_size")),
    }


def _file_plate(path: str, tree: dict[str, Any], instrument: Instrument) -> dict[str, float]:
    """Read the distances; the design working distance follows from the position of the pinhole."""
    beam = get_table(path, tree, "beam_param")
    incidence = get_number(path, beam, "init_angle")
    pinhole = get_array(path, beam.get("pinhole_c"), "beam_param.pinhole_c", 1)
    if pinhole.size != 3 or not np.all(np.isfinite(pinhole)) or abs(pinhole[2]) * 1000 > _LENGTH_TOLERANCE_UM:
        raise InputFileError(f"{path}: beam_param.pinhole_c must be (x, y, 0) mm, got {pinhole.tolist()}")
    distance = _um(get_number(path, get_table(path, tree, "param"), "z_sample_to_detector", low=0.0))
    if abs(incidence) < 0.1 or abs(incidence) > 80.0:
        return {"working_distance_um": instrument.working_distance, "sample_distance_um": distance}
    # the pinhole is W tan t upstream, given in mm to 8 decimals
    working = round(float(-pinhole[0]) * 1000 / math.tan(math.radians(incidence)), 3)
    return {"working_distance_um": working, "sample_distance_um": distance}


def _file_ellipses(path: str, tree: dict[str, Any]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Read centre and full axes of every aperture, lab frame [um]."""
    param = get_table(path, tree, "param")
    centers = get_list(path, param, "detector_position")
    axes = get_list(path, param, "detector_axes", len(centers))
    ellipses = []
    for k, (center, axis) in enumerate(zip(centers, axes, strict=True), start=1):
        c = get_array(path, center, f"param.detector_position{{{k}}}", 1)
        a = get_array(path, axis, f"param.detector_axes{{{k}}}", 1)
        if c.size != 2 or a.size != 2 or not np.all(np.isfinite([c, a])):
            raise InputFileError(f"{path}: aperture {k} must have two coordinates and two axes, got {c}, {a} mm")
        ellipses.append(((_um(c[0]), _um(-c[1]) + 0.0), (_um(a[0]), _um(a[1]))))
    return ellipses


def _match_apertures(path: str, ellipses: list, instrument: Instrument) -> list[int]:
    """Find each aperture of the instrument in the file by its centre, and check its axes."""
    if len(ellipses) != len(instrument.detector):
        raise InputFileError(
            f"{path} has {len(ellipses)} detectors, the instrument {len(instrument.detector)}: "
            "give the instrument that the file was made with"
        )
    order = []
    for ours, aperture in zip(instrument.detector, instrument.apertures(), strict=True):
        k = int(np.argmin([math.dist(center, aperture.center) for center, _ in ellipses]))
        _check_aperture(path, ours.name, ellipses[k], aperture)
        order.append(k)
    if len(set(order)) != len(order):
        raise InputFileError(f"{path}: two detectors of the instrument are the same aperture of the file ({order})")
    return order


def _check_aperture(path: str, name: str, ellipse: tuple, aperture: Aperture) -> None:
    """Compare one aperture of the file with that of the instrument."""
    center, axes = ellipse
    ours = tuple(2 * s for s in aperture.semi_axes)
    for what, theirs, given in (("centre", center, aperture.center), ("full axes", axes, ours)):
        if math.dist(theirs, given) > _LENGTH_TOLERANCE_UM:
            raise InputFileError(
                f"{path}: detector {name!r}: its {what} in the file is {theirs} um (lab frame), in the instrument "
                f"{tuple(round(g, 3) for g in given)} um: give the instrument that the file was made with"
            )


def _compare(path: str, table: str, found: dict[str, Any], given: dict[str, Any]) -> None:
    """Refuse explicitly given settings that differ from the file's."""
    for name, value in given.items():
        theirs = found.get(name)
        if theirs is None or value is None or value == theirs:
            continue
        if isinstance(value, str) or abs(value - theirs) > _RELATIVE_TOLERANCE * max(abs(value), abs(theirs)):
            raise InputFileError(
                f"{path}: {table}.{name} is {theirs} in the file but {value} in the instrument: "
                "give the instrument that the file was made with, or remove this setting"
            )


def _um(millimetres: float) -> float:
    """Convert mm to um (or rad to mrad), rounded to 1e-6 to keep the file's decimals."""
    return round(float(millimetres) * 1000, 6)
