"""From one micrograph stack to a `Reconstruction`: the stage's single entry, which runs the chosen method.

linear: normals with constant directions, then integration. nearfield: the same, directions re-evaluated at
the current height. refine: the fit of the heights, started from nearfield. Takes the substrate's distance and the
instrument from the stack, and, if the settings say so, that the border of the image is flat; no truth.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from helio_jax.errors import GuardError, PredictionError, SceneError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.readout import ScanOrder
from helio_jax.forward.surface import Surface
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.albedo_search import search_albedo_patches
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.integrate import integrate_slopes
from helio_jax.inverse.levels import GAIN, SKIRT, Region, covered, search_levels
from helio_jax.inverse.linear import MIN_IMAGES, signal_of, solve_known_albedo
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.inverse.nearfield import level, limited, photometric_heights, solve_nearfield
from helio_jax.inverse.quality import (
    FACET_IMAGES,
    TRUSTED,
    depth_jumps,
    floating,
    ill_explained,
    n_informative,
    reasons_from_data,
    reasons_from_fit,
    regions,
    squares,
)
from helio_jax.inverse.settings import LEAST_PATHS, ReconstructSettings
from helio_jax.inverse.state import linearised_in_normal, prediction_std
from helio_jax.inverse.verdict import (
    LIMIT,
    Misfit,
    Trace,
    judged,
    local_chi_square,
    misfit_of_map,
    residuals_of_state,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

MAX_WIDTH = 0.125
"""Levels are searched up to twice this share of the sample distance above and below the substrate ..."""
SEARCH_THRIFT = 8
"""... with this many times fewer paths per prediction than the fit, which is tested so, too."""
START_THRIFT = 4
"""The same for photometric solutions, but not fewer than the least number: from a noisier start the rim of sphere B is
7 % worse."""
MIN_CONTRADICTED = 0.02
"""Patches of another albedo are searched where the data contradict the fit without them in a larger share of pixels."""
MAX_LEVEL_SLOPE = 0.3
"""Steeper pixels of a region do not count for its level: they are its wall."""
MAX_BACKTRACKS = 3
"""How often a starting surface is smoothed when masks and multiple scattering cannot be predicted for it."""
GEOMETRY_WARNING = (
    "the geometry was fitted, too: on surfaces that do not scatter by the cosine law heights may be off by more than "
    "their stated standard deviations; compare with nearfield"
)
"""Part of the status of a fit whose aperture angles or distance are unknown."""

if TYPE_CHECKING:
    from helio_jax.inverse.fit import Fit, Report
    from helio_jax.inverse.state import Predict


def reconstruct_stack(
    stack: MicrographStack,
    settings: ReconstructSettings,
    make_predict: "Callable[[int], Predict] | None" = None,
    report: "Report | None" = None,
    trace: Trace | None = None,
) -> Reconstruction:
    """Reconstruct heights from three or more micrographs, and test them against these.

    Args:
        stack: images of one scan; background known or zero.
        settings: method and options.
        make_predict: from a number of paths to what predicts, with them, masks and multiple scattering; `refine` needs
            it, the other methods correct with it.
        report: called before each iteration of `refine`.
        trace: traces the finished map, for the verdict of the data (`verdict`); None: no verdict.

    Raises:
        GuardError: fewer than 3 images, no pixel recorded in 3 of them, or a height that is not finite.
    """
    n_usable = stack.is_observed.sum(0)
    if stack.shape[0] < MIN_IMAGES or not (n_usable >= MIN_IMAGES).any():
        raise GuardError(
            f"heights need {MIN_IMAGES} or more images of a pixel, got at most {int(n_usable.max())} from "
            f"{stack.shape[0]} detectors: add detector directions, or align rotated scans (helio align)"
        )
    if settings.method == "refine":
        result, residuals = _refined(stack, settings, make_predict, report)
        _check_finite(result)
        return judged(result, stack, partial(residuals, trace)) if trace else result

    predict = make_predict and make_predict(start_paths(stack, settings))
    test = None
    if trace:
        patches = search_albedo_patches(stack, settings, predict) if predict else AlbedoPatches.none(stack.shape[1:])
        test = partial(_tested, stack, patches, trace)
    result = photometric_heights(stack, settings, predict, test)
    _check_finite(result)
    return result


def _tested(
    stack: MicrographStack, patches: AlbedoPatches, trace: Trace, rec: Reconstruction
) -> tuple[Reconstruction, Misfit | None]:
    """Return a photometric height map with the verdict of its data, and its misfit unless it cannot be traced."""
    _check_finite(rec)
    misfit = cache(partial(misfit_of_map, stack, rec, patches, trace))
    tested = judged(rec, stack, lambda: misfit().residuals)
    return tested, None if tested.chi_square is None else misfit()


def _check_finite(rec: Reconstruction) -> None:
    """Raise GuardError if a height is not finite."""
    if not np.all(np.isfinite(rec.height)):
        raise GuardError("the reconstructed heights are not finite: please report it with the stack")


def start_paths(stack: MicrographStack, settings: ReconstructSettings) -> int:
    """Choose the number of paths per prediction on a photometric solution."""
    n_paths = settings.refine.paths(stack.counts[0].size)
    return min(n_paths, max(n_paths // START_THRIFT, LEAST_PATHS))


def search_paths(stack: MicrographStack, settings: ReconstructSettings) -> int:
    """Choose the number of paths per prediction in a search and in the test of a fit."""
    return max(settings.refine.paths(stack.counts[0].size) // SEARCH_THRIFT, 1000)


def _corrected(stack, settings, patches: AlbedoPatches, surface: Surface, normals: np.ndarray, predict) -> Surface:
    """Solve photometrically with the albedo of patches and the corrections predicted on a surface."""
    signal, variance = (f / patches.albedo**n for n, f in enumerate(signal_of(stack), 1))
    optics, raster = Optics.of(stack.instrument), Raster.of(stack)
    corrections = predict(surface.height, normals, **patches.known)
    sigma = prediction_std(corrections, normals, settings.refine)
    masked, multiple = linearised_in_normal(corrections, normals)
    visible = form_factor(optics, surface.height) - masked
    spread = variance + sigma**2
    (a, b), _ = solve_known_albedo(signal - multiple, spread, visible, normals, stack.instrument.beam_shift)
    weight = np.ones(stack.shape[1:])
    height = integrate_slopes(a, b, raster.dx, raster.dy, "weighted", weight)
    return Surface(limited(level(height, settings, weight), optics), a, b)


def _with_backtracking(work: Callable[[Surface], Any], surface: Surface, smoothed: Surface) -> tuple[Any, Surface]:
    """Run `work` on a surface; on PredictionError, halve the step towards a smoothed surface (`MAX_BACKTRACKS`)."""
    for _ in range(MAX_BACKTRACKS):
        try:
            return work(surface), surface
        except PredictionError:
            surface = jax.tree.map(lambda rough, smooth: 0.5 * (rough + smooth), surface, smoothed)
    return work(surface), surface


def sensitivity(fit: "Fit", settings: ReconstructSettings) -> dict[str, float]:
    """Compute the change of the highest point per change of each gain and offset, per cent per per cent of signal.

    All other unknowns follow the forced change; heights count from the median.
    """
    if fit.posterior is None:
        return {}
    height = fit.surface.height - np.median(fit.surface.height)
    top = np.unravel_index(np.argmax(np.abs(height)), height.shape)
    std = {"log_gain": settings.refine.gain_std, "offset": settings.refine.offset_std}
    return {
        name: float(response[top] / height[top] / std[name.split("[")[0]])
        for name, response in zip(fit.posterior.names, fit.posterior.response, strict=True)
        if name.split("[")[0] in std and height[top] != 0
    }


def scan_order(stack: MicrographStack) -> ScanOrder:
    """Order in which a stack's pixels were recorded."""
    return ScanOrder(0 if stack.fast_axis == "x" else 1, stack.scan_time)


