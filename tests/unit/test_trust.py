"""One word for trust: the rule of `is_valid` in words and in code, warnings, verdicts, and where they stand."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from sphere_case import make_case
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from helio_jax.commands.app import app
from helio_jax.figures.height_page import draw_reconstruction
from helio_jax.figures.notebook import as_html
from helio_jax.figures.report import write_report
from helio_jax.figures.trust import BAD, CARE, GOOD, discrepancy_text, error_sources, limits, verdict
from helio_jax.formats.hdf5 import read, write
from helio_jax.inverse import quality
from helio_jax.inverse import verdict as judge
from helio_jax.validity import CONTRADICTED, MEANINGS, NONE_VALID, REASONS, VALID_RULE

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def tested():
    """A reconstruction that its data have tested and found right."""
    _, rec, _ = make_case(41, 45, pitch=80.0)
    return rec.replace(chi_square=np.ones(rec.height.shape), height_std=np.full(rec.height.shape, 4.0))


def contradicted(rec):
    reason = np.where(np.arange(rec.height.size).reshape(rec.height.shape) % 4, rec.reason, 6)
    return rec.replace(reason=reason, is_valid=reason == 0)


def helio(*words):
    found = CliRunner().invoke(app, [str(w) for w in words])
    assert found.exit_code == 0, found.output
    return found


def test_the_rule_in_words_has_the_limits_of_the_code():
    """The constants that the code compares with are those that the words name. Catches a second constant, a limit that
    is changed in the code alone, a reason without a meaning, and a page that explains another rule."""
    assert f"above {quality.EXPLAINED:g}" in MEANINGS["depth jump"]
    assert f"{quality.FLOATING:.0%}" in MEANINGS["floating"]
    assert f"above {judge.CHI_SQUARE_LIMIT:g}" in MEANINGS["contradicts the data"]
    assert f"({quality.MIN_IMAGES}; {quality.FACET_IMAGES} for refine)" in VALID_RULE
    assert all(MEANINGS[reason] for reason in REASONS[1:])
    page = " ".join((ROOT / "docs" / "reconstruct.md").read_text(encoding="utf-8").split())
    assert VALID_RULE[0].upper() + VALID_RULE[1:] in page
    assert all(f"| {reason} | {MEANINGS[reason]} |" in page for reason in REASONS[1:])


def test_limits_are_stated_once():
    """Catches a limit of the rule that is typed in again where it is applied."""
    for name in ("MIN_IMAGES", "FACET_IMAGES", "EXPLAINED", "FLOATING", "CHI_SQUARE_LIMIT", "MAX_CONTRADICTED"):
        places = [p for p in (ROOT / "helio_jax").rglob("*.py") if re.search(rf"^{name} = ", p.read_text(), re.M)]
        assert [p.name for p in places] == ["validity.py"], name


def test_warnings_follow_the_map(tested):
    """That the data contradict the map, and that nothing is valid, comes and goes with the pixels; other warnings stay,
    each on one line. Catches a warning that survives a repaired map, or a map of garbage without one."""
    assert tested.warnings == ()
    rec = contradicted(tested.replace(warnings=("the fit\nhas not converged",)))
    assert rec.warnings == (CONTRADICTED, "the fit has not converged")
    repaired = rec.replace(reason=tested.reason, is_valid=tested.is_valid)
    assert repaired.warnings == ("the fit has not converged",)
    nothing = np.zeros(rec.height.shape, bool)
    assert tested.replace(is_valid=nothing, reason=np.full(nothing.shape, 2)).warnings == (NONE_VALID,)


def test_verdicts(tested):
    """Every kind of map gets its verdict with the reason. Catches "100 % valid" said of garbage."""
    assert verdict(tested)[0] == GOOD and "agree with the data in 100.0 %" in verdict(tested)[1]
    assert verdict(tested.replace(chi_square=None))[0] == CARE
    assert verdict(tested.replace(warnings=("it diverged",))) == (CARE, f"{verdict(tested)[1]}, but it diverged")
    word, reason = verdict(contradicted(tested))
    assert word == BAD and "deviate from the data in" in reason
    nothing = tested.replace(is_valid=np.zeros(tested.height.shape, bool), reason=np.full(tested.height.shape, 5))
    assert verdict(nothing) == (BAD, "no height is valid; main reason: floating (100.0 % of the pixels)")


def test_what_limits_the_trust(tested):
    """Sensitivity (% of height per % of signal) times the s.d. of a gain is that gain's share in the s.d. of the top.

    Catches prior instead of posterior deviations, per cents counted twice, a strange history that ends the report."""
    history = {
        "sensitivity": {"log_gain D1": -2.0, "offset D2": 0.5, "broken": "x"},
        "instrument": {"values": {"log_gain D1": [0.0, 0.01, 0.02, "relative"], "offset D2": [0.0, 0.01, 0.01, "-"]}},
    }
    rec = tested.replace(provenance=history)
    top = np.abs(rec.height - np.median(rec.height)).max()
    assert error_sources(rec) == [("gain D1", pytest.approx(0.02 * top)), ("offset D2", pytest.approx(0.005 * top))]
    assert any(text.startswith("gain D1: ") for text in limits(rec))
    for strange in ({"sensitivity": [1], "instrument": "x"}, {"sensitivity": {"a": 1.0}, "instrument": {"values": 3}}):
        assert error_sources(tested.replace(provenance=strange)) == []


def test_what_the_model_lacks_is_told(tested, tmp_path):
    """Per detector, against what is stated, in the report, too; nothing where nothing is known."""
    history = {"instrument": {"discrepancy": {"D1": 0.012, "D2": 0.034}, "discrepancy_std": 0.02}}
    rec = tested.replace(provenance=history)
    text = "smooth errors of the model: 1.2% (D1), 3.4% (D2) of the signal, stated 2.0%"
    assert discrepancy_text(rec) == text
    assert "smooth errors of the model" in write_report(tmp_path / "r.html", None, rec).read_text(encoding="utf-8")
    for strange in ({}, {"instrument": "x"}, {"instrument": {"discrepancy": [1, 2]}}):
        assert discrepancy_text(tested.replace(provenance=strange)) == ""


def test_rule_and_warnings_stand_everywhere(tested, tmp_path):
    """In the file (also for other readers), in info, measure, evaluate, export and report, in text and in JSON, in
    pictures' and notebooks' words. Catches the one door that says nothing."""
    rec = contradicted(tested.replace(warnings=("the fit has not converged",)))
    write(rec, tmp_path / "r.h5")
    write(tested, tmp_path / "truth.h5")
    assert read(tmp_path / "r.h5").warnings == rec.warnings
    with h5py.File(tmp_path / "r.h5") as file:
        assert VALID_RULE in file["entry/is_valid"].attrs["long_name"].decode()
        assert file["entry/warnings"][()].decode().splitlines() == list(rec.warnings)
    r, truth = tmp_path / "r.h5", ("--truth", tmp_path / "truth.h5")
    told = {
        "info": helio("info", r),
        "measure": helio("measure", r, "--roughness"),
        "evaluate": helio("evaluate", r, *truth),
        "export": helio("export", r, "-o", tmp_path / "r.csv"),
    }
    for name, found in told.items():
        assert VALID_RULE in found.output, name
        assert all(text in found.output for text in rec.warnings), name
    records = {
        "info": helio("info", r, "--json"),
        "measure": helio("measure", r, "--roughness", "--json"),
        "evaluate": helio("evaluate", r, *truth, "--json"),
        "report": helio("report", r, "-o", tmp_path / "r.html", "--json"),
    }
    for name, found in records.items():
        assert json.loads(found.stdout)["trust"] == rec.trust, name
        assert rec.trust["valid_rule"] == VALID_RULE and rec.trust["warnings"] == list(rec.warnings)
        assert name == "info" or all(f"warning: {text}" in found.stderr for text in rec.warnings), name
    html = write_report(tmp_path / "r.html", None, rec).read_text(encoding="utf-8")
    assert VALID_RULE in html and all(f"Warning: {text}" in html for text in rec.warnings)
    page = draw_reconstruction(rec)
    drawn = " ".join(" ".join(t.get_text() for ax in page.axes for t in ax.texts).split())
    assert (
        VALID_RULE in drawn and CONTRADICTED in drawn and "CONTRADICTED" in " ".join(t.get_text() for t in page.texts)
    )
    assert VALID_RULE in as_html(rec) and CONTRADICTED in as_html(rec)
