"""Multiple scattering by radiosity on the height raster, differentiable in heights and normals (JAX).

By reciprocity the multiple scattering of a pixel is the irradiance it would receive if the detectors emitted:
I_i = sum_j F_ij (g_j(i) + I_j) with the form factor F_ij of point j seen from point i, the chance g_j(i) that an atom
leaving j is detected directly while the beam is at pixel i, and the point's own multiple scattering I_j. Cosine law.

In the beam frame (x + z tx, y + z ty, z) the surface is one height per raster position and straight lines stay
straight. A receiver looks along a number of azimuths and marches over the raster: what rises above the horizon so far
uncovers a strip, whose form factor is known in closed form from its two slopes of sight. So visibility is part of the
march, near neighbours are no special case, and rows of F sum to the form factor of all below the horizon, at most 1.
Pixels receive; the cells between them send, with the mean of their corners' multiple scattering. Steep cells are cut
into levels, which do both: a depth jump is taken for a wall along the beam, as by the tracer's triangulation. Outside
of the raster lies a flat at z = 0, one strip per azimuth.

Approximations, with measured errors in tests/physics/test_indirect.py: few azimuths; one value per cell or level; a
level looks from its cell's lowest pixel; what hides a detector from a sender, and orders above 2, are taken with the
beam at the sender instead of at the pixel. Which strips are visible is planned and then held fixed: at an edge of
visibility a strip has no width, so the derivative is right all the same. Source: own derivation; Goral et al., SIGGRAPH
1984 (radiosity); Max, Vis. Comput. 4 (1988) 109 (horizons).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.arguments import checked
from helio_jax.errors import SceneError
from helio_jax.forward.masking import Slices, slice_apertures
from helio_jax.forward.optics import Optics, Raster, cast
from helio_jax.forward.surface import normal_of_slopes

MERGE = 1.4
"""Strips between two powers of this in distance are seen as one ..."""
MAX_MERGE_RELIEF = 0.5
"""... if the height changes by less than this within each, in pitches of the raster."""
LEVEL = 1.0
"""Height of a steep cell's levels, in pitches of the raster; a cell that is lower has none ..."""
MAX_LEVELS = 12
"""... and none has more than this."""
N_AZIMUTHS = 24
"""Directions in which a receiver looks."""
N_NODES = 8
"""Points on an aperture that receive what a sender emits."""
N_SLICES = 6
"""Azimuths along which each aperture is tested for being hidden."""
TOLERANCE = 1e-7
"""The Neumann series ends when its term is this small against the first one ..."""
MAX_TERMS = 200
"""... or after this many terms."""
_BLOCK = 1 << 14  # most receivers that march together
_GRAZING = 1e-5  # slope above the own tangent plane from which on something is seen: a plane does not see itself
_NOWHERE = -1e9  # height outside of the raster, um: never seen


class Interpolation(NamedTuple):
    """Frozen places on the surface, of height (1 - share) h[first] + share h[second] for flat indices of pixels."""

    first: Any
    second: Any
    share: Any

    def of(self, heights: Any) -> Any:
        """Interpolate the heights there, um, of `heights` [pixel + 1], the last of which is the flat outside."""
        return (1.0 - self.share) * heights[self.first] + self.share * heights[self.second]


class Strips(NamedTuple):
    """What receivers see, frozen [azimuth, strip]; those of one receiver follow each other outwards without a gap.

    Of every strip: the receiver (beyond the last point: no strip) and the point that it belongs to, its far end, that
    one's distance and the distance of its middle [um].
    """

    receiver: Any
    sender: Any
    end: Interpolation
    distance: Any
    middle: Any


class Plan(NamedTuple):
    """What is held fixed.

    Attributes:
        place: where the levels of steep cells get their heights, some to spare [level].
        cell: number of each level's cell [level].
        visible: unmasked share of each aperture, seen from each sender [sender, detector].
        strips: what the receivers see.
        directions: azimuths in which the receivers look [azimuth, 2].
    """

    place: Interpolation
    cell: Any
    visible: Any
    strips: Strips
    directions: Any


