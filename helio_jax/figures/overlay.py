"""Figures of an alignment (every scan in the common frame under the edges of the others) and of facets.

Where a scan is aligned, its own edges run along the drawn lines.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy import ndimage

from helio_jax.figures import canvas
from helio_jax.figures.plot_data import robust_range
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

_COLUMNS = 3
_INCH = 4.6
_LINE = "#f0a020"
_MARK = "#33bbee"
_STRONG = 0.88
"""Quantile of the edge strength at which the edges are drawn."""


def edge_strength(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Compute the gradient's magnitude of an image over its robust spread [y, x]; NaN near unknown pixels."""
    values = image[known]
    low, middle, high = np.quantile(values, [0.16, 0.5, 0.84]) if values.size else (0.0, 0.0, 1.0)
    scaled = np.where(known, (image - middle) / (high - low or 1.0), 0.0)
    inner = ndimage.binary_erosion(known, iterations=3)
    return np.where(inner, ndimage.gaussian_gradient_magnitude(scaled, 1.2), np.nan)


def overlay_panel(stack: MicrographStack, places: Mapping[str, tuple[float, float]] | None = None) -> canvas.Figure:
    """Draw each image of an aligned stack with the strongest edges of the others as lines, and the count map.

    Args:
        stack: from `align_scans`.
        places: points of the common frame to mark [um].
    """
    n = stack.shape[0]
    edges = np.stack([edge_strength(i, k) for i, k in zip(stack.counts, stack.is_observed, strict=True)])
    known = np.isfinite(edges)
    total, count = np.where(known, edges, 0.0).sum(0), known.sum(0)
    rows = -(-(n + 1) // _COLUMNS)
    figure = canvas.new_figure(_COLUMNS * _INCH, rows * _INCH)
    for k, name in enumerate(stack.instrument.detector_names):
        ax = figure.add_subplot(rows, _COLUMNS, k + 1)
        values = stack.counts[k][stack.is_observed[k]]
        low, high = np.percentile(values, [0.5, 99.5]) if values.size else (0.0, 1.0)
        image = np.ma.masked_array(stack.counts[k], ~stack.is_observed[k])
        canvas.draw_image(ax, stack.x, stack.y, image, canvas.COUNT_MAP, (low, high))
        others = (total - np.where(known[k], edges[k], 0.0)) / np.maximum(count - known[k], 1)
        level = np.quantile(others[count > 1], _STRONG) if np.any(count > 1) else 0.0
        if level > 0:
            ax.contour(stack.x, stack.y, others, [level], colors=_LINE, linewidths=0.8)
        for label, (x, y) in (places or {}).items():
            ax.plot(x, y, "+", color=_MARK, ms=9, mew=1.4)
            ax.annotate(label, (x, y), (4, 4), textcoords="offset points", color=_MARK, fontsize=8)
        canvas.label_axes(ax, name)
    ax = figure.add_subplot(rows, _COLUMNS, n + 1)
    shown = canvas.draw_image(ax, stack.x, stack.y, stack.is_observed.sum(0), canvas.HEIGHT_MAP, (0, n))
    figure.colorbar(shown, ax=ax, shrink=0.8)
    canvas.label_axes(ax, "images per pixel", "x (µm)", "y (µm)")
    return figure


def save_overlay(stack: MicrographStack, places: Mapping[str, tuple[float, float]], path: str | Path) -> None:
    """Draw `overlay_panel` into a file."""
    canvas.save_figure(overlay_panel(stack, places), path)


def facet_map(rec: Reconstruction, labels: np.ndarray) -> canvas.Figure:
    """Draw the heights and, beside them, the facets with their numbers (labels [y, x], 0: none)."""
    figure = canvas.new_figure(2 * _INCH, _INCH)
    x, y = rec.raster_x, rec.raster_y
    left, right = figure.subplots(1, 2)
    height = np.ma.masked_array(rec.height, ~rec.is_valid)
    limits = robust_range(rec.height[rec.is_valid], 1.0)
    shown = canvas.draw_image(left, x, y, height, canvas.HEIGHT_MAP, limits)
    figure.colorbar(shown, ax=left, shrink=0.8, label="height (µm)")
    colors = canvas.color_map("tab20", missing="#f2f2f2")
    canvas.draw_image(right, x, y, np.ma.masked_equal(labels % 20, 0), colors, (0, 19))
    for number in range(1, int(labels.max()) + 1):
        row, column = np.argwhere(labels == number).mean(0)
        right.text(x[round(column)], y[round(row)], str(number), ha="center", va="center", fontsize=9)
    for ax, title in ((left, "height"), (right, "facets")):
        canvas.label_axes(ax, title, "x (µm)")
    return figure


def describe_alignment(stack: MicrographStack) -> list[str]:
    """List the motions of an aligned stack in words, and how many pixels three or more of its images show."""
    record, lines = stack.provenance["align"], []
    for scan in record["scans"]:
        x, y = scan["shift_um"]
        error = f"+- {scan['std_um']:.1f} um" if scan["std_um"] is not None else "error unknown"
        moved = f"rotated by {scan['rotation_deg']:.3f} deg, moved by ({x:.1f}, {y:.1f}) um, {error}"
        lines.append(f"  {scan['name']}: {moved}")
    if "points" in record:
        residual, left_out = record["points"]["residual_rms_um"], record["points"]["left_out_rms_um"]
        lines.append(f"  points: residual {residual:.1f} um, leave-one-out {left_out:.1f} um (rms)")
    n, ny, nx = stack.shape
    share = (stack.is_observed.sum(0) >= 3).mean()
    return [*lines, f"{n} images on {nx} x {ny} pixels; {share:.0%} of them in 3 or more"]
