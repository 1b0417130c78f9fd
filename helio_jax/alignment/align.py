"""Align scans of a rotated sample and bring them onto one raster: a set of scans -> one stack, ready for the heights.

The rotation of each scan is known roughly (the stage's), its shift is not: the axis of rotation misses the centre of
the field. Both are found from control points (control_points.py) or automatically (automatic.py, for smooth samples
albedo_prior.py); an alignment that the scans do not determine is refused with its reason. Rigid motions only: no
stretching, no drift within a scan.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from helio_jax.alignment.albedo_prior import AlbedoAlignment, align_with_albedo_prior
from helio_jax.alignment.automatic import Aligner, Match
from helio_jax.alignment.control_points import Picks, PointFit, fit_points, rms
from helio_jax.alignment.resample import check_joinable, resample
from helio_jax.alignment.rigid import Rigid
from helio_jax.alignment.views import View
from helio_jax.arrays import as_json, pitch
from helio_jax.errors import GuardError, InputFileError
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.settings import Settings

MIN_VIEWS = 4
"""Scans for the automatic alignment: a view is a combination of three others."""


class AlignSettings(Settings):
    """How scans are aligned, and limits beyond which the result is refused."""

    field: Literal["union", "reference"] = "union"
    """Raster of the result: the union of all fields, or the first scan's own."""
    max_shift_um: float | None = Field(default=None, gt=0.0, le=1e7)
    """Automatic: largest shift of the field's centre [um]; default: a quarter of the first scan's shorter side."""
    max_rotation_deg: float = Field(default=3.0, gt=0.0, le=20.0)
    """Automatic: largest error of the stage's rotation [deg]; two scans may differ by twice as much."""
    min_correlation: float = Field(default=0.2, gt=0.0, lt=1.0)
    """Automatic: least correlation of a scan's fine structure with what the others predict (linear photometry)."""
    min_margin: float = Field(default=0.15, ge=0.0, lt=1.0)
    """Automatic: fraction of its height by which that correlation must exceed the next peak, 5 or more pixels away."""
    max_std_px: float = Field(default=0.5, gt=0.0, le=10.0)
    """Automatic: largest standard deviation of a pixel's place [pixels]."""
    min_restoring: float = Field(default=0.08, ge=0.0, lt=1.0)
    """Automatic: least observability of a common displacement of all fields (`Aligner.common_shift_observability`).

    The joint error of the scans is the model's error per view, some hundredths of a pixel, over this number. Traced
    crystals, pyramids and rough surfaces have 0.2 to 0.65; balls and soft hills, whose errors are 1 to 5 pixels, 0.06
    or less: below the limit the motions are fitted with a constant-albedo prior instead (albedo_prior.py)."""
    max_albedo_spread: float = Field(default=0.1, gt=0.0, le=1.0)
    """Automatic: largest robust standard deviation of the albedo where only its constancy determines the motions."""
    max_left_out_px: float = Field(default=3.0, gt=0.0, le=100.0)
    """Control points: largest root mean square of the leave-one-out errors [pixels]."""


