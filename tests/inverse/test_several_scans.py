"""One surface from several scans: geometry in closed form, then heights of traced scans at 45 degrees."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.alignment.correction import correct_motions
from helio_jax.alignment.resample import is_lit, joined_instrument, resample
from helio_jax.alignment.rigid import Rigid
from helio_jax.campaign import CampaignLaw
from helio_jax.errors import GuardError, InputFileError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.laws import PowerLaw, level_ratio
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import Corrections
from helio_jax.instrument import Instrument
from helio_jax.inverse.law_prior import with_level_of_law
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.micrograph import Calibration, MicrographSet, MicrographStack
from helio_jax.workflows import several_scans
from helio_jax.workflows.corrections import _joined
from helio_jax.workflows.scene_file import load_instrument, load_scene
from helio_jax.workflows.truth import true_surface

TURNS_DEG = 0.0, 72.0, 144.0, 216.0, 288.0


def make_scan(instrument: Instrument, turn_deg: float, counts=None, n: int = 21, step: float = 20.0) -> MicrographStack:
    axis = step * (np.arange(n) - 0.5 * (n - 1))
    counts = np.ones((len(instrument.detector), n, n)) if counts is None else counts
    return MicrographStack(
        counts, axis, axis, instrument, n_rays=1.0, sample_rotation=math.radians(turn_deg), name=f"at {turn_deg:g}"
    )


def rotated(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Rotate x, y of vectors [detector, 3, ...] counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1], vectors[:, 2]], 1)


@pytest.mark.parametrize("drop", [0.0, 150.0])
def test_joined_instrument_sees_each_point_as_its_own_scan_does(drop):
    """The form factors of joined scans are those of the scans, turned back, at every height.

    Catches: a rotation of the wrong sense, the beam's azimuth left in the scan's frame, the spot of the wrong beam.
    """
    one = load_instrument("bshem_wd4")
    one = one.at_distance(one.working_distance + drop)
    scans = tuple(make_scan(one, turn) for turn in (0.0, 50.0))
    motions = tuple(Rigid(s.sample_rotation, (0.0, 0.0)) for s in scans)
    joined, height = joined_instrument(scans, motions), np.array([-30.0, 0.0, 200.0])
    found = form_factor(hx.Optics.of(joined), height)
    own = form_factor(hx.Optics.of(one), height)
    turned = rotated(own, -math.radians(50.0))
    np.testing.assert_allclose(found, np.concatenate([own, turned]), rtol=1e-9, atol=1e-12)
    assert joined.beam_shift == (0.0, 0.0) and joined.has_several_beams
    parts = joined.by_beam()
    assert [of_beam for _, of_beam in parts] == [(0, 1, 2), (3, 4, 5)]
    assert parts[0][0].beam.incidence_deg == one.beam.incidence_deg and not parts[0][0].has_several_beams


def test_optics_of_several_beams_move_and_refuse_one_raster_frame():
    """Turning the beam turns that of every scan; the raster's own view stays. Catches a beam that is left behind."""
    one = load_instrument("ashem_45")
    scans = tuple(make_scan(one, turn) for turn in (0.0, 90.0))
    optics = hx.Optics.of(joined_instrument(scans, several_scans.stage_motions(MicrographSet(scans))))
    moved = optics.moved(incidence=math.radians(5.0))
    np.testing.assert_allclose(np.hypot(*np.asarray(moved.beam_shifts).T), math.tan(math.radians(50.0)))
    np.testing.assert_allclose(moved.beam_shift, 0.0)


def test_a_beam_that_sees_all_has_no_hidden_side():
    """Corrections of three detectors in two beams: detectors in order, 0 where the second beam hides nothing."""
    image = np.arange(1.0, 4.0)[:, None, None] * np.ones((3, 2, 2))
    form = image[:, None] * np.ones((3, 3, 2, 2))
    normals = np.zeros((2, 2, 3))
    oblique = Corrections(form[:2], image[:2], 5.0 * image[:2], normals)
    steep = Corrections(form[2:], image[2:], None, normals)
    found = _joined([oblique, steep], [[0, 2], [1]])
    np.testing.assert_array_equal(found.multiple[:, 0, 0], [1.0, 3.0, 2.0])
    np.testing.assert_array_equal(found.occluded[:, 0, 0], [5.0, 0.0, 10.0])
    assert found.surroundings is None


