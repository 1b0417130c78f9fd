"""From one micrograph stack to a `Reconstruction`: the stage's single entry, which runs the chosen method.

linear: normals with constant directions, then integration. nearfield: the same, directions re-evaluated at
the current height. refine: the fit of the heights, started from nearfield. Takes the substrate's distance and the
instrument from the stack, and, if the settings say so, that the border of the image is flat; no truth.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from helio_jax.errors import GuardError
from helio_jax.forward.optics import Optics, Raster
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.albedo_search import search_albedo_patches
from helio_jax.inverse.convergence import has_converged
from helio_jax.inverse.dead_detectors import dead_detectors
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.misfit_errors import with_path_error
from helio_jax.inverse.nearfield import photometric_heights
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
)
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.verdict import (
    Misfit,
    Trace,
    judged,
    misfit_of_map,
    misfit_of_state,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

INTERRUPTED_WARNING = "the fit was interrupted: these heights are the best so far, without error bars"
"""Warning of a fit that the user stopped ..."""
BIASED = "; their bias by noise was not subtracted (relief some per cent too flat where a drift is unknown)"
"""... where that bias matters."""
GEOMETRY_WARNING = (
    "the geometry was fitted, too: on surfaces that do not scatter by the cosine law heights may be off by more than "
    "their stated standard deviations; compare with nearfield"
)
"""Warning of a fit whose aperture angles or distance are unknown."""

LAW_WARNING = (
    "numbers of the scattering law were fitted: on traced samples they were off by up to 5 of their stated standard "
    "deviations (docs/limits.md), so that even a sample of the cosine law may be said not to be one: simulate the "
    "sample to test it"
)
"""Warning of a fit whose scattering law is unknown."""

UNUSED = "the anchors, {n} in number, were not used: {why}"
"""Warning of a height map that was not moved to what the user knows."""

if TYPE_CHECKING:
    from helio_jax.inverse.anchors import Anchors
    from helio_jax.inverse.fit import Fit, Report
    from helio_jax.inverse.state import Predict


def reconstruct_stack(
    stack: MicrographStack,
    settings: ReconstructSettings,
    make_predict: "Callable[[int], Predict] | None" = None,
    report: "Report | None" = None,
    trace: Trace | None = None,
    start: np.ndarray | None = None,
) -> Reconstruction:
    """Reconstruct heights from three or more micrographs, and test them against these.

    Args:
        stack: images of one scan; background known or zero.
        settings: method and options.
        make_predict: from a number of paths to what predicts, with them, masks and multiple scattering; `refine` needs
            it, the other methods correct with it.
        report: called before each iteration of `refine`.
        trace: traces the finished map, for the verdict of the data (`verdict`); None: no verdict.
        start: heights that `refine` starts from [y, x], um; default: the photometric solution.

    Raises:
        GuardError: fewer than 3 images, no pixel recorded in 3 of them, a detector without signal, or a height
            that is not finite.
    """
    check_images(stack)
    if settings.method == "refine":
        result, misfit_of, anchors, region, off_substrate = _refined(stack, settings, make_predict, report, start)
        _check_finite(result)
        if not trace:
            return result
        tested, misfit = _tested(stack, partial(misfit_of, trace), result, region)
        return with_path_error(tested, misfit, stack, settings, anchors, off_substrate) if misfit else tested

    predict = make_predict and make_predict(settings.refine.start_paths(stack.counts[0].size))
    test = None
    if trace:
        patches = search_albedo_patches(stack, settings, predict) if predict else AlbedoPatches.none(stack.shape[1:])
        test = lambda rec: _tested(stack, partial(misfit_of_map, stack, rec, patches, trace), rec)  # noqa: E731
    result = photometric_heights(stack, settings, predict, test)
    _check_finite(result)
    if settings.anchor:
        why = f"method {settings.method!r} takes none, refine does"
        result = result.replace(warnings=(UNUSED.format(n=len(settings.anchor), why=why), *result.warnings))
    return result


def check_images(stack: MicrographStack) -> None:
    """Raise GuardError where heights cannot be had: too few images of every pixel, or a detector without signal."""
    n_usable = stack.is_observed.sum(0)
    if stack.shape[0] < MIN_IMAGES or not (n_usable >= MIN_IMAGES).any():
        raise GuardError(
            f"heights need {MIN_IMAGES} or more images of a pixel, got at most {int(n_usable.max())} from "
            f"{stack.shape[0]} detectors: add detector directions, or align rotated scans (helio align)"
        )
    if dead := dead_detectors(stack):
        raise GuardError(
            "no detector shows a signal beyond its background: were these data read from the right file and channels, "
            "and is the background right?"
            if len(dead) == stack.shape[0]
            else f"detector {dead[0]!r} shows no signal beyond its background, where the others do: if it was off, or "
            "below the horizon of all that was scanned, leave its image out or set it to NaN, which stands for pixels "
            "without data; if not, its background is too high"
        )


def _tested(
    stack: MicrographStack, misfit_of: Callable[[], Misfit], rec: Reconstruction, region: np.ndarray | None = None
) -> tuple[Reconstruction, Misfit | None]:
    """Return a height map with the verdict of its data, and its misfit unless it cannot be traced."""
    _check_finite(rec)
    misfit = cache(misfit_of)
    tested = judged(rec, stack, lambda: misfit().residuals, region)
    return tested, None if tested.chi_square is None else misfit()


def _check_finite(rec: Reconstruction) -> None:
    """Raise GuardError if a height is not finite."""
    if not np.all(np.isfinite(rec.height)):
        raise GuardError("the reconstructed heights are not finite: please report it with the stack")


def warnings_of(fit: "Fit") -> tuple[str, ...]:
    """List what to know before the heights of a fit are trusted."""
    from helio_jax.inverse.geometry_score import geometry_warnings
    from helio_jax.inverse.wider_readout import warning_of

    tolerance = fit.problem.settings.tolerance_um
    found = []
    if fit.is_interrupted:
        has_bias = fit.problem.is_biased_by_noise and fit.problem.settings.bias_pairs
        found.append(INTERRUPTED_WARNING + (BIASED if has_bias and not fit.is_bias_subtracted else ""))
    if not has_converged(fit.changes, tolerance):
        found.append(
            f"the fit has not converged: its last iteration changed the heights by {fit.changes[-1]:.2f} um (limit "
            f"{tolerance:g} um)"
        )
    if fit.posterior is not None and fit.posterior.inflation > 1.0:
        found.append(
            "what was fitted of instrument and model deviates more from what is stated than its uncertainty explains: "
            f"all error bars are inflated by {fit.posterior.inflation:.1f}"
        )
    found += geometry_warnings(fit)
    if fit.parameters.aim.size or fit.parameters.distance.size:
        found.append(GEOMETRY_WARNING)
    if fit.problem.settings.has_own_law:
        found.append(LAW_WARNING)
    return (*found, *warning_of(fit))


def sensitivity(fit: "Fit") -> dict[str, float]:
    """Compute the change of the highest point per change of each gain and offset, per cent per per cent of signal.

    All other unknowns follow the forced change; heights count from the median.
    """
    from helio_jax.inverse.instrument_report import plain_name

    if fit.posterior is None:
        return {}
    height = fit.surface.height - np.median(fit.surface.height)
    top = np.unravel_index(np.argmax(np.abs(height)), height.shape)
    std = {"log_gain": fit.problem.settings.gain_std, "offset": fit.problem.settings.offset_std}
    return {
        plain_name(name, fit.instrument.detector_names): float(response[top] / height[top] / std[name.split("[")[0]])
        for name, response in zip(fit.posterior.names, fit.posterior.response, strict=True)
        if name.split("[")[0] in std and height[top] != 0
    }


class _Refined(NamedTuple):
    """A height map by the fit.

    Attributes:
        rec: the map, not tested.
        misfit_of: computes its misfit from a trace.
        anchors: that it was brought to.
        region: that depth jumps part from the rest, from `regions` [y, x].
        off_substrate: pixels that measured steps put off the substrate (`FitProblem`).
    """

    rec: Reconstruction
    misfit_of: Callable[[Trace], Misfit]
    anchors: "Anchors"
    region: np.ndarray
    off_substrate: np.ndarray | None


def _refined(stack, settings, make_predict, report, start) -> _Refined:
    """Reconstruct by the fit."""
    from helio_jax.inverse.anchoring import as_records, with_anchors
    from helio_jax.inverse.explanations import explain
    from helio_jax.inverse.instrument_report import describe_instrument
    from helio_jax.inverse.known_heights import check_places
    from helio_jax.inverse.wider_readout import priors_of

    if make_predict is None:
        raise GuardError(
            "method 'refine' needs a prediction of masks and multiple scattering: use helio_jax.reconstruct"
        )
    check_places(settings.anchor, Raster.of(stack), Optics.of(stack.instrument), stack.instrument.detector_names)
    found = explain(stack, settings, make_predict, report, start)
    (fit, anchors, used), is_floating = with_anchors(found.fit, found.steps), found.is_undecided
    posterior, raster, region = fit.posterior, Raster.of(stack), regions(fit.joined_x, fit.joined_y)
    if posterior is not None:
        known = used.known_steps(region)
        is_floating |= floating(fit.surface.height, posterior.samples, region, posterior.common_modes, known)
    worst = fit.weight.min(0, where=stack.is_observed, initial=1.0)
    jumps = (
        depth_jumps(fit.surface.height, fit.surface.slope_x, fit.joined_x, raster.dx, 1),
        depth_jumps(fit.surface.height, fit.surface.slope_y, fit.joined_y, raster.dy, 0),
    )
    informative = n_informative(fit.model_share, stack.is_observed)
    is_explained = (worst >= TRUSTED) & ~ill_explained(fit.residuals, stack.is_observed)
    reason = reasons_from_fit(reasons_from_data(stack, FACET_IMAGES), is_explained, informative, *jumps, is_floating)
    about_anchors = [a.sentence() for a in anchors if not a.agrees]
    if settings.anchor and not anchors:
        about_anchors = [
            UNUSED.format(n=len(settings.anchor), why="the fit has no error bars (interrupted, or samples = 0)")
        ]
    assumed = f"assumed: {found.assumed}" if found.assumed else ""
    rec = Reconstruction(
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
        status="; ".join(filter(None, (fit.status, assumed))),
        warnings=(*about_anchors, *warnings_of(fit)),
        provenance={
            "stack": dict(stack.provenance),
            "reconstruct": settings.model_dump(mode="json"),
            "height_changes_um": list(fit.changes),
            "contraction": fit.contraction,
            "sensitivity": sensitivity(fit),
            "instrument": describe_instrument(fit),
            "chi_square": fit.chi_square,
            "assumed": found.assumed,
            "readout_priors": priors_of(fit),
            "geometry_score": fit.geometry_score and fit.geometry_score.as_record(),
            "anchors": as_records(anchors),
        },
    )
    return _Refined(rec, partial(misfit_of_state, fit.problem, fit.state), used, region, fit.problem.off_substrate)
