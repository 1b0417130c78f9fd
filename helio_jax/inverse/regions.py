"""Regions whose level is poorly determined: candidates for `levels`, outlined by the images.

Slopes say nothing about the height of what a depth jump parts from the substrate: a least-squares fit bridges the jump
by slopes that the images contradict. Its heights still show roughly where the region is, and the images show its
outline: across a mask's edge one detector changes, across a jump two or more do. So regions are flooded from where the
heights stand out up to the strongest change of the images. Candidates may overlap and be wrong: evidence decides.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, label, watershed_ift

from helio_jax.arrays import border_mask

SHARES = 0.3, 0.6
"""Parts of the largest rise (or fall) of the heights beyond which a region is sure to be inside ..."""
OUTSIDE = 0.1
"""... and up to which a pixel is sure to be outside."""
MIN_REGION = 12
"""Smallest region that is looked for [pixels]."""
MAX_SHARE = 0.6
"""Largest share of the image that a region may cover."""
ALIKE = 0.9
"""Regions that share more than this of their union are one."""
CONTRADICTED = 0.1
"""Share of a region's outline that the data must contradict for its level to count as poorly determined."""
_SCALE = 1.0
"""Width of the Gaussian whose derivative measures the change of the images [pixels]."""
_DERIVATIVES: tuple[Any, ...] = (0, 0, 1), (0, 1, 0)
"""Orders of the derivatives by detector, y, x: along x, along y."""
_UNKNOWN = 1e6
"""Variance of data that were not observed, in those of the worst ones."""
_BAND = 2
"""Half width of a region's outline [pixels]."""
_STEPS = 60_000
"""Levels of the flooded relief, below 2^16."""


def contrast(signal: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Compute the change of the images at every pixel in standard deviations [y, x].

    The detector that changes most is left out: across the edge of a mask no other changes.

    Args:
        signal, variance: data [detector, y, x]; NaN where not observed.
    """
    is_known = np.isfinite(signal) & (variance > 0)
    worst = _UNKNOWN * np.max(variance, where=is_known, initial=1e-300)
    data, spread = np.where(is_known, signal, 0.0), np.where(is_known, variance, worst)
    slopes = (gaussian_filter(data, (0, _SCALE, _SCALE), order, mode="nearest") for order in _DERIVATIVES)
    square = sum(slope**2 for slope in slopes)
    noise = gaussian_filter(spread, (0, _SCALE, _SCALE), mode="nearest") / (8.0 * np.pi * _SCALE**4)
    relative = square / noise
    return np.sqrt(np.maximum(relative.sum(0) - relative.max(0), 0.0))


def find_regions(signal: np.ndarray, variance: np.ndarray, reliefs: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Find regions that stand out of the substrate, or lie below it; the largest first [y, x].

    Args:
        signal, variance: data [detector, y, x]; NaN where not observed.
        reliefs: heights of several solutions, each [y, x], um.

    Source: flooding: Lotufo and Falcao, The ordered queue and the optimality of the watershed approaches (2000).
    """
    change = contrast(signal, variance)
    cost = np.rint(_STEPS * change / max(float(change.max()), 1e-300)).astype(np.uint16)
    found: list[np.ndarray] = []
    for height in reliefs:
        rise = height - np.median(height[border_mask((height.shape[0], height.shape[1]), 0.06)])
        for way in (rise, -rise):
            top = float(np.quantile(way, 0.995))
            for share in SHARES if top > 0 else ():
                number, n = label(way > share * top)  # type: ignore[misc]  # SciPy's stubs
                for k in range(1, n + 1):
                    region = _flooded(cost, number == k, way < OUTSIDE * top)
                    if MIN_REGION <= region.sum() <= MAX_SHARE * region.size and not _is_among(region, found):
                        found.append(region)
    return sorted(found, key=lambda region: -int(region.sum()))


def _flooded(cost: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Grow a region from pixels inside it, against those outside, up to the largest cost between them [y, x]."""
    if inside.sum() < MIN_REGION or not outside.any():
        return np.zeros(cost.shape, bool)
    core = binary_erosion(inside, iterations=1)
    markers = np.where(core if core.any() else inside, 1, np.where(outside, 2, 0)).astype(np.int16)
    return watershed_ift(cost, markers) == 1


def _is_among(region: np.ndarray, others: list[np.ndarray]) -> bool:
    """Tell whether a region is (nearly) one of others."""
    return any((region & other).sum() > ALIKE * (region | other).sum() for other in others)


def outline(region: np.ndarray) -> np.ndarray:
    """Mark the pixels at a region's outline, on both sides [y, x]."""
    return grown(region, _BAND) & grown(~region, _BAND)


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Grow a mask [y, x] by so many pixels."""
    return np.asarray(binary_dilation(mask, np.ones((3, 3)), iterations=pixels))


def poorly_determined(regions: list[np.ndarray], is_contradicted: np.ndarray) -> list[np.ndarray]:
    """Keep the regions at whose outlines the data contradict a fit [y, x]."""
    return [region for region in regions if is_contradicted[outline(region)].mean() > CONTRADICTED]
