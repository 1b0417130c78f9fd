"""What users know of heights: pixels of places, masks, leaving anchors out, a fit with right and wrong ones."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.anchors import read_anchors
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.anchor_settings import AnchorSettings
from helio_jax.inverse.anchoring import (
    LIMIT,
    MEASURED,
    _Known,
    _moved,
    are_coherent,
    by_anchors,
    pulls_of,
    with_anchors,
)
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.explanations import explain
from helio_jax.inverse.fit import derivative_of_sums, with_posterior
from helio_jax.inverse.known_heights import anchors_of, check_places
from helio_jax.inverse.posterior import linearise, sample_posterior
from helio_jax.inverse.samples import on_raster
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.workflows.corrections import make_predictor
from helio_jax.workflows.heights import reconstruct
from helio_jax.workflows.pipeline import simulate_file
from helio_jax.workflows.scene_file import load_instrument
from helio_jax.workflows.truth import load_truth
from tests.gradients.test_model import make_problem

ROOT = Path(__file__).resolve().parents[2]
RASTER = Raster.regular((21, 31), 10.0, 20.0)

SCENE = """
extends = "{instrument}"
name = "hills"
[sample]
kind = "height_map"
file = "hills.npz"
unit = "um"
[scan]
nx = 21
ny = 21
pixel_size_um = 50.0
atoms_per_pixel = 1e6
[noise]
enabled = true
"""


def surface(height: np.ndarray | float) -> Surface:
    """A surface on the raster, its slopes not used."""
    return Surface(np.broadcast_to(height, RASTER.shape) + np.zeros(RASTER.shape), *np.zeros((2, *RASTER.shape)))


def anchor(**keys) -> tuple[AnchorSettings, ...]:
    """One anchor, of 2 um by default."""
    return (AnchorSettings.model_validate({"std_um": 2.0} | keys),)


@pytest.mark.parametrize(("name", "height"), [("bshem_wd3", 0.0), ("ashem_45", 60.0)])
def test_place_is_seen_by_the_pixel_whose_beam_meets_it(name, height):
    """A point (x, y) at height h is seen at x + h tan t: rejects places taken for beam positions, and swapped axes."""
    optics = Optics.of(load_instrument(name))
    found = anchors_of(anchor(at_um=(-40.0, 60.0), height_um=50.0), RASTER, optics, surface(height))
    row, column = np.argwhere(found.weight[0])[0]
    place = np.array([-40.0, 60.0]) + height * np.asarray(optics.beam_shift)
    assert abs(RASTER.x[column] - place[0]) <= 5.0 and abs(RASTER.y[row] - place[1]) <= 10.0
    assert found.weight.sum() == pytest.approx(0.5) and found.value == pytest.approx(25.0)


def test_sums_of_places():
    """Means within a radius, steps, and the highest point of a cone, on a plane 0.1 x - 0.2 y and off it."""
    plane = 0.1 * RASTER.x + -0.2 * RASTER.y[:, None]
    optics = Optics.of(load_instrument("ashem_normal"))
    step = anchor(kind="step", at_um=(50.0, 20.0), from_um=(-30.0, -40.0), height_um=0.0, radius_um=25.0)
    found = anchors_of(step, RASTER, optics, surface(plane))
    assert np.sum(found.weight * plane) * 2.0 == pytest.approx(0.1 * 80.0 - 0.2 * 60.0)
    assert (found.weight > 0).sum() > 5
    cone = 100.0 - np.hypot(RASTER.x - 70.0, RASTER.y[:, None] + 60.0)
    (top,) = anchors_of(anchor(kind="highest", height_um=90.0), RASTER, optics, surface(cone)).weight
    assert np.sum(top * cone) * 2.0 == pytest.approx(100.0)


@pytest.mark.parametrize("name", ["bshem_wd3", "ashem_45"])
def test_height_of_a_mask(name):
    """A plateau of height h with an edge at right angles to the detector's direction, its mask measured by rays.

    The end of the mask: where the ray to the centre of the aperture just clears the edge, in the plane through both.
    The length in the micrograph is from there to where the beam meets the edge. Rejects the beam left out (45 deg), far
    field (aperture 20 % off), and the standard deviation of the length taken for that of the height.
    """
    instrument, height = load_instrument(name), 80.0
    optics, detector = Optics.of(instrument), instrument.detector_names[0]
    shift, center = np.asarray(optics.beam_shift), np.asarray(optics.center)[0]
    low = np.array([float(v) for v in optics.spot(np.zeros(()))])
    way = (center - low)[:2] / np.hypot(*(center - low)[:2])
    # the stage brings every point under the beam, where the substrate's lie at `low`: the aperture is seen from there
    distance = height * np.hypot(*(center - low)[:2]) / (center - low)[2]
    end = np.array([-20.0, 10.0])
    edge_seen = end + way * distance + height * shift
    length = float((edge_seen - end) @ way)
    inside = (RASTER.x[None, :] - edge_seen[0]) * way[0] + (RASTER.y[:, None] - edge_seen[1]) * way[1] > 0
    plateau = surface(np.where(inside, height, 0.0))
    known = anchor(kind="mask", at_um=tuple(end), length_um=length, std_um=1.0, detector=detector)
    found = anchors_of(known, RASTER, optics, plateau, instrument.detector_names)
    std = 1.0 / np.maximum(found.weight, 0.0).sum()
    assert found.value[0] * std == pytest.approx(height, rel=1e-6)
    assert std == pytest.approx(height / length)
    assert np.sum(found.weight * plateau.height) * std == pytest.approx(height)


def test_thinning_keeps_every_anchor():
    """Weights of dropped pixels go to the nearest kept: none is lost, and places move by half a pitch at most."""
    weight = np.zeros((2, 9, 12))
    weight[0, 3, 5], weight[1, 8, 11], weight[1, 0, 0] = 1.0, 1.0, -1.0
    thin = slice(None, None, 4), slice(None, None, 4)
    thinned = Anchors(weight, np.zeros(2)).thinned(thin)
    y, x = np.mgrid[:9, :12]
    np.testing.assert_allclose(thinned.weight.sum((1, 2)), [1.0, 0.0])
    np.testing.assert_allclose(np.sum(thinned.weight * x[thin], (1, 2)), [4.0, 8.0])
    np.testing.assert_allclose(np.sum(thinned.weight * y[thin], (1, 2)), [4.0, 8.0])
    field, weight = (
        np.random.default_rng(1).standard_normal((3, 3)),
        np.random.default_rng(2).standard_normal((2, 9, 12)),
    )
    sums = np.sum(Anchors(weight, np.zeros(2)).thinned(thin).weight * field, (1, 2))
    np.testing.assert_allclose(sums, np.sum(weight * on_raster(field, (9, 12), 4), (1, 2)))  # also where pixels tie


def test_a_pixel_of_its_own_takes_up_no_level():
    """Of a level of 9 pixels, one is parted from the rest: it gets no weight, the sum of weights stays."""
    region = np.zeros((12, 12), int)
    region[4:7, 4:7] = 1
    level = Anchors.of_levels(region, {1: (50.0, 2.0)}, np.ones(region.shape, bool), 1)
    parted = region.copy()
    parted[5, 6] = 2
    found = level.within_one(parted)
    assert found.weight[0, 5, 6] == 0.0 and np.count_nonzero(found.weight[0] > 0.0) == 8
    for part in (level.weight > 0.0, level.weight < 0.0):
        assert found.weight[part].sum() == pytest.approx(level.weight[part].sum())
    assert np.array_equal(found.value, level.value)


def test_estimates_by_anchors_are_those_of_least_squares():
    """Sums by data and some of their anchors, by the closed form and by least squares with the anchors' rows."""
    rng = np.random.default_rng(5)
    rows, data = rng.standard_normal((12, 4)), rng.standard_normal(12)
    own = [8, 9, 10, 11]

    def estimate(kept: list[int]) -> tuple[np.ndarray, np.ndarray]:
        fitted = np.linalg.lstsq(rows[kept], data[kept], rcond=None)[0]
        return rows[own] @ np.linalg.inv(rows[kept].T @ rows[kept]) @ rows[own].T, rows[own] @ fitted - data[own]

    known = estimate(list(range(8)))
    for used in ([], [1], [1, 3], [0, 1, 2, 3]):
        wanted = estimate([*range(8), *(own[i] for i in used)])
        for found, value in zip(by_anchors(*known, used), wanted, strict=True):
            np.testing.assert_allclose(found, value, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("level_std", [1e3, 1e5])
def test_a_right_anchor_of_a_level_that_nothing_else_fixes_agrees(level_std):
    """Two right anchors of one level, and a third that is 20 standard deviations off; the level is free without them.

    Without the wrong one, which is named, each right one tells the other's height to sqrt(1 + 0.5^2 * 2) of its own
    standard deviation. Rejects estimates from all anchors out of which some are taken: they are lost to rounding.
    """
    known = level_std**2 + 0.25 * np.eye(3)
    off = 0.7 * level_std + np.array([0.5, -0.5, 20.0])
    found = pulls_of(known, off)
    np.testing.assert_allclose(found[1, :2], np.sqrt(1.5), rtol=1e-3)
    np.testing.assert_allclose(found[2, :2], [-1.0 / np.sqrt(2.5), 1.0 / np.sqrt(2.5)], rtol=1e-3)
    assert abs(found[2, 2]) > LIMIT


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_only_the_wrong_anchor_is_named(share):
    """Of 4 anchors of one height, one is 8 combined deviations off: it is named, the 3 right ones are not.

    `share`: of the weight that is the data's. 200 draws; right ones are named by chance 1 in 2000 each: more than 4
    named ones of 600 have a probability of 2e-5. Rejects pulls against an estimate that contains the wrong anchor.
    """
    rng = np.random.default_rng(8)
    named = np.zeros(4)
    for _ in range(200):
        weight = share / (1.0 - share)  # of the data, the anchors' being 1
        off = rng.standard_normal(4) + [0, 0, 8.0 * math.hypot(1.0, 1.0 / math.sqrt(3.0 + weight)), 0]
        data = rng.standard_normal() / math.sqrt(weight)
        pull = pulls_of(np.full((4, 4), 1.0 / weight), data - off)[2]
        named += np.abs(pull) > LIMIT
    assert named[2] == 200 and named.sum() - 200 <= 4


def test_columns_of_a_table(tmp_path):
    """A CSV file says what the tables of a scene say; wrong cells are named by line."""
    path = tmp_path / "a.csv"
    path.write_text(
        "# known\nname, kind, x_um, y_um, from_x_um, from_y_um, height_um, std_um\n"
        "T, step, 1, 2, 3, 4, 5, 0.5\n,,7,8,,,9,0.25\n"
    )
    first = {"name": "T", "kind": "step", "at_um": (1.0, 2.0), "from_um": (3.0, 4.0), "height_um": 5.0, "std_um": 0.5}
    assert read_anchors(path) == [first, {"at_um": (7.0, 8.0), "height_um": 9.0, "std_um": 0.25}]
    settings = ReconstructSettings().changed(anchor=read_anchors(path))
    assert [a.kind for a in settings.anchor] == ["step", "height"]
    for text, told in (
        ("nam,x_um\n", "line 1: there is no column 'nam': did you mean 'name'"),
        ("x_um,x_um\n", "line 1: a column is given twice"),
        ("x_um,y_um\n1,2\n3\n", "line 3: must have 2 columns, got 1"),
        ("x_um,std_um\n1,2\n", "line 2: a place needs x_um and y_um, got x_um alone"),
        ("height_um\nabout 5\n", "line 2: height_um must be a finite number, got 'about 5'"),
        ("\n", "empty file"),
        ("x_um,y_um\n", "has titles, but no anchor"),
    ):
        path.write_text(text)
        with pytest.raises(InputFileError, match=told):
            read_anchors(path)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"at_um": [0, 0]}, "an anchor of kind 'height' needs height_um"),
        ({"kind": "highest", "height_um": 1.0, "at_um": [0, 0]}, "takes no at_um"),
        ({"at_um": [0, 0], "height_um": 1.0, "std_um": 0.0}, "std_um"),
    ],
)
def test_incomplete_anchors_are_refused(keys, told):
    """Each kind states what it needs, and nothing that would be ignored."""
    with pytest.raises(SceneError, match=told):
        ReconstructSettings().changed(anchor=[{"std_um": 1.0} | keys])


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"at_um": (900.0, 0.0), "height_um": 1.0}, "'anchor 1': at_um: x = 900 um lies outside of the image"),
        ({"kind": "step", "at_um": (0, 0), "from_um": (1, 1), "height_um": 1.0}, "move them apart"),
        ({"kind": "mask", "at_um": (0, 0), "length_um": 9.0, "detector": "x"}, "there is no detector 'x'"),
    ],
)
def test_anchors_that_the_image_cannot_show(keys, told):
    """Places outside, a step within one pixel, a detector that is not there."""
    with pytest.raises(SceneError, match=told):
        check_places(anchor(**keys), RASTER, Optics.of(load_instrument("bshem_wd3")), ("a",))


