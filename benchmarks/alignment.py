"""How well rotated scans are aligned automatically: row 10 (30 traced cases) and row 4 (the alum crystal).

python benchmarks/alignment.py [--shared ../shared] [--output benchmarks/out] [--cases N] [--tiny]

Row 10: six views 60 degrees apart, the stage up to 2 degrees wrong, the field up to 6 pixels off in x and y, 200 counts
per pixel and Poisson noise. Every view is traced anew on the turned and moved sample itself (a formula, meshed at half
the pitch in the view's own frame), so nothing of the alignment's interpolation or of its sign conventions is in the
data. Masks, shadows of facets and multiple scattering are in. Row 4 needs the shared data.
"""

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.alignment.align import Alignment, find_motions  # noqa: E402
from helio_jax.alignment.control_points import rms  # noqa: E402
from helio_jax.alignment.rigid import Rigid, separation  # noqa: E402
from helio_jax.arrays import pitch  # noqa: E402
from helio_jax.formats.matlab import import_micrographs  # noqa: E402
from helio_jax.formats.points import read_points  # noqa: E402
from helio_jax.micrograph import MicrographSet, MicrographStack  # noqa: E402
from helio_jax.scene.surfaces import surface_body  # noqa: E402
from helio_jax.trace.run import make_experiment, trace_pixels  # noqa: E402
from helio_jax.trace.settings import TraceSettings  # noqa: E402
from helio_jax.workflows.scene_file import load_instrument  # noqa: E402

