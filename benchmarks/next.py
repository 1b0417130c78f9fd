"""Where to spend the next second, against the same time spent evenly: traced data with counting noise, ten decisions.

    python benchmarks/next.py [--seeds 3] [--decisions 10] [--size 31] [--shapes sphere,mesa] [--output benchmarks/out]
                              [--tiny]

A first even scan takes one part of the time; ten decisions of `hx.next_scan` take one part each, the heights fitted
anew by `refine` to all counts so far before each of them. Even: the first scan's counts and those of the rest of the
time spent evenly. Both are fitted by `refine`; the loop sees the truth nowhere. Score: mean square error of the heights
of the region, off walls (`WALL`), and the variance of the errors over the seeds of the noise, which a wrong model does
not enter. Rows 1: sphere A, the cap's middle; 2: all of its field; 3 and 4: the same of a random mesa, the first of one
level and without a hole in family `mesa` of `benchmarks/shapes.py`. Rows 5: what is expected of one decision, by the
size of the region, and with another rotation of the sample to choose from.
"""

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from benchmarks.shapes import members  # noqa: E402
from helio_jax.arrays import border_mask  # noqa: E402
from helio_jax.calibration.noise import add_noise  # noqa: E402
from helio_jax.inverse.settings import ReconstructSettings  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402
from helio_jax.workflows.truth import true_surface  # noqa: E402

DWELL = 0.1
"""Dwell time of a pixel of the first scan [s]."""
COUNTS = 200.0
"""Mean counts of a pixel of the first scan; see `--counts`."""
BACKGROUND = 0.05
"""Background, as a share of those."""
DECISION_PATHS = 400_000
"""Paths of a prediction in the fits that decisions are made of; those that are scored have the default."""
WALL = 1.0
"""Slopes between true neighbours above this one are walls, whose two pixels are not scored."""
MIDDLE = 0.125
"""Half the side of the middle region, as a share of the field."""


@dataclass(frozen=True)
class Case:
    """A shape, traced: expected counts of the first scan's dwell time, their mean, and the true heights [y, x], um."""

    name: str
    scene: SceneFile
    expected: MicrographStack
    truth: np.ndarray
    counts: float

    @classmethod
    def of(cls, name: str, scene: SceneFile, counts: float) -> "Case":
        """Trace a scene for so many counts per pixel."""
        traced = pipeline.simulate(scene).only()
        factor = counts / float(np.mean(traced.counts))
        assert traced.n_rays is not None  # simulated
        variance = None if traced.variance is None else factor**2 * traced.variance
        more = {"counts": factor * traced.counts, "variance": variance, "n_rays": factor * traced.n_rays}
        truth = true_surface(scene, traced.x, traced.y).height
        return cls(name, scene, traced.replace(**more, dwell=DWELL, by_order=None), truth, counts)

    def counted(self, dwell: np.ndarray, seed: int) -> MicrographStack:
        """Count for dwell times [y, x]: Poisson noise and background, on these pixels only."""
        seen = np.broadcast_to(dwell > 0.0, self.expected.shape)
        asked = self.expected.replace(dwell_map=dwell, is_observed=seen)
        noise = self.scene.noise.changed(background_per_pixel=BACKGROUND * self.counts, dwell_s=None)
        return add_noise(asked, noise, seed)

    def region(self, share: float | None) -> tuple[float, float, float, float] | None:
        """Return the middle of the field, or None: all of it."""
        if share is None:
            return None
        ends = []
        for axis in (self.expected.x, self.expected.y):
            middle, half = 0.5 * float(axis[0] + axis[-1]), share * float(axis[-1] - axis[0])
            ends += [middle - half, middle + half]
        return ends[0], ends[1], ends[2], ends[3]