def test_sums_covary_as_in_the_dense_inverse(bshem):
    """Covariance of known sums with heights, slopes and instrument, above a tilted substrate: (J'J)^-1 of all unknowns.

    Catches the change of a height above a tilted substrate that is left out, and mixed up fields.
    """
    sure = Uncertainty(sample_distance_um=100.0, tilt_deg=1.0, polar_deg=3.0)
    linear = linearise(*make_problem(bshem.model_copy(update={"uncertainty": sure}), law="power", law_std=0.1))
    n_pixels = math.prod(linear.shape)
    weight = np.random.default_rng(2).standard_normal((2, *linear.shape))
    sums = derivative_of_sums(Anchors(weight, np.zeros(2)), np.ones((2, *linear.shape)), linear)
    tilts = [3 * n_pixels + linear.names.index(f"tilt[{axis}]") for axis in (0, 1)]
    np.testing.assert_allclose(sums[tilts], -np.repeat(weight.sum((1, 2))[None], 2, 0))
    found = sample_posterior(linear, 2, sums=sums).sums
    both = np.hstack([linear.surface.toarray() + linear.common @ linear.weights.T, linear.instrument])
    wanted = np.linalg.solve(both.T @ both, sums)
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(found.surface[:, 1].reshape(2, -1).T, wanted[1 : 3 * n_pixels : 3], atol=1e-7 * scale)
    np.testing.assert_allclose(found.surface[:, 0].reshape(2, -1).T, wanted[: 3 * n_pixels : 3], atol=1e-7 * scale)
    np.testing.assert_allclose(found.instrument.T, wanted[3 * n_pixels :], atol=1e-7 * scale)
    np.testing.assert_allclose(found.own, sums.T @ wanted, rtol=1e-6)
    np.testing.assert_allclose(found.inflation, 1.0)


