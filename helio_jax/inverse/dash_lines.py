"""Lines of dashes: pixels in which a detector's signal dips, isolated, along a straight line of the image.

The mask band of a low step is shorter than a pixel. It shows only where a pixel happens to lie in it: as dashes along
the edge. A line counts as found where so many dips on it are no chance, at a stated number of false alarms.

Source: meaningful alignments: Desolneux, Moisan and Morel, Int. J. Comput. Vis. 40 (2000) 7.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, median_filter
from scipy.stats import binom

from helio_jax.arrays import nearest_known
from helio_jax.inverse.mask_edges import HALF, SHADED

FALSE_ALARMS = 1e-3
"""Expected number of lines that chance alone makes of the dips of one stack."""
MIN_SPAN = 12.0
"""Shortest line [pixels]."""
MIN_DIPS = 5
"""Fewest dips of a line."""
_AROUND = 7
"""Side of the square whose median a pixel is compared with [pixels]."""
_NOISE = 5.0
"""Least depth of a dip [standard deviations]."""
_FACES = 0.2
"""Least cosine of the angle between the normal of a line and a detector's -v for its mask to lie beside it, and between
normal and v for none to lie there."""
_TURN = np.radians(0.75)
"""Angle between the lines that are tried."""
_STRIP = 0.75
"""Half the width of the strip in which dips count for a line [pixels]."""
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


@dataclass(frozen=True)
class Dips:
    """Isolated dark pixels.

    Attributes:
        is_dip: whether a detector's signal dips [detector, y, x].
        is_counted: pixels that could show one: observed, and not within dark regions [y, x].
    """

    is_dip: np.ndarray
    is_counted: np.ndarray


def find_dips(signal: np.ndarray, variance: np.ndarray, lit: np.ndarray, is_explained: np.ndarray) -> Dips:
    """Find dark pixels that belong to no region as wide as two pixels.

    Args:
        signal: NaN where not observed [detector, y, x].
        variance: of the signal [detector, y, x].
        lit: signal of the level surface [detector].
        is_explained: pixels in the bands of measured steps [detector, y, x].
    """
    dips, wide = np.zeros(signal.shape, bool), np.zeros(signal.shape[1:], bool)
    for k, image in enumerate(signal):
        known = np.isfinite(image)
        if not known.any() or lit[k] <= 0.0:
            continue
        filled = image[nearest_known(known)]
        around = median_filter(filled, _AROUND, mode="nearest")
        dark = filled < SHADED * around
        square = binary_opening(filled < SHADED * lit[k], np.ones((2, 2)))
        wide |= np.asarray(binary_dilation(square, np.ones((3, 3)), 2), bool)
        deep = around - filled > _NOISE * np.sqrt(np.maximum(np.nan_to_num(variance[k]), 0.0))
        dips[k] = dark & deep & known & (around > HALF * lit[k])
    counted = np.isfinite(signal).all(0) & ~wide & ~is_explained.any(0)
    return Dips(dips & counted, counted)


def find_line(dips: Dips, place: np.ndarray, v: np.ndarray) -> Line | None:
    """Find the line on which chance explains the dips least, if it is below `FALSE_ALARMS`.

    The dips of other places are how frequent chance makes them. On a line count dips of the detectors that a step along
    it masks, in pixels where no other detector's signal dips: a groove darkens both.

    Args:
        dips: isolated dark pixels.
        place: of the pixels, about the middle of the image [y, x, 2], pixels.
        v: direction of each detector plus beam shift [detector, 2].
    """
    is_any = dips.is_dip.any(0)
    if is_any.sum() < MIN_DIPS:
        return None
    at, shows, counted = place[is_any], dips.is_dip[:, is_any], place[dips.is_counted]
    angles = np.arange(0.0, 2.0 * np.pi, _TURN)
    reach = float(np.hypot(place[..., 0], place[..., 1]).max()) + 2.0
    bins, width = int(2.0 * reach / _SHIFT), round(2.0 * _STRIP / _SHIFT)
    # every strip, and every start and end in it
    best, found = np.log(FALSE_ALARMS / (len(angles) * bins * 2.0 * reach**2)), None

    def in_strips(u: np.ndarray) -> np.ndarray:
        number = np.bincount(((u + reach) / _SHIFT).astype(int), minlength=bins)
        return np.convolve(number, np.ones(width), "valid")

    for angle in angles:
        line = Line(float(angle), 0.0, 0.0, 0.0)
        toward = v @ line.normal / np.maximum(np.hypot(v[:, 0], v[:, 1]), 1e-12)
        use = shows[toward < -_FACES].any(0) & ~shows[toward > _FACES].any(0)
        if use.sum() < MIN_DIPS:
            continue
        u, w = at[use] @ line.normal, at[use] @ line.along
        n, of = in_strips(u), in_strips(counted @ line.normal)
        i = int(np.argmax(n))
        share = (use.sum() - n[i] + 1.0) / len(counted)
        cost = float(binom.logsf(n[i] - 1, of[i], min(share, 0.5)))
        offset = (i + 0.5 * width) * _SHIFT - reach
        inside = np.abs(u - offset) <= _STRIP
        if cost < best and n[i] >= MIN_DIPS and np.ptp(w[inside]) >= MIN_SPAN:
            best, found = cost, Line(float(angle), offset, float(w[inside].min()), float(w[inside].max()))
    return found