def test_shadow_has_the_length_of_geometry():
    """Behind a block of height h a beam at incidence t leaves h tan t unlit, on the far side only."""
    x = 10.0 * np.arange(60)
    height = np.zeros((20, 60))
    height[:, 20:30] = 80.0
    lit = is_lit(height, x, x[:20], np.array([math.tan(math.radians(45.0)), 0.0]))
    shadow = np.flatnonzero(~lit[10])
    assert shadow.min() == 29 and abs(shadow.max() - 37) <= 1  # the pixel beside counts as shadowed, too
    assert is_lit(height, x, x[:20], np.zeros(2)).all()


def test_images_are_read_where_each_beam_meets_the_surface():
    """A scan whose image is its beam position's x gives x + h tan t, and 0.5 / um for a slope of 0.5 per um of place.

    Catches: parallax of the wrong sign, in the wrong frame, or per pixel instead of per um.
    """
    one = load_instrument("ashem_45")
    x = 20.0 * (np.arange(41) - 20)
    image = np.broadcast_to(0.5 * x + 1000.0, (1, 41, 41))
    scans = MicrographSet((make_scan(one, 0.0, image, 41), make_scan(one, 180.0, image, 41)))
    height = np.full((41, 41), 40.0)
    joined = resample(scans, several_scans.stage_motions(scans), "reference", height=height)
    middle = joined.counts[:, 20, 10:30] - 1000.0
    np.testing.assert_allclose(middle[0], 0.5 * (x[10:30] + 40.0), atol=1e-6)
    np.testing.assert_allclose(middle[1], 0.5 * (-x[10:30] + 40.0), atol=1e-6)
    np.testing.assert_allclose(joined.parallax[:, 20, 10:30], 0.5, rtol=1e-4)


def images_of_hills(n: int, errors: tuple[Rigid, ...], noise: float, rng: np.random.Generator):
    """Return images of a hilly surface from directions turned about z, each displaced by the error of a motion.

    Images [image, y, x], their variance, form factors, and the raster.
    """
    x = 10.0 * (np.arange(n) - 0.5 * (n - 1))
    waves = [(rng.normal(0, 0.03, 2), rng.uniform(0, 6)) for _ in range(8)]
    points = np.stack(np.meshgrid(x, x), -1)

    def image(direction: np.ndarray, at: np.ndarray) -> np.ndarray:
        slopes = sum(0.08 * np.cos(at @ k + phase)[..., None] * k / np.hypot(*k) for k, phase in waves)
        normal = np.concatenate([-slopes, np.ones((*at.shape[:2], 1))], -1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True) @ direction

    turns = np.radians(TURNS_DEG)
    form = np.stack([np.cos(turns), np.sin(turns), np.full(5, 1.2)], -1)
    images = np.stack([image(f, e.inverse().apply(points)) for f, e in zip(form, errors, strict=True)])
    images = images + noise * rng.standard_normal(images.shape)
    return images, np.full(images.shape, noise**2), np.broadcast_to(form[..., None, None], (5, 3, n, n)), x


NONE = Rigid(0.0, (0.0, 0.0))


def corrected(errors: tuple[Rigid, ...], noise: float, seed: int, n: int = 60):
    """Correct scans eight times; return the errors that are left, and the last correction."""
    stage = errors
    for _ in range(8):
        images, variance, form, x = images_of_hills(n, errors, noise, np.random.default_rng(seed))
        images[1] *= 1.1
        known = np.ones(images.shape, bool)
        stated = tuple(e.after(s.inverse()) for s, e in zip(stage, errors, strict=True))
        found = correct_motions(images, variance, form, known, np.arange(5), x, x, 1.0, stated)
        errors = tuple(c.inverse().after(e) for c, e in zip(found.motions, errors, strict=True))
    return errors, found


