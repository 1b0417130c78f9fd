"""Objects on a flat substrate: the outline and the level of what stands on it, from all micrographs together.

Where an object hides the substrate from a detector, the substrate's signal falls as if it sloped. A photometric
solution therefore joins an object and its mask bands in one hill, which is too wide and too low. Here the substrate is
taken for flat instead: within the sharp edges of the micrographs, what it does not explain is an object, and the
object's level is the one whose masks and multiple scattering explain the micrographs. All physics is predicted anew for
every trial. Whether the result is true is for a fit that starts from it to decide.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_erosion,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    label,
    median_filter,
)

from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import Surface
from helio_jax.inverse.border_level import levelled_signal
from helio_jax.inverse.levels import GAIN
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import Predict
from helio_jax.micrograph import MicrographStack

SHARP = 0.2
"""A signal that jumps by more than this share of the flat substrate's, beyond its change nearby, shows an edge."""
LEAST_PIXELS = 12
"""Smaller objects are not looked for."""
MOST_MISFIT = 2.0
"""No more objects are looked for where the first leaves so many times the misfit of the relief alone ..."""
HOPELESS = 2.0
"""... and its outline and level are not refined where it begins with so many times more."""
MOST_START = 3.0
"""Outlines are not looked for at a level that begins with so many times the misfit of the best one."""
MOST_OBJECTS = 8
"""More objects are not looked for: the smaller ones keep the relief that they start with."""
LEAST_SEGMENT = 4
"""Smaller segments join the nearest one."""
LIMIT = 4.0
"""Mean square residual, over detectors, up to which the flat substrate explains a pixel."""
STARTS = -0.3, 0.1, 0.2, 0.35, 0.5
"""Shifts of an object's relief that are tried at first, in widths of the object ..."""
STEPS = (0.14, -0.14), (0.07, -0.07), (0.035, -0.035)
"""... and then around the best one."""
ABOUT_AS_WELL = 1.05
"""Another outline that leaves up to so many times the misfit of the best one is a rival of it ..."""
OTHER_OUTLINE = 0.1
"""... where it differs from that one in a larger share of its pixels."""
_SQUARE = np.ones((3, 3))


@dataclass(frozen=True)
class Objects:
    """Objects on a flat substrate at height 0.

    Attributes:
        number: of every pixel's object, 0: the substrate [y, x].
        shift: of each object's relief, um.
    """

    number: np.ndarray
    shift: tuple[float, ...]

    def surface(self, relief: Surface) -> Surface:
        """Put the relief of a surface, shifted, where objects are, and the flat substrate elsewhere."""
        is_object = self.number > 0
        raised = replace(relief, height=relief.height + np.array((0.0, *self.shift))[self.number])
        return jax.tree.map(lambda field: np.where(is_object, field, 0.0), raised)

    def outlined(self, number: int, inside: np.ndarray) -> "Objects":
        """Give an object another outline; pixels that it leaves are substrate."""
        left = np.where(self.number == number, 0, self.number)
        return replace(self, number=np.where(inside & (left == 0), number, left))

    def shifted(self, number: int, shift: float) -> "Objects":
        """Give an object another shift."""
        return replace(self, shift=(*self.shift[: number - 1], shift, *self.shift[number:]))


class Trial(NamedTuple):
    """Objects, and the misfit of the data expected of them."""

    objects: Objects
    misfit: float


