"""Calibration by known shapes: what a user states, the instrument file, line noise, and a fit to a traced twin."""

import math

import numpy as np
import pytest

from helio_jax.calibration.common_errors import common_std, group_means, scan_lines, tiles, whitened
from helio_jax.calibration.known_model import no_multiple, probability, see, smoothed_by
from helio_jax.calibration.known_objects import KnownObject, Stated
from helio_jax.calibration.known_pixels import BESIDE, OUTLINE
from helio_jax.calibration.known_report import calibrated_instrument, table
from helio_jax.calibration.known_scan import Layout, prepare_scan
from helio_jax.calibration.known_shape import _Fit, fit_known_shapes
from helio_jax.calibration.unknowns import OBJECT, KnownShapeSettings, instrument_unknowns
from helio_jax.errors import SceneError
from helio_jax.formats.toml import write_calibrated
from helio_jax.forward.optics import Optics
from helio_jax.micrograph import MicrographStack
from helio_jax.trace.scan import trace_scene
from helio_jax.workflows.calibrate_known import calibrate_known
from helio_jax.workflows.known_scene import known_scene, multiple_tracer
from helio_jax.workflows.scene_file import load_instrument

AXIS = 120.0 * (np.arange(25) - 12.0)
BALL = "ball radius=1000"
PLATE = {"plate shift x": 250.0, "plate shift y": -120.0, "sample distance": -150.0, "incidence": 0.5}


def test_shapes_are_read_as_stated():
    """Catches numbers that go to the wrong key, and a deviation that is dropped."""
    wedge = KnownObject.parse("wedge height=200+-1.5 slope=30 facing=-90")
    assert wedge == KnownObject("wedge", None, Stated(200.0, 1.5), Stated(30.0), -90.0)
    assert [known.height is not None for known in KnownObject.parse(BALL).starts()] == [True] * 3


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("bal radius=3", "ball"),
        ("ball", "radius"),
        ("ball radius=-3", "radius"),
        ("ball radius=1000 height=1500", "overhanging"),
        ("ball radius=1 radius=2", "once"),
        ("flat height=3", "no 'height'|it has no numbers"),
        ("wedge height=3 slope=x", "slope=NUMBER"),
        ("", "known are"),
    ],
)
def test_impossible_shapes_are_refused(text, names):
    """Each message names what is wrong or what is known."""
    with pytest.raises(SceneError, match=names):
        KnownObject.parse(text)


def test_flat_alone_and_counts_of_shapes_are_refused(bshem):
    """Catches a calibration of directions that nothing determines."""
    counts = np.random.default_rng(1).normal(1000.0, 10.0, (3, 9, 9))
    stack = MicrographStack(counts, AXIS[:9], AXIS[:9], bshem, variance=np.full(counts.shape, 100.0))
    with pytest.raises(SceneError, match="2 known shapes for 1 scans"):
        calibrate_known([stack], [BALL, BALL])
    with pytest.raises(Exception, match="flat alone"):
        calibrate_known([stack], ["flat"])


