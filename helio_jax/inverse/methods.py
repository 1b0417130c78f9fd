"""From one micrograph stack to a `Reconstruction`: the stage's single entry, which runs the chosen method.

linear: normals with constant directions, then integration. nearfield: the same, directions re-evaluated at
the current height. refine: the fit of the heights, started from nearfield. Takes the substrate's distance and the
instrument from the stack, and, if the settings say so, that the border of the image is flat; no truth.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import GuardError
from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.readout import ScanOrder
from helio_jax.inverse.integrate import integrate_slopes
from helio_jax.inverse.levels import search_levels
from helio_jax.inverse.linear import MIN_IMAGES, signal_of, solve_known_albedo
from helio_jax.inverse.nearfield import level, limited, photometric_heights, solve_nearfield
from helio_jax.inverse.quality import (
    FACET_IMAGES,
    TRUSTED,
    depth_jumps,
    floating,
    ill_explained,
    reasons_from_data,
    reasons_from_fit,
    regions,
    telling,
)
from helio_jax.inverse.regions import find_plateaus, joined, unexplained
from helio_jax.inverse.residuals import Surface
from helio_jax.inverse.settings import LEAST_PATHS, ReconstructSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

MAX_WIDTH = 0.125
"""Plateaus are searched up to twice this share of the sample distance above and below the ground ..."""
SEARCH_THRIFT = 8
"""... with this many times fewer paths per prediction than the fit."""
START_THRIFT = 4
"""The same for the photometric solutions that the fit starts from, unless the image is small: it would save little."""

RETREATS = 3
"""How often a surface to start from is made calmer when nothing can be predicted of it."""

GEOMETRY_DOUBT = (
    "the geometry was fitted, too: on surfaces that do not scatter by the cosine law heights may be off by more than "
    "their stated deviations; compare with nearfield"
)
"""What the status says of a fit whose aims or distance are unknown."""

if TYPE_CHECKING:
    from helio_jax.inverse.fit import Fit, Report
    from helio_jax.inverse.problem import Predict


def reconstruct_stack(
    stack: MicrographStack,
    settings: ReconstructSettings,
    make_predict: "Callable[[int], Predict] | None" = None,
    report: "Report | None" = None,
) -> Reconstruction:
    """Turn three or more micrographs into heights.

    Args:
        stack: images of one scan; background known or zero.
        settings: method and options.
        make_predict: from a number of paths to what predicts, with them, all but single scattering; `refine` needs it,
            the other methods correct with it.
        report: called before each round of `refine`.

    Raises:
        GuardError: fewer than 3 images, no pixel recorded in 3 of them, or a height that is not finite.
    """
    n_usable = stack.is_observed.sum(0)
    if stack.shape[0] < MIN_IMAGES or not (n_usable >= MIN_IMAGES).any():
        raise GuardError(
            f"heights need {MIN_IMAGES} or more images of a pixel, got at most {int(n_usable.max())} from "
            f"{stack.shape[0]} detectors: add detector directions, or align turned scans (helio align)"
        )
    geometry = SpotGeometry(stack.instrument)
    if settings.method == "refine":
        result = _refined(stack, settings, geometry, make_predict, report)
    else:
        predict = None if make_predict is None else make_predict(start_paths(stack, settings))
        result = photometric_heights(stack, settings, geometry, predict)
    if not np.all(np.isfinite(result.height)):
        raise GuardError("the reconstructed heights are not finite: please report it with the stack")
    return result


def start_paths(stack: MicrographStack, settings: ReconstructSettings) -> int:
    """Return the number of paths per prediction that a photometric solution is worth."""
    n_paths = settings.refine.paths(stack.counts[0].size)
    return min(n_paths, max(n_paths // START_THRIFT, LEAST_PATHS))


def _corrected(stack, settings, geometry, height, normals, predict) -> Surface:
    """Return heights and slopes of the photometric solution of albedo 1 that a prediction on a surface corrects."""
    signal, variance = signal_of(stack)
    shift = stack.instrument.beam_shift
    prediction = predict(height, normals)
    doubt = prediction.doubt(normals, settings.refine.mask_error, settings.refine.multiple_error)
    near = prediction.about(normals)
    visible = geometry.form_factor(height) - near.hidden
    (a, b), _ = solve_known_albedo(signal - near.multiple, variance + doubt**2, visible, normals, shift)
    weight = np.ones(stack.shape[1:])
    height = integrate_slopes(a, b, pitch(stack.x), pitch(stack.y), "weighted", weight)
    return Surface(limited(level(height, settings, weight), stack), a, b)


def _retreating(work: Callable[[Surface], Any], surface: Surface, calmer: Surface) -> tuple[Any, Surface]:
    """Return what is made of a surface, and that surface: half-way to a calmer one while nothing is predicted of it."""
    for _ in range(RETREATS):
        try:
            return work(surface), surface
        except GuardError:
            surface = Surface(*(0.5 * (rough + calm) for rough, calm in zip(surface, calmer, strict=True)))
    return work(surface), surface


def sensitivity(fit: "Fit", settings: ReconstructSettings) -> dict[str, float]:
    """Return by how many per cent the highest point moves per per cent of signal of each gain and offset.

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


