"""Cracks and vertical edges as lines of text, and as a table with a row for each (CSV)."""

import csv
import io
import math
from collections.abc import Mapping
from typing import Any

from helio_jax.measure.cracks import Crack, Cracks
from helio_jax.measure.walls import Walls

COLUMNS = (
    "what", "number", "kind", "x0_um", "y0_um", "x1_um", "y1_um", "length_um", "length_std_um", "is_cut",
    "direction_deg", "width_um", "width_std_um", "depth_um", "depth_std_um", "depth_at_least_um", "is_determined",
    "score", "false_alarms", "note",
)  # fmt: skip
"""Columns of the table before those of the detectors; depth: of a groove, or height of a step."""
_ALONG_SCAN = 5.0
"""Angle to the scan lines below which a crack is marked [deg]."""


def crack_lines(found: Cracks) -> list[str]:
    """Format a summary and a table of cracks."""
    density, std = found.density
    total = sum(c.length_um for c in found.counted)
    lines = [
        f"cracks: {len(found.counted)}, total length {total / 1e3:.2f} mm, {1e3 * density:.2f} +- {1e3 * std:.2f} mm "
        f"per mm2 of {found.area_um2 / 1e6:.2f} mm2; also {len(found.cracks) - len(found.counted)} creases, steps "
        "and other lines",
        f"  allowed false alarms: {found.allowed:g} lines; {found.left_out} lines rejected (in one detector only, or "
        f"no concave kink); {found.n_ridges} ridges detected in the same way",
        "  no kind     from (um)          to (um)       length (um)    width (um)  depth (um)     false alarms",
    ]
    for c in found.cracks:
        width = _with_std(c.width_um, c.width_std_um, 0)
        if not math.isfinite(c.width_um) and math.isfinite(c.width_range_um[0]):
            width = f"{c.width_range_um[0]:.0f}-{c.width_range_um[1]:.0f}"
        depth = _with_std(c.depth_um, c.depth_std_um, 1)
        depth = f">= {c.depth_at_least_um:.0f}" if c.kind == "slit" else depth
        length = _with_std(c.length_um, c.length_std_um, 0)
        lines.append(
            f"  {c.number:>2} {c.kind:<6} {_place(c.start)} {_place(c.end)} {length:>12}"
            f"  {width:>12}  {depth:<13} {c.false_alarms:.0e}"
        )
        lines.append(f"     {_contrast(c)}; depth: {c.depth_note}")
        if c.is_cut:
            lines.append("     cut by the region's border: it may be longer")
        if c.along_scan_deg < _ALONG_SCAN:
            lines.append(f"     {c.along_scan_deg:.0f} deg from the scan lines: may be drift within a scan line")
    return lines


def wall_lines(found: Walls) -> list[str]:
    """Format a summary and a table of vertical edges."""
    n_determined = sum(w.is_determined for w in found.walls)
    lines = [
        f"vertical edges: {len(found.walls)}, {n_determined} with a determined step; {found.share:.0%} of "
        f"{int(found.marked.sum())} pixels flagged as jump, masked or floating rim belong to them",
        "  no  from (um)          to (um)       length (um)  runs   falls (deg)  step (um)",
    ]
    for w in found.walls:
        lines.append(
            f"  {w.number:>2} {_place(w.start)} {_place(w.end)} {_with_std(w.length_um, w.length_std_um, 0):>12}"
            f" {w.direction_deg:+6.0f} {w.falls_deg:+6.0f}       {_with_std(w.step_um, w.step_std_um, 1):<14} {w.note}"
        )
    return lines


def table(measured: Mapping[str, Any]) -> str:
    """Format a record of `measure_height_map` as CSV, one row for every crack and vertical edge; unknown: empty.

    After `COLUMNS` every detector has two columns, contrast and deviation: missing signal [um] of slits, steps and
    lines, change of the signal over the substrate's across grooves and creases.
    """
    found = measured.get("cracks", {"lines": []})["lines"]
    walls = measured.get("vertical_edges", {"edges": []})["edges"]
    detectors = list(dict.fromkeys(name for c in found for name in (c["missing_um"] or c["change"])))
    more = [f"{name}{end}" for name in detectors for end in ("", "_std")]
    text = io.StringIO()
    writer = csv.DictWriter(text, [*COLUMNS, *more], restval="", lineterminator="\n")
    writer.writeheader()
    for row in [_crack_row(c) for c in found] + [_wall_row(w) for w in walls]:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def _row(record: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Take the columns and the ends from a record."""
    (x0, y0), (x1, y1) = record["start"], record["end"]
    ends = {"x0_um": x0, "y0_um": y0, "x1_um": x1, "y1_um": y1}
    return {name: record.get(name) for name in COLUMNS} | ends | more


def _crack_row(c: Mapping[str, Any]) -> dict[str, Any]:
    value, std = (c["missing_um"], c["missing_std_um"]) if c["missing_um"] else (c["change"], c["change_std"])
    row = _row(c, what="crack", is_determined=c["depth_um"] is not None, note=c["depth_note"])
    return row | value | {f"{name}_std": v for name, v in std.items()}


def _wall_row(w: Mapping[str, Any]) -> dict[str, Any]:
    return _row(w, what="vertical edge", kind="jump", depth_um=w["step_um"], depth_std_um=w["step_std_um"])


def _place(p: tuple[float, float]) -> str:
    return f"({p[0]:6.0f},{p[1]:6.0f})"


def _with_std(value: float, std: float, digits: int) -> str:
    """Format "value +- std", or a dash for an unknown value."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}" + (f" +- {std:.{digits}f}" if math.isfinite(std) else "")


def _contrast(c: Crack) -> str:
    """Describe a crack's contrast in every detector."""
    if c.missing_um:
        parts = (f"{n} {v:+.1f} +- {c.missing_std_um[n]:.1f}" for n, v in c.missing_um.items())
        return f"missing signal (um of substrate): {', '.join(parts)}"
    parts = (f"{n} {v:+.1%} +- {c.change_std[n]:.1%}" for n, v in c.change.items())
    return f"kink {c.kink_deg:.1f} +- {c.kink_std_deg:.1f} deg; change of signal: {', '.join(parts)}"
