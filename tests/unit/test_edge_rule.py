"""How slopes at the pixels say by how much heights change between them: exact on curves, never across jumps."""

import numpy as np
import pytest

from helio_jax.inverse.edges import fourth_order_slopes, smoothness_weight, trapezoid_gap

NOISE, PITCH = 0.05, 10.0


@pytest.mark.parametrize("axis", [0, 1])
def test_edges_of_a_quartic_close(axis):
    """Heights of fourth degree: no edge between corrected slopes errs, the trapezoid rule by p'' d^2 / 12."""
    x = (np.arange(9.0) - 3.3) * PITCH / 40.0
    height, slope = np.tile(40.0 * (0.3 * x**4 + x**3), (9, 1)), np.tile(1.2 * x**3 + 3.0 * x**2, (9, 1))
    weight = np.tile(np.r_[0.0, np.ones(7), 0.0], (9, 1))
    if axis == 0:
        height, slope, weight = height.T, slope.T, weight.T
    gap = trapezoid_gap(height, fourth_order_slopes(slope, weight, axis), PITCH, axis)
    gap, plain = (np.moveaxis(f, axis, -1) for f in (gap, trapezoid_gap(height, slope, PITCH, axis)))
    assert np.abs(gap[:, 1:-1]).max() < 1e-12
    middle = 0.5 * (x[1:] + x[:-1])
    assert plain == pytest.approx(np.tile(-(7.2 * middle + 6.0) / 12.0 * (PITCH / 40.0) ** 2, (9, 1)), rel=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_rule_is_the_trapezoid_at_borders_jumps_and_kinks(axis):
    """A cut edge between 5 and 6, a kink of 40 noises between 11 and 12: no correction there, but next to them."""
    slope, joined = np.zeros((3, 18)), np.ones((3, 17))
    slope[:, 12:] = 40.0 * NOISE
    joined[:, 5] = 0.0
    if axis == 0:
        slope, joined = slope.T, joined.T
    weight = np.moveaxis(smoothness_weight(joined, slope, NOISE, axis), axis, -1)
    not_smooth = [0, 5, 6, 11, 12, 17]
    assert np.all(weight[:, [0, 5, 6, 17]] == 0.0) and weight[:, [11, 12]].max() < 0.02
    assert np.delete(weight, not_smooth, 1).min() == 1.0


def test_noise_does_not_stop_the_correction():
    """White noise of the slopes looks like small kinks: nearly all of the correction stays."""
    slope = NOISE * np.random.default_rng(0).normal(size=(40, 40))
    assert smoothness_weight(np.ones((40, 39)), slope, NOISE, 1)[:, 1:-1].mean() > 0.8
