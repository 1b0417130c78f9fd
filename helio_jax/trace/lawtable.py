"""Scattering laws as flat arrays for the numba kernels of `laws`, with tabulated norms of the lobes.

The norm of a lobe cut at the horizon depends on the tilt of its axis. It is tabulated once per law on `N_NODES` nodes
and interpolated linearly (relative error < 1e-3 for a lobe of half a degree at grazing incidence, < 1e-5 from 5 deg
up, < 1e-6 away from grazing incidence).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.scene.scattering import Shape, Term

N_NODES = 2049
"""Nodes of the tabulated norms."""
CUT = 8.0
"""Cut-off of a Gaussian in standard deviations."""
STEEPEST_LATTICE = 0.05
"""Smallest allowed cosine between a lattice's plane normal and the normal of its face."""


class LawTable(NamedTuple):
    """The laws of all materials of a body.

    Attributes:
        first: index of each material's first term, and the number of terms [materials + 1].
        share: share of the atoms of each term [terms].
        shape, numbers: kind and parameters of each term (`Shape`) [terms], [terms, 2].
        lattice: lattice vectors in wavelengths [terms, 2, 3].
        attenuation: B of the Debye-Waller factor [terms].
        first_row: index of each term's first row, and the number of rows [terms + 1].
        rows: diffraction peaks: order, order, weight, width, cumulative weight [rows, 5].
        first_node: index of each term's first node, and the number of nodes [terms + 1].
        nodes: norms of lobes, or a table (`_pack_table`).
    """

    first: np.ndarray
    share: np.ndarray
    shape: np.ndarray
    numbers: np.ndarray
    lattice: np.ndarray
    attenuation: np.ndarray
    first_row: np.ndarray
    rows: np.ndarray
    first_node: np.ndarray
    nodes: np.ndarray


def make_law_table(laws: Sequence[tuple[Term, ...]]) -> LawTable:
    """Pack laws into arrays, in the given order."""
    terms = [term for law in laws for term in law]
    rows = [np.column_stack([t.rows, np.cumsum(t.rows[:, 2])]) for t in terms]
    nodes = [_nodes(t) for t in terms]
    start = lambda parts: np.cumsum([0, *map(len, parts)]).astype(np.int64)  # noqa: E731
    return LawTable(
        start(laws),
        np.array([t.share for t in terms], float),
        np.array([t.shape for t in terms], np.int64),
        np.array([(*t.numbers, 0.0, 0.0)[:2] for t in terms], float),
        np.array([t.lattice for t in terms], float),
        np.array([t.attenuation for t in terms], float),
        start(rows),
        np.concatenate(rows).reshape(-1, 5),
        start(nodes),
        np.concatenate(nodes),
    )


def is_cosine(law: tuple[Term, ...]) -> bool:
    """Whether a law is the pure cosine law."""
    return all(term.shape == Shape.COSINE for term in law) and sum(term.share for term in law) == 1.0


def diffuse_shares(table: LawTable) -> np.ndarray | None:
    """Return each material's share of atoms that leave by the cosine law, the others adsorbed [materials].

    None where a material's law has another term than a single one of this kind.
    """
    is_single = np.all(np.diff(table.first) == 1)
    return table.share if is_single and np.all(table.shape == Shape.COSINE) else None


def check_lattices(laws: Sequence[tuple[Term, ...]], names: Sequence[str], normals: np.ndarray, index: np.ndarray):
    """Check that no lattice plane is nearly perpendicular to a face of its material.

    Args:
        laws, names: of the materials.
        normals: of the faces [m, 3].
        index: material of each face [m].

    Raises:
        SceneError: a lattice plane is tilted by more than 87 deg against such a face.
    """
    for i, law in enumerate(laws):
        for term in law:
            plane = np.cross(*term.lattice)
            if term.shape == Shape.DIFFRACTION and not term.numbers[1]:
                cosine = np.abs(normals[index == i] @ plane) / np.linalg.norm(plane)
                if cosine.size and cosine.min() < STEEPEST_LATTICE:
                    angle = np.degrees(np.arccos(cosine.min()))
                    raise SceneError(
                        f"material.{names[i]}.lattice_nm: the lattice's plane is tilted by {angle:.1f} deg against a "
                        "face of this material, the limit is 87 deg: give such faces a material with their own lattice"
                    )


