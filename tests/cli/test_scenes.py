"""helio scenes, init, validate, --version: what a person has who installed the program and has no clone."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import helio_jax
import helio_jax.__main__
from helio_jax.commands.app import app
from helio_jax.errors import HelioError
from helio_jax.scene.scene import Scene
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_instrument, load_scene
from helio_jax.workflows.shipped import list_shipped
from helio_jax.workflows.starting_file import INSTRUMENT, SCENE
from helio_jax.workflows.study_file import load_study


@pytest.fixture(autouse=True)
def empty(tmp_path, monkeypatch) -> Path:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def helio(*words: object) -> tuple[int, str]:
    """Run a command; return its exit code and what it said."""
    found = CliRunner().invoke(app, list(map(str, words)))
    if isinstance(found.exception, HelioError):
        return found.exception.exit_code, str(found.exception)
    assert isinstance(found.exception, (SystemExit, type(None))), found.exception
    return found.exit_code, found.output


def test_list():
    """Catches a file that is not listed, and a table and JSON that differ."""
    code, text = helio("scenes")
    assert code == 0
    for file in list_shipped():
        assert re.search(rf"^{file.name}\b.* {file.kind} +{re.escape(file.about)}$", text, re.MULTILINE), file.name
    listed = json.loads(helio("scenes", "--json")[1])
    assert [f["name"] for f in listed] == [f.name for f in list_shipped()]
    assert {"bshem"} in [set(f["aliases"]) for f in listed] and all(Path(f["path"]).is_file() for f in listed)


@pytest.mark.parametrize("file", list_shipped(), ids=lambda file: file.name)
def test_copy_is_complete(file, empty):
    """Every copy loads without the shipped files, as what it was. Catches an instrument that is left behind."""
    code, text = helio("scenes", "copy", file.name, empty / "sub")
    copies = [Path(line) for line in text.splitlines()]
    assert code == 0 and copies[0] == empty / "sub" / file.path.name
    load = {"scene": load_scene, "instrument": load_instrument, "study": load_study}[file.kind]
    original = file.path if file.kind == "study" else file.name
    assert load(copies[0]).model_dump(mode="json") == load(original).model_dump(mode="json")
    extended = tomllib.loads(copies[0].read_text(encoding="utf-8")).get("extends")
    assert extended is None or copies[0].parent / extended in copies


def test_copy_keeps_what_is_there():
    """A second scene shares its instrument with the first; a changed file stays, and nothing else is copied then.

    Catches a copy over the user's changes, a refusal of an unchanged instrument, and --force that is not heeded.
    """
    assert helio("scenes", "copy", "sphere_a")[0] == 0 and helio("scenes", "copy", "step")[0] == 0
    mine = Path("instruments/bshem_wd4.toml")
    before = mine.read_text(encoding="utf-8")
    mine.write_text("# mine", encoding="utf-8")
    code, text = helio("scenes", "copy", "trench")
    assert code == 2 and "bshem_wd4.toml exists and is kept" in text and "--force" in text
    assert mine.read_text(encoding="utf-8") == "# mine" and not Path("trench.toml").exists()
    code, text = helio("scenes", "copy", "trench", ".", "--force", "--json")
    assert code == 0 and json.loads(text) == ["trench.toml", str(mine)]
    assert mine.read_text(encoding="utf-8") == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("scenes", "copy"), "helio scenes lists their names"),
        (("scenes", "copy", "spher_a"), "did you mean 'sphere_a'"),
        (("scenes", "copy", "../sphere_a"), "no scene, instrument or study called '../sphere_a'"),
        (("scenes", "move", "sphere_a"), "'copy'"),
        (("scenes", "copy", "sphere_a", "file"), "FOLDER: cannot write file: file is a file"),
        (("init", "scene", "there.toml"), "there.toml exists and is kept"),
        (("init", "scene", "nowhere/s.toml"), "FILE: cannot write"),
        (("init", "plate"), "'instrument'"),
        (("validate", "spher_a"), "did you mean 'sphere_a'"),
        (("validate", "there.toml"), "there.toml: 2 errors"),
    ],
)
def test_refusals(words, told, empty):
    """Exit code 2, the remedy named, nothing written. Catches a path in the place of a name, and a file replaced."""
    Path("file").touch()
    Path("there.toml").write_text("# mine")
    code, text = helio(*words)
    assert code == 2 and told in " ".join(text.replace("│", " ").split()), text
    assert sorted(p.name for p in empty.iterdir()) == ["file", "there.toml"]
    assert Path("there.toml").read_text() == "# mine"


def uncommented(text: str) -> str:
    """Return a starting file whose commented keys with a default are set to it."""
    return re.sub(r"^# (\w+ = \S)", r"\1", text, flags=re.MULTILINE)


def named_keys(text: str, table: str) -> set[str]:
    """Return the keys that a starting file names, set or not, in the first table of a name."""
    section = text.split(f"\n{table}\n")[1].split("\n[")[0]
    return set(re.findall(r"^(?:# )?(\w+) =", section, re.MULTILINE))


def test_starting_instrument():
    """It loads as what the code means; each key of the models is there; each commented default is the default.

    Catches a default or a key that changed in a model and not in the file, and a comment that is no TOML.
    """
    assert helio("init", "instrument")[0] == 0
    path = Path("instrument.toml")
    assert load_instrument(path) == INSTRUMENT
    text = path.read_text(encoding="utf-8")
    for table, model in (
        ("[beam]", INSTRUMENT.beam),
        ("[plate]", INSTRUMENT.plate),
        ("[[detector]]", INSTRUMENT.detector[0]),
    ):
        assert named_keys(text, table) == set(type(model).model_fields)
    assert uncommented(text) != text
    path.write_text(uncommented(text), encoding="utf-8")
    assert load_instrument(path) == INSTRUMENT
    assert helio("validate", path)[0] == 0


def test_starting_scene():
    """It loads as what the code means, without a warning, can be traced, and names each key; defaults are defaults.

    Catches a starting file with which a person's first step fails.
    """
    assert helio("init", "scene", "my.toml")[0] == 0
    path = Path("my.toml")
    scene = load_scene(path)
    assert scene.warnings() == [] and scene.name == "my"
    assert all(getattr(scene, name) == table for name, table in SCENE.items())
    text = path.read_text(encoding="utf-8")
    for name, table in SCENE.items():
        inner = {key for key in type(table).model_fields if key in ("spheres", "refine")}
        assert named_keys(text, f"[{name}]") == set(type(table).model_fields) - inner
    path.write_text(uncommented(text), encoding="utf-8")
    assert Scene.model_dump(load_scene(path)) == Scene.model_dump(scene)
    small = {"scan.nx": 3, "scan.ny": 3, "trace.rays": 8}
    assert pipeline.simulate(load_scene(path, small), maps=False).only().counts.min() > 0
    assert helio("init", "scene", "my.toml", "--force")[0] == 0 and path.read_text(encoding="utf-8") == text


def test_validate_says_what_it_read():
    """Scene or instrument, directions of the detectors, distances, lists that are replaced; the same as JSON.

    Catches radians, the azimuth of another detector, an instrument that is refused for want of a sample.
    """
    code, text = helio("validate", "bshem")
    assert code == 0 and "bshem: ok, an instrument (3 detectors; it has no [sample] and no [scan])" in text
    assert "- left       polar 30 deg, azimuth 120 deg, channel 2" in text
    assert "beam         30 deg from the plate normal" in text and "substrate 3 mm below the plate" in text
    code, text = helio("validate", "sphere_a")
    assert code == 0 and "sphere_a: ok, a scene (121 x 121 pixels, 3 detectors)" in text
    assert "substrate 4.72 mm below the plate (aimed at 4 mm)" in text
    mine = 'extends = "bshem"\n[[detector]]\nname = "up"\npolar_deg = 0.0\nhalf_angle_deg = 3.0\nat_infinity = true\n'
    Path("mine.toml").write_text(mine)
    code, text = helio("validate", "mine.toml")
    assert code == 0 and "replaces all 3 of" in text and "- up         polar 0 deg, azimuth 0 deg, at infinity" in text
    found = json.loads(helio("validate", "mine.toml", "--json")[1])
    assert found["kind"] == "instrument" and len(found["replaced"]) == 1 and found["image"] is None
    assert found["instrument"]["detectors"][0]["polar_deg"] == 0.0


def test_version():
    """Catches a version that is typed in twice."""
    assert helio("--version") == (0, f"helio_jax {helio_jax.__version__}\n")


def test_a_study_is_no_scene(empty):
    """`validate` checks its points, `show` and `run` name the command for it, `init` does not offer one.

    Catches eight errors about unknown keys.
    """
    code, text = helio("validate", "trench_contrast")
    assert code == 0 and "ok, a study" in text and "12, each with micrographs only" in text
    for words in (
        ("show", "aspect_ratio", "-o", "x.png"),
        ("run", "aspect_ratio"),
        ("simulate", "detectors", "-o", "x.h5"),
    ):
        code, text = helio(*words)
        assert code == 2 and "this is a study of the scene 'sphere_a': helio study runs it" in text
    assert helio("init", "study")[0] == 2 and not list(empty.iterdir())
