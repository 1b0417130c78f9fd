"""The part of each aperture's form factor that the sample masks, differentiable in surface, optics and raster (JAX).

In the beam frame (x + z tx, y + z ty, z), a shear that keeps lines straight, the surface is one height per raster
position and the plate's apertures stand still: whatever the height of the point, the rim is seen at the same place,
only the depth below it changes. So all pixels share the same vertical slices of an aperture, and marching along one is
shifting the raster. In a slice of azimuth e everything beyond the distance depth / horizon is masked, the horizon being
the steepest slope up to the surface ahead or the point's own tangent plane, whichever is higher. Between two pixels the
surface is linear, but a wall stands half-way. Nothing is taken to stand outside of the raster; where apertures overlap,
each counts the common part. Which sample is the horizon is chosen outside JAX (`horizon`) and constant under
differentiation; the smooth parts are derived, so that the derivative is exact away from ties.
Source: own derivation, tests/physics/test_visibility.py.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.errors import SceneError
from helio_jax.forward.compiling import compiled
from helio_jax.forward.horizon import ACROSS, BEFORE, BESIDE, OUTSIDE, find_horizons, steps_per_um
from helio_jax.forward.known_shapes import NO_HORIZON, PlacedShape
from helio_jax.forward.optics import Optics, Raster, cast
from helio_jax.forward.surface import Surface

N_SLICES = 12
"""Vertical slices per aperture."""
_TAIL = 20.0
"""Widths below the aperture within which a smoothed horizon still counts."""
_STRAIGHT_UP = 1e-6
"""Least near end of a slice in units of its far end: the slope of sight straight up along the beam is infinite."""
_TIE = 1e-9
"""Crossings that are closer than this [steps] are one."""


class Slices(NamedTuple):
    """Vertical slices of the apertures in the beam frame [detector, slice]; lengths in um, from the point outwards.

    `direction` [detector, slice, 2] is the azimuth e; the aperture reaches from `near` to `far`; the integral over
    azimuth is the sum with `weight` [rad]; `plate` is the height above the substrate of the aperture's plane on the
    beam axis, and `rise` its slope along the azimuth, 0 unless the plate is tilted.
    """

    direction: Any
    near: Any
    far: Any
    weight: Any
    plate: Any
    rise: Any


def slice_apertures(optics: Optics, n_slices: int) -> Slices:
    """Slice the apertures by vertical planes through the beam axis, which is every point's azimuthal centre.

    In the frame where the ellipse is a unit circle the chord at impact parameter p is 2 sqrt(1 - p^2) long, so the
    nodes are Gauss-Chebyshev's of the second kind in p: an aperture that is masked as a whole converges geometrically,
    one that is cut as n_slices^-2. An aperture around the beam is sliced all round.
    """
    optics = optics.of_raster()
    shift = jnp.asarray(optics.beam_shift)

    def of_aperture(center, axes):
        stretch = axes[:2] + shift[:, None] * axes[2]  # unit circle -> ellipse in the beam frame
        middle = center[:2] + shift * center[2]
        gradient = jnp.linalg.solve(stretch.T, axes[2])  # of the aperture's plane
        place = jnp.linalg.solve(stretch, middle)
        square = jnp.sum(place**2)
        is_aside = square > 1.0
        # beside the beam
        node = np.pi * np.arange(1, n_slices + 1) / (n_slices + 1)
        p, chord = (f(node).astype(center.dtype) for f in (np.cos, np.sin))
        safe = jnp.where(is_aside, square, 2.0)
        distance, foot = jnp.sqrt(safe), jnp.sqrt(safe - p**2)
        beside = (jnp.arcsin(p / distance), foot - chord, foot + chord, np.pi / (n_slices + 1) * chord / foot)
        # around the beam
        turn = (2.0 * np.pi * np.arange(n_slices) / n_slices).astype(center.dtype)
        safe = jnp.where(is_aside, 0.0, jnp.where(square > 0.0, square, 0.0))
        inner = jnp.where(safe > 0.0, jnp.sqrt(jnp.where(safe > 0.0, safe, 1.0)), 0.0)
        far = inner * jnp.cos(turn) + jnp.sqrt(1.0 - (inner * jnp.sin(turn)) ** 2)
        about = (turn, _STRAIGHT_UP * far, far, jnp.full(n_slices, 2.0 * np.pi / n_slices, center.dtype))
        azimuth, near, far, weight = (jnp.where(is_aside, a, b) for a, b in zip(beside, about, strict=True))
        azimuth = azimuth + jnp.where(square > 0.0, jnp.arctan2(place[1], jnp.where(square > 0.0, place[0], 1.0)), 0.0)
        ray = jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)], -1) @ stretch.T
        scale = jnp.sqrt(jnp.sum(ray**2, -1))
        direction = ray / scale[:, None]
        weight = weight * jnp.abs(jnp.linalg.det(stretch)) / scale**2
        plate = center[2] + optics.drop - gradient @ middle
        return Slices(
            direction, near * scale, far * scale, weight, jnp.broadcast_to(plate, (n_slices,)), direction @ gradient
        )

    return jax.vmap(of_aperture)(jnp.asarray(optics.center), jnp.asarray(optics.axes))


def masked_form_factor(
    surface: Surface,
    optics: Optics,
    raster: Raster,
    *,
    n_slices: int = N_SLICES,
    width: float = 0.0,
    horizons: jax.Array | None = None,
) -> jax.Array:
    """Compute the part of each aperture's vector form factor that lies below a point's horizon [detector, 3, y, x].

    P = n . (Phi - masked), as with `trace.masks.masked_form_factor`; exactly 0 where the whole aperture is in view.
    Valid for heights below the plate. Differentiable in heights (the point's and the masking ones), slopes, optics and
    pitch; where two samples are seen under the same slope, the nearer one takes the derivative.

    Args:
        surface: heights and slopes [y, x]; the slopes make the points' own horizon.
        optics: the instrument.
        raster: beam positions.
        n_slices: azimuth slices per aperture, static.
        width: smoothing of the mask's edge in slope of sight, static; 0 is exact.
        horizons: from `choose_horizons` with the same arguments; default: chosen.
    """
    height, slope_x, slope_y = (jnp.asarray(f) for f in (surface.height, surface.slope_x, surface.slope_y))
    dtype, shape = height.dtype, height.shape
    optics, (dx, dy) = cast(optics, dtype), (jnp.asarray(d, dtype) for d in (raster.dx, raster.dy))
    slices = slice_apertures(optics, n_slices)
    if horizons is None:
        horizons = choose_horizons(surface, optics, raster, n_slices, width)
    padded = jnp.pad(height, [(n, n) for n in shape], mode="edge")

    def horizon_of(piece: Slices, found: jax.Array) -> jax.Array:
        return _slope_up(padded, height, piece.direction, dx, dy, found)

    return _sum_slices(horizon_of, (slices, horizons), Surface(height, slope_x, slope_y), optics.beam_shift, width)


def masked_by_shape(
    shape: PlacedShape,
    optics: Optics,
    raster: Raster,
    surface: Surface,
    is_object: bool,
    *,
    n_slices: int = N_SLICES,
) -> jax.Array:
    """Compute what `masked_form_factor` does for a part of a known shape, by exact horizons [detector, 3, y, x].

    Independent of the pitch: no relief within a pixel is missed. Differentiable in shape and optics. `surface` and
    `is_object` are those of the part (`PlacedShape.parts`); the object, convex, masks only the substrate.
    """
    shift = jnp.asarray(optics.beam_shift)

    def horizon_of(piece: Slices) -> Any:
        return NO_HORIZON if is_object else shape.horizon(raster, shift, piece.direction)

    return _sum_slices(horizon_of, (slice_apertures(optics, n_slices),), surface, shift, 0.0)


def _sum_slices(horizon_of, items: tuple, surface: Surface, shift: Any, width: float) -> jax.Array:
    """Add the masked parts of all slices [detector, 3, y, x]; `items` [detector, slice] go to `horizon_of`."""
    height = surface.height

    @jax.checkpoint  # a gradient evaluates slices anew: kept, they would take twenty times the memory of the value
    def of_slice(piece, *rest):
        tangent = surface.slope_x * piece.direction[0] + surface.slope_y * piece.direction[1]
        horizon = jnp.maximum(horizon_of(piece, *rest), tangent)
        return _masked_in_slice(horizon, piece.plate - height, piece, shift, width)

    def add_slice(total, item):
        return jax.tree.map(jnp.add, total, of_slice(*item)), None

    def of_aperture(items):
        return jax.lax.scan(add_slice, (jnp.zeros(height.shape, height.dtype),) * 3, items)[0]

    return jnp.stack(jax.lax.map(of_aperture, items), 1)


def choose_horizons(
    surface: Surface, optics: Optics, raster: Raster, n_slices: int = N_SLICES, width: float = 0.0
) -> jax.Array:
    """Choose the horizons of all slices on the host [detector, slice, y, x], constant under differentiation.

    Arguments as those of `masked_form_factor`. Known ones are searched at once; give the result to compiled functions:
    JAX does not keep a program that calls the host, and each process would compile it again. Under a JAX transformation
    the program calls the host, once for a batch of surfaces or optics.

    Raises:
        SceneError: fewer than 2 x 2 beam positions, whose pitch is not known.
    """
    height = jnp.asarray(surface.height)
    if min(height.shape) < 2:
        raise SceneError(
            f"masks need at least 2 x 2 beam positions, got {' x '.join(map(str, height.shape))}: enlarge the "
            "raster, or render with corrections = 'none'"
        )
    table = _slice_table(cast(optics, height.dtype), n_slices)
    pitch, tail = jnp.stack([jnp.asarray(d, height.dtype) for d in (raster.dy, raster.dx)]), _TAIL * width
    shape = (*table.shape[:2], *height.shape)

    def choose(heights: np.ndarray, tables: np.ndarray, pitches: np.ndarray) -> np.ndarray:
        lead, n = heights.shape[:-2], math.prod(heights.shape[:-2])
        images, pieces = heights.reshape(n, *heights.shape[-2:]), tables.reshape(n, -1, tables.shape[-1])
        return find_horizons(images, pieces, tail, pitches.reshape(n, 2)).reshape(*lead, *shape)

    operands = [jax.lax.stop_gradient(a) for a in (height, table, pitch)]
    if not any(isinstance(a, jax.core.Tracer) for a in operands):
        return jnp.asarray(choose(*(np.asarray(a, np.float64) for a in operands)))
    return jax.pure_callback(
        lambda *batch: choose(*(_from_bits(a) for a in batch)),
        jax.ShapeDtypeStruct(shape, jnp.int32),
        *(_as_bits(a) for a in operands),
        vmap_method="broadcast_all",
    )


@compiled
def _slice_table(optics: Optics, n_slices: int) -> jax.Array:
    """Collect what `find_horizons` takes of the slices [detector, slice, number]."""
    slices = slice_apertures(optics, n_slices)
    columns = slices.direction[..., 0], slices.direction[..., 1], slices.plate, slices.far, slices.rise
    return jnp.stack(columns, -1)


def _as_bits(array: jax.Array) -> jax.Array:
    """Return a float64 array as pairs of integers, for a callback's own thread would round it to float32."""
    return jax.lax.bitcast_convert_type(array, jnp.uint32) if array.dtype == np.float64 else array


def _from_bits(array: Any) -> np.ndarray:
    array = np.ascontiguousarray(array)
    return array.view(np.float64)[..., 0] if array.dtype == np.uint32 else array.astype(np.float64)


def _slope_up(padded: jax.Array, height: jax.Array, direction: Any, dx: Any, dy: Any, found: jax.Array) -> jax.Array:
    """Compute the slope from each point up to its horizon [y, x], a crossing chosen by `find_horizons`."""
    (ny, nx), columns = height.shape, padded.shape[1]
    rounded, place, axis, number = found & 1, (found >> 1) & 3, (found >> 3) & 1, jnp.maximum(found >> 4, 1)
    rows, cols = steps_per_um(direction, dx, dy)
    own, other = jnp.where(axis == 0, rows, cols), jnp.where(axis == 0, cols, rows)
    distance = number / jnp.abs(own)
    across = distance * other
    low = jax.lax.stop_gradient(jnp.floor(across))
    share = across - low
    previous = jnp.ceil(jax.lax.stop_gradient(distance * jnp.abs(other)) - _TIE) - 1.0
    before = jnp.maximum(jnp.maximum((number - 1) / jnp.abs(own), previous / jnp.abs(other)), 0.0)
    across_wall = distance - jnp.abs(share - 0.5) / jnp.abs(other)
    at = jnp.where(place == ACROSS, across_wall, distance)
    at = jnp.where(place == BESIDE, distance - 0.5 / jnp.abs(own), at)
    at = jnp.where(place == BEFORE, before, at)
    along, side = number * jnp.sign(own).astype(jnp.int32), low.astype(jnp.int32)
    row, column = jnp.where(axis == 0, along, side), jnp.where(axis == 0, side, along)
    here = (ny + jnp.arange(ny, dtype=jnp.int32))[:, None] * columns + nx + jnp.arange(nx, dtype=jnp.int32)
    first = here + row * columns + column
    heights = padded.ravel()
    share = jnp.where(rounded == 1, jax.lax.stop_gradient(jnp.round(share)), share)
    there = (1.0 - share) * heights[first] + share * heights[first + jnp.where(axis == 0, 1, columns)]
    return jnp.where(found == 0, OUTSIDE, (there - height) / at)


def _masked_in_slice(horizon, depth, piece: Slices, shift: jax.Array, width: float) -> tuple[jax.Array, ...]:
    """Compute the vector form factor of the slice's part below the horizon slope, three components [y, x].

    Stacked, they would be evaluated three times over: XLA does not share terms between parts of an array.
    """
    low, high = (depth / edge + piece.rise for edge in (piece.far, piece.near))
    if width:
        above_low, above_high = (width * jax.nn.softplus((horizon - edge) / width) for edge in (low, high))
        cut = low + above_low - above_high
    else:
        cut = jnp.clip(horizon, low, high)
    toward = piece.direction[0] * shift[0] + piece.direction[1] * shift[1]
    across2 = 1.0 + shift[0] ** 2 + shift[1] ** 2 - toward**2
    up, out = (b - a for a, b in zip(*(_primitives(1.0 / s, toward, across2) for s in (cut, low)), strict=True))
    parts = piece.direction[0] * out - shift[0] * up, piece.direction[1] * out - shift[1] * up, up
    return tuple(jnp.where(cut > low, part * (piece.weight / np.pi), 0.0) for part in parts)


def _primitives(u, toward, across2):
    """Compute the integrals of u / q^2 and u^2 / q^2 over u, with q = (u - toward)^2 + across2.

    A direction of the slice is d (u e - t, 1) for the distance u in units of the depth d, and t the beam shift: its
    squared length is d^2 q, and cos(theta_d) r / (pi r^3) dA = (u e - t, 1) u / (pi q^2) du dphi.
    """
    w = u - toward
    q, across = w * w + across2, jnp.sqrt(across2)
    angle = jnp.arctan(w / across) / across
    first, second, plain = -0.5 / q, 0.5 * (angle - w / q), 0.5 * (angle + w / q) / across2
    return first + toward * plain, second + 2.0 * toward * first + toward**2 * plain
