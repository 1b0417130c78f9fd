"""Align turned scans of a smooth sample by the wish that it has one albedo: what the linear photometry leaves open.

Model, far field, per pixel and image k: reading = gain_k (max(0, m . d_k) + share), level ground of albedo 1 reading
gain_k (1 + share); m is the normal times the albedo, whose length should be one. Unknown are the motions, a gain per
image, the background's share, the polar angle (prior: the instrument file's) and m in every pixel, which is eliminated
(variable projection: the steps of the few are those of the whole problem). Shadows, rims and multiple scattering are
outliers. Fields displaced alike along their detectors change balls and soft hills to others of another albedo, so
that this alone tells such a displacement; it fails where the albedo varies as slowly as the relief.

Source: variable projection: Golub & Pereyra, Inverse Problems 19 (2003) R1; robust weights: Geman & McClure, Bull. Int.
Stat. Inst. 52 (1987) 5; tests/unit/test_onealbedo.py.
"""

import math
from dataclasses import dataclass

import numpy as np

from helio_jax.alignment.resample import Readable, smooth
from helio_jax.alignment.rigid import Rigid, about, separation
from helio_jax.arrays import pitch, robust_std
from helio_jax.micrograph import MicrographStack

_LEVELS_PX = (3.0, 1.5, 1.0)
_STEPS = 30
_STEADY_PX = 0.01
_SHARES = (0.0, 0.3, 1.0, 3.0)
_ALBEDO_STD, _LOOSE = 0.05, 0.1
"""Deviation of the albedo in the fit, and in the second one that tells how much the result hangs on it."""
_SHAKE_PX = 2.0
"""Common displacement of all fields from which the second one starts: what does not return is in its deviation."""
_MODEL_ERROR = 0.1
"""Deviation of a reading from the model beside noise, in standard deviations of the image."""
_POLAR_STD = math.radians(5.0)
_OUTLIER = 2.5
_RIDGE = 1e-3
_LEAST_IMAGES = 4
_ALIKE_PX = 16
"""Side of a square in which errors of the model (multiple scattering, rims, near field) are taken as one error.

Balls traced by benchmarks/alignment.py end 0.2 to 1 px off, and this states 0.2 to 0.4 px per axis."""
_NORMAL_STEPS = 8
_PARTS = (1.0, 0.5, 0.2, 0.05)
_SLACK = 2e-3
"""Relative growth of the misfit that a step may cost, for the normals of few steps are not quite the best."""


@dataclass(frozen=True)
class OneAlbedo:
    """What was found.

    Attributes:
        motions: of all scans, in the first one's frame.
        std_um: standard deviation of a pixel's place per axis, for each scan [um].
        albedo_spread: robust deviation of the albedo over the pixels.
        share: background over level ground's signal.
        polar_deg: effective polar angle of the first aperture.
    """

    motions: tuple[Rigid, ...]
    std_um: tuple[float, ...]
    albedo_spread: float
    share: float
    polar_deg: float


def align_one_albedo(stacks: tuple[MicrographStack, ...], start: list[Rigid]) -> OneAlbedo:
    """Fit all motions at once, coarse to fine.

    Args:
        stacks: scans at normal incidence, four or more images in all.
        start: motions good to some pixels, the first one no motion.
    """
    first = _Fit(stacks, start, _LEVELS_PX[0], _ALBEDO_STD)
    first.begin()
    fit = first
    for level in _LEVELS_PX:
        fit = fit.on(level, _ALBEDO_STD)
        fit.run()
    again = fit
    again.motions, kept = fit.displaced(_SHAKE_PX), list(fit.motions)
    for level in _LEVELS_PX[1:]:
        again = again.on(level, _LOOSE)
        again.run()
    fit.motions = kept
    own = fit.std_um()
    doubt = [separation(a, b, fit.points) for a, b in zip(fit.motions, again.motions, strict=True)]
    stds = tuple(math.hypot(a, b / math.sqrt(2)) for a, b in zip(own, doubt, strict=True))
    length = np.linalg.norm(fit.m, axis=1)[fit.is_known]
    return OneAlbedo(
        tuple(fit.motions),
        stds,
        float(robust_std(length - 1.0)),
        fit.share,
        math.degrees(float(fit.polar()[0])),
    )


def _redescending(t: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + (t / _OUTLIER) ** 2) ** 2


def _convex(t: np.ndarray) -> np.ndarray:
    return 1.0 / np.sqrt(1.0 + (t / _OUTLIER) ** 2)


