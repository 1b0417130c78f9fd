"""From micrographs to heights: closed-form images first, then the reference program's (skipped without ../shared)."""

from pathlib import Path

import numpy as np
import pytest

from helio_jax.calibration.border import CalibrateSettings, calibrate_on_border
from helio_jax.errors import GuardError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import normal_of_slopes, slopes_of_normal
from helio_jax.inverse.convergence import status_of
from helio_jax.inverse.linear import solve_known_albedo, solve_linear
from helio_jax.inverse.state import multiple_in_normal
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.truth import true_height

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def bump_stack(instrument, amplitude=60.0, n=48):
    """Noise-free single-scattering images of a smooth bump at +x, +y, made without the tracer and the render model."""
    axis = (np.arange(n) - (n - 1) / 2) * 40.0
    gx, gy = np.meshgrid(axis, axis)
    height = amplitude * np.exp(-((gx - 200) ** 2 + (gy - 300) ** 2) / (2 * 250.0**2))
    a, b = -height * (gx - 200) / 250.0**2, -height * (gy - 300) / 250.0**2
    normal = np.stack(normal_of_slopes(a, b, instrument.beam_shift), -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    counts = 1e6 * np.einsum("kiyx,yxi->kyx", form_factor(Optics.of(instrument), height), normal)
    stack = MicrographStack(counts, axis, axis, instrument, variance=np.maximum(counts, 1.0), n_rays=1e6)
    return stack, height, normal


def test_slopes_and_normals_invert_each_other():
    """Round trip for several beam directions; catches a sign or the missing tan t term."""
    rng = np.random.default_rng(1)
    for shift in ((0.0, 0.0), (0.577, 0.0), (0.3, -0.4)):
        a, b = rng.uniform(-0.8, 0.8, (2, 500))
        normal = np.stack(normal_of_slopes(a, b, shift), -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        a2, b2, is_facing = slopes_of_normal(normal, shift)
        assert is_facing.all() and np.allclose(a, a2) and np.allclose(b, b2)


def test_surface_slope_law():
    """a = p / (1 + p tan t), b = q / (1 + p tan t) for a beam along +x (docs/conventions.md)."""
    p, q, t = 0.4, -0.3, np.tan(np.radians(30.0))
    a, b, _ = slopes_of_normal(np.array([-p, -q, 1.0]) / np.sqrt(1 + p * p + q * q), (t, 0.0))
    assert a == pytest.approx(p / (1 + p * t)) and b == pytest.approx(q / (1 + p * t))


def test_solve_linear_is_exact_and_marks_few_images(bshem):
    """Exact normals from exact data; pixels in 2 images get the flat normal and weight 0 (the paper's rule)."""
    stack, height, normal = bump_stack(bshem)
    signal = stack.counts / stack.n_rays
    signal[0, :5] = np.nan
    phi = form_factor(Optics.of(bshem), height)
    solved = solve_linear(signal, np.full(signal.shape, 1e-8), phi)
    assert np.allclose(solved.normals[5:], normal[5:], atol=1e-9)
    assert np.all(solved.normals[:5] == [0, 0, 1]) and np.all(solved.weight[:5] == 0)
    assert np.all(solved.n_images[:5] == 2)


@pytest.mark.parametrize(("method", "limit"), [("nearfield", 0.02), ("refine", 0.02)])
def test_smooth_bump(bshem, method, limit):
    """A bump of 60 um comes back at its place and height; catches mirrored axes, wrong slopes, a wrong level."""
    stack, height, _ = bump_stack(bshem)
    rec = pipeline.reconstruct(stack, method, refine={"max_rounds": 2})
    ours, true = (np.array(np.unravel_index(h.argmax(), h.shape)) for h in (rec.height, height))
    assert np.abs(ours - true).max() <= 1  # the top is flat: its neighbours are 0.1 um lower
    error = rec.height - height
    assert np.sqrt(np.mean((error - np.median(error)) ** 2)) <= limit * 60.0
    assert rec.is_valid.all()


def test_detectors_may_be_permuted(bshem):
    """Images and apertures permuted together give the same heights; catches an index that is not carried along."""
    stack, _, _ = bump_stack(bshem)
    order = [2, 0, 1]
    turned = bshem.model_copy(update={"detector": tuple(bshem.detector[k] for k in order)})
    other = stack.replace(counts=stack.counts[order], variance=stack.variance[order], instrument=turned)
    a, b = (pipeline.reconstruct(s, "nearfield").height for s in (stack, other))
    assert np.allclose(a, b, atol=1e-6)


def test_two_images_are_refused(bshem):
    """Two detectors cannot fix a height: a GuardError that says so, not a picture."""
    stack, _, _ = bump_stack(bshem)
    two = bshem.model_copy(update={"detector": bshem.detector[:2]})
    with pytest.raises(GuardError, match="3 or more images"):
        pipeline.reconstruct(MicrographStack(stack.counts[:2], stack.x, stack.y, two, n_rays=1e6), "nearfield")


@pytest.mark.parametrize("method", ["linear", "refine"])
def test_a_detector_that_counted_nothing_is_refused(bshem, method):
    """A channel that was off is no image of a dark surface: the error names it; catches heights from such data."""
    stack, _, _ = bump_stack(bshem)
    counts = stack.counts.copy()
    counts[1] = 0.0
    with pytest.raises(GuardError, match=f"detector {bshem.detector_names[1]!r} shows no signal"):
        pipeline.reconstruct(stack.replace(counts=counts, variance=np.ones_like(counts)), method)


def test_calibration_undoes_gain_background_and_drift(bshem):
    """Known gain and drift are found from the border; the background from a masked spot with no multiple scattering."""
    stack, _, _ = bump_stack(bshem, amplitude=1e-6)
    flat = stack.counts[:, 0, 0] / 1e6
    gain = np.array([2e5, 1e5, 3e5])[:, None, None]
    drift = 40.0 * np.linspace(-1, 1, 48)[None, :, None] ** 3
    counts = gain * stack.counts / 1e6 + 5000.0
    counts[:, 20:23, 20:23] = 5000.0
    raw = stack.replace(counts=counts + drift, variance=None, n_rays=None, noise="measured")
    settings = CalibrateSettings(masked_share=0.0, dark_quantile=0.001)
    done = calibrate_on_border(raw, flat, settings)
    record = done.provenance["calibrate"]
    assert record["background"] == pytest.approx([5000.0] * 3, abs=15)
    assert record["gain"] == pytest.approx(gain.ravel(), rel=0.02)


@pytest.mark.slow
def test_reference_sphere_by_rounds_of_physics(shared):
    """Binned 3 x 3 reference counts: linear 82-88 %, near field below 6 % RMS, the fit below 2.5 %, height to 2.5 %.

    Rejects a height taken at the raster position instead of the beam frame and a lost near field.
    """
    from helio_jax.formats.matlab import import_micrographs

    scene = load_scene(SCENES / "sphere_a_full.toml")
    full = import_micrographs(shared / "data" / "sphere_a_simulated.mat", scene.instrument)
    counts = full.counts[:, :351, :303].reshape(3, 117, 3, 101, 3).mean((2, 4))
    x, y = full.x[:303].reshape(-1, 3).mean(1), full.y.reshape(-1, 3).mean(1)
    variance = np.maximum(counts, 1.0) / 9
    stack = MicrographStack(counts, x, y, full.instrument, variance=variance, n_rays=full.n_rays)
    score = {}
    for method, integrator in (("linear", "dct_poisson"), ("nearfield", "weighted"), ("refine", "weighted")):
        rec = pipeline.reconstruct(stack, method, integrator=integrator)
        score[method] = pipeline.evaluate(rec, true_height(scene, rec))
    assert 0.82 <= score["linear"].recovered_height <= 0.88
    assert score["nearfield"].rms_region <= 0.06 and 0.90 <= score["nearfield"].recovered_height <= 1.03
    assert score["refine"].rms_region <= 0.025 and abs(score["refine"].recovered_height - 1) <= 0.025


def test_known_albedo_solution_is_exact_even_with_two_images(bshem):
    """Two unknown slopes per pixel: exact from exact data, also where one of three images is missing."""
    stack, height, normal = bump_stack(bshem)
    signal = stack.counts / stack.n_rays
    signal[0, :10] = np.nan
    flat = np.broadcast_to([0.0, 0.0, 1.0], normal.shape)
    phi = form_factor(Optics.of(bshem), height)
    slopes, covariance = solve_known_albedo(signal, np.full(signal.shape, 1e-14), phi, flat, bshem.beam_shift)
    a, b, _ = slopes_of_normal(normal, bshem.beam_shift)
    assert np.allclose(slopes, [a, b], atol=1e-4)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_multiple_scattering_about_a_normal_changes_nothing_there(bshem):
    """The linear model of the own normal is exact at that normal and darkens a facet that turns towards level."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4, 5, 3)) + [0, 0, 2]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    multiple = rng.uniform(0, 1, (3, 4, 5))
    was = Corrections(rng.normal(size=(3, 3, 4, 5)), multiple)
    slope, intercept = multiple_in_normal(was, normals, Optics.of(bshem))
    assert np.allclose(intercept - slope * normals[..., 2], multiple)
    is_steep = normals[..., 2] < 0.9
    assert np.all((intercept - slope < multiple)[:, is_steep])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ([100.0, 20.0, 1.5], "converged"),
        ([100.0, 20.0, 5.0], "stopped"),
        ([100.0, 20.0, 5.0, 2.1, 3.0], "stopped"),
        ([100.0, 20.0, 60.0], "diverging"),
        ([20.0, 40.0], "diverging"),
        ([0.0, 40.0], "diverging"),
        ([40.0], "stopped"),
    ],
)
def test_status_names_how_a_fit_ended(changes, named):
    """Tolerance 2 um. Catches a jitter of 2 and 3 um called divergence, growth called "stopped", a division by zero."""
    assert status_of(changes, 2.0).startswith(named)
    assert status_of(changes, 2.0, is_interrupted=True).startswith("interrupted")


def test_interrupted_fit_keeps_the_best_so_far(bshem):
    """Ctrl-C in a later round returns what was reached, and says so; in the first round there is nothing to keep."""
    stack, height, _ = bump_stack(bshem)
    for stop_at in (1, 0):

        def report(number, rounds, said, stop_at=stop_at):
            if number == stop_at:
                raise KeyboardInterrupt

        refine = {"max_rounds": 3, "tolerance_um": 1e-6, "samples": 0}
        if stop_at == 0:
            with pytest.raises(KeyboardInterrupt):
                pipeline.reconstruct(stack, "refine", report=report, refine=refine)
            continue
        rec = pipeline.reconstruct(stack, "refine", report=report, refine=refine)
        assert rec.status.startswith("interrupted")
        assert rec.height.max() == pytest.approx(height.max(), rel=0.1)
