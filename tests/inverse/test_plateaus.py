"""Plateaus: found in images made up for the purpose, put to the level a made-up misfit asks for, and a real trench."""

from dataclasses import dataclass

import jax
import numpy as np
import pytest

from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse import methods as solve
from helio_jax.inverse.levels import GAIN, Levels, at_level, search_levels
from helio_jax.inverse.regions import find_plateaus, joined, unexplained
from helio_jax.inverse.residuals import NAMES, Parameters
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.truth import true_height

SHAPE = (40, 60)
INSIDE = np.zeros(SHAPE, bool)
INSIDE[12:30, 15:41] = True


def images(change, seed=0, noise=0.04):
    """Return three noisy images of mean 1, changed within the rectangle by the given amounts, and their variances."""
    rng = np.random.default_rng(seed)
    signal = 1.0 + np.asarray(change)[:, None, None] * INSIDE + noise * rng.normal(size=(3, *SHAPE))
    return signal, np.full(signal.shape, noise**2)


def test_a_floor_that_two_detectors_see_change_is_found():
    region = find_plateaus(*images([-0.5, 0.3, 0.2]))
    assert region.max() == 1
    assert np.mean((region == 1) == INSIDE) > 0.995


def test_a_mask_is_no_plateau():
    """Only one detector changes. Rejects looking at the sum over all detectors."""
    assert find_plateaus(*images([-0.7, 0.0, 0.0])).max() == 0


def test_noise_and_tilted_planes_have_no_plateaus():
    for seed in range(20):
        signal, variance = images([0.0, 0.0, 0.0], seed)
        assert find_plateaus(signal + np.linspace(0.0, 0.3, SHAPE[1]), variance).max() == 0


def test_what_was_not_observed_hides_no_plateau():
    """A lost corner and single lost data beside the floor change nothing; nothing observed is no plateau."""
    signal, variance = images([-0.5, 0.3, 0.2])
    signal[:, :8, :8] = np.nan
    signal[1, 20, 45:48] = variance[2, 5, 30] = np.nan
    assert np.mean((find_plateaus(signal, variance) == 1) == INSIDE) > 0.995
    assert find_plateaus(np.full_like(signal, np.nan), variance).max() == 0


def test_only_unexplained_regions_are_moved():
    region = INSIDE.astype(int)
    good = np.random.default_rng(1).normal(size=(3, *SHAPE))
    assert not unexplained(region, good).any()
    assert np.array_equal(unexplained(region, good + 2.0 * INSIDE), region)


def test_regions_with_a_narrow_gap_are_one():
    region = np.where(np.arange(SHAPE[1]) < 27, 1, 2) * INSIDE
    region[:, 27:29] = 0
    assert np.array_equal(joined(region) == 1, INSIDE)


@pytest.mark.parametrize("best", [-130.0, 45.0])
def test_search_finds_the_level_of_least_misfit(best):
    """A misfit of two valleys, the deeper one at `best`. Rejects descending into the nearer valley."""
    calls = []

    def misfit(surface):
        level = surface.height[INSIDE].mean() - 7.0
        calls.append(level)
        return 1e4 + min(0.3 * (level - best) ** 2, 800.0 + (level - 2.0) ** 2), surface

    ground = Surface(np.full(SHAPE, 7.0), np.full(SHAPE, 0.1), np.full(SHAPE, 0.2))
    found, moved, undecided = search_levels(INSIDE.astype(int), ground, (10.0, 10.0), 500.0, misfit)
    assert moved == [1] and undecided == []
    assert np.median(found.height[INSIDE]) - 7.0 == pytest.approx(best, abs=3.0)
    assert np.all(found.slope_x[~INSIDE] == 0.1) and np.all(found.slope_x[INSIDE] == 0.0)
    assert np.all(found.height[~INSIDE] == 7.0)


def test_a_level_that_cannot_be_predicted_is_passed_over():
    """A trial above the ground fails: the search goes on below it. Catches a search that ends the whole fit."""

    def misfit(surface):
        level = surface.height[INSIDE].mean()
        if level > 0.0:
            raise PredictionError("too steep")
        return 1e4 + 0.3 * (level + 120.0) ** 2, surface

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search_levels(INSIDE.astype(int), ground, (10.0, 10.0), 500.0, misfit)
    assert moved == [1] and np.median(found.height[INSIDE]) == pytest.approx(-120.0, abs=3.0)


