"""Patches: parts of the surface whose albedo is unlike 1, the albedo of the calibrated substrate.

The photometric solution has an albedo of its own in every pixel. Where masks and multiple scattering are subtracted, an
object of another material shows as a closed region of constant albedo; a wrong mask, a crevice or a limb does not stay
constant. `find_albedo_patches` looks for such regions; `fit` makes their albedos unknowns.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion, label

from helio_jax.arrays import border_mask
from helio_jax.inverse.merging import merge_regions

PATCH_BLOCK = 8
"""Unknown albedos are filled up to a multiple of this, so that one compilation serves different numbers of them."""
LEAST_PIXELS = 16
"""Smallest patch [pixels]."""
LEAST_CHANGE = 0.02
"""Smallest change of the log albedo that makes a patch: less changes the heights by less than the noise."""
LEAST_COMMON = 0.05
"""The same for the substrate itself: less is within what the gains leave open."""
SIGNIFICANCE = 6.0
"""Least change of the log albedo, in standard deviations of a patch's mean."""
CONSTANCY = 2.0
"""Largest mean square deviation from a patch's mean, in that of the substrate and at least 1."""
LARGEST_CHANGE = 0.9
"""Largest one: three prior standard deviations; more is a mask or a depth jump."""
UNEXPLAINED = 2.0
"""Mean square residual of a fit in a patch, in that of the substrate, above which another albedo is tried."""
_PENALTY = 4.0
"""Cost of a border between two regions, per side of a pixel [chi-square]."""
_OUTLIER = 9.0
"""A pixel's squared deviation counts up to this where its patch is chosen ..."""
_TOUCH = 1.0
"""... and every neighbour of another patch costs this."""
_CHOICES = 8
"""How often the pixels choose their patches."""
_LEAST_STD = 0.01
"""Least standard deviation of the log albedo of a pixel: of what is predicted."""


