"""What is estimated from measured images alone: noise, spikes, scan lines, drift modes; seeds are fixed."""

import numpy as np
import pytest

from helio_jax.arrays import border_mask
from helio_jax.calibration.noise_model import NoiseModel, estimate_noise, find_spikes, line_noise
from helio_jax.errors import InputFileError, SceneError
from helio_jax.forward.readout import ScanOrder, drift_modes
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.pipeline import calibrate


def measured(bshem, counts, fast_axis="x", **fields) -> MicrographStack:
    """Return counts [detector, y, x] as a measured stack."""
    ny, nx = counts.shape[1:]
    axes = {"x": 30.0 * np.arange(nx), "y": 30.0 * np.arange(ny)}
    return MicrographStack(counts, **axes, instrument=bshem, fast_axis=fast_axis, noise="measured", **fields)


@pytest.mark.parametrize(("constant", "per_count"), [(4000.0, 1.0), (9000.0, 0.0), (0.0, 1.3)])
def test_noise_model(bshem, constant, per_count):
    """Variance a + b counts on a slope of counts 2000 to 10000, with drift from line to line: 10 % at both ends.

    23 000 pixels give the variance of each of 8 bins to 4 % (median of squares); a slope of counts alone would be
    taken for noise by first differences. Rejects a variance taken across lines, where drift is.
    """
    rng = np.random.default_rng(1)
    mean = np.broadcast_to(np.linspace(2000.0, 10_000.0, 152), (3, 152, 152))
    drift = 500.0 * rng.standard_normal((3, 152, 1))
    counts = mean + drift + np.sqrt(constant + per_count * mean) * rng.standard_normal(mean.shape)
    found = estimate_noise(measured(bshem, counts))
    for level in (2500.0, 9500.0):
        assert found.constant + found.per_count * level == pytest.approx([constant + per_count * level] * 3, rel=0.1)
    turned = estimate_noise(measured(bshem, counts.swapaxes(1, 2), "y"))
    assert turned.constant == pytest.approx(found.constant) and turned.per_count == pytest.approx(found.per_count)


def test_spikes_but_no_edges(bshem):
    """One hot and one dead pixel are found; a step, a wide particle and 6 sigma noise of 8000 pixels are not."""
    rng = np.random.default_rng(2)
    counts = 5000.0 + 70.0 * rng.standard_normal((3, 50, 55))
    counts[:, :, 30:] += 2000.0
    counts[0, 10, 10], counts[2, 40, 0], counts[1, 20:22, 20:22] = 9000.0, 0.0, 9000.0
    variance = np.full(counts.shape, 4900.0)
    found = find_spikes(measured(bshem, counts), variance, 6.0)
    assert np.argwhere(found).tolist() == [[0, 10, 10], [2, 40, 0]]


@pytest.mark.parametrize("fast_axis", ["x", "y"])
def test_line_noise(bshem, fast_axis):
    """Offsets of 60 counts per line in noise of 100 are found to 20 % (120 lines leave 10 % of the median's spread).

    The border is 20 pixels of a line, so the pixels alone would make 22. Rejects forgetting them in a stack without
    line noise (22 instead of less than 8) and the wrong axis (0).
    """
    rng = np.random.default_rng(3)
    noise = 100.0 * rng.standard_normal((3, 120, 120))
    lines = 60.0 * rng.standard_normal((3, 120, 1))
    frame = border_mask((120, 120), 0.083)
    for counts, low, high in ((noise + lines, 48.0, 72.0), (noise, 0.0, 12.0)):
        turned = counts if fast_axis == "x" else counts.swapaxes(1, 2)
        stack = measured(bshem, turned, fast_axis, variance=np.full(turned.shape, 1e4))
        found = line_noise(stack, turned, frame)
        assert np.all((found >= low) & (found <= high)), found


def test_drift_modes_are_what_they_say():
    """No constant, root mean square 1 / degree, slow along the slow axis. Catches exchanged axes."""
    modes = drift_modes((400, 300), ScanOrder(0), (4, 3))[0]
    assert len(modes) == 10
    assert np.abs(modes.mean((1, 2))).max() < 0.02
    assert modes[0] == pytest.approx(np.broadcast_to(modes[0][:1], (400, 300)))  # degree 1 along x, the fast axis
    assert np.sqrt((modes[0] ** 2).mean()) == pytest.approx(1.0, rel=0.01)
    assert drift_modes((300, 400), ScanOrder(1), (4, 3))[0] == pytest.approx(modes.swapaxes(1, 2))


def test_drift_modes_of_aligned_scans():
    """Of every scan those of its own time, whatever the raster's axes: degree 1 is the time. Catches raster rows."""
    across = np.linspace(-1.0, 1.0, 401)
    time = np.stack([np.broadcast_to(across, (3, 401)), np.broadcast_to(-across, (3, 401))])
    modes = drift_modes((3, 401), ScanOrder(0, time), (3, 2))
    assert modes.shape == (2, 3, 3, 401)
    assert modes[:, 0] == pytest.approx(np.sqrt(3.0) * time)
    assert np.sqrt((modes**2).mean((2, 3))) == pytest.approx(np.tile(1.0 / np.arange(1, 4), (2, 1)), rel=0.01)
    assert modes[1, 1] == pytest.approx(modes[0, 1]) and modes[1, 2] == pytest.approx(-modes[0, 2])


def test_a_known_beam_is_not_calibrated_again(bshem):
    """A simulated or calibrated stack is refused with the reason. Catches a second division by the gain."""
    stack = measured(bshem, np.ones((3, 20, 20)), n_rays=1.0)
    with pytest.raises(SceneError, match="calibrated already"):
        calibrate(stack)


def test_variance_beside_pixels_that_were_not_recorded(bshem):
    """A ramp with a hole: what is there has its own variance. Catches a median that takes NaN along, a detector of NaN.

    And a stack refuses a variance that is not a number where it was recorded: one such pixel makes all heights NaN.
    """
    counts = np.broadcast_to(np.linspace(1000.0, 3000.0, 40), (3, 40, 40)).copy()
    whole = NoiseModel(np.full(3, 100.0), np.ones(3)).variance(counts)
    counts[0, 10:17, 10:17], counts[2] = np.nan, np.nan
    found = NoiseModel(np.full(3, 100.0), np.ones(3)).variance(counts)
    known = np.isfinite(counts)
    assert found[known] == pytest.approx(whole[known], rel=0.1) and np.all(np.isfinite(found))
    with pytest.raises(InputFileError, match="variance must be >= 0, got nan"):
        measured(bshem, np.ones((3, 4, 5)), variance=np.full((3, 4, 5), np.nan))
