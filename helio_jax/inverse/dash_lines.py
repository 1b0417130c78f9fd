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
"""Least cosine of the angle between the normal of a line and a detector's -v for its mask to lie along it."""
_TURN = np.radians(0.75)
"""Angle between the lines that are tried."""
_STRIP = 0.75
"""Half the width of the strip in which dips count for a line [pixels]."""
_SHIFT = 0.25
"""Distance between the lines that are tried [pixels]."""


class Line(NamedTuple):
    """A straight line in units of pixels, (column, row).

    Attributes:
        angle: of the normal, which points to the side whose detectors the line darkens [rad].
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


def find_line(dips: Dips, v: np.ndarray) -> tuple[Line, float] | None:
    """Find the line on which chance explains the dips least.

    Args:
        dips: isolated dark pixels.
        v: direction of each detector plus beam shift, in pixels [detector, 2].

    Returns:
        The line, and the expected number of lines that chance makes of as many dips; None if none is below
        `FALSE_ALARMS`.
    """
    row, column = np.nonzero(dips.is_dip.any(0))
    if len(row) < MIN_DIPS:
        return None
    place, shows = np.stack([column, row], -1).astype(float), dips.is_dip[:, row, column]
    counted = np.argwhere(dips.is_counted)[:, ::-1].astype(float)
    angles = np.arange(0.0, 2.0 * np.pi, _TURN)
    reach = float(np.hypot(*dips.is_counted.shape))
    tests = np.log(len(angles) * 2.0 * reach / _SHIFT * 0.5 * reach**2)
    best, found = np.log(FALSE_ALARMS), None
    for angle in angles:
        line = Line(float(angle), 0.0, 0.0, 0.0)
        faces = v @ line.normal <= -_FACES * np.hypot(v[:, 0], v[:, 1])
        use = shows[faces].any(0) & ~shows[~faces].any(0)
        if use.sum() < MIN_DIPS:
            continue
        u = place[use] @ line.normal
        share = 1.0 / counted.shape[0]
        bins = int(2.0 * reach / _SHIFT) + 2
        width = round(2.0 * _STRIP / _SHIFT)
        of = lambda x: np.floor((x + reach) / _SHIFT).astype(int)  # noqa: E731
        n = np.convolve(np.bincount(of(u), minlength=bins), np.ones(width))[: bins + width - 1]
        m = np.convolve(np.bincount(of(counted @ line.normal), minlength=bins), np.ones(width))[: bins + width - 1]
        i = int(np.argmax(n))
        if n[i] < MIN_DIPS:
            continue
        rate = (use.sum() - n[i] + 1.0) * share
        centre = (i + 1 - 0.5 * width) * _SHIFT - reach
        cost = tests + float(binom.logsf(n[i] - 1, m[i], min(rate, 0.5)))
        inside = np.abs(u - centre) <= _STRIP
        w = place[use][inside] @ line.along
        if cost < best and inside.any() and np.ptp(w) >= MIN_SPAN:
            best, found = cost, Line(float(angle), float(centre), float(w.min()), float(w.max()))
    return None if found is None else (found, float(np.exp(best)))