def test_corrections_find_rigid_motions():
    """Rotations of 0.2 deg and shifts up to half a pixel are found to 0.05 deg and a tenth of a pixel; a gain is free.

    Catches: a correction of the wrong sense or frame, one scan's error laid on the others.
    """
    rng = np.random.default_rng(3)
    errors = (NONE, *(Rigid(math.radians(rng.normal(0, 0.2)), tuple(rng.uniform(-5.0, 5.0, 2))) for _ in range(4)))
    left, found = corrected(errors, 0.01, 3)
    assert max(found.std) < 1.0
    for error in left:
        assert abs(error.rotation_deg) < 0.05 and np.hypot(*error.shift) < 1.0


def test_errors_of_corrections_hold_in_noise():
    """Noise as large as the structure, eight draws: mean square of shift over stated deviation 0.4 to 1.6.

    For 64 normal numbers, half of them independent, the bounds have a false-alarm rate of 2 %. Rejects errors that
    count the gradients' noise as structure (2.5), and pixels of any albedo (1.8), where some motions of all scans
    together look like another surface.
    """
    squares = []
    for seed in range(8):
        left, found = corrected((NONE,) * 5, 0.1, seed, 40)
        squares += [(np.hypot(*e.shift) / std) ** 2 / 2 for e, std in zip(left[1:], found.std[1:], strict=True)]
    assert 0.4 < np.mean(squares) < 1.6


def test_images_that_tell_nothing_leave_motions_as_stated():
    """Structure far below the noise: corrections lead to where the stage states the scans, to a tenth of a pixel."""
    rng = np.random.default_rng(4)
    images, variance, form, x = images_of_hills(40, (NONE,) * 5, 1e-4, rng)
    images = 1.0 + 1e-5 * (images - images.mean()) + 1e-2 * rng.standard_normal(images.shape)
    stated = (NONE, *(Rigid(0.0, (12.0, -7.0)) for _ in range(4)))
    known = np.ones(images.shape, bool)
    found = correct_motions(images, variance + 1e-4, form, known, np.arange(5), x, x, 1.0, stated)
    for motion in found.motions[1:]:
        np.testing.assert_allclose(motion.shift, (12.0, -7.0), atol=1.0)


def test_correction_without_structure_is_refused():
    """Images of a level surface tell no motion: our error, not that of a singular matrix."""
    images, variance, form, x = images_of_hills(20, (NONE,) * 5, 0.0, np.random.default_rng(1))
    for known in (images > 0.0, images < 0.0):
        with pytest.raises(GuardError, match=r"no motion can be fitted: .* take the stage's motions"):
            level = np.ones_like(images)
            correct_motions(level, variance, form, known, np.arange(5), x, x, 1.0, (NONE,) * 5)


@pytest.fixture(scope="module")
def crystal(tmp_path_factory) -> tuple[MicrographSet, np.ndarray]:
    """Five scans of a low pyramid by one detector at 45 degrees, and its true heights seen straight down."""
    path = Path(tmp_path_factory.mktemp("crystal")) / "crystal.toml"
    path.write_text(
        'extends = "ashem_45"\nname = "crystal"\n[plate]\nsample_distance_um = 2200.0\n'
        '[sample]\nkind = "pyramid"\nbase_um = 700.0\ntop_um = 300.0\nheight_um = 100.0\nazimuth_deg = 20.0\n'
        '[scan]\nnx = 41\nny = 41\npixel_size_um = 30.0\npitch = "sample"\nrotations_deg = [0, 72, 144, 216, 288]\n'
        "[trace]\nrays = 128\n"
    )
    scene = load_scene(path)
    scans = hx.simulate(scene)
    assert isinstance(scans, MicrographSet)
    down = scene.beam.changed(incidence_deg=0.0)
    return scans, true_surface(scene, scans.stacks[0].x, scans.stacks[0].y, down).height


def relative_rms(height: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((height - truth) ** 2)) / truth.max())


