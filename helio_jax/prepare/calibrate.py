"""First calibration of a measured scan: slow drift, background and gain from the flat border of the image.

Measured stack (counts with unknown background and gain) -> the same stack in units of the beam, ready for a fit.
The drift is taken from the border; the gain from the border, whose expected signal is known; the background from the
darkest pixels: there the sample hides the whole aperture, and what is left above the background is multiple
scattering, of which a share of the flat's signal is assumed. A rough first estimate: gain and offset must stay
unknowns of the fit, with wide priors. Needs a flat border and a spot that is masked in each image.
"""

import numpy as np
from pydantic import Field

from helio_jax.arrays import border_mask
from helio_jax.errors import GuardError
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings


class CalibrateSettings(Settings):
    """How drift, background and gain are first estimated: table `[calibrate]`."""

    border_fraction: float = Field(default=0.08, gt=0.0, lt=0.5)
    """Width of the flat border, as a fraction of the image on each side."""
    drift_degree: int = Field(default=3, ge=0, le=9)
    """Degree of the polynomial in scan time (along the slow axis) that describes the drift."""
    dark_quantile: float = Field(default=0.002, ge=0.0, le=0.2)
    """Quantile of each image that is taken as a wholly masked spot."""
    masked_share: float = Field(default=0.27, ge=0.0, lt=0.9)
    """Multiple scattering in such a spot, as a share of the flat's signal (0.27 in the simulated sphere A)."""


def _drift(image: np.ndarray, frame: np.ndarray, degree: int) -> np.ndarray:
    """Return the drift of an image whose rows are scanned one after another, mean zero [y, x].

    A polynomial in the row (time) and a slope along the row, fitted robustly to the frame's pixels.
    """
    time, along = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in image.shape), indexing="ij")
    basis = np.concatenate([np.polynomial.legendre.legvander(time, degree), along[..., None]], -1)
    keep = frame & np.isfinite(image)
    for _ in range(4):
        coefficients = np.linalg.lstsq(basis[keep], image[keep], rcond=None)[0]
        misfit = np.abs(image - basis @ coefficients)
        keep = frame & (misfit <= 3.0 * 1.4826 * np.median(misfit[keep]) + 1e-12)
    curve = basis @ coefficients
    return curve - curve.mean()


def calibrate_on_border(
    stack: MicrographStack, flat_signal: np.ndarray, settings: CalibrateSettings
) -> MicrographStack:
    """Return the stack in units of the beam, with background and slow drift removed.

    Args:
        stack: measured counts.
        flat_signal: detection probability of the flat reference plane [detector].
        settings: border, drift, background.

    Raises:
        GuardError: a detector's border is not brighter than its background, so that it has no signal.
    """
    is_row_slow = stack.fast_axis == "x"
    frame = border_mask(stack.shape[1:], settings.border_fraction)
    steady = np.where(stack.is_observed, stack.counts, np.nan)
    for k, image in enumerate(steady):
        if is_row_slow:
            steady[k] = image - _drift(image, frame, settings.drift_degree)
        else:
            steady[k] = image - _drift(image.T, frame.T, settings.drift_degree).T
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
    record = {"gain": gain.tolist(), "background": background.tolist(), "settings": settings.model_dump(mode="json")}
    return stack.replace(
        counts=(steady - background[:, None, None]) / scale,
        variance=None if stack.variance is None else stack.variance / scale**2,
        background=None,
        n_rays=1.0,
        unit="detected per beam atom",
        provenance={**stack.provenance, "calibrate": record},
    )
