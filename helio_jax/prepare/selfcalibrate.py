"""Gains, background and polar angle of turned scans from the scans themselves: an albedo that is the same everywhere.

For measured scans of one aperture, aligned (align.py), without a flat border. Model, far field, per pixel and scan k:
reading = gain_k (max(0, n . d_k) / cos(polar) (1 - share) + share), level ground reading 1. Unknown are the gains, the
`share` of the background in level ground's reading, the polar angle of the aperture (prior: the plate's own), and
a normal in every pixel. Cast shadows count as outliers; multiple scattering goes into the share. Polar angle and share
are tied to each other and to the slopes: `spread_deg`, how far the angle may move, is stated, and slopes go with it.
"""

import math
from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.optimize import minimize

from helio_jax.errors import GuardError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings

_ROUNDS = 6
_OUTLIER = 0.06
_MODEL_ERROR = 0.02
"""Deviation of a reading, over level ground's, from the model: facets are not quite flat, albedos not quite one."""
_TOGETHER = 25
"""Pixels that share such an error."""
_WINDOW = 5
"""Side of the square whose median stands for a pixel. A mean would mix facets: their mean normal is shorter than one,
which looks like more background (0.78 for 0.75 on pyramids without any noise; by the median 0.757)."""
_TILT_STEP, _AZIMUTH_STEP, _MAX_TILT = 3.0, 9.0, 78.0


class SelfCalibrateSettings(Settings):
    """How turned scans calibrate themselves."""

    polar_std_deg: float = Field(default=5.0, gt=0.0, le=45.0)
    """Prior deviation of the apertures' polar angle from the instrument file's [deg]."""
    n_pixels: int = Field(default=400, ge=50, le=100_000)
    """Pixels, seen in all scans, that take part."""
    seed: int = Field(default=1, ge=0)
    """Which pixels those are."""


class SelfCalibration(NamedTuple):
    """What was found.

    Attributes:
        gain: reading of level ground in each image.
        share: background's share of it.
        polar_deg: effective polar angle.
        spread_deg: its deviation, from the curvature of the misfit and the prior.
        misfit: rms of reading / gain about the model.
    """

    gain: np.ndarray
    share: float
    polar_deg: float
    spread_deg: float
    misfit: float


def self_calibrate(
    stack: MicrographStack, settings: SelfCalibrateSettings = SelfCalibrateSettings()
) -> SelfCalibration:
    """Fit gains, background and polar angle of an aligned stack.

    Raises:
        GuardError: fewer than 4 images, apertures at different polar angles, or too few pixels seen in all.
    """
    centers = np.array([a.center for a in stack.instrument.apertures()])
    polar = np.arctan2(np.linalg.norm(centers, axis=1), stack.instrument.working_distance)
    if len(polar) < 4 or np.ptp(polar) > math.radians(0.5):
        raise GuardError(
            f"self-calibration needs 4 or more images by one turned aperture, got {len(polar)} at polar angles of "
            f"{np.degrees(polar.min()):.1f} to {np.degrees(polar.max()):.1f} deg: calibrate on a flat border instead"
        )
    inside = np.asarray(ndimage.binary_erosion(stack.is_observed.all(0), iterations=3), bool)
    if inside.sum() < settings.n_pixels:
        raise GuardError(f"self-calibration needs {settings.n_pixels} pixels in all images, got {int(inside.sum())}")
    calm = [
        ndimage.median_filter(np.where(known, image, np.median(image[known])), _WINDOW)
        for image, known in zip(stack.counts, stack.is_observed, strict=True)
    ]
    draw = np.random.default_rng(settings.seed)
    chosen = np.asarray(draw.permutation(int(inside.sum()))[: settings.n_pixels], np.int64)
    data = np.stack([np.asarray(image)[inside][chosen] for image in calm])
    scale = np.median(data, axis=1)
    azimuth, prior = np.arctan2(centers[:, 1], centers[:, 0]), math.degrees(polar.mean())

    def cost(at: np.ndarray) -> float:
        if not (10.0 < at[0] < 75.0 and 0.0 <= at[1] < 0.97):
            return 1e9
        misfit, _ = _fit(data / scale[:, None], azimuth, math.radians(at[0]), at[1])
        return (
            0.5 * settings.n_pixels / _TOGETHER * misfit**2 / _MODEL_ERROR**2
            + 0.5 * ((at[0] - prior) / settings.polar_std_deg) ** 2
        )

    starts = [np.array([prior, share]) for share in (0.2, 0.5, 0.7, 0.8)]
    start = min(starts, key=cost)
    simplex = np.array([start, start + [4.0, 0.0], start + [0.0, 0.05]])
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 50, "xatol": 0.2, "fatol": 0.01},
    )
    misfit, gain = _fit(data / scale[:, None], azimuth, math.radians(found.x[0]), found.x[1])
    sides = [min(cost(found.x + [turn, by]) for by in (-0.05, -0.025, 0.0, 0.025, 0.05)) for turn in (-4.0, 4.0)]
    curvature = max((sum(sides) - 2 * found.fun) / 16.0, 1e-4)
    return SelfCalibration(scale / gain, float(found.x[1]), float(found.x[0]), 1 / math.sqrt(curvature), misfit)


