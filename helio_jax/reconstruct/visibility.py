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

from helio_jax.arrays import WALL_PITCHES
from helio_jax.instrument import Aperture
from helio_jax.reconstruct.formfactor import SpotGeometry

_OUTSIDE = -1e9
"""Height outside of the raster [um]: hides nothing."""
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


class March(NamedTuple):
    """Where the ray of one azimuth crosses the grid lines of the raster, by growing distance, static.

    `first` and `second` [step, 2] are the raster positions (row, column), relative to the point, between which the
    height is interpolated, `share` [step] is that of the second; `distance` [step, um] is infinite off the raster. A
    wall half-way between two pixels was passed `since_across` [step, um] ago, if it separates those two, or
    `since_along`, if it runs beside both.
    """

    first: np.ndarray
    second: np.ndarray
    share: np.ndarray
    distance: np.ndarray
    since_across: np.ndarray
    since_along: np.ndarray


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


def plan_march(direction: np.ndarray, shape: tuple[int, int], dx: float, dy: float) -> March:
    """Return the crossings of a ray with all grid lines, where the surface is linear between two pixels.

    True of a triangulated and of a bilinear surface; what they do between the lines is where they differ.

    Args:
        direction: azimuth (x, y), unit.
        shape: of the raster (y, x).
        dx, dy: its pitch, um.
    """
    step = direction[::-1] / (dy, dx)  # (rows, columns) per um
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)
    parts = []
    for axis in (0, 1):
        distance = np.arange(1, shape[axis]) / np.abs(step[axis])
        across = distance * step[1 - axis]
        low = np.floor(across)
        is_inside = np.abs(across) <= shape[1 - axis] - 1
        first = np.stack([distance * step[axis], low], -1)[:, :: 1 - 2 * axis]
        first = np.where(is_inside[:, None], np.rint(first), 0.0).astype(np.int32)
        second = first + np.array([axis, 1 - axis], np.int32)
        since = np.abs(across - low - 0.5) / np.abs(step[1 - axis]), np.full(len(low), 0.5 / np.abs(step[axis]))
        parts.append((first, second, across - low, np.where(is_inside, distance, np.inf), *since))
    joined = March(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.argsort(joined.distance)
    return March(*(column[order] for column in joined))


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
    two samples are seen under the same slope, the nearer one takes the derivative. Costs two shifts of the raster per
    slice and grid line within reach of the mask.

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
    padded = jnp.pad(height, [(n, n) for n in shape], constant_values=_OUTSIDE)
    depth = instrument.sample_distance - height
    top, bottom = jnp.max(height), jnp.min(height)
    beyond_a_wall = np.hypot(dx, dy)

    def add_slice(total, item):
        piece, march = item
        # a sample at distance R matters where (top - h) / R > (D - h) / far - tail, soonest for h = bottom
        ceiling = instrument.sample_distance - _TAIL * width * piece.far
        reach = jnp.where(top < ceiling, piece.far * (top - bottom) / (ceiling - bottom) + beyond_a_wall, jnp.inf)
        seen = _find_horizon(*jax.lax.stop_gradient((padded, reach)), march, WALL_PITCHES * max(dx, dy), shape)
        tangent = slope_x * piece.direction[0] + slope_y * piece.direction[1]
        horizon = jnp.maximum(_slope_up(padded, height, march, seen), tangent)
        return total + _hidden_in_slice(horizon, depth, piece, instrument.beam_shift, width), None

    def of_aperture(items):
        return jax.lax.scan(add_slice, jnp.zeros((3, *shape), height.dtype), items)[0]

    return jax.lax.map(of_aperture, (as_input(slices), as_input(marches)))


def _stack(records: list) -> Any:
    """Return named tuples of arrays as one, with a new first axis."""
    return type(records[0])(*(np.stack(column) for column in zip(*records, strict=True)))


class Horizon(NamedTuple):
    """What a point sees steepest [y, x]: its step of the march, the share of the second pixel, and its distance, um."""

    step: jax.Array
    share: jax.Array
    distance: jax.Array


def _find_horizon(padded: jax.Array, reach: jax.Array, march: March, tall: float, shape: tuple[int, int]) -> Horizon:
    """Return where the surface is seen steepest; `reach`: how far to look [um], `tall`: least height of a wall [um].

    A crossing within a wall belongs to the nearer of its two pixels.
    """

    def view(corner):
        return jax.lax.dynamic_slice(padded, (corner[0] + shape[0], corner[1] + shape[1]), shape)

    here = padded[shape[0] : 2 * shape[0], shape[1] : 2 * shape[1]]

    def visit(s, state):
        best, horizon, before, passed = state
        first, second, far = view(march.first[s]), view(march.second[s]), march.distance[s]
        is_across = jnp.abs(second - first) > tall
        share = jnp.where(is_across, jnp.round(march.share[s]), march.share[s])
        there = (1.0 - share) * first + share * second
        across, beside = far - march.since_across[s], far - march.since_along[s]
        wall = jnp.where(is_across & (across > passed), across, beside)
        distance = jnp.where(there - before > tall, jnp.maximum(wall, passed), far)
        slope = (there - here) / distance
        found = Horizon(s.astype(jnp.int32), share, distance)
        horizon = Horizon(*(jnp.where(slope > best, new, old) for new, old in zip(found, horizon, strict=True)))
        return jnp.maximum(best, slope), horizon, there, far

    nothing = Horizon(jnp.zeros(shape, jnp.int32), *jnp.ones((2, *shape), padded.dtype))
    start = jnp.full(shape, -jnp.inf, padded.dtype), nothing, here, jnp.zeros((), padded.dtype)
    n_steps = jnp.searchsorted(march.distance, reach).astype(jnp.int32)
    return jax.lax.fori_loop(jnp.int32(0), n_steps, visit, start)[1]


def _slope_up(padded: jax.Array, height: jax.Array, march: March, horizon: Horizon) -> jax.Array:
    """Return the slope from each point up to its horizon [y, x]."""
    (ny, nx), columns = height.shape, padded.shape[1]
    here = (ny + jnp.arange(ny, dtype=jnp.int32))[:, None] * columns + nx + jnp.arange(nx, dtype=jnp.int32)

    def at(corner):
        return padded.ravel()[here + (corner[:, 0] * columns + corner[:, 1])[horizon.step]]

    first, second, share = at(march.first), at(march.second), horizon.share
    return ((1.0 - share) * first + share * second - height) / horizon.distance


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
