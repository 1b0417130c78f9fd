"""Steps that face away from an oblique beam: straight lines through the image beside which the lower ground is bright.

The beam jumps over the ground in the wall's shadow, so that no detector's mask is seen: there is no band to measure.
But the ground next to the shadow is brighter than the upper edge by what the wall scatters on it, and some detectors
see a part of their penumbrae there. The line tells where the step is; its height is for the search of levels (`levels`)
and the fit to find.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from helio_jax.forward.optics import Raster

MIN_JUMP = 0.03
"""Least jump of a signal at the line, in its median."""
SIGNIFICANT = 100.0
"""Least chi-square of the jumps of all detectors. By chance the best of 20 000 lines has 25 with three detectors."""
UNIQUE, APART = 4.0, 4.0
"""So many times as large must it be as on any parallel line farther than this [pixels]: waves have many crests."""
NEAR, LEAST_NEAR = (1.5, 4.5), 0.12
"""Pixels so far from a line [pixels] still differ by at least this share of the jump: dashes of low steps and crests of
short waves are narrower."""
FAR, MOST_FAR = (8.0, 14.0), 0.85
"""Pixels so far from a line on both sides differ by at most this share of the jump: of two facets that meet in a crease
they differ by all of it."""
QUARTERS, MIN_SHARE = 4, 0.4
"""The jump is in all parts of a line: in each of so many at least this share of the mean one."""
MIN_LENGTH = 0.5
"""Least length of a line, in the image's shorter side."""
_SHIFT = 4
"""Lines are tried so many times per pixel ..."""
_ANGLES = np.radians(np.arange(-84.0, 84.5, 1.0))
"""... and at these angles between their normal and the way of the beam, which is far from parallel to them ..."""
_FINER = np.radians(np.arange(-1.0, 1.01, 0.2))
"""... and at these ones about the best."""
_MEDIAN_SQUARE = 0.455
"""Median square of a normal deviate of variance 1."""
_NEAR, _NEXT = 1.5, -0.5
"""Weights of the means over the first and the second pixel beside a line: the signal at it, extrapolated."""


class _Line(NamedTuple):
    """A line tried: the angle of its normal [rad]; its distance from the middle of the image along that [pixels]; and
    the jump of every detector's signal there, along the normal, with its variance [detector]; and the largest
    chi-square of the lines parallel to it."""

    angle: float
    offset: float
    jump: np.ndarray
    variance: np.ndarray
    rival: float

    @property
    def normal(self) -> np.ndarray:
        return np.array([np.cos(self.angle), np.sin(self.angle)])

    @property
    def chi_square(self) -> float:
        return float(np.sum(self.jump**2 / self.variance))


def find_shadow_step(
    signal: np.ndarray, variance: np.ndarray, raster: Raster, beam_shift: tuple[float, float]
) -> np.ndarray | None:
    """Find the upper side of a straight step through the image that faces away from the beam [y, x].

    Args:
        signal: NaN where not observed [detector, y, x].
        variance: of the signal.
        raster: of the scan.
        beam_shift: `Instrument.beam_shift`.

    Returns:
        True on the side of the line that the beam comes from; None where no line is a step, and for a normal beam.

    Source: own derivation; signals on both sides are extrapolated to the line, so that slopes of them are no jump.
    """
    if not any(beam_shift):
        return None
    unit = np.nanmedian(signal, axis=(1, 2))[:, None, None]
    share, spread = signal / unit, _with_relief(signal, variance) / unit**2
    side = np.sqrt(float(raster.dx) * float(raster.dy))
    place = np.moveaxis(np.asarray(raster.centred_positions()), 0, -1) / side
    way = float(np.arctan2(beam_shift[1], beam_shift[0]))

    def best_of(angles: np.ndarray) -> _Line:
        return max((_best_line(share, spread, place, angle) for angle in angles), key=lambda line: line.chi_square)

    best = best_of(best_of(way + _ANGLES).angle + _FINER)
    is_step = best.chi_square > max(SIGNIFICANT, UNIQUE * best.rival) and best.jump.max() > MIN_JUMP
    if not is_step or not _is_glow(best, share, place) or not _is_through(best, share, spread, place):
        return None
    return place @ best.normal < best.offset


