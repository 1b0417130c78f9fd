"""Heights and error bars on random samples in families (benchmarks/shapes.py): docs/results.md, Any shape.

python benchmarks/families.py [--families mesa,slot,...] [--members 12] [--seed 1] [--methods refine,nearfield,linear]
    [--size 61 101] [--output benchmarks/out] [--keep] [--tiny]

Every member is traced, given counting noise, reconstructed by each method and scored; what is finished is written at
once and not done again. `--keep` writes scene, micrographs and height maps, too. Silently wrong is a pixel that is
valid and wrong by more than 2 % of the relief and 3 stated standard deviations.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import with_origin  # noqa: E402
from benchmarks.shapes import FAMILIES, Member, members  # noqa: E402
from helio_jax.arrays import border_mask  # noqa: E402
from helio_jax.errors import GuardError  # noqa: E402
from helio_jax.formats.hdf5 import write  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.reconstruction import Reconstruction  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402
from helio_jax.workflows.truth import true_surface  # noqa: E402

Case = dict[str, Any]
WRONG_SHARE, WRONG_STD = 0.02, 3.0
"""Errors beyond this share of the relief and this many standard deviations are silently wrong where valid."""
MARGIN = 2
"""Pixels beside a wall that do not count for the height of a level."""
TOLD = "contradict"
"""Word in the status of a reconstruction that its own data contradict."""


# --- wrong worlds ---------------------------------------------------------------------------------------------------


def true_settings(member: Member, rng: np.random.Generator) -> dict[str, Any]:
    """Return the settings of the scene as it really is, where the file of the scene is wrong."""
    n = len(member.tables["detector"])
    if member.world == "instrument turned":
        turn = float(rng.choice((-1, 1)) * rng.uniform(3, 10))
        azimuths = [d["azimuth_deg"] + turn for d in member.tables["detector"]]
        return {f"detector.{k}.azimuth_deg": azimuths[k] for k in range(n)}
    if member.world == "instrument nearer":
        return _with_polar(member, dict.fromkeys(range(n), 4.0))
    if member.world == "angles and distance":
        turns = dict.fromkeys(range(n), float(rng.choice((-3.0, 3.0))))
        distance = member.tables["plate"]["sample_distance_um"] * (1.0 + float(rng.choice((-0.05, 0.05))))
        return _with_polar(member, turns) | {"plate.sample_distance_um": distance}
    if member.world == "aperture off":
        return _with_polar(member, {int(rng.integers(n)): float(rng.choice((-3.0, 3.0)))})
    if member.world == "wide spot":
        return {"beam.pinhole_radius_um": 0.9 * member.tables["scan"]["pixel_size_um"]}
    return {}


def _with_polar(member: Member, turns: Mapping[int, float]) -> dict[str, float]:
    """Return settings of polar angles that are off by some degrees, by number of the detector."""
    return {f"detector.{k}.polar_deg": member.tables["detector"][k]["polar_deg"] + turn for k, turn in turns.items()}


def disturbed(world: str, stack: MicrographStack, rng: np.random.Generator) -> MicrographStack:
    """Return micrographs as a wrong world would record them."""
    counts = stack.counts.copy()
    if world == "channels swapped":
        counts = counts[[1, 0, *range(2, len(counts))]]
    elif world == "background":
        counts = counts + rng.poisson(0.3 * np.median(counts), counts.shape)
    elif world == "dead detector":
        counts[1] = rng.poisson(0.1 * np.median(counts[1]), counts[1].shape)
    elif world == "mirrored raster":
        counts = counts[:, :, ::-1]
    else:
        return stack
    return stack.replace(counts=counts, variance=np.maximum(counts, 1.0))


def simulated(member: Member, folder: Path) -> tuple[SceneFile, MicrographStack]:
    """Trace a member and draw its counts; the scene is what reconstruction is told."""
    path = member.write(folder)
    told, rng = load_scene(path), np.random.default_rng(member.tables["noise"]["seed"])
    scene = load_scene(path, true_settings(member, rng))
    stack = pipeline.record(scene, pipeline.simulate(scene))
    assert isinstance(stack, MicrographStack)
    instrument = scene.instrument if member.world == "wide spot" else told.instrument
    return told, disturbed(member.world, stack.replace(instrument=instrument, materials={}), rng)


# --- scores ---------------------------------------------------------------------------------------------------------


def plane_of(error: np.ndarray, rec: Reconstruction, use: np.ndarray) -> np.ndarray:
    """Fit c + a x + b y to errors where `use` holds; return c at the centre [um], a and b."""
    gx, gy = np.meshgrid(rec.raster_x, rec.raster_y)
    design = np.stack([np.ones(use.sum()), gx[use], gy[use]], 1)
    return np.linalg.lstsq(design, error[use], rcond=None)[0]


def without_plane(field: np.ndarray, rec: Reconstruction, use: np.ndarray) -> np.ndarray:
    """Return a field [y, x] less the plane fitted to it where `use` holds."""
    plane = plane_of(field, rec, use)
    gx, gy = np.meshgrid(rec.raster_x, rec.raster_y)
    return field - plane[0] - plane[1] * gx - plane[2] * gy


def shape_std(rec: Reconstruction, use: np.ndarray) -> np.ndarray | None:
    """Return the stated deviation of the shape [y, x]: of samples levelled as the error is, by a plane; um."""
    if rec.height_samples is None:
        return rec.height_std
    return np.sqrt(np.mean([without_plane(s, rec, use) ** 2 for s in rec.height_samples], axis=0))


def score(member: Member, truth: np.ndarray, rec: Reconstruction) -> Case:
    """Return the numbers of one reconstruction; errors over the relief of the true heights."""
    std = rec.height_std
    error, valid = rec.height - truth, rec.is_valid
    relief, n = float(np.ptp(truth)), truth.size
    out: Case = {"relief_um": relief, "invalid": 1.0 - float(valid.mean()), "status": rec.status}
    out["told"] = TOLD in rec.status
    if member.border == "flat":
        level = float(np.median(error[border_mask(truth.shape, 0.06)]))  # type: ignore[arg-type]
        error = error - level
    else:
        use = valid if valid.sum() > 9 else np.ones_like(valid)
        plane = plane_of(error, rec, use)
        out["tilt_deg"] = float(np.degrees(np.hypot(*plane[1:])))
        out["level_error"] = float(np.median(error[use])) / relief
        error = without_plane(error, rec, use)
        std = shape_std(rec, use)
    relative = error / relief
    out["rms_valid"] = float(np.sqrt(np.mean(relative[valid] ** 2))) if valid.any() else None
    out["rms_all"] = float(np.sqrt(np.mean(relative**2)))
    centered = truth - np.median(truth)
    if valid.sum() > 9 and centered[valid].any():
        slope = np.sum((centered[valid] + error[valid]) * centered[valid]) / np.sum(centered[valid] ** 2)
        out["recovered"] = float(slope)
    if std is not None:
        std = np.maximum(std, 1e-12)
        if valid.any():
            rms = max(float(np.sqrt(np.mean(error[valid] ** 2))), 1e-12)
            out["std_over_rms"] = float(np.median(std[valid])) / rms
            out["rms_std_over_rms"] = float(np.sqrt(np.mean(std[valid] ** 2))) / rms
        pull = np.abs(error / std)
        silent = valid & (np.abs(relative) > WRONG_SHARE) & (pull > WRONG_STD)
        out["silent"] = float(silent.sum()) / n
        for key, where in (("all", valid), ("hollow", valid & (truth < np.median(truth) - 0.05 * relief))):
            if where.any():
                out[f"coverage_{key}"] = [float(np.mean(pull[where] <= k)) for k in (1.0, 2.0)]
    out["steps"] = steps(member, truth, rec)
    return out


def inner(mask: np.ndarray) -> np.ndarray:
    """Return a mask without its outer `MARGIN` pixels, or as many as leave something."""
    for margin in range(MARGIN, 0, -1):
        if (found := binary_erosion(mask, np.ones((3, 3)), margin)).any():
            return found
    return mask


def apex_pixels(member: Member, truth: np.ndarray, rec: Reconstruction) -> Iterator[np.ndarray]:
    """Yield the pixel that sees each apex of a member, or the highest point, and its neighbours, as masks [y, x]."""
    beams = [np.array(place) + height * np.array(rec.instrument.beam_shift) for *place, height in member.apexes]
    axes = rec.raster_y, rec.raster_x
    pixels = [tuple(int(np.argmin(np.abs(axis - b))) for axis, b in zip(axes, at[::-1], strict=True)) for at in beams]
    for y, x in pixels or [np.unravel_index(np.argmax(np.abs(truth)), truth.shape)]:
        where = np.zeros(truth.shape, bool)
        where[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2] = True
        yield where


def steps(member: Member, truth: np.ndarray, rec: Reconstruction) -> list[Case]:
    """Return the heights of a member's levels or apexes above the substrate z = 0: relative errors."""
    near = 1e-3 * float(np.ptp(truth)) + 0.1
    base = inner(np.abs(truth) < near)
    if member.border == "free" and not member.levels:
        return []
    tops = [(level, inner(np.abs(truth - level) < near)) for level in member.levels if level]
    if not tops:
        tops = [(float(np.median(truth[where])), where) for where in apex_pixels(member, truth, rec)]
    out = []
    for level, where in tops:
        if not where.any() or not base.any():
            continue

        def height(z: np.ndarray, where=where) -> float:
            return float(np.median(z[where]) - np.median(z[base]))

        found, std = rec.spread(height)
        out.append(
            {
                "level_um": level,
                "error": found / level - 1.0,
                "std": std / abs(level),
                "valid": float(rec.is_valid[where].mean()),
            }
        )
    return out


