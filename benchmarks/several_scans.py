"""One surface from several scans: opposite beams, hybrid, one detector at 45 degrees, traced with noise.

python benchmarks/several_scans.py [--output benchmarks/out] [--members N] [--seed S] [--tiny]

Shapes and places are drawn anew for every member. Rows: a cap under one beam and under two opposite ones (unseen area,
error); the hybrid of the paper, three detectors at two azimuths, against three images of the same dose; a truncated
crystal under one detector at 45 degrees in five rotations, motions as the stage states them and fitted from wrong ones;
time of two scans. `--tiny`: one small member of each, by `nearfield`.
"""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))


import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.alignment.resample import is_lit  # noqa: E402
from helio_jax.inverse.linear import MIN_IMAGES  # noqa: E402
from helio_jax.inverse.settings import ReconstructSettings  # noqa: E402
from helio_jax.measure.sample_grid import resample_heights  # noqa: E402
from helio_jax.micrograph import MicrographSet  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402
from helio_jax.workflows.several_scans import stage_motions  # noqa: E402
from helio_jax.workflows.truth import true_height, true_surface  # noqa: E402

PITCH = 24.0


def scans_of(name: str, n: int, changes: dict[str, Any], seed: int) -> tuple[SceneFile, MicrographSet]:
    """Trace a shipped scene with changes, n x n pixels, with counting noise."""
    raster = {"scan.nx": n, "scan.ny": n, "scan.pixel_size_um": PITCH, "scan.pitch": "sample", "noise.seed": seed}
    scene = load_scene(name, raster | changes)
    found = pipeline.record(scene, pipeline.simulate(scene))
    return scene, MicrographSet(found.stacks)


def errors_of(rec: hx.Reconstruction, scene: SceneFile) -> tuple[float, float, float]:
    """Compute the RMS error of all and of the valid heights over the relief, and the coverage of 2 s.d."""
    truth = true_height(scene, rec).height
    error, valid = rec.height - truth, rec.is_valid
    covered = np.nan if rec.height_std is None else float(np.mean(np.abs(error)[valid] < 2.0 * rec.height_std[valid]))
    rms = [float(np.sqrt(np.mean(e**2)) / np.ptp(truth)) for e in (error, error[valid])]
    return rms[0], rms[1], covered


def said(errors: tuple[float, float, float], more: str = "") -> str:
    return f"RMS {errors[0]:.2%}, valid {errors[1]:.2%}, 2 s.d. {errors[2]:.0%}{more}"


def opposite_beams(rng: np.random.Generator, n: int, settings: ReconstructSettings, number: int) -> list[Row]:
    """Row 1: a ball on a plane, buried in part or not, which shadows the ground, seen by one beam and by two."""
    radius = float(rng.uniform(0.15, 0.2) * n * PITCH)
    height = float(rng.uniform(0.9, 1.5) * radius)
    ball = {"radius_um": radius, "cap_height_um": height, "center_um": rng.uniform(-30, 30, 2).tolist()}
    changes = {
        "sample.spheres": [ball],
        "plate.sample_distance_um": 4000.0 + height,
        "scan.rotations_deg": [0.0, 180.0],
    }
    scene, scans = scans_of("sphere_a", n, changes, number)
    down = scene.beam.changed(incidence_deg=0.0)
    alone = hx.reconstruct(scans.stacks[0], settings=settings)
    seen = resample_heights(alone, PITCH, use_all=True)
    error = seen.height - true_surface(scene, seen.x, seen.y, down).height
    start = time.perf_counter()
    rec, joined = hx.reconstruct_scans(scans, settings=settings)
    seconds = time.perf_counter() - start
    x, y = joined.stack.x, joined.stack.y
    is_seen = is_lit(true_height(scene, rec).height, x, y, np.array(scene.instrument.beam_shift))
    unseen = float(np.mean(~is_seen)), float(np.mean(joined.stack.is_observed.sum(0) < MIN_IMAGES))
    one = float(np.sqrt(np.nanmean(error**2)) / height)
    both = errors_of(rec, scene)
    what = f"ball of {radius:.0f} um, {height:.0f} um high, opposite beams"
    value = said(both, f" (one beam {one:.2%}, unseen {unseen[0]:.2%}, now {unseen[1]:.2%})")
    reached = both[0] <= 0.025 and unseen[1] < 0.5 * unseen[0]
    return [
        row("1", what, value, "unseen < half; <= 2.5 %", reached),
        row("11", f"two scans of {n} x {n} x 3", f"{seconds:.0f} s", "<= 60 s at 121 x 121", seconds <= 60),
    ]


