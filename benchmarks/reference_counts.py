"""Every count of the reference program against ours, as one family of p-values.

python benchmarks/reference_counts.py [--shared ../shared] [--output benchmarks/out] [--tiny]

Counts of every set per detector and scattering order (chi-square over its pixels; cells below 10 pooled; the variance
of our own estimate counted), the flat against the cosine-law integral, and histograms of scattered directions. Where
all is right no p-value is below 1e-4, and together they are uniform (Kolmogorov-Smirnov). Frame of the direction
histograms: normal +y, atoms come along (0.5, -0.866, 0), cells in outgoing (x, z); ours: x = x, y = -z.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.reference_sets import CountSet, broad_sets, flat_sets, sphere_set, trench_sets  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.scene.scattering import (  # noqa: E402
    BackscatteringLaw,
    BroadSpecularLaw,
    Compat,
    CosineLaw,
    CosineSpecularLaw,
    DebyeWaller,
    DiffractionLaw,
    UniformLaw,
)
from helio_jax.trace.laws import scatter_atoms  # noqa: E402
from helio_jax.trace.lawtable import make_law_table  # noqa: E402
from helio_jax.trace.run import N_REPLICATES  # noqa: E402
from helio_jax.trace.settings import TraceSettings  # noqa: E402
from tests.stats import pooled_chi2  # noqa: E402

ORDERS = [[0], [1], [2], list(range(3, 13))]
TRENCH_ORDERS = [[i] for i in range(13)]
SQUARE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
SEED = 8


def order_p_values(count_set: CountSet, settings: TraceSettings, orders: list[list[int]] = ORDERS) -> np.ndarray:
    """Return p [detector, group of orders] of a set of counts against our expectation."""
    mean, variance = count_set.expect(settings)
    out = np.empty((mean.shape[1], len(orders)))
    for k in range(mean.shape[1]):
        for j, group in enumerate(orders):
            columns = (a[:, k][:, group].sum(-1) for a in (count_set.counts, mean, variance))
            out[k, j] = pooled_chi2(*columns, dof=N_REPLICATES - 1)
    return out


WRONG_THERE = ["broad_specular", "broad_specular_wide", "backscattering", "diffraction"]
WRONG_THERE += ["diffraction2", "diffraction_specified"]
SETS = ["cosine", "uniform60", "cosine_specular", "dw_specular", "dw_diffraction", *WRONG_THERE]


def lattice_law(numbers: list, compat: Compat, **more) -> DiffractionLaw:
    """Return a law from (diffuse, order, order, wavelength / lattice constant, ..., peak width, order width)."""
    diffuse, n, m, ratio, *vectors, width, order_sigma = numbers
    vectors = [tuple(v) for v in np.reshape(vectors, (2, -1)).tolist()] if vectors else SQUARE
    return DiffractionLaw(
        diffuse_fraction=diffuse, max_order=(n, m), wavelength_nm=ratio, lattice_nm=(vectors[0], vectors[1]),
        peak_sigma=width, order_sigma=order_sigma, compat=compat, **more,
    )  # fmt: skip


def law_of(function: str, numbers: list, compat: Compat):
    """Return the law that one set of the file was made with."""
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
        peaks = tuple((int(n), int(m), float(w)) for n, m, w in np.reshape(peaks, (-1, 3)))
        return DiffractionLaw(
            diffuse_fraction=diffuse, wavelength_nm=ratio, lattice_nm=SQUARE, peak_sigma=width,
            peaks=peaks, compat=compat,
        )  # fmt: skip
    if function.startswith("dw_"):
        energy, mass, temperature, debye, diffuse, *rest = numbers
        thermal = DebyeWaller(energy_mev=energy, mass_u=mass, temperature_k=temperature, debye_k=debye)
        if function == "dw_diffraction":
            return lattice_law([diffuse, *rest], compat, debye_waller=thermal)
        return BroadSpecularLaw(diffuse_fraction=diffuse, sigma_deg=rest[0], compat=compat, debye_waller=thermal)
    return lattice_law(numbers, compat)


def law_p_value(shared: Path, name: str, compat: Compat, n_ours: int = 1_000_000) -> float:
    """Return the chi-square p of one set against our atoms; cells with fewer than 10 of ours are pooled."""
    about = json.loads((shared / "reference" / "distributions.json").read_text())
    with np.load(shared / "reference" / "distributions.npz", allow_pickle=False) as data:
        edges, observed = data["edges"], data[name].ravel().astype(float)
    what = about["distributions"][name]
    law = law_of(what["function"], what["params"], compat)
    x, y, z = about["incident"]
    incoming, normal = np.tile([x, -z, y], (n_ours, 1)), np.tile([0.0, 0.0, 1.0], (n_ours, 1))
    none, u = np.zeros(n_ours, np.int64), np.random.default_rng(4).random((n_ours, 2))
    table = make_law_table([law.terms()])
    out, _, leaves = scatter_atoms(table, none, incoming, normal, u, none, np.arange(n_ours), 0, SEED, False)
    assert leaves.all()
    ours = np.histogram2d(out[:, 0], -out[:, 1], (edges, edges))[0].ravel()
    is_small = ours < 10
    o, e = (np.append(a[~is_small], a[is_small].sum()) for a in (observed, ours))
    o, e, scale = o[o + e > 0], e[o + e > 0], o.sum() / n_ours
    return float(stats.chi2.sf(np.sum((o - scale * e) ** 2 / (o + scale**2 * e)), o.size - 1))


def families(shared: Path) -> dict[str, np.ndarray]:
    """Return the p-values of every set."""
    out = {}
    for count_set, rays, branches in [(sphere_set(shared), 256, 32)] + [(s, 8192, 16) for s in broad_sets(shared)]:
        out[count_set.name] = order_p_values(count_set, TraceSettings(rays=rays, branches=branches, n_orders=13))
    z = []
    for count_set, exact in flat_sets(shared):
        mean = count_set.n_rays * np.asarray(exact)
        z.append((count_set.counts[0, :, 0] - mean) / np.sqrt(mean))
    out["flat at 12 distances, against the integral"] = 2.0 * stats.norm.sf(np.abs(z))
    for count_set, _ in trench_sets(shared):
        settings = TraceSettings(rays=8192, branches=4, n_orders=13)
        out[count_set.name] = order_p_values(count_set, settings, TRENCH_ORDERS)
    out["directions, compat on"] = np.array([law_p_value(shared, name, "shem-ray-tracing") for name in SETS])
    return out


def reference_rows(shared: Path) -> list[Row]:
    """Return one row per set, and one for all together."""
    found = families(shared)
    rows = [
        row("1", name, f"smallest of {p.size} p-values {p.min():.2g}", ">= 1e-4", bool(p.min() >= 1e-4))
        for name, p in found.items()
    ]
    every = np.concatenate([p.ravel() for p in found.values()])
    ks = float(stats.kstest(every, "uniform").pvalue)
    return [*rows, row("1", "all p-values together", f"KS p = {ks:.3g} of {every.size}", "> 1e-3", ks > 1e-3)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    if not (args.shared / "reference").is_dir():
        rows = [row("1", "counts of the reference program", f"not measured: no {args.shared}/reference", "", None)]
    elif args.tiny:
        p = law_p_value(args.shared, "cosine", "none", 300_000)
        rows = [row("1", "directions of the cosine law, fewer atoms", f"p = {p:.2g}", ">= 1e-4", p >= 1e-4)]
    else:
        rows = reference_rows(args.shared)
    write(args.output / ("reference_tiny.json" if args.tiny else "reference_counts.json"), rows, seed=SEED)


if __name__ == "__main__":
    main()
