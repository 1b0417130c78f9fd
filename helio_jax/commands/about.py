"""Informational commands: info, doctor, fetch-data, cite."""

import json
import textwrap
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import AsJson, app
from helio_jax.commands.door import Reads, Writes


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="File written by helio (.h5)."), Reads()], as_json: AsJson = False
) -> None:
    """Say what a file holds, where it came from and how it was made."""
    from helio_jax.formats.hdf5 import describe

    found = describe(file)
    if as_json:
        print(json.dumps(found))
        return
    print(f"{found['file']}: {found['kind']}, {found['bytes']:,} bytes, written {found['created']}")
    for name, entry in found["entries"].items():
        print(f"{name or 'entry'}:")
        for place, field in entry["fields"].items():
            shape = " x ".join(map(str, field.get("shape", ()))) or "scalar"
            print(f"  {place:<24} {shape:<18} {field.get('unit', ''):<10} {field.get('long_name', '')}".rstrip())
        for key in ("instrument", "calibration", "alignment", "materials", "provenance"):
            if entry.get(key):
                print(f"  {key}:")
            for name, value in (entry.get(key) or {}).items():
                print(f"    {name}: {textwrap.shorten(json.dumps(value), 300, placeholder=' ... (--json: all)')}")


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
) -> None:
    """Download the paper's public micrographs (CC BY-SA), check their SHA-256 and print their paths."""
    from helio_jax.formats.fetch import CITATION, fetch_pack

    for path in fetch_pack(output):
        print(path)
    print(CITATION)


@app.command()
def cite() -> None:
    """Print the citations of this program and of the underlying papers."""
    from helio_jax.figures.report import CITATION

    print("\n".join(CITATION))
