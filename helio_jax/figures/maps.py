"""Maps that several pages draw: images with a colour bar, the shaded relief, the validity.

Images stay in the beam frame; the relief is drawn at the surface points' own positions.
"""

import textwrap
from typing import Any

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.plot_data import REASON_COLORS, cell_corners, cell_means, robust_range, surface_cells
from helio_jax.reconstruction import REASONS, Reconstruction

_MISSING = "#e8b4b8"
_SIZES = (10, 8.5, 8)
_BEAM_X, _BEAM_Y = "beam position X (µm)", "beam position Y (µm)"


def label_map(ax: canvas.Axes, title: str, xlabel: str = _BEAM_X, ylabel: str = _BEAM_Y) -> None:
    """Write title and labels of a map."""
    canvas.label_axes(ax, title, xlabel, ylabel, _SIZES)
    ax.tick_params(direction="out", length=3)


def draw_map(
    ax: canvas.Axes, x: np.ndarray, y: np.ndarray, image: np.ndarray, title: str, unit: str, **style: Any
) -> None:
    """Draw one image [y, x] over its beam positions, to scale, with a colour bar; missing pixels in pink."""
    low, high = limits = style.get("limits") or robust_range(image)
    cmap = canvas.color_map(style.get("cmap", canvas.COUNT_MAP), missing=_MISSING)
    shown = canvas.draw_image(ax, x, y, np.ma.masked_invalid(image), cmap, limits, aspect="equal")
    finite = image[np.isfinite(image)]
    below, above = (finite.min() < low, finite.max() > high) if finite.size else (False, False)
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    place = ax.inset_axes((1.03, 0.0, 0.04, 1.0))
    bar = ax.figure.colorbar(shown, cax=place, extendfrac=0.025, extend=extend[bool(below), bool(above)])
    bar.set_label(unit, fontsize=_SIZES[1])
    bar.ax.tick_params(labelsize=_SIZES[2], length=3)
    ax.locator_params(nbins=5)
    label_map(ax, title)


def draw_cells(ax: canvas.Axes, rec: Reconstruction, rgb: np.ndarray) -> None:
    """Draw colours of the raster cells [y-1, x-1, 3] at the surface points' own positions; cut cells stay empty."""
    cells = np.concatenate([rgb, surface_cells(rec)[..., None]], -1)
    ax.pcolormesh(*cell_corners(rec), cells, rasterized=True, linewidth=0, antialiased=False)
    ax.set_aspect("equal")


def draw_relief(ax: canvas.Axes, rec: Reconstruction) -> None:
    """Draw the surface from above at its own x, y, shaded from the upper left; occlusion edges and jumps stay white."""
    light = np.array([-0.5, 0.5, 0.9])
    shade = np.clip(rec.normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    rgb = canvas.colored(np.nan_to_num(rec.height), robust_range(rec.height))
    rgb = np.clip(rgb * (0.35 + 0.85 * np.nan_to_num(shade))[..., None], 0, 1)
    draw_cells(ax, rec, cell_means(rgb))
    ax.set_facecolor("white")
    ax.locator_params(nbins=5)
    label_map(ax, "Shaded relief (gaps: not seen by the beam)", "x (µm)", "y (µm)")


def draw_validity(ax: canvas.Axes, rec: Reconstruction) -> None:
    """Draw why pixels are not valid, with the share of each reason."""
    limits = -0.5, len(REASONS) - 0.5
    canvas.draw_image(ax, rec.raster_x, rec.raster_y, rec.reason, canvas.listed_colors(REASON_COLORS), limits)
    share = [float(np.mean(rec.reason == k)) for k in range(len(REASONS))]
    keys = [
        canvas.patch(color, f"{textwrap.fill(name, 11)}\n{100 * s:.1f} %", edgecolor="#888888", lw=0.5)
        for color, name, s in zip(REASON_COLORS, REASONS, share, strict=True)
        if s > 0
    ]
    ax.locator_params(nbins=5)
    label_map(ax, "Validity")
    style = {"fontsize": 8, "frameon": False, "loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    ax.legend(handles=keys, labelspacing=1.0, handlelength=0.9, handletextpad=0.5, **style)
