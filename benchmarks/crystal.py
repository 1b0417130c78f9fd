"""Angles and sides of a crystal whose faces are known, and of the measured one: which stage makes which error.

python benchmarks/crystal.py [--output benchmarks/out] [--size N] [--tiny]
                             [--sample crystal|tall|hills|pyramids|rough|measured] [--law JSON]

A truncated crystal ({100} top of 438 x 250 um, tilted by 6 degrees, four {111} sides at 125.26 degrees to it) on level
ground is traced anew for five rotations of one detector, with gains, background (75 % of the reading), its drift and
noise as the measured scans have them. Then one thing after the other is given as it truly is: the motions, the gains
and background, the multiple scattering. `tall` stands 1100 um high and fills the field, `hills` and `rough` have no
facets and are, as `pyramids`, scored by their slopes. Truth scores, and is given where a row says so; no reconstruction
knows it otherwise. `--law` makes another law of scattering true, as `[material.NAME]` of a scene would, of which the
reconstruction, by the cosine law, knows nothing: {"kind": "backscattering", "sigma_deg": 30, "diffuse_fraction": 0.9}.
Finished rows are kept in the output file and not done again. Where the shared data are, the measured crystal is
reconstructed by the same settings (`--sample measured`).
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import TypeAdapter

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))


from benchmarks import rows  # noqa: E402
from benchmarks.alignment import INSTRUMENT, POINTS, SCANS, Surface, bumps, pyramids, rough  # noqa: E402
from helio_jax.alignment.align import find_motions  # noqa: E402
from helio_jax.alignment.resample import resample  # noqa: E402
from helio_jax.alignment.rigid import Rigid  # noqa: E402
from helio_jax.arrays import pitch  # noqa: E402
from helio_jax.calibration.self_calibration import (  # noqa: E402
    SelfCalibration,
    apply_calibration,
    effective_instrument,
)
from helio_jax.errors import GuardError  # noqa: E402
from helio_jax.formats.matlab import import_micrographs  # noqa: E402
from helio_jax.formats.points import read_points  # noqa: E402
from helio_jax.forward.form_factor import substrate_signal  # noqa: E402
from helio_jax.forward.optics import Optics  # noqa: E402
from helio_jax.forward.surface import unit_normal  # noqa: E402
from helio_jax.measure.facets import Facet, FacetSettings, find_facets  # noqa: E402
from helio_jax.micrograph import MicrographSet, MicrographStack  # noqa: E402
from helio_jax.reconstruction import Reconstruction  # noqa: E402
from helio_jax.scene.body import COSINE  # noqa: E402
from helio_jax.scene.scattering import CosineLaw, Law  # noqa: E402
from helio_jax.scene.surfaces import surface_body  # noqa: E402
from helio_jax.trace.run import make_experiment, trace_pixels  # noqa: E402
from helio_jax.trace.settings import TraceSettings  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.calibrate_rotated import calibrate_rotated  # noqa: E402
from helio_jax.workflows.measure import reconstructed_area  # noqa: E402
from helio_jax.workflows.scene_file import load_instrument  # noqa: E402

FIELD_UM = 2000.0
TOP_UM, ANGLE_DEG, TILT_DEG, TURN_DEG = (438.0, 250.0), 125.26, 6.0, 65.0
SEM_UM, SEM_STD_UM = (438.0, 250.0), 9.0
GAINS = (6.4e-10, 1.3e-10, 1.3e-10, 4.5e-10, 5.1e-10)
"""Readings of level ground in the five measured scans, as their self-calibration finds them."""
SHARE, NOISE = 0.75, 0.02
"""Background and noise of a pixel, both as a share of level ground's reading."""
DRIFTS = ((-0.09, 0.05, -0.01), (0.01, 0.09, 0.01), (0.0, 0.02, 0.02), (-0.03, 0.02, 0.02), (-0.05, 0.02, 0.0))
"""Drift of the background, Legendre polynomials in scan time over level ground's reading, as in the measured scans."""
STAGES = ("full", "motions", "calibration", "multiple")
"""What is given as it truly is: nothing; motions; also gains, background, polar angle; also multiple scattering."""


SMOOTH = {"hills": bumps, "pyramids": pyramids, "rough": rough}
"""Samples of the alignment's benchmark, scored by their slopes."""


