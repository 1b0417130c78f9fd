"""The linear photometric solution: albedo and normal of every pixel from three or more images.

I_k = rho n . Phi_k per pixel, weighted least squares (Woodham, Opt. Eng. 19 (1980) 139; for helium: Radić et
al., arXiv 2501.14833). `Phi` may be constant (the paper's far-field method) or a function of the
pixel's current height (near field). Knows no shadows, masks or multiple scattering; NumPy only.
"""

from dataclasses import dataclass

import numpy as np

from helio_jax.block_fit import eliminate, limit_steps
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import normal_of_slopes, slopes_of_normal
from helio_jax.micrograph import MicrographStack
from helio_jax.robust import cauchy_weight
from helio_jax.validity import MIN_IMAGES

_ROBUST_ROUNDS = 8
_DARK_LIMIT = 3.0
_GRAZING = 0.3
"""Cosine between a facet's normal and an aperture's direction below which the facet's own horizon cuts the aperture
(half-angles of 12 to 17 degrees), so that n . Phi is too small, and much of what it reads is multiple scattering."""
_LITTLE = 1e-3
"""Weight left to such data."""
_SLOPE_STD = 4.0
"""Prior deviation of a beam-frame slope where the albedo is known."""
_NEWTON_STEPS = 8


@dataclass(frozen=True)
class PhotometricSolution:
    """Per-pixel result.

    Attributes:
        normals: unit normals [y, x, 3]; (0, 0, 1) where invalid.
        albedo: relative reflectivity [y, x]; NaN where invalid.
        weight: confidence of the slope, 0.05 to 1, relative to the best tenth's [y, x]; 0 where invalid.
        n_images: usable images [y, x].
        residuals: (data - model) / standard deviation [detector, y, x].
    """

    normals: np.ndarray
    albedo: np.ndarray
    weight: np.ndarray
    n_images: np.ndarray
    residuals: np.ndarray


def _unit_of(stack: MicrographStack) -> float:
    """Return the counts that are one beam: its atoms, or the mean signal where they are not known."""
    return stack.n_rays or float(np.nanmean(np.abs(np.where(stack.is_observed, stack.signal, np.nan))))


def signal_of(stack: MicrographStack) -> tuple[np.ndarray, np.ndarray]:
    """Compute background-subtracted signal and its variance in units of the beam (counts / n_rays) [detector, y, x].

    Without a known number of beam atoms the unit is the mean signal, so that the albedo is relative. Without
    a known variance every datum of the stack's dwell time gets the same one: 1 % of the mean signal, squared.
    """
    counts = np.where(stack.is_observed, stack.signal, np.nan)
    unit = _unit_of(stack)
    if stack.variance is not None:
        variance = np.where(stack.is_observed, stack.variance, np.nan)
        variance = np.maximum(variance, 1e-9 * np.nanmean(counts**2))
    else:
        variance = np.where(stack.is_observed, (0.01 * np.nanmean(np.abs(counts))) ** 2, np.nan)
        if stack.dwell_map is not None and stack.dwell is not None:
            variance = variance * stack.dwell / np.where(stack.dwell_map > 0.0, stack.dwell_map, np.nan)
    return counts / unit, variance / unit**2


def parallax_of(stack: MicrographStack) -> tuple[np.ndarray, np.ndarray] | None:
    """Return how the signal changes per um of height above given heights, in units of the beam; None: one beam.

    Returns:
        The change [detector, y, x], 1/um, and the heights [y, x], um.
    """
    if stack.parallax is None or stack.parallax_height is None:
        return None
    return np.where(stack.is_observed, stack.parallax, 0.0) / _unit_of(stack), stack.parallax_height


def noise_share_of(stack: MicrographStack) -> np.ndarray | None:
    """Return the noise of every pixel over that of the median dwell time [y, x]; None: all alike."""
    if stack.dwell_map is None:
        return None
    seen = stack.is_observed.any(0)
    if not seen.any():
        return None
    return np.sqrt(np.where(seen, np.median(stack.dwell_map[seen]) / np.where(seen, stack.dwell_map, 1.0), 1.0))


