"""The instruments and common changes of the heights that one solve moves along."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse import steps
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.residuals import border_residuals, data_residuals
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.solver import free_parameters
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import expected, freeze, step


@pytest.mark.parametrize("border", ["free", "flat"])
def test_data_tell_levels_from_gains_only_where_the_border_is_free(bshem, monkeypatch, border):
    """Moved along two columns, the data change by one standard deviation each, and in ways that are orthogonal.

    Catches a level, a tilt or a scale that is left out with a free border (the solve then stops with gains and level
    half-way: pulls of 1.3), slopes that do not follow their heights, a prior counted twice, and a level that moves
    although the border holds it.
    """
    shape, pitch = (9, 11), 30.0
    rng = np.random.default_rng(1)
    surface = Surface(rng.normal(scale=10.0, size=shape), *rng.normal(scale=0.2, size=(2, *shape)))
    signal = form_factor(Optics.of(bshem), surface.height)[:, 2]
    settings = ReconstructSettings(border=border)
    raster = Raster.regular(shape, pitch)
    problem = FitProblem.of(signal, (0.03 * signal) ** 2, bshem, raster, surface, settings)
    state, used = FitState.at(problem, surface), []
    none, one, (x, y) = np.zeros(shape), np.ones(shape), raster.centred_positions()
    changes = (surface, Surface(none - bshem.sample_distance, none, none), Surface(x, one, none), Surface(y, none, one))

    def solve(start, fixed, common, lm_steps, cg_steps, mixing, is_free):
        used.append((common, np.asarray(mixing)))
        raise InterruptedError

    monkeypatch.setattr(steps, "solve", solve)
    with pytest.raises(InterruptedError):
        step(problem, state, 8.0, 4.0, is_instrument_free=True)
    ((common, mixing),) = used
    n = len(common.height)
    with jax.enable_x64(True):
        unknowns, fixed = jax.tree.map(jnp.asarray, freeze(problem, state, 8.0, 4.0))
        flat, restore = free_parameters(unknowns.parameters)

        def misfits(values):
            parameters, amplitude = restore(flat + values[:-n]), values[-n:]
            moved = surface
            for size, change in zip(amplitude, changes, strict=False):
                moved = jax.tree.map(lambda f, d, size=size: f + size * d, moved, change)
            parts = data_residuals(moved, parameters, fixed), border_residuals(moved, parameters, fixed)
            return jnp.concatenate([*(m.ravel() for m in parts), values[:-n]])

        change = np.asarray(jax.jacfwd(misfits)(jnp.zeros(flat.size + n))) @ mixing
    if border == "flat":
        np.testing.assert_array_equal(mixing, np.diag([1.0] * flat.size + [0.0]))
    else:
        np.testing.assert_allclose(change.T @ change, np.eye(len(mixing)), atol=1e-8)
        assert n == len(changes) and np.all(abs(mixing[-n:]).max(1) > 0.0)
        assert bshem.sample_distance * abs(mixing[-3]).max() > 1.0


def test_a_wrong_scale_level_and_tilt_are_gone_after_one_solve(bshem):
    """With a free border, from a hill 13 % too low and tilted by 2 deg, in few steps of conjugate gradients.

    Rejects a solve in which single heights alone move: the shape is then 5 um off, the level 7 um.
    """
    raster = Raster.regular((41, 41), 30.0)
    x, y = raster.centred_positions()
    bump = np.exp(-(x**2 + y**2) / (2.0 * 200.0**2))

    def hill(height, tilt_x, tilt_y):
        z = height * bump
        return Surface(z + tilt_x * x + tilt_y * y, tilt_x - z * x / 200.0**2, tilt_y - z * y / 200.0**2)

    truth, start = hill(300.0, 0.0, 0.0), hill(260.0, 0.03, -0.02)
    signal = form_factor(Optics.of(bshem), truth.height)[:, 2]
    settings = ReconstructSettings.model_validate({"border": "free", "refine": {"cg_steps": 10}})
    problem = FitProblem.of(signal, (0.01 * signal) ** 2, bshem, raster, truth, settings)
    problem = replace(problem, signal=expected(problem, FitState.at(problem, truth), is_noisy=False))
    state, _ = step(problem, FitState.at(problem, start), 10.0, 5.0, is_instrument_free=True)
    error = state.surface.height - truth.height
    assert np.std(start.height - truth.height) > 10.0
    assert np.std(error) < 0.5 and abs(error.mean()) < 2.0
