"""Calibration of aligned scans of a rotated sample by their constant albedo: gains, backgrounds, drift and distance.

For measured scans of one aperture (alignment/align.py) without a flat border. Reading per pixel and scan = gain (signal
of the facet x (1 - share) + share + drift at the scan's time), where the signal of the substrate is 1; the fit itself
is constant_albedo.py. Polar angle (the sample's distance), shares and slopes are correlated: `spread_deg` states how
uncertain the angle is, and slopes change with it.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from helio_jax.arrays import as_json
from helio_jax.calibration.constant_albedo import Model, Readings, fit_constant_albedo, level_model
from helio_jax.errors import GuardError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack

MIN_SCANS = 4
"""Images in which a pixel that takes part is seen: two of them determine its normal, the others test the model."""
_MIN_PIXELS = 50
_MAX_PIXELS = 800
_SEED = 1
_DRIFT_DEGREE = 3
_WINDOW = 5
"""Side of the square whose median stands for a pixel. A mean would mix facets: their mean normal is shorter than one,
which looks like more background (0.78 for 0.75 on pyramids without any noise)."""
_MARGIN = 3
"""Width of a scan's border that is not used [pixels]."""
_SHARES = (0.5, 0.7, 0.8)
"""Shares of background from which the fit starts."""


class Relief(NamedTuple):
    """A known or estimated surface.

    Attributes:
        height: over the sample's plane [y, x], um.
        multiple: its multiple scattering, relative to the signal of the substrate [image, y, x].
    """

    height: np.ndarray
    multiple: np.ndarray


class SelfCalibration(NamedTuple):
    """Result of the calibration.

    Attributes:
        gain: reading of the substrate in each image.
        share: fraction of that reading which is background [image].
        drift: coefficients of the Legendre polynomials in scan time, from the first on, over the gain [image, degree].
        polar_deg: effective polar angle.
        spread_deg: its standard deviation.
        multiple: factor of the predicted multiple scattering.
        multiple_std: its standard deviation.
        misfit: rms of reading / gain about the model.
    """

    gain: np.ndarray
    share: np.ndarray
    drift: np.ndarray
    polar_deg: float
    spread_deg: float
    multiple: float
    multiple_std: float
    misfit: float

    @property
    def signal(self) -> np.ndarray:
        """Reading of the substrate above the background [image]."""
        return self.gain * (1.0 - self.share)

    def background(self, time: np.ndarray) -> np.ndarray:
        """Compute the reading of the background at scan times [image, y, x], -1 to 1."""
        terms = np.polynomial.legendre.legvander(time, self.drift.shape[1])
        level = np.concatenate([self.share[:, None], self.drift], 1)
        return self.gain[:, None, None] * np.einsum("kj,kyxj->kyx", level, terms)


def self_calibrate(
    stack: MicrographStack,
    relief: Relief | None = None,
    start: SelfCalibration | None = None,
    *,
    drift_degree: int = _DRIFT_DEGREE,
    n_pixels: int = _MAX_PIXELS,
) -> SelfCalibration:
    """Fit gains, backgrounds and polar angle of an aligned stack.

    Args:
        stack: readings; drift is fitted where the times of its scans are known.
        relief: the surface; None: a plane, which scatters once.
        start: an earlier calibration from which the fit starts.
        drift_degree: degree of the polynomial in scan time that describes each background; 0: no drift.
        n_pixels: at most so many pixels take part, drawn at random.

    Raises:
        GuardError: fewer than 4 images, apertures at different polar angles, or too few pixels seen in 4.
    """
    centers = np.array([a.center for a in stack.instrument.apertures()])
    radius = np.linalg.norm(centers, axis=1)
    polar = np.arctan2(radius, stack.instrument.sample_distance)
    if len(polar) < MIN_SCANS or np.ptp(polar) > math.radians(0.5):
        raise GuardError(
            f"self-calibration needs {MIN_SCANS} or more images by one aperture, the sample rotated, got {len(polar)} "
            f"at polar angles of {np.degrees(polar.min()):.1f} to {np.degrees(polar.max()):.1f} deg: calibrate on a "
            "flat border instead"
        )
    inside = np.stack([ndimage.binary_erosion(known, iterations=_MARGIN) for known in stack.is_observed])
    candidates = np.flatnonzero(inside.sum(0) >= MIN_SCANS)
    if candidates.size < _MIN_PIXELS:
        raise GuardError(f"self-calibration needs {_MIN_PIXELS} pixels in {MIN_SCANS} images, got {candidates.size}")
    chosen = np.random.default_rng(_SEED).permutation(candidates)[:n_pixels]
    size = math.sqrt(np.mean([np.prod(a.semi_axes) for a in stack.instrument.apertures()]))
    aperture = np.arctan2(*centers.T[::-1]), float(radius.mean()), size
    readings, unit = _readings(stack, drift_degree, relief, inside, chosen, aperture)
    prior = float(polar.mean()), math.radians(stack.instrument.polar_std_deg)
    if start is None:
        starts = [level_model(readings, share, prior[0]) for share in _SHARES]
    else:
        near = float(np.clip(start.share.mean(), 0.1, 0.95))
        starts = [level_model(readings, near + by, math.radians(start.polar_deg)) for by in (0.0, -0.05)]
    found = fit_constant_albedo(readings, prior, starts)
    return _in_readings(found.model, unit, found.covariance, found.misfit)