def _fit(data: np.ndarray, azimuth: np.ndarray, polar: float, share: float) -> tuple[float, np.ndarray]:
    """Return the rms misfit and the factors [image] that bring images [image, pixel] to level ground = 1."""
    tilt, turn = (
        g.ravel()
        for g in np.meshgrid(
            np.radians(np.arange(0.0, _MAX_TILT, _TILT_STEP)), np.radians(np.arange(0.0, 360.0, _AZIMUTH_STEP))
        )
    )
    cosine = np.cos(tilt) + np.sin(tilt) * math.tan(polar) * np.cos(azimuth[:, None] - turn)
    model = (1.0 - share) * np.maximum(cosine, 0.0) + share
    factor = np.ones(len(data))
    for number in range(_ROUNDS):
        scaled = data * factor[:, None]
        away = (scaled[:, :, None] - model[:, None, :]) ** 2
        best = model[:, np.argmin(np.minimum(away, _OUTLIER**2 if number > 2 else 1.0).sum(0), axis=1)]
        weight = np.abs(scaled - best) < (_OUTLIER if number > 2 else 1.0)
        factor = np.sum(weight * best * data, 1) / np.maximum(np.sum(weight * data**2, 1), 1e-12)
    away = (data * factor[:, None] - best) ** 2
    return float(np.sqrt(np.mean(np.minimum(away, _OUTLIER**2)))), factor


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
    factor = flat_signal / (found.gain * (1.0 - found.share))
    spread = factor[:, None, None]
    record = {"gain": found.gain.tolist(), "share": found.share, "polar_deg": found.polar_deg}
    record |= {"polar_spread_deg": found.spread_deg, "misfit": found.misfit}
    return stack.replace(
        counts=(stack.counts - (found.share * found.gain)[:, None, None]) * spread,
        variance=None if stack.variance is None else stack.variance * spread**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        instrument=instrument,
        provenance={**stack.provenance, "self_calibrate": record},
    )


def effective_instrument(instrument: Instrument, polar_deg: float) -> Instrument:
    """Return the instrument with every aperture moved to a polar angle, its solid angle about kept."""
    detectors = []
    for detector, aperture in zip(instrument.detector, instrument.apertures(), strict=True):
        azimuth = math.atan2(aperture.center[1], aperture.center[0])
        radius = instrument.working_distance * math.tan(math.radians(polar_deg))
        detectors.append(
            detector.model_copy(
                update={
                    "center_um": (radius * math.cos(azimuth), radius * math.sin(azimuth)),
                    "axes_um": (2 * aperture.semi_axes[0], 2 * aperture.semi_axes[1]),
                    "rotation_deg": math.degrees(aperture.rotation),
                    "polar_deg": None,
                    "azimuth_deg": None,
                    "half_angle_deg": None,
                }
            )
        )
    return instrument.model_copy(update={"detector": tuple(detectors)})
