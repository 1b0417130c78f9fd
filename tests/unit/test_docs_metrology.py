"""The examples of docs/metrology.md run as they are written, on a ridge with ripples, and find what is there."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax as hx
import helio_jax.__main__
from helio_jax.commands.app import app
from tests.height_maps import make_rec

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "metrology.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with height.h5: a ridge of 40 um, 400 um wide, with a ripple of 1 um and posterior samples."""
    rec = make_rec(lambda x, y: 40.0 * (np.abs(x) < 200.0) + np.cos(y / 40.0), n=(101, 111))
    samples = 0.2 * np.random.default_rng(0).standard_normal((16, *rec.height.shape))
    hx.write(rec.replace(height_samples=samples, height_std=np.std(samples, axis=0)), tmp_path / "height.h5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_commands(folder):
    """Each line ends with exit code 0; texture, profile and both steps are printed. Catches a renamed option."""
    (block,) = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    texts = []
    for line in block.splitlines():
        found = CliRunner().invoke(app, shlex.split(line.split("  #")[0])[1:], catch_exceptions=False)
        assert found.exit_code == 0, line
        texts.append(found.output)
    assert "S-L surface" in texts[0] and "16 posterior samples" in texts[0]
    assert (folder / "profile.csv").read_text().startswith("distance_um,x_um,y_um,height_um,height_std_um,flag\n")
    assert "type A): 40.0" in texts[2] and "step: 40.0" in texts[3]


def test_python(folder):
    """The block runs; the ridge is 40 um high. Catches a public function that moved on."""
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(compile(block, "docs/metrology.md", "exec"), names)
    assert names["step"].height == pytest.approx(40.0, abs=3 * names["step"].std + 1e-6)
    assert names["texture"].surface == "S-L surface" and np.isfinite(names["texture"].parameters["Sq"].std)
