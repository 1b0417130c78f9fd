"""Scattering laws as unknowns of the fit: recovered from rendered and traced micrographs, error bars, refusals."""

import math
from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from pydantic import ValidationError

import helio_jax as hx
from helio_jax.campaign import CampaignLaw
from helio_jax.errors import GuardError
from helio_jax.forward.laws import PowerLaw, level_ratio
from helio_jax.forward.render import Corrections
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.inverse.explanations import explain
from helio_jax.inverse.fit import Fit, fit_heights, with_posterior
from helio_jax.inverse.instrument_report import describe_instrument
from helio_jax.inverse.law_prior import (
    cosine_probability,
    law_prior,
    numbers_of,
    with_level_of_cosine_law,
    with_level_of_law,
)
from helio_jax.inverse.linear import signal_of
from helio_jax.inverse.parameters import LawPrior, smooth_albedo
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.state import FitState, update_corrections
from helio_jax.inverse.steps import expected
from helio_jax.micrograph import Calibration, MicrographStack
from helio_jax.workflows.pipeline import record

N, PITCH = 21, 48.0
SNR = 200.0
INSTRUMENT = Instrument(
    beam=Beam(incidence_deg=20.0),
    plate=Plate(working_distance_um=4000.0, sample_distance_um=4200.0),
    detector=tuple(Detector(name=f"d{k}", polar_deg=38.0, azimuth_deg=72.0 * k, half_angle_deg=8.0) for k in range(5)),
)
RASTER = hx.Raster.regular((N, N), PITCH)
TRUE = {
    "power": (hx.PowerLaw(0.3), [0.3]),
    "broad_specular": (hx.LobeLaw(0.15, 30.0), [0.15, 30.0]),
    "rough_diffuse": (hx.RoughLaw(20.0 / 90.0), [20.0 / 90.0]),
    "monotone": (hx.MonotoneLaw(np.full(7, np.log(1.2))), [np.log(1.2)] * 7),
}


def hills() -> hx.Surface:
    """Three smooth hills of up to 45 deg, which end inside the image."""
    x, y = np.meshgrid(RASTER.x, RASTER.y)
    height, slope_x, slope_y = np.zeros((3, N, N))
    for cx, cy, width, top in ((-150.0, -120.0, 90.0, 130.0), (170.0, 60.0, 80.0, 110.0), (-60.0, 190.0, 70.0, 80.0)):
        hill = top * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / width**2)
        height, slope_x, slope_y = (
            height + hill,
            slope_x - hill * (x - cx) / width**2,
            slope_y - hill * (y - cy) / width**2,
        )
    return hx.Surface(height, slope_x, slope_y)


@cache
def fitted(law: str, kind: str = "cosine", stated: CampaignLaw | None = None) -> Fit:
    """Fit noisy micrographs of the hills, rendered by a true law, with numbers of another one unknown."""
    surface, rng, true = hills(), np.random.default_rng(1), TRUE[kind][0] if kind in TRUE else None
    signal = np.asarray(hx.render(surface, hx.Optics.of(INSTRUMENT), RASTER, corrections="none", law=true))
    std = np.sqrt(signal * np.median(signal)) / SNR
    settings = ReconstructSettings(refine=RefineSettings.model_validate({"law": law}))
    data = signal + std * rng.normal(size=signal.shape)
    instrument = INSTRUMENT.model_copy(update={"law": stated})
    problem = FitProblem.of(data, std**2, instrument, RASTER, surface, settings)
    flat = hx.Surface(*np.zeros((3, N, N)))
    return with_posterior(fit_heights(problem, flat, lambda *_, **__: Corrections.none(signal.shape)))


def error(fit: Fit) -> float:
    """Root mean square error of the heights [um]."""
    return float(np.sqrt(np.mean((fit.surface.height - hills().height) ** 2)))


@pytest.mark.parametrize("kind", TRUE)
def test_law_is_recovered(kind):
    """Every number within 4 stated s.d. (false alarm below 6e-4 for all), the cosine law rejected with p < 1e-6.

    Heights by the law are better than by the cosine law, by 3 times where the law is `power` or the lobe. Rejected: a
    law whose numbers do not act on the data; one that is fixed at the prior; a value of another axis or norm.
    """
    numbers = TRUE[kind][1]
    fit = fitted(kind, kind)
    found = describe_instrument(fit)
    prior = fit.problem.priors.law
    for number, exact in zip(numbers_of(prior), numbers, strict=True):
        value, std, prior_std, _ = found["values"][number.name]
        assert abs(value - exact) < 4.0 * std, number.name
        assert std < 1.01 * prior_std
    assert found["law"]["kind"] == kind and found["law"]["cosine_probability"] < 1e-6
    ratio = error(fit) / error(fitted("cosine", kind))
    assert ratio < (1.0 / 3.0 if kind in ("power", "broad_specular") else 0.8)


