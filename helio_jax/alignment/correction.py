"""Correction of a scan's motion by what its images should be, where heights move pixels: Gauss-Newton.

At oblique incidence no rigid motion of the images exists, but on a known surface one of the sample does: images that
are read at the surface differ from the predicted ones by their gradient times the motion's error.
"""

import math

import numpy as np
from scipy import ndimage

from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import robust_std
from helio_jax.errors import GuardError
from helio_jax.robust import cauchy_weight

ROBUST_LIMIT = 2.0
"""Residual at which a pixel counts half, in robust standard deviations: masks and shadows are not predicted."""


def correct_motion(
    images: np.ndarray, predicted: np.ndarray, is_known: np.ndarray, x: np.ndarray, y: np.ndarray, smoothing: float
) -> tuple[Rigid, float, float]:
    """Fit the rigid motion by which images must be moved to agree with predicted ones, and a gain of each image.

    Valid for errors up to about the smoothing.

    Args:
        images: of one scan, read on the surface [detector, y, x].
        predicted: what they should be.
        is_known: where both are known [detector, y, x].
        x, y: raster of the common frame [um].
        smoothing: standard deviation of the Gaussian that images and prediction are smoothed by [pixels].

    Returns:
        The correction c: the scan's motion m becomes m after c. Then, where the images have structure (root mean
        square, weighted by the squared gradient): by how much it moves a pixel's place, and the standard deviation of
        that, by residuals that are independent over the smoothing's area [um].

    Raises:
        GuardError: the images determine no motion: nothing is known of them, or they show no structure.
    """
    (grid_x, grid_y), number = np.meshgrid(x, y), len(images)
    scale = 0.5 * max(np.ptp(x), np.ptp(y))
    rows, right = [], []
    for k, (image, model, known) in enumerate(zip(images, predicted, is_known, strict=True)):
        weight = ndimage.gaussian_filter(known.astype(float), smoothing)
        smooth = lambda f, known=known, weight=weight: (  # noqa: E731
            ndimage.gaussian_filter(np.where(known, f, 0.0), smoothing) / np.maximum(weight, 1e-6)
        )
        seen, wanted = smooth(image), smooth(model)
        down, along = np.gradient(wanted, y, x)
        is_used = np.asarray(ndimage.binary_erosion(known & (weight > 0.5), iterations=2), bool)
        gain = np.zeros((number, *image.shape))
        gain[k] = seen
        turned = (grid_x * down - grid_y * along) / scale
        rows.append(np.stack([along, down, turned, *gain], -1)[is_used])
        right.append((wanted - seen)[is_used])
    design, misfit = np.concatenate(rows), np.concatenate(right)
    if np.linalg.matrix_rank(design) < design.shape[1]:
        raise GuardError(
            f"no motion can be fitted: {len(misfit)} pixels of the scan and of what the others predict show no "
            "structure that tells it: take the stage's motions (--motions stage)"
        )
    weight = np.ones(len(misfit))
    for _ in range(5):
        found = np.linalg.lstsq(design * weight[:, None], misfit * weight, rcond=None)[0]
        rest = misfit - design @ found
        weight = cauchy_weight(rest / max(robust_std(rest), 1e-300), ROBUST_LIMIT)
    area = max(1.0, 4.0 * math.pi * smoothing**2)
    covariance = robust_std(rest) ** 2 * area * np.linalg.inv((design * weight[:, None] ** 2).T @ design)[:3, :3]
    # along the gradient a place moves by (change of the image) / |gradient|, weighted by its square
    slope, energy = design[:, :3], np.sum(design[:, :2] ** 2)
    moved = math.sqrt(float(np.sum((slope @ found[:3]) ** 2)) / energy)
    std = math.sqrt(float(np.einsum("ni,ij,nj->", slope, covariance, slope)) / energy)
    return Rigid(float(found[2] / scale), (float(found[0]), float(found[1]))), moved, std
