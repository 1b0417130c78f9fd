"""Points half-way between those of a grid, by heights and slopes.

Triangles between the points of a raster cut creases: the foot of a slope by up to half a pitch, where they hide the
lowest part of the slope from the pixel beside it, and ridges and tips, of which what stands around sees too little.
"""

import numpy as np

from helio_jax.scene.wall_grid import Grid

MOST = 1.0
"""Largest distance of a point half-way from the straight line [pitches]: that of a tip between flanks of 63 deg. Noise
of steep slopes would raise it more."""


def with_midpoints(
    grid: Grid,
    slope_x: np.ndarray,
    slope_y: np.ndarray,
    pitches: tuple[float, float],
    beam_shift: tuple[float, float],
) -> Grid:
    """Add the points half-way between those of a grid, and the middles of its cells.

    Between two points the surface is extrapolated from both, each with its slope and the change of slope behind it
    (beyond the border none). Of the two values half-way, taken from the straight line, the smaller one counts, and
    neither if their signs differ. That is exact on a parabola and on a crease anywhere between two planes; across a
    depth jump it is the straight line. No point is farther than `MOST` off it. The middle of a cell is the mean of
    those of its diagonals.

    Args:
        grid: points x, y, z of a surface [y, x], um: the raster, moved against the beam by z times its shift.
        slope_x, slope_y: slopes along the raster, at fixed beam positions [y, x]; NaN: not known, straight lines.
        pitches: of the raster along x and y, um.
        beam_shift: `Instrument.beam_shift`.

    Returns:
        The same with 2 n - 1 rows and columns.

    Source: the smaller one of one-sided extrapolations: Harten, Engquist, Osher and Chakravarthy, J. Comput. Phys. 71
        (1987) 231.
    """
    rise_x, rise_y = slope_x * pitches[0], slope_y * pitches[1]
    height = grid[2]
    x, y, z = (_halved(field) for field in grid)
    found = z.copy()
    found[::2, 1::2] = _half_way(height, rise_x, (0, 1))
    found[1::2, ::2] = _half_way(height, rise_y, (1, 0))
    down = _half_way(height, rise_x + rise_y, (1, 1))
    up = _half_way(height[::-1], (rise_x - rise_y)[::-1], (1, 1))[::-1]
    found[1::2, 1::2] = 0.5 * (down + up)
    most = MOST * min(pitches)
    above = np.clip(found - z, -most, most)
    return x - above * beam_shift[0], y - above * beam_shift[1], z + above


def first_of_halves(n: int) -> np.ndarray:
    """Number, for each of 2 n - 1 points, the one of n that it is or follows."""
    return np.arange(2 * n - 1) // 2


def _half_way(height: np.ndarray, rise: np.ndarray, step: tuple[int, int]) -> np.ndarray:
    """Compute heights half-way between each point [y, x] and the one a step (rows, columns) on; `rise`: per step."""
    rows, columns = (n - k for n, k in zip(height.shape, step, strict=True))
    around = np.pad(rise, 1, constant_values=np.nan)

    def rise_at(number: int) -> np.ndarray:
        """Return the rises so many steps on."""
        y, x = (1 + number * k for k in step)
        return around[y : y + rows, x : x + columns]

    before, first, second, after = map(rise_at, (-1, 0, 1, 2))
    a, b = height[:rows, :columns], height[step[0] :, step[1] :]
    from_first = 0.5 * (a - b + first) + 0.125 * np.nan_to_num(first - before)
    from_second = 0.5 * (b - a - second) + 0.125 * np.nan_to_num(after - second)
    smaller = np.where(np.abs(from_first) <= np.abs(from_second), from_first, from_second)
    return 0.5 * (a + b) + np.where(from_first * from_second > 0.0, smaller, 0.0)


def _halved(field: np.ndarray) -> np.ndarray:
    """Interpolate linearly half-way between the points [y, x]."""
    for axis in (0, 1):
        field = np.moveaxis(field, axis, 0)
        out = np.empty((2 * len(field) - 1, *field.shape[1:]))
        out[::2], out[1::2] = field, 0.5 * (field[:-1] + field[1:])
        field = np.moveaxis(out, 0, axis)
    return field
