"""Commands before and during a measurement: plan, plan-windows, design, next. They only parse, call, print."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from helio_jax.commands.app import CSV, FIGURE, AsJson, Bar, SceneArg, Set, app, say, scene_overrides
from helio_jax.commands.door import Reads, Writes

DESIGN = (
    "design.json",
    "pareto.png",
    *(f"layout_{i}.{suffix}" for i in range(1, 13) for suffix in ("toml", "png")),
)
"""What `design` may write in its folder (workflows/design_result.py); as many layouts as [design] keep may be."""


def _numbers(option: str, text: str | None, whole: bool = False) -> list[float]:
    """Parse numbers (`whole`: whole ones) separated by commas.

    Raises:
        SceneError: an item is no such number.
    """
    from helio_jax.errors import SceneError

    try:
        return [int(item) if whole else float(item) for item in text.split(",")] if text else []
    except ValueError:
        kind = "whole numbers" if whole else "numbers"
        raise SceneError(f"{option} must be {kind} separated by commas, got {text!r}") from None


@app.command()
def plan(
    scene: SceneArg,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Error against time (.png, .pdf, .svg)."), FIGURE
    ] = None,
    dwell: Annotated[str | None, typer.Option(help="Counting times of a pixel [s], separated by commas.")] = None,
    pixel: Annotated[str | None, typer.Option(help="Pixel sizes on the same field [um], separated by commas.")] = None,
    views: Annotated[str | None, typer.Option(help="Numbers of evenly spaced rotations, separated by commas.")] = None,
    rotations: Annotated[
        list[str] | None, typer.Option(help='Rotations of the scans [deg], e.g. "0,90,180" (repeat).')
    ] = None,
    error: Annotated[float | None, typer.Option(help="Wanted standard deviation of the heights [um].")] = None,
    timing: Annotated[
        Path | None, typer.Option(help="Measured scan (.mat, .h5): pause and time to move are taken from it."), Reads()
    ] = None,
    change: Annotated[float, typer.Option(help="Time between two scans, to rotate the sample [s].")] = 0.0,
    draws: Annotated[
        int, typer.Option("--check", min=0, help="Simulate and reconstruct the chosen candidate so often.")
    ] = 0,
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Plan an acquisition: time, SNR and expected errors of the heights by dwell, pixel and rotations."""
    from helio_jax.figures.planning import Curve, save_plan
    from helio_jax.figures.wording import duration
    from helio_jax.workflows.plan import measured_timing, stated_timing
    from helio_jax.workflows.plan import plan as plan_scene
    from helio_jax.workflows.scene_file import load_scene

    loaded = load_scene(scene, scene_overrides(changes))
    stage = measured_timing(timing) if timing else stated_timing(loaded)
    even = [[360.0 * i / n for i in range(n)] for n in map(int, _numbers("--views", views, whole=True))]
    found = plan_scene(
        loaded,
        dwell_s=_numbers("--dwell", dwell),
        pixel_size_um=_numbers("--pixel", pixel),
        rotations_deg=[*even, *(_numbers("--rotations", text) for text in rotations or ())],
        wanted_um=error,
        timing=replace(stage, change=change),
        draws=draws,
        say=say,
    )
    if output:
        curves = [
            Curve(f"{c[0].n_images} images, {c[0].pixel_size_um:g} um", [d.seconds / 3600 for d in c], errors)
            for c in found.curves
            for errors in [[d.height_std_um for d in c]]
        ]
        star = (found.chosen.seconds / 3600, found.chosen.height_std_um) if found.reaching else None
        save_plan(curves, error, star, f"{found.name}: plan", output)
    if as_json:
        print(json.dumps(found.as_dict()))
        return
    head = f"{'scans':>5} {'images':>6} {'pixel':>8} {'dwell':>8} {'time':>10} {'SNR':>6} {'heights':>9} {'level':>9}"
    print(f"{head} {'seen':>6} {'speed-up':>8}")

    def line(c) -> str:
        return (
            f"{len(c.rotations_deg):>5} {c.n_images:>6} {c.pixel_size_um:>5g} um {c.dwell_s:>6.3g} s "
            f"{duration(c.seconds):>10} {c.snr:>6.1f} {c.height_std_um:>6.3g} um {c.level_std_um:>6.3g} um "
            f"{c.seen_by_all:>6.0%} {c.speed_up:>8.2f}"
        )

    print("\n".join(map(line, found.candidates)))
    if found.reaching:
        print(f"\ns.d. of the heights {error:g} um, the fastest first:\n" + "\n".join(map(line, found.reaching)))
    elif error is not None:
        best = min(c.height_std_um for c in found.candidates)
        say(f"warning: no candidate reaches {error:g} um, the best has {best:.3g} um: add longer dwell times or views")
    if (c := found.check) is not None:
        print(
            f"\nsimulated {c.draws} times: predicted {c.predicted_um:.3g} um, obtained {c.obtained_um:.3g} um "
            f"(ratio {c.ratio:.2f}), stated {c.stated_um:.3g} um; {c.compared:.0%} of the pixels"
            + (f"; scatter of the draws {c.scatter_um:.3g} um" if c.scatter_um is not None else "")
        )