def hybrid(rng: np.random.Generator, n: int, settings: ReconstructSettings, number: int) -> list[Row]:
    """Row 2: three detectors at two azimuths, against three images of twice the dose."""
    radius = float(rng.uniform(0.28, 0.36) * n * PITCH)
    height = float(rng.uniform(0.3, 0.5) * radius)
    ball = {"radius_um": radius, "cap_height_um": height, "center_um": rng.uniform(-60, 60, 2).tolist()}
    changes = {"sample.spheres": [ball], "plate.sample_distance_um": 4000.0 + height}
    scene, scans = scans_of("hybrid", n, changes, number)
    six = errors_of(hx.reconstruct(scans, settings=settings), scene)
    dose = {"scan.rotations_deg": [0.0], "scan.atoms_per_pixel": 2.0 * scene.scan.atoms_per_pixel}
    scene, scans = scans_of("hybrid", n, changes | dose, number)
    three = errors_of(hx.reconstruct(scans.stacks[0], settings=settings), scene)
    value = said(six, f" (3 images {three[0]:.2%})")
    return [row("2", f"cap {height:.0f} um, hybrid, 6 images", value, "below 3 images", six[0] < three[0])]


def crystal(rng: np.random.Generator, n: int, settings: ReconstructSettings, number: int) -> list[Row]:
    """Row 3: one detector at 45 degrees, five rotations; motions known, then displaced by 1.5 pixels and fitted."""
    side, height, slope = 0.5 * n * PITCH, float(rng.uniform(0.06, 0.12) * n * PITCH), float(rng.uniform(25.0, 50.0))
    shape = {"base_um": side, "top_um": side - 2.0 * height / math.tan(math.radians(slope)), "height_um": height}
    changes = {f"sample.{k}": v for k, v in shape.items()} | {"sample.azimuth_deg": float(rng.uniform(0.0, 90.0))}
    scene, scans = scans_of("crystal_45", n, changes | {"plate.sample_distance_um": 2100.0 + height}, number)
    rec = hx.reconstruct(scans, settings=settings)
    rows, what = [], f"crystal {height:.0f} um, sides {slope:.0f} deg, 45 deg"
    errors = errors_of(rec, scene)
    rows.append(row("3", f"{what}, motions known", said(errors), "<= 3 %", errors[0] <= 0.03))
    shifts = rng.normal(0.0, 1.5 * PITCH, (len(scans.stacks), 2))
    shifts[0] = 0.0
    wrong = displaced(scans, shifts)
    rec, joined = hx.reconstruct_scans(wrong, settings=settings, motions="fitted")
    off = [
        math.dist(np.add(m.shift, -d), s.shift)
        for m, s, d in zip(joined.motions, stage_motions(scans), shifts, strict=True)
    ]
    errors = errors_of(rec, scene)
    value = said(errors, f"; motions {max(off) / PITCH:.1f} px off" + ("; WARNED" if joined.warnings else ""))
    rows.append(row("3", f"{what}, motions fitted", value, "<= 3 %", errors[0] <= 0.03))
    return rows


def displaced(scans: MicrographSet, shifts: np.ndarray) -> MicrographSet:
    """Return scans whose stage states positions that are off by shifts [scan, 2], um."""
    pairs = zip(scans.stacks, shifts, strict=True)
    return MicrographSet(tuple(s.replace(x=s.x + shift[0], y=s.y + shift[1]) for s, shift in pairs))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--members", type=int, default=3)
    parser.add_argument("--size", type=int, default=61)
    parser.add_argument("--seed", type=int, default=917)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    n, members = (21, 1) if args.tiny else (args.size, args.members)
    settings = ReconstructSettings(method="nearfield", samples=0) if args.tiny else ReconstructSettings(method="refine")
    rng, rows = np.random.default_rng(args.seed), []
    for number in range(members):
        for kind in (opposite_beams, hybrid, crystal):
            rows += kind(rng, n, settings, args.seed + number)
    write(args.output / "several_scans.json", rows, args.seed)


if __name__ == "__main__":
    main()
