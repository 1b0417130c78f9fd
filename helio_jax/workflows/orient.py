"""Orientation of a file's arrays and detector of each image, found by fits or stated by the user.

Stack of unknown orientation -> candidates (eight orientations times the orders of the images) -> quick near-field fits
on a binned stack, the best few again with masking and multiple scattering -> ranking -> the corrected stack, or a
refusal. The cost is the misfit of one surface to all images (inverse/consistency). No fit distinguishes two cases:

* Where an orientation maps the instrument onto itself, a stack and its turned copy have the same images: a tie. A tie
  by a turn is harmless: the heights are turned as a whole. A tie by a mirror gives the heights of the sample's mirror
  image: the user must state the handedness of the file.
* A turn by 180 deg with every image kept reverses all slopes: hollows for hills. In the far field it fits as well, so
  low relief far from the plate is refused.

The images must have one common gain, or a flat border from which `calibrate` finds it.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from helio_jax.alignment.orientation import (
    ALL_TURNS,
    MAX_PERMUTED,
    Candidate,
    bin_stack,
    group_ties,
    orders_tried,
    turn_stack,
)
from helio_jax.arrays import as_json
from helio_jax.errors import GuardError, InputFileError, PredictionError, SceneError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.instrument import Instrument
from helio_jax.inverse.consistency import degrees_of_freedom, misfit
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings
from helio_jax.workflows import pipeline
from helio_jax.workflows.corrections import make_predictor

NOISE_LIMIT = 5.0
"""Least margin, in standard deviations of the cost."""
_RAYS = 60_000
"""Paths of each prediction of masking and multiple scattering."""


class OrientSettings(Settings):
    """Candidates, effort, and limit beyond which the result is refused."""

    turn_deg: Literal[0, 90, 180, 270] | None = None
    """Counter-clockwise turn of the images, after the mirror; default: all four are tried."""
    mirror: bool | None = None
    """Whether x is reversed; default: both are tried."""
    detectors: tuple[str, ...] | None = None
    """Detector of each image of the file, in the file's order; default: the orders are tried."""
    min_margin: float = Field(default=0.2, ge=0.0, le=100.0)
    """Least relative excess of the next candidate's cost over the winner's, ties excluded."""
    max_pixels: int = Field(default=48, ge=12, le=400)
    """Longest side of the binned images."""
    rounds: int = Field(default=3, ge=1, le=20)
    """Iterations of the near-field fits."""
    finalists: int = Field(default=4, ge=2, le=1000)
    """Number of candidates that are fitted again with masking and multiple scattering, and the reverse of the best."""


@dataclass(frozen=True)
class Entry:
    """Candidates that the instrument's symmetry makes equivalent, and their cost (pure noise: 1 to 1.5).

    Attributes:
        ties: the candidates, the one that changes least first.
        quick: cost without masking and multiple scattering (chi-square per degree of freedom).
        full: cost with them, of the finalists; else NaN.
    """

    ties: tuple[Candidate, ...]
    quick: float
    full: float = math.nan


