"""Plans against acquisitions: times and speed-ups of the paper, and predicted against obtained errors of the heights.

    python benchmarks/plan.py [--members 12] [--draws 3] [--size 41 41] [--seed 5] [--output benchmarks/out] [--tiny]

Rows 1: the time to move is measured on one file of each instrument and predicts the other files; rows 2: speed-ups of
several detectors; row 3: windows from two scans of the alum crystal against where it was in the other three. Rows 4:
random samples of `benchmarks/shapes.py`, two of each family but `wrong`: `hx.fisher` on the true surface against
reconstructions of simulated, noisy micrographs, errors of typical heights. Rows 1 to 3 need the measured files
(`helio fetch-data`).
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, with_origin  # noqa: E402
from benchmarks.shapes import FAMILIES, members  # noqa: E402
from helio_jax.errors import GuardError  # noqa: E402
from helio_jax.figures.wording import duration  # noqa: E402
from helio_jax.formats.acquisition import Acquisition, read_acquisitions  # noqa: E402
from helio_jax.formats.points import read_points  # noqa: E402
from helio_jax.planning.coverage import scans_per_pixel  # noqa: E402
from helio_jax.planning.timing import scans_needed, seconds_per_height  # noqa: E402
from helio_jax.workflows.plan import check, measured_timing  # noqa: E402
from helio_jax.workflows.plan_windows import plan_windows  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402

DATA = Path(os.environ.get("HELIO_DATA") or ROOT.parent / "shared") / "data"
ALUM = ("scan003259", "scan003248", "scan003250", "scan003262", "scan003260")
SPHERE, SALT = "sc100351", "sc100378"
HOUR, MINUTE = 3600, 60
PAPER_S = {
    "A-SHeM, 5 scans": 14 * HOUR + 53 * MINUTE,
    "B-SHeM, sphere": 5 * HOUR + 14 * MINUTE,
    "B-SHeM, salt": 8 * HOUR + 8 * MINUTE,
}
"""Durations in the paper [s]."""
LOST = 0.24
"""Share of the alum image that the paper could not reconstruct."""


def planned(like: str, scans: list[Acquisition]) -> float:
    """Return the time of scans [s], with the time to move of one measured file."""
    timing = measured_timing(DATA / f"{like}.mat")
    return sum(timing.at_dwell(s.dwell).seconds(s.n_lines, s.n_per_line) for s in scans)


def times_and_speed_ups() -> list[Row]:
    """Rows 1 and 2."""
    scans = {name: read_acquisitions(DATA / f"{name}.mat")[0] for name in (*ALUM, SPHERE, SALT)}
    alum = [scans[name] for name in ALUM]
    one = planned("scan003248", alum)
    cases = (
        ("A-SHeM, 5 scans", "scan003248", one),
        ("B-SHeM, sphere", SALT, planned(SALT, [scans[SPHERE]])),
        ("B-SHeM, salt", SPHERE, planned(SPHERE, [scans[SALT]])),
    )
    rows = []
    for name, like, seconds in cases:
        error = seconds / PAPER_S[name] - 1.0
        what = f"time of {name}, moves as in {like}"
        rows.append(row("1", what, f"{duration(seconds)} ({error:+.2%})", duration(PAPER_S[name]), abs(error) < 0.01))
    n, pixels = len(ALUM), alum[0].n_pixels
    several = seconds_per_height(planned(SALT, [scans[SPHERE]]), scans[SPHERE].n_pixels)
    per_height = seconds_per_height(one, pixels, 1.0 - LOST) / several
    square = np.linspace(-0.5, 0.5, 201) * 200 / 201
    seen = scans_per_pixel(square, square, np.arange(n) * 2 * np.pi / n, np.zeros((n, 2)))
    ideal = float(np.mean(seen == n))
    equal = [scans_needed(n, 1) * seconds_per_height(1.0, 1, share) for share in (1.0 - LOST, ideal, 1.0)]
    three = scans_needed(3, 1) / scans_needed(3, 3)
    for what, value, target, limits in (
        ("speed-up per reconstructed pixel, as acquired", per_height, "5.4", (5.4, 5.4)),
        ("the same at equal time per pixel: 5 scans, 24 % lost", equal[0], "6.6", (6.6, 6.6)),
        ("the same, centred windows: 5 scans of squares", equal[1], "5-7", (5.0, 7.0)),
        ("the same, nothing lost", equal[2], "5-7", (5.0, 7.0)),
        ("three images, three detectors over one", three, "3", (3.0, 3.0)),
    ):
        is_reached = 0.99 * limits[0] <= value <= 1.01 * limits[1]
        rows.append(row("2", what, f"{value:.2f}", target, is_reached))
    return rows


def windows_row() -> Row:
    """Row 3: two scans predict where the crystal's points were on the stage in the other three scans."""
    picks = read_points(ROOT / "benchmarks" / "alum_points.csv")
    first, second, *others = (read_acquisitions(DATA / f"{name}.mat")[0] for name in ALUM)
    files = [DATA / f"{scan.name}.mat" for scan in (first, second)]
    center = plan_windows(files, picks, [0.0]).rotation_center
    misses = []
    for scan in others:
        for point in picks[first.name].keys() & picks[scan.name].keys():
            there = np.add(first.center, picks[first.name][point])
            found = center.windows(there, first.rotation, np.array([scan.rotation]))[0]
            misses.append(found - scan.center - picks[scan.name][point])
    rms = float(np.sqrt(np.mean(np.square(misses))))
    worst = float(np.hypot(*np.transpose(misses)).max())
    value = f"{rms:.0f} um per axis, worst {worst:.0f} um ({len(misses)} points)"
    pixel = first.pixel[0]
    return row(
        "3", f"stage windows from two scans, rms miss ({pixel:g} um pixels)", value, "< 2 pixels", rms < 2 * pixel
    )