@pytest.mark.parametrize("kind", ["rows", "columns", "tiles"])
def test_common_errors_are_whitened(kind):
    """W C W^T = 1 for the covariance C of noise and of errors that groups share. Catches lines along the wrong axis."""
    rng, shape, std = np.random.default_rng(2), (1, 3, 4), 2.0
    sigma, (row, column) = rng.uniform(1.0, 2.0, shape), np.indices(shape[1:])
    is_object = (row + column) % 3 == 0
    groups, number = {
        "rows": (scan_lines(shape[1:], 0), row),
        "columns": (scan_lines(shape[1:], 1), column),
        "tiles": (tiles(is_object, 2), 10 * (row // 2) + 2 * (column // 2) + is_object),
    }[kind]
    unit = np.eye(12).reshape(12, *shape)
    found = whitened(unit / sigma, 1.0 / sigma, np.full((1, groups.n), std), groups).reshape(12, 12)
    same = number.ravel()[:, None] == number.ravel()
    covariance = np.diag(sigma.ravel() ** 2) + std**2 * same
    assert found.T @ covariance @ found == pytest.approx(np.eye(12), abs=1e-12)


def test_common_errors_are_estimated():
    """Errors of groups come back within 4 standard errors, 0 where none are. Catches noise that is not subtracted.

    400 groups of 9 pixels: the estimate of a standard deviation of 2 (noise of a mean 1/3) scatters by 5 % (robust).
    "None" must not exceed noise by 2 deviations: false alarms in 2 % of all cases; this seed has none.
    """
    rng = np.random.default_rng(5)
    groups = tiles(np.zeros((60, 60), bool), 3)
    noise = rng.normal(0.0, 1.0, (2, 60, 60))
    error = groups.spread(rng.normal(0.0, 1.0, (2, groups.n)) * np.array([2.0, 0.0])[:, None])
    mean, total = group_means(noise + error, np.ones(noise.shape), groups)
    found = common_std(mean[:, ::2], total[:, ::2], is_sure=True)
    assert found[0] == pytest.approx(2.0, rel=0.2) and found[1] == 0.0


def test_instrument_moves_as_optics_do(bshem):
    """Catches another order or sign of the plate's motions in the file than in the fit."""
    aim = np.radians([[1.0, 2.0], [-1.0, 0.5], [0.3, -0.7]])
    moves = {"plate_shift": (300.0, -90.0), "scale": 1.03, "rotation": 0.02, "incidence": 0.01}
    written = Optics.of(bshem.moved(aim, 70.0, **moves))
    fitted = Optics.of(bshem).moved(distance=70.0, polar=aim[:, 0], azimuth=aim[:, 1], **moves)
    for name in ("center", "beam_shift", "sample_distance"):
        assert getattr(written, name) == pytest.approx(np.asarray(getattr(fitted, name)), rel=1e-6, abs=1e-6)
    areas = [np.cross(o.axes[..., 0], o.axes[..., 1])[:, 2] for o in (written, fitted)]
    assert areas[0] == pytest.approx(np.asarray(areas[1]), rel=1e-6)


def test_data_beside_the_outline_are_left_out(bshem):
    """Left out is every pixel that the object reaches or leaves when it moves by `BESIDE` pitches, and no other.

    At the last stage, whose outline is narrower. Pixels so close once held the fit off the right place by 5 to 15
    deviations. Catches a distance in wrong units, and an outline that no longer counts these pixels. No chance is
    involved.
    """
    counts = np.random.default_rng(4).normal(1000.0, 10.0, (3, AXIS.size, AXIS.size))
    stack = MicrographStack(counts, AXIS, AXIS, bshem, variance=np.full(counts.shape, 100.0), noise="poisson")
    settings = KnownShapeSettings(rays=0)
    scan = prepare_scan(stack, KnownObject.parse("ball radius=1000 height=680"), settings)
    fit = _Fit(bshem, [scan], settings, None)
    fit.stage = len(OUTLINE) - 1
    fit.update(2)
    at, turns = fit.layout.of_scan(0, fit.x), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    place = len(at) - len(OBJECT) + np.arange(2)

    def reached(step: float) -> np.ndarray:
        """Find the pixels that change sides when the object moves by a step in any direction [y, x]."""
        moved = [at + step * (np.eye(len(at))[place].T @ [np.cos(t), np.sin(t)]) for t in turns]
        return np.any(np.array([see(scan.model, m).is_object != see(scan.model, at).is_object for m in moved]), 0)

    left_out, scale = np.any(~fit.used[0], 0), BESIDE * (AXIS[1] - AXIS[0])
    assert left_out[reached(0.9 * scale)].all() and reached(0.9 * scale).sum() > 5
    assert not left_out[~reached(1.2 * scale)].any()
    assert fit.outlined[0].all()


def test_noise_of_traced_multiple_scattering_is_smoothed():
    """A prediction that is 3 and 12 % too small, with noise of 5 %: the noise falls to a third, the rest stays.

    What varies steeply in the prediction, as at a foot, is kept: means of both parts to 0.7 % (noise: 0.24 %). Rejects
    smoothing of the image itself, and across the outline.
    """
    y, x = np.mgrid[:40, :50]
    is_object = np.hypot(x - 25, y - 20) < 12.0
    predicted = np.stack([np.where(is_object, 2.0, 30.0 / np.hypot(x - 25, y - 20).clip(1.0)), 1.0 + 0.02 * x])
    true = predicted * np.where(is_object, 1.03, 1.12)
    traced = true * (1.0 + 0.05 * np.random.default_rng(2).standard_normal(true.shape))
    error = smoothed_by(traced, predicted, is_object) / true - 1.0
    for part in (is_object, ~is_object):
        assert np.std(error[:, part]) < 0.0175
        assert np.abs(np.mean(error[:, part], 1)).max() < 0.007


def modelled_ball(bshem, axis) -> MicrographStack:
    """Make a scan of a ball by the model of the fit itself, without multiple scattering, with noise."""
    counts = np.full((3, axis.size, axis.size), 5000.0)
    stack = MicrographStack(counts, axis, axis, bshem, variance=np.full(counts.shape, 3600.0), noise="poisson")
    scan = prepare_scan(stack, KnownObject.parse("ball radius=1000 height=680"), KnownShapeSettings(rays=0))
    layout = Layout(instrument_unknowns(bshem, KnownShapeSettings()), [scan])
    at = layout.of_scan(0, np.zeros(len(layout.unknowns)))
    image = probability(scan.model, at, no_multiple(scan.model, at, layout.free[0]))
    noise = np.random.default_rng(8).normal(0.0, 60.0, counts.shape)
    return stack.replace(counts=counts + 3000.0 * image / np.median(image) + noise)


@pytest.mark.parametrize("max_rounds", [1, 2])
def test_few_rounds_end_on_all_pixels(bshem, monkeypatch, max_rounds):
    """A large raster is first fitted on few pixels; what comes out is of all of them, however few the rounds.

    Catches a first fit that takes all rounds, and one that counts as converged.
    """
    monkeypatch.setattr("helio_jax.calibration.known_shape.FIRST_PIXELS", 13)
    axis = np.linspace(-1400.0, 1400.0, 25)
    scan = modelled_ball(bshem, axis)
    done = []
    settings = KnownShapeSettings(rays=0, max_rounds=max_rounds, drift=0.0, pedestal=0.0)
    known = [KnownObject.parse("ball radius=1000 height=680")]
    found = fit_known_shapes([scan], known, settings, report=lambda number, total, note: done.append((number, note)))
    assert found.rounds == len(done) == max_rounds and not found.is_converged
    assert found.residuals[0].shape == (3, 25, 25) and np.isfinite(found.values).all()
    assert [note for _, note in done].count("all pixels") == (max_rounds > 1)


@pytest.fixture(scope="module")
def fit(bshem):
    """A calibration on a traced twin, with noise and unequal gains."""
    shift = PLATE["plate shift x"], PLATE["plate shift y"]
    about = {"plate_shift": shift, "incidence": math.radians(PLATE["incidence"])}
    true = bshem.moved(np.zeros((3, 2)), PLATE["sample distance"], **about)
    known = KnownObject.parse(BALL)
    numbers = dict.fromkeys(OBJECT, 0.0) | {"radius": 1000.0, "height": 680.0, "object x": 40.0, "object y": -70.0}
    scene = known_scene(known, numbers, true, AXIS, AXIS, substrate_um=8000.0)
    traced = trace_scene(scene, scene.trace.changed(rays=256, maps=False)).only()
    image = traced.counts.reshape(3, AXIS.size, AXIS.size)
    signal = np.array([2000.0, 4000.0, 3000.0])[:, None, None] * image / np.median(image, axis=(1, 2), keepdims=True)
    noise = np.random.default_rng(3).normal(0.0, 60.0, image.shape)
    variance = np.full(image.shape, 3600.0)
    stack = MicrographStack(signal + 5000.0 + noise, AXIS, AXIS, bshem, variance=variance, noise="poisson")
    settings = KnownShapeSettings(drift=0.0, pedestal=0.0)
    trace = multiple_tracer([known], rays=512, substrate_um=8000.0)
    return fit_known_shapes([stack], [known], settings, trace=trace)


@pytest.mark.slow
def test_instrument_is_found(fit, bshem):
    """On a traced twin, within 4 stated deviations and closer than the prior; chi-square per pixel is 1.

    Catches a parameter of the wrong sign or unit, a wrong derivative, and error bars of the wrong size. 4 deviations in
    10 numbers: one false alarm in 1600.
    """
    found = {row.name: row for row in table(fit)}
    stated = {"sample distance": bshem.sample_distance, "incidence": bshem.beam.incidence_deg}
    true = {name: stated.get(name, 0.0) + value for name, value in PLATE.items()}
    true |= {"height": 680.0, "object x": 40.0, "object y": -70.0, "tilt x": 0.0, "tilt y": 0.0, "plate rotation": 0.0}
    for name, value in true.items():
        assert abs(found[name].value - value) < 4.0 * found[name].std, found[name]
    assert found["plate shift x"].std < 0.15 * found["plate shift x"].prior
    assert 0.85 < fit.chi_square < 1.15


@pytest.mark.slow
def test_covariance_comes_back_from_the_file(fit, tmp_path):
    """Catches a covariance that is lost, or of other parameters, in the instrument file."""
    instrument = calibrated_instrument(fit)
    write_calibrated(instrument, tmp_path / "found.toml", "a calibration\nof two lines")
    read = load_instrument(tmp_path / "found.toml")
    assert read.covariance is not None and instrument.covariance is not None
    n = fit.n_shared
    stated = fit.covariance[:n, :n] * np.outer(fit.priors[:n], fit.priors[:n])
    assert read.covariance.matrix() == pytest.approx(stated, rel=2e-3, abs=1e-3 * np.diag(stated).max())
    assert read.covariance.parameters == tuple(fit.names[:n])
    assert np.array([a.center for a in read.apertures()]) == pytest.approx(
        np.array([a.center for a in instrument.apertures()]), rel=1e-4
    )
    assert 0.0 < read.uncertainty.polar_deg < 5.0
