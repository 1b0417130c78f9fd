"""Time and compilations of `refine`: several geometries of one raster, another distance, fresh processes.

python benchmarks/fit.py [--output benchmarks/out] [--rows 1,2,7] [--tiny]

Simulated sphere A. Fresh processes keep no compiled code from earlier ones. Wall times; run them on an idle machine.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.workflows.pipeline import record  # noqa: E402
from tests.compilations import counted  # noqa: E402

SCENES = ROOT / "scenes"
STEP_UM = 25.0
"""Change of the plate's distance from one geometry to the next."""
SHORT = {"max_rounds": 2, "rays": 20_000}
"""Settings of rows 1 and 2: few paths, so that compilation would show."""
_CHILD = """
import sys, time
start = time.time()
import helio_jax as hx
stack = hx.read(sys.argv[1])
for _ in range(2):
    begin = time.time()
    hx.reconstruct(stack, "refine")
    print(time.time() - begin)
print(time.time() - start)
"""


def sphere(n: int, scene: str = "sphere_a") -> MicrographStack:
    """Simulate sphere A with counting noise on n x n pixels over the scene's field."""
    loaded = hx.load_scene(SCENES / f"{scene}.toml")
    if n:
        field = loaded.scan.pixel_size_um * 121
        changes = {"scan.nx": n, "scan.ny": n, "scan.pixel_size_um": field / n}
        loaded = hx.load_scene(SCENES / f"{scene}.toml", changes)
    return record(loaded, hx.simulate(loaded, rays=32)).only()


def farther(stack: MicrographStack, by_um: float) -> MicrographStack:
    """Return the same images by an instrument whose plate is farther away."""
    instrument = stack.instrument
    return stack.replace(instrument=instrument.at_distance(instrument.sample_distance + by_um))


def geometry_rows(n: int, n_geometries: int) -> list[Row]:
    """Row 1: programs compiled for further geometries; row 2: seconds of a fit at another distance."""
    stack = sphere(n)
    hx.reconstruct(stack, "refine", refine=SHORT)
    seconds = []
    with counted() as found:
        for i in range(1, n_geometries):
            begin = time.perf_counter()
            hx.reconstruct(farther(stack, i * STEP_UM), "refine", refine=SHORT)
            seconds.append(time.perf_counter() - begin)
    value = f"{sum(found.values())} programs after the first geometry"
    what = f"refine, {n} x {n}, {n_geometries} distances"
    first = f"{seconds[0]:.2f} s (least of all {min(seconds):.2f} s)"
    return [
        row("1", what, value, "0", not found, programs=dict(found)),
        row("2", f"second refine, another distance, {n} x {n}", first, "<= 2 s", seconds[0] <= 2.0, seconds=seconds),
    ]


def process_rows(cases: list[tuple[str, MicrographStack, tuple[float, float]]]) -> list[Row]:
    """Row 7: seconds of a fit in a fresh process, compilation and imports included, and of the next one in it."""
    out = []
    for name, stack, limits in cases:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "stack.h5"
            hx.write(stack, path)
            env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | {"PYTHONPATH": str(ROOT)}
            command = [sys.executable, "-c", _CHILD, str(path)]
            done = subprocess.run(command, capture_output=True, text=True, check=True, env=env)
        first, again, whole = map(float, done.stdout.split())
        fresh = whole - again
        out += [
            row("7", f"refine {name}, fresh process", f"{fresh:.1f} s", f"<= {limits[0]:g} s", fresh <= limits[0]),
            row("7", f"refine {name}, again", f"{again:.1f} s", f"<= {limits[1]:g} s", again <= limits[1], first=first),
        ]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--rows", default="1,7")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    rows: list[Row] = []
    if "1" in args.rows or "2" in args.rows:
        rows += geometry_rows(*((13, 2) if args.tiny else (31, 20)))
    if "7" in args.rows and not args.tiny:
        full = sphere(0, "sphere_a_full")
        rows += process_rows([("121 x 121 x 3", sphere(121), (15.0, 8.0)), ("351 x 304 x 3", full, (70.0, 70.0))])
    write(args.output / ("fit_tiny.json" if args.tiny else "fit.json"), rows, seed=1)


if __name__ == "__main__":
    main()
