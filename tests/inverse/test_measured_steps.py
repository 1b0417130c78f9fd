"""What measured steps are for a fit: walls between pixels, known differences; closed forms on tilted steps."""

import math
from dataclasses import replace

import numpy as np
import pytest

from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.measured_steps import anchors_of_steps, walls_of
from helio_jax.inverse.misfit_errors import accumulated
from helio_jax.inverse.problem import thinned_walls
from helio_jax.inverse.quality import regions
from helio_jax.inverse.step_records import BandRow, Patch, Step, Steps

RASTER = Raster.regular((21, 31), 10.0, 10.0)
HEIGHT, LENGTH, FALLS = 40.0, 60.0, 20.0
WAY = np.array([math.cos(math.radians(FALLS)), math.sin(math.radians(FALLS))])
DISTANCE = RASTER.x[None, :] * WAY[0] + RASTER.y[:, None] * WAY[1] + 3.0
"""From the edge, towards the lower side [y, x], um."""


def steps(**changes) -> Steps:
    """One straight step through the middle of the raster, 40 um high, with a mask band of 60 um across the edge."""
    along, middle = np.array([-WAY[1], WAY[0]]), -3.0 * WAY
    start, end = (tuple(middle + sign * 400.0 * along) for sign in (-1.0, 1.0))
    step = Step(1, start, end, FALLS - 90.0, FALLS, HEIGHT, 2.0, 1, 0.0, False, 1.0, 0, 1, "")
    band = BandRow(1, "d0", "dark", LENGTH, 1.0, HEIGHT, 2.0, False, 1.0, FALLS, "")
    patch = np.where(DISTANCE > 0.0, 1, 0)
    levels = Patch(0, 1, 0.0, 0.0, 1, False, 0.0), Patch(1, 1, -HEIGHT, 2.0, 1, False, 0.0)
    nothing = np.zeros((1, *RASTER.shape))
    return Steps((replace(step, **changes),), (band,), levels, patch, nothing > 0, nothing, 0.0, 0)


def test_a_wall_parts_the_pixels_on_its_two_sides():
    """Regions on both sides are parted wherever the edge runs; rejects a wall with gaps, or one at a steep facet."""
    region = regions(*(~cut for cut in walls_of(steps(), RASTER)))
    clear = np.abs(DISTANCE) > 4.0
    high, low = (set(region[clear & side].tolist()) for side in (DISTANCE < 0.0, DISTANCE > 0.0))
    assert len(high) == len(low) == 1 and high != low
    for other in (steps(note="curved"), steps(p_wall=0.5), steps(is_lower_bound=True), None):
        assert not any(cut.any() for cut in walls_of(other, RASTER))


def test_walls_of_a_thinned_raster_lie_between_the_pixels_kept():
    """Every second pixel: parted where any of the two edges between them is; rejects one that is dropped."""
    along_x, along_y = walls_of(steps(), RASTER)
    thin = thinned_walls(along_x, along_y, 2)
    assert [t.shape for t in thin] == [(11, 15), (10, 16)]
    side = DISTANCE[::2, ::2] > 0.0
    assert not (np.diff(side, axis=1) & ~thin[0]).any() and not (np.diff(side, axis=0) & ~thin[1]).any()


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_the_sum_of_heights_is_that_of_the_edge_above_the_end_of_the_band(tilt):
    """A step of 40 um in a surface that falls by 0.15 along the band: the edge is 40 + 0.15 * 60 um above its end.

    The bands measure that height; rejects heights of the pixels that are not carried to edge and end (off by 9 um).
    """
    height = np.where(DISTANCE > 0.0, -HEIGHT, 0.0) - tilt * DISTANCE
    slope = np.full(RASTER.shape, -tilt)
    surface = Surface(height, WAY[0] * slope, WAY[1] * slope)
    measured = steps(height_um=HEIGHT + tilt * LENGTH)
    region = regions(*(~cut for cut in walls_of(measured, RASTER)))
    numbers, anchors = anchors_of_steps(measured, surface, RASTER, region)
    assert numbers == (1,)
    std = math.hypot(2.0, 0.006 * measured.steps[0].height_um)
    assert float(np.sum(anchors.weight * height)) == pytest.approx(float(anchors.value[0]), abs=1e-6)
    assert np.maximum(anchors.weight, 0.0).sum() == pytest.approx(1.0 / std)
    assert (DISTANCE[anchors.weight[0] < 0.0] > LENGTH).all()


def test_known_differences_bound_the_error_along_the_path():
    """A column of wrong slopes parts the raster; beyond it the error is its sum, or 0 where a step ties both sides."""
    wrong = np.zeros(RASTER.shape)
    wrong[:, 15] = 0.5
    border = np.zeros(RASTER.shape, bool)
    border[:, 0] = True
    weight = np.zeros((1, *RASTER.shape))
    weight[0, 10, 12:14], weight[0, 10, 18:20] = -0.5, 0.5
    free = accumulated(wrong, RASTER, border)
    tied = accumulated(wrong, RASTER, border, Anchors(weight, np.zeros(1)))
    assert free[:, 20:].min() == pytest.approx(5.0, rel=1e-6) and tied[:, 20:].max() < 1e-6
