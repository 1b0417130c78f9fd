"""Derivatives of the fit's residuals: Taylor remainder, adjoint, cost; and the sparse Jacobian of the posterior."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.readout import ScanOrder
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.posterior import linearise
from helio_jax.inverse.problem import Refiner
from helio_jax.inverse.residuals import INSTRUMENT, Prediction, Surface
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from tests.derivatives import adjoint_products, taylor_remainders

SHAPE, PITCH = (9, 11), 30.0


def make_problem(instrument, order=ScanOrder(1), border="flat", **settings):
    """A rough surface with a kink, a jump, two plateaus, hidden parts, multiple scattering and free albedo.

    What is unknown of the instrument is away from its prior mean, where masks were predicted. With a free border the
    multiple scattering follows the modes of the relief.
    """
    rng = np.random.default_rng(3)
    geometry = SpotGeometry(instrument)
    height = rng.normal(scale=8.0, size=SHAPE)
    height[:, 6:] += 150.0
    slopes = rng.normal(scale=0.3, size=(2, *SHAPE))
    slopes[0, 4:] += 1.5
    signal = geometry.form_factor(height)[:, 2] * rng.uniform(0.7, 1.1, (3, *SHAPE))
    signal[1, 2, 3] = np.nan
    chosen = ReconstructSettings(border=border, refine=RefineSettings(albedo_std=0.05, albedo_modes=3, **settings))
    surface = Surface(height, *slopes)
    variance = (0.03 * np.nan_to_num(signal, nan=1.0)) ** 2
    region = np.zeros(SHAPE, int)
    region[2:5, 2:5], region[6:8, 5:9] = 1, 3
    refiner = Refiner(signal, variance, geometry, PITCH, PITCH, surface, chosen, region, order)
    with jax.enable_x64(True):
        hidden = rng.uniform(0, 0.1, (3, 3, *SHAPE)) * geometry.form_factor(height)
        response = rng.normal(scale=1e-4, size=hidden.shape)
        multiple, unseen = 0.2 * np.nan_to_num(signal), 0.05 * np.nan_to_num(signal)
        prediction = Prediction(multiple, hidden, lambda change: response * (1.0 + change.mean()), unseen)
        refiner.predict(lambda height, normals, instrument=None: prediction)
        if settings:
            refiner.values |= {name: 0.5 * rng.normal(size=v.shape) for name, v in refiner.values.items()}
        if border == "free":
            refiner.follow_modes(lambda h, normals, *about: replace(prediction, multiple=multiple * (1.0 + 1e-3 * h)))
        return refiner.model, *refiner.lag(8.0, 3.0)


@pytest.fixture(scope="module")
def stated(bshem):
    """The instrument is what it says, but for gains and offsets, as with simulated data."""
    return make_problem(bshem)


@pytest.fixture(scope="module")
def unknown(bshem):
    """All of the instrument is unknown, as with measured data."""
    sure = Uncertainty(sample_distance_um=100.0, tilt_deg=1.0, polar_deg=3.0, azimuth_deg=2.0)
    return make_problem(bshem.model_copy(update={"uncertainty": sure}), drift_std=0.2, line_std=0.02, law_std=0.1)


@pytest.fixture(scope="module")
def turned(bshem):
    """Aligned scans with a free border: each drifts in its own time, predictions follow the relief."""
    time = np.random.default_rng(5).uniform(-1.0, 1.0, (3, *SHAPE))
    sure = Uncertainty(sample_distance_um=100.0, tilt_deg=1.0, polar_deg=3.0, azimuth_deg=2.0)
    about = {
        "order": ScanOrder(1, time),
        "border": "free",
        "level_std_um": 200.0,
        "drift_std": 0.2,
        "line_std": 0.02,
        "law_std": 0.1,
    }
    return make_problem(bshem.model_copy(update={"uncertainty": sure}), **about)


@pytest.fixture(params=["stated", "unknown", "turned"])
def problem(request):
    """All of them."""
    return request.getfixturevalue(request.param)


def random_direction(unknowns, seed):
    """Return a tree of standard normal numbers."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), unknowns)


def test_taylor_remainder_falls_with_the_square(problem):
    """Slope 2.0 +- 0.05 over three decades of the step. Catches a wrong or missing term of any derivative (slope 1)."""
    model, unknowns, lagged = problem
    with jax.enable_x64(True):
        direction = random_direction(unknowns, 1)
        steps = np.logspace(-1, -4, 7)
        rest = taylor_remainders(jax.jit(lambda u: model.residuals(u, lagged)), unknowns, direction, steps)
    order = np.polyfit(np.log(steps), np.log(rest), 1)[0]
    assert order == pytest.approx(2.0, abs=0.05)


def test_adjoint(problem):
    """<J v, w> = <v, J' w> to 1e-11."""
    model, unknowns, lagged = problem
    with jax.enable_x64(True):
        direction, weigh = random_direction(unknowns, 2), lambda value: random_direction(value, 3)
        forth, back = adjoint_products(jax.jit(lambda u: model.residuals(u, lagged)), unknowns, direction, weigh)
    assert forth == pytest.approx(back, rel=1e-11)


def test_gradient_is_cheap(stated):
    """The gradient of the cost takes at most 4 times the floating-point operations of the cost."""
    model, unknowns, lagged = stated

    def cost(u):
        return sum(jnp.sum(r**2) for r in model.residuals(u, lagged).values())

    def operations(f):
        return jax.jit(f).lower(unknowns).compile().cost_analysis()["flops"]

    with jax.enable_x64(True):
        assert operations(jax.grad(cost)) <= 4.0 * operations(cost)


@pytest.mark.parametrize(("name", "n_far"), [("unknown", 4), ("turned", 8)])
def test_sparse_jacobian_is_the_automatic_one(request, name, n_far):
    """J of the posterior times a change of surface and instrument = jvp of the residuals, for every kind of residual.

    The two are written apart. Catches a missing weight, a sign, a wrong neighbour or a lost column.
    """
    model, unknowns, lagged = request.getfixturevalue(name)
    with jax.enable_x64(True):
        linear = linearise(model, unknowns, lagged)
        direction = random_direction(unknowns, 4)._replace(lines=jnp.zeros_like(unknowns.lines))
        value, slope = jax.jvp(lambda u: model.residuals(u, lagged), (unknowns,), (direction,))
        change = jax.jvp(lambda u: model.surface(u, lagged), (unknowns,), (direction,))[1]
    surface = np.stack([np.asarray(part).ravel() for part in change], 1).ravel()
    names = model.instrument_fields(unknowns)
    instrument = np.concatenate([np.asarray(getattr(direction, n)).ravel() for n in names])
    levels = linear.plateau.T @ surface
    assert (
        linear.far.shape[1] == n_far
        and np.abs(linear.far @ levels).max() > 1e-3 * np.abs(linear.surface @ surface).max()
    )
    ours = linear.surface @ surface + linear.far @ levels + linear.instrument @ instrument
    order = ["data", "edge_x", "edge_y", "border", "slope_x", "slope_y", "level", *names]
    assert set(names) == set(INSTRUMENT) - {"lines"}
    theirs = np.concatenate([np.asarray(slope[name]).ravel() for name in order])
    assert set(order) == set(value) - {"lines"}
    assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())
