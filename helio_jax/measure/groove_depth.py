"""Heights across a piece of a groove: depth below the lower shoulder, and width at half of that depth."""

import itertools
from dataclasses import dataclass

import numpy as np

from helio_jax.reconstruction import Reconstruction

FLANK = 12
"""Distance to both sides in which a groove's shoulders are searched [pixels]."""


@dataclass(frozen=True)
class HeightProfile:
    """Heights across a piece of a line: pixels in bins a pixel wide; bins of its bottom and shoulders."""

    rows: np.ndarray
    columns: np.ndarray
    place: np.ndarray
    known: np.ndarray
    bottom: int
    shoulders: tuple[int, int]

    @classmethod
    def of(cls, rec: Reconstruction, rows: np.ndarray, columns: np.ndarray, t: np.ndarray) -> "HeightProfile | None":
        """Bin pixels by their distances t; None where too few heights are known on either side."""
        place = np.round(t).astype(int) + FLANK
        counts = np.bincount(place, minlength=2 * FLANK + 1)
        known = counts >= max(2.0, 0.3 * float(np.median(counts)))
        if not known[FLANK] or known[: FLANK - 1].sum() < 3 or known[FLANK + 2 :].sum() < 3:
            return None
        q = cls(rows, columns, place, known, 0, (0, 0)).means(rec.height)
        bottom = FLANK - 1 + int(np.argmin(np.where(known, q, np.inf)[FLANK - 1 : FLANK + 2]))
        sides = np.flatnonzero(known[:bottom]), bottom + 1 + np.flatnonzero(known[bottom + 1 :])
        left, right = (int(side[np.argmax(q[side])]) for side in sides)
        return cls(rows, columns, place, known, bottom, (left, right))

    def means(self, height: np.ndarray) -> np.ndarray:
        """Compute the mean height of every bin."""
        n = self.known.size
        total = np.bincount(self.place, height[self.rows, self.columns], n)
        return total / np.maximum(np.bincount(self.place, minlength=n), 1)

    def depth(self, height: np.ndarray) -> float:
        """Compute the depth of the bottom below the lower shoulder."""
        q = self.means(height)
        return float(min(q[i] for i in self.shoulders) - q[self.bottom])

    def depth_and_std(self, rec: Reconstruction) -> tuple[float, float]:
        """Compute the depth and its deviation, from the samples or else from the heights' scatter along the piece.

        The scatter is not divided by a number of pixels, because errors of neighbouring heights are correlated.
        """
        depth, std = rec.spread(self.depth)
        if rec.height_samples is None:
            std = float(np.std(rec.height[self.rows, self.columns] - self.means(rec.height)[self.place]))
        return depth, std

    def width(self, height: np.ndarray) -> float:
        """Compute the width at half of the depth [pixels]."""
        q = self.means(height)
        level = q[self.bottom] + 0.5 * self.depth(height)
        bins = np.flatnonzero(self.known)
        left, right = bins[bins <= self.bottom][::-1], bins[bins >= self.bottom]
        return _crossing(q, right, level) + _crossing(q, left, level)


def _crossing(q: np.ndarray, bins: np.ndarray, level: float) -> float:
    """Compute the distance from the first bin at which a profile first rises to a level."""
    for i, j in itertools.pairwise(bins):
        if q[j] >= level:
            return abs(float(i - bins[0])) + abs(float(j - i)) * float((level - q[i]) / (q[j] - q[i]))
    return abs(float(bins[-1] - bins[0]))
