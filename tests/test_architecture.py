"""The structure of the package: who may import whom, and where the one door to each heavy library is.

Order (DESIGN.md section 5), each level may import only from levels below; the stages are blind to one another:
__main__ > pipeline > config > explain > stages > scene > nouns > settings, arrays, errors.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "helio_jax"
LEVELS = [
    {"errors"},
    {"arrays", "settings"},
    {"instrument"},
    {"micrograph", "heightmap", "reconstruction"},
    {"scene"},
    {"trace", "prepare", "reconstruct", "evaluate", "formats"},
    {"explain"},
    {"config"},
    {"pipeline"},
    {"__main__", "__init__"},
]
LEVEL = {name: i for i, names in enumerate(LEVELS) for name in names}
STAGES = LEVELS[5]
DOORS = {
    "embreex": {"trace/intersect.py"},
    "trimesh": {"scene/sample.py"},
    "h5py": {"formats/hdf5.py"},
    "pymatreader": {"formats/matlab.py"},
    "pooch": {"formats/fetch.py"},
    "matplotlib": {"evaluate/figures.py"},
    "plotly": {"evaluate/interactive.py", "evaluate/report.py"},
    "optimistix": {"reconstruct/refine.py"},
    "lineax": {"reconstruct/refine.py"},
    "rich": {"__main__.py"},
    "typer": {"__main__.py"},
}
FOLDERS = {"jax": {"reconstruct", "pipeline.py"}, "numba": {"trace"}}
FILES = sorted(ROOT.rglob("*.py"))


def imports(source: str) -> list[str]:
    """Return the full name of every imported module in a source text."""
    out = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            out += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            out += [f"{node.module}.{alias.name}" for alias in node.names]
    return out


def problems(place: str, source: str) -> list[str]:
    """Return what is wrong with the imports of one file, and where each belongs."""
    out = []
    part = place.split("/")[0].removesuffix(".py")
    for name in imports(source):
        head, *rest = name.split(".")
        if head in DOORS and place not in DOORS[head]:
            out.append(f"{place} imports {head}, whose only door is {sorted(DOORS[head])}")
        if head in FOLDERS and place.split("/")[0] not in FOLDERS[head]:
            out.append(f"{place} imports {head}, which belongs to {sorted(FOLDERS[head])}")
        if name == "__future__.annotations":
            out.append(f"{place}: __future__.annotations defeats the shape checks")
        if head == "helio_jax" and rest and rest[0] in LEVEL and rest[0] != part:
            if part in STAGES and rest[0] in STAGES:
                out.append(f"{place} imports {name}: stages are blind to one another, only pipeline joins them")
            elif LEVEL[rest[0]] >= LEVEL[part]:
                out.append(f"{place} imports {name}, which lies above or beside it")
    if "jax.config.update" in source:
        out.append(f"{place} switches JAX globally: use `with jax.enable_x64(True)`")
    return out


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_and_size(path):
    """Catches an upward or sideways import, a second door to a heavy library, a global switch, a file that grew."""
    text = path.read_text()
    assert problems(path.relative_to(ROOT).as_posix(), text) == []
    assert len(text.splitlines()) <= 450, "split the file by idea"


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("reconstruct/refine.py", "from helio_jax.evaluate.metrics import Truth"),
        ("trace/run.py", "from helio_jax.reconstruct.render import render_single"),
        ("scene/scan.py", "import helio_jax.pipeline"),
        ("evaluate/metrics.py", "import h5py"),
        ("trace/tally.py", "import jax.numpy as jnp"),
    ],
)
def test_checker_sees_violations(place, source):
    """The checker itself: each of these must be refused."""
    assert problems(place, source)


def test_truth_stays_out_of_reconstruct():
    """No truth may enter a reconstruction: nothing of the scorer, its settings or the scene is imported there."""
    for path in (ROOT / "reconstruct").glob("*.py"):
        names = [n for n in imports(path.read_text()) if n.startswith("helio_jax.")]
        assert not [n for n in names if n.split(".")[1] in {"evaluate", "scene", "trace", "config", "pipeline"}], path


def loaded_by(code: str) -> set[str]:
    """Return the heavy packages that a fresh interpreter has loaded after `code`."""
    heavy = ("jax", "numba", "trimesh", "h5py", "matplotlib", "plotly", "scipy")
    script = f"{code}\nimport sys; print(*[m for m in {heavy!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_imports_are_lazy():
    """`import helio_jax` and the command line load no heavy package; catches a slow `helio --help`."""
    assert loaded_by("import helio_jax") == set()
    assert loaded_by("import helio_jax.__main__") == set()
    assert loaded_by("import helio_jax; helio_jax.load_scene") & {"jax", "numba", "trimesh", "h5py"} == set()
