"""What an experiment would determine of a height map and of its instrument: the bound by Fisher's information.

No data are needed: the linearisation, priors and marginalisation are those of the fit, at a surface that is assumed,
with the counting noise that its expected micrographs would have. For planning (dose, raster) and design (apertures).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np

from helio_jax.arguments import checked
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import plan_radiosity
from helio_jax.forward.render import (
    Corrections,
    detection_probability,
    masking_corrections,
    radiosity_corrections,
)
from helio_jax.forward.surface import Surface, surface_of_heights
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.fit import posterior_at
from helio_jax.inverse.instrument_report import listed_one_by_one, plain_name, units_of
from helio_jax.inverse.posterior import Posterior
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.samples import check_samples
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState, set_corrections, with_responses

N_SAMPLES = 256
"""Samples of the posterior: standard deviations are known to 4 %."""


@dataclass(frozen=True)
class Information:
    """What an experiment would determine.

    Attributes:
        height_std: standard deviation of each height above the substrate, or, with a free border, of the level and
            relief that the data and the priors leave [y, x], um.
        parameters: of every unknown of the instrument: standard deviation that the experiment would leave, prior
            standard deviation, unit; e.g. parameters["log_gain 0"] of the first detector.
        posterior: samples, covariance of the parameters, response of the heights to each.

    Example:
        >>> hx.fisher(height, optics, raster, 35_000).height_std
    """

    height_std: np.ndarray
    parameters: Mapping[str, tuple[float, float, str]]
    posterior: Posterior


@checked
def fisher(
    height: Any,
    optics: Optics,
    raster: Raster,
    dose: Any,
    *,
    background: Any = 0.0,
    uncertainty: Uncertainty | None = None,
    settings: ReconstructSettings | None = None,
    corrections: Corrections | Literal["none", "masking", "radiosity"] = "masking",
    albedo: Any = 1.0,
    n_samples: int = N_SAMPLES,
) -> Information:
    """Compute what an experiment would determine of heights and instrument.

    Args:
        height: assumed heights [y, x], um, or a `Surface` with known slopes.
        optics: beam and apertures.
        raster: beam positions.
        dose: beam atoms per pixel times detection efficiency, scalar or [detector]; counting noise is Poisson.
        background: counts per pixel that do not come from the sample, scalar or [detector].
        uncertainty: prior standard deviations of the geometry (table [uncertainty]); default: known exactly.
        settings: priors of gain, offset, drift ...; whether the border is flat (table [reconstruct]).
        corrections: masks and multiple scattering, as in `hx.render`.
        albedo: relative reflectivity, scalar or [y, x].
        n_samples: from which standard deviations are taken, 2 at least; they are known to 1 / sqrt(2 n).

    Raises:
        SceneError: too few samples.

    Example:
        >>> three = hx.fisher(height, hx.Optics.of(instrument), raster, dose=1e6)
        >>> three.height_std.mean(), three.parameters["offset 0"]

    Source: Cramer-Rao bound with Gaussian priors; sampling as in `posterior.sample_posterior`.
    """
    check_samples(n_samples)
    problem, state = pose_experiment(
        height, optics, raster, dose, background, uncertainty, settings, corrections, albedo
    )
    posterior = posterior_at(problem, with_responses(problem, state), n_samples)
    listed = listed_one_by_one(posterior.names)
    names = tuple(posterior.names[i] for i in listed)
    matrix, units = units_of(problem, names)
    deviation = np.sqrt(np.diag(matrix @ posterior.instrument_covariance[np.ix_(listed, listed)] @ matrix.T))
    numbers, priors = tuple(map(str, range(optics.n_detectors))), np.linalg.norm(matrix, axis=1)
    parameters = {
        plain_name(name, numbers, problem.priors.law): (float(std), float(prior), unit)
        for name, std, prior, unit in zip(names, deviation, priors, units, strict=True)
        if prior > 0.0
    }
    return Information(posterior.height_std, parameters, posterior)


def pose_experiment(
    height: Any,
    optics: Optics,
    raster: Raster,
    dose: Any,
    background: Any,
    uncertainty: Uncertainty | None,
    settings: ReconstructSettings | None,
    corrections: Corrections | Literal["none", "masking", "radiosity"],
    albedo: Any,
) -> tuple[FitProblem, FitState]:
    """Pose the fit to the expected micrographs of an assumed surface, its state being the truth; as `fisher`."""
    settings = settings or ReconstructSettings()
    shift = np.asarray(optics.beam_shift)
    with jax.enable_x64(True):
        surface = height if isinstance(height, Surface) else surface_of_heights(height, raster)
        surface = jax.tree.map(lambda f: np.asarray(f, np.float64), surface)
        if corrections == "none":
            corrections = Corrections.none((optics.n_detectors, *raster.shape))
        elif corrections == "radiosity":
            plan = plan_radiosity(surface.height, surface.normals(shift), optics, raster)
            corrections = radiosity_corrections(surface, optics, raster, plan)
        elif corrections == "masking":
            corrections = masking_corrections(surface, optics, raster)
        probability = np.asarray(detection_probability(surface, optics, corrections, albedo))
    dose = np.broadcast_to(dose, len(probability))[:, None, None]
    counts = dose * np.maximum(probability, 0.0) + np.broadcast_to(background, len(probability))[:, None, None]
    variance = np.maximum(counts, 1.0) / dose**2
    problem = FitProblem.of(probability, variance, optics, raster, surface, settings, uncertainty=uncertainty)
    return problem, set_corrections(problem, FitState.at(problem, surface), corrections, surface)


@checked
def posterior_std(height: Any, optics: Optics, raster: Raster, dose: Any, **options: Any) -> np.ndarray:
    """Compute the standard deviation [y, x], um, with which an experiment would determine each height (`fisher`).

    Example:
        >>> hx.posterior_std(height, optics, raster, 35_000)
    """
    return fisher(height, optics, raster, dose, **options).height_std
