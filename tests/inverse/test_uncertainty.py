"""Error bars: against dense algebra, against repeated noise, and where nothing fixes a height."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse
from scipy.ndimage import gaussian_filter

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.correlated_errors import Errors, ModelError
from helio_jax.inverse.posterior import (
    Linearised,
    exact_height_covariance,
    linearise,
    sample_posterior,
)
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.quality import floating, regions
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import freeze
from helio_jax.workflows import pipeline
from helio_jax.workflows.corrections import make_predictor


def random_problem(shape=(4, 5), n_parameters=3, n_common=2, seed=0) -> Linearised:
    rng = np.random.default_rng(seed)
    n = 3 * shape[0] * shape[1]
    matrix = sparse.random(5 * n, n, density=0.1, random_state=1, format="csr") + sparse.vstack(
        [sparse.identity(n), sparse.csr_matrix((4 * n, n))]
    )
    instrument = matrix @ rng.normal(size=(n, n_parameters)) + 0.1 * rng.normal(size=(5 * n, n_parameters))
    rows = sparse.vstack([matrix, sparse.csr_matrix((n_parameters, n))], format="csr")
    names = tuple(f"p[{i}]" for i in range(n_parameters))
    common = 0.3 * rng.normal(size=(5 * n + n_parameters, n_common))
    weights = rng.normal(size=(n, n_common))
    return Linearised(rows, np.vstack([instrument, np.eye(n_parameters)]), common, weights, names, shape)


def test_samples_have_the_dense_covariance():
    """20000 samples against the dense inverse of J'J, instrument marginalised: 4 standard errors are 2 % per height.

    Rejects a posterior with the instrument held fixed (differs by more than 5 % here).
    """
    linear = random_problem()
    found = sample_posterior(linear, 20_000)
    exact = exact_height_covariance(linear)
    assert np.allclose(found.height_std.ravel(), np.sqrt(np.diag(exact)), rtol=0.025)
    sampled = np.cov(found.samples.reshape(20_000, -1).T)
    assert np.abs(sampled - exact).max() < 5 * exact.max() / np.sqrt(20_000)
    dense = linear.surface.toarray() + linear.common @ linear.weights.T
    fixed = np.linalg.inv(dense.T @ dense)[::3, ::3]
    assert (np.sqrt(np.diag(exact) / np.diag(fixed)) > 1.05).any()


def test_response_is_what_a_forced_parameter_does():
    """Minimising with one parameter forced to 1 and the others held moves the heights by `response`, exactly."""
    linear = random_problem()
    found = sample_posterior(linear, 1)
    dense = linear.surface.toarray() + linear.common @ linear.weights.T
    moved = np.linalg.lstsq(dense, -linear.instrument[:, 1], rcond=None)[0]
    assert np.allclose(found.response[1].ravel(), moved[::3], atol=1e-10)


def test_regions_and_floating():
    """A plateau cut off all around floats if its level is uncertain, and not if something fixes it."""
    joined_x, joined_y = np.ones((12, 11)), np.ones((11, 12))
    joined_x[4:8, 3] = joined_x[4:8, 7] = 0.0
    joined_y[3, 4:8] = joined_y[7, 4:8] = 0.0
    region = regions(joined_x, joined_y)
    inside = np.zeros((12, 12), bool)
    inside[4:8, 4:8] = True
    assert np.array_equal(region == 1, inside) and np.all(region[~inside] == 0)
    level = np.random.default_rng(0).normal(size=(50, 1, 1)) * inside
    height = 100.0 * inside
    assert np.array_equal(floating(height, 50.0 * level, region), inside)
    assert not floating(height, 2.0 * level, region).any()
    shifted = np.zeros((1, *height.shape))
    shifted[0, 0] = -0.25 * np.ptp(height)
    found = floating(height, 2.0 * level, region, shifted + 1000.0)  # all heights together are no relief
    assert found[0].all() and not found[1:].any()
    assert not floating(height, 2.0 * level, region, 0.7 * shifted).any()


def test_pulls_of_repeated_noise(bshem):
    """Errors of 4 fits to fresh noise over their stated standard deviation: a root mean square near 1.

    A smooth bump, no masks. The pulls of one fit are strongly correlated, so the limits 0.6 and 1.6 are wide; they
    reject error bars wrong by a factor of 2. The full study: benchmarks/reconstruction.py.
    """
    from tests.inverse.test_reconstruct import bump_stack

    pulls = []
    for seed in range(4):
        stack, height, normal = bump_stack(bshem, n=56)
        rng = np.random.default_rng(seed)
        multiple = make_predictor(stack, 4_000_000)(height, normal).multiple
        expected = 3.5e4 * (stack.counts / 1e6 + multiple)
        noisy = rng.poisson(expected).astype(float)
        one = stack.replace(counts=noisy, variance=expected, n_rays=3.5e4)
        rec = pipeline.reconstruct(one, "refine", refine={"max_rounds": 2, "rays": 100_000})
        assert rec.height_std is not None and rec.height_samples is not None
        error = rec.height - height
        pulls.append(error / rec.height_std)
        top = np.unravel_index(height.argmax(), height.shape)
        value, std = rec.spread(lambda h, top=top: h[top] - np.median(h))
        assert value == pytest.approx(60.0, abs=5 * std) and 0 < std < 20
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert jax.config.read("jax_enable_x64") is False


def level_fit(instrument, shape):
    """Return unknowns and fixed terms of a fit to a level surface with 3 % noise."""
    level = Surface(*np.zeros((3, *shape)))
    signal = form_factor(Optics.of(instrument), level.height)[:, 2]
    known = signal, (0.03 * signal) ** 2, instrument, Raster.regular(shape, 30.0), level, ReconstructSettings()
    problem = FitProblem.of(*known)
    return freeze(problem, FitState.at(problem, level), 8.0, 4.0)


def test_a_thinned_raster_has_a_whole_border(bshem):
    """Every second of 20 rows and 22 columns: the flat border still holds all four sides.

    Catches the border's weights thinned, too, which leaves the last row and column free.
    """
    level = Surface(*np.zeros((3, 20, 22)))
    signal = form_factor(Optics.of(bshem), level.height)[:, 2]
    known = signal, (0.03 * signal) ** 2, bshem, Raster.regular((20, 22), 30.0), level, ReconstructSettings()
    border = FitProblem.of(*known).thinned(2).border
    assert border.shape == (10, 11)
    for side in (border[0], border[-1], border[:, 0], border[:, -1]):
        assert np.all(side == border.max())
    assert np.all(border[1:-1, 1:-1] < 0.1 * border.max())


def test_a_pixel_that_nothing_fixes_has_a_large_deviation(bshem):
    """All four edges cut and no datum left: an error bar of millimetres, no singular matrix."""
    shape = (5, 6)
    with jax.enable_x64(True):
        unknowns, fixed = jax.tree.map(jnp.asarray, level_fit(bshem, shape))
        cut = (
            fixed.edges.inverse_std_x.at[2, 2:4].set(0.0),
            fixed.edges.inverse_std_y.at[1:3, 3].set(0.0),
            fixed.inverse_sigma.at[:, 2, 3].set(0.0),
        )
        fixed = eqx.tree_at(lambda f: (f.edges.inverse_std_x, f.edges.inverse_std_y, f.inverse_sigma), fixed, cut)
        found = sample_posterior(linearise(unknowns, fixed), 200)
    assert found.height_std[2, 3] > 1e4
    others = np.ones(shape, bool)
    others[2, 3] = False
    assert found.height_std[others].max() < 10.0


@pytest.mark.parametrize("stride", [1, 2])
def test_errors_that_agree(stride):
    """Means over blocks of a correlated field: variance and correlation as `ModelError` states them, within 4 %.

    The field is made at full resolution from independent errors, the blocks' means are taken, and both are compared
    with `deviation` and with the draws at one datum per block. 4000 draws leave 2.2 % of a variance. Rejected wrong
    models: errors that average away as independent ones (variance too low by 2 to 4), a length not divided by the
    stride, a covariance that forgets the counts.
    """
    length, n, draws = (1.5, 2.5), 24, 4000
    rng = np.random.default_rng(3)
    white = rng.standard_normal((draws, n, n))
    field = gaussian_filter(white, length, axes=(1, 2))
    field = field / field[:, n // 2, n // 2].std()
    blocks = field.reshape(draws, n // stride, stride, n // stride, stride).mean((2, 4))
    m = n // stride
    error = ModelError(np.full((1, m, m), 0.8), length, stride)
    middle, beside = (0, m // 2, m // 2), (0, m // 2, m // 2 + 1)
    stated = error.deviation[middle] ** 2 / (0.8 * stride**2)
    assert stated == pytest.approx(blocks[:, m // 2, m // 2].var(), rel=0.08)
    found = error.draw(rng, rng.standard_normal((m * m, draws))).reshape(1, m, m, draws)
    assert found[middle].var() == pytest.approx(error.deviation[middle] ** 2 + 0.2, rel=0.1)
    agreement = np.corrcoef(blocks[:, m // 2, m // 2], blocks[:, m // 2, m // 2 + 1])[0, 1]
    seen = np.corrcoef(found[middle], found[beside])[0, 1] * (1.0 + 0.2 / error.deviation[middle] ** 2)
    assert seen == pytest.approx(agreement, abs=0.08)
    influence = np.zeros((m * m, 2))
    influence[:, 0], influence[m // 2 * m : (m // 2 + 1) * m, 1] = 1.0 / m**2, 1.0
    sums = influence.T @ found.reshape(m * m, draws)
    assert error.covariance(influence) == pytest.approx(np.cov(sums), rel=0.1)


def test_independent_errors_change_nothing(bshem):
    """A model error of no length has the spread that the fit assumes: the instrument's covariance to 1e-9.

    With a length of a third of the raster the heights' deviations must grow: errors that agree do not average.
    """
    shape = (20, 21)
    linear = linearise(*level_fit(bshem, shape))
    share = np.full((3, *shape), 0.5)
    plain = sample_posterior(linear, 200)
    apart = sample_posterior(linear, 200, errors=Errors(ModelError(share, (0.0, 0.0))))
    wide = sample_posterior(linear, 200, errors=Errors(ModelError(share, (7.0, 7.0))))
    assert apart.instrument_covariance == pytest.approx(plain.instrument_covariance, rel=1e-9, abs=1e-12)
    assert apart.height_std.mean() == pytest.approx(plain.height_std.mean(), rel=0.1)
    assert wide.height_std.mean() > 2.0 * plain.height_std.mean()
    assert wide.instrument_covariance[0, 0] == pytest.approx(wide.instrument_samples[:, 0].var(), rel=0.4)
