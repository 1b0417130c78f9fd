"""What is unknown in a real instrument and in a scan of a known object: names, units, prior standard deviations.

One list serves the fit, its report and the instrument file. The plate with its apertures is one rigid piece: shift,
scale, rotation, distance; single apertures deviate from it by a little. The sample is tilted against the plate, along
which the stage moves. Read-out unknowns (`readout_columns`) are linear: the model is gain * probability + offset +
pedestal + drift.
"""

import math
from typing import NamedTuple

import numpy as np
from pydantic import Field

from helio_jax.calibration.known_objects import KnownObject
from helio_jax.forward.readout import ScanOrder, drift_modes, pedestal_modes
from helio_jax.instrument import Instrument
from helio_jax.settings import Settings

PLATE = ("plate shift x", "plate shift y", "plate scale", "plate rotation", "sample distance", "incidence")
"""Unknowns of plate and beam, in array order; those of every aperture follow."""
OBJECT = (
    *("object x", "object y", "object azimuth", "tilt x", "tilt y", "radius", "height", "slope"),
    *("log albedo ratio", "exponent", "log multiple scattering"),
)
"""Unknowns of every scan, in array order."""
_UNITS = {
    "deg": ("plate rotation", "incidence", "polar", "azimuth", "object azimuth", "tilt x", "tilt y", "slope"),
    "um": ("plate shift x", "plate shift y", "sample distance", "object x", "object y", "radius", "height"),
}


PATHS, RAYS = 2_000_000, (64, 512)
"""Default number of traced paths, and of paths per pixel: least and most."""


