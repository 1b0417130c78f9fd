"""Levels of regions: where a region starts from, and the wall that an oblique beam sees beside it."""

import numpy as np
import pytest

from helio_jax.forward.surface import Surface
from helio_jax.inverse.levels import Region, beside_wall, search_levels

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


@pytest.mark.parametrize("is_substrate_flat", [True, False])
def test_a_raised_foot_is_left_on_a_flat_substrate(is_substrate_flat):
    """A short fit that bridges a wall leaves a foot of eight pixels, and keeps it: gone on a flat substrate.

    With a free border that is the plane of the slopes around the region. Rejects trials on the surface fitted only.
    """
    truth = np.where(INSIDE, 100.0, 0.0)
    near = (X >= 14) & (X < 40) & ~INSIDE
    bridged = Surface(np.where(INSIDE, 60.0, 20.0 * near), *np.zeros((2, *SHAPE)))

    def misfit(surface):
        return float(np.sum(np.abs(surface.height - truth)))

    def short_fit(surface):
        kept = bridged if surface is FLAT else surface
        return misfit(kept), kept

    region = Region(INSIDE, height=100.0, std=1.0, step=100.0)
    found = search_levels(
        [region], FLAT, PITCH, 1e3, misfit, short_fit, (TAN30, 0.0), is_substrate_flat=is_substrate_flat
    )
    assert found.moved == [0]
    assert np.array_equal(found.surface.height, truth)
