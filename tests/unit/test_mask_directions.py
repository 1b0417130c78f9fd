"""Directions by the outlines of ball and masks: closed forms, a traced twin, what the estimator must not depend on."""

import dataclasses
import math

import numpy as np
import pytest

from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.known_scan import Layout, prepare_scan
from helio_jax.calibration.mask_directions import fit_masks
from helio_jax.calibration.mask_model import N_COLUMNS, MaskModel, columns, directions_of, parts_of, reading_derivative
from helio_jax.calibration.mask_report import direction_rows, instrument_by_masks, verdict
from helio_jax.calibration.unknowns import OBJECT, KnownShapeSettings, instrument_unknowns
from helio_jax.errors import GuardError, SceneError
from helio_jax.forward.optics import Optics
from helio_jax.micrograph import MicrographStack
from helio_jax.trace.scan import trace_scene
from helio_jax.workflows.calibrate_known import calibrate_known_files, calibrate_masks
from helio_jax.workflows.known_scene import known_scene

AXIS = 45.0 * (np.arange(53) - 26.0)
RADIUS, HEIGHT = 800.0, 820.0
BALL = f"ball radius={RADIUS:g}"
SETTINGS = KnownShapeSettings(pedestal=0.0, drift=0.0, max_rounds=8)


def blank(bshem) -> MicrographStack:
    """Make a scan of noise alone."""
    counts = np.random.default_rng(4).normal(1000.0, 10.0, (3, AXIS.size, AXIS.size))
    return MicrographStack(counts, AXIS, AXIS, bshem, variance=np.full(counts.shape, 100.0), noise="poisson")


def model_at(bshem) -> tuple[MaskModel, np.ndarray, np.ndarray]:
    """Make the model of a ball about the origin: it, its unknowns, the numbers of the free ones."""
    scan = prepare_scan(blank(bshem), KnownObject.parse(f"{BALL} height={HEIGHT:g}+-50"), SETTINGS)
    layout = Layout(instrument_unknowns(bshem, SETTINGS), [scan])
    return MaskModel(scan.model), layout.of_scan(0, np.zeros(len(layout.unknowns))), layout.free[0]


def test_directions_are_those_of_the_centres(bshem):
    """From the spot on the substrate, not from the lab frame's origin. Catches a spot on the wrong side. Exact."""
    optics = Optics.of(bshem.moved(np.zeros((3, 2)), 200.0))
    depth = optics.sample_distance - bshem.working_distance  # the beam passes through the lab frame's origin
    spot = depth * math.tan(math.radians(bshem.beam.incidence_deg)) * np.array([1.0, 0.0])
    found = np.asarray(directions_of(optics))
    for center, (polar, azimuth) in zip(np.asarray(optics.center), found, strict=True):
        reach = optics.sample_distance * np.tan(polar) * np.array([np.cos(azimuth), np.sin(azimuth)])
        assert spot + reach == pytest.approx(center[:2], rel=1e-5)


def test_visible_share_falls_where_the_ball_hides_an_aperture(bshem):
    """The mask of an aperture of half-angle a ends between the shadows of its nearest and farthest rim point.

    A direction at polar angle p from the substrate touches a ball whose centre stands c above it at the distance
    c tan p + R / cos p from its axis, on the other side. Catches a mask on the detector's side, or one of wrong length.
    """
    model, at, _ = model_at(bshem)
    visible, _, log_share = columns(model, at, 0.0)
    x, y = np.meshgrid(AXIS, AXIS)
    optics = model.scan.optics
    for k, (center, axes) in enumerate(zip(optics.center, optics.axes, strict=True)):
        outward = center[:2] / np.hypot(*center[:2])
        t = np.linspace(0.0, 2.0 * np.pi, 400)
        rim = (center + np.stack([np.cos(t), np.sin(t)], 1) @ axes.T)[:, :2] @ outward
        ends = [(HEIGHT - RADIUS) * tan + RADIUS * math.hypot(1.0, tan) for tan in rim / optics.sample_distance]
        along, across = x * outward[0] + y * outward[1], x * outward[1] - y * outward[0]
        on_axis = (np.abs(across) < 40.0) & (log_share[1] > log_share[0]) & (along < 0.0)
        assert (visible[k][on_axis & (along < -max(ends) - 20.0)] > 0.999).all()
        assert (visible[k][on_axis & (along > -max(ends) + 60.0)] < 0.999).all()
        assert (visible[k][(along > 0.0) & (log_share[1] > log_share[0])].mean()) > 0.99


def test_derivatives_are_those_of_the_readings(bshem):
    """Central differences agree, away from the outline. Catches an unknown whose column is dropped or doubled."""
    model, at, free = model_at(bshem)
    rng = np.random.default_rng(6)
    linear, width = rng.normal(0.0, 1.0, (3, N_COLUMNS)), 30.0
    _, _, log_share = columns(model, at, width)
    member = np.exp(log_share)
    slopes, _ = reading_derivative(model, at, width, member, linear, free)

    def reading(u: np.ndarray) -> np.ndarray:
        visible, every, _ = columns(model, u, width)
        ball, flat = parts_of(visible, every, linear)
        return member[0] * ball + member[1] * flat

    for slope, number in zip(slopes, free, strict=True):
        step = np.zeros(len(at))
        step[number] = 1e-4 if abs(at[number]) < 10.0 else 0.1
        wanted = (reading(at + step) - reading(at - step)) / (2.0 * step[number])
        far = np.abs(log_share).min(0) < 1e-3
        size = np.abs(wanted[:, far]).max()
        assert np.median(np.abs(slope - wanted)[:, far]) < 1e-3 * size + 1e-12


