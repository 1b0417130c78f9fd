"""Simulation against experiment: normalisation, shift of the sample, verdicts, and evidence for effects."""

import json

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law
from stats import assert_likely

from helio_jax import load_scene, simulate
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.scores.agreement import Terms, find_shift, lagged, normalise
from helio_jax.workflows.compare import compare

SCENE = """
name = "cap"
[beam]
incidence_deg = 30.0
pinhole_radius_um = 1.0
source_size_mrad = 0.5
[plate]
kind = "transparent"
working_distance_um = 3000.0
sample_distance_um = 3500.0
[[detector]]
name = "forward"
polar_deg = 40.0
azimuth_deg = 0.0
half_angle_deg = 12.0
[[detector]]
name = "left"
polar_deg = 40.0
azimuth_deg = 120.0
half_angle_deg = 12.0
[[detector]]
name = "right"
polar_deg = 40.0
azimuth_deg = -120.0
half_angle_deg = 12.0
[sample]
kind = "spheres"
size_um = 8000.0
[[sample.spheres]]
radius_um = 1000.0
cap_height_um = 400.0
[scan]
nx = 25
ny = 25
pixel_size_um = 130.0
pitch = "sample"
[trace]
rays = 16
branches = 4
n_orders = 2
"""


def blob_stack(rng, gain=4e5, offset=5000.0):
    """Return a signal on 40 x 40 pixels and a Poisson measurement of it with offset, drift and slope along the rows."""
    detector = Detector(name="a", polar_deg=40.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=(detector,))
    axis = np.arange(40) * 20.0
    time, along = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40), indexing="ij")
    signal = 0.02 + 0.01 * np.exp(-((time - 0.1) ** 2 + (along + 0.2) ** 2) / 0.1)[None]
    mean = gain * signal + offset + 300.0 * time**2 + 100.0 * time + 80.0 * along
    counts = rng.poisson(mean).astype(float)
    return signal, MicrographStack(counts, axis, axis, instrument, variance=mean, noise="measured")


def test_normalise_recovers_gain_and_offset():
    """Known gain, offset and drift are recovered within 5 standard errors, and chi-square is that of noise.

    Rejects 3 % of the gain (0.5 % standard error); catches a missing term, swapped axes and a missing weight.
    """
    signal, stack = blob_stack(np.random.default_rng(1))
    found = normalise(stack, signal)
    assert found.gain[0] == pytest.approx(4e5, rel=0.02)
    total, dof = float(np.nansum(found.residuals**2)), found.n_data - found.n_parameters
    assert_likely(2 * min(chi2_law.sf(total, dof), chi2_law.cdf(total, dof)), "chi-square of the normalised blob")
    assert "agree within" in found.verdict()
    assert found.bic < normalise(stack, signal, Terms(drift=0)).bic < normalise(stack, signal, Terms(offset=False)).bic


def test_a_drifting_gain_is_separated_from_a_drifting_background():
    """A gain that falls by 30 % over the scan is found to 3 %, with the chi-square of noise.

    A drift of the background does not fit. Catches a drift along the fast axis, and parameters that are not counted.
    """
    signal, stack = blob_stack(np.random.default_rng(3))
    time = np.linspace(-1.0, 1.0, 40)[:, None]
    stack = stack.replace(counts=stack.counts - 0.15 * 4e5 * signal * time)
    steady, drifting = normalise(stack, signal), normalise(stack, signal, Terms(gain_drift=1))
    assert drifting.n_parameters == steady.n_parameters + 1
    assert drifting.gain[0] == pytest.approx(4e5, rel=0.02)
    assert drifting.gain_drift[0, 0] == pytest.approx(-0.15, abs=0.015)
    assert drifting.bic < steady.bic - 10.0
    total, dof = float(np.nansum(drifting.residuals**2)), drifting.n_data - drifting.n_parameters
    assert_likely(2 * min(chi2_law.sf(total, dof), chi2_law.cdf(total, dof)), "chi-square with a drifting gain")


def test_scratches_do_not_set_the_gain():
    """Three bright scratches change the gain by less than 1 % and are flagged; catches least squares."""
    signal, stack = blob_stack(np.random.default_rng(2))
    counts = stack.counts.copy()
    counts[0, ::12, 5:30] += 4000.0
    found = normalise(stack.replace(counts=counts), signal)
    assert found.gain[0] == pytest.approx(4e5, rel=0.02)
    assert found.is_flagged[::12, 5:30].all() and found.is_flagged.mean() < 0.1


def test_negative_contrast_is_refused():
    """An inverted image does not fit this scene: the message names the detector and the remedy."""
    signal, stack = blob_stack(np.random.default_rng(3))
    with pytest.raises(GuardError, match=r"'a'.*orientation"):
        normalise(stack, 0.05 - signal)