@dataclass(frozen=True)
class Ranking:
    """Result of the search, the best entry first.

    Attributes:
        stack: the stack as read.
        entries: finalists by their full cost, then the others by their quick cost.
        limit: least margin.
        settings: of the search.
        notes: candidates that were not tried.
    """

    stack: MicrographStack
    entries: tuple[Entry, ...]
    limit: float
    settings: OrientSettings
    notes: tuple[str, ...] = ()

    @property
    def winner(self) -> Candidate:
        """The best candidate; of ties, the one that changes least."""
        return self.entries[0].ties[0]

    @property
    def rival(self) -> Entry | None:
        """The entry of least margin to the winner; None where there is no other."""
        return min(self.entries[1:], key=self._margin_to, default=None)

    @property
    def margin(self) -> float:
        """Relative excess of the rival's cost over the winner's; infinite without a rival.

        Of the full costs; of the quick ones where the rival has no full cost: it was no finalist, or its surface could
        not be traced from, which does not disprove it.
        """
        return math.inf if self.rival is None else self._margin_to(self.rival)

    def _margin_to(self, other: Entry) -> float:
        first = self.entries[0]
        if not math.isfinite(first.full):
            return 0.0
        a, b = (first.full, other.full) if math.isfinite(other.full) else (first.quick, other.quick)
        return b / a - 1.0 if a > 0 else math.inf

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons to refuse the winner; empty where there is none."""
        out, best = [], self.entries[0]
        mirrored = next((c for c in best.ties if c.turn.mirror != self.winner.turn.mirror), None)
        if mirrored:
            out.append(
                f"the instrument is its own mirror image, so '{self._label(self.winner)}' and "
                f"'{self._label(mirrored)}' fit alike and give heights that are mirror images of one another: state "
                "the handedness of the file by --mirror or --no-mirror"
            )
        rival = self.rival
        if rival is None or self.margin >= self.limit:
            return tuple(out)
        why = "the relief is too low or too regular, or the images are too noisy"
        if not math.isfinite(self.entries[0].full):
            why = "all surfaces found are too rough or steep to predict masking and multiple scattering"
        if self.winner.reversed in rival.ties:
            why = "the rival has all slopes reversed, hollows for hills; low relief or a far plate do not exclude it"
        out.append(
            f"the cost of '{self._label(rival.ties[0])}' exceeds that of the best, '{self._label(self.winner)}', by "
            f"{self.margin:.1%} only, the limit is {self.limit:.0%} (min_margin, noise); {why}: state the known part "
            "by --turn, --mirror or --no-mirror, --detectors"
        )
        return tuple(out)

    def _label(self, candidate: Candidate) -> str:
        return f"{candidate.turn}, {','.join(candidate.names(self.stack.instrument))}"

    def table(self, n: int = 6) -> list[str]:
        """Format the best few as lines of text: costs are chi-squares per degree of freedom."""
        lines = [f"  {'turn':>4} {'mirror':>6} {'quick fit':>11} {'full fit':>9}  detector of each image"]
        for e in self.entries[:n]:
            full = f"{e.full:>9.4g}" if math.isfinite(e.full) else f"{'':>9}"
            for k, c in enumerate(e.ties):
                cost = f"{e.quick:>11.4g} {full}" if k == 0 else f"{'the same':>21}"
                names = ",".join(c.names(self.stack.instrument))
                lines.append(f"  {c.turn.turn_deg:>4} {'yes' if c.turn.mirror else 'no':>6} {cost}  {names}")
        return lines + ([f"  ... and {len(self.entries) - n} more"] if len(self.entries) > n else [])

    def summary(self) -> list[str]:
        """Format the result as lines of text: the best few, the winner and its margin, what was not tried."""
        if len(self.entries) == 1 and math.isnan(self.entries[0].quick):
            return [f"stated by the user: {self._label(self.winner)}"]
        n = len(self.entries[0].ties) - 1
        ties = f"; {n} tie(s) by the instrument's symmetry: the sample turned or mirrored as a whole" if n else ""
        best = f"best: {self._label(self.winner)}; margin {self.margin:.1%}, limit {self.limit:.0%}{ties}"
        return [*self.table(), best, *self.notes]

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record: the winner, its margin, and the best few."""
        instrument = self.stack.instrument
        ties = [[c.as_dict(instrument) for c in e.ties] for e in self.entries[:6]]
        best = [{"quick": e.quick, "full": e.full, "ties": t} for e, t in zip(self.entries, ties, strict=False)]
        about = {"margin": self.margin, "limit": self.limit, "problems": list(self.problems)}
        about |= {"notes": list(self.notes), "settings": self.settings.model_dump(mode="json")}
        return as_json({**self.winner.as_dict(instrument), **about, "best": best})

    def applied(self) -> MicrographStack:
        """Correct the stack by the winner; the record goes to `provenance["orient"]`.

        Raises:
            GuardError: there are reasons to refuse the winner.
        """
        if self.problems:
            raise GuardError(f"{self.stack.name}: the orientation is refused: " + "; ".join(self.problems))
        turned = turn_stack(self.stack, self.winner.turn, self.winner.order)
        return turned.replace(provenance={**self.stack.provenance, "orient": self.as_dict()})


