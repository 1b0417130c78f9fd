"""Commands around the tracer: run, simulate, rays, resume, study, spot, plate. They parse, call and print only."""

import json
import math
import time
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import (
    COLUMNS,
    FIGURE,
    AsJson,
    Bar,
    H5WithPicture,
    Method,
    Picture,
    Processes,
    Rays,
    Restart,
    SceneArg,
    Scheduler,
    Seed,
    Strict,
    Workers,
    app,
    given_options,
    print_table,
    say,
    tell_micrographs,
    warn,
)
from helio_jax.commands.door import Reads, Writes

RUN = ("micrographs.h5", "height.h5", "scores.json", "report.html", "report.png")
"""What `run` writes in its folder (pipeline.py)."""
STUDY = ("study.json", "index.json", "index.csv", "index.png")
"""What `study` writes in its folder beside the points (study.py)."""


@app.command()
def run(
    scene: SceneArg,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder (default: helio-out/NAME)."), Writes(within=RUN)
    ] = None,
    rays: Rays = None,
    seed: Seed = None,
    method: Method = None,
    workers: Workers = None,
    processes: Processes = False,
    scheduler: Scheduler = None,
    restart: Restart = False,
    as_json: AsJson = False,
    strict: Strict = False,
) -> None:
    """Simulate a scene, reconstruct its height map, score it against the truth and write a report."""
    from helio_jax.figures.trust import trust_lines
    from helio_jax.workflows.pipeline import Executor
    from helio_jax.workflows.pipeline import run as run_scene

    overrides = given_options(**{"trace.rays": rays, "trace.seed": seed, "reconstruct.method": method})
    executor = Executor(workers, processes, scheduler)
    result = run_scene(scene, output, overrides=overrides, stage=Bar, executor=executor, restart=restart, say=say)
    if as_json:
        print(json.dumps(result.as_dict()))
        warn(result.trust, strict)
        return
    print(f"\n{result.name}: {result.method}, {result.status}")
    print_table(result.scores.as_table())
    print("\n".join(trust_lines(result.trust)))
    print("\nfiles:")
    for label, path in result.files.items():
        print(f"  {label:<12} {path}")
    if result.status.startswith("interrupted"):
        raise KeyboardInterrupt
    warn(result.trust, strict)


@app.command()
def simulate(
    scene: SceneArg,
    output: H5WithPicture,
    rays: Rays = None,
    seed: Seed = None,
    workers: Workers = None,
    estimator: Annotated[str | None, typer.Option(help="expected or analog.")] = None,
    noise: Annotated[bool, typer.Option(help="Add the scene's counting noise and background.")] = False,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: trace the i-th of N shares; the last one writes.")] = None,
    scheduler: Scheduler = None,
    restart: Restart = False,
    picture: Picture = True,
) -> None:
    """Trace the micrographs of a scene and write them to an HDF5 file; repeat the command to resume it."""
    from helio_jax.workflows.pipeline import Executor, SimulateOptions, simulate_file

    overrides = given_options(**{"trace.rays": rays, "trace.seed": seed, "trace.estimator": estimator})
    start = time.perf_counter()
    with Bar("tracing") as bar:
        options = SimulateOptions(noise, Executor(workers, processes, scheduler), shard, restart, bar, say)
        stack = simulate_file(scene, output, overrides=overrides, options=options)
    if stack is None:
        return
    print(f"{output}: {time.perf_counter() - start:.1f} s")
    if "rays_per_pixel" in stack.provenance:
        print(f"  {stack.provenance['rays_per_pixel']:.0f} rays per pixel on average")
        for one in stack.stacks:
            if (missed := one.provenance.get("n_above_target")) is not None:
                print(f"  {one.name}: {missed} of {one.counts[0].size} pixels are above the target error")
    tell_micrographs(stack, output, picture)


@app.command()
def rays(
    scene: SceneArg,
    output: Annotated[Path, typer.Option("--output", "-o", help="Table of all atoms (.csv or .npz)."), COLUMNS],
    pixel: Annotated[tuple[int, int] | None, typer.Option(metavar="ROW COLUMN", help="From 0 (default: all).")] = None,
    directions: Annotated[
        Path | None, typer.Option(help="Histogram of directions, too (.csv or .npz)."), COLUMNS
    ] = None,
    view: Annotated[int, typer.Option(help="Which view of the scan, from 0.")] = 0,
    n: Annotated[int | None, typer.Option("--rays", min=8, help="Atoms per pixel (default: the scene's).")] = None,
    seed: Seed = None,
) -> None:
    """Follow single atoms: where each last scattered, its direction, its order and what became of it."""
    from helio_jax.formats.columns import write_columns
    from helio_jax.trace.follow import follow_scene
    from helio_jax.trace.tally import FATES
    from helio_jax.workflows.scene_file import load_scene

    loaded = load_scene(scene, given_options(**{"trace.rays": n, "trace.seed": seed}))
    atoms = follow_scene(loaded, loaded.trace, pixel, view)
    write_columns(output, atoms.columns())
    if directions:
        write_columns(directions, atoms.directions())
    fates = ", ".join(f"{int((atoms.fate == i).sum())} {name}" for i, name in enumerate(FATES))
    print(f"{output}: {atoms.fate.size} atoms: {fates}; mean order {atoms.order.mean():.3f}")


