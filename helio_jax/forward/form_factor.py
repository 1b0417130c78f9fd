"""The vector form factor of an elliptical aperture in JAX, written apart from the tracer's so each checks the other.

Phi = (1/2 pi) closed contour integral (r x dl)/|r|^2 over the rim, counter-clockwise seen from above, r from the
point to the rim; P = n . Phi is the probability that a diffusely scattered atom enters the aperture while nothing
hides it. Trapezoid rule, which converges geometrically for a smooth closed rim. Source: docs/conventions.md; Baum,
Rushmeier, Winget, SIGGRAPH 1989 (Lambert's formula).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.compiling import is_zero
from helio_jax.forward.optics import Optics

N_RIM = 32
"""Rim points: relative error below 1e-9 from a distance of 1.3 semi-axes up."""


def _contour_integral(optics: Optics, height: jax.Array) -> jax.Array:
    """Compute Phi [detector, 3, ...] by the sum over the rim."""
    points, tangents = (jnp.asarray(a, height.dtype) for a in optics.rims(N_RIM))  # [rim, 3, detector]
    spot = tuple(jnp.asarray(v, height.dtype) for v in optics.spot(height))
    expand = (...,) + (None,) * height.ndim

    @jax.checkpoint  # the transpose evaluates the terms anew: kept, they would be 32 times the result
    def term(spot, point, tangent):
        x, y, z = (p[expand] - s for p, s in zip(point, spot, strict=True))
        tx, ty, tz = (t[expand] for t in tangent)
        w = 1.0 / (x * x + y * y + z * z)
        return (y * tz - z * ty) * w, (z * tx - x * tz) * w, (x * ty - y * tx) * w

    def add(total, rim):
        return jax.tree.map(jnp.add, total, term(spot, *rim)), None

    zero = jnp.zeros((optics.n_detectors, *height.shape), height.dtype)
    total, _ = jax.lax.scan(add, (zero, zero, zero), (points, tangents))
    return jnp.stack(total, 1) / N_RIM


@jax.custom_jvp
def form_factor_at(optics: Optics, height: jax.Array) -> jax.Array:
    """Compute the vector form factor [detector, 3, ...] of the points illuminated at heights [...], um.

    Valid for points below the plate and apertures that the point's own horizon does not cut. Differentiable in every
    leaf and in the heights, whose derivative is computed once and kept instead of the terms of the sum.
    """
    return _contour_integral(optics, height)


@partial(form_factor_at.defjvp, symbolic_zeros=True)
def _form_factor_jvp(primals, tangents):
    (optics, height), (d_optics, d_height) = primals, tangents
    value, slope = jax.jvp(lambda h: _contour_integral(optics, h), (height,), (jnp.ones_like(height),))
    change = jnp.zeros_like(value) if is_zero(d_height) else slope * d_height
    leaves = jax.tree.leaves(d_optics, is_leaf=is_zero)
    if not all(map(is_zero, leaves)):
        d_optics = jax.tree.map(lambda o, d: jnp.zeros_like(o) if is_zero(d) else d, optics, d_optics)
        change = change + jax.jvp(lambda o: _contour_integral(o, height), (optics,), (d_optics,))[1]
    return value, change


_jitted = jax.jit(form_factor_at)


def form_factor(optics: Optics, height: np.ndarray) -> np.ndarray:
    """Compute the vector form factor [detector, 3, ...] of NumPy heights [...], um, in float64."""
    with jax.enable_x64(True):
        return np.asarray(_jitted(optics, jnp.asarray(height, jnp.float64)))


def substrate_signal(optics: Optics) -> np.ndarray:
    """Compute the single-scattering detection probability of the substrate, level and unmasked [detector]."""
    return form_factor(optics, np.zeros(1))[:, 2, 0]
