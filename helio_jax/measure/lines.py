"""Line detection in micrographs: thin dark or bright lines, and creases where the surface is kinked.

All detectors are filtered together with elongated Gaussian derivatives in all directions. Thin lines: the second
derivative responds with any sign in each detector; the sum of squared responses over their variances is a chi-square
field. Creases: across a crease with the unit normal u the surface's slope changes by `kink`, and the relative signal
of micrograph k by -kink r_k + albedo, r_k = u.d_k / d_z with the detector's direction d_k; the kink fitted to the
responses of the first derivative, over its deviation, is a Gaussian field. The threshold follows from the number of
false alarms allowed, because the expected number of maxima of such fields of place and direction in noise has a closed
form. Does not use heights.

Source: Steger, IEEE PAMI 20 (1998) 113 (lines as maxima of directed second derivatives); Canny, IEEE PAMI 8 (1986) 679
(two thresholds); Worsley, Adv. Appl. Prob. 26 (1994) 13, theorem 3.5, and Siegmund and Worsley, Ann. Stat. 23 (1995)
608 (maxima of filtered noise). tests/unit/test_lines.py.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field
from scipy import ndimage, optimize, signal

from helio_jax.errors import GuardError, SceneError
from helio_jax.instrument import Instrument
from helio_jax.measure.regions import check_micrographs
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings

Kind = Literal["line", "groove"]
ORDER: dict[Kind, int] = {"line": 2, "groove": 1}
"""Derivative of the Gaussian across the line: the second detects lines, the first edges."""
_DIRECTIONS = 16
_WIDTHS = (0.8, 1.6)
"""Standard deviations of the filters across the line [pixels]."""
_ELONGATION = 3.0
"""Standard deviation of the filters along the line over that across."""
_CUT = 4.0
"""Half width of the filters [standard deviations]."""
_CLIP, _CLIPPED_MEAN = 2.0, 0.78089
"""The mean of min(abs(z), 2) of a standard normal z."""
_SURROUNDINGS = 16.0
"""Standard deviation of the neighbourhood whose texture a line must exceed [pixels]."""
_MEDIAN_WINDOW, _MEDIAN_ITERATIONS = (9, 1), 6
"""Running median across scan lines: window [pixels] and iterations."""


class LineSettings(Settings):
    """Search for lines and cracks."""

    false_alarms: float = Field(default=0.05, gt=0.0, le=10.0)
    """Mean number of lines of all kinds that noise alone may show in the searched area."""
    min_length_px: float = Field(default=6.0, ge=3.0)
    """Shorter lines are discarded [pixels]."""


@dataclass(frozen=True)
class Contrast:
    """Micrographs relative to the substrate's signal, without offsets of scan lines.

    Attributes:
        values: signal / median signal - 1 [detector, y, x]; 0 where not observed.
        variance: of `values`.
        is_known: True where all detectors were observed [y, x].
        instrument: of the micrographs.
    """

    values: np.ndarray
    variance: np.ndarray
    is_known: np.ndarray
    instrument: Instrument

    @property
    def directions(self) -> np.ndarray:
        """d_xy / d_z of the detectors, from the substrate plane [detector, 2]."""
        return self.instrument.directions()


@dataclass(frozen=True)
class Found:
    """The strongest filter response at every pixel.

    Attributes:
        score: largest of all directions and widths [y, x]: root of chi-square (lines), kink over its deviation
            (grooves).
        amplitude: score without the expected contribution of noise.
        angle: of the line's normal [y, x], rad, 0 to pi.
        threshold: score that noise exceeds with the allowed false alarms.
        density: from `false_alarm_density`, summed over the widths.
        degrees: of freedom of the chi-square; 0: a Gaussian field.
        n_pixels: searched pixels.
    """

    score: np.ndarray
    amplitude: np.ndarray
    angle: np.ndarray
    threshold: float
    density: float
    degrees: int
    n_pixels: int

    def false_alarms(self, score: float) -> float:
        """Compute the mean number of maxima at or above a score that noise alone shows in the searched pixels."""
        return self.n_pixels * self.density * euler_density(score, self.degrees)


def contrast_of(stack: MicrographStack) -> Contrast:
    """Normalise micrographs to their median and subtract the offsets of scan lines.

    The offset of a scan line is the median, along it, of the difference to a running median across the scan lines. This
    is iterated, because the running median follows the offsets at first.

    Raises:
        SceneError: the stack is not calibrated, its noise is unknown, or there are fewer than three detectors.
    """
    check_micrographs(stack)
    if stack.variance is None:
        raise SceneError(f"{stack.name}: the variance of its counts is not known: lines cannot be separated from noise")
    if stack.shape[0] < 3:
        raise SceneError(f"{stack.name}: cracks need the slopes from 3 or more detectors, got {stack.shape[0]}")
    axis = 1 if stack.fast_axis == "x" else 0
    window = _MEDIAN_WINDOW if axis == 1 else _MEDIAN_WINDOW[::-1]
    known = np.all(stack.is_observed, axis=0)
    values, variance = [], []
    for counts, noise in zip(stack.signal, stack.variance, strict=True):
        flat = float(np.median(counts[known]))
        q = np.where(known, counts / flat - 1.0, 0.0)
        for _ in range(_MEDIAN_ITERATIONS):
            smooth = ndimage.median_filter(q, size=window, mode="nearest")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of scan lines without a known pixel
                lines = np.nanmedian(np.where(known, q - smooth, np.nan), axis=axis, keepdims=True)
            q = np.where(known, q - np.nan_to_num(lines), 0.0)
        values.append(q)
        variance.append(np.where(known, noise, 0.0) / flat**2)
    return Contrast(np.array(values), np.array(variance), known, stack.instrument)


def kernel(order: int, width: float, angle: float) -> np.ndarray:
    """Compute a derivative of a Gaussian across a line, elongated along it [y, x].

    Normalised so that the response is the missing signal of a narrow dark line [pixels] (order 2), or the height of a
    step along +u (order 1).

    Args:
        order: 1 or 2.
        width: standard deviation across [pixels]; along: 3 times as much.
        angle: of the line's normal u [rad].
    """
    long = _ELONGATION * width
    n = math.ceil(_CUT * long)
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    across, along = math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x
    g = np.exp(-0.5 * (across / width) ** 2 - 0.5 * (along / long) ** 2) / (2.0 * np.pi * width * long)
    if order == 1:  # the integral over a step is half of the mean distance under 2 g
        k = across * g
        return k * (math.sqrt(2.0 * np.pi) / width / (np.sum(g) or 1.0))
    k = (across**2 / width**2 - 1.0) * g
    k -= k.mean()
    return k * math.sqrt(2.0 * np.pi) * width


def euler_density(score: float, degrees: int) -> float:
    """Compute the density of maxima above a score in three dimensions, over the square root of det L.

    Args:
        score: T.
        degrees: 0: of a Gaussian field; n: of the root of a field of chi-square, t = T^2.

    Source: Worsley (1994), as in the module: (T^2 - 1) exp(-t / 2) / (2 pi)^2; and
        t^((n - 3) / 2) exp(-t / 2) (t^2 - (2 n - 1) t + (n - 1)(n - 2)) / ((2 pi)^(3/2) 2^((n - 2) / 2) Gamma(n / 2)).
    """
    t = score * score
    if degrees == 0:
        return max(t - 1.0, 0.0) * math.exp(-0.5 * t) / (2.0 * math.pi) ** 2
    n = degrees
    bracket = t * t - (2 * n - 1) * t + (n - 1) * (n - 2)
    scale = (2.0 * math.pi) ** 1.5 * 2.0 ** (0.5 * (n - 2)) * math.gamma(0.5 * n)
    return max(bracket, 0.0) * t ** (0.5 * (n - 3)) * math.exp(-0.5 * t) / scale


def false_alarm_density(order: int, width: float) -> float:
    """Compute the factor of `euler_density` per pixel, pi sqrt(det L), for white noise and all directions.

    L is the covariance of the field's derivatives by x, y and angle, from the filter's spectrum,
    a^n exp(-(s a)^2 / 2 - (l b)^2 / 2) with s across and l along:

        <a^2> = (2 n + 1) / (2 s^2), <b^2> = 1 / (2 l^2), and of the rotation, a d/db - b d/da,
        <b^2> [(l^2 - s^2)^2 <a^2> + 2 n (l^2 - s^2) + n^2 2 s^2 / (2 n - 1)].

    Source: own derivation, tests/unit/test_lines.py.
    """
    n, s, long = order, width, _ELONGATION * width
    a2, b2, more = (2 * n + 1) / (2 * s * s), 1 / (2 * long * long), long * long - s * s
    rotation = b2 * (more**2 * a2 + 2 * n * more + n * n * 2 * s * s / (2 * n - 1))
    return math.pi * math.sqrt(a2 * b2 * rotation)


def find_lines(contrast: Contrast, inside: np.ndarray, kind: Kind, s: LineSettings, sign: float = 1.0) -> Found:
    """Compute at every pixel the strongest response to a line of a kind.

    Args:
        contrast: from `contrast_of`.
        inside: True where lines are searched [y, x].
        kind: "line": thin, of any sign; "groove": the slope grows across it.
        s: settings.
        sign: -1: ridges instead of grooves (a control).

    Raises:
        GuardError: no pixel is left to search.
    """
    order = ORDER[kind]
    reach = math.ceil(_ELONGATION * max(_WIDTHS))  # excludes filters over the border and unknown pixels
    searched = inside & ndimage.binary_erosion(contrast.is_known, np.ones((3, 3), bool), iterations=reach)
    if not searched.any():
        raise GuardError(
            f"no pixel to search for cracks: {reach} pixels around it must be known in all detectors; choose another "
            "region"
        )
    score, amplitude, angle = (np.zeros(searched.shape) for _ in range(3))
    degrees = len(contrast.values) if kind == "line" else 0
    density = sum(false_alarm_density(order, w) for w in _WIDTHS)
    for width in _WIDTHS:
        responses = []
        for direction in np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
            k = kernel(order, width, direction)
            values, variances = _filter(contrast.values, k), _filter(contrast.variance, k**2)
            responses.append((direction, sign * values, np.maximum(variances, 1e-30)))
        scale = np.max([_texture(v / np.sqrt(variances), searched) for _, v, variances in responses], axis=0)
        for direction, values, variances in responses:
            if kind == "line":
                square = np.sum(values**2 / (variances * scale**2), axis=0)
                t, size = np.sqrt(square), np.sqrt(np.maximum(square - degrees, 0.0))
            else:
                r = contrast.directions @ np.array([math.cos(direction), math.sin(direction)])
                t = size = _kink_score(values, variances * scale**2, r)
            t = np.where(searched, t, 0.0)
            better = t > score
            both = (t, score), (size, amplitude), (direction, angle)
            score, amplitude, angle = (np.where(better, new, old) for new, old in both)
    n = int(searched.sum())
    allowed = s.false_alarms / len(ORDER)
    lowest = math.sqrt(max(2 * degrees, 4))
    surplus = lambda t: n * density * euler_density(t, degrees) - allowed  # noqa: E731
    threshold = optimize.root_scalar(surplus, bracket=(lowest, 40.0)).root if surplus(lowest) > 0 else lowest
    return Found(score, amplitude, angle, threshold, density, degrees, n)


def _filter(images: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Correlate images [detector, y, x] with a kernel, mirrored at their borders."""
    n = k.shape[0] // 2
    padded = np.pad(images, ((0, 0), (n, n), (n, n)), mode="symmetric")
    return signal.fftconvolve(padded, k[None, ::-1, ::-1], mode="valid", axes=(1, 2))


def _texture(scores: np.ndarray, searched: np.ndarray) -> np.ndarray:
    """Compute the factor by which responses around each pixel exceed those of noise, >= 1 [detector, y, x].

    The largest factor of all directions is used, so that a line must also exceed a ripple.
    """
    clipped = np.minimum(np.abs(scores), _CLIP)
    mean = lambda image: ndimage.gaussian_filter(image, _SURROUNDINGS, mode="constant")  # noqa: E731
    weight = mean(searched.astype(float)) + 1e-12
    return np.maximum(np.stack([mean(np.where(searched, c, 0.0)) / weight for c in clipped]) / _CLIPPED_MEAN, 1.0)


def _kink_score(values: np.ndarray, variances: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Fit `kink` and `albedo` to the changes of all detectors [detector, y, x]; return kink over its deviation."""
    weight = 1.0 / variances
    a = -r[:, None, None]
    aa, bb, ab = (a * a * weight).sum(0), weight.sum(0), (a * weight).sum(0)
    av, bv = (a * weight * values).sum(0), (weight * values).sum(0)
    return (bb * av - ab * bv) / np.sqrt(np.maximum(bb * (aa * bb - ab * ab), 1e-300))
