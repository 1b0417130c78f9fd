"""The level of the signal on a flat border: where it is off, fits and searches start from there.

Wrong gains, background that nobody subtracted, wrong directions and a dark substrate all bring it off. By the stated
instrument all data of such a detector are outliers: the photometric solution takes them for slopes, and a robust fit
from there can rest in heights of three times the true ones.
"""

import numpy as np

from helio_jax.arrays import border_mask
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.laws import level_ratio
from helio_jax.forward.optics import Optics
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.linear import signal_of
from helio_jax.inverse.parameters import LawPrior
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack

OFF = 0.05
"""Levels count as right where no detector's is off by a larger share: multiple scattering and masks of high objects do
as much."""
MOST = 5.0
"""Levels that are off by a larger factor, or not positive, count as off by this one."""


def border_signal(optics: Optics, law: LawPrior | None = None) -> np.ndarray:
    """Compute the signal of the level substrate [detector]; arguments as those of `border_levels`."""
    return substrate_signal(optics) * (1.0 if law is None else level_ratio(law.mean, optics))


def border_ratios(signal: np.ndarray, expected: np.ndarray, border_fraction: float) -> np.ndarray:
    """Compute the median signal on the border over what is expected [detector], NaN for a detector without data there.

    Args:
        signal: of every pixel [detector, y, x], NaN where not observed.
        expected: signal of the level substrate [detector].
        border_fraction: width of the border.
    """
    of_border = signal[:, border_mask(signal.shape[1:], border_fraction)]  # type: ignore[arg-type]
    found, is_known = np.full(len(signal), np.nan), np.isfinite(of_border).any(1)
    found[is_known] = np.nanmedian(of_border[is_known], axis=1) / expected[is_known]
    return found


def border_levels(
    signal: np.ndarray,
    optics: Optics,
    settings: ReconstructSettings,
    law: LawPrior | None = None,
    is_albedo_known: bool = True,
) -> np.ndarray:
    """Compute the level of a flat border's signal over that of the level substrate [detector].

    All are 1 where the border is free, and where none is off by more than `OFF`; so is that of a detector without data
    on the border.

    Args:
        signal: in units of the beam, over the albedo [detector, y, x], NaN where not observed.
        optics: as stated.
        settings: width and kind of the border.
        law: whose mean the substrate scatters by; None: the cosine law.
        is_albedo_known: whether `signal` is that of albedo 1; if not, levels are relative to their geometric mean.
    """
    none = np.ones(len(signal))
    if settings.border != "flat":
        return none
    ratios = border_ratios(signal, border_signal(optics, law), settings.border_fraction)
    is_known = np.isfinite(ratios)
    found = np.where(is_known, np.clip(ratios, 1.0 / MOST, MOST), none)
    if is_known.any() and not is_albedo_known:
        found[is_known] /= np.exp(np.mean(np.log(found[is_known])))
    return found if np.abs(found - 1.0).max() > OFF else none


def levelled_signal(
    stack: MicrographStack,
    settings: ReconstructSettings,
    patches: AlbedoPatches | None = None,
    is_albedo_known: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Return signal and variance of a stack (`signal_of`), brought to the right level on a flat border.

    Args:
        stack: micrographs.
        settings: width and kind of the border.
        patches: of other albedos, which the signal of the border is divided by.
        is_albedo_known: as in `border_levels`, apart from `patches`; if not, the detectors are brought to one level.
    """
    signal, variance = signal_of(stack)
    of_sample = signal if patches is None else signal / patches.albedo
    level = border_levels(of_sample, Optics.of(stack.instrument), settings, is_albedo_known=is_albedo_known)
    return signal / level[:, None, None], variance / level[:, None, None] ** 2
