"""No command destroys data: an output is no input and no other output, and a bad one is told before any work.

What is tested follows from the marks of the commands (commands/door.py): a new command or option is covered as soon as
it is there, and is refused here without a mark.
"""

import contextlib
import itertools
import os
import tempfile
import typing
from pathlib import Path

import pytest
import typer
from typer.core import TyperCommand
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from helio_jax.commands import measured, simulating
from helio_jax.commands.app import app
from helio_jax.commands.door import Command, Reads, Writes, marks_of
from helio_jax.errors import SceneError
from helio_jax.formats.parts import Parts
from helio_jax.workflows import compare as comparison
from helio_jax.workflows import pipeline, study
from helio_jax.workflows.scene_file import files_read

COMMANDS: dict[str, typing.Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
MARKS = {name: marks_of(command.callback) for name, command in COMMANDS.items()}
WRITING = [(c, n) for c, marks in MARKS.items() for n, m in marks.items() if isinstance(m, Writes) and n != "log"]
"""Without --log, which is the same code for all commands: test_habit.py."""
PAIRS = [(c, read, out) for c, out in WRITING for read, mark in MARKS[c].items() if isinstance(mark, Reads)]
TWINS = [(c, a, b) for (c, a), (other, b) in itertools.combinations(WRITING, 2) if c == other]
SCENE = '[sample]\nkind = "mesh"\nfile = {file!r}\n'
MESH_READERS = [(c, r, out) for c, r, out in PAIRS if MARKS[c][r].names_files]


def line(command: str, folder: Path, /, **given: Path) -> list[str]:
    """Return a command with the paths given, and values made up for everything else that it needs."""
    words, params = [command], COMMANDS[command].params
    last = max((i for i, p in enumerate(params) if p.param_type_name == "argument" and p.name in given), default=-1)
    for i, param in enumerate(params):
        mark = MARKS[command].get(param.name)
        stands_before = param.param_type_name == "argument" and i < last
        if not (param.required or param.name in given or stands_before):
            continue
        value = given.get(param.name, folder / f"{param.name}{suffix(mark) if isinstance(mark, Writes) else '.h5'}")
        if mark is None:
            value = {"action": "list", "kind": "scene"}.get(param.name, 1)
        words += [str(value)] if param.param_type_name == "argument" else [max(param.opts, key=len), str(value)]
    return words


def suffix(mark: Writes) -> str:
    """Return a suffix that an output may have."""
    return (mark.suffixes or ("",))[0]


def places(mark: Writes, out: Path) -> list[Path]:
    """Return where a command that is given `out` writes."""
    if mark.within is not None:
        return [out / name for name in mark.within]
    return [out, *(out.with_suffix(s) for s in (*mark.beside, mark.picture) if s)]


def said(found: typing.Any) -> tuple[int, str]:
    """Return the exit code and everything that was said."""
    code = found.exit_code if found.exception is None else getattr(found.exception, "exit_code", found.exit_code)
    return code, " ".join((found.output + str(found.exception)).replace("│", " ").split())


@pytest.fixture
def no_work(monkeypatch):
    """Let no command be entered."""

    def reached(self, ctx):
        raise AssertionError("the command was entered")

    monkeypatch.setattr(TyperCommand, "invoke", reached, raising=False)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_path_is_marked(command):
    """Catches a new command or option that passes by the door: its paths must say whether they are read or written."""
    assert isinstance(COMMANDS[command], Command)
    hints = typing.get_type_hints(COMMANDS[command].callback, include_extras=True)
    assert {name for name, hint in hints.items() if "Path" in str(hint)} == set(MARKS[command])


@pytest.mark.parametrize("command", COMMANDS)
def test_command_without_arguments(command, no_work):
    """What is missing is told (exit code 2), or nothing is. Catches a look at the first word where there is none."""
    found = CliRunner().invoke(app, [command])
    assert found.exit_code == 2 or str(found.exception) == "the command was entered", found


@pytest.mark.parametrize("how", ["same", "symbolic", "hard"])
@pytest.mark.parametrize(("command", "read", "out"), PAIRS)
def test_output_that_is_an_input(command, read, out, how, tmp_path):
    """Exit code 2, both options and the remedy named, the input as it was; nothing else written.

    Catches outputs compared with inputs by their spelling, forgotten options, and files written beside an output.
    """
    mark = MARKS[command][out]
    (tmp_path / "out").mkdir()
    (tmp_path / "in").mkdir()
    output = tmp_path / "out" if mark.within is not None else tmp_path / "out" / f"x{suffix(mark)}"
    for place in places(mark, output):
        victim = place if how == "same" else tmp_path / "in" / f"victim{place.suffix}"
        victim.write_bytes(b"measured for a week")
        if how == "symbolic":
            place.symlink_to(victim)
        if how == "hard":
            os.link(victim, place)
        spelled = victim.parent / ".." / victim.parent.name / victim.name
        before = sorted(tmp_path.rglob("*"))
        code, text = said(CliRunner().invoke(app, line(command, tmp_path, **{out: output, read: spelled})))
        options = {p.name: min(p.opts, key=len) for p in COMMANDS[command].params if p.param_type_name == "option"}
        assert code == 2 and str(spelled) in text and f"name another file with {options[out]}" in text, text
        assert options.get(read, "(") in text and place.name in text
        assert victim.read_bytes() == b"measured for a week" and sorted(tmp_path.rglob("*")) == before
        place.unlink()


@pytest.mark.parametrize(("command", "read", "out"), MESH_READERS)
def test_output_that_a_scene_reads(command, read, out, tmp_path):
    """A file that the scene names is an input, too. Catches `helio plate` replacing the mesh of its own scene."""
    mark = MARKS[command][out]
    output = tmp_path / f"x{suffix(mark)}"
    place = places(mark, output)[0]
    place.parent.mkdir(exist_ok=True)
    place.write_bytes(b"v 0 0 0")
    scene, above = tmp_path / "scene.toml", tmp_path / "above.toml"
    scene.write_text('extends = "above.toml"\n')
    above.write_text(SCENE.format(file=str(place.relative_to(tmp_path))))
    code, text = said(CliRunner().invoke(app, line(command, tmp_path, **{out: output, read: scene})))
    assert code == 2 and "a file of scene.toml" in text and place.read_bytes() == b"v 0 0 0", text


def test_files_of_a_scene(tmp_path):
    """The file that a scene extends, meshes named by an override and the .mtl beside them are read; nothing is needed.

    Catches a list of the scene's own tables alone, and a door that fails on a scene that is missing or wrong.
    """
    (tmp_path / "a.toml").write_text('extends = "b.toml"\n' + SCENE.format(file="a.obj"))
    (tmp_path / "b.toml").write_text("[plate]\nfile = 'p.stl'\n")
    (tmp_path / "c.mtl").touch()
    found = files_read(tmp_path / "a.toml", "SCENE", {"sample.file": "c.obj"})
    assert {p.name for _, p in found} == {"a.toml", "b.toml", "p.stl", "c.obj", "c.mtl"}
    (tmp_path / "a.toml").write_text("no TOML")
    for name in ("a.toml", "missing.toml"):
        assert files_read(tmp_path / name, "SCENE") == [("SCENE", tmp_path / name)]


@pytest.mark.parametrize(("command", "first", "second"), TWINS)
def test_two_outputs_in_one_file(command, first, second, tmp_path, no_work):
    """Catches a second output that replaces the first one through a link to where nothing is yet."""
    one, two = (tmp_path / f"{n}{suffix(MARKS[command][p])}" for n, p in (("one", first), ("two", second)))
    two.symlink_to(one)
    code, text = said(CliRunner().invoke(app, line(command, tmp_path, **{first: one, second: two})))
    assert code == 2 and "give them two names" in text, text


@pytest.mark.parametrize("wrong", ["missing", "folder", "long", "protected", "suffix", "disk", "loop"])
@pytest.mark.parametrize(("command", "out"), WRITING)
def test_bad_output_is_told_before_any_work(command, out, wrong, tmp_path, no_work, monkeypatch):
    """Exit code 2 with the path, before the command is entered, and nothing is left behind.

    Catches an output that is first looked at when an hour of tracing is to be written into it.
    """
    mark = MARKS[command][out]
    good = tmp_path / "out" / f"x{suffix(mark)}"
    good.parent.mkdir()
    bad = {
        "missing": tmp_path / "nowhere" / good.name,
        "long": good.with_name("x" * 300 + good.suffix),
        "suffix": good.with_suffix(".jpg"),
    }.get(wrong, good)
    if mark.within is not None and wrong in ("missing", "folder"):
        bad.parent.mkdir(exist_ok=True)
        bad.write_text("a file where a folder should be")
    elif wrong == "folder":
        bad.mkdir()
    elif wrong == "protected":
        place = bad / mark.within[0] if mark.within else bad
        if mark.within == ():
            pytest.skip("its files are those of the pack")
        place.parent.mkdir(exist_ok=True)
        place.write_text("kept")
        place.chmod(0o444)
    elif wrong == "loop":
        bad.symlink_to(bad)
        if mark.within is not None:
            pytest.skip("a folder is made through no loop")
    elif wrong == "disk":

        def refuse(dir):
            if Path(dir) == good.parent:
                raise PermissionError(13, "Permission denied")
            return contextlib.nullcontext()

        monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    elif wrong == "suffix" and not mark.suffixes:
        pytest.skip("any suffix will do")
    before = sorted(tmp_path.rglob("*"))
    code, text = said(CliRunner().invoke(app, line(command, tmp_path, **{out: bad})))
    labels = "-o: ", f"--{out.replace('_', '-')}: ", f"{out.upper()}: "
    assert code == 2 and bad.name[:20] in text and any(label in text for label in labels), text
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("command", "out"), WRITING)
def test_good_output_passes_and_is_then_kept(command, out, tmp_path, no_work):
    """A new output passes; one of before is refused, first or beside it, and passes with --force. Nothing is made.

    Catches a door that refuses everything, a command whose second call replaces what the first one made, and a
    command without --force. Commands that add to what is there, or know their own, pass without; the picture of
    micrographs is replaced, for `helio show` of their scene may have drawn one of that name.
    """
    mark = MARKS[command][out]
    output = tmp_path / "results" if mark.within is not None else tmp_path / f"x{suffix(mark)}"
    words = line(command, tmp_path, **{out: output})
    assert "the command was entered" in said(CliRunner().invoke(app, words))[1] and not output.exists()
    pictured = output.with_suffix(mark.picture) if mark.picture else None
    for place in places(mark, output):
        place.parent.mkdir(exist_ok=True)
        place.write_text("of before")
        code, text = said(CliRunner().invoke(app, words))
        if mark.keeps or place == pictured:
            assert "the command was entered" in text
        else:
            assert code == 2 and f"{place.name} exists and is kept" in text and "--force" in text
            assert "the command was entered" in said(CliRunner().invoke(app, [*words, "--force"]))[1]
        assert place.read_text() == "of before"
        place.unlink()


