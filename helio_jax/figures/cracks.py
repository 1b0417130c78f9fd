"""Picture of cracks and vertical edges: micrographs and heights, above without and below with what was found."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from helio_jax.figures.panel import raster_style, robust_range
from helio_jax.measure.cracks import Cracks
from helio_jax.measure.lines import contrast_of
from helio_jax.measure.walls import Walls
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INCH = 4.6
_RANGE = 0.2
"""Signal over the flat's, minus 1, at which grey ends."""
_COLORS = {"slit": "#ee3377", "groove": "#ee7733", "crease": "#33bbee", "step": "#009988", "line": "#ddcc00"}
_DETERMINED, _OPEN = "#44dd44", "#ff9900"


def crack_panel(
    rec: Reconstruction,
    regions: Sequence[np.ndarray],
    stack: MicrographStack | None = None,
    cracks: Cracks | None = None,
    walls: Walls | None = None,
) -> "Figure":
    """Draw every micrograph and the heights twice: as they are, and with the lines that were found.

    Args:
        rec: heights.
        regions: that were searched, drawn where they are not the whole raster.
        stack: micrographs, if any.
        cracks: solid, numbered; creases, steps and other lines dashed.
        walls: on the heights; green where their step is determined, else orange.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    x, y = rec.raster_x, rec.raster_y
    style = raster_style(x, y)
    images = {} if stack is None else dict(zip(stack.instrument.detector_names, contrast_of(stack).values, strict=True))
    figure = Figure(figsize=((len(images) + 1) * _INCH, 2.1 * _INCH), facecolor="white", layout="constrained")
    axes = figure.subplots(2, len(images) + 1, squeeze=False, sharex=True, sharey=True)
    inside = np.any(regions, axis=0)
    shown = np.ma.masked_array(rec.height, ~rec.has_relief)
    low, high = robust_range(shown.compressed(), 1.0)
    for row in axes:
        for ax, (name, image) in zip(row, images.items(), strict=False):
            ax.imshow(image, cmap="gray", vmin=-_RANGE, vmax=_RANGE, **style)
            ax.set_title(f"{name}: signal over flat", fontsize=9, loc="left")
        picture = row[-1].imshow(shown, cmap="viridis", vmin=low, vmax=high, **style)
        row[-1].set_title("height (white: jump or masked)", fontsize=9, loc="left")
        figure.colorbar(picture, ax=row[-1], shrink=0.8, label="µm")
    for ax in axes[1]:
        if not inside.all():
            ax.contour(x, y, inside.astype(float), [0.5], colors="white", linewidths=0.5, linestyles="dotted")
        if cracks is not None:
            _draw_cracks(ax, cracks)
    if walls is not None:
        for w in walls.walls:
            color = _DETERMINED if w.is_determined else _OPEN
            axes[1, -1].plot(*zip(w.start, w.end, strict=True), "-", color=color, lw=2.0)
    for ax in axes.ravel():
        ax.tick_params(labelsize=7)
    for ax in axes[1]:
        ax.set_xlabel("beam position X (µm)", fontsize=8)
    handles = []
    if cracks is not None:
        kinds = {c.kind for c in cracks.cracks}
        handles += [Line2D([], [], color=color, label=kind) for kind, color in _COLORS.items() if kind in kinds]
    if walls is not None:
        handles += [Line2D([], [], color=_DETERMINED, label="vertical edge: step determined")]
        handles += [Line2D([], [], color=_OPEN, label="vertical edge: step not determined")]
    figure.legend(handles=handles, loc="outside lower center", ncols=max(len(handles), 1), fontsize=8)
    return figure


def _draw_cracks(ax: "Axes", cracks: Cracks) -> None:
    """Draw the lines of cracks, and their numbers beside their middles."""
    for c in cracks.cracks:
        dash = "-" if c in cracks.counted else (0, (3, 2))
        ax.plot(*c.points.T, color=_COLORS[c.kind], lw=1.1, ls=dash)
        middle = c.points[len(c.points) // 2]
        ax.annotate(str(c.number), middle, (5, 5), textcoords="offset points", color=_COLORS[c.kind], fontsize=9)
