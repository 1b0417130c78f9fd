"""The surface as the beam sees it: one height per raster position, its slopes, and its normals.

A point of height h seen at beam position (X, Y) lies at (X - h tx, Y - h ty, h), with (tx, ty) = tan t (cos phi,
sin phi). Its tangents along X and Y give the normal n ~ (-a, -b, 1 - a tx - b ty) for the slopes a = dh/dX, b =
dh/dY: linear in the slopes, valid wherever the beam sees the surface (n . u < 0). Works on NumPy and JAX arrays.
Source: docs/conventions.md; own derivation, tests/unit/test_conventions.py.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from helio_jax.arguments import checked
from helio_jax.forward.optics import Raster

MIN_FACING = 0.02
"""Smallest -n . u / cos t that a measured normal may have; below, the slope would be beyond the grazing limit."""
SMOOTH_CHANGE = 0.2
"""Change of slope e from pixel to pixel up to which `surface_of_heights` takes a surface as smooth."""
_LINE_PENALTY = 0.9
"""Change of slope from which it prefers the line to the next pixel to a parabola through three pixels."""
_NO_EDGE = 1e-3
"""Weight that a pixel with two cut edges would still need: its one-sided slope is then about zero."""


class Surface(eqx.Module):
    """Heights and slopes at the beam positions.

    Attributes:
        height: above the substrate [um].
        slope_x: dh/dX, per um of raster.
        slope_y: dh/dY.

    Example:
        >>> hx.surface_of_heights(height, raster).slope_x
    """

    height: Float[Any, "y x"]
    slope_x: Float[Any, "y x"]
    slope_y: Float[Any, "y x"]

    def normals(self, shift: Any) -> np.ndarray:
        """Compute the unit normals [y, x, 3] as a NumPy array.

        Args:
            shift: `Optics.beam_shift`.
        """
        return np.moveaxis(unit_normal(np.asarray(self.slope_x), np.asarray(self.slope_y), shift), 0, -1)


def normal_of_slopes(a: Any, b: Any, shift: Any) -> tuple[Any, Any, Any]:
    """Compute the unnormalised normal (-a, -b, 1 - a tx - b ty) of slopes per um of raster."""
    return -a, -b, 1.0 - a * shift[0] - b * shift[1]


def unit_normal(a: Any, b: Any, shift: Any) -> Any:
    """Compute the unit normals [3, ...] of slopes per um of raster [...]."""
    xp = a.__array_namespace__()
    n = xp.stack(normal_of_slopes(a, b, shift))
    return n / xp.sqrt(xp.sum(n * n, axis=0))


def slopes_of_normal(normal: np.ndarray, shift: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the beam-frame slopes (a, b) of normals [..., 3], and where they are usable.

    A noisy normal may face away from the beam, which no visible surface can: there the slope is limited to
    `MIN_FACING` and the third output is False.
    """
    facing = normal[..., 2] - normal[..., 0] * shift[0] - normal[..., 1] * shift[1]
    is_facing = facing > MIN_FACING
    c = np.maximum(facing, MIN_FACING)
    return -normal[..., 0] / c, -normal[..., 1] / c, is_facing


def along(field: Any, axis: int) -> tuple[Any, Any]:
    """Return the values [y, x] at the two ends of every edge along `axis` (0: y, 1: x)."""
    return (field[:, :-1], field[:, 1:]) if axis == 1 else (field[:-1], field[1:])


def around(edge: Any, axis: int) -> tuple[Any, Any]:
    """Return for every pixel [y, x] the values of the edges before and after it along `axis`; 0 outside the raster."""
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 1)
    return along(edge.__array_namespace__().pad(edge, pad), axis)


def to_pixels(edge: Any, axis: int) -> Any:
    """Sum over the two edges of every pixel along `axis`; the adjoint of summing an edge's two ends."""
    before, after = around(edge, axis)
    return before + after