def test_one_detector_at_45_degrees_gives_heights(crystal):
    """Five rotations about the plate normal under an oblique beam: 2 % of the height, where reading all images at the
    substrate's places, as for rotations about the beam, is off by more than 3 %. The linear method refuses.
    """
    scans, truth = crystal
    joined = several_scans.join_scans(scans)
    assert joined.change < several_scans.SETTLED and joined.stack.instrument.has_several_beams
    assert relative_rms(joined.stack.parallax_height, truth) < 0.02
    flat = resample(scans, joined.motions, "reference", height=np.zeros(truth.shape))
    rec = hx.reconstruct(flat.replace(parallax=None, parallax_height=None), "nearfield", samples=0)
    assert relative_rms(rec.height, truth) > 0.03
    with pytest.raises(GuardError, match="rotated about the plate's normal under a beam at 45 deg"):
        hx.reconstruct(scans, "linear")


def test_fitted_motions_return_to_the_true_ones(crystal, monkeypatch):
    """Scans displaced by 1 to 2 pixels come back to within 0.4 pixels, and the heights to 2.5 %."""
    scans, truth = crystal
    true = several_scans.stage_motions(scans)
    errors = np.random.default_rng(5).normal(0.0, 40.0, (5, 2)) * (np.arange(5) > 0)[:, None]
    wrong = tuple(Rigid(m.rotation, (float(a), float(b))) for m, (a, b) in zip(true, errors, strict=True))
    monkeypatch.setattr(several_scans, "stage_motions", lambda _: wrong)
    joined = several_scans.join_scans(scans, motions="fitted")
    off = [np.hypot(*np.subtract(m.shift, t.shift)) for m, t in zip(joined.motions, true, strict=True)]
    assert max(off) < 12.0 < np.hypot(*errors.T).max()
    assert relative_rms(joined.stack.parallax_height, truth) < 0.025


def test_priors_of_a_calibration_reach_the_heights(crystal):
    """Joined scans are as uncertain as their calibration says, from the command's function and from hx.reconstruct.

    Catches heights of calibrated scans with the error bars of simulated ones.
    """
    scans, _ = crystal
    calibration = Calibration("border", {"gain_std": 0.123})
    calibrated = MicrographSet(tuple(s.replace(calibration=calibration) for s in scans.stacks))
    how = {"samples": 0, "corrections": 0}
    for rec in (
        hx.reconstruct(calibrated, "nearfield", **how),
        hx.reconstruct_scans(calibrated, "nearfield", **how)[0],
    ):
        assert rec.provenance["reconstruct"]["refine"]["gain_std"] == 0.123


