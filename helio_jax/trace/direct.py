"""Vector form factors and aiming at detectors (numba).

For a point with normal n and an aperture that is neither masked nor cut by the point's horizon, the detection
probability is P = n . Phi with the vector form factor Phi = (1/2 pi) contour integral (r x dl)/|r|^2 (Lambert's
formula, Baum et al., SIGGRAPH 1989; docs/conventions.md, "Physics"). The caller subtracts masked parts. A detector at
infinity is a cone of directions; its solid angle takes the place of area cosine / distance^2. The form factor of
`forward` is a second, independent implementation in JAX.
"""

import numpy as np

from helio_jax.detector import Cone
from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.lobes import rotate_from_z

RIM_POINTS = (12, 16, 24, 32, 64, 256)
"""Rim points of the trapezoid rule, the first ones for far points."""
RIM_RATIOS = (4.0, 2.0, 1.2, 0.7, 0.3)
"""Distance to the plate, in largest semi-axes, above which each of RIM_POINTS is used (error < 1e-9)."""
_AT_INFINITY = 6
"""Column of `ApertureTable.shapes`."""


class ApertureTable:
    """Detectors of an instrument as flat arrays for the numba kernels (lab frame, um).

    Attributes:
        shapes: [k, 7]. Aperture: centre x, y, semi-axes, cosine and sine of the rotation, 0. Cone at infinity: axis
            x, y, z, cosine and squared sine of the half-angle, 0, 1. Under a mesh plate, which counts by itself, all
            but cones are NaN: no point is inside.
        area: of an aperture; of a cone the solid angle [k].
        rims: for each of RIM_POINTS, positions and tangents of the rims [level, k, 2, max points, 2] (zero padded).
    """

    def __init__(self, instrument: Instrument) -> None:
        openings = instrument.openings()
        self.shapes, self.area = np.zeros((len(openings), 7)), np.zeros(len(openings))
        self.rims = np.zeros((len(RIM_POINTS), len(openings), 2, max(RIM_POINTS), 2))
        for k, a in enumerate(openings):
            if isinstance(a, Cone):
                b = a.half_angle
                self.shapes[k] = *a.axis, np.cos(b), np.sin(b) ** 2, 0.0, 1.0
                self.area[k] = a.solid_angle
                continue
            if a is None or instrument.plate.is_mesh:
                self.shapes[k, :_AT_INFINITY] = np.nan
                continue
            self.shapes[k] = *a.center, *a.semi_axes, np.cos(a.rotation), np.sin(a.rotation), 0.0
            self.area[k] = np.pi * np.prod(a.semi_axes)
            for level, n in enumerate(RIM_POINTS):
                self.rims[level, k, :, :n] = a.rim(n)

    def __len__(self) -> int:
        return len(self.area)

    def largest_weight(self, gap: float) -> float:
        """Compute an upper bound of the detection probability of any detector that is at least `gap` [um] away.

        Point-detector approximation: area / (pi gap^2) for an aperture, solid angle / pi for a cone.
        """
        square = np.where(self.shapes[:, _AT_INFINITY] != 0.0, 1.0, max(gap, 0.0) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.max(np.nan_to_num(self.area / (np.pi * square), nan=np.inf)))


@kernel
def form_factor(x, y, depth, k, shapes, rims):
    """Compute Phi (3 components) of detector `k` at (x, y), `depth` below the plate (lab frame, um).

    Apertures: valid for depth > 0; relative error < 1e-9 from 0.3 semi-axes up. Cones at infinity: sin^2(b) a, with
    half-angle b and axis a: the integral of omega / pi over the cone.
    """
    if shapes[k, _AT_INFINITY] != 0.0:
        sin2 = shapes[k, 4]
        return sin2 * shapes[k, 0], sin2 * shapes[k, 1], sin2 * shapes[k, 2]
    ratio = depth / max(shapes[k, 2], shapes[k, 3])
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
def is_inside(x, y, dx, dy, dz, k, shapes):
    """Whether detector `k` counts an atom at the plate's point (x, y) with direction d."""
    if shapes[k, _AT_INFINITY] != 0.0:
        return dx * shapes[k, 0] + dy * shapes[k, 1] + dz * shapes[k, 2] >= shapes[k, 3]
    ax, ay = x - shapes[k, 0], y - shapes[k, 1]
    c, s = shapes[k, 4], shapes[k, 5]
    p, q = (ax * c + ay * s) / shapes[k, 2], (ay * c - ax * s) / shapes[k, 3]
    return p * p + q * q <= 1.0