def prediction_rows(
    per_family: int, draws: int, size: tuple[int, int], seed: int, families: Sequence[str], keep
) -> None:
    """Rows 4: predicted over obtained standard deviation of typical heights."""
    for number in range(per_family):
        for family in families:
            (member,) = members(family, seed, range(number, number + 1), size)
            started = time.perf_counter()
            try:
                with tempfile.TemporaryDirectory() as folder:
                    found = check(load_scene(member.write(Path(folder))), draws)
            except GuardError as e:
                keep(row("4", f"{member.name}, {member.about['kind']}", f"refused: {e}"[:48], "0.8-1.25", False))
                continue
            value = (
                f"{found.ratio:.2f}: {found.predicted_um:.3g} for {found.obtained_um:.3g} um "
                f"(scatter {found.scatter_um or math.nan:.3g}, stated {found.stated_um:.3g}, rms {found.rms_um:.3g})"
            )
            ratios = {"ratio": found.ratio, "ratio_to_stated": found.predicted_um / found.stated_um}
            if found.scatter_um:
                ratios["ratio_to_scatter"] = found.predicted_um / found.scatter_um
            more = vars(found) | member.about | ratios | {"seconds": time.perf_counter() - started}
            what = f"{member.name}, {member.about['kind']}"
            keep(row("4", what, value, "0.8-1.25", 0.8 <= found.ratio <= 1.25, **more))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--members", type=int, default=12, help="rows 4, in all families together")
    parser.add_argument("--families", default=",".join(f for f in FAMILIES if f != "wrong"))
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=(41, 41))
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    given = parser.parse_args()
    if given.tiny:
        given.members, given.families, given.draws, given.size = 1, "smooth", 1, (16, 16)
    families, rows = given.families.split(","), []
    given.output.mkdir(parents=True, exist_ok=True)

    def keep(one: Row) -> None:
        rows.append(one)
        text = json.dumps(with_origin(rows, given.seed), indent=1)
        (given.output / "plan.json").write_text(text + "\n", encoding="utf-8")

    if DATA.is_dir():
        for one in (*times_and_speed_ups(), windows_row()):
            keep(one)
    else:
        print(f"no measured data in {DATA}: rows 1 to 3 are left out")
    per_family = -(-given.members // len(families))
    prediction_rows(per_family, given.draws, given.size, given.seed, families, keep)
    for key, what in (
        ("ratio", "errors obtained"),
        ("ratio_to_scatter", "scatter over the draws"),
        ("ratio_to_stated", "s.d. that the reconstructions state"),
    ):
        found = [r[key] for r in rows if key in r]
        if found:
            low, middle, high = np.quantile(found, [0.0, 0.5, 1.0])
            print(f"rows 4: predicted over {what}: {low:.2f} to {high:.2f}, median {middle:.2f}")


if __name__ == "__main__":
    main()
