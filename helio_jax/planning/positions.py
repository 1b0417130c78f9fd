"""Lists of beam positions with dwell times, in the order in which a scan visits them. Numbers in, numbers out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError

MAX_GROUPS = 1024
"""Blocks per scan at most, where no size of a block is given."""


def block_size(shape: tuple[int, int], given: int | None, least: int = 1) -> int:
    """Choose the side of square blocks of a raster [pixels]: as given, or the least one with `MAX_GROUPS` at most.

    Raises:
        SceneError: the given side is not within 1 to the longer side of the raster, or below `least`.
    """
    if given is None:
        size = least
        while -(-shape[0] // size) * -(-shape[1] // size) > MAX_GROUPS:
            size += 1
        return size
    if not least <= given <= max(shape):
        why = "" if least == 1 else " (every so many rows and columns stand for the rest on a raster of this size)"
        raise SceneError(f"the block must be {least} to {max(shape)} pixels{why}, got {given}: choose another size")
    return given


def number_blocks(may_visit: np.ndarray, size: int) -> np.ndarray:
    """Number the blocks of a raster that have pixels to visit, from 0; -1 where a pixel cannot be visited [y, x]."""
    rows, columns = (np.arange(n) // size for n in may_visit.shape)
    block = rows[:, None] * (columns[-1] + 1) + columns[None, :]
    out = np.full(may_visit.shape, -1)
    out[may_visit] = np.unique(block[may_visit], return_inverse=True)[1]
    return out


@dataclass(frozen=True)
class Positions:
    """Beam positions to visit, in this order.

    Attributes:
        scan: number of the scan that each belongs to [position].
        xy: beam positions (x, y) in its frame [position, 2], um.
        dwell: counting times [position], s.
    """

    scan: np.ndarray
    xy: np.ndarray
    dwell: np.ndarray

    @classmethod
    def of(
        cls,
        dwell: Sequence[np.ndarray],
        axes: Sequence[tuple[np.ndarray, np.ndarray]],
        fast_axis: Literal["x", "y"],
    ) -> "Positions":
        """List the visited pixels of rasters, line by line, each line from its low end to its high end.

        Args:
            dwell: of the pixels of every scan [scan][y, x], s; 0: not visited.
            axes: beam positions x and y of every scan.
            fast_axis: along which lines lie.
        """
        scans, points, times = [], [], []
        for number, (image, (x, y)) in enumerate(zip(dwell, axes, strict=True)):
            if fast_axis == "x":
                row, column = np.nonzero(image)
            else:
                column, row = np.nonzero(image.T)
            scans.append(np.full(row.size, number))
            points.append(np.stack([x[column], y[row]], 1))
            times.append(image[row, column])
        return cls(np.concatenate(scans), np.concatenate(points), np.concatenate(times))

    def seconds(self, move: float, change: float, present: int = 0) -> float:
        """Compute the time of all [s]: counting, moving to each position, changing to other scans than the present."""
        changes = int(np.sum(np.unique(self.scan) != present))
        return float(self.dwell.sum()) + move * self.dwell.size + change * changes


def round_dwell(dwell: np.ndarray, step: float) -> np.ndarray:
    """Round dwell times down to whole steps [s], so that the time in all is not exceeded."""
    return step * np.floor(dwell / step + 1e-9)


def nearest_pixels(places: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Find the pixel of a raster that is nearest to each place.

    Args:
        places: (x, y) [..., 2], um.
        x, y: axes of the raster.

    Returns:
        Its number, row by row; -1 for places more than half a pixel outside [...].
    """
    column, row = (np.rint((places[..., i] - a[0]) / pitch(a)).astype(int) for i, a in enumerate((x, y)))
    is_inside = (column >= 0) & (column < x.size) & (row >= 0) & (row < y.size)
    return np.where(is_inside, row * x.size + column, -1)
