"""A step across the whole field that faces away from the beam: near field and glow alone tell how high it is."""

from pathlib import Path

import numpy as np

from helio_jax.micrograph import MicrographStack
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.truth import true_height

STEP = Path(__file__).parents[2] / "scenes" / "step.toml"


def test_a_step_that_faces_away_is_said_to_float():
    """Its stated deviation is more than a fifth of it and covers the truth, and a tenth of the image is flagged.

    Row 5 of benchmarks/reconstruction.py at a quarter of its pixels: 93 +- 31 um. Catches error bars that take the
    gains for granted (+- 9), and a fit that finds gains of 1.2 instead of the step (-160 +- 150).
    """
    scene = load_scene(STEP, {"scan.nx": 61, "scan.ny": 15, "scan.pixel_size_um": 20.0})
    stack = pipeline.record(scene, pipeline.simulate(scene, seed=1))
    assert isinstance(stack, MicrographStack)
    rec = pipeline.reconstruct(stack, border="free", refine={"albedo_std": 0.05, "substrate_um": 6000.0})
    up = true_height(scene, rec).height > 50.0
    value, std = rec.spread(lambda h: float(np.median(h[up]) - np.median(h[~up])))
    assert std > 0.2 * abs(value) and abs(value - 100.0) < 3.0 * std, (value, std)
    assert np.mean(rec.reason == 5) > 0.1
