"""Levels of regions: put to the level a made-up misfit asks for, a real trench."""

import jax
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, gaussian_filter

from helio_jax.errors import PredictionError
from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.backtracking import with_backtracking
from helio_jax.inverse.levels import GAIN, Region, at_level, grown, plane_around, search_levels, without_skirt
from helio_jax.inverse.measured_steps import measured_regions, off_ground
from helio_jax.inverse.step_records import Patch, Steps
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.truth import true_height

SHAPE = (40, 60)
INSIDE = np.zeros(SHAPE, bool)
INSIDE[12:30, 15:41] = True


def search(surface, misfit, beam_shift=(0.0, 0.0)):
    """Search the level of the rectangle; a short fit changes nothing."""
    return search_levels([Region(INSIDE)], surface, (10.0, 10.0), 500.0, misfit, lambda s: (misfit(s), s), beam_shift)


def blurred(height):
    """Return what a fit makes of a region at a height: right inside, with a skirt of three pixels."""
    return gaussian_filter(np.where(INSIDE, height, 0.0), 2.0)


def test_the_skirt_of_a_region_is_taken_off():
    """Beside the region the surroundings go on level; inside, beyond and in other regions nothing changes."""
    surface = Surface(blurred(40.0), *np.ones((2, *SHAPE)))
    others = np.zeros(SHAPE, bool)
    others[:, 43:45] = True
    found = without_skirt(Region(INSIDE), others, surface)
    assert np.abs(found.height[8:12, 20:35]).max() < 1.0
    for same in (INSIDE, others):
        np.testing.assert_array_equal(found.height[same], surface.height[same])


def test_the_skirt_is_as_wide_as_the_masks():
    """Raised by 30 um up to seven pixels from the region: rejects a skirt of four pixels."""
    reach = np.asarray(binary_dilation(INSIDE, np.ones((3, 3)), iterations=7)) & ~INSIDE
    surface = Surface(np.where(INSIDE, 40.0, 30.0 * reach), *np.zeros((2, *SHAPE)))
    for skirt, raised in ((7, 0.0), (4, 30.0)):
        found = without_skirt(Region(INSIDE, skirt=skirt), np.zeros(SHAPE, bool), surface)
        assert found.height[reach].max() == raised


def test_the_plane_around_a_region_is_that_of_the_slopes():
    """Slopes of 0.05 and -0.02 beyond the skirt, heights that bend by 50 um there: the plane has the slopes.

    Through the median of the heights; slopes in the skirt and the region are those of a bridged jump.
    """
    y, x = np.indices(SHAPE) * 10.0
    wrong = np.where(grown(INSIDE, 4), 0.7, 0.0)
    height = 0.05 * x - 0.02 * y + 50.0 * (x / x.max()) ** 2
    surface = Surface(height, 0.05 + wrong, -0.02 - wrong)
    plane = plane_around(Region(INSIDE), np.zeros(SHAPE, bool), surface, (10.0, 10.0))
    assert np.all(plane.slope_x == 0.05) and np.all(plane.slope_y == -0.02)
    np.testing.assert_allclose(np.diff(plane.height, axis=1), 0.5, atol=1e-9)
    np.testing.assert_allclose(np.diff(plane.height, axis=0), -0.2, atol=1e-9)
    known = ~grown(INSIDE, 4)
    assert np.median((plane.height - height)[known]) == pytest.approx(0.0, abs=1e-9)


def test_differences_of_anchors_leave_their_mean_open():
    """Steps of 20, 24 and 28 um at three places: any common change fits, one place alone that changes does not.

    The sum of squares of a change d of one place is (d / std)^2 times 1 - 1/3. Rejects steps that are anchored.
    """
    lower, upper = np.zeros((2, 3, *SHAPE))
    for i, part in enumerate(np.array_split(np.arange(SHAPE[1]), 3)):
        lower[i, 0, part], upper[i, -1, part] = 1.0 / part.size, 1.0 / part.size
    std, steps = 2.0, np.array([20.0, 24.0, 28.0])
    anchors = Anchors((upper - lower) / std, steps / std).differences()
    assert Anchors.none(SHAPE).differences().value.size == 0
    height = np.zeros(SHAPE)
    for i in range(3):
        height[-1, upper[i, -1] > 0.0] = steps[i]
    for common in (0.0, 13.0):
        off = np.einsum("ayx,yx->a", anchors.weight, height + common * (np.indices(SHAPE)[0] > 0)) - anchors.value
        assert np.abs(off).max() < 1e-9
    height[-1, upper[1, -1] > 0.0] += 3.0
    off = np.einsum("ayx,yx->a", anchors.weight, height) - anchors.value
    assert np.sum(off**2) == pytest.approx((3.0 / std) ** 2 * (1.0 - 1.0 / 3.0))


