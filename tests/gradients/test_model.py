"""Derivatives of the fit's residuals: Taylor remainder, adjoint, cost; and the sparse Jacobian of the posterior."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.readout import ScanOrder
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import Surface
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.parameters import NAMES
from helio_jax.inverse.posterior import linearise
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.residuals import Unknowns, residuals, surface_of
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.state import FitState, update_corrections
from helio_jax.inverse.steps import freeze
from tests.derivatives import adjoint_products, taylor_remainders

SHAPE, PITCH = (9, 11), 30.0


def make_problem(instrument, order=ScanOrder(1), border="flat", **settings):
    """Make unknowns and fixed terms: a rough surface with a kink, a jump, two plateaus, masks and free albedo.

    What is unknown of the instrument is away from its prior mean, where masks were computed. Masks follow the levels of
    the plateaus; with a free border masks and multiple scattering follow level, scale and tilt of the relief.
    """
    rng = np.random.default_rng(3)
    optics, raster = Optics.of(instrument), Raster.regular(SHAPE, PITCH)
    height = rng.normal(scale=8.0, size=SHAPE)
    height[:, 6:] += 150.0
    slopes = rng.normal(scale=0.3, size=(2, *SHAPE))
    slopes[0, 4:] += 1.5
    phi = form_factor(optics, height)
    signal = phi[:, 2] * rng.uniform(0.7, 1.1, (3, *SHAPE))
    signal[1, 2, 3] = np.nan
    chosen = ReconstructSettings(border=border, refine=RefineSettings(albedo_std=0.05, albedo_modes=3, **settings))
    surface = Surface(height, *slopes)
    variance = (0.03 * np.nan_to_num(signal, nan=1.0)) ** 2
    region = np.zeros(SHAPE, int)
    region[2:5, 2:5], region[6:8, 5:9] = 1, 3
    problem = FitProblem.of(signal, variance, instrument, raster, surface, chosen, region, order)
    known = np.nan_to_num(signal)
    corrections = Corrections(rng.uniform(0, 0.1, (3, 3, *SHAPE)) * phi, 0.2 * known, 0.05 * known)
    state = update_corrections(problem, FitState.at(problem, surface), lambda *_, **__: corrections)
    if settings:
        drawn = jax.tree.map(lambda v: 0.5 * rng.normal(size=v.shape), state.parameters)
        state = replace(state, parameters=drawn)
    with jax.enable_x64(True):
        return jax.tree.map(jnp.asarray, freeze(problem, state, 8.0, 3.0))


@pytest.fixture(scope="module")
def stated(bshem):
    """The instrument is what it says, but for gains and offsets, as with simulated data."""
    return make_problem(bshem)


@pytest.fixture(scope="module")
def unknown(bshem):
    """All of the instrument is unknown, as with measured data."""
    sure = Uncertainty(sample_distance_um=100.0, tilt_deg=1.0, polar_deg=3.0, azimuth_deg=2.0, discrepancy=0.02)
    return make_problem(
        bshem.model_copy(update={"uncertainty": sure}), drift_std=0.2, line_std=0.02, law="power", law_std=0.1
    )


@pytest.fixture(scope="module")
def turned(bshem):
    """Aligned scans with a free border: each drifts in its own time, corrections follow the relief."""
    time = np.random.default_rng(5).uniform(-1.0, 1.0, (3, *SHAPE))
    sure = Uncertainty(sample_distance_um=100.0, tilt_deg=1.0, polar_deg=3.0, azimuth_deg=2.0, discrepancy=0.02)
    about = {
        "order": ScanOrder(1, time),
        "border": "free",
        "level_std_um": 200.0,
        "drift_std": 0.2,
        "line_std": 0.02,
        "law": "broad_specular",
        "law_std": 0.1,
    }
    return make_problem(bshem.model_copy(update={"uncertainty": sure}), **about)


@pytest.fixture(params=["stated", "unknown", "turned"])
def problem(request):
    """All of them."""
    return request.getfixturevalue(request.param)


def without_lines(unknowns):
    """Return unknowns whose scan lines are 0."""
    parameters = unknowns.parameters.replaced(lines=0.0 * unknowns.parameters.lines)
    return Unknowns(unknowns.height, unknowns.slope_x, unknowns.slope_y, parameters)


def random_direction(unknowns, seed):
    """Return a tree of standard normal numbers."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), unknowns)


