"""Commands around the tracer: run, simulate, rays, resume, rerun, study, spot, plate. They only parse, call, print."""

import json
import math
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from helio_jax.commands.app import (
    COLUMNS,
    FIGURE,
    HDF5,
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
    Set,
    Strict,
    Workers,
    app,
    print_result,
    print_table,
    say,
    scene_overrides,
    tell_micrographs,
    warn,
)
from helio_jax.commands.door import Force, Reads, Writes, keep_existing

RUN = ("micrographs.h5", "height.h5", "scores.json", "report.html", "report.png")
"""What `run` writes in its folder (pipeline.py)."""
STUDY = ("study.json", "index.json", "index.csv", "index.png", "table.md")
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
    changes: Set = None,
    workers: Workers = None,
    processes: Processes = False,
    scheduler: Scheduler = None,
    restart: Restart = False,
    as_json: AsJson = False,
    strict: Strict = False,
    force: Force = False,
) -> None:
    """Simulate a scene, reconstruct its height map, score it against the truth and write a report."""
    from helio_jax.figures.trust import trust_lines
    from helio_jax.reconstruction import end_if_interrupted
    from helio_jax.workflows.pipeline import Executor, default_folder
    from helio_jax.workflows.pipeline import run as run_scene
    from helio_jax.workflows.scene_file import load_scene

    overrides = scene_overrides(changes, **{"trace.rays": rays, "trace.seed": seed, "reconstruct.method": method})
    executor = Executor(workers, processes, scheduler)
    if output is None and not force:
        keep_existing(("-o", default_folder(load_scene(scene, overrides)) / name) for name in RUN)
    _warn_of_scene(scene, overrides)
    result = run_scene(scene, output, overrides=overrides, stage=Bar, executor=executor, restart=restart, say=say)
    if as_json:
        print(json.dumps(result.as_dict()))
    else:
        print(f"\n{result.name}: {result.method}, {result.status}")
        print_table(result.scores.as_table())
        print("\n".join(trust_lines(result.trust)))
        print("\nfiles:")
        for label, path in result.files.items():
            print(f"  {label:<12} {path}")
    end_if_interrupted(result.status)
    warn(result.trust, strict)


