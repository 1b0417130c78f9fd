"""Competing explanations of one stack's micrographs, each fitted; the one that explains them best is kept.

The first is the photometric solution, with regions at the levels of the steps that mask bands show; where none do and
the border is free, of a step in the beam's shadow (`shadow_steps`). Where the data contradict its fit, pits in and
objects on a flat substrate are tried, and then patches of another albedo. An unknown instrument can explain nearly any
images: there, patches are tried first, and so they are on a substrate that is too dark. With a flat border they are
also tried where the fit moves the instrument far beyond what is stated (`is_strained`), and so are, at the end, gains
and offsets that are not what is stated (`wider_readout`). At last other instruments are fitted where the micrographs
ask for one (`instrument_choice`). A level that explains the images about as well as the one that is kept is undecided.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.ndimage import binary_opening, maximum_filter, minimum_filter

from helio_jax.errors import PredictionError, SceneError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.readout import ScanOrder
from helio_jax.forward.surface import Surface, surface_of_heights
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.albedo_patches import LEAST_COMMON, AlbedoPatches
from helio_jax.inverse.albedo_search import AlbedoSearch, search_albedo
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.backtracking import with_backtracking
from helio_jax.inverse.border_level import border_ratios
from helio_jax.inverse.fit import (
    Fit,
    Report,
    after_one_solve,
    fit_heights,
    interrupted,
    short_fit,
    without_noise_bias,
)
from helio_jax.inverse.geometry_score import usual_uncertainty
from helio_jax.inverse.instrument_choice import InstrumentChoice, is_at_rest
from helio_jax.inverse.law_prior import with_level_of_cosine_law, with_level_of_law
from helio_jax.inverse.levels import GAIN, Region, covered, search_levels
from helio_jax.inverse.linear import noise_share_of, parallax_of, signal_of
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.inverse.measured_steps import (
    anchors_of_steps,
    labelled,
    level_anchors,
    measured_regions,
    off_ground,
    walls_of,
)
from helio_jax.inverse.objects import Objects, find_objects
from helio_jax.inverse.parameters import HELD, Parameters
from helio_jax.inverse.photometric_start import start_of_free_albedo, start_of_known_albedo
from helio_jax.inverse.pits import PitSearch
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.quality import contradicted_regions, half_chi_square, regions, squares
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.shadow_steps import find_shadow_step
from helio_jax.inverse.state import FitState, Predict
from helio_jax.inverse.step_parts import steps_in_parts
from helio_jax.inverse.step_records import Steps
from helio_jax.inverse.strain import is_strained, strain_improvement
from helio_jax.inverse.verdict import expected_chi_square, local_chi_square, residuals_of_state
from helio_jax.inverse.wider_readout import (
    READOUT,
    Widths,
    evidence,
    fit_wider_readout,
    instrument_improvement,
    with_widths,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.validity import CHI_SQUARE_LIMIT

MAX_WIDTH = 0.125
"""Levels are searched up to twice this share of the sample distance above and below the substrate."""
MIN_CONTRADICTED = 0.02
"""Other explanations are tried where the data contradict a fit in a larger share of the pixels."""
NARROW = 5
"""Contradicted strips less wide are those of walls and creases, not of pits and patches of another albedo [pixels].
An area holds a disc of this width, of whole pixels: a patch is as often round as square. Slanted strips
4.3 pixels wide hold it, too."""
LESS_CONTRADICTED = 0.95
"""An explanation that the data contradict in more than this share of the pixels of another explains nothing more."""
MORE_CONTRADICTED = 1.05
"""Gains and offsets that are not as stated may be contradicted in up to so many times as many pixels."""
UNLIKELY_GAIN = 3.0
"""Gains differ from what is stated by up to so many of their prior standard deviations."""
OTHER_TRIED = "while another explanation was tried"
FREE_TRIED = "while free gains and offsets were tried"
"""Said of a fit that was interrupted meanwhile."""
AT_REST = 0.1
"""Fits with free gains whose last iteration changed the heights by more are not kept, rms over the relief with held
gains: along what the data do not determine they wander, to a slightly lower misfit and a tilt of several degrees."""


class Explanation(NamedTuple):
    """A fit, and what it takes for granted.

    Attributes:
        fit: without error bars.
        is_undecided: where another level explains the images as well [y, x].
        number: of the object or pit of every pixel, 0: flat substrate [y, x]; None: no flat substrate is assumed.
        kind: "objects on" or "pits in" the substrate.
        n_steps: number of regions that were put to the levels of measured steps.
        steps: measured in the micrographs; None where none can be.
    """

    fit: Fit
    is_undecided: np.ndarray
    number: np.ndarray | None = None
    kind: str = ""
    n_steps: int = 0
    steps: Steps | None = None

    @property
    def has_levels(self) -> bool:
        """Whether regions were put to levels that were found."""
        return self.n_steps > 0 or bool(self.fit.problem.region.any())

    @property
    def assumed(self) -> str:
        """What the fit takes for granted beyond the settings, in words; "": nothing."""
        if self.number is not None:
            return f"{len(np.unique(self.number)) - 1} {self.kind} a flat substrate"
        return f"{self.n_steps} levels from mask bands" if self.n_steps else ""


def explain(
    stack: MicrographStack,
    settings: ReconstructSettings,
    make_predict: Callable[[int], Predict],
    report: Report | None,
    start: np.ndarray | None = None,
) -> Explanation:
    """Fit the heights, and other explanations where the data or what is known of the instrument contradict the fit.

    Another explanation is kept where it explains the micrographs (with a flat border: and what is known of the
    instrument) better by `GAIN`, and where the data contradict it in fewer pixels (`LESS_CONTRADICTED`), or in as few
    as before (`MIN_CONTRADICTED`); other gains and offsets also in a few more (`MORE_CONTRADICTED`). The outlines of
    objects are known to a pixel only: pixels beside them do not count. Interrupted after the first fit, it returns the
    best of those that were compared. Arguments as `reconstruct_stack`.
    """
    stack = with_level_of_law(stack, settings.refine)
    fits = _Fits(stack, settings, make_predict, report, start)
    none = AlbedoPatches.none(stack.shape[1:])
    if start is None:
        best, others = fits.from_steps(none), [fits.from_pits, fits.from_objects]
    else:
        best, others = fits.from_given_heights(none), []
    is_albedo_likely = best.fit.problem.is_instrument_unknown or fits.is_substrate_dark
    others.insert(0 if is_albedo_likely else len(others), fits.from_albedo_patches)
    others.append(fits.from_wider_readout)
    residuals: np.ndarray | None = None
    readout: Fit | None = None
    for other in others:
        if best.fit.is_interrupted:
            break
        try:
            residuals = fits.residuals_of_first(best.fit) if residuals is None else residuals
            right = fits.right_chi_square(residuals)
            contradicted = fits.contradicted(residuals, right)
            share = contradicted.mean()
            # pits and patches are areas; an object that is too low is contradicted at its rim
            extent = share if other == fits.from_objects else share_of_areas(contradicted)
            may_be_pits = other == fits.from_pits and has_contradicted_hollow(contradicted, best.fit)
            is_contradicted = extent >= MIN_CONTRADICTED or may_be_pits
            explains_strain = other in (fits.from_albedo_patches, fits.from_wider_readout)
            if not is_contradicted and not (explains_strain and fits.is_strained(best.fit)):
                continue
            found = other(best, residuals)
            if found is None:
                continue
            if other == fits.from_wider_readout:
                readout = found.fit
            if found.fit.is_interrupted:  # whichever is kept
                best = best._replace(fit=interrupted(best.fit, OTHER_TRIED))
            rest = fits.residuals(found.fit)
            most = LESS_CONTRADICTED * share if is_contradicted else MIN_CONTRADICTED
            if other == fits.from_wider_readout:  # gains and offsets act on all pixels: few contradict wrong ones
                most = max(most, MORE_CONTRADICTED * share)
            still = fits.contradicted(rest, right)
            if other == fits.from_objects and found.number is not None:
                still &= ~beside_outlines(found.number)
            is_less = still.mean() < most
            gained = improvement(residuals, rest) + fits.instrument_improvement(best.fit, found.fit)
            if is_less and gained > GAIN:
                best, residuals = found, rest
        except PredictionError as e:
            fits.say(f"another explanation is given up: {e}")
        except KeyboardInterrupt:
            best = best._replace(fit=interrupted(best.fit, OTHER_TRIED))
    best = fits.with_likely_instrument(best, readout)
    fit = best.fit if fits.subtracts_bias_at_once else without_noise_bias(best.fit, report)
    return best._replace(fit=fit, steps=fits.steps)


@dataclass(frozen=True)
class _Fits:
    """Fits of one stack from different starts; fields as the arguments of `explain`.

    The stack is scaled to the level of the fit's law (`with_level_of_law`).
    """

    stack: MicrographStack
    settings: ReconstructSettings
    make_predict: Callable[[int], Predict]
    report: Report | None
    given: np.ndarray | None = None

    @property
    def n_pixels(self) -> int:
        return self.stack.counts[0].size

    @cached_property
    def steps(self) -> Steps | None:
        """Steps that mask bands show; None where steps cannot be measured."""
        try:
            return find_steps(self.stack)
        except SceneError:
            return None

    @cached_property
    def shadowed(self) -> list[Region]:
        """The upper side of a step in the beam's shadow, which no mask band shows: with a free border only."""
        if self.settings.border == "flat":
            return []
        upper = find_shadow_step(*signal_of(self.stack), Raster.of(self.stack), self.stack.instrument.beam_shift)
        return [] if upper is None else [Region(upper)]

    @cached_property
    def walls(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges between pixels that cross a wall."""
        return walls_of(self.steps, Raster.of(self.stack))

    @cached_property
    def measured(self) -> list[Region]:
        """Regions between measured steps, the largest first."""
        return measured_regions(self.steps, Raster.of(self.stack))

    @cached_property
    def off_substrate(self) -> np.ndarray:
        """Pixels that mask bands show above or below the substrate [y, x]."""
        return off_ground(self.measured, (self.stack.shape[1], self.stack.shape[2]), self.settings.border_std_um)

    def anchors_at(self, surface: Surface, labels: np.ndarray, moved: list[Region]) -> Anchors:
        """Anchor the mean levels of regions where the border is flat; else the heights of their walls, part by part.

        A surface with a free border bends between the means of its levels.

        Args:
            surface: with the regions at their levels.
            labels: number of every pixel's region, from 1 [y, x].
            moved: the regions, in their order.
        """
        if self.settings.border == "flat" or self.steps is None:
            return level_anchors(labels, moved, surface)
        about = surface, Raster.of(self.stack), labels
        _, anchors = anchors_of_steps(self.steps, *about)
        anchors = anchors.across(labels)
        for parts in steps_in_parts(self.steps, self.stack):
            _, found = anchors_of_steps(parts, *about)
            anchors = anchors.and_also(found.across(labels).differences())
        return anchors

    @cached_property
    def by_cosine_law(self) -> MicrographStack:
        """The stack scaled to the level of the cosine law, which photometric starts and the search for objects take."""
        return with_level_of_cosine_law(self.stack, self.settings.refine)

    @cached_property
    def predict(self) -> Predict:
        """As precise as a fit needs it."""
        return self.make_predict(self.settings.refine.paths(self.n_pixels))

    @cached_property
    def predict_start(self) -> Predict:
        """As precise as a photometric solution needs it."""
        return self.make_predict(self.settings.refine.start_paths(self.n_pixels))

    @cached_property
    def predict_trial(self) -> Predict:
        """As precise as a search and the test of a fit need it."""
        return self.make_predict(self.settings.refine.search_paths(self.n_pixels))

    def pose(
        self,
        surface: Surface,
        patches: AlbedoPatches,
        region: np.ndarray | None = None,
        anchors: Anchors | None = None,
        settings: ReconstructSettings | None = None,
        uncertainty: Uncertainty | None = None,
    ) -> FitProblem:
        """Pose the fit from a surface on; `settings`, `uncertainty` of the instrument: other ones than stated."""
        return FitProblem.of(
            *signal_of(self.stack),
            self.stack.instrument,
            Raster.of(self.stack),
            surface,
            settings or self.settings,
            region,
            scan_order(self.stack),
            uncertainty=uncertainty,
            patches=patches,
            anchors=anchors,
            parallax=parallax_of(self.stack),
            noise_share=noise_share_of(self.stack),
            walls=self.walls,
            off_substrate=self.off_substrate,
        )

    def misfit(self, surface: Surface, patches: AlbedoPatches) -> float:
        """Half the chi-square of the data expected on a surface, nothing fitted; infinite if none can be predicted."""
        try:
            return half_chi_square(self.residuals_on(surface, patches))
        except PredictionError:
            return math.inf

    def residuals_on(self, surface: Surface, patches: AlbedoPatches) -> np.ndarray:
        """Compute the residuals of a surface, nothing fitted [detector, y, x]."""
        problem = self.pose(surface, patches)
        return residuals_of_state(problem, FitState.starting(problem, surface), self.predict_trial)

    def short_fit(self, surface: Surface, patches: AlbedoPatches) -> tuple[float, Surface]:
        """Compute the misfit (`misfit`) after a short fit from a surface, and the surface fitted."""
        try:
            return short_fit(self.pose(surface, patches), surface, self.predict_trial)
        except PredictionError:
            return math.inf, surface

    def residuals(self, fit: Fit) -> np.ndarray:
        """Compute (model - data) / standard deviation of a fit, predicted anew [detector, y, x]."""
        return residuals_of_state(fit.problem, fit.state, self.predict_trial)

    def traced_misfit(self, fit: Fit) -> float:
        """Compute half the chi-square of a fit, predicted anew; infinite where its surface cannot be traced."""
        try:
            return half_chi_square(self.residuals(fit))
        except PredictionError:
            return math.inf

    def residuals_of_first(self, fit: Fit) -> np.ndarray:
        """Compute the residuals of a first fit; where its surface cannot be traced, those of its last solve.

        Else no other explanation would be tried where the first one is least likely.
        """
        try:
            return self.residuals(fit)
        except PredictionError as e:
            self.say(f"the first fit cannot be tested by tracing: {e}")
            return fit.residuals

    def right_chi_square(self, residuals: np.ndarray) -> float:
        """Compute the chi-square of a right fit from the residuals of the best one so far [detector, y, x]."""
        chi_square = local_chi_square(residuals, self.stack.is_observed)
        return expected_chi_square(self.stack, self.stack.instrument, chi_square)

    def contradicted(self, residuals: np.ndarray, right: float) -> np.ndarray:
        """Find the pixels [y, x] in which residuals [detector, y, x] contradict a fit.

        `right`: chi-square of a right fit (`right_chi_square`).
        """
        return local_chi_square(residuals, self.stack.is_observed) > CHI_SQUARE_LIMIT * right

    @property
    def weighs_instrument(self) -> bool:
        """Whether an instrument far from what is stated speaks against a fit.

        Not with a free border: what the data do not fix of the relief, its level, tilt and scale, moves the gains, and
        a patch of another albedo that brings them back hides it. A step of 100 um came out as 30 +- 12 um.
        """
        return self.settings.border == "flat"

    def instrument_improvement(self, fit: Fit, other: Fit) -> float:
        """Compute by how much another fit is nearer to what is stated of the instrument, in half chi-square."""
        return instrument_improvement(fit, other) if self.weighs_instrument else 0.0

    def is_strained(self, fit: Fit) -> bool:
        """Whether the instrument speaks against a fit."""
        return self.weighs_instrument and is_strained(fit.parameters, fit.problem.held)

    def say(self, said: str) -> None:
        """Report what is tried."""
        if self.report:
            self.report(0, self.settings.refine.max_rounds, said)

    def fitted(self, surface: Surface, smoothed: Surface, *known: Any) -> Fit:
        """Fit the heights from a surface, or one nearer to a smoothed one; `known` as in `pose`.

        With a free border, gains and offsets have much the same effect as tilt and relief: what the model lacks moved
        gains of a right instrument by several per cent, and tilted the heights with them. They are then held as stated;
        only where free ones improve one solve by `GAIN` they are fitted, too, and kept if that fit comes to rest
        (`AT_REST`) and improves on the other by it, what is known of the instrument included. The error bars include
        them in either case.
        """
        problem = self.pose(surface, *known)
        if self.settings.border == "flat" or problem.is_instrument_unknown:
            return self._unbiased(self._fit(surface, smoothed, *known))
        held = with_widths(self.settings, dict.fromkeys(READOUT, HELD))
        patches, region, anchors = (*known, None, None)[:3]
        fit = self._unbiased(self._fit(surface, smoothed, patches, region, anchors, held))
        parameters = readout_as_stated(fit.parameters)
        as_held, state = fit.problem, replace(fit.state, parameters=parameters)
        fit = replace(fit, problem=problem, parameters=parameters, state=state)
        if fit.is_interrupted:
            return fit
        try:
            after, before = (after_one_solve(posed, state) for posed in (problem, as_held))
            if improvement(before, after) < GAIN:
                return fit
            free = self._fit(state.surface, smoothed, *known)
            if free.is_interrupted:  # it may not have come to rest
                return interrupted(fit, FREE_TRIED)
            if free.changes[-1] > AT_REST * np.ptp(fit.surface.height):
                self.say("free gains and offsets are given up: that fit did not come to rest")
                return fit
            free = self._unbiased(free)
            if free.is_interrupted:
                fit = interrupted(fit, FREE_TRIED)
            gained = improvement(self.residuals(fit), self.residuals(free))
            return free if gained + strain_improvement(fit.parameters, free.parameters) > GAIN else fit
        except PredictionError as e:
            self.say(f"free gains and offsets are given up: {e}")
            return fit
        except KeyboardInterrupt:
            return interrupted(fit, FREE_TRIED)

    def _fit(self, surface: Surface, smoothed: Surface, *known: Any) -> Fit:
        """Fit once, the bias by noise left in; arguments as those of `fitted`."""
        fit, _ = with_backtracking(
            lambda start: fit_heights(self.pose(start, *known), start, self.predict, self.report), surface, smoothed
        )
        return fit

    def _unbiased(self, fit: Fit) -> Fit:
        """Subtract the bias by noise where every fit needs that."""
        return without_noise_bias(fit, self.report) if self.subtracts_bias_at_once else fit

    @property
    def subtracts_bias_at_once(self) -> bool:
        """Whether the bias by noise is subtracted from every fit, not from the one that is kept alone.

        With a free border it depends on the gains, which are held in a part of the fits.
        """
        return self.settings.border == "free"

    @cached_property
    def albedo_search(self) -> AlbedoSearch:
        """The photometric solution with an albedo of its own in every pixel, and the patches that it shows."""
        return search_albedo(self.by_cosine_law, self.settings, self.predict_start)

    @property
    def is_substrate_dark(self) -> bool:
        """Whether the flat border is darker than albedo 1 and gains as stated make it.

        It decides what is tried first, not what a fit begins with: background that was wrongly subtracted changes the
        level, too, and a fit to the substrate's albedo alone hides that (heights 23 % too low, uncontradicted).
        """
        if self.settings.border != "flat":
            return False
        expected = substrate_signal(Optics.of(self.stack.instrument))
        ratios = border_ratios(signal_of(self.by_cosine_law)[0], expected, self.settings.border_fraction)
        ratios = ratios[np.isfinite(ratios)]
        limit = math.exp(-max(LEAST_COMMON, UNLIKELY_GAIN * self.settings.refine.gain_std))
        return bool(ratios.size and np.median(ratios) < limit)

    def start(self, patches: AlbedoPatches) -> tuple[Surface, Surface]:
        """Find the photometric solution that a fit starts from, and a smoother one."""
        known, smoothed = start_of_known_albedo(self.by_cosine_law, self.settings, patches, self.predict_start)
        if not self.pose(known, patches).is_instrument_unknown or not self.albedo_search.is_corrected:
            return known, smoothed
        free = start_of_free_albedo(self.by_cosine_law, self.albedo_search.height, self.albedo_search.solution)
        return min((known, free), key=lambda surface: self.short_fit(surface, patches)[0]), smoothed

    @cached_property
    def plain_start(self) -> tuple[Surface, Surface]:
        """The same without patches of another albedo, or the given heights; several explanations begin with it."""
        if self.given is None:
            return self.start(AlbedoPatches.none(self.stack.shape[1:]))
        with jax.enable_x64(True):
            start = jax.tree.map(np.asarray, surface_of_heights(self.given, Raster.of(self.stack)))
        return start, Surface(*np.zeros((3, *self.given.shape)))

    def from_steps(self, patches: AlbedoPatches) -> Explanation:
        """Fit from the photometric solution, with regions at the levels of steps, measured or in the beam's shadow."""
        start, smoothed = self.start(patches) if patches.objects else self.plain_start
        shape = self.stack.shape[1:]
        labels, is_undecided, anchors, n_steps = np.zeros(shape, int), np.zeros(shape, bool), None, 0
        raster = Raster.of(self.stack)
        if steps := self.measured or self.shadowed:
            found = search_levels(
                steps,
                start,
                (raster.dy, raster.dx),
                MAX_WIDTH * self.stack.instrument.sample_distance,
                lambda trial: self.misfit(trial, patches),
                lambda trial: self.short_fit(trial, patches),
                self.stack.instrument.beam_shift,
                self.say,
                is_substrate_flat=self.settings.border == "flat",
            )
            start, is_undecided = found.surface, covered(steps, found.undecided)
            if moved := [steps[i] for i in found.moved]:
                labels = labelled(moved)
                anchors = self.anchors_at(start, labels, moved)
                # masks on the raster, whose edges lie on pixels, would pull measured levels off
                measured = [i for i in found.moved if steps[i].height is not None]
                labels[covered(steps, measured)], n_steps = 0, len(measured)
        fit = self.fitted(start, smoothed, patches, labels, anchors)
        return Explanation(fit, is_undecided, n_steps=n_steps)

    def from_given_heights(self, patches: AlbedoPatches) -> Explanation:
        """Fit from given heights, whose levels are taken to be right."""
        return Explanation(self.fitted(*self.plain_start, patches), np.zeros(self.stack.shape[1:], bool))

    def from_objects(self, best: Explanation, residuals: np.ndarray, /) -> Explanation | None:
        """Fit from objects on a flat substrate; None where there are none, or steps are measured, which are better.

        Where other outlines explain the data about as well, the better of two fits.
        """
        if self.settings.border != "flat" or not self.settings.refine.objects or best.n_steps:
            return None
        none, (surface, smoothed) = AlbedoPatches.none(self.stack.shape[1:]), self.plain_start
        found = find_objects(
            self.by_cosine_law,
            self.settings,
            surface,
            self.predict_trial,
            lambda surface: self.misfit(surface, none),
            self.say,
        )

        def fitted(objects: Objects) -> Explanation | None:
            start = self.promising(objects.surface(surface), best)
            if start is None:
                return None
            fit = self.fitted(start, smoothed, none, objects.number)
            return Explanation(fit, np.zeros(self.stack.shape[1:], bool), objects.number, "objects on")

        return self.best_of((partial(fitted, objects) for objects in found), best, "outlines")

    def best_of(
        self, attempts: Iterable[Callable[[], Explanation | None]], before: Explanation, what: str
    ) -> Explanation | None:
        """Try several explanations of one kind, and return the best; None where none can be fitted.

        Compared by their misfits, with a flat border by what is known of the instrument, too, as in `explain`.
        Interrupted, it returns the best so far, marked so; nothing is lost but the attempts that follow.

        Args:
            attempts: each makes one; it may fail (`PredictionError`).
            before: the best explanation of other kinds.
            what: name of what an attempt starts from, plural, for the report.
        """
        fits: list[tuple[float, Explanation]] = []
        is_interrupted = False
        for attempt in attempts:
            found = None
            try:
                if (found := attempt()) is None:
                    continue
                is_interrupted = found.fit.is_interrupted
                fits.append((self.traced_misfit(found.fit) - self.instrument_improvement(before.fit, found.fit), found))
            except PredictionError as e:
                self.say(f"these {what} are given up: {e}")
            except KeyboardInterrupt:
                is_interrupted = True
                if not fits:
                    if found is None:
                        raise
                    fits.append((math.inf, found))  # the only one: there is nothing to compare it with
            if is_interrupted:
                break
        if not fits:
            return None
        best = min(fits, key=lambda one: one[0])[1]
        return best._replace(fit=interrupted(best.fit, OTHER_TRIED)) if is_interrupted else best

    def from_pits(self, best: Explanation, residuals: np.ndarray, /) -> Explanation | None:
        """Fit from pits with flat floors in a flat substrate; None where there are none."""
        if self.settings.border != "flat" or not self.settings.refine.objects:
            return None
        none, raster, shape = AlbedoPatches.none(self.stack.shape[1:]), Raster.of(self.stack), self.stack.shape[1:]
        try:
            rival = self.residuals_on(best.fit.state.surface, none)
        except PredictionError:
            rival = None
        search = PitSearch(
            lambda surface: self.residuals_on(surface, none),
            (raster.dy, raster.dx),
            self.stack.instrument.beam_shift,
            self.say,
            rival,
        )
        pits = search.find((shape[0], shape[1]))
        if pits is None:
            return None
        start = self.promising(pits.surface, best)
        if start is None:
            return None
        fit = self.fitted(start, self.plain_start[1], none, pits.number)
        return Explanation(fit, np.zeros(shape, bool), pits.number, "pits in")

    def promising(self, surface: Surface, best: Explanation) -> Surface | None:
        """Fit shortly from a surface without patches; None where the surface of the best explanation does better so.

        Only where the instrument is unknown, whose fits take minutes: there, fits bend the instrument, which a short
        fit holds as stated, so that a right explanation does better after a short one.
        """
        misfit, start = self.short_fit(surface, AlbedoPatches.none(self.stack.shape[1:]))
        problem = best.fit.problem
        if problem.is_instrument_unknown and misfit > self.short_fit(best.fit.state.surface, problem.patches)[0]:
            return None
        return start

    def from_albedo_patches(self, best: Explanation, residuals: np.ndarray, /) -> Explanation | None:
        """Fit with the albedos of patches that a fit does not explain; None where there are none.

        Objects and pits that leave something unexplained may be what a patch looked like: a fit without them is tried,
        too, and the better of the two returned.
        """
        if not self.settings.refine.albedo_patches:
            return None
        patches = self.albedo_search.patches
        if not self.is_strained(best.fit):
            patches = patches.keeping(patches.unexplained(squares(residuals).mean(0)))
        if not patches.objects:
            return None
        if not best.has_levels and self.given is None:
            return self.from_steps(patches)
        surface, problem = best.fit.state.surface, best.fit.problem  # levels that were found hold here, too

        def kept() -> Explanation:
            return best._replace(fit=self.fitted(surface, surface, patches, problem.region, problem.anchors))

        if best.number is None:
            return kept()
        return self.best_of((kept, lambda: self.from_steps(patches)), best, "patches")

    def from_wider_readout(self, best: Explanation, residuals: np.ndarray, /) -> Explanation | None:
        """Fit gains or offsets that are not what is stated; None where no such fit explains more.

        With patches of other albedos and without: they may stand for what wrong gains and offsets do, and have to
        explain more by `GAIN` than the fit without them.
        """
        problem, surface = best.fit.problem, best.fit.state.surface
        if problem.is_instrument_unknown or not self.is_strained(best.fit):
            return None
        start = (surface, surface) if best.has_levels else self.plain_start
        none = AlbedoPatches.none(self.stack.shape[1:])
        fit = best.fit
        for patches in (none, problem.patches) if problem.patches.objects else (none,):
            known = patches, problem.region, problem.anchors
            fitted = partial(self._with_wider_priors, known)
            found = fit_wider_readout(best.fit, start, fitted, self.say)
            if found is None:
                continue
            if evidence(fit, found) > (0.0 if fit is best.fit else GAIN):
                fit = found
            if found.is_interrupted:
                fit = interrupted(fit, OTHER_TRIED)
                break
        return None if fit is best.fit else best._replace(fit=fit)

    def with_likely_instrument(self, best: Explanation, readout: Fit | None) -> Explanation:
        """Fit other instruments where the micrographs ask for one (`instrument_choice`).

        `readout`: fit with wider priors of gains and offsets, kept or not; None: none was made.
        """
        fit = best.fit
        if fit.is_interrupted or not is_at_rest(fit):
            return best

        @cache
        def first() -> tuple[float, float]:
            residuals = self.residuals_of_first(fit)
            right = self.right_chi_square(residuals)
            share = float(self.contradicted(residuals, right).mean())
            return right, max(MIN_CONTRADICTED, MORE_CONTRADICTED * share)

        def is_explained(other: Fit) -> bool:
            right, most = first()
            try:
                return bool(self.contradicted(self.residuals(other), right).mean() <= most)
            except PredictionError as e:
                self.say(f"another instrument is given up: {e}")
                return False

        return best._replace(fit=InstrumentChoice(self._refit_geometry, is_explained, self.say).best_of(fit, readout))

    def _refit_geometry(self, fit: Fit, patches: AlbedoPatches, factors: Widths, start: Any) -> Fit:
        """Fit with an uncertain geometry; arguments as `instrument_choice.Refit`."""
        problem, surface, settings = fit.problem, fit.state.surface, with_widths(self.settings, factors)
        known = patches, problem.region, problem.anchors, settings, usual_uncertainty(problem)
        posed = self.pose(surface, *known)
        found = self._unbiased(fit_heights(posed, surface, self.predict, self.report, start(posed)))
        return replace(found, prior_widths=fit.prior_widths if max(factors.values()) > 1.0 else {})

    def _with_wider_priors(self, known: tuple, surface: Surface, smoothed: Surface, wider: Widths) -> Fit:
        """Fit as `fitted`, gains or offsets by wider priors; `known` as in `pose`: patches, regions, anchors."""
        fit = self.fitted(surface, smoothed, *known, with_widths(self.settings, wider))
        return replace(fit, prior_widths=wider)


def share_of_areas(is_contradicted: np.ndarray) -> float:
    """Compute the share of the pixels that are contradicted [y, x] and in an area that is not `NARROW`."""
    y, x = (axis - 0.5 * (NARROW - 1) for axis in np.ogrid[:NARROW, :NARROW])
    return float(binary_opening(is_contradicted, x**2 + y**2 <= 0.25 * NARROW**2).mean())


def has_contradicted_hollow(is_contradicted: np.ndarray, fit: Fit) -> bool:
    """Whether data contradict [y, x] a region below the largest one, from which depth jumps part it."""
    region, height = regions(fit.joined_x, fit.joined_y), fit.surface.height
    is_below = height < np.median(height[region == 0])
    return bool((contradicted_regions(is_contradicted, region) & is_below).any())


def beside_outlines(number: np.ndarray) -> np.ndarray:
    """Find the pixels [y, x] with another object, or the substrate, among their eight neighbours; `number` of it."""
    return maximum_filter(number, 3) != minimum_filter(number, 3)


def improvement(residuals: np.ndarray, others: np.ndarray) -> float:
    """Compute by how much other residuals [detector, y, x] are smaller, in half chi-square."""
    return half_chi_square(residuals) - half_chi_square(others)


def readout_as_stated(parameters: Parameters) -> Parameters:
    """Set gains and offsets to what is stated."""
    return parameters.replaced(log_gain=0.0 * parameters.log_gain, offset=0.0 * parameters.offset)


def scan_order(stack: MicrographStack) -> ScanOrder:
    """Order in which a stack's pixels were recorded."""
    return ScanOrder(0 if stack.fast_axis == "x" else 1, stack.scan_time)