def test_taylor_remainder_falls_with_the_square(problem):
    """Slope 2.0 +- 0.05 over three decades of the step. Catches a wrong or missing term of any derivative (slope 1)."""
    unknowns, fixed = problem
    with jax.enable_x64(True):
        direction = random_direction(unknowns, 1)
        steps = np.logspace(-1, -4, 7)
        rest = taylor_remainders(jax.jit(lambda u: residuals(u, fixed)), unknowns, direction, steps)
    order = np.polyfit(np.log(steps), np.log(rest), 1)[0]
    assert order == pytest.approx(2.0, abs=0.05)


def test_adjoint(problem):
    """<J v, w> = <v, J' w> to 1e-11."""
    unknowns, fixed = problem
    with jax.enable_x64(True):
        direction, weigh = random_direction(unknowns, 2), lambda value: random_direction(value, 3)
        forth, back = adjoint_products(jax.jit(lambda u: residuals(u, fixed)), unknowns, direction, weigh)
    assert forth == pytest.approx(back, rel=1e-11)


def test_gradient_is_cheap(stated):
    """The gradient of the cost takes at most 4.25 times the floating-point operations of the cost (4.07 were counted).

    In theory a gradient takes at most 5 times as many: Baur and Strassen, Theor. Comput. Sci. 22 (1983) 317. Catches a
    part that is computed again in reverse.
    """
    unknowns, fixed = stated

    def cost(u):
        return sum(jnp.sum(r**2) for r in residuals(u, fixed).values())

    def operations(f):
        return jax.jit(f).lower(unknowns).compile().cost_analysis()["flops"]

    with jax.enable_x64(True):
        assert operations(jax.grad(cost)) <= 4.25 * operations(cost)


@pytest.mark.parametrize(("name", "n_common"), [("unknown", 7), ("turned", 11)])
def test_sparse_jacobian_is_the_automatic_one(request, name, n_common):
    """J of the posterior times a change of surface and instrument = jvp of the residuals, for every kind of residual.

    The two are written apart. Catches a missing weight, a sign, a wrong neighbour or a lost column.
    """
    unknowns, fixed = request.getfixturevalue(name)
    with jax.enable_x64(True):
        linear = linearise(unknowns, fixed)
        direction = without_lines(random_direction(unknowns, 4))
        value, slope = jax.jvp(lambda u: residuals(u, fixed), (unknowns,), (direction,))
        change = jax.jvp(lambda u: surface_of(u, fixed), (unknowns,), (direction,))[1]
    surface = np.stack([np.asarray(part).ravel() for part in jax.tree.leaves(change)], 1).ravel()
    names = unknowns.parameters.free()
    instrument = np.concatenate([np.asarray(getattr(direction.parameters, n)).ravel() for n in names])
    amplitudes = linear.weights.T @ surface
    assert (
        linear.common.shape[1] == n_common
        and np.abs(linear.common @ amplitudes).max() > 1e-3 * np.abs(linear.surface @ surface).max()
    )
    ours = linear.surface @ surface + linear.common @ amplitudes + linear.instrument @ instrument
    order = ["data", "edge_x", "edge_y", "border", "slope_x", "slope_y", "anchors", *names]
    known = {"surroundings"} if name == "unknown" else set()  # a flat border leaves nothing unknown beyond it
    assert set(names) == set(NAMES) - {"lines", "patch"} - known  # these fits have no albedo patches
    theirs = np.concatenate([np.asarray(slope[name]).ravel() for name in order])
    assert set(order) == set(value) - {"lines", "patch"} - known
    assert np.allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())
