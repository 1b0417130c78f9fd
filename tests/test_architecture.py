"""The structure of the package: who may import whom, and where the one door to each heavy library is.

Each level may import only from levels below; stages of one level are blind to one another:
commands > workflows > figures > measure, scores, inverse, calibration, alignment, planning > forward, trace, formats >
scene > nouns > settings, arrays, kernel, block_fit > errors, spelling, validity.
"""

import ast
import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "helio_jax"
LEVELS = [
    {"errors", "spelling", "validity", "texts", "cpus"},
    {"arguments", "arrays", "settings", "kernel", "robust", "block_fit", "drawable", "child"},
    {"detector", "campaign"},
    {"instrument"},
    {"micrograph", "heightmap", "reconstruction", "geometry_prior"},
    {"scene"},
    {"trace", "forward", "formats"},
    {"inverse", "calibration", "alignment", "scores", "measure", "planning"},
    {"figures"},
    {"workflows"},
    {"commands"},
    {"__main__", "__init__"},
]
LEVEL = {name: i for i, names in enumerate(LEVELS) for name in names}
STAGES = LEVELS[6] | LEVELS[7]
DOORS = {
    "embreex": {"trace/intersect.py"},
    "trimesh": {"scene/sample.py", "scene/meshes.py"},
    "h5py": {"formats/hdf5.py"},
    "pymatreader": {"formats/matlab.py"},
    "pooch": {"formats/fetch.py"},
    "optimistix": {"inverse/solver.py"},
    "distributed": {"trace/scan.py"},
    "rich": {"commands/app.py"},
    "manifold3d": {"scene/drill.py"},
    "matplotlib": {"figures/canvas.py"},
    "plotly": {"figures/interactive.py"},
    "xarray": {"formats/as_xarray.py"},
    "platformdirs": {"workflows/compilation_cache.py"},
    "numba": {"kernel.py", "trace/random.py"},
}
FOLDERS = {
    "jax": {"forward", "inverse", "calibration", "workflows/doctor.py"},
    "equinox": {"forward", "inverse", "calibration"},
    "llvmlite": {"trace"},
    "typer": {"commands"},
}
SOFT_LINES = 400
FILES = sorted(ROOT.rglob("*.py"))


def imports(source: str) -> list[str]:
    """Return the full name of every imported module in a source text; a relative import begins with a dot."""
    out = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            out += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            out += [f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names]
    return out


def package_attributes(source: str) -> set[str]:
    """Return which public names are reached through `import helio_jax; helio_jax.NAME`."""
    nodes = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]
    return {node.attr for node in nodes if node.value.id == "helio_jax"} - {"__version__"}


def _layer_problem(place: str, part: str, name: str) -> str | None:
    """Return what is wrong with one import from within the package."""
    _, *rest = name.split(".")
    if not rest or rest[0] == part or rest[0] == "__version__":
        return None
    if rest[0] not in LEVEL:
        home = "import it from its own module"
        return None if part == "commands" else f"{place} imports {name} through the package's front door: {home}"
    if part in STAGES and LEVEL[rest[0]] == LEVEL[part]:
        return f"{place} imports {name}: stages are blind to one another, only workflows/ joins them"
    if LEVEL[rest[0]] >= LEVEL[part]:
        return f"{place} imports {name}, which lies above or beside it: move what both need down, or join in workflows/"
    return None


def problems(place: str, source: str) -> list[str]:
    """Return what is wrong with the imports of one file, and where each belongs."""
    out = []
    part = place.split("/")[0].removesuffix(".py")
    if part not in LEVEL:
        return [f"{place} has no level: add {part!r} to LEVELS here"]
    for name in imports(source):
        head = name.split(".")[0]
        if head in DOORS and place not in DOORS[head]:
            out.append(f"{place} imports {head}, whose only door is {sorted(DOORS[head])}")
        if head in FOLDERS and not {place, place.split("/")[0]} & FOLDERS[head]:
            out.append(f"{place} imports {head}, which belongs to {sorted(FOLDERS[head])}")
        if name == "__future__.annotations":
            out.append(f"{place}: __future__.annotations defeats the shape checks")
        if not head:
            out.append(f"{place} imports {name}: write helio_jax.FOLDER.MODULE, so that levels can be seen")
        if head == "helio_jax" and (problem := _layer_problem(place, part, name)):
            out.append(problem)
    if part != "commands":
        out += [f"{place} uses helio_jax.{name}: import it from its own module" for name in package_attributes(source)]
    if "jax.config.update" in source:
        out.append(f"{place} switches JAX globally: use `with jax.enable_x64(True)`")
    return out