def _known(fit: "Fit") -> dict[str, np.ndarray]:
    """Return what a fit knows of the instrument that does not depend on the surface."""
    return {name: value for name, value in fit.values.items() if name not in ("log_multiple", "unseen")}


def scan_order(stack: MicrographStack) -> ScanOrder:
    """Return in which order a stack's pixels were recorded."""
    return ScanOrder(0 if stack.fast_axis == "x" else 1, stack.scan_time)


def _with_plateaus(stack, settings, geometry, make_predict, report, start, calmer, predict) -> "tuple[Fit, np.ndarray]":
    """Fit the heights, from a start or one nearer to a calmer surface, then those of plateaus that stay unexplained.

    They are put to better levels, at first those that touch as one, and all is fitted again.

    Return the fit, and where another level explains the images as well, or better but could not be fitted [y, x].
    """
    from helio_jax.inverse.fit import fit_heights, misfit_on

    signal, variance = signal_of(stack)
    problem = signal, variance, geometry, pitch(stack.x), pitch(stack.y)
    order = scan_order(stack)
    fit, _ = _retreating(
        lambda surface: fit_heights(*problem, surface, settings, predict, report, order=order), start, calmer
    )
    region, levelled = find_plateaus(signal, variance), np.zeros(stack.shape[1:], int)
    is_undecided = np.zeros(stack.shape[1:], bool)
    roughly = make_predict(max(settings.refine.paths(region.size) // SEARCH_THRIFT, 1000))
    for is_last in (False, True):
        single = unexplained(region, fit.residuals)
        left = single if is_last else joined(single)
        if fit.is_interrupted or not left.any():
            break
        try:
            found = search_levels(
                left,
                fit.surface,
                (pitch(stack.y), pitch(stack.x)),
                MAX_WIDTH * stack.instrument.sample_distance,
                lambda surface, fit=fit: misfit_on(*problem, surface, settings, roughly, order, _known(fit)),
                stack.instrument.beam_shift,
                lambda said: report(0, settings.refine.max_rounds, said) if report else None,
            )
            is_undecided[left > 0] = np.isin(left, found.undecided)[left > 0]
            if found.moved:
                is_moved = np.isin(left, found.moved)
                is_undecided |= is_moved  # unless the fit goes on from there
                trial = np.where(is_moved, levelled.max() + left, levelled)
                fit = fit_heights(*problem, found.surface, settings, predict, report, trial, order)
                levelled, is_undecided = trial, is_undecided & (~is_moved | np.isin(left, found.undecided))
            elif np.unique(left).size == np.unique(single).size:
                break
        except KeyboardInterrupt:
            fit = replace(fit, status=f"interrupted in the search for plateaus; before that: {fit.status}")
            break
        except GuardError as e:
            fit = replace(fit, status=f"{fit.status}; a plateau was found that could not be fitted: {e}")
            break
    return fit, is_undecided


def _refined(stack, settings, geometry, make_predict, report) -> Reconstruction:
    if make_predict is None:
        raise GuardError(
            "method 'refine' needs a prediction of masks and multiple scattering: use helio_jax.reconstruct"
        )
    shift = stack.instrument.beam_shift
    predict = make_predict(settings.refine.paths(stack.counts[0].size))
    roughly = make_predict(start_paths(stack, settings))
    steps = pitch(stack.x), pitch(stack.y)
    height, solution = solve_nearfield(*signal_of(stack), geometry, *steps, settings, settings.rounds)

    def correct(surface: Surface) -> Surface:
        return _corrected(stack, settings, geometry, surface.height, surface.normals(shift), roughly)

    calmer = Surface(*np.zeros((3, *height.shape)))
    try:
        start = _corrected(stack, settings, geometry, limited(height, stack), solution.normals, roughly)
    except GuardError:
        start = correct(calmer)
    for _ in range(settings.refine.photometric_rounds - 1):
        start, calmer = _retreating(correct, start, calmer)
    fit, is_floating = _with_plateaus(stack, settings, geometry, make_predict, report, start, calmer, predict)
    from helio_jax.inverse.instrument_report import describe_instrument

    posterior = fit.posterior
    if posterior is not None:
        is_floating |= floating(
            fit.surface.height, posterior.samples, regions(fit.intact_x, fit.intact_y), posterior.bent
        )
    worst = fit.weight.min(0, where=stack.is_observed, initial=1.0)
    height, slope_x, slope_y = fit.surface
    jumps = (
        depth_jumps(height, slope_x, fit.intact_x, pitch(stack.x), 1),
        depth_jumps(height, slope_y, fit.intact_y, pitch(stack.y), 0),
    )
    is_moved = bool(fit.values["aim"].size or fit.values["distance"].size)
    n_telling = telling(fit.model_share, stack.is_observed)
    is_explained = (worst >= TRUSTED) & ~ill_explained(fit.residuals, stack.is_observed)
    reason = reasons_from_fit(reasons_from_data(stack, FACET_IMAGES), is_explained, n_telling, *jumps, is_floating)
    return Reconstruction(
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
        status=f"{fit.status}; {GEOMETRY_DOUBT}" if is_moved else fit.status,
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
