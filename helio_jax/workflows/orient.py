"""Which way a file's arrays lie, and which image belongs to which detector: found by fits, or given by hand.

Stack of unknown orientation -> candidates (eight orientations times the orders of the images) -> quick near-field fits
on a binned stack, the best few again with masks and multiple scattering -> ranking -> the stack put right, or a
refusal. The cost is how badly one surface explains all images (inverse/consistency). What no fit can tell is said:

* Where an orientation maps the instrument onto itself, a stack and its turned copy are one set of images: a tie. It is
  harmless where it is a turn, for the heights come out turned as a whole; where it is a mirror, the heights would be
  those of the sample's mirror image, and the file's handedness must be given.
* A turn by 180 deg with every image kept reverses all slopes: hollows for hills. Far field, that fits as well; low
  relief seen from afar is refused.

The images must have one common gain, or a flat border from which `calibrate` gets it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field

from helio_jax.alignment.arrangement import MAX_PERMUTED, Candidate, group_ties, orders_tried
from helio_jax.alignment.orientation import ALL_TURNS, bin_stack, turn_stack
from helio_jax.arrays import as_json
from helio_jax.errors import GuardError, InputFileError, SceneError
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
"""The margin must exceed the chance scatter of the cost so many times."""


class OrientSettings(Settings):
    """What is tried, how, and when the result is refused."""

    turn_deg: Literal[0, 90, 180, 270] | None = None
    """Counter-clockwise turn of the images, after the mirror; default: all four are tried."""
    mirror: bool | None = None
    """Whether x is reversed; default: both are tried."""
    detectors: tuple[str, ...] | None = None
    """Detector of each image of the file, in the file's order; default: the orders are tried."""
    min_margin: float = Field(default=0.2, ge=0.0, le=100.0)
    """By what share the cost of the next candidate that is no tie must exceed the winner's."""
    max_pixels: int = Field(default=48, ge=12, le=400)
    """Longest side of the binned images."""
    rounds: int = Field(default=3, ge=1, le=20)
    """Rounds of the near-field fits."""
    finalists: int = Field(default=4, ge=2, le=1000)
    """So many of the best are fitted again with masks and multiple scattering, and the reverse of the very best."""
    rays: int = Field(default=60_000, ge=1000, le=10**8)
    """Paths of each of these predictions."""


@dataclass(frozen=True)
class Entry:
    """Candidates that are one by the instrument's symmetry, and how badly they fit (pure noise: 1 to 1.5).

    Attributes:
        ties: the candidates, the one that changes least first.
        quick: cost without masks and multiple scattering (chi-square per degree of freedom).
        full: cost with them, of the finalists; else NaN.
    """

    ties: tuple[Candidate, ...]
    quick: float
    full: float = math.nan


