"""Walls between pixels: a grid of heights on which depth jumps are walls along the beam, not slopes.

Triangles between the points of two pixels make a ramp of a wall, one pixel wide, with its foot at the lower point. The
wall is somewhere between the points: half-way on the average. Every pixel is given eight more points, just inside its
own square, and only pixels that no wall parts share their heights.

The sides of the squares make stairs of a wall at an angle to the raster: the points move to a smooth outline
(`wall_outlines`).
"""

import numpy as np

from helio_jax.arrays import WALL_PITCHES
from helio_jax.scene.wall_outlines import shift_to_outlines

GAP = 1e-3
"""How far from the half-way line the points on both sides of it are [pixels]."""
LEVEL_COSINE = 0.87
"""Least z of the unit normal at the rim of a wall: it falls by less than 30 degrees."""
LEAST_JUMP = 2.0
"""By how much the slope between neighbours that a wall parts exceeds the next ones."""

Grid = tuple[np.ndarray, np.ndarray, np.ndarray]
"""x, y, z of points [y, x], um."""


def wall_links(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the neighbours that a wall parts: the slope between them is far above the next ones in line.

    A facet two pixels wide is none, however steep, up to a slope of `WALL_PITCHES`.

    Args:
        x, y: positions on the raster [y, x], um; x increases with the column and y with the row.
        z: heights [y, x], um.

    Returns:
        Whether a wall parts neighbours along x [y, x - 1], and along y [y - 1, x].
    """
    found = []
    for place, heights in ((x, z), (y.T, z.T)):
        with np.errstate(divide="ignore", invalid="ignore"):  # points that coincide: no wall
            slope = np.pad(np.abs(np.diff(heights, axis=1)) / np.diff(place, axis=1), ((0, 0), (1, 1)))
        jump = slope[:, 1:-1] - np.maximum(slope[:, :-2], slope[:, 2:])
        found.append((jump > LEAST_JUMP) | (slope[:, 1:-1] > WALL_PITCHES))
    return found[0], found[1].T


def has_level_rims(z: np.ndarray, normals: np.ndarray, is_foot: np.ndarray) -> bool:
    """Decide whether the edges above occluded points are those of walls, not the limbs of round bodies.

    A round body's hidden side begins where the beam grazes it; half a pixel before, its surface is far lower than at
    the last pixel that is seen. True where nothing is occluded.

    Args:
        z: heights [y, x], um.
        normals: unit normals [y, x, 3].
        is_foot: points at the foot of a hidden side [y, x].
    """
    if not is_foot.any():
        return True
    top, upright = z.copy(), normals[..., 2].copy()
    room = np.pad(np.stack([z, normals[..., 2]]), ((0, 0), (1, 1), (1, 1)), mode="edge")
    for dy, dx in np.ndindex(3, 3):
        height, cosine = room[:, dy : dy + len(z), dx : dx + z.shape[1]]
        is_higher = height > top
        top, upright = np.where(is_higher, height, top), np.where(is_higher, cosine, upright)
    return bool(np.mean(upright[is_foot] > LEVEL_COSINE) > 0.5)


def with_upright_walls(grid: Grid, behind: Grid, beam_shift: tuple[float, float]) -> tuple[Grid, Grid, np.ndarray]:
    """Refine a beam-frame grid to one whose walls are half-way between the pixels, if it has any.

    Args:
        grid: x, y, z of the points of the pixels [y, x], um.
        behind: the same with the lower ends of occlusion edges moved (`occluded_vertices`).
        beam_shift: `Instrument.beam_shift` of the grid.

    Returns:
        Both refined (`refined_grid`), without the lines of points that no wall needs; and the number of the pixel to
        which every point belongs. Without walls: the grids as they are.
    """
    x, y, z = grid
    walls = wall_links(x + beam_shift[0] * z, y + beam_shift[1] * z, z)
    if not any(w.any() for w in walls):
        return grid, behind, np.arange(z.size).reshape(z.shape)
    fine, moved, number = refined_grid(grid, behind, beam_shift, *walls)
    lines = np.ix_(_needed(*walls), _needed(walls[1].T, walls[0].T))
    fine, moved = ((x[lines], y[lines], z[lines]) for x, y, z in (fine, moved))
    return fine, moved, number[lines]


def refined_grid(
    grid: Grid, behind: Grid, beam_shift: tuple[float, float], wall_x: np.ndarray, wall_y: np.ndarray
) -> tuple[Grid, Grid, np.ndarray]:
    """Give every pixel of a grid eight more points, of heights that walls do not join [3 y - 2, 3 x - 2].

    Arguments and results as those of `with_upright_walls`, walls as from `wall_links`.
    """
    (x, y, z), (tx, ty) = grid, beam_shift
    shift = shift_to_outlines(wall_x, wall_y)
    height, is_foot = _refined_heights(z, wall_x, wall_y, shift)
    # the points of two pixels on both sides of a half-way line are one of the grid of half pixels
    lines = np.ix_(*((2 * np.arange(3 * n - 2) + 1) // 3 for n in z.shape))
    place_y, place_x = (
        _refined_places(place) + float(np.diff(place, axis=axis).min()) * shift[axis][lines]
        for axis, place in enumerate((y + ty * z, x + tx * z))
    )
    fine = place_x - tx * height, place_y - ty * height, height
    owner = _inner(np.repeat(np.repeat(np.arange(z.size).reshape(z.shape), 3, 0), 3, 1))
    moved_x, moved_y, moved_z = (
        new + np.where(is_foot, (end - start).ravel()[owner], 0.0)
        for new, start, end in zip(fine, grid, behind, strict=True)
    )
    return fine, (moved_x, moved_y, moved_z), owner


def _needed(wall_x: np.ndarray, wall_y: np.ndarray) -> np.ndarray:
    """Mark the rows of points that walls need [3 y - 2].

    Those of the pixels, and those between two rows of pixels that a wall parts somewhere, or whose walls between
    columns differ.
    """
    between = wall_y.any(1) | (wall_x[1:] != wall_x[:-1]).any(1)
    return np.append(np.column_stack([np.ones(between.size, bool), between, between]).ravel(), True)


def _inner(field: np.ndarray) -> np.ndarray:
    """Leave out the points beyond the pixels of the border."""
    return field[1:-1, 1:-1]


def _refined_places(place: np.ndarray) -> np.ndarray:
    """Interpolate raster positions [y, x] at the points of the pixels [3 y - 2, 3 x - 2]."""
    for axis in (0, 1):
        n = place.shape[axis]
        at = np.ravel(np.arange(n)[:, None] + [-0.5 + GAP, 0.0, 0.5 - GAP])[1:-1]
        low = np.minimum(at.astype(int), n - 2)
        share = np.expand_dims(at - low, 1 - axis)
        place = (1.0 - share) * place.take(low, axis) + share * place.take(low + 1, axis)
    return place


def _refined_heights(
    z: np.ndarray, wall_x: np.ndarray, wall_y: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the heights of the points: means over the pixels around that no wall parts from the own one.

    Towards a wall the surface goes on as it comes: a wall below an edge goes on down.

    Args:
        z: heights [y, x], um.
        wall_x, wall_y: from `wall_links`.
        shift: of the points along y and x [2, 2 y - 1, 2 x - 1], pixels.

    Returns:
        Heights, um, and whether a point is at the foot of a wall [3 y - 2, 3 x - 2].
    """
    ny, nx = z.shape
    room = np.pad(z, 1, mode="edge")
    half_x, half_y = (
        {side: np.pad(step, 1, mode="edge") for side, step in steps.items()}
        for steps in (_half_steps(z, wall_x), {k: step.T for k, step in _half_steps(z.T, wall_y.T).items()})
    )
    slope_y, slope_x = (half[1] - half[-1] for half in (half_y, half_x))
    shift = np.pad(shift, ((0, 0), (1, 1), (1, 1)))
    # whether no wall parts columns x - 1 and x [y + 2, x + 1], rows y - 1 and y [y + 1, x + 2]; beyond the border: none
    open_x, open_y = (~np.pad(wall, 1) for wall in (wall_x, wall_y))
    height, is_foot = np.empty((ny, 3, nx, 3)), np.zeros((ny, 3, nx, 3), bool)
    height[:, 1, :, 1] = z

    def average(sy: int, sx: int, joined: dict[tuple[int, int], np.ndarray]) -> None:
        """Set the points towards (sy, sx): the mean of what the own pixel and those joined to it have there."""
        total, moved, count = np.zeros((3, *z.shape))
        along_y, along_x = shift[:, 1 + sy :: 2, 1 + sx :: 2][:, :ny, :nx]
        for (dy, dx), is_joined in {(0, 0): np.ones(z.shape, bool), **joined}.items():
            window = np.s_[1 + dy : 1 + dy + ny, 1 + dx : 1 + dx + nx]
            there = room[window] + sum(
                half[-side if delta else side][window]
                for half, side, delta in ((half_x, sx, dx), (half_y, sy, dy))
                if side
            )
            total += np.where(is_joined, there, 0.0)
            moved += np.where(is_joined, along_y * slope_y[window] + along_x * slope_x[window], 0.0)
            count += is_joined
            is_foot[:, 1 + sy, :, 1 + sx] |= ~is_joined & (room[window] > z)
        height[:, 1 + sy, :, 1 + sx] = z + (1.0 - 2.0 * GAP) * (total / count - z) + moved / count

    for side in (-1, 1):
        ahead = (1 + side) // 2
        average(0, side, {(0, side): open_x[1:-1, ahead : ahead + nx]})
        average(side, 0, {(side, 0): open_y[ahead : ahead + ny, 1:-1]})
    for sy, sx in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        column, row = (1 + sx) // 2, (1 + sy) // 2
        here_x, there_x = (open_x[1 + dy : 1 + dy + ny, column : column + nx] for dy in (0, sy))
        here_y, there_y = (open_y[row : row + ny, 1 + dx : 1 + dx + nx] for dx in (0, sx))
        # also the other way round the four pixels
        to_x = here_x | (here_y & there_x & there_y)
        to_y = here_y | (here_x & there_y & there_x)
        to_both = (here_x & there_y) | (here_y & there_x)
        average(sy, sx, {(0, sx): to_x, (sy, 0): to_y, (sy, sx): to_both})
    return _inner(height.reshape(3 * ny, 3 * nx)), _inner(is_foot.reshape(3 * ny, 3 * nx))


def _half_steps(z: np.ndarray, walls: np.ndarray) -> dict[int, np.ndarray]:
    """Compute the change of heights over half a pixel towards the columns -1 and +1 beside [y, x], um.

    Towards a wall: as on the other side of the pixel, but not past what is beyond the wall.
    """
    step = np.pad(np.diff(z, axis=1), ((0, 0), (1, 1)))
    is_open = np.pad(~walls, ((0, 0), (1, 1)), constant_values=True)
    out = {}
    for side, ahead, back in ((1, np.s_[:, 1:], np.s_[:, :-1]), (-1, np.s_[:, :-1], np.s_[:, 1:])):
        to_other = side * step[ahead]
        goes_on = 0.5 * side * np.where(is_open[back], step[back], 0.0)
        goes_on = np.where(to_other > 0.0, np.minimum(goes_on, to_other), np.maximum(goes_on, to_other))
        out[side] = np.where(is_open[ahead], 0.5 * to_other, goes_on)
    return out
