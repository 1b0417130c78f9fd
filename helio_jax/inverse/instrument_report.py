"""Report on the instrument as fitted, for files and people: values, error bars, weakly determined combinations.

A combination of parameters that the data hardly distinguish from others is no better known than its prior, and heights
depend on that prior: such combinations are listed, never hidden.
"""

from typing import Any

import numpy as np

from helio_jax.instrument import Uncertainty
from helio_jax.inverse.fit import Fit
from helio_jax.inverse.settings import RefineSettings

WEAK = 0.5
"""A combination is weak when the data leave more than this share of its prior standard deviation."""
_MAX_LISTED = 6
_MAX_TERMS = 4
"""Weak combinations that are listed at most, and parameters that are named in each."""
_PRIOR_DOMINATED = 1.0 - 1e-6
"""A parameter that keeps all of its prior standard deviation affects no datum, and so no height."""


def prior_stds(uncertainty: Uncertainty, distance_um: float, settings: RefineSettings) -> dict[str, tuple[float, str]]:
    """List the prior standard deviation and its unit of every kind of parameter."""
    return {
        "log_gain": (settings.gain_std, "relative"),
        "offset": (settings.offset_std, "of the signal"),
        "log_multiple": (settings.multiple_error, "relative"),
        "drift": (settings.drift_std, "of the signal"),
        "law": (settings.law_std, "of the exponent"),
        "patch": (settings.patch_albedo_std, "natural logarithm"),
        "distance": (distance_um, "um"),
        "tilt": (uncertainty.tilt_deg, "deg"),
        "polar": (uncertainty.polar_deg, "deg"),
        "azimuth": (uncertainty.azimuth_deg, "deg"),
    }


def kind_of(name: str) -> str:
    """Name the kind of a parameter like "aim[2, 0]"."""
    head, _, index = name.partition("[")
    return head if head != "aim" else ("polar", "azimuth")[int(index.rstrip("]").split(",")[1])]


def plain_name(name: str, detectors: tuple[str, ...]) -> str:
    """Make the name that is shown: "polar forward" for "aim[0, 0]"."""
    _, _, index = name.partition("[")
    parts = [int(i) for i in index.rstrip("]").replace(" ", "").split(",") if i]
    kind = kind_of(name)
    if kind in ("distance", "occluded", "surroundings", "law"):
        return kind
    if kind == "tilt":
        return f"tilt {'xy'[parts[0]]}"
    if kind == "albedo":
        return f"albedo {parts}"
    if kind == "patch":
        return f"log albedo of patch {parts[0] + 1}"
    rest = f" {parts[1]}" if kind == "drift" else ""
    return f"{kind} {detectors[parts[0]]}{rest}"


def describe_instrument(fit: Fit, settings: RefineSettings) -> dict[str, Any]:
    """List values, standard deviations and weakly determined combinations of the instrument's parameters.

    `values`: name -> (value, standard deviation, prior standard deviation, unit); gain, offset, drift and angles as
    changes of what stack and instrument state. `weak`: combinations of which the data leave more than `WEAK` of their
    prior standard deviation: `share` is what they leave, `of` the largest terms of the (unit) combination. `inflation`:
    Birge ratio by which all error bars are enlarged. `common_mode_um`: largest common-mode error that was added for an
    instrument that contradicts the file or a fit that has not converged.
    """
    posterior = fit.posterior
    if posterior is None:
        return {}
    detectors = fit.instrument.detector_names
    units = prior_stds(fit.instrument.uncertainty, fit.distance_std, settings)
    flat = np.concatenate([np.ravel(getattr(fit.parameters, name)) for name in posterior.fields])
    deviation = np.sqrt(np.diag(posterior.instrument_covariance))
    values = {}
    for name, value, std in zip(posterior.names, flat, deviation, strict=True):
        prior, unit = units.get(kind_of(name), (1.0, "prior deviations"))
        if prior > 0:
            numbers = (float(prior * value), float(prior * std), float(prior))
            values[plain_name(name, detectors)] = [*numbers, unit]
    determined = np.flatnonzero(deviation < _PRIOR_DOMINATED)
    size, vector = np.linalg.eigh(posterior.instrument_covariance[np.ix_(determined, determined)])
    weak = []
    for i in np.argsort(size)[::-1][:_MAX_LISTED]:
        if size[i] <= WEAK**2:
            break
        terms = np.argsort(-np.abs(vector[:, i]))[:_MAX_TERMS]
        of = {plain_name(posterior.names[determined[t]], detectors): round(float(vector[t, i]), 3) for t in terms}
        weak.append({"share": float(np.sqrt(size[i])), "of": of})
    common = 0.0 if posterior.common_modes is None else float(np.sqrt((posterior.common_modes**2).sum(0)).max())
    return {"values": values, "weak": weak, "inflation": posterior.inflation, "common_mode_um": common}
