"""Pits in a flat substrate: outlines from what flat floors do not explain, levels by trial."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from helio_jax.forward.surface import Surface
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.correlated_errors import EdgeError
from helio_jax.inverse.edges import find_edges
from helio_jax.inverse.explanations import _Fits
from helio_jax.inverse.pits import LIMIT, Pits, PitSearch, floor_of, minima, outlines
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.verdict import EDGE_PLACE, edge_std
from helio_jax.workflows.corrections import make_predictor
from tests import terraces

SHAPE = 40, 50
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]
OUTER = (np.abs(X - 25) < 11) & (np.abs(Y - 20) < 9)
INNER = (np.abs(X - 27) < 5) & (np.abs(Y - 21) < 4)
PITCH = 10.0


def found(depths, beam_shift=(0.0, 0.0), inner=INNER):
    """Search pits where each pixel's one residual is its height error over 30 um, beyond 0.9."""
    truth = -depths[0] * OUTER - (depths[1] - depths[0]) * inner
    search = PitSearch(lambda s: (0.9 + np.abs(s.height - truth) / 30.0)[None], (PITCH, PITCH), beam_shift)
    return truth, search.find(SHAPE)


def test_a_pit_in_a_pit_has_two_outlines_and_two_levels():
    """Both floors to 5 % of their depth, nothing beside them. Rejects one level for all."""
    truth, pits = found((80.0, 130.0))
    assert pits is not None and pits.number.max() >= 2
    assert np.sum((pits.number > 0) != OUTER) <= 4  # corners
    assert np.sum(np.abs(pits.surface.height - truth) > 0.05 * 130.0) <= 8


def test_a_large_pit_in_a_pit_has_its_own_outline():
    """One half of a floor is 80 um deeper: a level between the two explains neither, the rim shows the upper one.

    Both floors to 2 um. Rejects the best level of the whole floor, which leaves no pit at all.
    """
    inner = (np.abs(X - 27) < 8) & (np.abs(Y - 21) < 6)
    assert 0.4 < inner.sum() / OUTER.sum() < 0.6
    truth, pits = found((80.0, 160.0), inner=inner)
    assert pits is not None and pits.number.max() == 2
    assert np.sum((pits.surface.height < -120.0) != inner) <= 4  # corners
    for inside in (OUTER & ~inner, inner):
        assert np.median(pits.surface.height[inside]) == pytest.approx(np.median(truth[inside]), abs=2.0)


def test_all_minima_of_the_depth_are_looked_into():
    """A narrow minimum at 57 um beside a wide one at 500 um: both are found, the least first."""
    assert minima([5.0, 3.0, 4.0, 6.0, 2.0, 2.5]) == [4, 1]
    assert minima([np.inf, np.inf]) == [] and minima([1.0]) == [0]

    def residuals(surface):
        depth = -surface.height
        narrow = 0.9 + 2.0 * np.minimum(np.abs(depth - 57.0) / 20.0, 2.0)
        wide = 1.2 + 2.0 * np.minimum(np.abs(depth - 500.0) / 400.0, 2.0)
        return np.where(OUTER, np.minimum(narrow, wide), 0.9 + np.abs(depth))[None]

    pits = PitSearch(residuals, (PITCH, PITCH), (0.0, 0.0)).find(SHAPE)
    assert pits is not None and np.median(pits.surface.height[OUTER]) == pytest.approx(-57.0, abs=5.0)


def test_no_pit_where_the_substrate_explains_all():
    assert found((0.0, 0.0))[1] is None


def test_an_image_that_nothing_explains_is_no_pit():
    """Residuals of 4 everywhere, as of a substrate of another albedo: no pit that leaves no substrate around it."""
    search = PitSearch(lambda s: np.full((1, *SHAPE), 4.0 - 0.001 * np.abs(s.height)), (PITCH, PITCH), (0.0, 0.0))
    assert search.find(SHAPE) is None


def test_a_cone_is_no_pit():
    """A floor at any level explains a ring of it alone: no pit, and nothing is looked for within. A flat one is a pit.

    Without the rule there is a pit of several levels, whose floors explain 10 to 20 % of their pixels.
    """
    cone = np.minimum(8.0 * np.hypot(X - 25, Y - 20) - 120.0, 0.0)
    for truth, is_pit in ((cone, False), (-100.0 * (cone < -30.0), True)):
        search = PitSearch(lambda s, z=truth: (0.9 + np.abs(s.height - z) / 12.0)[None], (PITCH, PITCH), (0.0, 0.0))
        assert (search.find(SHAPE) is not None) == is_pit


def test_what_another_surface_explains_far_better_is_no_pit():
    """Its depth is not refined, and no pit is looked for in its floor; a rival that explains less changes nothing."""
    tried = []

    def residuals(surface):
        tried.append(surface.height.min())
        return (0.9 + np.abs(surface.height + 80.0 * OUTER + 60.0 * INNER) / 30.0)[None]

    counts = []
    for left in (1.5, 0.1):
        search = PitSearch(residuals, (PITCH, PITCH), (0.0, 0.0), rival=np.full((1, *SHAPE), left))
        assert (search.find(SHAPE) is None) == (left == 0.1)
        counts.append(len(tried))
        tried.clear()
    assert counts[1] < 0.3 * counts[0], counts


