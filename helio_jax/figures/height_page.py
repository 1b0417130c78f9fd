"""Page of a height map: heights in the sample frame, standard deviation, validity, and the numbers in words."""

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures import canvas
from helio_jax.figures.maps import draw_cells, draw_map, draw_relief, draw_validity, label_map
from helio_jax.figures.plot_data import cell_means, highest_valid, robust_range
from helio_jax.figures.scale_bar import draw_scale_bar
from helio_jax.figures.sheet import Sheet
from helio_jax.figures.summary import summarise
from helio_jax.figures.text_box import LINE, wrap_rows, write_rows
from helio_jax.figures.wording import typeset
from helio_jax.heightmap import HeightMap
from helio_jax.reconstruction import Reconstruction

_WIDTH = 10.0
_TOP = "#ee3377"


def draw_reconstruction(rec: Reconstruction) -> canvas.Figure:
    """Draw heights at the surface points' own positions, their standard deviation, the validity, and numbers."""
    rows = wrap_rows(summarise(rec), _WIDTH - 1.0)
    cell = 0.5 * _WIDTH
    high = Sheet.map_height(rec.raster_x, rec.raster_y, cell)
    heading = f"Height map by {rec.method}" + ": CONTRADICTED by its data" * rec.is_contradicted
    n_maps = 2 if rec.height_std is None else 3
    heights = [high] * -(-n_maps // 2)
    page = Sheet(_WIDTH, [*heights, LINE * len(rows)], heading=heading)
    _draw_heights(page.add(0, 0, 2), rec)
    places = iter([(0, 1), (1, 0)])
    if rec.height_std is not None:
        known = rec.height_std[rec.is_valid] if rec.is_valid.any() else rec.height_std
        style = {"cmap": canvas.FRACTION_MAP, "limits": (0.0, robust_range(known, 2.0)[1])}
        title = "Standard deviation of the heights"
        draw_map(page.add(*next(places), 2), rec.raster_x, rec.raster_y, rec.height_std, title, "s.d. (µm)", **style)
    draw_validity(page.add(*next(places), 2), rec)
    if n_maps == 3:
        draw_relief(page.add(1, 1, 2), rec)
    write_rows(page.add(len(heights), 0, 1), rows)
    return page.figure


def draw_height_map(found: HeightMap) -> canvas.Figure:
    """Draw a height map on a regular grid, and numbers."""
    rows = wrap_rows(summarise(found), 0.6 * _WIDTH)
    page = Sheet(
        0.6 * _WIDTH, [Sheet.map_height(found.x, found.y, 0.6 * _WIDTH), LINE * len(rows)], heading="Height map"
    )
    ax = page.add(0, 0, 1)
    draw_map(ax, found.x, found.y, found.height, "Height (sample frame)", "height (µm)", cmap=canvas.HEIGHT_MAP)
    label_map(ax, "Height (sample frame)", "x (µm)", "y (µm)")
    draw_scale_bar(ax)
    write_rows(page.add(1, 0, 1), rows)
    return page.figure


def _draw_heights(ax: canvas.Axes, rec: Reconstruction) -> None:
    """Draw the heights in the sample frame, invalid ones pale, with a mark at the highest valid point."""
    limits = robust_range(rec.height[rec.is_valid]) if rec.is_valid.any() else robust_range(rec.height)
    rgb = canvas.colored(np.nan_to_num(cell_means(rec.height)), limits)
    is_valid = cell_means(rec.is_valid.astype(float)) == 1.0
    draw_cells(ax, rec, np.where(is_valid[..., None], rgb, 0.35 * rgb + 0.65))
    half_x, half_y = 0.5 * pitch(rec.raster_x), 0.5 * pitch(rec.raster_y)
    ax.set_xlim(rec.raster_x[0] - half_x, rec.raster_x[-1] + half_x)
    ax.set_ylim(rec.raster_y[0] - half_y, rec.raster_y[-1] + half_y)
    ax.locator_params(nbins=5)
    canvas.color_bar(ax, limits, canvas.HEIGHT_MAP, "height (µm)")
    if (top := highest_valid(rec)) is not None:
        ax.plot(rec.x[top], rec.y[top], "+", color=_TOP, ms=11, mew=1.8)
        std = rec.height_std
        error = f" +- {std[top]:.3g}" if std is not None and np.isfinite(std[top]) else ""
        right = rec.x[top] > np.mean(ax.get_xlim())
        words = ax.annotate(
            typeset(f"{rec.height[top]:.4g}{error} um"), (rec.x[top], rec.y[top]), (-8 if right else 8, 8),
            textcoords="offset points", ha="right" if right else "left", color="white", fontsize=9,
        )  # fmt: skip
        canvas.outline_text(words)
    draw_scale_bar(ax)
    pale = "" if rec.is_valid.all() else " (pale: not valid)"
    label_map(ax, f"Height, sample frame{pale}", "x (µm)", "y (µm)")
