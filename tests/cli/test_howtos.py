"""Tutorial, how-tos and the pages for users of other programs run line by line; so do the README's names of scenes."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from tests.pages import ROOT, blocks, run_page

SMALL = {"nx = 41": "nx = 21", "ny = 41": "ny = 21", "pixel_size_um = 30.0": "pixel_size_um = 60.0"}
"""The tutorial's field of view on the raster of the other pages, for which JAX then compiles once."""
TINY = """extends = "bshem_wd4"
sample = { kind = "spheres", spheres = [{ radius_um = 500.0, cap_height_um = 150.0 }] }
scan = { nx = 21, ny = 21, pixel_size_um = 60.0 }
trace = { rays = 16 }
reconstruct = { method = "nearfield" }
"""
PAGES = ("tutorial", "howto_mat", "howto_instrument", "howto_plate", "howto_cluster", "howto_steps", "howto_studies")
PAGES += ("from_matlab", "from_gwyddion")


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_all_pages_that_promise_to_run_are_run():
    """Each block is of a language that `run_page` runs. Catches a new how-to, and a block that is skipped."""
    there = {path.stem for path in (ROOT / "docs").glob("*.md") if re.match("tutorial|howto_|from_", path.stem)}
    assert there == {*PAGES, "howto_calibrate"}
    for name in there:
        for language, code in blocks(page(name)):
            assert language in ("sh", "python") or re.match(r"# \w+\.toml\n", code), (name, code)


@pytest.mark.parametrize("name", PAGES)
def test_page(name, tmp_path, monkeypatch):
    """Each command ends with exit code 0 and leaves its file; what the page states of its example holds.

    Catches an option or a name that has moved on, and a line that needs a file that no line before it has made.
    """
    if name == "howto_cluster":
        shutil.copy(ROOT / "docs" / "slurm_array.sh", tmp_path)
    names = run_page(page(name), tmp_path, monkeypatch, SMALL)
    if name == "tutorial":
        assert names["rec"].height[names["row"], names["column"]] == pytest.approx(150.0, abs=25.0)
        assert b"<html" in Path("report.html").read_bytes()[:500]
    if name == "howto_mat":
        assert names["scan"].x == pytest.approx(hx.read("ball.h5").x)
        assert np.corrcoef(names["scan"].counts.ravel(), names["stack"].counts.ravel())[0, 1] > 0.5
    if name == "howto_plate":
        assert 0.0 < names["below"].counts.sum() < names["ideal"].counts.sum()
    if name == "howto_cluster":
        one, two, cores = (hx.read(f"{name}.h5").counts for name in ("big", "slurm", "cores"))
        assert np.array_equal(one, two) and np.array_equal(one, cores)
    if name == "howto_studies":
        rows = Path("walls/table.md").read_text(encoding="utf-8").splitlines()[2:]
        assert len(rows) == 4 and all(row.count("+-") == 6 for row in rows)
    if name == "howto_steps":
        heights = [step.height_um for step in names["steps"].steps]
        assert len(heights) == 4 and heights == pytest.approx([60.0] * 4, abs=3.0)
    if name == "from_gwyddion":
        assert Path("height.gwy").read_bytes()[:4] == b"GWYP"


@pytest.mark.slow
def test_calibrate_page(tmp_path, monkeypatch):
    """Catches a known shape, a setting or a file kind that has moved on. One round of a fit: half a minute."""
    small = {"nx = 25": "nx = 13", "ny = 25": "ny = 13", "pixel_size_um = 120.0": "pixel_size_um = 240.0"}
    run_page(page("howto_calibrate"), tmp_path, monkeypatch, small)
    assert hx.load_instrument("plate.toml").covariance is not None


def test_scenes_by_name(tmp_path, monkeypatch):
    """The README's block, with a small scene of that name in the folder, which wins, and a scan to import."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").split("\n## Scenes by name\n")[1].split("\n## ")[0]
    monkeypatch.chdir(tmp_path)
    Path("sphere_a").write_text(TINY, encoding="utf-8")
    hx.export(hx.simulate(hx.load_scene("sphere_a"), rays=8), "scan.mat")
    text = text.replace("--instrument bshem\n", "--instrument bshem_wd4\n")  # that of the reference simulator's layout
    run_page(text, tmp_path, monkeypatch, {})
    assert {path.name for path in (tmp_path / "my_scenes").rglob("*.toml")} == {"sphere_a.toml", "bshem_wd4.toml"}
