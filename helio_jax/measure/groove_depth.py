"""Heights across a piece of a groove: its depth below the lower shoulder, and its width at half of that."""

import itertools
from dataclasses import dataclass

import numpy as np

from helio_jax.reconstruction import Reconstruction


@dataclass(frozen=True)
class HeightProfile:
    """Heights across a piece of a line: pixels in bins a pixel wide; its bottom and shoulders, as bins."""

    rows: np.ndarray
    columns: np.ndarray
    place: np.ndarray
    known: np.ndarray
    bottom: int
    shoulders: tuple[int, int]

    @classmethod
    def of(
        cls, rec: Reconstruction, rows: np.ndarray, columns: np.ndarray, t: np.ndarray, reach: int
    ) -> "HeightProfile | None":
        """Return the profile of pixels at distances t, or None where too little is known on either side."""
        place = np.round(t).astype(int) + reach
        counts = np.bincount(place, minlength=2 * reach + 1)
        known = counts >= max(2.0, 0.3 * float(np.median(counts)))
        if not known[reach] or known[: reach - 1].sum() < 3 or known[reach + 2 :].sum() < 3:
            return None
        self = cls(rows, columns, place, known, reach, (reach, reach))
        q = self.means(rec.height)
        bottom = reach - 1 + int(np.argmin(np.where(known, q, np.inf)[reach - 1 : reach + 2]))
        sides = np.flatnonzero(known[:bottom]), bottom + 1 + np.flatnonzero(known[bottom + 1 :])
        left, right = (int(side[np.argmax(q[side])]) for side in sides)
        return cls(rows, columns, place, known, bottom, (left, right))

    def means(self, height: np.ndarray) -> np.ndarray:
        """Return the mean height in every bin."""
        n = self.known.size
        total = np.bincount(self.place, height[self.rows, self.columns], n)
        return total / np.maximum(np.bincount(self.place, minlength=n), 1)

    def depth(self, height: np.ndarray) -> float:
        """Return the depth of the bottom below the lower shoulder."""
        q = self.means(height)
        return float(min(q[i] for i in self.shoulders) - q[self.bottom])

    def depth_and_std(self, rec: Reconstruction) -> tuple[float, float]:
        """Return the depth and its deviation: of the samples, or else the scatter of the heights along the piece.

        That scatter is not divided by a number of pixels, for errors of neighbouring heights go together.
        """
        depth, std = rec.spread(self.depth)
        if rec.height_samples is None:
            std = float(np.std(rec.height[self.rows, self.columns] - self.means(rec.height)[self.place]))
        return depth, std

    def width(self, height: np.ndarray) -> float:
        """Return the width at half of the depth [pixels]."""
        q = self.means(height)
        level = q[self.bottom] + 0.5 * self.depth(height)
        bins = np.flatnonzero(self.known)
        left, right = bins[bins <= self.bottom][::-1], bins[bins >= self.bottom]
        return _crossing(q, right, level) + _crossing(q, left, level)


def _crossing(q: np.ndarray, bins: np.ndarray, level: float) -> float:
    """Return how far from its first bin a profile first rises to a level."""
    for i, j in itertools.pairwise(bins):
        if q[j] >= level:
            return abs(float(i - bins[0])) + abs(float(j - i)) * float((level - q[i]) / (q[j] - q[i]))
    return abs(float(bins[-1] - bins[0]))