def _weighted_solve(phi: np.ndarray, signal: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Solve the 3 x 3 normal equations of every pixel; returns rho n [y, x, 3]."""
    normal_matrix = np.einsum("kyx,kiyx,kjyx->yxij", weight, phi, phi)
    right = np.einsum("kyx,kiyx,kyx->yxi", weight, phi, signal)
    scale = np.trace(normal_matrix, axis1=-2, axis2=-1)[..., None, None]
    scale = np.where(scale > 0, scale, 1.0)
    ridge = 1e-12 * np.eye(3)
    return np.linalg.solve(normal_matrix / scale + ridge, (right / scale[..., 0])[..., None])[..., 0]


def solve_linear(signal: np.ndarray, variance: np.ndarray, phi: np.ndarray) -> PhotometricSolution:
    """Solve for albedo and normal in every pixel.

    Pixels recorded in fewer than 3 images get the flat normal and weight 0 (as in the paper). With more than 3
    images, data darker than the model by several standard deviations are taken as masked and down-weighted
    (Cauchy weight, one-sided: a mask can only darken). Where an aperture is at or below the facet's own horizon and the
    datum brighter than n . Phi, which is then too small or negative, it shows only that the facet faces away: it is
    left out where 3 others remain (else steep facets come out too flat). With exactly 3 images nothing is redundant,
    and masked data stay: they hold all the steep slope there is (docs/conventions.md).

    Args:
        signal, variance: data [detector, y, x], NaN where not observed.
        phi: form factors [detector, 3, y, x].
    """
    observed = np.isfinite(signal)
    n_images = observed.sum(0)
    is_solvable = n_images >= MIN_IMAGES
    data = np.where(observed, signal, 0.0)
    base = np.where(observed, 1.0 / np.where(observed, variance, 1.0), 0.0)
    base = np.where(is_solvable, base, 0.0)
    weight, is_away = base, np.zeros_like(observed)
    sigma = np.sqrt(np.where(observed, variance, 1.0))
    n_rounds = _ROBUST_ROUNDS if signal.shape[0] > MIN_IMAGES else 1
    for _ in range(n_rounds):
        rho_n = _weighted_solve(phi, data, weight)
        model = single_scattering(phi, np.moveaxis(rho_n, -1, 0))
        residuals = np.where(observed, (data - model) / sigma, 0.0)
        is_away = observed & (model < _GRAZING * np.linalg.norm(phi, axis=1) * np.linalg.norm(rho_n, axis=-1))
        is_away &= (residuals > 0.0) & ((observed & ~is_away).sum(0) >= MIN_IMAGES)
        weight = base * cauchy_weight(np.minimum(residuals, 0.0), _DARK_LIMIT) * np.where(is_away, _LITTLE, 1.0)
    rho = np.linalg.norm(rho_n, axis=-1)
    ok = is_solvable & (rho > 0)
    normals = np.where(ok[..., None], rho_n / np.where(ok, rho, 1.0)[..., None], np.array([0.0, 0.0, 1.0]))
    tells = observed & ~is_away if n_rounds > 1 else observed
    confidence = np.where(ok, np.clip((data * np.sqrt(base)).min(0, where=tells, initial=np.inf), 0.0, None), 0.0)
    top = np.quantile(confidence[ok], 0.9) if ok.any() else 1.0
    slope_weight = np.where(ok, np.clip(confidence / (top or 1.0), 0.05, 1.0), 0.0)
    return PhotometricSolution(normals, np.where(ok, rho, np.nan), slope_weight, n_images, residuals)


def solve_known_albedo(
    signal: np.ndarray, variance: np.ndarray, phi: np.ndarray, start: np.ndarray, shift: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the two beam-frame slopes of every pixel where the albedo is known to be 1.

    Two unknowns instead of three: pixels that are masked in one of three detectors stay determined. Damped
    Gauss-Newton on (a, b) with a weak prior N(0, `_SLOPE_STD`^2), which holds what no datum fixes.

    Args:
        signal, variance: single-scattering data [detector, y, x], NaN where not observed.
        phi: visible form factors [detector, 3, y, x].
        start: unit normals [y, x, 3].
        shift: `Instrument.beam_shift`.

    Returns:
        Slopes dh/dX, dh/dY [2, y, x], and their posterior covariances [y, x, 2, 2].

    Source: own derivation; the same equations as Woodham (1980) with rho given.
    """
    observed = np.isfinite(signal)
    data = np.where(observed, signal, 0.0)
    weight = np.where(observed, 1.0 / variance, 0.0).reshape(len(data), -1)
    a, b, _ = slopes_of_normal(start, shift)
    slopes = np.clip(np.stack([a, b], -1), -_SLOPE_STD, _SLOPE_STD)
    tangents = np.array([[-1.0, 0.0, -shift[0]], [0.0, -1.0, -shift[1]]])
    for _ in range(_NEWTON_STEPS):
        normal = np.stack(normal_of_slopes(slopes[..., 0], slopes[..., 1], shift))
        length = np.sqrt((normal**2).sum(0))
        unit = normal / length
        model = single_scattering(phi, unit)
        along = np.einsum("kiyx,si->skyx", phi, tangents)
        turn = np.einsum("iyx,si->syx", unit, tangents)
        by_slope = np.moveaxis((along - model * turn[:, None]) / length, 0, -1)
        prior = np.eye(2) / _SLOPE_STD**2, -slopes.reshape(-1, 2) / _SLOPE_STD**2
        n = len(data)
        found = eliminate((data - model).reshape(n, -1), weight, by_slope.reshape(n, -1, 2), own_prior=prior)
        steps = found.pixel_steps().reshape(slopes.shape)
        slopes = slopes + limit_steps(steps, 0.5 * np.sqrt(1.0 + (slopes**2).sum(-1)))
    return np.moveaxis(slopes, -1, 0), found.covariance.reshape(*slopes.shape, 2)
