"""The rounds of the fit: they come to rest, and what is lagged follows the relief where its border is free."""

import jax
import numpy as np
import pytest

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.readout import ScanOrder
from helio_jax.forward.render import render_single
from helio_jax.inverse.convergence import aitken, left_to_go
from helio_jax.inverse.fit import fit_heights
from helio_jax.inverse.problem import LEVEL_STEP, SCALE_STEP, TILT_STEP, Refiner
from helio_jax.inverse.residuals import Prediction, Surface
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings

SHAPE, PITCH = (24, 20), 30.0


@pytest.mark.parametrize("factor", [0.3, 0.6, 0.85])
def test_how_far_rounds_that_creep_have_to_go(factor):
    """What is left of a geometric series. Catches the last change taken for what is left (0.85: 5.7 changes to go)."""
    x = np.random.default_rng(1).normal(size=SHAPE)
    before = (factor - 1.0) * x
    x = x + before
    change = (factor - 1.0) * x
    left = left_to_go([np.std(before), np.std(change)], aitken(before, change))
    assert left == pytest.approx(factor / (1.0 - factor))
    assert np.allclose(x + (1.0 + left) * change, 0.0, atol=1e-9)


def test_rounds_that_tremble_are_a_change_off():
    """Fits that jump about their result, by predictions that are noisy: off by a change at most, not by nine.

    20,000 pixels: the change exceeds what the last fit is off by sqrt(2), to 1 %. Catches sizes of changes read as a
    geometric series: equal ones would be off by nine times their size.
    """
    fits = np.random.default_rng(1).normal(size=(3, 100, 200))
    before, change = np.diff(fits, axis=0)
    left = left_to_go([np.std(before), np.std(change)], aitken(before, change))
    assert left == 1.0
    assert np.std(left * change) == pytest.approx(np.sqrt(2.0) * np.std(fits[-1]), rel=0.05)


@pytest.fixture(autouse=True)
def _double():
    """The fit's own precision."""
    with jax.enable_x64(True):
        yield


def bump():
    """Return a bump of 100 um, and its positions."""
    x, y = np.meshgrid(*((np.arange(n) - 0.5 * (n - 1)) * PITCH for n in SHAPE[::-1]))
    height = 100.0 * np.exp(-(x**2 + y**2) / 150.0**2)
    return Surface(height, -2.0 * x / 150.0**2 * height, -2.0 * y / 150.0**2 * height), (x, y)


def follower(bshem):
    """Return a fit with a free border about a bump, and a prediction that follows the heights, linearly."""
    surface, (x, y) = bump()
    geometry = SpotGeometry(bshem)
    signal = geometry.form_factor(surface.height)[:, 2]
    settings = ReconstructSettings(border="free")
    fit = Refiner(signal, (0.003 * signal) ** 2, geometry, PITCH, PITCH, surface, settings)
    weights = np.random.default_rng(2).normal(size=SHAPE) / np.prod(SHAPE)

    def predict(at, normals):
        return Prediction(signal * (0.2 + 1e-3 * np.sum(weights * at) + 1e-4 * at), np.zeros((3, 3, *SHAPE)))

    fit.predict(predict)
    return fit, predict, (x, y)


def expected(fit, surface, predict=None):
    """Return the data that a fit expects of a surface, with its own prediction or one made there."""
    moved = fit.simulated()
    moved.surface = surface
    if predict is not None:
        moved.adopt(predict(surface.height, surface.normals((0.0, 0.0))), surface)
    return moved.simulated().data


def test_predictions_follow_the_relief(bshem):
    """Lowered, flattened and tilted, all at once: the data expected without a new prediction are those with one.

    Multiple scattering is linear in the heights here, and noise small, which changes the mean of what is curved.
    Catches a mode that is missing or of the wrong sign or size: without following they are off by 5 % of the change.
    """
    fit, predict, (x, y) = follower(bshem)
    height, slope_x, slope_y = fit.surface
    lower, flatter, tilt = 0.7 * LEVEL_STEP * bshem.sample_distance, 1.5 * SCALE_STEP, (TILT_STEP, -0.5 * TILT_STEP)
    changed = Surface(
        height - lower - flatter * (height - height.mean()) + tilt[0] * x + tilt[1] * y,
        (1.0 - flatter) * slope_x + tilt[0],
        (1.0 - flatter) * slope_y + tilt[1],
    )
    held, anew = expected(fit, changed), expected(fit, changed, predict)
    fit.follow_modes(predict)
    followed = expected(fit, changed)
    missing = np.sqrt(np.mean((held - anew) ** 2))
    assert missing > 0.003 * anew.mean()
    assert np.sqrt(np.mean((followed - anew) ** 2)) < 0.05 * missing


