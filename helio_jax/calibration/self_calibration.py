"""Gains, backgrounds, drifts and distance of turned scans from the scans themselves: one albedo everywhere.

For measured scans of one aperture, aligned (align.py), without a flat border. Reading per pixel and scan = gain (signal
of the facet x (1 - share) + share + drift of the scan's time), where the signal of level ground is 1. The fit itself is
`constantalbedo.py`. Polar angle (the sample's distance) and shares are tied to each other and to the slopes:
`spread_deg`, how far the angle may move, is stated, and slopes go with it.
"""

import math
from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy import ndimage

from helio_jax.arrays import as_json
from helio_jax.calibration.constant_albedo import Model, Priors, Readings, fit_constant_albedo, level_model
from helio_jax.errors import GuardError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings

MIN_SCANS = 4
"""Images that a pixel which takes part is seen in: two of them fix its normal, the others test the model."""
_WINDOW = 5
"""Side of the square whose median stands for a pixel. A mean would mix facets: their mean normal is shorter than one,
which looks like more background (0.78 for 0.75 on pyramids without any noise)."""
_MARGIN = 3
"""Pixels along a scan's border that are left out."""
_SHARES = (0.5, 0.7, 0.8)
"""Shares of background from which the fit starts."""


class SelfCalibrateSettings(Settings):
    """How turned scans calibrate themselves."""

    polar_std_deg: float = Field(default=5.0, gt=0.0, le=45.0)
    """Prior deviation of the apertures' polar angle from the instrument file's [deg]."""
    share_std: float = Field(default=0.1, gt=0.0, le=1.0)
    """Prior deviation of the background from that of the other scans, relative to the reading."""
    drift_degree: int = Field(default=3, ge=0, le=9)
    """Degree of the polynomial in scan time that describes each background; 0: none drifts."""
    drift_std: float = Field(default=0.2, gt=0.0, le=1.0)
    """Prior deviation of its coefficients, relative to the reading."""
    multiple_std: float = Field(default=0.25, gt=0.0, le=10.0)
    """Prior deviation of the factor of predicted multiple scattering from 1; the surface is not yet known well."""
    n_pixels: int = Field(default=800, ge=50, le=100_000)
    """Pixels, seen in 4 scans or more, that take part, at most."""
    seed: int = Field(default=1, ge=0)
    """Which pixels those are."""


class Relief(NamedTuple):
    """What is known of the surface: heights over the sample's plane [y, x], um, and the multiple scattering of it
    [image, y, x], relative to level ground's signal."""

    height: np.ndarray
    multiple: np.ndarray


class SelfCalibration(NamedTuple):
    """What was found.

    Attributes:
        gain: reading of level ground in each image.
        share: background's share of it [image].
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
        """What level ground reads above the background [image]."""
        return self.gain * (1.0 - self.share)

    def background(self, time: np.ndarray) -> np.ndarray:
        """Return the background's reading at scan times [image, y, x], -1 to 1."""
        terms = np.polynomial.legendre.legvander(time, self.drift.shape[1])
        level = np.concatenate([self.share[:, None], self.drift], 1)
        return self.gain[:, None, None] * np.einsum("kj,kyxj->kyx", level, terms)


