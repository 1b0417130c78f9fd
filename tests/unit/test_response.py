"""Lag, drift and what a measured file does not tell: closed forms, a fine integration in time, and statistics."""

import math

import numpy as np
import pytest
from stats import assert_likely, assert_mean, pooled_chi2

from helio_jax.calibration.noise import NoiseSettings, add_noise
from helio_jax.calibration.response import ScanTime, lagging, slow_drift
from helio_jax.errors import SceneError
from helio_jax.micrograph import MicrographStack

TIME = ScanTime(dwell=0.3, move=0.1, flyback=0.7, fast_axis="x")


def test_step_response():
    """After a step the k-th pixel lacks (tau / T)(1 - exp(-T / tau)) exp(-(k (T + m) + m) / tau) of it, to 1e-12.

    Catches a lag per pixel instead of per second, counts at the end of the dwell time instead of over it, and time that
    runs backwards.
    """
    tau, image = 0.5, np.concatenate([np.full(6, 2.0), np.full(9, 10.0)])[None]
    found = lagging(image, tau, TIME)[0]
    k = np.arange(9)
    lack = tau / 0.3 * -math.expm1(-0.3 / tau) * np.exp(-(0.4 * k + 0.1) / tau)
    np.testing.assert_allclose(found[:6], 2.0, rtol=1e-12)
    np.testing.assert_allclose(found[6:], 10.0 - 8.0 * lack, rtol=1e-12)
    np.testing.assert_allclose(lagging(image, 1e-9, TIME), image, rtol=1e-6)
    assert lagging(image, 0.0, TIME) is image


@pytest.mark.parametrize("fast_axis", ["x", "y"])
def test_lag_is_a_detector_of_first_order(fast_axis):
    """A random raster against 4000 Euler steps per pixel, fly-back included, for several images at once.

    Catches a fly-back that is left out or put at the end of the scan, and columns taken for rows.
    """
    image = np.random.default_rng(2).uniform(0, 5, (2, 3, 4))
    time, tau = ScanTime(0.3, 0.1, 0.7, fast_axis), 0.6
    found = lagging(image, tau, time)
    for k in range(2):
        lines = image[k] if fast_axis == "x" else image[k].T
        expected, r, n = np.empty(lines.shape), lines[0, 0], 4000
        for i, j in np.ndindex(lines.shape):
            wait = 0.1 + (0.7 if j == 0 and i > 0 else 0.0)
            for _ in range(n):
                r += (lines[i, j] - r) * wait / n / tau
            total = 0.0
            for _ in range(n):
                r += (lines[i, j] - r) * 0.3 / n / tau
                total += r / n
            expected[i, j] = total
        np.testing.assert_allclose(found[k], expected if fast_axis == "x" else expected.T, rtol=1e-3)


def test_drift_is_slow():
    """Over 400 scans: mean 0, variance 1, correlation exp(-t / tau) along a line and across the fly-back.

    A correlation wrong by 0.06 is rejected. Catches lines that begin anew, and a fly-back without time.
    """
    tau = 2.0
    d = slow_drift((400, 5, 6), tau, TIME, [3, 1])

    def check(products: np.ndarray, expected: float, what: str) -> None:
        per_scan = products.reshape(400, -1).mean(1)
        assert_mean(float(per_scan.mean()), expected, float(per_scan.std(ddof=1)) / 20.0, what)

    check(d, 0.0, "mean")
    check(d**2, 1.0, "variance")
    check(d[:, :, 2:] * d[:, :, :-2], math.exp(-0.8 / tau), "two pixels on")
    check(d[:, 1:, 0] * d[:, :-1, -1], math.exp(-1.1 / tau), "the next line")
    assert not np.array_equal(d[0], d[1]) and np.array_equal(d, slow_drift((400, 5, 6), tau, TIME, [3, 1]))


def stack_of(bshem, level: float) -> MicrographStack:
    counts = np.full((3, 60, 50), level)
    by_order = np.stack([0.75 * counts, 0.25 * counts])
    return MicrographStack(counts, np.arange(50.0), np.arange(60.0), bshem, by_order=by_order, n_rays=1000.0)


def test_recorded_counts(bshem):
    """A flat scene: Poisson about gain * expected + background; with drift the background wanders by as much as asked.

    9000 counts by chi-square (3 % of the mean is rejected). Catches noise drawn before the gain, and a drift of the
    gain instead of the background.
    """
    settings = NoiseSettings(gain=(2.0, 1.0, 0.5), background_per_pixel=100.0, lag_s=0.2, dwell_s=0.1)
    noisy = add_noise(stack_of(bshem, 400.0), settings)
    expected = np.broadcast_to(np.array([900.0, 500.0, 300.0])[:, None, None], noisy.shape)
    assert_likely(pooled_chi2(noisy.counts, expected, 0 * expected), "recorded counts")
    assert pooled_chi2(noisy.counts, 1.03 * expected, 0 * expected) < 1e-6
    np.testing.assert_allclose(noisy.by_order.sum(0), expected - 100.0)
    assert noisy.dwell == 0.1 and noisy.fast_axis == "x" and noisy.background.tolist() == [100.0] * 3
    long = NoiseSettings(background_per_pixel=5000.0, drift_per_pixel=300.0, dwell_s=0.1, drift_time_s=20.0)
    drifting = add_noise(stack_of(bshem, 400.0), long).counts.mean(2)  # a line: 5 s, a quarter of the drift's time
    steps, spread = np.diff(drifting, axis=1).std(), drifting.std()
    assert 150.0 < spread < 450.0 and steps < 0.8 * spread


def test_as_measured(bshem):
    """Only counts, raster, instrument and times are left, with the variance that the counts suggest.

    Catches knowledge of the truth that a blind test of the reconstruction could use.
    """
    noisy = add_noise(stack_of(bshem, 400.0), NoiseSettings(as_measured=True, dwell_s=0.5, fast_axis="y"))
    assert noisy.noise == "measured" and noisy.n_rays is None and noisy.background is None and noisy.by_order is None
    assert noisy.masked is None and noisy.fast_axis == "y" and np.array_equal(noisy.variance, noisy.counts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lag_s": 0.1}, "noise.dwell_s is needed for noise.lag_s"),
        ({"drift_per_pixel": (1.0, 0.0, 0.0)}, "noise.dwell_s is needed for noise.drift_per_pixel"),
        ({"lag_s": (0.1, 0.2), "dwell_s": 1.0}, r"noise.lag_s must be one number or one per detector \(3\), got 2"),
        ({"lag_s": -1.0, "dwell_s": 1.0}, "noise.lag_s must be >= 0 s"),
        ({"drift_per_pixel": 300.0, "dwell_s": 1.0}, "raise noise.background_per_pixel"),
    ],
)
def test_wrong_settings_say_so(bshem, changes, message):
    """Catches a lag without times, and a negative mean that is clipped."""
    with pytest.raises(SceneError, match=message):
        add_noise(stack_of(bshem, 10.0), NoiseSettings(**changes))