class Sample(NamedTuple):
    """A sample and, for a crystal, the unit normals of its top and sides [face, 3]."""

    surface: Surface
    normals: np.ndarray | None


def crystal(height_um: float) -> Sample:
    """Return a truncated crystal; its top's centre is `height_um` above the ground."""
    tilt, lean, turn = math.radians(TILT_DEG), math.radians(180.0 - ANGLE_DEG), math.radians(TURN_DEG)
    # frame of the top: e1 along its long side, e2, e3 outward
    c, s = math.cos(turn), math.sin(turn)
    spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    lay = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    normals, reaches = [np.array([0.0, 0.0, 1.0])], [0.0]
    for k in range(4):
        a = 0.5 * math.pi * k
        normals.append(np.array([math.sin(lean) * math.cos(a), math.sin(lean) * math.sin(a), math.cos(lean)]))
        reaches.append(0.5 * TOP_UM[k % 2] * math.sin(lean))
    faces = np.array([spin @ lay @ n for n in normals])

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        planes = [
            height_um + (r - n[0] * x - n[1] * y) / n[2] for n, r in zip(faces, reaches, strict=True)
        ]  # n . (point - centre of the top) = r
        return np.maximum(np.minimum.reduce(planes), 0.0)

    return Sample(height, faces)


def make_sample(name: str) -> Sample:
    """Return a sample by its name."""
    if name in SMOOTH:
        return Sample(SMOOTH[name](np.random.default_rng(3)), None)
    return crystal(1100.0 if name == "tall" else 600.0)


class Recorded(NamedTuple):
    """Scans, and what only a simulation knows: motions, their multiple scattering in units of the reading's signal."""

    scans: MicrographSet
    motions: tuple[Rigid, ...]
    multiple: MicrographSet


def record(sample: Sample, n: int, rays: int, seed: int, drifts: tuple = DRIFTS, law: Law = CosineLaw()) -> Recorded:
    """Trace five turned scans and read them as the measured ones were read."""
    instrument, rng = load_instrument(INSTRUMENT), np.random.default_rng(seed)
    step = FIELD_UM / n
    axis = (np.arange(n) - (n - 1) / 2) * step
    fine = 0.5 * step
    grid = np.arange(-1.2 * FIELD_UM, 1.2 * FIELD_UM, fine) + 0.37 * fine
    mesh_x, mesh_y = np.meshgrid(grid, grid)
    pixel_x, pixel_y = (a.ravel() for a in np.meshgrid(axis, axis))
    flat = float(substrate_signal(Optics.of(instrument))[0])
    scans, multiples, motions = [], [], []
    time = np.linspace(-1.0, 1.0, n)[:, None]
    for k, (gain, drift) in enumerate(zip(GAINS, drifts, strict=True)):
        turn = -k * 2.0 * math.pi / len(GAINS)
        shift = rng.uniform(-3.0, 3.0, 2) * step if k else np.zeros(2)
        motion = Rigid(turn + math.radians(rng.uniform(-1.0, 1.0) if k else 0.0), (float(shift[0]), float(shift[1])))
        places = motion.inverse().apply(np.stack([mesh_x, mesh_y], -1))
        body = surface_body(mesh_x, mesh_y, sample.surface(places[..., 0], places[..., 1]), 8000.0)
        settings = TraceSettings(rays=rays, branches=2, seed=900 + k)
        experiment = make_experiment(body, instrument, settings, {COSINE: law.terms()})
        traced = trace_pixels(experiment, pixel_x, pixel_y)
        signal, several = (
            a.reshape(n, n) / flat for a in (traced.total_mean[0], traced.mean[1:, 0].sum(0))
        )  # level ground: 1
        level = SHARE + np.polynomial.legendre.legval(time, (0.0, *drift))
        reading = gain * ((1.0 - SHARE) * signal + level + NOISE * rng.normal(size=(n, n)))
        about = {"sample_rotation": turn, "name": f"turned{k}"}
        spread = np.full((1, n, n), (gain * NOISE) ** 2)
        scans.append(MicrographStack(reading[None], axis, axis, instrument, spread, noise="measured", **about))
        multiples.append(MicrographStack(several[None] * flat, axis, axis, instrument, spread, **about))
        motions.append(motion)
    return Recorded(MicrographSet(tuple(scans)), tuple(motions), MicrographSet(tuple(multiples)))