# --- runs and tables ------------------------------------------------------------------------------------------------


def run_member(member: Member, methods: Sequence[str], folder: Path, keeps: bool, done: Callable[[str, str], bool]):
    """Yield the cases of a member that are not done yet."""
    left = [m for m in methods if not done(member.name, m)]
    if not left:
        return
    scene, stack = simulated(member, folder)
    truth = true_surface(scene, stack.x, stack.y).height
    if keeps:
        write(stack, folder / f"{member.name}.h5")
        np.savez(folder / f"{member.name}-truth.npz", height=truth)
    for method in left:
        started = time.perf_counter()
        case: Case = {"row": member.name.split("-")[0], "case": member.name, "method": method, **member.about}
        try:
            rec = pipeline.reconstruct(stack, method, settings=scene.reconstruct)
            seconds = time.perf_counter() - started
            yield case | score(member, truth, rec) | {"seconds": seconds}
            if keeps:
                write(rec, folder / f"{member.name}-{method}.h5")
        except GuardError as e:
            yield case | {"refused": str(e), "seconds": time.perf_counter() - started}


def line(case: Case) -> str:
    """Return one line on a case."""
    if "refused" in case:
        return f"{case['case']:<16}{case['method']:<10}{case['kind']:<22} refused: {case['refused'][:70]}"
    shown = " ".join(
        f"{s['error']:+.1%}({s['std']:.1%}{'' if s['valid'] > 0.5 else ' flagged'})" for s in case["steps"]
    )
    tilt = f" tilt {case['tilt_deg']:.2f}" if "tilt_deg" in case else ""
    coverage = "/".join(f"{c:.0%}" for c in case.get("coverage_all", []))
    rms = np.nan if case["rms_valid"] is None else case["rms_valid"]
    recovered = case.get("recovered", np.nan)
    return (
        f"{case['case']:<16}{case['method']:<10}{case['kind']:<22} rms {rms:6.2%} rec {recovered:6.1%} "
        f"silent {case.get('silent', np.nan):5.1%} invalid {case['invalid']:4.0%} cover {coverage:<9} "
        f"{'TOLD ' if case['told'] else ''}{case['seconds']:4.0f} s{tilt} steps {shown}"
    )


