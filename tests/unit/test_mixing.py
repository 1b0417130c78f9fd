"""The instruments and levels that one solve moves along."""

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
from helio_jax.inverse.steps import freeze, step


@pytest.mark.parametrize("border", ["free", "flat"])
def test_data_tell_levels_from_gains_only_where_the_border_is_free(bshem, monkeypatch, border):
    """Moved along two columns, the data change by one standard deviation each, and in ways that are orthogonal.

    Catches a level that is left out with a free border (the solve then stops with gains and level half-way: pulls of
    1.3), its prior counted twice, and a level that moves although the border holds it.
    """
    shape, pitch = (9, 11), 30.0
    rng = np.random.default_rng(1)
    surface = Surface(rng.normal(scale=10.0, size=shape), *rng.normal(scale=0.2, size=(2, *shape)))
    signal = form_factor(Optics.of(bshem), surface.height)[:, 2]
    settings = ReconstructSettings(border=border)
    raster = Raster.regular(shape, pitch)
    problem = FitProblem.of(signal, (0.03 * signal) ** 2, bshem, raster, surface, settings)
    state, used = FitState.at(problem, surface), []

    def solve(start, fixed, lm_steps, cg_steps, mixing, is_free):
        used.append(np.asarray(mixing))
        raise InterruptedError

    monkeypatch.setattr(steps, "solve", solve)
    with pytest.raises(InterruptedError):
        step(problem, state, 8.0, 4.0, is_instrument_free=True)
    (mixing,) = used
    with jax.enable_x64(True):
        unknowns, fixed = jax.tree.map(jnp.asarray, freeze(problem, state, 8.0, 4.0))
        flat, restore = free_parameters(unknowns.parameters)

        def misfits(values):
            moved = restore(flat + values[:-1])
            raised = Surface(surface.height + values[-1], surface.slope_x, surface.slope_y)
            parts = data_residuals(raised, moved, fixed), border_residuals(raised, moved, fixed)
            return jnp.concatenate([*(m.ravel() for m in parts), values[:-1]])

        change = np.asarray(jax.jacfwd(misfits)(jnp.zeros(flat.size + 1))) @ mixing
    if border == "flat":
        np.testing.assert_array_equal(mixing, np.diag([1.0] * flat.size + [0.0]))
    else:
        np.testing.assert_allclose(change.T @ change, np.eye(len(mixing)), atol=1e-8)
        assert abs(mixing[-1]).max() > 1.0
