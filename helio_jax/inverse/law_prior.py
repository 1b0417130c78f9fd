"""What is unknown of the scattering law: its numbers, their prior, and their test against the cosine law."""

from typing import NamedTuple

import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.stats import chi2

from helio_jax.campaign import CampaignLaw
from helio_jax.errors import GuardError
from helio_jax.forward.laws import KNOTS_DEG, LobeLaw, MonotoneLaw, PowerLaw, RoughLaw, level_ratio
from helio_jax.forward.optics import Optics
from helio_jax.inverse.parameters import HELD, LawPrior
from helio_jax.inverse.settings import RefineSettings
from helio_jax.micrograph import MicrographStack

LEAST_IMAGES = 5
"""Least number of images from which a monotone law is fitted: three give the facet and its albedo."""
_NAMES = {
    PowerLaw: (("exponent of the law", "m of cos^(1 + m)"),),
    LobeLaw: (("share of the lobe", "of the atoms"), ("width of the lobe", "deg")),
    RoughLaw: (("roughness", "r of the rough diffuse law"),),
    MonotoneLaw: tuple((f"log exponent at {angle:.0f} deg", "natural logarithm") for angle in KNOTS_DEG),
}


class LawNumber(NamedTuple):
    """A number of a law: name and unit as they are shown, prior mean and standard deviation."""

    name: str
    unit: str
    mean: float
    std: float


def law_prior(settings: RefineSettings, stated: CampaignLaw | None = None) -> LawPrior | None:
    """Return the prior of a law's numbers; None where it is the cosine law.

    Args:
        settings: of the fit. A law that they name has a prior about the numbers of the cosine law.
        stated: law of the instrument file, for settings that name none. It is held (`HELD`), for three images hardly
            tell the law of unknown relief; what that leaves open is in the error bars (`fit.linearised_at`).
    """
    s = settings
    if s.law == "as_stated" and stated is not None:
        return LawPrior(PowerLaw(stated.exponent), PowerLaw(HELD * stated.std))
    if s.law == "power":
        return LawPrior(PowerLaw(0.0), PowerLaw(s.law_std))
    if s.law == "broad_specular":
        mean, std = (0.0, s.law_width_deg), (s.law_std, s.law_width_std_deg)
        return LawPrior(LobeLaw(*mean), LobeLaw(*std))
    if s.law == "rough_diffuse":
        return LawPrior(RoughLaw(0.0), RoughLaw(s.law_std))
    if s.law == "monotone":
        n = len(KNOTS_DEG)
        return LawPrior(MonotoneLaw(np.zeros(n)), MonotoneLaw(np.full(n, s.law_std)))
    return None


def with_level_of_law(stack: MicrographStack, settings: RefineSettings) -> MicrographStack:
    """Scale a calibrated stack: its substrate gets the signal that the stated law of the fit gives a level substrate.

    Calibration gives it that of the cosine law (about, where all facets of rotated scans are given one albedo). A stack
    in units of a known beam stays as it is.
    """
    ratio = None if stack.calibration is None else _stated_level_ratio(stack, settings)
    return stack if ratio is None else stack.scaled(ratio)


def with_level_of_cosine_law(stack: MicrographStack, settings: RefineSettings) -> MicrographStack:
    """Scale a stack whose substrate has the signal of the fit's stated law to that of the cosine law.

    Photometric starts take the cosine law.
    """
    ratio = _stated_level_ratio(stack, settings)
    return stack if ratio is None else stack.scaled(1.0 / ratio)


def _stated_level_ratio(stack: MicrographStack, settings: RefineSettings) -> np.ndarray | None:
    """Compute the signal of a level substrate by the law of the instrument file over that by the cosine law.

    [detector, 1, 1]; None where the file states none, or the fit takes another law, whose prior mean is the cosine law.
    """
    stated = stack.instrument.law
    if settings.law != "as_stated" or stated is None:
        return None
    return level_ratio(PowerLaw(stated.exponent), Optics.of(stack.instrument))[:, None, None]


def check_law(settings: RefineSettings, stated: CampaignLaw | None, n_images: int) -> None:
    """Raise GuardError where the images are too few for the law, or the multiple scattering is not modelled by it."""
    if settings.law == "as_stated" and stated is not None and settings.multiple == "radiosity":
        raise GuardError(
            "reconstruct.refine.multiple = 'radiosity' knows the cosine law only, the instrument file states another "
            "one in [law]: set multiple = 'traced', or law = 'cosine'"
        )
    if settings.law == "monotone" and n_images < LEAST_IMAGES:
        raise GuardError(
            f"reconstruct.refine.law = 'monotone' needs {LEAST_IMAGES} or more images, got {n_images}: take another "
            "law, e.g. law = 'power', or add detectors or rotated scans"
        )


def numbers_of(prior: LawPrior | None) -> list[LawNumber]:
    """List the unknown numbers of a law; none of the cosine law."""
    if prior is None:
        return []
    means, stds = (np.asarray(ravel_pytree(part)[0]).tolist() for part in (prior.mean, prior.std))
    return [LawNumber(*name, *known) for name, *known in zip(_NAMES[type(prior.mean)], means, stds, strict=True)]


def cosine_probability(prior: LawPrior, whitened: np.ndarray, covariance: np.ndarray) -> float:
    """Compute how often numbers of the cosine law would come out as far from it as fitted ones, or farther, by chance.

    The cosine law's numbers are 0. The width of a lobe does not count: a lobe without atoms is the cosine law whatever
    its width.

    Args:
        prior: of the law.
        whitened: fitted numbers, in prior standard deviations from their prior means [number].
        covariance: posterior covariance, in these units [number, number].
    """
    n = 1 if isinstance(prior.mean, LobeLaw) else len(whitened)
    mean, std = (np.asarray(ravel_pytree(part)[0]) for part in (prior.mean, prior.std))
    from_cosine = (whitened + mean / std)[:n]
    chi_square = from_cosine @ np.linalg.solve(covariance[:n, :n], from_cosine)
    return float(chi2.sf(chi_square, n))