class Cells(NamedTuple):
    """The raster's cells, frozen: lowest and highest corner, number of levels, number of the first one [cell]."""

    lowest: np.ndarray
    highest: np.ndarray
    n_levels: np.ndarray
    level: np.ndarray


class Receivers(NamedTuple):
    """Pixels, and levels, each at its cell's lowest pixel: flat index, height [um] and normal [receiver]."""

    pixel: np.ndarray
    height: np.ndarray
    normal: np.ndarray

    def tangent(self, direction: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
        """Compute the slope of the tangent planes along an azimuth."""
        return -(self.normal[:, :2] @ direction) / (self.normal @ [-shift[0], -shift[1], 1.0])


class Crossings(NamedTuple):
    """Where a ray crosses the grid lines, by growing distance, um, infinite where the raster has ended [step], static.

    The height is interpolated between two pixels, at rows and columns [step, 2] from the receiver's.
    """

    first: np.ndarray
    second: np.ndarray
    share: np.ndarray
    distance: np.ndarray


@checked
def plan_radiosity(
    height: np.ndarray,
    normals: np.ndarray,
    optics: Optics,
    raster: Raster,
    *,
    substrate_um: float | None = None,
    n_azimuths: int = N_AZIMUTHS,
) -> Plan:
    """Find the points of a surface and the strips that each of them sees (host work: NumPy; no tracers).

    Valid for normals that face the beam and heights below the plate.

    Args:
        height: above the substrate [y, x], um.
        normals: unit normals [y, x, 3].
        optics: the instrument.
        raster: at least 2 x 2 beam positions.
        substrate_um: side of the substrate about the z axis; default: half an image beyond each border.
        n_azimuths: directions in which a receiver looks; a multiple of 4.

    Raises:
        SceneError: the images were taken with several beams.

    Example:
        >>> plan = hx.plan_radiosity(rec.height, rec.normals, optics, raster)
        >>> hx.render(rec.height, optics, raster, corrections=plan)
    """
    if optics.beam_shifts is not None:
        raise SceneError("radiosity knows one beam, these images were taken with several: have them traced instead")
    height, normals = np.asarray(height, np.float64), np.asarray(normals, np.float64)
    optics, raster = (jax.tree.map(lambda a: np.asarray(a, np.float64), tree) for tree in (optics, raster))
    pitches, shift = (raster.dy, raster.dx), optics.beam_shift
    border = max(np.abs(raster.x).max(), np.abs(raster.y).max())
    reach = border + 0.5 * max(np.ptp(raster.x), np.ptp(raster.y)) if substrate_um is None else 0.5 * substrate_um
    azimuth = 2.0 * np.pi * (np.arange(n_azimuths) + 0.5) / n_azimuths
    directions = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    cells, place, cell = _cut(height, LEVEL * max(pitches))
    with jax.enable_x64(True):
        z, normal = _receivers(jnp.asarray(height), jnp.asarray(normals), place, cell, pitches, shift)
        slices = jax.tree.map(np.asarray, _sliced(optics))
    receivers = Receivers(np.append(np.arange(height.size), place.first), np.asarray(z), np.asarray(normal))
    parts = [Slices(*(column[k] for column in slices)) for k in range(optics.n_detectors)]
    visible = np.stack([_visible_share(height, receivers, part, pitches, shift) for part in parts], -1)
    with jax.enable_x64(True):
        visible = np.asarray(_spread(visible, height.shape, 1.0))
    rows = [_visible_strips(height, cells, len(visible) - 1, receivers, e, raster, shift, reach) for e in directions]
    width = _roomy(max(len(row.receiver) for row in rows))
    strips = jax.tree.map(lambda *row: np.stack([_filled(a, width) for a in row]), *rows)
    is_strip = np.arange(width) < np.array([[len(row.receiver)] for row in rows])
    strips = strips._replace(receiver=np.where(is_strip, strips.receiver, len(receivers.pixel)).astype(np.int32))
    return Plan(place, cell, visible, strips, directions)


@jax.jit
def _sliced(optics: Optics) -> Slices:
    return slice_apertures(optics, N_SLICES)


def radiosity(height: Any, normals: Any, optics: Optics, raster: Raster, plan: Plan, albedo: Any = None) -> jax.Array:
    """Compute the multiple scattering, orders 2 and above [detector, y, x], for a fixed plan; differentiable.

    Of an atom that its own pixel has scattered: the albedo of that pixel is not included.

    Args:
        height: above the substrate [y, x], um.
        normals: unit normals [y, x, 3].
        optics: the instrument.
        raster: beam positions.
        plan: from `plan_radiosity` on this surface, or one that differs little.
        albedo: of the pixels, that of the substrate outside being 1 [y, x]; default: 1.
    """
    height = jnp.asarray(height)
    plan, optics, steps = (cast(part, height.dtype) for part in (plan, optics, (raster.dy, raster.dx)))
    sent = jnp.ones((), height.dtype)
    if albedo is not None:
        pixels = jnp.ravel(albedo)
        sent = _spread(jnp.append(pixels, plan.place.of(jnp.append(pixels, 1.0))), height.shape, 1.0)
    weight, second = transfer(height, jnp.asarray(normals), optics, steps, plan, sent)

    def remainder(irradiance):
        emitted = jnp.expand_dims(sent, -1) * _spread(irradiance, height.shape, 0.0)
        return irradiance - _gather(plan.strips, weight, emitted, len(irradiance))

    total = jax.lax.custom_linear_solve(remainder, second, _neumann, _neumann)
    return total[: height.size].T.reshape(-1, *height.shape)


def _visible_share(height, receivers: Receivers, slices: Slices, pitches, shift) -> np.ndarray:
    """Compute the share of the irradiance above their own horizon that the sample leaves receivers, beam at them."""
    normal = receivers.normal[:, None]
    node, weight = np.polynomial.legendre.leggauss(3)
    visible, total = np.zeros(len(receivers.height)), np.full(len(receivers.height), 1e-300)
    for e, near, far, azimuth, plate, rise in zip(*slices, strict=True):
        tangent = receivers.tangent(e, shift)
        horizon = _march(height, receivers, tangent, _crossings(e, height.shape, pitches), 0.0)[0]
        depth = plate - receivers.height[:, None]
        for irradiance, edge in ((visible, horizon), (total, tangent)):
            length = (depth / np.maximum(edge[:, None] - rise, 1e-9)).clip(near, far) - near
            u = near + 0.5 * (node + 1.0) * length
            up = depth + rise * u
            x, y = (u * e[axis] - up * shift[axis] for axis in (0, 1))
            irradiance += azimuth * (length * weight * u * _irradiance(normal, x, y, up, np)).sum(-1)
    return np.minimum(visible / total, 1.0)


def _visible_strips(
    height, cells: Cells, outside: int, receivers: Receivers, direction, raster: Raster, shift, reach
) -> Strips:
    """Find the strips that receivers see along an azimuth, in the order of the receivers [strip]."""
    pitches = (raster.dy, raster.dx)
    crossings, tangent = _crossings(direction, height.shape, pitches), receivers.tangent(direction, shift)
    horizon, codes = _march(height, receivers, tangent, crossings, MAX_MERGE_RELIEF * max(pitches))
    strips = _label_strips(height, cells, receivers, direction[::-1] / pitches, crossings, tangent, codes)
    # the substrate outside
    row, column = np.divmod(receivers.pixel, height.shape[1])
    x, y = raster.x[0] + column * raster.dx, raster.y[0] + row * raster.dy
    far = np.min([(reach * np.sign(e) - v) / e for e, v in zip(direction, (x, y), strict=True)], 0)
    i = np.flatnonzero((horizon < 0.0) & (-receivers.height > horizon * far))
    none = np.full(i.size, height.size)
    middle = 2.0 / (1.0 / far[i] - horizon[i] / receivers.height[i])
    flat = Strips(i, np.full(i.size, outside), Interpolation(none, none, 0.0 * middle), far[i], middle)
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), strips, flat)
    order = np.argsort(joined.receiver, kind="stable")
    return jax.tree.map(lambda a: a[order].astype(np.int32 if a.dtype.kind == "i" else np.float64), joined)