def quantiles(values: list[float]) -> str:
    return f"{np.median(values):.2%}, {np.max(values):.2%}" if values else "-"


def summary(cases: list[Case]) -> list[str]:
    """Return a line for each family and method: medians and worst."""
    out = []
    for family in FAMILIES:
        for method in dict.fromkeys(c["method"] for c in cases):
            part = [c for c in cases if c["row"] == family and c["method"] == method and "refused" not in c]
            if not part:
                continue
            errors = [abs(s["error"]) for c in part for s in c["steps"] if s["valid"] > 0.5 and not c["told"]]
            flagged = sum(s["valid"] <= 0.5 or c["told"] for c in part for s in c["steps"])
            silent = [c["silent"] for c in part if "silent" in c and not c["told"]]
            covers = {
                where: "/".join(f"{np.mean([c[where][k] for c in part if where in c] or [np.nan]):.0%}" for k in (0, 1))
                for where in ("coverage_all", "coverage_hollow")
            }
            width = [c["std_over_rms"] for c in part if "std_over_rms" in c]
            rms = [c["rms_valid"] for c in part if c["rms_valid"] is not None]
            out.append(
                f"{family:<10}{method:<10}{len(part):>3} members; step error median, worst unflagged "
                f"{quantiles(errors)} ({flagged} flagged); RMS {quantiles(rms)}; silently wrong "
                f"{np.mean(silent) if silent else np.nan:.2%}; invalid {np.mean([c['invalid'] for c in part]):.0%}; "
                f"cover {covers['coverage_all']}, hollows {covers['coverage_hollow']}, stated over actual error "
                f"{np.median(width) if width else np.nan:.2f}; told {sum(c['told'] for c in part)}; "
                f"worst time {max(c['seconds'] for c in part):.0f} s"
            )
            if family == "smooth" and method == "refine":
                other = {c["case"]: c for c in cases if c["method"] == "nearfield" and c.get("rms_valid")}
                ratio = [c["rms_valid"] / other[c["case"]]["rms_valid"] for c in part if c["case"] in other]
                if ratio:
                    out.append(f"          RMS over nearfield's: median {np.median(ratio):.2f}, worst {max(ratio):.2f}")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--members", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="number of the first member")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--methods", default="refine,nearfield,linear")
    parser.add_argument("--size", type=int, nargs=2, default=(61, 101))
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--tiny", action="store_true")
    given = parser.parse_args()
    if given.tiny:
        given.families, given.members, given.methods, given.size = "mesa,wrong", 1, "nearfield", (24, 24)
    record = given.output / "families.json"
    rows: list[Case] = json.loads(record.read_text())["rows"] if record.exists() else []
    given.output.mkdir(parents=True, exist_ok=True)
    known = {(c["case"], c["method"]) for c in rows}
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.output / "families" if given.keep else Path(scratch)
        for family in given.families.split(","):
            for member in members(family, given.seed, range(given.first, given.first + given.members), given.size):
                for case in run_member(
                    member, given.methods.split(","), folder, given.keep, lambda n, m: (n, m) in known
                ):
                    rows.append(case)
                    print(line(case), flush=True)
                    part = record.with_suffix(".part")
                    part.write_text(json.dumps(with_origin(rows, given.seed), indent=1) + "\n")
                    part.replace(record)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
