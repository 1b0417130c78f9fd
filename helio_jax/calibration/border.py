"""First calibration of a measured scan on its flat border: spikes, noise, slow drift, background and gain.

Measured stack (counts with unknown background and gain) -> the same stack in units of the beam, ready for a fit.
Drift and gain are estimated on the border, whose expected signal is known; the background from the darkest pixels:
there the sample masks the whole aperture, and the counts above the background are multiple scattering, an assumed
fraction of the substrate's signal. These are first estimates: `Calibration.priors` leave gain, offset, drift and
offsets of scan lines as unknowns to the fit. Needs a flat border and a masked spot in each image.
"""

import numpy as np
from pydantic import Field

from helio_jax.arrays import border_mask, robust_std
from helio_jax.calibration.noise_model import estimate_noise, find_spikes, line_noise
from helio_jax.errors import GuardError
from helio_jax.micrograph import Calibration, MicrographStack
from helio_jax.settings import Settings

_PRIORS = {"gain_std": 0.3, "offset_std": 0.3, "max_rounds": 6}
_DRIFT_PRIORS = {"drift_std": 0.2}
"""Priors of the fit: relative standard deviation of the gain, standard deviations of background and residual drift over
the substrate's signal, and its iterations: with an unknown instrument heights converge more slowly."""


class CalibrateSettings(Settings):
    """First estimate of drift, background and gain: `helio calibrate --set KEY=VALUE`."""

    border_fraction: float = Field(default=0.08, gt=0.0, lt=0.5)
    """Width of the flat border, as a fraction of the image on each side."""
    drift_degree: int = Field(default=3, ge=0, le=9)
    """Degree of the polynomial in scan time (along the slow axis) that describes the drift."""
    dark_quantile: float = Field(default=0.002, ge=0.0, le=0.2)
    """Quantile of each image that is taken for a wholly masked spot."""
    masked_share: float = Field(default=0.27, ge=0.0, lt=0.9)
    """Multiple scattering in such a spot, as a fraction of the substrate's signal (0.27 in the simulated sphere A)."""
    drift: bool = True
    """Whether drift is subtracted and left as an unknown of the fit."""
    noise_model: bool = True
    """Whether the variance is a + b counts, estimated from the data; else it stays as imported."""
    spike_limit: float = Field(default=6.0, ge=0.0, le=100.0)
    """A pixel that exceeds all its neighbours by so many standard deviations counts as unobserved; 0: no such test."""
    lines: bool = True
    """Whether offsets of single scan lines are unknowns of the fit."""


def _drift(image: np.ndarray, frame: np.ndarray, degree: int) -> np.ndarray:
    """Estimate the drift of an image whose rows are scanned one after another, mean zero [y, x].

    A polynomial in the row (time) and a slope along the row, fitted robustly to the frame's pixels. (A parabola along
    the row would fit the frame of the measured sphere A with 9 to 18 % of the substrate's signal, but is absent from
    the whole image compared with its simulation.)
    """
    time, along = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in image.shape), indexing="ij")
    basis = np.concatenate([np.polynomial.legendre.legvander(time, degree), along[..., None]], -1)
    keep = frame & np.isfinite(image)
    for _ in range(4):
        coefficients = np.linalg.lstsq(basis[keep], image[keep], rcond=None)[0]
        misfit = np.abs(image - basis @ coefficients)
        keep = frame & (misfit <= 3.0 * robust_std(misfit[keep]) + 1e-12)
    curve = basis @ coefficients
    return curve - curve.mean()


def _steady(stack: MicrographStack, frame: np.ndarray, settings: CalibrateSettings) -> np.ndarray:
    """Subtract the drift from the counts [detector, y, x]; NaN where not observed."""
    counts = np.where(stack.is_observed, stack.counts, np.nan)
    if not settings.drift:
        return counts
    if stack.fast_axis == "x":
        return np.stack([image - _drift(image, frame, settings.drift_degree) for image in counts])
    return np.stack([image - _drift(image.T, frame.T, settings.drift_degree).T for image in counts])


def _without_faults(stack: MicrographStack, settings: CalibrateSettings) -> tuple[MicrographStack, dict]:
    """Estimate the variance of the counts and mark spikes as unobserved; also return a record of both."""
    model = estimate_noise(stack)
    record = {"noise_constant": model.constant.tolist(), "noise_per_count": model.per_count.tolist()}
    spread = model.variance(stack.counts)
    if settings.noise_model or stack.variance is None:
        stack = stack.replace(variance=spread)
    spikes = np.zeros(stack.shape, bool)
    if settings.spike_limit > 0:
        spikes = find_spikes(stack, spread, settings.spike_limit)
        stack = stack.replace(is_observed=stack.is_observed & ~spikes)
    record["spikes"] = spikes.sum((1, 2)).tolist()
    return stack, record


def calibrate_on_border(
    stack: MicrographStack, flat_signal: np.ndarray, settings: CalibrateSettings
) -> MicrographStack:
    """Scale a stack to units of the beam and subtract first estimates of background and slow drift.

    Args:
        stack: measured counts.
        flat_signal: detection probability of the substrate [detector].
        settings: border, drift, background, priors.

    Raises:
        GuardError: a detector's border is not brighter than its background, so that it has no signal.
    """
    frame = border_mask(stack.shape[1:], settings.border_fraction)
    stack, record = _without_faults(stack, settings)
    assert stack.variance is not None  # `_without_faults` estimates it
    steady = _steady(stack, frame, settings)
    flat = np.nanmedian(steady[:, frame], axis=1)
    darkest = np.nanquantile(steady.reshape(len(steady), -1), settings.dark_quantile, axis=1)
    background = darkest - settings.masked_share / (1.0 - settings.masked_share) * (flat - darkest)
    for detector, level, dark in zip(stack.instrument.detector, flat, background, strict=True):
        if not level > dark:
            raise GuardError(
                f"detector {detector.name!r} has no signal: its flat border ({level:g} {stack.unit}) is not brighter "
                f"than its background ({dark:g}); check the channel and that the border of the image is flat"
            )
    gain = (flat - background) / flat_signal
    scale = gain[:, None, None]
    pixel_std = np.sqrt(np.nanmedian(np.where(frame, stack.variance, np.nan), axis=(1, 2)))
    of_lines = line_noise(stack, steady, frame)
    lines = float(np.sqrt(np.mean((of_lines / (flat - background)) ** 2)))
    record["line_noise"] = of_lines.tolist()
    priors = _PRIORS | (_DRIFT_PRIORS if settings.drift else {})
    priors |= {"line_std": lines} if settings.lines and lines > 0 else {}
    record |= {"gain": gain.tolist(), "background": background.tolist(), "flat": flat.tolist()}
    record |= {"snr": ((flat - background) / pixel_std).tolist(), "pixel_std": pixel_std.tolist()}
    record["settings"] = settings.model_dump(mode="json")
    return stack.replace(
        counts=(steady - background[:, None, None]) / scale,
        variance=stack.variance / scale**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        calibration=Calibration("border", priors),
        provenance={**stack.provenance, "calibrate": record},
    )