PITCH_UM = 20.0
COUNTS = 200.0
INSTRUMENT = ROOT / "scenes" / "instruments" / "ashem_normal.toml"
POINTS = ROOT / "benchmarks" / "alum_points.csv"
SCANS = ("scan003259", "scan003248", "scan003250", "scan003262", "scan003260")
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Heights [um] at points x, y [um]."""


def crystal(rng: np.random.Generator) -> Surface:
    """Return a crystal: the lowest of a top and seven leaning planes, on a flat."""
    azimuth = rng.uniform(0, 2 * np.pi) + np.arange(7) * 2 * np.pi / 7 + rng.uniform(-0.3, 0.3, 7)
    slope, reach = np.tan(np.radians(rng.uniform(30, 58, 7))), rng.uniform(250, 700, 7)
    top, tilt = rng.uniform(150, 450), rng.uniform(-0.1, 0.1, 2)

    def height(x, y):
        sides = [s * (r - x * np.cos(a) - y * np.sin(a)) for a, s, r in zip(azimuth, slope, reach, strict=True)]
        return np.maximum(np.minimum.reduce([top + tilt[0] * x + tilt[1] * y, *sides]), 0.0)

    return height


def spheres(rng: np.random.Generator) -> Surface:
    """Return six half-buried balls on a flat."""
    at, radius = rng.uniform(-900, 900, (6, 2)), rng.uniform(150, 450, 6)

    def height(x, y):
        caps = [
            np.sqrt(np.maximum(r * r - (x - a) ** 2 - (y - b) ** 2, 0)) for (a, b), r in zip(at, radius, strict=True)
        ]
        return np.maximum.reduce(caps)

    return height


def rough(rng: np.random.Generator) -> Surface:
    """Return a rough surface: 60 plane waves of 120 to 900 um, rms slope about 0.35."""
    wave = 2 * np.pi / rng.uniform(120, 900, 60)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    size = 0.35 * math.sqrt(2 / 60) / wave

    def height(x, y):
        waves = [
            s * np.sin(k * (x * np.cos(a) + y * np.sin(a)) + p)
            for s, k, a, p in zip(size, wave, angle, phase, strict=True)
        ]
        return np.sum(waves, axis=0)

    return height


def bumps(rng: np.random.Generator) -> Surface:
    """Return twelve Gaussian hills and dips."""
    at, width, size = rng.uniform(-1000, 1000, (12, 2)), rng.uniform(60, 200, 12), rng.uniform(-1, 1, 12)

    def height(x, y):
        hills = [
            h * w * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * w * w))
            for (a, b), w, h in zip(at, width, size, strict=True)
        ]
        return np.sum(hills, axis=0)

    return height


def pyramids(rng: np.random.Generator) -> Surface:
    """Return five truncated pyramids, each turned, on a flat."""
    at, turn = rng.uniform(-800, 800, (5, 2)), rng.uniform(0, np.pi, 5)
    half, slope, top = rng.uniform(150, 450, 5), rng.uniform(0.3, 1.2, 5), rng.uniform(60, 250, 5)

    def height(x, y):
        out = np.zeros(np.shape(x))
        for (a, b), t, r, s, h in zip(at, turn, half, slope, top, strict=True):
            u, v = (x - a) * np.cos(t) + (y - b) * np.sin(t), (y - b) * np.cos(t) - (x - a) * np.sin(t)
            out = np.maximum(out, np.minimum(s * (r - np.maximum(np.abs(u), np.abs(v))), h))
        return out

    return height


KINDS = (crystal, spheres, rough, bumps, pyramids)


def make_case(number: int, n: int = 101, n_views: int = 6, counts: float = COUNTS) -> tuple[MicrographSet, list[Rigid]]:
    """Trace one case.

    Returns:
        The scans with the stage's nominal rotations, and the true motions in the first scan's frame.
    """
    rng = np.random.default_rng([10, number])
    surface = KINDS[number % len(KINDS)](rng)
    instrument = load_instrument(INSTRUMENT)
    axis = (np.arange(n) - (n - 1) / 2) * PITCH_UM
    grid = (np.arange(2 * n + 41) - n - 20 + 0.37) * 0.5 * PITCH_UM
    mesh_x, mesh_y = np.meshgrid(grid, grid)
    pixel_x, pixel_y = (a.ravel() for a in np.meshgrid(axis, axis))
    stacks, motions = [], []
    for k in range(n_views):
        nominal = k * 2 * np.pi / n_views
        shift = rng.uniform(-6, 6, 2) * PITCH_UM
        motion = Rigid(nominal + math.radians(rng.uniform(-2, 2)), (float(shift[0]), float(shift[1])))
        on_sample = motion.inverse().apply(np.stack([mesh_x, mesh_y], -1))
        body = surface_body(mesh_x, mesh_y, surface(on_sample[..., 0], on_sample[..., 1]), 6000.0)
        experiment = make_experiment(body, instrument, TraceSettings(rays=32, branches=2, seed=number * 64 + k))
        mean = trace_pixels(experiment, pixel_x, pixel_y).total()[0][0].reshape(n, n)
        mean = np.maximum(mean, 0.0)  # what few paths leave of a dark pixel may lie a little below 0
        noisy = rng.poisson(mean * counts / mean.mean()).astype(float)
        about = {"sample_rotation": nominal, "name": f"view{k}", "noise": "poisson"}
        stacks.append(MicrographStack(noisy[None], axis, axis, instrument, np.maximum(noisy, 1.0)[None], **about))
        motions.append(motion)
    back = motions[0].inverse()
    return MicrographSet(tuple(stacks)), [m.after(back) for m in motions]


def errors_px(found: Alignment, true: list[Rigid], scans: MicrographSet) -> list[float]:
    """Return the root mean square displacement over the first field of every view but the first [pixels]."""
    first = scans.stacks[0]
    places = np.stack(np.meshgrid(first.x, first.y), -1).reshape(-1, 2)
    return [separation(a, b, places) / pitch(first.x) for a, b in zip(found.motions, true, strict=True)][1:]


def synthetic_rows(n_cases: int, n: int = 101) -> list[Row]:
    """Row 10."""
    rows, worst, flagged = [], [], []
    for number in range(n_cases):
        scans, true = make_case(number, n)
        found = find_motions(scans)
        errors = errors_px(found, true, scans)
        worst.append(max(errors))
        flagged.append(bool(found.problems))
        stds = [s / PITCH_UM for s in found.std_um[1:]]
        text = f"worst view {max(errors):.3f} px (stated {max(stds):.3f}){', refused' if flagged[-1] else ''}"
        more = {"errors_px": errors, "std_px": stds, "problems": list(found.problems)}
        rows.append(
            row(
                "10", f"case {number}: {KINDS[number % len(KINDS)].__name__}", text, "< 1 px", max(errors) < 1.0, **more
            )
        )
    good = np.array([w < 1.0 and not f for w, f in zip(worst, flagged, strict=True)])
    unseen = sum(w >= 1.0 and not f for w, f in zip(worst, flagged, strict=True))
    text = f"{good.sum()} of {n_cases} below 1 px, median {np.median(worst):.3f} px; {unseen} failures not flagged"
    rows.append(row("10", "all cases", text, ">= 95 %, failures flagged", bool(good.mean() >= 0.95 and unseen == 0)))
    return rows


def alum_rows(shared: Path) -> list[Row]:
    """Row 4: the automatic motions against the control points picked by hand."""
    instrument = load_instrument(INSTRUMENT)
    scans = MicrographSet(tuple(import_micrographs(shared / "data" / f"{name}.mat", instrument) for name in SCANS))
    picks = read_points(POINTS)
    by_hand, auto = find_motions(scans, picks), find_motions(scans)
    assert by_hand.points is not None
    step = pitch(scans.stacks[0].x)
    own = rms(by_hand.points.left_out) / step
    places = np.array(list(by_hand.points.places.values()))
    text = f"residual {rms(by_hand.points.residuals) / step:.2f}, leave-one-out {own:.2f} px (rms)"
    rows = [row("4", f"points by hand, {min(map(len, picks.values()))} or more per scan", text, "stated", None)]
    for k, name in enumerate(SCANS[1:], 1):
        apart = separation(auto.motions[k], by_hand.motions[k], places) / step
        turned = math.degrees(
            math.remainder(
                auto.motions[k].rotation - scans.stacks[k].sample_rotation + scans.stacks[0].sample_rotation, math.tau
            )
        )
        beyond = math.sqrt(max(apart**2 - 2 * (by_hand.std_um[k] / step) ** 2, 0.0))
        text = f"{apart:.2f} px, beyond their error {beyond:.2f}; stage {turned:+.2f} deg"
        rows.append(
            row("4", f"{name}: automatic against points", text, "<= 1 px beyond it", beyond <= 1.0, apart_px=apart)
        )
    rows.append(row("4", "automatic: refused?", "; ".join(auto.problems) or "no", "no", not auto.problems))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--tiny", action="store_true", help="one small case")
    args = parser.parse_args()
    rows = synthetic_rows(1, 51) if args.tiny else synthetic_rows(args.cases)
    if not args.tiny and (args.shared / "data").is_dir():
        rows += alum_rows(args.shared)
    write(args.output / ("alignment_tiny.json" if args.tiny else "alignment.json"), rows, seed=10)


if __name__ == "__main__":
    main()
