"""Form factors of apertures that are aimed a little elsewhere than the instrument says: unknowns of the fit (JAX).

The polar angle of an aperture's centre, seen from the nominal spot, and its azimuth about it are changed as
`Instrument.moved` does; a sample that is farther away than stated is a height that is lower by as much. The size of
an aperture is not an unknown: beside its gain, the images hardly tell it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.form_factor import SpotGeometry, form_factor


def aimed_rims(geometry: SpotGeometry, aim: jax.Array) -> jax.Array:
    """Return `geometry.rims` [detector, 2, n, 2] after changes of polar angle and azimuth [detector, 2], rad."""
    center = np.array([a.center for a in geometry.instrument.apertures()])
    radius = np.hypot(*center.T)
    outward = center / np.maximum(radius, 1e-9)[:, None]
    w = geometry.instrument.working_distance
    shift = (w * jnp.tan(np.arctan2(radius, w) + aim[:, 0]) - radius)[:, None] * outward
    cos, sin = jnp.cos(aim[:, 1]), jnp.sin(aim[:, 1])
    turn = jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)
    rims = jnp.asarray(geometry.rims).at[:, 0].add(shift[:, None])
    return jnp.einsum("kij,kpnj->kpni", turn, rims)


def _direct(geometry: SpotGeometry, height: jax.Array, aim: jax.Array) -> jax.Array:
    return form_factor(aimed_rims(geometry, aim), *geometry.position(height))


def aimed_slopes(geometry: SpotGeometry, height: jax.Array, aim: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return Phi [detector, 3, ...] and its derivatives with respect to height, polar angle and azimuth, stacked."""
    ways = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

    def along(way):
        tangent = way[0] * jnp.ones_like(height), jnp.asarray(way[1:]) * jnp.ones_like(aim)
        return jax.jvp(partial(_direct, geometry), (height, aim), tangent)[1]

    return _direct(geometry, height, aim), jnp.stack([along(way) for way in ways])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def aimed_form_factor(geometry: SpotGeometry, height: jax.Array, aim: jax.Array) -> jax.Array:
    """Return Phi [detector, 3, ...] of points seen at `height` [um] by aimed apertures.

    Differentiable in both; each derivative is computed once and kept, as in `formfactor`.

    Args:
        geometry: of the instrument as stated, static.
        height: um.
        aim: changes of polar angle and azimuth [detector, 2], rad.
    """
    return _direct(geometry, height, aim)


@aimed_form_factor.defjvp
def _aimed_jvp(geometry, primals, tangents):
    (height, aim), (dh, da) = primals, tangents
    value, slopes = aimed_slopes(geometry, height, aim)
    expand = (slice(None), slice(None), *((None,) * (value.ndim - 1)))
    da = jnp.moveaxis(da[expand], 1, 0)
    return value, slopes[0] * dh + slopes[1] * da[0] + slopes[2] * da[1]
