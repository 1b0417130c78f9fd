"""Sample and evaluate the scattering law of the material hit (numba).

A law is a mixture of the cosine law, whose detection probability is known in closed form (`direct`), and of lobes
(`lobes`). It is evaluated as the share of cosine atoms and the density of the lobes; mirrors and exact diffraction
peaks have no density and are only sampled. All random numbers are functions of (seed, pixel, path, event, trial).
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.scene.scattering import Shape
from helio_jax.trace import lobes
from helio_jax.trace.lawtable import LawTable
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.random import philox

_EMISSION, _ATTENUATION = np.uint64(5), np.uint64(6)
"""Streams of random numbers: of the emitted atom, and of the sample that estimates the attenuation."""
EXACT = np.inf
"""Density of an exact direction, for which aiming at a detector is impossible."""
_MAX_TRIALS = 1_000_000
_CHECK_ORDERS = 64
"""Trial at which the sampler checks whether any diffraction order is open."""
_NO_ORDER = 1e-9
"""Share of open diffraction orders below which all atoms follow the cosine law."""
_COSINE, _SPECULAR, _UNIFORM, _LOBE = (int(s) for s in (Shape.COSINE, Shape.SPECULAR, Shape.UNIFORM, Shape.LOBE))
_COSINE_LOBE, _DIFFRACTION, _ROUGH = (int(s) for s in (Shape.COSINE_LOBE, Shape.DIFFRACTION, Shape.ROUGH))


@kernel
def _debye_waller(table, t, d, x, y, z):
    """Compute the Debye-Waller factor of a direction: the share that stays in the lobe."""
    if table.attenuation[t] == 0.0:
        return 1.0
    return np.exp(-table.attenuation[t] * ((x - d[0]) ** 2 + (y - d[1]) ** 2 + (z - d[2]) ** 2))


@kernel
def _arrays(table, t):
    """Return the rows and nodes of a term."""
    rows = table.rows[table.first_row[t] : table.first_row[t + 1]]
    return rows, table.nodes[table.first_node[t] : table.first_node[t + 1]]


@kernel
def _has_orders(table, t, d, n):
    """Whether any diffraction order of a term is open."""
    b1, b2 = lobes.lattice_steps(table.lattice[t], table.numbers[t, 1] > 0.0, n)
    rows, nodes = _arrays(table, t)
    return lobes.diffraction_norm(d, n, b1, b2, rows, table.numbers[t, 0], nodes) > _NO_ORDER


@kernel
def _draw(table, t, d, n, key, stream, pixel, path, event):
    """Draw from one lobe: (direction, is_exact); NaN where no order is open."""
    shape, p, q = table.shape[t], table.numbers[t, 0], table.numbers[t, 1]
    if shape == _SPECULAR:
        x, y, z = lobes.mirror(d, n, 1.0)
        return x, y, z, True
    rows, nodes = _arrays(table, t)
    b1, b2 = n, n
    if shape == _DIFFRACTION:
        b1, b2 = lobes.lattice_steps(table.lattice[t], table.numbers[t, 1] > 0.0, n)
    for trial in range(1, _MAX_TRIALS):
        a, b, c, e = philox(key, stream, pixel, path, event, np.uint64(2 * trial))
        is_exact = False
        if shape == _DIFFRACTION and trial == _CHECK_ORDERS and not _has_orders(table, t, d, n):
            return np.nan, np.nan, np.nan, False
        if shape == _UNIFORM:
            is_kept, x, y, z = lobes.try_uniform(n, p, a, b)
        elif shape == _LOBE:
            is_kept, x, y, z = lobes.try_lobe(d, n, p, q, a, b, c)
        elif shape == _COSINE_LOBE:
            is_kept, x, y, z = lobes.try_cosine_lobe(d, n, a, b)
        elif shape == _DIFFRACTION:
            is_kept, x, y, z, is_exact = lobes.try_diffraction(d, n, b1, b2, rows, a, b, c)
        elif shape == _ROUGH:
            is_kept, x, y, z = lobes.try_rough(d, n, p, a, b, c, e)
        else:
            f, g, _, _ = philox(key, stream, pixel, path, event, np.uint64(2 * trial + 1))
            is_kept, x, y, z = lobes.try_table(d, n, nodes, a, b, c, e, f, g)
        if is_kept:
            length = np.sqrt(x * x + y * y + z * z)
            return x / length, y / length, z / length, is_exact
    return np.nan, np.nan, np.nan, False


@kernel
def _density(table, t, d, n, o):
    """Compute the density of one lobe with attenuation (0 for exact directions)."""
    shape, p, q = table.shape[t], table.numbers[t, 0], table.numbers[t, 1]
    rows, nodes = _arrays(table, t)
    if shape == _UNIFORM:
        cosine = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
        out = 1.0 / (2.0 * np.pi * (1.0 - p)) if cosine >= p else 0.0
    elif shape == _LOBE:
        out = lobes.lobe_density(d, n, p, q, nodes, o)
    elif shape == _COSINE_LOBE:
        out = lobes.cosine_lobe_density(d, n, o)
    elif shape == _DIFFRACTION:
        b1, b2 = lobes.lattice_steps(table.lattice[t], table.numbers[t, 1] > 0.0, n)
        out = lobes.diffraction_density(d, n, b1, b2, rows, p, nodes, o)
    elif shape == _ROUGH:
        out = lobes.rough_density(d, n, p, o)
    else:
        out = lobes.table_density(d, n, nodes, o)
    return out * _debye_waller(table, t, d, o[0], o[1], o[2])


@kernel
def lobe_density(table: LawTable, material, d, n, o):
    """Compute the density per steradian of a material's lobes, without its cosine part; 0 below the surface."""
    total = 0.0
    if o[0] * n[0] + o[1] * n[1] + o[2] * n[2] > 0.0:
        for t in range(table.first[material], table.first[material + 1]):
            if table.shape[t] != _COSINE and table.shape[t] != _SPECULAR:
                total += table.share[t] * _density(table, t, d, n, o)
    return total


