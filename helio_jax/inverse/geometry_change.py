"""The change of geometry that the data of a fit ask for where an instrument file states it as exact."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.inverse.parameters import Parameters

LIKELY = 3.0
"""Natural logarithm of the Bayes factor from which on another geometry is likely: strong evidence (Kass and Raftery,
J. Am. Stat. Assoc. 90 (1995) 773, sec. 3.2)."""
_NAMED, _MOST_NAMED = 2.0, 4
"""Changes of so many standard deviations are named, the largest ones, so many at most."""


@dataclass(frozen=True)
class GeometryScore:
    """What the data of a fit say of a geometry that it took for exact.

    Attributes:
        log_bayes: logarithm of the Bayes factor of an uncertain geometry (`geometry_score.usual_uncertainty`) over the
            stated one; above 0 where the data ask for another one.
        values: name -> (change that the data ask for, its standard deviation, unit).
        parameters: of a fit with that uncertain geometry, to first order.
        height_change: of the same fit, above the substrate, um [y, x].
    """

    log_bayes: float
    values: Mapping[str, tuple[float, float, str]]
    parameters: Parameters
    height_change: np.ndarray

    @property
    def is_likely(self) -> bool:
        """Whether another geometry is likely."""
        return self.log_bayes > LIKELY

    def as_record(self) -> dict[str, Any]:
        """Return what files keep of it."""
        return {"log_bayes": self.log_bayes, "values": dict(self.values)}


def largest_changes(values: Mapping[str, tuple[float, float, str]]) -> str:
    """Name the most certain of some changes (value, standard deviation, unit), one at least, in words."""
    ranked = sorted(values.items(), key=lambda item: -abs(item[1][0]) / item[1][1])
    certain = [item for item in ranked if abs(item[1][0]) > _NAMED * item[1][1]][:_MOST_NAMED]
    shown = certain or ranked[:1]
    return ", ".join(f"{name} {value:+.3g} +- {std:.2g} {unit}" for name, (value, std, unit) in shown)