class KnownShapeSettings(Settings):
    """The fit of an instrument to objects of known shape: `helio calibrate --known`, `--set KEY=VALUE`.

    Prior standard deviations are those of a real instrument; 0: known exactly. What the instrument file states in
    [uncertainty] wins over those of plate and beam, not over those of single apertures: there a file states all that
    is uncertain of their angles, of which the plate's rigid motion is the greater part.
    """

    plate_shift: float = Field(default=0.15, ge=0.0, le=1.0)
    """Of the plate's shift against the beam, along x and y, over the sample distance."""
    plate_scale: float = Field(default=0.03, ge=0.0, le=0.5)
    """Of the scale of the plate's plane."""
    plate_rotation_deg: float = Field(default=2.0, ge=0.0, le=45.0)
    """Of the plate's rotation about its normal [deg]."""
    distance: float = Field(default=0.06, ge=0.0, le=0.5)
    """Of the sample distance, relative."""
    incidence_deg: float = Field(default=0.6, ge=0.0, le=20.0)
    """Of the beam's incidence [deg]."""
    polar_deg: float = Field(default=0.0, ge=0.0, le=20.0)
    """Of the polar angle of every aperture by itself [deg]."""
    azimuth_deg: float = Field(default=0.0, ge=0.0, le=20.0)
    """Of the azimuth of every aperture by itself [deg]."""
    tilt_deg: float = Field(default=1.7, ge=0.0, le=10.0)
    """Of the substrate's tilt against the plate, about x and y [deg]."""
    albedo: float = Field(default=0.1, ge=0.0, le=1.0)
    """Of the albedo of the object over the substrate's."""
    exponent: float = Field(default=0.1, ge=0.0, le=1.0)
    """Of m in a scattering law cos^(1 + m); 0: the cosine law."""
    multiple: float = Field(default=0.05, ge=0.0, le=1.0)
    """Of the multiple scattering, relative."""
    pedestal: float = Field(default=0.3, ge=0.0, le=10.0)
    """Of the pedestal over the raster, in units of the substrate's signal."""
    pedestal_degree: int = Field(default=3, ge=0, le=6)
    """Degree of its polynomial."""
    drift: float = Field(default=0.05, ge=0.0, le=10.0)
    """Of the drift in scan time, in units of the substrate's signal."""
    drift_degree: int = Field(default=5, ge=0, le=9)
    """Degree of its polynomial."""
    gain: float = Field(default=1.0, gt=0.0, le=10.0)
    """Of every gain, relative."""
    offset: float = Field(default=3.0, gt=0.0, le=100.0)
    """Of every offset, in units of the substrate's signal."""
    leave_out_ring: tuple[float, float] | None = None
    """Ring about the foot of a ball that is left out, in radii of the foot, e.g. [0.93, 1.06]."""
    robust_limit: float = Field(default=4.0, gt=0.0, le=100.0)
    """Residual [standard deviations] at which a pixel's weight falls to a half."""
    max_rounds: int = Field(default=14, ge=1, le=50)
    """How often multiple scattering and weights are computed anew."""
    substrate_um: float = Field(default=8000.0, gt=0.0, le=1e6)
    """Side of the substrate about the image's middle, as far as it scatters [um]."""
    rays: int | None = Field(default=None, ge=0, le=100_000)
    """Paths per pixel by which the multiple scattering is traced; 0: it is computed by radiosity alone. Few of them
    make its fitted factor too small, as noise in a regressor does. Default: 2 million paths, 64 to 512 per pixel."""

    def rays_of(self, n_pixels: int) -> int:
        """Number of paths per pixel of a raster of so many pixels."""
        least, most = RAYS
        return int(np.clip(PATHS // n_pixels, least, most)) if self.rays is None else self.rays


class Unknown(NamedTuple):
    """One unknown: its name, unit, stated value, prior standard deviation (0: known), and 1 unit in um, rad or 1."""

    name: str
    unit: str
    stated: float
    prior: float
    factor: float


def unit_of(name: str) -> tuple[str, float]:
    """Return the unit in which an unknown is shown, and one of it in um, rad or 1."""
    head = name.split(" of ")[0]
    for unit, names in _UNITS.items():
        if head in names:
            return unit, math.radians(1.0) if unit == "deg" else 1.0
    return "", 1.0


def instrument_unknowns(instrument: Instrument, settings: KnownShapeSettings) -> list[Unknown]:
    """List the unknowns that all scans share: plate, beam, apertures."""
    s, stated, distance = settings, instrument.uncertainty, instrument.sample_distance
    priors = {
        "plate shift x": stated.plate_shift_um or s.plate_shift * distance,
        "plate shift y": stated.plate_shift_um or s.plate_shift * distance,
        "plate scale": stated.plate_scale or s.plate_scale,
        "plate rotation": stated.plate_rotation_deg or s.plate_rotation_deg,
        "sample distance": stated.sample_distance_um or s.distance * distance,
        "incidence": stated.incidence_deg or s.incidence_deg,
    }
    values = {"plate scale": 1.0, "sample distance": distance, "incidence": instrument.beam.incidence_deg}
    for kind, prior in (("polar", s.polar_deg), ("azimuth", s.azimuth_deg)):
        for k, name in enumerate(instrument.detector_names):
            aim = instrument.detector[k].aim(instrument.working_distance)
            assert aim is not None  # apertures in a flat plate
            label = f"{kind} of {name}"
            priors[label], values[label] = prior, math.degrees(aim[kind == "azimuth"])
    return [_unknown(name, values.get(name, 0.0), prior) for name, prior in priors.items()]


def object_unknowns(known: KnownObject, reach: float, settings: KnownShapeSettings) -> list[Unknown]:
    """List the unknowns of one scan; `reach` is half the width of its image [um]."""
    s, deg = settings, math.degrees(1.0)
    (radius, height, slope), (radius_std, height_std, slope_std) = known.numbers(), known.stds()
    has_edge, is_object = known.kind in ("step", "wedge"), known.kind != "flat"
    rows = (
        (0.0, reach * is_object), (0.0, reach * (known.kind == "ball")), (known.facing, 5.0 * has_edge),
        (0.0, s.tilt_deg), (0.0, s.tilt_deg), (radius, radius_std), (height, height_std),
        (deg * slope, deg * slope_std), (0.0, s.albedo * is_object), (0.0, s.exponent), (0.0, s.multiple * is_object),
    )  # fmt: skip
    return [_unknown(name, value, prior) for name, (value, prior) in zip(OBJECT, rows, strict=True)]


def _unknown(name: str, value: float, prior: float) -> Unknown:
    unit, factor = unit_of(name)
    return Unknown(name, unit, value, prior, factor)


class Columns(NamedTuple):
    """The linear unknowns of one detector: names, shapes [mode, y, x], prior standard deviations over the signal."""

    names: tuple[str, ...]
    modes: np.ndarray
    priors: np.ndarray


def readout_columns(x: np.ndarray, y: np.ndarray, slow_axis: int, settings: KnownShapeSettings) -> Columns:
    """List offset, pedestal over the raster and drift in scan time; the gain is apart."""
    s, shape = settings, (y.size, x.size)
    u, v = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in shape[::-1]))
    parts = [np.ones((1, *shape))]
    names, priors = ["offset"], [s.offset]
    if s.pedestal and s.pedestal_degree:
        parts.append(pedestal_modes(u, v, s.pedestal_degree)[0])
        names += [f"pedestal {i + 1}" for i in range(len(parts[-1]))]
        priors += [s.pedestal] * len(parts[-1])
    if s.drift and s.drift_degree:
        parts.append(drift_modes(shape, ScanOrder(slow_axis), (s.drift_degree, 1))[0])
        names += [f"drift {i + 1}" for i in range(len(parts[-1]))]
        priors += [s.drift] * len(parts[-1])
    return Columns(tuple(names), np.concatenate(parts), np.array(priors))