@pytest.fixture(scope="module")
def hills(tmp_path_factory):
    """A hill and a hollow with a free border, 21 x 21 pixels of a million atoms: fit, micrographs, true heights."""
    folder = tmp_path_factory.mktemp("hills")
    at = np.arange(-2500.0, 2501.0, 25.0)
    x, y = np.meshgrid(at, at)
    hill = np.exp(-((x - 150) ** 2 + (y + 100) ** 2) / 2 / 300**2)
    hollow = np.exp(-((x + 200) ** 2 + (y - 200) ** 2) / 2 / 200**2)
    np.savez(folder / "hills.npz", x=at, y=at, height=100.0 + 150.0 * hill - 80.0 * hollow)
    (folder / "hills.toml").write_text(SCENE.format(instrument=ROOT / "scenes/instruments/bshem_wd3.toml"))
    found = simulate_file(folder / "hills.toml", folder / "hills.h5")
    assert found is not None
    stack = found.only().replace(instrument=found.only().instrument.model_copy(update={"uncertainty": Uncertainty()}))
    fast = {"bias_pairs": 0, "photometric_rounds": 2, "albedo_patches": False, "objects": False, "rays": 100_000}
    settings = ReconstructSettings().changed(border="free", refine=fast)
    fit = explain(stack, settings, lambda n: make_predictor(stack, n, None, border="free"), None).fit
    seen = reconstruct(stack, "nearfield", border="free", samples=0, rounds=1, corrections=0)
    return fit, stack, load_truth(folder / "hills.toml", seen).height