def test_other_changes_are_not_followed(bshem):
    """A change of the surface that is orthogonal to all modes leaves the prediction. Catches own-pixel sums."""
    fit, predict, _ = follower(bshem)
    fit.follow_modes(predict)
    bumpy = np.random.default_rng(4).normal(size=SHAPE)
    modes = fit.mode.reshape(4, -1)
    bumpy -= (np.linalg.pinv(modes) @ (modes @ bumpy.ravel())).reshape(SHAPE)
    changed = fit.surface._replace(height=fit.surface.height + bumpy)
    followed = expected(fit, changed)
    fit.mode_response[:] = 0.0
    assert followed == pytest.approx(expected(fit, changed), rel=1e-12)


def nothing_more(height, normals, *about):
    """A prediction of single scattering without masks."""
    return Prediction(np.zeros((3, *SHAPE)), np.zeros((3, 3, *SHAPE)))


def fitted(bshem, drift=0.0, order=ScanOrder(), border="flat", noise=0.01, stated=None, **refine):
    """Fit what a bump scatters once, and a drift of its background, by the instrument or as it is stated to be."""
    surface, _ = bump()
    signal = np.asarray(single_scattering(SpotGeometry(bshem), surface))
    variance = (noise * signal.mean()) ** 2 * np.ones_like(signal)
    settings = ReconstructSettings(border=border, refine=RefineSettings(**{"samples": 64, "bias_pairs": 0} | refine))
    data = signal + drift * signal.mean()
    geometry = SpotGeometry(stated or bshem)
    return fit_heights(data, variance, geometry, PITCH, PITCH, surface, settings, nothing_more, order=order)


def single_scattering(geometry, surface):
    """Return what single scattering sends into the apertures [detector, y, x]."""
    normals = np.moveaxis(surface.normals(geometry.instrument.beam_shift), -1, 0)
    return render_single(surface.height, normals, np.zeros((3, 3, *SHAPE)), geometry)


def test_each_scan_drifts_in_its_own_time(bshem):
    """Backgrounds that drift by 10 % in the times of three turned scans: heights to 0.5 um, as they are without drift.

    Catches times along other directions, as of scans that are turned the other way, which leave 5 times as much.
    """
    surface, (x, y) = bump()
    turns = np.radians([10.0, 130.0, 250.0])[:, None, None]
    time = (np.cos(turns) * x + np.sin(turns) * y) / 450.0
    drift = np.array([0.1, -0.1, 0.07])[:, None, None] * time + 0.05 * (1.5 * time**2 - 0.5)
    unknown = {"drift_std": 0.1, "drift_degrees": (3, 3), "max_rounds": 2, "samples": 0}
    own, other = (
        np.std(fitted(bshem, drift, ScanOrder(0, t), **unknown).surface.height - surface.height)
        for t in (time, (np.sin(turns) * x - np.cos(turns) * y) / 450.0)
    )
    assert own < 0.5 and other > 5.0 * own, (own, other)


def test_the_distance_to_a_held_level_is_found(bshem):
    """A plate stated 150 um too far away, the mean height held: it stays, and distance and relief are found.

    The distance to 4 of its standard deviations, of which noise leaves less than 15 um, the relief to 0.5 um. Catches a
    level that is not held, a distance that is taken for known (the relief is then off by 2 um), and one whose
    prior deviation is not the one given.
    """
    surface, _ = bump()
    told = {"border": "free", "noise": 1e-3, "max_rounds": 6, "gain_std": 0.02, "offset_std": 0.01}
    stated = bshem.at_distance(bshem.sample_distance + 150.0)
    found, known = (fitted(bshem, stated=stated, level_std_um=std, **told) for std in (300.0, 1e-3))
    assert found.surface.height.mean() == pytest.approx(surface.height.mean(), abs=0.5)
    column = found.posterior.names.index("distance[0]")
    std = 300.0 * np.sqrt(found.posterior.instrument_covariance[column, column])
    assert std < 15.0
    assert found.instrument.sample_distance == pytest.approx(bshem.sample_distance, abs=4.0 * std)
    off, kept = (np.std(fit.surface.height - surface.height) for fit in (found, known))
    assert off < 0.5 and kept > 1.5, (off, kept)
