"""A geometry that is stated as exact and is wrong: what the data say of it, by closed form, by refit and in a scan."""

from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.alignment.rigid import Rigid
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import surface_of_heights
from helio_jax.inverse import explanations, instrument_choice
from helio_jax.inverse.anchor_settings import AnchorSettings
from helio_jax.inverse.anchoring import with_anchors
from helio_jax.inverse.fit import Fit, fit_heights, with_posterior
from helio_jax.inverse.further_images import with_further_images
from helio_jax.inverse.geometry_change import LIKELY, largest_changes
from helio_jax.inverse.geometry_score import (
    USUAL_DEG,
    _log_bayes,
    geometry_warnings,
    score_geometry,
    surface_misfit,
    usual_uncertainty,
)
from helio_jax.inverse.linear import signal_of
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.workflows.next_scan import _joint, _like
from helio_jax.workflows.several_scans import JoinedScans
from tests.predictions import nothing_traced

SIDE = 25
PITCH = 40.0
DOSE = 2e6


def hill_and_raster() -> tuple[np.ndarray, Raster]:
    """Two hills of different heights on a flat border, 25 x 25."""
    x = PITCH * np.arange(SIDE)
    gx, gy = np.meshgrid(x - x.mean(), x - x.mean())
    height = 150.0 * np.exp(-((gx + 120.0) ** 2 + gy**2) / 2 / 110.0**2)
    return height - 90.0 * np.exp(-((gx - 180.0) ** 2 + (gy - 120.0) ** 2) / 2 / 90.0**2), Raster(x=x, y=x)


def recorded(instrument: hx.Instrument, truth: hx.Instrument, seed: int) -> MicrographStack:
    """Record by one instrument, without masks and multiple scattering, what another one is stated for."""
    height, raster = hill_and_raster()
    signal = np.asarray(hx.render(height, Optics.of(truth), raster, corrections="none"))
    counts = np.random.default_rng(seed).poisson(DOSE * signal).astype(float)
    variance = np.maximum(counts, 1.0)
    return MicrographStack(counts, raster.x, raster.y, instrument, variance=variance, n_rays=DOSE, noise="poisson")


def fitted(instrument: hx.Instrument, truth: hx.Instrument, seed: int) -> Fit:
    """Fit by one instrument the micrographs that another one records."""
    height, raster = hill_and_raster()
    start = surface_of_heights(0.9 * height, raster)
    data = signal_of(recorded(instrument, truth, seed))
    return fit_heights(FitProblem.of(*data, instrument, raster, start, ReconstructSettings()), start, nothing_traced)


@pytest.mark.parametrize("seed", range(3))
def test_right_geometry_is_not_doubted(bshem, seed):
    """Estimates within 4 standard deviations, Bayes factor below 1. False alarms: 1 in 700 by the former."""
    score = score_geometry(fitted(bshem, bshem, seed))
    assert score is not None and score.log_bayes < 0.0
    for value, std, _ in score.values.values():
        assert abs(value) < 4.0 * std


def test_wrong_polar_angle_is_found_and_named(bshem):
    """One aperture 3 deg off: it is the change that is named first, within 3 standard deviations of the truth.

    A fit with the usual uncertainty gives the same within two standard deviations: the score is its first step.
    """
    aim = np.zeros((3, 2))
    aim[1, 0] = np.radians(3.0)
    fit = fitted(bshem, bshem.moved(aim, 0.0), 1)
    score = score_geometry(fit)
    assert score is not None and score.is_likely
    name = f"polar {bshem.detector_names[1]}"
    value, std, unit = score.values[name]
    assert unit == "deg" and abs(value - 3.0) < 3.0 * std and std < 0.5 * USUAL_DEG
    assert largest_changes(score.values).startswith(name)

    p = fit.problem
    free = FitProblem.of(
        p.signal, p.variance, bshem, p.raster, fit.surface, p.reconstruct_settings, uncertainty=usual_uncertainty(p)
    )
    refit = fit_heights(free, fit.state.surface, nothing_traced)
    moved = np.degrees(free.moves(refit.parameters)[1, 1])
    assert abs(moved - value) < 2.0 * std


def test_an_uncertain_geometry_is_not_tested(bshem):
    """Directions that the file states as uncertain are unknowns of the fit already."""
    fit = fitted(bshem, bshem, 0)
    geometry = replace(fit.problem.geometry, covariance=1e-4 * np.eye(7))
    assert score_geometry(replace(fit, problem=replace(fit.problem, geometry=geometry))) is None


