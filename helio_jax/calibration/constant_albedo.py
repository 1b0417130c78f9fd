"""Fit of instrument and normals to the readings of one aperture, sample rotated, with a constant albedo.

reading_k = signal_k ((n . d_k)+ + m M_k) + background_k(t); the substrate reads signal + background. Unknown are the
polar angle, signals, backgrounds (Legendre polynomials in the scan's own time t), the factor m of a predicted multiple
scattering M, and a normal in every pixel, which is eliminated (block_fit.py). Normals from a grid alternate with
Gauss-Newton steps of all unknowns and avoid local minima. Masked readings count as outliers.

The vector d_k points to the aperture from the surface: for a small aperture at r = (R cos a, R sin a, D - h) the signal
of a facet is proportional to n . r (D - h) / |r|^4. The aperture's radius R on the plate is known, the sample's
distance D = R / tan(polar) is not. Source: own derivation, tests/unit/test_turned.py.
"""

import math
from typing import NamedTuple

import numpy as np

from helio_jax.block_fit import eliminate, limit_steps
from helio_jax.robust import cauchy_weight

OUTLIER = 0.06
"""Residual of a reading, over the image's median, at which its weight has fallen to a quarter."""
_MODEL_ERROR = 0.02
"""Standard deviation of the model over the median: facets are not quite flat, albedos not quite one."""
_CORRELATED = 25
"""Pixels that share an error of the model."""
_COARSE = (1.0, 0.15)
"""Outlier limits of the first two iterations, whose normals are still wrong."""
_START_ITERATIONS, _ITERATIONS, _STEPS = 3, 10, 8
_CONVERGED = 3e-4
_SLOPE_STD = 4.0
_BACKGROUND_STD = 0.1
"""Prior standard deviation of a background from the mean of all, over the median reading."""
_DRIFT_STD = 0.2
"""Prior standard deviation of the coefficients of drift, over the median reading."""
_MULTIPLE_STD = 0.25
"""Prior standard deviation of the factor of predicted multiple scattering from 1: the surface is an estimate."""
_POLAR_LIMITS = (0.15, 1.3)
_MAX_POLAR_STEP, _MAX_STEP = math.radians(5.0), 0.1
_TILT_STEP, _AZIMUTH_STEP, _MAX_TILT = 3.0, 9.0, 78.0


class Readings(NamedTuple):
    """Readings of n pixels in k scans, each over its scan's median.

    Attributes:
        value: readings [k, n].
        known: 1 where recorded [k, n].
        basis: Legendre polynomials of the scan's time at each pixel [k, n, degree + 1].
        height: of the surface over the sample's plane, 0 where unknown [n], um.
        multiple: predicted multiple scattering over the signal of the substrate [k, n].
        azimuth: of the apertures [k], rad.
        radius: of the apertures' centres on the plate, um.
        size: radius of a disc of an aperture's area, um.
    """

    value: np.ndarray
    known: np.ndarray
    basis: np.ndarray
    height: np.ndarray
    multiple: np.ndarray
    azimuth: np.ndarray
    radius: float
    size: float


class Model(NamedTuple):
    """Common unknowns.

    Attributes:
        polar: angle to the aperture [rad].
        multiple: factor of the predicted multiple scattering.
        signal: of the substrate, over the median reading [k].
        background: coefficients of the polynomials, over the median reading [k, degree + 1].
    """

    polar: float
    multiple: float
    signal: np.ndarray
    background: np.ndarray

    def vector(self) -> np.ndarray:
        """Join all unknowns in one array."""
        return np.concatenate([[self.polar, self.multiple], self.signal, self.background.ravel()])

    def moved(self, step: np.ndarray) -> "Model":
        """Add a step of all unknowns, shortened to its limits."""
        most = max(abs(step[0]) / _MAX_POLAR_STEP, np.abs(step[1:]).max() / _MAX_STEP, 1.0)
        at, k = self.vector() + step / most, len(self.signal)
        polar, signal = float(np.clip(at[0], *_POLAR_LIMITS)), np.maximum(at[2 : 2 + k], 0.02)
        return Model(polar, float(at[1]), signal, at[2 + k :].reshape(k, -1))


