"""What the model lacks, as an unknown of the fit: closed forms of its images, error bars of law and heights."""

from collections.abc import Iterable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import helio_jax as hx
from helio_jax.forward.render import Corrections
from helio_jax.geometry_prior import GeometryPrior
from helio_jax.instrument import Instrument, Uncertainty
from helio_jax.inverse.bootstrap import bootstrap_heights
from helio_jax.inverse.fit import Fit, fit_heights, with_posterior
from helio_jax.inverse.instrument_report import describe_instrument
from helio_jax.inverse.parameters import smooth_images
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings

N, PITCH, HEIGHT, WIDTH = 31, 40.0, 160.0, 150.0
SNR, DISCREPANCY, EXPONENT, EXPONENT_STD = 60.0, 0.03, 0.02, 0.05
RASTER = hx.Raster.regular((N, N), PITCH)
DRAWS = range(4)


def test_images_have_the_stated_variance():
    """Standard normal modes give pixels of the stated variance, averaged over the image: an identity of the modes.

    The mean of every image is 0: an offset is not a discrepancy.
    """
    n, shape, std = 5, (17, 24), np.array([0.02, 0.05])
    each = np.eye(n * n).reshape(-1, n, n)
    with jax.enable_x64(True):
        images = np.array([smooth_images(jnp.asarray(np.stack([mode, mode])), shape, std) for mode in each])
    variance = np.sum(images**2, 0).mean((1, 2))
    assert variance == pytest.approx(std**2, rel=1e-12)
    assert np.abs(images.mean((2, 3))).max() < 1e-15


def hill() -> hx.Surface:
    """A smooth hill on a flat substrate, slopes of up to 33 deg."""
    x, y = RASTER.centred_positions()
    with jax.enable_x64(True):
        surface = hx.surface_of_heights(HEIGHT * np.exp(-0.5 * (x**2 + y**2) / WIDTH**2), RASTER)
        return jax.tree.map(lambda f: np.asarray(f, float), surface)


def disturbance(rng: np.random.Generator) -> np.ndarray:
    """Draw smooth images of unit root mean square and zero mean by another way than the model's [detector, y, x].

    Noise smoothed by Gaussians of three widths, an octave apart.
    """
    out = np.zeros((3, N, N))
    for width in 0.06 * N, 0.12 * N, 0.24 * N:
        image = gaussian_filter(rng.standard_normal((3, 3 * N, 3 * N)), (0.0, width, width))[:, N : 2 * N, N : 2 * N]
        out += image / np.std(image)
    out -= out.mean((1, 2), keepdims=True)
    return out / np.sqrt(np.mean(out**2, (1, 2), keepdims=True))


@cache
def fitted(instrument: Instrument, seed: int, discrepancy: float) -> Fit:
    """Fit the hill to what an instrument with another error of its model recorded."""
    uncertainty = Uncertainty(tilt_deg=1.0, discrepancy=discrepancy)
    stated = instrument.model_copy(update={"uncertainty": uncertainty})
    rng, none = np.random.default_rng([7, seed]), Corrections.none((3, N, N))
    with jax.enable_x64(True):
        optics = jax.tree.map(jnp.asarray, hx.Optics.of(stated))
        signal = np.asarray(hx.render(hill(), optics, RASTER, corrections=none, law=hx.PowerLaw(EXPONENT)))
    usual = np.median(signal, axis=(1, 2), keepdims=True)
    data = signal + DISCREPANCY * usual * disturbance(rng) + usual / SNR * rng.standard_normal(signal.shape)
    settings = ReconstructSettings(refine=RefineSettings(max_rounds=4, samples=32, law="power", law_std=EXPONENT_STD))
    variance = np.broadcast_to((usual / SNR) ** 2, signal.shape)
    problem = FitProblem.of(data, variance, stated, RASTER, hill(), settings)
    return with_posterior(fit_heights(problem, hill(), lambda *_, **__: none))


