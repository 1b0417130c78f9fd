"""Commands about heights: reconstruct, evaluate, measure, report."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from helio_jax.commands.app import (
    CSV,
    FIGURE,
    HDF5,
    HTML,
    TOML,
    AsJson,
    Bar,
    H5File,
    Method,
    Strict,
    app,
    describe,
    given_options,
    print_result,
    print_table,
    say,
    set_options,
    warn,
)
from helio_jax.commands.door import Reads


@app.command("reconstruct")
def reconstruct_files(
    stack: Annotated[
        list[Path], typer.Argument(help="Micrographs (.h5); several scans of one sample: one surface."), Reads()
    ],
    output: H5File,
    method: Method = None,
    settings: Annotated[
        Path | None, typer.Option(help="Scene file whose table [reconstruct] is used."), Reads(names_files=True)
    ] = None,
    motions: Annotated[
        Literal["stage", "fitted"],
        typer.Option(help="Of the sample between several scans: stage (as stated) or fitted (by the images)."),
    ] = "stage",
    write_joined: Annotated[
        Path | None, typer.Option(help="Also several scans as joined on the surface, for reports (.h5)."), HDF5
    ] = None,
    border: Annotated[str | None, typer.Option(help="flat: the image's border is the substrate; free.")] = None,
    anchors: Annotated[
        Path | None,
        typer.Option(help="Known heights, steps, masks (.csv, columns as [[reconstruct.anchor]]).", metavar="FILE.csv"),
        Reads(),
    ] = None,
    write_instrument: Annotated[
        Path | None, typer.Option(help="Also the instrument as fitted, for other scans (.toml)."), TOML
    ] = None,
    strict: Strict = False,
    as_json: AsJson = False,
) -> None:
    """Reconstruct a height map from three or more micrographs, of one scan or of several of one sample."""
    from helio_jax import MicrographSet, write
    from helio_jax.alignment.added_scans import add_by_orientation
    from helio_jax.figures.trust import anchor_lines, discrepancy_text, trust_lines
    from helio_jax.formats.anchors import read_anchors
    from helio_jax.formats.hdf5 import read_micrographs
    from helio_jax.reconstruction import end_if_interrupted, was_interrupted
    from helio_jax.workflows.heights import reconstruct, reconstruct_scans
    from helio_jax.workflows.scene_file import load_scene

    given = load_scene(settings).reconstruct if settings else None
    known = read_anchors(anchors) if anchors else None
    scans = add_by_orientation([s for path in stack for s in read_micrographs(path).stacks], only_lists=True)
    if write_instrument:
        from helio_jax.formats import toml

        toml.check_uncertain(scans[0].instrument, write_instrument)
    joined = None
    with Bar("reconstructing") as bar:
        how: dict[str, Any] = {"settings": given, "report": bar, **given_options(border=border, anchor=known)}
        if len(scans) == 1:
            result = reconstruct(scans[0], method, **how)
        else:
            result, joined = reconstruct_scans(MicrographSet(scans), method, motions=motions, **how)
    write(result, output)
    if write_joined:
        write(scans[0] if joined is None else joined.stack, write_joined)
    if write_instrument and was_interrupted(result.status):
        say(f"warning: {write_instrument} is not written: an interrupted fit has no error bars of the instrument")
    elif write_instrument:
        toml.write_instrument(result, write_instrument)
    if as_json:
        about = {"method": result.method, "status": result.status, "trust": result.trust}
        print(json.dumps(describe(output) | about))
    else:
        print(f"{output}: {result.method}, {result.status}")
        print("\n".join(trust_lines(result.trust) + anchor_lines(result)))
        for name, factor in result.provenance.get("sensitivity", {}).items():
            print(f"  the highest point moves by {factor:+.1f} % per % of signal in {name.removeprefix('log_')}")
        _print_instrument(result.provenance.get("instrument", {}))
        if text := discrepancy_text(result):
            print(f"  {text}")
    end_if_interrupted(result.status)
    warn(result.trust, strict)


@app.command()
def evaluate(
    height: Annotated[Path, typer.Argument(help="Height map (.h5)."), Reads()],
    truth: Annotated[
        Path | None,
        typer.Option(help="Scene file, or a height map (.h5) on the same raster (default: the scene simulated)."),
        Reads(names_files=True),
    ] = None,
    fit_center: Annotated[bool, typer.Option(help="Fit the position of the scene's sphere first.")] = False,
    as_json: AsJson = False,
) -> None:
    """Score a height map against the true heights of the same beam positions."""
    from helio_jax.errors import InputFileError
    from helio_jax.figures.trust import trust_lines
    from helio_jax.formats.hdf5 import read_height
    from helio_jax.workflows import pipeline
    from helio_jax.workflows.truth import load_truth, simulated_scene, true_height

    rec = read_height(height)
    if truth is None:
        try:
            found = true_height(simulated_scene(rec, height), rec)
        except InputFileError as e:
            raise InputFileError(f"{e}; to score it, give its true heights by --truth") from None
    else:
        found = load_truth(truth, rec, fit_center=fit_center)
    about_truth = _warn_of_truth(truth, found, rec)
    scores = pipeline.evaluate(rec, found)
    if as_json:
        center = list(found.region.center) if found.region else None
        print(json.dumps(scores.as_dict() | {"center_um": center, "trust": rec.trust, "truth_warnings": about_truth}))
        warn(rec.trust)
        return
    if found.region and fit_center:
        print(f"  centre fitted at x = {found.region.center[0]:.1f} um, y = {found.region.center[1]:.1f} um")
    print_table(scores.as_table())
    print("\n".join(trust_lines(rec.trust)))
    warn(rec.trust)


def _warn_of_truth(path: Path | None, truth: Any, rec: Any) -> list[str]:
    """Print and return in what a scene is not what was simulated, and a height in [truth] that is not the sample's."""
    from helio_jax.formats.suffixes import HDF5_SUFFIXES
    from helio_jax.workflows.truth import odd_height, other_sample

    other = other_sample(path, rec) if path and path.suffix.lower() not in HDF5_SUFFIXES else None
    found = [text for text in (other, odd_height(truth)) if text]
    for text in found:
        say(f"warning: {text}")
    return found


