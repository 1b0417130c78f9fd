"""Habits of a command line: --quiet (results, warnings and errors stay), --json, completion of words by the shell."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import warnings

import pytest
import typer
from typer.testing import CliRunner

import helio_jax.__main__
from helio_jax import __version__
from helio_jax.commands.app import app, say
from helio_jax.commands.door import is_quiet
from helio_jax.commands.interrupts import not_lost
from helio_jax.commands.log import logged

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_them(name):
    """--quiet and --json; `schema` prints JSON anyway. Catches a command without the common options."""
    options = {option for param in COMMANDS[name].params for option in param.opts}
    assert "--quiet" in options and ("--json" in options or name == "schema")


JSON_LINES = (
    ("init instrument bshem.toml", "file"),
    ("simulate step -o a.h5 --rays 8", "picture"),
    ("export a.h5 -o a.mat", "not_written"),
    ("import a.mat -o b.h5 --instrument bshem_wd4 --no-picture", "picture"),
    ("reconstruct a.h5 -o height.h5 --method linear", "trust"),
    ("report height.h5 -o r.html", "panel"),
    ("show height.h5", "file"),
    ("rays step -o rays.csv --pixel 3 4 --rays 32", "fates"),
    ("resume a.h5", "files"),
    ("rerun a.h5", "is_equal"),
)


def test_json_is_one_object(tmp_path, monkeypatch):
    """stdout of each command with --json is one JSON object with its own key, and the files that it names exist.

    Catches lines of text beside it, and numbers that JSON does not know.
    """
    monkeypatch.chdir(tmp_path)
    for line, key in JSON_LINES:
        done = CliRunner().invoke(app, [*line.split(), "--json", "--quiet"], catch_exceptions=False)
        assert done.exit_code == 0, line
        record = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
        assert key in record, line
        for name in ("file", "picture", "report", "panel"):
            assert not isinstance(record.get(name), str) or (tmp_path / record[name]).is_file(), line
    assert len(json.loads(CliRunner().invoke(app, ["cite", "--json"]).stdout)) > 1


def test_messages_go_and_results_stay(tmp_path):
    """One simulation with and without: the same results, "tracing" on stderr only without.

    Catches an option that is parsed and not acted on, one that swallows results, and one that lasts.
    """
    words = ["simulate", "step", "--rays", "8", "--no-picture", "-o"]
    texts = {}
    for name, more in (("loud", []), ("quiet", ["--quiet"]), ("again", [])):
        done = CliRunner().invoke(app, [*words, str(tmp_path / f"{name}.h5"), *more], catch_exceptions=False)
        assert done.exit_code == 0 and "counts of" in done.stdout
        texts[name] = done.stderr
    assert texts["quiet"] == "" and "tracing" in texts["loud"] and "tracing" in texts["again"]


def test_warnings_and_errors_stay(capsys, monkeypatch):
    """Catches a warning that is lost, which would hide that data contradict a height map, and one that is said twice.

    Without pytest's handlers, logging prints warnings that nobody handles.
    """
    monkeypatch.setattr(logging.getLogger("helio_jax"), "propagate", False)
    token = is_quiet.set(True)
    try:
        say("warning: do not trust it")
        say("42 of 99 units")
    finally:
        is_quiet.reset(token)
    assert capsys.readouterr().err == "warning: do not trust it\n"
    with pytest.raises(SystemExit) as end:
        helio_jax.__main__.main(["info", "nowhere.h5", "--quiet"])
    assert end.value.code == 3 and "nowhere.h5" in capsys.readouterr().err


def test_log_holds_command_messages_warnings_and_end(tmp_path, monkeypatch):
    """Two commands in one log: version and command, messages, Python's and our warnings, the error; times.

    Catches a log that is replaced by the next command, one that --quiet empties, and handlers that stay.
    """
    path = tmp_path / "a log.txt"
    monkeypatch.setattr(sys, "argv", ["helio", "simulate", "my scene"])
    with logged(path):
        token = is_quiet.set(True)
        say("tracing")
        is_quiet.reset(token)
        say("warning: do not trust it")
        warnings.warn("a division by zero", stacklevel=1)
    say("after it")
    done = CliRunner().invoke(app, ["info", str(tmp_path / "nowhere.h5"), "--log", str(path)])
    assert done.exception is not None
    found = path.read_text()
    assert len(re.findall(r"(?m)^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING) ", found)) == 7
    wanted = (f"helio_jax {__version__}", "helio simulate 'my scene'", "tracing", "WARNING warning: do not trust it")
    wanted += ("a division by zero", "ended well", "ended with exit code 3", "nowhere.h5 does not exist")
    places = [found.find(text) for text in wanted]
    assert -1 not in places and places == sorted(places) and "after it" not in found


def test_log_is_no_input(tmp_path):
    """Catches a log that is written into the file that the command reads."""
    (tmp_path / "a.h5").write_bytes(b"measured for a week")
    path = str(tmp_path / "a.h5")
    done = CliRunner().invoke(app, ["info", path, "--log", path])
    assert "is the same file as" in str(done.exception) and (tmp_path / "a.h5").read_bytes() == b"measured for a week"


SCENE_COMMANDS = ("run", "simulate", "rays", "spot", "plate", "validate", "show", "compare", "plan", "design")


@pytest.mark.parametrize("name", SCENE_COMMANDS)
def test_values_of_a_scene_can_be_set(name):
    """Catches a command that takes a scene and no --set."""
    assert "--set" in {option for param in COMMANDS[name].params for option in param.opts}


def test_set_takes_values_as_in_toml():
    """Numbers, lists and words; what is wrong is told. Catches values that stay texts, and a key set twice."""

    def validate(*items: str) -> tuple[int, str]:
        words = [word for item in items for word in ("--set", item)]
        done = CliRunner().invoke(app, ["validate", "sphere_a", "--json", *words])
        return getattr(done.exception, "exit_code", done.exit_code), done.stdout + str(done.exception)

    code, text = validate("scan.nx=7", "sample.spheres.0.center_um=[50, 0]", "scan.pitch=sample")
    assert code == 0 and json.loads(text.removesuffix("None"))["image"]["nx"] == 7
    for items, told in (
        (["scan.nx"], "give it as KEY=VALUE"),
        (["scan.nx=7", "scan.nx=8"], "is given already"),
        (["scan.nnx=7"], "unknown key 'nnx'"),
        (["a." * 50 + "b=1"], "at most 32 parts"),
    ):
        code, text = validate(*items)
        assert code == 2 and told in text, text


@pytest.mark.skipif(os.name != "posix", reason="interval timer")
def test_interrupt_that_python_drops_comes_again():
    """Ctrl-C inside a destructor, where Python drops KeyboardInterrupt: it ends the block within a second.

    Catches a command that goes on after Ctrl-C (JAX's callback of the garbage collector drops it, too).
    """

    class Interrupted:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    start, before = time.monotonic(), (sys.unraisablehook, signal.getsignal(signal.SIGALRM))
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt), not_lost():
            it = Interrupted()
            del it
            while time.monotonic() < start + 10.0:
                pass
    finally:
        signal.signal(signal.SIGINT, heeded)
    assert time.monotonic() < start + 5.0 and before == (sys.unraisablehook, signal.getsignal(signal.SIGALRM))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is always full")
def test_full_disk_under_stdout_is_no_bug():
    """`helio info > FILE` on a full disk: exit code 2 and the reason. Catches a traceback (exit code 1)."""
    code = "import sys; sys.argv[1:] = ['schema']; from helio_jax.__main__ import main; main()"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2 and "No space left on device" in done.stderr and "Traceback" not in done.stderr


def test_read_only_home_no_display_and_spaces(tmp_path):
    """A scene drawn without a home, a display or colours, into a folder with a space. Catches a need of any of them."""
    folder = tmp_path / "with space"
    folder.mkdir()
    code = f"import sys; sys.argv[1:] = ['show', 'step', '-o', {str(folder / 'a b.png')!r}]; "
    code += "from helio_jax.__main__ import main; main()"
    gone = {name: str(tmp_path / "nowhere" / name) for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")}
    (tmp_path / "nowhere").touch()  # a file: nothing can be made below it, not even by root
    asked = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "JAX_COMPILATION_CACHE_DIR")} | gone
    done = subprocess.run([sys.executable, "-c", code], env=asked, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and (folder / "a b.png").is_file(), done.stderr
    assert "\x1b" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "found"), [("helio rec", "reconstruct"), ("helio measure --step-h", "--step-height")]
)
def test_shell_completes_words(words, found):
    """As bash asks for it. Catches a program that completes nothing, or prints more than the words."""
    code = "import sys; sys.argv = ['helio']; from helio_jax.__main__ import main; main()"
    asked = {"_HELIO_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | asked, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.split() == [found], done.stderr


def test_progress_is_printed_where_there_is_no_terminal(capsys, monkeypatch):
    """One line after half a minute, with the share and the time that remains; none before.

    Catches a run of hours that prints "tracing" once.
    """
    now = [100.0]
    monkeypatch.setattr(helio_jax.commands.app.time, "monotonic", lambda: now[0])
    bar = helio_jax.commands.app.Bar("tracing")
    for seconds, done in ((1.0, 5), (20.0, 10), (35.0, 25), (40.0, 30), (100.0, 100)):
        now[0] = 100.0 + seconds
        bar(done, 100)
    assert capsys.readouterr().err.splitlines() == ["tracing", "  tracing: 25% done, about 2 min left"]
