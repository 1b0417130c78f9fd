"""Noise of the slopes beside a steep sphere does not raise it."""

from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.workflows.pipeline import record
from helio_jax.workflows.truth import true_height

H = 1040.0
"""Height of sphere B, um."""
SCENES = Path(__file__).resolve().parents[2] / "scenes"


@pytest.mark.slow
def test_noise_beside_a_sphere_does_not_raise_it():
    """Sphere B, 91 x 91, SNR 19, gains unknown: valid heights of its upper half are not 1 % too high, nor 2 % too low.

    0.6 % too low with this seed; the apex at 121 x 121 varies by 0.3 % between seeds: a false alarm is 4 standard
    deviations off. Noise tilts the facets beside the sphere. Where their multiple scattering answered to that more
    strongly than their view of level surroundings allows, gains came out 2 % too low and the sphere 1.6 % too high.
    """
    size = {"scan.nx": 91, "scan.ny": 91, "scan.pixel_size_um": 32.0}
    scene = hx.load_scene(SCENES / "sphere_b.toml", size)
    stack = record(scene, hx.simulate(scene, seed=2))
    settings = scene.reconstruct
    quick = settings.refine.changed(objects=False, albedo_patches=False, samples=8)
    rec = hx.reconstruct(stack, settings=settings.changed(refine=quick))
    truth = true_height(scene, rec).height
    is_known = rec.is_valid & (truth > 0.5 * H)
    assert is_known.sum() > 1500
    scale = np.sum((rec.height * truth)[is_known]) / np.sum(truth[is_known] ** 2)
    assert -0.02 < scale - 1.0 < 0.01, scale
