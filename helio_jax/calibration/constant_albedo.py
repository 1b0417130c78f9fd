"""The fit of instrument and normals to readings of one aperture from several sides, with one albedo everywhere.

reading_k = signal_k ((n . d_k)+ + m M_k) + background_k(t), level ground reading signal + background. Unknown
are polar angle, signals, backgrounds (Legendre polynomials in the scan's own time t), the share m of a predicted
multiple scattering M, and a normal in every pixel. The normals are eliminated (Schur complement); normals anew from a
grid, in turns with Gauss-Newton steps of all unknowns, keep it out of local minima. Cast shadows count as outliers.

The vector d_k points to the aperture from where the surface is: for a small aperture at r = (R cos a, R sin a, D - h)
the signal of a facet goes with n . r (D - h) / |r|^4. The aperture's radius R on the plate is known, and the sample's
distance D = R / tan(polar) is not. Source: own derivation; the elimination as in Triggs et al., Bundle Adjustment, LNCS
1883 (2000) 298, sec. 6.1.
"""

import math
from typing import NamedTuple

import numpy as np

OUTLIER = 0.06
"""Deviation of a reading, over the image's median, at which its weight has fallen to a quarter (Geman and McClure)."""
_MODEL_ERROR = 0.02
"""The same of the model: facets are not quite flat, albedos not quite one."""
_TOGETHER = 25
"""Pixels that share such an error."""
_COARSE = (1.0, 0.15)
"""Outlier limits of the first two turns, whose normals are still wrong."""
_START_TURNS, _TURNS, _STEPS = 3, 10, 8
_SETTLED = 3e-4
_SLOPE_STD = 4.0
_POLAR_LIMITS = (0.15, 1.3)
_LARGEST_TURN, _LARGEST_CHANGE = math.radians(5.0), 0.1
_TILT_STEP, _AZIMUTH_STEP, _MAX_TILT = 3.0, 9.0, 78.0


class Readings(NamedTuple):
    """Readings of n pixels in k scans, each over its scan's median.

    Attributes:
        value: readings [k, n].
        known: 1 where recorded [k, n].
        basis: Legendre polynomials of the scan's time at each pixel [k, n, degree + 1].
        height: of the surface, where something is known of it, over the sample's plane [n], um.
        multiple: predicted multiple scattering, over level ground's signal [k, n].
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


class Priors(NamedTuple):
    """Prior means and standard deviations; backgrounds over an image's median reading."""

    polar: float
    polar_std: float
    background_std: float
    drift_std: float
    multiple_std: float


class Model(NamedTuple):
    """What the readings say of the instrument.

    Attributes:
        polar: angle to the aperture [rad].
        multiple: factor of the predicted multiple scattering.
        signal: of level ground, over the median reading [k].
        background: coefficients of the polynomials, over the median reading [k, degree + 1].
    """

    polar: float
    multiple: float
    signal: np.ndarray
    background: np.ndarray

    def vector(self) -> np.ndarray:
        """Return all unknowns in one array."""
        return np.concatenate([[self.polar, self.multiple], self.signal, self.background.ravel()])

    def moved(self, step: np.ndarray) -> "Model":
        """Return the model after a step of all unknowns, kept within limits."""
        most = max(abs(step[0]) / _LARGEST_TURN, np.abs(step[1:]).max() / _LARGEST_CHANGE, 1.0)
        at, k = self.vector() + step / most, len(self.signal)
        polar, signal = float(np.clip(at[0], *_POLAR_LIMITS)), np.maximum(at[2 : 2 + k], 0.02)
        return Model(polar, float(at[1]), signal, at[2 + k :].reshape(k, -1))


class Fitted(NamedTuple):
    """The model, the covariance of its unknowns, the rms of the readings about it (outliers cut), and the cost."""

    model: Model
    covariance: np.ndarray
    misfit: float
    cost: float


