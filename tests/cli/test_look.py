"""helio show and helio info as a user meets them: every kind of file, every suffix, no display, wrong files."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax as hx
import helio_jax.__main__  # registers the commands
from helio_jax.commands.app import app
from helio_jax.errors import HelioError
from helio_jax.formats.points import write_points
from helio_jax.workflows import shipped

ROOT = Path(__file__).resolve().parents[2]
TRENCH = ROOT / "scenes" / "trench.toml"
INSTRUMENT = ROOT / "scenes" / "instruments" / "bshem_wd3.toml"
HEADS = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}


def helio(*words):
    """Run a command in this process; return exit code and output, an error's text included."""
    found = CliRunner().invoke(app, [str(w) for w in words])
    code = found.exception.exit_code if isinstance(found.exception, HelioError) else found.exit_code
    return code, found.output + str(found.exception or "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A stack of two detectors, a set, a height map, a mesh, tables."""
    out = tmp_path_factory.mktemp("look")
    instrument = hx.load_instrument(INSTRUMENT)
    x, y = np.arange(30) * 20.0, np.arange(20) * 10.0
    counts = np.full((3, 20, 30), 400.0)
    counts[2] = 100.0
    stack = hx.MicrographStack(
        counts, x, y, instrument, variance=counts, background=np.zeros(3), noise="poisson", n_rays=5000.0, name="made"
    )
    hx.write(stack, out / "stack.h5")
    hx.write(hx.MicrographSet((stack, stack.replace(name="other"))), out / "set.h5")
    np.savez(out / "map.npz", x=x, y=y, height=np.add.outer(y, x))
    (out / "box.obj").write_text(
        "v 0 0 0\nv 2 0 0\nv 0 3 0\nv 0 0 5\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n", encoding="utf-8"
    )
    (out / "positions.csv").write_text("x_um,y_um\n1.5,-2\n4,7\n", encoding="utf-8")
    (out / "grid.txt").write_text("\n".join(" ".join(map(str, range(k, k + 20))) for k in range(5)), encoding="utf-8")
    (out / "nan.csv").write_text("nan,nan,1,2,3,4,5,6\n" + "0,1,2,3,4,5,6,7\n" * 3, encoding="utf-8")
    (out / "profile.csv").write_text("height_um,flag\n1,valid\n2.5,valid\n,depth jump\n", encoding="utf-8")
    wide = ",".join(f"c_{k}" for k in range(12)) + "\n" + 2 * (",".join(map(str, range(12))) + "\n")
    (out / "wide.csv").write_text(wide, encoding="utf-8")
    write_points(out / "points.csv", {"scan 1": {"P1": (1.0, 2.0)}, "scan 2": {"P1": (0.0, 2.5), "P2": (5.0, 6.0)}})
    (out / "box.mtl").write_text("newmtl steel\nhelio_law cosine\nnewmtl glass\nKd 1 1 1\n", encoding="utf-8")
    np.save(out / "rays.npy", np.zeros((11, 6)))
    return out


@pytest.mark.parametrize("suffix", HEADS)
def test_show_writes_every_suffix(folder, tmp_path, suffix):
    """Catches a suffix that the option offers and the figure refuses."""
    code, said = helio("show", folder / "stack.h5", "-o", tmp_path / f"p{suffix}")
    assert code == 0, said
    assert (tmp_path / f"p{suffix}").read_bytes().startswith(HEADS[suffix])


@pytest.mark.parametrize("name", ["stack.h5", "set.h5", "map.npz"])
def test_picture_goes_beside_the_file(folder, name):
    """FILE.show.png, said on the terminal; a picture of another command (FILE.png) is not touched."""
    other = (folder / name).with_suffix(".png")
    other.write_bytes(b"of another command")
    code, said = helio("show", folder / name)
    picture = (folder / name).with_suffix(".show.png")
    assert code == 0 and str(picture) in said.replace("\n", "")
    assert picture.read_bytes().startswith(HEADS[".png"]) and other.read_bytes() == b"of another command"


@pytest.mark.parametrize("file", [TRENCH, INSTRUMENT], ids=["scene", "instrument"])
def test_scene_and_instrument_without_a_display(file, tmp_path):
    """In a process of its own, with no display and no choice of backend: a picture is written, a window is refused with
    exit code 5 and a remedy. Catches pyplot where no window is asked for."""
    free = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")}
    run = [sys.executable, "-m", "helio_jax", "show", str(file)]
    done = subprocess.run([*run, "-o", str(tmp_path / "p.png")], capture_output=True, text=True, env=free, check=False)
    assert done.returncode == 0, done.stderr
    window = subprocess.run([*run, "--window"], capture_output=True, text=True, env=free, check=False)
    assert window.returncode == 5 and "-o FILE.png" in window.stderr and "Traceback" not in window.stderr


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Scenes within the package, as a wheel has them, and an empty folder to work in; return the former."""
    package = tmp_path / "site-packages" / "helio_jax"
    shutil.copytree(ROOT / "scenes", package / "scenes", ignore=shutil.ignore_patterns("*.png"))
    monkeypatch.setattr(shipped, "__file__", str(package / "workflows" / "shipped.py"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return package / "scenes"


@pytest.mark.parametrize(
    ("named", "name"),
    [("trench", "trench"), ("bshem", "bshem"), ("ashem_45", "ashem_45"), ("instruments/bshem_wd4.toml", "bshem_wd4")],
)
def test_picture_of_what_is_shipped_goes_here(installed, named, name):
    """By its name, an alias or its path: the current folder has the picture, the package none. --view, -o as ever.

    Catches a picture within an installed package.
    """
    before = sorted(installed.rglob("*"))
    code, said = helio("show", installed / named if "/" in named else named)
    assert code == 0 and said.split() == [f"{name}.show.png"], said
    assert Path(f"{name}.show.png").read_bytes().startswith(HEADS[".png"])
    assert helio("show", name, "-o", "p.svg")[0] == 0
    assert sorted(p.name for p in Path().iterdir()) == sorted([f"{name}.show.png", "p.svg"])
    assert sorted(installed.rglob("*")) == before


def test_picture_of_a_copy_goes_beside_it(installed):
    """A copy is the user's own file. Catches every file of a shipped name taken for the shipped one."""
    assert helio("scenes", "copy", "trench", "mine")[0] == 0
    code, said = helio("show", "mine/trench.toml")
    assert code == 0 and said.strip() == str(Path("mine/trench.show.png")) and Path(said.strip()).is_file()
    assert not Path("trench.show.png").exists()


def test_info_by_name(installed):
    """A name says what its file says; a file of that very name wins. Catches a name that only some commands know."""
    for name, path in (("trench", "trench.toml"), ("bshem", "instruments/bshem_wd3.toml")):
        assert helio("info", name, "--all") == helio("info", installed / path, "--all")
    assert hx.show("bshem").axes
    shutil.copy(installed / "instruments" / "bshem_wd4.toml", "trench")
    assert helio("info", "trench")[0] == 3  # a file without a suffix


def test_window_shows_the_figure(folder, monkeypatch):
    """The figure that was drawn is what the window holds. Catches an empty window."""
    from matplotlib import pyplot

    from helio_jax.figures import canvas

    shown = []
    monkeypatch.setattr(canvas, "_NO_DISPLAY", ())
    monkeypatch.setattr(pyplot, "show", lambda: shown.append(pyplot.gcf()))
    code, said = helio("show", folder / "stack.h5", "--window")
    pyplot.close("all")
    assert code == 0, said
    assert len(shown) == 1 and sum(bool(ax.images) for ax in shown[0].axes) == 3


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ("show nothing.h5", 3, "does not exist"),
        ("show positions.csv", 3, "helio info"),
        ("show box.obj", 3, "belong in a scene"),
        ("show stack.h5 -o p.jpg", 2, ".png or .pdf or .svg"),
        ("show stack.h5 -o missing/p.png", 2, "No such file or directory"),
        ("show spher_a", 2, "did you mean 'sphere_a'"),
        ("show sphere_a --view 1", 2, "view must be 0 to 0"),
        ("info nothing.toml", 3, "does not exist"),
        ("info bshen", 2, "did you mean 'bshem'"),
        ("info sphere_a.toml", 2, "without folder and suffix, names"),
        ("info points.xyz", 3, "unknown kind of file .xyz"),
        ("info broken.npz", 3, "broken.npz"),
        ("info broken.h5", 3, "not an HDF5 file"),
        ("info broken.csv", 3, "broken.csv"),
        ("info broken.npy", 3, "broken.npy"),
    ],
)
def test_wrong_files(folder, monkeypatch, words, code, told):
    """The documented exit code and a sentence that helps; never a traceback."""
    monkeypatch.chdir(folder)
    (folder / "points.xyz").write_text("1 2 3", encoding="utf-8")
    for suffix in (".npz", ".h5", ".npy", ".csv"):
        (folder / f"broken{suffix}").write_bytes(b"\xff\x00 nonsense, but long enough")
    found, said = helio(*words.split())
    assert found == code and told in " ".join(said.replace("│", " ").split()), said


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("stack.h5", ["30 x 20 pixels of 20 x 10 um; field of view 600 x 200 um", "5,000 beam atoms per pixel"]),
        ("stack.h5", ["- right polar 30 deg, azimuth -120 deg; mean 100 counts", "noise 10 counts, SNR 10"]),
        ("set.h5", ["2, counts with noise", "- other"]),
        ("map.npz", ["height map", "0 to 770 um", "grid 30 x 20 pixels of 20 x 10 um"]),
        ("box.obj", ["4 triangles, 4 vertices", "2 x 3 x 5 in the file's unit", "closed yes"]),
        ("positions.csv", ["2 lines of 2 numbers", "x_um 1.5 to 4", "y_um -2 to 7", "beam positions x, y in um"]),
        ("profile.csv", ["3 lines of 2 columns", "height_um 1 to 2.5", "flag valid (2), depth jump (1)"]),
        ("wide.csv", ["2 lines of 12 numbers", "c_1 1 to 1", "further columns c_10, c_11"]),
        ("nan.csv", ["grid of numbers", "4 lines of 8 numbers", "0 to 7, 2 missing"]),
        ("grid.txt", ["5 lines of 20 numbers", "0 to 23", "a height map"]),
        ("points.csv", ["control points", "scan 2 P1, P2"]),
        ("box.mtl", ["steel cosine", "glass no helio_law"]),
        ("rays.npy", ["11 x 6 of float64", "rays of a beam"]),
        (TRENCH, ["sample trench, 6 x 6 mm wide, from -250 um to 0 um", "512 rays per pixel", "35,000 beam atoms"]),
        (INSTRUMENT, ["- left polar 30 deg, azimuth 120 deg, channel 2", "uncertainty polar 5 deg, azimuth 3 deg"]),
        (ROOT / "docs" / "study_cap_height.toml", ["points 10 (grid)"]),
    ],
    ids=str,
)
def test_info_states_what_a_file_holds(folder, name, told):
    """About ten lines with the right numbers, for every kind of file. Catches axes exchanged and a kind not read."""
    code, said = helio("info", folder / name)
    assert code == 0, said
    text = " ".join(said.split())
    assert all(words in text for words in told), said
    assert len(said.splitlines()) <= 14


