"""Calibration of an instrument by scans of objects of known shape: `helio calibrate --known`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from helio_jax.calibration import mask_report
from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.known_report import ON_TWINS, as_record, calibrated_instrument, robust_chi_square
from helio_jax.calibration.known_shape import KnownFit, fit_known_shapes
from helio_jax.calibration.mask_directions import MaskFit, fit_masks
from helio_jax.calibration.unknowns import KnownShapeSettings
from helio_jax.errors import SceneError
from helio_jax.figures.known_shape import save_known_shape
from helio_jax.figures.mask_directions import save_mask_directions
from helio_jax.formats.hdf5 import read_stack
from helio_jax.formats.safe import check_outputs
from helio_jax.formats.toml import write_calibrated
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.known_scene import multiple_tracer


def calibrate_known(
    stacks: Sequence[MicrographStack],
    shapes: Sequence[str],
    settings: KnownShapeSettings | None = None,
    *,
    report: Callable[[int, int, str], None] | None = None,
    **changes: Any,
) -> KnownFit:
    """Fit the instrument of scans of objects of known shape.

    Args:
        stacks: as imported, all of one instrument.
        shapes: what each scan shows ("ball radius=1000"), or one for all.
        settings: default: the defaults of `KnownShapeSettings`.
        report: called before each round with (round, rounds, what is known).
        changes: settings that replace those, e.g. exponent=0.1.

    Raises:
        SceneError: an unknown shape or setting, or not as many shapes as scans.
    """
    known, chosen = _stated(stacks, shapes, settings, changes)
    rays = min(chosen.rays_of(stack.counts[0].size) for stack in stacks)
    trace = multiple_tracer(known, rays=rays, substrate_um=chosen.substrate_um) if rays else None
    return fit_known_shapes(list(stacks), known, chosen, trace=trace, report=report or (lambda *_: None))


def calibrate_masks(
    stacks: Sequence[MicrographStack],
    shapes: Sequence[str],
    settings: KnownShapeSettings | None = None,
    *,
    report: Callable[[int, int, str], None] | None = None,
    **changes: Any,
) -> MaskFit:
    """Find the directions of the apertures by the outlines of balls and of their masks alone.

    Free of the scattering law, gain and offset; a check on `calibrate_known`.

    Args:
        stacks: as imported, all of one instrument.
        shapes: what each scan shows ("ball radius=1000"), or one for all.
        settings: default: the defaults of `KnownShapeSettings`.
        report: called before each round with (round, rounds, what is known).
        changes: settings that replace those, e.g. polar_deg=10.

    Raises:
        SceneError: an unknown shape or setting, or not as many shapes as scans.
        GuardError: an object is no ball.
    """
    known, chosen = _stated(stacks, shapes, settings, changes)
    return fit_masks(list(stacks), known, chosen, report=report or (lambda *_: None))


def _stated(
    stacks: Sequence[MicrographStack],
    shapes: Sequence[str],
    settings: KnownShapeSettings | None,
    changes: dict[str, Any],
) -> tuple[list[KnownObject], KnownShapeSettings]:
    """Read the known shapes, one per scan, and the settings."""
    if len(shapes) not in (1, len(stacks)):
        raise SceneError(f"got {len(shapes)} known shapes for {len(stacks)} scans: give one for each, or one for all")
    known = [KnownObject.parse(text) for text in shapes] * (len(stacks) if len(shapes) == 1 else 1)
    return known, (settings or KnownShapeSettings()).changed(**changes)


def calibrate_known_files(
    paths: Sequence[str | Path],
    output: str | Path,
    shapes: Sequence[str],
    *,
    masks: bool = False,
    report: Callable[[int, int, str], None] | None = None,
    **changes: Any,
) -> dict[str, Any]:
    """Calibrate an instrument by the scans of files; write the instrument file, and a picture of residuals beside it.

    Args:
        paths: of the scans.
        output: instrument file to write.
        shapes: as for `calibrate_known`.
        masks: by the outlines of balls and their masks alone (`calibrate_masks`).
        report: called before each round with (round, rounds, what is known).
        changes: settings that replace the defaults.

    Returns:
        Table, read-out, chi-square by region and verdict, JSON-compatible.
    """
    output = Path(output)
    picture = output.with_suffix(".png")
    inputs = [("path", Path(path)) for path in paths]
    check_outputs(inputs, [("output", output), ("output: the .png beside it", picture)])
    stacks = [read_stack(path) for path in paths]
    if masks:
        return _written_masks(calibrate_masks(stacks, shapes, report=report, **changes), shapes, output, picture)
    fit = calibrate_known(stacks, shapes, report=report, **changes)
    record = as_record(fit)
    names = ", ".join(scan.name for scan in fit.scans)
    what = f"Instrument calibrated by helio calibrate --known {' '.join(map(repr, shapes))} on {names}."
    about = f"Robust chi-square {robust_chi_square(fit):.2f} per pixel, standard deviations x {fit.inflation:.2f}."
    where = "sample_distance_um is that of these scans' stage height. [covariance]: how the errors belong together."
    shared = "Other scans of this campaign share [readout], signal and background of the detectors, and [law]."
    write_calibrated(
        calibrated_instrument(fit), output, "\n".join((what, about, f"{ON_TWINS.capitalize()}.", where, shared))
    )
    save_known_shape(fit, picture)
    return record | {"files": [str(output), str(picture)]}


def _written_masks(fit: MaskFit, shapes: Sequence[str], output: Path, picture: Path) -> dict[str, Any]:
    """Write what masks tell of an instrument; see `calibrate_known_files`."""
    names = ", ".join(scan.name for scan in fit.scans)
    what = f"Directions by helio calibrate --masks --known {' '.join(map(repr, shapes))} on {names}."
    about = f"By geometry alone: no scattering law, gain or offset. Standard deviations x {fit.inflation:.2f}."
    where = "sample_distance_um is that of these scans' stage height. [covariance]: how the errors belong together."
    said = [f"{sentence[0].upper()}{sentence[1:]}." for sentence in mask_report.verdict(fit)]
    write_calibrated(mask_report.instrument_by_masks(fit), output, "\n".join((what, about, *said, where)))
    save_mask_directions(fit, picture)
    return mask_report.as_record(fit) | {"files": [str(output), str(picture)]}
