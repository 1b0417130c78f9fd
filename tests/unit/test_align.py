"""Alignment of turned scans: motions, control points, correlation, the automatic way, resampling, refusals."""

import math

import numpy as np
import pytest

from helio_jax.alignment.align import AlignSettings, _stage_errors, align_scans, find_motions
from helio_jax.alignment.automatic import Aligner
from helio_jax.alignment.control_points import fit_points, rms
from helio_jax.alignment.correlate import correlate_masked, find_peak
from helio_jax.alignment.resample import resample
from helio_jax.alignment.rigid import Rigid, fit_rigid, rotation_about, separation
from helio_jax.alignment.views import View
from helio_jax.calibration.self_calibration import effective_instrument, self_calibrate
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.figures.pick import Picker
from helio_jax.formats.points import read_points, write_points
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.workflows import pipeline

PITCH = 20.0
POLAR = 46.0


def make_instrument(incidence=0.0) -> Instrument:
    center = 3000.0 * math.tan(math.radians(POLAR))
    detector = Detector(name="d", center_um=(center, 0.0), axes_um=(1790.0, 1400.0))
    return Instrument(beam=Beam(incidence_deg=incidence), plate=Plate(working_distance_um=3000.0), detector=(detector,))


def crystal_light(x, y, azimuth, share=0.0):
    """Reading of a truncated pyramid turned by 0.3 rad with unlike sides, lit from `azimuth`; far field, no masks."""
    c, s = math.cos(0.3), math.sin(0.3)
    u, v = c * x + s * y, c * y - s * x
    planes = [(0.0, 0.0, 400.0), (-1.2, 0.0, 800.0), (1.0, 0.2, 750.0), (0.1, -1.3, 700.0), (-0.2, 0.9, 650.0)]
    height = np.stack([a * u + b * v + h for a, b, h in planes] + [0.05 * u])
    lowest = np.argmin(height[:-1], 0)
    lowest = np.where(height[:-1].min(0) < height[-1], 5, lowest)
    slope = np.array([(a * c - b * s, a * s + b * c) for a, b, _ in planes] + [(0.05 * c, 0.05 * s)])[lowest]
    t = math.radians(POLAR)
    along = slope[..., 0] * math.cos(azimuth) + slope[..., 1] * math.sin(azimuth)
    light = (math.cos(t) - math.sin(t) * along) / np.sqrt(1 + (slope**2).sum(-1)) / math.cos(t)
    return (1 - share) * np.maximum(light, 0.0) + share


def hill_light(x, y, azimuth, share=0.0):
    """Reading of a soft hill of 250 um on a flat; far field, no masks."""
    width, t = 300.0, math.radians(POLAR)
    rise = -250.0 / width**2 * np.exp(-(x * x + y * y) / (2 * width**2))
    along = rise * (x * math.cos(azimuth) + y * math.sin(azimuth))
    light = (1 - math.tan(t) * along) / np.sqrt(1 + rise**2 * (x * x + y * y))
    return (1 - share) * np.maximum(light, 0.0) + share


def make_scans(
    n=61, counts=2000.0, share=0.0, seed=3, noise_only=False, light=crystal_light
) -> tuple[MicrographSet, list[Rigid]]:
    """Return five scans 72 deg apart with gains and shifts of their own, and the true motions."""
    rng = np.random.default_rng(seed)
    axis = (np.arange(n) - (n - 1) / 2) * PITCH
    points = np.stack(np.meshgrid(axis, axis), -1)
    stacks, motions = [], []
    for k, (turn, move) in enumerate(
        [(0, (0, 0)), (1.2, (70, -50)), (-0.9, (-45, 80)), (0.4, (30, 60)), (-1.5, (-80, -20))]
    ):
        nominal = -k * math.radians(72.0)
        motion = Rigid(nominal + math.radians(turn), (float(move[0]), float(move[1])))
        sample = motion.inverse().apply(points)
        mean = counts * (0.5 + 0.3 * k) * light(sample[..., 0], sample[..., 1], -motion.rotation, share)
        image = rng.poisson(np.full_like(mean, counts) if noise_only else mean).astype(float)
        about_it = {"sample_rotation": nominal, "name": f"scan{k}", "noise": "poisson"}
        stacks.append(
            MicrographStack(image[None], axis, axis, make_instrument(), np.maximum(image, 1.0)[None], **about_it)
        )
        motions.append(motion)
    return MicrographSet(tuple(stacks)), motions