def test_outlines_need_several_pixels():
    """Single pixels, however wrong, are noise; a block of 4 x 5 is a region, to the pixel."""
    wrong = np.zeros((2, *SHAPE))
    wrong[:, 5, 5] = 100.0
    wrong[0, 20:24, 30:35] = 2.0 * np.sqrt(LIMIT)
    regions = outlines(Pits(Surface(*np.zeros((3, *SHAPE))), np.zeros(SHAPE, int), wrong**2).is_unexplained)
    assert len(regions) == 1
    rows, columns = np.nonzero(regions[0])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 23, 30, 34)


def test_a_wall_without_a_floor_has_no_level():
    """Deeper than the beam reaches all levels are one wall: at 30 deg no deeper floor is accepted than one in view."""
    _, pits = found((1e4, 1e4), (np.tan(np.radians(30.0)), 0.0))
    assert pits is None or np.sum(floor_of(pits.surface, OUTER)) >= 0.15 * OUTER.sum()


def test_edges_are_known_to_a_pixel():
    """A step of 100 has a deviation of 100 / sqrt(12) at its two pixels, a ramp and noise (less than 3 %) have none."""
    step = np.where(X < 25, 0.0, 100.0)[None]
    assert edge_std(step, np.zeros((1, *SHAPE)))[0, 20, 24:26] == pytest.approx(EDGE_PLACE * 100.0)
    assert np.all(edge_std(step, np.zeros((1, *SHAPE)))[0, :, :23] == 0.0)
    assert np.all(edge_std(5.0 * X[None], np.zeros((1, *SHAPE))) < 1e-9 + 5.0 * EDGE_PLACE * ((X == 0) | (X == 49)))
    noise = np.random.default_rng(1).normal(0.0, 10.0, (1, *SHAPE))
    assert np.sqrt(np.mean(edge_std(noise, np.full((1, *SHAPE), 100.0)) ** 2)) < 0.3 * 10.0


def test_errors_of_a_straight_rim_do_not_average():
    """The mean over a straight rim of 30 edges has the deviation of one edge, over independent edges 1 / sqrt(30).

    4000 draws leave 2.2 % of a variance. Rejects independent edges (a variance too low by 30).
    """
    height = np.maximum(X[:30] - 24.5, 0.0) * PITCH
    slope = np.gradient(height, PITCH, axis=1)
    surface = Surface(height, slope, 0.0 * slope)
    edges = find_edges(height, slope, PITCH, 1, 0.01, 3.0), find_edges(height, 0.0 * slope, PITCH, 0, 0.01, 3.0)
    error = EdgeError.of(surface, *edges)
    on_rim = error.run > 0
    assert on_rim.any() and len(np.unique(error.run[on_rim])) == on_rim.sum() // 30
    rng = np.random.default_rng(2)
    drawn = error.draw(rng, rng.standard_normal((error.run.size, 4000)))
    first = error.run == error.run[on_rim][0]
    share = float(error.share[first][0])
    assert drawn[first].mean(0).var() == pytest.approx(share + (1.0 - share) / 30.0, rel=0.12)
    assert drawn[~on_rim].var() == pytest.approx(1.0, rel=0.02)
    influence = np.stack([first / 30.0, np.ones(first.size)], 1)
    assert error.covariance(influence)[0, 0] == pytest.approx(share + (1.0 - share) / 30.0, rel=1e-9)


@pytest.mark.slow
def test_a_traced_pit_has_its_level(tmp_path):
    """A square pit, 14 pixels wide and 10 deep, turned, seen from above: outline and level by search alone, no fit.

    The level to 8 %, which is a pixel of a mask's end; measured over eight draws, 4.6 to 7.2 % too deep, as the outline
    takes pixels that the rim cuts. Rejects the flat substrate and other depths.
    """
    fixed = {"outline": "square", "n": 35, "pixel": 10.0, "incidence": 0.0, "width": 140.0, "height": -100.0}
    member = terraces.draw(np.random.default_rng(9), **fixed, turn=20.0, snr=60.0)
    stack = terraces.trace(member, tmp_path, rays=64)
    settings = ReconstructSettings(border="flat")
    fits = _Fits(stack, settings, lambda n: make_predictor(stack, n, settings.refine.substrate_um), None)
    none = AlbedoPatches.none(stack.shape[1:])
    search = PitSearch(lambda s: fits.residuals_on(s, none), (PITCH, PITCH), stack.instrument.beam_shift)
    pits = search.find((35, 35))
    seen = terraces.seen_level(member, *np.meshgrid(stack.x, stack.y))
    assert pits is not None and np.mean((pits.number > 0) != (seen == -100.0)) < 0.03
    inner = binary_erosion(seen == -100.0, iterations=2)
    assert np.median(pits.surface.height[inner]) == pytest.approx(-100.0, rel=0.08)