@dataclass(frozen=True)
class AlbedoPatches:
    """Where patches of another albedo are, and the albedos that a fit starts from.

    Attributes:
        number: of the patch of every pixel, 0: albedo 1 [y, x].
        log_albedo: natural logarithm of the relative albedo of the patches 1, 2, ... [patch].
        has_substrate: whether patch 1 is the substrate, of which the albedo is not 1.
    """

    number: np.ndarray
    log_albedo: np.ndarray
    has_substrate: bool = False

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "AlbedoPatches":
        """Make a raster [y, x] of albedo 1."""
        return cls(np.zeros(shape, int), np.zeros(0))

    def __bool__(self) -> bool:
        return bool(self.log_albedo.size)

    @property
    def objects(self) -> list[int]:
        """Numbers of the patches that are not the substrate."""
        return list(range(1 + self.has_substrate, 1 + self.log_albedo.size))

    def keeping(self, objects: list[int]) -> "AlbedoPatches":
        """Leave out all other objects: they take the substrate's albedo."""
        kept = [1, *objects] if self.has_substrate else objects
        number = np.full_like(self.number, int(self.has_substrate))
        for place, old in enumerate(kept, 1):
            number[self.number == old] = place
        return AlbedoPatches(number, self.log_albedo[[i - 1 for i in kept]], self.has_substrate)

    def unexplained(self, square: np.ndarray) -> list[int]:
        """List the objects whose images a fit explains worse than the substrate's.

        Args:
            square: mean square residual [y, x].
        """
        usual = float(np.mean(square[~np.isin(self.number, self.objects)]))
        return [i for i in self.objects if np.mean(square[self.number == i]) > UNEXPLAINED * usual]

    @property
    def albedo(self) -> np.ndarray:
        """Relative albedo of every pixel [y, x]."""
        return np.exp(np.append(0.0, self.log_albedo))[self.number]

    @property
    def members(self) -> np.ndarray:
        """Make 1 in the pixels of each patch, 0 elsewhere, filled up to full blocks [room, y, x]."""
        room = PATCH_BLOCK * -(-self.log_albedo.size // PATCH_BLOCK)
        return (self.number == np.arange(1, room + 1)[:, None, None]).astype(float)

    @property
    def known(self) -> dict[str, Any]:
        """Keywords by which a prediction is given the albedo; none where it is 1 everywhere."""
        return {"albedo": self.albedo} if self else {}

    def with_albedo(self, log_albedo: np.ndarray) -> "AlbedoPatches":
        """Copy with other albedos; those of a filled-up block are left out."""
        return replace(self, log_albedo=np.asarray(log_albedo)[: self.log_albedo.size])

    def thinned(self, thin: tuple[slice, ...]) -> "AlbedoPatches":
        """Keep some rows and columns."""
        return replace(self, number=self.number[thin])


def find_albedo_patches(log_albedo: np.ndarray, std: np.ndarray, border: float | None) -> AlbedoPatches:
    """Find the patches of a noisy map of the albedo.

    Args:
        log_albedo: of the photometric solution, NaN where there is none [y, x].
        std: its standard deviation [y, x].
        border: width of the flat border, which is of the substrate, as a share of the image; None: the border is free,
            and the largest region counts as the substrate.
    """
    is_known = np.isfinite(log_albedo) & np.isfinite(std)
    value = np.where(is_known, log_albedo, 0.0)
    spread = np.hypot(np.where(is_known, std, 1.0), _LEAST_STD)
    weight = np.where(is_known, spread**-2, 0.0)
    frame = is_known & (np.ones(value.shape, bool) if border is None else border_mask(value.shape, border))  # type: ignore[arg-type]
    if not frame.any():
        return AlbedoPatches.none(value.shape)
    middle = float(np.median(value[frame]))
    limited = np.clip(value, middle - 1.0, middle + 1.0)
    region = merge_regions(limited, weight, _PENALTY)
    base = 0 if border is None else int(np.bincount(region[frame]).argmax())
    substrate = level_of(limited, weight, region == base)
    noise = max(1.0, _scatter(limited, weight, region == base, substrate))
    found = [substrate]
    for number in np.flatnonzero(np.bincount(region.ravel()) >= LEAST_PIXELS):
        inside = region == number
        if number != base and _is_patch(limited, weight, inside, substrate, noise):
            found.append(level_of(limited, weight, inside))
    levels = np.array(found)
    choice = _closed(_chosen(limited, weight, levels))
    levels = np.array([level_of(limited, weight, choice == i, level) for i, level in enumerate(levels)])
    kept = [i for i in range(1, levels.size) if np.sum(choice == i) >= LEAST_PIXELS]
    is_common = border is not None and abs(substrate) > LEAST_COMMON
    found = AlbedoPatches(choice + 1, levels, True).keeping([i + 1 for i in kept])
    if is_common:
        return found
    return AlbedoPatches(found.number - 1, found.log_albedo[1:] - levels[0])


def level_of(value: np.ndarray, weight: np.ndarray, inside: np.ndarray, default: float = 0.0) -> float:
    """Compute the median of a map [y, x] in a region, of which the pixels count by their weight."""
    of, share = value[inside], weight[inside]
    if not share.sum() > 0.0:
        return default
    order = np.argsort(of)
    share = np.cumsum(share[order])
    return float(of[order][np.searchsorted(share, 0.5 * share[-1])])


def _scatter(value: np.ndarray, weight: np.ndarray, inside: np.ndarray, level: float) -> float:
    """Compute the mean square deviation from a level in a region [chi-square]; single outliers are limited."""
    return float(np.mean(np.minimum(weight * (value - level) ** 2, _OUTLIER)[inside]))


def _is_patch(value: np.ndarray, weight: np.ndarray, inside: np.ndarray, substrate: float, noise: float) -> bool:
    """Whether a region differs from the substrate, is more than a rim, and of one albedo."""
    level = level_of(value, weight, inside)
    significance = abs(level - substrate) * np.sqrt(weight[inside].sum() / noise)
    core = binary_erosion(inside, np.ones((2, 2)))
    is_rim = core.sum() < 0.25 * inside.sum()
    is_constant = _scatter(value, weight, inside, level) < CONSTANCY * noise
    is_other = LEAST_CHANGE < abs(level - substrate) < LARGEST_CHANGE
    return is_other and significance > SIGNIFICANCE and is_constant and not is_rim


def _chosen(value: np.ndarray, weight: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Choose the level of every pixel [y, x], by its value and the choice of its neighbours.

    Source: iterated conditional modes: Besag, J. R. Stat. Soc. B 48 (1986) 259.
    """
    cost = np.minimum(weight * (value - levels[:, None, None]) ** 2, _OUTLIER)
    choice = np.argmin(cost, axis=0)
    rows = np.arange(value.shape[0])[:, None] + 2 * np.arange(value.shape[1])
    for _ in range(_CHOICES):
        for part in range(4):
            same = np.stack([_neighbours(choice == i) for i in range(levels.size)])
            best = np.argmin(cost - _TOUCH * same, axis=0)
            choice = np.where(rows % 4 == part, best, choice)
    return choice


def _neighbours(inside: np.ndarray) -> np.ndarray:
    """Count the eight neighbours of every pixel in a region [y, x]; outside of the image its border continues."""
    room = np.pad(inside.astype(float), 1, mode="edge")
    rows = room[:-2] + room[1:-1] + room[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] - inside


def _closed(choice: np.ndarray) -> np.ndarray:
    """Leave out parts of patches [y, x] that are smaller than a patch: they take the substrate's number, 0."""
    out = np.zeros_like(choice)
    for i in range(1, int(choice.max()) + 1):
        parts = np.asarray(label(choice == i)[0])  # type: ignore[index]  # SciPy's stubs take the result for a number
        is_large = np.bincount(parts.ravel()) >= LEAST_PIXELS
        is_large[0] = False
        out[np.isin(parts, np.flatnonzero(is_large))] = i
    return out
