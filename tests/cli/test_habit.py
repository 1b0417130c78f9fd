"""Habits of a command line: --quiet (results, warnings and errors stay), completion of words by the shell."""

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
def test_every_command_has_it(name):
    """Catches a command that is registered without the common options."""
    assert "--quiet" in {option for param in COMMANDS[name].params for option in param.opts}


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
