"""The part of each aperture's form factor that the sample hides, differentiable in heights and slopes (JAX).

In the beam frame (x + z tx, y + z ty, z), a shear that keeps lines straight, the surface is one height per raster
position and the plate's apertures stand still: the rim, seen from a point, is at c + W (tx, ty) whatever its height,
only the depth d = D - h below it changes. So all pixels share the same vertical slices of an aperture, and marching
along one is shifting the raster. In a slice of azimuth e everything beyond the distance d / horizon is hidden, the
horizon being the steepest slope up to the surface ahead or the point's own tangent plane, whichever is higher.
Between two pixels the surface is linear, but a wall stands half-way. Nothing is taken to stand outside of the
raster; where apertures overlap, each counts the common part.
Source: own derivation, tests/physics/test_visibility.py; horizons of height fields: Max, Vis. Comput. 4 (1988) 109.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.detector import Aperture
from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.horizon import OUTSIDE, March, at_horizon, find_horizons, plan_march

_TAIL = 20.0
"""Widths below the aperture within which a smoothed horizon still counts."""


class Slices(NamedTuple):
    """Vertical slices of an aperture in the beam frame, static [slice]; lengths in um, from the point outwards.

    `direction` [slice, 2] is the azimuth e; the aperture reaches from `near` to `far`; the integral over azimuth is
    the sum with `weight` [rad].
    """

    direction: np.ndarray
    near: np.ndarray
    far: np.ndarray
    weight: np.ndarray


def slice_aperture(aperture: Aperture, pinhole: np.ndarray, n_slices: int) -> Slices:
    """Slice an aperture by vertical planes through the pinhole, which is every point's azimuthal centre.

    In the frame where the ellipse is a unit circle the chord at impact parameter p is 2 sqrt(1 - p^2) long, so the
    nodes are Gauss-Chebyshev's of the second kind in p: an aperture that is hidden as a whole converges geometrically,
    one that is cut as n_slices^-2. An aperture around the pinhole is sliced all round.

    Args:
        aperture: the ellipse on the plate, lab frame.
        pinhole: centre (x, y) of the pinhole, lab frame [um].
        n_slices: number of slices.
    """
    cos, sin = np.cos(aperture.rotation), np.sin(aperture.rotation)
    stretch = np.array([[cos, -sin], [sin, cos]]) * aperture.semi_axes  # unit circle -> ellipse
    center = np.linalg.solve(stretch, np.asarray(aperture.center) - pinhole)
    distance, azimuth = np.linalg.norm(center), np.arctan2(center[1], center[0])
    if distance > 1.0:
        node = np.pi * np.arange(1, n_slices + 1) / (n_slices + 1)
        p, chord = np.cos(node), np.sin(node)
        foot = np.sqrt(distance**2 - p**2)
        azimuth, weight = azimuth + np.arcsin(p / distance), np.pi / (n_slices + 1) * chord / foot
        near, far = foot - chord, foot + chord
    else:
        turn = 2.0 * np.pi * np.arange(n_slices) / n_slices
        foot, p = distance * np.cos(turn), distance * np.sin(turn)
        azimuth, weight = azimuth + turn, np.full(n_slices, 2.0 * np.pi / n_slices)
        far = foot + np.sqrt(1.0 - p**2)
        near = 1e-6 * far  # not 0: the slope of sight straight up along the beam is infinite
    ray = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) @ stretch.T
    scale = np.linalg.norm(ray, axis=1)
    return Slices(ray / scale[:, None], near * scale, far * scale, weight * np.prod(aperture.semi_axes) / scale**2)


def hidden_form_factor(
    height: jax.Array | np.ndarray,
    slope_x: jax.Array | np.ndarray,
    slope_y: jax.Array | np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    *,
    n_slices: int = 12,
    width: float = 0.0,
) -> jax.Array:
    """Return the part of each aperture's vector form factor that is below a point's horizon [detector, 3, y, x].

    P = n . (Phi - hidden), as with `trace.masks.hidden_form_factor`; exactly 0 where the whole aperture is in view.
    Valid for heights below the plate. Differentiable in heights (the point's and the blocking ones) and slopes; where
    two samples are seen under the same slope, the nearer one takes the derivative.

    Args:
        height: beam-frame heights [y, x], um.
        slope_x, slope_y: slopes dh/dX, dh/dY of the surface at the points, for their own horizon [y, x].
        geometry: the instrument, static.
        dx, dy: raster pitch, um, static.
        n_slices: azimuth slices per aperture, static.
        width: smoothing of the mask's edge in slope of sight, static; 0 is exact.
    """
    with jax.enable_x64(True):
        return _hidden_form_factor(height, slope_x, slope_y, geometry, float(dx), float(dy), n_slices, float(width))


def hidden_response(
    height: np.ndarray,
    slope_x: np.ndarray,
    slope_y: np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    change: np.ndarray,
) -> jax.Array:
    """Return the derivative of `hidden_form_factor` [detector, 3, y, x] along a change of the heights [y, x]."""
    with jax.enable_x64(True):
        return _hidden_response(jnp.asarray(height), slope_x, slope_y, geometry, float(dx), float(dy), change)


@partial(jax.jit, static_argnums=(3, 4, 5))
def _hidden_response(height, slope_x, slope_y, geometry, dx, dy, change):
    return jax.jvp(
        lambda h: hidden_form_factor(h, slope_x, slope_y, geometry, dx, dy), (height,), (jnp.asarray(change),)
    )[1]


@partial(jax.jit, static_argnums=(3, 4, 5, 6, 7))
def _hidden_form_factor(height, slope_x, slope_y, geometry, dx, dy, n_slices, width):
    instrument, shape = geometry.instrument, height.shape
    pinhole = instrument.pinhole_center[:2]
    slices = _stack([slice_aperture(a, pinhole, n_slices) for a in instrument.apertures()])
    marches = _stack([_stack([plan_march(e, shape, dx, dy) for e in row]) for row in slices.direction])
    as_input = partial(jax.tree.map, lambda a: jnp.asarray(a, height.dtype if a.dtype.kind == "f" else a.dtype))
    padded = jnp.pad(height, [(n, n) for n in shape], constant_values=OUTSIDE)
    depth = instrument.sample_distance - height

    def choose(bits: Any) -> np.ndarray:
        heights = np.ascontiguousarray(bits).view(np.float64)[..., 0]
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), marches)
        found = find_horizons(heights, instrument.sample_distance, slices.far.ravel(), _TAIL * width, flat, dx, dy)
        return found.reshape(*slices.far.shape, *shape)

    # as bits, for a callback's own thread would round them to float32
    bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(height).astype(jnp.float64), jnp.uint32)
    chosen = jax.pure_callback(choose, jax.ShapeDtypeStruct((*slices.far.shape, *shape), jnp.int32), bits)

    @jax.checkpoint  # a gradient evaluates slices anew: kept, they would take twenty times the memory of the value
    def of_slice(piece, march, found):
        tangent = slope_x * piece.direction[0] + slope_y * piece.direction[1]
        horizon = jnp.maximum(_slope_up(padded, height, march, found), tangent)
        return _hidden_in_slice(horizon, depth, piece, instrument.beam_shift, width)

    def add_slice(total, item):
        return total + of_slice(*item), None

    def of_aperture(items):
        return jax.lax.scan(add_slice, jnp.zeros((3, *shape), height.dtype), items)[0]

    return jax.lax.map(of_aperture, (as_input(slices), as_input(marches), chosen))


def _stack(records: list) -> Any:
    """Return named tuples of arrays as one, with a new first axis."""
    return type(records[0])(*(np.stack(column) for column in zip(*records, strict=True)))


def _slope_up(padded: jax.Array, height: jax.Array, march: March, found: jax.Array) -> jax.Array:
    """Return the slope from each point up to its horizon [y, x]."""
    (ny, nx), columns = height.shape, padded.shape[1]
    here = (ny + jnp.arange(ny, dtype=jnp.int32))[:, None] * columns + nx + jnp.arange(nx, dtype=jnp.int32)
    step, share, distance = at_horizon(march, found)

    def at(corner):
        return padded.ravel()[here + (corner[:, 0] * columns + corner[:, 1])[step]]

    return ((1.0 - share) * at(march.first) + share * at(march.second) - height) / distance


def _hidden_in_slice(horizon, depth, piece: Slices, shift: tuple[float, float], width: float) -> jax.Array:
    """Return the vector form factor of the slice's part below the horizon slope [3, y, x]."""
    low, high = depth / piece.far, depth / piece.near
    if width:
        above_low, above_high = (width * jax.nn.softplus((horizon - edge) / width) for edge in (low, high))
        cut = low + above_low - above_high
    else:
        cut = jnp.clip(horizon, low, high)
    toward = piece.direction[0] * shift[0] + piece.direction[1] * shift[1]
    across2 = 1.0 + shift[0] ** 2 + shift[1] ** 2 - toward**2
    up, out = (b - a for a, b in zip(*(_primitives(1.0 / s, toward, across2) for s in (cut, low)), strict=True))
    part = [piece.direction[0] * out - shift[0] * up, piece.direction[1] * out - shift[1] * up, up]
    return jnp.where(cut > low, jnp.stack(part) * (piece.weight / np.pi), 0.0)


def _primitives(u, toward, across2):
    """Return the integrals of u / q^2 and u^2 / q^2 over u, with q = (u - toward)^2 + across2.

    A direction of the slice is d (u e - t, 1) for the distance u in units of the depth d, and t the beam shift: its
    squared length is d^2 q, and cos(theta_d) r / (pi r^3) dA = (u e - t, 1) u / (pi q^2) du dphi.
    """
    w = u - toward
    q, across = w * w + across2, jnp.sqrt(across2)
    angle = jnp.arctan(w / across) / across
    first, second, plain = -0.5 / q, 0.5 * (angle - w / q), 0.5 * (angle + w / q) / across2
    return first + toward * plain, second + 2.0 * toward * first + toward**2 * plain
