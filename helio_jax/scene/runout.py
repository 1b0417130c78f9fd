"""A surface beyond its image: its border falls to level ground, a terrace goes on, and then all goes on level.

An image often ends on a flank. What lies beyond it is not seen, but scatters into it: taken to go on as high as the
border, it stands above the true ground, nearer to the apertures, and sends more back than it does.
"""

import numpy as np
from scipy.ndimage import median_filter

from helio_jax.arrays import border_mask

BORDER, GROUND = 0.06, 0.05
"""Width of the border, as a share of each side, and the quantile of its heights that is taken for level ground."""
TERRACE = 0.2, 0.5
"""A terrace slopes outwards by less than this and stands in the upper part of the relief above this share; any other
border falls to the ground as steeply as before it, by at least that slope. Ground that went on as high as each pixel of
the border, by mistakes of a fit too, kept a tall crystal's from finding their level (benchmarks/crystal.py)."""
_INWARD = 4
"""Pixels from the border over which its slope is taken."""
_SMOOTH = 9
"""Pixels along the border whose median counts."""


def ground_level(height: np.ndarray) -> float:
    """Return the height of level ground, the lowest part of the border of heights [y, x], um."""
    return float(np.quantile(height[border_mask(height.shape, BORDER)], GROUND))


def run_out(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, level: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of a grid with two rings more [y + 4, x + 4]: where the border ends on the ground, and far out.

    A terrace goes on as high as it is.

    Args:
        x, y, z: positions [y, x], um; x grows with the column and y with the row.
        level: height of the ground, um.
        reach: half the side of the square to which the ground goes on, um.
    """
    terrace = level + TERRACE[1] * (float(np.max(z)) - level)
    x, y, z = _widened(x, y, z, level, terrace, reach)
    y, x, z = (field.T for field in _widened(y.T, x.T, z.T, level, terrace, reach))
    return x, y, z


def _widened(
    across: np.ndarray, along: np.ndarray, z: np.ndarray, level: float, terrace: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points with two columns more on either side; `across` grows with the column, a `terrace` is as high."""
    pitch = float(np.ptp(across) / (across.shape[1] - 1))
    fields, inward = (across, along, z), min(_INWARD, across.shape[1] - 1)
    for side in (-1, 1):
        edge, inner = (0, inward) if side < 0 else (-1, -1 - inward)
        at, height = fields[0][:, edge], fields[2][:, edge]
        slope = (fields[2][:, inner] - height) / np.maximum(side * (at - fields[0][:, inner]), pitch)
        slope = median_filter(slope, _SMOOTH, mode="nearest") * np.sign(height - level)
        far = max(reach, float(np.max(side * at)) + 2.0 * pitch)
        distance = np.clip(np.abs(height - level) / np.maximum(slope, TERRACE[0]), pitch, 0.5 * (far - side * at))
        beyond = np.where((slope < TERRACE[0]) & (height > terrace), height, level)
        rings = (at + side * distance, np.full_like(at, side * far)), (fields[1][:, edge],) * 2, (beyond, beyond)
        fields = tuple(
            np.column_stack([*ring[::-1], field] if side < 0 else [field, *ring])
            for field, ring in zip(fields, rings, strict=True)
        )
    return fields  # type: ignore[return-value]
