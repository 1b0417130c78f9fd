"""Commands for files of other programs and measured scans: import, export, compare, align, pick, calibrate, orient.

Each parses, calls, prints; no logic of its own.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from helio_jax.commands.app import (
    FIGURE,
    AsJson,
    Bar,
    H5File,
    H5WithPicture,
    Picture,
    Rays,
    SceneArg,
    Set,
    app,
    print_result,
    print_table,
    say,
    scene_overrides,
    set_options,
    tell_micrographs,
    warn,
)
from helio_jax.commands.door import Reads, Writes
from helio_jax.formats.export_formats import SUFFIXES, help_text
from helio_jax.formats.suffixes import HDF5_SUFFIXES

COMPARISON = ("comparison.json", "comparison.png", "effects.png")
"""What `compare` writes in its folder (comparison.py)."""


@app.command("import")
def import_files(
    files: Annotated[
        list[Path], typer.Argument(help="Micrographs (.mat of B-SHeM, A-SHeM, the reference simulator)."), Reads()
    ],
    output: H5WithPicture,
    instrument: Annotated[
        Path | None,
        typer.Option(help="Instrument or scene, file or name, for files that lack it."),
        Reads(names_files=True),
    ] = None,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Read measured or simulated micrographs of other programs and write them to an HDF5 file."""
    from helio_jax import MicrographSet, import_micrographs, write
    from helio_jax.workflows.scene_file import load_instrument

    given = load_instrument(instrument) if instrument else None
    stacks = tuple(import_micrographs(path, given) for path in files)
    found = stacks[0] if len(stacks) == 1 else MicrographSet(stacks)
    write(found, output)
    if not as_json:
        print(f"written to {output}")
    tell_micrographs(found, output, picture, as_json)


@app.command(epilog=f"\b\n{help_text()}\n\nWhat each file holds, frames and units: docs/exports.md.")
def export(
    file: Annotated[Path, typer.Argument(help="Micrographs or heights (.h5)."), Reads()],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help=f"File to write: {' '.join(SUFFIXES)}."),
        Writes("a file of another program", SUFFIXES),
    ],
    view: Annotated[int | None, typer.Option(help="Which scan of a set, from 0.")] = None,
    detector: Annotated[str | None, typer.Option(help="Only the micrograph of this detector.")] = None,
    invalid: Annotated[
        str, typer.Option(help="Heights that are not valid: nan (missing), keep (as they are), fill (interpolated).")
    ] = "nan",
    grid: Annotated[
        float | None, typer.Option(help="Heights on a regular grid of this pitch in the sample frame [um].")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write micrographs or heights for another program; the suffix of the file selects the format."""
    from helio_jax import Reconstruction, read
    from helio_jax import export as write_foreign
    from helio_jax.figures.trust import trust_lines

    found = read(file)
    left_out = write_foreign(found, output, view=view, detector=detector, invalid=invalid, grid=grid)  # type: ignore
    lines = [str(output), *(f"  not written: {what}" for what in left_out)]
    if isinstance(found, Reconstruction):
        lines[1:1] = [f"  {line}" for line in (f"{found.method}, {found.status}", *trust_lines(found.trust))]
        warn(found.trust)
    print_result(as_json, {"file": str(output), "not_written": left_out}, *lines)


@app.command()
def compare(
    stack: Annotated[Path, typer.Argument(help="Measured micrographs (.h5)."), Reads()],
    scene: SceneArg,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write."), Writes(within=COMPARISON)] = Path(
        "helio-out/comparison"
    ),
    explain: Annotated[bool, typer.Option(help="Add one effect at a time and tabulate what it does.")] = False,
    rays: Rays = None,
    changes: Set = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a scene in the instrument that measured, and compare it with the measurement."""
    from helio_jax.formats.hdf5 import read_stack
    from helio_jax.workflows.compare import compare as compare_with_scene

    overrides = scene_overrides(changes, **{"trace.rays": rays})
    found = compare_with_scene(read_stack(stack), scene, overrides=overrides, explain=explain, progress=say)
    files = found.write(output)
    if as_json:
        print(json.dumps(found.as_dict() | {"files": list(map(str, files))}))
        return
    print(found.agreement.verdict())
    print_table(found.as_table())
    for path in files:
        print(path)


def _read_set(path: Path) -> Any:
    """Read a file of one or several scans as a set."""
    from helio_jax import MicrographSet
    from helio_jax.formats.hdf5 import read_micrographs

    return MicrographSet(read_micrographs(path).stacks)


@app.command()
def align(
    scans: Annotated[
        Path, typer.Argument(help="Scans of one sample, rotated between them (.h5 of helio import)."), Reads()
    ],
    output: H5File,
    points: Annotated[Path | None, typer.Option(help="Control points (CSV: view,point,x_um,y_um)."), Reads()] = None,
    auto: Annotated[bool, typer.Option("--auto", help="Without points: predict each scan from the others.")] = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE: field, max_shift_um, ... (repeat).")
    ] = None,
    figure: Annotated[Path | None, typer.Option(help="Overlays as a picture (.png, .pdf, .svg)."), FIGURE] = None,
    as_json: AsJson = False,
) -> None:
    """Align scans of a rotated sample and bring them onto one raster, ready for reconstruct."""
    from helio_jax import write
    from helio_jax.errors import SceneError
    from helio_jax.workflows import pipeline

    if auto == (points is not None):
        raise SceneError("align needs either --points FILE.csv or --auto")
    stack, places = pipeline.align(_read_set(scans), points, **set_options(settings))
    write(stack, output)
    if figure:
        from helio_jax.figures.overlay import save_overlay

        save_overlay(stack, places, figure)
    if as_json:
        print(json.dumps(stack.provenance["align"]))
        return
    from helio_jax.figures.overlay import describe_alignment

    print("\n".join(describe_alignment(stack)))
    print(f"written to {output}")


