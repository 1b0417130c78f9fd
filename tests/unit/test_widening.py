"""Error bars of a fit whose geometry came out elsewhere than stated."""

import numpy as np
import pytest

from helio_jax.inverse.convergence import SLOWEST, extrapolation, remaining_error
from helio_jax.inverse.parameters import NAMES as FIELDS
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.posterior import Posterior

NAMES = ("log_gain[0]", "aim[0, 0]", "aim[1, 0]")
SHAPE = (4, 5)


def parameters(**values: np.ndarray) -> Parameters:
    """Return parameters of which only those given are unknown."""
    return Parameters(**{name: values.get(name, np.zeros(0)) for name in FIELDS})


def posterior(n_samples: int = 4000) -> Posterior:
    """White heights of 2 um; the gain follows the first aim by -0.5; heights follow gain and aims in three pixels."""
    rng = np.random.default_rng(2)
    spread = np.array([[0.01, -0.005, 0.0], [-0.005, 0.01, 0.0], [0.0, 0.0, 0.04]])
    response = np.zeros((3, *SHAPE))
    response[0, 0, 0], response[1, 1, 1], response[2, 2, 2] = 8.0, 10.0, -20.0
    samples = 2.0 * rng.standard_normal((n_samples, *SHAPE))
    return Posterior(samples, np.zeros((n_samples, 3)), response, spread, NAMES)


def test_geometry_that_moved_too_far_adds_what_it_did_to_the_heights():
    """By its own response and that of the gain, which followed; one error for all pixels, all else only widened.

    The factor is the Birge ratio: values 3 and 4 of unit variance, but for what the posterior has of it. 4000 samples
    tell a deviation to 1.1 %. Catches the gain's share forgotten, one error per pixel, and the factor in the bend.
    """
    before = posterior()
    after = before.inflated(parameters(log_gain=np.zeros(1), aim=np.array([[3.0], [4.0]])), ("aim",))
    factor = np.sqrt(0.5 * (9.0 / 0.99 + 16.0 / 0.96))
    assert after.inflation == pytest.approx(factor)
    bend = np.sqrt(1.0 - factor**-2) * np.array([-0.5 * 3.0 * 8.0, 3.0 * 10.0, -4.0 * 20.0])
    assert after.common_modes is not None
    assert after.common_modes[0, [0, 1, 2], [0, 1, 2]] == pytest.approx(bend)
    assert after.height_std[[0, 1, 2], [0, 1, 2]] == pytest.approx(np.hypot(2.0 * factor, bend), rel=0.05)
    assert after.height_std[3, 4] == pytest.approx(2.0 * factor, rel=0.05)
    agree = np.corrcoef(after.samples[:, 1, 1], after.samples[:, 2, 2])[0, 1]
    free = 4.0 * factor**2
    expected = bend[1] * bend[2] / np.sqrt((bend[1] ** 2 + free) * (bend[2] ** 2 + free))
    assert agree == pytest.approx(expected, abs=0.05)


def test_geometry_within_what_is_stated_changes_nothing():
    """Catches the bend added to fits whose instrument file is right: theirs are error bars of the data alone."""
    before = posterior(50)
    after = before.inflated(parameters(log_gain=np.ones(1), aim=np.array([[0.6], [-0.7]])), ("aim",))
    assert after.inflation == 1.0 and np.array_equal(after.samples, before.samples)
    assert after.common_modes is not None and not after.common_modes.any()
    assert before.inflated(parameters(log_gain=np.full(1, 9.0)), ("distance",)) is before


def test_gains_that_are_off_by_far_widen_too_and_add_to_geometry():
    """Less than twice as far off as expected is chance; then both factors multiply, both bends add in squares.

    Catches gains that widen every other fit, for they come out by 1.2 of what is expected as often as by 0.8.
    """
    values = parameters(log_gain=np.array([1.8]), aim=np.array([[3.0], [4.0]]))
    after = posterior(50).inflated(values, ("aim",))
    assert after.inflated(values, ("log_gain",), 2.0) is after
    further = after.inflated(values.replaced(log_gain=np.array([5.0])), ("log_gain",), 2.0)
    alone = posterior(50).inflated(values.replaced(log_gain=np.array([5.0])), ("log_gain",), 2.0)
    assert after.inflation > 2.0 and alone.inflation > 2.0
    factor = 5.0 / np.sqrt(1.0 - 0.01)  # by its own error, not by what the geometry inflated that to
    assert further.inflation == pytest.approx(after.inflation * factor)
    assert further.common_modes is not None and after.common_modes is not None
    np.testing.assert_allclose(further.common_modes[0], factor * after.common_modes[0])
    assert (
        abs(further.common_modes[1, 0, 0]) > 1.0 and further.common_modes[1, 2, 2] == 0.0
    )  # the third aim does not follow the gain


