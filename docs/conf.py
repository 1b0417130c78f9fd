"""The documentation site, made by Sphinx from the Markdown pages, the notebooks and the program.

`sphinx-build -W -c docs . helio-out/site`, from the repository's root: links between pages are the same on GitHub and
on the site. Reference pages come from docs/reference.py, the menu from the tables of docs/README.md.
"""

import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

import reference  # noqa: E402

import helio_jax  # noqa: E402

project = "helio_jax"
author = copyright = "The helio_jax developers"
version = release = helio_jax.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/README"
include_patterns = ["*.md", "docs/*.md", "notebooks/*.ipynb"]
exclude_patterns = [".*", "helio_jax", "tests", "scenes", "benchmarks", "helio-out", "build", "dist"]
html_theme = "furo"
html_title = f"helio_jax {version}"
html_show_sourcelink = False
html_copy_source = False
myst_heading_anchors = 6
smartquotes = False  # "--option" stays as it is
toc_object_entries = False
default_role = "literal"  # docstrings are Markdown: `name`
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
measured = [
    p for p in sorted((DOCS.parent / "notebooks").glob("*.ipynb")) if '"needs": "measured data"' in p.read_text()
]
nb_execution_excludepatterns = [] if "HELIO_DATA" in os.environ else [f"notebooks/{path.name}" for path in measured]
nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS.parent / "helio-out" / "notebooks")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
os.environ.setdefault("HELIO_FAST", "1")  # notebooks on small rasters; HELIO_FAST=0 runs them as they are


def insert(app, docname, source):
    """Replace the marks of a page by what the program says; add the menu to the first page."""
    source[0] = re.sub(r"<!-- insert: (\w+) -->", lambda mark: getattr(reference, mark[1])(), source[0])
    if docname == root_doc:
        source[0] += menu(source[0])


def menu(text):
    """Make the menu from the first page: a part for each heading, an entry for each row of its table."""
    parts = []
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        pages = re.findall(r"^\| \[[^]]*\]\(([^)]+)\.(?:md|ipynb)\)", section, flags=re.MULTILINE)
        title = section.split("\n")[0]
        parts.append("\n".join(["\n```{toctree}", ":hidden:", f":caption: {title}", *pages, "```\n"]))
    return "\n".join(parts)


def escape_docstring(app, what, name, obj, options, lines):
    """Escape what reStructuredText would read as markup outside of `code`, or napoleon as the type of a property."""
    if what == "property":
        lines[:0] = ["..", ""]
    for i, line in enumerate(lines):
        lines[i] = "`".join(
            part if k % 2 else re.sub(r"([*|_])(?=\W|$)", r"\\\1", part) for k, part in enumerate(line.split("`"))
        )


def add_index(app, error):
    """Let a folder's index.html be the first page."""
    if not error and app.builder.name == "html":
        (Path(app.outdir) / "index.html").write_text(
            '<meta http-equiv="refresh" content="0; url=docs/README.html"><a href="docs/README.html">helio_jax</a>\n'
        )


def setup(app):
    """Connect them."""
    app.connect("source-read", insert)
    app.connect("autodoc-process-docstring", escape_docstring, priority=400)  # before napoleon
    app.connect("build-finished", add_index)
