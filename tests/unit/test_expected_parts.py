"""Variance by scattering order and of the effusive beam, as simulated stacks hold them."""

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.workflows.scene_file import SceneFile

SEEDS = range(20)


@pytest.fixture(scope="module")
def scene() -> SceneFile:
    """A ball on a flat, five by five pixels about its foot, with an effusive beam."""
    values = {"scan.nx": 5, "scan.ny": 5, "scan.pixel_size_um": 200.0, "scan.center_um": [900.0, 0.0], "trace.rays": 16}
    effusive = {"beam.effusive": {"atoms_per_pixel": 1000.0}}
    return hx.load_scene("sphere_a", values | effusive)


def test_variances_are_those_of_other_seeds(scene):
    """Mean stated variance over that of 20 seeds, sum of 75 data of each order: within 25 % (3 standard deviations).

    Rejects the variance of one path (16 times), of the total for each order, and units of probabilities.
    """
    stacks = [hx.simulate(scene, seed=seed) for seed in SEEDS]
    for name, order in (("by_order", 1), ("by_order", 2), ("effuse", slice(None))):
        values = np.array([getattr(stack, name)[order] for stack in stacks])
        stated = np.array([getattr(stack, f"{name}_variance")[order] for stack in stacks])
        assert values.var(0, ddof=1).sum() / stated.mean(0).sum() == pytest.approx(1.0, abs=0.25), (name, order)


def test_analog_counts_have_their_poisson_variance(scene):
    stack = hx.simulate(scene, estimator="analog", rays=2000)
    np.testing.assert_array_equal(stack.by_order_variance, stack.by_order)
    np.testing.assert_array_equal(stack.effuse_variance, stack.effuse)


def test_they_are_kept(scene, tmp_path):
    """In a file, with noise (gain squared), turned. Catches a field that is left behind or not scaled."""
    stack = hx.simulate(scene)
    hx.write(stack, tmp_path / "s.h5")
    again = hx.read(tmp_path / "s.h5")
    for name in ("by_order_variance", "effuse_variance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(stack, name))