def pull_of_exponent(fit: Fit) -> float:
    """Compute (fitted - true exponent) / its stated standard deviation."""
    assert fit.posterior is not None
    column = fit.posterior.names.index("law[0]")
    return float(
        (fit.parameters.law[0] - EXPONENT / EXPONENT_STD) / np.sqrt(fit.posterior.instrument_covariance[column, column])
    )


def pull_of_hill(fit: Fit) -> float:
    """Compute the error of the hill's height over its stated standard deviation."""
    assert fit.posterior is not None
    weight = hill().height / np.sum(hill().height ** 2)
    std = float(np.std(np.tensordot(fit.posterior.samples, weight, 2)))
    return float(np.sum(weight * fit.surface.height) - 1.0) / std


def test_error_bars_hold_where_the_model_lacks_something(bshem):
    """Root mean square pull of exponent and hill over 4 instruments: at most 2.2 (false alarm 7e-4 each, chi-square).

    Rejects a model that is taken for complete, whose exponent is off by 3 and more standard deviations. Its gains show
    that: the Birge ratio inflates the error bars, here by 2.8 and more, which is left out of the comparison.
    """
    known = [fitted(bshem, seed, DISCREPANCY) for seed in DRAWS]
    complete = [fitted(bshem, seed, 0.0) for seed in DRAWS[:2]]  # far off in every draw
    assert rms(pull_of_exponent(fit) for fit in known) < 2.2
    assert rms(pull_of_hill(fit) for fit in known) < 2.2
    inflation = [fit.posterior.inflation for fit in complete if fit.posterior is not None]
    assert rms(f * pull_of_exponent(fit) for f, fit in zip(inflation, complete, strict=True)) > 2.5
    assert min(inflation) > 2.0


def rms(values: Iterable[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


def test_error_bars_of_photometric_methods_contain_it():
    """A method whose heights are one detector's data, 2 % off: their samples scatter by 2 % of the median signal.

    48 samples of 35 modes; within 30 %. Rejects errors that are left out, or scaled by another detector's signal.
    """
    data = np.stack([np.full((N, N), level) for level in (1.0, 5.0, 2.0)])
    settings = ReconstructSettings(samples=48, border="free")
    settings = settings.model_copy(update={"refine": RefineSettings(gain_std=1e-9, offset_std=1e-9)})
    optics = hx.Optics.of(hx.load_instrument("bshem_wd4"))
    exact = GeometryPrior.of_uncertainty(Uncertainty(), 3)
    drawn = [
        bootstrap_heights(data, 1e-12 * data, optics, exact, settings, lambda d, *_: d[1], discrepancy=size)
        for size in (0.02, 0.0)
    ]
    assert np.sqrt(np.mean(drawn[0] ** 2)) == pytest.approx(0.02 * 5.0, rel=0.3)
    assert np.abs(drawn[1]).max() < 1e-4


def test_an_experiment_knows_less_of_the_heights(bshem):
    """`hx.fisher` counts it; its modes are not listed. Rejects names that several modes share."""
    known = {"dose": 1e6, "corrections": "none", "n_samples": 200}
    optics = hx.Optics.of(bshem)
    without, found = (
        hx.fisher(hill().height, optics, RASTER, uncertainty=Uncertainty(tilt_deg=1.0, discrepancy=d), **known)
        for d in (0.0, DISCREPANCY)
    )
    assert found.height_std.mean() > 1.5 * without.height_std.mean()
    assert found.parameters.keys() == without.parameters.keys()


def test_it_is_reported(bshem):
    """The error found is within a factor of 1.5 of the true one; its modes are not listed one by one."""
    fit = fitted(bshem, 0, DISCREPANCY)
    told = describe_instrument(fit)
    assert set(told["discrepancy"]) == set(bshem.detector_names)
    assert all(DISCREPANCY / 1.5 < found < 1.5 * DISCREPANCY for found in told["discrepancy"].values())
    assert told["discrepancy_std"] == DISCREPANCY
    assert not any("discrepancy" in name for name in told["values"])
