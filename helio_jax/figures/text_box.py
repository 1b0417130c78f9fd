"""Rows of (label, text) written into axes."""

import textwrap
from collections.abc import Sequence

from helio_jax.figures import canvas
from helio_jax.figures.wording import short, typeset

LINE = 0.2
"""Height of a line [inch]."""
_LABEL = 1.15
"""Width of the labels [inch]."""
_LETTERS = 16
"""Longest label."""
_LETTER = 0.072
"""Mean width of a letter [inch]."""


def wrap_rows(rows: Sequence[tuple[str, str]], width: float) -> list[tuple[str, str]]:
    """Break the texts of rows to lines that fit `width` [inch]; continued lines have no label."""
    out = []
    for label, text in rows:
        lines = textwrap.wrap(typeset(text), max(10, int((width - _LABEL) / _LETTER))) or [""]
        out += [(short(label, _LETTERS) if i == 0 else "", line) for i, line in enumerate(lines)]
    return out


def write_rows(ax: canvas.Axes, rows: Sequence[tuple[str, str]]) -> None:
    """Write wrapped rows from the top of the axes downwards, labels in grey, those in capitals in red."""
    ax.set_axis_off()
    style = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "top", "fontsize": 9}
    for k, (label, text) in enumerate(rows):
        ax.annotate(label, (0.0, 1.0), (0, -72 * LINE * k), color="#b00020" if label.isupper() else "#555555", **style)
        ax.annotate(text, (0.0, 1.0), (72 * _LABEL, -72 * LINE * k), **style)
