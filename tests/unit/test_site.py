"""The documentation site builds without a warning and holds every public name, scene key and command; its drawings."""

import html
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import pytest
from pydantic import BaseModel

import helio_jax as hx
from helio_jax.__main__ import app
from helio_jax.workflows.scene_file import SceneFile

ROOT = Path(__file__).resolve().parents[2]


def module(name: str) -> ModuleType:
    """Load a script of docs/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec and spec.loader
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, warnings being errors; notebooks, which the gate executes, are shown without outputs."""
    pytest.importorskip("sphinx", reason="pip install 'helio-jax[docs]'")
    out = tmp_path_factory.mktemp("site")
    words = ("-m", "sphinx", "-W", "-q", "-D", "nb_execution_mode=off", "-d", str(out / "doctrees"), "-c", "docs", ".")
    done = subprocess.run(
        [sys.executable, *words, str(out / "html")], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and not done.stderr, done.stdout + done.stderr
    return out / "html"


def text(site: Path, name: str) -> str:
    return html.unescape((site / "docs" / f"{name}.html").read_text(encoding="utf-8"))


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """Return the models that a field may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    return {model for part in get_args(annotation) for model in models_in(part)}


def models_below(model: type[BaseModel]) -> set[type[BaseModel]]:
    """Return a model and all models of the tables within it."""
    found, new = set(), {model}
    while new:
        found |= new
        new = {m for one in new for f in one.model_fields.values() for m in models_in(f.annotation)} - found
    return found


@pytest.mark.slow
def test_every_public_name_is_there(site):
    """Catches a name that the lazy loader has and the page lacks, and one without a description."""
    page = text(site, "api")
    for name in hx.__all__:
        entry = page.split(f'id="helio_jax.{name}"')
        assert len(entry) == 2 and re.search(r"<p>\w", entry[1][:20_000]), name


@pytest.mark.slow
def test_every_scene_key_is_there(site):
    """Each key of each table and kind stands below its head, with its meaning. Walks the models, not the schema.

    Catches a kind that the page leaves out, and a key without a description.
    """
    sections = re.findall(r"<h\d>(.*?)<a.*?</h\d>(.*?)(?=<h\d>|\Z)", text(site, "scene_keys"), re.DOTALL)
    tables = [
        set(re.findall(r'<tr class="row-\w+"><td><p><code[^>]*><span class="pre">(\w+)<', body)) for _, body in sections
    ]
    models = models_below(SceneFile) - {SceneFile}
    assert len(models) > 30
    for model in models:
        assert set(model.model_fields) in tables, model.__name__
        plain = {name: f for name, f in model.model_fields.items() if name != "kind" and not models_in(f.annotation)}
        assert not [name for name, field in plain.items() if not field.description], model
    heads = " ".join(head for head, _ in sections)
    for table in (
        "beam",
        "plate",
        "uncertainty",
        "covariance",
        "[detector]",
        "sample",
        "scan",
        "material.NAME",
        "trace",
    ):
        assert f"[{table}]" in heads, table


@pytest.mark.slow
def test_every_command_and_option_is_there(site):
    """Catches a command that the page lacks."""
    from typer.main import get_command

    page = re.sub(r"<[^>]+>", "", text(site, "commands"))
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        section = page.split(f"\nhelio {name} ")[1]
        assert (command.help or "").split(".")[0].split("\n")[0] in section
        for option in (o for p in command.params for o in p.opts if o.startswith("--")):
            assert option in section[:20_000], (name, option)


@pytest.mark.slow
def test_site_is_complete_and_works_offline(site):
    """All pages are in the menu; no script, style, font or picture comes from elsewhere; local links have a target.

    Catches a page that no reader finds, a script from the network, and a link that works on GitHub alone.
    """
    pages = sorted(site.rglob("*.html"))
    menu = (site / "docs" / "README.html").read_text(encoding="utf-8")
    for path in {*(ROOT / "docs").glob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")} - {ROOT / "docs" / "README.md"}:
        assert re.search(rf'class="reference internal" href="[^"]*{path.stem}\.html"', menu), path.name
        assert (site / path.relative_to(ROOT).with_suffix(".html")).is_file()
    assert (site / "index.html").is_file() and len(pages) > 30
    for page in pages:
        source = re.sub(r"<pre.*?</pre>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        loaded = re.findall(r'(?:src|(?<=stylesheet" )href|(?<=text/css" )href)="([^"]+)"', source)
        linked = re.findall(r'href="(?!https?:|mailto:|#)([^"#?]+)', source)
        for target in [*loaded, *linked]:
            assert "//" not in target, (page.name, target)
            assert (page.parent / target.split("?")[0]).exists(), (page.name, target)


def test_drawings_are_those_of_the_program():
    """Catches an instrument whose frames have moved, and a drawing that was changed by hand."""
    for name, svg in module("drawings").drawings().items():
        assert (ROOT / "docs" / name).read_text(encoding="utf-8") == svg, "run: python docs/drawings.py"
        assert f"({name})" in (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")


def test_reference_lists_follow_the_models():
    """A key, its limits and its default as a person reads them. Catches limits that are left out or swapped."""
    keys = module("reference").scene_keys()
    assert (
        "| `incidence_deg` | number >= 0, <= 80 | `0.0` | Angle t between the beam and the plate normal \\[deg]. |"
        in keys
    )
    assert "| `radius_um` | number > 0, <= 1e+06 | required |" in keys
    assert '### [sample], kind = "spheres"' in keys and "#### [[sample.spheres]]" in keys
