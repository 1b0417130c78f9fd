"""What the fit found out about the instrument, in words that files and reports keep: values, error bars, weak spots.

A combination of instrument parameters that the data hardly tell apart from others is no better known than its prior
says, and heights depend on that prior: such combinations are listed, never hidden.
"""

from typing import Any

import numpy as np

from helio_jax.inverse.fit import Fit
from helio_jax.inverse.settings import RefineSettings

WEAK = 0.5
"""A combination is weak when the data leave more than this share of its prior deviation."""
_LISTED = 6
_TERMS = 4
"""Weak combinations that are listed at most, and parameters that are named in each."""
_PRIOR_DOMINATED = 1.0 - 1e-6
"""A parameter that keeps all of its prior deviation touches no datum, and so no height."""


def prior_deviations(fit: Fit, settings: RefineSettings) -> dict[str, tuple[float, str]]:
    """Return the prior deviation and its unit of every kind of instrument parameter."""
    stated = fit.instrument.uncertainty
    return {
        "log_gain": (settings.gain_std, "relative"),
        "offset": (settings.offset_std, "of the signal"),
        "log_multiple": (settings.multiple_error, "relative"),
        "drift": (settings.drift_std, "of the signal"),
        "law": (settings.law_std, "of the exponent"),
        "distance": (fit.distance_std, "um"),
        "tilt": (stated.tilt_deg, "deg"),
        "polar": (stated.polar_deg, "deg"),
        "azimuth": (stated.azimuth_deg, "deg"),
    }


def _kind(name: str) -> str:
    """Return the kind of a parameter like "aim[2, 0]"."""
    head, _, index = name.partition("[")
    return head if head != "aim" else ("polar", "azimuth")[int(index.rstrip("]").split(",")[1])]


def _plain(name: str, detectors: tuple[str, ...]) -> str:
    """Return the name that is shown: "polar forward" for "aim[0, 0]"."""
    _, _, index = name.partition("[")
    parts = [int(i) for i in index.rstrip("]").replace(" ", "").split(",") if i]
    kind = _kind(name)
    if kind in ("distance", "occluded", "law"):
        return kind
    if kind == "tilt":
        return f"tilt {'xy'[parts[0]]}"
    if kind == "albedo":
        return f"albedo {parts}"
    rest = f" {parts[1]}" if kind == "drift" else ""
    return f"{kind} {detectors[parts[0]]}{rest}"


def describe_instrument(fit: Fit, settings: RefineSettings) -> dict[str, Any]:
    """Return values, standard deviations and weakly determined combinations of the instrument's parameters.

    `values`: name -> (value, standard deviation, prior deviation, unit), gain, offset, drift and angles as changes from
    what the stack and the instrument say. `weak`: the combinations of which the data leave more than `WEAK` of their
    prior deviation: `left` is that share, `of` the largest terms of the (unit) combination, in prior deviations.
    `widening`: factor by which all deviations are enlarged, for the geometry disagrees with what the file says;
    `bent_um`: the largest deviation that was added for it, or for a fit that has not converged, of all heights as one.
    """
    posterior = fit.posterior
    if posterior is None:
        return {}
    detectors = fit.instrument.detector_names
    units = prior_deviations(fit, settings)
    flat = np.concatenate([np.ravel(getattr(fit.parameters, name)) for name in posterior.fields])
    deviation = np.sqrt(np.diag(posterior.instrument_covariance))
    values = {}
    for name, value, std in zip(posterior.names, flat, deviation, strict=True):
        prior, unit = units.get(_kind(name), (1.0, "prior deviations"))
        if prior > 0:
            numbers = (float(prior * value), float(prior * std), float(prior))
            values[_plain(name, detectors)] = [*numbers, unit]
    determined = np.flatnonzero(deviation < _PRIOR_DOMINATED)
    size, vector = np.linalg.eigh(posterior.instrument_covariance[np.ix_(determined, determined)])
    weak = []
    for i in np.argsort(size)[::-1][:_LISTED]:
        if size[i] <= WEAK**2:
            break
        terms = np.argsort(-np.abs(vector[:, i]))[:_TERMS]
        of = {_plain(posterior.names[determined[t]], detectors): round(float(vector[t, i]), 3) for t in terms}
        weak.append({"left": float(np.sqrt(size[i])), "of": of})
    bent = 0.0 if posterior.common_modes is None else float(np.sqrt((posterior.common_modes**2).sum(0)).max())
    return {"values": values, "weak": weak, "widening": posterior.inflation, "bent_um": bent}