def test_motions_compose_and_invert():
    """after, inverse, about: catches the order of turn and shift, and a rotation of the other sense."""
    m, first = Rigid(0.7, (30.0, -10.0)), Rigid(-1.1, (5.0, 8.0))
    points = np.array([[1.0, 2.0], [-30.0, 4.0]])
    np.testing.assert_allclose(m.after(first).apply(points), m.apply(first.apply(points)), atol=1e-12)
    np.testing.assert_allclose(m.inverse().apply(m.apply(points)), points, atol=1e-12)
    np.testing.assert_allclose(Rigid(math.pi / 2, (0.0, 0.0)).apply(np.array([1.0, 0.0])), [0.0, 1.0], atol=1e-12)
    center = np.array([10.0, 20.0])
    np.testing.assert_allclose(rotation_about(center, 0.4, np.array([1.0, 2.0])).apply(center), center + [1.0, 2.0])
    found = fit_rigid(points, m.apply(points))
    assert separation(found, m, points) < 1e-9 and found.rotation == pytest.approx(0.7)


def test_correlation_of_pictures_with_missing_parts():
    """Shift, gain and offset are found although a third is missing; index (reach, reach) is no shift.

    Catches the sign of the shift and zero padding that counts as data.
    """
    rng = np.random.default_rng(1)
    big = rng.standard_normal((60, 70))
    fixed, moving = big[10:50, 10:50], 3.0 * big[7:47, 15:55] + 9.0  # moving(r + u) = fixed(r): u = (3, -5)
    is_moving = np.ones((40, 40), bool)
    is_moving[:, :13] = False
    ncc = correlate_masked(fixed, np.ones((40, 40), bool), np.where(is_moving, moving, 1e6), is_moving, 8)
    peaks = find_peak(ncc, 2.0)
    assert peaks.shift == (3, -5) and peaks.height == pytest.approx(1.0, abs=1e-6) and peaks.rival < 0.3


def test_control_points_give_back_exact_motions():
    """Noise-free picks: residuals and leave-one-out errors vanish, though no point is in all views."""
    rng = np.random.default_rng(2)
    places = {f"P{i}": rng.uniform(-500, 500, 2) for i in range(9)}
    true = [Rigid(0.0, (0.0, 0.0)), Rigid(-1.25, (40.0, 9.0)), Rigid(2.5, (-70.0, 30.0))]
    seen = [range(7), range(2, 9), (0, 1, 4, 7, 8)]
    views = ("a", "b", "c")
    picks = {
        v: {f"P{i}": tuple(m.apply(places[f"P{i}"])) for i in use} for v, m, use in zip(views, true, seen, strict=True)
    }
    fit = fit_points(picks, views)
    at = np.array(list(places.values()))
    assert max(separation(a, b, at) for a, b in zip(fit.motions, true, strict=True)) < 1e-3
    assert rms(fit.residuals) < 1e-3 and rms(fit.left_out) < 1e-3


def test_deviation_of_picks_is_honest():
    """60 sets of picks with 10 um noise per axis: the stated deviation is 10 um on average within 6 %.

    Its relative error is 1 / sqrt(2 x 15 degrees of freedom x 60) = 2.4 %; catches 2 n or 2 n - 3 (m - 1) as degrees
    of freedom (22 % and 14 % off). Leave-one-out errors are larger than residuals.
    """
    rng = np.random.default_rng(3)
    views, places = ("a", "b", "c"), rng.uniform(-500, 500, (6, 2))
    true = [Rigid(0.0, (0.0, 0.0)), Rigid(-1.25, (40.0, 9.0)), Rigid(2.5, (-70.0, 30.0))]
    variance = []
    for _ in range(60):
        picks = {
            v: {str(i): tuple(m.apply(p) + 10.0 * rng.standard_normal(2)) for i, p in enumerate(places)}
            for v, m in zip(views, true, strict=True)
        }
        fit = fit_points(picks, views) if not variance else _quick_fit(picks, views)
        variance.append(fit.std_um**2)
        if len(variance) == 1:
            assert rms(fit.left_out) > 1.2 * rms(fit.residuals)
    assert math.sqrt(np.mean(variance)) == pytest.approx(10.0, rel=0.06)