def test_anchors_hold_the_level_of_a_region():
    """Mean height of the region above the others' beyond a margin, in standard deviations; the same when thinned."""
    region, height = INSIDE.astype(int), np.where(INSIDE, 25.0, 5.0)
    height[10:12, 16:40] = 99.0  # beside the region
    anchors = Anchors.of_levels(region, {1: (18.0, 0.5), 2: (1.0, 1.0)}, np.ones(SHAPE, bool), 3)
    for kept, heights in ((anchors, height), (anchors.thinned((slice(None, None, 2),) * 2), height[::2, ::2])):
        assert kept.value == pytest.approx([36.0])
        assert np.einsum("ayx,yx->a", kept.weight, heights) == pytest.approx([40.0], rel=1e-2)
    assert anchors.padded(4).weight.shape == (4, *SHAPE) and not anchors.padded(4).weight[1:].any()


def test_a_measured_step_is_tried_above_the_surface_around():
    """Where the border is free that is at any height. Rejects steps taken for heights above 0."""
    ground = Surface(np.full(SHAPE, 70.0), *np.zeros((2, *SHAPE)))
    region = Region(INSIDE, height=20.0, std=0.3, step=20.0)
    assert region.heights(70.0, (10.0, 10.0), 500.0) == [90.0]
    found = search_levels(
        [region],
        ground,
        (10.0, 10.0),
        500.0,
        misfit := lambda s: 1e4 + 0.3 * (s.height[INSIDE].mean() - 90.0) ** 2,
        lambda s: (misfit(s), s),
    )
    assert found.moved == [0] and found.surface.height[INSIDE].mean() == pytest.approx(90.0, abs=2.0)


def patches_of(patch, *levels, std=1.0):
    """Regions between steps, from the numbers of patches [y, x] and their levels above the first."""
    about = [(int(np.sum(patch == n)), level, 0.0 if n == 0 else std) for n, level in enumerate(levels)]
    listed = tuple(Patch(n, size, level, sigma, 1, False, 0.0) for n, (size, level, sigma) in enumerate(about))
    nothing = np.zeros((3, *patch.shape))
    return measured_regions(
        Steps((), (), listed, patch, nothing > 0.0, nothing, 0.0, 0), Raster.regular(patch.shape, 10.0)
    )


def test_a_measured_level_is_above_the_patch_around_it():
    """A level of 150 um on one of 100 um is a step of 50 um; on one that is not known it is none.

    Rejects steps that count from the substrate elsewhere, which a surface with a free border may put at any height.
    """
    patch = np.zeros(SHAPE, int)
    patch[4:-4, 4:-4], patch[10:-10, 10:-10] = 1, 2
    found = [[(r.height, r.step) for r in patches_of(patch, 0.0, level, 150.0)] for level in (100.0, np.nan)]
    assert found == [[(100.0, 100.0), (150.0, 50.0)], [(None, None), (150.0, None)]]


def test_levels_count_from_the_ground():
    """The patch that has most of the border, even where a mesa is the largest one. Rejects counting from the latter."""
    patch = np.ones(SHAPE, int)
    patch[2:-2, 2:-2] = 0
    (mesa,) = patches_of(patch, 0.0, -100.0, std=2.0)
    assert (mesa.height, mesa.std) == (100.0, 2.0) and np.array_equal(mesa.inside, patch == 0)
    assert np.array_equal(off_ground([mesa], SHAPE, 2.0), patch == 0)


