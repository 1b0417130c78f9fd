"""Tracing to a wanted error per pixel: what is reached, what each pixel is, and that stated errors are honest."""

import numpy as np
import pytest
from scale import SCENE, SMALL
from stats import assert_mean

from helio_jax.errors import SceneError
from helio_jax.scene.shapes import TrenchSample
from helio_jax.trace.converge import trace_to_target
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.transport import trace_block
from helio_jax.workflows.pipeline import simulate
from helio_jax.workflows.scene_file import load_scene

SETTINGS = TraceSettings(rays=16, branches=2, target_error=0.03, max_rays=1024, n_orders=2)


def slot():
    return TrenchSample(width_um=100.0, length_um=600.0, depth_um=150.0).build()


def test_every_pixel_is_a_plain_run_of_its_rays(bshem):
    """Each pixel has the bits that `rays` = its own number gives, in its place, and the books balance.

    Catches pixels put back in another order, a pilot that is mixed in, and random numbers that depend on the block.
    """
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-400, 400, 40), rng.uniform(-70, 70, 40)
    ids, body, about = np.arange(100, 140), slot(), SETTINGS.model_copy(update={"target_error": 0.15})
    found = trace_to_target(make_experiment(body, bshem, about), about, ids, x, y)
    assert found.n_unaccounted == 0 and set(found.n_rays) <= {16 << k for k in range(7)} and len(set(found.n_rays)) >= 4
    plain = {}
    for n in set(found.n_rays.tolist()):
        settings = SETTINGS.model_copy(update={"rays": n})
        plain[n] = trace_block(make_experiment(body, bshem, settings), ids, x, y).estimate()
    for i, n in enumerate(found.n_rays):
        for name in ("mean", "variance", "total_mean", "total_variance", "fates"):
            assert np.array_equal(getattr(found, name)[..., i], getattr(plain[n], name)[..., i]), name


def test_stated_errors_are_honest(bshem):
    """Against a long run, 10 places x 25 seeds: the mean of z is 0 and that of z^2 is 7/5, as Student's t of 7 says.

    250 values: a bias of 0.5 standard errors and errors stated 1.5 times too small are rejected. Catches an error that
    is the target or the pilot's, and counts of another number of rays. (Stopping on the estimate itself is biased in
    principle, in this slot by less than 0.5 %, which no test of this length would see.)
    """
    x, y = np.linspace(-250.0, 260.0, 10), np.linspace(-45.0, 40.0, 10)
    body, z = Intersector(slot()), []
    long = SETTINGS.model_copy(update={"rays": 4096, "branches": 4})
    truth, variance = trace_pixels(make_experiment(body, bshem, long), x, y).total()
    for seed in range(2, 27):
        settings = SETTINGS.model_copy(update={"seed": seed, "max_rays": 256})
        found = trace_to_target(make_experiment(body, bshem, settings), settings, np.arange(10), x, y)
        z.append((found.total_mean[0] - truth[0]) / np.sqrt(found.total_variance[0] + variance[0]))
    z = np.array(z)
    assert_mean(float(z.mean()), 0.0, np.sqrt(1.4 / z.size + 0.032 / 10), "mean of z")  # the long run is shared
    assert_mean(float((z**2).mean()), 1.4, np.sqrt((9.8 - 1.4**2) / z.size), "mean of z^2")


def test_target_is_reached_where_it_can_be(tmp_path):
    """Sphere A in 20 x 18 pixels to 2 %: nearly all pixels, with fewer rays than the hardest one needs everywhere.

    Catches an error relative to something else, a target that is missed by half of the pixels, and a cap not kept.
    """
    settings = {"trace.rays": 16, "trace.target_error": 0.02, "trace.max_rays": 512, "trace.maps": False}
    scene = load_scene(SCENE, SMALL | settings)
    stack = simulate(scene)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = (stack.std_error / stack.counts).max(0)
    n_above = int(np.sum(~(error <= 0.02)))
    assert stack.provenance["n_above_target"] == n_above and n_above < 0.15 * error.size
    assert 16 <= stack.provenance["rays_per_pixel"] < 200
    plain = simulate(load_scene(SCENE, SMALL | {"trace.rays": 16, "trace.maps": False}))
    assert np.sum((plain.std_error / np.maximum(plain.counts, 1e-9)).max(0) > 0.02) > 2 * n_above
    cut = simulate(load_scene(SCENE, SMALL | settings | {"trace.paths_per_unit": 10**9}))
    assert np.array_equal(cut.counts, stack.counts) and np.array_equal(cut.variance, stack.variance)


def test_as_good_as_counting(bshem):
    """Each order of each pixel as well known as 35 000 counted atoms tell, 10 places about a slot, over 20 seeds.

    The mean of variance / (counting variance) is below 1 in every place and order, where plain runs of the smallest
    number of rays miss it by far. Catches a target for the total alone, and one per ray instead of per atom.
    """
    x, y = np.linspace(-60.0, 60.0, 10), np.linspace(-45.0, 40.0, 10)
    about = {"rays": 8, "branches": 2, "n_orders": 2, "target_atoms": 35_000.0, "max_rays": 16_384}
    ratios = []
    for seed in range(20):
        settings = TraceSettings.model_validate(about | {"seed": seed})
        experiment = make_experiment(slot(), bshem, settings)
        found = trace_to_target(experiment, settings, np.arange(10), x, y)
        plain = trace_pixels(experiment, x, y)
        ratios.append([35_000.0 * e.variance / np.maximum(e.mean, 1e-5) for e in (found, plain)])
    reached, before = np.mean(ratios, axis=0)
    assert reached.max() < 1.0 and before.max() > 4.0, (reached.max(), before.max())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trace.estimator": "analog", "trace.target_error": 0.1}, "trace: target_error needs estimator = 'expected'"),
        ({"trace.target_error": 0.1, "trace.max_rays": 8}, "max_rays must be >= rays = 64, got 8"),
        ({"trace.target_error": 0.1, "trace.target_atoms": 9.0}, "remove one of them"),
        ({"trace.target_atoms": 9.0, "trace.max_rays": 8}, "max_rays must be >= rays = 64, got 8"),
        ({"trace.target_error": 0.0}, r"trace.target_error = 0.0: must be > 0"),
    ],
)
def test_impossible_targets_are_refused(changes, message):
    """Catches analog counts of another number of atoms in every pixel."""
    with pytest.raises(SceneError, match=message):
        load_scene(SCENE, changes)
