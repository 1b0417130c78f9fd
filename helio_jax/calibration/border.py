"""First calibration of a measured scan on its flat border: spikes, noise, slow drift, background and gain.

Measured stack (counts with unknown background and gain) -> the same stack in units of the beam, ready for a fit.
Drift and gain are estimated on the border, whose expected signal is known. The background is that of the measuring
campaign where the instrument states one ([readout], `shared_background`) and the border does not contradict it. Else it
comes from the darkest pixels: there the sample masks the whole aperture, and the counts above the background are
multiple scattering, an assumed fraction of the substrate's signal; each image needs a masked spot then. These are first
estimates: `Calibration.priors` leave gain, offset, drift and offsets of scan lines as unknowns to the fit.
"""

from typing import NamedTuple

import numpy as np
from pydantic import Field
from scipy.stats import chi2

from helio_jax.arrays import border_mask, robust_std
from helio_jax.calibration.noise_model import estimate_noise, find_spikes, line_noise
from helio_jax.calibration.shared_background import shared_background
from helio_jax.errors import GuardError
from helio_jax.micrograph import Calibration, MicrographStack
from helio_jax.settings import Settings

_PRIORS = {"gain_std": 0.3, "offset_std": 0.3}
_DRIFT_PRIORS = {"drift_std": 0.2}
"""Priors of the fit: relative standard deviation of the gain, standard deviations of background and residual drift over
the substrate's signal."""
_KNOWN_DRIFT_STD = 0.05
"""That of the drift where the background is the campaign's."""
_FALSE_ALARM = 1e-4
"""Probability at which the border of a scan contradicts the background of its campaign by chance."""
SAME_HEIGHT_UM = 5.0
"""Difference of the stage's heights up to which a scan has the sample distance of the campaign [um]."""
MAX_LEVEL_STD = 0.3
"""Largest standard deviation of the campaign's background with which it is used, over the signal."""


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
    readout: bool = True
    """Whether the background is taken from the instrument's [readout] where there is one."""
    readout_std: float = Field(default=0.02, ge=0.0, le=1.0)
    """By how much it may differ from scan to scan of a campaign [standard deviation, over the substrate's signal]."""
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


class _Background(NamedTuple):
    """Background of a scan as it was found.

    Attributes:
        above: counts above it, without drift [detector, y, x]; NaN where not observed.
        level: its mean over the image [detector], counts.
        source: where it comes from, in words.
        priors: settings of the fit that go with it.
        warnings: why the campaign's was not used, and that its sample distance does not hold.
    """

    above: np.ndarray
    level: np.ndarray
    source: str
    priors: dict[str, float]
    warnings: tuple[str, ...] = ()


def _of_darkest_pixels(stack: MicrographStack, frame: np.ndarray, settings: CalibrateSettings) -> _Background:
    """Estimate the background by the darkest pixels."""
    steady = _steady(stack, frame, settings)
    flat = np.nanmedian(steady[:, frame], axis=1)
    darkest = np.nanquantile(steady.reshape(len(steady), -1), settings.dark_quantile, axis=1)
    background = darkest - settings.masked_share / (1.0 - settings.masked_share) * (flat - darkest)
    return _Background(steady - background[:, None, None], background, "darkest pixels", {})


def _find_background(stack: MicrographStack, frame: np.ndarray, settings: CalibrateSettings) -> _Background:
    """Take the background from the campaign; where that is not known, or contradicted, from the darkest pixels."""
    readout = stack.instrument.readout
    if readout is None or not settings.readout:
        return _of_darkest_pixels(stack, frame, settings)
    shared = shared_background(stack, readout)
    level_std = np.hypot(shared.level_std / shared.signal, settings.readout_std)
    above = _steady(stack.replace(counts=stack.counts - shared.mean), frame, settings)
    ratio = np.nanmedian(above[:, frame], axis=1) / shared.signal
    # the level of the border is measured: an error of the background changes the signal above it by as much
    weight = level_std**-2.0
    misfit = float(np.sum(weight * (ratio - np.sum(weight * ratio) / np.sum(weight)) ** 2))
    why = ""
    if np.any(level_std > MAX_LEVEL_STD):
        cause = "the scan may lie outside of the stage window" if shared.is_placed else "the stage position is unknown"
        why = f"it is known to {np.max(level_std):.0%} of the signal only: {cause}"
    elif not np.all(ratio > 0.0) or (len(ratio) > 1 and chi2.sf(misfit, len(ratio) - 1) < _FALSE_ALARM):
        each = zip(stack.instrument.detector_names, ratio, level_std, strict=True)
        numbers = ", ".join(f"{name!r} {r:.2f} +- {std:.2f}" for name, r, std in each)
        why = f"with it the border's signal, relative to the campaign's, would be {numbers}, which do not agree"
    warnings = ()
    if abs(shared.raised) > SAME_HEIGHT_UM:
        warnings = (
            f"the stage stood {shared.raised:+.0f} um from its height in the scans that calibrated the instrument: the "
            "sample distance of its file is not that of this scan; set plate.sample_distance_um, or its uncertainty",
        )
    if why:
        text = f"the background of the instrument file ([readout]) was NOT used: {why}. Taken from the darkest pixels"
        return _of_darkest_pixels(stack, frame, settings)._replace(warnings=(*warnings, text))
    priors = {"offset_std": float(np.max(level_std))}
    if settings.drift:
        priors["drift_std"] = float(np.hypot(_KNOWN_DRIFT_STD, np.max(shared.shape_std / shared.signal)))
    source = "campaign" if shared.is_placed else "campaign, stage position unknown"
    return _Background(above, np.mean(shared.mean, axis=(1, 2)), source, priors, warnings)


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
        SceneError: the instrument's read-out is of other detectors or of another unit.
    """
    frame = border_mask(stack.shape[1:], settings.border_fraction)
    stack, record = _without_faults(stack, settings)
    assert stack.variance is not None  # `_without_faults` estimates it
    found = _find_background(stack, frame, settings)
    signal = np.nanmedian(found.above[:, frame], axis=1)
    for detector, above, dark in zip(stack.instrument.detector, signal, found.level, strict=True):
        if not above > 0.0:
            raise GuardError(
                f"detector {detector.name!r} has no signal: its flat border ({above + dark:g} {stack.unit}) is not "
                f"brighter than its background ({dark:g}); check the channel and that the border of the image is flat"
            )
    gain = signal / flat_signal
    scale = gain[:, None, None]
    pixel_std = np.sqrt(np.nanmedian(np.where(frame, stack.variance, np.nan), axis=(1, 2)))
    of_lines = line_noise(stack, found.above, frame)
    lines = float(np.sqrt(np.mean((of_lines / signal) ** 2)))
    record["line_noise"] = of_lines.tolist()
    priors = _PRIORS | (_DRIFT_PRIORS if settings.drift else {}) | found.priors
    priors |= {"line_std": lines} if settings.lines and lines > 0 else {}
    record |= {"gain": gain.tolist(), "background": found.level.tolist(), "flat": (signal + found.level).tolist()}
    record |= {"background_from": found.source, "warnings": list(found.warnings)}
    record |= {"snr": (signal / pixel_std).tolist(), "pixel_std": pixel_std.tolist()}
    record["settings"] = settings.model_dump(mode="json")
    return stack.replace(
        counts=found.above / scale,
        variance=stack.variance / scale**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        calibration=Calibration("border", priors, warnings=found.warnings),
        provenance={**stack.provenance, "calibrate": record},
    )
