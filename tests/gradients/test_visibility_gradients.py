"""Derivatives of the masked form factor: Taylor remainders, the adjoint, differences in each height, and their cost."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.masking import masked_form_factor
from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from tests.compilations import OPTIMISED
from tests.derivatives import adjoint_products, taylor_remainders

DX, DY = 12.0, 9.0


def masked_of(surface: Surface, optics, **options):
    """Compute the masked form factors on a raster of pitches DX, DY."""
    return masked_form_factor(surface, optics, Raster.regular(surface.height.shape, DX, DY), **options)


def rough_scene(rng: np.random.Generator, shape: tuple[int, int]) -> Surface:
    """Return random heights [um] and slopes, no two samples of which tie; every eighth aperture is cut in part."""
    return Surface(*(size * rng.normal(size=shape) for size in (8.0, 0.7, 0.7)))


@pytest.mark.parametrize("width", [0.0, 0.1])
def test_taylor_and_adjoint(optics, width):
    """The Taylor remainder falls with slope 2.0 +- 0.05 over 3 decades of step, and <J v, w> = <v, J' w> to 1e-12.

    The seed is one of those where no slice crosses the mask's edge within the longest step (0.03 um; at such a kink of
    the exact mask the slope is 1). Rejected wrong models: a derivative that leaves out the blocking height, the point's
    own height, the depth below the aperture or the own slopes: slope 1.
    """
    rng = np.random.default_rng(4)
    scene = rough_scene(rng, (7, 8))
    direction = Surface(*(size * rng.normal(size=(7, 8)) for size in (1.0, 0.05, 0.05)))
    with jax.enable_x64(True):

        @jax.jit
        def model(inputs):
            return masked_of(inputs, optics, width=width)

        start, v = (jax.tree.map(jnp.asarray, arrays) for arrays in (scene, direction))
        share = np.asarray(model(start)[:, 2]) / form_factor(optics, scene.height)[:, 2]
        steps = 10.0 ** np.arange(-1.5, -4.6, -0.5)
        rest = taylor_remainders(model, start, v, steps)
        forth, to_and_fro = adjoint_products(model, start, v, lambda f: jnp.asarray(rng.normal(size=f.shape)))
    assert np.mean((share > 1e-3) & (share < 0.999)) > 0.1
    orders = np.diff(np.log10(rest)) / np.diff(np.log10(steps))
    assert np.all(np.abs(orders - 2.0) < 0.05), orders
    assert forth == pytest.approx(to_and_fro, rel=1e-12)


def test_single_heights(optics):
    """A point before a wall: central differences in its height and in that of the wall's edge; 0 for the wall behind.

    The masked part of a detector grows with the wall and falls with the point. Catches a derivative that goes to the
    wrong sample of the march.
    """
    height = np.zeros((9, 31))
    height[:, 20:] = 100.0
    flat = np.zeros_like(height)

    @jax.jit
    def masked(heights):
        return masked_of(Surface(heights, flat, flat), optics)[0, 2, 4, 12]

    with jax.enable_x64(True):
        slope = np.asarray(jax.grad(masked)(jnp.asarray(height)))
        for j in (12, 20):
            step = np.zeros_like(height)
            step[4 if j == 12 else slice(None), j] = 1e-3
            central = float(masked(jnp.asarray(height + step)) - masked(jnp.asarray(height - step))) / 2e-3
            assert np.sum(slope * step) == pytest.approx(1e-3 * central, rel=1e-6)
    assert slope[4, 12] < 0.0 < slope[:, 20].sum()
    assert not np.any(slope[:, 22:])


def test_cost(optics):
    """A gradient costs at most 4 times the value (measured 1.2 to 2.1) and holds at most 3 times as much (1.9).

    Catches a march that is differentiated, and slices that are kept for the way back (22 times).
    """
    with jax.enable_x64(True):
        surface = jax.tree.map(jnp.asarray, rough_scene(np.random.default_rng(2), (61, 61)))

        def total(surface):
            return jnp.sum(masked_of(surface, optics) ** 2)

        compiled = [jax.jit(f).lower(surface).compile(OPTIMISED) for f in (total, jax.grad(total))]
        memory = [function.memory_analysis() for function in compiled]
        held = [m.temp_size_in_bytes + m.argument_size_in_bytes + m.output_size_in_bytes for m in memory]
        seconds = [np.inf, np.inf]
        for _ in range(12):  # in turns: both meet the same other load, the first time they warm up
            for k, function in enumerate(compiled):
                start = time.perf_counter()
                jax.block_until_ready(function(surface))
                seconds[k] = min(seconds[k], time.perf_counter() - start)
    assert seconds[1] < 4.0 * seconds[0]
    assert held[1] < 3.0 * held[0]
