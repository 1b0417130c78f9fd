"""Lines in micrographs: thin dark or bright ones, and creases along which the surface is kinked.

All detectors are looked at together, through elongated Gaussian derivative filters in all directions. Across a line the
even filter (second derivative) answers to what is thin, whatever its sign in each detector: the answers' sum of squares
over their variances is a field of chi-square. Across a crease with the unit normal u the surface's slope changes by
`kink`, and micrograph k by -kink r_k + albedo, r_k = u.d_k / d_z of detector k's direction: the kink fitted to the odd
filter's answers, over its deviation, is a Gaussian field. Maxima of such fields of place and direction in noise above a
threshold are counted by a closed form; so the threshold follows from the false alarms that are allowed. Maxima across
the line are then joined to paths, with two thresholds. Knows nothing of heights.

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
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings

Kind = Literal["line", "groove"]
ORDER: dict[Kind, int] = {"line": 2, "groove": 1}
"""Derivative of the Gaussian across the line: the second finds lines, the first edges."""
_TURNS = 16
_ELONGATION = 3.0
_CUT = 4.0
"""Filters end at so many standard deviations."""
_CLIP, _CLIPPED_MEAN = 2.0, 0.78089
"""The mean of min(abs(z), 2) of a normal z."""
_SURROUNDINGS = 16.0
"""Standard deviation of the surroundings that a line must stand out of, too [pixels]."""
_LINES, _LINE_ROUNDS = (9, 1), 6
"""Window of the running median across scan lines [pixels], and how often it is taken."""


class LineSettings(Settings):
    """How lines are looked for."""

    false_alarms: float = Field(default=0.05, gt=0.0, le=10.0)
    """Lines that noise alone is allowed to show in the searched area, all kinds together, on average."""
    widths_px: tuple[float, ...] = Field(default=(0.8, 1.6), min_length=1)
    """Standard deviations of the filters across the line [pixels]."""
    low_share: float = Field(default=0.6, gt=0.0, le=1.0)
    """A line goes on down to this share of the threshold that it had to exceed somewhere."""
    min_length_px: float = Field(default=6.0, ge=3.0)
    """Shorter lines are left out [pixels]."""


@dataclass(frozen=True)
class Contrast:
    """Micrographs relative to their flat, without scan lines.

    Attributes:
        values: signal / flat signal - 1 [detector, y, x]; 0 where not observed.
        variance: of them.
        is_known: True where all detectors were observed [y, x].
        directions: d_xy / d_z of the detectors, from the reference plane [detector, 2].
    """

    values: np.ndarray
    variance: np.ndarray
    is_known: np.ndarray
    directions: np.ndarray


@dataclass(frozen=True)
class Found:
    """The best answer at every pixel.

    Attributes:
        score: the largest of all directions and widths [y, x]: the root of chi-square (lines), the kink over its
            deviation (grooves).
        amplitude: the score without what noise adds to it.
        angle: of the line's normal [y, x], rad, 0 to pi.
        threshold: score that noise exceeds with the allowed false alarms.
        density: from `false_alarm_density`, summed over the widths.
        degrees: of freedom of the chi-square; 0: a Gaussian field.
        n_pixels: that were searched.
    """

    score: np.ndarray
    amplitude: np.ndarray
    angle: np.ndarray
    threshold: float
    density: float
    degrees: int
    n_pixels: int

    def false_alarms(self, score: float) -> float:
        """Return how many maxima at or above a score noise alone shows in the searched pixels, on average."""
        return self.n_pixels * self.density * euler_density(score, self.degrees)


def contrast_of(stack: MicrographStack) -> Contrast:
    """Return the micrographs relative to their median, with the offsets of scan lines taken off.

    The offset of a scan line is the median, along it, of what a running median across the scan lines leaves; again and
    again, for that running median follows the offsets at first.

    Raises:
        SceneError: the stack is not calibrated, its noise is unknown, or there are fewer than three detectors.
    """
    if stack.n_rays is None:
        raise SceneError(f"{stack.name}: its background is not known: give the file that helio calibrate wrote")
    if stack.variance is None:
        raise SceneError(f"{stack.name}: the variance of its counts is not known: nothing tells a line from noise")
    if stack.shape[0] < 3:
        raise SceneError(f"{stack.name}: cracks are told from slopes by 3 or more detectors, got {stack.shape[0]}")
    axis = 1 if stack.fast_axis == "x" else 0
    known = np.all(stack.is_observed, axis=0)
    values, variance = [], []
    for counts, noise in zip(stack.signal, stack.variance, strict=True):
        flat = float(np.median(counts[known]))
        q = np.where(known, counts / flat - 1.0, 0.0)
        for _ in range(_LINE_ROUNDS):
            smooth = ndimage.median_filter(q, size=_LINES if axis == 1 else _LINES[::-1], mode="nearest")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of lines without a known pixel
                lines = np.nanmedian(np.where(known, q - smooth, np.nan), axis=axis, keepdims=True)
            q = np.where(known, q - np.nan_to_num(lines), 0.0)
        values.append(q)
        variance.append(np.where(known, noise, 0.0) / flat**2)
    return Contrast(np.array(values), np.array(variance), known, stack.instrument.directions())


def kernel(order: int, width: float, angle: float) -> np.ndarray:
    """Return a derivative of a Gaussian across a line, elongated along it [y, x].

    Normalised to the amplitude of a narrow dark line's missing signal [pixels] (order 2), or of a step along +u (1).

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
    if order == 1:  # integral over a step is one half of 2 g's mean distance
        k = across * g
        return k * (math.sqrt(2.0 * np.pi) / width / (np.sum(g) or 1.0))
    k = (across**2 / width**2 - 1.0) * g
    k -= k.mean()
    return k * math.sqrt(2.0 * np.pi) * width