def find_orientation(
    stack: MicrographStack,
    settings: OrientSettings = OrientSettings(),
    report: Callable[[int, int, str], None] | None = None,
) -> Ranking:
    """Rank the candidates that the settings allow; a single candidate is not fitted.

    Args:
        stack: a raster scan with three or more detectors, measured or simulated.
        settings: known parts of the orientation, and effort.
        report: called with (fits done, number of fits, "").

    Raises:
        GuardError: too few images for a fit; a measured detector has no signal.
        InputFileError: no raster, or calibrated or aligned already.
        SceneError: `detectors` does not name each detector once.
    """
    turn_stack(stack, ALL_TURNS[0], tuple(range(stack.shape[0])))  # refuses what is no raster
    _check_unfinished(stack)
    candidates, notes = _candidates(stack.instrument, settings)
    if len(candidates) == 1:
        return Ranking(stack, (Entry(tuple(candidates), math.nan),), settings.min_margin, settings)
    if stack.shape[0] < MIN_IMAGES:
        raise GuardError(
            f"{stack.name}: an orientation is found from {MIN_IMAGES} or more images of one scan, got "
            f"{stack.shape[0]}: state --turn, --mirror or --no-mirror, and --detectors"
        )
    scaled, flat = _calibrated(stack)
    binned = bin_stack(scaled, settings.max_pixels)
    groups = group_ties(candidates, stack.instrument)
    dof = degrees_of_freedom(binned)
    if dof == 0:
        raise GuardError(
            f"{stack.name}: no pixel is recorded in {MIN_IMAGES} images, so no fit finds their orientation: "
            "state --turn, --mirror or --no-mirror, and --detectors"
        )
    trial = _Trial(binned, flat, settings)
    done, n_fits = itertools.count(), len(groups) + min(settings.finalists, len(groups)) + 1

    def fitted(fit: Callable[[Candidate], float], ties: tuple[Candidate, ...]) -> float:
        if report:
            report(next(done), n_fits, "")
        return fit(ties[0])

    entries = sorted((Entry(ties, fitted(trial.quick, ties)) for ties in groups), key=lambda e: e.quick)
    reverse = entries[0].ties[0].reversed
    chosen = [e for k, e in enumerate(entries) if k < settings.finalists or reverse in e.ties]
    full = sorted((replace(e, full=fitted(trial.full, e.ties)) for e in chosen), key=lambda e: e.full)
    rest = [e for e in entries if e not in chosen]
    limit = max(settings.min_margin, NOISE_LIMIT * math.sqrt(2.0 / dof))
    return Ranking(stack, (*full, *rest), limit, settings, notes)


class _Trial:
    """Fits of one binned stack in units of the beam, in the orientation and order of a candidate."""

    def __init__(self, stack: MicrographStack, flat: np.ndarray | None, settings: OrientSettings) -> None:
        self.stack, self.flat, self.settings = stack, flat, settings
        self.optics = Optics.of(stack.instrument)

    def _arranged(self, candidate: Candidate) -> MicrographStack:
        stack = turn_stack(self.stack, candidate.turn, candidate.order)
        if self.flat is None:
            return stack
        scale = (self.flat / self.flat[list(candidate.order)])[:, None, None]
        return stack.scaled(scale)

    def quick(self, candidate: Candidate) -> float:
        """Compute the cost without masking and multiple scattering."""
        how = ReconstructSettings(method="nearfield", integrator="dct_poisson", rounds=self.settings.rounds)
        return misfit(self._arranged(candidate), self.optics, how)

    def full(self, candidate: Candidate) -> float:
        """Compute the cost with depth jumps, masking and multiple scattering; infinite where they are not predicted."""
        how = ReconstructSettings(method="nearfield", integrator="weighted", rounds=self.settings.rounds)
        stack = self._arranged(candidate)
        try:
            return misfit(stack, self.optics, how, make_predictor(stack, _RAYS))
        except PredictionError:  # the surface is too rough or steep to be traced from
            return math.inf


def _candidates(instrument: Instrument, settings: OrientSettings) -> tuple[list[Candidate], tuple[str, ...]]:
    """List the candidates that the settings allow, the least change first, and notes on what is not tried."""
    names, notes = instrument.detector_names, ()
    if settings.detectors is not None:
        if sorted(settings.detectors) != sorted(names):
            raise SceneError(
                f"detectors must name the detector of each image once, {', '.join(names)} in the file's order, got "
                f"{', '.join(settings.detectors)}"
            )
        orders = [tuple(settings.detectors.index(name) for name in names)]
    else:
        orders, is_all = orders_tried(instrument)
        notes = () if is_all else (_note(len(names), len(orders)),)
    turns = [
        t
        for t in ALL_TURNS
        if settings.turn_deg in (None, t.turn_deg) and (settings.mirror is None or settings.mirror == t.mirror)
    ]
    return sorted((Candidate(t, o) for t in turns for o in orders), key=lambda c: (c.change, c.order)), notes


def _note(n: int, tried: int) -> str:
    return (
        f"of the orders of {n} images only the {tried} that keep neighbours around the ring neighbours were tried "
        f"(all of them up to {MAX_PERMUTED} detectors); others: --detectors"
    )


def _check_unfinished(stack: MicrographStack) -> None:
    """Refuse stacks that are scaled or aligned by an orientation already: their images belong to their detectors."""
    for record, what, command in (
        (stack.calibration, "calibrated", "calibrate"),
        (stack.alignment, "aligned", "align"),
    ):
        if record is not None:
            raise InputFileError(f"{stack.name}: this scan is {what}: orient the imported one, before helio {command}")


def _calibrated(stack: MicrographStack) -> tuple[MicrographStack, np.ndarray | None]:
    """Scale a measured stack to units of the beam; also return the substrate's signal used [detector]."""
    if stack.noise != "measured":
        return stack, None
    return pipeline.calibrate(stack), substrate_signal(Optics.of(stack.instrument))
