"""What a fit contradicts in the images of neighbours together is not valid, though no datum is far off alone."""

import numpy as np

from helio_jax.inverse.quality import ill_explained, reasons_from_fit

SHAPE = (3, 100, 80)
ALL = np.ones(SHAPE, bool)
INSIDE = np.zeros(SHAPE[1:], bool)
INSIDE[30:60, 20:50] = True


def noise(seed=0):
    return np.random.default_rng(seed).normal(size=SHAPE)


def test_noise_is_explained():
    """80 000 pixels; also where all images are twice as noisy as stated, and where there are few data."""
    few = ALL & (np.arange(SHAPE[2]) > 40)
    for seed in range(10):
        assert not ill_explained(noise(seed), ALL).any()
        assert not ill_explained(2.0 * noise(seed), ALL).any()
        assert not ill_explained(np.where(few, noise(seed), np.nan), few).any()


def test_an_area_that_the_fit_contradicts_is_told():
    """Residuals of 2.5 deviations, all of one sign: none is far off alone. Two detectors are enough."""
    residuals = noise() + 2.5 * INSIDE
    for is_observed in (ALL, ALL & np.array([True, True, False])[:, None, None]):
        found = ill_explained(np.where(is_observed, residuals, 0.0), is_observed)
        assert found[32:58, 22:48].mean() > 0.97
        assert not found[:28].any() and not found[62:].any() and not found[:, 52:].any()


def test_what_is_not_explained_is_no_height():
    """It is counted to the jumps, unless the data alone had a reason already."""
    reason = np.zeros(SHAPE[1:], np.uint8)
    reason[40:45, 20:30] = 1
    no_jump = np.zeros((100, 79), bool), np.zeros((99, 80), bool)
    out = reasons_from_fit(reason, ~INSIDE, np.full(SHAPE[1:], 3), *no_jump, np.zeros(SHAPE[1:], bool))
    assert np.all(out[reason == 1] == 1) and np.all(out[INSIDE & (reason == 0)] == 3) and not out[~INSIDE].any()
