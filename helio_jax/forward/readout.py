"""What the detectors read besides the sample's signal: an offset that drifts along the scan, and the scan lines' noise.

A reading also holds helium that came from elsewhere. It changes slowly in time and, since the moving sample changes
how the gas around it escapes, smoothly with the position: low polynomials of both. From line to line it jumps a little.
Time runs along the slow axis of the scan.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander


class ScanOrder(NamedTuple):
    """When the pixels were recorded.

    Attributes:
        slow_axis: of the raster, along which the scan moves slowly, 0 (y) or 1 (x).
        time: where the images are aligned scans of their own, when each recorded a pixel, -1 to 1 [detector, y, x].
    """

    slow_axis: int = 0
    time: np.ndarray | None = None

    def thinned(self, thin: tuple[slice, ...]) -> "ScanOrder":
        """Return it on some rows and columns."""
        return self if self.time is None else self._replace(time=self.time[:, *thin])


def drift_modes(shape: tuple[int, int], order: ScanOrder, degrees: tuple[int, int]) -> np.ndarray:
    """Return the shapes of the slow drift [detector or 1, mode, y, x], the constant left out.

    Products of Legendre polynomials along the slow and the fast axis, of degree (i, j) with i / slow degree + j / fast
    degree <= 1, each divided by its degree i + j, so that one prior deviation serves all of a smooth drift, and of a
    root mean square value of 1 / (i + j). Of aligned scans: those of each one's own time, up to the slow degree.

    Args:
        shape: of the raster (y, x).
        order: in which the pixels were recorded.
        degrees: largest degree along the slow and the fast axis.
    """
    if order.time is not None:
        degree = np.arange(1, degrees[0] + 1)
        modes = legvander(order.time, degrees[0])[..., 1:] * np.sqrt(2.0 * degree + 1.0) / degree
        return np.moveaxis(modes, -1, 1)
    slow_axis = order.slow_axis
    sides = [np.linspace(-1.0, 1.0, n) for n in (shape if slow_axis == 0 else shape[::-1])]
    slow, fast = (
        legvander(side, d) * np.sqrt(2.0 * np.arange(d + 1) + 1.0) for side, d in zip(sides, degrees, strict=True)
    )
    modes = [
        np.outer(slow[:, i], fast[:, j]) / (i + j)
        for i in range(degrees[0] + 1)
        for j in range(degrees[1] + 1)
        if i + j > 0 and i * degrees[1] + j * degrees[0] <= degrees[0] * degrees[1]
    ]
    grid = np.array(modes).reshape(-1, len(sides[0]), len(sides[1]))
    return (grid if slow_axis == 0 else grid.swapaxes(1, 2))[None]