def _roomy(count: int) -> int:
    """Round `count` up by at most an eighth, so that compiled code fits surfaces that differ a little."""
    unit = 1 << max(0, count.bit_length() - 4)
    return -(-count // unit) * unit


def _filled(array: np.ndarray, length: int) -> np.ndarray:
    """Extend an array to a length by copies of its last element."""
    return np.pad(array, (0, length - len(array)), mode="edge")


def _cut(height: np.ndarray, tall: float) -> tuple[Cells, Interpolation, np.ndarray]:
    """Cut the raster's steep cells into levels: the cells, and of all levels the places and numbers of cells."""
    corners = np.stack(_corners(np.arange(height.size).reshape(height.shape))).reshape(4, -1)
    heights, columns = height.ravel()[corners], np.arange(corners.shape[1])
    lowest, highest = (corners[f(heights, 0), columns] for f in (np.argmin, np.argmax))
    n_levels = np.ceil(np.ptp(heights, 0) / tall).astype(int).clip(max=MAX_LEVELS)
    n_levels[n_levels == 1] = 0
    first, cell = np.cumsum(n_levels) - n_levels, np.repeat(columns, n_levels)
    share = (np.arange(len(cell)) - first[cell] + 0.5) / n_levels[cell]
    room = _roomy(len(cell) + 1)
    cell, share = _filled(np.append(cell, 0), room), _filled(np.append(share, 0.5), room)
    return Cells(lowest, highest, n_levels, first), Interpolation(lowest[cell], highest[cell], share), cell


def _corners(image: Any) -> tuple[Any, Any, Any, Any]:
    """Values of an image [y, x, ...] at the corners of its cells, four of [y - 1, x - 1, ...]."""
    return image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]


