"""The vector form factor of an elliptical aperture in JAX, written apart from the tracer's so each checks the other.

Phi = (1/2 pi) closed contour integral (r x dl)/|r|^2 over the rim, counter-clockwise seen from above, r from the
point to the rim; P = n . Phi is the probability that a diffusely scattered atom enters the aperture while nothing
hides it. Trapezoid rule, which converges geometrically for a smooth closed rim. Source: DESIGN.md section 2; Baum,
Rushmeier, Winget, SIGGRAPH 1989 (Lambert's formula).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.instrument import Instrument

N_RIM = 32
"""Default rim points: relative error below 1e-9 from a distance of 1.3 semi-axes up."""


def rim_table(instrument: Instrument, n_points: int = N_RIM) -> np.ndarray:
    """Return rim points and tangents of every aperture [detector, 2, n_points, 2], lab frame, um."""
    return np.stack([a.rim(n_points) for a in instrument.apertures()])


def form_factor(rims: jax.Array, x: jax.Array, y: jax.Array, depth: jax.Array) -> jax.Array:
    """Return Phi of every aperture [detector, 3, ...] for points (x, y), `depth` below the plate.

    Valid for depth > 0 and apertures that are not cut by the point's own horizon.

    Args:
        rims: from `rim_table` [detector, 2, n, 2].
        x, y, depth: lab position, any common shape, um.
    """

    def of_point(carry, rim):
        px, py, tx, ty = rim  # each [detector]
        expand = (...,) + (None,) * x.ndim
        rx, ry = px[expand] - x, py[expand] - y
        tx, ty = tx[expand], ty[expand]
        w = 1.0 / (rx * rx + ry * ry + depth * depth)
        fx, fy, fz = carry
        return (fx - depth * ty * w, fy + depth * tx * w, fz + (rx * ty - ry * tx) * w), None

    n, rims = rims.shape[2], rims.astype(x.dtype)
    zero = jnp.zeros((rims.shape[0], *x.shape), x.dtype)
    per_point = (rims[:, 0, :, 0].T, rims[:, 0, :, 1].T, rims[:, 1, :, 0].T, rims[:, 1, :, 1].T)
    total, _ = jax.lax.scan(of_point, (zero, zero, zero), per_point)
    return jnp.stack(total, 1) / n


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def form_factor_of_height(geometry: "SpotGeometry", height: jax.Array) -> jax.Array:
    """Return Phi [detector, 3, ...] of the surface point seen at `height`: in a raster it depends on h alone.

    Differentiable in `height` (the derivative is computed once and kept, not the 32 rim terms).
    """
    return form_factor(jnp.asarray(geometry.rims), *geometry.position(height))


@form_factor_of_height.defjvp
def _form_factor_jvp(geometry, primals, tangents):
    (height,), (dh,) = primals, tangents
    value, slope = jax.jvp(
        lambda h: form_factor(jnp.asarray(geometry.rims), *geometry.position(h)), (height,), (jnp.ones_like(height),)
    )
    return value, slope * dh


class SpotGeometry:
    """Where the illuminated point is in the lab frame, as a function of its height (hashable, static under jit)."""

    def __init__(self, instrument: Instrument, n_rim: int = N_RIM) -> None:
        self.instrument = instrument
        self.rims = rim_table(instrument, n_rim)
        self._key = (type(self).__name__, instrument.model_dump_json(), n_rim)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SpotGeometry) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def position(self, height: Any) -> tuple[Any, Any, Any]:
        """Return lab x, y and the depth below the plate [um]."""
        x, y, z = self.instrument.spot_position(height)
        return x, y, self.instrument.working_distance - z

    def form_factor(self, height: np.ndarray) -> np.ndarray:
        """Return Phi [detector, 3, ...] in float64 for NumPy heights [um]."""
        with jax.enable_x64(True):
            at = (jnp.asarray(x, jnp.float64) for x in self.position(np.asarray(height, np.float64)))
            return np.asarray(_jitted(jnp.asarray(self.rims, jnp.float64), *at))

    def flat_signal(self) -> np.ndarray:
        """Return the detection probability of the flat reference plane [detector]."""
        return self.form_factor(np.zeros(1))[:, 2, 0]


_jitted = jax.jit(form_factor)