def test_info_has_the_rest_on_request(folder):
    """--all adds every array and the instrument; --json is one object with the summary and everything."""
    short, long = helio("info", folder / "stack.h5")[1], helio("info", folder / "stack.h5", "--all")[1]
    assert long.startswith(short) and "micrographs/counts" in long and "micrographs/counts" not in short
    found = json.loads(helio("info", folder / "stack.h5", "--json")[1])
    assert found["entries"][""]["fields"]["micrographs/counts"]["shape"] == [3, 20, 30]
    assert found["kind"] == "micrographs" and "5,000" in found["summary"]["counts of"]
    assert json.loads(helio("info", TRENCH, "--json")[1])["settings"]["scan"]["nx"] == 121


def test_info_and_import_of_measured_files(shared, tmp_path):
    """A .mat states which channels hold data, before any instrument is known; import ends with its summary and picture.

    Catches a guess of channels, one run at a time.
    """
    source = shared / "data" / "sc100351.mat"
    code, said = helio("info", source)
    text = " ".join(said.split())
    assert code == 0 and "channel 1 121 x 121 (columns x rows), only zeros: not connected" in text
    assert "channel 4 121 x 121 (columns x rows), mean 9938" in text and "pixel 30 x 30 um" in text
    assert "single 1 304 x 351 (columns" in " ".join(
        helio("info", source.with_name("sphere_a_simulated.mat"))[1].split()
    )
    code, said = helio("import", source, "-o", tmp_path / "m.h5", "--instrument", INSTRUMENT)
    assert code == 0 and "field of view 3.63 x 3.63 mm" in said and "scanned in 5 h 14 min" in said
    assert (tmp_path / "m.show.png").read_bytes().startswith(HEADS[".png"])


