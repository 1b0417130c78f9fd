"""Joint alignment of rotated scans with a constant-albedo prior (variable projection), for smooth samples.

Linear photometry leaves a common displacement of all fields along their detectors undetermined on balls and soft hills:
it changes them to others of varying albedo. A constant albedo determines it; the fit fails where the albedo varies as
slowly as the relief. Model, far field, for image k: reading = gain_k (max(0, m . d_k) + background), where m is the
normal times the albedo and the substrate of albedo 1 reads gain_k (1 + background). Common unknowns: the motions, a
gain per image, background, polar angle. The m of each pixel are eliminated (block_fit.py); their length has a prior of
1. Masks, rims and multiple scattering count as outliers.

Source: variable projection: Golub & Pereyra, Inverse Problems 19 (2003) R1; tests/unit/test_onealbedo.py.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from helio_jax.alignment.resample import SplineImage, smooth
from helio_jax.alignment.rigid import Rigid, rotation_about, separation
from helio_jax.arrays import pitch, robust_std
from helio_jax.block_fit import Eliminated, eliminate, limit_steps
from helio_jax.micrograph import MicrographStack
from helio_jax.robust import cauchy_weight

_LEVELS_PX = (3.0, 1.5, 1.0)
_STEPS = 30
_CONVERGED_PX = 0.01
_BACKGROUNDS = (0.0, 0.3, 1.0, 3.0)
"""Backgrounds from which the fit starts."""
_ALBEDO_STD, _LOOSE_ALBEDO_STD = 0.05, 0.1
"""Prior standard deviation of the albedo, and the one of a second fit that shows how far the result depends on it."""
_START_OFFSET_PX = 2.0
"""Common displacement from which the second fit starts: what it does not recover adds to the standard deviation."""
_MODEL_ERROR = 0.1
"""Standard deviation of the model's error of a reading, in standard deviations of the image."""
_OUTLIER = 2.5
_DAMPING = 1e-3
_MIN_IMAGES = 4
_CORRELATED_PX = 16
"""Side of a square in which the model's errors (multiple scattering, rims, near field) count as one error.

Balls traced by benchmarks/alignment.py end 0.2 to 1 px off; the stated standard deviation is 0.2 to 0.4 px per axis."""
_NORMAL_STEPS = 8
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05)
_TOLERANCE = 2e-3
"""Relative growth of the cost that a step may cause: few inner steps do not find the best normals."""


@dataclass(frozen=True)
class AlbedoAlignment:
    """Result of the fit.

    Attributes:
        motions: of all scans, from the frame of the first one.
        std_um: standard deviation of a pixel's place per axis, for each scan [um].
        albedo_spread: robust standard deviation of the albedo over the pixels.
        background: over the signal of the substrate.
        polar_deg: effective polar angle of the first aperture.
    """

    motions: tuple[Rigid, ...]
    std_um: tuple[float, ...]
    albedo_spread: float
    background: float
    polar_deg: float


def align_with_albedo_prior(stacks: tuple[MicrographStack, ...], start: list[Rigid]) -> AlbedoAlignment:
    """Fit all motions at once, coarse to fine.

    Args:
        stacks: scans at normal incidence, four or more images in all.
        start: motions good to some pixels, the first one no motion.
    """
    fit = _JointFit(stacks, start, _LEVELS_PX[0], _ALBEDO_STD)
    fit.choose_background()
    for level in _LEVELS_PX:
        fit = fit.at_level(level, _ALBEDO_STD, fit.state.motions)
        fit.run()
    second, motions = fit, _displaced(fit.state.motions, _START_OFFSET_PX * fit.step)
    for level in _LEVELS_PX[1:]:
        second = second.at_level(level, _LOOSE_ALBEDO_STD, motions)
        second.run()
        motions = second.state.motions
    apart = [separation(a, b, fit.points) for a, b in zip(fit.state.motions, motions, strict=True)]
    stds = tuple(math.hypot(a, b / math.sqrt(2)) for a, b in zip(fit.std_um(), apart, strict=True))
    albedo = np.linalg.norm(fit.state.m, axis=1)[fit.is_known]
    polar = math.degrees(float(fit.polar()[0]))
    return AlbedoAlignment(fit.state.motions, stds, float(robust_std(albedo - 1.0)), fit.state.background, polar)


def _displaced(motions: tuple[Rigid, ...], size_um: float) -> tuple[Rigid, ...]:
    """Displace the field of every scan along its own x; the frame stays the first scan's."""
    moved = [Rigid(0.0, (size_um, 0.0)).after(m) for m in motions]
    back = moved[0].inverse()
    return tuple(m.after(back) for m in moved)