def scored(case: Case, truth: np.ndarray, region: tuple[float, float, float, float] | None) -> np.ndarray:
    """Return the pixels that are scored [y, x]: of the region, off the border and off walls."""
    x, y = case.expected.x, case.expected.y
    inside = ~border_mask(truth.shape, 0.06)
    if region is not None:
        inside &= (x >= region[0]) & (x <= region[1]) & ((y >= region[2]) & (y <= region[3]))[:, None]
    wall = np.zeros(truth.shape, bool)
    for axis, step in ((1, x[1] - x[0]), (0, y[1] - y[0])):
        steep = np.abs(np.diff(truth, axis=axis)) > WALL * step
        pad = [(0, 0), (0, 0)]
        for ends in ((1, 0), (0, 1)):
            pad[axis] = ends
            wall |= np.pad(steep, pad)
    return inside & ~wall


def loop(
    case: Case,
    region: tuple[float, float, float, float] | None,
    decisions: int,
    seed: int,
    settings: ReconstructSettings,
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Spend the time by decisions, and evenly.

    Returns:
        Heights of both, and the ratio of the variances that each decision expects for itself.
    """
    every = np.full(case.expected.shape[1:], DWELL)
    fewer = settings.refine.model_copy(update={"rays": min(DECISION_PATHS, settings.refine.rays or DECISION_PATHS)})
    deciding = settings.model_copy(update={"refine": fewer})
    first = case.counted(every, 1000 * seed)
    part, so_far, expected = float(every.sum()), first, []
    for number in range(decisions):
        found = hx.next_scan(so_far, part, region_um=region, settings=deciding, n_samples=16)
        expected.append(found.variance_ratio or math.nan)
        print(
            f"{case.name}, seed {seed}, decision {number + 1}: {found.now_um:.3g} um so far",
            file=sys.stderr,
            flush=True,
        )
        so_far = hx.add_scans(so_far, case.counted(found.dwell_maps[0], 1000 * seed + 1 + number))
    even = hx.add_scans(first, case.counted(decisions * every, 1000 * seed + 500))
    heights = [hx.reconstruct(s, "refine", settings=settings).height for s in (so_far, even)]
    return heights[0], heights[1], expected


def loop_rows(
    number: str, case: Case, share: float | None, args: argparse.Namespace, settings: ReconstructSettings
) -> list[Row]:
    """Rows 1 to 4."""
    region = case.region(share)
    spent, even, ratios = [], [], []
    start = time.perf_counter()
    for seed in range(1, args.seeds + 1):
        heights = loop(case, region, args.decisions, seed, settings)
        spent.append(heights[0])
        even.append(heights[1])
        ratios += heights[2]
    truth = case.truth
    use = scored(case, truth, region)
    square = np.array([[np.mean((h - truth)[use] ** 2) for h in arm] for arm in (spent, even)])  # [arm, seed]
    ratio = square[0] / square[1]
    error = float(np.std(np.log(ratio), ddof=1) / math.sqrt(len(ratio))) if len(ratio) > 1 else math.nan
    typical = [float(np.median(np.abs((np.array(arm) - truth)[:, use]))) for arm in (spent, even)]
    about = {
        "mean_square_um2": square.tolist(),
        "typical_um": [1.4826 * t for t in typical],
        "pixels": int(use.sum()),
        "expected_ratio_of_decisions": ratios,
        "seconds": time.perf_counter() - start,
    }
    mean = float(np.exp(np.mean(np.log(ratio))))
    said = f"{mean:.2f} x/: {math.exp(error):.2f}" if len(ratio) > 1 else f"{mean:.2f}"
    where = "all" if share is None else f"middle {2 * share:.0%}"
    rms = np.sqrt(square.mean(1))
    value = f"{said} (rms {rms[0]:.3g} for {rms[1]:.3g} um; expected {np.nanmean(ratios):.2f})"
    rows = [row(number, f"{case.name}, {where}: mean square error over even", value, "<= 0.5", mean <= 0.5, **about)]
    if len(ratio) > 1:
        scatter = [float(np.mean(np.var(np.array(arm)[:, use], axis=0, ddof=1))) for arm in (spent, even)]
        value = f"{scatter[0] / scatter[1]:.2f} ({scatter[0]:.3g} for {scatter[1]:.3g} um^2)"
        what = f"{case.name}, {where}: variance over the seeds over even"
        rows.append(row(f"{number}s", what, value, "<= 0.5", scatter[0] <= 0.5 * scatter[1], scatter_um2=scatter))
    return rows


def expected_rows(case: Case, settings: ReconstructSettings, rotation: float | None) -> list[Row]:
    """Rows 5: what is expected of one decision over the first scan's time, by the size of the region; not simulated.

    With another rotation to choose from, the last row compares with the time spent evenly on the present and on both.
    """
    every = np.full(case.expected.shape[1:], DWELL)
    first, rows = case.counted(every, 1), []
    for share in (None, 0.25, MIDDLE):
        found = hx.next_scan(first, float(every.sum()), region_um=case.region(share), settings=settings)
        where = "all" if share is None else f"middle {2 * share:.0%}"
        value = f"{found.variance_ratio:.2f} ({found.proposed_um:.3g} for {found.even_um:.3g} um)"
        rows.append(row("5", f"{case.name}, {where}: expected of one decision", value, "", None, **found.as_dict()))
    if rotation is not None:
        region = case.region(MIDDLE)
        found = hx.next_scan(first, float(every.sum()), region_um=region, settings=settings, rotations_deg=(rotation,))
        even_all = found.even_all_um or math.nan
        value = f"{found.variance_ratio:.2f}; over even on both {(found.proposed_um / even_all) ** 2:.2f}"
        what = f"{case.name}, middle {2 * MIDDLE:.0%}, {rotation:g} deg offered: expected"
        rows.append(row("5", what, value, "", None, **found.as_dict()))
    return rows


def sphere_a(size: int, counts: float) -> Case:
    """Trace sphere A on a raster of so many pixels a side."""
    changes = {"scan.nx": size, "scan.ny": size, "scan.pixel_size_um": 30.0 * 121 / size}
    return Case.of("sphere A", load_scene("sphere_a", changes), counts)


def mesa(size: int, seed: int, counts: float) -> Case:
    """Trace the first mesa of one level without a hole; the family also has pits and rings."""
    for member in members("mesa", seed, range(100), (size, size)):
        kind = member.about["kind"]
        if kind.startswith("mesa") and "ring" not in kind and len(member.levels) == 1:
            with tempfile.TemporaryDirectory() as folder:
                return Case.of(kind, load_scene(member.write(Path(folder))), counts)
    raise AssertionError("a hundred members of a family without one of its kinds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--decisions", type=int, default=10)
    parser.add_argument("--size", type=int, default=31)
    parser.add_argument("--counts", type=float, default=COUNTS, help="mean counts of a pixel of the first scan")
    parser.add_argument("--shapes", default="sphere,mesa")
    parser.add_argument("--regions", default="middle,all")
    parser.add_argument("--seed", type=int, default=5, help="of the mesa")
    parser.add_argument("--no-loops", action="store_true", help="rows 5 only")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    if args.tiny:
        args.seeds, args.decisions, args.size, args.shapes, args.regions = 1, 1, 11, "sphere", "middle"
    rows: list[Row] = []
    for shape in args.shapes.split(","):
        case = sphere_a(args.size, args.counts) if shape == "sphere" else mesa(args.size, args.seed, args.counts)
        settings = case.scene.reconstruct
        if args.tiny:
            quick = {"max_rounds": 1, "rays": 20_000, "photometric_rounds": 1, "samples": 0}
            settings = settings.model_copy(update={"refine": settings.refine.model_copy(update=quick)})
        if not args.tiny:
            rows += expected_rows(case, settings, 180.0 if shape == "sphere" else None)
        for where in () if args.no_loops else args.regions.split(","):
            number = str(1 + 2 * (shape == "mesa") + (where == "all"))
            rows += loop_rows(number, case, MIDDLE if where == "middle" else None, args, settings)
            write(args.output / "next.json", rows, args.seed)
        write(args.output / "next.json", rows, args.seed)


if __name__ == "__main__":
    main()