@dataclass(frozen=True)
class ObjectSearch:
    """Outlines and levels of objects by trial.

    Attributes:
        relief: of the objects, at any level.
        sharp: pixels where a signal jumps [y, x].
        pitch: dy, dx, um.
        misfit: half the chi-square of the data expected on a surface; infinite where nothing can be predicted.
        unexplained: mean square residual of the flat substrate beside the objects of a surface [y, x].
        report: called with what is tried next.
    """

    relief: Surface
    sharp: np.ndarray
    pitch: tuple[float, float]
    misfit: Callable[[Surface], float]
    unexplained: Callable[[Surface], np.ndarray]
    report: Callable[[str], None] = lambda said: None

    def find(self, objects: Objects) -> list[Objects]:
        """Find each object's outline and level, from outlines that are too wide.

        A relief that is only shifted has not the object's shape: two outlines can explain the data about as well
        (`ABOUT_AS_WELL`) that fits tell apart.

        Returns:
            The best objects and, where some have a rival outline, those with the rivals that together explain the data
            about as well; none where a flat substrate explains too little (`MOST_MISFIT`).
        """
        best, n = self._tried(objects), len(objects.shift)
        rivals: dict[int, Objects] = {}
        limit = MOST_MISFIT * self.misfit(self.relief)
        sizes = np.bincount(objects.number.ravel())[1:]
        for place, number in enumerate(np.argsort(-sizes)[:MOST_OBJECTS] + 1, 1):
            self.report(f"object {place} of {min(n, MOST_OBJECTS)}")
            starts = [best, *self._shifted(best, number, STARTS)]
            most = MOST_START * _best(starts).misfit
            best = _best(self._without_segments(trial, number) for trial in starts if trial.misfit <= most)
            if best.misfit > HOPELESS * limit:
                return []
            tried = [best]
            for steps in (STARTS, *STEPS):
                others = list(self._shifted(best, number, steps))
                tried += [*others, *(self._peeled(t, number) for t in others)]
                best = _best(tried)
            tried.append(self._peeled(best, number))
            best = _best(tried)
            if not np.isfinite(best.misfit) or best.misfit > limit:
                return []
            rival = _rival(tried, best, number)
            if rival is not None:
                rivals[number] = rival
        found = best
        for number, rival in rivals.items():
            outlined = found.objects.outlined(number, rival.number == number)
            other = self._tried(outlined.shifted(number, rival.shift[number - 1]))
            found = other if other.misfit <= ABOUT_AS_WELL * best.misfit else found
        return [best.objects] if found is best else [best.objects, found.objects]

    def _tried(self, objects: Objects) -> Trial:
        return Trial(objects, self.misfit(objects.surface(self.relief)))

    def _shifted(self, trial: Trial, number: int, shares: Iterable[float]) -> Iterator[Trial]:
        """Shift an object by shares of its width."""
        inside, before = trial.objects.number == number, trial.objects.shift[number - 1]
        distance = distance_transform_edt(np.pad(inside, 1), sampling=self.pitch)
        width = 2.0 * float(np.max(np.asarray(distance)))
        return (self._tried(trial.objects.shifted(number, before + share * width)) for share in shares)

    def _without_segments(self, best: Trial, number: int) -> Trial:
        """Give segments at the rim to the substrate, while that lowers the misfit.

        All that lower it alone are given together, where that lowers it more than the best one does.
        """
        parts = segments(self.sharp, best.objects.number == number)

        def without(given: Sequence[int]) -> Trial:
            outline = _filled((best.objects.number == number) & ~np.isin(parts, given))
            other = best.objects.outlined(number, outline)
            is_tried = outline.sum() >= LEAST_PIXELS and np.any(other.number != best.objects.number)
            return self._tried(other) if is_tried else best

        while np.isfinite(best.misfit):
            inside = best.objects.number == number
            trials = {part: without([part]) for part in np.unique(parts[inside & ~_core(inside)])}
            lower = [part for part, trial in trials.items() if trial.misfit <= best.misfit - GAIN]
            if not lower:
                break
            best = _best([*trials.values(), *([without(lower)] if len(lower) > 1 else [])])
        return best

    def _peeled(self, trial: Trial, number: int) -> Trial:
        """Give the outermost pixels to the substrate where it explains them, until none is left that it explains."""
        objects = trial.objects
        for _ in range(max(objects.number.shape)):
            inside = objects.number == number
            core = _core(inside)
            found = self.unexplained(objects.outlined(number, core).surface(self.relief))
            is_kept = core | (inside & (median_filter(found, 3) > LIMIT))
            other = objects.outlined(number, _filled(binary_opening(is_kept, np.ones((2, 2)))))
            if np.sum(other.number == number) < LEAST_PIXELS or np.array_equal(other.number, objects.number):
                break
            objects = other
        return self._tried(objects)


def find_objects(
    stack: MicrographStack,
    settings: ReconstructSettings,
    relief: Surface,
    predict: Predict,
    misfit: Callable[[Surface], float],
    report: Callable[[str], None] = lambda said: None,
) -> list[Objects]:
    """Find the objects on a flat substrate in micrographs, as `ObjectSearch.find`; none if no sharp edges enclose any.

    Args:
        stack: micrographs, in units of the beam; the substrate at height 0.
        settings: of the reconstruction.
        relief: of the objects, e.g. the photometric solution.
        predict: masks and multiple scattering on a surface.
        misfit: half the chi-square of the data expected on a surface.
        report: called with what is tried next.
    """
    substrate = _Substrate(stack, settings, predict)
    sharp = jumps(substrate.ratio, substrate.ratio_std) > SHARP
    enclosed = enclosed_by(sharp)
    if not enclosed.any():
        return []
    raster = Raster.of(stack)
    search = ObjectSearch(relief, sharp, (raster.dy, raster.dx), misfit, substrate.unexplained, report)
    return search.find(Objects(enclosed, (0.0,) * int(enclosed.max())))


