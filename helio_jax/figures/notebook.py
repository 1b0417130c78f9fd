"""A record in a notebook: a thumbnail and a table of what a person wants to know (HTML, a few tens of kB at most)."""

import base64
import html
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures import canvas
from helio_jax.figures.instrument_views import draw_plan
from helio_jax.figures.plot_data import observed_counts, robust_range
from helio_jax.figures.summary import summarise
from helio_jax.figures.wording import typeset
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction

_SIDE = 160
"""Largest side of a thumbnail [dots]."""
_PLAN = 300
"""Side of a plan view [dots]."""
_MOST = 4
"""Largest number of images of a stack that are shown."""


@dataclass(frozen=True)
class Thumbnail:
    """A small picture: what it shows, its PNG, and its size on the page [dots]."""

    about: str
    png: bytes
    width: int
    height: int

    def as_html(self) -> str:
        """Return the element of a page."""
        about, data = html.escape(self.about), base64.b64encode(self.png).decode()
        style = f"width:{self.width}px;height:{self.height}px;margin-right:6px;image-rendering:pixelated"
        return f'<img alt="{about}" title="{about}" style="{style}" src="data:image/png;base64,{data}">'


def as_html(what: Any) -> str:
    """Return thumbnails and a table of a record; texts from files are escaped."""
    pictures = "".join(thumbnail.as_html() for thumbnail in _thumbnails(what))
    cell = 'style="text-align:left;vertical-align:top;padding:1px 10px 1px 0"'
    rows = "".join(
        f"<tr><th {cell}>{html.escape(label)}</th><td {cell}>{html.escape(typeset(text))}</td></tr>"
        for label, text in summarise(what)
    )
    return f"<div><b>{type(what).__name__}</b><div>{pictures}</div><table>{rows}</table></div>"


def _thumbnails(what: Any) -> list[Thumbnail]:
    """Return what stands above the table."""
    if isinstance(what, MicrographSet):
        return [_of_image(s.name, observed_counts(s)[0], s.x, s.y, canvas.COUNT_MAP) for s in what.stacks[:_MOST]]
    if isinstance(what, MicrographStack):
        pairs = zip(what.instrument.detector_names[:_MOST], observed_counts(what), strict=False)
        return [_of_image(name, image, what.x, what.y, canvas.COUNT_MAP) for name, image in pairs]
    if isinstance(what, Reconstruction):
        return [_of_image("height", what.height, what.raster_x, what.raster_y, canvas.HEIGHT_MAP)]
    if isinstance(what, HeightMap):
        return [_of_image("height", what.height, what.x, what.y, canvas.HEIGHT_MAP)]
    figure = canvas.new_figure(3.4, 3.4)
    draw_plan(figure.add_subplot(), what)
    return [Thumbnail("plan view of the plate", canvas.figure_png(figure, dpi=120), _PLAN, _PLAN)]


def _of_image(about: str, image: np.ndarray, x: np.ndarray, y: np.ndarray, colors: str) -> Thumbnail:
    """Return an image [y, x] over its positions, thinned to at most 160 dots a side, true to scale."""
    small = image[tuple(slice(None, None, -(-n // _SIDE)) for n in image.shape)]
    sides = np.array([pitch(x) * x.size, pitch(y) * y.size])
    width, height = np.maximum(1, np.round(_SIDE * sides / sides.max())).astype(int)
    return Thumbnail(about, canvas.image_png(small, robust_range(small), colors), int(width), int(height))