def calibrated(known: Recorded, stage: str, method: str) -> MicrographStack:
    """Return the aligned stack in units of the beam; what the stage names is given, the rest is found."""
    motions = find_motions(known.scans).motions if stage == "full" else known.motions
    stack = resample(known.scans, motions, "reference")
    if stage in ("full", "motions"):
        return calibrate_rotated(stack, keeps_multiple=method == "refine")
    polar = math.degrees(math.atan2(3120.0, 3000.0))
    found = SelfCalibration(np.array(GAINS), np.full(5, SHARE), np.array(DRIFTS), polar, 0.0, 1.0, 0.0, 0.0)
    instrument = effective_instrument(stack.instrument, found.polar_deg)
    done = apply_calibration(stack, found, substrate_signal(Optics.of(instrument)), instrument)
    if stage == "multiple":
        done = done.replace(counts=done.counts - resample(known.multiple, motions, "reference").counts)
    return done


def reconstructed(stack: MicrographStack, method: str, refine: dict) -> Reconstruction:
    """Reconstruct with the settings that every sample of this benchmark, the measured one too, gets."""
    return pipeline.reconstruct(stack, method, border="free", refine=refine)


def standing_highest(facets: tuple[Facet, ...], labels: np.ndarray, height: np.ndarray) -> Facet | None:
    """Return the facet, of those that the field does not cut, whose middle stands highest."""
    inner = [f for f in facets if not f.is_cut]
    return max(inner, key=lambda f: float(np.median(height[labels == f.number])), default=None)


def facets_of(rec: Reconstruction, min_pixels: int) -> dict:
    """Return top face, its angles to its neighbours and the share that is not reconstructed."""
    out: dict = {"lost": 1.0 - reconstructed_area(rec)["share"], "has_std": rec.height_std is not None}
    try:
        found = find_facets(rec, FacetSettings(min_pixels=min_pixels))
    except GuardError as error:
        return out | {"problem": str(error)}
    top = standing_highest(found.facets, found.labels, rec.height)
    if top is None:
        return out | {"problem": "the field cuts every facet"}
    edges = [e for e in found.edges if top.number in e.facets]
    out |= {"angles": [e.angle_deg for e in edges], "angle_stds": [e.angle_std_deg for e in edges]}
    sizes = ("tilt_deg", "long_um", "long_std_um", "short_um", "short_std_um", "area_um2", "area_std_um2")
    return out | {name: getattr(top, name) for name in sizes}


