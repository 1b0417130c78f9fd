"""A small scene cut into many units, and what a killed run of it may do: shared by the tests of scaling out.

Importing this loads the tracer and its compiled kernels, so that a fork server which has imported it starts runs at
once. Embree is left alone here: it may start threads, which do not survive a fork.
"""

import os
from pathlib import Path

import numpy as np

from helio_jax.micrograph import MicrographStack
from helio_jax.trace import run, units
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.scan import Executor
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "sphere_a.toml"
N_UNITS = 12
SMALL = {
    "scan.nx": 20,
    "scan.ny": 18,
    "scan.pixel_size_um": 180.0,
    "trace.rays": 192,
    "trace.paths_per_unit": 360 // N_UNITS * 192 * 8,
}
ARRAYS = ("counts", "variance", "by_order", "by_order_variance", "masked", "shadowed")


def assert_same_bits(a: MicrographStack, b: MicrographStack) -> None:
    """Every array and every ray is the same."""
    for name in ARRAYS:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert a.provenance["rays"] == b.provenance["rays"] and a.provenance["job"] == b.provenance["job"]


def run_logged(output: str, log: str, workers: int) -> None:
    """Simulate into a file in small blocks, and write down every block of pixels that is begun."""
    run.RAYS_PER_BLOCK = 8192
    traced = units._trace

    def logged(experiment, job, start, stop):
        with open(log, "ab", buffering=0) as file:
            file.write(f"{start}\n".encode())
        return traced(experiment, job, start, stop)

    units._trace = logged
    options = pipeline.SimulateOptions(executor=Executor(workers))
    pipeline.simulate_file(SCENE, output, overrides=SMALL, options=options)


if os.environ.get("HELIO_TEST_FORK_SERVER"):
    _scene = load_scene(SCENE, SMALL)
    _body = Intersector(_scene.build_body(), "exhaustive")
    trace_pixels(make_experiment(_body, _scene.instrument, _scene.trace), np.zeros(1), np.zeros(1), workers=1)
