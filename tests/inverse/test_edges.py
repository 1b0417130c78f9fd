"""Edges between pixels: smooth, kinked or cut."""

import numpy as np
import pytest

from helio_jax.forward.surface import one_sided, to_pixels
from helio_jax.inverse.edges import find_edges, kink_size
from helio_jax.inverse.quality import depth_jumps

NOISE, PITCH = 0.05, 10.0


def roof(u: float, steep: float = 3.0, n: int = 21) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and slopes [3, n] of a flat that bends into a slope, u of a pitch behind pixel 10."""
    x = (np.arange(n) - 10.0 - u) * PITCH
    height, slope = np.where(x > 0, steep * x, 0.0), np.where(x > 0, steep, 0.0)
    return np.tile(height, (3, 1)), np.tile(slope, (3, 1))


def test_error_at_a_kink_has_the_stated_variance():
    """For kinks uniform within an edge the trapezoid rule errs by (s2 - s1)^2 / 12 in the mean square, unbiased.

    2000 kinks: 4 standard errors are 3 % of the standard deviation. Rejects a sigma of (s2 - s1) / 2 or 0.
    """
    rng = np.random.default_rng(0)
    errors = []
    for u in rng.uniform(0, 1, 2000):
        height, slope = roof(u)
        errors.append((height[0, 11] - height[0, 10]) / PITCH - 0.5 * (slope[0, 10] + slope[0, 11]))
    edges = find_edges(*roof(0.5), PITCH, 1, NOISE, 3.0)
    assert abs(np.mean(errors)) < 4 * np.std(errors) / np.sqrt(2000)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(edges.sigma[0, 10], rel=0.05)


def test_a_kink_is_not_a_jump_and_a_jump_is():
    """A kink keeps its edge wherever it lies; a jump of 100 um between equal slopes loses it, and only that one."""
    for u in (0.01, 0.5, 0.99):
        assert find_edges(*roof(u), PITCH, 1, NOISE, 3.0).joined.min() > 0.5
    height, slope = np.zeros((3, 21)), np.zeros((3, 21))
    height[:, 12:] = 100.0
    joined = find_edges(height, slope, PITCH, 1, NOISE, 3.0).joined
    assert joined[:, 11].max() < 1e-3 and np.delete(joined, 11, 1).min() > 0.99


def test_smooth_curvature_is_no_kink():
    """On a parabola the slope changes as much in every edge: no kink, and no sigma beyond the floor."""
    x = np.arange(21.0) * PITCH
    slope = np.tile(x / 100.0, (3, 1))
    assert kink_size(slope, 1).max() < 1e-12
    edges = find_edges(np.tile(x**2 / 200.0, (3, 1)), slope, PITCH, 1, NOISE, 3.0)
    assert np.allclose(edges.sigma, 0.2 * NOISE) and np.allclose(edges.joined, 1.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_one_sided_slopes_do_not_look_across_a_jump(axis):
    """Beside a cut edge the slope is that of the other side; both axes behave alike."""
    height = np.tile(np.where(np.arange(8) > 3, 500.0, 0.0) + 2.0 * np.arange(8), (8, 1))
    joined = np.ones((8, 7))
    joined[:, 3] = 0.0
    if axis == 0:
        height, joined = height.T, joined.T
    slope = one_sided(np.diff(height, axis=axis), joined, axis)
    assert np.allclose(slope, 2.0, rtol=2e-3)


def test_to_pixels_is_the_adjoint_of_summing_ends():
    rng = np.random.default_rng(1)
    edge, field = rng.normal(size=(4, 6)), rng.normal(size=(4, 7))
    assert np.sum(to_pixels(edge, 1) * field) == pytest.approx(np.sum(edge * (field[:, 1:] + field[:, :-1])))


def test_only_cut_edges_with_a_step_are_depth_jumps():
    """Cut by noise (a twentieth of a pitch) and joined with a step: no jumps. Exchanged axes or pitches show."""
    height = np.zeros((4, 5))
    height[:, 3:] = 8.0
    height[0, 1:] += 1.0
    joined = np.ones((4, 4))
    joined[0, 0] = joined[1, 2] = joined[2, 2] = 0.0
    found = depth_jumps(height, np.zeros((4, 5)), joined, 20.0, 1)
    assert np.argwhere(found).tolist() == [[1, 2], [2, 2]]
    turned = depth_jumps(height.T, np.zeros((5, 4)), joined.T, 20.0, 0)
    assert np.array_equal(turned, found.T)
    assert not depth_jumps(height, np.full((4, 5), 0.4), joined, 20.0, 1)[1, 2]
