"""Which of several instruments is kept, and what the error bars contain of the others: by fits of known misfits."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse import instrument_choice
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.instrument_choice import TRIED, UNDECIDED, InstrumentChoice, least_misfit
from helio_jax.inverse.parameters import NAMES, Parameters

ORIGIN = Parameters(**{name: np.zeros(2) for name in NAMES})


class Score(NamedTuple):
    """What the test of a geometry says."""

    is_likely: bool
    values: dict = {"polar of left": (3.0, 0.1, "deg")}
    parameters: Parameters = ORIGIN.replaced(offset=np.ones(2), log_gain=np.ones(2))


LIKELY, UNLIKELY = Score(True), Score(False)
WIDE = {"offset": 4.0}


@dataclass(frozen=True, eq=False)
class Known:
    """A fit of a known misfit and height; `score`: what the test of its geometry says."""

    name: str
    misfit: float
    height: float = 0.0
    score: Score = UNLIKELY
    is_geometry_fitted: bool = False
    prior_widths: Mapping[str, float] = field(default_factory=dict)
    geometry_score: Score | None = None
    rival_change: np.ndarray | None = None
    status: str = ""
    is_interrupted: bool = False
    is_at_rest: bool = True
    patches: AlbedoPatches = field(default_factory=lambda: AlbedoPatches.none((2, 2)))

    @property
    def surface(self) -> Surface:
        return Surface(*np.full((3, 2, 2), self.height))

    @property
    def state(self) -> str:
        return self.name

    @property
    def problem(self) -> SimpleNamespace:
        return SimpleNamespace(patches=self.patches)


@pytest.fixture(autouse=True)
def _known(monkeypatch):
    monkeypatch.setattr(instrument_choice, "total_misfit", lambda fit: fit.misfit)
    monkeypatch.setattr(instrument_choice, "is_plausible", lambda fit: True)
    monkeypatch.setattr(instrument_choice, "is_at_rest", lambda fit: fit.is_at_rest)
    monkeypatch.setattr(instrument_choice, "score_geometry", lambda fit: fit.score if fit.is_at_rest else 1 / 0)


STATED = Known("stated", 100.0, 1.0, LIKELY)
GEOMETRY = Known("geometry", 90.0, 3.0, is_geometry_fitted=True)
READOUT = Known("readout", 95.0, 7.0, prior_widths=WIDE)
DOUBTFUL = replace(READOUT, score=LIKELY, geometry_score=LIKELY)


@pytest.mark.parametrize(
    ("fits", "kept", "change"),
    [
        ([STATED], "stated", None),
        ([STATED, replace(GEOMETRY, misfit=98.0)], "stated", 2.0),
        ([STATED, GEOMETRY], "geometry", -2.0),
        ([STATED, replace(GEOMETRY, misfit=100.0 - UNDECIDED)], "geometry", None),
        ([STATED, GEOMETRY, READOUT], "readout", -6.0),
        ([STATED, replace(GEOMETRY, misfit=96.0 - UNDECIDED), READOUT], "readout", -6.0),
        ([STATED, replace(GEOMETRY, misfit=94.0 - UNDECIDED), READOUT], "geometry", None),
        ([STATED, replace(GEOMETRY, misfit=70.0), DOUBTFUL], "geometry", None),
        ([STATED, GEOMETRY, DOUBTFUL], "geometry", 4.0),
        ([STATED, replace(READOUT, misfit=101.0)], "stated", 6.0),
        ([replace(STATED, misfit=94.0), GEOMETRY, READOUT], "stated", 6.0),
        ([STATED, replace(GEOMETRY, is_at_rest=False)], "stated", 2.0),
        ([STATED, GEOMETRY, replace(READOUT, is_at_rest=False)], "geometry", 4.0),
    ],
)
def test_what_is_kept_and_what_may_be_right_as_well(fits, kept, change):
    """A geometry has to be likelier, and much more so than a read-out at which the data ask for none.

    Fits that did not converge are not kept; the error bars contain them.
    """
    found = least_misfit([(fit.misfit, fit) for fit in fits])
    assert found.name == kept
    assert (found.rival_change is None) if change is None else np.all(found.rival_change == change)


def choose(fit, readout, fits, is_explained=lambda fit: True):
    """Choose with these fits of the geometry, in this order; an exception is raised in place of a fit."""
    made = []

    def refit(of, patches, factors, start):
        posed = SimpleNamespace(stated_parameters=lambda: ORIGIN)
        made.append((of.name, max(factors.values()), float(start(posed).offset[0])))
        found = fits[len(made) - 1]
        if isinstance(found, BaseException):
            raise found
        return replace(found, is_geometry_fitted=True)

    return InstrumentChoice(refit, is_explained, lambda said: None).best_of(fit, readout), made


def test_what_is_fitted():
    """The geometry; read-out and geometry together only where the data ask for that when the read-out is fitted."""
    both = Known("both", 60.0, 4.0, prior_widths=WIDE)
    found, made = choose(replace(STATED, score=UNLIKELY), None, [])
    assert (found.name, made) == ("stated", [])
    found, made = choose(STATED, READOUT, [GEOMETRY])
    assert (found.name, made) == ("readout", [("stated", 1.0, 1.0)])
    found, made = choose(STATED, replace(READOUT, score=LIKELY), [GEOMETRY, both])
    assert (found.name, made) == ("both", [("stated", 1.0, 1.0), ("readout", 4.0, 1.0)])
    # a read-out that did not converge is not tested
    found, made = choose(STATED, replace(READOUT, misfit=80.0, is_at_rest=False), [GEOMETRY])
    assert (found.name, len(made)) == ("geometry", 1) and np.all(found.rival_change == 4.0)
    # the read-out that was kept before: its offset, in wider units, starts the fit with the stated prior
    found, made = choose(replace(READOUT, score=UNLIKELY), READOUT, [GEOMETRY])
    assert (found.name, made) == ("readout", [("readout", 1.0, 4.0)])
    found, made = choose(replace(READOUT, score=LIKELY), READOUT, [GEOMETRY, both])
    assert (found.name, [m[:2] for m in made]) == ("both", [("readout", 1.0), ("readout", 4.0)])


def test_patches_may_stand_for_a_geometry():
    """With patches of other albedos the geometry is fitted without them, too."""
    patches = AlbedoPatches(np.array([[0, 1], [0, 0]]), np.log([0.7]))
    found, made = choose(
        replace(STATED, patches=patches), None, [GEOMETRY, replace(GEOMETRY, name="with", misfit=95.0)]
    )
    assert found.name == "geometry" and len(made) == 2


def test_what_cannot_be_predicted_does_not_end_the_rest():
    """The geometry is fitted with patches, though it cannot be traced without them."""
    patches = AlbedoPatches(np.array([[0, 1], [0, 0]]), np.log([0.7]))
    found, made = choose(replace(STATED, patches=patches), None, [PredictionError("too steep"), GEOMETRY])
    assert found.name == "geometry" and len(made) == 2 and not found.is_interrupted


def test_what_the_data_contradict_is_no_rival():
    """Neither kept nor in the error bars."""
    found, _ = choose(STATED, READOUT, [GEOMETRY], lambda fit: fit.name != "readout")
    assert found.name == "geometry" and np.all(found.rival_change == -2.0)
    found, _ = choose(STATED, READOUT, [GEOMETRY], lambda fit: False)
    assert found.name == "stated" and found.rival_change is None and found.geometry_score is LIKELY


@pytest.mark.parametrize("end", [KeyboardInterrupt(), PredictionError("too steep"), "a fit that was interrupted"])
def test_a_geometry_that_was_found_is_kept(end):
    """Where the fit of its rival is interrupted, or cannot be predicted."""
    rival = replace(GEOMETRY, name="both", misfit=50.0, is_interrupted=True) if isinstance(end, str) else end
    found, made = choose(STATED, replace(READOUT, score=LIKELY), [GEOMETRY, rival])
    assert found.name == "geometry" and len(made) == 2
    is_marked = not isinstance(end, PredictionError)
    assert found.is_interrupted == is_marked and (TRIED in found.status) == is_marked
