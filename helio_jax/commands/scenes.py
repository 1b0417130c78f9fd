"""Commands about scene, instrument and study files: scenes, init, validate, schema."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from helio_jax.commands.app import TOML, AsJson, Set, app, print_result, scene_overrides
from helio_jax.commands.door import Force, Reads, Writes
from helio_jax.workflows.shipped import list_shipped


@app.command()
def scenes(
    action: Annotated[Literal["list", "copy"], typer.Argument(help="List them, or copy one.")] = "list",
    name: Annotated[str | None, typer.Argument(help="Which one to copy.")] = None,
    folder: Annotated[
        Path | None, typer.Argument(help="Where to copy it (default: here)."), Writes("scenes", within=())
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """List the scenes, instruments, studies that come with helio; copy one with the files it reads, to change it."""
    if action == "copy":
        _copy(name, folder or Path(), force, as_json)
        return
    files = list_shipped()
    if as_json:
        keys = ("name", "aliases", "kind", "about")
        print(json.dumps([{key: getattr(f, key) for key in keys} | {"path": str(f.path)} for f in files]))
        return
    names = [", ".join((file.name, *file.aliases)) for file in files]
    width = max(map(len, names), default=0)
    for called, file in zip(names, files, strict=True):
        print(f"{called:<{width}}  {file.kind:<10}  {file.about}")
    print(
        "\nhelio run NAME; helio import --instrument NAME; helio study NAME; helio scenes copy NAME: a copy to change"
    )


def _copy(name: str | None, folder: Path, force: bool, as_json: bool) -> None:
    """Copy one and print the copies."""
    from helio_jax.workflows.copy_scene import copy_shipped

    if name is None:
        raise typer.BadParameter("say which one to copy: helio scenes lists their names", param_hint="NAME")
    files = list(map(str, copy_shipped(name, folder, force=force)))
    print(json.dumps(files) if as_json else "\n".join(files))


@app.command()
def init(
    kind: Annotated[Literal["scene", "instrument"], typer.Argument(help="What to begin.", show_default=False)],
    file: Annotated[
        Path | None, typer.Argument(help="File to write (default: scene.toml or instrument.toml)."), TOML
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a starting file of a scene or an instrument that works as it is, with every key and its meaning."""
    from helio_jax.workflows.starting_file import write_starting_file

    path = file or Path(f"{kind}.toml")
    write_starting_file(kind, path, force=force)
    print_result(as_json, {"file": str(path)}, f"{path}: check it with helio validate {path}")


@app.command()
def validate(
    file: Annotated[
        Path,
        typer.Argument(help="Scene, instrument or study: file (TOML), or name of helio scenes.", metavar="SCENE"),
        Reads(names_files=True),
    ],
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Check a scene with its sample, an instrument or a study; list all errors with key, value, limit and remedy."""
    from helio_jax.figures.summary import body_lines, hole_lines, text_lines
    from helio_jax.workflows.validate import check_file

    found = check_file(file, scene_overrides(changes))
    if as_json:
        print(json.dumps(asdict(found)))
        return
    print("\n".join(text_lines(found.about)))
    for name, body in (("sample       ", found.body), ("plate's mesh ", found.plate)):
        for text in (*body_lines(body, name), *hole_lines(body)) if body else ():
            print(f"  {text}")
    for text in found.replaced:
        print(f"  {text}")
    for warning in found.warnings:
        print(f"  warning: {warning}")
    n = len(found.instrument["detectors"])
    about = f"{n} detector{'s' * (n != 1)}"
    if found.image:
        views = f", {found.image['views']} views" if found.image["views"] > 1 else ""
        about = f"{found.image['nx']} x {found.image['ny']} pixels, {about}{views}"
    else:
        about += "; it has no [sample] and no [scan]"
    if found.body and found.body["n_holes"]:
        from helio_jax.trace.run import MAX_LOST

        limit = f"more than {MAX_LOST:.2%} of the rays leak through its mesh"
        print(f"{file}: {found.kind} ({about}) that tracing refuses if {limit}")
        return
    print(f"{file}: ok, {'an' if found.kind == 'instrument' else 'a'} {found.kind} ({about})")


@app.command()
def schema() -> None:
    """Print the JSON schema of scene files, for editors."""
    from helio_jax.workflows.scene_file import json_schema

    print(json.dumps(json_schema(), indent=2))