class Fitted(NamedTuple):
    """The model, the covariance of its unknowns, the rms of the readings about it (outliers cut), and the cost."""

    model: Model
    covariance: np.ndarray
    misfit: float
    cost: float


def level_model(readings: Readings, share: float, polar: float) -> Model:
    """Make a start: the same share of background in each scan, no drift."""
    k, _, n_terms = readings.basis.shape
    background = np.zeros((k, n_terms))
    background[:, 0] = share
    return Model(polar, 1.0, np.full(k, 1.0 - share), background)


def fit_constant_albedo(readings: Readings, polar_prior: tuple[float, float], starts: list[Model]) -> Fitted:
    """Fit the model from several starts, and continue from the best of them.

    Args:
        readings: of pixels in all scans.
        polar_prior: mean and standard deviation of the polar angle [rad].
        starts: from `level_model`.
    """
    begun = [_iterate(readings, polar_prior, start, _START_ITERATIONS, _COARSE) for start in starts]
    best = min(begun, key=lambda found: found.cost)
    return _iterate(readings, polar_prior, best.model, _ITERATIONS, ())


def _iterate(
    readings: Readings, polar_prior: tuple[float, float], model: Model, n_iterations: int, coarse: tuple[float, ...]
) -> Fitted:
    """Alternate between normals from the grid and Gauss-Newton steps of all unknowns until the cost converges."""
    last = math.inf
    for number in range(n_iterations):
        limit = coarse[number] if number < len(coarse) else OUTLIER
        slopes = _slopes_from_grid(readings, model, limit)
        for _ in range(_STEPS):
            model, slopes, residual, information = _step(readings, polar_prior, model, slopes, limit)
        misfit = math.sqrt(float(np.sum(np.minimum(residual**2, OUTLIER**2)) / readings.known.sum()))
        n_free = (readings.known.sum() - 2.0 * len(slopes)) / _CORRELATED
        mean, std = polar_prior
        cost = 0.5 * n_free * misfit**2 / _MODEL_ERROR**2 + 0.5 * ((model.polar - mean) / std) ** 2
        if number >= len(coarse) + 3 and abs(cost - last) < _CONVERGED * cost:
            break
        last = cost
    return Fitted(model, np.linalg.inv(information), misfit, cost)


def _directions(readings: Readings, polar: float) -> np.ndarray:
    """Compute the vectors d [k, n, 3]: n . d is the signal of a facet over that of the substrate."""
    radius, depth = readings.radius, readings.radius / math.tan(polar)
    z = np.maximum(depth - readings.height, 0.1 * depth)
    size = ((radius**2 + depth**2) / (depth * (radius**2 + z**2))) ** 2 * z
    x, y, up = np.broadcast_arrays(*(radius * f(readings.azimuth)[:, None] for f in (np.cos, np.sin)), z)
    return size[:, None] * np.stack([x, y, up], -1)


def _half_angle(readings: Readings, polar: float) -> float:
    """Compute the half-angle [rad] of the disc that looks as large as an aperture from the sample's plane."""
    return readings.size * math.sqrt(math.cos(polar)) * math.sin(polar) / readings.radius