@pytest.mark.parametrize("turn", (3.0, -3.0))
def test_a_wrong_geometry_is_fitted_and_the_warning_names_it(bshem, turn):
    """Heights of a whole reconstruction, against one by the right instrument: within 3 stated standard deviations.

    By the instrument as stated, or with the patches of another albedo that a wrong one seems to show, the hill is 4 to
    5 % off. The error bars (2.5 %) contain what background instead of a part of the turn would change; without, they
    are 1 %.
    """
    aim = np.zeros((3, 2))
    aim[:, 0] = np.radians(turn)
    wrong, right = (
        reconstruct_stack(recorded(bshem, truth, 2), ReconstructSettings(), lambda _: nothing_traced)
        for truth in (bshem.moved(aim, 0.0), bshem)
    )
    warning = next(w for w in wrong.warnings if w.startswith("the geometry is not what the instrument file states"))
    assert f"polar {bshem.detector_names[1]} {turn:+.0f}"[:-1] in warning and "[uncertainty]" in warning
    assert wrong.provenance["geometry_score"]["log_bayes"] > LIKELY
    top = np.unravel_index(np.argmax(right.height), right.height.shape)
    found, std = wrong.spread(lambda z: float(z[top] - np.median(z[0])))
    expected, _ = right.spread(lambda z: float(z[top] - np.median(z[0])))
    assert abs(found - expected) < min(3.0 * std, 0.02 * expected) and std < 0.03 * expected

    assert right.provenance["geometry_score"] is None
    assert not any("geometry" in w for w in right.warnings)


def with_background(stack: MicrographStack, shares: tuple[float, ...]) -> MicrographStack:
    """Add background to a stack, in shares of each detector's median."""
    median = np.median(stack.counts, axis=(1, 2), keepdims=True)
    counts = stack.counts + np.array(shares)[:, None, None] * median
    return stack.replace(counts=counts, variance=np.maximum(counts, 1.0))


@pytest.mark.parametrize(
    "shares", [(0.1,) * 3, (0.2,) * 3, (0.2, 0.1, 0.15), (0.15, 0.15, 0.0), (0.0, 0.2, 0.0), (0.0, -0.15, 0.0)]
)
def test_background_is_not_taken_for_a_geometry_with_narrow_error_bars(bshem, shares):
    """Background that was not subtracted, or too much: the hill within 2.5 stated standard deviations and 2 %.

    By the geometry alone, the first two are 4.7 and 8.4 % too low, by 2 and 5 standard deviations; with geometry and
    background together, which the least misfit asks for, the third and fourth 3 %. From a photometric solution that
    takes the level of the border for slopes, the last two came out 180 % too high and 87 % too low.
    """
    wrong, right = (
        reconstruct_stack(
            with_background(recorded(bshem, bshem, 2), of), ReconstructSettings(), lambda _: nothing_traced
        )
        for of in (shares, (0.0,) * 3)
    )
    top = np.unravel_index(np.argmax(right.height), right.height.shape)
    found, std = wrong.spread(lambda z: float(z[top] - np.median(z[0])))
    expected, _ = right.spread(lambda z: float(z[top] - np.median(z[0])))
    assert abs(found - expected) < min(2.5 * std, 0.02 * expected)
    assert any("background" in w or "deviates more from what is stated" in w for w in wrong.warnings)


def test_what_is_known_of_the_distance_stays(bshem):
    """A standard deviation from [covariance], too, which the table [uncertainty] does not state."""
    problem = fitted(bshem, bshem, 0).problem
    known = replace(problem.geometry, covariance=np.diag([20.0**2, *np.zeros(6)]))
    assert usual_uncertainty(replace(problem, geometry=known)).sample_distance_um == pytest.approx(20.0)
    assert usual_uncertainty(problem).sample_distance_um == pytest.approx(0.05 * bshem.sample_distance)


def test_interrupted_during_the_test_the_fit_is_kept(bshem, monkeypatch):
    """Ctrl-C after the fit, while its geometry is tested, loses nothing but the test."""
    monkeypatch.setattr(instrument_choice, "score_geometry", mock.Mock(side_effect=KeyboardInterrupt))
    rec = reconstruct_stack(recorded(bshem, bshem, 0), ReconstructSettings(), lambda _: nothing_traced)
    assert rec.status.startswith("interrupted while another instrument was tried")
    assert rec.height.max() > 100.0


