"""From micrographs to heights: calibration where it is missing, prediction, test of the result; one scan or several."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from helio_jax.alignment.rigid import Rigid
from helio_jax.arguments import checked
from helio_jax.calibration.border import CalibrateSettings, calibrate_on_border
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.methods import check_images, reconstruct_stack
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import Predict
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction, end_if_interrupted
from helio_jax.workflows.calibrate_rotated import calibrate_rotated
from helio_jax.workflows.corrections import make_predictor
from helio_jax.workflows.provenance import this_run
from helio_jax.workflows.several_scans import JoinedScans, Motions, join_scans, merged_heights, stage_motions

if TYPE_CHECKING:
    from helio_jax.inverse.fit import Fit

VERDICT_PATHS = 400_000
"""Paths of the multiple scattering by which a finished height map is tested against its data."""
MAX_FITS = 6
"""Largest number of fits between which the images of several beams are read anew on the fitted surface."""
FITTED = 0.1
"""They end where the places change by less than this, root mean square [pixels]."""
Report = Callable[[int, int, str], None]
Predictor = Callable[[MicrographStack], Predict]


def calibrate(stack: MicrographStack, settings: CalibrateSettings | None = None, **changes: Any) -> MicrographStack:
    """Bring a measured stack into units of the beam by its flat border.

    Args:
        stack: measured counts.
        settings: default: the defaults of `CalibrateSettings`.
        changes: settings that replace those, e.g. drift=False.

    Raises:
        SceneError: the stack is calibrated already, its beam is known (simulated), or its dwell times differ.
        GuardError: a detector has no signal.
    """
    if stack.n_rays is not None:
        raise SceneError(
            f"{stack.name}: this stack is in units of a known beam ({stack.n_rays:g} atoms): it is simulated or "
            "calibrated already; calibrate the imported file itself"
        )
    if stack.dwell_map is not None:
        raise SceneError(
            f"{stack.name}: pixels of different dwell times have no common noise and drift: calibrate the scans that "
            "it was added from, then add them"
        )
    return calibrate_on_border(
        stack, substrate_signal(Optics.of(stack.instrument)), (settings or CalibrateSettings()).changed(**changes)
    )


_LIMITS = "robust_limits", "jump_limits"
"""Two settings of one schedule, of the same length: a user who sets one of them sets both."""


def _with_priors(settings: ReconstructSettings, stack: MicrographStack, changes: dict[str, Any]) -> dict[str, Any]:
    """Add the priors of the stack's calibration to changes of the settings, except where the user has set them."""
    given = dict(changes.get("refine", {}))
    priors = {} if stack.calibration is None else stack.calibration.priors
    taken = settings.refine.model_fields_set | given.keys()
    if taken & set(_LIMITS):
        taken |= set(_LIMITS)
    added = {key: value for key, value in priors.items() if key not in taken}
    if not added and not given:
        return changes
    return changes | {"refine": settings.refine.model_dump() | added | given}


@checked
def reconstruct(
    stack: MicrographStack | MicrographSet,
    method: str | None = None,
    *,
    settings: ReconstructSettings | None = None,
    motions: Motions = "stage",
    report: Report | None = None,
    workers: int | None = None,
    **changes: Any,
) -> Reconstruction:
    """Turn micrographs into heights.

    Args:
        stack: three or more images on one raster; or a set of scans of one sample, with three or more images in all,
            from which one surface is made (`reconstruct_scans`).
        method: "linear", "nearfield" or "refine"; default: the settings' own.
        settings: table [reconstruct]; default: its defaults.
        motions: of the sample between the scans of a set: as the "stage" states them, or "fitted" from there on.
        report: called before each round of the refinement with (round, rounds, what is known).
        workers: threads that trace; default: one per CPU that this process may use.
        changes: settings that replace those, e.g. integrator="dct_poisson".

    Raises:
        GuardError: too few images; the linear method, where the beams of several scans are oblique.
        InputFileError: a list of positions; scans that must be aligned or calibrated first.

    Example:
        >>> hx.reconstruct(stack, "nearfield").height
    """
    if len(stack.stacks) > 1:
        how: dict[str, Any] = {"settings": settings, "motions": motions, "report": report, "workers": workers}
        return reconstruct_scans(MicrographSet(stack.stacks), method, **how, **changes)[0]
    wanted = changes | ({"method": method} if method else {})
    settings = settings or ReconstructSettings()
    one = stack.only()
    if one.positions is not None:
        raise InputFileError(
            f"{one.name}: heights need a raster, this scan is a list of {len(one.positions)} positions"
        )
    if one.noise == "measured" and one.n_rays is None:
        is_fit = wanted.get("method", settings.method) == "refine"
        one = calibrate(one) if one.alignment is None else calibrate_rotated(one, keeps_multiple=is_fit)
    chosen = settings.changed(**_with_priors(settings, one, wanted))
    return _Reconstructing(chosen, workers).finish(one, report)


