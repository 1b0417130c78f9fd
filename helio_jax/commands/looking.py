"""Commands to look at files: show, info. They parse, call and print only."""

import json
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import FIGURE, PICTURE, AsJson, Set, app, print_result, scene_overrides
from helio_jax.commands.door import Reads


@app.command()
def show(
    file: Annotated[
        Path,
        typer.Argument(help="Micrographs or height map (.h5, .mat, .npz); scene or instrument, file (.toml) or name."),
        Reads(names_files=True),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Picture (default: FILE.show.png beside the file; of a name: here)."),
        FIGURE,
    ] = None,
    window: Annotated[bool, typer.Option("--window", help="Open a window instead of writing a picture.")] = False,
    instrument: Annotated[
        Path | None,
        typer.Option(help="Instrument or scene, file or name, for a .mat file."),
        Reads(names_files=True),
    ] = None,
    common_scale: Annotated[
        bool, typer.Option("--common-scale", help="One grey scale for all micrographs (default: one for each).")
    ] = False,
    view: Annotated[int, typer.Option(min=0, help="Which view of a scene's scan, from 0.")] = 0,
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Draw a file: micrographs and apertures, heights, the instrument, or a scene before any tracing."""
    from helio_jax.workflows.shipped import path_beside
    from helio_jax.workflows.show import show as draw_file

    picture = output if output or window else path_beside(file, PICTURE)
    options = {"window": window, "instrument": instrument, "common_scale": common_scale, "view": view}
    draw_file(file, picture, **options, overrides=scene_overrides(changes))
    if picture:
        print_result(as_json, {"file": str(picture)}, str(picture))


@app.command()
def info(
    file: Annotated[
        Path,
        typer.Argument(help="Any file that helio reads (.h5, .toml, .mat, meshes, .npz, .npy, .csv, .mtl), or a name."),
        Reads(),
    ],
    everything: Annotated[
        bool, typer.Option("--all", help="Also every array, setting and step of the history.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """State what a file holds, in about ten lines: sizes, counts, heights, geometry, where it came from."""
    from helio_jax.figures.summary import text_lines
    from helio_jax.workflows.file_info import file_info

    found = file_info(file)
    if as_json:
        print(json.dumps(found.as_dict()))
        return
    print(f"{found.file}: {found.kind}, {found.n_bytes:,} bytes")
    print("\n".join(text_lines(found.rows)))
    if everything:
        print("\n".join(found.detail_lines()))