@app.command("plan-windows")
def plan_windows(
    scans: Annotated[
        list[Path], typer.Argument(help="Two or more A-SHeM scans of different rotation (.mat, .h5)."), Reads()
    ],
    points: Annotated[Path, typer.Option(help="The same points in the scans (CSV: view,point,x_um,y_um)."), Reads()],
    rotations: Annotated[str, typer.Option(help="Wanted rotations of the sample [deg], separated by commas.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Stage windows (.csv)."), CSV] = None,
    center: Annotated[
        tuple[float, float], typer.Option(metavar="X Y", help="Centre of the region in the first scan [um].")
    ] = (0.0, 0.0),
    as_json: AsJson = False,
) -> None:
    """Find the rotation centre of a stage from two scans, and the windows that keep a region centred."""
    from helio_jax.formats.points import read_points
    from helio_jax.workflows.plan_windows import plan_windows as find_windows

    found = find_windows(scans, read_points(points), _numbers("--rotations", rotations), center)
    if output:
        found.write(output)
    if as_json:
        print(json.dumps(found.as_dict()))
        return
    c, signs = found.rotation_center, [-1.0 if axis[0] == "-" else 1.0 for axis in found.axes]
    place = ", ".join(f"{a[1:]} {s * v:.1f} um" for a, s, v in zip(found.axes, signs, c.center, strict=True))
    print(f"rotation centre: {place}; s.d. {c.std:.1f} um, {c.n_points} points, residual {c.residual:.1f} um")
    names = [axis[1:] for axis in found.axes]
    print(f"{'rotation':>12}" + "".join(f"{f'{n} low':>14}{f'{n} high':>14}" for n in names))
    for row in found.rows():
        ends = "".join(f"{row[f'{n}_{e}_um']:>11.1f} um" for n in names for e in ("low", "high"))
        print(f"{row['rotation_deg']:>8g} deg{ends}")
    print(f"all windows see {found.seen_by_all:.0%} of the first one")


@app.command()
def design(
    scene: SceneArg,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder: table, Pareto plot, instrument files and drawings."),
        Writes(within=DESIGN),
    ],
    sample: Annotated[
        list[Path] | None,
        typer.Option(help="Scene whose sample counts, too (repeat).", metavar="SCENE"),
        Reads(names_files=True),
    ] = None,
    apertures: Annotated[str | None, typer.Option(help="Numbers of apertures, separated by commas.")] = None,
    starts: Annotated[int | None, typer.Option(help="Searches from starts without symmetry.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the random starts.")] = None,
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Design layouts of apertures: least expected errors of the heights, least masked area, against the scene's."""
    from helio_jax.workflows.design import design as design_layouts
    from helio_jax.workflows.scene_file import load_scene

    numbers = _numbers("--apertures", apertures, whole=True) or None
    options = {"design.apertures": numbers, "design.starts": starts, "design.seed": seed}
    loaded = load_scene(scene, scene_overrides(changes, **options))
    found = design_layouts(loaded, samples=[load_scene(path) for path in sample or ()], say=say)
    files = found.write(output)
    for text in found.warnings:
        say(f"warning: {text}")
    if as_json:
        print(json.dumps({"files": [str(file) for file in files], **found.as_dict()}))
        return
    head = f"{'layout':>6} {'apertures':>15} {'heights':>10} {'variance':>8} {'masked':>7} {'counts':>6}"
    print(f"{head}  polar@azimuth [deg]")
    for i, p in enumerate((found.reference, *found.proposals)):
        aims = " ".join(f"{polar:.0f}@{azimuth:+.0f}" for polar, azimuth in p.angles_deg)
        print(
            f"{i or '-':>6} {p.label:>15} {p.height_std_um:>7.3g} um {p.variance_ratio:>8.2f} {p.masked:>7.2%} "
            f"{p.count_ratio:>6.2f}  {aims}"
        )
    print(f"files in {output}: {', '.join(file.name for file in files)}")