def _with_levels(
    stack: MicrographStack,
    settings: ReconstructSettings,
    make_predict: "Callable[[int], Predict]",
    report: "Report | None",
    patches: AlbedoPatches,
    start: Surface,
    smoothed: Surface,
) -> "tuple[Fit, np.ndarray]":
    """Fit the heights from a start, or one nearer to a smoothed surface, with regions at the levels of their steps.

    Returns:
        The fit, and where another level explains the images as well [y, x].
    """
    from helio_jax.inverse.fit import fit_heights, misfit_of, short_fit
    from helio_jax.inverse.problem import FitProblem
    from helio_jax.inverse.state import FitState

    signal, variance = signal_of(stack)
    raster, n_paths = Raster.of(stack), settings.refine.paths(signal[0].size)
    predict, roughly = make_predict(n_paths), make_predict(search_paths(stack, settings))

    def pose(surface: Surface, region: np.ndarray | None = None, anchors: Anchors | None = None) -> FitProblem:
        known = signal, variance, stack.instrument, raster, surface, settings, region
        return FitProblem.of(*known, scan_order(stack), patches=patches, anchors=anchors)

    labels, is_undecided = np.zeros(stack.shape[1:], int), np.zeros(stack.shape[1:], bool)
    anchors = None
    if steps := measured_regions(stack, start):
        try:
            found = search_levels(
                steps,
                start,
                (raster.dy, raster.dx),
                MAX_WIDTH * stack.instrument.sample_distance,
                lambda trial: misfit_of(problem := pose(trial), FitState.at(problem, trial), roughly),
                lambda trial: short_fit(pose(trial), trial, roughly),
                stack.instrument.beam_shift,
                lambda said: report(0, settings.refine.max_rounds, said) if report else None,
            )
            start, is_undecided = found.surface, covered(steps, found.undecided)
            if moved := [steps[i] for i in found.moved]:
                labels = labelled(moved)
                anchors = level_anchors(labels, moved, start)
        except PredictionError:
            pass  # the start is too rough for it: the fit begins at a smoother one
    fit, _ = _with_backtracking(
        lambda surface: fit_heights(pose(surface, labels, anchors), surface, predict, report), start, smoothed
    )
    return fit, is_undecided