@app.command()
def pick(
    scans: Annotated[
        Path, typer.Argument(help="Scans of one sample, rotated between them (.h5 of helio import)."), Reads()
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Control points (CSV); those in the file are kept."),
        Writes(keeps=True),
    ],
    as_json: AsJson = False,
) -> None:
    """Open a window to click the same points in all scans; every click is saved."""
    from helio_jax.figures.pick import pick_points
    from helio_jax.formats.points import read_points, write_points

    before = read_points(output) if output.exists() else {}
    picks = pick_points(_read_set(scans), before, lambda found: write_points(output, found))
    n = sum(map(len, picks.values()))
    record = {"file": str(output), "picks": n, "scans": len(picks)}
    print_result(as_json, record, f"{output}: {n} picks in {len(picks)} scans")


@app.command()
def calibrate(
    stacks: Annotated[
        list[Path], typer.Argument(help="Measured micrographs (.h5), from helio import; several with --known."), Reads()
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="File to write: micrographs (.h5), or with --known an instrument (.toml)."),
        Writes("HDF5, or TOML with --known", (*HDF5_SUFFIXES, ".toml"), beside=(".png",)),
    ],
    known: Annotated[
        list[str] | None,
        typer.Option(help='Calibrate the instrument by objects of this shape, "ball radius=1000" (one per scan)'),
    ] = None,
    masks: Annotated[
        bool, typer.Option("--masks", help="With --known: directions by the outlines of ball and masks alone.")
    ] = False,
    drift: Annotated[bool, typer.Option(help="Subtract slow drift, and leave its residual to the fit.")] = True,
    lines: Annotated[bool, typer.Option(help="Leave offsets of single scan lines to the fit.")] = True,
    noise_model: Annotated[bool, typer.Option(help="Estimate the variance as a + b counts.")] = True,
    spike_limit: Annotated[float | None, typer.Option(help="Standard deviations of a spike; 0: none.")] = None,
    masked_share: Annotated[float | None, typer.Option(help="Multiple scattering in the darkest spot / flat.")] = None,
    leave_out_ring: Annotated[
        tuple[float, float] | None,
        typer.Option(help="With --known: ring about a ball's foot that is left out [foot radii]"),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE: border_fraction, plate_shift, ... (repeat).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate background, gain, drift and noise of a measured scan; with --known: an instrument by known shapes."""
    from helio_jax.errors import SceneError

    if known:
        changes = set_options(settings, leave_out_ring=leave_out_ring)
        _calibrate_known(stacks, output, known, masks, changes, as_json)
        return
    if len(stacks) > 1 or masks or leave_out_ring is not None or output.suffix.lower() == ".toml":
        raise SceneError(
            "several scans, --masks, --leave-out-ring and an instrument file (.toml) need --known SHAPE: add it"
        )
    stack = stacks[0]
    from helio_jax.workflows.pipeline import calibrate_file

    own = {"drift": drift, "lines": lines, "noise_model": noise_model}
    given = set_options(settings, **own, spike_limit=spike_limit, masked_share=masked_share)
    found = calibrate_file(stack, output, **given)
    assert found.calibration is not None  # just made
    record, priors = found.provenance["calibrate"], found.calibration.priors
    for text in found.calibration.warnings:
        say(f"warning: {text}")
    if as_json:
        about = {"priors": dict(priors), "detectors": found.instrument.detector_names}
        print(json.dumps({**record, **about}))
        return
    heads = ("background", 11), ("flat", 9), ("noise", 8), ("SNR", 7), ("lines", 8), ("a + b counts", 17), ("spikes", 8)
    print(f"  {'detector':<12}" + "".join(f"{head:>{width}}" for head, width in heads))
    for k, name in enumerate(found.instrument.detector_names):
        flat, background, noise, snr, lines_, a, b, spikes = (
            record[key][k]
            for key in (
                "flat", "background", "pixel_std", "snr", "line_noise", "noise_constant", "noise_per_count", "spikes"
            )
        )  # fmt: skip
        law = f"{a:.0f} + {b:.2f}"
        print(
            f"  {name:<12}{background:>11.0f}{flat - background:>9.0f}{noise:>8.1f}{snr:>7.2f}{lines_:>8.1f}"
            f"{law:>17}{spikes:>8}"
        )
    print(f"flat: signal above the background; prior standard deviation of the background: {priors['offset_std']:.0%}")
    print(f"background from: {record['background_from']}")
    print(f"{output}\n{output.with_suffix('.png')}")


def _calibrate_known(
    stacks: list[Path], output: Path, known: list[str], masks: bool, changes: dict, as_json: bool
) -> None:
    """Calibrate an instrument by known shapes, and print what was found."""
    from helio_jax.errors import SceneError
    from helio_jax.workflows.calibrate_known import calibrate_known_files

    if output.suffix.lower() != ".toml":
        raise SceneError(f"--known writes an instrument file: give -o the suffix .toml, got {str(output)!r}")
    with Bar("calibrating by masks" if masks else "calibrating by known shapes") as bar:
        found = calibrate_known_files(stacks, output, known, masks=masks, report=bar, **changes)
    if as_json:
        print(json.dumps(found))
        return
    from helio_jax.figures.summary import known_shape_lines, mask_lines

    print("\n".join((mask_lines if masks else known_shape_lines)(found)))


@app.command()
def orient(
    stack: Annotated[Path, typer.Argument(help="Micrographs of one scan with 3 or more detectors (.h5)."), Reads()],
    output: H5File,
    turn: Annotated[int | None, typer.Option(help="Counter-clockwise turn: 0, 90, 180, 270 (default: tried).")] = None,
    mirror: Annotated[
        bool | None, typer.Option("--mirror/--no-mirror", help="Whether x is reversed, before the turn.")
    ] = None,
    detectors: Annotated[
        str | None, typer.Option(help="NAME,NAME,...: detector of each image of the file (default: tried).")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE: min_margin, max_pixels, ... (repeat).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find by quick fits the orientation of a file's arrays and the detector of each image, and correct them."""
    from helio_jax import write
    from helio_jax.formats.hdf5 import read_stack
    from helio_jax.workflows.orient import OrientSettings, find_orientation

    names = None if detectors is None else tuple(name.strip() for name in detectors.split(","))
    how = OrientSettings().changed(**set_options(settings, turn_deg=turn, mirror=mirror, detectors=names))
    with Bar("fitting orientations") as bar:
        found = find_orientation(read_stack(stack), how, bar)
    print(json.dumps(found.as_dict()) if as_json else "\n".join(found.summary()))
    write(found.applied(), output)
    if not as_json:
        print(f"written to {output}")