def self_calibrate(
    stack: MicrographStack,
    settings: SelfCalibrateSettings = SelfCalibrateSettings(),
    relief: Relief | None = None,
    start: SelfCalibration | None = None,
) -> SelfCalibration:
    """Fit gains, backgrounds and polar angle of an aligned stack.

    Args:
        stack: readings; drift is fitted where it knows its scans' time (`resample` tells it).
        settings: priors.
        relief: the surface, if something is known of it; else all is in the sample's plane, and scatters once.
        start: an earlier calibration, from which the fit starts instead of at the priors.

    Raises:
        GuardError: fewer than 4 images, apertures at different polar angles, or too few pixels seen in 4.
    """
    centers = np.array([a.center for a in stack.instrument.apertures()])
    radius = np.linalg.norm(centers, axis=1)
    polar = np.arctan2(radius, stack.instrument.sample_distance)
    if len(polar) < MIN_SCANS or np.ptp(polar) > math.radians(0.5):
        raise GuardError(
            f"self-calibration needs {MIN_SCANS} or more images by one turned aperture, got {len(polar)} at polar "
            f"angles of {np.degrees(polar.min()):.1f} to {np.degrees(polar.max()):.1f} deg: calibrate on a flat border "
            "instead"
        )
    inside = np.stack([ndimage.binary_erosion(known, iterations=_MARGIN) for known in stack.is_observed])
    candidates = np.flatnonzero(inside.sum(0) >= MIN_SCANS)
    least = SelfCalibrateSettings.model_fields["n_pixels"].metadata[0].ge
    if candidates.size < least:
        raise GuardError(f"self-calibration needs {least} pixels in {MIN_SCANS} images, got {candidates.size}")
    chosen = np.random.default_rng(settings.seed).permutation(candidates)[: settings.n_pixels]
    size = math.sqrt(np.mean([np.prod(a.semi_axes) for a in stack.instrument.apertures()]))
    aperture = np.arctan2(*centers.T[::-1]), float(radius.mean()), size
    readings, unit = _readings(stack, settings, relief, inside, chosen, aperture)
    mean = float(polar.mean())
    priors = Priors(
        mean, math.radians(settings.polar_std_deg), settings.share_std, settings.drift_std, settings.multiple_std
    )
    if start is None:
        starts = [level_model(readings, priors, share) for share in _SHARES]
    else:
        near = float(np.clip(start.share.mean(), 0.1, 0.95))
        starts = [level_model(readings, priors, near + by, math.radians(start.polar_deg)) for by in (0.0, -0.05)]
    found = fit_constant_albedo(readings, priors, starts)
    return _described(found.model, unit, found.covariance, found.misfit)


def _readings(stack, settings, relief, inside, chosen, aperture) -> tuple[Readings, np.ndarray]:
    """Return the chosen pixels' readings, and the median reading of each image."""
    calm = [
        ndimage.median_filter(np.where(known, image, np.median(image[known])), _WINDOW)
        for image, known in zip(stack.counts, stack.is_observed, strict=True)
    ]
    k, time = len(calm), stack.scan_time
    value, known = (np.stack([np.asarray(image).ravel()[chosen] for image in images]) for images in (calm, inside))
    unit = np.array([np.median(v[seen]) for v, seen in zip(value, known, strict=True)])
    when = np.zeros(value.shape) if time is None else time.reshape(k, -1)[:, chosen]
    basis = np.polynomial.legendre.legvander(when, 0 if time is None else settings.drift_degree)
    height = np.zeros(chosen.size) if relief is None else relief.height.ravel()[chosen]
    multiple = np.zeros(value.shape) if relief is None else relief.multiple.reshape(k, -1)[:, chosen]
    data = np.where(known, value / unit[:, None], 0.0)
    return Readings(data, known.astype(float), basis, height, multiple, *aperture), unit


def _described(model: Model, unit: np.ndarray, covariance: np.ndarray, misfit: float) -> SelfCalibration:
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


def apply(
    stack: MicrographStack, found: SelfCalibration, flat_signal: np.ndarray, instrument: Instrument
) -> MicrographStack:
    """Return the stack in units of the beam, background removed.

    Args:
        stack: readings.
        found: from `self_calibrate`.
        flat_signal: detection probability of level ground by the effective instrument [detector].
        instrument: from `effective_instrument`.
    """
    time = stack.scan_time
    scale = (flat_signal / found.signal)[:, None, None]
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
    """Return the instrument with the sample so far away that it sees the apertures under a polar angle.

    The plate is as it was drilled; how far away a tall sample stands is the less certain number.
    """
    radius = np.mean([math.hypot(*a.center) for a in instrument.apertures()])
    distance = float(radius / math.tan(math.radians(polar_deg)))
    return instrument.at_distance(distance)


def distance_std(instrument: Instrument, spread_deg: float) -> float:
    """Return how far off the distance of an effective instrument is [um] where its polar angle is off by so much."""
    radius = np.mean([math.hypot(*a.center) for a in instrument.apertures()])
    return float((radius + instrument.sample_distance**2 / radius) * math.radians(spread_deg))
