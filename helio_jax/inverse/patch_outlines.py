"""Outlines of surface patches by the signals beside them.

Edges are laid as straight lines, and gaps between them are closed by what is shortest: a row of pixels may be given to
the patch on the other side, and masks and multiple scattering then end a pixel off. The signals beside a wall differ so
much from those above it that every pixel shows to which side it belongs.
"""

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from helio_jax.inverse.edges import ranked

PASSES = 3
"""Outlines move by up to a pixel in each."""
WINDOW = 5
"""Side of the square whose pixels of a patch show what a pixel of it looks like; those at outlines do not count."""
MODEL_ERROR = 0.05
"""Error of that, as a fraction of the signal of the level surface."""
ALIKE = 16.0
"""Largest mean square difference, over detectors, from the patch that a pixel is given to [standard deviations squared]
..."""
UNLIKE = 4.0
"""... and how many times as large it is at least for the patch that the pixel was given to before."""


def with_outlines_moved(patch: np.ndarray, signal: np.ndarray, variance: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Give pixels beside an outline to the patch on the other side where only its pixels look alike.

    Args:
        patch: number of every pixel's patch [y, x].
        signal, variance: [detector, y, x]; NaN where not observed.
        lit: signal of the level surface [detector].

    Returns:
        Numbers of the patches, by falling size [y, x].
    """
    for _ in range(PASSES):
        is_inside = minimum_filter(patch, 3, mode="nearest") == maximum_filter(patch, 3, mode="nearest")
        numbers = np.arange(int(patch.max()) + 1)
        unlike = np.array([_unlike(is_inside & (patch == k), signal, variance, lit) for k in numbers])
        beside = np.array([maximum_filter(patch == k, 3, mode="nearest") for k in numbers])
        unlike = np.where(beside, unlike, np.inf)
        best, own = np.argmin(unlike, axis=0), np.take_along_axis(unlike, patch[None], 0)[0]
        least = np.min(unlike, axis=0)
        is_other = (least < ALIKE) & (own > UNLIKE * np.maximum(least, 1.0)) & np.isfinite(own)
        moved = np.where(is_other, best, patch)
        if np.array_equal(moved, patch):
            break
        patch = moved
    return ranked(np.unique(patch, return_inverse=True)[1].ravel()).reshape(patch.shape)


def _unlike(inside: np.ndarray, signal: np.ndarray, variance: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Compute the mean square difference of every pixel from the pixels inside a patch around it [y, x].

    Infinite where there are none; in standard deviations squared.
    """
    known = np.isfinite(signal) & np.isfinite(variance)
    is_used = inside & known.all(0)
    count = uniform_filter(is_used.astype(float), WINDOW, mode="constant")
    total = np.array([uniform_filter(np.where(is_used, s, 0.0), WINDOW, mode="constant") for s in signal])
    with np.errstate(divide="ignore", invalid="ignore"):
        square = (signal - total / count) ** 2 / (variance + (MODEL_ERROR * lit[:, None, None]) ** 2)
        mean = np.sum(np.where(known, square, 0.0), 0) / known.sum(0)
    return np.where((count > 0.5 / WINDOW**2) & known.any(0), mean, np.inf)
