"""Scans of one orientation added up, and stacks whose pixels have dwell times of their own."""

import dataclasses

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.alignment.added_scans import add_by_orientation, add_scans
from helio_jax.alignment.orientation import Turn, bin_stack, turn_stack
from helio_jax.calibration.noise import NoiseSettings, add_noise
from helio_jax.errors import InputFileError, SceneError
from helio_jax.figures.summary import summarise
from helio_jax.inverse.linear import signal_of
from helio_jax.workflows.heights import calibrate

RATE = 400.0
"""Counts per second."""


def scan(bshem, dwell: float = 0.5, seed: int = 1, shape: tuple[int, int] = (5, 7), **changes) -> hx.MicrographStack:
    """Poisson counts of a flat rate, with a background of a tenth."""
    n = len(bshem.detector)
    counts = np.random.default_rng(seed).poisson(RATE * dwell, (n, *shape)).astype(float)
    given = {
        "counts": counts,
        "x": 30.0 * np.arange(shape[1]),
        "y": 30.0 * np.arange(shape[0]),
        "instrument": bshem,
        "variance": np.full(counts.shape, RATE * dwell),
        "background": np.full(n, 0.1 * RATE * dwell),
        "n_rays": 1e4 * dwell,
        "dwell": dwell,
        "noise": "poisson",
    }
    return hx.MicrographStack(**{**given, **changes})


def test_counts_and_times_add(bshem):
    """Two scans of 0.5 and 1.5 s: raw counts add, as do times; the scaled variance is that of the sum over its time.

    Rejects a plain mean (variance 0.67 of the first one's instead of 0.25), and counts scaled to the wrong time.
    """
    first, other = scan(bshem), scan(bshem, 1.5, 2)
    both = add_scans(first, other)
    assert np.allclose(both.counts * 2.0 / 0.5, first.counts + other.counts)
    assert both.dwell_map is not None and np.allclose(both.dwell_map, 2.0) and both.dwell == 0.5
    assert np.allclose(both.variance / first.variance, 0.25) and np.allclose(both.background, 0.1 * RATE * 0.5)
    assert both.n_rays == first.n_rays


def test_the_order_does_not_matter(bshem):
    """((a + b) + c) = (a + (b + c)). Catches weights that forget the times so far."""
    a, b, c = (scan(bshem, d, i) for i, d in enumerate((0.5, 0.2, 1.1)))
    left, right = add_scans(add_scans(a, b), c), add_scans(a, add_scans(b, c))
    for name in ("counts", "variance", "background", "dwell_map"):
        assert np.allclose(getattr(left, name), getattr(right, name))


def listed(bshem, points: np.ndarray, times: np.ndarray, **changes) -> hx.MicrographStack:
    """A list of positions (row, column) on the raster with dwell times; counts are exactly their expectation."""
    n = len(bshem.detector)
    counts = np.full((n, 1, len(points)), RATE * 0.5)
    given = {
        "counts": counts,
        "shape": None,
        "x": np.arange(float(len(points))),
        "y": np.zeros(1),
        "positions": 30.0 * points[:, ::-1].astype(float),
        "variance": RATE * 0.5 * 0.5 / times * np.ones((n, 1, 1)),
        "dwell_map": times[None],
    }
    given.pop("shape")
    return scan(bshem, 0.5, 3, (1, len(points)), **{**given, **changes})


def test_lists_are_put_on_the_raster(bshem):
    """Times of listed pixels add, twice where listed twice; others keep theirs. Catches swapped rows and columns."""
    points, times = np.array([[1, 6], [4, 2], [1, 6]]), np.array([0.25, 1.0, 0.5])
    (both,) = add_by_orientation([listed(bshem, points, times), scan(bshem)])
    expected = np.full((5, 7), 0.5)
    expected[1, 6] += 0.75
    expected[4, 2] += 1.0
    assert both.dwell_map is not None and np.allclose(both.dwell_map, expected)
    assert np.allclose(both.variance, RATE * 0.5 * 0.5 / expected)
    first = scan(bshem)
    assert np.allclose(both.counts[:, 4, 2], (first.counts[:, 4, 2] + 2.0 * RATE * 0.5) / 3.0)


