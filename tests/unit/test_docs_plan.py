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
SMALL = {"nx = 61": "nx = 11", "ny = 61": "ny = 11", "pixel_size_um = 20.0": "pixel_size_um = 60.0"}


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
    """The three images are planned; the picture is there; table and Python block agree with the command.

    Only three views of one pixel size: everything else is compiled anew. Catches a renamed option, and a time without
    one of dwell, movement, pixels and scans.
    """
    first, second = lines()[:2]
    record = json.loads(run([*(w.replace("20,30", "60").replace("3,4", "3") for w in second), "--json"]))
    assert (folder / "plan.png").stat().st_size > 5000
    assert [c["seconds"] for c in record["candidates"]] == pytest.approx(
        [3 * 121 * (d + 0.45) for d in (0.125, 0.5, 2)]
    )
    (reaching,) = record["reaching"]
    assert reaching["height_std_um"] == 1.0 and 0.125 < reaching["dwell_s"] < 2.0
    table = run(first).splitlines()
    assert len(table) == 2 and f"{record['candidates'][1]['height_std_um']:.3g} um" in table[1]
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert "(0, 90, 180, 270)" in block
    names: dict = {}
    exec(compile(block.replace("(0, 90, 180, 270)", ""), "docs/plan.md", "exec"), names)
    assert [c.dwell_s for c in names["found"].reaching] == pytest.approx([reaching["dwell_s"]])


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