@pytest.mark.parametrize("kind", TRUE)
def test_cosine_micrographs_give_the_cosine_law(kind):
    """The cosine law is not rejected (p > 1e-4, the false alarm), and the law is it within 2 % at 20 to 60 deg.

    Error bars of the heights grow: they contain the law. Rejects a fit in which edges or priors favour another law.
    """
    fit, known = fitted(kind), fitted("cosine")
    assert describe_instrument(fit)["law"]["cosine_probability"] > 1e-4
    cos = np.cos(np.radians([20.0, 30.0, 40.0, 50.0, 60.0]))
    law = fit.problem.law_at(fit.parameters)
    assert law is not None
    with jax.enable_x64(True):
        value = np.asarray(law.relative(1.0, cos, -cos))
    assert np.abs(value / value.mean() - 1.0).max() < 0.02
    assert fit.posterior is not None and known.posterior is not None
    assert np.mean(fit.posterior.height_std**2) > np.mean(known.posterior.height_std**2)


def test_law_of_the_instrument_file_is_held():
    """It is taken unless the settings name a law: heights of cos^1.3 data become three times better by m = 0.27.

    m is not fitted. Catches a law that is read and not used, one that is fitted, and one that a named law does not
    replace.
    """
    stated = CampaignLaw(exponent=0.27, std=0.05)
    fit, blind = fitted("as_stated", "power", stated), fitted("cosine", "power", stated)
    assert error(fit) < error(blind) / 3.0
    assert blind.parameters.law.size == 0 and fitted("as_stated").parameters.law.size == 0
    law = fit.problem.law_at(fit.parameters)
    assert isinstance(law, hx.PowerLaw) and float(law.exponent) == pytest.approx(0.27, abs=1e-4)
    about = describe_instrument(fit)
    assert about["law"] == {"kind": "as_stated", "exponent": 0.27, "std": 0.05}
    assert "exponent of the law" not in about["values"]
    assert [n.mean for n in numbers_of(law_prior(RefineSettings(law="power"), stated))] == [0.0]


def test_error_bars_contain_a_law_that_is_held():
    """Added variance of the hills' scale: what m 0.05 larger does to it, squared, to 30 % (32 samples: 13 %).

    Rejects bars of a law that is taken for known, and of one that the data are taken to determine.
    """
    narrow, wide = (fitted("as_stated", "power", CampaignLaw(exponent=0.27, std=std)) for std in (1e-4, 0.1))
    moved = fitted("as_stated", "power", CampaignLaw(exponent=0.32, std=1e-4))
    true = hills().height
    weight = true / np.sum(true**2)
    assert narrow.posterior is not None and wide.posterior is not None
    change = float(np.sum(weight * (moved.surface.height - narrow.surface.height))) * 0.1 / 0.05
    std = [float(np.std(np.tensordot(fit.posterior.samples, weight, 2))) for fit in (narrow, wide) if fit.posterior]
    assert math.sqrt(std[1] ** 2 - std[0] ** 2) == pytest.approx(abs(change), rel=0.3)


def test_predicted_multiple_scattering_counts_as_it_is_under_a_law():
    """Expected data are single scattering by the law and, as predicted, the multiple scattering, on steep facets, too.

    Rejects a law that also weights the slope by which multiple scattering follows the own normal: the bright faces of a
    pyramid came out 2 % too dark by m = 0.14, its height 10 % too low.
    """
    surface, optics = hills(), hx.Optics.of(INSTRUMENT)
    single = np.asarray(hx.render(surface, optics, RASTER, corrections="none", law=hx.PowerLaw(0.3)))
    multiple = 0.1 * single.mean() * (1.0 + np.random.default_rng(3).uniform(size=single.shape))
    settings = ReconstructSettings()
    instrument = INSTRUMENT.model_copy(update={"law": CampaignLaw(exponent=0.3, std=0.05)})
    problem = FitProblem.of(single + multiple, 1e-12 * single, instrument, RASTER, surface, settings)
    found = Corrections(Corrections.none(single.shape).masked, multiple)
    state = update_corrections(problem, FitState.at(problem, surface), lambda *_, **__: found)
    assert np.allclose(expected(problem, state, is_noisy=False), single + multiple, rtol=1e-4)


