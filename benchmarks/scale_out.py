"""What a large simulation needs: memory against the size of the raster, threads and processes against one thread.

python benchmarks/scale_out.py [--output benchmarks/out] [--tiny] [--rows memory,speed,cost] [--update]

memory: peak memory of a process that traces rasters of growing size over a rough surface of 1.3 million triangles,
with 4 detectors and 6 orders, into a file; what is beyond the output arrays must not grow with the raster.
speed: time of one thread over that of two threads or processes, alternating within one run, the median of the ratios.
cost: shortest time with finished units kept on disk over the shortest without.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, update, write  # noqa: E402
from helio_jax.cpus import n_cpus  # noqa: E402
from helio_jax.formats.parts import Parts  # noqa: E402
from helio_jax.trace.job import Job  # noqa: E402
from helio_jax.trace.scan import Executor  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.checkpoint import CheckpointedRun  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402

MIB = 1024**2
ARRAYS = ("counts", "variance", "by_order", "by_order_variance", "masked", "shadowed", "is_observed", "x", "y")


def rough_scene(pixels: int, points: int, rays: int, folder: Path) -> SceneFile:
    """Return a raster of `pixels` squared over a rough surface of 2 (points - 1)^2 triangles, with 4 detectors."""
    axis = np.linspace(-4000.0, 4000.0, points)
    x, y = np.meshgrid(axis, axis)
    height = 30.0 * np.sin(x / 70.0) * np.cos(y / 90.0) + 10.0 * np.sin((x + 2.0 * y) / 31.0)
    path = folder / f"rough_{points}.npz"
    if not path.exists():
        np.savez(path, x=axis, y=axis, height=height)
    base = load_scene(ROOT / "scenes" / "sphere_a.toml")
    detectors = [d.model_dump(exclude_none=True) for d in base.detector]
    fourth = {"name": "fourth", "center_um": (2309.4, 1800.0), "axes_um": (300.0, 300.0)}
    changes = {
        "sample": {"kind": "height_map", "file": str(path)},
        "detector": [*detectors, fourth],
        "scan": {"nx": pixels, "ny": pixels, "pixel_size_um": 6000.0 / pixels},
        "trace": {"rays": rays, "branches": 1, "n_orders": 6},
    }
    return load_scene(ROOT / "scenes" / "sphere_a.toml", changes)


def trace_child(pixels: int, points: int, rays: int, folder: str) -> None:
    """Trace and write one raster; print sizes in MiB. Runs in a process of its own."""
    scene = rough_scene(pixels, points, rays, Path(folder))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    checkpointed_run = CheckpointedRun(Parts(Path(folder) / f"out_{pixels}.h5"), {}, Executor())
    start = time.perf_counter()
    stack = checkpointed_run.trace(scene, scene.trace)
    assert stack is not None
    traced = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    checkpointed_run.parts.finish(lambda path: pipeline.write(stack, path))
    seconds = time.perf_counter() - start
    written = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    arrays = sum(getattr(stack, name).nbytes for name in ARRAYS) / MIB
    print(json.dumps({"before": before, "traced": traced, "written": written, "arrays": arrays, "seconds": seconds}))


def memory_rows(sizes: tuple[int, ...], points: int, rays: int) -> list[Row]:
    """Peak memory beyond the output arrays, for every size of raster."""
    rows, beyond = [], []
    with tempfile.TemporaryDirectory(prefix="helio-scale-") as folder:
        for pixels in sizes:
            command = [sys.executable, __file__, "--child", *map(str, (pixels, points, rays)), folder]
            found = json.loads(
                subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1]
            )
            beyond.append(found["traced"] - found["arrays"])
            written = found["written"] - found["arrays"]
            what = f"memory, {pixels} x {pixels} pixels, {2 * (points - 1) ** 2:,} triangles"
            value = f"arrays {found['arrays']:.0f}, beyond {beyond[-1]:.0f}, writing {written:.0f} MiB"
            rows.append(row("13", what, value, "beyond < 3072 MiB", written < 3072, **found, pixels=pixels))
        growth = beyond[-1] - beyond[0]
        value = f"{growth:+.0f} MiB for {sizes[-1] ** 2 - sizes[0] ** 2:,} more pixels"
        rows.append(
            row("13", "growth of what is beyond the arrays", value, "< 15 % of the arrays", None, growth=growth)
        )
    return rows


def speed_rows(scene: SceneFile, repeats: int) -> list[Row]:
    """One thread over two threads; the order alternates, so that a busy machine disturbs both alike."""
    pipeline.simulate(scene, rays=8, branches=1)
    times: dict[int, list[float]] = {1: [], 2: []}
    for i in range(repeats):
        for workers in ((1, 2), (2, 1))[i % 2]:
            start = time.perf_counter()
            pipeline.simulate(scene, workers=workers)
            times[workers].append(time.perf_counter() - start)
    ratios = [a / b for a, b in zip(times[1], times[2], strict=True)]
    text = f"{statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f}), {min(times[1]):.2f} s on one"
    load = os.getloadavg()[0]
    reached = statistics.median(ratios) >= 1.7 if n_cpus() > 1 else None
    return [row("9", f"two threads over one, load {load:.1f}", text, ">= 1.7", reached, times=times, load=load)]


def cost_rows(scene: SceneFile, repeats: int) -> list[Row]:
    """Time with units kept on disk over the time without."""
    body = scene.build_body()
    n_units = len(Job.of(scene, scene.trace, body).units())
    plain, kept = [], []
    with tempfile.TemporaryDirectory(prefix="helio-scale-") as folder:
        for _ in range(repeats):
            checkpointed_run = CheckpointedRun(Parts(Path(folder) / "out.h5"), {}, Executor(1))
            start = time.perf_counter()
            pipeline.simulate(scene, workers=1)
            between = time.perf_counter()
            checkpointed_run.trace(scene, scene.trace)
            plain.append(between - start)
            kept.append(time.perf_counter() - between)
            checkpointed_run.parts.remove()
    text = f"{min(kept) / min(plain):.3f} ({min(kept):.2f} over {min(plain):.2f} s), {n_units} units"
    return [
        row("cost", "keeping finished units: time with over without", text, "<= 1.03", None, plain=plain, kept=kept)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--rows", default="memory,speed,cost")
    parser.add_argument("--update", action="store_true", help="also put the rows into benchmarks/results")
    parser.add_argument("--child", nargs=4)
    args = parser.parse_args()
    if args.child:
        pixels, points, rays, folder = args.child
        trace_child(int(pixels), int(points), int(rays), folder)
        return
    scene = load_scene(ROOT / "scenes" / "sphere_a.toml")
    small = {
        "scan.nx": 31,
        "scan.ny": 31,
        "scan.pixel_size_um": 117.0,
        "trace.rays": 16,
        "trace.paths_per_unit": 20_000,
    }
    scene = load_scene(ROOT / "scenes" / "sphere_a.toml", small) if args.tiny else scene
    makers = {
        "memory": lambda: memory_rows((24,), 60, 8) if args.tiny else memory_rows((250, 500, 1000), 807, 8),
        "speed": lambda: speed_rows(scene, 1 if args.tiny else 5),
        "cost": lambda: cost_rows(scene, 1 if args.tiny else 5),
    }
    rows = [row for name in args.rows.split(",") for row in makers[name]()]
    rows = [r | {"reached": None} for r in rows] if args.tiny else rows
    write(args.output / ("scale_out_tiny.json" if args.tiny else "scale_out.json"), rows, scene.trace.seed)
    if args.update and not args.tiny:
        update(ROOT / "benchmarks" / "results" / "scale_out.json", rows, scene.trace.seed)


if __name__ == "__main__":
    main()
