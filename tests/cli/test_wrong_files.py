"""Files of the wrong kind and names of the wrong suffix: the documented exit code, at once, and nothing written."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from helio_jax import MicrographSet, MicrographStack, Reconstruction, write
from helio_jax.commands.app import app
from helio_jax.errors import InputFileError, ResumeError
from helio_jax.formats.hdf5 import describe
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.workflows.pipeline import resume
from helio_jax.workflows.scene_file import load_scene


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a stack, a set of two, a height map and a scene."""
    folder = tmp_path_factory.mktemp("files")
    detector = Detector(name="a", polar_deg=40.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=(detector,))
    axis = np.arange(4) * 10.0
    stack = MicrographStack(np.ones((1, 4, 4)), axis, axis, instrument)
    write(stack, folder / "stack.h5")
    write(MicrographSet((stack, stack)), folder / "set.h5")
    normals = np.tile([0.0, 0.0, 1.0], (4, 4, 1))
    rec = Reconstruction(
        height=np.zeros((4, 4)), raster_x=axis, raster_y=axis, instrument=instrument, method="linear",
        normals=normals, albedo=np.ones((4, 4)), is_valid=np.ones((4, 4), bool), reason=np.zeros((4, 4), int),
        status="made up",
    )  # fmt: skip
    write(rec, folder / "height.h5")
    return folder


@pytest.mark.parametrize(
    ("command", "needed"),
    [
        ("report stack.h5 -o r.html", "height map"),
        ("report height.h5 -o r.html --stack height.h5", "micrographs"),
        ("report height.h5 -o r.html --stack set.h5", "one stack"),
        ("evaluate stack.h5 --truth height.h5", "height map"),
        ("evaluate height.h5 --truth stack.h5", "height map"),
        ("reconstruct height.h5 -o out.h5", "micrographs"),
        ("calibrate height.h5 -o out.h5", "micrographs"),
        ("measure stack.h5 --roughness", "height map"),
        ("align height.h5 -o out.h5 --auto", "micrographs"),
    ],
)
def test_wrong_kind_of_file(files, command, needed):
    """A helio file of another kind is an InputFileError (exit 3) that says what is needed; it was a traceback."""
    before = sorted(files.iterdir())
    words = [str(files / w) if w.endswith((".h5", ".html")) else w for w in command.split()]
    found = CliRunner().invoke(app, words)
    assert isinstance(found.exception, InputFileError) and needed in str(found.exception), found
    assert sorted(files.iterdir()) == before


@pytest.mark.parametrize("command", ["reconstruct stack.h5", "calibrate stack.h5", "import x.mat", "simulate s.toml"])
def test_wrong_suffix(files, command):
    """HDF5 under another suffix is refused while the command line is read (exit 2), not after an hour of tracing."""
    words = [str(files / w) if "." in w else w for w in command.split()]
    found = CliRunner().invoke(app, [*words, "-o", str(files / "out.png")])
    assert found.exit_code == 2 and ".h5" in found.output, found.output
    assert not (files / "out.png").exists()


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("rays {scene} -o {out}/a.csv --pixel 1,2", "write --pixel 1 2"),
        ("rays {scene} --pixel=1,2 -o {out}/a.csv", "write --pixel 1 2"),
        ("rays {scene} --rays 8 -o {out}/a.csv --directions {out}/b.txt", ".csv or .npz"),
        ("rays {scene} --rays 8 -o {out}/a.csv --directions {out}/a.csv", "two names"),
        ("measure {files}/height.h5 --roughness --profile 0,0,9,9", "write --profile 0 0 9 9"),
        ("measure {files}/height.h5 --facets --figure {out}/a.txt", ".png or .pdf or .svg"),
        ("measure {files}/height.h5 --vertical-edges --table {out}/a.txt", "the suffix .csv"),
        ("measure {files}/height.h5 --cracks", "--stack FILE.h5"),
        ("report {files}/height.h5 -o {out}/a.txt", ".html"),
        ("spot {scene} --heights nan -o {out}/a.png", "finite numbers of um, got nan"),
        ("spot {scene} --heights 9000 -o {out}/a.png", "below the plate"),
    ],
)
def test_usage_is_told_before_any_work(files, tmp_path, command, told):
    """Commas between numbers, wrong suffixes of every output and NaN: exit code 2, the remedy named, nothing written.

    Catches outputs that are checked one after another, between the computations (the first table was left behind).
    """
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.format(scan="nx = 3\nny = 3\npixel_size_um = 10.0", rotate=""))
    out = tmp_path / "out"
    out.mkdir()
    found = CliRunner().invoke(app, command.format(scene=scene, out=out, files=files).split())
    code = found.exit_code if found.exception is None else getattr(found.exception, "exit_code", found.exit_code)
    said = " ".join((found.output + str(found.exception)).replace("│", " ").split())
    assert code == 2 and told in said, (code, said)
    assert not list(out.iterdir())


SCENE = """
[plate]
working_distance_um = 3000.0
[[detector]]
name = "a"
polar_deg = 40.0
half_angle_deg = 10.0
[sample]
kind = "flat"
{rotate}
[scan]
{scan}
"""


def test_scene_without_a_name_and_lists(tmp_path):
    """A scene is called as its file; a missing list of positions is told with its key; x of a list is no length.

    Catches every unnamed scene writing to helio-out/scene, and a number of a position given as micrometres.
    """
    scene = tmp_path / "spots.toml"
    scene.write_text(SCENE.format(scan='kind = "list"\nfile = "there.csv"', rotate=""))
    loaded = load_scene(scene)
    assert loaded.name == "spots"
    with pytest.raises(InputFileError, match=r"scan\.file = 'there.csv': .*no such file"):
        loaded.positions()
    detector = Detector(name="a", polar_deg=40.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=(detector,))
    spots = np.array([[0.0, 5.0], [7.0, 1.0], [2.0, 2.0]])
    write(
        MicrographStack(np.ones((1, 1, 3)), np.arange(3.0), np.zeros(1), instrument, positions=spots), tmp_path / "l.h5"
    )
    fields = describe(tmp_path / "l.h5")["entries"][""]["fields"]
    assert fields["micrographs/x"] == {"shape": [3], "unit": "", "long_name": "number of the beam position"}
    assert fields["positions"]["unit"] == "um"


def test_validate_knows_the_border_of_a_tilted_flat(tmp_path):
    """The outer border of a tilted substrate is open by design. Catches the bounding box of the tilted substrate."""
    scene = tmp_path / "tilted.toml"
    scene.write_text(SCENE.format(scan="nx = 3\nny = 3\npixel_size_um = 10.0", rotate="rotate_deg = [3.0, 5.0, 20.0]"))
    found = CliRunner().invoke(app, ["validate", str(scene)])
    assert found.exit_code == 0 and "ok, a scene" in found.output and "leak" not in found.output
    body = json.loads(CliRunner().invoke(app, ["validate", str(scene), "--json"]).stdout)["body"]
    assert body["n_inner_open_edges"] == 0 and body["n_open_edges"] > 0


def test_resume_asks_whether_a_file_is_whole(tmp_path, files):
    """An empty file, or one of another kind, is no finished run (exit 6). Catches `is_file` taken for finished."""
    empty = tmp_path / "s.h5"
    empty.touch()
    for path, told in ((empty, "empty"), (files / "height.h5", "reconstruction")):
        with pytest.raises(ResumeError, match=told):
            resume(path)
    assert resume(files / "stack.h5", say=lambda text: None) == []