def test_a_level_that_gains_little_is_not_taken():
    def misfit(surface):
        return -0.9 * GAIN * (surface.height[INSIDE].mean() < -20.0), surface

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search_levels(INSIDE.astype(int), ground, (10.0, 10.0), 500.0, misfit)
    assert moved == [] and found is ground


@pytest.mark.parametrize(("way", "axis"), [((0.5, 0.0), 1), ((-0.5, 0.0), 1), ((0.0, 0.25), 0)])
@pytest.mark.parametrize("level", [-30.0, 30.0, -1e3])
def test_the_wall_that_the_beam_sees(way, axis, level):
    """At the far side of a hollow, at the near side of a plateau: it rises along the beam by the cotangent.

    Half the region is 9 or 13 pixels wide, so both signs of 30 um leave some of the level; -1000 um is never reached.
    Catches: the wall at the other side, its slope's sign, pixels that count to their far end.
    """
    ground = Surface(np.full(SHAPE, 7.0), np.full(SHAPE, 0.1), np.full(SHAPE, 0.2))
    found = at_level(INSIDE, ground, level, 5.0, (4.0, 4.0), way)
    index = np.indices(SHAPE)[axis][INSIDE]
    shift = way[1 - axis]
    is_from_low = (shift > 0) == (level > 0)
    to_wall = 4.0 * (index - index.min() if is_from_low else index.max() - index) + 2.0
    wall = to_wall / abs(shift)
    expected = np.sign(level) * np.minimum(wall, abs(level))
    np.testing.assert_allclose(found.height[INSIDE], 5.0 + expected)
    slopes = found.slope_x, found.slope_y
    np.testing.assert_allclose(slopes[1 - axis][INSIDE], np.where(wall < abs(level), 1.0 / shift, 0.0))
    assert not slopes[axis][INSIDE].any()
    for field, before in zip(*map(jax.tree.leaves, (found, ground)), strict=True):
        np.testing.assert_array_equal(field[~INSIDE], before[~INSIDE])
    undercut = at_level(INSIDE, ground, level, 5.0, (4.0, 4.0), None)
    assert np.all(undercut.height[INSIDE] == 5.0 + level) and not undercut.slope_x[INSIDE].any()


def test_a_region_at_the_border_has_no_wall_there():
    """The far side of the hollow is outside the image: what the beam meets is floor up to that border's far wall."""
    inside = np.zeros(SHAPE, bool)
    inside[:, 40:] = True
    found = at_level(inside, Surface(*np.zeros((3, *SHAPE))), -30.0, 0.0, (4.0, 4.0), (0.5, 0.0))
    assert np.all(found.height[inside] == -30.0)


def test_search_tries_levels_with_a_wall():
    """A misfit that asks for the far wall of a hollow 60 um deep. Rejects a search of flat levels only."""
    want = at_level(INSIDE, Surface(*np.zeros((3, *SHAPE))), -60.0, 0.0, (10.0, 10.0), (0.5, 0.0))

    def misfit(surface):
        return 1e-2 * float(np.sum((surface.height - want.height) ** 2)), surface

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search_levels(INSIDE.astype(int), ground, (10.0, 10.0), 500.0, misfit, (0.5, 0.0))
    assert moved == [1]
    np.testing.assert_allclose(found.height, want.height, atol=3.0)


@pytest.mark.parametrize(("worse", "is_open"), [(0.5 * GAIN, True), (2.0 * GAIN, False)])
def test_two_levels_that_explain_alike_are_undecided(worse, is_open):
    """-250 um is best, 62 um worse by half or twice what counts as a difference. Rejects keeping the best silently."""

    def misfit(surface):
        level = surface.height[INSIDE].mean()
        return min(0.02 * (level + 250.0) ** 2, worse + 0.02 * (level - 62.0) ** 2, 1e4), surface

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, undecided = search_levels(INSIDE.astype(int), ground, (10.0, 10.0), 500.0, misfit)
    assert moved == [1] and undecided == ([1] if is_open else [])
    assert np.median(found.height[INSIDE]) == pytest.approx(-250.0, abs=5.0)


@dataclass(frozen=True)
class _Fit:
    """What the search for plateaus reads of a fit: flat, the floor's data unexplained."""

    surface: Surface
    residuals: np.ndarray
    parameters: Parameters
    status: str = "first"
    is_interrupted: bool = False