@pytest.mark.parametrize("command", ["simulate", "run"])
def test_an_unfinished_run_goes_on(command, tmp_path, no_work):
    """Parts of an unfinished run beside its micrographs: the same command goes on, without --force.

    Catches a rule that takes a resumed run for one that overwrites.
    """
    output = tmp_path / ("results" if command == "run" else "x.h5")
    micrographs = output / "micrographs.h5" if command == "run" else output
    micrographs.parent.mkdir(exist_ok=True)
    micrographs.write_text("of before")
    words = line(command, tmp_path, output=output)
    assert "exists and is kept" in said(CliRunner().invoke(app, words))[1]
    Parts(micrographs).begin({})
    assert "the command was entered" in said(CliRunner().invoke(app, words))[1]


def test_default_folder_of_a_run_is_kept(tmp_path, monkeypatch):
    """Without -o, results of before in helio-out/NAME are kept, too. Catches a rule for stated paths only."""
    monkeypatch.chdir(tmp_path)
    before = tmp_path / "helio-out" / "sphere_a" / "height.h5"
    before.parent.mkdir(parents=True)
    before.write_text("of before")
    code, text = said(CliRunner().invoke(app, ["run", "sphere_a"]))
    assert code == 2 and "exists and is kept" in text and "--force" in text and before.read_text() == "of before"


