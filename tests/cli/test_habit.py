"""Habits of a command line: --quiet (results, warnings and errors stay), --json, completion of words by the shell."""

import json
import os
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

import helio_jax.__main__
from helio_jax.commands.app import app, say
from helio_jax.commands.door import is_quiet

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


def test_warnings_and_errors_stay(capsys):
    """Catches a warning that is lost, which would hide that data contradict a height map."""
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
