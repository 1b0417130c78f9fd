"""Correction of the motions of several scans, all at once, where heights move pixels: Gauss-Newton.

At oblique incidence no rigid motion of the images exists, but on a known surface one of the sample does. More than
three images of a point, read at the right places, agree on one albedo and normal; where they do not, their gradients
tell the motions' errors. Albedo and normal of every pixel are eliminated, so the motions are fitted to the images
themselves, not to what other scans predict that may be as far off.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from helio_jax.alignment.resample import smooth
from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import pitch, robust_std
from helio_jax.block_fit import eliminate
from helio_jax.errors import GuardError
from helio_jax.geometry_prior import ROTATION_STD
from helio_jax.robust import cauchy_weight

ROBUST_LIMIT = 2.0
"""Residual at which a datum counts half, in robust standard deviations: masks and shadows are in no normal."""
REWEIGHTINGS = 5
"""Solutions with weights of the one before."""
SHIFT_STD = 3.0
"""Assumed standard deviation of the stage's shifts [pixels]; of its rotations: `ROTATION_STD`."""
N_OWN = 3
"""Unknowns of a pixel: albedo times normal."""
WORST_CONDITION = 1e-10
"""Least share of the largest eigenvalue that the smallest one of determined motions has."""
LEAST_TRUE = 0.1
"""Least share of the information that is taken to be the structure's, not that of noise in the gradients."""
ALBEDO_STD = 0.03
"""Assumed standard deviation of the albedo, from pixel to pixel, over its typical value."""
_LEAST_LEFT = 0.05
"""Least share of a datum's noise that its residual is taken to have."""
_DAMPING = 1e-9
"""Of pixels whose images do not tell their normals."""


class MotionCorrection(NamedTuple):
    """What must be changed of the motions of scans.

    Attributes:
        motions: correction c of each scan: its motion m becomes m after c; the first scan's is none.
        moved: by how much each moves a pixel's place, root mean square where the images have structure [um].
        std: standard deviation of that, by residuals that are independent over the smoothing's area [um].
    """

    motions: tuple[Rigid, ...]
    moved: tuple[float, ...]
    std: tuple[float, ...]


