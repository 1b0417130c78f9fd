"""Settings that are given, left open, or go together."""

import re

import pytest

from helio_jax.commands.app import set_options
from helio_jax.errors import SceneError
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.measure.spectrum import RippleSettings
from helio_jax.micrograph import Calibration
from helio_jax.spelling import did_you_mean
from helio_jax.workflows.calibrate_rotated import _JUMPS
from helio_jax.workflows.heights import _with_priors
from helio_jax.workflows.measure import Wanted, _settings


def test_what_nobody_set_stays_open():
    """Catches a change of one setting that makes all others count as given: a calibration's priors lose their say."""
    settings = ReconstructSettings().changed(border="free")
    assert settings.model_fields_set == {"border"} and not settings.refine.model_fields_set


@pytest.mark.parametrize("way", ["file", "call"])
def test_limits_go_together(way):
    """Who gives one list of limits keeps the other: a calibration's has another length. Catches an error about it."""
    own = {"robust_limits": (9.0, 9.0, 7.0)}
    settings = ReconstructSettings(refine=own if way == "file" else {})
    changes = {"refine": own} if way == "call" else {}

    class Stack:
        """What is asked of a stack."""

        calibration = Calibration("constant_albedo", dict(_JUMPS) | {"max_rounds": 12})

    chosen = settings.changed(**_with_priors(settings, Stack(), changes)).refine  # type: ignore[arg-type]
    assert chosen.robust_limits == own["robust_limits"] and len(chosen.jump_limits) == 3 and chosen.max_rounds == 12


def test_options_by_their_keys():
    """Catches a key given twice, which ended in a TypeError, and an item without a value, which became an empty one."""
    assert set_options(["a=1", "b=x=y"], c=2, d=None) == {"a": "1", "b": "x=y", "c": 2}
    assert set_options(None) == {}
    for items in (["a"], ["=1"], ["a=1", "a=2"], ["c=1"]):
        with pytest.raises(SceneError, match="--set"):
            set_options(items, c=2)


def test_settings_of_a_measurement():
    """Each goes to what has it; one that nothing wanted has is refused. Catches remedies that cannot be followed."""
    wanted = Wanted(facets=True, cracks=True, settings={"max_turn_deg": "20", "min_pixels": 9})
    how = _settings(wanted)
    assert how["facets"].max_turn_deg == 20.0 and how["facets"].min_pixels == 9 and how["ripple"] == RippleSettings()
    with pytest.raises(SceneError, match="along_axes: the requested measurements have no such setting"):
        _settings(wanted._replace(settings={"along_axes": "true"}))
    assert _settings(Wanted(ripple=True, settings={"along_axes": "true"}))["ripple"].along_axes


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"metod": "linear"}, "metod: there is no such setting: did you mean 'method'?"),
        ({"refine": {"max_round": 2}}, "refine.max_round: there is no such setting: did you mean 'max_rounds'?"),
        ({"max_rounds": 2}, "belongs to 'refine': give it as refine={'max_rounds': 2}"),
        ({"zzz": 1}, "known are method"),
    ],
)
def test_misspelt_settings(changes, told):
    """Catches pydantic's wording, a nearest name taken from the wrong table, and no word on what is known."""
    with pytest.raises(SceneError, match=re.escape(told)):
        ReconstructSettings().changed(**changes)


def test_units_are_no_likeness():
    """Catches a key that is proposed because it ends in a unit, too."""
    assert did_you_mean("diameter_mm", ["center_um", "axes_um"]) is None
    assert did_you_mean("radius_mm", ["center_um", "radius_um"]) == "did you mean 'radius_um'?"
