"""Beyond the image a sample with a free border goes on as its border lets expect: what that sends back into it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from helio_jax.micrograph import MicrographStack
from helio_jax.scene.border import continue_border, extend_border, mirror_border, predict_border
from helio_jax.scene.surfaces import surface_body
from helio_jax.scene.waves import continue_waves
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows import pipeline
from helio_jax.workflows.corrections import make_predictor
from helio_jax.workflows.scene_file import load_instrument, load_scene

SCENES = Path(__file__).parents[2] / "scenes"
STEP = SCENES / "step.toml"


@pytest.mark.parametrize("border, low, high", [("free", 0.8, 1.5), ("flat", 0.0, 0.6)])
def test_a_wall_across_the_image_goes_on_beyond_it(border, low, high):
    """A step of 100 um, seen over 0.28 mm of its 6 mm: multiple scattering of the lower terrace as simulated.

    The beam does not see the wall, so what it sends is known to a third; a fifth of a millimetre and more away from it,
    noise is 5 %. With a flat outside the image the wall ends there and sends less than half, and fits ran away.
    """
    scene = load_scene(STEP, {"scan.nx": 25, "scan.ny": 7, "scan.pixel_size_um": 40.0})
    stack = pipeline.simulate(scene, seed=1)
    assert stack.multiple is not None and stack.n_rays is not None
    is_lower = np.arange(25) > 13  # the beam sees none of the wall: its foot is where the shadow ends
    height = np.where(is_lower, 0.0, 100.0) * np.ones((7, 1))
    normals = np.broadcast_to([0.0, 0.0, 1.0], (7, 25, 3))
    predicted = make_predictor(stack, 400_000, 6000.0, border=border)(height, normals)
    true = stack.multiple[:, :, 19:].sum((1, 2)) / stack.n_rays
    ratio = predicted.multiple[:, :, 19:].sum((1, 2)) / true
    assert np.all((low < ratio) & (ratio < high)), ratio


def test_flanks_go_on_down_to_the_ground():
    """The first of the two ways: a pyramid whose 55 degree flanks leave the image half-way down. Its foot to 3 %.

    The truth is traced on the whole pyramid, whose ground the image's corners show. Statistics of both: 0.5 %. Flanks
    that go on outside as high as at the border stand nearer to the aperture: the flanks then receive 7 % too much.
    """
    instrument = load_instrument(SCENES / "instruments" / "ashem_normal.toml")

    def height(x, y):
        return np.maximum(850.0 - abs(x) - abs(y), 0.0)

    fine = np.arange(-60, 61) * 20.0
    axis = (np.arange(25) - 12.0) * 40.0
    x, y = np.meshgrid(axis, axis)
    is_flank = (x != 0.0) & (y != 0.0) & (abs(x) + abs(y) < 750.0)
    normals = np.where(is_flank[..., None], np.stack([np.sign(x), np.sign(y), np.ones_like(x)], -1), [0.0, 0.0, 1.0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    pyramid = surface_body(*np.meshgrid(fine, fine), height(*np.meshgrid(fine, fine)), 9000.0)
    settings = TraceSettings(rays=512, branches=8, n_orders=2, seed=2)
    traced = trace_pixels(make_experiment(pyramid, instrument, settings), x[is_flank], y[is_flank])
    stack = MicrographStack(np.ones((1, 25, 25)), axis, axis, instrument, n_rays=1.0)
    found = make_predictor(stack, 4_000_000, border="free")(height(x, y), normals)
    assert found.surroundings is not None
    falling = (found.multiple - found.surroundings)[0, is_flank]
    assert falling.sum() / traced.mean[1:, 0].sum() == pytest.approx(1.0, abs=0.03)


def test_waves_go_on_along_their_contours():
    """Oblique waves, 6 of 25 pixels beyond each border, the corners apart: right to 0.3 of their deviation (0.2).

    Rejects a plain mirror image, which bends every crest at the border: wrong by more than the whole deviation.
    """

    def height(x, y):
        return 60.0 * np.sin(2.0 * np.pi * (0.8 * x + 0.6 * y) / 400.0)

    reach, pitch = 6, 20.0
    inner, outer = (pitch * np.arange(-n, n + 1) for n in (20, 20 + reach))
    z, true = (height(*np.meshgrid(axis, axis)) for axis in (inner, outer))
    ring = np.zeros_like(true, bool)
    ring[reach + 4 : -reach - 4, :reach] = ring[:reach, reach + 4 : -reach - 4] = True
    ring |= ring[::-1, ::-1]
    found = mirror_border(z, (pitch, pitch), float(z.min()), reach)
    plain = np.pad(z, reach, mode="reflect")
    assert np.sqrt(np.mean((found - true)[ring] ** 2)) < 0.3 * true.std()
    assert np.sqrt(np.mean((plain - true)[ring] ** 2)) > true.std()


def random_relief(n: int, length: float, seed: int) -> np.ndarray:
    """Draw a stationary Gaussian surface of Gaussian autocorrelation, 30 um rms [n, n]; `length` in pixels."""
    white = np.random.default_rng(seed).standard_normal((n + 60, n + 60))
    z = gaussian_filter(white, length)[30:-30, 30:-30]
    return 30.0 * z / z.std()


def test_rough_relief_is_predicted_and_waves_that_graze_the_border_are():
    """Beyond the border, 4 pixels far: nearer to the truth than a mirror image, and never out of the heights' range.

    Rough relief, correlated over 8 pixels (20 draws of 41 x 41): the mean squared error is below 0.4 of the variance,
    that of the mirror image above it times 1.5. Waves 15 degrees off the columns: whose contours all but graze the
    border, which the mirror image folds there. Rejects a correlation of the wrong axis or sign.
    """
    reach, errors = 4, []
    for seed in range(20):
        true = random_relief(41 + 2 * reach, 8.0 / np.sqrt(2.0), seed)
        inside = true[reach:-reach, reach:-reach]
        mirrored = mirror_border(inside, (20.0, 20.0), float(inside.min()), reach)
        predicted = predict_border(inside, reach)
        assert predicted.min() >= inside.min() and predicted.max() <= inside.max()
        assert np.array_equal(predicted[reach:-reach, reach:-reach], inside)
        errors.append([np.mean((found - true) ** 2) / true.var() for found in (predicted, mirrored)])
    predicted, mirrored = np.mean(errors, axis=0)
    assert predicted < 0.4 and mirrored > 1.5 * predicted
    x, y = np.meshgrid(*(np.arange(-reach, 61 + reach),) * 2)
    true = 50.0 * np.sin(2.0 * np.pi * (np.cos(0.26) * x + np.sin(0.26) * y) / 20.0 + 1.0)
    inside = true[reach:-reach, reach:-reach]
    assert np.mean((predict_border(inside, reach) - true) ** 2) < 0.03 * true.var()
    assert np.mean((mirror_border(inside, (20.0, 20.0), float(inside.min()), reach) - true) ** 2) > 0.1 * true.var()


@pytest.mark.parametrize("seed", range(8))
def test_waves_of_few_periods_go_on_half_an_image_far(seed):
    """One to three periods of a wave with a harmonic, any direction, 2 % noise, 20 pixels beyond 41: right to 8 % rms.

    Rejects the prediction from the autocorrelation, in which waves fade: wrong by more than a fifth in every draw.
    """
    rng, n, reach = np.random.default_rng(seed), 41, 20
    x, y = np.meshgrid(*(np.arange(-reach, n + reach),) * 2)
    angle, periods = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.0, 3.0)
    phase = 2.0 * np.pi * periods / n * (np.cos(angle) * x + np.sin(angle) * y) + rng.uniform(0.0, 6.0)
    true = 100.0 * np.sin(phase) + 20.0 * np.sin(2.0 * phase + 1.0)
    inside = (true + 2.0 * rng.standard_normal(true.shape))[reach:-reach, reach:-reach]
    found = continue_border(inside, (20.0, 20.0), float(inside.min()), reach)
    assert np.array_equal(found, continue_waves(inside, reach))
    assert np.array_equal(found[reach:-reach, reach:-reach], inside)
    assert found.min() >= inside.min() and found.max() <= inside.max()
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.08 * true.std()
    assert np.sqrt(np.mean((predict_border(inside, reach) - true) ** 2)) > 0.2 * true.std()


def test_what_predicts_the_margin_better_goes_on():
    """A terrace that a wall across the image bounds is mirrored, as it was; an image of a few rows is, too; a plane
    without relief stays."""
    step = np.where(np.arange(40) > 22, 100.0, 0.0) * np.ones((40, 1))
    assert np.array_equal(continue_border(step, (1.0, 1.0), 0.0, 8), mirror_border(step, (1.0, 1.0), 0.0, 8))
    few = random_relief(7, 3.0, 1)
    assert np.array_equal(continue_border(few, (1.0, 1.0), 0.0, 3), mirror_border(few, (1.0, 1.0), 0.0, 3))
    for way in (predict_border, continue_waves):
        assert np.array_equal(way(np.full((9, 9), 3.0), 2), np.full((13, 13), 3.0))


def test_a_grid_runs_out_to_the_ground_and_a_terrace_goes_on():
    """A flank of 1 in 2 falls its last 50 um in 100 um; a ground's bump of 5 um, at 1 in 5; a terrace stays as high."""
    x, y = np.meshgrid(np.arange(40) * 10.0, np.arange(40) * 10.0)
    height = np.clip(245.0 - 0.5 * x, 50.0, 200.0)  # a terrace to x = 90 um, then a flank
    height[15:25, 20:] = 0.0
    height[20, 20:] = 5.0
    around_x, around_y, around_z = extend_border(x, y, height, 0.0, 5000.0)
    assert around_x.shape == around_y.shape == around_z.shape == (44, 44)
    flank, ground, bump, terrace = 40, 20, 22, 5  # rows, and a column, of the wider grid
    assert np.allclose(around_x[flank, -2:], [390.0 + 100.0, 5000.0]) and np.allclose(around_z[flank, -2:], 0.0)
    assert np.allclose(around_x[[ground, bump], -2], [400.0, 415.0]) and np.allclose(around_z[[ground, bump], -2:], 0.0)
    assert np.allclose(around_z[flank, :2], 200.0) and np.allclose(around_z[-2:, terrace], 200.0)
    assert np.allclose(np.abs(around_x[:, [0, -1]]), 5000.0) and np.allclose(np.abs(around_y[[0, -1]]), 5000.0)
    assert np.all(np.diff(around_x, axis=1) > 0) and np.all(np.diff(around_y, axis=0) > 0)