def _with_relief(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Enlarge the variance of signals to the one that neighbours differ by: relief is no step [detector, y, x]."""
    change = np.nanmedian(np.diff(signal, axis=2) ** 2, axis=(1, 2)) / (2.0 * _MEDIAN_SQUARE)
    return variance * np.maximum(change / np.nanmedian(variance, axis=(1, 2)), 1.0)[:, None, None]


def _best_line(share: np.ndarray, spread: np.ndarray, place: np.ndarray, angle: float) -> _Line:
    """Find the line of a direction at which the signals jump most; arguments as those of `_jumps`."""
    offset, jump, variance = _jumps(share, spread, place @ np.array([np.cos(angle), np.sin(angle)]))
    chi_square = np.sum(jump**2 / variance, axis=0)
    i = int(np.argmax(chi_square))
    rival = np.max(chi_square, where=np.abs(offset - offset[i]) > APART, initial=0.0)
    return _Line(angle, float(offset[i]), jump[:, i], variance[:, i], float(rival))


def _jumps(share: np.ndarray, spread: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the jumps of signals at lines across u.

    Args:
        share: signals over their medians [detector, y, x].
        spread: their variances.
        u: distance of the pixels along the normal [y, x], pixels.

    Returns:
        Places of the lines [line], and the jump and its variance [detector, line], infinite where a side has no pixels.
    """
    low, n_bins = float(u.min()), int(np.ptp(u) * _SHIFT) + 1
    number = ((u - low) * _SHIFT).astype(int)
    sums = np.zeros((3, len(share), n_bins))
    for k, (image, noise) in enumerate(zip(share, spread, strict=True)):
        seen = np.isfinite(image) & np.isfinite(noise)
        for of, weight in zip(sums, (np.ones(seen.sum()), image[seen], noise[seen]), strict=True):
            of[k] = np.bincount(number[seen], weight, n_bins)
    room = np.cumsum(np.pad(sums, ((0, 0), (0, 0), (1, 0))), axis=-1)
    count, total, noise = room[..., _SHIFT:] - room[..., :-_SHIFT]  # of strips one pixel wide
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, variance = total / count, noise / count**2
    first = np.arange(2 * _SHIFT, mean.shape[-1] - _SHIFT)
    strips = (first, _NEAR), (first + _SHIFT, _NEXT), (first - _SHIFT, -_NEAR), (first - 2 * _SHIFT, -_NEXT)
    jump = sum((weight * mean[:, at] for at, weight in strips), np.zeros(1))
    of_jump = sum((weight**2 * variance[:, at] for at, weight in strips), np.zeros(1))
    is_known = np.isfinite(jump) & (of_jump > 0.0)
    return low + first / _SHIFT, np.where(is_known, jump, 0.0), np.where(is_known, of_jump, np.inf)


def _is_glow(line: _Line, share: np.ndarray, place: np.ndarray) -> bool:
    """Decide whether signals level off from the jump at a line as glow does: neither at once nor not at all."""
    u, weight = place @ line.normal - line.offset, line.jump / line.variance

    def still(low: float, high: float) -> float | None:
        """Return the difference of strips on both sides, in that of the jump; None where one is beyond the image."""
        beyond, before = (np.isfinite(share).all(0) & (way * u > low) & (way * u < high) for way in (1.0, -1.0))
        if not beyond.any() or not before.any():
            return None
        change = share[:, beyond].mean(1) - share[:, before].mean(1)
        return float(weight @ change / (weight @ line.jump))

    near, far = still(*NEAR), still(*FAR)
    return near is not None and near > LEAST_NEAR and (far is None or far < MOST_FAR)


def _is_through(line: _Line, share: np.ndarray, spread: np.ndarray, place: np.ndarray) -> bool:
    """Decide whether the jump is in all parts of a line."""
    u, w = place @ line.normal, place @ np.array([-line.normal[1], line.normal[0]])
    beside = np.abs(u - line.offset) < 1.0
    if np.ptp(w[beside]) < MIN_LENGTH * min(u.shape):
        return False
    ends = np.linspace(w[beside].min(), w[beside].max(), QUARTERS + 1)
    weight = line.jump / line.variance
    for start, end in pairwise(ends):
        part = (w >= start) & (w <= end) & (np.abs(u - line.offset) < 4.0)
        offset, jump, variance = _jumps(share[:, part][:, None], spread[:, part][:, None], u[part][None])
        here = np.abs(offset - line.offset) <= 0.5
        seen = here & np.all(np.isfinite(variance), axis=0)
        if not seen.any() or (weight @ jump[:, seen]).max() < MIN_SHARE * float(weight @ line.jump):
            return False
    return True
