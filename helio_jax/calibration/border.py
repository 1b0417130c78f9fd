"""First calibration of a measured scan: spikes, noise, slow drift, background and gain, with how far to trust them.

Measured stack (counts with unknown background and gain) -> the same stack in units of the beam, ready for a fit.
The drift is taken from the flat border; the gain from the border, whose expected signal is known; the background from
the darkest pixels: there the sample hides the whole aperture, and what is left above the background is multiple
scattering, of which a share of the flat's signal is assumed. All of that is a first estimate and fixes nothing: the
stack carries prior deviations (provenance, `calibrate.priors`) with which gain, offset, drift and the scan lines stay
unknowns of the fit. Needs a flat border and a spot that is masked in each image.
"""

import numpy as np
from pydantic import Field

from helio_jax.arrays import border_mask, robust_std
from helio_jax.calibration.noise_model import estimate_noise, find_spikes, line_noise
from helio_jax.errors import GuardError
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings


class CalibrateSettings(Settings):
    """How drift, background and gain are first estimated: `helio calibrate --set KEY=VALUE`."""

    border_fraction: float = Field(default=0.08, gt=0.0, lt=0.5)
    """Width of the flat border, as a fraction of the image on each side."""
    drift_degree: int = Field(default=3, ge=0, le=9)
    """Degree of the polynomial in scan time (along the slow axis) that describes the drift."""
    dark_quantile: float = Field(default=0.002, ge=0.0, le=0.2)
    """Quantile of each image that is taken as a wholly masked spot."""
    masked_share: float = Field(default=0.27, ge=0.0, lt=0.9)
    """Multiple scattering in such a spot, as a share of the flat's signal (0.27 in the simulated sphere A)."""
    drift: bool = True
    """Whether drift is taken off and left as an unknown of the fit."""
    noise_model: bool = True
    """Whether the variance follows the counts (a + b counts, from the data); else it stays as imported."""
    spike_limit: float = Field(default=6.0, ge=0.0, le=100.0)
    """A pixel that exceeds all its neighbours by so many standard deviations is a spike, unobserved; 0: none is."""
    lines: bool = True
    """Whether offsets of single scan lines are unknowns of the fit."""
    gain_std: float = Field(default=0.3, gt=0.0, le=1.0)
    """Prior deviation of the gain, relative, handed on to the fit."""
    offset_std: float = Field(default=0.3, gt=0.0, le=1.0)
    """Prior deviation of the background, relative to the flat's signal, handed on to the fit."""
    drift_std: float = Field(default=0.2, gt=0.0, le=1.0)
    """Prior deviation of what drift is left, relative to the flat's signal, handed on to the fit."""

    fit_rounds: int = Field(default=6, ge=1, le=50)
    """Rounds of the fit, handed on to it: with an unknown instrument heights settle more slowly."""


def _drift(image: np.ndarray, frame: np.ndarray, degree: int) -> np.ndarray:
    """Return the drift of an image whose rows are scanned one after another, mean zero [y, x].

    A polynomial in the row (time) and a slope along the row, fitted robustly to the frame's pixels. (A parabola along
    the row fits the frame of the measured sphere A with 9 to 18 % of the flat's signal, but hardly anything in the
    whole image against its simulation: it would be read into the sample.)
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
    """Return the counts without drift [detector, y, x], NaN where not observed."""
    counts = np.where(stack.is_observed, stack.counts, np.nan)
    if not settings.drift:
        return counts
    if stack.fast_axis == "x":
        return np.stack([image - _drift(image, frame, settings.drift_degree) for image in counts])
    return np.stack([image - _drift(image.T, frame.T, settings.drift_degree).T for image in counts])


def _without_faults(stack: MicrographStack, settings: CalibrateSettings) -> tuple[MicrographStack, dict]:
    """Return the stack with the noise of its counts and without spikes, and what was found."""
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
    """Return the stack in units of the beam, with first estimates of background and slow drift taken off.

    Args:
        stack: measured counts.
        flat_signal: detection probability of the flat reference plane [detector].
        settings: border, drift, background, priors.

    Raises:
        GuardError: a detector's border is not brighter than its background, so that it has no signal.
    """
    frame = border_mask(stack.shape[1:], settings.border_fraction)
    stack, record = _without_faults(stack, settings)
    assert stack.variance is not None  # estimated, if it was not known
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
    priors = {"gain_std": settings.gain_std, "offset_std": settings.offset_std, "max_rounds": settings.fit_rounds}
    priors |= {"drift_std": settings.drift_std} if settings.drift else {}
    priors |= {"line_std": lines} if settings.lines and lines > 0 else {}
    record |= {"gain": gain.tolist(), "background": background.tolist(), "flat": flat.tolist(), "priors": priors}
    record |= {"snr": ((flat - background) / pixel_std).tolist(), "pixel_std": pixel_std.tolist()}
    record["settings"] = settings.model_dump(mode="json")
    return stack.replace(
        counts=(steady - background[:, None, None]) / scale,
        variance=stack.variance / scale**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        provenance={**stack.provenance, "calibrate": record},
    )