def test_joined_scans_have_the_level_that_their_law_gives_them(crystal):
    """The calibration brings a level substrate to the cosine law's signal, a fit by the stated law to that law's.

    Catches joined scans that are fitted at the cosine law's level, for no calibration goes with them, and the first
    scan's priors for all. Scans of which one is not calibrated, or states a law that disagrees, are refused.
    """
    scans, _ = crystal
    stated = CampaignLaw(exponent=0.2, std=0.01)
    instruments = [s.instrument.model_copy(update={"law": stated}) for s in scans.stacks]
    calibration = Calibration("border", {"offset_std": 0.01, "gain_std": 0.1}, warnings=("dark",))
    stacks = [s.replace(calibration=calibration, instrument=i) for s, i in zip(scans.stacks, instruments, strict=True)]
    stacks[1] = stacks[1].replace(calibration=Calibration("border", {"offset_std": 0.3}, warnings=("dark",)))
    joined = several_scans.join_scans(MicrographSet(tuple(stacks))).stack
    assert joined.calibration == Calibration("border", {"offset_std": 0.3, "gain_std": 0.1}, warnings=("dark",))
    scaled = with_level_of_law(joined, RefineSettings())
    ratio = level_ratio(PowerLaw(0.2), Optics.of(joined.instrument))
    np.testing.assert_allclose(scaled.counts, joined.counts * ratio[:, None, None])
    np.testing.assert_allclose(scaled.parallax, joined.parallax * ratio[:, None, None])
    assert np.abs(ratio - 1.0).max() > 0.01
    with pytest.raises(InputFileError, match="must be calibrated alike"):
        several_scans.join_scans(MicrographSet((stacks[0].replace(calibration=None), *stacks[1:])))
    other = stacks[0].instrument.model_copy(update={"law": CampaignLaw(exponent=0.23, std=0.02)})
    of_both = several_scans.join_scans(MicrographSet((stacks[0].replace(instrument=other), *stacks[1:]))).stack
    # the other scans share one measurement of the law
    assert of_both.instrument.law.exponent == pytest.approx((0.23 + 4 * 0.2) / 5)
    assert of_both.instrument.law.std == pytest.approx((0.02 + 4 * 0.01) / 5 * max(1.0, 0.03 / np.hypot(0.02, 0.01)))

    def joined_law(*laws):
        models = [stacks[0].instrument.model_copy(update={"law": CampaignLaw(exponent=m, std=std)}) for m, std in laws]
        stated_apart = [s.replace(instrument=model) for s, model in zip(stacks, models, strict=True)]
        return several_scans.join_scans(MicrographSet(tuple(stated_apart))).stack.instrument.law

    # chi-square 8 of 2 degrees of freedom: times the Birge ratio, copies of a statement count once; two that disagree,
    # neither the smallest nor largest; and laws so vague that together they tell nothing
    law = joined_law((0.2, 0.02), (0.28, 0.02), (0.24, 0.02), (0.24, 0.02), (0.24, 0.02))
    assert law.exponent == pytest.approx(0.24)
    assert law.std == pytest.approx(0.02 * 2.0)
    with pytest.raises(InputFileError, match=r"determine m to \+- 1\.1 only"):
        joined_law((0.0, 0.4), (1.6, 0.4), (0.0, 0.4), (0.0, 0.4), (0.0, 0.4))
    with pytest.raises(InputFileError, match="must agree on the scattering law"):
        joined_law((0.0, 0.2), (0.3, 0.2), (0.1, 0.001), (0.15, 0.001), (0.1, 0.2))
    other = other.model_copy(update={"law": CampaignLaw(exponent=0.3, std=0.02)})
    with pytest.raises(InputFileError, match="must agree on the scattering law"):
        several_scans.join_scans(MicrographSet((stacks[0].replace(instrument=other), *stacks[1:])))


def test_command_joins_the_scans_of_several_files(crystal, tmp_path):
    """helio reconstruct of two files is hx.reconstruct of their scans; the joined images belong to the heights."""
    scans, _ = crystal
    hx.write(MicrographSet(scans.stacks[:3]), tmp_path / "a.h5")
    hx.write(MicrographSet(scans.stacks[3:]), tmp_path / "b.h5")
    command = ["reconstruct", "a.h5", "b.h5", "-o", "height.h5", "--method", "nearfield", "--write-joined", "joined.h5"]
    done = subprocess.run(
        [sys.executable, "-m", "helio_jax", *command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    rec, joined = hx.read(tmp_path / "height.h5"), hx.read(tmp_path / "joined.h5")
    wanted, parts = hx.reconstruct_scans(scans, settings=ReconstructSettings(method="nearfield"))
    np.testing.assert_allclose(rec.height, wanted.height, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(joined.counts, parts.stack.counts)
    np.testing.assert_allclose(joined.parallax, parts.stack.parallax)
    assert rec.instrument.has_several_beams and rec.instrument.beam.incidence_deg == 0.0


def test_scans_that_one_surface_cannot_explain_are_refused():
    one = load_instrument("ashem_45")
    far = make_scan(one.at_distance(one.sample_distance + 100.0), 90.0)
    with pytest.raises(InputFileError, match="must have one sample distance, got 2100 and 2200 um"):
        several_scans.join_scans(MicrographSet((make_scan(one, 0.0), far)))
    measured = make_scan(one, 0.0).replace(noise="measured", n_rays=None)
    with pytest.raises(InputFileError, match="calibrate measured scans before they are joined"):
        hx.reconstruct(MicrographSet((measured, measured)))
