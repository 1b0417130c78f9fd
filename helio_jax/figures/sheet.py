"""Page layout: rows of equal cells whose boxes are placed in inches, so that maps line up and nothing overlaps."""

from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures import canvas


class Sheet:
    """A figure filled row by row; every box is placed in inches, so that maps line up and nothing overlaps."""

    left, right, foot = 0.75, 0.9, 0.55

    def __init__(self, width: float, heights: list[float], *, title_lines: int = 1, heading: str = "") -> None:
        """Start a page.

        Args:
            width: of the page [inch].
            heights: of the boxes of each row [inch].
            title_lines: lines of the title above each box.
            heading: of the page; "": none.
        """
        self.head = 0.4 + 0.18 * (title_lines - 1)
        band = 0.3 if heading else 0.0
        self.width, self.heights = width, [h + self.head + self.foot for h in heights]
        self.total = sum(self.heights) + band
        self.figure = canvas.new_figure(width, self.total, layout=None)
        if heading:
            style = {"fontsize": 12, "fontweight": "bold", "va": "top"}
            self.figure.text(self.left / width, 1.0 - 0.1 / self.total, heading, **style)

    def add(self, row: int, column: int, n_columns: int) -> canvas.Axes:
        """Add axes in one of `n_columns` cells of a row, with room for labels and a colour bar."""
        cell, total = self.width / n_columns, self.total
        bottom = sum(self.heights[row + 1 :]) + self.foot
        size = ((cell - self.left - self.right) / self.width, (self.heights[row] - self.head - self.foot) / total)
        return self.figure.add_axes(((column * cell + self.left) / self.width, bottom / total, *size), anchor="NW")

    def add_wide(self, row: int, column: int, n_columns: int, **options: Any) -> canvas.Axes:
        """Add axes that fill a whole cell below its title, for drawings in 3-D, whose labels lie within."""
        size = (1.0 / n_columns, (self.heights[row] - self.head) / self.total)
        corner = (column / n_columns, sum(self.heights[row + 1 :]) / self.total)
        return self.figure.add_axes((*corner, *size), **options)

    @classmethod
    def map_height(cls, x: np.ndarray, y: np.ndarray, cell: float) -> float:
        """Return the height [inch] that lets a map fill a cell's width, within sensible limits."""
        ratio = (np.ptp(y) + pitch(y)) / (np.ptp(x) + pitch(x))
        return float(np.clip((cell - cls.left - cls.right) * ratio, 0.6, 6.0))