@checked
def reconstruct_scans(
    scans: MicrographSet,
    method: str | None = None,
    *,
    settings: ReconstructSettings | None = None,
    motions: Motions = "stage",
    report: Report | None = None,
    workers: int | None = None,
    **changes: Any,
) -> tuple[Reconstruction, JoinedScans]:
    """Make one surface of several scans of a sample, rotated between them: what one beam does not see others do.

    Heights belong to x, y of the sample frame, seen straight down (the frame of an unrotated sample). With oblique
    beams images are read anew on every fitted surface until their places stay (`join_scans`).

    Args:
        scans: two or more, of one plate at one distance; simulated or calibrated, then with priors of one kind.
        method, settings, motions, report, workers, changes: as in `reconstruct`.

    Returns:
        The heights, and the scans as they were joined at the end; `stack` holds the images that the heights explain.

    Raises:
        GuardError: too few images; the linear method, where beams are oblique.
        InputFileError: measured scans that are not aligned (normal incidence) or not calibrated; other distances.

    Example:
        >>> hx.reconstruct_scans(hx.MicrographSet((first, second))).height
    """
    wanted = changes | ({"method": method} if method else {})
    settings = settings or ReconstructSettings()
    chosen = settings.changed(**_with_priors(settings, scans.stacks[0], wanted))
    joined, work = _joined(scans, chosen, motions, report, workers)
    rec = work.finish(joined.stack, report)
    return replace(rec, warnings=(*rec.warnings, *joined.warnings)), joined


def fit_scans(
    scans: MicrographSet,
    *,
    settings: ReconstructSettings | None = None,
    joins: bool = False,
    report: Report | None = None,
    workers: int | None = None,
) -> "tuple[Fit, MicrographStack, tuple[Rigid, ...], Predictor]":
    """Fit the heights of scans, without error bars or a test, for what follows from the fit itself.

    Args:
        scans: one of three or more images, or several as in `reconstruct_scans`; simulated or calibrated.
        settings: table [reconstruct]; the method is `refine`.
        joins: whether a single scan is brought into the frame of the unrotated sample, too, as several are.
        report, workers: as in `reconstruct`.

    Returns:
        The fit, the stack that it explains, the motions of the scans from its frame (empty: the scan's own frame), and
        what makes predictions for stacks of the same sample.

    Raises:
        GuardError, InputFileError, SceneError: as `reconstruct_scans`.
    """
    settings, first = settings or ReconstructSettings(), scans.stacks[0]
    chosen = settings.changed(**_with_priors(settings, first, {"method": "refine"}))
    if len(scans.stacks) > 1:
        joined, work = _joined(scans, chosen, "stage", report, workers)
        return work.fitted(joined.stack, report), joined.stack, joined.motions, work.predict
    work = _Reconstructing(chosen, workers)
    if not joins:
        return work.fitted(first, report), first, (), work.predict
    motions, height = stage_motions(scans), None
    if scans.is_oblique:
        height = merged_heights(scans, motions, lambda scan: work.fit(scan, report))
    stack = JoinedScans.at(scans, motions, (0.0,), height).stack
    return work.fitted(stack, report), stack, motions, work.predict