def _quick_fit(picks, views):
    """The same fit without its leave-one-out errors, which take most of the time."""
    from unittest import mock

    with mock.patch("helio_jax.alignment.control_points._left_out", return_value=math.nan):
        return fit_points(picks, views)


def test_bad_points_are_named(tmp_path):
    """Too few, unknown view, wrong unit, bad number, twice: file, line and remedy are in the message."""
    scans, _ = make_scans(21)
    path = tmp_path / "p.csv"
    picks = {s.name: {n: (10.0 * i, 5.0 * i * i) for i, n in enumerate("abc")} for s in scans.stacks}
    write_points(path, picks)
    assert read_points(path) == picks
    with pytest.raises(InputFileError, match=r"'scan0' must have 3 or more points .* got 2"):
        fit_points({v: dict(list(p.items())[: 2 + (v != "scan0")]) for v, p in picks.items()}, tuple(picks))
    with pytest.raises(InputFileError, match="view 'scanX' is none of the scans"):
        fit_points(picks | {"scanX": picks["scan0"]}, tuple(picks))
    far = {v: {n: (x + 5000.0, y) for n, (x, y) in p.items()} for v, p in picks.items()}
    with pytest.raises(InputFileError, match="outside the scan"):
        align_scans(scans, far)
    for text, message in (
        ("a,b\n", "first line must be view,point,x_um,y_um"),
        ("view,point,x_um,y_um\ns,p,1,zz\n", r"line 2: x_um and y_um must be finite numbers, got '1', 'zz'"),
        ("view,point,x_um,y_um\ns,p,1,2\ns,p,1,2\n", "line 3: point 'p' of view 's' is given twice"),
        ("view,point,x_um,y_um\ns,p,1\n", "line 2: must have 4 columns, got 3"),
    ):
        path.write_text(text)
        with pytest.raises(InputFileError, match=message):
            read_points(path)


@pytest.fixture(scope="module")
def found():
    """Five scans with gains of 0.5 to 1.7 aligned without a hand."""
    scans, true = make_scans(share=0.3)
    return scans, true, find_motions(scans)


def test_automatic_alignment_is_sub_pixel(found):
    """Below half a pixel, nothing refused. Catches a sense of rotation (72 deg off) and gains taken as equal."""
    scans, true, alignment = found
    axis = scans.stacks[0].x
    places = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    errors = [separation(a, b, places) / PITCH for a, b in zip(alignment.motions, true, strict=True)]
    assert max(errors) < 0.5 and alignment.problems == (), (errors, alignment.problems)
    assert max(alignment.std_um) < 0.5 * PITCH


def test_aligned_stack_has_turned_apertures(found):
    """Sample turned by a: aperture turned by -a; pixels outside a scan are not observed; pictures coincide.

    Catches apertures turned by +a, and variances reduced by interpolation.
    """
    scans, true, alignment = found
    stack = resample(scans, alignment.motions, "union", alignment.std_um)
    assert stack.shape[0] == 5 and not stack.is_observed.all() and stack.is_observed.any(0).mean() > 0.5
    for aperture, motion in zip(stack.instrument.apertures(), true, strict=True):
        azimuth = math.atan2(aperture.center[1], aperture.center[0])
        assert abs(math.remainder(azimuth + motion.rotation, math.tau)) < math.radians(0.5)
    grid_x, grid_y = np.meshgrid(stack.x, stack.y)
    for k, motion in enumerate(true):
        ideal = 2000.0 * (0.5 + 0.3 * k) * crystal_light(grid_x, grid_y, -motion.rotation, 0.3)
        away = np.abs(stack.counts[k] - ideal)[stack.is_observed[k]] / ideal.mean()
        assert np.median(away) < 0.03
        flat = stack.is_observed[k] & (np.hypot(grid_x, grid_y) < 150)
        assert np.median(stack.variance[k][flat] / ideal[flat]) == pytest.approx(1.0, rel=0.2)
    same = resample(scans, alignment.motions, "reference")
    assert same.shape[1:] == (61, 61)