@dataclass(frozen=True)
class Ranking:
    """What was found, the best entry first.

    Attributes:
        stack: the stack as it was read.
        entries: finalists by their full cost, then the others by their quick one.
        limit: least margin.
        settings: what was asked for.
        notes: what was not tried.
    """

    stack: MicrographStack
    entries: tuple[Entry, ...]
    limit: float
    settings: OrientSettings
    notes: tuple[str, ...] = ()

    @property
    def winner(self) -> Candidate:
        """The best candidate; of ties the one that changes least."""
        return self.entries[0].ties[0]

    @property
    def rival(self) -> Entry | None:
        """The entry that comes closest to the winner; None where there is one only."""
        return min(self.entries[1:], key=self._margin_to, default=None)

    @property
    def margin(self) -> float:
        """By what share the rival's cost exceeds the winner's; infinite without a rival.

        The full costs; the quick ones where the rival was no finalist, or no surface that can be traced from: that
        a fit went astray is no proof against it.
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
        """Why the winner should not be taken; empty when it may be."""
        out, best = [], self.entries[0]
        mirrored = next((c for c in best.ties if c.turn.mirror != self.winner.turn.mirror), None)
        if mirrored:
            out.append(
                f"the instrument is its own mirror image, so '{self._label(self.winner)}' and "
                f"'{self._label(mirrored)}' fit alike and give heights that are mirror images of one another: give the "
                "file's handedness by --mirror or --no-mirror"
            )
        rival = self.rival
        if rival is None or self.margin >= self.limit:
            return tuple(out)
        why = "the relief is too low or too regular, or the images are too noisy"
        if not math.isfinite(self.entries[0].full):
            why = "all surfaces came out too rough or steep to predict masks and multiple scattering from"
        if self.winner.reversed in rival.ties:
            why = "the rival has all slopes reversed, hollows for hills, which low relief or a far plate leave open"
        out.append(
            f"the best, '{self._label(self.winner)}', is not told from '{self._label(rival.ties[0])}', whose cost "
            f"exceeds its own by {self.margin:.1%}, the limit is {self.limit:.0%} (min_margin, chance); {why}: give "
            "what is known by --turn, --mirror or --no-mirror, --detectors"
        )
        return tuple(out)

    def _label(self, candidate: Candidate) -> str:
        return f"{candidate.turn}, {','.join(candidate.names(self.stack.instrument))}"

    def table(self, n: int = 6) -> list[str]:
        """Return the best few as lines of text: costs are chi-squares per degree of freedom."""
        lines = [f"  {'turn':>4} {'mirror':>6} {'quick fit':>11} {'full fit':>9}  detector of each image"]
        for e in self.entries[:n]:
            full = f"{e.full:>9.4g}" if math.isfinite(e.full) else f"{'':>9}"
            for k, c in enumerate(e.ties):
                cost = f"{e.quick:>11.4g} {full}" if k == 0 else f"{'the same':>21}"
                names = ",".join(c.names(self.stack.instrument))
                lines.append(f"  {c.turn.turn_deg:>4} {'yes' if c.turn.mirror else 'no':>6} {cost}  {names}")
        return lines + ([f"  ... and {len(self.entries) - n} more"] if len(self.entries) > n else [])

    def summary(self) -> list[str]:
        """Return what to tell a person: the best few, the winner and its margin, what was not tried."""
        if len(self.entries) == 1 and math.isnan(self.entries[0].quick):
            return [f"given by hand: {self._label(self.winner)}"]
        ties = len(self.entries[0].ties) - 1
        told = f"; {ties} tie(s) by the instrument's symmetry: the sample turned or mirrored as a whole" if ties else ""
        best = f"best: {self._label(self.winner)}; margin {self.margin:.1%}, limit {self.limit:.0%}{told}"
        return [*self.table(), best, *self.notes]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record: what the winner is, how sure, and the best few."""
        instrument = self.stack.instrument
        best = [
            {"quick": e.quick, "full": e.full, "ties": [c.as_dict(instrument) for c in e.ties]}
            for e in self.entries[:6]
        ]
        about = {"margin": self.margin, "limit": self.limit, "problems": list(self.problems)}
        about |= {"notes": list(self.notes), "settings": self.settings.model_dump(mode="json")}
        return as_json({**self.winner.as_dict(instrument), **about, "best": best})

    def applied(self) -> MicrographStack:
        """Return the stack put right, with this record in `provenance["orient"]`.

        Raises:
            GuardError: the winner is not sure.
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
    """Rank the candidates that the settings leave open; where only one is left, nothing is fitted.

    Args:
        stack: a raster scan with three or more detectors, measured or simulated.
        settings: what is known, and how the rest is tried.
        report: called with (fits done, fits in all, "").

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
            f"{stack.shape[0]}: give --turn, --mirror or --no-mirror, and --detectors"
        )
    scaled, flat = _calibrated(stack)
    binned = bin_stack(scaled, settings.max_pixels)
    groups = group_ties(candidates, stack.instrument)
    dof = degrees_of_freedom(binned)
    if dof == 0:
        raise GuardError(
            f"{stack.name}: no pixel is recorded in {MIN_IMAGES} images, so that nothing tells how they lie: "
            "give --turn, --mirror or --no-mirror, and --detectors"
        )
    trial = _Trial(binned, flat, settings)
    n_full = min(settings.finalists, len(groups)) + 1
    tell = report or (lambda done, total, note: None)
    entries = []
    for k, ties in enumerate(groups):
        tell(k, len(groups) + n_full, "")
        entries.append(Entry(ties, trial.quick(ties[0])))
    entries.sort(key=lambda e: e.quick)
    chosen = entries[: settings.finalists]
    reverse = entries[0].ties[0].reversed
    chosen += [e for e in entries[settings.finalists :] if reverse in e.ties]
    full = []
    for k, e in enumerate(chosen):
        tell(len(groups) + k, len(groups) + n_full, "")
        full.append(Entry(e.ties, e.quick, trial.full(e.ties[0])))
    full.sort(key=lambda e: e.full)
    rest = [e for e in entries if e not in chosen]
    limit = max(settings.min_margin, NOISE_LIMIT * math.sqrt(2.0 / dof))
    return Ranking(stack, (*full, *rest), limit, settings, notes)


class _Trial:
    """The fits of one binned stack in units of the beam, its images dealt and turned in turn."""

    def __init__(self, stack: MicrographStack, flat: np.ndarray | None, settings: OrientSettings) -> None:
        self.stack, self.flat, self.settings = stack, flat, settings
        self.optics = Optics.of(stack.instrument)

    def _arranged(self, candidate: Candidate) -> MicrographStack:
        stack = turn_stack(self.stack, candidate.turn, candidate.order)
        if self.flat is None:
            return stack
        scale = (self.flat / self.flat[list(candidate.order)])[:, None, None]
        assert stack.variance is not None  # calibration gave it
        return stack.replace(counts=stack.counts * scale, variance=stack.variance * scale**2)

    def quick(self, candidate: Candidate) -> float:
        """Return the cost without masks and multiple scattering."""
        how = ReconstructSettings(method="nearfield", integrator="dct_poisson", rounds=self.settings.rounds)
        return misfit(self._arranged(candidate), self.optics, how)

    def full(self, candidate: Candidate) -> float:
        """Return the cost with depth jumps, masks and multiple scattering; infinite for an impossible surface."""
        how = ReconstructSettings(method="nearfield", integrator="weighted", rounds=self.settings.rounds)
        stack = self._arranged(candidate)
        try:
            return misfit(stack, self.optics, how, make_predictor(stack, self.settings.rays))
        except GuardError:  # so rough or steep that nothing can be traced from it
            return math.inf


def _candidates(instrument: Instrument, settings: OrientSettings) -> tuple[list[Candidate], tuple[str, ...]]:
    """Return what the settings leave open, the least change first, and notes on what is not tried."""
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
    """Refuse what is scaled or turned by an orientation already: its images cannot go to other detectors any more."""
    for done, what in (("calibrate", "calibrated"), ("align", "aligned")):
        if done in stack.provenance:
            raise InputFileError(f"{stack.name}: this scan is {what}: orient the imported one, before helio {done}")


def _calibrated(stack: MicrographStack) -> tuple[MicrographStack, np.ndarray | None]:
    """Return a measured stack in units of the beam, and the flat's signal per detector that it was scaled to."""
    if stack.noise != "measured":
        return stack, None
    return pipeline.calibrate(stack), pipeline.flat_signal(stack.instrument)
