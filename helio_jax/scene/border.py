"""Extrapolation of a surface beyond its image: the border falls to the substrate, a terrace continues level.

An image often ends on a flank. The surface beyond it is not imaged but scatters atoms into the image. Continued at the
height of the border, it would lie above the true substrate, nearer to the apertures, and scatter too much.
"""

import numpy as np
from scipy.ndimage import median_filter

MAX_TERRACE_SLOPE = 0.2
"""A terrace slopes outwards by less than this. Any other border falls with its own slope, by at least this slope.
A continuation at the height of each border pixel, errors of a fit included, kept the fit of a tall crystal from finding
its level (benchmarks/crystal.py)."""
MIN_TERRACE_HEIGHT = 0.5
"""A terrace is higher than this fraction of the relief."""
_SLOPE_PIXELS = 4
"""Pixels from the border over which its slope is measured."""
_MEDIAN_PIXELS = 9
"""Pixels along the border whose slopes are reduced to their median."""


def extend_border(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, level: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add two rings of points to a grid [y + 4, x + 4]: the foot of the border on the substrate, and the far end.

    A terrace continues at its own height.

    Args:
        x, y, z: positions [y, x], um; x increases with the column and y with the row.
        level: height of the substrate, um.
        reach: half the side of the square that the substrate fills, um.
    """
    terrace = level + MIN_TERRACE_HEIGHT * (float(np.max(z)) - level)
    x, y, z = _extend_columns(x, y, z, level, terrace, reach)
    y, x, z = (field.T for field in _extend_columns(y.T, x.T, z.T, level, terrace, reach))
    return x, y, z


def _extend_columns(
    across: np.ndarray, along: np.ndarray, z: np.ndarray, level: float, terrace: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add two columns on either side; `across` increases with the column, terraces are higher than `terrace`."""
    pitch = float(np.ptp(across) / (across.shape[1] - 1))
    fields, inward = (across, along, z), min(_SLOPE_PIXELS, across.shape[1] - 1)
    for side in (-1, 1):
        edge, inner = (0, inward) if side < 0 else (-1, -1 - inward)
        at, height = fields[0][:, edge], fields[2][:, edge]
        slope = (fields[2][:, inner] - height) / np.maximum(side * (at - fields[0][:, inner]), pitch)
        slope = median_filter(slope, _MEDIAN_PIXELS, mode="nearest") * np.sign(height - level)
        far = max(reach, float(np.max(side * at)) + 2.0 * pitch)
        run = np.abs(height - level) / np.maximum(slope, MAX_TERRACE_SLOPE)
        distance = np.clip(run, pitch, 0.5 * (far - side * at))
        beyond = np.where((slope < MAX_TERRACE_SLOPE) & (height > terrace), height, level)
        rings = (at + side * distance, np.full_like(at, side * far)), (fields[1][:, edge],) * 2, (beyond, beyond)
        fields = tuple(
            np.column_stack([*ring[::-1], field] if side < 0 else [field, *ring])
            for field, ring in zip(fields, rings, strict=True)
        )
    return fields  # type: ignore[return-value]
