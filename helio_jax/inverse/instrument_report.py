"""Report on the instrument as fitted, for files and people: values, error bars, weakly determined combinations.

A combination of parameters that the data hardly distinguish from others is no better known than its prior, and heights
depend on that prior: such combinations are listed, never hidden.
"""

import math
from typing import Any

import numpy as np

from helio_jax.inverse.fit import Fit
from helio_jax.inverse.law_prior import cosine_probability, numbers_of
from helio_jax.inverse.parameters import LawPrior, mode_weights
from helio_jax.inverse.problem import FitProblem

WEAK = 0.5
"""A combination is weak when the data leave more than this share of its prior standard deviation."""
_MAX_LISTED = 6
_MAX_TERMS = 4
"""Weak combinations that are listed at most, and parameters that are named in each."""
LEAST_PROBABILITY = 0.01
"""A law whose numbers deviate from the cosine law's with a smaller probability is not the cosine law."""
_OTHER = 1.0, "prior standard deviations"
_PRIOR_DOMINATED = 1.0 - 1e-6
"""A parameter that keeps all of its prior standard deviation affects no datum, and so no height."""


def units_of(problem: FitProblem, names: tuple[str, ...]) -> tuple[np.ndarray, list[str]]:
    """Compute the matrix from parameters in prior deviations to the units that are shown, and those units.

    It is diagonal but for distance and directions, whose prior errors may belong together.
    """
    s, geometry = problem.settings, problem.priors.geometry
    priors = {
        "log_gain": (s.gain_std, "relative"),
        "offset": (s.offset_std, "of the signal"),
        "log_multiple": (s.multiple_error, "relative"),
        "drift": (s.drift_std, "of the signal"),
        "patch": (s.patch_albedo_std, "natural logarithm"),
        "tilt": (math.degrees(problem.tilt_std), "deg"),
        "distance": (1.0, "um"),
        "polar": (math.degrees(1.0), "deg"),
        "azimuth": (math.degrees(1.0), "deg"),
    }
    kinds, law = [kind_of(name) for name in names], iter(numbers_of(problem.priors.law))
    found = [((number := next(law)).std, number.unit) if kind == "law" else priors.get(kind, _OTHER) for kind in kinds]
    matrix = np.diag([size for size, _ in found])
    of_geometry = [i for i, kind in enumerate(kinds) if kind in ("distance", "polar", "azimuth")]
    if of_geometry:
        matrix[np.ix_(of_geometry, of_geometry)] = np.diag(matrix)[of_geometry, None] * geometry
    return matrix, [unit for _, unit in found]


def kind_of(name: str) -> str:
    """Name the kind of a parameter like "aim[2, 0]"."""
    head, _, index = name.partition("[")
    return head if head != "aim" else ("polar", "azimuth")[int(index.rstrip("]").split(",")[1])]


def listed_one_by_one(names: tuple[str, ...]) -> list[int]:
    """Return the places of the parameters that say something alone: the modes of the discrepancy do not."""
    return [i for i, name in enumerate(names) if kind_of(name) != "discrepancy"]


def plain_name(name: str, detectors: tuple[str, ...], law: LawPrior | None = None) -> str:
    """Make the name that is shown: "polar forward" for "aim[0, 0]"; `law`: whose numbers the names may be of."""
    _, _, index = name.partition("[")
    parts = [int(i) for i in index.rstrip("]").replace(" ", "").split(",") if i]
    kind = kind_of(name)
    if kind in ("distance", "occluded", "surroundings"):
        return kind
    if kind == "law":
        return numbers_of(law)[parts[0]].name
    if kind == "tilt":
        return f"tilt {'xy'[parts[0]]}"
    if kind == "albedo":
        return f"albedo {parts}"
    if kind == "patch":
        return f"log albedo of patch {parts[0] + 1}"
    rest = f" {parts[1]}" if kind == "drift" else ""
    return f"{kind} {detectors[parts[0]]}{rest}"


