"""How far a fit moves the instrument from what is stated: beyond chance it speaks against the fit.

An uncertain instrument can imitate another albedo almost anywhere, so that the data alone contradict hardly a pixel.
"""

import math
from collections.abc import Collection

import numpy as np

from helio_jax.inverse.parameters import Parameters

INSTRUMENT = "log_gain", "offset", "log_multiple", "discrepancy", "law", "distance", "tilt", "aim"
"""Parameters whose prior is what is known of the instrument and the model."""
STRAIN = 5.0
"""The instrument is strained where its pulls' chi-square exceeds its mean by this many of its standard deviations."""


def instrument_pulls(parameters: Parameters, without: Collection[str] = ()) -> np.ndarray:
    """Pulls of all unknowns but the surface, its albedo, drift and scan lines, in prior standard deviations [number].

    They are independent and normal under the prior. `without`: names that are left out.
    """
    return np.concatenate([np.ravel(getattr(parameters, name)) for name in INSTRUMENT if name not in without])


def is_strained(parameters: Parameters, held: Collection[str] = ()) -> bool:
    """Whether a fit moves the instrument farther than is stated, by more than chance (`STRAIN`).

    `held`: names of parameters that are held, and so tell nothing.
    """
    pulls = instrument_pulls(parameters, held)
    return float(np.sum(pulls**2)) > pulls.size + STRAIN * math.sqrt(2.0 * pulls.size)


def strain_improvement(parameters: Parameters, others: Parameters) -> float:
    """Compute by how much less a fit of other parameters moves the instrument, in half chi-square."""
    before, after = (float(np.sum(instrument_pulls(p) ** 2)) for p in (parameters, others))
    return 0.5 * (before - after)
