"""Aimed apertures: against the instrument that is moved as a whole, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor, form_factor_at
from helio_jax.forward.optics import Optics
from tests.derivatives import adjoint_products, taylor_remainders


def aimed_form_factor(optics, height, aim, distance=0.0):
    """Compute the form factors of apertures turned by aim (polar angle, azimuth) [detector, 2]."""
    return form_factor_at(optics.moved(polar=aim[:, 0], azimuth=aim[:, 1], distance=distance), height)


@pytest.fixture(scope="module")
def problem(optics):
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
        yield jax.jit(lambda v: {"phi": aimed_form_factor(optics, v["height"], v["aim"])}), at, way


def test_the_same_as_a_moved_instrument(oblique, optics):
    """Phi of aimed apertures with a moved sample, or at a lower height, = that of the moved instrument, to 1e-12.

    Catches an azimuth that turns the other way, a polar angle seen from elsewhere, a sign of the distance.
    """
    aim, distance = np.radians([[5.0, -3.0], [-4.0, 6.0]]), 150.0
    height = np.linspace(-100.0, 300.0, 7)
    moved = form_factor(Optics.of(oblique.moved(aim, distance)), height)
    with jax.enable_x64(True):
        ours = np.asarray(aimed_form_factor(optics, jnp.asarray(height), jnp.asarray(aim), distance))
        lower = np.asarray(aimed_form_factor(optics, jnp.asarray(height - distance), jnp.asarray(aim)))
    assert ours == pytest.approx(moved, rel=1e-9, abs=1e-12)
    assert lower == pytest.approx(moved, rel=1e-9, abs=1e-12)
    polar = [np.arctan2(np.hypot(*a.center), oblique.working_distance) for a in oblique.apertures()]
    new = oblique.moved(aim, 0.0)
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