def _signal_at_horizon(facing: np.ndarray, direction: np.ndarray, half_angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the signal of facets whose own horizon may cut the aperture, and its derivative by `facing` [k, n].

    The mean of max(0, c + s t) over a disc, c = n . d of its middle and s = |d| half_angle: where the middle is on the
    horizon, 0.2 s is seen; without it that signal would look like background.
    """
    s = np.linalg.norm(direction, axis=-1) * half_angle
    u = np.clip(facing / s, -1.0, 1.0)
    root = np.sqrt(1.0 - u * u)
    seen = 0.5 + (np.arcsin(u) + u * root) / math.pi
    signal = s * (u * seen + 2.0 / (3.0 * math.pi) * root**3)
    return np.where(facing > s, facing, signal), seen


def _background(readings: Readings, model: Model) -> np.ndarray:
    return np.einsum("kj,knj->kn", model.background, readings.basis)


def _slopes_from_grid(readings: Readings, model: Model, limit: float) -> np.ndarray:
    """Find the slopes [n, 2] of the grid's normals that explain the readings best."""
    tilt, azimuth = (
        g.ravel()
        for g in np.meshgrid(
            np.radians(np.arange(0.0, _MAX_TILT, _TILT_STEP)), np.radians(np.arange(0.0, 360.0, _AZIMUTH_STEP))
        )
    )
    grid = np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    single = readings.value - _background(readings, model) - model.multiple * model.signal[:, None] * readings.multiple
    predicted = model.signal[:, None, None] * np.maximum(_directions(readings, model.polar) @ grid, 0.0)
    cost = np.einsum("kn,kng->ng", readings.known, np.minimum((single[..., None] - predicted) ** 2, limit**2))
    normal = grid[:, np.argmin(cost, axis=1)].T
    return -normal[:, :2] / normal[:, 2:]


def _step(
    readings: Readings, polar_prior: tuple[float, float], model: Model, slopes: np.ndarray, limit: float
) -> tuple[Model, np.ndarray, np.ndarray, np.ndarray]:
    """Take a Gauss-Newton step: model and slopes after it, residuals and the model's information before it."""
    k, n, n_terms = readings.basis.shape
    signal = model.signal[:, None]
    length = np.sqrt(1.0 + np.sum(slopes**2, 1))
    normal = np.concatenate([-slopes, np.ones((n, 1))], 1) / length[:, None]
    direction, nudge = _directions(readings, model.polar), 1e-3
    by_polar = (_directions(readings, model.polar + nudge) - _directions(readings, model.polar - nudge)) / (2.0 * nudge)
    facing = np.einsum("kni,ni->kn", direction, normal)
    single, seen = _signal_at_horizon(facing, direction, _half_angle(readings, model.polar))
    relative = single + model.multiple * readings.multiple
    residual = readings.known * (readings.value - _background(readings, model) - signal * relative)
    weight = readings.known * cauchy_weight(residual, limit) ** 2 / _MODEL_ERROR**2
    by_model = np.zeros((k, n, 2 + k + k * n_terms))
    by_model[..., 0] = signal * seen * np.einsum("kni,ni->kn", by_polar, normal)
    by_model[..., 1] = signal * readings.multiple
    for i in range(k):
        by_model[i, :, 2 + i] = relative[i]
        by_model[i, :, 2 + k + i * n_terms : 2 + k + (i + 1) * n_terms] = readings.basis[i]
    tilts = [-(np.eye(3)[axis] - normal * normal[:, axis : axis + 1]) / length[:, None] for axis in (0, 1)]
    by_slope = np.stack([signal * seen * np.einsum("kni,ni->kn", direction, t) for t in tilts], -1)
    slope_prior = np.eye(2) / _SLOPE_STD**2, -slopes / _SLOPE_STD**2
    found = eliminate(residual, weight, by_slope, by_model, slope_prior)
    prior, mean = _prior(polar_prior, k, n_terms)
    information = found.information / _CORRELATED + prior
    step = np.linalg.solve(information, found.right / _CORRELATED - prior @ (model.vector() - mean))
    moved = model.moved(step)
    own_steps = limit_steps(found.pixel_steps(moved.vector() - model.vector()), 0.5 * length)
    return moved, slopes + own_steps, residual, information


def _prior(polar_prior: tuple[float, float], k: int, n_terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute information and mean of the prior; the mean of all backgrounds is free."""
    size = 2 + k + k * n_terms
    information, mean = 1e-6 * np.eye(size), np.zeros(size)
    information[0, 0], mean[0] = polar_prior[1] ** -2, polar_prior[0]
    information[1, 1], mean[1] = _MULTIPLE_STD**-2, 1.0
    level = 2 + k + np.arange(k) * n_terms
    information[np.ix_(level, level)] += (np.eye(k) - 1.0 / k) / _BACKGROUND_STD**2
    for term in range(1, n_terms):
        information[level + term, level + term] += _DRIFT_STD**-2
    return information, mean
