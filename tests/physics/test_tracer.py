"""The tracer: closed forms, book-keeping, two estimators and two ray engines against each other."""

from dataclasses import replace

import numpy as np
import pytest
from stats import assert_likely, assert_mean, smallest_tail

from helio_jax.errors import GuardError
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.scattering import COSINE_LAW
from helio_jax.scene.shapes import Sphere, SpheresSample, TrenchSample
from helio_jax.scene.surfaces import Body, flat_body
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.random import philox
from helio_jax.trace.run import first_hits, make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import DETECTED, ESCAPED, STOPPED


def sphere_a() -> Body:
    return SpheresSample(spheres=(Sphere(radius_um=1000.0, cap_height_um=720.0),), size_um=8000.0).build()


def grid(n: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    axis = np.linspace(-reach, reach, n)
    x, y = np.meshgrid(axis, axis)
    return x.ravel(), y.ravel()


def test_philox_is_numpys():
    """Word for word NumPy's Philox 4x64-10 (which counts up before its first block); catches a wrong round."""
    generator = np.random.Generator(np.random.Philox(counter=[5, 6, 7, 8], key=[11, 12]))
    u = np.uint64
    assert np.array_equal(generator.random(4), philox(u(11), u(12), u(6), u(6), u(7), u(8)))


def test_same_result_for_any_number_of_workers(bshem):
    """Bitwise equal for 1, 2, 3 threads; catches random numbers or sums that depend on the schedule."""
    x, y = grid(40, 1500.0)
    experiment = make_experiment(sphere_a(), bshem, TraceSettings(rays=64))
    runs = [trace_pixels(experiment, x, y, workers=n) for n in (1, 2, 3)]
    for other in runs[1:]:
        assert np.array_equal(runs[0].mean, other.mean) and np.array_equal(runs[0].fates, other.fates)
        assert np.array_equal(runs[0].hits, other.hits)


def test_every_ray_is_accounted_for(bshem):
    """Launched = detected + escaped + stopped + lost in exact integers, and hits are the detected ones."""
    x, y = grid(20, 1500.0)
    for estimator in ("analog", "expected"):
        settings = TraceSettings(rays=400, estimator=estimator, max_events=2)
        tally = trace_pixels(make_experiment(sphere_a(), bshem, settings), x, y)
        assert tally.n_unaccounted == 0
        assert np.array_equal(tally.hits.sum((0, 1)), tally.fates[DETECTED])
        assert tally.fates[2].sum() > 0  # the cap of 2 events does stop some


@pytest.mark.parametrize(("estimator", "branches"), [("analog", 1), ("expected", 4), ("expected", 64)])
def test_one_kernel_gives_the_bits_of_separate_steps(bshem, monkeypatch, estimator, branches):
    """Sphere A, fast inner loop against the general one: equal to the last bit; catches a wrong number, order, skip.

    With 64 branches the first flight must be done in steps: the atoms that fly on tell what is hidden.
    """
    x, y = grid(9, 1200.0)
    settings = TraceSettings(rays=16, branches=branches, estimator=estimator)
    fast = trace_pixels(make_experiment(sphere_a(), bshem, settings), x, y)
    monkeypatch.setattr(Experiment, "can_fuse", lambda *_: False)
    slow = trace_pixels(make_experiment(sphere_a(), bshem, settings), x, y)
    for name in ("mean", "variance", "hits", "fates"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name)), name
    assert fast.mean[1:].max() > 0


def two_albedos() -> Body:
    """Spheres of two materials on a sheet whose triangles are of either."""
    spheres = Sphere(radius_um=1000.0, cap_height_um=720.0), Sphere(radius_um=500.0, center_um=(1200.0, 0.0))
    body = SpheresSample(spheres=spheres, size_um=8000.0).build()
    of_faces, of_spheres = (np.arange(len(of)) % 2 for of in (body.faces, body.spheres))
    return replace(body, materials=("dark", "darker"), face_material=of_faces, sphere_material=of_spheres)


