"""Page layout: rows of equal cells whose boxes are placed in inches, so that maps line up and nothing overlaps."""

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures import canvas


class Sheet:
    """A figure filled row by row; every box is placed in inches, so that maps line up and nothing overlaps."""

    left, right, head, foot = 0.75, 0.9, 0.4, 0.55

    def __init__(self, width: float, heights: list[float]) -> None:
        self.width, self.heights = width, [h + self.head + self.foot for h in heights]
        self.figure = canvas.new_figure(width, sum(self.heights), layout=None)

    def add(self, row: int, column: int, n_columns: int) -> canvas.Axes:
        """Add axes in one of `n_columns` cells of a row, with room for labels and a colour bar."""
        cell, total = self.width / n_columns, sum(self.heights)
        bottom = total - sum(self.heights[: row + 1]) + self.foot
        size = ((cell - self.left - self.right) / self.width, (self.heights[row] - self.head - self.foot) / total)
        return self.figure.add_axes(((column * cell + self.left) / self.width, bottom / total, *size), anchor="NW")

    @classmethod
    def map_height(cls, x: np.ndarray, y: np.ndarray, cell: float) -> float:
        """Return the height [inch] that lets a map fill a cell's width, within sensible limits."""
        ratio = (np.ptp(y) + pitch(y)) / (np.ptp(x) + pitch(x))
        return float(np.clip((cell - cls.left - cls.right) * ratio, 0.6, 6.0))
