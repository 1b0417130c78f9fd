"""What noise does to a fit in the mean, simulated from the fit, against its second-order formula."""

import jax
import numpy as np
import pytest

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.inverse.noise_bias import noise_bias
from helio_jax.inverse.problem import Refiner
from helio_jax.inverse.residuals import Model, Surface
from helio_jax.inverse.settings import ReconstructSettings

SHAPE = (20, 20)


def level_fit(bshem, noise):
    """Return a fit of a level surface with this relative noise per pixel."""
    geometry, level = SpotGeometry(bshem), Surface(*np.zeros((3, *SHAPE)))
    signal = geometry.form_factor(np.zeros(SHAPE))[:, 2]
    return Refiner(signal, (noise * signal) ** 2, geometry, 30.0, 30.0, level, ReconstructSettings())


def rise(refiner, n_pairs):
    """Return the relative change of the signal that gains and offsets are biased by [detector]."""
    _, moved = noise_bias(refiner, n_pairs)
    s = refiner.settings
    return s.gain_std * moved["log_gain"] + s.offset_std * moved["offset"]


def test_noisy_slopes_raise_the_gains_as_the_second_order_tells(bshem, monkeypatch):
    """Without the model's own corrections the bias of the signal is what `noise_change` would add, within 20 %.

    The mean of a curved signal over the noise of its slopes is too low, and gains make up for it. Rejects a bias of the
    wrong sign, noise whose odd powers do not cancel (they leave half of it), and noise of another size.
    """
    with jax.enable_x64(True):
        refiner = level_fit(bshem, 0.05)
        _, lagged = refiner.lag(8.0, 4.0)
        signal = refiner.data.mean((1, 2))
        expected = -np.asarray(lagged.noise_change).mean((1, 2)) / signal
        monkeypatch.setattr(Model, "noise_change", lambda self, surface, *_: 0.0 * surface.height[None] * refiner.data)
        monkeypatch.setattr(Model, "edge_scale", lambda self, *_: 1.0)
        jax.clear_caches()
        found = rise(refiner, 2)
        jax.clear_caches()
    assert expected.min() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0.2)


def test_no_noise_no_bias_and_the_same_data_the_same_bias(bshem):
    """Data without noise leave the fit alone; the drawn noise is the data's own, and the same each time."""
    with jax.enable_x64(True):
        refiner = level_fit(bshem, 1e-6)
        change, moved = noise_bias(refiner, 1)
        assert np.abs(change.height).max() < 1e-3 and np.abs(moved["log_gain"]).max() < 0.01
        noisy = level_fit(bshem, 0.05)
        once, again = noise_bias(noisy, 1), noise_bias(noisy, 1)
        np.testing.assert_array_equal(once[0].height, again[0].height)
        noisy.data = noisy.data * (1.0 + 1e-9)
        other = noise_bias(noisy, 1)
        assert np.abs(other[0].height - once[0].height).max() > 1e-3


def test_moving_back_takes_a_change_away(bshem):
    """Height, gain and residuals all follow."""
    with jax.enable_x64(True):
        refiner = level_fit(bshem, 0.05)
        nothing = {name: np.zeros(value.shape) for name, value in refiner.values.items()}
        refiner.move_back(Surface(*np.zeros((3, *SHAPE))), nothing)
        before = refiner.residuals
        up = {name: value + 1.0 for name, value in nothing.items()}
        refiner.move_back(Surface(np.ones(SHAPE), *np.zeros((2, *SHAPE))), up)
        assert np.all(refiner.surface.height == -1.0) and np.all(refiner.values["log_gain"] == -1.0)
        s, signal = refiner.settings, refiner.data[:, 0, 0]
        moved = ((refiner.residuals - before) * refiner.sigma)[:, 10, 10] / signal
        # lower by a micrometre changes less than a hundredth of that
        assert moved == pytest.approx(np.expm1(-s.gain_std) - s.offset_std, rel=0.02)
