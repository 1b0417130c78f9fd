"""Objects of known shape on a flat substrate, as the beam sees them: exact heights, normals and horizons (JAX).

Each shape knows its own frame (z up, z = 0 on the substrate, the object about the origin) and two closed forms there:
the first hit of the beam, and the steepest slope up to the object from a point of the substrate. `PlacedShape` puts it
into the sample frame: place, azimuth, and the substrate's tilt against the plate, the stage moving along the plate. A
tilt turns the beam in the shape's frame, so it is exact as well. All is differentiable in shape, place and beam; which
pixels lie on the object is constant under differentiation.
Source: own derivation; tests/physics/test_known_shapes.py compares with the tracer.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from helio_jax.forward.optics import Optics, Raster, rotation_matrix
from helio_jax.forward.surface import Surface

NO_HORIZON = -1e9
"""Slope of a horizon where nothing rises."""
_TINY = 1e-12


class Hit(eqx.Module):
    """First hits of the beam: heights [y, x], normals [3, y, x], and which lie on the object [y, x]."""

    height: Any
    normal: Any
    is_object: Any


class Flat(eqx.Module):
    """The bare substrate."""

    def hit(self, x: Any, y: Any, shift: Any) -> Hit:
        """Compute the first hits at beam positions (x, y) [y, x], um, of a beam of that shift per um of depth."""
        return Hit(jnp.zeros_like(x), _upward(x), jnp.zeros(x.shape, bool))

    def horizon(self, x: Any, y: Any, direction: Any, shift: Any) -> Any:
        """Compute the slope up to the object [y, x] from the substrate at beam positions (x, y), along a direction."""
        return jnp.full_like(x, NO_HORIZON)


class Ball(eqx.Module):
    """A ball of `radius` whose top stands `height` above the substrate, 0 < height <= 2 radius [um]."""

    radius: Float[Any, ""]
    height: Float[Any, ""]

    def hit(self, x: Any, y: Any, shift: Any) -> Hit:
        """Compute the first hits, see `Flat.hit`."""
        depth = self.height - self.radius  # of the centre
        square = 1.0 + shift @ shift
        half = x * shift[0] + y * shift[1] + depth
        inside = half**2 - square * (x**2 + y**2 + depth**2 - self.radius**2)
        root = (half + jnp.sqrt(jnp.where(inside > 0.0, inside, 1.0))) / square
        is_object = (inside > 0.0) & (root > 0.0)
        h = jnp.where(is_object, root, 0.0)
        normal = jnp.stack([x - h * shift[0], y - h * shift[1], h - depth]) / self.radius
        return Hit(h, jnp.where(is_object, normal, _upward(x)), is_object)

    def horizon(self, x: Any, y: Any, direction: Any, shift: Any) -> Any:
        """Compute the slope of the tangent to the ball, see `Flat.horizon`.

        The line from the point v (relative to the centre) along e + s w, w = (-t, 1), touches the ball where (v . (e +
        s w))^2 = |e + s w|^2 (|v|^2 - R^2): a quadratic in the slope s.
        """
        depth = self.height - self.radius
        e_w = -(direction @ shift)
        w_w = 1.0 + shift @ shift
        v_e = x * direction[0] + y * direction[1]
        v_w = -x * shift[0] - y * shift[1] - depth
        outside = jnp.maximum(x**2 + y**2 + depth**2 - self.radius**2, 0.0)
        a, b, c = v_w**2 - outside * w_w, v_e * v_w - outside * e_w, v_e**2 - outside
        inside = b**2 - a * c
        meets = inside > 0.0
        q = -(b + jnp.where(b < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.where(meets, inside, 1.0)))
        slope = jnp.full_like(x, NO_HORIZON)
        for top, bottom in ((q, a), (c, q)):
            is_finite = meets & (jnp.abs(bottom) > _TINY * outside)
            s = jnp.where(is_finite, top, 0.0) / jnp.where(is_finite, bottom, 1.0)
            is_ahead = is_finite & (v_e + s * v_w < 0.0)  # the tangent point lies ahead
            slope = jnp.where(is_ahead, jnp.maximum(slope, s), slope)
        return slope


class Ramp(eqx.Module):
    """A straight step: an upper terrace for x < 0 at `height` [um], and a facet down to the substrate on its +x side.

    `cotangent` is that of the facet's angle to the substrate: 0 for a vertical wall.
    """

    height: Float[Any, ""]
    cotangent: Float[Any, ""]

    def hit(self, x: Any, y: Any, shift: Any) -> Hit:
        """Compute the first hits, see `Flat.hit`."""
        is_top = x - self.height * shift[0] <= 0.0
        run = self.cotangent - shift[0]  # of the facet's foot in the beam frame, per um of height
        is_lit = run > 0.0
        facet = (self.height * self.cotangent - x) / jnp.where(is_lit, run, 1.0)
        is_facet = ~is_top & is_lit & (facet > 0.0)
        height = jnp.where(is_top, self.height, jnp.where(is_facet, facet, 0.0))
        size = jnp.sqrt(1.0 + self.cotangent**2)
        face = jnp.stack([1.0 / size, 0.0 * size, self.cotangent / size])[:, None, None]
        return Hit(height, jnp.where(is_facet, face, _upward(x)), is_top | is_facet)

    def horizon(self, x: Any, y: Any, direction: Any, shift: Any) -> Any:
        """Compute the slope up to the upper edge, see `Flat.horizon`."""
        toward = jnp.where(jnp.abs(direction[0]) > _TINY, direction[0], _TINY)
        distance = (self.height * shift[0] - x) / toward
        is_ahead = distance > 0.0
        return jnp.where(is_ahead, self.height / jnp.where(is_ahead, distance, 1.0), NO_HORIZON)


Shape = Flat | Ball | Ramp


class PlacedShape(eqx.Module):
    """A shape in the sample frame.

    Attributes:
        shape: the object.
        place: (x, y) of its origin in the tilted substrate [um].
        azimuth: by which it is turned, counter-clockwise seen from above [rad].
        tilt: slopes dz/dx, dz/dy of the substrate, about the sample frame's origin.
    """

    shape: Shape
    place: Float[Any, "2"]
    azimuth: Float[Any, ""]
    tilt: Float[Any, "2"]

    def _frame(self) -> Any:
        """Compute the axes of the substrate, as columns [3, 3]."""
        about_y, about_x = -jnp.arctan(self.tilt[0]), jnp.arctan(self.tilt[1] * jnp.cos(jnp.arctan(self.tilt[0])))
        zero = jnp.zeros_like(about_x)
        return rotation_matrix(zero, about_y, zero) @ rotation_matrix(about_x, zero, self.azimuth)

    def _local(self, raster: Raster, shift: Any) -> tuple[Any, ...]:
        """Compute the axes, the beam's direction per um of depth, its shift and its positions, in the shape's frame."""
        axes = self._frame()
        beam = axes.T @ jnp.append(-shift, 1.0)
        x, y = jnp.meshgrid(raster.x, raster.y)
        ends = jnp.einsum("ji,jyx->iyx", axes, jnp.stack([x, y, jnp.zeros_like(x)]))
        local_shift = -beam[:2] / beam[2]
        cos, sin = jnp.cos(self.azimuth), jnp.sin(self.azimuth)
        place = jnp.stack([cos * self.place[0] + sin * self.place[1], cos * self.place[1] - sin * self.place[0]])
        at = ends[:2] + ends[2] * local_shift[:, None, None] - place[:, None, None]
        return axes, beam, local_shift, at

    def seen(self, raster: Raster, shift: Any) -> tuple[Surface, Any]:
        """Compute the surface that the beam sees, and which pixels lie on the object [y, x].

        Args:
            raster: beam positions.
            shift: `Optics.beam_shift`.
        """
        axes, beam, local_shift, at = self._local(raster, shift)
        hit = self.shape.hit(at[0], at[1], local_shift)
        x, y = jnp.meshgrid(raster.x, raster.y)
        # the local height is a distance along the beam: `beam[2]` of it per um of the sample's height
        start = jnp.einsum("j,jyx->yx", axes[:, 2], jnp.stack([x, y, jnp.zeros_like(x)]))
        height = (hit.height - start) / beam[2]
        normal = jnp.einsum("ij,jyx->iyx", axes, hit.normal)
        facing = normal[2] - normal[0] * shift[0] - normal[1] * shift[1]
        return Surface(height, -normal[0] / facing, -normal[1] / facing), hit.is_object

    def horizon(self, raster: Raster, shift: Any, direction: Any) -> Any:
        """Compute the slope from every point of the substrate up to the object [y, x], in the beam frame.

        Args:
            raster, shift: as for `seen`.
            direction: azimuth in the beam frame [2], a unit vector.
        """
        axes, beam, local_shift, at = self._local(raster, shift)
        along = axes.T @ jnp.append(direction, 0.0)
        level = along[:2] + along[2] * local_shift
        length = jnp.sqrt(level @ level)
        slope = self.shape.horizon(at[0], at[1], level / length, local_shift)
        return jnp.where(slope > NO_HORIZON, (slope * length - along[2]) / beam[2], NO_HORIZON)


def _upward(x: Any) -> Any:
    """Return vertical unit normals [3, y, x]."""
    return jnp.stack([jnp.zeros_like(x), jnp.zeros_like(x), jnp.ones_like(x)])


def seen_surface(shape: PlacedShape, raster: Raster, optics: Optics) -> tuple[Surface, Any]:
    """Compute the surface that the beam of `optics` sees, and which pixels lie on the object [y, x]."""
    return shape.seen(raster, jnp.asarray(optics.beam_shift))
