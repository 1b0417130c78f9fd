"""Scale bar of a map: a length of 1, 2 or 5 with a round number of zeros, drawn in the map's own coordinates."""

import math

from helio_jax.figures import canvas
from helio_jax.figures.wording import length, typeset

_LARGEST_SHARE = 0.25
"""Longest bar, in widths of the map."""


def bar_length(width: float) -> float:
    """Return the longest of 1, 2, 5, 10, 20, 50, ... that is at most a quarter of the width (same unit)."""
    most = _LARGEST_SHARE * width
    power = 10.0 ** math.floor(math.log10(most))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= most * (1 + 1e-9))


def draw_scale_bar(ax: canvas.Axes) -> None:
    """Draw a bar with its length at the lower left of a map whose axes are in um."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    long, high = bar_length(x1 - x0), 0.014 * (x1 - x0)
    left, low = x0 + 0.05 * (x1 - x0), y0 + 0.05 * (y1 - y0)
    style = {"facecolor": "white", "edgecolor": "black", "linewidth": 0.6}
    bar = ax.fill([left, left + long, left + long, left], [low, low, low + high, low + high], **style)[0]
    bar.set_gid("scale bar")
    text = typeset(length(long))
    place = (left + 0.5 * long, low + high + 0.006 * (y1 - y0))
    words = ax.text(*place, text, ha="center", va="bottom", color="white", fontsize=9)
    canvas.outline_text(words)