def test_smooth_albedo_weights_all_orders():
    """The own pixel scatters atoms of every order first: its albedo weights single and multiple scattering alike.

    Rejects an albedo of single scattering alone, by which a bright pixel beside a wall came out too dark.
    """
    surface, optics = hills(), hx.Optics.of(INSTRUMENT)
    single = np.asarray(hx.render(surface, optics, RASTER, corrections="none"))
    multiple = 0.3 * single.mean() * (1.0 + np.random.default_rng(3).uniform(size=single.shape))
    settings = ReconstructSettings(refine=RefineSettings(albedo_std=0.1, albedo_modes=3))
    problem = FitProblem.of(single + multiple, 1e-12 * single, INSTRUMENT, RASTER, surface, settings)
    found = Corrections(Corrections.none(single.shape).masked, multiple)
    state = update_corrections(problem, FitState.at(problem, surface), lambda *_, **__: found)
    modes = np.zeros((3, 3))
    modes[0, 1] = 1.0
    there = replace(state, parameters=state.parameters.replaced(albedo=modes))
    albedo = np.asarray(smooth_albedo(modes, surface.height.shape, settings.refine.albedo_std))
    assert np.ptp(albedo) > 0.1
    assert np.allclose(expected(problem, there, is_noisy=False), albedo * (single + multiple), rtol=1e-4)


def test_calibrated_substrate_has_the_level_of_the_stated_law():
    """A border brought to the cosine law's level is what a fit by cos^1.3 expects of the substrate, gains as stated.

    And what starts by the cosine law gets it back. Rejects a level that is 7 % off at the prior means.
    """
    flat, optics = hx.Surface(*np.zeros((3, N, N))), hx.Optics.of(INSTRUMENT)
    cosine, power = (
        np.asarray(hx.render(flat, optics, RASTER, corrections="none", law=law)) for law in (None, hx.PowerLaw(0.3))
    )
    instrument = INSTRUMENT.model_copy(update={"law": CampaignLaw(exponent=0.3, std=0.05)})
    about = {"n_rays": 1.0, "variance": 1e-6 * cosine, "calibration": Calibration("border")}
    stack, settings = hx.MicrographStack(cosine, RASTER.x, RASTER.y, instrument, **about), RefineSettings()
    brought = with_level_of_law(stack, settings)
    assert np.abs(power / cosine - 1.0).min() > 0.07
    assert np.allclose(brought.counts, power, rtol=1e-6)
    assert np.allclose(signal_of(brought)[1] / signal_of(stack)[1], (power / cosine) ** 2, rtol=1e-6)
    assert np.allclose(with_level_of_cosine_law(brought, settings).counts, cosine, rtol=1e-6)
    assert with_level_of_law(stack, RefineSettings(law="cosine")) is stack
    known = stack.replace(calibration=None)  # in units of a known beam
    assert with_level_of_law(known, settings) is known


def test_multiple_scattering_follows_the_law():
    """Between predictions it changes by the rate that predictions at two laws give; without a law there is no rate.

    Catches a rate per unit instead of per prior s.d., and a change that counts from the prior mean.
    """
    signal = np.ones((5, N, N))
    settings = ReconstructSettings(refine=RefineSettings(law="power", law_std=0.2))
    problem = FitProblem.of(signal, signal, INSTRUMENT, RASTER, hills(), settings)
    state = FitState.at(problem, hills())
    state = replace(state, parameters=state.parameters.replaced(law=np.array([0.5])))

    def predict(height, normals, *, law):
        nothing = Corrections.none(signal.shape)
        return Corrections(nothing.masked, 0.1 * np.exp(-2.0 * law.exponent) * signal)

    state = update_corrections(problem, state, predict)
    assert state.held.law_rate == pytest.approx([-2.0 * 0.2], rel=1e-6)
    moved = replace(state, parameters=state.parameters.replaced(law=np.array([1.0])))
    still = replace(moved, held=replace(moved.held, law_rate=np.zeros(1)))
    change = expected(problem, moved, is_noisy=False) - expected(problem, still, is_noisy=False)
    assert np.allclose(change, 0.1 * (np.exp(-0.4) - np.exp(-0.2)), rtol=1e-6)


def test_probability_of_the_cosine_law():
    """Uniform where the numbers deviate by their own errors: 5 % below 0.05 (10 000 draws, 5 s.d. are 1.1 %).

    The width of a lobe does not count. Catches a wrong number of degrees of freedom.
    """
    rng, prior = np.random.default_rng(4), law_prior(RefineSettings(law="monotone"))
    assert prior is not None
    root = 0.1 * rng.normal(size=(7, 7))
    draws = [cosine_probability(prior, root @ rng.normal(size=7), root @ root.T) for _ in range(10_000)]
    assert np.mean(np.array(draws) < 0.05) == pytest.approx(0.05, abs=0.011)
    lobe = law_prior(RefineSettings(law="broad_specular"))
    assert lobe is not None
    assert cosine_probability(lobe, np.array([0.0, 5.0]), np.eye(2)) == 1.0
    about = LawPrior(PowerLaw(0.2), PowerLaw(0.05))
    assert cosine_probability(about, np.array([-4.0]), np.eye(1)) == pytest.approx(1.0)
    assert cosine_probability(about, np.array([0.0]), np.eye(1)) == pytest.approx(6.3e-5, rel=0.01)  # 4 deviations