def test_right_anchors_sharpen_and_a_wrong_one_is_named(hills):
    """A right step and a right height of hills with a free border; then, beside them, a height that is 30 um off.

    Right ones agree, and the step and the level are then known better than data (level: to some um) or anchors (1 um)
    know them alone. The wrong one is named and widens all error bars. Catches anchors without effect, error bars that
    do not follow, and a comparison with heights that contain the wrong anchor.
    """
    fit, stack, true = hills
    top, low = (np.unravel_index(k, true.shape) for k in (true.argmax(), true.argmin()))

    def place(pixel):
        tx, ty = stack.instrument.beam_shift
        return float(stack.x[pixel[1]] - tx * true[pixel]), float(stack.y[pixel[0]] - ty * true[pixel])

    def moved(anchors):
        settings = fit.problem.reconstruct_settings.changed(anchor=anchors)
        return with_anchors(replace(fit, problem=replace(fit.problem, reconstruct_settings=settings)))[:2]

    step = {"name": "step", "kind": "step", "at_um": place(top), "from_um": place(low), "std_um": 1.0}
    right = [step | {"height_um": float(true[top] - true[low])}]
    right += [{"name": "place", "at_um": place((4, 16)), "height_um": float(true[4, 16]), "std_um": 1.0}]
    wrong = {"name": "wrong", "at_um": place((15, 15)), "height_um": float(true[15, 15]) + 30.0, "std_um": 1.0}
    (alone, none), (better, checks), (worse, named) = moved([]), moved(right), moved([*right, wrong])
    assert none == () and all(one.agrees for one in checks) and checks[1].without_std > 3.0
    assert [one.name for one in named if not one.agrees] == ["wrong"] and "contradicts" in named[2].sentence()

    def spread(fit, number):
        return np.sqrt(np.mean([number(sample) ** 2 for sample in fit.posterior.samples]))

    def height_of_step(height):
        return height[top] - height[low]

    assert spread(better, height_of_step) < min(1.0, spread(alone, height_of_step))
    assert abs(height_of_step(better.surface.height - true)) < 3.0
    assert spread(better, np.mean) < 0.5 * spread(alone, np.mean)
    assert np.abs(worse.residuals - fit.residuals).max() > 0.1  # those of the heights as moved
    assert np.median(worse.posterior.height_std) > 2.0 * np.median(better.posterior.height_std)