def _joined(
    scans: MicrographSet, chosen: ReconstructSettings, motions: Motions, report: Report | None, workers: int | None
) -> "tuple[JoinedScans, _Reconstructing]":
    """Join scans on the surface that is fitted to them; return what reconstructs, too."""
    for scan in scans.stacks:
        if scan.noise == "measured" and not scans.is_oblique:
            scans.only()  # says that they must be aligned
        if scan.noise == "measured" and scan.n_rays is None:
            raise InputFileError(f"{scan.name}: calibrate measured scans before they are joined (helio calibrate)")
    if scans.is_oblique and chosen.method == "linear":
        tilt = max(s.instrument.beam.incidence_deg for s in scans.stacks)
        raise GuardError(
            "method 'linear' takes a pixel for one point of the sample in all images, which holds for rotations about "
            "the beam; these samples were rotated about the plate's normal under a beam at "
            f"{tilt:g} deg, where heights move pixels: use method nearfield or refine"
        )
    say = (lambda text: report(0, MAX_FITS, text)) if report else (lambda text: None)
    joined = join_scans(scans, chosen, motions=motions, say=say)
    work = _Reconstructing(chosen, workers)
    if scans.is_oblique and chosen.method == "refine":
        if all(s.shape[0] >= MIN_IMAGES for s in scans.stacks):  # each fitted alone shows depth jumps, too
            joined = joined.on(merged_heights(joined.scans, joined.motions, lambda s: work.fit(s, report)))
        for _ in range(1, MAX_FITS):
            joined = joined.on(work.fit(joined.stack, report).height)
            if joined.change < FITTED:
                break
    return joined, work


@dataclass(frozen=True)
class _Reconstructing:
    """How stacks become heights: settings, and threads that trace."""

    settings: ReconstructSettings
    workers: int | None

    def fit(self, stack: MicrographStack, report: Report | None) -> Reconstruction:
        """Reconstruct without error bars or a test of the result; an interrupt ends it."""
        refine = self.settings.refine.model_copy(update={"samples": 0})
        quick = self.settings.model_copy(update={"refine": refine})
        rec = reconstruct_stack(stack, quick, self._make_predict(stack), report, start=stack.parallax_height)
        end_if_interrupted(rec.status)
        return rec

    def fitted(self, stack: MicrographStack, report: Report | None) -> "Fit":
        """Fit the heights without error bars."""
        from helio_jax.inverse.explanations import explain

        check_images(stack)
        return explain(stack, self.settings, self._make_predict(stack), report, stack.parallax_height).fit

    def predict(self, stack: MicrographStack) -> Predict:
        """Return what predicts the masks and the multiple scattering of a stack."""
        return self._make_predict(stack)(self.settings.refine.paths(stack.counts[0].size))

    def finish(self, stack: MicrographStack, report: Report | None) -> Reconstruction:
        """Reconstruct with error bars, and test the result against the data."""
        known = {"border": self.settings.border, "workers": self.workers, "masks_by": "rays"}
        trace = make_predictor(stack, VERDICT_PATHS, self.settings.refine.substrate_um, **known)
        make_predict = self._make_predict(stack)
        rec = reconstruct_stack(stack, self.settings, make_predict, report, trace, stack.parallax_height)
        of_calibration = () if stack.calibration is None else stack.calibration.warnings
        warnings = (*rec.warnings, *of_calibration, *_law_warnings(stack, self.settings))
        return replace(rec, provenance={**rec.provenance, **this_run()}, warnings=warnings)

    def _make_predict(self, stack: MicrographStack) -> Callable[[int], Predict]:
        refine = self.settings.refine

        def make_predict(n_rays: int) -> Predict:
            about = {"multiple": refine.multiple, "border": self.settings.border, "workers": self.workers}
            return make_predictor(stack, n_rays, refine.substrate_um, **about)

        return make_predict


def _law_warnings(stack: MicrographStack, settings: ReconstructSettings) -> list[str]:
    """List where heights assume another scattering law than that of the sample or of the instrument file."""
    refine, stated, out = settings.refine, stack.instrument.law, []
    is_fit = settings.method == "refine"
    assumed = refine.law_of_fit(stated is not None) if is_fit else "cosine"
    if stated is not None and refine.law == "as_stated" and not is_fit:
        out.append(
            f"{settings.method} assumes the cosine law, the instrument states cos^{1.0 + stated.exponent:.2f}: "
            "steep slopes are off; refine takes it into account"
        )
    others = [f"{name} ({kind})" for name, kind in stack.materials.items() if kind not in ("cosine", assumed)]
    if others:
        out.append(f"NOT the {assumed.replace('_', ' ')} law, which heights assume, holds for {', '.join(others)}")
    return out
