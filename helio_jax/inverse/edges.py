"""The edges of the raster: whether two neighbouring pixels are joined smoothly, by a kink, or parted by a jump.

The surface is known by heights and slopes at the beam positions. Along an edge the height should change by the mean of
the two slopes (trapezoid rule; `fourth_order_slopes` where the surface is smooth further on). A kink between the two
positions makes that rule uncertain, and across a depth jump it means nothing. Kinks and jumps are found on the current
surface and then held fixed: they are the weights of the next least-squares solve. NumPy; functions that take `Any` also
work on JAX arrays.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.forward.surface import along, around
from helio_jax.inverse.rims import AxisRims
from helio_jax.robust import cauchy_weight

NOISE_FLOOR = 0.2
"""Smallest standard deviation of the trapezoid rule, in units of the slope noise of one pixel."""


def ranked(region: np.ndarray) -> np.ndarray:
    """Renumber regions [pixel] by falling size: the largest is 0."""
    order = np.argsort(-np.bincount(region), kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return rank[region]


def neighbour_links(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the links of all pixels of a raster [y, x] to their eight neighbours, each once.

    Returns:
        The numbers of the two pixels, and the way between them: 0 along x, 1 along y, 2 diagonal [link].
    """
    pixel = np.arange(shape[0] * shape[1]).reshape(shape)
    pairs = (
        (pixel[:, :-1], pixel[:, 1:], 0),
        (pixel[:-1], pixel[1:], 1),
        (pixel[:-1, :-1], pixel[1:, 1:], 2),
        (pixel[:-1, 1:], pixel[1:, :-1], 2),
    )
    first = np.concatenate([a.ravel() for a, _, _ in pairs])
    second = np.concatenate([b.ravel() for _, b, _ in pairs])
    return first, second, np.concatenate([np.full(a.size, way) for a, _, way in pairs])


def trapezoid_gap(height: Any, slope: Any, pitch: float, axis: int) -> Any:
    """Compute by how much every edge's slope, (height change) / pitch, exceeds the mean slope of its two ends."""
    before, after = along(height, axis)
    return (after - before) / pitch - 0.5 * sum(along(slope, axis))


def fourth_order_slopes(slope: Any, weight: Any, axis: int) -> Any:
    """Compute slopes [y, x] whose means over the two ends of an edge are right to fourth order on curved surfaces.

    A twelfth of the second difference is taken away: the mean is then that of the cubic through four slopes,
    (-p0 + 13 p1 + 13 p2 - p3) / 24. The trapezoid rule alone makes a wave of k radians per pixel too low by
    (k / 2) / tan(k / 2): 3 % at 10 pixels, 21 % at 4; so it is by 0.2 and 8 %. Source: own derivation; the term is that
    of Euler and Maclaurin.

    Args:
        slope: at the pixels [y, x].
        weight: of the second-difference term, from `smoothness_weight`; 0 at the border [y, x].
        axis: 0 (y) or 1 (x).
    """
    before, after = along(slope, axis)
    to_previous, to_next = around(after - before, axis)
    return slope - weight / 12.0 * (to_next - to_previous)


def kink_size(slope: np.ndarray, axis: int) -> np.ndarray:
    """Compute by how much the slope changes in every edge beyond its change in the edges before and after.

    Zero where the surface is smoothly curved; the whole change of slope at an isolated kink.
    """
    before, after = along(slope, axis)
    change = np.abs(after - before)
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 1)
    padded = np.pad(change, pad, mode="edge")
    neighbours = np.maximum(*(np.take(padded, range(s, s + change.shape[axis]), axis) for s in (0, 2)))
    return np.maximum(change - neighbours, 0.0)


@dataclass(frozen=True)
class AxisEdges:
    """The edges along one axis, as the next solve sees them.

    Attributes:
        sigma: standard deviation of (height change / pitch) - (mean of the two slopes) on an edge without a jump; the
            mean of it is `rims.gap`.
        joined: weight that is left to the edge, 1: joined, 0: a depth jump.
        rims: of domes along this axis.
    """

    sigma: np.ndarray
    joined: np.ndarray
    rims: AxisRims

    @property
    def smooth(self) -> np.ndarray:
        """Weight for `smoothness_weight`: `joined`, and 0 at rims, where slopes are no cubic."""
        return np.where(self.rims.is_rim, 0.0, self.joined)

    @property
    def weight(self) -> np.ndarray:
        """Factor that turns the misfit of an edge into standard deviations, robustly."""
        return np.sqrt(self.joined) / self.sigma


def noise_of_edges(noise: float | np.ndarray, axis: int) -> float | np.ndarray:
    """Return the slope noise of the edges along an axis: root mean square of that of their two ends, if it differs."""
    if np.ndim(noise) == 0:
        return noise
    before, after = along(np.asarray(noise) ** 2, axis)
    return np.sqrt(0.5 * (before + after))


def find_edges(
    height: np.ndarray,
    slope: np.ndarray,
    pitch: float,
    axis: int,
    noise: float | np.ndarray,
    cut: float,
    rims: AxisRims | None = None,
) -> AxisEdges:
    """Find kinks and jumps in all edges along one axis.

    With a kink uniformly within the edge, slopes s1 and s2 on its two sides, the trapezoid rule's error is
    (u - 1/2)(s2 - s1), u uniform in (0, 1): a variance of (s2 - s1)^2 / 12. A smooth surface leaves a twelfth of the
    second difference of its slopes. An edge whose misfit is explained by neither is a jump.

    Args:
        height: heights [y, x], um.
        slope: slopes along this axis [y, x].
        pitch: um.
        axis: 0 (y) or 1 (x).
        noise: slope noise of one pixel, or of every pixel [y, x].
        cut: misfit, in standard deviations, at which an edge has lost three quarters of its weight.
        rims: of domes along this axis; default: none.

    Source: own derivation, tests/inverse/test_edges.py.
    """
    before, after = along(slope, axis)
    curvature = np.gradient(after - before, axis=axis) if slope.shape[axis] > 2 else np.zeros_like(before)
    own = noise_of_edges(noise, axis)
    sigma = np.sqrt((NOISE_FLOOR * own) ** 2 + kink_size(slope, axis) ** 2 / 12.0 + (curvature / 12.0) ** 2)
    rims = rims or AxisRims.none(sigma.shape)
    sigma = np.where(rims.is_rim, np.hypot(NOISE_FLOOR * own, rims.sigma), sigma)
    misfit = (trapezoid_gap(height, slope, pitch, axis) - rims.gap) / sigma
    return AxisEdges(sigma, cauchy_weight(misfit, cut) ** 2, rims)


def smoothness_weight(joined: np.ndarray, slope: np.ndarray, noise: float | np.ndarray, axis: int) -> np.ndarray:
    """Compute the weight of `fourth_order_slopes` in every pixel [y, x]: the smoothness of both of its edges.

    Beside a kink the correction errs by a 24th of it; it fades where that exceeds the least sigma of the edges.

    Args:
        joined: weight left of the edges.
        slope: slopes along `axis` [y, x].
        noise: slope noise of one pixel, or of every pixel [y, x].
        axis: 0 (y) or 1 (x).
    """
    smooth = joined * cauchy_weight(kink_size(slope, axis) / 24.0, NOISE_FLOOR * noise_of_edges(noise, axis))
    previous, following = around(smooth, axis)
    return previous * following
