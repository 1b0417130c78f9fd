"""The reference program's histograms of scattered directions against our laws, with its faults and without (DATA.md).

Frame of the files: normal +y, atoms come along (0.5, -0.866, 0), histogram over outgoing (x, z); ours: x = x, y = -z.
"""

import json

import numpy as np
import pytest
from scipy import stats

from helio_jax.scene.scattering import (
    BackscatteringLaw,
    BroadSpecularLaw,
    CosineLaw,
    CosineSpecularLaw,
    DebyeWaller,
    DiffractionLaw,
    UniformLaw,
)
from helio_jax.trace.laws import scatter_atoms
from helio_jax.trace.lawtable import make_law_table

N_OURS = 1_000_000


def lattice_law(numbers, compat, **more):
    """A law from (diffuse, order, order, wavelength / lattice constant, ..., peak width, order width)."""
    diffuse, n, m, ratio, *vectors, width, order_sigma = numbers
    vectors = np.reshape(vectors, (2, -1)).tolist() if vectors else [[1, 0, 0], [0, 1, 0]]
    return DiffractionLaw(
        diffuse_fraction=diffuse, max_order=(n, m), wavelength_nm=ratio, lattice_nm=vectors, peak_sigma=width,
        order_sigma=order_sigma, compat=compat, **more,
    )  # fmt: skip


def law_of(function: str, numbers: list, compat: str):
    """The law that one set of the file was made with."""
    if function == "cosine":
        return CosineLaw()
    if function == "uniform":
        return UniformLaw(half_angle_deg=numbers[0])
    if function == "cosine_specular":
        return CosineSpecularLaw()
    if function in ("broad_specular", "backscattering"):
        law = BroadSpecularLaw if function == "broad_specular" else BackscatteringLaw
        return law(diffuse_fraction=numbers[0], sigma_deg=numbers[1], compat=compat)
    if function == "diffraction_specified":
        diffuse, ratio, width, _, *peaks = numbers
        peaks = [(int(n), int(m), w) for n, m, w in np.reshape(peaks, (-1, 3))]
        return DiffractionLaw(
            diffuse_fraction=diffuse, wavelength_nm=ratio, lattice_nm=[[1, 0, 0], [0, 1, 0]], peak_sigma=width,
            peaks=peaks, compat=compat,
        )  # fmt: skip
    if function.startswith("dw_"):
        energy, mass, temperature, debye, diffuse, *rest = numbers
        thermal = DebyeWaller(energy_mev=energy, mass_u=mass, temperature_k=temperature, debye_k=debye)
        if function == "dw_diffraction":
            return lattice_law([diffuse, *rest], compat, debye_waller=thermal)
        return BroadSpecularLaw(diffuse_fraction=diffuse, sigma_deg=rest[0], compat=compat, debye_waller=thermal)
    return lattice_law(numbers, compat)


def p_value(shared, name: str, compat: str) -> float:
    """Chi-square p of one set against as many atoms of ours; cells where we expect fewer than 10 are pooled."""
    about = json.loads((shared / "reference" / "distributions.json").read_text())
    with np.load(shared / "reference" / "distributions.npz", allow_pickle=False) as data:
        edges, observed = data["edges"], data[name].ravel().astype(float)
    what = about["distributions"][name]
    law = law_of(what["function"], what["params"], compat)
    x, y, z = about["incident"]
    incoming, normal = np.tile([x, -z, y], (N_OURS, 1)), np.tile([0.0, 0.0, 1.0], (N_OURS, 1))
    none, u = np.zeros(N_OURS, np.int64), np.random.default_rng(4).random((N_OURS, 2))
    table = make_law_table([law.terms()])
    out, _, leaves = scatter_atoms(table, none, incoming, normal, u, none, np.arange(N_OURS), 0, 8, False)
    assert leaves.all()
    ours = np.histogram2d(out[:, 0], -out[:, 1], (edges, edges))[0].ravel()
    is_small = ours < 10
    o, e = (np.append(a[~is_small], a[is_small].sum()) for a in (observed, ours))
    o, e = o[o + e > 0], e[o + e > 0]
    return float(stats.chi2.sf(np.sum((o - e) ** 2 / (o + e)), o.size - 1))


WRONG_THERE = ["broad_specular", "broad_specular_wide", "backscattering", "diffraction"]
WRONG_THERE += ["diffraction2", "diffraction_specified"]
SETS = ["cosine", "uniform60", "cosine_specular", "dw_specular", "dw_diffraction", *WRONG_THERE]


@pytest.mark.parametrize("name", SETS)
def test_compatible_laws(shared, name):
    """Every set is matched with the program's faults switched on (p > 1e-4); catches a fault copied wrongly."""
    p = p_value(shared, name, "shem-ray-tracing")
    print(f"{name}: p = {p:.3g}")
    assert p > 1e-4, f"{name}: p = {p:.2e}"


@pytest.mark.parametrize("name", WRONG_THERE)
def test_correct_laws_differ(shared, name):
    """The same test rejects the correct laws, where the program's are wrong (thermal: few are left)."""
    assert p_value(shared, name, "none") < 1e-9
