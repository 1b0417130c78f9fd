"""Objects of known shape on a flat substrate, as the beam sees them: exact heights, normals and horizons (JAX).

Each shape knows its own frame (z up, z = 0 on the substrate, the object about the origin) and two closed forms there:
the first hit of the beam, and the steepest slope up to the object from a point of the substrate. `PlacedShape` puts it
into the sample frame: place, azimuth, and the substrate's tilt against the plate, the stage moving along the plate. A
tilt turns the beam in the shape's frame, so it is exact as well. All is differentiable in shape, place and beam.

What the beam sees consists of parts (object and substrate; a step has an upper terrace, a facet and the substrate). A
part's share of a pixel falls from 1 to 0 across its outline as a logistic function of the distance, so that images are
differentiable in where the outline lies, too; of width 0 it is a step, and constant under differentiation.
Source: own derivation; tests/physics/test_known_shapes.py compares with the tracer.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from helio_jax.forward.optics import Raster, rotation_matrix
from helio_jax.forward.surface import MIN_FACING, Surface

NO_HORIZON = -1e9
"""Slope of a horizon where nothing rises."""
_TINY = 1e-12
_NEAR = 1e-6
"""Share of a distance by which a point that the ball covers is put beyond its outline."""


class Part(eqx.Module):
    """One part of what the beam sees, continued beyond its outline.

    Attributes:
        share: of the pixel that it takes [y, x].
        height: where the beam meets it [y, x], um.
        normal: unit normals [3, y, x].
        is_object: whether it belongs to the object, not to the substrate.
    """

    share: Any
    height: Any
    normal: Any
    is_object: bool = eqx.field(static=True)


class Flat(eqx.Module):
    """The bare substrate."""

    def parts(self, x: Any, y: Any, shift: Any, width: Any) -> list[Part]:
        """Compute what beams at positions (x, y) [y, x], um, meet.

        Args:
            x, y: where the beams meet the substrate.
            shift: of a beam per um of depth.
            width: over which the parts' shares change at an outline, the scale of a logistic function [um]; 0: a step.
        """
        return [Part(jnp.ones_like(x), jnp.zeros_like(x), _upward(x), False)]

    def horizon(self, x: Any, y: Any, direction: Any, shift: Any) -> Any:
        """Compute the slope up to the object [y, x] from the substrate at beam positions (x, y), along a direction."""
        return jnp.full_like(x, NO_HORIZON)


class Ball(eqx.Module):
    """A ball of `radius` whose top stands `height` above the substrate, 0 < height <= 2 radius [um]."""

    radius: Float[Any, ""]
    height: Float[Any, ""]

    def parts(self, x: Any, y: Any, shift: Any, width: Any) -> list[Part]:
        """Compute the ball and the substrate, see `Flat.parts`.

        The outline is the foot where the beam meets the ball's lower edge, elsewhere the contour where it grazes the
        ball. Beyond that contour, and where the beam all but grazes, the ball is continued by its nearest normals.
        """
        depth = self.height - self.radius  # of the centre
        square = 1.0 + shift @ shift
        half = x * shift[0] + y * shift[1] + depth
        out_of_foot = x**2 + y**2 + depth**2 - self.radius**2
        inside = half**2 - square * out_of_foot  # the square of radius times the cosine to the beam, over `square`
        least = (MIN_FACING * self.radius) ** 2
        steepness = jnp.sqrt((half * shift[0] - square * x) ** 2 + (half * shift[1] - square * y) ** 2 + least)
        to_contour = 0.5 * inside / steepness
        to_foot = -0.5 * out_of_foot / jnp.sqrt(x**2 + y**2 + least)
        share = _share(jnp.where(half > 0.0, to_contour, to_foot), width)
        height = (half + jnp.sqrt(jnp.maximum(inside, least))) / square
        normal = jnp.stack([x - height * shift[0], y - height * shift[1], height - depth])
        normal = normal / jnp.sqrt(jnp.sum(normal**2, 0))
        return [Part(share, height, normal, True), Part(1.0 - share, jnp.zeros_like(x), _upward(x), False)]

    def horizon(self, x: Any, y: Any, direction: Any, shift: Any) -> Any:
        """Compute the slope of the tangent to the ball, see `Flat.horizon`.

        The line from the point v (relative to the centre) along e + s w, w = (-t, 1), touches the ball where (v . (e +
        s w))^2 = |e + s w|^2 (|v|^2 - R^2): a quadratic in the slope s.
        """
        depth = self.height - self.radius
        e_w = -(direction @ shift)
        w_w = 1.0 + shift @ shift
        x, y = self._beside(x, y, shift)
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

    def _beside(self, x: Any, y: Any, shift: Any) -> tuple[Any, Any]:
        """Move points that the ball covers, which only a blurred outline has, to its outline, away from a centre.

        The outline is the foot where `half` < 0, the contour of grazing beams elsewhere. Where it has both, the centre
        lies on the line between them, half = 0, so that the moved point is continuous.
        """
        depth, steep = self.height - self.radius, shift @ shift
        square, foot_square = 1.0 + steep, self.radius**2 - depth**2
        half = x * shift[0] + y * shift[1] + depth
        has_both = depth**2 < steep * foot_square
        scale = jnp.where(has_both, -depth / jnp.where(has_both, steep, 1.0), jnp.maximum(depth, 0.0))
        start = jnp.where(has_both, 0.0, scale * steep + depth)  # `half` at the centre
        center = [scale * shift[i] for i in (0, 1)]
        way = [x - center[0], y - center[1]]
        rise, first = jnp.where(half > 0.0, half - start, 0.0), jnp.where(half > 0.0, start, 0.0)
        # half^2 = square * (x^2 + y^2 - foot^2) at the outline, half = 0 at the foot: quadratic in the share of the way
        a = square * jnp.maximum(way[0] ** 2 + way[1] ** 2, _NEAR * self.radius**2) - rise**2
        b = first * rise - square * (center[0] * way[0] + center[1] * way[1])
        c = jnp.maximum(square * (foot_square - center[0] ** 2 - center[1] ** 2) + first**2, _NEAR * self.radius**2)
        away = jnp.maximum((1.0 + _NEAR) * (b + jnp.sqrt(b**2 + a * c)) / a, 1.0)
        return center[0] + away * way[0], center[1] + away * way[1]


class Ramp(eqx.Module):
    """A straight step: an upper terrace for x < 0 at `height` [um], and a facet down to the substrate on its +x side.

    `cotangent` is that of the facet's angle to the substrate: 0 for a vertical wall.
    """

    height: Float[Any, ""]
    cotangent: Float[Any, ""]

    def parts(self, x: Any, y: Any, shift: Any, width: Any) -> list[Part]:
        """Compute terrace, facet and substrate, see `Flat.parts`."""
        edge = self.height * shift[0]
        run = self.cotangent - shift[0]  # of the facet's foot in the beam frame, per um of height
        is_lit = run > 0.0
        foot = edge + self.height * jnp.maximum(run, 0.0)
        top, bottom = _share(edge - x, width), _share(x - foot, width)
        facet = (self.height * self.cotangent - x) / jnp.where(is_lit, run, 1.0)
        size = jnp.sqrt(1.0 + self.cotangent**2)
        face = jnp.stack([1.0 / size, 0.0 * size, self.cotangent / size])[:, None, None]
        face = jnp.where(is_lit, face * jnp.ones_like(x), _upward(x))
        middle = jnp.where(is_lit, jnp.maximum(1.0 - top - bottom, 0.0), 0.0)
        return [
            Part(top, self.height * jnp.ones_like(x), _upward(x), True),
            Part(middle, jnp.where(is_lit, facet, 0.0), face, True),
            Part(bottom, jnp.zeros_like(x), _upward(x), False),
        ]

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

    def parts(self, raster: Raster, shift: Any, width: Any = 0.0) -> list[tuple[Any, Surface, bool]]:
        """Compute the parts of what the beam sees: share of each pixel [y, x], surface, whether it is of the object.

        Args:
            raster: beam positions.
            shift: `Optics.beam_shift`.
            width: of the outline, see `Flat.parts` [um].
        """
        axes, beam, local_shift, at = self._local(raster, shift)
        x, y = jnp.meshgrid(raster.x, raster.y)
        # the local height is a distance along the beam: `beam[2]` of it per um of the sample's height
        start = jnp.einsum("j,jyx->yx", axes[:, 2], jnp.stack([x, y, jnp.zeros_like(x)]))
        out = []
        for part in self.shape.parts(at[0], at[1], local_shift, width):
            height = (part.height - start) / beam[2]
            normal = jnp.einsum("ij,jyx->iyx", axes, part.normal)
            facing = jnp.maximum(normal[2] - normal[0] * shift[0] - normal[1] * shift[1], 0.5 * MIN_FACING)
            out.append((part.share, Surface(height, -normal[0] / facing, -normal[1] / facing), part.is_object))
        return out

    def seen(self, raster: Raster, shift: Any) -> tuple[Surface, Any]:
        """Compute the surface that the beam sees, and which pixels lie on the object [y, x].

        Args:
            raster, shift: as for `parts`.
        """
        (share, surface, _), *others = self.parts(raster, shift)
        is_object = share > 0.5 if len(others) else jnp.zeros(raster.shape, bool)
        for other_share, other, of_object in others:
            is_here = other_share > 0.5
            surface = jax.tree.map(lambda a, b, is_here=is_here: jnp.where(is_here, b, a), surface, other)
            is_object = is_object | (is_here & of_object)
        return surface, is_object

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


def _share(distance: Any, width: Any) -> Any:
    """Compute the share of a pixel at a distance [um] within the outline of a part, see `Flat.parts`."""
    is_blurred = width > 0.0
    blurred = jax.nn.sigmoid(distance / jnp.where(is_blurred, width, 1.0))
    return jnp.where(is_blurred, blurred, (distance > 0.0).astype(blurred.dtype))
