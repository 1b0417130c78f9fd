"""The differentiable render model of single scattering: heights and slopes -> detection probabilities (JAX).

The spot is small against a pixel, so a count belongs to a point: P_k = n . (Phi_k(h) - hidden_k) with the near-field
form factor at the point's height and the part of it that the sample hides (masks and own horizon). How heights and
slopes of neighbouring points hang together is the fit's matter (`edges`, `refine`): a depth jump between two points
touches neither of them. Compared in tests/physics/test_render.py with the tracer, with which it shares no kernel.
"""

import jax
import jax.numpy as jnp

from helio_jax.forward.aiming import aimed_form_factor
from helio_jax.forward.form_factor import SpotGeometry, form_factor_of_height

LEAST_COS = 0.05
"""Facets seen under a smaller cosine take the law's power of this one: it has no slope at the horizon."""


def render_single(
    height: jax.Array,
    normal: jax.Array,
    hidden: jax.Array,
    geometry: SpotGeometry,
    aim: jax.Array | None = None,
    power: jax.Array | None = None,
) -> jax.Array:
    """Return the single-scattering detection probability of every pixel [detector, y, x].

    Args:
        height: heights at the beam positions [y, x], um.
        normal: unit normals there [3, y, x].
        hidden: hidden part of the form factor [detector, 3, y, x].
        geometry: where a point of a given height is, static.
        aim: changes of the apertures' polar angles and azimuths [detector, 2], rad, or None.
        power: m of a law cos^(1 + m), not normalised, instead of the cosine law; the cosine is that of the angle
            between the normal and the aperture's mean direction. None: 0.
    """
    at = form_factor_of_height(geometry, height) if aim is None else aimed_form_factor(geometry, height, aim)
    single = jnp.einsum("kiyx,iyx->kyx", at - hidden, normal)
    if power is None:
        return single
    cos = jnp.einsum("kiyx,iyx->kyx", at, normal) / jnp.sqrt(jnp.sum(at**2, axis=1))
    return single * jnp.maximum(cos, LEAST_COS) ** power
