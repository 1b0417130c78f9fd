"""The areal autocorrelation function and its parameters: autocorrelation length Sal, texture aspect ratio Str."""

import math

import numpy as np
from scipy import fft, ndimage

THRESHOLD = 0.2
"""Value to which the autocorrelation decays (the standard's default)."""
_LARGEST_LAG = 0.5
"""Largest lag, as a share of the field's sides: beyond it too few pairs are left."""
_STEP = 0.25
"""Step along a ray [pitches]."""


def autocorrelation(z: np.ndarray) -> np.ndarray:
    """Compute the autocorrelation of heights, 1 at lag 0, for lags of at most half the sides [2 ny + 1, 2 nx + 1].

    Each value is the mean product of all pairs of known heights at that lag, over the mean square of all.

    Args:
        z: deviations from their mean [y, x], um; NaN: unknown.

    Source: ISO 25178-2:2021 (autocorrelation function); estimated as in Bendat and Piersol, Random Data, 11.4
        (zero-padded FFT, divided by the number of pairs).
    """
    is_known = np.isfinite(z)
    size = [fft.next_fast_len(2 * n, real=True) for n in z.shape]
    square = lambda a: np.asarray(fft.irfft2(np.abs(np.asarray(fft.rfft2(a, size))) ** 2, size))  # noqa: E731
    products, pairs = square(np.where(is_known, z, 0.0)), np.round(square(is_known.astype(float)))
    mean = np.where(pairs > 0, products / np.maximum(pairs, 1.0), np.nan)
    lags = [np.arange(-m, m + 1) for m in (int(_LARGEST_LAG * n) for n in z.shape)]
    return (mean / mean[0, 0])[np.ix_(*lags)]


def spatial_parameters(z: np.ndarray, steps: tuple[float, float]) -> dict[str, float]:
    """Compute Sal [um] and Str from the distance at which the autocorrelation first falls to 0.2, in all directions.

    Sal is the smallest distance, Str the smallest over the largest. Sal is NaN where there is no decay in any
    direction within half the field. Str is NaN where there is none in some direction: the texture is longer than that.

    Args:
        z: deviations from their mean [y, x], um; NaN: unknown.
        steps: pitch along y and x [um].

    Source: ISO 25178-2:2021 (Sal, Str); tests/unit/test_texture.py.
    """
    if not np.nanmax(np.abs(z)) > 0.0:
        return {"Sal": math.nan, "Str": math.nan}
    return decay_lengths(autocorrelation(z), steps)


def decay_lengths(acf: np.ndarray, steps: tuple[float, float]) -> dict[str, float]:
    """Compute Sal [um] and Str of an autocorrelation function [2 my + 1, 2 mx + 1] with its lag 0 in the middle."""
    if not np.isfinite(acf).all():
        acf = np.where(np.isfinite(acf), acf, 1.0)  # lags without a pair: no decay is seen there
    spline = ndimage.spline_filter(acf, order=3, mode="nearest")
    half = [(n - 1) // 2 for n in acf.shape]
    reach = math.hypot(*(n * s for n, s in zip(half, steps, strict=True)))
    radii = np.arange(0.0, reach, _STEP * min(steps))

    def decay(angles: np.ndarray) -> np.ndarray:
        """Return the distance [um] of the first fall to the threshold in each direction; inf: none in the field."""
        row = half[0] + np.sin(angles)[:, None] * radii / steps[0]
        column = half[1] + np.cos(angles)[:, None] * radii / steps[1]
        value = ndimage.map_coordinates(spline, [row, column], order=3, mode="nearest", prefilter=False)
        inside = (row >= 0) & (row <= 2 * half[0]) & (column >= 0) & (column <= 2 * half[1])
        is_below = inside & (value <= THRESHOLD)
        last = np.argmax(is_below, axis=1)
        k = np.arange(angles.size)
        before, after = value[k, last - 1], value[k, last]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = radii[last - 1] + (radii[1] - radii[0]) * (before - THRESHOLD) / (before - after)
        return np.where(is_below.any(axis=1), distance, np.inf)

    angles = np.radians(np.arange(0.0, 180.0, 1.0))
    coarse = decay(angles)
    if not np.isfinite(coarse).any():
        return {"Sal": math.nan, "Str": math.nan}
    fine = np.radians(np.arange(-1.0, 1.001, 0.04))
    shortest = float(decay(angles[np.argmin(coarse)] + fine).min())
    longest = float(decay(angles[np.argmax(coarse)] + fine).max())
    return {"Sal": shortest, "Str": shortest / longest if math.isfinite(longest) else math.nan}
