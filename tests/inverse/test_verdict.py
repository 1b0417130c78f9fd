"""The verdict of the data on a finished height map: contradicted where it is wrong, and not where it is right."""

from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.inverse.quality import contradicted_regions
from helio_jax.inverse.verdict import local_chi_square
from helio_jax.validity import CHI_SQUARE_LIMIT as LIMIT
from helio_jax.validity import REASONS, contradicted_share
from helio_jax.workflows import pipeline

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SPHERE = {"scan.nx": 31, "scan.ny": 31, "scan.pixel_size_um": 90.0, "noise.seed": 3}
PIT = {"scan.nx": 61, "scan.ny": 31, "scan.pixel_size_um": 16.0, "scan.atoms_per_pixel": 300_000}
PIT |= {"sample.depth_um": 80.0, "sample.width_um": 200.0, "sample.length_um": 500.0}
CONTRADICTED = REASONS.index("contradicts the data")


def test_noise_contradicts_nothing():
    """False alarms: of 600 000 pixels of noise 12 are expected above the limit, at most 40 may be.

    Rejects a limit of 2.1, which noise exceeds twenty times as often.
    """
    rng, shape = np.random.default_rng(5), (3, 300, 200)
    n_above = [
        int(np.sum(local_chi_square(rng.standard_normal(shape), np.ones(shape, bool)) > limit))
        for limit in (LIMIT, 2.1)
        for _ in range(10)
    ]
    assert sum(n_above[:10]) <= 40 < sum(n_above[10:])


def test_a_region_is_contradicted_as_a_whole():
    """12 x 12 pixels parted from the rest, whose core is the inner 8 x 8: 6 of 64 pixels are 9 %, 7 are 11 %.

    Rejects regions whose outline is contradicted, where a wall stands half a pixel off, and the largest region.
    """
    region = np.zeros((30, 30), int)
    region[5:17, 5:17] = 1
    core = region.copy() > 0
    core[[5, 6, 15, 16]] = core[:, [5, 6, 15, 16]] = False
    for n_wrong, is_wrong in ((6, False), (7, True)):
        wrong = np.zeros(region.shape, bool)
        wrong[tuple(np.argwhere(core)[:n_wrong].T)] = True
        assert np.array_equal(contradicted_regions(wrong, region), (region == 1) & is_wrong)
    outline = (region == 1) & ~core
    assert not contradicted_regions(outline | (region == 0), region).any()


def test_single_wild_data_are_no_contradiction():
    """A spike in one datum says nothing of the surface; the same misfit of three neighbours in one detector does."""
    residuals = np.zeros((3, 9, 9))
    residuals[0, 4, 4] = 1000.0
    assert not (local_chi_square(residuals, np.ones(residuals.shape, bool)) > LIMIT).any()
    residuals[0, 4, 3:6] = 1000.0
    assert (local_chi_square(residuals, np.ones(residuals.shape, bool)) > LIMIT).any()


@pytest.fixture(scope="module")
def sphere() -> tuple:
    scene = hx.load_scene(SCENES / "sphere_a.toml", SPHERE)
    return scene, pipeline.record(scene, hx.simulate(scene))


@pytest.mark.slow
def test_a_right_map_is_not_contradicted(sphere):
    """Sphere A by refine: under 5 % of the pixels, and the status says nothing of it.

    Nearfield, 8 % too low at the rim, is contradicted there and not elsewhere.
    """
    scene, stack = sphere
    rec = pipeline.reconstruct(stack, "refine", settings=scene.reconstruct)
    assert not rec.is_contradicted and "contradicts" not in rec.status
    near = pipeline.reconstruct(stack, "nearfield", settings=scene.reconstruct)
    radius = np.hypot(*np.meshgrid(near.raster_x, near.raster_y))
    is_told = near.reason == CONTRADICTED
    assert near.is_contradicted and is_told[radius < 700.0].mean() < 0.1
    assert rec.chi_square is not None and np.median(rec.chi_square) < 1.3


@pytest.mark.slow
def test_a_wrong_instrument_is_contradicted(sphere, tmp_path):
    """Two channels swapped, nothing else: told in status and reasons, after a file as well."""
    scene, stack = sphere
    swapped = stack.replace(counts=stack.counts[[1, 0, 2]], variance=stack.variance[[1, 0, 2]])
    rec = pipeline.reconstruct(swapped, "nearfield", settings=scene.reconstruct)
    hx.write(rec, tmp_path / "rec.h5")
    again = hx.read(tmp_path / "rec.h5")
    for found in (rec, again):
        assert found.is_contradicted and "contradicts the data" in found.status
        assert contradicted_share(found.reason) > 0.2
    np.testing.assert_array_equal(again.reason == CONTRADICTED, rec.reason == CONTRADICTED)


@pytest.mark.slow
def test_walls_that_linear_smears_are_contradicted():
    """A pit with vertical walls becomes a hollow, as deep as it should be: only the substrate beyond it is valid."""
    scene = hx.load_scene(SCENES / "trench.toml", PIT)
    stack = pipeline.record(scene, hx.simulate(scene))
    rec = pipeline.reconstruct(stack, "linear", settings=scene.reconstruct)
    is_told = rec.reason == CONTRADICTED
    assert is_told[8:23, 12:50].mean() > 0.6 and is_told[:3].mean() < 0.02 and is_told[-3:].mean() < 0.02
