"""Automatic alignment of rotated scans: each view is predicted from the others, correlated and moved, iteratively.

Start: the stage's rotations, and shifts from the correlation of edge strengths, view after view. Then the photometric
model: where nothing is masked, a micrograph is a linear combination of three others taken under the same beam, plus a
constant (I = rho n . Phi + background, three unknowns per pixel). Its coefficients are fitted robustly, so gains,
backgrounds and apertures need not be known. Gauss-Newton on rotation and shift, coarse to fine, ends below a pixel.
Error bars: sandwich estimates over blocks of the picture, plus a jackknife over the predicting views (masking and other
errors of the model), plus the change with a wider band-pass. On smooth round objects shifts of all views along their
detectors look like a change of albedo: see `Aligner.common_shift_observability` and albedo_prior.py.

Source: linear combination: Shashua, Int. J. Comput. Vis. 21 (1997) 99; sandwich: White, Econometrica 48 (1980) 817;
jackknife: Efron & Stein, Ann. Statist. 9 (1981) 586.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from helio_jax.alignment.correlate import correlate_masked, find_peak
from helio_jax.alignment.rigid import Rigid, rotation_about, separation
from helio_jax.alignment.views import Frame, View, resample_images
from helio_jax.arrays import robust_std
from helio_jax.robust import cauchy_weight

_LEVELS_PX = (3.0, 1.5, 1.0)
_ITERATIONS, _SEARCHES = 12, 2
_CONVERGED_PX = 0.01
_RIVAL_PX = 5.0
_TEST_SHIFT_PX = 0.3
_BLOCK_PX = 10
_MIN_COMMON = 0.3
_MIN_PIXELS = 100
_RANK = 3
_BANDS = (2.0, 4.0)
_BAND_FACTOR = 2.0
"""Error of a fit over the difference of its two band-passes (benchmarks/alignment.py)."""
_RIDGE = 1e-3
_ROBUST = 2.5


@dataclass(frozen=True)
class Match:
    """Agreement of a view with its prediction from the others.

    Attributes:
        correlation: of fine structure, view against prediction.
        margin: fraction of its height by which the peak exceeds the next one elsewhere.
        offset: distance of the peak from the fitted place [pixels].
        std_um: standard deviation of a pixel's place per axis, mean over the field [um].
    """

    correlation: float
    margin: float
    offset: float
    std_um: float


class Aligner:
    """The views, the common raster and the present motions, which `run` improves."""

    def __init__(self, views: list[View], rotations: list[float], reach_um: float, max_rotation: float) -> None:
        """Begin with rotations about the centres of the fields.

        Args:
            views: the first one is the common frame.
            rotations: of the sample in each view, relative to the first [rad].
            reach_um: largest shift of the field's centre.
            max_rotation: largest correction of a rotation [rad].
        """
        self.views = views
        self._kept: dict[int, tuple] = {}
        self.band = _BANDS[0]
        self.band_difference_um = np.zeros(len(views))
        first = views[0]
        self.frame = Frame.around_view(first, reach_um)
        self.reach = max(1, math.ceil(reach_um / self.frame.step))
        half = 0.5 * math.hypot(*(np.ptp(a) for a in (first.x, first.y)))
        n_angles = math.ceil(max_rotation / (1.5 * self.frame.step / half))
        self.angles = np.linspace(-max_rotation, max_rotation, 2 * n_angles + 1)
        self.motions = [
            rotation_about(self.frame.center, angle, v.center - self.frame.center)
            for v, angle in zip(views, rotations, strict=True)
        ]

    def run(self) -> None:
        """Move the views, after `start_on_edges`, until they converge."""
        for search in range(_SEARCHES):
            for k in range(1, len(self.views)):
                self._search(k, np.zeros(1) if search else self.angles)
            for level in _LEVELS_PX:
                self._refine(level)
        found, places = list(self.motions), self.frame.points[self.frame.inside]
        self.band = _BANDS[1]
        self._refine(_LEVELS_PX[-1])
        self.band_difference_um = np.array([separation(a, b, places) for a, b in zip(found, self.motions, strict=True)])
        self.band, self.motions = _BANDS[0], found

    def _shifted(self, motion: Rigid, shift_px: tuple[int, int]) -> Rigid:
        """Shift a motion by (rows, columns) of the common raster."""
        rows, columns = shift_px
        return motion.after(Rigid(0.0, (columns * self.frame.step, rows * self.frame.step)))

    def _rotated(self, motion: Rigid, angle: float) -> Rigid:
        return motion.after(rotation_about(self.frame.center, angle, np.zeros(2)))

    def start_on_edges(self) -> None:
        """Place view after view, highest correlation first, by its edges against the mean of those placed."""
        edges = [view.edges() for view in self.views]
        total, known = resample_images(edges[:1], self.motions[0], self.frame)
        total, count = np.where(known, total, 0.0)[0], known[0].astype(float)
        waiting = {}
        for k in range(1, len(self.views)):
            motions = [self._rotated(self.motions[k], a) for a in self.angles]
            waiting[k] = [(m, *resample_images([edges[k]], m, self.frame)) for m in motions]
        while waiting:
            mean, is_mean = total / np.maximum(count, 1.0), count > 0
            found = []
            for k, candidates in waiting.items():
                for motion, strength, seen in candidates:
                    ncc = correlate_masked(mean, is_mean, strength[0], seen[0], self.reach)
                    peaks = find_peak(ncc, _RIVAL_PX)
                    found.append((peaks.height, k, self._shifted(motion, peaks.shift)))
            _, k, self.motions[k] = max(found, key=lambda f: f[0])
            del waiting[k]
            strength, seen = resample_images([edges[k]], self.motions[k], self.frame)
            total, count = total + np.where(seen, strength, 0.0)[0], count + seen[0]

    def _resampled(self, k: int, sigma_um: float) -> tuple[np.ndarray, np.ndarray]:
        """Resample the pictures of view k at its present motion; the latest result is kept."""
        key = self.motions[k], sigma_um, self.band
        if k not in self._kept or self._kept[k][0] != key:
            images = self.views[k].band_passed(sigma_um, self.band)
            self._kept[k] = key, resample_images(images, self.motions[k], self.frame)
        return self._kept[k][1]

    def predict(
        self, k: int, sigma_um: float, without: int | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield, per detector of view k: its picture, where known, its prediction from the others, where known [y, x].

        `without`: one more view that is not used.
        """
        own, is_own = self._resampled(k, sigma_um)
        others = [self._resampled(j, sigma_um) for j in range(len(self.views)) if j not in (k, without)]
        pictures = [(p, s) for images, seen in others for p, s in zip(images, seen, strict=True)]
        for image, seen in zip(own, is_own, strict=True):
            chosen = _companions(seen, pictures)
            common = np.all([s for _, s in chosen], axis=0)
            use = common & seen
            if use.sum() < _MIN_PIXELS:
                yield image, seen, np.zeros_like(image), np.zeros_like(seen)
                continue
            columns = np.concatenate([_components(np.stack([p for p, _ in chosen]), use), np.ones((1, *image.shape))])
            yield image, seen, np.tensordot(_combine(columns[:, use], image[use]), columns, 1), common

    def _search(self, k: int, angles: np.ndarray) -> None:
        """Move view k to the highest correlation with its prediction."""
        sigma = _LEVELS_PX[1] * self.frame.step
        guesses = [(p, s) for _, _, p, s in self.predict(k, sigma)]
        found = []
        for angle in angles:
            motion = self._rotated(self.motions[k], float(angle))
            images, seen = resample_images(self.views[k].band_passed(sigma, self.band), motion, self.frame)
            maps = [
                correlate_masked(p, s, image, known, min(self.reach, 15))
                for (p, s), image, known in zip(guesses, images, seen, strict=True)
            ]
            peaks = find_peak(np.mean(maps, axis=0), _RIVAL_PX)
            found.append((peaks.height, self._shifted(motion, peaks.shift)))
        self.motions[k] = max(found, key=lambda f: f[0])[1]

    def _refine(self, level_px: float) -> None:
        """Gauss-Newton steps of one view after the other until none moves by more than a hundredth of a pixel.

        The first view moves too: otherwise the common displacement of all others does not converge. At the end of each
        iteration it defines the common frame again.
        """
        for _ in range(_ITERATIONS):
            before = list(self.motions)
            for k in range(len(self.views)):
                step, _ = self._step(k, level_px)
                self.motions[k] = self.motions[k].after(rotation_about(self.frame.center, step[2], step[:2]))
            back = self.motions[0].inverse()
            self.motions = [m.after(back) for m in self.motions]
            places = self.frame.points[self.frame.inside]
            moved = max(separation(a, b, places) for a, b in zip(before, self.motions, strict=True))
            if moved < _CONVERGED_PX * self.frame.step:
                return

    def _step(self, k: int, level_px: float, without: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Compute the step (x, y [um], rotation [rad]) that fits view k best to its prediction, and its covariance."""
        n_unknown = 3
        lever = self.frame.points - self.frame.center
        matrix, right, scores = np.zeros((n_unknown, n_unknown)), np.zeros(n_unknown), []
        rows, columns = np.indices(self.frame.inside.shape) // _BLOCK_PX
        block = rows * (columns.max() + 1) + columns
        for image, seen, guess, common in self.predict(k, level_px * self.frame.step, without):
            use = ndimage.binary_erosion(seen) & common
            if use.sum() < _MIN_PIXELS:
                continue
            down, along = np.gradient(image, self.frame.step)
            slope = np.stack([along, down, down * lever[..., 0] - along * lever[..., 1]], -1)[use]
            plain = np.stack([guess[use], np.ones(use.sum())], -1)
            weight = np.ones(len(plain))
            for _ in range(3):
                root = np.sqrt(weight)[:, None]
                level = np.linalg.lstsq(plain * root, image[use] * root[:, 0], rcond=None)[0]
                misfit = plain @ level - image[use]
                weight = _robust_weights(misfit)
            root = np.sqrt(weight)[:, None]
            free = slope - plain @ np.linalg.lstsq(plain * root, slope * root, rcond=None)[0]
            matrix += (free * weight[:, None]).T @ free
            right += (free * weight[:, None]).T @ misfit
            scores.append((free, weight, misfit, block[use]))
        scale = np.diag(matrix)
        if not scores or np.any(scale <= 0) or np.linalg.cond(matrix / np.sqrt(np.outer(scale, scale))) > 1e6:
            return np.zeros(n_unknown), np.full((n_unknown, n_unknown), np.inf)
        step, inverse = np.linalg.solve(matrix, right), np.linalg.inv(matrix)
        spread = np.zeros_like(matrix)
        for free, weight, misfit, number in scores:
            per_pixel = free * (weight * (misfit - free @ step))[:, None]
            sums = np.stack([np.bincount(number, column) for column in per_pixel.T], -1)
            spread += sums.T @ sums
        limit = 2.0 * level_px * self.frame.step  # beyond this step the picture is not linear
        size = math.sqrt(self._field_rms(np.outer(step, step)) ** 2 + 1e-30)
        return step * min(1.0, limit / size), inverse @ spread @ inverse

    def common_shift_observability(self) -> float:
        """Compute the observability of a common displacement of all fields, 0 (none) to 1.

        The smallest eigenvalue of the Gauss-Newton response: every field is displaced alike along the axes of its own
        scan, and the fraction that one step of every view takes back counts. Where a displaced view looks like another
        albedo, as on balls and soft hills, it is near 0. Errors of the model of some hundredths of a pixel per view
        then become whole pixels, which the standard deviations of the single views do not contain.
        """
        found = list(self.motions)

        def own_steps(moved: np.ndarray) -> np.ndarray:
            self.motions = [Rigid(0.0, (float(moved[0]), float(moved[1]))).after(m) for m in found]
            steps = [self._step(k, _LEVELS_PX[-1])[0][:2] for k in range(len(found))]
            return np.mean([m.matrix @ step for m, step in zip(found, steps, strict=True)], axis=0)

        at_rest = own_steps(np.zeros(2))
        size = _TEST_SHIFT_PX * self.frame.step  # a larger one makes edges outliers, which then have no weight
        back = np.stack([(at_rest - own_steps(v)) / size for v in np.eye(2) * size], -1)
        self.motions = found
        return float(np.min(np.linalg.eigvals(back).real))

    def _field_rms(self, second_moment: np.ndarray) -> float:
        """Compute the rms displacement over the first field [um] from the second moment of a step."""
        lever = (self.frame.points - self.frame.center)[self.frame.inside]
        x, y = lever.T
        m = second_moment
        mean = m[0, 0] + m[1, 1] + m[2, 2] * np.mean(x * x + y * y) + 2 * (m[1, 2] * x.mean() - m[0, 2] * y.mean())
        return float(np.sqrt(max(mean, 0.0))) if np.isfinite(mean) else math.inf

    def match(self, k: int) -> Match:
        """Measure the agreement of view k with its prediction."""
        maps = []
        for image, seen, guess, common in self.predict(k, self.frame.step):
            both = seen & common
            maps.append(correlate_masked(guess, both, image, both, min(self.reach, 15)))
        peaks = find_peak(np.mean(maps, axis=0), _RIVAL_PX)
        margin = 1.0 - max(peaks.rival, 0.0) / peaks.height if peaks.height > 0 else 0.0
        step, covariance = self._step(k, _LEVELS_PX[-1])
        others = [j for j in range(len(self.views)) if j != k]
        for j in others:  # jackknife over the predicting views: errors of the linear model
            change = self._step(k, _LEVELS_PX[-1], without=j)[0] - step
            covariance = covariance + (len(others) - 1) / len(others) * np.outer(change, change)
        std = math.hypot(self._field_rms(covariance), _BAND_FACTOR * self.band_difference_um[k]) / math.sqrt(2)
        return Match(peaks.height, margin, math.hypot(*peaks.shift), std)


def _companions(seen: np.ndarray, pictures: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Select the pictures that overlap one; those of least overlap are dropped while the common field is small."""
    chosen = sorted(pictures, key=lambda p: -int(np.sum(p[1] & seen)))
    while len(chosen) > 2 and np.sum(np.all([s for _, s in chosen], axis=0) & seen) < _MIN_COMMON * seen.sum():
        chosen = chosen[:-1]
    return chosen


def _components(pictures: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Compute the three principal components of pictures [picture, y, x] over the pixels in `use`.

    The photometric model has three. With more, shifts of view k by A c_k would go unnoticed: five free pictures can
    imitate their terms, which are quadratic in c_k.
    """
    data = pictures[:, use]
    _, vectors = np.linalg.eigh(data @ data.T)
    return np.tensordot(vectors[:, : -_RANK - 1 : -1].T, pictures, 1)


def _robust_weights(misfit: np.ndarray) -> np.ndarray:
    """Compute robust weights: a quarter at `_ROBUST` robust standard deviations."""
    return cauchy_weight(misfit, _ROBUST * robust_std(misfit) + 1e-12) ** 2


def _combine(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit the coefficients [n] of a combination of columns [n, pixel] to a target [pixel], robustly."""
    weight = np.ones(target.size)
    ridge = _RIDGE * target.size * np.diag([*np.ones(len(columns) - 1), 0.0])
    for _ in range(3):
        weighted = columns * weight
        coefficients = np.linalg.solve(weighted @ columns.T + ridge, weighted @ target)
        misfit = target - coefficients @ columns
        weight = _robust_weights(misfit)
    return coefficients