@pytest.mark.parametrize(("estimator", "branches"), [("analog", 1), ("expected", 4), ("expected", 64)])
def test_one_kernel_adsorbs_the_same_atoms(bshem, monkeypatch, estimator, branches):
    """Surfaces of albedo 0.9 and 0.4: to the last bit as by separate steps; catches a number drawn for another event.

    Adsorbed atoms count as stopped, and scatter towards the detectors before.
    """
    x, y = grid(9, 1200.0)
    settings = TraceSettings(rays=16, branches=branches, estimator=estimator)
    laws = {"dark": (replace(COSINE_LAW[0], share=0.9),), "darker": (replace(COSINE_LAW[0], share=0.4),)}
    experiment = make_experiment(two_albedos(), bshem, settings, laws)
    assert experiment.can_fuse(1)
    fast = trace_pixels(experiment, x, y)
    monkeypatch.setattr(Experiment, "can_fuse", lambda *_: False)
    slow = trace_pixels(experiment, x, y)
    for name in ("mean", "variance", "hits", "fates"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name)), name
    assert fast.mean[1:].max() > 0 and fast.fates[STOPPED].sum() > 0.1 * fast.fates.sum()


def test_flat_white_furnace():
    """An aperture that fills the sky to 1e-6 catches every atom of a flat: 1 - O(1e-6); catches a lost 1/pi or cos."""
    wide = Detector(name="all", center_um=(0.0, 0.0), axes_um=(8e6, 8e6))
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(wide,))
    settings = TraceSettings(rays=20_000, estimator="analog", maps=False)
    tally = trace_pixels(make_experiment(flat_body(2000.0), instrument, settings), np.zeros(2), np.zeros(2))
    assert tally.fates[DETECTED].sum() + tally.fates[ESCAPED].sum() == 40_000
    assert tally.fates[ESCAPED].sum() <= 3  # expected 40 000 x (4000 / 4e6)^2 = 0.04
    expected = trace_pixels(make_experiment(flat_body(2000.0), instrument, TraceSettings(rays=64)), *np.zeros((2, 2)))
    assert expected.total()[0] == pytest.approx(1.0, abs=1e-5)


def test_trench_floor_sees_the_opening():
    """Floor centre of a long slot sees the opening with 1/sqrt(1 + (2 d/w)^2); rejects a 1 % error of masking."""
    width, depth = 400.0, 300.0
    trench = TrenchSample(width_um=width, length_um=60_000.0, depth_um=depth, size_um=80_000.0).build()
    wide = Detector(name="all", center_um=(0.0, 0.0), axes_um=(8e6, 8e6))
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(wide,))
    n = 400_000
    settings = TraceSettings(rays=n, estimator="analog")
    tally = trace_pixels(make_experiment(trench, instrument, settings), np.zeros(1), np.zeros(1))
    exact = 1.0 / np.sqrt(1.0 + (2 * depth / width) ** 2)
    std = np.sqrt(exact * (1 - exact) / n)
    assert_mean(tally.hits[0, 0, 0] / n, exact, std, "single scattering from a trench floor")
    assert 0.01 * exact / std > 6  # the error that this rejects
    assert tally.hits.sum() == pytest.approx(n, abs=30)  # in the end every atom leaves through the sky


def test_step_mask_length():
    """A step of height d facing the detector's far side masks d tan t_d of the lower side (normal incidence)."""
    from helio_jax.scene.shapes import StepSample

    body = StepSample(height_um=200.0).build()
    top_side = np.sign(np.mean(body.vertices[body.vertices[:, 2] > 100.0][:, 0]))
    narrow = Detector(name="n", polar_deg=45.0, azimuth_deg=0.0 if top_side > 0 else 180.0, half_angle_deg=0.2)
    beam = Beam(source="pencil", pinhole_radius_um=0.0)
    instrument = Instrument(beam=beam, plate=Plate(working_distance_um=4000.0), detector=(narrow,))
    distance = np.array([100.0, 190.0, 210.0, 300.0])  # from the step, on the lower side
    x = -top_side * distance
    tally = trace_pixels(make_experiment(body, instrument, TraceSettings(rays=64)), x, np.zeros(4))
    single = tally.probability()[0][0, 0]
    # the plate is 4 mm away, so the direction to the aperture changes by < 3 deg over the line
    assert np.all(single[:2] < 1e-9) and np.all(single[2:] > 1e-6)


def test_analog_against_expected(bshem):
    """Exact Poisson tails over all pixels and detectors (Sidak); rejects a 2 % bias of either estimator."""
    x, y = grid(25, 1400.0)
    expected = trace_pixels(make_experiment(sphere_a(), bshem, TraceSettings(rays=1024, branches=16)), x, y)
    settings = TraceSettings(rays=40_000, estimator="analog", seed=5)
    analog = trace_pixels(make_experiment(sphere_a(), bshem, settings), x, y)
    hits = analog.hits.sum(0)
    mean, variance = expected.total()
    # where our own variance is not negligible, the Poisson tail must be asked at the far end of our error
    n = 40_000 * mean
    slack = 4 * 40_000 * np.sqrt(variance)
    nearest = np.clip(hits, n - slack, n + slack)
    assert_likely(smallest_tail(hits, nearest), "analog counts against the expected estimator")
    z = (hits.sum(1) - n.sum(1)) / np.sqrt(n.sum(1))
    assert np.all(np.abs(z) < 6)
    wrong = (hits.sum(1) - 1.02 * n.sum(1)) / np.sqrt(n.sum(1))
    assert np.all(np.abs(wrong) > 6)