def module_graph(sources: dict[str, str]) -> dict[str, set[str]]:
    """Return for every module which modules of the package it imports, at the top of the file or inside a function."""
    graph = {}
    for module, source in sources.items():
        names = {part for name in imports(source) for part in (name, name.rpartition(".")[0])}
        graph[module] = (names & set(sources)) - {module}
    return graph


def late_bindings(source: str) -> list[str]:
    """Return texts that name a module of the package and may be imported by name, past the rules above."""
    texts = [n.value for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    return [t for t in texts if re.fullmatch(r"helio_jax(\.\w+)+", t)]


def find_cycle(graph: dict[str, set[str]]) -> list[str]:
    """Return one cycle of imports, or nothing."""
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module in done:
            return []
        for other in sorted(graph[module]):
            if cycle := visit(other, [*path, module]):
                return cycle
        done.add(module)
        return []

    return next((cycle for module in sorted(graph) if (cycle := visit(module, []))), [])


def truth_imports(source: str) -> list[str]:
    """Return what a file of `inverse` imports that knows the truth: scorer, scene, tracer, or what joins them."""
    forbidden = {"scores", "figures", "scene", "trace", "workflows"}
    return [n for n in imports(source) if n.startswith("helio_jax.") and n.split(".")[1] in forbidden]


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_and_size(path):
    """Catches an upward or sideways import, a second door to a heavy library, a global switch; warns of long files."""
    text = path.read_text(encoding="utf-8")
    assert problems(path.relative_to(ROOT).as_posix(), text) == []
    n_lines = len(text.splitlines())
    if n_lines > SOFT_LINES:
        warnings.warn(f"{path.name} has {n_lines} lines, soft limit {SOFT_LINES}: split it by idea", stacklevel=1)


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("inverse/fit.py", "from helio_jax.scores.metrics import Truth"),
        ("trace/run.py", "from helio_jax.forward.render import render"),
        ("scene/scan.py", "import helio_jax.workflows.pipeline"),
        ("scores/metrics.py", "import h5py"),
        ("measure/facets.py", "import plotly.graph_objects as go"),
        ("inverse/linear.py", "def f():\n    from matplotlib import pyplot"),
        ("figures/panel.py", "def f():\n    from matplotlib.figure import Figure"),
        ("figures/report.py", "import plotly.graph_objects as go"),
        ("inverse/linear.py", "import optimistix"),
        ("inverse/linear.py", "from numba import njit"),
        ("trace/run.py", "import embreex"),
        ("scene/surfaces.py", "import trimesh"),
        ("formats/hdf5.py", "from pymatreader import read_mat"),
        ("trace/tally.py", "import jax.numpy as jnp"),
        ("instrument.py", "from helio_jax.micrograph import MicrographStack"),
        ("errors.py", "from helio_jax.arrays import pitch"),
        ("trace/run.py", "from helio_jax import evaluate"),
        ("inverse/methods.py", "from helio_jax import true_height"),
        ("inverse/methods.py", "import helio_jax\ntruth = helio_jax.true_height"),
        ("inverse/methods.py", "from ..evaluate import metrics"),
        ("inverse/methods.py", "from __future__ import annotations"),
        ("inverse/methods.py", "import jax\njax.config.update('jax_enable_x64', True)"),
        ("utils.py", "x = 1"),
    ],
)
def test_checker_sees_violations(place, source):
    """The checker itself: each of these must be refused, and the message names the file."""
    found = problems(place, source)
    assert found and all(place in message for message in found)


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("workflows/scene_file.py", "from helio_jax.inverse.settings import ReconstructSettings"),
        ("trace/run.py", "from helio_jax.trace.tally import Tally"),
        ("formats/hdf5.py", "import h5py\nimport helio_jax\nversion = helio_jax.__version__"),
        ("commands/heights.py", "from helio_jax import read"),
    ],
)
def test_checker_lets_the_rest_pass(place, source):
    """Catches a checker that refuses everything."""
    assert problems(place, source) == []


