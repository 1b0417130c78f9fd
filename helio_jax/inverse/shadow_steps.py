"""Steps that face away from an oblique beam: straight lines through the image beside which the lower ground is bright.

The beam jumps over the ground in the wall's shadow, so that no detector's mask is seen: there is no band to measure.
But multiple scattering from the wall makes the ground next to the shadow brighter than the upper edge (its *glow*), and
the penumbra of a detector's mask may reach beyond the shadow. The line tells where the step is; its height is for the
search of levels (`levels`) and the fit to find.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from helio_jax.arrays import robust_std, typical_signals
from helio_jax.forward.optics import Raster
from helio_jax.inverse.dash_lines import Line

MIN_JUMP = 0.03
"""Least jump of a signal at the line, in its median."""
SIGNIFICANT = 100.0
"""Least chi-square of the jumps of all detectors. By chance the best of 20 000 lines has 25 with three detectors."""
UNIQUE, APART = 4.0, 4.0
"""Least ratio of its chi-square to that of any parallel line farther off than this [pixels]: waves have many crests."""
NEAR, LEAST_NEAR = (1.5, 4.5), 0.12
"""So far from a line [pixels] both sides still differ by at least this share of the jump: dashes of low steps and
crests of short waves are narrower."""
FAR, MOST_FAR = (8.0, 14.0), 0.85
"""So far from a line [pixels] both sides differ by at most this share of the jump: at a crease, where two facets meet,
they differ by all of it."""
QUARTERS, MIN_SHARE = 4, 0.4
"""In each of so many parts of a line the jump is at least this share of the mean one."""
MIN_LENGTH = 0.5
"""Least length of a line, as a share of the image's shorter side."""
LEAST_SIDE = 8.0
"""Smaller images do not show how glow levels off [pixels]."""
_SHIFT = 4
"""Lines are tried so many times per pixel ..."""
_ANGLES = np.radians(np.arange(-84.0, 84.5, 1.0))
"""... and at these angles between their normal and the way of the beam, which is far from parallel to them ..."""
_FINER = np.radians(np.arange(-1.0, 1.01, 0.2))
"""... and at these ones about the best."""
_NEAR, _NEXT = 1.5, -0.5
"""Weights of the means over the first and the second pixel beside a line: the signal at it, extrapolated."""


class _Jump(NamedTuple):
    """Jump of the signals at a line that was tried.

    Attributes:
        line: through the whole image.
        size, variance: of the jump along the line's normal, in the median signal [detector].
        rival: largest chi-square of the lines parallel to it.
    """

    line: Line
    size: np.ndarray
    variance: np.ndarray
    rival: float

    @property
    def chi_square(self) -> float:
        return float(np.sum(self.size**2 / self.variance))

    def projected(self, change: np.ndarray) -> np.ndarray:
        """Project changes of the signals [detector, ...] on the jump: 1 for the jump itself."""
        weight = self.size / self.variance
        return np.tensordot(weight, change, 1) / (weight @ self.size)


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
    is_live = np.isfinite(signal).any((1, 2))
    if not any(beam_shift) or not is_live.any():
        return None
    signal, variance = signal[is_live], variance[is_live]
    unit = typical_signals(signal)[:, None, None]
    share, spread = signal / unit, _with_relief(signal, variance) / unit**2
    side = np.sqrt(float(raster.dx) * float(raster.dy))
    place = np.moveaxis(np.asarray(raster.centred_positions()), 0, -1) / side
    if np.ptp(place, axis=(0, 1)).min() < LEAST_SIDE:
        return None
    way = float(np.arctan2(beam_shift[1], beam_shift[0]))

    def best_of(angles: np.ndarray) -> _Jump:
        return max((_largest_jump(share, spread, place, angle) for angle in angles), key=lambda jump: jump.chi_square)

    best = best_of(best_of(way + _ANGLES).line.angle + _FINER)
    is_step = best.chi_square > max(SIGNIFICANT, UNIQUE * best.rival) and best.size.max() > MIN_JUMP
    if not is_step or not _is_glow(best, share, place) or not _is_through(best, share, spread, place):
        return None
    return place @ best.line.normal < best.line.offset


def _with_relief(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Enlarge the variance of signals to the one that neighbours differ by: relief is no step [detector, y, x]."""
    change = 0.5 * robust_std(np.diff(signal, axis=2), (1, 2)) ** 2
    return variance * np.maximum(change / np.nanmedian(variance, axis=(1, 2), keepdims=True), 1.0)


def _largest_jump(share: np.ndarray, spread: np.ndarray, place: np.ndarray, angle: float) -> _Jump:
    """Find the line of a direction at which the signals jump most; arguments as those of `_jumps`."""
    line = Line(float(angle), 0.0, 0.0, 0.0)
    u, w = place @ line.normal, place @ line.along
    offset, jump, variance = _jumps(share, spread, u)
    chi_square = np.sum(jump**2 / variance, axis=0)
    i = int(np.argmax(chi_square))
    rival = np.max(chi_square, where=np.abs(offset - offset[i]) > APART, initial=0.0)
    along = w[np.abs(u - offset[i]) < 1.0]
    line = line._replace(offset=float(offset[i]), start=float(along.min()), end=float(along.max()))
    return _Jump(line, jump[:, i], variance[:, i], float(rival))


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
    jump = np.sum([weight * mean[:, at] for at, weight in strips], axis=0)
    of_jump = np.sum([weight**2 * variance[:, at] for at, weight in strips], axis=0)
    is_known = np.isfinite(jump) & (of_jump > 0.0)
    return low + first / _SHIFT, np.where(is_known, jump, 0.0), np.where(is_known, of_jump, np.inf)


def _is_glow(jump: _Jump, share: np.ndarray, place: np.ndarray) -> bool:
    """Decide whether signals level off beyond a line as glow does: neither at once nor not at all."""
    u = place @ jump.line.normal - jump.line.offset

    def left(low: float, high: float) -> float | None:
        """Return the share of the jump that is left between strips on both sides; None where one is not observed."""
        beyond, before = (np.isfinite(share).all(0) & (sign * u > low) & (sign * u < high) for sign in (1.0, -1.0))
        if not beyond.any() or not before.any():
            return None
        return float(jump.projected(share[:, beyond].mean(1) - share[:, before].mean(1)))

    near, far = left(*NEAR), left(*FAR)
    return near is not None and near > LEAST_NEAR and (far is None or far < MOST_FAR)


def _is_through(jump: _Jump, share: np.ndarray, spread: np.ndarray, place: np.ndarray) -> bool:
    """Decide whether a line is long enough, and the jump in all parts of it."""
    line = jump.line
    if line.end - line.start < MIN_LENGTH * min(place.shape[:2]):
        return False
    u, w = place @ line.normal - line.offset, place @ line.along
    for start, end in pairwise(np.linspace(line.start, line.end, QUARTERS + 1)):
        part = (w >= start) & (w <= end) & (np.abs(u) < 4.0)
        offset, change, variance = _jumps(share[:, part][:, None], spread[:, part][:, None], u[part][None])
        seen = (np.abs(offset) <= 0.5) & np.all(np.isfinite(variance), axis=0)
        if not seen.any() or jump.projected(change[:, seen]).max() < MIN_SHARE:
            return False
    return True
