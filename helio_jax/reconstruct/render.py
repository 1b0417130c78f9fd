"""The differentiable render model of single scattering: corner heights -> expected detection probabilities (JAX).

The unknowns are the heights at the corners of the pixels: each pixel is a quad with a height (mean of its four
corners) and two slopes, and a depth jump stays inside the one pixel that contains it. P_k = n . (Phi_k(h) -
hidden_k) with the near-field form factor and the hidden part of it (masks and horizon) as a given constant.
Compared in tests/physics/test_render.py with the tracer, with which it shares no kernel.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.reconstruct.beamframe import normal_of_slopes
from helio_jax.reconstruct.formfactor import SpotGeometry, form_factor_of_height


class Quads(NamedTuple):
    """Height and slopes of every pixel [y, x]."""

    height: Any
    slope_x: Any
    slope_y: Any


def quads_of_corners(corners: Any, dx: float, dy: float) -> Quads:
    """Return the pixels' heights [um] and slopes from corner heights [y + 1, x + 1], um; pitches in um."""
    south, north = corners[:-1], corners[1:]
    sw, se, nw, ne = south[:, :-1], south[:, 1:], north[:, :-1], north[:, 1:]
    return Quads(0.25 * (sw + se + nw + ne), 0.5 * (se - sw + ne - nw) / dx, 0.5 * (nw - sw + ne - se) / dy)


def render_single(corners: jax.Array, hidden: jax.Array, geometry: SpotGeometry, dx: float, dy: float) -> jax.Array:
    """Return the single-scattering detection probability of every pixel [detector, y, x].

    Args:
        corners: heights at the pixel corners [y + 1, x + 1], um.
        hidden: hidden part of the form factor [detector, 3, y, x].
        geometry: where a point of a given height is, static.
        dx, dy: raster pitch, um.
    """
    quads = quads_of_corners(corners, dx, dy)
    nx, ny, nz = normal_of_slopes(quads.slope_x, quads.slope_y, geometry.instrument.beam_shift)
    phi = form_factor_of_height(geometry, quads.height) - hidden
    length = jnp.sqrt(nx * nx + ny * ny + nz * nz)
    return (nx * phi[:, 0] + ny * phi[:, 1] + nz * phi[:, 2]) / length


def corners_of_pixels(height: np.ndarray, jump: float) -> np.ndarray:
    """Return corner heights [y + 1, x + 1] of pixel heights [y, x], um.

    A corner is the mean of its pixels; where they differ by more than `jump` [um] it takes the mean of the upper
    ones only, so that a depth jump is not spread over the pixels on both of its sides.
    """
    padded = np.pad(height, 1, mode="edge")
    four = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
    middle = 0.5 * (four.max(0) + four.min(0))
    is_upper = (four >= middle) | (np.ptp(four, axis=0) <= jump)
    return (four * is_upper).sum(0) / is_upper.sum(0)