@app.command()
def report(
    height: Annotated[Path, typer.Argument(help="Height map (.h5)."), Reads()],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write (.html)."), HTML],
    stack: Annotated[Path | None, typer.Option(help="Its micrographs (.h5)."), Reads()] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Scene file or height map to compare with."), Reads(names_files=True)
    ] = None,
    fit_center: Annotated[bool, typer.Option(help="Fit the position of the scene's sphere first.")] = False,
    panel: Annotated[
        Path | None, typer.Option(help="Panel for print (.png, .pdf, .svg; default: .png beside the report)."), FIGURE
    ] = None,
    steps: Annotated[bool, typer.Option("--steps", help="Also measure steps in the micrographs of --stack.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write one self-contained HTML report of a height map, and a panel on one page."""
    from helio_jax.formats.hdf5 import read_height, read_stack
    from helio_jax.workflows import pipeline
    from helio_jax.workflows.truth import load_truth

    rec, images = read_height(height), read_stack(stack) if stack else None
    known = load_truth(truth, rec, fit_center=fit_center) if truth else None
    if known:
        _warn_of_truth(truth, known, rec)
    scores = pipeline.evaluate(rec, known) if known else None
    title = images.name if images else height.stem
    drawn = pipeline.write_report_files(
        output, images, rec, known, scores, title=title, panel_path=panel, with_steps=steps
    )
    print_result(as_json, {"report": str(output), "panel": str(drawn), "trust": rec.trust}, str(output), str(drawn))
    warn(rec.trust)


@app.command()
def measure(
    height: Annotated[Path, typer.Argument(help="Height map (.h5); with --steps micrographs (.h5)."), Reads()],
    facets: Annotated[bool, typer.Option("--facets", help="Planar facets: angles, sides, areas.")] = False,
    profile: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="x0 y0 x1 y1 in the sample frame [um]: a table of heights, s.d. and flags."),
    ] = None,
    step: Annotated[
        bool, typer.Option("--step", help="Instead of the table: the single step that the profile crosses.")
    ] = False,
    step_height: Annotated[
        bool,
        typer.Option(
            "--step-height", help="ISO 5436-1 type A: height of the ridge or groove that the profile crosses."
        ),
    ] = False,
    step_edges: Annotated[
        tuple[float, float] | None,
        typer.Option(help="The edges of the ridge or groove along the profile [um] (default: found)."),
    ] = None,
    texture: Annotated[
        bool,
        typer.Option("--texture", "--roughness", help="ISO 25178: Sa, Sq, ..., Sdq, Sdr, Sk, ..., Sal, Str with s.d."),
    ] = False,
    ripple: Annotated[bool, typer.Option("--ripple", help="The strongest ripple: wavelength, amplitude.")] = False,
    region: Annotated[
        list[str] | None,
        typer.Option(help="'X,Y X,Y ...': corners in um, for texture, ripple, cracks, edges (repeat)."),
    ] = None,
    cracks: Annotated[bool, typer.Option("--cracks", help="Slits and grooves in the micrographs of --stack.")] = False,
    vertical_edges: Annotated[
        bool, typer.Option("--vertical-edges", help="Walls in the map of jumps, masked and floating pixels.")
    ] = False,
    steps: Annotated[
        bool, typer.Option("--steps", help="Heights of walls from the mask bands of micrographs, without a height map.")
    ] = False,
    stack: Annotated[
        Path | None,
        typer.Option(help="Calibrated micrographs (.h5): do they show the ripple? Where are cracks?"),
        Reads(),
    ] = None,
    min_pixels: Annotated[int | None, typer.Option(help="Smallest facet.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE: l_filter_um, max_turn_deg, ... (repeat).")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Facets, ripple, cracks or steps as a picture (.png, .pdf, .svg)."), FIGURE
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="The profile, or cracks, vertical edges or steps, a row for each (.csv)."), CSV
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure facets, profiles, texture, ripples, cracks, edges on a height map; steps on micrographs (--steps)."""
    from helio_jax.formats.hdf5 import read_height, read_stack
    from helio_jax.formats.safe import atomic_path
    from helio_jax.measure.crack_text import table as as_table
    from helio_jax.measure.profiles import profile_table
    from helio_jax.workflows.measure import Wanted, measure_height_map

    wanted = Wanted(
        facets=facets,
        profile=profile,
        step=step,
        step_height=step_height,
        edges=step_edges,
        texture=texture,
        ripple=ripple,
        regions=tuple(region or ()),
        cracks=cracks,
        vertical_edges=vertical_edges,
        table=table is not None,
        settings=set_options(settings, min_pixels=min_pixels),
    )
    if steps:
        from helio_jax.workflows.steps import check_alone, measure_steps, steps_table

        check_alone(wanted, has_stack=stack is not None)
        found, lines = measure_steps(read_stack(height), figure)
        text = steps_table(found)
    else:
        images = read_stack(stack) if stack else None
        found, lines = measure_height_map(read_height(height), wanted, figure, images)
        text = profile_table(found["profile"]) if profile and not wanted.lines else as_table(found)
        warn(found["trust"])
    if table:
        with atomic_path(table) as part:
            part.write_text(text, encoding="utf-8")
    print(json.dumps(found) if as_json else "\n".join(lines))


def _print_instrument(found: dict[str, Any]) -> None:
    """Print the fitted geometry and its weakly determined combinations."""
    for name, (value, std, prior, unit) in found.get("values", {}).items():
        if unit in ("um", "deg"):
            print(f"  {name}: {value:+.2f} +- {std:.2f} {unit} from the stated value (prior {prior:g})")
    if found.get("inflation", 1.0) > 1.0:
        common = found.get("common_mode_um", 0.0)
        print(
            f"  error bars are inflated by {found['inflation']:.1f}; common to all heights: up to {common:.0f} um more"
        )
    for weak in found.get("weak", [])[:3]:
        terms = ", ".join(f"{factor:+.2f} {name}" for name, factor in weak["of"].items())
        print(f"  weakly determined, posterior / prior standard deviation {weak['share']:.0%}: {terms}")
