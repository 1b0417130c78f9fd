"""Page of an instrument: plan view, side view, and its numbers in words."""

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.instrument_views import draw_plan, draw_side
from helio_jax.figures.sheet import Sheet
from helio_jax.figures.summary import summarise
from helio_jax.figures.text_box import LINE, wrap_rows, write_rows
from helio_jax.figures.wording import plural
from helio_jax.instrument import Instrument

_WIDTH = 10.0


def draw_instrument_views(instrument: Instrument) -> canvas.Figure:
    """Draw plate and apertures from above and from the side, without words."""
    return _views(instrument, []).figure


def draw_instrument(instrument: Instrument) -> canvas.Figure:
    """Draw plate and apertures from above and from the side, over a table of the instrument's numbers."""
    rows = wrap_rows(summarise(instrument), _WIDTH - 1.0)
    page = _views(instrument, [LINE * len(rows)])
    write_rows(page.add(1, 0, 1), rows)
    return page.figure


def _views(instrument: Instrument, below: list[float]) -> Sheet:
    """Draw both views on a page with room below [inch]."""
    square = np.arange(2.0)
    heights = [Sheet.map_height(square, square, 0.5 * _WIDTH), *below]
    page = Sheet(_WIDTH, heights, heading=f"Instrument with {plural(len(instrument.detector), 'detector')}")
    draw_plan(page.add(0, 0, 2), instrument)
    draw_side(page.add(0, 1, 2), instrument)
    return page
