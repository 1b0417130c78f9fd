"""Informational commands: doctor, fetch-data, cite."""

import json
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import AsJson, app, print_result
from helio_jax.commands.door import Writes


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check this installation: versions, ray engine, JAX devices, a small trace."""
    from helio_jax.workflows.doctor import diagnose

    found = diagnose()
    if as_json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"  {key:<14} {value}")
    if not found["ok"]:
        raise typer.Exit(4)


@app.command("fetch-data")
def fetch_data(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder (default: the user's cache)."), Writes(within=())
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Download the paper's public micrographs (CC BY-SA), check their SHA-256 and print their paths."""
    from helio_jax.formats.fetch import CITATION, fetch_pack

    files = [str(path) for path in fetch_pack(output)]
    print_result(as_json, {"files": files, "citation": CITATION}, *files, CITATION)


@app.command()
def cite(as_json: AsJson = False) -> None:
    """Print the citations of this program and of the underlying papers."""
    from helio_jax.figures.report import CITATION

    print_result(as_json, list(CITATION), *CITATION)
