"""What noise does to a fit in the mean, simulated from the fit, against its second-order formula."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse import residuals, steps
from helio_jax.inverse.noise_bias import noise_bias, subtract_bias
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import freeze

SHAPE = (20, 20)


def level_fit(bshem, noise):
    """Return a fit of a level surface with this relative noise per pixel: problem and state."""
    level = Surface(*np.zeros((3, *SHAPE)))
    signal = form_factor(Optics.of(bshem), level.height)[:, 2]
    raster = Raster.regular(SHAPE, 30.0)
    problem = FitProblem.of(signal, (noise * signal) ** 2, bshem, raster, level, ReconstructSettings())
    return problem, FitState.at(problem, level)


def rise(problem, state, n_pairs):
    """Return the relative change of the signal that gains and offsets are biased by [detector]."""
    _, moved = noise_bias(problem, state, n_pairs)
    s = problem.settings
    return s.gain_std * moved.log_gain + s.offset_std * moved.offset


def test_noisy_slopes_raise_the_gains_as_the_second_order_tells(bshem, monkeypatch):
    """Without the model's own corrections the bias of the signal is that of `second_order_noise_bias`, within 20 %.

    The mean of a curved signal over the noise of its slopes is too low, and gains make up for it. Rejects a bias of the
    wrong sign, noise whose odd powers do not cancel (they leave half of it), and noise of another size.
    """
    problem, state = level_fit(bshem, 0.05)
    _, fixed = freeze(problem, state, 8.0, 4.0)
    expected = -fixed.noise_bias.mean((1, 2)) / problem.data.mean((1, 2))
    monkeypatch.setattr(steps, "_noise_bias", lambda *_: np.zeros(problem.data.shape))
    monkeypatch.setattr(residuals, "edge_scale", lambda *_: 1.0)
    jax.clear_caches()
    found = rise(problem, state, 2)
    jax.clear_caches()
    assert expected.min() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0.2)


def test_no_noise_no_bias_and_the_same_data_the_same_bias(bshem):
    """Data without noise leave the fit alone; the drawn noise is the data's own, and the same each time."""
    change, moved = noise_bias(*level_fit(bshem, 1e-6), 1)
    assert np.abs(change.height).max() < 1e-3 and np.abs(moved.log_gain).max() < 0.01
    problem, state = level_fit(bshem, 0.05)
    once, again = noise_bias(problem, state, 1), noise_bias(problem, state, 1)
    np.testing.assert_array_equal(once[0].height, again[0].height)
    other = noise_bias(replace(problem, signal=problem.signal * (1.0 + 1e-9)), state, 1)
    assert np.abs(other[0].height - once[0].height).max() > 1e-3


def test_a_subtracted_bias_is_gone(bshem):
    """Height, gain and residuals all follow."""
    problem, state = level_fit(bshem, 0.05)
    nothing = jax.tree.map(np.zeros_like, problem.prior_means())
    before = subtract_bias(problem, state, Surface(*np.zeros((3, *SHAPE))), nothing)
    up = jax.tree.map(lambda value: value + 1.0, nothing)
    after = subtract_bias(problem, before, Surface(np.ones(SHAPE), *np.zeros((2, *SHAPE))), up)
    assert np.all(after.surface.height == -1.0) and np.all(after.parameters.log_gain == -1.0)
    s, signal = problem.settings, problem.data[:, 0, 0]
    moved = ((after.residuals - before.residuals) * state.held.sigma)[:, 10, 10] / signal
    # lower by a micrometre changes less than a hundredth of that
    assert moved == pytest.approx(np.expm1(-s.gain_std) - s.offset_std, rel=0.02)