def test_a_plateau_that_cannot_be_fitted_is_flagged(bshem, monkeypatch):
    """The surface with the floor put down is too steep to go on from: the fit before it stays, the floor is undecided.

    Catches an error that ends the whole reconstruction, and a floor that nobody doubts.
    """
    signal, variance = images([-0.5, 0.3, 0.2])
    axis_y, axis_x = (20.0 * (np.arange(n) - 0.5 * (n - 1)) for n in SHAPE)
    stack = MicrographStack(1e6 * signal, axis_x, axis_y, bshem, variance=1e12 * variance, n_rays=1e6)
    start = Surface(*np.zeros((3, *SHAPE)))
    none = Parameters(**{name: np.zeros(0) for name in NAMES})
    fits = iter([_Fit(start, np.random.default_rng(1).normal(size=(3, *SHAPE)) + 3.0 * INSIDE, none)])

    def fit_heights(*args, **kwargs):
        for fit in fits:
            return fit
        raise PredictionError("too steep")

    monkeypatch.setattr("helio_jax.inverse.fit.fit_heights", fit_heights)
    monkeypatch.setattr(solve, "search_levels", lambda region, surface, *args: Levels(surface, [1], []))
    fit, is_undecided = solve._with_plateaus(stack, ReconstructSettings(), lambda n: None, None, start, start)
    assert "too steep" in fit.status and fit.status.startswith("first")
    assert np.mean(is_undecided == INSIDE) > 0.99


def test_a_start_too_rough_to_predict_is_smoothed():
    """Half-way to the smoothed surface as often as needed, three times at most; then the error is the caller's."""

    def work(surface, limit):
        if surface.height.max() > limit:
            raise PredictionError("too rough")
        return surface.height.max()

    rough, smooth = (Surface(*np.full((3, *SHAPE), value)) for value in (9.0, 1.0))
    found, surface = solve._with_backtracking(lambda surface: work(surface, 4.0), rough, smooth)
    assert found == surface.height.max() == 3.0
    with pytest.raises(PredictionError):
        solve._with_backtracking(lambda surface: work(surface, 1.5), rough, smooth)


@pytest.mark.slow
def test_a_slot_across_the_beam_shows_its_far_wall():
    """A slot twice as deep as wide, of which the beam reaches the far wall only: it is taken for that wall.

    At most 5 % of its pixels are valid and wrong by more than 3 stated deviations and 5 % of the depth; half are valid.
    Rejects a floor at some level that ends undercut (40 % wrong), for which multiple scattering makes the wall look.
    """
    overrides = {"sample.width_um": 240.0, "sample.depth_um": 480.0, "sample.azimuth_deg": 90.0, "trace.rays": 256}
    overrides |= {"scan.nx": 31, "scan.ny": 61, "scan.pixel_size_um": 20.0, "scan.center_um": [3.0, 4.0]}
    scene = load_scene("scenes/trench.toml", overrides)
    stack = pipeline.record(scene, pipeline.simulate(scene, seed=5))
    rec = pipeline.reconstruct(stack, "refine", refine={"rays": 200_000, "substrate_um": 6000.0})
    true = true_height(scene, rec).height
    inside = true < -24.0
    assert rec.height_std is not None
    is_wrong = np.abs(rec.height - true) > 3.0 * rec.height_std + 24.0
    assert np.mean((rec.is_valid & is_wrong)[inside]) <= 0.05
    assert np.mean(rec.is_valid[inside]) > 0.5


@pytest.mark.slow
def test_a_trench_along_the_beam_has_its_depth():
    """A floor 240 um deep whose walls the beam does not see, 40 x 24 pixels, SNR 23: depth within 7 %.

    Rejects a fit without plateaus: it bridges the walls and stops at about half the depth.
    """
    overrides = {"sample.width_um": 480.0, "sample.depth_um": 240.0, "sample.length_um": 800.0, "trace.rays": 64}
    overrides |= {"scan.nx": 61, "scan.ny": 41, "scan.pixel_size_um": 20.0, "scan.center_um": [3.0, 4.0]}
    scene = load_scene("scenes/trench.toml", overrides)
    stack = pipeline.record(scene, pipeline.simulate(scene, seed=5))
    rec = pipeline.reconstruct(stack, "refine", refine={"rays": 200_000, "substrate_um": 6000.0, "max_rounds": 1})
    true = true_height(scene, rec).height
    floor = true < -230.0
    depth, std = rec.spread(lambda h: float(np.median(h[~floor]) - np.median(h[floor])))
    assert depth == pytest.approx(240.0, rel=0.07)
    assert 0.1 < std < 20.0