def true_normals(sample: Sample, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the unit normals of the surface at points [y, x, 3], by differences over 0.2 um."""
    h = 0.1
    slopes = [
        (sample.surface(x + a * h, y + b * h) - sample.surface(x - a * h, y - b * h)) / (2 * h)
        for a, b in ((1, 0), (0, 1))
    ]
    return np.moveaxis(unit_normal(slopes[0], slopes[1], (0.0, 0.0)), 0, -1)


def against_truth(rec: Reconstruction, sample: Sample) -> dict:
    """Return how the heights' slopes differ from the true ones: turn of normals, tilts of faces, heights."""
    x, y = np.meshgrid(rec.raster_x, rec.raster_y)
    gy, gx = np.gradient(rec.height, pitch(rec.raster_y), pitch(rec.raster_x))
    normal = np.moveaxis(unit_normal(gx, gy, (0.0, 0.0)), 0, -1)
    true, use = true_normals(sample, x, y), rec.is_valid
    turn = np.degrees(np.arccos(np.clip(np.sum(true * normal, -1), -1.0, 1.0)))
    away = (rec.height - sample.surface(x, y))[use]
    out: dict = {"turn_deg": float(np.median(turn[use])), "rms_um": float(np.std(away))}
    if sample.normals is not None:
        tilts = []
        for face in sample.normals:
            region = use & (true @ face > 0.9999)
            plane = np.median(np.stack([gx, gy], -1)[region], 0) if region.sum() > 5 else np.full(2, np.nan)
            tilts.append(math.degrees(math.atan(math.hypot(*plane))))
        out |= {"face_tilts": tilts, "true_tilts": np.degrees(np.arccos(sample.normals[:, 2])).tolist()}
    return out


def summary(found: dict) -> tuple[str, bool]:
    """Return a line about the facets and whether rows 5 to 7 are reached."""
    if "angles" not in found or not found["angles"]:
        return f"{found.get('problem', 'no edges')}; lost {found['lost']:.0%}", False
    angles = np.array(found["angles"])
    sides = (found["long_um"], found["long_std_um"]), (found["short_um"], found["short_std_um"])
    within = [abs(v - t) <= 2 * math.hypot(std, SEM_STD_UM) for (v, std), t in zip(sides, SEM_UM, strict=True)]
    good = abs(angles.mean() - ANGLE_DEG) <= 2 and np.all(np.abs(angles - ANGLE_DEG) <= 5) and found["lost"] <= 0.12
    text = f"{angles.mean():.1f} ({' '.join(f'{a:.0f}' for a in angles)}) deg, {found['long_um']:.0f} x "
    text += f"{found['short_um']:.0f} um, {found['area_um2'] / 1e6:.3f} mm2, lost {found['lost']:.0%}"
    return text, bool(good and all(within))


def measured(shared: Path, method: str) -> MicrographStack:
    """Return the measured crystal, aligned by the points picked by hand, calibrated by itself."""
    instrument = load_instrument(INSTRUMENT)
    scans = MicrographSet(tuple(import_micrographs(shared / "data" / f"{name}.mat", instrument) for name in SCANS))
    found = find_motions(scans, read_points(POINTS))
    return calibrate_rotated(resample(scans, found.motions, "reference"), keeps_multiple=method == "refine")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--sample", default="crystal", choices=("crystal", "tall", *SMOOTH, "measured"))
    parser.add_argument("--size", type=int, default=101)
    parser.add_argument("--rays", type=int, default=128)
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--stages", default=",".join(STAGES))
    parser.add_argument("--methods", default="linear,nearfield")
    parser.add_argument("--refine", type=json.loads, default={}, help="JSON: settings of [reconstruct.refine]")
    parser.add_argument("--law", type=TypeAdapter(Law).validate_json, help="JSON: true law; default: cosine")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    if args.tiny:
        args.size, args.rays, args.stages, args.methods = 41, 8, "motions,multiple", "linear"
    path = args.output / ("crystal_tiny.json" if args.tiny else "crystal.json")
    done = json.loads(path.read_text())["rows"] if path.exists() else []
    asked = {"size": args.size, "rays": args.rays, "seed": args.seed, "refine": args.refine}
    asked["law"] = args.law and args.law.model_dump(mode="json", exclude_unset=True)
    is_real = args.sample == "measured"
    sample = None if is_real else make_sample(args.sample)
    known: Recorded | None = None
    stacks: dict[tuple[str, bool], MicrographStack] = {}
    for stage in ("measured",) if is_real else args.stages.split(","):
        for method in args.methods.split(","):
            key = {"sample": args.sample, "stage": stage, "method": method} | asked
            if any(all(r.get(k) == v for k, v in key.items()) for r in done):
                continue
            which = stage, method == "refine"
            if which in stacks:
                stack = stacks[which]
            elif sample is None:
                stack = measured(args.shared, method)
            else:
                known = known or record(sample, args.size, args.rays, args.seed, law=args.law or CosineLaw())
                stack = calibrated(known, stage, method)
            stacks[which] = stack
            rec = reconstructed(stack, method, args.refine)
            found = facets_of(rec, max(15, round(60 * (args.size / 101) ** 2)))
            found["calibration"] = stack.provenance.get("self_calibrate")
            text, is_reached = summary(found)
            if sample is not None:
                found |= against_truth(rec, sample)
                tilts = " ".join(f"{t:.0f}" for t in found.get("face_tilts", ()))
                text += f"; normals {found['turn_deg']:.1f} deg, rms {found['rms_um']:.0f} um; tilts {tilts}"
            if args.sample in SMOOTH:
                text, is_reached = f"normals {found['turn_deg']:.1f} deg, rms {found['rms_um']:.0f} um", None
            what = f"{args.sample}: {method}, known: {stage}" + (f", {args.law.kind}" if args.law else "")
            done.append(rows.row("5-7", what, text, "125.26 +- 2 (5), 438 x 250, <= 12 %", is_reached, **key, **found))
            rows.write(path, done, seed=args.seed)


if __name__ == "__main__":
    main()
