"""How much of a diffuse emitter's flux a detector aperture catches: the tracer's own form factor (numba).

For a point with normal n and an aperture that is neither hidden nor cut by the point's horizon, the detection
probability is P = n . Phi with the vector form factor Phi = (1/2 pi) contour integral (r x dl)/|r|^2 (DESIGN.md
section 2; Lambert's formula, Baum et al., SIGGRAPH 1989). Hidden parts are subtracted by the caller,
sample point by sample point. The JAX form factor of `reconstruct` is written separately so that each checks the other.
"""

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel

RIM_POINTS = (12, 16, 24, 32, 64, 256)
"""Rim points of the trapezoid rule, the first ones for far points."""
RIM_RATIOS = (4.0, 2.0, 1.2, 0.7, 0.3)
"""Distance to the plate in largest semi-axes above which each of RIM_POINTS is used (error < 1e-9)."""


class ApertureTable:
    """The apertures of an instrument as flat arrays for the numba kernels (lab x, y; um).

    Attributes:
        center, semi_axes: [k, 2].
        cos_sin: of the rotation [k, 2].
        rims: for each of RIM_POINTS, positions and tangents [level, k, 2, max points, 2] (zero padded).
    """

    def __init__(self, instrument: Instrument) -> None:
        apertures = instrument.apertures()
        self.center = np.array([a.center for a in apertures])
        self.semi_axes = np.array([a.semi_axes for a in apertures])
        self.cos_sin = np.array([(np.cos(a.rotation), np.sin(a.rotation)) for a in apertures])
        self.area = np.pi * self.semi_axes.prod(1)
        self.rims = np.zeros((len(RIM_POINTS), len(apertures), 2, max(RIM_POINTS), 2))
        for level, n in enumerate(RIM_POINTS):
            for k, a in enumerate(apertures):
                self.rims[level, k, :, :n] = a.rim(n)


@kernel
def form_factor(x, y, depth, k, semi_axes, rims):
    """Return Phi (3 components) of aperture `k` seen from (x, y), `depth` below the plate (lab frame, um).

    Valid for depth > 0; relative error < 1e-9 from 0.3 semi-axes up. Source: DESIGN.md section 2.
    """
    ratio = depth / max(semi_axes[k, 0], semi_axes[k, 1])
    level = len(RIM_POINTS) - 1
    for i in range(len(RIM_RATIOS)):
        if ratio > RIM_RATIOS[i]:
            level = i
            break
    n = RIM_POINTS[level]
    fx = fy = fz = 0.0
    for i in range(n):
        rx, ry = rims[level, k, 0, i, 0] - x, rims[level, k, 0, i, 1] - y
        tx, ty = rims[level, k, 1, i, 0], rims[level, k, 1, i, 1]
        w = 1.0 / (rx * rx + ry * ry + depth * depth)
        fx -= depth * ty * w
        fy += depth * tx * w
        fz += (rx * ty - ry * tx) * w
    return fx / n, fy / n, fz / n


@kernel
def is_inside(x, y, k, center, semi_axes, cos_sin):
    """Whether the plate point (x, y) lies in aperture `k`."""
    dx, dy = x - center[k, 0], y - center[k, 1]
    c, s = cos_sin[k, 0], cos_sin[k, 1]
    p, q = (dx * c + dy * s) / semi_axes[k, 0], (dy * c - dx * s) / semi_axes[k, 1]
    return p * p + q * q <= 1.0


@kernel
def find_aperture(x, y, center, semi_axes, cos_sin):
    """Return the first aperture that contains the plate point (x, y), or -1."""
    for k in range(center.shape[0]):
        if is_inside(x, y, k, center, semi_axes, cos_sin):
            return k
    return -1


@kernel
def aperture_ahead(origins, directions, i, x, y, plate_z, center, semi_axes, cos_sin):
    """Return the aperture that ray `i` flies through, or -1, and its distance [um]; `x`, `y`: the plate's origin."""
    if directions[i, 2] <= 0.0:
        return -1, 0.0
    r = (plate_z - origins[i, 2]) / directions[i, 2]
    x, y = origins[i, 0] + r * directions[i, 0] - x, origins[i, 1] + r * directions[i, 1] - y
    return find_aperture(x, y, center, semi_axes, cos_sin), r


@kernel
def aperture_point(u, v, k, center, semi_axes, cos_sin):
    """Map two uniform numbers to a point uniform in area on aperture `k`; return (x, y) [um]."""
    r, angle = np.sqrt(u), 2.0 * np.pi * v
    p, q = r * np.cos(angle) * semi_axes[k, 0], r * np.sin(angle) * semi_axes[k, 1]
    c, s = cos_sin[k, 0], cos_sin[k, 1]
    return center[k, 0] + c * p - s * q, center[k, 1] + s * p + c * q


def form_factors(instrument: Instrument, points: np.ndarray) -> np.ndarray:
    """Return Phi of every aperture for lab-frame points [n, 3] as [detector, n, 3] (see `form_factor`)."""
    table = ApertureTable(instrument)
    return _form_factors(np.ascontiguousarray(points, float), instrument.working_distance, table.semi_axes, table.rims)


@kernel
def _form_factors(points, plate_z, semi_axes, rims):
    out = np.empty((semi_axes.shape[0], points.shape[0], 3))
    for k in range(semi_axes.shape[0]):
        for i in range(points.shape[0]):
            out[k, i] = form_factor(points[i, 0], points[i, 1], plate_z - points[i, 2], k, semi_axes, rims)
    return out