def level_model(readings: Readings, priors: Priors, share: float, polar: float | None = None) -> Model:
    """Return a start: the same share of background in each scan, no drift, at the prior's polar angle or another."""
    k, _, n_terms = readings.basis.shape
    background = np.zeros((k, n_terms))
    background[:, 0] = share
    return Model(priors.polar if polar is None else polar, 1.0, np.full(k, 1.0 - share), background)


def fit_constant_albedo(readings: Readings, priors: Priors, starts: list[Model]) -> Fitted:
    """Fit the model from several starts, the best of which is followed to the end."""
    begun = [_turns(readings, priors, start, _START_TURNS, _COARSE) for start in starts]
    best = min(begun, key=lambda found: found.cost)
    return _turns(readings, priors, best.model, _TURNS, ())


def _turns(readings: Readings, priors: Priors, model: Model, n_turns: int, coarse: tuple[float, ...]) -> Fitted:
    """Take normals from the grid and follow all unknowns from there, in turns, until the cost settles."""
    last = math.inf
    for turn in range(n_turns):
        limit = coarse[turn] if turn < len(coarse) else OUTLIER
        slopes = _slopes_from_grid(readings, model, limit)
        for _ in range(_STEPS):
            model, slopes, residual, information = _step(readings, priors, model, slopes, limit)
        misfit = math.sqrt(float(np.sum(np.minimum(residual**2, OUTLIER**2)) / readings.known.sum()))
        n_free = (readings.known.sum() - 2.0 * len(slopes)) / _TOGETHER
        cost = 0.5 * n_free * misfit**2 / _MODEL_ERROR**2 + 0.5 * ((model.polar - priors.polar) / priors.polar_std) ** 2
        if turn >= len(coarse) + 3 and abs(cost - last) < _SETTLED * cost:
            break
        last = cost
    return Fitted(model, np.linalg.inv(information), misfit, cost)


def _directions(readings: Readings, polar: float) -> np.ndarray:
    """Return the vectors d [k, n, 3], so that n . d is the signal of a facet over level ground's."""
    radius, depth = readings.radius, readings.radius / math.tan(polar)
    z = np.maximum(depth - readings.height, 0.1 * depth)
    size = ((radius**2 + depth**2) / (depth * (radius**2 + z**2))) ** 2 * z
    turn = readings.azimuth[:, None]
    up = np.broadcast_to(z, (len(readings.azimuth), len(z)))
    return size[:, None] * np.stack([radius * np.cos(turn) + 0.0 * up, radius * np.sin(turn) + 0.0 * up, up], -1)


def _half_angle(readings: Readings, polar: float) -> float:
    """Return the angle [rad] of the disc that looks as large as an aperture from the sample's plane."""
    return readings.size * math.sqrt(math.cos(polar)) * math.sin(polar) / readings.radius


