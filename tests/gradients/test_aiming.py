"""Aimed apertures: against the instrument that is moved as a whole, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helio_jax.forward.aiming import aimed_form_factor

from helio_jax.forward.form_factor import SpotGeometry
from tests.derivatives import adjoint_products, taylor_remainders


@pytest.fixture(scope="module")
def problem(geometry):
    """Heights, aims and a direction in both."""
    rng = np.random.default_rng(5)
    with jax.enable_x64(True):
        at = {
            "height": jnp.asarray(rng.normal(scale=200.0, size=(4, 5))),
            "aim": jnp.asarray(rng.normal(scale=0.05, size=(2, 2))),
        }
        way = {
            "height": jnp.asarray(rng.normal(scale=100.0, size=(4, 5))),
            "aim": jnp.asarray(rng.normal(scale=0.1, size=(2, 2))),
        }
        yield jax.jit(lambda v: {"phi": aimed_form_factor(geometry, v["height"], v["aim"])}), at, way


def test_the_same_as_a_moved_instrument(geometry):
    """Phi of aimed apertures at a lower height = that of the instrument whose apertures and sample are moved, to 1e-12.

    Catches an azimuth that turns the other way, a polar angle seen from elsewhere, a sign of the distance.
    """
    aim, distance = np.radians([[5.0, -3.0], [-4.0, 6.0]]), 150.0
    height = np.linspace(-100.0, 300.0, 7)
    moved = SpotGeometry(geometry.instrument.moved(aim, distance)).form_factor(height)
    with jax.enable_x64(True):
        ours = np.asarray(aimed_form_factor(geometry, jnp.asarray(height - distance), jnp.asarray(aim)))
    assert ours == pytest.approx(moved, rel=1e-9, abs=1e-12)
    polar = [
        np.arctan2(np.hypot(*a.center), geometry.instrument.working_distance) for a in geometry.instrument.apertures()
    ]
    new = geometry.instrument.moved(aim, 0.0)
    assert [np.arctan2(np.hypot(*a.center), new.working_distance) for a in new.apertures()] == pytest.approx(
        polar + aim[:, 0]
    )


def test_derivatives(problem):
    """Taylor remainder of order 2 and <Jv, w> = <v, J'w>. Catches a lost derivative of an angle (order 1)."""
    function, at, way = problem
    steps = np.logspace(0, -3, 6)
    with jax.enable_x64(True):
        rest = taylor_remainders(function, at, way, steps)
        rng = np.random.default_rng(6)
        weigh = lambda value: jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), value)  # noqa: E731
        forth, back = adjoint_products(function, at, way, weigh)
    assert np.polyfit(np.log(steps), np.log(rest), 1)[0] == pytest.approx(2.0, abs=0.05)
    assert forth == pytest.approx(back, rel=1e-10)