def test_a_list_of_another_rotation_gets_a_raster(bshem):
    """Observed in its pixels only. Catches a list that is added to the wrong orientation."""
    points, times = np.array([[1, 6], [4, 2]]), np.array([0.25, 1.0])
    first, other = add_by_orientation([scan(bshem), listed(bshem, points, times, sample_rotation=1.0)])
    assert first.dwell_map is None and other.sample_rotation == 1.0
    assert other.is_observed.sum() == 2 * len(bshem.detector) and other.dwell_map[4, 2] == 1.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sample_rotation": 0.5}, "rotations of the sample differ"),
        ({"dwell": None}, "states no dwell time"),
        ({"n_rays": 1e4}, "atoms per second must be the same"),
        ({"n_rays": None}, "must be known for both or for none"),
        ({"x": 31.0 * np.arange(7)}, "rasters differ"),
        ({"noise": "expected"}, "noise must be the same"),
    ],
)
def test_what_cannot_be_added_is_refused(bshem, changes, said):
    """Catches counts added that do not belong together."""
    with pytest.raises(InputFileError, match=said):
        add_scans(scan(bshem), scan(bshem, 1.5, 2).replace(**changes))


def test_positions_off_the_raster_are_refused(bshem):
    """Catches rounding to the next pixel, which would blur the image."""
    points = np.array([[1.0, 6.0], [2.0, 3.4]])
    with pytest.raises(InputFileError, match="1 others, the first at x = 102, y = 60 um"):
        add_scans(scan(bshem), listed(bshem, points, np.ones(2)))


def test_round_trip_and_words(bshem, tmp_path):
    """Bit for bit through a file; `helio info` states the times. Catches a field that is not written."""
    both = add_scans(scan(bshem), listed(bshem, np.array([[1, 6]]), np.array([0.7])))
    hx.write(both, tmp_path / "a.h5")
    back = hx.read(tmp_path / "a.h5")
    for field in dataclasses.fields(both):
        if isinstance(value := getattr(both, field.name), np.ndarray):
            assert np.array_equal(getattr(back, field.name), value, equal_nan=value.dtype != bool), field.name
    assert any("dwell times of 0.5 to 1.2 s" in text for _, text in summarise(back))
    assert "dwell_map" in {v.name for v in both.to_xarray().data_vars.values()}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dwell_map": np.ones((5, 6))}, "dwell_map must have the shape"),
        ({"dwell_map": -np.ones((5, 7))}, "finite times >= 0"),
        ({"dwell_map": np.zeros((5, 7))}, "got 0 at 35 such pixels"),
        ({"dwell_map": np.ones((5, 7)), "dwell": None}, "dwell must be > 0 s"),
    ],
)
def test_impossible_dwell_maps_are_refused(bshem, changes, said):
    """Catches counts without a time they were recorded in."""
    with pytest.raises(InputFileError, match=said):
        scan(bshem).replace(**changes)


def test_turning_and_binning_keep_them(bshem):
    """A turned stack has turned times; a binned one the means. Catches times left in the old frame."""
    times = 0.1 + np.arange(36.0).reshape(6, 6)
    stack = scan(bshem, shape=(6, 6), dwell_map=times)
    turn = Turn(90, False)
    turned = turn_stack(stack, turn, tuple(range(len(bshem.detector))))
    assert np.array_equal(turned.dwell_map, turn.image(times))
    assert np.allclose(bin_stack(stack, 3).dwell_map, times.reshape(3, 2, 3, 2).mean((1, 3)))


