"""Noise model of a measured scan, estimated from its images: pixel noise, spikes, offsets of scan lines.

Images are not corrected: spikes become unobserved pixels, noise becomes variance, the offsets of lines a prior standard
deviation of the fit. Images are those of a stack [detector, y, x]; along the fast axis neighbouring pixels follow one
another in time.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, median_filter, minimum_filter

from helio_jax.arrays import nearest_known, robust_std
from helio_jax.micrograph import MicrographStack

_BINS = 8
_MIN_PIXELS = 50
"""Bins of the noise model, and least number of pixels in a bin."""
_MIN_IN_LINE = 4
"""Least number of border pixels in a line, and of such lines, to estimate their offsets."""
_RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel = `constant` + `per_count` * counts, for every detector; counts as read."""

    constant: np.ndarray
    per_count: np.ndarray

    def variance(self, counts: np.ndarray) -> np.ndarray:
        """Compute the variance of every pixel [detector, y, x] from a smoothed image, not from single counts."""
        mean = np.stack([median_filter(_filled(image), 5, mode="nearest") for image in counts])
        return self.constant[:, None, None] + self.per_count[:, None, None] * np.maximum(mean, 0.0)


def _filled(image: np.ndarray) -> np.ndarray:
    """Fill missing pixels of an image [y, x] by the nearest known one; 0 if there is none."""
    known = np.isfinite(image)
    return image[nearest_known(known)] if known.any() else np.zeros(image.shape)


def time_last(stack: MicrographStack) -> np.ndarray:
    """Order the counts with the fast axis last [detector, line, pixel]; NaN where not observed."""
    counts = np.where(stack.is_observed, stack.counts, np.nan)
    return counts if stack.fast_axis == "x" else counts.swapaxes(1, 2)


def estimate_noise(stack: MicrographStack) -> NoiseModel:
    """Estimate constant and slope of the noise variance from second differences along the fast axis.

    Valid where the image is smooth over 3 pixels in more than half of its area. Neither coefficient is negative: where
    the best line has one that is, the other alone is fitted.

    Source: own derivation: a second difference of white noise has 6 times its variance, the median of its square 0.455
        times its mean; tests/unit/test_calibrate.py.
    """
    found = [_noise_line(image) for image in time_last(stack)]
    return NoiseModel(*np.array(found).T)


def _noise_line(image: np.ndarray) -> tuple[float, float]:
    second = image[:, 2:] - 2.0 * image[:, 1:-1] + image[:, :-2]
    level = (image[:, 2:] + image[:, 1:-1] + image[:, :-2]) / 3.0
    known = np.isfinite(second)
    second, level = second[known], level[known]
    if second.size < _MIN_PIXELS:
        return float(np.nanvar(image)), 0.0
    groups = np.array_split(np.argsort(level), min(_BINS, second.size // _MIN_PIXELS))
    x = np.array([level[g].mean() for g in groups])
    y = np.array([robust_std(second[g]) ** 2 / 6.0 for g in groups])
    weight = 1.0 / np.maximum(y, 1e-9 * y.max() + 1e-300)
    lines = []
    for columns in ([0, 1], [1], [0]):
        basis, line = np.stack([np.ones_like(x), x], 1), np.zeros(2)
        line[columns] = np.linalg.lstsq(basis[:, columns] * weight[:, None], y * weight, rcond=None)[0]
        if np.all(line >= 0):
            lines.append((float(np.sum(((y - basis @ line) * weight) ** 2)), line))
    line = min(lines, key=lambda entry: entry[0])[1]
    return float(line[0]), float(line[1])


def find_spikes(stack: MicrographStack, variance: np.ndarray, limit: float) -> np.ndarray:
    """Find single pixels that differ from all of their 8 neighbours by more than `limit` deviations [detector, y, x].

    Edges, scratches and particles two pixels wide are no spikes.

    Args:
        stack: as read.
        variance: of its pixels.
        limit: in standard deviations of the difference of two pixels.
    """
    counts = np.where(stack.is_observed, stack.counts, np.nan)
    high = maximum_filter(np.nan_to_num(counts, nan=-np.inf), footprint=_RING[None], mode="mirror")
    low = minimum_filter(np.nan_to_num(counts, nan=np.inf), footprint=_RING[None], mode="mirror")
    beyond = limit * np.sqrt(2.0 * variance)
    with np.errstate(invalid="ignore"):
        return (counts > high + beyond) | (counts < low - beyond)


def line_noise(stack: MicrographStack, steady: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of the offsets of single scan lines [detector], in counts.

    From the means of each line over the flat border, less the contribution of the pixels' noise. Correlation between
    neighbouring lines is included, slow drift, which is subtracted before, is not.

    Args:
        stack: with the variance of its pixels.
        steady: its counts without slow drift [detector, y, x].
        frame: the flat border [y, x].
    """
    axis = 2 if stack.fast_axis == "x" else 1
    use = frame & np.isfinite(steady)
    n = use.sum(axis)
    assert stack.variance is not None  # callers estimate it
    out = []
    for k, (image, known) in enumerate(zip(steady, use, strict=True)):
        enough = n[k] >= _MIN_IN_LINE
        if enough.sum() < _MIN_IN_LINE:
            out.append(0.0)
            continue
        mean = np.sum(np.where(known, image, 0.0), axis - 1)[enough] / n[k][enough]
        noise = np.sum(np.where(known, stack.variance[k], 0.0), axis - 1)[enough] / n[k][enough] ** 2
        spread = robust_std(mean - np.median(mean)) ** 2
        out.append(float(np.sqrt(max(spread - np.median(noise), 0.0))))
    return np.array(out)
