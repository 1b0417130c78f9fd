"""The beam frame: one height per pixel of the raster, its slopes, and the surface normals they stand for.

A point of height h seen at beam position (X, Y) lies at (X - h tx, Y - h ty, h), with (tx, ty) = tan t (cos phi,
sin phi). Its tangents along X and Y give the normal n ~ (-a, -b, 1 - a tx - b ty) for the slopes a = dh/dX, b =
dh/dY: linear in the slopes, valid wherever the beam sees the surface (n . u < 0). Works on NumPy and JAX arrays.
Source: DESIGN.md section 1; own derivation, tests/unit/test_conventions.py.
"""

from typing import Any

import numpy as np

MIN_FACING = 0.02
"""Smallest -n . u / cos t that a measured normal may have; below, the slope would be beyond the grazing limit."""


def normal_of_slopes(a: Any, b: Any, shift: tuple[float, float]) -> tuple[Any, Any, Any]:
    """Return the unnormalised normal (-a, -b, 1 - a tx - b ty) of slopes per um of raster."""
    return -a, -b, 1.0 - a * shift[0] - b * shift[1]


def unit_normal(a: Any, b: Any, shift: tuple[float, float]) -> Any:
    """Return the unit normals [3, ...] of slopes per um of raster [...]."""
    xp = a.__array_namespace__()
    n = xp.stack(normal_of_slopes(a, b, shift))
    return n / xp.sqrt(xp.sum(n * n, axis=0))


def slopes_of_normal(normal: np.ndarray, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the beam-frame slopes (a, b) of normals [..., 3], and where they are usable.

    A noisy normal may face away from the beam, which no visible surface can: there the slope is limited to
    `MIN_FACING` and the third output is False.
    """
    facing = normal[..., 2] - normal[..., 0] * shift[0] - normal[..., 1] * shift[1]
    is_facing = facing > MIN_FACING
    c = np.maximum(facing, MIN_FACING)
    return -normal[..., 0] / c, -normal[..., 1] / c, is_facing