def test_a_soft_hill_does_not_fix_a_common_displacement():
    """Displaced along the detectors, a hill looks like another albedo: at the true motions little returns.

    The crystal brings back more. Catches an observability computed in the axes of the common frame (there displacements
    of rotated scans are no common one, and the hill seems fixed), and one of the best direction instead of the worst.
    """
    shares = []
    for light in (hill_light, crystal_light):
        scans, true = make_scans(light=light)
        aligner = Aligner([View.of(s) for s in scans.stacks], [m.rotation for m in true], 300.0, math.radians(3.0))
        aligner.motions = list(true)
        shares.append(aligner.common_shift_observability())
        assert aligner.motions == true
    assert shares[0] < AlignSettings().min_restoring < 1.5 * AlignSettings().min_restoring < shares[1], shares


def test_stage_errors_are_not_blamed_on_one_scan():
    """The first scan 2 deg wrong, the others right to 1.7 deg: no error above 2 deg, nor one hidden by a full turn.

    Catches errors relative to the first scan, of which the limit then refuses 3.7 deg.
    """
    nominal = np.radians([0.0, 60.0, 120.0])
    found = nominal + np.radians([0.0, 2.0 + 1.7, 360.0 + 2.0])
    np.testing.assert_allclose(np.degrees(_stage_errors(list(found), list(nominal))), [-1.85, 1.85, 0.15], atol=1e-9)


def test_refuses_what_does_not_fix_it():
    """Pure noise, too few scans, oblique incidence, no scans of one name, a limit not met: each with its reason."""
    noise, _ = make_scans(25, noise_only=True)
    with pytest.raises(GuardError, match=r"refused: .*scan .* standard deviation of its place"):
        align_scans(noise)
    scans, _ = make_scans(21)
    with pytest.raises(InputFileError, match="needs 4 or more scans, got 3"):
        align_scans(MicrographSet(scans.stacks[:3]))
    tilted = scans.stacks[1].replace(instrument=make_instrument(30.0))
    with pytest.raises(GuardError, match="'scan1' has an incidence of 30 deg"):
        align_scans(MicrographSet((scans.stacks[0], tilted, *scans.stacks[2:])))
    with pytest.raises(InputFileError, match="names must differ"):
        align_scans(MicrographSet((*scans.stacks[:4], scans.stacks[0])))
    picks = {
        s.name: {n: (40.0 * i * (-1) ** k, 9.0 * i * i) for i, n in enumerate("abcd")}
        for k, s in enumerate(scans.stacks)
    }
    with pytest.raises(GuardError, match=r"leave-one-out error must be <= 0\.01 px"):
        align_scans(scans, picks, AlignSettings(max_left_out_px=0.01))
    with pytest.raises(SceneError, match="wobble"):
        pipeline.align(scans, None, wobble="1")


def test_picker_keeps_points():
    """Put, step, delete: a new point begins after the last. Catches a click that lands in another view."""
    picker = Picker(["a", "b"], {"a": {"P1": (1.0, 2.0)}})
    picker.step(1)
    picker.put("b", 3.0, 4.0)
    assert picker.current == "P2" and picker.picks == {"a": {"P1": (1.0, 2.0)}, "b": {"P2": (3.0, 4.0)}}
    picker.step(-1)
    picker.delete("a")
    assert picker.picks == {"a": {}, "b": {"P2": (3.0, 4.0)}}


def test_self_calibration_finds_gains_and_background():
    """Gains of 1 to 3.4, background 75 % of the level reading, aperture at 46 deg: found from the crystal itself.

    Catches a background of the dark pixels only per image, and equal gains.
    """
    scans, true = make_scans(counts=2e5, share=0.75)
    stack = resample(scans, tuple(true), "reference")
    found = self_calibrate(stack, n_pixels=120)
    assert found.share == pytest.approx(0.75, abs=0.04)  # in each scan
    assert found.polar_deg == pytest.approx(POLAR, abs=5.0)
    np.testing.assert_allclose(found.gain / found.gain[0], [(0.5 + 0.3 * k) / 0.5 for k in range(5)], rtol=0.03)
    moved = effective_instrument(stack.instrument, 30.0)
    radius = np.mean([math.hypot(*a.center) for a in stack.instrument.apertures()])
    assert moved.apertures() == stack.instrument.apertures()  # the plate is as it was drilled
    assert math.degrees(math.atan2(radius, moved.sample_distance)) == pytest.approx(30.0)
    with pytest.raises(GuardError, match="4 or more images"):
        self_calibrate(scans.stacks[0])