def test_simulate_ends_with_a_summary_and_a_picture(tmp_path):
    """Pixel, field, atoms, counts, error and time on the terminal; --no-picture leaves none. Catches silence."""
    text = TRENCH.read_text(encoding="utf-8").replace('"instruments/', f'"{(ROOT / "scenes/instruments").as_posix()}/')
    (tmp_path / "t.toml").write_text(text.replace("nx = 121", "nx = 9").replace("ny = 41", "ny = 7"), encoding="utf-8")
    code, said = helio("simulate", tmp_path / "t.toml", "-o", tmp_path / "t.h5", "--rays", 16)
    assert code == 0, said
    for words in (
        "t.h5: ",
        " s\n",
        "9 x 7 pixels of 10 x 10 um; field of view 90 x 70 um",
        "35,000 beam atoms per pixel",
    ):
        assert words in said, words
    assert said.count("error of the simulation") == 3 and "seed 1" in said
    assert (tmp_path / "t.show.png").read_bytes().startswith(HEADS[".png"])
    assert helio("simulate", tmp_path / "t.toml", "-o", tmp_path / "u.h5", "--rays", 16, "--no-picture")[0] == 0
    assert (tmp_path / "u.h5").exists() and not (tmp_path / "u.show.png").exists()


def test_documented_example_runs(tmp_path, monkeypatch):
    """The Python block of docs/show.md, in an empty folder. Catches docs ahead of the program."""
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "show.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(block, "docs/show.md", "exec"), {})
    assert (tmp_path / "stack.pdf").read_bytes().startswith(HEADS[".pdf"])
