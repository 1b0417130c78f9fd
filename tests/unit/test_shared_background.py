"""The background that scans of a campaign share: joined over the stage, predicted elsewhere, tested by a border."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from helio_jax.calibration.known_shape import KnownFit
from helio_jax.calibration.shared_background import campaign_readout, shared_background
from helio_jax.calibration.unknowns import KnownShapeSettings, readout_columns
from helio_jax.campaign import CampaignReadout
from helio_jax.errors import SceneError
from helio_jax.formats.hdf5 import read_stack, write
from helio_jax.formats.toml import write_calibrated
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.pipeline import calibrate
from helio_jax.workflows.scene_file import load_instrument

AXIS = np.linspace(-600.0, 600.0, 25)
SIGNAL = np.array([1500.0, 3000.0, 2000.0])


def hill(x, y, k):
    """Return a cubic background over the stage [um] of detector k."""
    u, v = x / 3000.0, y / 3000.0
    return SIGNAL[k] * (2.0 + 0.3 * u - 0.2 * v + 0.15 * u * v - 0.1 * u**2 + 0.05 * v**3)


def fit_of(bshem, stages, stds, rng) -> KnownFit:
    """Return what a calibration would find of that background in scans at stage positions, of given errors."""
    columns = readout_columns(AXIS, AXIS, 1, KnownShapeSettings())
    n, scans, linear, covariances = 1 + len(columns.names), [], [], []
    for stage, std in zip(stages, stds, strict=True):
        x, y = np.meshgrid(AXIS + stage[0], AXIS + stage[1])
        modes = columns.modes[:10].reshape(10, -1)
        found = np.zeros((3, n))
        for k in range(3):
            found[k, 1:11] = np.linalg.lstsq(modes.T, hill(x, y, k).ravel(), rcond=None)[0]
        scans.append(
            SimpleNamespace(
                stage=np.array([*stage, -1660.0]),
                half_width=np.full(2, 600.0),
                dwell=1.0,
                unit="counts",
                columns=columns,
            )
        )
        factor = np.linalg.cholesky(0.6 * np.eye(n) + 0.4)
        covariances.append(np.broadcast_to(std**2 * (factor @ factor.T), (3, n, n)))
        linear.append(found + std * rng.standard_normal((3, n)) @ factor.T)
    fit = SimpleNamespace(scans=scans, linear=linear, linear_covariance=covariances, instrument=bshem)
    return cast(KnownFit, fit)


def readout_of(bshem, stages, std=0.0, seed=1) -> CampaignReadout:
    """Return the read-out that such scans give."""
    stds = [max(std, 1e-3)] * len(stages)
    fit = fit_of(bshem, stages, stds, np.random.default_rng(seed))
    return campaign_readout(fit, np.tile(SIGNAL, (len(stages), 1)))


def scan(bshem, readout, stage: Any, *, noise=0.0, offset=(0.0, 0.0, 0.0), brightness=1.0) -> MicrographStack:
    """Return counts of a flat sample at a stage position, of detectors whose offsets differ by shares of the signal."""
    x, y = np.meshgrid(AXIS + stage[0], AXIS + stage[1])
    counts = np.stack([hill(x, y, k) + (brightness + offset[k]) * SIGNAL[k] for k in range(3)])
    counts = counts + noise * np.random.default_rng(5).standard_normal(counts.shape)
    about: dict[str, Any] = {"instrument": bshem.model_copy(update={"readout": readout}), "noise": "measured"}
    return MicrographStack(counts, AXIS, AXIS, dwell=1.0, stage_position=np.array([*stage, -1660.0]), **about)


def test_scans_are_joined_over_the_stage(bshem):
    """Cubic backgrounds of two windows give that of a third place, to 1e-5. Catches a wrong place, scale or axis."""
    readout = readout_of(bshem, [(0.0, 0.0), (900.0, -400.0)])
    assert readout.stage_um == pytest.approx((450.0, -200.0, -1660.0)) and readout.window_um == pytest.approx(
        (1050.0, 800.0)
    )
    found = shared_background(scan(bshem, readout, (500.0, 100.0)), readout)
    x, y = np.meshgrid(AXIS + 500.0, AXIS + 100.0)
    for k in range(3):
        assert found.mean[k] == pytest.approx(hill(x, y, k), rel=1e-5)
    assert found.is_placed and found.signal == pytest.approx(SIGNAL)


def test_errors_are_as_stated(bshem):
    """200 draws of the errors: pulls of the level have the standard deviation 1 +- 0.1 (a false alarm in 1e4).

    Joined by their covariance, two scans know the level better than one. Catches variances that are added, and a
    covariance that does not move with the window.
    """
    pulls, alone, both = [], [], []
    for seed in range(200):
        two, one = (readout_of(bshem, [(0.0, 0.0), (300.0, 200.0)][:n], 20.0, seed) for n in (2, 1))
        stack = scan(bshem, two, (150.0, 50.0))
        found, known = shared_background(stack, two), shared_background(stack, one)
        x, y = np.meshgrid(AXIS + 150.0, AXIS + 50.0)
        true = np.array([hill(x, y, k).mean() for k in range(3)])
        pulls.append((found.mean.mean((1, 2)) - true) / found.level_std)
        alone.append(known.level_std)
        both.append(found.level_std)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1)
    assert np.mean(both) < 0.8 * np.mean(alone)


def test_an_unknown_stage_leaves_the_hill_unknown(bshem):
    """Without a stage position the mean is expected, and the hill is in both errors. Catches a hill at x = y = 0."""
    readout = readout_of(bshem, [(0.0, 0.0)])
    stack = scan(bshem, readout, (0.0, 0.0)).replace(stage_position=None)
    found = shared_background(stack, readout)
    x, y = np.meshgrid(AXIS, AXIS)
    for k in range(3):
        assert np.ptp(found.mean[k]) < 1e-9
        spread = hill(x, y, k).std()
        assert found.level_std[k] == pytest.approx(spread, rel=0.15)
        assert found.shape_std[k] == pytest.approx(spread, rel=0.15)


def test_the_border_takes_it_or_names_what_disagrees(bshem):
    """Right: background and gain to 0.5 %, of a brighter sample, too. One offset is wrong by half the signal: told.

    Catches gains from the darkest pixels of a sample that masks nothing (here off by 30 % and more), and a read-out of
    another campaign that is believed.
    """
    readout = readout_of(bshem, [(0.0, 0.0), (900.0, -400.0)], 2.0)
    flat = np.asarray(substrate_signal(Optics.of(bshem)))
    for brightness in (1.0, 1.3):
        found = calibrate(scan(bshem, readout, (500.0, 100.0), noise=20.0, brightness=brightness))
        record = found.provenance["calibrate"]
        assert record["background_from"] == "campaign" and not found.calibration.warnings
        assert record["gain"] == pytest.approx(brightness * SIGNAL / flat, rel=0.005)
        assert found.calibration.priors["offset_std"] == pytest.approx(0.02, rel=0.1)
        assert found.calibration.priors["drift_std"] < 0.06
    wrong = calibrate(scan(bshem, readout, (500.0, 100.0), noise=20.0, offset=(0.0, 0.5, 0.0)))
    (text,) = wrong.calibration.warnings
    assert "NOT used" in text and repr(bshem.detector_names[1]) in text
    assert wrong.provenance["calibrate"]["background_from"] == "darkest pixels"
    assert wrong.calibration.priors["offset_std"] == 0.3
    unused = calibrate(scan(bshem, readout, (500.0, 100.0), noise=20.0), readout=False)
    assert unused.provenance["calibrate"]["background_from"] == "darkest pixels" and not unused.calibration.warnings
    raised = scan(bshem, readout, (500.0, 100.0), noise=20.0)
    raised = calibrate(raised.replace(stage_position=np.array([500.0, 100.0, -1560.0])))
    assert "+100 um" in raised.calibration.warnings[0]
    assert raised.provenance["calibrate"]["background_from"] == "campaign"
    far = calibrate(scan(bshem, readout, (9000.0, 100.0), noise=20.0))
    assert "outside of the stage window" in far.calibration.warnings[0]


def test_counts_of_another_dwell_time_are_scaled(bshem):
    """Twice the dwell time: twice the background. Catches a background in counts that knows no time."""
    readout = readout_of(bshem, [(0.0, 0.0)])
    stack = scan(bshem, readout, (0.0, 0.0))
    once, twice = (shared_background(stack.replace(dwell=t), readout) for t in (1.0, 2.0))
    assert twice.mean == pytest.approx(2.0 * once.mean) and twice.level_std == pytest.approx(2.0 * once.level_std)


def test_a_readout_of_other_detectors_is_refused(bshem):
    """Catches a background that is given to the detector of the same number."""
    readout = readout_of(bshem, [(0.0, 0.0)])
    others = tuple(d.model_copy(update={"name": f"other {i}"}) for i, d in enumerate(readout.detector))
    with pytest.raises(SceneError, match="not of detector"):
        calibrate(scan(bshem, readout.model_copy(update={"detector": others}), (0.0, 0.0), noise=20.0))


def test_it_comes_back_from_the_files(bshem, tmp_path):
    """Read-out and stage position in the instrument file and in the stack. Catches one that is lost on the way."""
    readout = readout_of(bshem, [(0.0, 0.0)], 5.0)
    stack = scan(bshem, readout, (500.0, 100.0))
    write_calibrated(stack.instrument, tmp_path / "found.toml", "a calibration")
    read = load_instrument(tmp_path / "found.toml").readout
    assert read is not None
    for again, first in zip(read.detector, readout.detector, strict=True):
        assert again.background == pytest.approx(first.background, rel=1e-5)
        assert again.covariance() == pytest.approx(first.covariance(), rel=1e-3)
    write(stack, tmp_path / "scan.h5")
    back = read_stack(tmp_path / "scan.h5")
    assert back.stage_position == pytest.approx(stack.stage_position) and back.instrument.readout == readout