def test_substrate_beyond_a_ridge_is_substrate():
    """Over both walls of a ridge its level is 1 +- 3 um. Rejects taking every other patch for off the ground."""
    patch = np.zeros(SHAPE, int)
    patch[:, SHAPE[1] // 2 - 2 :], patch[:, SHAPE[1] // 2 + 3 :] = 1, 2
    assert np.array_equal(off_ground(patches_of(patch, 0.0, 100.0, 1.0, std=3.0), SHAPE, 2.0), patch == 1)


def test_a_level_that_steps_disagree_about_is_not_held_to_the_ground():
    """40 +- 2 and 150 +- 2 um give 95 +- 55 um: held to 0 +- 2 um it would come out there. 5 +- 8 um is held."""
    patch = np.zeros(SHAPE, int)
    patch[:, SHAPE[1] // 2 + 4 :] = 1
    for level, std, is_off in ((95.0, 55.0, True), (5.0, 8.0, False)):
        assert off_ground(patches_of(patch, 0.0, level, std=std), SHAPE, 2.0).any() == is_off


def test_above_a_ground_of_unknown_level_no_height_is_known():
    """Masks in the ground that no step explains: levels above the largest patch, a mesa, are not above the ground."""
    patch = np.full(SHAPE, 1)
    patch[2:-2, 2:-2], patch[10:-10, 10:-10] = 0, 2
    mesa, block = patches_of(patch, 0.0, np.nan, 40.0)
    assert mesa.height is None and block.height is None and block.step == 40.0


@pytest.mark.parametrize("best", [-130.0, 45.0])
def test_search_finds_the_level_of_least_misfit(best):
    """A misfit of two valleys, the deeper one at `best`. Rejects descending into the nearer valley."""
    calls = []

    def misfit(surface):
        level = surface.height[INSIDE].mean() - 7.0
        calls.append(level)
        return 1e4 + min(0.3 * (level - best) ** 2, 800.0 + (level - 2.0) ** 2)

    ground = Surface(np.full(SHAPE, 7.0), np.full(SHAPE, 0.1), np.full(SHAPE, 0.2))
    found, moved, undecided = search(ground, misfit)
    assert moved == [0] and undecided == []
    assert np.median(found.height[INSIDE]) - 7.0 == pytest.approx(best, abs=6.0)
    assert np.all(found.slope_x[~INSIDE] == 0.1)
    assert np.all(found.height[~INSIDE] == 7.0)


def test_a_level_that_cannot_be_predicted_is_passed_over():
    """Trials above the ground fail: the search goes on below it. Catches a search that stays where it failed."""

    def misfit(surface):
        level = surface.height[INSIDE].mean()
        if level > 0.0:
            return np.inf
        return 1e4 + 0.3 * (level + 120.0) ** 2

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search(ground, misfit)
    assert moved == [0] and np.median(found.height[INSIDE]) == pytest.approx(-120.0, abs=6.0)


def test_a_level_that_gains_little_is_not_taken():
    def misfit(surface):
        return -0.9 * GAIN * (surface.height[INSIDE].mean() < -20.0)

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search(ground, misfit)
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
        return 1e-2 * float(np.sum((surface.height - want.height) ** 2))

    ground = Surface(*np.zeros((3, *SHAPE)))
    found, moved, _ = search(ground, misfit, (0.5, 0.0))
    assert moved == [0]
    np.testing.assert_allclose(found.height, want.height, atol=6.0)


@pytest.mark.parametrize(("worse", "is_open"), [(0.5 * GAIN, True), (2.0 * GAIN, False)])
def test_two_reliefs_that_explain_alike_are_undecided(worse, is_open):
    """Flat at -250 um is best; a relief 150 um higher is worse by half or twice what counts as a difference."""

    def misfit(surface):
        level, is_flat = surface.height[INSIDE].mean(), np.ptp(surface.height[INSIDE]) == 0
        return min(0.02 * (level + (250.0 if is_flat else 100.0)) ** 2 + (0.0 if is_flat else worse), 1e4)

    ground = Surface(np.where(INSIDE, -60.0, 0.0), *np.zeros((2, *SHAPE)))
    ground.height[15, 20] = -65.0
    found, moved, undecided = search(ground, misfit)
    assert moved == [0] and undecided == ([0] if is_open else [])
    assert np.median(found.height[INSIDE]) == pytest.approx(-250.0, abs=15.0)


def test_a_measured_height_is_taken():
    """No other height is tried."""
    tried = []

    def misfit(surface):
        tried.append(float(np.median(surface.height[INSIDE])))
        return 1e4 * (tried[-1] > -1.0)

    ground = Surface(*np.zeros((3, *SHAPE)))
    region = Region(INSIDE, -33.0, 1.0, -33.0)
    found = search_levels([region], ground, (10.0, 10.0), 500.0, misfit, lambda s: (misfit(s), s))
    assert found.moved == [0] and set(tried) == {0.0, -33.0}


def test_a_start_too_rough_to_predict_is_smoothed():
    """Half-way to the smoothed surface as often as needed, four times at most; then the error is the caller's."""

    def work(surface, limit):
        if surface.height.max() > limit:
            raise PredictionError("too rough")
        return surface.height.max()

    rough, smooth = (Surface(*np.full((3, *SHAPE), value)) for value in (9.0, 1.0))
    found, surface = with_backtracking(lambda surface: work(surface, 4.0), rough, smooth)
    assert found == surface.height.max() == 3.0
    with pytest.raises(PredictionError):
        with_backtracking(lambda surface: work(surface, 1.2), rough, smooth)


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
