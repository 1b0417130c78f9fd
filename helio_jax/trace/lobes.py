"""Lobes of the scattering laws: rejection samplers and densities (numba).

Each `try_*` maps uniform numbers to (is_accepted, direction); after a rejection the caller tries again with new
numbers. Each `*_density` is the exact density per steradian of that sampler. d is the incoming unit direction (towards
the surface), n the unit normal, o an outgoing unit direction.
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.lawtable import CUT

_REJECTED = (False, 0.0, 0.0, 0.0)
_EON_A = 0.5 - 2.0 / (3.0 * np.pi)
_EON_B = 2.0 / 3.0 - 28.0 / (15.0 * np.pi)


@kernel
def rotate_from_z(nx, ny, nz, x, y, z):
    """Rotate (x, y, z) from a frame whose third axis is the unit vector n; return a unit vector.

    Source of the frame: Duff et al., J. Comput. Graph. Tech. 6 (2017) 1.
    """
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    out_x = x * (1.0 + sign * nx * nx * a) + y * b + z * nx
    out_y = x * sign * b + y * (sign + ny * ny * a) + z * ny
    out_z = -x * sign * nx - y * ny + z * nz
    length = np.sqrt(out_x * out_x + out_y * out_y + out_z * out_z)
    return out_x / length, out_y / length, out_z / length


@kernel
def cosine_direction(nx, ny, nz, u, v):
    """Draw a cosine-distributed direction about a unit vector (Malley's method)."""
    r, angle = np.sqrt(u), 2.0 * np.pi * v
    return rotate_from_z(nx, ny, nz, r * np.cos(angle), r * np.sin(angle), np.sqrt(1.0 - u))


@kernel
def mirror(d, n, sign):
    """Return the specular direction (sign 1) or the backscattering direction (sign -1)."""
    if sign < 0.0:
        return -d[0], -d[1], -d[2]
    s = 2.0 * (d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    return d[0] - s * n[0], d[1] - s * n[1], d[2] - s * n[2]


@kernel
def interpolate(nodes, x, x_max):
    """Interpolate a table over [0, x_max] linearly at x, constant beyond its ends."""
    s = min(max(x / x_max, 0.0), 1.0) * (nodes.size - 1)
    i = min(int(s), nodes.size - 2)
    return nodes[i] + (s - i) * (nodes[i + 1] - nodes[i])


@kernel
def try_uniform(n, cos_edge, a, b):
    """Draw uniformly within a cone about the normal."""
    z, angle = 1.0 - a * (1.0 - cos_edge), 2.0 * np.pi * b
    r = np.sqrt(max(0.0, 1.0 - z * z))
    x, y, z = rotate_from_z(n[0], n[1], n[2], r * np.cos(angle), r * np.sin(angle), z)
    return True, x, y, z


@kernel
def try_lobe(d, n, sigma, sign, a, b, c):
    """Draw from cos(theta) exp(-g^2 / (2 sigma^2)): a Rayleigh angle g, accepted with cos(theta) sin(g) / g."""
    g, angle = sigma * np.sqrt(-2.0 * np.log(1.0 - a)), 2.0 * np.pi * b
    if g >= np.pi:
        return _REJECTED
    ax, ay, az = mirror(d, n, sign)
    s = np.sin(g)
    x, y, z = rotate_from_z(ax, ay, az, s * np.cos(angle), s * np.sin(angle), np.cos(g))
    cosine = x * n[0] + y * n[1] + z * n[2]
    return c < cosine * (s / g if g > 0.0 else 1.0), x, y, z


@kernel
def lobe_density(d, n, sigma, sign, norm, o):
    """Density of `try_lobe`; `norm`: table of `lawtable.lobe_norm`."""
    ax, ay, az = mirror(d, n, sign)
    g = np.arccos(min(1.0, max(-1.0, ax * o[0] + ay * o[1] + az * o[2])))
    tilt = np.arccos(min(1.0, abs(d[0] * n[0] + d[1] * n[1] + d[2] * n[2])))
    cosine = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
    return cosine * np.exp(-0.5 * (g / sigma) ** 2) / interpolate(norm, tilt, 0.5 * np.pi)


@kernel
def try_cosine_lobe(d, n, a, b):
    """Draw from the cosine law about the specular direction, cut at the horizon."""
    ax, ay, az = mirror(d, n, 1.0)
    x, y, z = cosine_direction(ax, ay, az, a, b)
    return x * n[0] + y * n[1] + z * n[2] > 0.0, x, y, z


@kernel
def cosine_lobe_density(d, n, o):
    """Density of `try_cosine_lobe`; its norm is pi/2 (1 + cos(tilt)) (half disc and half ellipse)."""
    ax, ay, az = mirror(d, n, 1.0)
    tilt_cosine = ax * n[0] + ay * n[1] + az * n[2]
    return max(0.0, ax * o[0] + ay * o[1] + az * o[2]) / (0.5 * np.pi * (1.0 + tilt_cosine))


@kernel
def _fujii_albedo(cosine, r):
    """Directional albedo of the single-scattering model (FON) at albedo 1."""
    s = np.sqrt(max(0.0, 1.0 - cosine * cosine))
    grazing = s / max(cosine, 1e-12) * (1.0 - s * s * s) - s
    g = s * (np.arccos(min(1.0, cosine)) - s * cosine) + 2.0 / 3.0 * grazing
    return (1.0 + r * g / np.pi) / (1.0 + _EON_A * r)


@kernel
def rough_density(d, n, r, o):
    """Density of the energy-preserving Oren-Nayar model at albedo 1: BRDF times cos(theta).

    Source: Portsmouth, Kutz, Hill, JCGT 14 (2025) 1: brdf = (A + B s / t + multiple scattering) / pi.
    """
    ci = -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    co = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
    s = -(d[0] * o[0] + d[1] * o[1] + d[2] * o[2]) - ci * co
    a = 1.0 / (1.0 + _EON_A * r)
    single = a * (1.0 + r * (s / max(ci, co) if s > 0.0 else s))
    missing = 1.0 - a * (1.0 + _EON_B * r)
    both = (1.0 - _fujii_albedo(ci, r)) * (1.0 - _fujii_albedo(co, r))
    return co / np.pi * (single + (both / missing if r > 0.0 else 0.0))


@kernel
def try_rough(d, n, r, a, b, c, e):
    """Draw from `rough_density` by rejection from a cosine and a uniform part; B cos(theta) s / t <= B is the bound."""
    ci = -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    flat = 1.0 / (1.0 + _EON_A * r)
    missing = 1.0 - flat * (1.0 + _EON_B * r)
    diffuse = flat + ((1.0 - _fujii_albedo(ci, r)) * (1.0 - flat) / missing if r > 0.0 else 0.0)
    round_part = 2.0 * r * flat
    if a * (diffuse + round_part) < diffuse:
        x, y, z = cosine_direction(n[0], n[1], n[2], b, c)
    else:
        _, x, y, z = try_uniform(n, 0.0, b, c)
    cosine = x * n[0] + y * n[1] + z * n[2]
    envelope = diffuse * cosine / np.pi + round_part / (2.0 * np.pi)
    return e * envelope < rough_density(d, n, r, np.array((x, y, z))), x, y, z


@kernel
def lattice_steps(lattice, is_turned, n):
    """Compute the direction changes of the orders (1, 0) and (0, 1) on a face (see `DiffractionLaw`)."""
    z = np.array((0.0, 0.0, 1.0)) if is_turned else n
    b1, b2 = np.cross(lattice[1], z), np.cross(z, lattice[0])
    volume = b1[0] * lattice[0, 0] + b1[1] * lattice[0, 1] + b1[2] * lattice[0, 2]
    if is_turned:
        for b in (b1, b2):
            length = np.sqrt(b[0] * b[0] + b[1] * b[1])
            x, y, up = rotate_from_z(n[0], n[1], n[2], b[0] / length, b[1] / length, 0.0)
            b[0], b[1], b[2] = length * x, length * y, length * up
    return b1 / volume, b2 / volume


@kernel
def _peak(d, n, b1, b2, row):
    """Compute the tangential direction of one order."""
    s = d[0] * n[0] + d[1] * n[1] + d[2] * n[2]
    return (
        d[0] - s * n[0] + row[0] * b1[0] + row[1] * b2[0],
        d[1] - s * n[1] + row[0] * b1[1] + row[1] * b2[1],
        d[2] - s * n[2] + row[0] * b1[2] + row[1] * b2[2],
    )


@kernel
def diffraction_norm(d, n, b1, b2, rows, sigma, nodes):
    """Compute the share of all peaks above the horizon."""
    total, low = 0.0, max(0.0, 1.0 - CUT * sigma)
    for i in range(rows.shape[0]):
        x, y, z = _peak(d, n, b1, b2, rows[i])
        distance = np.sqrt(x * x + y * y + z * z)
        if rows[i, 3] > 0.0:
            total += rows[i, 2] * interpolate(nodes, distance - low, 1.0 + CUT * sigma - low)
        elif distance < 1.0:
            total += rows[i, 2]
    return total


@kernel
def try_diffraction(d, n, b1, b2, rows, a, b, c):
    """Draw a peak by weight and a point in it, rejected below the horizon; also return is_exact."""
    i = min(np.searchsorted(rows[:, 4], a * rows[-1, 4], side="right"), rows.shape[0] - 1)
    x, y, z = _peak(d, n, b1, b2, rows[i])
    if rows[i, 3] > 0.0:
        r, angle = rows[i, 3] * np.sqrt(-2.0 * np.log(1.0 - b)), 2.0 * np.pi * c
        tx, ty, tz = rotate_from_z(n[0], n[1], n[2], np.cos(angle), np.sin(angle), 0.0)
        x, y, z = x + r * tx, y + r * ty, z + r * tz
    rest = 1.0 - x * x - y * y - z * z
    if rest <= 0.0:
        return False, 0.0, 0.0, 0.0, False
    up = np.sqrt(rest)
    return True, x + up * n[0], y + up * n[1], z + up * n[2], rows[i, 3] == 0.0


@kernel
def diffraction_density(d, n, b1, b2, rows, sigma, nodes, o):
    """Density of the broadened peaks of `try_diffraction`, without exact peaks."""
    if sigma == 0.0:
        return 0.0
    cosine = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
    total = 0.0
    for i in range(rows.shape[0]):
        if rows[i, 3] > 0.0:
            x, y, z = _peak(d, n, b1, b2, rows[i])
            x, y, z = o[0] - cosine * n[0] - x, o[1] - cosine * n[1] - y, o[2] - cosine * n[2] - z
            square = (x * x + y * y + z * z) / (sigma * sigma)
            if square < CUT * CUT:
                total += rows[i, 2] * np.exp(-0.5 * square)
    if total == 0.0:
        return 0.0
    norm = diffraction_norm(d, n, b1, b2, rows, sigma, nodes)
    return total * cosine / (2.0 * np.pi * sigma * sigma * norm)


@kernel
def _plane_of_incidence(d, n):
    """Return the tangential forward direction; an arbitrary tangent at normal incidence."""
    s = d[0] * n[0] + d[1] * n[1] + d[2] * n[2]
    x, y, z = d[0] - s * n[0], d[1] - s * n[1], d[2] - s * n[2]
    length = np.sqrt(x * x + y * y + z * z)
    if length < 1e-9:
        return rotate_from_z(n[0], n[1], n[2], 1.0, 0.0, 0.0)
    return x / length, y / length, z / length


@kernel
def _between(axis, x):
    """Return the interval of an increasing axis that contains x and the position in it (clamped to 0..1)."""
    if axis.size == 1:
        return 0, 0.0
    i = min(max(np.searchsorted(axis, x, side="right") - 1, 0), axis.size - 2)
    return i, min(max((x - axis[i]) / (axis[i + 1] - axis[i]), 0.0), 1.0)


@kernel
def _unpack(nodes):
    """Return axes, intensity and cumulative envelope of a packed table (`lawtable._pack_table`)."""
    ni, nt, np_ = int(nodes[0]), int(nodes[1]), int(nodes[2])
    a = 3 + ni
    b = a + nt
    c = b + np_
    e = c + ni * nt * np_
    return nodes[3:a], nodes[a:b], nodes[b:c], nodes[c:e].reshape(ni, nt, np_), nodes[e:].reshape(ni, -1)


@kernel
def _bilinear(f, j, s, k, t):
    low = f[j, k] * (1.0 - t) + f[j, k + 1] * t
    return low * (1.0 - s) + (f[j + 1, k] * (1.0 - t) + f[j + 1, k + 1] * t) * s


@kernel
def try_table(d, n, nodes, a, b, c, e, f, g):
    """Draw an incidence, a cell by its envelope and a point in the cell; accept by the interpolated intensity."""
    incidence, theta, phi, intensity, envelope = _unpack(nodes)
    i, s = _between(incidence, np.arccos(min(1.0, -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2]))))
    i += 1 if a < s else 0
    cells = envelope[i]
    cell = min(np.searchsorted(cells, b * cells[-1], side="right"), cells.size - 1)
    j, k = cell // (phi.size - 1), cell % (phi.size - 1)
    low, high = np.cos(theta[j + 1]), np.cos(theta[j])
    z = low + c * (high - low)
    angle = phi[k] + e * (phi[k + 1] - phi[k])
    corners = intensity[i, j : j + 2, k : k + 2]
    at = (np.arccos(z) - theta[j]) / (theta[j + 1] - theta[j])
    if f * corners.max() >= _bilinear(intensity[i], j, at, k, e):
        return _REJECTED
    angle = -angle if phi[-1] < 4.0 and g < 0.5 else angle
    tx, ty, tz = _plane_of_incidence(d, n)
    bx, by, bz = n[1] * tz - n[2] * ty, n[2] * tx - n[0] * tz, n[0] * ty - n[1] * tx
    r = np.sqrt(max(0.0, 1.0 - z * z))
    p, q = r * np.cos(angle), r * np.sin(angle)
    return z > 0.0, p * tx + q * bx + z * n[0], p * ty + q * by + z * n[1], p * tz + q * bz + z * n[2]


@kernel
def table_density(d, n, nodes, o):
    """Density of `try_table`."""
    incidence, theta, phi, intensity, _ = _unpack(nodes)
    z = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
    tilt = np.arccos(min(1.0, z))
    if tilt < theta[0] or tilt > theta[-1]:
        return 0.0
    tx, ty, tz = _plane_of_incidence(d, n)
    bx, by, bz = n[1] * tz - n[2] * ty, n[2] * tx - n[0] * tz, n[0] * ty - n[1] * tx
    angle = np.arctan2(o[0] * bx + o[1] * by + o[2] * bz, o[0] * tx + o[1] * ty + o[2] * tz)
    if phi[-1] < 4.0:
        angle = abs(angle)
    elif angle < 0.0:
        angle += 2.0 * np.pi
    j, s = _between(theta, tilt)
    k, t = _between(phi, angle)
    i, u = _between(incidence, np.arccos(min(1.0, -(d[0] * n[0] + d[1] * n[1] + d[2] * n[2]))))
    out = (1.0 - u) * _bilinear(intensity[i], j, s, k, t)
    return out + (u * _bilinear(intensity[i + 1], j, s, k, t) if u > 0.0 else 0.0)
