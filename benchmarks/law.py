"""Scattering laws in the fit: the law found against the law traced, and heights against those of the cosine law.

    python benchmarks/law.py [--members 4] [--family smooth] [--dose 1] [--size 33 41] [--seed 7] [--tiny]
        [--output benchmarks/out]

Random samples of `benchmarks/shapes.py`, with five detectors instead of theirs and a multiple of their dose. Each is
traced with every law; its noisy micrographs are reconstructed once by the cosine law and once by a law with unknown
numbers. Errors of the heights are root mean squares over all pixels. Samples and settings are the same for all laws;
the truth only scores.
"""

import argparse
import math
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from benchmarks.shapes import FAMILIES, Member, members  # noqa: E402
from helio_jax.workflows.pipeline import record  # noqa: E402

FINER = 4
"""The triangles of a coarser map are roughness below the pixel, which acts like another law."""
RAYS = 4096
"""Beam rays per pixel: with 256 the tracer's own noise is about 1.5 % of the signal by EON, that of counting 0.6 %."""
N_DETECTORS, POLAR_DEG, HALF_ANGLE_DEG = 5, 38.0, 8.0
ANGLES = np.radians([20.0, 30.0, 40.0, 50.0, 60.0])
"""Angles to the normal at which a law is compared with the cosine law: those that the detectors see most."""
LAWS: dict[str, tuple[dict[str, Any], str, dict[str, float]]] = {
    "cosine by power": ({"kind": "cosine"}, "power", {"exponent of the law": 0.0}),
    "cosine by monotone": ({"kind": "cosine"}, "monotone", {}),
    "EON of 20 deg": ({"kind": "rough_diffuse", "roughness": 20.0 / 90.0}, "rough_diffuse", {"roughness": 20.0 / 90.0}),
    "15 % lobe of 30 deg": (
        {"kind": "broad_specular", "sigma_deg": 30.0, "diffuse_fraction": 0.85},
        "broad_specular",
        {"share of the lobe": 0.15, "width of the lobe": 30.0},
    ),
}
"""Cases: material of the scene, law of the fit, its true numbers."""


def with_law(member: Member, material: dict[str, Any], dose: float) -> Member:
    """Return a sample all of which scatters by one law, seen by five detectors, with a multiple of its dose."""
    detectors = [
        {"name": f"d{k}", "polar_deg": POLAR_DEG, "azimuth_deg": 72.0 * k, "half_angle_deg": HALF_ANGLE_DEG}
        for k in range(N_DETECTORS)
    ]
    sample = member.tables["sample"] | {"material": "all"}
    scan = member.tables["scan"] | {"atoms_per_pixel": round(dose * member.tables["scan"]["atoms_per_pixel"])}
    tables = member.tables | {"sample": sample, "material": {"all": material}, "detector": detectors, "scan": scan}
    return replace(member, tables=tables, map=member.map and finer(*member.map))


def finer(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate a height map by cubic splines to `FINER` times its points along each axis."""
    at_x, at_y = (np.linspace(a[0], a[-1], FINER * (a.size - 1) + 1) for a in (x, y))
    return at_x, at_y, RectBivariateSpline(y, x, height)(at_y, at_x)


def deviation(law: Any) -> float:
    """Return the largest deviation of a law from the cosine law at `ANGLES`, both scaled to the same mean there."""
    relative = np.asarray(law.relative(1.0, np.cos(ANGLES), -np.cos(ANGLES)))
    return float(np.abs(relative / relative.mean() - 1.0).max())


def fitted_law(kind: str, values: dict[str, list[Any]]) -> Any:
    """Return a law as reported."""
    numbers = np.array([v[0] for name, v in values.items() if "exponent" in name])
    return hx.PowerLaw(numbers[0]) if kind == "power" else hx.MonotoneLaw(numbers)


def run(member: Member, name: str, rays: int, refine: dict[str, Any], dose: float) -> Row:
    """Trace a sample with a law by so many rays per pixel, reconstruct it twice, and score both."""
    material, kind, true = LAWS[name]
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        scene = hx.load_scene(with_law(member, material, dose).write(Path(folder)))
        stack = record(scene, hx.simulate(scene, rays=rays)).only()
        errors, found = [], {}
        for law in ("cosine", kind):
            rec = hx.reconstruct(stack, border=member.border, refine={"law": law} | refine)
            scores = hx.evaluate(rec, hx.true_height(scene, rec))
            errors.append(scores.rms_image * scores.H_um)
            found = rec.provenance["instrument"]
    values, judged = found["values"], found["law"]
    pulls = {n: (values[n][0] - value) / values[n][1] for n, value in true.items()}
    said = ", ".join(f"{n.split(' of')[0]} {values[n][0]:.3f} +- {values[n][1]:.3f}" for n in true)
    more: dict[str, float] = {}
    is_right = all(abs(pull) <= 2.0 for pull in pulls.values())
    if material["kind"] == "cosine":
        more["deviation"] = deviation(fitted_law(kind, values))
        is_right &= more["deviation"] <= 0.02
        said = f"{said}; " * bool(said) + f"off cosine by {more['deviation']:.1%}"
    ratio = errors[1] / errors[0]
    value = f"{said}; p {judged['cosine_probability']:.2g}; rms {errors[0]:.3g} -> {errors[1]:.3g} um ({ratio:.2f})"
    more |= {"rms_cosine_um": errors[0], "rms_um": errors[1], "ratio": ratio, "seconds": time.perf_counter() - started}
    about = {
        "kind": member.about["kind"],
        "incidence_deg": member.about["incidence_deg"],
        "snr": member.about["snr"] * math.sqrt(dose),
    }
    what = f"{name}: {member.name}, {about['kind']}, SNR {about['snr']:.0f}"
    kept = {n: values[n] for n in values if n in true or "exponent" in n}
    judged = {"probability": judged["cosine_probability"]}
    return row("5", what, value, "2 s.d.", is_right, law=name, numbers=kept, pulls=pulls, **about, **more, **judged)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--members", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="number of the first member")
    parser.add_argument("--family", default="smooth", choices=list(FAMILIES))
    parser.add_argument("--laws", default=",".join(LAWS), help="names of `LAWS`")
    parser.add_argument("--dose", type=float, default=1.0, help="times the counts of the samples")
    parser.add_argument("--size", type=int, nargs=2, default=(33, 41))
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    given = parser.parse_args()
    rays, refine = RAYS, dict[str, Any]()
    if given.tiny:
        given.members, given.size, given.laws = 1, (16, 16), "EON of 20 deg"
        rays, refine = 64, {"max_rounds": 2, "rays": 20_000, "samples": 8}
    chosen = [name for name in LAWS if name in given.laws.split(",")]
    rows: list[Any] = []
    size, numbers = (given.size[0], given.size[1]), range(given.first, given.first + given.members)
    for member in members(given.family, given.seed, numbers, size):
        for name in chosen:
            rows.append(run(member, name, rays, refine, given.dose))
            write(given.output / "law.json", rows, given.seed)
    for name in chosen:
        of = [r for r in rows if r["law"] == name]
        pulls = [abs(p) for r in of for p in r["pulls"].values()]
        ratio = math.exp(np.mean([math.log(r["ratio"]) for r in of]))
        right = f"{np.mean(np.array(pulls) <= 2.0):.0%} of the numbers within 2 s.d., " if pulls else ""
        print(f"{name}: {right}height error over that of the cosine fit {ratio:.2f} (geometric mean)")


if __name__ == "__main__":
    main()
