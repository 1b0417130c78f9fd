"""A measured ball by its own best-fit sphere: form deviation, radius, height; no height is taken for known.

python benchmarks/measured_sphere.py [STACK.h5] [--every N] [--methods nearfield,refine] [--radius UM] [--outline UM]
    [--tiny]

STACK.h5 is calibrated (`helio import`, then `helio calibrate`, by the instrument file to be judged); `--every` keeps
every N-th row and column. A sphere of free radius, place and height is fitted to the heights inside 0.8 of its foot's
radius. Printed: root mean square deviation from it, its radius against the ball's, its top above the border with the
stated standard deviation, against the height that the outline alone gives (`outline.py`), what is said of the map, and
the time. Without a stack: the scene sphere_a, simulated, of which radius and height are known.
"""

import argparse
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks import rows  # noqa: E402
from benchmarks.fit import sphere  # noqa: E402
from helio_jax.formats.hdf5 import read_stack  # noqa: E402

INSIDE, PASSES, SOFT = 0.8, 4, 20.0
"""Share of the foot's radius inside which the sphere is fitted; how often; deviation that counts less [um]."""
LOWEST = 0.15
"""Heights below this share of the highest do not count."""
FORM_UM, RADIUS_SHARE, STD_SHARE = 12.0, 0.03, 0.06
"""Targets: form deviation, deviation of the radius, standard deviation of the height."""


class Sphere(NamedTuple):
    """The best-fit sphere: radius, top above the border, form deviation (root mean square), um."""

    radius: float
    height: float
    form: float


def best_sphere(rec: hx.Reconstruction) -> Sphere:
    """Fit a sphere to a height map, at the places of the sample that the beam meets."""
    x, y = np.meshgrid(rec.raster_x, rec.raster_y)
    shift, n = rec.instrument.beam_shift, max(3, rec.height.shape[0] // 20)
    frame = np.ones(rec.height.shape, bool)
    frame[n:-n, n:-n] = False
    z = rec.height - np.median(rec.height[frame])
    x, y = x - z * shift[0], y - z * shift[1]
    top, foot = z > 0.8 * z.max(), np.inf
    radius = 0.5 * np.sqrt(np.sum(z > 0.5 * z.max())) * np.ptp(rec.raster_x) / len(z)
    at = np.array([x[top].mean(), y[top].mean(), z.max() - radius, radius])
    for _ in range(PASSES):
        used = (np.hypot(x - at[0], y - at[1]) < INSIDE * foot) & (z > LOWEST * z.max())

        def deviation(q: np.ndarray, used: np.ndarray = used) -> np.ndarray:
            return np.sqrt((x[used] - q[0]) ** 2 + (y[used] - q[1]) ** 2 + (z[used] - q[2]) ** 2) - q[3]

        at = least_squares(deviation, at, loss="soft_l1", f_scale=SOFT).x
        foot = float(np.sqrt(max(at[3] ** 2 - at[2] ** 2, 0.0)))
    return Sphere(float(at[3]), float(at[2] + at[3]), float(np.sqrt(np.mean(deviation(at) ** 2))))


def every(stack: hx.MicrographStack, n: int) -> hx.MicrographStack:
    """Keep every n-th row and column."""
    thin, shape = (slice(None, None, n),) * 2, stack.shape
    changes = {"x": stack.x[::n], "y": stack.y[::n]}
    for field in fields(stack):
        value = getattr(stack, field.name)
        if isinstance(value, np.ndarray) and value.shape in (shape, shape[1:]):
            changes[field.name] = value[..., *thin]
    return stack.replace(**changes)


def judged(stack: hx.MicrographStack, method: str, radius: float, outline: tuple[float, float]) -> list[rows.Row]:
    """Reconstruct by a method and print what its sphere is like; `outline`: height by it and its error, um."""
    begin = time.time()
    rec = hx.reconstruct(stack, method)
    seconds, ball = time.time() - begin, best_sphere(rec)
    highest = np.unravel_index(np.argmax(np.where(rec.is_valid, rec.height, -np.inf)), rec.height.shape)
    std = np.nan if rec.height_std is None else float(rec.height_std[highest])
    off = ball.height - outline[0]
    share = ball.radius / radius - 1.0
    out = [
        rows.row("5", f"{method}: deviation from its sphere", f"{ball.form:.1f} um", "12 um", ball.form <= FORM_UM),
        rows.row(
            "5", f"{method}: radius", f"{ball.radius:.0f} um ({share:+.1%})", "within 3 %", abs(share) <= RADIUS_SHARE
        ),
        rows.row(
            "5", f"{method}: height", f"{ball.height:.0f} +- {std:.0f} um, outline {outline[0]:.0f}",
            "within 2 s.d.", bool(abs(off) <= 2.0 * np.hypot(std, outline[1])),
        ),
        rows.row(
            "5", f"{method}: standard deviation of the height", f"{std / ball.height:.1%}", "6 %",
            bool(std <= STD_SHARE * ball.height),
        ),
        rows.row("5", f"{method}: valid pixels", f"{rec.is_valid.mean():.0%}", "-", None),
        rows.row("5", f"{method}: time", f"{seconds:.0f} s", "-", None),
    ]  # fmt: skip
    for warning in rec.warnings:
        print(f"        {method}: {warning}")
    return out


def main() -> None:
    """Reconstruct and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stack", nargs="?", type=Path)
    parser.add_argument("--every", type=int, default=1, metavar="N")
    parser.add_argument("--methods", default="nearfield,refine")
    parser.add_argument("--radius", type=float, default=1000.0, help="of the ball [um]")
    parser.add_argument("--outline", type=float, default=681.0, help="height by its outline, known to 5 um [um]")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true", help="few pixels, nearfield only")
    args = parser.parse_args()
    if args.stack is None:
        stack, outline = sphere(21 if args.tiny else 61), (720.0, 1.0)
    else:
        stack, outline = every(read_stack(args.stack), args.every), (args.outline, 5.0)
    methods = ["nearfield"] if args.tiny else args.methods.split(",")
    found = [row for method in methods for row in judged(stack, method, args.radius, outline)]
    args.output.mkdir(parents=True, exist_ok=True)
    rows.write(args.output / ("measured_sphere_tiny.json" if args.tiny else "measured_sphere.json"), found, 0)


if __name__ == "__main__":
    main()
