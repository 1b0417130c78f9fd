"""Variance of heights as a function of dwell times, against a dense inverse, finite differences and `hx.fisher`."""

import dataclasses

import jax
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward.render import detection_probability, masking_corrections
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.dwell_information import EDGE_NOISE, DwellInformation, RegionVariance
from helio_jax.inverse.edges import NOISE_FLOOR, find_edges
from helio_jax.inverse.fit import posterior_at
from helio_jax.inverse.further_images import noise_of_signal, parallax_of_image
from helio_jax.inverse.posterior import exact_height_covariance
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState, set_corrections, with_responses

N = 13
DOSE = 2e5
"""Beam atoms per second."""


@pytest.fixture(scope="module")
def raster() -> hx.Raster:
    return hx.Raster.regular((N, N), 200.0)


@pytest.fixture(scope="module")
def height(raster) -> np.ndarray:
    """A smooth hill."""
    x, y = np.meshgrid(raster.x, raster.y)
    return 100.0 * np.exp(-(x**2 + y**2) / (2.0 * 700.0**2))


@pytest.fixture(scope="module")
def region(raster) -> np.ndarray:
    return np.hypot(*np.meshgrid(raster.x, raster.y)) < 500.0


def posed(bshem, raster, height, seconds: np.ndarray, uncertainty: Uncertainty | None = None) -> DwellInformation:
    """Linearise at the true heights, counted for dwell times [detector, y, x]."""
    optics, settings = hx.Optics.of(bshem), ReconstructSettings()
    surface = jax.tree.map(np.asarray, hx.surface_of_heights(height, raster))
    with jax.enable_x64(True):
        corrections = masking_corrections(surface, optics, raster)
        probability = np.asarray(detection_probability(surface, optics, corrections, 1.0))
    known = optics, raster, surface, settings
    problem = FitProblem.of(probability, probability / (DOSE * seconds), *known, uncertainty=uncertainty)
    state = set_corrections(problem, FitState.at(problem, surface), corrections, surface)
    return DwellInformation.of(problem, with_responses(problem, state), seconds, edge_noise=NOISE_FLOOR)


@pytest.fixture(scope="module")
def seconds(bshem) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 2.0, (len(bshem.detector), N, N))


@pytest.fixture(scope="module")
def about(bshem, raster, height, seconds) -> DwellInformation:
    return posed(bshem, raster, height, seconds)


def test_variance_is_that_of_the_dense_inverse(about, region, seconds):
    """All heights of a region, gains and offsets marginalised. Rejects a lost border term, and a sum for a mean."""
    exact = np.diag(exact_height_covariance(about.at.linear))[region.ravel()].mean()
    assert RegionVariance(about, region)(seconds)[0] == pytest.approx(exact, rel=1e-6)
    other = 3.0 * seconds
    dense = exact_height_covariance(about.linear_at(other))
    assert RegionVariance(about, region)(other)[0] == pytest.approx(np.diag(dense)[region.ravel()].mean(), rel=1e-6)


@pytest.mark.parametrize("n_probes", [256, 20])
def test_derivative_is_that_of_finite_differences(about, region, seconds, n_probes):
    """Along a random direction, exact and with random sums, to 1e-5. Rejects a factor, and a shrinking model error."""
    variance = RegionVariance(about, region, n_probes=n_probes)
    step = 0.1 * seconds * np.random.default_rng(1).normal(size=seconds.shape)
    up, down = (variance(seconds + s * 1e-3 * step)[0] for s in (1.0, -1.0))
    slope = variance(seconds)[1]
    assert (up - down) / 2e-3 == pytest.approx(np.sum(slope * step), rel=1e-5)
    assert np.all(slope <= 0.0)


def test_variance_is_convex(about, region, seconds):
    """Below its chord between two sets of dwell times, and above its tangent.

    Catches an information that is not concave, whose optimum could be a local one.
    """
    variance = RegionVariance(about, region)
    other = np.random.default_rng(2).uniform(0.2, 5.0, seconds.shape)
    ends = variance(seconds), variance(other)
    middle = variance(0.5 * (seconds + other))[0]
    assert middle <= 0.5 * (ends[0][0] + ends[1][0])
    assert ends[1][0] >= ends[0][0] + np.sum(ends[0][1] * (other - seconds))


def test_random_sums_stand_for_all_heights(about, seconds):
    """64 sums of 169 heights: the fall of the variance by twice the time agrees to 5 % with all of them."""
    everywhere = np.ones((N, N), bool)
    few, all_of_them = (RegionVariance(about, everywhere, n_probes=n) for n in (64, 1000))
    falls = [f(2.0 * seconds)[0] / f(seconds)[0] for f in (few, all_of_them)]
    assert falls[0] == pytest.approx(falls[1], rel=0.05)


