"""Planes through regions of a height map: fitted robustly, and extrapolated from a region to the pixels around it."""

import numpy as np
from scipy import ndimage

from helio_jax.arrays import pitch, robust_std
from helio_jax.reconstruction import Reconstruction

_TUKEY = 4.685
_ITERATIONS = 30
_NO_WIDTH = 1e-12
"""Mean square width of a region over its mean square length below which it is a line."""
_NO_CORE = 1e-6
"""Sum of Gaussian weights below which a region is not extrapolated."""


def fit_planes(rec: Reconstruction, region: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit z = a x + b y + c robustly (Tukey's biweight) to a region of surfaces [surface, y, x].

    By normal equations about the middle of the region. A region one pixel wide has no slope across.

    Returns:
        (a, b, c) [surface, 3] and the misfit of the region's pixels [surface, pixel].
    """
    z = heights[:, region]
    middle = np.array([rec.x[region].mean(), rec.y[region].mean()])
    design = np.stack([rec.x[region] - middle[0], rec.y[region] - middle[1], np.ones(z.shape[1])])
    weight, least = np.ones(z.shape), 1e-9 * (np.ptp(z, axis=1, keepdims=True) + 1.0)
    for _ in range(_ITERATIONS):
        weighted = weight[:, None] * design
        inverse = np.linalg.pinv(weighted @ design.T, rcond=_NO_WIDTH, hermitian=True)
        planes = (inverse @ (weighted @ z[..., None]))[..., 0]
        misfit = z - planes @ design
        ratio = np.minimum(np.abs(misfit) / (_TUKEY * robust_std(misfit, (1,)) + least), 1.0)
        new = (1.0 - ratio**2) ** 2
        if np.allclose(new, weight, atol=1e-6):
            break
        weight = new
    planes[:, 2] -= planes[:, :2] @ middle
    return planes, misfit


def extrapolated(rec: Reconstruction, core: np.ndarray, width: float) -> np.ndarray:
    """Compute the heights [y, x] of the planes fitted, around every pixel, to a region's core with Gaussian weights.

    Args:
        rec: heights.
        core: pixels that the planes are fitted to [y, x].
        width: standard deviation of the weights [pixels]; beyond 5 of them from the core the result is infinite.
    """

    def weighted(values: np.ndarray | float) -> np.ndarray:
        return ndimage.gaussian_filter(np.where(core, values, 0.0), width, mode="constant", truncate=5.0)

    def mean(values: np.ndarray) -> np.ndarray:
        return weighted(values) / total

    total = np.maximum(weighted(1.0), np.finfo(float).tiny)
    x, y, z = rec.x - rec.x.mean(), rec.y - rec.y.mean(), rec.height
    at = np.stack([mean(x), mean(y)], -1)
    level = mean(z)
    moments = [[mean(a * b) - mean(a) * mean(b) for b in (x, y)] for a in (x, y)]
    slopes = np.stack([mean(a * z) - mean(a) * level for a in (x, y)], -1)
    ridge = 0.1 * pitch(rec.raster_x) * pitch(rec.raster_y)  # a core one pixel wide has no slope across
    matrix = np.moveaxis(np.array(moments), (0, 1), (-2, -1)) + ridge * np.eye(2)
    plane = np.linalg.solve(matrix, slopes[..., None])[..., 0]
    height = level + np.sum(plane * (np.stack([x, y], -1) - at), -1)
    return np.where(total > _NO_CORE, height, np.inf)