def _solve(matrix: np.ndarray, right: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the solution in the free unknowns [n], zero in the others."""
    scale = np.sqrt(np.maximum(np.diag(matrix)[free], 1e-12))
    small = matrix[np.ix_(free, free)] / np.outer(scale, scale) + 1e-6 * np.eye(free.size)
    out = np.zeros_like(right)
    out[free] = np.linalg.solve(small, right[free] / scale) / scale
    return out


class _Fit:
    """Motions and instrument at one smoothness, and the normals they leave; `run` improves them."""

    def __init__(
        self, stacks: tuple[MicrographStack, ...], motions: list[Rigid], level_px: float, albedo_std: float
    ) -> None:
        """Smooth the images by `level_px` pixels of the first scan; its every second one will do if that is > 2."""
        first = stacks[0]
        self.stacks, self.motions, self.level, self.albedo_std = stacks, list(motions), level_px, albedo_std
        self.step = pitch(first.x)
        every = 2 if level_px > 2 else 1
        self.shape = first.y[::every].size, first.x[::every].size
        self.points = np.stack(np.meshgrid(first.x[::every], first.y[::every]), -1).reshape(-1, 2)
        self.center = np.array([first.x.mean(), first.y.mean()])
        self.alike = (_ALIKE_PX / every) ** 2  # pixels that share an error of the model
        self.together = max(1.0, 4 * math.pi * level_px**2 / every**2)  # pixels that share noise
        self.pictures, self.noise, self.view, azimuth, tangent = [], [], [], [], []
        for k, stack in enumerate(stacks):
            for n, aperture in enumerate(stack.instrument.apertures()):
                known = stack.is_observed[n]
                middle = float(np.median(stack.counts[n][known]))
                image = smooth(stack.counts[n] / middle, known, level_px * self.step / pitch(stack.x))
                slopes = np.gradient(image, stack.y, stack.x)
                self.pictures.append([Readable.of(a, known, stack.x, stack.y) for a in (image, slopes[1], slopes[0])])
                inside = np.clip(image[known], *np.quantile(image[known], [0.01, 0.99]))
                noise = 0.0 if stack.variance is None else float(np.median(stack.variance[n][known])) / middle**2
                self.noise.append(math.hypot(_MODEL_ERROR * float(np.std(inside)), math.sqrt(noise / self.together)))
                self.view.append(k)
                azimuth.append(math.atan2(aperture.center[1], aperture.center[0]))
                tangent.append(math.hypot(*aperture.center) / stack.instrument.sample_distance)
        self.azimuth, self.polar_given = np.array(azimuth), np.arctan(tangent)
        self.sigma = np.maximum(np.array(self.noise), 1e-6)
        self.gain, self.share, self.more_polar = np.ones(len(self.view)), 0.0, 0.0
        self.m = np.zeros((len(self.points), 3))

    def on(self, level_px: float, albedo_std: float) -> "_Fit":
        """Return the fit that goes on from here at another smoothness."""
        out = _Fit(self.stacks, self.motions, level_px, albedo_std)
        out.gain, out.share, out.more_polar = self.gain.copy(), self.share, self.more_polar
        out._read()
        out._solve_convex()
        return out

    def polar(self) -> np.ndarray:
        """Polar angles of the apertures [image]."""
        return self.polar_given + self.more_polar

    def displaced(self, size_px: float) -> list[Rigid]:
        """Return the motions with every scan's field displaced alike along its own x, in the first one's frame."""
        moved = [Rigid(0.0, (size_px * self.step, 0.0)).after(m) for m in self.motions]
        back = moved[0].inverse()
        return [m.after(back) for m in moved]

    def begin(self) -> None:
        """Choose the background's share by the least misfit of fits with the motions as they are."""
        found = []
        self._read()
        for share in _SHARES:
            self.gain, self.share, self.more_polar = np.full(len(self.view), 1.0 / (1.0 + share)), share, 0.0
            self._solve_convex()
            for _ in range(6):
                self._advance(move=False)
            found.append((self._cost(), self.gain.copy(), self.share, self.more_polar))
        _, self.gain, self.share, self.more_polar = min(found, key=lambda f: f[0])

    def run(self) -> None:
        """Step until no motion changes by more than a hundredth of a pixel."""
        for _ in range(_STEPS):
            before = list(self.motions)
            is_done = self._advance()
            moved = max(separation(a, b, self.points) for a, b in zip(before, self.motions, strict=True))
            if not is_done or moved < _STEADY_PX * self.step:
                break

    def _read(self) -> None:
        """Read all images at the present motions, with their slopes by (x, y, turn) of the motion [image, pixel, 3]."""
        values, slopes, seen = [], [], []
        lever = self.points - self.center
        for k, (picture, along, down) in zip(self.view, self.pictures, strict=True):
            at = self.motions[k].apply(self.points)
            value, is_seen = picture.at(at)
            slope = np.stack([along.at(at)[0], down.at(at)[0]], -1) @ self.motions[k].matrix
            turn = slope[:, 1] * lever[:, 0] - slope[:, 0] * lever[:, 1]
            values.append(value)
            seen.append(is_seen)
            slopes.append(np.concatenate([slope, turn[:, None]], -1))
        self.values, self.slopes, self.seen = np.stack(values), np.stack(slopes), np.stack(seen)
        self.is_known = self.seen.sum(0) >= _LEAST_IMAGES

    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return d, its derivative by the polar angle and by a turn of the motion [image, 3]; d . z = 1."""
        azimuth = self.azimuth - np.array([self.motions[k].rotation for k in self.view])
        c, s, t = np.cos(azimuth), np.sin(azimuth), np.tan(self.polar())
        zero = np.zeros_like(t)
        by_polar = np.stack([c, s, zero], -1) * (1 + t * t)[:, None]
        return np.stack([t * c, t * s, zero + 1.0], -1), by_polar, np.stack([t * s, -t * c, zero], -1)

    def _misfit(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the lit part of the model, misfits over their deviations: [image, pixel], albedo's [pixel]."""
        lit = np.maximum(self._directions()[0] @ self.m.T, 0.0)
        misfit = self.values - self.gain[:, None] * (lit + self.share)
        return lit, misfit / self.sigma[:, None], (np.linalg.norm(self.m, axis=1) - 1.0) / self.albedo_std

    def _cost(self) -> float:
        """Return the mean robust misfit."""
        _, t, of_albedo = self._misfit()
        t2, a2 = (t / _OUTLIER) ** 2, (of_albedo / _OUTLIER) ** 2
        return float(np.mean((np.sum(np.where(self.seen, t2 / (1 + t2), 0.0), 0) + a2 / (1 + a2))[self.is_known]))

    def _birge(self) -> float:
        """Return the weighted mean square misfit per degree of freedom: data and albedo less three unknowns a pixel."""
        _, t, of_albedo = self._misfit()
        weight, pull = np.where(self.seen, _redescending(t), 0.0), _redescending(of_albedo)
        total = (np.sum(weight * t**2, 0) + pull * of_albedo**2)[self.is_known].sum()
        return float(total / np.maximum(weight.sum(0) + pull - 3.0, 0.0)[self.is_known].sum())

    def _solve_convex(self) -> None:
        """Find the normals from nothing, so that no pixel is caught by a wrong set of outliers."""
        self.m = np.tile([0.0, 0.0, 1.0], (len(self.points), 1))
        for _ in range(_NORMAL_STEPS):
            self._step_normals(_convex)
        for _ in range(_NORMAL_STEPS):
            self._step_normals(_redescending)

    def _normal_system(self, weigh) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return matrix and right side of the step of m [pixel, 3(, 3)], and each datum's weight and slope by m."""
        lit, t, of_albedo = self._misfit()
        weight = np.where(self.seen, weigh(t), 0.0)
        is_active = (lit > 0) | (t > 0)
        by_m = is_active[..., None] * (self.gain / self.sigma)[:, None, None] * self._directions()[0][:, None]
        length = np.maximum(np.linalg.norm(self.m, axis=1), 1e-9)
        unit = self.m / length[:, None]
        pull = weigh(of_albedo) / self.albedo_std
        matrix = np.einsum("kp,kpi,kpj->pij", weight, by_m, by_m)
        matrix += (pull / self.albedo_std)[:, None, None] * unit[:, :, None] * unit[:, None, :]
        matrix += (_RIDGE * (np.einsum("pii->p", matrix) + 1.0))[:, None, None] * np.eye(3)
        right = np.einsum("kp,kpi,kp->pi", weight, by_m, t) - (pull * of_albedo)[:, None] * unit
        return matrix, right, weight, by_m

    def _step_normals(self, weigh) -> None:
        matrix, right, _, _ = self._normal_system(weigh)
        step = np.linalg.solve(matrix, right[..., None])[..., 0]
        self.m = self.m + step * np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(step, axis=1), 1e-9))[:, None]

    def _reduced(self) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix and right side of the step of the common unknowns, the normals eliminated ([n, n], [n]).

        Unknowns: x, y [um] and turn of every view but the first, log gain of every image, share, polar angle.
        """
        matrix, of_normals, weight, by_m = self._normal_system(_redescending)
        lit, t, _ = self._misfit()
        n_motion, n_images = 3 * (len(self.stacks) - 1), len(self.view)
        _, by_polar, by_turn = self._directions()
        model = np.zeros((n_images, len(self.points), n_motion + n_images + 2))
        for i, k in enumerate(self.view):
            if k:
                own = slice(3 * (k - 1), 3 * k)
                model[i, :, own] = -self.slopes[i]
                model[i, :, 3 * k - 1] += self.gain[i] * (lit[i] > 0) * (self.m @ by_turn[i])
            model[i, :, n_motion + i] = self.gain[i] * (lit[i] + self.share)
            model[i, :, -2] = self.gain[i]
            model[i, :, -1] = self.gain[i] * (lit[i] > 0) * (self.m @ by_polar[i])
        model /= self.sigma[:, None, None]
        weight = weight * self.is_known
        across = np.einsum("kp,kpi,kpg->pig", weight, by_m, model)
        solved = np.linalg.solve(matrix, across)
        root = np.sqrt(weight)[..., None] * model
        whole = np.tensordot(root, root, ((0, 1), (0, 1))) - np.tensordot(across, solved, ((0, 1), (0, 1)))
        scores = np.einsum("kp,kpg,kp->pg", weight, model, t) - np.einsum("pig,pi->pg", solved, of_normals)
        right = scores.sum(0)
        whole[-1, -1] += self.alike / _POLAR_STD**2
        right[-1] -= self.alike * self.more_polar / _POLAR_STD**2
        return whole, right

    def _advance(self, move: bool = True) -> bool:
        """Do a Gauss-Newton step of everything, shorter if the misfit would grow; return whether it was done."""
        self._settle()
        before = self._cost()
        whole, right = self._reduced()
        n_motion = 3 * (len(self.stacks) - 1)
        free = np.arange(0 if move else n_motion, right.size)
        step = _solve(whole, right, free)
        if self.share + step[-2] < 0.0:  # at its bound it is no unknown
            right = right - whole[:, -2] * -self.share
            step = _solve(whole, right, free[free != right.size - 2])
            step[-2] = -self.share
        kept = self._state()
        for part in _PARTS:
            self._restore(kept)
            self._move(part * step)
            self._settle()
            if self._cost() <= before * (1.0 + _SLACK):
                return True
        self._restore(kept)
        return False

    def _state(self) -> tuple:
        return list(self.motions), self.gain, self.share, self.more_polar, self.m

    def _restore(self, state: tuple) -> None:
        motions, self.gain, self.share, self.more_polar, self.m = state
        self.motions = list(motions)

    def _settle(self) -> None:
        """Read the images where they are now, find the normals, and scale them to the most common albedo, one."""
        self._read()
        for _ in range(_NORMAL_STEPS // 2):
            self._step_normals(_redescending)
        length = float(np.median(np.linalg.norm(self.m, axis=1)[self.is_known]))
        self.m, self.gain, self.share = self.m / length, self.gain * length, self.share / length

    def _move(self, step: np.ndarray) -> None:
        """Change all common unknowns by a step (see `_reduced`), limited to where the model is about linear."""
        limit, n_motion = 1.5 * self.level * self.step, 3 * (len(self.stacks) - 1)
        for k in range(1, len(self.motions)):
            x, y, turn = step[3 * (k - 1) : 3 * k]
            part = min(1.0, limit / max(math.hypot(x, y), 1e-12))
            move_by = about(self.center, part * turn, part * np.array([x, y]))
            self.motions[k] = self.motions[k].after(move_by)
        self.gain = self.gain * np.exp(np.clip(step[n_motion : n_motion + len(self.view)], -0.2, 0.2))
        far = 0.1 * (1.0 + self.share)
        self.share = max(0.0, self.share + float(np.clip(step[-2], -far, far)))
        self.more_polar += float(np.clip(step[-1], -0.05, 0.05))

    def std_um(self) -> list[float]:
        """Return a pixel's standard deviation per axis for every scan: errors of the model alike over whole squares."""
        whole, _ = self._reduced()
        scale = np.sqrt(np.maximum(np.diag(whole), 1e-12))
        covariance = np.linalg.inv(whole / np.outer(scale, scale) + 1e-9 * np.eye(scale.size)) / np.outer(scale, scale)
        scale2 = self.alike * self._birge()
        lever, out = self.points - self.center, [0.0]
        for k in range(1, len(self.stacks)):
            own = np.diag(covariance)[3 * (k - 1) : 3 * k]
            variance = own[0] + own[1] + own[2] * float(np.mean(np.sum(lever**2, -1)))
            out.append(math.sqrt(scale2 * variance / 2))
        return out
