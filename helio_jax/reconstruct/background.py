"""What the detectors read besides the sample's signal: an offset that drifts along the scan, and the scan lines' noise.

A reading also holds helium that came from elsewhere. It changes slowly in time and, since the moving sample changes
how the gas around it escapes, smoothly with the position: low polynomials of both. From line to line it jumps a little.
Time runs along the slow axis of the scan.
"""

import numpy as np
from numpy.polynomial.legendre import legvander


def drift_modes(shape: tuple[int, int], slow_axis: int, degrees: tuple[int, int]) -> np.ndarray:
    """Return products of Legendre polynomials along the slow and the fast axis [mode, y, x], the constant left out.

    Those of degree (i, j) with i / slow degree + j / fast degree <= 1, each divided by its degree i + j, so that one
    prior deviation serves all of a smooth drift, and of a root mean square value of 1 / (i + j).

    Args:
        shape: of the raster (y, x).
        slow_axis: 0 (y) or 1 (x).
        degrees: largest degree along the slow and the fast axis.
    """
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
    return grid if slow_axis == 0 else grid.swapaxes(1, 2)