def _cell_normals(height, pitches, shift):
    """Compute the unit normals [cell, 3] of the raster's cells, differentiable."""
    h00, h01, h10, h11 = _corners(height)
    slopes = 0.5 * (h01 + h11 - h00 - h10) / pitches[1], 0.5 * (h10 + h11 - h00 - h01) / pitches[0]
    normal = jnp.stack(normal_of_slopes(*slopes, shift), -1).reshape(-1, 3)
    return normal / jnp.sqrt(jnp.sum(normal**2, -1, keepdims=True))


def _receivers(height, normals, place: Interpolation, cell, pitches, shift):
    """Compute heights [receiver], um, and unit normals [receiver, 3] of pixels and levels, differentiable."""
    level = _cell_normals(height, pitches, shift)[cell]
    return jnp.append(height, place.of(height.ravel())), jnp.concatenate([normals.reshape(-1, 3), level])


def _spread(values, shape: tuple[int, int], outside: float):
    """Compute senders' values from receivers': means of corners for cells, levels' own, `outside` for the flat."""
    n, rest = shape[0] * shape[1], values.shape[1:]
    cells = 0.25 * jnp.stack(_corners(values[:n].reshape(*shape, *rest))).sum(0).reshape(-1, *rest)
    return jnp.concatenate([cells, values[n:], jnp.full((1, *rest), outside, values.dtype)])


