"""A fit that is interrupted while something else is tried is kept, says so, and ends the reconstruction."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from helio_jax.inverse import explanations
from helio_jax.inverse.explanations import Explanation, explain
from helio_jax.inverse.fit import interrupted
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.reconstruction import was_interrupted

SHAPE = (6, 7)


@dataclass(frozen=True)
class StandIn:
    """What is read of a fit that has converged."""

    status: str = "converged: the last of 5 iterations"
    is_interrupted: bool = False
    problem: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(is_instrument_unknown=False, settings=SimpleNamespace(bias_pairs=1))
    )


@pytest.mark.parametrize("place", ["residuals_of_first", "from_pits"])
def test_the_fit_so_far_is_kept(monkeypatch, place):
    """Interrupted while its residuals are traced, or a pit is looked for. Catches an interrupt that loses the fit."""
    tried = []
    first = Explanation(StandIn(), np.zeros(SHAPE, bool))  # type: ignore[arg-type]
    stack = SimpleNamespace(shape=(3, *SHAPE), counts=np.zeros((3, *SHAPE)), calibration=None)

    def stop(self, *known):
        raise KeyboardInterrupt

    fits = explanations._Fits
    monkeypatch.setattr(fits, "from_steps", lambda self, patches: first)
    monkeypatch.setattr(fits, "from_objects", lambda self, *known: tried.append("objects"))
    monkeypatch.setattr(fits, "residuals_of_first", lambda self, fit: np.full((3, *SHAPE), 9.0))
    monkeypatch.setattr(fits, "right_chi_square", lambda self, residuals: 1.0)
    monkeypatch.setattr(fits, "contradicted", lambda self, residuals, right: np.ones(SHAPE, bool))
    monkeypatch.setattr(fits, place, stop)
    monkeypatch.setattr(explanations, "has_contradicted_hollow", lambda is_contradicted, fit: False)
    for name, value in (("is_substrate_dark", False), ("steps", None)):
        monkeypatch.setattr(fits, name, value)
    found = explain(stack, ReconstructSettings(), lambda n: None, None)  # type: ignore[arg-type]
    assert found.fit.is_interrupted and not tried
    assert found.fit.status == "interrupted while another explanation was tried; converged: the last of 5 iterations"
    assert was_interrupted(f"contradicts the data: 20 %; {found.fit.status}") and not was_interrupted(StandIn().status)


@pytest.mark.parametrize("n_before", [0, 1])
def test_the_first_of_several_attempts_is_kept(monkeypatch, n_before):
    """Interrupted while an attempt is tested: the only one is returned, or the one that was tested before it."""
    attempts = [Explanation(StandIn(f"converged: attempt {i}"), np.zeros(SHAPE, bool)) for i in range(2)]  # type: ignore[arg-type]
    tested = iter(range(n_before))

    def traced_misfit(self, fit):
        if next(tested, None) is None:
            raise KeyboardInterrupt
        return 2.0

    monkeypatch.setattr(explanations._Fits, "traced_misfit", traced_misfit)
    monkeypatch.setattr(explanations._Fits, "instrument_improvement", lambda self, before, fit: 0.0)
    fits = object.__new__(explanations._Fits)
    found = fits.best_of([lambda one=one: one for one in attempts], attempts[0], "outlines")
    assert found is not None and found.fit.is_interrupted and "attempt 0" in found.fit.status


def test_an_interrupted_fit_keeps_its_own_words():
    """The sentence of its last iteration stays; the fit is not said to have been interrupted twice."""
    fit = StandIn("interrupted: best so far", True)
    assert interrupted(fit, "while wider priors were tried") is fit  # type: ignore[arg-type,comparison-overlap]
