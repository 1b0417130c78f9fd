"""Steps from mask bands: traced terraces of random outline, size, height, turn and place, and what is measured on them.

python benchmarks/steps.py [--members N] [--seed S]

Members: mesas and pits with vertical walls (square, L, T, ring) and two levels, height over width 0.1 to 0.6, 61 to 101
pixels a side, 0 and 30 deg incidence, SNR 30 to 100 (tests/terraces.py). A patch is wrong without notice where its
level counts as determined and is off by more than 2 % of the relief and three stated deviations.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.inverse.mask_steps import find_steps  # noqa: E402
from helio_jax.inverse.step_records import Steps  # noqa: E402
from tests.terraces import draw, seen_level, trace  # noqa: E402

MIN_PIXELS = 20
"""Smaller patches are not scored [pixels]."""


def score(member: dict[str, Any], x: np.ndarray, y: np.ndarray, found: Steps) -> list[dict[str, Any]]:
    """Compare every patch with the true level of its pixels, relative to that of patch 0."""
    true = seen_level(member, *np.meshgrid(x, y))
    reference = float(np.nanmedian(true[found.patch == 0]))
    out = []
    for patch in found.patches[1:]:
        seen = true[found.patch == patch.number]
        if patch.pixels < MIN_PIXELS or not np.isfinite(seen).any():
            continue
        height = float(np.nanmedian(seen)) - reference
        error = patch.level_um - height
        is_wrong = abs(error) > max(3.0 * patch.level_std_um, 0.02 * abs(member["height"]))
        out.append(
            {
                "true_um": height,
                "error": error / height if height else np.nan,
                "pull": error / patch.level_std_um,
                "is_determined": patch.is_determined,
                "is_wrong": patch.is_determined and is_wrong,
                "is_pit": member["height"] < 0,
                "incidence": member["incidence"],
            }
        )
    return out


def rows_of(patches: list[dict[str, Any]], name: str) -> list[Row]:
    """Return the rows of a group of patches."""
    known = [p for p in patches if p["is_determined"] and np.isfinite(p["error"])]
    wrong = sum(p["is_wrong"] for p in patches)
    if not known:
        return [row("", f"{name}: patches", "none", "", None)]
    error = np.abs([p["error"] for p in known])
    pull = np.abs([p["pull"] for p in known])
    right = np.array([not p["is_wrong"] for p in known])
    value = f"median {np.median(error):.2%}, worst {error.max():.1%}; of those not wrong {error[right].max():.1%}"
    inside = f"{np.mean(pull < 1):.0%}, {np.mean(pull < 2):.0%}"
    open_ = sum(not p["is_determined"] for p in patches)
    return [
        row("1", f"{name}: level of {len(known)} patches", value, "<= 2 %, 6 %", bool(np.median(error) <= 0.02)),
        row("2", f"{name}: within 1 and 2 deviations", inside, "68, 95 %", None),
        row("3", f"{name}: wrong without notice; not determined", f"{wrong}; {open_}", "0", wrong == 0),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=48)
    parser.add_argument("--seed", type=int, default=400, help="Of the first member.")
    parser.add_argument("--tiny", action="store_true", help="Two members, few rays.")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    args = parser.parse_args()
    patches: list[dict[str, Any]] = []
    seconds: list[float] = []
    without = 0
    for i in range(2 if args.tiny else args.members):
        fixed = {"n": 61, "outline": "square", "pixel": 8.0} if args.tiny else {}
        member = draw(np.random.default_rng(args.seed + i), **fixed)
        with tempfile.TemporaryDirectory() as folder:
            stack = trace(member, Path(folder), rays=32 if args.tiny else 128)
        start = time.perf_counter()
        found = find_steps(stack)
        seconds.append(time.perf_counter() - start)
        new = score(member, stack.x, stack.y, found)
        for p in new:
            if p["is_wrong"]:
                print(f"wrong: seed {args.seed + i}, true {p['true_um']:.1f} um, {p['pull']:+.1f} deviations")
        without += not any(p["is_determined"] for p in new)
        patches += new
    groups = {
        "all": patches,
        "0 deg": [p for p in patches if p["incidence"] == 0.0],
        "30 deg": [p for p in patches if p["incidence"] == 30.0],
        "pits": [p for p in patches if p["is_pit"]],
    }
    rows = [r for name, group in groups.items() for r in rows_of(group, name)]
    rows.append(row("4", "members without a determined patch", f"{without} of {len(seconds)}", "", None))
    rows.append(row("5", "time of a stack", f"{np.median(seconds):.1f} s", "<= 60 s", bool(max(seconds) <= 60.0)))
    write(args.output / "steps.json", rows, args.seed)


if __name__ == "__main__":
    main()
