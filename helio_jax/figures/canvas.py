"""Canvas of every figure: the only module that imports matplotlib, and only when the first figure is drawn.

Uses `matplotlib.figure.Figure`: no pyplot, no display, no global state. Only windows need pyplot. Images
are drawn in the beam frame: one pixel per beam position, origin lower, axes in um.
"""

import functools
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import MissingDependencyError, SceneError
from helio_jax.formats.safe import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

HEIGHT_MAP, COUNT_MAP, FRACTION_MAP, ERROR_MAP = "viridis", "gray", "magma", "RdBu_r"
_FORMATS = ("png", "pdf", "svg")
_NO_DISPLAY = ("agg", "pdf", "svg", "ps", "cairo", "template")
"""Backends of matplotlib that open no window."""


def new_figure(width: float, height: float, layout: Any = "constrained") -> Figure:
    """Create an empty white figure [inch]; `layout=None` leaves the placing of axes to the caller."""
    return _figure_class()(figsize=(width, height), facecolor="white", layout=layout)


@functools.cache
def _figure_class() -> Any:
    """Return a figure that a notebook shows as it is, without pyplot."""
    from matplotlib import figure

    class Picture(figure.Figure):
        def _repr_png_(self) -> bytes:
            return figure_png(self, dpi=80)

    return Picture


def check_display(what: str, otherwise: str) -> None:
    """Refuse to open a window where there is no display.

    Args:
        what: needs the window, for the message.
        otherwise: what else the user can do.

    Raises:
        MissingDependencyError: no window can be opened on this machine.
    """
    import matplotlib

    backend = matplotlib.get_backend()
    if backend.lower() in _NO_DISPLAY:
        raise MissingDependencyError(
            f"{what} needs a window, but matplotlib has only the backend {backend!r} here: run it on a machine with a "
            f"display and a GUI toolkit (pip install PyQt6), or {otherwise}"
        )


def open_window(figure: Figure) -> None:
    """Show a figure in a window; return when it is closed (see `check_display`)."""
    from matplotlib import pyplot

    pyplot.figure(FigureClass=lambda **_: figure)  # type: ignore[arg-type]  # pyplot makes the window of the figure that is there
    pyplot.show()


def color_map(name: str, missing: str | None = None) -> Any:
    """Return a colour map by name; masked pixels in the colour `missing`, or transparent."""
    from matplotlib import colormaps

    return colormaps[name] if missing is None else colormaps[name].with_extremes(bad=missing)


def listed_colors(colors: Sequence[str]) -> Any:
    """Return a colour map of the integers from 0."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(list(colors))


def colored(values: np.ndarray, limits: tuple[float, float], name: str = HEIGHT_MAP) -> np.ndarray:
    """Return the colours of values by a colour map [..., 3], from 0 to 1."""
    from matplotlib.colors import Normalize

    return color_map(name)(Normalize(*limits)(values))[..., :3]


def patch(color: str, label: str, **style: Any) -> Any:
    """Return a coloured rectangle for a legend."""
    from matplotlib.patches import Patch

    return Patch(facecolor=color, label=label, **style)


def line(color: str, label: str) -> Any:
    """Return a coloured line for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=color, label=label)


def draw_circle(ax: Axes, center: tuple[float, float], radius: float) -> None:
    """Draw a thin white circle."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle(center, radius, fill=False, color="white", lw=1.0))


def fill_level(ax: Any, x: np.ndarray, y: np.ndarray, z: float, **style: Any) -> None:
    """Fill a level polygon at the height z in 3-D axes."""
    from matplotlib.collections import PolyCollection

    ax.add_collection3d(PolyCollection([np.column_stack([x, y])], **style), zs=z, zdir="z")


def label_axes(
    ax: Axes, title: str, xlabel: str = "", ylabel: str = "", sizes: tuple[float, float, float] = (9, 8, 7)
) -> None:
    """Write title and labels of axes; `sizes` of title, labels and ticks [pt]."""
    ax.set_title(title, fontsize=sizes[0], loc="left")
    ax.set_xlabel(xlabel, fontsize=sizes[1])
    ax.set_ylabel(ylabel, fontsize=sizes[1])
    ax.tick_params(labelsize=sizes[2])


def draw_image(
    ax: Axes,
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
    cmap: Any,
    limits: tuple[float, float] | tuple[None, None] = (None, None),
    **style: Any,
) -> Any:
    """Draw an image [y, x] about its beam positions x, y [um]: unsmoothed, y upwards; return matplotlib's image."""
    half_x, half_y = 0.5 * pitch(x), 0.5 * pitch(y)
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    style = {"origin": "lower", "interpolation": "nearest", "extent": extent, **style}
    return ax.imshow(image, cmap=cmap, vmin=limits[0], vmax=limits[1], **style)


def contour_lines(x: np.ndarray, y: np.ndarray, values: np.ndarray, n: int = 8) -> tuple[float, list[np.ndarray]]:
    """Find the contours of an image [y, x] at about `n` round levels.

    Args:
        x, y: positions of the columns and rows, two or more each.
        values: the image; NaN leaves a gap.
        n: levels at most.

    Returns:
        The distance of the levels, and the lines, each an array of points (x, y). A level at the median, which noise
        would draw all over a flat surface, is omitted.
    """
    from matplotlib.ticker import MaxNLocator

    finite = values[np.isfinite(values)]
    levels = MaxNLocator(n).tick_values(float(finite.min()), float(finite.max()))
    apart = float(levels[1] - levels[0])
    levels = levels[np.abs(levels - np.median(finite)) > 0.2 * apart]
    found = new_figure(1.0, 1.0, None).add_subplot().contour(x, y, np.ma.masked_invalid(values), levels)
    return apart, [line for lines in found.allsegs for line in lines]


def outline_text(text: Any, color: str = "black") -> None:
    """Draw a thin rim around a text, so that it can be read on any image."""
    from matplotlib import patheffects

    text.set_path_effects([patheffects.withStroke(linewidth=1.6, foreground=color)])


def image_png(image: np.ndarray, limits: tuple[float, float], name: str) -> bytes:
    """Return an image [y, x] as PNG, one dot per pixel, y upwards; missing pixels are transparent."""
    from matplotlib import image as images

    buffer = io.BytesIO()
    images.imsave(
        buffer, np.ma.masked_invalid(image), cmap=color_map(name), vmin=limits[0], vmax=limits[1], origin="lower",
        format="png",
    )  # fmt: skip
    return buffer.getvalue()


def color_bar(ax: Axes, limits: tuple[float, float], name: str, label: str) -> None:
    """Draw a colour bar at the right of axes for colours from `colored`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    place = ax.inset_axes((1.03, 0.0, 0.04, 1.0))
    bar = ax.figure.colorbar(ScalarMappable(Normalize(*limits), color_map(name)), cax=place)
    bar.set_label(label, fontsize=8.5)
    bar.ax.tick_params(labelsize=8, length=3)


def figure_png(figure: Figure, *, dpi: float = 150.0) -> bytes:
    """Return a figure as PNG, e.g. for a notebook."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, PDF or SVG by the file's suffix, atomically.

    Raises:
        SceneError: another suffix, or the file cannot be written.
    """
    kind = Path(path).suffix.lower().lstrip(".")
    if kind not in _FORMATS:
        raise SceneError(f"{path}: a figure's suffix must be one of {', '.join(_FORMATS)}, got {kind or 'none'!r}")
    with atomic_path(path) as part:
        figure.savefig(part, format=kind, dpi=150.0)
