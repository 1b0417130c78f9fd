"""Smooth outlines of walls between pixels.

The sides of the pixels make stairs of a wall at an angle to the raster. They have up to 1.4 times its area, which sends
too much to a detector on its side, and hide too much from pixels beside it. An outline is smoothed as a signal along
it, by the low-pass filter of Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995 (eqs 9 to
11), which neither shrinks nor grows what it encloses.
"""

import numpy as np
from scipy.sparse import coo_array, csr_array

SMOOTHING = 0.5, -0.505
"""Factors of the low-pass filter, applied in turn: its pass band ends at ripples of 16 pixels ..."""
PASSES = 200
"""... and after so many turns those of 6 pixels have half their height."""
MAX_SHIFT, MAX_CORNER_SHIFT = 0.4, 0.35
"""Points of an outline move no farther along each axis [pixels]; the second holds where the sides of pixels turn."""
LEAST_AREA = 0.005
"""The quadrangle of a pixel, the middles of two sides and the corner between them is larger than the triangle without
the corner by so much [pixels]. Other corners go to the line between their neighbours along the outline ..."""
LEAST_TURN = 0.05
"""... and by this share of the way from there to where the sides meet."""


def shift_to_outlines(wall_x: np.ndarray, wall_y: np.ndarray) -> np.ndarray:
    """Compute by how much points of a grid move along y and x to smooth outlines of walls.

    The grid is one of half pixels: pixels at even rows and columns, middles of their sides at odd columns or rows. An
    outline runs through the middles and the corners of the sides that are walls. Where it ends or branches it stays.

    Args:
        wall_x, wall_y: whether a wall parts neighbours along x [y, x - 1], and along y [y - 1, x].

    Returns:
        Along y and x [2, 2 y - 1, 2 x - 1], pixels.
    """
    ny, nx = wall_x.shape[0], wall_y.shape[1]
    is_wall = np.zeros((2 * ny - 1, 2 * nx - 1), bool)
    is_wall[::2, 1::2], is_wall[1::2, ::2] = wall_x, wall_y
    is_wall[1::2, 1::2] = wall_x[1:] | wall_x[:-1] | wall_y[:, 1:] | wall_y[:, :-1]
    start = 0.5 * np.argwhere(is_wall)
    beside = _neighbours(is_wall)
    is_free = (beside.sum(1) == 2.0)[:, None]
    place = start
    for factor in PASSES * SMOOTHING:
        place = place + factor * np.where(is_free, 0.5 * (beside @ place) - place, 0.0)
    is_turn = is_free & np.any(beside @ start != 2.0 * start, axis=1, keepdims=True)
    limit = np.where(is_turn, MAX_CORNER_SHIFT, MAX_SHIFT)
    shift = np.zeros((2, *is_wall.shape))
    place = start + np.clip(place - start, -limit, limit)
    shift[:, is_wall] = (place - start).T
    is_folded = np.zeros(is_wall.shape, bool)
    is_folded[1::2, 1::2] = _is_folded(shift)
    is_folded = is_folded[is_wall][:, None] & is_free
    place = np.where(is_folded, (1.0 - LEAST_TURN) * 0.5 * (beside @ place) + LEAST_TURN * start, place)
    shift[:, is_wall] = (place - start).T
    return shift


def _neighbours(is_wall: np.ndarray) -> csr_array:
    """Mark which points of a grid of half pixels are next to each other along an outline [point, point]."""
    number = np.cumsum(is_wall).reshape(is_wall.shape) - 1
    ends = []
    for numbers, walls in (number, is_wall), (number.T, is_wall.T):
        is_pair = walls[1:] & walls[:-1]
        ends.append(np.stack([numbers[1:][is_pair], numbers[:-1][is_pair]]))
    one, other = np.concatenate(ends, axis=1)
    at = np.append(one, other), np.append(other, one)
    n = int(is_wall.sum())
    return coo_array((np.ones(at[0].size), at), (n, n)).tocsr()


def _is_folded(shift: np.ndarray) -> np.ndarray:
    """Find corners that add less than `LEAST_AREA` to the triangle of a pixel and the middles of two sides.

    Args:
        shift: as from `shift_to_outlines`.

    Returns:
        [y - 1, x - 1].
    """
    place = shift + 0.5 * np.indices(shift.shape[1:])
    corner = place[:, 1::2, 1::2]
    out = np.zeros(corner.shape[1:], bool)
    rows, columns = ({0: np.s_[1::2], -1: np.s_[:-1:2], 1: np.s_[2::2]} for _ in range(2))
    for sy, sx in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        center, one, other = (place[:, rows[y], columns[x]] for y, x in ((sy, sx), (sy, 0), (0, sx)))
        (ay, ax), (by, bx), (cy, cx) = (to - one for to in (other, corner, center))
        beyond = -0.5 * np.sign(ay * cx - ax * cy) * (ay * bx - ax * by)
        out |= beyond < LEAST_AREA
    return out