def _redescending(t: np.ndarray) -> np.ndarray:
    return cauchy_weight(t, _OUTLIER) ** 2


def _convex(t: np.ndarray) -> np.ndarray:
    return 1.0 / np.sqrt(1.0 + (t / _OUTLIER) ** 2)


def _inverse(matrix: np.ndarray, ridge: float) -> np.ndarray:
    """Invert a matrix of unknowns of different units; the ridge is relative to its diagonal."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    units = np.outer(scale, scale)
    return np.linalg.inv(matrix / units + ridge * np.eye(scale.size)) / units


def _solve(matrix: np.ndarray, right: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Solve for the free unknowns [n]; the others are zero."""
    out = np.zeros_like(right)
    out[free] = _inverse(matrix[np.ix_(free, free)], 1e-6) @ right[free]
    return out


class _State(NamedTuple):
    """All unknowns: motions, gain [image], background, correction of the polar angle [rad], m [pixel, 3]."""

    motions: tuple[Rigid, ...]
    gain: np.ndarray
    background: float
    polar_change: float
    m: np.ndarray


class _JointFit:
    """Images at one smoothness, and the unknowns (`state`), which `run` improves."""

    def __init__(
        self, stacks: tuple[MicrographStack, ...], motions: list[Rigid], level_px: float, albedo_std: float
    ) -> None:
        """Smooth the images by `level_px` pixels of the first scan; above 2 every second pixel is used."""
        first = stacks[0]
        self.stacks, self.level, self.albedo_std = stacks, level_px, albedo_std
        self.step = pitch(first.x)
        every = 2 if level_px > 2 else 1
        self.points = np.stack(np.meshgrid(first.x[::every], first.y[::every]), -1).reshape(-1, 2)
        self.center = np.array([first.x.mean(), first.y.mean()])
        self.n_correlated = (_CORRELATED_PX / every) ** 2  # pixels that share an error of the model
        n_smoothed = max(1.0, 4 * math.pi * level_px**2 / every**2)  # pixels that share noise
        self.images, self.scan, sigma, azimuth, tangent = [], [], [], [], []
        for k, stack in enumerate(stacks):
            for n, aperture in enumerate(stack.instrument.apertures()):
                known = stack.is_observed[n]
                median = float(np.median(stack.counts[n][known]))
                image = smooth(stack.counts[n] / median, known, level_px * self.step / pitch(stack.x))
                by_y, by_x = np.gradient(image, stack.y, stack.x)
                self.images.append([SplineImage.of(a, known, stack.x, stack.y) for a in (image, by_x, by_y)])
                inside = np.clip(image[known], *np.quantile(image[known], [0.01, 0.99]))
                noise = 0.0 if stack.variance is None else float(np.median(stack.variance[n][known])) / median**2
                sigma.append(math.hypot(_MODEL_ERROR * float(np.std(inside)), math.sqrt(noise / n_smoothed)))
                self.scan.append(k)
                azimuth.append(math.atan2(aperture.center[1], aperture.center[0]))
                tangent.append(math.hypot(*aperture.center) / stack.instrument.sample_distance)
        self.azimuth, self.nominal_polar = np.array(azimuth), np.arctan(tangent)
        self.sigma = np.maximum(np.array(sigma), 1e-6)
        self.polar_std = math.radians(first.instrument.polar_std_deg)
        self.n_motion = 3 * (len(stacks) - 1)
        self.state = _State(tuple(motions), np.ones(len(self.scan)), 0.0, 0.0, np.zeros((len(self.points), 3)))

    def at_level(self, level_px: float, albedo_std: float, motions: tuple[Rigid, ...]) -> "_JointFit":
        """Make the fit at another smoothness, from these motions and the present instrument."""
        out = _JointFit(self.stacks, list(motions), level_px, albedo_std)
        s = self.state
        out.state = out.state._replace(gain=s.gain, background=s.background, polar_change=s.polar_change)
        out._sample_images()
        out._solve_normals()
        return out

    def polar(self) -> np.ndarray:
        """Polar angles of the apertures [image]."""
        return self.nominal_polar + self.state.polar_change

    def choose_background(self) -> None:
        """Choose the background by the least cost of fits with the motions as they are."""
        found, start = [], self.state
        self._sample_images()
        for background in _BACKGROUNDS:
            gain = np.full(len(self.scan), 1.0 / (1.0 + background))
            self.state = start._replace(gain=gain, background=background)
            self._solve_normals()
            for _ in range(6):
                self._advance(move=False)
            found.append((self._cost(), self.state))
        self.state = min(found, key=lambda f: f[0])[1]

    def run(self) -> None:
        """Step until no motion changes by more than a hundredth of a pixel."""
        for _ in range(_STEPS):
            before = self.state.motions
            is_done = self._advance()
            moved = max(separation(a, b, self.points) for a, b in zip(before, self.state.motions, strict=True))
            if not is_done or moved < _CONVERGED_PX * self.step:
                break

    def _sample_images(self) -> None:
        """Interpolate all images at the present motions, and their slopes by (x, y, rotation) [image, pixel, 3]."""
        values, slopes, seen = [], [], []
        lever = self.points - self.center
        for k, (image, by_x, by_y) in zip(self.scan, self.images, strict=True):
            motion = self.state.motions[k]
            places = motion.apply(self.points)
            value, is_seen = image.at(places)
            slope = np.stack([by_x.at(places)[0], by_y.at(places)[0]], -1) @ motion.matrix
            by_rotation = slope[:, 1] * lever[:, 0] - slope[:, 0] * lever[:, 1]
            values.append(value)
            seen.append(is_seen)
            slopes.append(np.concatenate([slope, by_rotation[:, None]], -1))
        self.values, self.slopes, self.seen = np.stack(values), np.stack(slopes), np.stack(seen)
        self.is_known = self.seen.sum(0) >= _MIN_IMAGES

    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute d (d . z = 1) and its derivatives by polar angle and by rotation of the scan [image, 3]."""
        azimuth = self.azimuth - np.array([self.state.motions[k].rotation for k in self.scan])
        c, s, t = np.cos(azimuth), np.sin(azimuth), np.tan(self.polar())
        zero = np.zeros_like(t)
        by_polar = np.stack([c, s, zero], -1) * (1 + t * t)[:, None]
        return np.stack([t * c, t * s, zero + 1.0], -1), by_polar, np.stack([t * s, -t * c, zero], -1)

    def _residuals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute signal / gain and residual / sigma [image, pixel], and (albedo - 1) / std [pixel]."""
        signal = np.maximum(self._directions()[0] @ self.state.m.T, 0.0)
        residual = self.values - self.state.gain[:, None] * (signal + self.state.background)
        albedo = np.linalg.norm(self.state.m, axis=1)
        return signal, residual / self.sigma[:, None], (albedo - 1.0) / self.albedo_std

    def _cost(self) -> float:
        """Compute the mean robust cost of a pixel."""
        _, t, of_albedo = self._residuals()
        t2, a2 = (t / _OUTLIER) ** 2, (of_albedo / _OUTLIER) ** 2
        return float(np.mean((np.sum(np.where(self.seen, t2 / (1 + t2), 0.0), 0) + a2 / (1 + a2))[self.is_known]))

    def _chi_square(self) -> float:
        """Compute the weighted chi-square per degree of freedom: data and albedo less three unknowns per pixel."""
        _, t, of_albedo = self._residuals()
        weight, albedo_weight = np.where(self.seen, _redescending(t), 0.0), _redescending(of_albedo)
        total = (np.sum(weight * t**2, 0) + albedo_weight * of_albedo**2)[self.is_known].sum()
        return float(total / np.maximum(weight.sum(0) + albedo_weight - 3.0, 0.0)[self.is_known].sum())

    def _solve_normals(self) -> None:
        """Find m from level pixels; convex weights first, so that no pixel keeps a wrong set of outliers."""
        self.state = self.state._replace(m=np.tile([0.0, 0.0, 1.0], (len(self.points), 1)))
        for weigh in (_convex, _redescending):
            for _ in range(_NORMAL_STEPS):
                self._step_normals(weigh)

    def _eliminate(self, weigh: Callable[[np.ndarray], np.ndarray], by_common: np.ndarray | None = None) -> Eliminated:
        """Linearise in m; the last row of the data is the albedo's prior."""
        signal, t, of_albedo = self._residuals()
        weight = np.where(self.seen, weigh(t), 0.0)
        if by_common is not None:
            weight *= self.is_known
        is_active = (signal > 0) | (t > 0)
        by_m = is_active[..., None] * (self.state.gain / self.sigma)[:, None, None] * self._directions()[0][:, None]
        unit = self.state.m / np.maximum(np.linalg.norm(self.state.m, axis=1), 1e-9)[:, None]
        return eliminate(
            np.concatenate([t, -of_albedo[None]]),
            np.concatenate([weight, weigh(of_albedo)[None]]),
            np.concatenate([by_m, unit[None] / self.albedo_std]),
            by_common,
            damping=_DAMPING,
        )

    def _step_normals(self, weigh: Callable[[np.ndarray], np.ndarray]) -> None:
        self.state = self.state._replace(m=self.state.m + limit_steps(self._eliminate(weigh).pixel_steps(), 1.0))

    def _normal_equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute matrix and right side of the step of the common unknowns, the m eliminated ([n, n], [n]).

        Unknowns: x, y [um] and rotation of every scan but the first, log gain of every image, background, polar angle.
        """
        s, n_images = self.state, len(self.scan)
        signal = self._residuals()[0]
        _, by_polar, by_rotation = self._directions()
        model = np.zeros((n_images + 1, len(self.points), self.n_motion + n_images + 2))
        for i, k in enumerate(self.scan):
            is_facing = signal[i] > 0
            if k:
                model[i, :, 3 * (k - 1) : 3 * k] = -self.slopes[i]
                model[i, :, 3 * k - 1] += s.gain[i] * is_facing * (s.m @ by_rotation[i])
            model[i, :, self.n_motion + i] = s.gain[i] * (signal[i] + s.background)
            model[i, :, -2] = s.gain[i]
            model[i, :, -1] = s.gain[i] * is_facing * (s.m @ by_polar[i])
        model[:-1] /= self.sigma[:, None, None]
        matrix, right, *_ = self._eliminate(_redescending, model)
        matrix[-1, -1] += self.n_correlated / self.polar_std**2
        right[-1] -= self.n_correlated * s.polar_change / self.polar_std**2
        return matrix, right

    def _advance(self, move: bool = True) -> bool:
        """Take a Gauss-Newton step of all unknowns, shortened if the cost would grow; return whether one was taken."""
        self._settle()
        before, kept = self._cost(), self.state
        matrix, right = self._normal_equations()
        free = np.arange(0 if move else self.n_motion, right.size)
        step = _solve(matrix, right, free)
        if kept.background + step[-2] < 0.0:  # at its bound it is no unknown
            right = right - matrix[:, -2] * -kept.background
            step = _solve(matrix, right, free[free != right.size - 2])
            step[-2] = -kept.background
        for length in _STEP_LENGTHS:
            self.state = self._moved(kept, length * step)
            self._settle()
            if self._cost() <= before * (1.0 + _TOLERANCE):
                return True
        self.state = kept
        return False

    def _settle(self) -> None:
        """Sample the images, improve the m, and scale them so that the median albedo is one."""
        self._sample_images()
        for _ in range(_NORMAL_STEPS // 2):
            self._step_normals(_redescending)
        s = self.state
        albedo = float(np.median(np.linalg.norm(s.m, axis=1)[self.is_known]))
        self.state = s._replace(m=s.m / albedo, gain=s.gain * albedo, background=s.background / albedo)

    def _moved(self, state: _State, step: np.ndarray) -> _State:
        """Add a step of the common unknowns (see `_normal_equations`), limited to where the model is about linear."""
        limit, motions = 1.5 * self.level * self.step, list(state.motions)
        for k in range(1, len(motions)):
            x, y, rotation = step[3 * (k - 1) : 3 * k]
            part = min(1.0, limit / max(math.hypot(x, y), 1e-12))
            motions[k] = motions[k].after(rotation_about(self.center, part * rotation, part * np.array([x, y])))
        most = 0.1 * (1.0 + state.background)
        return state._replace(
            motions=tuple(motions),
            gain=state.gain * np.exp(np.clip(step[self.n_motion : -2], -0.2, 0.2)),
            background=max(0.0, state.background + float(np.clip(step[-2], -most, most))),
            polar_change=state.polar_change + float(np.clip(step[-1], -0.05, 0.05)),
        )

    def std_um(self) -> list[float]:
        """Compute a pixel's standard deviation per axis for every scan; the model's errors are correlated."""
        covariance = _inverse(self._normal_equations()[0], 1e-9)
        inflation = self.n_correlated * self._chi_square()
        lever, out = self.points - self.center, [0.0]
        for k in range(1, len(self.stacks)):
            own = np.diag(covariance)[3 * (k - 1) : 3 * k]
            variance = own[0] + own[1] + own[2] * float(np.mean(np.sum(lever**2, -1)))
            out.append(math.sqrt(inflation * variance / 2))
        return out