@app.command("next")
def next_scan(
    scans: Annotated[
        list[Path],
        typer.Argument(help="Micrographs of the scans so far (.h5), of one sample.", metavar="SCAN..."),
        Reads(),
    ],
    seconds: Annotated[float, typer.Option(help="Time to spend: counting, moves and rotations [s].")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="List of positions (.csv)."), CSV] = None,
    region: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="X0 X1 Y0 Y1", help="Region whose heights count [um] (default: all)."),
    ] = None,
    rotations: Annotated[
        str | None, typer.Option(help='Further rotations of the sample to choose from [deg], e.g. "120,240".')
    ] = None,
    dwell: Annotated[
        float | None, typer.Option(help="Dwell time that the counts belong to [s] (default: the files').")
    ] = None,
    move: Annotated[float, typer.Option(help="Time to reach a position, without counting [s].")] = 0.0,
    change: Annotated[float, typer.Option(help="Time to change to another rotation [s].")] = 0.0,
    timing: Annotated[
        Path | None, typer.Option(help="Measured scan (.mat, .h5): pause and time to move are taken from it."), Reads()
    ] = None,
    block: Annotated[
        int | None, typer.Option(min=1, help="Side of the squares of pixels with one dwell time [pixels].")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Scene file whose table [reconstruct] is used."), Reads(names_files=True)
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Dwell map over the heights (.png, .pdf, .svg)."), FIGURE] = None,
    as_json: AsJson = False,
) -> None:
    """List where to spend the next seconds: positions and dwell times that most reduce the variance of the heights."""
    from helio_jax.errors import SceneError
    from helio_jax.figures.dwell import DwellMap, save_dwell
    from helio_jax.figures.wording import duration
    from helio_jax.formats.hdf5 import read_micrographs
    from helio_jax.workflows.next_scan import next_scan as find_next
    from helio_jax.workflows.plan import measured_timing
    from helio_jax.workflows.scene_file import load_scene

    if timing and move:
        raise SceneError("--move and --timing both give the time to move: give one of them")
    stage = measured_timing(timing) if timing else None
    stacks = [stack for path in scans for stack in read_micrographs(path).stacks]
    if dwell is not None:
        if known := [s for s in stacks if s.dwell is not None and s.dwell != dwell]:
            raise SceneError(
                f"--dwell {dwell:g} s contradicts {known[0].name}, whose file states {known[0].dwell:g} s: leave it out"
            )
        stacks = [s.replace(dwell=dwell) for s in stacks]
    given = load_scene(settings).reconstruct if settings else None
    with Bar("finding the next positions") as bar:
        found = find_next(
            stacks,
            seconds,
            region_um=region,
            rotations_deg=_numbers("--rotations", rotations),
            move_s=move if stage is None else stage.pause + stage.move,
            change_s=change,
            block=block,
            settings=given,
            report=bar,
            say=say,
        )
    if output:
        found.write(output)
    if picture:
        maps = [
            DwellMap(f"{share.rotation_deg:g} deg, {share.share:.0%} of the time", *axes, image)
            for share, axes, image in zip(found.shares, found.axes, found.dwell_maps, strict=True)
        ]
        std = found.std_now, found.std_proposed
        save_dwell(*found.height_axes, found.height, std, found.region_um, maps, f"{found.name}: next scan", picture)
    if as_json:
        print(json.dumps(found.as_dict()))
        return
    out = f", {found.left_out} poorly determined ones left out" if found.left_out else ""
    print(f"{found.name}: s.d. of the region's heights ({found.region_pixels} pixels{out})")
    even = "not possible: moving alone takes longer" if found.even_um is None else f"{found.even_um:.3g} um"
    rows = [("so far", f"{found.now_um:.3g} um"), (f"after {duration(found.seconds)} spent evenly", even)]
    if found.even_all_um is not None:
        rows.append(("the same, new rotations, too", f"{found.even_all_um:.3g} um"))
    rows.append((f"after this list, {duration(found.spent_s)}", f"{found.proposed_um:.3g} um"))
    if found.variance_ratio is not None:
        rows.append(("variance over that of even times", f"{found.variance_ratio:.2f}"))
    for label, value in rows:
        print(f"  {label:<32} {value}")
    print(f"{'rotation':>12} {'positions':>10} {'counting':>12} {'share':>6} {'dwell times':>20}")
    for s in found.shares:
        spread = f"{s.shortest_s:.3g} to {s.longest_s:.3g} s" if s.positions else "-"
        print(
            f"{s.rotation_deg:>8g} deg {s.positions:>10} {duration(s.seconds):>12} {s.share:>6.0%} {spread:>20}"
            + ("" if s.is_present else "  (new)")
        )
    if found.variance_ratio is not None and found.variance_ratio > 1.0:
        say("warning: even dwell times are expected to do as well: nothing is gained by this list")