@kernel
def cosine_shares(table, material, incoming, normal, ids, path, event, seed):
    """Compute the share of atoms that leave by the cosine law [n].

    The mean attenuation of a lobe has no closed form; one atom drawn from the lobe gives an unbiased estimate.
    """
    out = np.zeros(material.size)
    key = np.uint64(seed)
    for i in range(material.size):
        d, n = incoming[i], normal[i]
        for t in range(table.first[material[i]], table.first[material[i] + 1]):
            if table.shape[t] == _COSINE:
                out[i] += table.share[t]
            elif table.attenuation[t] > 0.0:
                x, y, z, _ = _draw(
                    table, t, d, n, key, _ATTENUATION, np.uint64(ids[i]), np.uint64(path[i]), np.uint64(event)
                )
                out[i] += table.share[t] * (1.0 if np.isnan(x) else 1.0 - _debye_waller(table, t, d, x, y, z))
            elif table.shape[t] == _DIFFRACTION and not _has_orders(table, t, d, n):
                out[i] += table.share[t]
    return out


@kernel
def leaves_surface(share, seed, pixel, path, event):
    """Whether an atom leaves a surface that re-emits this share of them; the choice of `scatter_atoms`."""
    key, number = np.uint64(seed), np.uint64(event)
    return philox(key, _EMISSION, np.uint64(pixel), np.uint64(path), number, np.uint64(0))[0] < share


@kernel
def scatter_atoms(table, material, incoming, normal, u, ids, path, event, seed, with_density=True):
    """Sample the directions of scattered atoms.

    Args:
        table: laws of the materials.
        material: of each point [n].
        incoming: unit directions [n, 3].
        normal: unit normals, outward [n, 3].
        u: random numbers of the cosine law, low-discrepancy at the first scattering [n, 2 or more].
        ids, path, event, seed: key of the other random numbers: pixel [n], path in the pixel [n].
        with_density: False skips the density.

    Returns:
        Directions [n, 3]; density of the material's lobes there, 0 for atoms of the cosine law, `EXACT` for exact
        directions [n]; False for adsorbed atoms [n].
    """
    size = material.size
    out, density, leaves = np.empty((size, 3)), np.zeros(size), np.ones(size, np.bool_)
    key = np.uint64(seed)
    for i in range(size):
        d, n = incoming[i], normal[i]
        pixel, ray, number = np.uint64(ids[i]), np.uint64(path[i]), np.uint64(event)
        out[i] = cosine_direction(n[0], n[1], n[2], u[i, 0], u[i, 1])
        a, b, _, _ = philox(key, _EMISSION, pixel, ray, number, np.uint64(0))
        t, last = table.first[material[i]], table.first[material[i] + 1]
        while t < last and a >= table.share[t]:
            a -= table.share[t]
            t += 1
        leaves[i] = t < last
        if t == last or table.shape[t] == _COSINE:
            continue
        x, y, z, is_exact = _draw(table, t, d, n, key, _EMISSION, pixel, ray, number)
        if np.isnan(x) or b >= _debye_waller(table, t, d, x, y, z):
            continue
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
        if with_density:
            density[i] = EXACT if is_exact else lobe_density(table, material[i], d, n, out[i])
    return out, density, leaves