def correct_motions(
    images: np.ndarray,
    variance: np.ndarray,
    form_factor: np.ndarray,
    is_known: np.ndarray,
    scan: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    smoothing: float,
    stated: tuple[Rigid, ...],
) -> MotionCorrection:
    """Fit the rigid motions by which the images of all scans agree, and a gain of each image.

    Valid for errors up to about the smoothing. Images that tell little leave motions where they are stated to be.

    Args:
        images: read on the surface [image, y, x].
        variance: of their noise [image, y, x].
        form_factor: of that surface [image, 3, y, x].
        is_known: [image, y, x].
        scan: number of each image's scan, from 0 [image].
        x, y: raster of the common frame [um].
        smoothing: standard deviation of the Gaussian that images are smoothed by [pixels].
        stated: corrections that lead to the motions that the stage states, to `ROTATION_STD` and `SHIFT_STD`.

    Raises:
        GuardError: the images determine no motion: fewer than four see the same points, or they show no structure.

    Source: Gauss-Newton with the pixels' unknowns eliminated (`helio_jax.block_fit`); noise in the gradients, which
    would shorten the steps and the error bars, is taken off the information (errors in variables: Fuller, Measurement
    Error Models, 1987, sec. 2.2).
    """
    linear = _Linearised.of(images, variance, form_factor, is_known, scan, x, y, smoothing)
    area = max(1.0, 4.0 * math.pi * smoothing**2)  # whose noise is one datum's
    scale, n_gains = linear.scale, len(images) - 1
    prior_std = np.array([SHIFT_STD * pitch(x), SHIFT_STD * pitch(y), ROTATION_STD * scale])
    prior = np.concatenate([np.tile(prior_std**-2.0, linear.n_moved), np.zeros(n_gains)])
    wanted = np.concatenate([*((*c.shift, c.rotation * scale) for c in stated[1:]), np.zeros(n_gains)])
    step, own_prior, robust = np.zeros(len(wanted)), None, linear.weight
    for _ in range(1 + REWEIGHTINGS):
        fit = eliminate(linear.images, robust, linear.by_own, linear.by_common, own_prior, _DAMPING)
        _check_determined(fit.information, linear.images.shape[1])
        pixel = fit.pixel_steps(step)
        rest = linear.images - np.einsum("knb,nb->kn", linear.by_own, pixel) - linear.by_common @ step
        # share of its noise that is left in a datum's residual: the pixel's unknowns take the rest
        left = 1.0 - robust * np.einsum("kni,nij,knj->kn", linear.by_own, fit.covariance, linear.by_own)
        std = max(float(robust_std((rest / np.sqrt(np.maximum(left, _LEAST_LEFT)))[linear.weight > 0.0])), 1e-300)
        information = fit.information / (area * std**2) + np.diag(prior)
        step = np.linalg.solve(information, fit.right / (area * std**2) + prior * wanted)
        noise = linear.noise_of_gradients(robust * left)
        robust = linear.weight * cauchy_weight(rest / std, ROBUST_LIMIT) ** 2
        own_prior = _same_albedo(pixel, std)
    covariance = np.linalg.inv(_without_noise(fit.information, noise) / (area * std**2) + np.diag(prior))
    found = MotionCorrection((Rigid(0.0, (0.0, 0.0)),), (0.0,), (0.0,))
    for n in range(1, linear.n_moved + 1):
        part = linear.unknowns(n)
        dx, dy, turn = step[part]
        change = linear.change[scan == n][linear.weight[scan == n] > 0.0]
        # along the gradient a place moves by (change of the image) / |gradient|, weighted by its square
        energy = np.sum(change[:, :2] ** 2)
        moved = math.sqrt(float(np.sum((change @ step[part]) ** 2) / energy))
        place_std = math.sqrt(float(np.einsum("ni,ij,nj->", change, covariance[part, part], change) / energy))
        motion = Rigid(float(turn / scale), (float(dx), float(dy)))
        found = MotionCorrection((*found.motions, motion), (*found.moved, moved), (*found.std, place_std))
    return found


@dataclass(frozen=True)
class _Linearised:
    """Smoothed images as linear functions of corrections, of gains, and of albedo times normal: k images, n pixels.

    Corrections of a scan are shifts along x and y [um], and a rotation times `scale`: a length, too.

    Attributes:
        images: [k, n].
        weight: 1 where used, else 0 [k, n].
        by_own: derivative by albedo times normal [k, n, 3].
        by_common: derivative by corrections of all scans and gains of all images, but the first [k, n, c].
        change: of each image by the correction of its scan [k, n, 3].
        scan: number of each image's scan [k].
        gradient_variance: of the gradients' noise along one axis [k, n].
        lever: derivative of `change` by the gradient along x and y [n, 3, 2].
        scale: half the field's side [um].
    """

    images: np.ndarray
    weight: np.ndarray
    by_own: np.ndarray
    by_common: np.ndarray
    change: np.ndarray
    scan: np.ndarray
    gradient_variance: np.ndarray
    lever: np.ndarray
    scale: float

    @classmethod
    def of(
        cls,
        images: np.ndarray,
        variance: np.ndarray,
        form_factor: np.ndarray,
        is_known: np.ndarray,
        scan: np.ndarray,
        x: np.ndarray,
        y: np.ndarray,
        smoothing: float,
    ) -> "_Linearised":
        """Linearise; arguments as those of `correct_motions`."""
        inside = np.stack([ndimage.binary_erosion(known, iterations=2) for known in is_known])
        use = inside & (inside.sum(0) > N_OWN)
        at = use.any(0)
        if not at.any():
            raise _undetermined(0)
        smoothed = np.stack([smooth(i, known, smoothing) for i, known in zip(images, is_known, strict=True)])
        down, along = (g[:, at] for g in np.gradient(smoothed, y, x, axis=(1, 2)))
        scale = 0.5 * float(max(np.ptp(x), np.ptp(y)))
        turn_x, turn_y = (g[at] / scale for g in np.meshgrid(x, y))
        lever = np.zeros((int(at.sum()), 3, 2))
        lever[:, 0, 0] = lever[:, 1, 1] = 1.0
        lever[:, 2] = np.stack([-turn_y, turn_x], -1)
        change = np.einsum("nia,kna->kni", lever, np.stack([along, down], -1))
        seen, n_moved = smoothed[:, at], 3 * int(scan.max())
        by_common = np.zeros((*seen.shape, n_moved + len(images) - 1))
        for k, number in enumerate(scan):
            if number:
                by_common[k, :, 3 * (number - 1) : 3 * number] = -change[k]
            if k:
                by_common[k, :, n_moved + k - 1] = -seen[k]
        gain = gradient_gain(smoothing, (pitch(y), pitch(x)))
        noise = gain * np.where(is_known, variance, 0.0)[:, at]
        by_own = np.moveaxis(form_factor, 1, -1)[:, at]
        return cls(seen, use[:, at].astype(float), by_own, by_common, change, scan, noise, lever, scale)

    @property
    def n_moved(self) -> int:
        """Number of scans that are moved."""
        return int(self.scan.max())

    def unknowns(self, number: int) -> slice:
        """Find the unknowns of a scan's correction among the common ones."""
        return slice(3 * (number - 1), 3 * number)

    def noise_of_gradients(self, weight: np.ndarray) -> np.ndarray:
        """Compute what the noise of the gradients adds to the information of the common unknowns [c, c].

        `weight`: of the data, times the share of the noise that the pixels' unknowns leave [k, n].
        """
        added = np.zeros((self.by_common.shape[-1],) * 2)
        for k, number in enumerate(self.scan):
            if number:
                block = self.unknowns(number)
                noise = weight[k] * self.gradient_variance[k]
                added[block, block] += np.einsum("n,nia,nja->ij", noise, self.lever, self.lever)
        return added