def test_lag_is_an_exponential_along_each_line():
    """A step becomes 1 - exp(-n / lag) from its pixel on; lines start settled; the slow axis is unchanged."""
    step = np.zeros((3, 12))
    step[1:, 5:] = 1.0
    exact = 1.0 - np.exp(-(np.arange(7) + 1.0) / 2.0)
    assert lagged(step, 2.0, True)[1, 5:] == pytest.approx(exact, rel=1e-12)
    assert np.all(lagged(step, 2.0, True)[0] == 0) and np.all(lagged(step, 0.0, True) == step)
    assert lagged(step.T, 2.0, False) == pytest.approx(lagged(step, 2.0, True).T)


def test_find_shift():
    """A known subpixel shift of a blob is found within 0.15 pixel in each direction; catches swapped axes."""
    signal, stack = blob_stack(np.random.default_rng(4))
    time, along = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40), indexing="ij")
    dx, dy = 0.1, -0.15  # of the half field, 19.5 pixels
    elsewhere = 0.02 + 0.01 * np.exp(-((time - 0.1 - dy) ** 2 + (along + 0.2 - dx) ** 2) / 0.1)[None]
    x, y = find_shift(stack, elsewhere)
    assert x / 20.0 == pytest.approx(-dx * 19.5, abs=0.15) and y / 20.0 == pytest.approx(-dy * 19.5, abs=0.15)
    assert signal.shape == elsewhere.shape


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("compare") / "cap.toml"
    path.write_text(SCENE)
    return path


def measured(scene_path, overrides):
    """Return a scan with counting noise, background and another gain per detector, of a changed scene."""
    found = simulate(load_scene(scene_path, overrides))
    gain, offset = np.array([6e4, 4e4, 2e4])[:, None, None], np.array([1200.0, 1000.0, 1100.0])[:, None, None]
    mean = gain * found.counts / found.n_rays + offset
    counts = np.random.default_rng(5).poisson(mean).astype(float)
    return MicrographStack(counts, found.x, found.y, found.instrument, variance=mean, noise="measured", name="scan")


def test_compare_finds_the_sample_and_agrees(scene_path, tmp_path):
    """The same cap, 150 um off: found within 15 um, chi-square that of noise, files written; a flatter cap differs.

    Catches a shift of the wrong sign (simulated at the wrong place, the caps would not overlap), and a verdict that
    does not depend on the data.
    """
    data = measured(scene_path, {"sample.spheres.0.center_um": [150.0, -60.0]})
    found = compare(data, scene_path)
    assert found.agreement.shift == pytest.approx((150.0, -60.0), abs=15.0)
    assert np.mean(found.agreement.chi2) < 1.2 and "agree within" in found.agreement.verdict()
    assert found.height == pytest.approx(400.0, rel=0.15)
    files = found.write(tmp_path)
    assert json.loads(files[0].read_text())["chi2_per_pixel"] < 1.2 and files[1].stat().st_size > 20_000
    flatter = compare(data, scene_path, overrides={"sample.spheres.0.cap_height_um": 300.0})
    assert "differ" in flatter.agreement.verdict()


def test_explain_names_the_effect(scene_path, tmp_path):
    """Data of a rough-diffuse surface: of all effects that law has the best evidence; no effect is lost silently.

    Catches a table whose rows do not simulate their effects, and a BIC of the wrong sign.
    """
    rough = {"material.r": {"kind": "rough_diffuse", "roughness": 0.3}, "sample.spheres.0.material": "r"}
    data = measured(scene_path, rough | {"sample.material": "r"})
    found = compare(data, scene_path, explain=True)
    known = {row.name: row.d_bic for row in found.effects if not row.note}
    assert min(known, key=known.get).startswith("rough-diffuse") and min(known.values()) < -10
    assert len(known) >= 15, [row for row in found.effects if row.note]
    assert all(path.is_file() for path in found.write(tmp_path))


def test_other_detectors_are_refused(scene_path):
    """The message names both lists of detectors and the remedy."""
    _, stack = blob_stack(np.random.default_rng(6))
    with pytest.raises(SceneError, match=r"forward.*'a'.*--instrument"):
        compare(stack, scene_path)


def test_what_is_no_single_raster_is_refused_before_simulating(scene_path):
    """Catches: a list read as a raster, a height map's traceback, a scene's views blamed on the data, time lost."""
    data = measured(scene_path, {"trace.rays": 8, "scan.nx": 5, "scan.ny": 5})
    row = MicrographStack(
        data.counts[:, :1], data.x, data.y[:1], data.instrument, positions=np.zeros((5, 2)), name="row"
    )
    refused = [
        (row, {}, InputFileError, "row: comparing needs a raster, this scan is a list of 5 positions"),
        (data.instrument, {}, InputFileError, "with micrographs, got Instrument: name a scan's file"),
        (MicrographSet((data, data)), {}, InputFileError, r"set of 2 scans .*stacks\[0\]"),
        (
            data,
            {"scan.rotations_deg": [0.0, 90.0]},
            SceneError,
            "cap.toml: scan has 2 views, comparing needs one: remove",
        ),
    ]
    for given, overrides, error, message in refused:
        with pytest.raises(error, match=message):
            compare(given, scene_path, overrides=overrides, progress=pytest.fail)