@kernel
def find_aperture(x, y, dx, dy, dz, shapes):
    """Return the first detector that counts an atom at the plate's point (x, y) with direction d, or -1."""
    for k in range(shapes.shape[0]):
        if is_inside(x, y, dx, dy, dz, k, shapes):
            return k
    return -1


@kernel
def aperture_ahead(origins, directions, i, x, y, plate_z, shapes):
    """Return the detector on ray `i`, or -1, and the distance to the plate [um]; `x`, `y`: the plate's origin."""
    dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
    if dz <= 0.0:
        return -1, 0.0
    r = (plate_z - origins[i, 2]) / dz
    x, y = origins[i, 0] + r * dx - x, origins[i, 1] + r * dy - y
    return find_aperture(x, y, dx, dy, dz, shapes), r


@kernel
def disc_point(u, v):
    """Map two uniform numbers to a point (p, q) uniform in area on the unit disc."""
    r, angle = np.sqrt(u), 2.0 * np.pi * v
    return r * np.cos(angle), r * np.sin(angle)


@kernel
def aim(k, p, q, point, i, offset_x, offset_y, plate_z, shapes):
    """Aim from point `i` at the point of an aperture, or direction of a cone, given by (p, q) on the unit disc.

    Returns:
        Vector to the aperture point [um] (cone: unit vector), its squared length, and whether detector `k` is the
        first that counts there.
    """
    if shapes[k, _AT_INFINITY] != 0.0:
        u = p * p + q * q
        axial = 1.0 - u * (shapes[k, 4] / (1.0 + shapes[k, 3]))
        wide = np.sqrt((1.0 - axial) * (1.0 + axial) / u) if u > 0.0 else 0.0
        dx, dy, dz = rotate_from_z(shapes[k, 0], shapes[k, 1], shapes[k, 2], wide * p, wide * q, axial)
        if dz <= 0.0:
            return dx, dy, dz, 1.0, False
        r = (plate_z - point[i, 2]) / dz
        x, y = point[i, 0] + r * dx - offset_x, point[i, 1] + r * dy - offset_y
        return dx, dy, dz, 1.0, find_aperture(x, y, dx, dy, dz, shapes) == k
    p, q = p * shapes[k, 2], q * shapes[k, 3]
    c, s = shapes[k, 4], shapes[k, 5]
    x, y = shapes[k, 0] + c * p - s * q, shapes[k, 1] + s * p + c * q
    dx, dy, dz = x + offset_x - point[i, 0], y + offset_y - point[i, 1], plate_z - point[i, 2]
    r2 = dx * dx + dy * dy + dz * dz
    r = np.sqrt(r2)
    return dx, dy, dz, r2, find_aperture(x, y, dx / r, dy / r, dz / r, shapes) == k


@kernel
def area_factors(k, square, cosine, shapes):
    """Return (square, cosine) so that the solid angle is area cosine / square; (1, 1) for a cone at infinity."""
    return (1.0, 1.0) if shapes[k, _AT_INFINITY] != 0.0 else (square, cosine)


def form_factors(instrument: Instrument, points: np.ndarray) -> np.ndarray:
    """Compute Phi of every detector for lab-frame points [n, 3] [um] as [detector, n, 3] (see `form_factor`)."""
    table = ApertureTable(instrument)
    return _form_factors(np.ascontiguousarray(points, float), instrument.working_distance, table.shapes, table.rims)


@kernel
def _form_factors(points, plate_z, shapes, rims):
    out = np.empty((shapes.shape[0], points.shape[0], 3))
    for k in range(shapes.shape[0]):
        for i in range(points.shape[0]):
            out[k, i] = form_factor(points[i, 0], points[i, 1], plate_z - points[i, 2], k, shapes, rims)
    return out