def euler_density(score: float, degrees: int) -> float:
    """Return the density of maxima above a score in three dimensions, over the square root of det L.

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
    """Return what `euler_density` is multiplied by, per pixel: pi sqrt(det L), for white noise and all directions.

    L is the covariance of the field's derivatives by x, y and angle, from the filter's spectrum,
    a^n exp(-(s a)^2 / 2 - (l b)^2 / 2) with s across and l along:

        <a^2> = (2 n + 1) / (2 s^2), <b^2> = 1 / (2 l^2), and of the turn, a d/db - b d/da,
        <b^2> [(l^2 - s^2)^2 <a^2> + 2 n (l^2 - s^2) + n^2 2 s^2 / (2 n - 1)].

    Source: own derivation, tests/unit/test_lines.py.
    """
    n, s, long = order, width, _ELONGATION * width
    a2, b2, more = (2 * n + 1) / (2 * s * s), 1 / (2 * long * long), long * long - s * s
    turn = b2 * (more**2 * a2 + 2 * n * more + n * n * 2 * s * s / (2 * n - 1))
    return math.pi * math.sqrt(a2 * b2 * turn)


def find_lines(contrast: Contrast, inside: np.ndarray, kind: Kind, s: LineSettings, sign: float = 1.0) -> Found:
    """Return how much every pixel looks as if on a line of a kind.

    Args:
        contrast: from `contrast_of`.
        inside: where lines are looked for [y, x].
        kind: "line": thin, of any sign; "groove": the slope grows across it.
        s: settings.
        sign: -1: ridges instead of grooves (a control).

    Raises:
        GuardError: no pixel is left to search.
    """
    order = ORDER[kind]
    reach = math.ceil(_ELONGATION * max(s.widths_px))  # beyond the border and in unknown pixels nothing is known
    searched = inside & ndimage.binary_erosion(contrast.is_known, np.ones((3, 3), bool), iterations=reach)
    if not searched.any():
        raise GuardError(
            f"no pixel to look for cracks at: they need {reach} pixels known in all detectors around them; take "
            "another region"
        )
    shape = contrast.is_known.shape
    score, amplitude, angle = (np.zeros(shape) for _ in range(3))
    degrees = len(contrast.values) if kind == "line" else 0
    density = sum(false_alarm_density(order, w) for w in s.widths_px)
    for width in s.widths_px:
        answers = []
        for turn in np.pi * np.arange(_TURNS) / _TURNS:
            k = kernel(order, width, turn)
            values, variances = _filtered(contrast.values, k), _filtered(contrast.variance, k**2)
            answers.append((turn, sign * values, np.maximum(variances, 1e-30)))
        scale = np.max([_excess(values / np.sqrt(variances), searched) for _, values, variances in answers], axis=0)
        for turn, values, variances in answers:
            r = contrast.directions @ np.array([math.cos(turn), math.sin(turn)])
            if kind == "line":
                square = np.sum(values**2 / (variances * scale**2), axis=0)
                t, size = np.sqrt(square), np.sqrt(np.maximum(square - degrees, 0.0))
            else:
                t = size = _kink_score(values, variances * scale**2, r)
            t = np.where(searched, t, 0.0)
            better = t > score
            both = (t, score), (size, amplitude), (turn, angle)
            score, amplitude, angle = (np.where(better, new, old) for new, old in both)
    n = int(searched.sum())
    share = s.false_alarms / len(ORDER)
    lowest = math.sqrt(max(2 * degrees, 4))
    surplus = lambda t: n * density * euler_density(t, degrees) - share  # noqa: E731
    threshold = optimize.root_scalar(surplus, bracket=(lowest, 40.0)).root if surplus(lowest) > 0 else lowest
    return Found(score, amplitude, angle, threshold, density, degrees, n)


def _filtered(images: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Return images [detector, y, x] correlated with a kernel, their borders continued by mirroring."""
    n = k.shape[0] // 2
    padded = np.pad(images, ((0, 0), (n, n), (n, n)), mode="symmetric")
    return signal.fftconvolve(padded, k[None, ::-1, ::-1], mode="valid", axes=(1, 2))


def _excess(scores: np.ndarray, searched: np.ndarray) -> np.ndarray:
    """Return by what factor one direction's answers about each pixel exceed those of noise, >= 1 [detector, y, x].

    The largest of all directions counts: so a line has to stand out of a ripple, too.
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