def _readings(stack, drift_degree, relief, inside, chosen, aperture) -> tuple[Readings, np.ndarray]:
    """Collect the smoothed readings of the chosen pixels, over the median reading of each image, and these medians."""
    smoothed = [
        ndimage.median_filter(np.where(known, image, np.median(image[known])), _WINDOW)
        for image, known in zip(stack.counts, stack.is_observed, strict=True)
    ]
    k, time = len(smoothed), stack.scan_time
    value, known = (np.stack([np.asarray(image).ravel()[chosen] for image in images]) for images in (smoothed, inside))
    unit = np.array([np.median(v[seen]) for v, seen in zip(value, known, strict=True)])
    when = np.zeros(value.shape) if time is None else time.reshape(k, -1)[:, chosen]
    basis = np.polynomial.legendre.legvander(when, 0 if time is None else drift_degree)
    height = np.zeros(chosen.size) if relief is None else relief.height.ravel()[chosen]
    multiple = np.zeros(value.shape) if relief is None else relief.multiple.reshape(k, -1)[:, chosen]
    data = np.where(known, value / unit[:, None], 0.0)
    return Readings(data, known.astype(float), basis, height, multiple, *aperture), unit


def _in_readings(model: Model, unit: np.ndarray, covariance: np.ndarray, misfit: float) -> SelfCalibration:
    level = model.signal + model.background[:, 0]
    return SelfCalibration(
        gain=unit * level,
        share=model.background[:, 0] / level,
        drift=model.background[:, 1:] / level[:, None],
        polar_deg=math.degrees(model.polar),
        spread_deg=math.degrees(math.sqrt(covariance[0, 0])),
        multiple=model.multiple,
        multiple_std=math.sqrt(covariance[1, 1]),
        misfit=misfit,
    )


def apply_calibration(
    stack: MicrographStack, found: SelfCalibration, substrate_signal: np.ndarray, instrument: Instrument
) -> MicrographStack:
    """Subtract the backgrounds and scale a stack to units of the beam.

    Args:
        stack: readings.
        found: from `self_calibrate`.
        substrate_signal: detection probability of the substrate by the effective instrument [detector].
        instrument: from `effective_instrument`.
    """
    time = stack.scan_time
    scale = (substrate_signal / found.signal)[:, None, None]
    return stack.replace(
        counts=(stack.counts - found.background(np.zeros(stack.shape) if time is None else time)) * scale,
        variance=None if stack.variance is None else stack.variance * scale**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        instrument=instrument,
        provenance={**stack.provenance, "self_calibrate": as_json(found._asdict())},
    )


def effective_instrument(instrument: Instrument, polar_deg: float) -> Instrument:
    """Move the sample to the distance from which it sees the apertures at a polar angle.

    The plate is known as drilled; the distance of a tall sample is the less certain number.
    """
    radius = np.mean([math.hypot(*a.center) for a in instrument.apertures()])
    distance = float(radius / math.tan(math.radians(polar_deg)))
    return instrument.at_distance(distance)


def distance_std(instrument: Instrument, polar_std_deg: float) -> float:
    """Compute the standard deviation of an effective instrument's distance [um] from that of its polar angle."""
    radius = np.mean([math.hypot(*a.center) for a in instrument.apertures()])
    return float((radius + instrument.sample_distance**2 / radius) * math.radians(polar_std_deg))