def test_no_import_cycle():
    """No module needs itself through others, not even through an import inside a function; and the finder finds one."""
    modules = {}
    for path in FILES:
        name = ".".join(("helio_jax", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        modules[name] = path.read_text(encoding="utf-8")
    front_door = "helio_jax"  # every module imports it implicitly, and it imports nothing of the package
    assert find_cycle(module_graph({k: v for k, v in modules.items() if k != front_door})) == []
    assert [n for n in imports(modules[front_door]) if n.startswith("helio_jax")] == []
    bad = {"p.a": "from p.b import f", "p.b": "import p.c", "p.c": "def g():\n    from p import a"}
    assert find_cycle(module_graph(bad)) == ["p.a", "p.b", "p.c", "p.a"]


def test_late_binding_has_one_place():
    """Only `drawable` names modules above it as texts: those behind `plot()` and `to_xarray()`.

    Catches a hidden upward import.
    """
    found = {p.relative_to(ROOT).as_posix(): late_bindings(p.read_text(encoding="utf-8")) for p in FILES}
    assert {place: names for place, names in found.items() if names} == {
        "drawable.py": ["helio_jax.workflows.show", "helio_jax.figures.notebook", "helio_jax.formats.as_xarray"]
    }


def test_truth_stays_out_of_inverse():
    """No truth may enter a reconstruction: nothing of the scorer, its settings, the scene or the tracer is there."""
    for path in (ROOT / "inverse").rglob("*.py"):
        assert truth_imports(path.read_text(encoding="utf-8")) == [], path
    assert truth_imports("def f():\n    from helio_jax.scores.settings import TruthSettings")


def provenance_reads(source: str) -> list[int]:
    """Return the lines that use `x.provenance` other than by copying it whole: `{**p}`, `dict(p)`, `provenance=p`."""
    tree, copied = ast.parse(source), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            copied |= {id(value) for key, value in zip(node.keys, node.values, strict=True) if key is None}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict":
            copied |= {id(value) for value in node.args}
        elif isinstance(node, ast.keyword) and node.arg == "provenance":
            copied.add(id(node.value))
    attributes = [n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr == "provenance"]
    return [node.lineno for node in attributes if id(node) not in copied]


def test_provenance_is_history():
    """No step depends on it: only files, pictures and commands read its keys. A typed record on the noun steers."""
    for path in FILES:
        place = path.relative_to(ROOT)
        if place.parts[0] not in ("formats", "figures", "commands"):
            assert provenance_reads(path.read_text(encoding="utf-8")) == [], f"{place}: add a field to the noun instead"
    for read in ("s.provenance['a']", "s.provenance.get('a')", "'a' in s.provenance", "p = s.provenance"):
        assert provenance_reads(read) == [1]
    assert provenance_reads("f({**s.provenance, 'a': 1}, dict(s.provenance), provenance=s.provenance)") == []


def loaded_by(code: str) -> set[str]:
    """Return the heavy packages that a fresh interpreter has loaded after `code`."""
    heavy = ("jax", "numba", "trimesh", "h5py", "matplotlib", "plotly", "scipy")
    script = f"import sys\n{code}\nprint('loaded:', *[m for m in {heavy!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(run.stdout.splitlines()[-1].split()[1:])


def test_imports_are_lazy():
    """`import helio_jax` and `helio --help` load no heavy package; loading a scene no JAX and no tracer.

    `helio --help` lists all commands and makes none, which saves a quarter of its time. Catches a slow `helio --help`.
    """
    assert loaded_by("import helio_jax") == set()
    assert loaded_by("import helio_jax.__main__") == set()
    command = "import runpy; sys.argv = ['helio', '--help']"
    run_main = "try:\n    runpy.run_module('helio_jax', run_name='__main__')\nexcept SystemExit:\n    pass"
    made = "from helio_jax.commands.group import COMMANDS\nassert len(COMMANDS) > 30 and not COMMANDS._made"
    assert loaded_by(f"{command}\n{run_main}\n{made}") == set()
    scene = ROOT.parent / "scenes" / "sphere_a.toml"
    loaded = loaded_by(f"import helio_jax; helio_jax.load_scene({str(scene)!r})")
    assert loaded & {"jax", "numba", "trimesh", "h5py", "matplotlib", "plotly"} == set()
    assert "scipy" in loaded_by("import scipy")  # the probe itself
