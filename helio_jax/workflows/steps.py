"""What `helio measure --steps` prints, draws and writes: steps of any stack, simulated or measured, as text and CSV."""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from helio_jax.errors import SceneError
from helio_jax.figures.canvas import save_figure
from helio_jax.figures.steps import step_panel
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.inverse.step_records import BandRow, Patch, Step, Steps
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.measure import Wanted

COLUMNS = (
    "step", "x0_um", "y0_um", "x1_um", "y1_um", "direction_deg", "falls_deg", "above", "below", "step_height_um",
    "step_height_std_um", "step_is_lower_bound", "p_wall", "step_note", "detector", "kind", "length_um",
    "length_std_um", "runs_deg", "height_um", "height_std_um", "is_lower_bound", "note",
)  # fmt: skip
"""Columns of the table: of the step, then of one of its bands."""


def measure_steps(stack: MicrographStack, figure: str | Path | None = None) -> tuple[dict[str, Any], list[str]]:
    """Measure the steps of a stack; return a JSON-compatible record and lines to print.

    Args:
        stack: micrographs.
        figure: file for a picture of the bands and the steps.

    Raises:
        SceneError: as `find_steps`.
    """
    found = find_steps(stack)
    if figure:
        save_figure(step_panel(stack, found), figure)
    return found.as_dict(), step_lines(found)


def check_alone(wanted: Wanted, has_stack: bool) -> None:
    """Check that nothing of a height map is requested together with steps.

    Raises:
        SceneError: it is.
    """
    if has_stack or wanted._replace(table=False) != Wanted():
        raise SceneError(
            "--steps measures micrographs, which are the file itself: remove --stack, --set and the measurements of a "
            "height map (only --figure, --table and --json go with --steps)"
        )


def step_lines(found: Steps) -> list[str]:
    """Format the steps, the bands of each, and the patches."""
    used = sum(s.is_used for s in found.steps)
    lines = [
        f"steps: {len(found.steps)} edges, {used} with a measured height; lengths and heights in um",
        "  no  from             to               falls (deg)  height            patches  walls (p)  note",
    ]
    for s in found.steps:
        lines.append(
            f"  {s.number:>2}  {_place(s.start)}  {_place(s.end)}  {s.falls_deg:+6.0f}       {_height(s):<17} "
            f"{s.above:>2} -> {s.below:<2}  {s.p_wall:.2f}       {s.note}"
        )
        lines += [f"        {_band(b)}" for b in found.bands if b.step == s.number]
    lines.append("patches: level above patch 0 (um)")
    lines += [f"  {p.number:>2}  {p.pixels:>6} pixels  {_level(p)}" for p in found.patches]
    if found.dof:
        lines.append(f"  agreement of all steps: chi-square {found.chi2:.1f} of {found.dof} degrees of freedom")
    return lines


def steps_table(record: Mapping[str, Any]) -> str:
    """Format a record of `measure_steps` as CSV: one row for every band, and for a step without one; unknown: empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list[str](COLUMNS), restval="", lineterminator="\n")
    writer.writeheader()
    for step in record["steps"]:
        bands = [b for b in record["bands"] if b["step"] == step["number"]] or [{}]
        for band in bands:
            row = {name: band.get(name) for name in COLUMNS} | _step_columns(step)
            writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def _step_columns(step: Mapping[str, Any]) -> dict[str, Any]:
    """Take the columns of the step from its record."""
    (x0, y0), (x1, y1) = step["start"], step["end"]
    own = {name: step[name] for name in ("direction_deg", "falls_deg", "above", "below", "p_wall")}
    height = {f"step_{name}": step[name] for name in ("height_um", "height_std_um", "is_lower_bound", "note")}
    return {"step": step["number"], "x0_um": x0, "y0_um": y0, "x1_um": x1, "y1_um": y1} | own | height


def _place(p: tuple[float, float]) -> str:
    return f"({p[0]:6.0f},{p[1]:6.0f})"


def _height(s: Step) -> str:
    """Format the height of a step."""
    if not math.isfinite(s.height_um):
        return "-"
    return f"{'>= ' if s.is_lower_bound else ''}{s.height_um:.2f} +- {s.height_std_um:.2f}"


def _band(b: BandRow) -> str:
    """Describe one band."""
    what = "mask band" if b.kind == "dark" else "wall"
    bound = ", lower bound" if b.is_lower_bound else ""
    note = f", not used: {b.note}" if b.note else ""
    return (
        f"{b.detector}: {what} {b.length_um:.1f} +- {b.length_std_um:.1f} long towards {b.runs_deg:+.0f} deg, height "
        f"{b.height_um:.2f} +- {b.height_std_um:.2f}{bound}{note}"
    )


def _level(p: Patch) -> str:
    """Format the level of a patch."""
    if not math.isfinite(p.level_um):
        return "not determined" + (": only lower bounds are known" if p.is_lower_bound else "")
    note = "" if p.is_determined else f"; not reliable: {p.unexplained:.0%} of it masked without a step"
    return f"{p.level_um:+.2f} +- {p.level_std_um:.2f} ({p.n_steps} steps){note}"