@dataclass(frozen=True)
class _Substrate:
    """The flat substrate at height 0, as the micrographs would show it; fields as in `find_objects`."""

    stack: MicrographStack
    settings: ReconstructSettings
    predict: Predict

    @cached_property
    def signal(self) -> tuple[np.ndarray, np.ndarray]:
        """Signal and variance, at the right level on the border [detector, y, x]."""
        return levelled_signal(self.stack, self.settings)

    @cached_property
    def form(self) -> np.ndarray:
        """Form factors, nothing masked [detector, 3, y, x]."""
        return form_factor(Optics.of(self.stack.instrument), np.zeros(self.stack.shape[1:]))

    @cached_property
    def surface(self) -> Surface:
        return Surface(*np.zeros((3, *self.stack.shape[1:])))

    @cached_property
    def normals(self) -> np.ndarray:
        """[y, x, 3]."""
        return self.surface.normals(self.stack.instrument.beam_shift)

    def single(self, form: np.ndarray) -> np.ndarray:
        """Singly scattered signal of form factors [detector, y, x]."""
        return np.asarray(single_scattering(form, np.moveaxis(self.normals, -1, 0)))

    @property
    def ratio(self) -> np.ndarray:
        """Signal over that of the substrate, nothing masked [detector, y, x]."""
        return self.signal[0] / self.single(self.form)

    @property
    def ratio_std(self) -> np.ndarray:
        """Standard deviation of `ratio` by noise [detector, y, x]."""
        return np.sqrt(self.signal[1]) / self.single(self.form)

    def unexplained(self, surface: Surface) -> np.ndarray:
        """Compute the mean square residual of the substrate, masked and lit by what stands on it [y, x].

        Infinite where nothing can be predicted.
        """
        signal, variance = self.signal
        try:
            corrections = self.predict(surface.height, surface.normals(self.stack.instrument.beam_shift))
        except PredictionError:
            return np.full(signal.shape[1:], np.inf)
        model = self.single(self.form - corrections.masked) + corrections.multiple
        s = self.settings.refine
        masked = s.mask_error * self.single(corrections.masked)
        multiple, gain = s.multiple_error * corrections.multiple, s.gain_std * self.single(self.form)
        return np.mean((signal - model) ** 2 / (variance + masked**2 + multiple**2 + gain**2), axis=0)


def jumps(ratio: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Compute by how much signals jump at every pixel, beyond their change nearby, in any of four directions [y, x].

    The jump is taken over two pixels, for an edge lies anywhere within one; twice the larger change before and after,
    and two standard deviations, are subtracted: penumbrae and curved surfaces have none.

    Args:
        ratio: signals over those of the flat substrate [detector, y, x].
        std: standard deviation of those.

    Returns:
        Root of the sum of squares over detectors [y, x].
    """
    ny, nx = ratio.shape[1:]
    room = np.pad(ratio, ((0, 0), (2, 2), (2, 2)), mode="edge")
    largest = np.zeros((ny, nx))
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        line = [room[:, 2 + n * dy : 2 + n * dy + ny, 2 + n * dx : 2 + n * dx + nx] for n in (-2, -1, 1, 2)]
        before, jump, after = (np.abs(b - a) for a, b in pairwise(line))
        beyond = np.maximum(jump - 2.0 * np.maximum(before, after) - 2.0 * std, 0.0)
        largest = np.maximum(largest, np.sqrt(np.sum(beyond**2, axis=0)))
    return largest


def enclosed_by(sharp: np.ndarray) -> np.ndarray:
    """Number the regions that sharp edges enclose, edges included; 0 elsewhere [y, x]."""
    room = np.pad(sharp, 4)
    closed = _filled(binary_closing(room, _SQUARE))[4:-4, 4:-4]
    return numbered(binary_opening(closed, _SQUARE), LEAST_PIXELS)


def segments(sharp: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Number the segments into which sharp edges part a region; the edges belong to the nearest; 0 outside [y, x]."""
    number = numbered(inside & ~sharp, LEAST_SEGMENT)
    if not number.any():
        return inside.astype(int)
    nearest = distance_transform_edt(number == 0, return_distances=False, return_indices=True)
    return np.where(inside, number[tuple(np.asarray(nearest))], 0)


def numbered(mask: np.ndarray, least: int) -> np.ndarray:
    """Number the connected parts of a mask that have so many pixels at least."""
    number = np.asarray(label(mask)[0], np.intp)  # type: ignore[index]  # SciPy's stubs take the result for a number
    is_large = np.bincount(number.ravel()) >= least
    is_large[0] = False
    rank = np.where(is_large, np.cumsum(is_large), 0)
    return rank[number]


def _core(inside: np.ndarray) -> np.ndarray:
    """Take the outermost pixels away from a region; the image's border is none."""
    return np.asarray(binary_erosion(inside, _SQUARE, border_value=1))


def _filled(inside: np.ndarray) -> np.ndarray:
    return np.asarray(binary_fill_holes(inside))


def _rival(trials: Iterable[Trial], best: Trial, number: int) -> Objects | None:
    """Choose the best objects of those that explain the data about as well as the best, an object's outline another."""
    outline = best.objects.number == number

    def is_rival(trial: Trial) -> bool:
        differs = (trial.objects.number == number) != outline
        return trial.misfit <= ABOUT_AS_WELL * best.misfit and bool(differs.sum() > OTHER_OUTLINE * outline.sum())

    rivals = [trial for trial in trials if is_rival(trial)]
    return _best(rivals).objects if rivals else None


def _best(trials: Iterable[Trial]) -> Trial:
    return min(trials, key=lambda trial: trial.misfit)