def test_refusals():
    """A monotone law from three images, a prior without a law, and radiosity with a law; each names the remedy."""
    signal = np.ones((3, N, N))
    three = INSTRUMENT.model_copy(update={"detector": INSTRUMENT.detector[:3]})
    settings = ReconstructSettings(refine=RefineSettings(law="monotone"))
    with pytest.raises(GuardError, match="needs 5 or more images, got 3"):
        FitProblem.of(signal, signal, three, RASTER, hills(), settings)
    with pytest.raises(ValidationError, match="set law, too"):
        RefineSettings(law_std=0.1)
    stated = three.model_copy(update={"law": CampaignLaw(exponent=0.2, std=0.05)})
    with pytest.raises(GuardError, match="set multiple = 'traced'"):
        FitProblem.of(
            signal, signal, stated, RASTER, hills(), ReconstructSettings(refine=RefineSettings(multiple="radiosity"))
        )
    with pytest.raises(ValidationError, match="set it to 'traced'"):
        RefineSettings(law="power", multiple="radiosity")


SCENE = """
name = "cap"
[beam]
incidence_deg = 0.0
source = "pencil"
[plate]
working_distance_um = 4000.0
sample_distance_um = 4200.0
[sample]
kind = "spheres"
size_um = 8000.0
material = "all"
[[sample.spheres]]
radius_um = 400.0
cap_height_um = 150.0
center_um = [7.0, -11.0]
material = "all"
[material.all]
{material}
[scan]
nx = 25
ny = 25
pixel_size_um = 40.0
atoms_per_pixel = 3000000
[trace]
rays = 64
maps = false
[noise]
seed = 3
""" + "".join(
    f'[[detector]]\nname = "d{k}"\npolar_deg = 38.0\nazimuth_deg = {72.0 * k}\nhalf_angle_deg = 8.0\n' for k in range(5)
)


def test_traced_rough_surface(tmp_path):
    """A traced cap of an EON surface of 20 deg: r within 4 stated s.d. (false alarm 6e-5), the cosine law rejected.

    The tracer shares neither law nor form factor with the fit. The material's law is the fitted one, so that nothing
    warns. Rejects a fit without the law in its prediction of the multiple scattering.
    """
    path = tmp_path / "cap.toml"
    path.write_text(SCENE.format(material=f'kind = "rough_diffuse"\nroughness = {20.0 / 90.0}'))
    scene = hx.load_scene(path)
    stack = record(scene, hx.simulate(scene)).only()
    rec = hx.reconstruct(stack, refine={"law": "rough_diffuse", "rays": 100_000, "max_rounds": 4})
    value, std, _, _ = rec.provenance["instrument"]["values"]["roughness"]
    assert abs(value - 20.0 / 90.0) < 4.0 * std and std < 0.1
    assert not rec.provenance["instrument"]["law"]["is_cosine"]
    assert not any("NOT the" in warning for warning in rec.warnings)


@pytest.mark.slow
def test_a_calibrated_stack_is_fitted_at_the_level_of_its_law():
    """Micrographs in units of the beam, and the same at the cosine law's level as a calibration leaves them: one map.

    Through `explain`, as `refine` runs it: heights agree to 0.2 um, gains are 1 to 0.5 %. Catches a stack that is not
    brought to the level of its law (gains off by the ratio of the levels), or brought there twice.
    """
    stated, surface = CampaignLaw(exponent=0.27, std=0.05), hills()
    instrument = INSTRUMENT.model_copy(update={"law": stated})
    signal = np.asarray(hx.render(surface, hx.Optics.of(INSTRUMENT), RASTER, corrections="none", law=PowerLaw(0.27)))
    std = np.sqrt(signal * np.median(signal)) / SNR
    axis = PITCH * (np.arange(N) - 0.5 * (N - 1))
    data = signal + std * np.random.default_rng(1).normal(size=signal.shape)
    stack = MicrographStack(data, axis, axis, instrument, variance=std**2, n_rays=1.0)
    settings = ReconstructSettings(refine=RefineSettings(samples=0, bias_pairs=0, objects=False))
    ratio = level_ratio(PowerLaw(0.27), hx.Optics.of(INSTRUMENT))[:, None, None]
    calibrated = stack.scaled(1.0 / ratio).replace(calibration=Calibration("border"))

    def predict(height, normals, *instrument, **known):
        return Corrections.none(signal.shape)

    fits = [explain(one, settings, lambda n: predict, None).fit for one in (stack, calibrated)]
    heights = [fit.surface.height for fit in fits]
    assert np.abs(heights[0] - surface.height).max() < 3.0 and np.abs(heights[1] - heights[0]).max() < 0.2
    assert np.abs(ratio - 1.0).max() > 0.02
    assert all(np.abs(fit.gain - 1.0).max() < 0.005 for fit in fits)
