"""The scene, the commands and the Python block of docs/plan.md run as they stand there, on a smaller raster."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from helio_jax.commands.app import app

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "plan.md").read_text(encoding="utf-8")
SMALL = {"nx = 61": "nx = 11", "ny = 61": "ny = 11", "pixel_size_um = 20.0": "pixel_size_um = 110.0"}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with hill.toml of the page."""
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    for key, value in SMALL.items():
        assert key in text
        text = text.replace(key, value)
    (tmp_path / "hill.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lines() -> list[list[str]]:
    """Return the words of every command of the page."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    return [shlex.split(line)[1:] for block in blocks for line in block.splitlines()]


def run(words: list[str]) -> str:
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, (words, done.output)
    return done.stdout


def test_plan(folder):
    """Four views of the sample are better than three; the picture is there; the Python block agrees with the command.

    Catches a renamed option, and an error that does not fall with images. Few rasters: each one is compiled.
    """
    first, second = lines()[:2]
    words = [w.replace("20,30", "110") for w in second]
    record = json.loads(run([*words, "--json"]))
    assert (folder / "plan.png").stat().st_size > 5000
    by_images = {c["n_images"]: c for c in record["candidates"] if c["dwell_s"] == 0.5}
    assert 0.7 < by_images[4]["height_std_um"] / by_images[3]["height_std_um"] < 1.0
    assert by_images[3]["seconds"] == pytest.approx(3 * 121 * 0.95)
    table = run(first).splitlines()
    assert len(table) == 2 and f"{by_images[3]['height_std_um']:.3g} um" in table[1]
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(compile(block, "docs/plan.md", "exec"), names)
    dwells = [c["dwell_s"] for c in record["reaching"]]
    assert dwells and [c.dwell_s for c in names["found"].reaching] == pytest.approx(dwells)


def test_measured(folder, shared):
    """The commands with measured files: times of the measured stage; five windows of 2 mm. Catches a renamed option."""
    third, windows = lines()[2:]
    for name in ("scan003259", "scan003248"):
        (folder / f"{name}.mat").symlink_to(shared / "data" / f"{name}.mat")
    shutil.copy(ROOT / "benchmarks" / "alum_points.csv", folder / "points.csv")
    record = json.loads(run([w.replace("0.5,1,2", "0.5") for w in third]))
    assert record["timing"]["pause"] == 0.25 and record["timing"]["move"] == pytest.approx(0.2, abs=0.01)
    assert "rotation centre" in run(windows)
    rows = (folder / "windows.csv").read_text().splitlines()
    assert len(rows) == 6 and rows[1].startswith("0.0,-5850.0")
