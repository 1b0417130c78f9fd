"""Changes of the heights that grow, or hardly fall, from iteration to iteration of a fit: corrections follow them.

Masks and multiple scattering are held during a solve. Where the data tell little of a change once they are held, as of
the level of a cap with a steep rim, what the held ones lack can drive it on: each iteration then moves farther than the
one before, by a third of the cap's height in the end. What the last iteration did is such a change; corrections that
follow it (`responses.relief_responses`) turn the next solves to where the data are explained. They do so by a model;
where the data, predicted anew, are explained worse, the fit goes on without.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np

from helio_jax.forward.surface import Surface
from helio_jax.inverse.levels import GAIN
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.quality import half_chi_square
from helio_jax.inverse.state import FitState, with_responses
from helio_jax.inverse.steps import with_residuals

MOST_FOLLOWED = 3
"""So many changes are followed, the last ones."""
SLOW = 3.0
"""Extrapolation from which on changes fall by less than a third from iteration to iteration."""


class _Start(NamedTuple):
    """Where an iteration began: the state, with its corrections, and half the chi-square of the data there."""

    state: FitState
    misfit: float


@dataclass(frozen=True)
class Growth:
    """The changes that are followed.

    Attributes:
        problem: data, instrument, priors.
        changes: of the surface, the last one first.
        best: the best start of an iteration since some are followed; None: none are.
        is_given_up: whether following them led away from the data: none are followed any more.
    """

    problem: FitProblem
    changes: tuple[Surface, ...] = ()
    best: _Start | None = None
    is_given_up: bool = False

    def following(self, before: Surface, after: Surface, extrapolated: float) -> "Growth":
        """Follow the change that an iteration made, too, if changes grow or hardly fall.

        Not with a free border: what corrections follow of all heights there is much of such changes, and would count
        twice.

        Args:
            before, after: surfaces that the iteration began and ended with.
            extrapolated: from `convergence.extrapolation`, below 0 where changes keep their sign and grow.
        """
        if self.is_given_up or self.problem.follows_relief or 0.0 < extrapolated < SLOW:
            return self
        change = jax.tree.map(np.subtract, after, before)
        return replace(self, changes=(change, *self.changes)[:MOST_FOLLOWED])

    def checked(self, state: FitState) -> tuple["Growth", FitState]:
        """Judge a state with new corrections; where it explains the data worse by `GAIN`, return to the best start."""
        if not self.changes:
            return self, state
        start = _Start(state, self._misfit(state))
        if self.best is not None and start.misfit > self.best.misfit + GAIN:
            return Growth(self.problem, is_given_up=True), with_responses(self.problem, self.best.state)
        is_best = self.best is None or start.misfit < self.best.misfit
        return (replace(self, best=start) if is_best else self), state

    def _misfit(self, state: FitState) -> float:
        return half_chi_square(with_residuals(self.problem, state).residuals)
