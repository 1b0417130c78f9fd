"""The docs' table of formats is that of the program, and the docs' recipe adds a format in three places."""

import filecmp
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = "docs/exports.md"
COPIED = ("helio_jax", "tests/conftest.py", "tests/formats", "scenes", "docs", "pyproject.toml")
PLACES = {
    "helio_jax/formats/write_arrays.py": "",
    "helio_jax/formats/export_formats.py": ")\n\nSUFFIXES =",
    "tests/formats/second_readers.py": "",
}
"""Files that the recipe names, and the text before which its code goes as a row; none: at the end."""
MAX_PLACES = 3


def run(folder: Path, *words: str) -> str:
    """Run Python on the project in a folder and return what it printed; fails unless it ends well."""
    paths = [str(folder), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=env, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def copy_project(folder: Path) -> None:
    """Copy what exports, their tests and docs need."""
    for name in COPIED:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)


def follow(step: str, file: Path, before: str) -> None:
    """Put the code of one step of the recipe into its file."""
    code = re.search(r"```python\n(.*?)```", step, re.DOTALL)
    assert code
    source = file.read_text(encoding="utf-8")
    if before:
        assert source.count(before) == 1
        row = textwrap.indent(code[1].rstrip(), "    ") + ",\n"
        file.write_text(source.replace(before, row + before), encoding="utf-8")
    else:
        file.write_text(f"{source}\n\n{code[1]}", encoding="utf-8")


def test_docs_have_the_table_of_the_program(tmp_path):
    """Catches a row that was changed in the program alone."""
    copy_project(tmp_path)
    run(tmp_path, "docs/export_table.py")
    page = (ROOT / PAGE).read_text(encoding="utf-8")
    assert "| `.x3p` | X3P |" in page
    assert (tmp_path / PAGE).read_text(encoding="utf-8") == page, "run: python docs/export_table.py"


def test_a_format_is_added_by_the_recipe(tmp_path):
    """The docs' example is followed to the letter on a copy: three files change, and all tests of formats pass.

    Catches a recipe that has aged, and a fourth place that a new format would need.
    """
    recipe = (ROOT / PAGE).read_text(encoding="utf-8").split("\n## Add a format\n")[1]
    steps = re.split(r"^\d\. ", recipe, flags=re.MULTILINE)[1:]
    assert len(steps) == len(PLACES) <= MAX_PLACES
    copy_project(tmp_path)
    for step, (place, before) in zip(steps, PLACES.items(), strict=True):
        assert f"`{place}`" in step
        follow(step, tmp_path / place, before)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    changed = [p for p in files if not filecmp.cmp(p, ROOT / p.relative_to(tmp_path), shallow=False)]
    assert sorted(p.relative_to(tmp_path).as_posix() for p in changed) == sorted(PLACES)
    run(tmp_path, "docs/export_table.py")
    assert "| `.asc` | ASC | heights, one image | um |" in (tmp_path / PAGE).read_text(encoding="utf-8")
    assert ".asc" in run(tmp_path, "-m", "helio_jax", "export", "--help")
    tests = ("-m", "pytest", "-p", "no:cacheprovider", "tests/formats/test_export_formats.py", "-k", "asc or second")
    passed = re.search(r"(\d+) passed", run(tmp_path, *tests))
    assert passed and int(passed[1]) >= 5
