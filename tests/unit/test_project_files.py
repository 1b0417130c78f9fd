"""README, docs, module map, gate, constraints and citation agree with each other and with the program."""

import ast
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import helio_jax

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "helio_jax"
README = (ROOT / "README.md").read_text(encoding="utf-8")
GATE = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
FRESH = "python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e"
OWN_DEPENDENCIES = {"charset-normalizer", "filelock"}
"""Declared though nothing imports them: trimesh needs the first for text meshes, JAX's bounded cache the second."""
IMPORT_NAMES = {"distributed": "dask"}
"""Distribution of an imported package, where it has another name."""


def fresh_machine_commands() -> list[str]:
    """Return what the README's copy-paste lines run after the installation, without the environment's folder."""
    lines = [line.removeprefix(FRESH).split("&&") for line in README.splitlines() if line.startswith(FRESH)]
    return [last.strip().removeprefix(".venv/bin/") for _, *rest in lines for last in rest]


def helio_commands() -> list[tuple[str, list[str]]]:
    """Return page and words of every `helio` command in shell blocks and inline code of README and docs."""
    out = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
        lines = [line.split("  #")[0] for block in blocks for line in block.splitlines()]
        lines += [line.replace("\n", " ") for line in re.findall(r"`(helio [^`]+)`", prose)]
        for part in (part for line in lines for part in re.split("&&|;", line)):
            words = shlex.split(part, comments=True)
            if len(words) > 1 and Path(words[0]).name == "helio" and words[1].islower() and words[1][0] != "-":
                out.append((page.name, words))
    return out


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub forms them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_gate_runs_the_readmes_test_command():
    """Catches a gate that tests something else than a contributor does."""
    run, test = fresh_machine_commands()
    assert run == "helio run scenes/sphere_a.toml" and test == "python -m pytest -n 2 --dist worksteal"
    assert f".ci-venv/bin/{test}\n" in GATE and "-c constraints.txt -e '.[test,docs]'" in GATE
    assert GATE.rstrip().endswith(test)  # pytest's closing line is the last thing that is printed
    for tool in ("ruff format --check", "ruff check", "pyright", "sphinx-build -W"):
        assert f".ci-venv/bin/{tool}" in GATE


def test_gate_is_portable():
    """Executable; no machine's path and no host's name. Catches a gate that passes on its author's machine alone."""
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    for text in (GATE.split("\n", 1)[1], (ROOT / "constraints.txt").read_text(encoding="utf-8")):
        assert not re.search(r"://|index-url|find-links|(?<![.\w])/(?:work|home|root|opt|usr|tmp)/", text)


def test_constraints_pin_versions_of_everything():
    """Each line is name==version; all dependencies, and those for tests and docs, are named, at an allowed version.

    Catches hashes, URLs and editable lines, and a dependency added to the project but not to the file.
    """
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    pins = [Requirement(line) for line in lines]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in lines)
    pinned = {canonicalize_name(r.name): next(iter(r.specifier)).version for r in pins}
    extras = PROJECT["optional-dependencies"]
    for text in PROJECT["dependencies"] + extras["test"] + extras["docs"]:
        wanted = Requirement(text)
        assert wanted.specifier.contains(pinned[canonicalize_name(wanted.name)]), text


def test_dependencies_are_those_that_are_imported():
    """Catches an import that only another package's dependency provides, and a dependency that nobody imports."""
    found: set[str] = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found |= {name.split(".")[0] for name in names}
    found -= {*sys.stdlib_module_names, "helio_jax"}
    imported = {canonicalize_name(IMPORT_NAMES.get(name, name)) for name in found}
    required = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    extras = PROJECT["optional-dependencies"]
    optional = {canonicalize_name(Requirement(t).name) for k in ("dask", "plates", "xarray") for t in extras[k]}
    assert imported - required - optional == set(), "imported, but not in pyproject.toml"
    assert required - imported - OWN_DEPENDENCIES == set(), "in pyproject.toml, but not imported"
    assert optional - imported == set()


def test_readme_is_short():
    """At most 900 words, code included. Catches a README that grows into a manual."""
    assert len(README.split()) <= 900