def measured_regions(stack: MicrographStack, start: Surface) -> list[Region]:
    """Find the patches whose steps the mask bands show, the largest first; none where steps cannot be measured.

    Steps are measured from the substrate, which the start puts at any height where the border is free.
    """
    try:
        found = find_steps(stack)
    except SceneError:
        return []
    substrate = float(np.median(start.height[found.patch == 0]))
    return [
        Region(found.patch == p.number, p.level_um, p.level_std_um, substrate)
        if p.is_determined
        else Region(found.patch == p.number)
        for p in sorted(found.patches[1:], key=lambda patch: -patch.pixels)
    ]


def level_anchors(labels: np.ndarray, regions: list[Region], surface: Surface) -> Anchors:
    """Anchor the regions whose heights are measured, where the surface is level in them.

    Args:
        labels: 1, 2, ... in the regions [y, x].
        regions: that were moved, in this order.
        surface: with the regions at their levels.
    """
    is_level = np.hypot(surface.slope_x, surface.slope_y) < MAX_LEVEL_SLOPE
    known = {i: (r.height, r.std) for i, r in enumerate(regions, 1) if r.height is not None}
    return Anchors.of_levels(labels, known, is_level, SKIRT)


def labelled(regions: list[Region]) -> np.ndarray:
    """Number the pixels of regions 1, 2, ... [y, x]; 0 outside of all."""
    out = np.zeros(regions[0].inside.shape, int)
    for number, region in enumerate(regions, 1):
        out[region.inside] = number
    return out


def _start(
    stack: MicrographStack, settings: ReconstructSettings, patches: AlbedoPatches, predict: "Predict"
) -> tuple[Surface, Surface]:
    """Find the photometric solution that the fit starts from, and a smoother one."""
    optics, raster, shift = Optics.of(stack.instrument), Raster.of(stack), stack.instrument.beam_shift
    height, solution = solve_nearfield(*signal_of(stack), optics, raster, settings, settings.rounds)

    def correct(surface: Surface) -> Surface:
        return _corrected(stack, settings, patches, surface, surface.normals(shift), predict)

    smoothed = Surface(*np.zeros((3, *height.shape)))
    try:
        near = Surface(limited(height, optics), *np.zeros((2, *height.shape)))
        start = _corrected(stack, settings, patches, near, solution.normals, predict)
    except PredictionError:
        start = correct(smoothed)
    for _ in range(settings.refine.photometric_rounds - 1):
        start, smoothed = _with_backtracking(correct, start, smoothed)
    return start, smoothed


