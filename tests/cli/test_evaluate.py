"""Scores count against what was simulated, and another truth is warned of."""

import json
import re

import pytest
from typer.testing import CliRunner

import helio_jax as hx
from helio_jax.__main__ import app
from helio_jax.errors import InputFileError
from helio_jax.workflows.truth import other_sample

SMALL = {"scan.nx": 21, "scan.ny": 21, "scan.pixel_size_um": 180.0, "trace.rays": 8, "truth.height_um": 400.0}
CAP = "sample.spheres.0.cap_height_um"


@pytest.fixture(scope="module")
def height(tmp_path_factory):
    """A height map of a cap of 400 um, of the scene whose cap is 720 um."""
    path = tmp_path_factory.mktemp("evaluate") / "h.h5"
    stack = hx.simulate(hx.load_scene("sphere_a", SMALL | {CAP: 400.0}))
    hx.write(hx.reconstruct(stack, method="linear"), path)
    return path


def evaluate(*words) -> tuple[dict, list[str]]:
    """Return the scores and the warnings about the truth."""
    done = CliRunner().invoke(app, ["evaluate", *map(str, words), "--json"], catch_exceptions=False)
    said = [line for line in done.stderr.splitlines() if "not what was simulated" in line or "height_um" in line]
    scores = json.loads(done.stdout)
    assert [f"warning: {text}" for text in scores["truth_warnings"]] == said
    return scores, said


def test_the_truth_is_what_was_simulated(height, tmp_path):
    """Without --truth, and with a file of the same scene: equal scores, no warning. Catches a scene without --set."""
    scores, said = evaluate(height)
    assert scores["H_um"] == 400.0 and 0.7 < scores["recovered_height"] < 1.3 and said == []
    same = tmp_path / "same.toml"
    same.write_text('extends = "bshem_wd4"\n[plate]\nsample_distance_um = 4720.0\n[sample]\nkind = "spheres"\n'
                    "size_um = 8000.0\n[[sample.spheres]]\nradius_um = 1000.0\ncap_height_um = 400.0\n[scan]\nnx = 21\n"
                    "pixel_size_um = 180.0\n"
                    "ny = 21\n[truth]\nregion_radius_um = 1050.0\nsubstrate_radius_um = 1400.0\nheight_um = 400.0\n"
                    )  # fmt: skip
    again, said = evaluate(height, "--truth", same)
    assert again["rms_image"] == scores["rms_image"] and said == []


def test_another_truth_is_warned_of(height):
    """The shipped scene has another cap; each warning names the values. Catches 51 % without a word."""
    _, said = evaluate(height, "--truth", "sphere_a")
    assert said == [f"warning: sphere_a is not what was simulated: {CAP} 720.0 instead of 400.0"]
    assert "sample.kind 'step' instead of 'spheres'" in str(other_sample("step", hx.read(height)))


def test_a_height_that_is_not_the_samples_is_warned_of(tmp_path):
    """[truth] keeps its 720 um where only the cap is set to 400 um."""
    stack = hx.simulate(hx.load_scene("sphere_a", SMALL | {CAP: 400.0, "truth.height_um": 720.0}))
    hx.write(hx.reconstruct(stack, method="linear"), tmp_path / "h.h5")
    _, said = evaluate(tmp_path / "h.h5")
    assert len(said) == 1 and re.search(r"height_um is 720 um, the true heights reach (39\d|400) um", said[0])


def test_measured_heights_need_a_truth(height, tmp_path):
    """Catches a truth that is made up."""
    rec = hx.read(height)
    hx.write(rec.replace(provenance={}), tmp_path / "h.h5")
    with pytest.raises(InputFileError, match="give its true heights by --truth"):
        CliRunner().invoke(app, ["evaluate", str(tmp_path / "h.h5")], catch_exceptions=False)


def test_a_run_warns_of_it_too(tmp_path):
    """`helio run --set` of the cap alone. Catches 54 % recovered without a word."""
    changes = [f"--set={key}={value}" for key, value in (SMALL | {CAP: 400.0, "truth.height_um": 720.0}).items()]
    words = ["run", "sphere_a", "-o", str(tmp_path / "out"), "--method", "linear", *changes]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0 and "warning: truth.height_um is 720 um, the true heights reach" in done.stderr
