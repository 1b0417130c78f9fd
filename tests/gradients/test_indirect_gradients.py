"""Derivatives of the radiosity model with a frozen plan: Taylor remainders and the adjoint, in heights and normals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward import radiosity as indirect
from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import normal_of_slopes
from tests.derivatives import adjoint_products, taylor_remainders


def test_taylor_and_adjoint(optics, monkeypatch):
    """The Taylor remainder falls with slope 2.0 +- 0.05 over 2 decades of step, and <J v, w> = <v, J' w> to 1e-10.

    A rough surface with a step of 6 pitches, so that levels, strips cut at levels and the flat outside take part.
    Rejected wrong models: a derivative that leaves out the sender's height, the end of a strip, the levels or the
    solve: slope 1. The series is summed to 1e-14, for its end is not smooth.
    """
    monkeypatch.setattr(indirect, "TOLERANCE", 1e-14)
    rng = np.random.default_rng(3)
    raster = Raster(12.0 * np.arange(10), 9.0 * np.arange(9))
    height = 4.0 * rng.normal(size=(9, 10)) + 40.0
    height[:, 5:] += 70.0
    raw = np.stack(normal_of_slopes(*(0.3 * rng.normal(size=(2, 9, 10))), optics.beam_shift), -1)
    start = height, raw / np.linalg.norm(raw, axis=-1, keepdims=True)
    plan = indirect.plan_radiosity(*start, optics, raster)
    direction = rng.normal(size=height.shape), 0.05 * rng.normal(size=raw.shape)

    def value_at(surface):
        return indirect.radiosity(*surface, optics, raster, plan)

    with jax.enable_x64(True):
        start, v = (tuple(map(jnp.asarray, arrays)) for arrays in (start, direction))
        steps = 10.0 ** np.arange(-1.5, -3.6, -0.5)
        rest = taylor_remainders(value_at, start, v, steps)
        forth, to_and_fro = adjoint_products(value_at, start, v, lambda f: jnp.asarray(rng.normal(size=f.shape)))
    orders = np.diff(np.log10(rest)) / np.diff(np.log10(steps))
    assert np.all(np.abs(orders - 2.0) < 0.05), orders
    assert forth == pytest.approx(to_and_fro, rel=1e-10)
