"""Informational commands: validate, schema, doctor, fetch-data, cite."""

import json
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import AsJson, SceneArg, app
from helio_jax.commands.door import Writes


@app.command()
def validate(scene: SceneArg) -> None:
    """Check a scene file and its sample; list all errors with key, value, limit and remedy."""
    from helio_jax.scene.plates import check_solid
    from helio_jax.scene.sample import check_body
    from helio_jax.workflows.scene_file import load_scene

    loaded = load_scene(scene)
    loaded.read_laws()
    loaded.read_rays()
    body = check_body(
        loaded.build_body(), loaded.sample.build_shape(loaded.base_dir) if loaded.sample.is_tilted else None
    )
    for key, value in body.items():
        print(f"  {key}: {value}")
    if body["n_open_edges"] and not body["n_inner_open_edges"]:
        print("  open edges: all on the outer border; a substrate with structure is an open surface by design")
    if (plate := loaded.read_plate()) is not None:
        for key, value in check_solid(plate).items():
            print(f"  plate {key}: {value}")
    for warning in loaded.warnings():
        print(f"  warning: {warning}")
    ny, nx = loaded.image_shape
    views = f", {loaded.scan.n_views} views" if loaded.scan.n_views > 1 else ""
    print(f"{scene}: ok ({nx} x {ny} pixels, {len(loaded.detector)} detectors{views})")


@app.command()
def schema() -> None:
    """Print the JSON schema of scene files, for editors."""
    from helio_jax.workflows.scene_file import json_schema

    print(json.dumps(json_schema(), indent=2))


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
