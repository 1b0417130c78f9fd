"""Cracks: slits of our own tracer in all directions, false alarms in noise, and the measured salt crystal.

python benchmarks/cracks.py [--salt HEIGHT.h5 CALIBRATED.h5]     (those of scenes/measured_salt.toml)

Slits of 500 um length in a flat, under the B-SHeM with its beam 30 deg oblique, on pixels of 20 um with the noise of
the measured salt: what kind of line they are taken for, their lengths and directions, missing signal and the bound of
the depth. False alarms: lines in noise with drift, scan lines and a ripple, against those that are allowed.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.formats.hdf5 import read_height, read_stack  # noqa: E402
from helio_jax.measure.cracks import Crack, find_cracks  # noqa: E402
from helio_jax.measure.line_paths import trace_lines  # noqa: E402
from helio_jax.measure.lines import ORDER, LineSettings, contrast_of, find_lines  # noqa: E402
from helio_jax.measure.regions import inside_polygon, parse_region  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.reconstruction import Reconstruction  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402

SALT = ROOT / "scenes" / "measured_salt.toml"
NOISE = (0.025, 0.034, 0.053)
"""Of one pixel of the measured salt, over the flat's signal; by detector."""
LENGTH, PIXELS, STEP_DEG = 500.0, 61, 15
TOP = "-130,900 -960,0 -100,-880 800,20"
"""Top of the measured crystal."""
SEED = 1


def _with_noise(stack: MicrographStack, seed: int) -> MicrographStack:
    """Return a stack with the noise of the measured salt, as a calibrated one."""
    std = np.array(NOISE)[:, None, None] * np.median(stack.counts, axis=(1, 2), keepdims=True)
    counts = stack.counts + std * np.random.default_rng(seed).standard_normal(stack.shape)
    return stack.replace(counts=counts, variance=np.broadcast_to(std**2, stack.shape), n_rays=1.0, by_order=None)


def _flat(stack: MicrographStack) -> Reconstruction:
    """Return level heights: slits are measured in the micrographs."""
    shape, up = stack.shape[1:], np.zeros((*stack.shape[1:], 3)) + [0.0, 0.0, 1.0]
    known = np.ones(shape, bool)
    return Reconstruction(
        np.zeros(shape), stack.x, stack.y, stack.instrument, "linear", up, np.ones(shape), known, np.zeros(shape, int)
    )


def _record(crack: Crack) -> dict[str, Any]:
    """Return a crack's record without the points along it."""
    return {key: value for key, value in crack.as_dict().items() if key != "points"}


def slit_rows(sizes: list[tuple[float, float]], azimuths: list[int]) -> list[Row]:
    """Trace slits (width, depth) in all directions; one row for each, and one for all."""
    rows, pulls, kinds = [], [], []
    for width, depth in sizes:
        for azimuth in azimuths:
            sample = {"kind": "trench", "width_um": width, "length_um": LENGTH, "depth_um": depth, "size_um": 8000.0}
            sample |= {"azimuth_deg": azimuth, "center_um": [7.0, 3.0]}
            given = {"sample": sample, "scan.nx": PIXELS, "scan.ny": PIXELS, "trace.rays": 64}
            stack = _with_noise(pipeline.simulate(load_scene(SALT, given)).only(), SEED)
            found = find_cracks(_flat(stack), stack, np.ones(stack.shape[1:], bool)).cracks
            what = f"slit {width:.0f} x {depth:.0f} um at {azimuth} deg"
            if not found:
                rows.append(row("slit", what, "not found", "found", False))
                continue
            c = found[0]
            turned = (c.direction_deg - azimuth + 90.0) % 180.0 - 90.0
            lacks = " ".join(f"{v:+.1f}" for v in c.missing_um.values())
            value = f"{c.kind} {c.length_um:.0f} +- {c.length_std_um:.0f}, {turned:+.0f} deg, lacks {lacks}"
            pull = (c.length_um - LENGTH) / c.length_std_um
            rows.append(row("slit", what, value, f"{LENGTH:.0f} within 3 s.d.", abs(pull) < 3.0, record=_record(c)))
            pulls.append(pull)
            kinds.append(c.kind)
            assert c.depth_at_least_um < depth
    good = sum(abs(p) < 3.0 for p in pulls)
    counted = ", ".join(f"{kinds.count(k)} {k}" for k in sorted(set(kinds)))
    n = len(sizes) * len(azimuths)
    rows.append(row("slits", f"{n} slits", f"{len(pulls)} found ({counted}), {good} lengths", "all found", None))
    return rows


def noise_row(images: int) -> Row:
    """Count lines in noise with drift, scan lines and a ripple, with many false alarms allowed."""
    s = LineSettings(false_alarms=4.0, min_length_px=3.0)
    scene = load_scene(SALT, {"scan.nx": PIXELS, "scan.ny": PIXELS})
    axis = (np.arange(PIXELS) - 0.5 * (PIXELS - 1)) * 20.0
    x, y = np.meshgrid(axis, axis)
    n = 0
    for seed in range(images):
        rng = np.random.default_rng(seed)
        image = 1.0 + 0.05 * np.sin(y / 400.0) + 0.05 * x / 800.0 + 0.01 * np.sin(2 * np.pi * (x - y) / 1.414 / 114.0)
        image = image + 0.06 * rng.standard_normal((3, PIXELS, 1))
        stack = _with_noise(MicrographStack(image, axis, axis, scene.instrument), seed)
        contrast, everywhere = contrast_of(stack), np.ones(stack.shape[1:], bool)
        n += sum(len(trace_lines(find_lines(contrast, everywhere, kind, s), s)) for kind in ORDER)
    allowed = images * s.false_alarms
    return row("noise", f"{images} images of noise, drift, ripple", f"{n} lines", f"<= {allowed:.0f}", n <= allowed)


def salt_rows(height: Path, calibrated: Path) -> list[Row]:
    """List the cracks of the crystal's top."""
    rec, stack = read_height(height), read_stack(calibrated)
    inside = inside_polygon(parse_region(TOP), rec.raster_x, rec.raster_y)
    found = find_cracks(rec, stack, inside)
    density, std = (1e3 * v for v in found.density)
    rows = [row("8", "salt: cracks per area", f"{density:.2f} +- {std:.2f} mm/mm2", "picture", None)]
    for c in found.cracks:
        depth = "" if math.isnan(c.depth_um) else f", {c.depth_um:.1f} +- {c.depth_std_um:.1f} deep"
        value = f"{c.length_um:.0f} +- {c.length_std_um:.0f} um{depth}"
        rows.append(
            row("8", f"salt: {c.kind} at {c.direction_deg:+.0f} deg", value, "picture", None, record=_record(c))
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--salt", type=Path, nargs=2, metavar=("HEIGHT.h5", "CALIBRATED.h5"))
    parser.add_argument("--tiny", action="store_true", help="one slit, one image of noise")
    args = parser.parse_args()
    if args.tiny:
        rows = [*slit_rows([(40.0, 200.0)], [90]), noise_row(1)]
    else:
        rows = [*slit_rows([(20.0, 100.0), (40.0, 200.0)], list(range(0, 180, STEP_DEG))), noise_row(40)]
    rows += salt_rows(*args.salt) if args.salt else []
    write(args.output / ("cracks_tiny.json" if args.tiny else "cracks.json"), rows, seed=SEED)


if __name__ == "__main__":
    main()