@pytest.mark.parametrize("noise", (0.1, 1.0))
def test_bayes_factor_in_closed_form(noise):
    """One number, measured as d with the standard deviation s: log BF = (d^2 / s^2 / (1 + s^2) - log(1 + 1 / s^2)) / 2.

    Wakefield (2009), eq. 2. With errors that agree between pixels, S > C, the same with the larger s.
    """
    d, s2 = 0.7, noise**2
    c = s2 / (1.0 + s2)
    found = _log_bayes(np.array([d * (1.0 - c)]), np.array([[c]]), np.array([[c]]))
    # C - C^2 is the variance of the drawn estimate, (1 - C)^2 s^2
    assert found == pytest.approx(0.5 * (d**2 / s2 / (1.0 + s2) - np.log1p(1.0 / s2)))
    wide = 2.5 * s2
    spread = c + (wide - s2) * (1.0 - c) ** 2
    found = _log_bayes(np.array([d * (1.0 - c)]), np.array([[c]]), np.array([[spread]]))
    assert found == pytest.approx(0.5 * (d**2 / wide / (1.0 + wide) - np.log1p(1.0 / wide)))


def test_what_the_data_do_not_tell_decides_nothing():
    """A second number of which next to nothing is known changes the Bayes factor by less than 0.01."""
    one = _log_bayes(np.array([0.5]), np.array([[0.01]]), np.array([[0.01]]))
    both = np.diag([0.01, 1.0 - 1e-9])
    assert _log_bayes(np.array([0.5, 1e-6]), both, both) == pytest.approx(one, abs=0.01)
    assert LIKELY > 1.0


def test_error_bars_hold_a_geometry_that_is_not_fitted(bshem, monkeypatch):
    """All azimuths 6 deg off, and no fit with another geometry kept: 2 standard deviations hold 90 % of the heights.

    Against those by the right instrument; without what another geometry would change, they hold half of them.
    """
    monkeypatch.setattr(instrument_choice, "is_plausible", lambda *_: False)
    aim = np.zeros((3, 2))
    aim[:, 1] = np.radians(6.0)
    wrong, right = (
        reconstruct_stack(recorded(bshem, truth, 2), ReconstructSettings(), lambda _: nothing_traced)
        for truth in (bshem.moved(aim, 0.0), bshem)
    )
    assert any("no fit with an uncertain geometry was kept" in w for w in wrong.warnings)
    error = np.abs(wrong.height - right.height)[wrong.is_valid]
    assert np.mean(error < 2.0 * wrong.height_std[wrong.is_valid]) > 0.9


@pytest.mark.parametrize("factor", [0.5, -2.0])
def test_error_bars_count_one_doubt_once(bshem, factor):
    """What the test asks for and a fitted rival may be the same change of geometry: the larger one alone is contained.

    Both together would be counted as independent: twice the variance where they agree.
    """
    fit = fitted(bshem, bshem.moved(np.radians([[3.0, 0.0]] * 3), 0.0), 0)
    score = score_geometry(fit)
    rival = factor * score.height_change
    neither, both = (
        with_posterior(one).posterior.common_modes
        for one in (fit, replace(fit, geometry_score=score, rival_change=rival))
    )
    assert len(both) == len(neither) + 1
    np.testing.assert_array_equal(both[-1], score.height_change if abs(factor) < 1.0 else rival)


def test_an_anchor_settles_which_instrument_is_right(bshem):
    """A known top, which is that of the fit: the other instrument's heights go through it, and nothing is warned of.

    Without it the warning names the difference, which the error bars contain.
    """
    fit = fitted(bshem, bshem, 0)
    rival = replace(fit, rival_change=0.6 * fit.surface.height)
    (warned,) = geometry_warnings(with_anchors(rival).fit)
    assert f"{0.6 * np.abs(fit.surface.height).max():.3g} um; the error bars contain" in warned
    x, y = np.meshgrid(fit.problem.raster.x, fit.problem.raster.y)
    top = np.unravel_index(np.argmax(fit.surface.height), x.shape)
    height = float(fit.surface.height[top])
    at = (float(p[top]) - height * shift for p, shift in zip((x, y), bshem.beam_shift, strict=True))
    known = {"at_um": tuple(at), "height_um": height, "std_um": 1.0}
    settings = fit.problem.reconstruct_settings.changed(anchor=(AnchorSettings(**known, radius_um=20.0),))
    anchored = with_anchors(replace(rival, problem=replace(fit.problem, reconstruct_settings=settings))).fit
    assert abs(anchored.surface.height[top] - height) < 1.0
    assert np.abs(anchored.rival_change[top]) < 2.0 and not geometry_warnings(anchored)


