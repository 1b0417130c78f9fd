"""Lines of dashes: isolated pixels, darker or brighter than those around, along a straight line of the image.

The mask band of a low step is shorter than a pixel. It shows only where a pixel happens to lie in it: as dark dashes
along the edge. A step that faces away from an oblique beam hides its masks in the beam's shadow, but its foot is
brighter by what the wall scatters to it, as a wall that faces the beam is itself: bright dashes. A line counts as found
where so many dashes on it are no chance, at a stated number of false alarms.

Source: meaningful alignments: Desolneux, Moisan and Morel, Int. J. Comput. Vis. 40 (2000) 7.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, median_filter
from scipy.stats import binom

from helio_jax.arrays import nearest_known
from helio_jax.inverse.mask_edges import HALF, SHADED

FALSE_ALARMS = 1e-3
"""Expected number of lines that chance alone makes of the dashes of one stack."""
MIN_SPAN = 12.0
"""Shortest line [pixels]."""
MIN_DASHES = 5
"""Fewest dashes of a line."""
_AROUND = 7
"""Side of the square whose median a pixel is compared with [pixels]."""
_NOISE = 5.0
"""Least difference of a dash from the pixels around it [standard deviations]."""
_FACES = 0.2
"""Least cosine of the angle between the normal of a line and a detector's -v for its mask to lie beside it, between
normal and v for none to lie there, and between normal and an oblique beam for wall or foot to be bright."""
_OBLIQUE = 0.1
"""Least shift of an oblique beam per height."""
_TURN = np.radians(0.75)
"""Angle between the lines that are tried."""
_STRIP = 0.75
"""Half the width of the strip in which dashes count for a line [pixels]."""
_SHIFT = 0.25
"""Distance between the lines that are tried [pixels]."""


class Line(NamedTuple):
    """A straight line; lengths in pixels.

    Attributes:
        angle: of the normal, which points to the lower side: along it the masks of the step run [rad].
        offset: distance from the origin along the normal.
        start, end: of the line, along its direction (the normal turned by +90 deg).
    """

    angle: float
    offset: float
    start: float
    end: float

    @property
    def normal(self) -> np.ndarray:
        """Unit normal [2]."""
        return np.array([np.cos(self.angle), np.sin(self.angle)])

    @property
    def along(self) -> np.ndarray:
        """Unit vector along the line [2]."""
        return np.array([-np.sin(self.angle), np.cos(self.angle)])

    @property
    def reversed(self) -> "Line":
        """The same line of a step that falls the other way."""
        return Line(self.angle + np.pi, -self.offset, -self.end, -self.start)


@dataclass(frozen=True)
class Dashes:
    """Isolated dark and bright pixels.

    Attributes:
        is_dark: whether a detector's signal is far lower than around the pixel [detector, y, x].
        is_bright: whether it is higher than around by more than noise [detector, y, x].
        is_counted: pixels that could show one: observed, and not within wide dark regions [y, x].
    """

    is_dark: np.ndarray
    is_bright: np.ndarray
    is_counted: np.ndarray

    def without(self, pixels: np.ndarray) -> "Dashes":
        """Leave out the dashes in some pixels [y, x]."""
        return replace(self, is_dark=self.is_dark & ~pixels, is_bright=self.is_bright & ~pixels)


def find_dashes(signal: np.ndarray, variance: np.ndarray, lit: np.ndarray, is_explained: np.ndarray) -> Dashes:
    """Find dark and bright pixels that belong to no region as wide as two pixels.

    Args:
        signal: NaN where not observed [detector, y, x].
        variance: of the signal [detector, y, x].
        lit: signal of the level surface [detector].
        is_explained: pixels in the bands of measured steps [detector, y, x].
    """
    darker, brighter = np.zeros(signal.shape, bool), np.zeros(signal.shape, bool)
    wide = np.zeros(signal.shape[1:], bool)
    for k, image in enumerate(signal):
        known = np.isfinite(image)
        if not known.any() or lit[k] <= 0.0:
            continue
        filled = image[nearest_known(known)]
        around = median_filter(filled, _AROUND, mode="nearest")
        wide |= _near_wide(filled < SHADED * lit[k])
        noise = _NOISE * np.sqrt(np.maximum(np.nan_to_num(variance[k]), 0.0))
        shows = known & (around > HALF * lit[k])
        darker[k] = shows & (filled < SHADED * around) & (around - filled > noise)
        brighter[k] = shows & (filled - around > noise)
        brighter[k] &= ~_near_wide(brighter[k])
    counted = np.isfinite(signal).all(0) & ~wide & ~is_explained.any(0)
    return Dashes(darker & counted, brighter & counted, counted)


def _near_wide(mask: np.ndarray) -> np.ndarray:
    """Mark the pixels of regions as wide as two pixels, and those beside them [y, x]."""
    return np.asarray(binary_dilation(binary_opening(mask, np.ones((2, 2))), np.ones((3, 3)), 2), bool)


def find_line(dashes: Dashes, place: np.ndarray, v: np.ndarray, beam_shift: np.ndarray) -> tuple[Line, ...]:
    """Find the line on which chance explains the dashes least, if it is below `FALSE_ALARMS`.

    The dashes of other places are how frequent chance makes them. On a line count dark dashes of the detectors that a
    step along it masks, in pixels where no other detector has any: a groove darkens both; and across an oblique beam
    bright dashes of any detector, which may be of a step that falls either way.

    Args:
        dashes: isolated pixels.
        place: of the pixels, about the middle of the image [y, x, 2], pixels.
        v: direction of each detector plus beam shift [detector, 2].
        beam_shift: `Instrument.beam_shift` [2].

    Returns:
        The line; and its reverse, if most of its dashes are bright; none if chance explains the dashes.
    """
    is_any = dashes.is_dark.any(0) | dashes.is_bright.any(0)
    if is_any.sum() < MIN_DASHES:
        return ()
    at, counted = place[is_any], place[dashes.is_counted]
    dark, bright = dashes.is_dark[:, is_any], dashes.is_bright[:, is_any].any(0)
    angles = np.arange(0.0, 2.0 * np.pi, _TURN)
    reach = float(np.hypot(place[..., 0], place[..., 1]).max()) + 2.0
    bins, width = int(2.0 * reach / _SHIFT), round(2.0 * _STRIP / _SHIFT)
    oblique = float(np.hypot(*beam_shift))
    # every strip, and every start and end in it
    best = np.log(FALSE_ALARMS / (len(angles) * bins * 2.0 * reach**2))
    found: tuple[Line, ...] = ()

    def in_strips(u: np.ndarray) -> np.ndarray:
        number = np.bincount(((u + reach) / _SHIFT).astype(int), minlength=bins)
        return np.convolve(number, np.ones(width), "valid")

    for angle in angles:
        line = Line(float(angle), 0.0, 0.0, 0.0)
        toward = v @ line.normal / np.maximum(np.hypot(v[:, 0], v[:, 1]), 1e-12)
        is_mask = np.asarray(dark[toward < -_FACES].any(0) & ~dark[toward > _FACES].any(0))
        is_across = oblique > _OBLIQUE and abs(beam_shift @ line.normal) > _FACES * oblique
        use = is_mask | (bright & is_across)
        if use.sum() < MIN_DASHES:
            continue
        u, w = at[use] @ line.normal, at[use] @ line.along
        n, of = in_strips(u), in_strips(counted @ line.normal)
        i = int(np.argmax(n))
        share = (use.sum() - n[i] + 1.0) / len(counted)
        cost = float(binom.logsf(n[i] - 1, of[i], min(share, 0.5)))
        offset = (i + 0.5 * width) * _SHIFT - reach
        inside = np.abs(u - offset) <= _STRIP
        if cost < best and n[i] >= MIN_DASHES and np.ptp(w[inside]) >= MIN_SPAN:
            best, line = cost, Line(float(angle), offset, float(w[inside].min()), float(w[inside].max()))
            found = (line, line.reversed) if np.mean(is_mask[use][inside]) < 0.5 else (line,)
    return found
