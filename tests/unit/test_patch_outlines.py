"""Outlines of patches that are moved to where the signals change."""

import numpy as np
import pytest

from helio_jax.inverse.patch_outlines import with_outlines_moved

Y, X = np.mgrid[:30, :34]
LIT = np.array([100.0, 100.0, 100.0])


def images(is_high, rng, snr):
    """Make signals of a mesa on a ground: a mask to the right of it for one detector, glow around it for the others."""
    band = np.roll(is_high, 6, axis=1) & ~is_high
    distance = np.min([np.hypot(Y - y, X - x) for y, x in np.argwhere(is_high)], axis=0)
    glow = np.where(is_high, 0.0, np.exp(-distance / 6.0))
    signal = LIT[:, None, None] * np.stack([np.where(band, 0.1, 1.0 + 0.2 * glow), 1.0 + 0.6 * glow, 1.0 + 0.4 * glow])
    variance = signal * LIT[0] / snr**2
    return signal + np.sqrt(variance) * rng.standard_normal(signal.shape), variance


@pytest.mark.parametrize("snr", [30.0, 100.0])
def test_rows_on_the_wrong_side_change_it(snr):
    """A row too much on one side of a mesa and one too few on another: all but 2 of 25 pixels are put right.

    Right outlines stay: none of 40 draws moves a pixel. Rejects the comparison with all of a patch instead of what is
    near (up to 16 pixels stay wrong, in the band).
    """
    rng = np.random.default_rng(0)
    is_high = (X > 8) & (X < 20) & (Y > 6) & (Y < 22)
    wrong = (X > 8) & (X < 21) & (Y > 7) & (Y < 22)
    for _ in range(40):
        data = images(is_high, rng, snr)
        assert np.array_equal(with_outlines_moved(is_high.astype(int), *data, LIT), is_high)
        found = with_outlines_moved(wrong.astype(int), *data, LIT)
        assert np.sum(wrong != is_high) == 25 and np.sum(found != is_high) <= 2


def test_narrow_patches_and_dead_pixels_stay():
    """A strip two pixels wide has no pixel that is not beside its outline; a pixel without data shows nothing."""
    rng = np.random.default_rng(1)
    is_high = (X > 8) & (X < 20) & (Y > 6) & (Y < 22)
    signal, variance = images(is_high, rng, 50.0)
    strip = np.where((X > 24) & (X < 27), 2, is_high.astype(int))
    assert np.array_equal(with_outlines_moved(strip, signal, variance, LIT), strip)
    signal[:, 10:14, 19] = np.nan
    found = with_outlines_moved(is_high.astype(int), signal, variance, LIT)
    assert np.array_equal(found, is_high)