def _with_albedos(stack, settings, make_predict, report) -> "tuple[Fit, np.ndarray]":
    """Fit with one albedo, that of the substrate; then with those of the patches that this fit does not explain.

    Their albedos are kept where the data that are expected of the second fit explain the images better.
    """
    predict = make_predict(start_paths(stack, settings))
    roughly = make_predict(search_paths(stack, settings))

    def fitted(patches: AlbedoPatches) -> "tuple[Fit, np.ndarray]":
        start = _start(stack, settings, patches, predict)
        return _with_levels(stack, settings, make_predict, report, patches, *start)

    def tested(fit: "Fit") -> np.ndarray:
        return residuals_of_state(fit.problem, fit.state, roughly)

    plain = fitted(AlbedoPatches.none(stack.shape[1:]))
    if plain[0].is_interrupted or not settings.refine.albedo_patches:
        return plain
    try:
        residuals = tested(plain[0])
        if np.mean(local_chi_square(residuals, stack.is_observed) > LIMIT) < MIN_CONTRADICTED:
            return plain
        square, found = squares(residuals), search_albedo_patches(stack, settings, predict)
        left = found.keeping(found.unexplained(square.mean(0)))
        if not left.objects:
            return plain
        other = fitted(left)
        is_better = 0.5 * np.sum(square - squares(tested(other[0]))) > GAIN
    except PredictionError:
        return plain
    return other if is_better else plain


def _refined(stack, settings, make_predict, report) -> tuple[Reconstruction, Callable[[Trace], np.ndarray]]:
    """Reconstruct by the fit; return what computes its residuals from a trace, too."""
    from helio_jax.inverse.fit import with_posterior
    from helio_jax.inverse.instrument_report import describe_instrument

    if make_predict is None:
        raise GuardError(
            "method 'refine' needs a prediction of masks and multiple scattering: use helio_jax.reconstruct"
        )
    fit, is_floating = _with_albedos(stack, settings, make_predict, report)
    fit = with_posterior(fit)
    posterior, raster = fit.posterior, Raster.of(stack)
    if posterior is not None:
        region = regions(fit.joined_x, fit.joined_y)
        is_floating |= floating(fit.surface.height, posterior.samples, region, posterior.common_modes)
    worst = fit.weight.min(0, where=stack.is_observed, initial=1.0)
    jumps = (
        depth_jumps(fit.surface.height, fit.surface.slope_x, fit.joined_x, raster.dx, 1),
        depth_jumps(fit.surface.height, fit.surface.slope_y, fit.joined_y, raster.dy, 0),
    )
    is_moved = bool(fit.parameters.aim.size or fit.parameters.distance.size)
    informative = n_informative(fit.model_share, stack.is_observed)
    is_explained = (worst >= TRUSTED) & ~ill_explained(fit.residuals, stack.is_observed)
    reason = reasons_from_fit(reasons_from_data(stack, FACET_IMAGES), is_explained, informative, *jumps, is_floating)
    found = Reconstruction(
        height=fit.surface.height,
        raster_x=stack.x,
        raster_y=stack.y,
        instrument=fit.instrument,
        method="refine",
        normals=fit.normals,
        albedo=fit.albedo,
        height_std=None if posterior is None else posterior.height_std,
        height_samples=None if posterior is None else posterior.samples,
        is_valid=reason == 0,
        reason=reason,
        residuals=fit.residuals,
        gain=fit.gain,
        offset=fit.offset,
        border=settings.border,
        status=f"{fit.status}; {GEOMETRY_WARNING}" if is_moved else fit.status,
        provenance={
            "stack": dict(stack.provenance),
            "reconstruct": settings.model_dump(mode="json"),
            "height_changes_um": list(fit.changes),
            "contraction": fit.contraction,
            "sensitivity": sensitivity(fit, settings),
            "instrument": describe_instrument(fit, settings.refine),
            "chi_square": fit.chi_square,
        },
    )
    return found, partial(residuals_of_state, fit.problem, fit.state)