def one_sided(slope: Any, edge_weight: Any, axis: int) -> Any:
    """Compute pixel slopes [y, x]: means of the edges' slopes by weight (1 joined, 0 cut), never across a jump."""
    return to_pixels(edge_weight * slope, axis) / (to_pixels(edge_weight, axis) + _NO_EDGE)


def _slope_along(height: Any, step: float, axis: int) -> Any:
    """Estimate the slope along one axis from the candidates of `surface_of_heights`."""
    n = height.shape[axis]
    if n == 1:
        return jnp.zeros_like(height / step)
    at = jnp.arange(n).reshape((-1, 1) if axis == 0 else (1, -1))
    padded = jnp.pad(height, [(2, 2) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
    z = {k: jax.lax.slice_in_dim(padded, 2 + k, 2 + k + n, axis=axis) for k in range(-2, 3)}
    before, after = (z[0] - z[-1]) / step, (z[1] - z[0]) / step
    change = {k: (z[k + 1] - 2.0 * z[k] + z[k - 1]) / step for k in (-1, 0, 1)}
    candidates = (  # slope, how far it is from smooth, weight, first and last pixel that it needs
        (before + 0.5 * change[-1], change[-1] ** 2, 1 / 6, -2, 0),
        (0.5 * (before + after), change[0] ** 2, 4 / 6, -1, 1),
        (after - 0.5 * change[1], change[1] ** 2, 1 / 6, 0, 2),
        (before, before**2 + _LINE_PENALTY**2, 1 / 6, -1, 0),
        (after, after**2 + _LINE_PENALTY**2, 1 / 6, 0, 1),
    )
    total = weighted = 0.0
    for slope, roughness, order_weight, first, last in candidates:
        is_inside = (at + first >= 0) & (at + last < n)
        weight = jnp.where(is_inside, order_weight / (SMOOTH_CHANGE**2 + roughness) ** 2, 0.0)
        total, weighted = total + weight, weighted + weight * slope
    return weighted / total


@checked
def surface_of_heights(height: Any, raster: Raster, edges: tuple[Any, Any] | None = None) -> Surface:
    """Estimate the slopes of heights alone; differentiable in the heights.

    Along each axis the slope is a weighted mean of the slopes of the three parabolas through a pixel and two of its
    neighbours. On smooth surfaces the weights 1/6, 4/6, 1/6 make it the central difference of fourth order. Divided
    by (e^2 + c^2)^2, with c the change of slope along the parabola, they leave out what crosses a kink or a depth
    jump. Where all three cross one, as in a deep slot two pixels wide, the line to the flatter neighbour remains.

    Valid to 0.05 in slope on a Gaussian hill 0.8 steep whose standard deviation is 2.75 pixels, to 0.13 where it is 2;
    beside a kink to half of its change of slope, at one pixel; beside a step of half a pixel or more to 0.04, a lower
    one to 0.1. In a level slot two pixels wide, or on such a tread, to 0.6 where it is 0.2 to 3 pixels deep, else to
    0.15; on steep ground such a slot is not distinguished from the ground. On a feature one pixel wide the slope is
    meaningless. A height that is not finite spoils two pixels to either side. Where slopes or normals are known,
    make the `Surface` from them.

    Args:
        height: above the substrate [y, x], um.
        raster: its beam positions.
        edges: weights of the edges along x [y, x - 1] and y [y - 1, x], 1 joined, 0 a depth jump: slopes are then the
            means of the differences along joined edges; default: as above.

    Source: weighted essentially non-oscillatory stencils, Jiang and Shu, J. Comput. Phys. 126 (1996) 202.

    Example:
        >>> hx.surface_of_heights(height, raster)
    """
    height = jnp.asarray(height)
    slopes = []
    for number, (axis, step) in enumerate(((1, raster.dx), (0, raster.dy))):
        if edges is None:
            slopes.append(_slope_along(height, step, axis))
        else:
            edge = jnp.diff(height, axis=axis) / step
            slopes.append(one_sided(edge, jnp.asarray(edges[number], edge.dtype), axis))
    return Surface(height, *slopes)