def _same_albedo(pixel: np.ndarray, std: float) -> tuple[np.ndarray, np.ndarray]:
    """Make the prior that all pixels have one albedo, as `eliminate` takes it; pixels far from it are left out of it.

    Without it a motion's error, some motions of all scans together, can look like another surface.

    Args:
        pixel: albedo times normal [n, 3].
        std: of the data, in whose units the information is.
    """
    albedo = np.linalg.norm(pixel, axis=1)
    typical = float(np.median(albedo))
    normal = pixel / np.maximum(albedo, 1e-300)[:, None]
    trust = cauchy_weight((albedo - typical) / (ALBEDO_STD * typical), ROBUST_LIMIT) ** 2
    trust = trust * (std / (ALBEDO_STD * typical)) ** 2
    return trust[:, None, None] * normal[:, :, None] * normal[:, None, :], (trust * typical)[:, None] * normal


def gradient_gain(smoothing: float, pitch: tuple[float, float]) -> float:
    """Compute the variance of a smoothed image's gradient over that of the image's noise, mean of y and x [1/um2]."""
    reach = 2 + math.ceil(4.0 * smoothing)
    point = np.zeros((2 * reach + 1,) * 2)
    point[reach, reach] = 1.0
    return 0.5 * sum(float(np.sum(g**2)) for g in np.gradient(ndimage.gaussian_filter(point, smoothing), *pitch))


def _without_noise(information: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Take what noise adds to an information matrix off, but for `LEAST_TRUE` of it in every direction."""
    root = np.linalg.cholesky(information)
    share, ways = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, noise).T))
    turned = root @ ways
    return turned @ np.diag(np.maximum(1.0 - share, LEAST_TRUE)) @ turned.T


def _check_determined(information: np.ndarray, n_pixels: int) -> None:
    """Refuse images that do not determine motions and gains."""
    least, *_, largest = np.linalg.eigvalsh(information)
    if least <= WORST_CONDITION * largest:
        raise _undetermined(n_pixels)


def _undetermined(n_pixels: int) -> GuardError:
    return GuardError(
        f"no motion can be fitted: {n_pixels} pixels that four or more images see show no structure that tells it: "
        "take the stage's motions (--motions stage)"
    )