def _crossings(direction: np.ndarray, shape: tuple[int, int], pitches: tuple[float, float]) -> Crossings:
    """Find the crossings of a pixel's ray with the grid lines."""
    step = direction[::-1] / pitches
    parts = []
    for axis in (0, 1):
        distance = np.arange(1, shape[axis] + 1) / abs(step[axis])
        line, across = np.rint(distance * step[axis]), distance * step[1 - axis]
        first = np.stack([line, np.floor(across)], -1)[:, :: 1 - 2 * axis].astype(int)
        inside = np.abs(across) <= shape[1 - axis]
        parts.append([a[inside] for a in (first, first + [axis, 1 - axis], across % 1.0, distance)])
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[-1])
    ended = sum(shape) + 1 - len(order)
    first, second, share = (np.pad(c[order], ((0, ended), (0, 0))[: c.ndim]) for c in columns[:3])
    return Crossings(first, second, share, np.append(columns[3][order], np.full(ended, np.inf)))


def _march(height, receivers: Receivers, tangent, crossings: Crossings, tall: float) -> tuple[np.ndarray, np.ndarray]:
    """March over the raster, in single precision: horizons [receiver] and codes [receiver, step].

    Code: is the surface before the crossing seen: 0 no, 1 yes, 2 yes and it rises or falls by more than `tall`.
    """
    margin = [(n + 1, n + 1) for n in height.shape]
    padded = np.pad(height, margin, constant_values=_NOWHERE).astype(np.float32)
    to_flat = np.array([padded.shape[1], 1])
    base = (np.stack(np.divmod(receivers.pixel, height.shape[1]), -1) + np.array(height.shape) + 1) @ to_flat
    table = (crossings.first @ to_flat, crossings.second @ to_flat, *map(np.float32, crossings[2:]))
    tangent = tangent + _GRAZING * (1.0 + np.abs(tangent))
    columns = (base, receivers.height.astype(np.float32), tangent.astype(np.float32))
    horizon, codes = np.zeros(len(base)), np.zeros((len(base), sum(height.shape) + 1), np.int8)
    for start in range(0, len(base), _BLOCK):
        block = slice(start, min(start + _BLOCK, len(base)))
        n = block.stop - start
        out = _march_block(padded.ravel(), *(_filled(c[block], _roomy(n)) for c in columns), table, np.float32(tall))
        horizon[block], codes[block] = np.asarray(out[0])[:n], np.asarray(out[1])[:, :n].T
    return horizon, codes


@jax.jit
def _march_block(heights, base, own, tangent, table, tall):
    def visit(state, crossing):
        horizon, z_before = state
        first, second, share, distance = crossing
        z = (1.0 - share) * heights[base + first] + share * heights[base + second]
        slope = (z - own) / distance
        is_seen = (slope > horizon) & (distance < jnp.inf)
        code = is_seen.astype(jnp.int8) * (1 + (jnp.abs(z - z_before) > tall).astype(jnp.int8))
        return (jnp.where(is_seen, slope, horizon), z), code

    (horizon, _), codes = jax.lax.scan(visit, (tangent, own), table)
    return horizon, codes


