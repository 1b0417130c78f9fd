"""helio rerun: a simulated file is repeated from its history alone, and a difference is seen."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax as hx
import helio_jax.__main__
from helio_jax.commands.app import app
from helio_jax.errors import InputFileError
from helio_jax.reconstruction import Reconstruction
from helio_jax.workflows.rerun import rerun

SCENE = """
extends = "bshem_wd4"
sample = { kind = "spheres", size_um = 9000.0, spheres = [{ center_um = [0.0, 0.0], radius_um = 600.0 }] }
plate = { sample_distance_um = 4720.0 }
scan = { nx = 15, ny = 17, pixel_size_um = 220.0 }
trace = { rays = 16, seed = 7 }
"""


def helio(*words) -> str:
    """Run a command that must succeed; return what it printed."""
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with noisy micrographs of a small sphere (overrides by options) and their linear heights."""
    out = tmp_path_factory.mktemp("rerun")
    (out / "scene.toml").write_text(SCENE)
    helio("simulate", out / "scene.toml", "-o", out / "a.h5", "--noise", "--rays", 24, "--no-picture")
    helio("reconstruct", out / "a.h5", "-o", out / "height.h5", "--method", "linear")
    (out / "scene.toml").unlink()
    return out


@pytest.mark.parametrize("name", ["a.h5", "height.h5"])
def test_repeats_bit_for_bit(folder, name, tmp_path):
    """Without the scene file, with the overrides and the noise; the repetition can be repeated itself.

    Catches a repetition of the scene file's own settings (16 rays), without noise, or by another method.
    """
    found = json.loads(helio("rerun", folder / name, "-o", tmp_path / name, "--json"))
    assert found["is_equal"] and found["largest"] == 0.0 and found["version"] == hx.__version__
    assert "equal bit for bit" in helio("rerun", tmp_path / name)
    assert type(hx.read(tmp_path / name)) is type(hx.read(folder / name))


def test_sees_a_difference(folder, tmp_path):
    """A height that was changed by 3 um. Catches a comparison of the repetition with itself."""
    rec = hx.read(folder / "height.h5")
    assert isinstance(rec, Reconstruction)
    height = rec.height.copy()
    height[4, 5] += 3.0
    hx.write(rec.replace(height=height), tmp_path / "changed.h5")
    done = rerun(tmp_path / "changed.h5")
    assert not done.is_equal and done.largest == pytest.approx(3.0)
    assert "not equal: the largest difference is 3 um" in helio("rerun", tmp_path / "changed.h5")


def test_refuses_what_cannot_be_repeated(folder, tmp_path):
    """Measured or damaged histories name what is missing. Catches a KeyError, and a scene of another version."""
    stack = hx.read(folder / "a.h5")
    assert isinstance(stack, hx.MicrographStack)
    scene = dict(stack.provenance["scene"])
    for changes, words in (
        ({"calibrate": {}}, "it was calibrated"),
        ({"scene": None}, "its history has no scene"),
        ({"scene": scene | {"unknown": 1}}, "scene in its history: 1 error"),
    ):
        hx.write(stack.replace(provenance={**stack.provenance, **changes}), tmp_path / "bad.h5")
        with pytest.raises(InputFileError, match=words):
            rerun(tmp_path / "bad.h5")
    assert np.isfinite(stack.counts).all()
