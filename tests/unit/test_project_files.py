"""README, gate, constraints and citation agree with each other and with the program."""

import os
import re
import shlex
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import helio_jax

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GATE = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
FRESH = "python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e"


def fresh_machine_commands() -> list[str]:
    """Return what the README's copy-paste lines run after the installation, without the environment's folder."""
    lines = [line.removeprefix(FRESH).split("&&") for line in README.splitlines() if line.startswith(FRESH)]
    return [last.strip().removeprefix(".venv/bin/") for _, *rest in lines for last in rest]


def shell_commands(name: str) -> list[list[str]]:
    """Return the words of every command of that name in the README's shell blocks."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    lines = [part for block in blocks for line in block.splitlines() for part in re.split("&&|;", line.split("  #")[0])]
    words = [shlex.split(line, comments=True) for line in lines]
    return [w for w in words if w and Path(w[0]).name == name]


def test_gate_runs_the_readmes_test_command():
    """Catches a gate that tests something else than a contributor does."""
    run, test = fresh_machine_commands()
    assert run == "helio run scenes/sphere_a.toml" and test == "python -m pytest -n 2 --dist worksteal"
    assert f".ci-venv/bin/{test}\n" in GATE and "-c constraints.txt -e '.[test]'" in GATE
    assert GATE.rstrip().endswith(test)  # pytest's closing line is the last thing that is printed
    for tool in ("ruff format --check", "ruff check", "pyright"):
        assert f".ci-venv/bin/{tool}" in GATE


def test_gate_is_portable():
    """Executable; no machine's path and no host's name. Catches a gate that passes on its author's machine alone."""
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    for text in (GATE.split("\n", 1)[1], (ROOT / "constraints.txt").read_text(encoding="utf-8")):
        assert not re.search(r"://|index-url|find-links|(?<![.\w])/(?:work|home|root|opt|usr|tmp)/", text)


def test_constraints_pin_versions_of_everything():
    """Each line is name==version; all dependencies, and those for the tests, are named, at an allowed version.

    Catches hashes, URLs and editable lines, and a dependency added to the project but not to the file.
    """
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    pins = [Requirement(line) for line in lines]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in lines)
    pinned = {canonicalize_name(r.name): next(iter(r.specifier)).version for r in pins}
    for text in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["test"]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pinned[canonicalize_name(wanted.name)]), text


@pytest.mark.parametrize("words", shell_commands("helio"), ids=" ".join)
def test_readme_commands_exist(words):
    """Every `helio` command and option in the README is one of the program. Catches a README ahead of the program."""
    from typer.main import get_command

    from helio_jax.__main__ import app

    group = get_command(app)
    if words[1].startswith("-"):
        return
    command = group.commands[words[1]]  # type: ignore[attr-defined]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words[2:] if word.startswith("-")} <= options | {"--help"}
    for word in words[2:]:
        if word.startswith("scenes/"):
            assert (ROOT / word).is_file(), word


def test_readme_names_files_that_exist():
    """Links, pictures and scripts. Catches a moved file and a picture that was never made."""
    named = re.findall(r"\]\(([^)#]+)\)|\b((?:benchmarks|tests|docs|scenes)/[\w/.-]+\.\w+)", README)
    names = {a or b for a, b in named if "://" not in (a or b)}
    missing = sorted(name for name in names if not (ROOT / name).exists())
    assert names and not missing, f"README.md names {missing}, which are not there"


def test_readme_maps_every_module():
    """Each file and folder of the package is in the reading order. Catches a module that a newcomer would not find."""
    table = README.split("## Reading order")[1].split("\n## ")[0]
    named = re.findall(r"[\w*]+", table)
    for path in (ROOT / "helio_jax").rglob("*.py"):
        of = path.stem if path.stem != "__init__" else path.parent.name
        if of != "helio_jax":
            assert any(fnmatch(of, name) for name in named), f"{path} is not in the README's reading order"


def test_one_version():
    """Package, project file and citation agree."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert citation.startswith("cff-version: 1.2.0\n")
    assert PROJECT["version"] == helio_jax.__version__
    assert f"\nversion: {helio_jax.__version__}\n" in citation


def test_tests_named_as_sources_exist():
    """A docstring that names a test as its source names a file. Catches a promise that was never kept."""
    for path in sorted((ROOT / "helio_jax").rglob("*.py")):
        for name in re.findall(r"\btests/[\w/]+\.py", path.read_text(encoding="utf-8")):
            assert (ROOT / name).is_file(), f"{path.relative_to(ROOT)} names {name}, which is not there"