@dataclass(frozen=True)
class Alignment:
    """Rigid motions of all scans and their uncertainty.

    Attributes:
        names: of the scans.
        motions: from the common frame, which is the first scan's, to each scan.
        std_um: standard deviation of a pixel's place per axis, for each scan [um].
        matches: automatic: of each scan.
        common_shift_observability: automatic: see `Aligner.common_shift_observability`.
        albedo_prior: automatic: the fit with a constant-albedo prior, where that observability is too small.
        points: control points: their fit.
        problems: reasons to refuse the result; empty where there is none.
    """

    names: tuple[str, ...]
    motions: tuple[Rigid, ...]
    std_um: tuple[float, ...]
    matches: tuple[Match, ...] | None = None
    common_shift_observability: float | None = None
    albedo_prior: AlbedoAlignment | None = None
    points: PointFit | None = None
    problems: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record."""
        scans: list[dict[str, Any]] = [
            {"name": name, "rotation_deg": m.rotation_deg, "shift_um": list(m.shift), "std_um": std}
            for name, m, std in zip(self.names, self.motions, self.std_um, strict=True)
        ]
        out: dict[str, Any] = {"scans": scans, "problems": list(self.problems)}
        if self.common_shift_observability is not None:
            out["restoring"] = self.common_shift_observability
        if (a := self.albedo_prior) is not None:
            out["one_albedo"] = {"albedo_spread": a.albedo_spread, "share": a.background, "polar_deg": a.polar_deg}
        if self.matches is not None:
            for scan, match in zip(scans, self.matches, strict=True):
                scan["match"] = asdict(match)
        if self.points is not None:
            out["points"] = {
                "std_um": self.points.std_um,
                "residual_rms_um": rms(self.points.residuals),
                "left_out_rms_um": rms(self.points.left_out),
                "residuals_um": self.points.residuals,
                "left_out_um": self.points.left_out,
            }
        return as_json(out)


def align_scans(
    scans: MicrographSet,
    picks: Picks | None = None,
    settings: AlignSettings = AlignSettings(),
    source: str = "the control points",
) -> tuple[MicrographStack, Alignment]:
    """Align scans and bring them onto one raster in the frame of the first one.

    Args:
        scans: two or more, normal incidence, `sample_rotation` known to a few degrees.
        picks: control points; default: automatic alignment, which needs four or more scans.
        settings: limits and field.
        source: name of the control points' file, for messages.

    Returns:
        One stack, whose detectors are the apertures of every scan, rotated back, and the alignment.

    Raises:
        GuardError: the scans do not determine the alignment, or oblique incidence, where heights move pixels.
        InputFileError: too few scans, equal names, different instruments or calibrations, or unusable control points.
    """
    alignment = find_motions(scans, picks, settings, source)
    if alignment.problems:
        raise GuardError(
            "the alignment is refused: "
            + "; ".join(alignment.problems)
            + (": pick control points (helio pick) and give --points" if picks is None else ": check the points named")
        )
    stack = resample(scans, alignment.motions, settings.field, alignment.std_um)
    record = alignment.as_dict() | {"settings": settings.model_dump(mode="json")}
    return stack.replace(provenance={**stack.provenance, "align": record}), alignment


def find_motions(
    scans: MicrographSet,
    picks: Picks | None = None,
    settings: AlignSettings = AlignSettings(),
    source: str = "the control points",
) -> Alignment:
    """Find the motions; reasons to refuse them are in `problems`. See `align_scans`."""
    _check(scans, is_auto=picks is None)
    return _automatic(scans, settings) if picks is None else _from_points(scans, picks, settings, source)


def _check(scans: MicrographSet, is_auto: bool) -> None:
    """Refuse sets that rigid motions cannot align."""
    first, *others = scans.stacks
    names = [s.name for s in scans.stacks]
    if not others or (is_auto and len(names) < MIN_VIEWS):
        wanted = MIN_VIEWS if is_auto else 2
        hint = "give --points (helio pick makes them)" if is_auto and others else "import all of them into one file"
        raise InputFileError(f"alignment needs {wanted} or more scans, got {len(names)} ({', '.join(names)}): {hint}")
    if len(set(names)) < len(names):
        raise InputFileError(f"the scans' names must differ, got {', '.join(names)}: rename the files and import anew")
    check_joinable(scans.stacks)
    for stack in scans.stacks:
        if stack.instrument.beam.incidence_deg:
            raise GuardError(
                f"scan {stack.name!r} has an incidence of {stack.instrument.beam.incidence_deg:g} deg: rotated scans "
                "can be aligned rigidly only at 0 deg; at oblique incidence heights move pixels"
            )
        if stack.instrument.sample_distance != first.instrument.sample_distance:
            raise InputFileError(
                f"scans {first.name!r} and {stack.name!r} must have one sample distance, got "
                f"{first.instrument.sample_distance:g} and {stack.instrument.sample_distance:g} um"
            )


def _automatic(scans: MicrographSet, settings: AlignSettings) -> Alignment:
    first = scans.stacks[0]
    reach = settings.max_shift_um or 0.25 * min(np.ptp(first.x), np.ptp(first.y))
    rotations = [s.sample_rotation - first.sample_rotation for s in scans.stacks]
    aligner = Aligner(
        [View.of(s) for s in scans.stacks], rotations, float(reach), math.radians(settings.max_rotation_deg)
    )
    aligner.start_on_edges()
    start, observability = list(aligner.motions), aligner.common_shift_observability()
    if observability >= settings.min_restoring:
        aligner.run()
        observability = aligner.common_shift_observability()
    joint, problems = None, []
    if not observability >= settings.min_restoring:
        joint = align_with_albedo_prior(scans.stacks, start)
        aligner.motions = list(joint.motions)
        if not joint.albedo_spread <= settings.max_albedo_spread:
            problems.append(
                "the scans together: only a constant albedo determines a common displacement of their fields "
                f"(observability by photometry {observability:.3f}, min_restoring {settings.min_restoring:g}), and "
                f"its robust deviation must be <= {settings.max_albedo_spread:g}, got {joint.albedo_spread:.3f}"
            )
    matches = tuple(aligner.match(k) for k in range(len(scans.stacks)))
    if joint is not None:
        matches = tuple(replace(m, std_um=std) for m, std in zip(matches, joint.std_um, strict=True))
    errors = _stage_errors([m.rotation for m in aligner.motions], rotations)
    for k, (stack, match, motion) in enumerate(zip(scans.stacks, matches, aligner.motions, strict=True)):
        stage_error = math.degrees(abs(errors[k]))
        moved = math.dist(motion.apply(aligner.frame.center), aligner.views[k].center)
        checks = [
            (not match.std_um <= settings.max_std_px * aligner.frame.step, "standard deviation of its place",
             f"{match.std_um / aligner.frame.step:.2f} px", f"<= {settings.max_std_px:g} px"),
            (stage_error > settings.max_rotation_deg, "error of the stage's rotation",
             f"{stage_error:.2f} deg", f"<= {settings.max_rotation_deg:g} deg"),
            (moved > reach, "shift of its centre", f"{moved:.0f} um", f"<= {reach:g} um"),
        ]  # fmt: skip
        if joint is None:  # smooth samples have no fine structure to correlate
            checks += [
                (match.correlation < settings.min_correlation, "correlation with the prediction from the other scans",
                 f"{match.correlation:.2f}", f">= {settings.min_correlation:g}"),
                (match.margin < settings.min_margin, "margin of its peak over the next one",
                 f"{match.margin:.2f}", f">= {settings.min_margin:g}"),
                (match.offset > 1.5, "distance of that peak from the fit", f"{match.offset:.1f} px", "<= 1.5 px"),
            ]  # fmt: skip
        problems += [
            f"scan {stack.name!r}: {what} must be {limit}, got {got}" for bad, what, got, limit in checks if bad
        ]
    stds = (0.0, *(m.std_um for m in matches[1:]))
    names, motions = tuple(s.name for s in scans.stacks), tuple(aligner.motions)
    return Alignment(names, motions, stds, matches, observability, joint, problems=tuple(problems))


def _stage_errors(found: list[float], nominal: list[float]) -> np.ndarray:
    """Compute the least errors of the stage's rotations [rad] that explain the rotations found.

    Only differences between scans are known: the error that all have in common makes the largest one smallest.
    """
    apart = np.array([math.remainder(a - b, math.tau) for a, b in zip(found, nominal, strict=True)])
    return apart - 0.5 * (apart.max() + apart.min())


def _from_points(scans: MicrographSet, picks: Picks, settings: AlignSettings, source: str) -> Alignment:
    names = tuple(s.name for s in scans.stacks)
    _check_in_field(scans, picks, source)
    fit = fit_points(picks, names, source)
    step = pitch(scans.stacks[0].x)
    left_out = rms(fit.left_out) / step
    problems = []
    if not left_out <= settings.max_left_out_px:
        worst = max(
            ((e, v, p) for v, named in fit.left_out.items() for p, e in named.items() if math.isfinite(e)),
            default=(math.nan, "?", "?"),
        )
        problems.append(
            f"{source}: the leave-one-out error must be <= {settings.max_left_out_px:g} px, got {left_out:.2f} px "
            f"(worst: point {worst[2]!r} in {worst[1]!r}, {worst[0] / step:.1f} px)"
        )
    # a rigid motion has 3 unknowns for 2 n coordinates: mean square displacement per axis over the points
    stds = tuple(
        0.0 if k == 0 else fit.std_um * math.sqrt(1.5 / len(fit.residuals[v]) + 1.5 / len(fit.residuals[names[0]]))
        for k, v in enumerate(names)
    )
    return Alignment(names, fit.motions, stds, points=fit, problems=tuple(problems))


def _check_in_field(scans: MicrographSet, picks: Mapping, source: str) -> None:
    """Refuse points outside their scan: they have another unit or belong to another file."""
    for stack in scans.stacks:
        for point, (x, y) in picks.get(stack.name, {}).items():
            for axis, value, own in (("x", x, stack.x), ("y", y, stack.y)):
                if not own[0] - pitch(own) <= value <= own[-1] + pitch(own):
                    raise InputFileError(
                        f"{source}: point {point!r} of {stack.name!r} has {axis} = {value:g} um, outside the scan "
                        f"({own[0]:g} to {own[-1]:g} um): give beam positions in um"
                    )