def test_a_measured_step_that_contradicts_all_else_is_not_used(hills):
    """Two right measured steps and a wrong one beside them: the map is that of the right ones, and says so.

    Catches a wrong step that moves the map, one that is not named, and heights "in the map" of a map that used it.
    """
    fit, _, true = hills
    ends = [((5, 5), (15, 15)), ((15, 5), (5, 15)), ((10, 4), (10, 16))]
    weight, value = np.zeros((3, *true.shape)), np.zeros(3)
    for i, (high, low) in enumerate(ends):
        weight[i][high], weight[i][low] = 0.5, -0.5
        value[i] = 0.5 * (true[high] - true[low])
    value[2] += 40.0

    def moved(which):
        anchors = Anchors(weight[which], value[which])
        names = tuple((f"step {i + 1}", MEASURED) for i in which)
        return _moved(with_posterior(fit, anchors), _Known(names, anchors))

    right, both = moved([0, 1]), moved([0, 1, 2])
    assert [one.name for one in both.checks if not one.agrees] == ["step 3"] and len(both.used.value) == 2
    np.testing.assert_allclose(both.fit.surface.height, right.fit.surface.height, atol=0.02)
    for i, one in enumerate(both.checks):
        assert one.fitted == pytest.approx(2.0 * float(np.sum(weight[i] * both.fit.surface.height)), abs=1e-6)
    assert "not used" in both.checks[2].sentence()
    spread = [np.median(found.fit.posterior.height_std) for found in (right, both)]
    assert spread[1] > spread[0]


def test_a_measured_step_that_moves_few_pixels_is_not_coherent():
    """Sides that move as a whole, one of them not at all, count; 12 of 70 pixels that move far alone do not."""
    weight, change = np.zeros((3, 20, 20)), np.zeros((3, 20, 20))
    weight[:, 2:9, 2:12], weight[:, 12:16, 2:12] = 1.0 / 70.0, -1.0 / 40.0
    change[0, 2:9, 2:12] = 1.0 + 0.2 * np.arange(10)
    change[1, 2:5, 2:6] = 6.0
    change[2, 2:9, 2:12], change[2, 12:14, 2:5] = 1.0, 10.0
    assert are_coherent(weight, change).tolist() == [True, False, False]
