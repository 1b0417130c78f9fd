"""Filters of areal surface texture: the Gaussian S-filter and L-filter, and the F-operator. Arrays in, arrays out.

Unknown heights are NaN. The filter is a normalised convolution: weights of unknown heights, and of those beyond the
border, are 0, and the sum is divided by the sum of the other weights. Nothing is extrapolated or filled.
"""

import math
from typing import Literal

import numpy as np
from scipy import fft

ALPHA = math.sqrt(math.log(2.0) / math.pi)
"""Constant of the Gaussian filter, 0.4697: a wave of the nesting index is transmitted by 50 %."""
_REACH = 7.0
"""Standard deviations beyond which a weight is nil."""
Form = Literal["none", "plane", "quadratic"]


def gaussian_mean(z: np.ndarray, nesting_um: float, steps: tuple[float, float]) -> np.ndarray:
    """Compute the Gaussian mean surface: S-filter; the L-filter subtracts it.

    The weight of a height at the distance r is exp(-pi r^2 / (alpha L)^2), with the nesting index L. Far from border
    and gaps a wave of the wavelength w is transmitted by exp(-pi (alpha L / w)^2), down to two pitches.

    Args:
        z: heights [y, x], um; NaN: unknown.
        nesting_um: nesting index (cut-off wavelength) [um].
        steps: pitch along y and x [um].

    Returns:
        The mean surface [y, x], um; NaN where z is.

    Source: ISO 16610-61:2015 (areal Gaussian filter), alpha = sqrt(ln 2 / pi); normalised convolution: Knutsson and
        Westin, CVPR (1993) 515; tests/unit/test_areal_filters.py.
    """
    sigma = [ALPHA * nesting_um / (math.sqrt(2.0 * math.pi) * step) for step in steps]
    size = [fft.next_fast_len(n + math.ceil(_REACH * s) + 1, real=True) for n, s in zip(z.shape, sigma, strict=True)]
    fy, fx = fft.fftfreq(size[0]), fft.rfftfreq(size[1])
    transmission = np.exp(-2.0 * np.pi**2 * ((sigma[0] * fy[:, None]) ** 2 + (sigma[1] * fx) ** 2))
    ny, nx = z.shape
    convolve = lambda a: np.asarray(fft.irfft2(fft.rfft2(a, size) * transmission, size))[:ny, :nx]  # noqa: E731
    is_known = np.isfinite(z)
    weight = convolve(is_known.astype(float))
    return np.where(is_known, convolve(np.where(is_known, z, 0.0)) / np.where(is_known, weight, 1.0), np.nan)


def form_surface(z: np.ndarray, form: Form, steps: tuple[float, float]) -> np.ndarray:
    """Compute the least-squares form of heights: their mean, a plane or a polynomial of second degree.

    Deviations are counted along z, not normal to the form.

    Args:
        z: heights [y, x], um; NaN: unknown.
        form: "none" (the mean), "plane", "quadratic".
        steps: pitch along y and x [um].

    Returns:
        The form [y, x], um, everywhere.

    Source: ISO 25178-3:2012, F-operation by association.
    """
    sides = (step * (np.arange(n) - 0.5 * (n - 1)) for n, step in zip(z.shape, steps, strict=True))
    y, x = np.meshgrid(*sides, indexing="ij")
    scale = max(float(np.abs(x).max()), float(np.abs(y).max()), 1.0)
    x, y = x / scale, y / scale
    degree = {"none": 0, "plane": 1, "quadratic": 2}[form]
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], -1)
    is_known = np.isfinite(z)
    return terms @ np.linalg.lstsq(terms[is_known], z[is_known], rcond=None)[0]
