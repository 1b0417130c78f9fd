"""Pictures of an alignment (every scan in the common frame under the edges of all others) and of facets.

Where a scan is in place, its own edges run along the lines. Uses `matplotlib.figure.Figure` only: no display.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from helio_jax.figures.panel import raster_style, robust_range, save_figure
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 3
_INCH = 4.6
_LINE = "#f0a020"
_SHARE = 0.88


def edge_strength(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the gradient's size of a picture over its robust spread [y, x]; NaN near what is not known."""
    values = image[known]
    low, middle, high = np.quantile(values, [0.16, 0.5, 0.84]) if values.size else (0.0, 0.0, 1.0)
    scaled = np.where(known, (image - middle) / (high - low or 1.0), 0.0)
    inner = ndimage.binary_erosion(known, iterations=3)
    return np.where(inner, ndimage.gaussian_gradient_magnitude(scaled, 1.2), np.nan)


def overlay_panel(stack: MicrographStack, places: Mapping[str, tuple[float, float]] | None = None) -> "Figure":
    """Draw each picture of an aligned stack with the strongest edges of the others as lines, and the count map.

    Args:
        stack: from `align_scans`.
        places: points of the common frame to mark [um].
    """
    from matplotlib.figure import Figure

    n = stack.shape[0]
    edges = np.stack([edge_strength(i, k) for i, k in zip(stack.counts, stack.is_observed, strict=True)])
    known = np.isfinite(edges)
    total, count = np.where(known, edges, 0.0).sum(0), known.sum(0)
    rows = -(-(n + 1) // _COLUMNS)
    figure = Figure(figsize=(_COLUMNS * _INCH, rows * _INCH), facecolor="white", layout="constrained")
    style = raster_style(stack.x, stack.y)
    for k, name in enumerate(stack.instrument.detector_names):
        ax = figure.add_subplot(rows, _COLUMNS, k + 1)
        values = stack.counts[k][stack.is_observed[k]]
        low, high = np.percentile(values, [0.5, 99.5]) if values.size else (0.0, 1.0)
        shown = np.ma.masked_array(stack.counts[k], ~stack.is_observed[k])
        ax.imshow(shown, cmap="gray", vmin=low, vmax=high, **style)
        rest = (total - np.where(known[k], edges[k], 0.0)) / np.maximum(count - known[k], 1)
        level = np.quantile(rest[count > 1], _SHARE) if np.any(count > 1) else 0.0
        if level > 0:
            ax.contour(stack.x, stack.y, rest, [level], colors=_LINE, linewidths=0.8)
        for label, (x, y) in (places or {}).items():
            ax.plot(x, y, "+", color="#33bbee", ms=9, mew=1.4)
            ax.annotate(label, (x, y), (4, 4), textcoords="offset points", color="#33bbee", fontsize=8)
        ax.set_title(name, fontsize=9, loc="left")
        ax.tick_params(labelsize=7)
    ax = figure.add_subplot(rows, _COLUMNS, n + 1)
    shown = ax.imshow(stack.is_observed.sum(0), cmap="viridis", vmin=0, vmax=n, **style)
    figure.colorbar(shown, ax=ax, shrink=0.8)
    ax.set_title("images per pixel", fontsize=9, loc="left")
    ax.set_xlabel("x (µm)", fontsize=8)
    ax.set_ylabel("y (µm)", fontsize=8)
    ax.tick_params(labelsize=7)
    return figure


def save_overlay(stack: MicrographStack, places: Mapping[str, tuple[float, float]], path: str | Path) -> None:
    """Draw `overlay_panel` into a file."""
    save_figure(overlay_panel(stack, places), path)


def facet_map(rec: Reconstruction, labels: np.ndarray) -> "Figure":
    """Draw the heights and, beside them, the facets with their numbers (labels [y, x], 0: none)."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2 * _INCH, _INCH), facecolor="white", layout="constrained")
    x, y = rec.raster_x, rec.raster_y
    style = raster_style(x, y)
    left, right = figure.subplots(1, 2)
    known = np.ma.masked_array(rec.height, ~rec.is_valid)
    low, high = robust_range(rec.height[rec.is_valid], 1.0)
    shown = left.imshow(known, cmap="viridis", vmin=low, vmax=high, **style)
    figure.colorbar(shown, ax=left, shrink=0.8, label="height (µm)")
    colors = colormaps["tab20"].with_extremes(bad="#f2f2f2")
    right.imshow(np.ma.masked_equal(labels % 20, 0), cmap=colors, vmin=0, vmax=19, **style)
    for number in range(1, int(labels.max()) + 1):
        row, column = np.argwhere(labels == number).mean(0)
        right.text(x[round(column)], y[round(row)], str(number), ha="center", va="center", fontsize=9)
    for ax, title in ((left, "height"), (right, "facets")):
        ax.set_title(title, fontsize=9, loc="left")
        ax.set_xlabel("x (µm)", fontsize=8)
        ax.tick_params(labelsize=7)
    return figure
