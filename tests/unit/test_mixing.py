"""The instruments and levels that one solve moves along."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.inverse.problem import Refiner
from helio_jax.inverse.residuals import Surface
from helio_jax.inverse.settings import ReconstructSettings


@pytest.mark.parametrize("border", ["free", "flat"])
def test_data_tell_levels_from_gains_only_where_the_border_is_free(bshem, border):
    """Moved along two columns, the data change by one standard deviation each, and in ways that are orthogonal.

    Catches a level that is left out with a free border (the solve then stops with gains and level half-way: pulls of
    1.3), its prior counted twice, and a level that moves although the border holds it.
    """
    shape, pitch = (9, 11), 30.0
    rng = np.random.default_rng(1)
    surface = Surface(rng.normal(scale=10.0, size=shape), *rng.normal(scale=0.2, size=(2, *shape)))
    geometry = SpotGeometry(bshem)
    signal = geometry.form_factor(surface.height)[:, 2]
    settings = ReconstructSettings(border=border)
    refiner = Refiner(signal, (0.03 * signal) ** 2, geometry, pitch, pitch, surface, settings)
    model = refiner.model
    with jax.enable_x64(True):
        unknowns, lagged = refiner.lag(8.0, 4.0)
        mixing = np.asarray(refiner._mixing((model, unknowns, lagged), is_instrument_free=True))
        names = sorted(model.instrument_fields(unknowns))  # the order of a tree
        sizes = [getattr(unknowns, name).size for name in names]

        def residuals(values):
            parts = jnp.split(values[:-1], np.cumsum(sizes)[:-1])
            moved = unknowns._replace(
                **{n: p.reshape(getattr(unknowns, n).shape) for n, p in zip(names, parts, strict=True)}
            )
            raised = Surface(surface.height + values[-1], surface.slope_x, surface.slope_y)
            misfits = model.data_residuals(raised, moved, lagged), model.border_residuals(raised, moved, lagged)
            return jnp.concatenate([*(m.ravel() for m in misfits), values[:-1]])

        change = np.asarray(jax.jacfwd(residuals)(jnp.zeros(sum(sizes) + 1))) @ mixing
    if border == "flat":
        np.testing.assert_array_equal(mixing, np.diag([1.0] * sum(sizes) + [0.0]))
    else:
        np.testing.assert_allclose(change.T @ change, np.eye(len(mixing)), atol=1e-8)
        assert abs(mixing[-1]).max() > 1.0