def test_other_objects_are_refused(bshem, tmp_path):
    """A straight edge determines one component only; the output must be an instrument file's."""
    with pytest.raises(GuardError, match="need a ball, got a step"):
        calibrate_masks([blank(bshem)], ["step height=100"])
    with pytest.raises(SceneError, match="2 known shapes for 1 scans"):
        calibrate_masks([blank(bshem)], [BALL, BALL])


@pytest.fixture(scope="module")
def twin(bshem):
    """A traced scan of a ball whose plate is shifted, read by an instrument file that does not know it; the truth."""
    true = bshem.moved(np.zeros((3, 2)), 0.0, plate_shift=(350.0, -200.0))
    numbers = dict.fromkeys(OBJECT, 0.0) | {"radius": RADIUS, "height": HEIGHT, "object x": 30.0, "object y": -20.0}
    scene = known_scene(KnownObject.parse(BALL), numbers, true, AXIS, AXIS, substrate_um=6000.0)
    traced = trace_scene(scene, scene.trace.changed(rays=256, maps=False)).only()
    image = traced.counts.reshape(3, AXIS.size, AXIS.size)
    image = 3000.0 * image / np.median(image, axis=(1, 2), keepdims=True)
    counts = image + np.random.default_rng(3).normal(0.0, 120.0, image.shape)
    variance = np.full(image.shape, 120.0**2)
    stack = MicrographStack(counts, AXIS, AXIS, bshem, variance=variance, noise="poisson", name="twin")
    return stack, np.degrees(np.asarray(directions_of(Optics.of(true)))).ravel()


@pytest.fixture(scope="module")
def fit(twin):
    """The directions on the twin."""
    return fit_masks([twin[0]], [KnownObject.parse(BALL)], SETTINGS)


@pytest.mark.slow
def test_directions_are_found(twin, fit, bshem):
    """Within 4 standard deviations, and a plate that is shifted by 0.13 of the distance is named.

    6 numbers: a false alarm in 2600. Catches a mask that is mirrored, and directions that only repeat the file: it is
    off by up to 6 degrees.
    """
    rows, true = direction_rows(fit), twin[1]
    for row, value in zip(rows, true, strict=True):
        away = (row["value"] - value + 180.0) % 360.0 - 180.0
        assert abs(away) < 4.0 * row["std"], row
        assert row["is_determined"], row
    assert max(abs(row["stated"] - value) for row, value in zip(rows, true, strict=True)) > 4.0
    assert any("masks contradict the instrument file: polar of" in text for text in verdict(fit))
    far = dataclasses.replace(fit, values=np.where(np.array(fit.names) == "incidence", 40.0, fit.values))
    assert "do not trust" in verdict(far)[0] and not any("do not trust" in text for text in verdict(fit))
    assert fit.is_converged and 0.7 < fit.chi_square < 1.6  # the twin's own noise adds to the stated one
    written = instrument_by_masks(fit)
    assert np.asarray(directions_of(Optics.of(written))).ravel() == pytest.approx(fit.directions.ravel(), abs=1e-6)
    assert written.covariance is not None and written.uncertainty.plate_shift_um < 200.0


@pytest.mark.slow
def test_gain_offset_and_law_make_no_difference(twin, fit):
    """Other gains and offsets give the same directions within 1.5 standard deviations (1.05 on one machine).

    Not exactly: the fit ends where a round changes it little, and single pixels at the outline may change sides.
    Catches a level, an offset or a prior that is not in units of the signal. No chance is involved.
    """
    stack, _ = twin
    gain = np.array([0.3, 5.0, 1.0])[:, None, None]
    other = stack.replace(counts=stack.counts * gain + 7000.0, variance=stack.variance * gain**2)
    found = fit_masks([other], [KnownObject.parse(BALL)], SETTINGS)
    assert np.all(np.abs(found.directions - fit.directions) < 1.5 * fit.direction_stds)


@pytest.mark.slow
def test_files_are_written(twin, tmp_path):
    """The command's workflow writes an instrument file that is read back, and a picture."""
    from helio_jax import write
    from helio_jax.workflows.scene_file import load_instrument

    write(twin[0], tmp_path / "a.h5")
    output = tmp_path / "masks.toml"
    found = calibrate_known_files(
        [tmp_path / "a.h5"], output, [BALL], masks=True, max_rounds=1, pedestal=0.0, drift=0.0
    )
    assert load_instrument(output).covariance is not None
    assert "not converged" in output.read_text()  # whoever reads the file sees what the terminal said
    assert (tmp_path / "masks.png").stat().st_size > 10_000
    assert [row["unit"] for row in found["directions"]] == ["deg"] * 6
    assert "not converged" in " ".join(found["verdict"])
