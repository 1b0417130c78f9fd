"""Directions of the apertures by the outlines of ball and masks alone, on twins made by the tracer.

python benchmarks/mask_directions.py [--instruments N] [--first SEED] [--pixels N] [--tiny]

The twins are those of benchmarks/known_shape.py: a ball of known radius whose burial is not known, scanned by an
instrument drawn at random, with scattering law, pedestal, drift, offsets of scan lines and noise (SNR 25). Scored are
polar angle and azimuth of every aperture as the spot sees them, where the masks determine them, and those of all
apertures. How much the masks can tell depends on how far the ball stands out: at its foot a cap of height H and radius
R hides nothing that is steeper than its own slope: an aperture nearer to the normal than asin(1 - H / R) has no mask.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import known_shape, rows  # noqa: E402
from helio_jax.calibration.mask_model import directions_of  # noqa: E402
from helio_jax.calibration.mask_report import direction_rows  # noqa: E402
from helio_jax.forward.optics import Optics  # noqa: E402
from helio_jax.workflows.calibrate_known import calibrate_masks  # noqa: E402


def evaluate(seed: int, size: int, twin_rays: int, **changes: Any) -> dict[str, Any]:
    """Find the directions on the twin of a seed: errors and standard deviations [detector, 2], degrees."""
    stack, _ = known_shape.scan(seed, size, twin_rays)
    true = np.asarray(directions_of(Optics.of(known_shape.draw(seed, stack.instrument)[0])))
    begin = time.time()
    fit = calibrate_masks([stack], [known_shape.KNOWN], **changes)
    seconds, found = time.time() - begin, direction_rows(fit)
    error = (np.array([r["value"] for r in found]) - np.degrees(true).ravel() + 180.0) % 360.0 - 180.0
    about = {name: [r[name] for r in found] for name in ("std", "prior", "is_determined")}
    return about | {
        "seed": seed, "pixels": size, "error": error.tolist(), "true": np.degrees(true).ravel().tolist(), "s": seconds,
        "rounds": fit.rounds, "is_converged": fit.is_converged, "inflation": fit.inflation,
    }  # fmt: skip


def collect(found: list[dict[str, Any]]) -> list[rows.Row]:
    """Tabulate errors and pulls of polar angles and azimuths."""
    out = []
    error, std, known = (np.array([f[key] for f in found]) for key in ("error", "std", "is_determined"))
    for i, (name, limit) in enumerate((("polar angle", 1.0), ("azimuth", 2.0))):
        e, s, k = error[:, i::2].ravel(), std[:, i::2].ravel(), known[:, i::2].ravel()
        if not k.any():
            out.append(rows.row("4", f"{name}, determined", "none", f"{limit:g} deg", False))
            continue
        size, pull = float(np.sqrt(np.mean(e[k] ** 2))), float(np.sqrt(np.mean((e[k] / s[k]) ** 2)))
        text = f"rms {size:.2f}, largest {np.abs(e[k]).max():.2f} deg, {k.sum()} of {k.size}"
        out.append(rows.row("4", f"{name}, determined", text, f"{limit:g} deg", size <= limit))
        text = f"rms {pull:.2f}, largest {np.abs(e[k] / s[k]).max():.1f}"
        out.append(rows.row("4", "  its pulls", text, "0.8 to 1.25", 0.8 <= pull <= 1.25))
        sharp = s <= limit
        if sharp.any():
            text = f"rms {np.sqrt(np.mean(e[sharp] ** 2)):.2f} deg, {sharp.sum()} of {k.size}"
            out.append(rows.row("4", f"  stated s.d. at most {limit:g} deg", text, f"{limit:g} deg", None))
    lost = [f["seed"] for f in found if not f["is_converged"]]
    out.append(rows.row("4", "fits that have not converged", f"{len(lost)} of {len(found)} {lost}", "0", not lost))
    seconds = float(np.median([f["s"] for f in found]))
    out.append(rows.row("4", "time of a fit, compilation included", f"median {seconds:.0f} s", "-", None))
    return out


def main() -> None:
    """Make twins, find the directions, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instruments", type=int, default=12)
    parser.add_argument("--first", type=int, default=900, help="seed of the first twin")
    parser.add_argument("--pixels", type=int, default=121)
    parser.add_argument("--rays", type=int, default=256, help="of the twins, per pixel")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true", help="one twin, few rays and pixels")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    name = "mask_directions_tiny" if args.tiny else "mask_directions"
    n, size, rays = (1, 21, 64) if args.tiny else (args.instruments, args.pixels, args.rays)
    changes = {"max_rounds": 1, "drift_degree": 3} if args.tiny else {}
    found = []
    for seed in range(args.first, args.first + n):
        found.append(evaluate(seed, size, rays, **changes))
        print(f"twin {seed}: errors {np.round(found[-1]['error'], 2)} deg, s.d. {np.round(found[-1]['std'], 2)}")
    (args.output / f"{name}_twins.json").write_text(json.dumps(found))
    rows.write(args.output / f"{name}.json", collect(found), args.first)


if __name__ == "__main__":
    main()
