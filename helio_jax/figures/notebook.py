"""A record in a notebook: a thumbnail and a table of what a person wants to know (HTML, a few tens of kB at most)."""

import base64
import html
from typing import Any

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.instrument_views import draw_plan
from helio_jax.figures.plot_data import observed_counts, robust_range
from helio_jax.figures.summary import summarise
from helio_jax.figures.wording import typeset
from helio_jax.heightmap import HeightMap
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction

_SIDE = 160
"""Largest side of a thumbnail [dots]."""
_MOST = 4
"""Largest number of images of a stack that are shown."""


def as_html(what: Any) -> str:
    """Return thumbnails and a table of a record; texts from files are escaped."""
    pictures = "".join(
        f'<img alt="{html.escape(alt)}" title="{html.escape(alt)}" style="width:{_SIDE}px;margin-right:6px;'
        f'image-rendering:pixelated" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        for alt, png in _thumbnails(what)
    )
    cell = 'style="text-align:left;vertical-align:top;padding:1px 10px 1px 0"'
    rows = "".join(
        f"<tr><th {cell}>{html.escape(label)}</th><td {cell}>{html.escape(typeset(text))}</td></tr>"
        for label, text in summarise(what)
    )
    return f"<div><b>{type(what).__name__}</b><div>{pictures}</div><table>{rows}</table></div>"


def _thumbnails(what: Any) -> list[tuple[str, bytes]]:
    """Return a description and a PNG of each thumbnail."""
    if isinstance(what, MicrographSet):
        return _of_images([(s.name, observed_counts(s)[0]) for s in what.stacks[:_MOST]], canvas.COUNT_MAP)
    if isinstance(what, MicrographStack):
        names = what.instrument.detector_names
        return _of_images(list(zip(names, observed_counts(what), strict=True))[:_MOST], canvas.COUNT_MAP)
    if isinstance(what, (Reconstruction, HeightMap)):
        return _of_images([("height", what.height)], canvas.HEIGHT_MAP)
    if isinstance(what, Instrument):
        figure = canvas.new_figure(3.4, 3.2)
        draw_plan(figure.add_subplot(), what)
        return [("plan view of the plate", canvas.figure_png(figure, dpi=90))]
    return []


def _of_images(images: list[tuple[str, np.ndarray]], colors: str) -> list[tuple[str, bytes]]:
    """Return thumbnails of images [y, x], thinned to at most 160 dots a side."""
    out = []
    for name, image in images:
        small = image[tuple(slice(None, None, -(-n // _SIDE)) for n in image.shape)]
        out.append((name, canvas.image_png(small, robust_range(small), colors)))
    return out