@app.command()
def simulate(
    scene: SceneArg,
    output: H5WithPicture,
    rays: Rays = None,
    seed: Seed = None,
    workers: Workers = None,
    estimator: Annotated[str | None, typer.Option(help="expected or analog.")] = None,
    changes: Set = None,
    noise: Annotated[bool, typer.Option(help="Add the scene's counting noise and background.")] = False,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: trace the i-th of N shares; the last one writes.")] = None,
    scheduler: Scheduler = None,
    restart: Restart = False,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Trace the micrographs of a scene and write them to an HDF5 file; repeat the command to resume it."""
    from helio_jax.workflows.pipeline import Executor, SimulateOptions, simulate_file

    options = {"trace.rays": rays, "trace.seed": seed, "trace.estimator": estimator}
    overrides = scene_overrides(changes, **options)
    start = time.perf_counter()
    _warn_of_scene(scene, overrides)
    with Bar("tracing") as bar:
        how = SimulateOptions(noise, Executor(workers, processes, scheduler), shard, restart, bar, say)
        stack = simulate_file(scene, output, overrides=overrides, options=how)
    if stack is None:
        return
    if not as_json:
        print(f"{output}: {time.perf_counter() - start:.1f} s")
    if "rays_per_pixel" in stack.provenance and not as_json:
        print(f"  {stack.provenance['rays_per_pixel']:.0f} rays per pixel on average")
        for one in stack.stacks:
            if (missed := one.provenance.get("n_above_target")) is not None:
                print(f"  {one.name}: {missed} of {one.counts[0].size} pixels are above the target error")
    tell_micrographs(stack, output, picture, as_json)


def _warn_of_scene(scene: Path, overrides: dict[str, Any]) -> None:
    """Print the probable mistakes of a scene before it is traced."""
    from helio_jax.workflows.scene_file import load_scene
    from helio_jax.workflows.scene_warnings import scene_warnings

    loaded = load_scene(scene, overrides)
    for text in (*loaded.warnings(), *scene_warnings(loaded, loaded.build_body())):
        say(f"warning: {text}")


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
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Follow single atoms: where each last scattered, its direction, its order and what became of it."""
    from helio_jax.formats.columns import write_columns
    from helio_jax.trace.follow import follow_scene
    from helio_jax.trace.tally import FATES
    from helio_jax.workflows.scene_file import load_scene

    loaded = load_scene(scene, scene_overrides(changes, **{"trace.rays": n, "trace.seed": seed}))
    atoms = follow_scene(loaded, loaded.trace, pixel, view)
    write_columns(output, atoms.columns())
    if directions:
        write_columns(directions, atoms.directions())
    fates = {name: int((atoms.fate == i).sum()) for i, name in enumerate(FATES)}
    mean_order = float(atoms.order.mean())
    record = {"file": str(output), "atoms": int(atoms.fate.size), "fates": fates, "mean_order": mean_order}
    shown = ", ".join(f"{n} {name}" for name, n in fates.items())
    print_result(as_json, record, f"{output}: {atoms.fate.size} atoms: {shown}; mean order {mean_order:.3f}")


@app.command()
def resume(
    path: Annotated[
        Path, typer.Argument(help="The file (OUT.h5) or folder of an unfinished simulate, run or study."), Reads()
    ],
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Resume an interrupted or killed run or study; finished units are not traced again."""
    from helio_jax.formats.hdf5 import read_micrographs
    from helio_jax.workflows.pipeline import resume as resume_run

    if (path / "study.json").is_file():
        from helio_jax.workflows.study import resume_study

        files = [str(resume_study(path, say=say))]
    else:
        files = [str(file) for file in resume_run(path, stage=Bar, say=say)]
    print_result(as_json, {"files": files}, *files)
    if files == [str(path)] and not as_json:
        tell_micrographs(read_micrographs(path), path, picture, as_json)


@app.command()
def rerun(
    file: Annotated[Path, typer.Argument(help="Micrographs or heights (.h5) of a simulated scene."), Reads()],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the repetition, too (.h5)."), HDF5
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Repeat what made a file, from its history: simulate, reconstruct; say whether the result is the same."""
    from helio_jax import __version__, write
    from helio_jax.workflows.rerun import rerun as repeat

    done = repeat(file, say)
    if output:
        write(done.found, output)
    if as_json:
        print(json.dumps(done.as_dict()))
        return
    unit = "um" if done.what == "height" else "counts"
    how = "equal bit for bit" if done.is_equal else f"not equal: the largest difference is {done.largest:.3g} {unit}"
    print(f"{file}: {done.what} of the repetition {how}; made by version {done.version}, repeated by {__version__}")


@app.command()
def study(
    file: Annotated[
        Path,
        typer.Argument(help="Study file (TOML), or a name that helio scenes lists.", metavar="STUDY"),
        Reads(),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for the points and their index."),
        Writes(within=STUDY, keeps=True),
    ],
    go_on: Annotated[bool, typer.Option("--resume", help="Go on in a folder that holds this study.")] = False,
    workers: Workers = None,
    processes: Processes = False,
    shard: Annotated[str | None, typer.Option(help="i/N: run every N-th point, starting with the i-th.")] = None,
    scheduler: Scheduler = None,
    as_json: AsJson = False,
) -> None:
    """Vary values of a scene: each point in its own folder, an index, a table and a figure of the scores."""
    from helio_jax.workflows.pipeline import Executor, SimulateOptions
    from helio_jax.workflows.study import run_study

    options = SimulateOptions(executor=Executor(workers, processes, scheduler), shard=shard, say=say)
    index = run_study(file, output, resume=go_on, options=options)
    files = {"index": index, "table": index.with_name("table.md"), "figure": index.with_name("index.png")}
    written = {what: str(path) for what, path in files.items() if path.is_file()}
    if not as_json and "table" in written:
        print(files["table"].read_text(encoding="utf-8"))
    print_result(as_json, written, *written.values())


@app.command()
def spot(
    scene: SceneArg,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Figure to write (.png, .pdf, .svg)."), FIGURE
    ] = None,
    heights: Annotated[str, typer.Option(help="Heights above the substrate [um], separated by commas.")] = "0",
    changes: Set = None,
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
    found = draw_spot(load_scene(scene, scene_overrides(changes)), at, output)
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
        Path,
        typer.Option("--output", "-o", help="File to write: .obj (um), or .stl (mm) to print or mill."),
        Writes("OBJ, which names parts, or STL", (".obj", ".stl")),
    ],
    thickness_um: Annotated[float, typer.Option(help="Thickness of the plate [um].")],
    radius_um: Annotated[float | None, typer.Option(help="Radius of the disc [um] (default: all apertures).")] = None,
    channel_deg: Annotated[
        float | None, typer.Option(help="Angle of the channels to the plate normal [deg] (default: to the spot).")
    ] = None,
    conical: Annotated[
        bool, typer.Option("--conical", help="Channels widen upwards as seen from the nominal spot (default: uniform).")
    ] = False,
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Make a watertight mesh of a plate with channels for an instrument's apertures and pinhole (.obj, .stl)."""
    from helio_jax.formats.safe import atomic_path
    from helio_jax.scene.drill import STL_UNIT, drill_plate
    from helio_jax.workflows.scene_file import load_instrument

    angle = None if channel_deg is None else math.radians(channel_deg)
    loaded, is_stl = load_instrument(instrument, scene_overrides(changes)), output.suffix.lower() == ".stl"
    found = drill_plate(loaded, thickness_um, radius_um, angle, is_conical=conical)
    with atomic_path(output) as part:
        about = f"made by helio plate from {instrument.name}, {thickness_um:g} um thick; units: um"
        part.write_bytes(found.stl() if is_stl else found.obj(about).encode())
    tables = found.tables_of_stl(output.name) if is_stl else found.tables(output.name)
    n_faces, n_ends, unit = len(found.faces), len(found.ends), STL_UNIT if is_stl else "um"
    record = {"file": str(output), "triangles": n_faces, "channels": n_ends, "unit": unit, "tables": tables}
    print_result(as_json, record, f"{output}: {n_faces} triangles, {n_ends} channels, in {unit}; in a scene:\n", tables)