@app.command()
def resume(
    path: Annotated[
        Path, typer.Argument(help="The file (OUT.h5) or folder of an unfinished simulate, run or study."), Reads()
    ],
    picture: Picture = True,
) -> None:
    """Resume an interrupted or killed run or study; finished units are not traced again."""
    from helio_jax.formats.hdf5 import read_micrographs
    from helio_jax.workflows.pipeline import resume as resume_run

    if (path / "study.json").is_file():
        from helio_jax.workflows.study import resume_study

        print(resume_study(path, say=say))
        return
    files = resume_run(path, stage=Bar, say=say)
    for file in files:
        print(file)
    if files == [path]:
        tell_micrographs(read_micrographs(path), path, picture)


@app.command()
def study(
    file: Annotated[
        Path, typer.Argument(help="Study file (TOML): a scene and what is varied.", metavar="STUDY.toml"), Reads()
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the points and their index."), Writes(within=STUDY)
    ],
    go_on: Annotated[bool, typer.Option("--resume", help="Go on in a folder that holds this study.")] = False,
    workers: Workers = None,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: run every N-th point, starting with the i-th.")] = None,
    scheduler: Scheduler = None,
) -> None:
    """Vary values of a scene: each point in its own folder, with an index of values and scores."""
    from helio_jax.workflows.pipeline import Executor, SimulateOptions
    from helio_jax.workflows.study import run_study

    options = SimulateOptions(executor=Executor(workers, processes, scheduler), shard=shard, say=say)
    print(run_study(file, output, resume=go_on, options=options))


@app.command()
def spot(
    scene: SceneArg,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Figure to write (.png, .pdf, .svg)."), FIGURE
    ] = None,
    heights: Annotated[str, typer.Option(help="Heights above the substrate [um], separated by commas.")] = "0",
    as_json: AsJson = False,
) -> None:
    """Measure and draw the beam's spot at one or more heights above the substrate."""
    from helio_jax.errors import SceneError
    from helio_jax.workflows.scene_file import load_scene
    from helio_jax.workflows.spot import draw_spot

    try:
        at = [float(text) for text in heights.split(",")]
    except ValueError:
        raise SceneError(f"--heights must be numbers separated by commas, got {heights!r}") from None
    found = draw_spot(load_scene(scene), at, output)
    if as_json:
        print(json.dumps(found))
        return
    for row in found:
        print("  ".join(f"{key} {value:.4g}" for key, value in row.items()))


@app.command()
def plate(
    instrument: Annotated[
        Path,
        typer.Argument(help="Instrument or scene with apertures, file or name.", metavar="SCENE"),
        Reads(names_files=True),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File to write (.obj)."), Writes("OBJ, which names parts", (".obj",))
    ],
    thickness_um: Annotated[float, typer.Option(help="Thickness of the plate [um].")],
    radius_um: Annotated[float | None, typer.Option(help="Radius of the disc [um] (default: all apertures).")] = None,
    channel_deg: Annotated[
        float | None, typer.Option(help="Angle of the channels to the plate normal [deg] (default: to the spot).")
    ] = None,
) -> None:
    """Make a watertight mesh of a plate with channels for an instrument's apertures and pinhole (.obj)."""
    from helio_jax.formats.safe import atomic_path
    from helio_jax.scene.drill import drill_plate
    from helio_jax.workflows.scene_file import load_instrument

    angle = None if channel_deg is None else math.radians(channel_deg)
    found = drill_plate(load_instrument(instrument), thickness_um, radius_um, angle)
    with atomic_path(output) as part:
        about = f"made by helio plate from {instrument.name}, {thickness_um:g} um thick; units: um"
        part.write_text(found.obj(about), encoding="utf-8")
    print(f"{output}: {len(found.faces)} triangles, {len(found.ends)} channels; in a scene:\n")
    print(found.tables(output.name))
