"""Printed panel for papers: micrographs, heights, errors, profiles, numbers.

Maps are drawn in the beam frame, the relief at the surface points' own positions, profiles in the sample frame. The
interactive version of the same data is `report`.
"""

import textwrap
from typing import Any

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.maps import draw_map, draw_relief, draw_validity, label_map
from helio_jax.figures.plot_data import (
    Profile,
    highest_valid,
    is_checkable,
    multiple_fraction,
    observed_counts,
    profiles,
    residual_rms,
    robust_range,
    symmetric_range,
)
from helio_jax.figures.sheet import Sheet
from helio_jax.figures.trust import COLORS, verdict, verdict_text
from helio_jax.figures.wording import typeset
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scores.metrics import Scores, Truth, height_error

PANEL_SCORES = (
    "recovered_height", "rms_region", "rms_image", "rms_valid", "ring_error", "shape_error", "slope_rms",
    "coverage_1", "coverage_2", "valid_fraction", "H_um",
)  # fmt: skip
WIDTH = 12.6
"""Width of the panel [inch]."""


def _draw_profile(ax: canvas.Axes, cut: Profile) -> None:
    """Draw the heights along a line of the sample frame; gaps where none is valid."""
    if cut.truth is not None:
        ax.plot(cut.at, cut.truth, label="truth", color="#222222", lw=2.2, alpha=0.45)
    if cut.height_std is not None:
        low, high = cut.height - cut.height_std, cut.height + cut.height_std
        ax.fill_between(cut.at, low, high, color="#4477aa", alpha=0.3, lw=0, label="± 1 s.d.")
    ax.plot(cut.at, cut.height, label="reconstruction", color="#4477aa", lw=1.2)
    title = f"Profile through the highest valid point, along {cut.along} at {cut.place}"
    label_map(ax, title, f"{cut.along} (µm), sample frame", "height (µm)")
    ax.grid(color="#dddddd", lw=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.margins(x=0.01, y=0.08)
    ax.legend(fontsize=8, frameon=False, loc="best")


def _draw_numbers(ax: canvas.Axes, rec: Reconstruction, scores: Scores | None) -> None:
    """Write the headline numbers as a table, and the verdict below it."""
    ax.set_axis_off()
    ax.set_title("Numbers", fontsize=10, loc="left")
    heights = rec.height[rec.is_valid & np.isfinite(rec.height)]
    rows = [("method", rec.method, "")]
    if (top := highest_valid(rec)) is not None:
        std = rec.height_std
        error = "" if std is None or not np.isfinite(std[top]) else f" ± {std[top]:.{0 if std[top] >= 10 else 1}f}"
        rows.append(("highest valid point", f"{rec.height[top]:.4g}{error}", "um"))
        rows.append(("relief of the valid heights", f"{np.ptp(heights):.4g}", "um"))
    if scores is None:
        rows.append(("valid pixels", f"{100 * rec.valid_share:.1f}", "%"))
    rows += [] if scores is None else scores.as_table(PANEL_SCORES)
    step = 1.0 / 16.0
    text = {"transform": ax.transAxes, "fontsize": 8.5, "va": "top"}
    for k, (label, value, unit) in enumerate(rows):
        ax.text(0.0, 1.0 - k * step, label, color="#444444", **text)
        ax.text(1.03, 1.0 - k * step, value, ha="right", color="#000000", **text)
        ax.text(1.06, 1.0 - k * step, unit.replace("um", "µm").replace("deg", "°"), color="#444444", **text)
    said = textwrap.fill(f"Verdict: {verdict_text(rec)}", 48)
    ax.text(0.0, 1.0 - (len(rows) + 0.5) * step, typeset(said), color=COLORS[verdict(rec)[0]], **text)


def _extra_maps(rec: Reconstruction, error: np.ndarray | None) -> list[tuple[np.ndarray, str, str, dict[str, Any]]]:
    """Return (image, title, unit, style) of the maps known for this reconstruction, the most informative first."""
    out: list[tuple[np.ndarray, str, str, dict[str, Any]]] = []
    if error is not None:
        style = {"cmap": canvas.ERROR_MAP, "limits": symmetric_range(error)}
        out.append((error, "Height error (reconstructed - true)", "error (µm)", style))
    if rec.height_std is not None:
        out.append((rec.height_std, "Standard deviation of height", "std (µm)", {"cmap": canvas.FRACTION_MAP}))
    if is_checkable(rec):
        assert rec.residuals is not None
        out.append((residual_rms(rec.residuals), "Residuals, RMS over detectors", "std", {"cmap": canvas.FRACTION_MAP}))
    return [*out, (rec.albedo, "Albedo", "albedo (flat = 1)", {})]


def panel(
    stack: MicrographStack | None, rec: Reconstruction, truth: Truth | None = None, scores: Scores | None = None
) -> canvas.Figure:
    """Draw one panel for a paper: micrographs, height and error maps, relief, profiles, validity, numbers.

    Args:
        stack: the micrographs (any number of detectors), or None to leave them out.
        rec: the reconstruction.
        truth: true heights on the same raster; gives the error map and the truth in the profiles.
        scores: numbers to print, from `evaluate_height`.

    Returns:
        The figure, for `canvas.save_figure`.

    Raises:
        InputFileError, GuardError: the truth does not fit the reconstruction (see `height_error`).
    """
    error, level = (None, 0.0) if truth is None else height_error(rec, truth)
    x, y = rec.raster_x, rec.raster_y
    n = 0 if stack is None else stack.shape[0]
    per_row = 4 if n == 4 else 3
    top = -(-n // per_row)
    tall = Sheet.map_height(x, y, WIDTH / 3)
    cuts = profiles(rec, None if truth is None else truth.height, level)
    rows = [Sheet.map_height(x, y, WIDTH / per_row)] * top + [tall, max(tall, 3.2)] + [2.3] * bool(cuts)
    sheet = Sheet(WIDTH, rows)
    if stack is not None:
        for k, (name, image) in enumerate(zip(stack.instrument.detector_names, observed_counts(stack), strict=True)):
            ax = sheet.add(k // per_row, k % per_row, per_row)
            draw_map(ax, stack.x, stack.y, image, f"Micrograph {name}", f"{stack.unit} per pixel")
    levelled = rec.replace(height=rec.height - level)
    draw_map(sheet.add(top, 0, 3), x, y, levelled.height, "Height", "height (µm)", cmap=canvas.HEIGHT_MAP)
    draw_relief(sheet.add(top, 1, 3), levelled)
    for (row, column), extra in zip(((top, 2), (top + 1, 1)), _extra_maps(rec, error), strict=False):
        draw_map(sheet.add(row, column, 3), x, y, extra[0], extra[1], extra[2], **extra[3])
    draw_validity(sheet.add(top + 1, 0, 3), rec)
    _draw_numbers(sheet.add(top + 1, 2, 3), rec, scores)
    for column, cut in enumerate(cuts):
        _draw_profile(sheet.add(top + 2, column, 2), cut)
    return sheet.figure


def micrograph_panel(stack: MicrographStack) -> canvas.Figure:
    """Draw the images of one scan: counts and, where known, multiple scattering, masked and shadowed fractions.

    One column per detector, one row per kind of map.
    """
    n = stack.shape[0]
    kinds: list[tuple[str, np.ndarray, str, dict[str, Any]]] = [
        ("Micrograph", observed_counts(stack), f"{stack.unit} per pixel", {})
    ]
    multiple = multiple_fraction(stack)
    fraction = {"cmap": canvas.FRACTION_MAP, "limits": (0.0, 1.0)}
    if multiple is not None:
        limits = 0.0, robust_range(multiple, 0.5)[1]
        kinds.append(("Multiple scattering", multiple, "fraction of counts", fraction | {"limits": limits}))
    if stack.masked is not None:
        kinds.append(("Masked", stack.masked, "fraction of aperture", fraction))
    if stack.shadowed is not None:
        kinds.append(("Shadowed", stack.shadowed[None], "fraction", fraction))
    cell = max(4.0, WIDTH / n) if n > 3 else WIDTH / 3
    sheet = Sheet(cell * n, [Sheet.map_height(stack.x, stack.y, cell)] * len(kinds))
    for i, (title, images, unit, style) in enumerate(kinds):
        for k, image in enumerate(images):
            name = "" if len(images) != n or title == "Shadowed" else f" {stack.instrument.detector_names[k]}"
            draw_map(sheet.add(i, k, n), stack.x, stack.y, image, title + name, unit, **style)
    return sheet.figure