def test_library_refuses_as_well(tmp_path):
    """Catches a guard of the command line alone, which `resume`, a study's points and notebooks pass by."""
    mesh, scene = tmp_path / "out" / "height.h5", tmp_path / "scene.toml"
    mesh.parent.mkdir()
    mesh.write_text("precious")
    scene.write_text((Path(__file__).resolve().parents[2] / "scenes" / "sphere_b.toml").read_text())
    instruments = Path(__file__).resolve().parents[2] / "scenes" / "instruments"
    scene.write_text(scene.read_text().replace('"instruments/', f'"{instruments.as_posix()}/'))
    os.link(scene, tmp_path / "micrographs.h5")
    plan = tmp_path / "index.csv"
    plan.write_text('scene = "scene.toml"\n[vary]\n"trace.seed" = [1]\n')
    for call in (
        lambda: pipeline.calibrate_file(mesh, mesh),
        lambda: pipeline.simulate_file(scene, tmp_path / "micrographs.h5"),
        lambda: pipeline.run(scene, tmp_path),
        lambda: study.run_study(plan, tmp_path),
    ):
        with pytest.raises(SceneError, match="is the same file as"):
            call()
    assert mesh.read_text() == "precious" and plan.read_text().startswith("scene")


def test_marks_name_what_is_written():
    """Catches files of a folder that a command writes and its mark does not know."""
    assert simulating.STUDY == study.WRITTEN
    assert set(simulating.RUN) == set(pipeline.RUN_FILES.values())
    assert measured.COMPARISON == comparison.WRITTEN


def test_parts_leave_what_is_not_theirs(tmp_path):
    """Catches a folder OUT.parts that was the user's, or got a file of his, being removed whole."""
    parts = Parts(tmp_path / "a.h5")
    parts.begin({})
    parts.save(3, {})
    assert parts.claim("1/2")
    (parts.folder / "notes.txt").write_text("mine")
    parts.remove()
    assert [p.name for p in parts.folder.iterdir()] == ["notes.txt"]
    (parts.folder / "notes.txt").unlink()
    parts.remove()
    assert not parts.folder.exists()