def test_error_bars_are_honest(bshem):
    """Variance over 40 seeds against the stated one: ratio 1 within 25 %; catches treating QMC points as random."""
    x, y = np.array([-1200.0, 700.0, 900.0]), np.array([0.0, 300.0, -500.0])
    runs = [
        trace_pixels(make_experiment(sphere_a(), bshem, TraceSettings(rays=128, seed=s)), x, y).total()
        for s in range(40)
    ]
    spread = np.var([mean for mean, _ in runs], axis=0, ddof=1).sum(0)
    stated = np.mean([variance for _, variance in runs], axis=0).sum(0)
    assert np.all(np.abs(spread / stated - 1) < 0.6)
    assert abs(np.mean(spread / stated) - 1) < 0.35


def test_embree_against_every_triangle():
    """Embree and the exhaustive float64 engine agree on random rays, edges aside; catches wrapper and index errors."""
    rng = np.random.default_rng(2)
    vertices = rng.normal(size=(300, 3)) * 500
    body = Body(vertices, rng.integers(0, 300, (200, 3)), np.array([[0.0, 0.0, 0.0, 200.0]]))
    origin = rng.normal(size=(4000, 3)) * 2000
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    none = np.full(4000, -1, np.int32)
    a, b = (Intersector(body, engine).nearest(origin, direction, none) for engine in ("embree", "exhaustive"))
    differ = a.surface != b.surface
    assert differ.mean() < 1e-3
    same = ~differ & (a.surface != -1)
    assert same.sum() > 200
    assert np.abs(a.point[same] - b.point[same]).max() < 0.05


def test_exact_sphere_against_closed_form(bshem):
    """First hits of the beam axis on sphere A equal the closed form to 1e-6 um; catches a tessellated sphere."""
    from helio_jax.scene.surfaces import first_hit_spheres

    x, y = grid(61, 1600.0)
    hits = first_hits(Intersector(sphere_a()), bshem, x, y)
    height, normal = first_hit_spheres(x, y, np.array([[0.0, 0.0, -280.0, 1000.0]]), bshem.beam_shift)
    away = np.abs(height - hits.point[:, 2]) < 1.0  # a float32 plane may win at the rim itself
    assert away.mean() > 0.999
    assert np.abs(height - hits.point[:, 2])[away].max() < 1e-3
    assert np.abs(normal - hits.normal)[away & (height > 0)].max() < 1e-6


def test_inverted_mesh_is_refused(bshem):
    """A flat with its normals down loses every ray: GuardError, not dark images."""
    flat = flat_body(8000.0)
    turned = Body(flat.vertices, flat.faces[:, ::-1], flat.spheres)
    with pytest.raises(GuardError, match="from behind"):
        trace_pixels(make_experiment(turned, bshem, TraceSettings(rays=8)), np.zeros(2), np.zeros(2))


@pytest.mark.parametrize(("source", "second_moment"), [("uniform", 0.5), ("gaussian", 2.0)])
def test_source_second_moment(source, second_moment):
    """<theta^2> is theta_max^2/2 (uniform) and 2 sigma^2 (Gaussian); rejects sqrt and sigma mix-ups by many s.d."""
    from helio_jax.trace.source import Sampling, beam_numbers, launch_rays

    beam = Beam(incidence_deg=20.0, pinhole_radius_um=0.0, source=source, source_size_mrad=10.0)
    detector = Detector(name="d", polar_deg=45.0, half_angle_deg=5.0)
    instrument = Instrument(beam=beam, plate=Plate(working_distance_um=4000.0), detector=(detector,))
    s = Sampling.make(200_000, 1, 0, 3)
    numbers = beam_numbers(np.zeros(1, np.int64), s.n_rays, 0, s.points, s.seed)
    _, direction = launch_rays(instrument, np.zeros(1), np.zeros(1), numbers)
    squares = 2 * (1 - direction @ instrument.beam_direction) / 0.01**2
    assert_mean(squares.mean(), second_moment, squares.std() / np.sqrt(squares.size), f"{source} source")