def test_more_time_is_what_fisher_expects(bshem, raster, height, region, seconds, about):
    """The posterior after three times the dwell agrees with the information posed at those times, to 3 %.

    The same random numbers, so that nothing but edges and thinning differs. Rejects model errors or edges that count
    twice (10 % and more).
    """
    before, after = (np.mean(about.posterior(k * seconds, 256).samples[:, region] ** 2) for k in (1.0, 3.0))
    anew = np.mean(posed(bshem, raster, height, 3.0 * seconds).posterior(3.0 * seconds, 256).samples[:, region] ** 2)
    assert after == pytest.approx(anew, rel=0.03) and after < 0.6 * before
    given = hx.fisher(height, hx.Optics.of(bshem), raster, DOSE, n_samples=256)
    even = posed(bshem, raster, height, np.ones_like(seconds))
    assert even.posterior(np.ones_like(seconds), 256).height_std == pytest.approx(given.height_std, rel=1e-6)


def test_masks_do_not_improve_with_time(about):
    """Information is proportional to time, but saturates at that of the prediction error, here as large as the noise's.

    Rejects a variance of which all falls with the time: 3 times the time would give 3 times the information.
    """
    assert np.allclose(about.information(3.0 * about.seconds)[0], 3.0)
    held = about.at.state.held
    state = dataclasses.replace(about.at.state, held=dataclasses.replace(held, sigma=np.sqrt(2.0) * held.sigma))
    both = dataclasses.replace(about, at=about.at._replace(state=state))
    assert np.allclose(both.information(about.seconds)[0], 1.0)
    assert np.allclose(both.information(3.0 * about.seconds)[0], 1.5)
    assert np.allclose(both.information(1e9 * about.seconds)[0], 2.0)


def test_edges_on_a_noisy_level_surface():
    """Their root mean square standard deviation is EDGE_NOISE times the noise of the slopes, to 5 %."""
    slope = np.random.default_rng(5).normal(size=(60, 60))
    edges = find_edges(np.zeros((60, 60)), slope, 1.0, 1, 1.0, 3.0)
    assert np.sqrt(np.mean(edges.sigma**2)) == pytest.approx(EDGE_NOISE, rel=0.05)


def test_noise_of_further_images_is_that_of_the_same_signal():
    """Variance = background + signal, found from 400 data and applied at other signals. Catches the mean noise."""
    rng = np.random.default_rng(4)
    signal = rng.uniform(50.0, 200.0, (2, 20, 20))
    found = noise_of_signal(signal, 30.0 + 2.0 * signal, np.array([[[10.0, 300.0]]]), np.array([1]))
    assert found.ravel() == pytest.approx([50.0, 630.0])


def test_parallax_of_an_image_on_a_slope():
    """A scan's image g = a X + b Y, seen on a tilted plane h = p x + q y: moving the beam by s changes it by a s.

    Rejects the derivative on the surface instead of that in the scan (a factor of 1 + s . grad h, here 1.13).
    """
    raster = hx.Raster.regular((9, 11), 20.0)
    x, y = np.meshgrid(raster.x, raster.y)
    shift, height = np.array([0.5, 0.1]), 0.3 * x - 0.2 * y
    image = 2.0 * (x + height * shift[0]) + 0.7 * (y + height * shift[1])
    found = parallax_of_image(image, height, raster, shift)
    assert np.allclose(found, 2.0 * shift[0] + 0.7 * shift[1])


def test_incidence_that_is_not_fitted_errs_at_all_dwell_times(bshem, raster, height, seconds):
    """At the present dwell times the error bars are those of the fit; at longer ones the incidence's error stays.

    Same random numbers: equal to rounding. With 100 times the time counting noise is a tenth: what 5 deg of incidence
    do to heights is then more than half of the error bar. Rejects a posterior that forgets the incidence, and one whose
    error falls with the counts.
    """
    about = posed(bshem, raster, height, seconds, Uncertainty(incidence_deg=5.0))
    certain = posed(bshem, raster, height, seconds)
    fit = posterior_at(about.at.problem, about.state, 100)
    assert about.posterior(seconds, 100).height_std == pytest.approx(fit.height_std, rel=1e-6)
    longer, without = (a.posterior(100.0 * seconds, 400).height_std.mean() for a in (about, certain))
    assert longer > 1.15 * without