def test_the_bend_follows_the_raster():
    """Catches a bend left on the thinned raster, where findings and heights would no longer have one shape."""
    after = posterior(50).inflated(parameters(aim=np.array([[3.0], [4.0]])), ("aim",)).on_raster((8, 10), 2)
    assert after.common_modes is not None and after.common_modes.shape == (1, 8, 10)


@pytest.mark.parametrize("contraction", [0.2, 0.8])
def test_what_is_left_of_a_fit_that_converges_geometrically(contraction):
    """Heights go to 100 um by a constant share of what is left: the sum of all changes to come is known exactly.

    Catches the last change itself for it, which is right for a contraction of a half only.
    """
    height = 100.0 * (1.0 - contraction ** np.arange(4))
    changes = np.diff(height)
    assert remaining_error(list(changes), extrapolation(changes[-2], changes[-2], changes[-1])) * changes[
        -1
    ] == pytest.approx(100.0 - height[-1])


def test_what_is_left_of_other_fits():
    """A single round, none left, two that diverge, the last by swinging. Catches infinite and negative error bars."""
    assert remaining_error([7.0], 1.0) == 1.0
    assert remaining_error([0.0, 0.0], np.inf) == 1.0
    assert remaining_error([1.0, 3.0], extrapolation(1.0, 1.0, 3.0)) == SLOWEST / (1.0 - SLOWEST)
    assert remaining_error([1.0, 3.0], extrapolation(1.0, 1.0, -3.0)) == 1.0


def test_an_error_of_all_heights_is_added_in_squares():
    """Pixels agree by it and nothing else, and earlier ones stay. Catches one error per pixel, one factor for two."""
    error = np.zeros(SHAPE)
    error[0, 0], error[3, 3] = 6.0, -8.0
    before = posterior()
    after = before.with_common_mode(error)
    assert after.common_modes is not None
    np.testing.assert_allclose(after.common_modes[0], error)
    np.testing.assert_allclose(after.height_std, np.hypot(2.0, error), rtol=0.06)
    both = 6.0 * -8.0 / np.sqrt((36.0 + 4.0) * (64.0 + 4.0))
    assert np.corrcoef(after.samples[:, 0, 0], after.samples[:, 3, 3])[0, 1] == pytest.approx(both, abs=0.05)
    twice = after.with_common_mode(error)
    assert twice.common_modes is not None
    np.testing.assert_allclose(twice.common_modes, [error, error])
    np.testing.assert_allclose(twice.height_std, np.hypot(2.0, np.sqrt(2.0) * error), rtol=0.06)


def test_one_small_change_among_large_ones_is_no_convergence():
    """Off by a whole change where only the last fall is large. Catches the last ratio alone (0.53 changes for 0.35)."""
    assert remaining_error([81.0, 92.0, 32.0], extrapolation(1.0, 1.0, -0.35)) == 1.0
    assert remaining_error([81.0, 8.1, 0.81], extrapolation(1.0, 1.0, -0.1)) == pytest.approx(1.0 / 9.0)


def test_error_bars_above_a_tilted_plane():
    """Heights that are white noise above a plane whose slopes are unknown: its spread is not theirs.

    Catches error bars of the heights before they are levelled, and what a tilt does to them taken with its other sign.
    """
    rng = np.random.default_rng(4)
    planes = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0))) * 30.0
    tilts, white = rng.standard_normal((4000, 2)), rng.standard_normal((4000, *SHAPE))
    response = np.stack([np.ones(SHAPE), *planes])
    names = ("log_gain[0]", "tilt[0]", "tilt[1]")
    gains = rng.standard_normal((4000, 1))
    raw = white + np.tensordot(tilts, planes, 1)
    levelled = Posterior(raw, np.hstack([gains, tilts]), response, np.eye(3), names).levelled(planes)
    assert levelled.samples == pytest.approx(white)
    assert levelled.response[0] == pytest.approx(1.0) and levelled.response[1:] == pytest.approx(0.0)
    assert posterior(5).levelled(planes).samples.shape == (5, *SHAPE)  # where no tilt is unknown
