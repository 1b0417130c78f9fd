"""Occlusion edges: behind a rim that falls off steeper than the beam the surface has a depth jump.

A fit whose instrument is free would rather change the instrument than cut the surface: if all edges are joined at
first, angles and offsets make the far side of a hill come down to the substrate. So while the instrument is fitted for
the first time, such edges are cut; afterwards each is joined again if its misfit allows.
"""

from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from helio_jax.forward.surface import Surface, along

WALL = 25.0
"""Change across an edge (chi-square without the detector that changes most) from which on it may be a wall: noise alone
reaches it in fewer than one edge of 250 000."""
_HALF_LENGTHS = (1, 3)
"""Pixels to both sides, along the edge, over which its change is averaged."""
STEEP = 1.0
"""Fall of the beam-frame height along the beam, per raster step of the same length, from which on it may be one."""


def wall_strength(signal: np.ndarray, variance: np.ndarray, axis: int, half: int) -> np.ndarray:
    """Compute the change across every edge, in chi-square without the detector that changes most.

    Two pixels on each side are compared, averaged over 2 half + 1 pixels along the edge.
    """
    length = 2 * half + 1
    mean, spread = (np.asarray(uniform_filter1d(f, length, 2 - axis, mode="nearest")) for f in (signal, variance))
    spread = spread / length
    n = signal.shape[1 + axis] - 1

    def at(field: np.ndarray, offset: int) -> np.ndarray:
        return np.take(field, np.clip(np.arange(n) + offset, 0, n), 1 + axis)

    change = 0.5 * (at(mean, 1) + at(mean, 2) - at(mean, 0) - at(mean, -1))
    square = change**2 / (0.25 * sum(at(spread, i) for i in (-1, 0, 1, 2)))
    return square.sum(0) - square.max(0)


def find_occlusion_edges(
    signal: np.ndarray, variance: np.ndarray, surface: Surface, shift: Any, axis: int
) -> np.ndarray:
    """Find edges along an axis (0: y, 1: x) that may be occlusion edges: depth jumps behind a rim, along the beam.

    The images change across them as across a wall, and the surface on either side falls steeply along the beam.

    Args:
        signal, variance: data [detector, y, x], NaN where not observed.
        surface: to begin with.
        shift: tan t (cos phi, sin phi) of the beam.
        axis: of the edges.
    """
    component, slope = (shift[0], surface.slope_x) if axis == 1 else (shift[1], surface.slope_y)
    if component == 0.0:
        return np.zeros(along(slope, axis)[0].shape, bool)
    fall = np.maximum(*(-np.sign(component) * end for end in along(slope, axis)))
    observed = np.isfinite(signal) & np.isfinite(variance)
    data, spread = np.where(observed, signal, 0.0), np.where(observed, variance, np.nanmax(variance))
    strength = np.maximum(*(wall_strength(data, spread, axis, half) for half in _HALF_LENGTHS))
    return (fall * abs(component) > STEEP * np.hypot(*shift)) & (strength > WALL)
