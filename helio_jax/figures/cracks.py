"""Figure of cracks and vertical edges: micrographs and heights, above without and below with the detected lines."""

import numpy as np

from helio_jax.figures.canvas import COUNT_MAP, HEIGHT_MAP, Axes, Figure, draw_image, label_axes, line, new_figure
from helio_jax.figures.plot_data import robust_range
from helio_jax.measure.cracks import Cracks
from helio_jax.measure.lines import contrast_of
from helio_jax.measure.walls import Walls
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

_INCH = 4.6
_RANGE = 0.2
"""Limit of the grey scale: signal over the substrate's, minus 1."""
_COLORS = {"slit": "#ee3377", "groove": "#ee7733", "crease": "#33bbee", "step": "#009988", "line": "#ddcc00"}
_DETERMINED, _UNDETERMINED = "#44dd44", "#ff9900"


def crack_panel(
    rec: Reconstruction,
    region: np.ndarray,
    stack: MicrographStack | None = None,
    cracks: Cracks | None = None,
    walls: Walls | None = None,
) -> Figure:
    """Draw every micrograph and the heights twice: as they are, and with the detected lines.

    Args:
        rec: heights.
        region: True where lines were searched [y, x]; outlined unless it is the whole raster.
        stack: micrographs, if any.
        cracks: solid, numbered; creases, steps and other lines dashed.
        walls: on the heights; green where their step is determined, else orange.
    """
    x, y = rec.raster_x, rec.raster_y
    images = {} if stack is None else dict(zip(stack.instrument.detector_names, contrast_of(stack).values, strict=True))
    figure = new_figure((len(images) + 1) * _INCH, 2.1 * _INCH)
    axes = figure.subplots(2, len(images) + 1, squeeze=False, sharex=True, sharey=True)
    height = np.ma.masked_array(rec.height, ~rec.has_relief)
    for row, xlabel in zip(axes, ("", "beam position X (µm)"), strict=True):
        for ax, (name, image) in zip(row, images.items(), strict=False):
            draw_image(ax, x, y, image, COUNT_MAP, (-_RANGE, _RANGE))
            label_axes(ax, f"{name}: signal over substrate", xlabel)
        shown = draw_image(row[-1], x, y, height, HEIGHT_MAP, robust_range(height.compressed(), 1.0))
        label_axes(row[-1], "height (white: jump or masked)", xlabel)
        figure.colorbar(shown, ax=row[-1], shrink=0.8, label="µm")
    handles = []
    for ax in axes[1]:
        if not region.all():
            ax.contour(x, y, region.astype(float), [0.5], colors="white", linewidths=0.5, linestyles="dotted")
        if cracks is not None:
            _draw_cracks(ax, cracks)
    if cracks is not None:
        kinds = {c.kind for c in cracks.cracks}
        handles += [line(color, kind) for kind, color in _COLORS.items() if kind in kinds]
    if walls is not None:
        for w in walls.walls:
            color = _DETERMINED if w.is_determined else _UNDETERMINED
            axes[1, -1].plot(*zip(w.start, w.end, strict=True), "-", color=color, lw=2.0)
        handles.append(line(_DETERMINED, "vertical edge: step determined"))
        handles.append(line(_UNDETERMINED, "vertical edge: step not determined"))
    figure.legend(handles=handles, loc="outside lower center", ncols=max(len(handles), 1), fontsize=8)
    return figure


def _draw_cracks(ax: Axes, cracks: Cracks) -> None:
    """Draw the course of each crack, and its number beside the middle."""
    for c in cracks.cracks:
        dash = "-" if c in cracks.counted else (0, (3, 2))
        ax.plot(*c.points.T, color=_COLORS[c.kind], lw=1.1, ls=dash)
        middle = c.points[len(c.points) // 2]
        ax.annotate(str(c.number), middle, (5, 5), textcoords="offset points", color=_COLORS[c.kind], fontsize=9)
