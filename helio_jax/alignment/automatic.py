"""Automatic alignment of turned scans: each view is predicted from the others, correlated, and moved; repeated.

Start: the stage's rotations, and shifts from the correlation of edge strengths, view after view. Then the photometric
model: while nothing is masked, a micrograph is a linear combination of three others taken under the same beam, plus a
constant (I = rho n . Phi + background, three unknowns per pixel). Its coefficients are fitted, robustly, so neither
gains, backgrounds nor apertures need be known. Gauss-Newton on rotation and shift, coarse to fine, ends below a pixel.
Error bars are sandwich estimates over blocks of the picture plus a jackknife over the predicting views, so they feel
masks and other errors of the model; and what changes when slower shades are let in is added. On smooth round objects
the latter matters: shifts of all views along their detectors look like a change of albedo there (onealbedo.py).

Source: linear combination: Shashua, Int. J. Comput. Vis. 21 (1997) 99; sandwich: White, Econometrica 48 (1980) 817;
jackknife: Efron & Stein, Ann. Statist. 9 (1981) 586.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from helio_jax.alignment.correlate import correlate_masked, find_peak
from helio_jax.alignment.rigid import Rigid, about, separation
from helio_jax.alignment.views import Frame, View, read
from helio_jax.arrays import robust_std

_LEVELS_PX = (3.0, 1.5, 1.0)
_SWEEPS, _SEARCHES = 12, 2
_STEADY_PX = 0.01
_RIVAL_PX = 5.0
_SMALL_PX = 0.3
_BLOCK_PX = 10
_LEAST_COMMON = 0.3
_LEAST_PIXELS = 100
_RANK = 3
_BANDS = (2.0, 4.0)
_DOUBT = 2.0
"""How much farther off a fit is than its two bands disagree (benchmarks/alignment.py, errors over stated ones)."""
_RIDGE = 1e-3
_ROBUST = 2.5


@dataclass(frozen=True)
class Match:
    """How well a view fits what the others predict of it.

    Attributes:
        correlation: of fine structure, view against prediction.
        margin: by how much of its height the peak stands above the next one elsewhere.
        offset: how far the peak is from the fitted place [pixels].
        std_um: standard deviation of a pixel's place per axis, mean over the field [um].
    """

    correlation: float
    margin: float
    offset: float
    std_um: float


class Aligner:
    """The views, the common raster and the present motions; `run` moves them."""

    def __init__(self, views: list[View], rotations: list[float], reach_um: float, turn: float) -> None:
        """Begin with turns about the fields' centres.

        Args:
            views: the first one is the common frame.
            rotations: of the sample in each view, relative to the first [rad].
            reach_um: largest shift of the field's centre.
            turn: largest correction of a rotation [rad].
        """
        self.views = views
        self._kept: dict[int, tuple] = {}
        self.band = _BANDS[0]
        self.doubt_um = np.zeros(len(views))
        first = views[0]
        self.frame = Frame.around_view(first, reach_um)
        self.reach = max(1, math.ceil(reach_um / self.frame.step))
        half = 0.5 * math.hypot(*(np.ptp(a) for a in (first.x, first.y)))
        n_turns = math.ceil(turn / (1.5 * self.frame.step / half))
        self.turns = np.linspace(-turn, turn, 2 * n_turns + 1)
        self.motions = [
            about(self.frame.center, angle, v.center - self.frame.center)
            for v, angle in zip(views, rotations, strict=True)
        ]

    def run(self) -> None:
        """Move the views, after `start_on_edges`, until they stay."""
        for search in range(_SEARCHES):
            for k in range(1, len(self.views)):
                self._search(k, self.turns[len(self.turns) // 2 :: len(self.turns)] if search else self.turns)
            for level in _LEVELS_PX:
                self._refine(level)
        found, places = list(self.motions), self.frame.points[self.frame.inside]
        self.band = _BANDS[1]
        self._refine(_LEVELS_PX[-1])
        self.doubt_um = np.array([separation(a, b, places) for a, b in zip(found, self.motions, strict=True)])
        self.band, self.motions = _BANDS[0], found

    def _shifted(self, motion: Rigid, shift_px: tuple[int, int]) -> Rigid:
        """Return a motion read further on by (rows, columns) of the common raster."""
        rows, columns = shift_px
        return motion.after(Rigid(0.0, (columns * self.frame.step, rows * self.frame.step)))

    def _turned(self, motion: Rigid, angle: float) -> Rigid:
        return motion.after(about(self.frame.center, angle, np.zeros(2)))

    def start_on_edges(self) -> None:
        """Place view after view, the clearest first, by its edges against the mean of those placed."""
        edges = [view.edges() for view in self.views]
        total, known = read(edges[:1], self.motions[0], self.frame)
        total, count = np.where(known, total, 0.0)[0], known[0].astype(float)
        turned = {
            k: [(m, *read([edges[k]], m, self.frame)) for m in (self._turned(self.motions[k], a) for a in self.turns)]
            for k in range(1, len(self.views))
        }
        while turned:
            mean, is_mean = total / np.maximum(count, 1.0), count > 0
            found = []
            for k, candidates in turned.items():
                for motion, strength, seen in candidates:
                    ncc = correlate_masked(mean, is_mean, strength[0], seen[0], self.reach)
                    peaks = find_peak(ncc, _RIVAL_PX)
                    found.append((peaks.height, k, self._shifted(motion, peaks.shift)))
            _, k, self.motions[k] = max(found, key=lambda f: f[0])
            del turned[k]
            strength, seen = read([edges[k]], self.motions[k], self.frame)
            total, count = total + np.where(seen, strength, 0.0)[0], count + seen[0]

    def _read(self, k: int, sigma_um: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the pictures of view k at its present motion, read anew only where that changed."""
        key = self.motions[k], sigma_um, self.band
        if k not in self._kept or self._kept[k][0] != key:
            self._kept[k] = key, read(self.views[k].readable(sigma_um, self.band), self.motions[k], self.frame)
        return self._kept[k][1]

    def predict(
        self, k: int, sigma_um: float, without: int | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield, per detector of view k: its picture, where known, the others' prediction of it, where known [y, x].

        `without`: one more view that does not take part.
        """
        own, is_own = self._read(k, sigma_um)
        others = [self._read(j, sigma_um) for j in range(len(self.views)) if j not in (k, without)]
        pictures = [(p, s) for images, seen in others for p, s in zip(images, seen, strict=True)]
        for image, seen in zip(own, is_own, strict=True):
            chosen = _companions(seen, pictures)
            common = np.all([s for _, s in chosen], axis=0)
            use = common & seen
            if use.sum() < _LEAST_PIXELS:
                yield image, seen, np.zeros_like(image), np.zeros_like(seen)
                continue
            columns = np.concatenate([_components(np.stack([p for p, _ in chosen]), use), np.ones((1, *image.shape))])
            yield image, seen, np.tensordot(_combine(columns[:, use], image[use]), columns, 1), common

    def _search(self, k: int, turns: np.ndarray) -> None:
        """Move view k to the highest correlation with its prediction."""
        sigma = _LEVELS_PX[1] * self.frame.step
        guesses = [(p, s) for _, _, p, s in self.predict(k, sigma)]
        found = []
        for angle in turns:
            motion = self._turned(self.motions[k], float(angle))
            images, seen = read(self.views[k].readable(sigma, self.band), motion, self.frame)
            maps = [
                correlate_masked(p, s, image, known, min(self.reach, 15))
                for (p, s), image, known in zip(guesses, images, seen, strict=True)
            ]
            peaks = find_peak(np.mean(maps, axis=0), _RIVAL_PX)
            found.append((peaks.height, self._shifted(motion, peaks.shift)))
        self.motions[k] = max(found, key=lambda f: f[0])[1]

    def _refine(self, level_px: float) -> None:
        """Gauss-Newton steps of one view after the other until none moves by more than a hundredth of a pixel.

        The first view takes part, for only then does what all others have in common converge; at the end of each
        sweep it defines the common frame again.
        """
        for _ in range(_SWEEPS):
            before = list(self.motions)
            for k in range(len(self.views)):
                step, _ = self._step(k, level_px)
                self.motions[k] = self.motions[k].after(about(self.frame.center, step[2], step[:2]))
            back = self.motions[0].inverse()
            self.motions = [m.after(back) for m in self.motions]
            places = self.frame.points[self.frame.inside]
            moved = max(separation(a, b, places) for a, b in zip(before, self.motions, strict=True))
            if moved < _STEADY_PX * self.frame.step:
                return

    def _step(self, k: int, level_px: float, without: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the step (x, y [um], turn [rad]) that fits view k best to its prediction, and its covariance."""
        n_unknown = 3
        lever = self.frame.points - self.frame.center
        matrix, right, scores = np.zeros((n_unknown, n_unknown)), np.zeros(n_unknown), []
        rows, columns = np.indices(self.frame.inside.shape) // _BLOCK_PX
        block = rows * (columns.max() + 1) + columns
        for image, seen, guess, common in self.predict(k, level_px * self.frame.step, without):
            use = ndimage.binary_erosion(seen) & common
            if use.sum() < 100:
                continue
            down, along = np.gradient(image, self.frame.step)
            slope = np.stack([along, down, down * lever[..., 0] - along * lever[..., 1]], -1)[use]
            plain = np.stack([guess[use], np.ones(use.sum())], -1)
            weight = np.ones(len(plain))
            for _ in range(3):
                root = np.sqrt(weight)[:, None]
                level = np.linalg.lstsq(plain * root, image[use] * root[:, 0], rcond=None)[0]
                misfit = plain @ level - image[use]
                weight = _trust(misfit)
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
        limit = 2.0 * level_px * self.frame.step  # beyond it the picture is not linear in the step
        size = math.sqrt(self._field_rms(np.outer(step, step)) ** 2 + 1e-30)
        return step * min(1.0, limit / size), inverse @ spread @ inverse

    def restoring(self) -> float:
        """Return which share of a common displacement of all fields one fit of every view takes back, 0 to 1.

        Every scan's field is displaced alike, along its own axes; the worst direction counts. While what is
        displaced looks like another albedo, as on balls and soft hills, next to nothing comes back: then errors of
        the model of a few hundredths of a pixel per view become whole pixels, each view's own deviation not telling.
        """
        found = list(self.motions)
        turns = [Rigid(m.rotation, (0.0, 0.0)).matrix for m in found]

        def own_steps(moved: np.ndarray) -> np.ndarray:
            self.motions = [Rigid(0.0, (float(moved[0]), float(moved[1]))).after(m) for m in found]
            steps = [self._step(k, _LEVELS_PX[-1])[0][:2] for k in range(len(found))]
            return np.mean([turn @ step for turn, step in zip(turns, steps, strict=True)], axis=0)

        at_rest = own_steps(np.zeros(2))
        size = _SMALL_PX * self.frame.step  # larger ones make edges outliers, which then hold nothing
        back = np.stack([(at_rest - own_steps(v)) / size for v in np.eye(2) * size], -1)
        self.motions = found
        return float(np.min(np.linalg.eigvals(back).real))

    def _field_rms(self, second_moment: np.ndarray) -> float:
        """Return the root mean square displacement over the first field of steps with this second moment [um]."""
        lever = (self.frame.points - self.frame.center)[self.frame.inside]
        x, y = lever.T
        m = second_moment
        mean = m[0, 0] + m[1, 1] + m[2, 2] * np.mean(x * x + y * y) + 2 * (m[1, 2] * x.mean() - m[0, 2] * y.mean())
        return float(np.sqrt(max(mean, 0.0))) if np.isfinite(mean) else math.inf

    def judge(self, k: int) -> Match:
        """Return how well view k fits its prediction."""
        maps = []
        for image, seen, guess, common in self.predict(k, self.frame.step):
            both = seen & common
            maps.append(correlate_masked(guess, both, image, both, min(self.reach, 15)))
        peaks = find_peak(np.mean(maps, axis=0), _RIVAL_PX)
        margin = 1.0 - max(peaks.rival, 0.0) / peaks.height if peaks.height > 0 else 0.0
        step, covariance = self._step(k, _LEVELS_PX[-1])
        others = [j for j in range(len(self.views)) if j != k]
        for j in others:  # jackknife over the views that predict: they feel what the linear model leaves out
            away = self._step(k, _LEVELS_PX[-1], without=j)[0] - step
            covariance = covariance + (len(others) - 1) / len(others) * np.outer(away, away)
        std = math.hypot(self._field_rms(covariance), _DOUBT * self.doubt_um[k]) / math.sqrt(2)
        return Match(peaks.height, margin, math.hypot(*peaks.shift), std)


def _companions(seen: np.ndarray, pictures: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the pictures that share a field with one, dropping those that overlap least while that field is small."""
    chosen = sorted(pictures, key=lambda p: -int(np.sum(p[1] & seen)))
    while len(chosen) > 2 and np.sum(np.all([s for _, s in chosen], axis=0) & seen) < _LEAST_COMMON * seen.sum():
        chosen = chosen[:-1]
    return chosen


def _components(pictures: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return the three strongest components of pictures [picture, y, x], their weights taken from the pixels in `use`.

    More would be no photometry: shifts of view k by A c_k make terms quadratic in c_k, which five free pictures
    can imitate, so that such shifts of all views would go unseen.
    """
    data = pictures[:, use]
    _, vectors = np.linalg.eigh(data @ data.T)
    return np.tensordot(vectors[:, : -_RANK - 1 : -1].T, pictures, 1)


def _trust(misfit: np.ndarray) -> np.ndarray:
    """Return robust weights: 1 at no misfit, a quarter at `_ROBUST` robust deviations."""
    return 1.0 / (1.0 + (misfit / (_ROBUST * robust_std(misfit) + 1e-12)) ** 2) ** 2


def _combine(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the coefficients [n] of the robust combination of columns [n, pixel] nearest to a target [pixel]."""
    weight = np.ones(target.size)
    ridge = _RIDGE * target.size * np.diag([*np.ones(len(columns) - 1), 0.0])
    for _ in range(3):
        weighted = columns * weight
        coefficients = np.linalg.solve(weighted @ columns.T + ridge, weighted @ target)
        misfit = target - coefficients @ columns
        weight = _trust(misfit)
    return coefficients
