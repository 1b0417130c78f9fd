"""The README's tour and Python example run as they are written, on a sphere of 21 x 21 pixels."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import helio_jax as hx

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SMALL = {"nx = 121": "nx = 21", "ny = 121": "ny = 21", "pixel_size_um = 30.0": "pixel_size_um = 170.0"}
"""The same field of view on fewer pixels; keys of scenes/sphere_a.toml."""


def code_block(title: str, language: str) -> str:
    """Return the first code block of a language below a heading of the README."""
    section = README.split(f"\n## {title}\n")[1].split("\n## ")[0]
    found = re.search(rf"```{language}\n(.*?)```", section, re.DOTALL)
    assert found, f"README.md has no {language} block below {title!r}"
    return found[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with the project's scenes, of which sphere A is small."""
    out = tmp_path_factory.mktemp("tour")
    shutil.copytree(ROOT / "scenes", out / "scenes")
    scene = out / "scenes" / "sphere_a.toml"
    text = scene.read_text(encoding="utf-8")
    for key, value in SMALL.items():
        assert key in text
        text = text.replace(key, value)
    scene.write_text(text, encoding="utf-8")
    return out


def test_tour(folder):
    """Each line ends with exit code 0 and leaves the file that it names; at most ten lines.

    Catches an option or a file kind that a later line does not take from an earlier one.
    """
    lines = code_block("Tour", "sh").splitlines()
    assert 0 < len(lines) <= 10
    for line in lines:
        command, *words = line.split("#")[0].split()
        assert command == "helio"
        done = subprocess.run(
            [sys.executable, "-m", "helio_jax", *words],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, f"{line}\n{done.stderr}"
        if "-o" in words:
            assert (folder / words[words.index("-o") + 1]).stat().st_size > 0, line


def test_python_example(folder, monkeypatch):
    """The example runs, its comments state the right shapes, and its derivatives are finite.

    Catches a public interface that moved on, and an optics record with a number that is no leaf.
    """
    if not hasattr(hx, "render"):
        pytest.skip("hx.render is not part of this version")
    import jax
    import numpy as np

    monkeypatch.chdir(folder)
    names: dict = {}
    exec(compile(code_block("Python", "python"), "README.md", "exec"), names)
    shape = names["stack"].counts.shape
    assert names["rec"].height.shape == shape[1:] and names["counts"].shape == shape
    ratio = np.median(names["counts"], axis=(1, 2)) / np.median(names["stack"].by_order[0], axis=(1, 2))
    assert np.ptp(ratio) < 0.05 * ratio.mean()  # the substrate: probability times one number of atoms
    leaves = jax.tree.leaves(names["gradient"])
    assert leaves and all(np.all(np.isfinite(leaf)) for leaf in leaves)
    assert any(np.any(np.asarray(leaf) != 0.0) for leaf in leaves)