def _nodes(term: Term) -> np.ndarray:
    """Return the nodes of a term."""
    if term.shape == Shape.LOBE:
        return lobe_norm(np.linspace(0.0, 0.5 * np.pi, N_NODES), term.numbers[0])
    if term.shape == Shape.DIFFRACTION and term.numbers[0] > 0:
        reach = CUT * term.numbers[0]
        return open_share(np.linspace(max(0.0, 1.0 - reach), 1.0 + reach, N_NODES), term.numbers[0])
    if term.shape == Shape.TABLE:
        return _pack_table(term.axes, term.intensity)
    return np.zeros(0)


def lobe_norm(tilt: np.ndarray, sigma: float) -> np.ndarray:
    """Compute the integral of cos(theta)+ exp(-g^2 / (2 sigma^2)) over all directions; `tilt` of the axis [n] [rad].

    On a circle at angle g about the axis, cos(theta) = p + q cos(a) with p = cos(tilt) cos(g), q = sin(tilt) sin(g)
    and azimuth a; its positive part integrates to 2 (p t + q sin t), t = arccos(-p / q). Source: own derivation.
    """
    x, w = np.polynomial.legendre.leggauss(400)
    g = 0.5 * min(np.pi, CUT * sigma) * (x + 1.0)
    p, q = np.cos(tilt)[:, None] * np.cos(g), np.maximum(np.sin(tilt)[:, None] * np.sin(g), 1e-300)
    angle = np.arccos(np.clip(-p / q, -1.0, 1.0))
    circle = 2.0 * (p * angle + q * np.sin(angle))
    return circle @ (w * 0.5 * min(np.pi, CUT * sigma) * np.sin(g) * np.exp(-0.5 * (g / sigma) ** 2))


def open_share(distance: np.ndarray, sigma: float) -> np.ndarray:
    """Compute the share of a 2-D Gaussian of width `sigma`, centred at `distance` [n], within the unit disc.

    Valid for distance <= 1 + CUT * sigma; the quadrature is stretched towards the disc's edge. Source: own derivation.
    """
    from scipy.special import erf

    x, w = np.polynomial.legendre.leggauss(200)
    v, center = 0.5 * (x + 1.0), distance[:, None]
    low, high = np.maximum(center - CUT * sigma, -1.0), np.minimum(center + CUT * sigma, 1.0)
    at = high - (high - low) * v**2
    across = erf(np.sqrt(np.maximum(1.0 - at**2, 0.0)) / (np.sqrt(2.0) * sigma))
    return np.sum((high - low) * w * v * across * np.exp(-0.5 * ((at - center) / sigma) ** 2), 1) / (
        sigma * np.sqrt(2.0 * np.pi)
    )


def _pack_table(axes: tuple[np.ndarray, ...], intensity: np.ndarray) -> np.ndarray:
    """Pack a tabulated law into one array.

    Order: sizes (3), axes, intensity normalised to 1 over the hemisphere [i, t, p], and for each incidence the
    cumulative envelope (largest corner times solid angle) of its cells [i, (t - 1) (p - 1)], for sampling.
    """
    _, theta, phi = axes
    x, w = np.polynomial.legendre.leggauss(8)
    step, turns = np.diff(theta), 2.0 if phi[-1] < 4.0 else 1.0
    at = 0.5 * (x + 1.0)
    sine = np.sin(theta[:-1, None] + step[:, None] * at) * (0.5 * w * step[:, None])
    low, high = (sine * (1.0 - at)).sum(1), (sine * at).sum(1)
    along = 0.5 * (intensity[..., 1:] + intensity[..., :-1]) * np.diff(phi)
    total = turns * np.einsum("itp,t->i", along[:, :-1], low) + turns * np.einsum("itp,t->i", along[:, 1:], high)
    f = intensity / total[:, None, None]
    corner = np.max([f[:, :-1, :-1], f[:, 1:, :-1], f[:, :-1, 1:], f[:, 1:, 1:]], axis=0)
    cell = corner * ((np.cos(theta[:-1]) - np.cos(theta[1:]))[:, None] * np.diff(phi))
    return np.concatenate([f.shape, *axes, f.ravel(), np.cumsum(cell.reshape(len(f), -1), 1).ravel()])