def test_the_error_bars_of_an_anchored_fit_are_said_to_contain_what_they_do(bshem):
    """An anchor can make the smaller one of two changes the larger one; the error bars still contain the other.

    Catches the choice made anew after the anchors.
    """
    fit = fitted(bshem, bshem, 0)
    bump = np.zeros_like(fit.surface.height)
    bump[3, 3] = 5.0
    score = score_geometry(fitted(bshem, bshem.moved(np.radians([[3.0, 0.0]] * 3), 0.0), 0))
    both = with_posterior(
        replace(fit, geometry_score=replace(score, height_change=20.0 * fit.surface.height), rival_change=bump)
    )
    assert not both.is_rival_contained
    after = replace(both, geometry_score=replace(both.geometry_score, height_change=0.0 * bump))
    assert after.instrument_change is bump
    assert all("contain the difference" not in w for w in geometry_warnings(after))


def test_a_rival_is_named_where_the_data_miss_its_largest_change(bshem):
    """A hole in the data at the top, where the error bars are wide anyway: the warning is of the heights around it.

    Catches a comparison at the pixel of the largest change alone.
    """
    fit = with_posterior(replace(fitted(bshem, bshem, 0), rival_change=None))
    rival = 0.2 * fit.surface.height
    top = np.unravel_index(np.argmax(rival), rival.shape)
    wide = fit.posterior.height_std.copy()
    wide[top] = 10.0 * rival[top]
    about = replace(fit, rival_change=rival, is_rival_contained=True)
    posterior = SimpleNamespace(height_std=np.where(wide < rival, np.hypot(wide, rival), wide))
    (warned,) = geometry_warnings(replace(about, posterior=posterior))
    assert "the error bars contain" in warned and f"{rival[top]:.3g} um" not in warned


def test_misfit_grows_with_data_that_are_far_off(bshem):
    """A tenth of the data farther and farther off: each fit explains less. Rejects squares of weighted residuals."""
    fit = fitted(bshem, bshem, 0)
    off = np.random.default_rng(3).random(fit.residuals.shape) < 0.1
    misfits = [surface_misfit(replace(fit, residuals=np.where(off, k, fit.residuals))) for k in (0, 4, 8, 16)]
    assert misfits[0] < misfits[1] < misfits[2] <= misfits[3]


def test_further_images_keep_a_geometry_that_was_fitted(bshem):
    """All polar angles 3 deg off, and an image by the same plate turned by 90 deg that is not recorded yet.

    Posed with it, the recorded images are explained as well as by the fit, and each aperture has the same change in
    both. By the stated geometry the squared residuals are 300 times as large.
    """
    bshem = bshem.model_copy(update={"beam": bshem.beam.changed(incidence_deg=0.0)})
    aim = np.zeros((3, 2))
    aim[:, 0] = np.radians(3.0)
    here = Rigid(0.0, (0.0, 0.0))
    present = recorded(bshem, bshem.moved(aim, 0.0), 2).replace(dwell=1.0)
    stack = JoinedScans.at(MicrographSet((present,)), (here,), (0.0,), None).stack
    fit = explanations.explain(stack, ReconstructSettings(), lambda _: nothing_traced, None).fit
    assert fit.is_geometry_fitted

    joint = _joint(stack, [present], [_like(present, 90.0)], (here,))
    seconds = np.ones((6, SIDE, SIDE))
    predict = lambda height, *_, **__: Corrections.none((6, *height.shape))  # noqa: E731
    problem, state = with_further_images(fit, joint, predict, seconds, np.arange(3))
    assert np.nanmean(state.residuals[:3] ** 2) < 1.2 * np.mean(fit.residuals**2)
    moves = problem.moves(state.parameters)
    np.testing.assert_allclose(moves[:, 3:], moves[:, :3], atol=1e-12)
    assert np.degrees(moves[1, :3]) == pytest.approx(3.0, abs=0.7)