@pytest.mark.parametrize(
    ("page", "words"), helio_commands(), ids=lambda value: value if isinstance(value, str) else " ".join(value)
)
def test_documented_commands_exist(page, words):
    """Every `helio` command, option and scene in README and docs is there. Catches docs ahead of the program."""
    from typer.main import get_command

    from helio_jax.__main__ import app

    group = get_command(app)
    command = group.commands[words[1]]  # type: ignore[attr-defined]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word.split("=")[0] for word in words[2:] if word.startswith("--") or word == "-o"} <= options | {"--help"}
    for word in words[2:]:
        if word.startswith("scenes/") and word.isascii() and "*" not in word:
            assert (ROOT / word).is_file(), word


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page):
    """Links with their anchors, pictures, scripts and tests. Catches a moved file and a renamed heading."""
    text = page.read_text(encoding="utf-8")
    missing = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            missing.append(target)
    for name in re.findall(r"\b(?:helio_jax|benchmarks|tests|docs|scenes|notebooks)/[\w/.-]+\.\w+", text):
        if not (ROOT / name).exists():
            missing.append(name)
    assert not missing, f"{page.name} names {missing}, which are not there"


def test_every_page_is_in_the_table_of_contents():
    """Catches a page that no reader finds."""
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"({page.name})" in index, page.name


def test_conventions_name_tests_that_exist():
    """Every statement about frames ends with the test that pins it. Catches a renamed test, a statement without one."""
    section = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8").split("## Frames and units")[1]
    statements = re.findall(r"^\* (.*?)(?=^\* |^$|\Z)", section.split("\n## ")[0], re.MULTILINE | re.DOTALL)
    assert len(statements) > 15
    for statement in statements:
        assert statement.rstrip().endswith("`]."), f"no test is named: {statement}"
        for file, name in re.findall(r"`(?:([\w/]+\.py)::)?(test_\w+)`", statement):
            text = (ROOT / (file or "tests/unit/test_conventions.py")).read_text(encoding="utf-8")
            assert f"def {name}(" in text, name


def module_map() -> list[str]:
    """Return the modules, as paths within the package, that the package's docstring lists."""
    out, folder = [], ""
    for line in (helio_jax.__doc__ or "").split("Module map")[1].splitlines():
        if head := re.match(r"(\.|\w+/) {2,}\S", line):
            folder = "" if head[1] == "." else head[1]
        elif module := re.match(r"  (\w+) +\S", line):
            out.append(f"{folder}{module[1]}.py")
    return out


def test_module_map_is_complete():
    """Each module of the package is named once, below its folder; nothing else is.

    Catches a module that a newcomer would not find, and a renamed one.
    """
    named = module_map()
    there = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")} - {"__init__.py"}
    there = {name for name in there if not name.endswith("/__init__.py") or (PACKAGE / name).stat().st_size > 0}
    where = "in the docstring of helio_jax/__init__.py"
    assert not (more := sorted(there - set(named))), f"missing {where}: {', '.join(more)}"
    assert not (less := sorted(set(named) - there)), f"{where}, but not in the package: {', '.join(less)}"
    assert not (twice := sorted({name for name in named if named.count(name) > 1})), f"twice {where}: {twice}"


def test_fast_modules_exist():
    """Catches a renamed test module that silently leaves the fast subset."""
    from tests.conftest import FAST

    for folder, names in FAST.items():
        for name in names:
            assert (ROOT / "tests" / folder / f"test_{name}.py").is_file(), f"{folder}/test_{name}.py"


def test_one_version():
    """Package, project file and citation agree."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert citation.startswith("cff-version: 1.2.0\n")
    assert PROJECT["version"] == helio_jax.__version__
    assert f"\nversion: {helio_jax.__version__}\n" in citation


def test_tests_named_as_sources_exist():
    """A docstring that names a test as its source names a file. Catches a promise that was never kept."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for name in re.findall(r"\btests/[\w/]+\.py", path.read_text(encoding="utf-8")):
            assert (ROOT / name).is_file(), f"{path.relative_to(ROOT)} names {name}, which is not there"


def test_package_states_that_it_is_typed():
    """Catches a wheel whose annotations type checkers ignore (PEP 561)."""
    assert (PACKAGE / "py.typed").is_file()