def _beside_horizon(facing: np.ndarray, direction: np.ndarray, half_angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the signal of facets whose own horizon may cut the aperture, and its derivative by `facing` [k, n].

    The mean of max(0, c + s t) over a disc, c = n . d of its middle and s = |d| half_angle: where the middle is on the
    horizon, 0.2 s is seen and not nothing, which would look like background.
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
    """Return the slopes [n, 2] of the grid's normals that explain the readings best."""
    tilt, turn = (
        g.ravel()
        for g in np.meshgrid(
            np.radians(np.arange(0.0, _MAX_TILT, _TILT_STEP)), np.radians(np.arange(0.0, 360.0, _AZIMUTH_STEP))
        )
    )
    grid = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    rest = readings.value - _background(readings, model) - model.multiple * model.signal[:, None] * readings.multiple
    away = np.zeros((readings.value.shape[1], grid.shape[1]))
    for signal, direction, data, known in zip(
        model.signal, _directions(readings, model.polar), rest, readings.known, strict=True
    ):
        away += known[:, None] * np.minimum((data[:, None] - signal * np.maximum(direction @ grid, 0.0)) ** 2, limit**2)
    normal = grid[:, np.argmin(away, axis=1)].T
    return -normal[:, :2] / normal[:, 2:]


def _step(
    readings: Readings, priors: Priors, model: Model, slopes: np.ndarray, limit: float
) -> tuple[Model, np.ndarray, np.ndarray, np.ndarray]:
    """Return model and slopes after a Gauss-Newton step, the residuals before it, and the model's information."""
    k, n, n_terms = readings.basis.shape
    signal = model.signal[:, None]
    length = np.sqrt(1.0 + np.sum(slopes**2, 1))
    normal = np.concatenate([-slopes, np.ones((n, 1))], 1) / length[:, None]
    direction, nudge = _directions(readings, model.polar), 1e-3
    turned = (_directions(readings, model.polar + nudge) - _directions(readings, model.polar - nudge)) / (2.0 * nudge)
    facing = np.einsum("kni,ni->kn", direction, normal)
    single, is_lit = _beside_horizon(facing, direction, _half_angle(readings, model.polar))
    light = single + model.multiple * readings.multiple
    residual = readings.known * (readings.value - _background(readings, model) - signal * light)
    weight = readings.known / ((1.0 + (residual / limit) ** 2) ** 2 * _MODEL_ERROR**2)
    by_model = np.zeros((k, n, 2 + k + k * n_terms))
    by_model[..., 0] = signal * is_lit * np.einsum("kni,ni->kn", turned, normal)
    by_model[..., 1] = signal * readings.multiple
    for i in range(k):
        by_model[i, :, 2 + i] = light[i]
        by_model[i, :, 2 + k + i * n_terms : 2 + k + (i + 1) * n_terms] = readings.basis[i]
    tilts = [-(np.eye(3)[axis] - normal * normal[:, axis : axis + 1]) / length[:, None] for axis in (0, 1)]
    by_slope = np.stack([signal * is_lit * np.einsum("kni,ni->kn", direction, t) for t in tilts], -1)
    own = np.einsum("kn,kni,knj->nij", weight, by_slope, by_slope) + np.eye(2) / _SLOPE_STD**2
    own_right = np.einsum("kn,kni,kn->ni", weight, by_slope, residual) - slopes / _SLOPE_STD**2
    both = np.einsum("kn,kng,kni->ngi", weight, by_model, by_slope)
    solved = np.einsum("ngi,nij->ngj", both, np.linalg.inv(own))
    flat = by_model.reshape(k * n, -1)
    weighed = flat * weight.reshape(-1, 1)
    # not by BLAS, whose threads would spin on the other cores for nothing
    whole = np.einsum("mg,mh->gh", weighed, flat) - np.einsum("ngj,nhj->gh", solved, both)
    right = np.einsum("mg,m->g", weighed, residual.ravel()) - np.einsum("ngj,nj->g", solved, own_right)
    prior, mean = _prior(priors, k, n_terms)
    information = whole / _TOGETHER + prior
    step = np.linalg.solve(information, right / _TOGETHER - prior @ (model.vector() - mean))
    moved = model.moved(step)
    done = moved.vector() - model.vector()
    own_step = np.linalg.solve(own, (own_right - np.einsum("ngi,g->ni", both, done))[..., None])[..., 0]
    most = 0.5 * length / np.maximum(np.linalg.norm(own_step, axis=1), 1e-12)
    return moved, slopes + own_step * np.minimum(1.0, most)[:, None], residual, information


def _prior(priors: Priors, k: int, n_terms: int) -> tuple[np.ndarray, np.ndarray]:
    """Return information and mean of the prior: what all backgrounds have in common is free."""
    size = 2 + k + k * n_terms
    information, mean = 1e-6 * np.eye(size), np.zeros(size)
    information[0, 0], mean[0] = priors.polar_std**-2, priors.polar
    information[1, 1], mean[1] = priors.multiple_std**-2, 1.0
    level = 2 + k + np.arange(k) * n_terms
    information[np.ix_(level, level)] += (np.eye(k) - 1.0 / k) / priors.background_std**2
    for term in range(1, n_terms):
        information[level + term, level + term] += priors.drift_std**-2
    return information, mean
