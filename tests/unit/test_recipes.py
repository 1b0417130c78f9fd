"""The recipes of docs/extend.md are followed to the letter on a copy: each needs three places at most, and works.

The recipe of a format: tests/formats/test_export_recipe.py.
"""

import filecmp
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
COPIED = ("helio_jax", "tests", "scenes", "docs", "pyproject.toml")
MAX_PLACES = 3
LAW = {
    "helio_jax/scene/scattering.py": ("class TableLaw(", "    | TableLaw\n"),
    "tests/physics/test_laws.py": ("",),
}
MEASURE = {
    "helio_jax/measure/texture_parameters.py": ('        "Sz": float(', '    "Sdq": Kind('),
    "tests/unit/test_texture.py": ("",),
}
"""The files of a recipe in their order, and the text before which each step goes; none: at the end."""


def run(folder: Path, *words: str) -> str:
    """Run Python on the project in a folder and return what it printed; fails unless it ends well."""
    paths = [str(folder), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def follow(title: str, places: dict[str, tuple[str, ...]], folder: Path) -> None:
    """Copy the project with its compiled kernels, and put each step into its place; no other file changes."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name)
        else:
            shutil.copy(ROOT / name, folder / name)
    section = PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    codes = re.findall(r"^\d\. .*?```python\n(.*?)```", section, flags=re.MULTILINE | re.DOTALL)
    steps = [(file, before) for file, several in places.items() for before in several]
    assert len(codes) == len(steps) <= MAX_PLACES
    for code, (name, before) in zip(codes, steps, strict=True):
        assert f"`{name}`" in section
        file = folder / name
        source = file.read_text(encoding="utf-8")
        if before:
            assert source.count(before) == 1, (name, before)
            gap = "\n\n" if code.startswith("class") else ""
            source = source.replace(before, code + gap + before)
        else:
            source += f"\n\n{code}"
        file.write_text(source, encoding="utf-8")
    files = [path for path in folder.rglob("*") if path.is_file()]
    changed = [p for p in files if not filecmp.cmp(p, ROOT / p.relative_to(folder), shallow=False)]
    assert sorted(p.relative_to(folder).as_posix() for p in changed) == sorted(places)


def run_test(folder: Path, place: str, name: str) -> None:
    """Run the recipe's own test."""
    assert "1 passed" in run(folder, "-m", "pytest", "-p", "no:cacheprovider", place, "-k", name)


@pytest.mark.slow
def test_a_law_is_added_by_the_recipe(tmp_path):
    """Catches a recipe that has aged, and a further place that a new law would need.

    The new kind is in the reference, a scene takes it, and the recipe's own test of draws and density passes.
    """
    follow("A scattering law", LAW, tmp_path)
    run_test(tmp_path, "tests/physics/test_laws.py", "lommel_seeliger")
    script = """
import sys; sys.path.insert(0, "docs")
import helio_jax as hx, reference
assert 'kind = "lommel_seeliger"' in reference.scene_keys()
law = {"material.m": {"kind": "lommel_seeliger"}, "sample": {"kind": "flat", "material": "m"}}
assert hx.load_scene("step", law).material["m"].terms()[0].share == 1.0
"""
    run(tmp_path, "-c", script)


@pytest.mark.slow
def test_a_measure_is_added_by_the_recipe(tmp_path):
    """Catches a recipe that has aged, and a further place that a new parameter would need.

    The new parameter has a value and a standard deviation, and `helio measure` prints it with its meaning.
    """
    follow("A measure", MEASURE, tmp_path)
    run_test(tmp_path, "tests/unit/test_texture.py", "peak_extreme")
    script = """
import numpy as np, helio_jax as hx
from tests.height_maps import make_rec
from helio_jax.workflows.measure import Wanted, measure_height_map
rec = make_rec(lambda x, y: 5.0 * np.sin(x / 50.0), n=(40, 40))
rec = rec.replace(height_std=np.full(rec.height.shape, 0.1))
_, lines = measure_height_map(rec, Wanted(texture=True))
assert any("Sxp" in line and "peak extreme height" in line for line in lines), lines
assert hx.measure_texture(rec).Sxp > 1.0 and hx.measure_texture(rec).parameters["Sxp"].std > 0.0
"""
    run(tmp_path, "-c", script)
