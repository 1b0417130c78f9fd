"""Scenes and instruments that come with the program: found by name, extended by name, complete in the wheel."""

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import helio_jax as hx
from helio_jax.errors import SceneError
from helio_jax.workflows import pipeline, provenance, shipped
from helio_jax.workflows.scene_file import files_read
from helio_jax.workflows.shipped import ALIASES, find_shipped, list_shipped, locate

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def empty(tmp_path, monkeypatch) -> Path:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_names(empty):
    """Every file of scenes/ is found by its name, names differ, and each has a line about it.

    Catches a name for a scene and an instrument, an alias of nothing, a first comment that is no line of a table.
    """
    files = list_shipped()
    there = {p.relative_to(ROOT / "scenes") for p in (ROOT / "scenes").rglob("*.toml")}
    assert {f.path.relative_to(shipped.shipped_folder()) for f in files} == there
    names = [f.name for f in files] + list(ALIASES)
    assert len(set(names)) == len(names) and {a for f in files for a in f.aliases} == set(ALIASES)
    for file in files:
        assert 20 < len(file.about) <= 95 and file.about[-1] in ".:", file
        assert locate(file.name) == file.path == find_shipped(file.name).path
    assert hx.load_scene("sphere_a").name == "sphere_a"
    assert hx.load_instrument("bshem") == hx.load_instrument("bshem_wd3")
    assert hx.load_instrument("bshem", {"plate.sample_distance_um": 3500.0}).sample_distance == 3500.0


def test_a_file_wins_over_a_name(empty):
    """A file of that very name is taken, a folder is not. Catches a shipped scene in the place of the user's own."""
    Path("step").mkdir()
    assert locate("step") == find_shipped("step").path
    Path("trench").write_text("mine")
    assert locate("trench") == Path("trench")
    (empty / "step.toml").touch()
    assert locate("step.toml", empty) == empty / "step.toml"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("spher_a", "did you mean 'sphere_a'"),
        ("qqqq", "choose another name (helio scenes lists all)"),
        ("folder", "is a folder"),
        ("nowhere/sphere_a.toml", "'sphere_a', without folder and suffix, names"),
        ("x" * 300, "no such file"),
    ],
)
@pytest.mark.parametrize("load", [hx.load_scene, hx.load_instrument])
def test_unknown_names(load, name, told, empty):
    """Catches a bare "no such file", and an error of the operating system for a name that is too long."""
    Path("folder").mkdir()
    with pytest.raises(SceneError) as error:
        load(name)
    assert told in str(error.value)


def test_scene_extends_a_name(empty):
    """A scene outside a clone extends an instrument by name; the file is among those it reads; one beside it wins.

    Catches a name that is looked up in the working folder alone.
    """
    (empty / "sub").mkdir()
    scene = empty / "sub" / "s.toml"
    scene.write_text('extends = "bshem"\n[sample]\nkind = "flat"\n[scan]\nnx = 3\nny = 3\npixel_size_um = 9.0\n')
    assert hx.load_scene(scene).working_distance == 3000.0
    assert [p for _, p in files_read(scene, "SCENE")] == [scene, find_shipped("bshem").path]
    own = (ROOT / "scenes/instruments/bshem_wd4.toml").read_text()
    (empty / "sub" / "bshem").write_text(own)
    assert hx.load_scene(scene).working_distance == 4000.0


def test_simulation_by_name(empty):
    """The file holds the scene's text and can be resumed. Catches a name that is read as a path further down."""
    small = {"scan.nx": 3, "scan.ny": 3, "trace.rays": 8}
    stack = pipeline.simulate_file("step", empty / "s.h5", overrides=small)
    assert stack is not None and stack.stacks[0].provenance["scene_file"] == "step.toml"


def test_commit_is_that_of_a_clone(tmp_path, monkeypatch):
    """A clone states its commit, an installed package that of no repository above it.

    Catches a project of the user's, in whose environment the program is installed, taken for the program's own.
    """
    is_clone = (ROOT / ".git").exists() and Path(hx.__file__).is_relative_to(ROOT)
    assert bool(provenance.git_commit()) == is_clone
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    commit = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "--allow-empty", "-m", "mine"]
    subprocess.run(commit, cwd=tmp_path, check=True)
    inside = tmp_path / "site-packages" / "helio_jax" / "workflows"
    inside.mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(inside / "provenance.py"))
    assert provenance.git_commit() == ""


def test_instrument_is_no_scene():
    """Catches a list of missing tables without the reason."""
    with pytest.raises(SceneError, match="this is an instrument file"):
        hx.load_scene("bshem")


def test_installed_package_looks_inside(tmp_path, monkeypatch):
    """The folder within the package wins, as in a wheel. Catches a wheel whose program looks beside site-packages."""
    (tmp_path / "helio_jax" / "workflows").mkdir(parents=True)
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "helio_jax" / "workflows" / "shipped.py"))
    assert shipped.shipped_folder() == tmp_path / "scenes"
    (tmp_path / "helio_jax" / "scenes").mkdir()
    assert shipped.shipped_folder() == tmp_path / "helio_jax" / "scenes"


@pytest.mark.skipif(importlib.util.find_spec("hatchling") is None, reason="hatchling, the build backend, is missing")
def test_wheel_is_complete(tmp_path):
    """The wheel holds all scenes, instruments, modules and py.typed. Catches a clone that works and a wheel without."""
    build = "from hatchling.build import build_wheel; import sys; print(build_wheel(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    inside = set(zipfile.ZipFile(wheel).namelist())
    needed = {f"helio_jax/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "scenes").rglob("*.toml")}
    needed |= {"helio_jax/py.typed"}
    needed |= {p.relative_to(ROOT).as_posix() for p in (ROOT / "helio_jax").rglob("*.py")}
    assert needed <= inside, needed - inside