def describe_instrument(fit: Fit) -> dict[str, Any]:
    """List values, standard deviations and weakly determined combinations of the instrument's parameters.

    `values`: name -> (value, standard deviation, prior standard deviation, unit); gain, offset, drift and angles as
    changes of what stack and instrument state. `weak`: combinations of which the data leave more than `WEAK` of their
    prior standard deviation: `share` is what they leave, `of` the largest terms of the (unit) combination. `inflation`:
    Birge ratio by which all error bars are enlarged. `common_mode_um`: largest common-mode error that was added for an
    instrument that contradicts the file or a fit that has not converged. `law`: `describe_law`, but for the
    cosine law.
    `discrepancy`: what the model was found to lack, detector -> root mean square over the median signal, where the
    instrument states any, and `discrepancy_std`, that; its modes are in neither list. Without error bars: `law` alone.
    """
    posterior, law = fit.posterior, fit.problem.priors.law
    if posterior is None:
        return {} if law is None else {"law": describe_law(fit)}
    detectors = fit.instrument.detector_names
    listed = [i for i in listed_one_by_one(posterior.names) if kind_of(posterior.names[i]) not in fit.problem.held]
    names = tuple(posterior.names[i] for i in listed)
    matrix, units = units_of(fit.problem, names)
    flat = np.concatenate([np.ravel(getattr(fit.parameters, name)) for name in posterior.fields])[listed]
    covariance, prior = posterior.instrument_covariance[np.ix_(listed, listed)], np.linalg.norm(matrix, axis=1)
    means = iter(number.mean for number in numbers_of(law))
    mean = np.array([next(means) if kind_of(name) == "law" else 0.0 for name in names])
    found = zip(
        names,
        mean + matrix @ flat,
        np.sqrt(np.diag(matrix @ covariance @ matrix.T)),
        prior,
        units,
        strict=True,
    )
    values = {
        plain_name(name, detectors, law): [float(value), float(std), float(own), unit]
        for name, value, std, own, unit in found
        if own > 0.0
    }
    determined = np.flatnonzero(np.sqrt(np.diag(covariance)) < _PRIOR_DOMINATED)
    size, vector = np.linalg.eigh(covariance[np.ix_(determined, determined)])
    relative = matrix[np.ix_(determined, determined)] / np.where(prior > 0.0, prior, 1.0)[determined, None]
    weak = []
    for i in np.argsort(size)[::-1][:_MAX_LISTED]:
        if size[i] <= WEAK**2:
            break
        combination = relative @ vector[:, i]
        terms = np.argsort(-np.abs(combination))[:_MAX_TERMS]
        of = {plain_name(names[determined[t]], detectors, law): round(float(combination[t]), 3) for t in terms}
        weak.append({"share": float(np.sqrt(size[i])), "of": of})
    common = 0.0 if posterior.common_modes is None else float(np.sqrt((posterior.common_modes**2).sum(0)).max())
    found = {"values": values, "weak": weak, "inflation": posterior.inflation, "common_mode_um": common}
    if fit.parameters.discrepancy.size:
        std, modes = fit.problem.discrepancy_std, fit.parameters.discrepancy
        size = std * np.sqrt(np.sum((modes * mode_weights(modes.shape[-1])) ** 2, (1, 2)))
        found["discrepancy"] = dict(zip(detectors, size.tolist(), strict=True))
        found["discrepancy_std"] = std
    return found if law is None else found | {"law": describe_law(fit)}


def describe_law(fit: Fit) -> dict[str, Any]:
    """Describe the scattering law; of a fitted one, test whether it is compatible with the cosine law.

    `kind`: of the law; `cosine_probability`: `law_prior.cosine_probability`; `is_cosine`: whether it exceeds
    `LEAST_PROBABILITY`; both only with error bars, without them its `numbers`, name -> value. Of a law that is held:
    `exponent` and `std`, as the instrument file states them.
    """
    if fit.problem.is_law_held:
        assert fit.problem.instrument is not None and fit.problem.instrument.law is not None
        return {"kind": "as_stated"} | fit.problem.instrument.law.model_dump()
    prior, whitened, posterior = fit.problem.priors.law, np.ravel(fit.parameters.law), fit.posterior
    if posterior is None:
        found = {n.name: n.mean + n.std * float(w) for n, w in zip(numbers_of(prior), whitened, strict=True)}
        return {"kind": fit.problem.settings.law, "numbers": found}
    of_law = [i for i, name in enumerate(posterior.names) if kind_of(name) == "law"]
    assert prior is not None
    probability = cosine_probability(prior, whitened, posterior.instrument_covariance[np.ix_(of_law, of_law)])
    return {
        "kind": fit.problem.settings.law,
        "cosine_probability": probability,
        "is_cosine": probability > LEAST_PROBABILITY,
    }