def _label_strips(height, cells: Cells, receivers: Receivers, per_um, crossings: Crossings, tangent, codes) -> Strips:
    """Divide what is seen into strips of one sender each: pieces merge (`MERGE`) or are cut at their cell's levels."""
    flat, (ny, nx) = np.append(height, 0.0), height.shape
    before = np.append(0.0, crossings.distance[:-1])
    ring = np.floor(np.log(np.maximum(before, 1.0)) / np.log(MERGE))
    joins = (codes[:, 1:] == 1) & (codes[:, :-1] == 1) & (ring[1:] == ring[:-1])
    is_seen, whole = codes > 0, np.ones((len(codes), 1), bool)
    begin = np.nonzero(is_seen & np.concatenate([whole, ~joins], 1))[1]
    receiver, last = np.nonzero(is_seen & np.concatenate([~joins, whole], 1))

    def at(step: np.ndarray) -> Interpolation:
        offset = crossings.first[step], crossings.second[step]
        first, second = (receivers.pixel[receiver] + o @ [nx, 1] for o in offset)
        return Interpolation(first, second, crossings.share[step])

    near, far, end, own = before[begin], crossings.distance[last], at(last), receivers.height[receiver]
    z = np.where(begin == 0, own, at(begin - 1).of(flat)), end.of(flat)
    middle = np.stack(np.divmod(receivers.pixel[receiver], nx), -1) + 0.5 * (near + far)[:, None] * per_um
    number = np.floor(middle).astype(int).clip(0, [ny - 2, nx - 2]) @ [nx - 1, 1]
    cell = Cells(*(field[number] for field in cells))
    low, relief, most = flat[cell.lowest], np.ptp(flat[np.stack(cell[:2])], 0), np.maximum(cell.n_levels, 1)
    share = [(v - low) / np.maximum(relief, 1e-9) for v in z]
    first, final = (np.floor(most * s).clip(0, most - 1).astype(int) for s in share)
    # all levels of the receiver's own cell lie in one line of sight: the middle one stands for them
    first, final = (np.where(begin == 0, (first + final) // 2, a) for a in (first, final))
    n = abs(final - first) + 1
    i = np.repeat(np.arange(len(n)), n)  # one strip per level
    k = np.arange(len(i)) - (np.cumsum(n) - n)[i]
    level, is_last = first[i] + np.sign(final - first)[i] * k, k == n[i] - 1
    edge = (level + (final > first)[i]) / most[i]
    part = (edge - share[0][i]) / np.where(is_last, 1.0, (share[1] - share[0])[i])
    distance = np.where(is_last, far[i], near[i] + part.clip(0.0, 1.0) * (far - near)[i])
    levels = Interpolation(cell.lowest[i], cell.highest[i], edge)
    ends = Interpolation(*(np.where(is_last, a[i], b) for a, b in zip(end, levels, strict=True)))
    start = np.where(k == 0, near[i], np.roll(distance, 1))
    sender = np.where(cell.n_levels[i] > 0, len(cells.level) + cell.level[i] + level, number[i])
    strips = Strips(receiver[i], sender, ends, distance, 0.5 * (start + distance))
    # levels below the horizon are not seen
    top, slope = (z[1] - own) / far, (ends.of(flat) - own[i]) / distance
    horizon = np.where(receiver == np.roll(receiver, 1), np.roll(top, 1), tangent[receiver])
    keep = is_last | ((slope > horizon[i]) & (slope < top[i]))
    return jax.tree.map(lambda a: a[keep], strips)


def _irradiance(normal: Any, x: Any, y: Any, depth: Any, xp: Any) -> Any:
    """Compute max(n . r, 0) r_z / (pi |r|^4), the irradiance of a point by those of an aperture at r."""
    facing = normal[..., 0] * x + normal[..., 1] * y + normal[..., 2] * depth
    return xp.maximum(facing, 0.0) * depth / (np.pi * (x * x + y * y + depth * depth) ** 2)


def transfer(height, normals, optics: Optics, pitches, plan: Plan, albedo: Any = 1.0):
    """Compute the form factors of strips [azimuth, strip] and the direct flux that they bring [receiver, detector].

    A strip from slope m0 to m1 in a slice of azimuth e and width dphi has the vector form factor
    (dphi / pi) integral of D / |D|^4 dm with D = (e - m t, m), the direction of slope m; t is the beam shift.

    Args:
        height, normals: as in `radiosity`.
        optics: the instrument.
        pitches: dy, dx of the raster, um.
        plan: the strips.
        albedo: of the senders [sender], or a number.
    """
    shape, shift = height.shape, optics.beam_shift
    heights = jnp.append(height, 0.0)
    z, normal = _receivers(height, normals, plan.place, plan.cell, pitches, shift)
    upward = jnp.eye(3, dtype=height.dtype)[2:]
    sender_normal = jnp.concatenate([_cell_normals(height, pitches, shift), normal[height.size :], upward])
    position = optics.spot(_spread(z, shape, 0.0))
    # points of equal weight: right for cubic functions, to 1 % where the sender's own horizon cuts the aperture
    angle = 2.0 * np.pi * np.arange(N_NODES) / N_NODES
    circle = np.sqrt(0.5) * np.stack([np.cos(angle), np.sin(angle)]).astype(height.dtype)
    nodes = optics.center[:, None] + jnp.einsum("kin,nj->kji", optics.axes, circle)  # [detector, node, 3]
    area = jnp.cross(optics.axes[..., 0], optics.axes[..., 1])  # its vector, along the plate's normal
    share = plan.visible * (np.pi / N_NODES) * jnp.expand_dims(albedo, -1)
    steep = 1.0 + shift[0] ** 2 + shift[1] ** 2
    across = normal[:, 2] - normal[:, :2] @ shift

    def primitives(slope, toward):
        w, k2 = slope - toward, 1.0 / steep - toward**2
        k, q = jnp.sqrt(k2), w * w + k2
        zeroth = (w / q + jnp.arctan(w / k) / k) / (2.0 * k2 * steep**2)
        return jnp.stack([zeroth, toward * zeroth - 0.5 / (q * steep**2)])

    def add(total, row):
        e, strip = row
        i, j, toward = strip.receiver, strip.sender, e @ shift / steep
        along = normal[:, :2] @ e
        high = primitives((strip.end.of(heights) - z[i]) / strip.distance, toward)
        tangent = primitives(-along / across, toward)
        gain, up = high - jnp.where(i == jnp.roll(i, 1), jnp.roll(high, 1, 1), tangent[:, i])
        weight = 2.0 / len(plan.directions) * (along[i] * gain + across[i] * up)
        x, y = (position[axis][j] + strip.middle * e[axis] for axis in (0, 1))
        ray = jnp.stack(
            [nodes[..., 0, None] - x, nodes[..., 1, None] - y, nodes[..., 2, None] - position[2][j]]
        )  # [3, detector, node, strip]
        facing = jnp.maximum(jnp.einsum("iknj,ji->knj", ray, sender_normal[j]), 0.0)
        onto = jnp.einsum("iknj,ki->knj", ray, area)
        direct = (facing * onto / jnp.sum(ray**2, 0) ** 2 / np.pi).sum(1).T
        received = weight[:, None] * direct * share[j]
        return total.at[i].add(received, mode="drop"), weight

    start = jnp.zeros((len(z), optics.n_detectors), height.dtype)
    second, weight = jax.lax.scan(jax.checkpoint(add), start, (plan.directions, plan.strips))
    return weight, second


def _neumann(remainder: Callable[[jax.Array], jax.Array], first: jax.Array) -> jax.Array:
    """Solve remainder(x) = first, where remainder(x) = x - F x, by the series first + F first + F^2 first + ..."""

    def add(state):
        total, term, n = state
        return total + term, term - remainder(term), n + 1

    def is_open(state):
        return (state[2] < MAX_TERMS) & (jnp.abs(state[1]).max() > TOLERANCE * jnp.abs(first).max())

    return jax.lax.while_loop(is_open, add, (jnp.zeros_like(first), first, 0))[0]


def _gather(strips: Strips, weight: jax.Array, emitted: jax.Array, n: int) -> jax.Array:
    """Compute sum_j F_ij e_j [receiver, detector], n receivers, of what the senders emit, e [sender, detector]."""

    def add(total, row):
        receiver, sender, w = row
        return total.at[receiver].add(w[:, None] * emitted[sender], mode="drop"), None

    return jax.lax.scan(add, jnp.zeros((n, emitted.shape[1]), emitted.dtype), (strips.receiver, strips.sender, weight))[
        0
    ]
