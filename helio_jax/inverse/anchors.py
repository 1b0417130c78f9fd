"""What is known of many heights together: levels of regions, a held mean height, what the user states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from helio_jax.inverse.levels import grown
from helio_jax.inverse.samples import nearest_kept


def most_frequent(numbers: np.ndarray) -> int:
    """Return the most frequent of some numbers; 0 of none."""
    return int(np.argmax(np.bincount(numbers))) if numbers.size else 0


@dataclass(frozen=True)
class Anchors:
    """Sums of weights times heights that are known.

    Attributes:
        weight: over the standard deviation [anchor, y, x], 1/um.
        value: of the sums, over their standard deviations [anchor].
    """

    weight: np.ndarray
    value: np.ndarray

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "Anchors":
        """Make those of a raster [y, x] without any."""
        return cls(np.zeros((0, *shape)), np.zeros(0))

    @classmethod
    def of_levels(
        cls, region: np.ndarray, levels: Mapping[int, tuple[float, float]], is_level: np.ndarray, margin: int
    ) -> "Anchors":
        """Anchor mean heights of regions above the largest one, number 0.

        Args:
            region: number of every pixel's region [y, x].
            levels: height above region 0 and its standard deviation by number, um.
            is_level: pixels that are at their region's level, no walls [y, x].
            margin: pixels beside other regions that do not count for the level of region 0.
        """
        base = ~grown(region > 0, margin)
        weight, value = [], []
        for number, (height, std) in levels.items():
            inside = (region == number) & is_level
            if inside.any() and base.any():
                weight.append((inside / inside.sum() - base / base.sum()) / std)
                value.append(height / std)
        return cls(np.stack(weight), np.array(value)) if weight else cls.none(region.shape)

    def known_steps(self, region: np.ndarray) -> dict[int, tuple[float, np.ndarray]]:
        """Find the largest known difference of heights between each region and region 0.

        Args:
            region: number of every pixel's region [y, x].

        Returns:
            By number of the region: the difference [um], and the weights that measure it, of sum 1 on its upper side
            and -1 on its lower side [y, x].
        """
        found: dict[int, tuple[float, np.ndarray]] = {}
        for weight, value in zip(self.weight, self.value, strict=True):
            sides = [region[side] for side in (weight > 0.0, weight < 0.0)]
            if not all(side.size for side in sides):
                continue
            low, high = sorted(map(most_frequent, sides))
            total = float(weight.sum(where=weight > 0.0))
            height = abs(float(value)) / total
            if low == 0 < high and height > found.get(high, (0.0, weight))[0]:
                found[high] = height, weight / total
        return found

    def and_also(self, other: "Anchors") -> "Anchors":
        """Join with others."""
        return Anchors(np.concatenate([self.weight, other.weight]), np.concatenate([self.value, other.value]))

    def differences(self) -> "Anchors":
        """Anchor only how they differ from one another; what is common to them stays open.

        Of sums whose weights, times the standard deviation, add up to 1 above and -1 below.
        """
        if len(self.value) < 2:
            return Anchors.none(self.weight.shape[1:])
        std = 1.0 / np.sum(self.weight, (1, 2), where=self.weight > 0.0)
        weight, value = std[:, None, None] * self.weight, std * self.value
        share = std**-2 / np.sum(std**-2)
        return Anchors((weight - np.tensordot(share, weight, 1)) / std[:, None, None], (value - share @ value) / std)

    def across(self, region: np.ndarray) -> "Anchors":
        """Take those whose pixels above and below are mostly of different regions [y, x]."""
        return self.taken([most_frequent(region[w > 0.0]) != most_frequent(region[w < 0.0]) for w in self.weight])

    def taken(self, which: Sequence[bool] | np.ndarray) -> "Anchors":
        """Take some of them."""
        is_taken = np.asarray(which, bool)
        return Anchors(self.weight[is_taken], self.value[is_taken])

    def within_one(self, region: np.ndarray) -> "Anchors":
        """Keep, above and below, the pixels of the most frequent region [y, x], at the same sum of weights.

        A pixel that jumps part from all others may have any height: it would take up what the anchor says of the rest.
        """
        out = np.zeros_like(self.weight)
        for new, old in zip(out, self.weight, strict=True):
            for part in (old > 0.0, old < 0.0):
                if part.any():
                    kept = part & (region == most_frequent(region[part]))
                    new[kept] = old[kept] * (old[part].sum() / old[kept].sum())
        return Anchors(out, self.value)

    def padded(self, block: int) -> "Anchors":
        """Fill up with empty ones to a multiple of `block`: one compilation serves different numbers of them."""
        n = -len(self.value) % block if len(self.value) else block
        return Anchors(np.pad(self.weight, ((0, n), (0, 0), (0, 0))), np.pad(self.value, (0, n)))

    def thinned(self, thin: tuple[slice, ...]) -> "Anchors":
        """Keep some rows and columns; the others' weights go to the nearest of them.

        The transpose of `samples.on_raster`: sums of what that resamples are sums of the thinned heights.
        """
        out = self.weight
        for axis, part in enumerate(thin, 1):
            nearest = nearest_kept(out.shape[axis], part.step or 1)
            is_nearest = nearest[:, None] == np.arange(nearest.max() + 1)
            out = np.moveaxis(np.moveaxis(out, axis, -1) @ is_nearest, -1, axis)
        return Anchors(out, self.value)