def test_noise_is_that_of_each_pixels_time(bshem):
    """Scaled counts of 4 s scatter half as much as those of 1 s, about one mean, to 6 standard errors.

    Rejects noise of the reference time in all pixels (a factor of 4 in the variance), and unscaled counts.
    """
    n, shape = len(bshem.detector), (60, 60)
    times = np.where(np.arange(60)[:, None] < 30, 1.0, 4.0) * np.ones(shape)
    clean = scan(bshem, 1.0, shape=shape, counts=np.full((n, *shape), RATE), variance=None, background=None,
                 noise="expected", dwell_map=times)  # fmt: skip
    noisy = add_noise(clean, NoiseSettings(background_per_pixel=RATE))
    quick, long = noisy.counts[:, :30], noisy.counts[:, 30:]
    for part, time in ((quick, 1.0), (long, 4.0)):
        variance = 2.0 * RATE / time
        assert abs(part.mean() - 2.0 * RATE) < 6.0 * np.sqrt(variance / part.size)
        assert abs(part.var() / variance - 1.0) < 6.0 * np.sqrt(2.0 / part.size)
    assert np.allclose(noisy.variance[:, [0, 59], 0], [2.0 * RATE, 0.5 * RATE])
    with pytest.raises(SceneError, match="lag_s"):
        add_noise(clean, NoiseSettings(lag_s=0.1, dwell_s=1.0))


def test_unknown_variance_goes_with_the_time(bshem):
    """Without a variance, data of twice the time have half of it. Catches equal weights."""
    times = np.where(np.arange(7) < 3, 0.5, 1.0) * np.ones((5, 7))
    _, variance = signal_of(scan(bshem, variance=None, dwell_map=times))
    assert np.allclose(variance[:, :, 0] / variance[:, :, -1], 2.0)


def test_calibration_wants_even_times(bshem):
    """Catches a noise model of mixed dwell times."""
    stack = scan(bshem, dwell_map=np.ones((5, 7)), n_rays=None, background=None, noise="measured")
    with pytest.raises(SceneError, match="calibrate the scans"):
        calibrate(stack)


def test_recorded_positions_are_added(bshem):
    """Raw counts of listed positions: the sum over the time, noise as the scan's for that time; elsewhere unchanged.

    Rejects counts taken for scaled ones, and the noise of the scan's own time.
    """
    first, times = scan(bshem), np.array([2.0, 0.25])
    xy = 30.0 * np.array([[2.0, 4.0], [6.0, 1.0]])
    raw = RATE * times * np.ones((len(bshem.detector), 1))
    both = hx.add_positions(first, xy, times, raw)
    assert np.allclose(both.counts[:, 4, 2] * 2.5 / 0.5, first.counts[:, 4, 2] + RATE * 2.0)
    assert np.allclose(both.variance[:, 4, 2] / first.variance[:, 4, 2], 0.5 / 2.5)
    assert np.allclose(both.background, first.background[:, None, None])
    elsewhere = both.dwell_map == 0.5
    assert elsewhere.sum() == 33 and np.array_equal(both.counts[:, elsewhere], first.counts[:, elsewhere])
    other = hx.add_positions(first, xy, times, raw, rotation_deg=120.0)
    assert other.sample_rotation == pytest.approx(np.radians(120.0)) and other.is_observed.sum() == raw.size
    assert np.allclose(other.variance[:, 1, 6], RATE * 0.5 * 0.5 / 0.25)


def test_recorded_positions_must_fit(bshem):
    """Catches counts that are given per position instead of per detector and position, and a time of 0."""
    first, xy = scan(bshem), np.array([[60.0, 120.0]])
    with pytest.raises(InputFileError, match="counts must have the shape"):
        hx.add_positions(first, xy, np.ones(1), np.ones(1))
    with pytest.raises(InputFileError, match="finite time > 0 s"):
        hx.add_positions(first, xy, np.zeros(1), np.ones((len(bshem.detector), 1)))
