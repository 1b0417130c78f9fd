"""Levels of regions: where a region starts from, and the wall that an oblique beam sees beside it."""

import numpy as np
import pytest

from helio_jax.forward.surface import Surface
from helio_jax.inverse.levels import Region, beside_wall, least_between, search_levels

SHAPE, PITCH = (24, 40), (10.0, 10.0)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]
INSIDE = (X >= 22) & (X < 32) & (Y >= 8) & (Y < 16)
FLAT = Surface(*np.zeros((3, *SHAPE)))
TAN30 = float(np.tan(np.radians(30.0)))


def test_a_wall_beside_a_plateau_is_vertical():
    """In a beam along x at 30 deg the wall's points lie below the plateau's edge, to a pixel, and nothing else moves.

    Catches the far side, a wall within the plateau, another slope.
    """
    found = beside_wall(INSIDE, FLAT, 100.0, 0.0, PITCH, (TAN30, 0.0))
    wall = ~INSIDE & (found.height > 0.0)
    place = 10.0 * X - found.height * TAN30
    assert wall.any() and np.all(X[wall] < 22) and set(np.unique(Y[wall])) == set(range(8, 16))
    assert np.ptp(place[wall]) < 1e-9 and abs(place[wall][0] - place[10, 22]) <= 10.0
    assert np.all(found.height[INSIDE] == 100.0) and np.all(found.slope_x[wall] == pytest.approx(1.0 / TAN30))
    assert np.all(found.height[~INSIDE & ~wall] == 0.0)
    assert np.all(beside_wall(INSIDE, FLAT, -100.0, 0.0, PITCH, (TAN30, 0.0)).height[~INSIDE] == 0.0)


@pytest.mark.parametrize(("is_substrate_flat", "step"), [(True, 100.0), (False, 100.0), (False, None)])
def test_a_raised_foot_is_left_on_a_flat_substrate(is_substrate_flat, step):
    """A short fit that bridges a wall leaves a foot of eight pixels, and keeps it: gone on a flat substrate.

    With a free border that is the plane of the slopes around the region, also where the step is not measured, and is
    found to 1 um. Rejects trials on the surface fitted only.
    """
    truth = np.where(INSIDE, 100.0, 0.0)
    near = (X >= 14) & (X < 40) & ~INSIDE
    bridged = Surface(np.where(INSIDE, 60.0, 20.0 * near), *np.zeros((2, *SHAPE)))

    def misfit(surface):
        return float(np.sum(np.abs(surface.height - truth)))

    def short_fit(surface):
        kept = bridged if surface is FLAT else surface
        return misfit(kept), kept

    region = Region(INSIDE, height=step, std=1.0, step=step)
    found = search_levels(
        [region], FLAT, PITCH, 1e3, misfit, short_fit, (TAN30, 0.0), is_substrate_flat=is_substrate_flat
    )
    assert found.moved == [0]
    np.testing.assert_allclose(found.surface.height, truth, atol=1.0 if step is None else 0.0)


def test_the_least_of_noisy_misfits_is_that_of_a_parabola():
    """Noise of 10 on a misfit of 0.7 per square um: places to 0.75 um, half the 1.4 um of the least value met.

    200 draws leave 5 % of a standard deviation. Rejects the place of the least value.
    """
    errors, of_least = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        place, tried = rng.uniform(90.0, 120.0), {}

        def misfit(at, place=place, tried=tried, rng=rng):
            tried[at] = 1200.0 + 0.7 * (at - place) ** 2 + rng.normal(0.0, 10.0)
            return tried[at]

        value, found = least_between(misfit, 70.0, 140.0, 6, {105.0: misfit(105.0)})
        assert value == tried[found] and len(tried) <= 8
        errors.append(found - place)
        of_least.append(min(tried, key=tried.__getitem__) - place)
    assert np.std(errors) < 0.75 and np.std(of_least) > 1.1


def test_places_without_a_prediction_are_no_part_of_the_parabola():
    """Half of the range cannot be predicted: the least is found in the other half; where nothing can, any place."""
    value, found = least_between(lambda at: (at - 104.0) ** 2 if at < 110.0 else np.inf, 70.0, 140.0, 12)
    assert found == pytest.approx(104.0, abs=0.5) and value < 0.25
    value, found = least_between(lambda at: np.inf, 70.0, 140.0, 6)
    assert value > 1e99 and 70.0 <= found <= 140.0
