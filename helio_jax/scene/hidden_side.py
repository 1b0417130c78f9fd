"""The side of a sample that the beam does not see: where it may stand, and the faces of it.

A beam-frame grid joins the rim of a wall and the point where its shadow ends by a sheet along the beam. Such a sheet
faces the plate and would scatter atoms there that a real cavity keeps.
"""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from helio_jax.arrays import WALL_PITCHES, distance_to_end, nearest_known
from helio_jax.scene.body import Body
from helio_jax.scene.surfaces import with_area

_ALONG = 1e-6
"""Cosine below which a neighbour counts as beside a point, neither before nor behind it along the beam."""
_LEAST_RISE = 1.0
"""A neighbour that is higher by so many pitches belongs to what casts the shadow."""
_MIN_NORMAL_Z = 0.5
"""Lower limit of the normal's z when the height at the foot of a wall is extrapolated: a wall counts as 60 degrees."""
_TURN_PIXELS = 2.0
"""Standard deviation of the Gaussian average from which a wall's direction is taken [pixels]."""


def occluded_vertices(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, normals: np.ndarray, beam_shift: tuple[float, float], share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate the shadowed surface behind occlusion edges of a beam-frame grid, for `with_cavities`.

    The shadowed surface lies between the sheet along the beam, its outer limit, and the vertical below the edge. The
    point at the sheet's foot, below a neighbour that is not behind it along the beam, is moved back by a fraction of
    the way to the vertical, in its tangent plane (a wall counts as 60 degrees). A point beside a wall along the beam
    moves, too: there the shadow ends, and the faces to the wall's top would be a fin that stands in the shadow. It
    moves no farther than to the front end of that wall. Measured on spheres A and B, in a trench and on mesas:
    tests/physics/test_hidden_side.py.

    Args:
        x, y, z: sample-frame positions [y, x], um, as for `surface_body`.
        normals: unit normals there [y, x, 3].
        beam_shift: `Instrument.beam_shift` of the grid.
        share: fraction of the way, 0 (the sheet along the beam) to 1 (a vertical wall below the edge).

    Returns:
        x, y, z with the moved points [y, x], um.
    """
    along = float(np.hypot(*beam_shift))
    if not along:
        return x, y, z
    pitch = _raster_pitch(x, y, z, beam_shift)
    fall = _fall_from_before(z, beam_shift, pitch)
    drop = np.where(_is_high(fall, pitch), fall, 0.0)
    if not drop.any():
        return x, y, z
    back = np.minimum(share * drop * along, _free_way(z, fall > _LEAST_RISE * max(pitch), beam_shift, pitch))
    back_x, back_y = (back * shift / along for shift in beam_shift)
    rise = (normals[..., 0] * back_x + normals[..., 1] * back_y) / np.maximum(normals[..., 2], _MIN_NORMAL_Z)
    return x - back_x, y - back_y, z + rise


def undercut_vertices(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, lean: float, beam_shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate the side of walls that lean over their feet, for `with_cavities`.

    The beam does not see whether such a wall is vertical or leans, as that of a mushroom or the lower half of a ball
    does. The foot is moved below the wall's top, square to the wall, by a share of the wall's height, and at most
    half-way through what stands there.

    Args:
        x, y, z: sample-frame positions [y, x], um, as for `surface_body`.
        lean: run of the wall under its top over its height; 0: vertical.
        beam_shift: `Instrument.beam_shift` of the grid.

    Returns:
        x, y, z with the moved points [y, x], um.
    """
    pitch = _raster_pitch(x, y, z, beam_shift)
    fall = _fall_from_before(z, beam_shift, pitch)
    foot = np.nonzero(_is_high(fall, pitch))
    if not foot[0].size:
        return x, y, z
    fall = fall[foot]
    smooth = gaussian_filter(z, _TURN_PIXELS)
    uphill = np.stack([np.gradient(smooth, step, axis=axis)[foot] for axis, step in enumerate(pitch)])
    uphill /= np.maximum(np.hypot(*uphill), np.finfo(float).tiny)
    back = lean * fall
    along = np.array(beam_shift[::-1]) @ uphill
    free = _way_below_top(z, foot, uphill, fall, along, pitch, float(back.max(initial=0.0)))
    back = np.minimum(back, 0.5 * free)
    moved_x, moved_y = x.copy(), y.copy()
    moved_x[foot] += back * uphill[1]
    moved_y[foot] += back * uphill[0]
    return moved_x, moved_y, z


def is_foot(z: np.ndarray, beam_shift: tuple[float, float], pitch: tuple[float, ...]) -> np.ndarray:
    """Find the points at the foot of a side that the beam does not see [y, x]; `pitch` along y and x, um."""
    return _is_high(_fall_from_before(z, beam_shift, pitch), pitch)


def _is_high(fall: np.ndarray, pitch: tuple[float, ...]) -> np.ndarray:
    """Tell whether falls [um] are those of sides that the beam does not see, not of slopes."""
    return fall > WALL_PITCHES * max(pitch)


def _raster_pitch(x: np.ndarray, y: np.ndarray, z: np.ndarray, beam_shift: tuple[float, float]) -> tuple[float, ...]:
    """Compute the pitch along y and x of the raster on which an oblique beam sees the points [y, x], um."""
    return tuple(
        float(np.abs(np.diff(at + z * shift, axis=axis)).mean())
        for axis, at, shift in zip((0, 1), (y, x), beam_shift[::-1], strict=True)
    )


def _way_below_top(
    z: np.ndarray,
    foot: tuple[np.ndarray, ...],
    uphill: np.ndarray,
    fall: np.ndarray,
    along: np.ndarray,
    pitch: tuple[float, ...],
    reach: float,
) -> np.ndarray:
    """Compute how far from below a rim the surface stays above half of the wall [foot], um, up to twice the reach.

    `along`: beam shift towards the rim [foot]; a side that an oblique beam sees is wide on the raster, not below it.
    """
    step, way = 0.5 * min(pitch), np.zeros(fall.size)
    is_below = np.ones(fall.size, bool)
    for n in range(1, int(2.0 * reach / step) + 2):
        at = [index + n * step * u / p for index, u, p in zip(foot, uphill, pitch, strict=True)]
        height = map_coordinates(z, at, order=1, mode="nearest")
        # within a pixel of its foot the wall itself is crossed
        is_below &= (height > z[foot] + 0.5 * fall) | (n * step < 1.5 * max(pitch))
        here = n * step - along * (height - z[foot] - fall)
        way[is_below] = here[is_below]
    return np.maximum(way, 0.0)


def _fall_from_before(z: np.ndarray, beam_shift: tuple[float, float], pitch: tuple[float, ...]) -> np.ndarray:
    """Compute the fall to every point from the highest neighbour before or beside it along the beam [y, x], um.

    Along the normal all neighbours are beside it.
    """
    dy, dx = np.mgrid[:3, :3]
    way = (1 - dx) * pitch[1] * beam_shift[0] + (1 - dy) * pitch[0] * beam_shift[1]
    beside = way >= -_ALONG * max(pitch) * np.hypot(*beam_shift)
    return np.maximum(maximum_filter(z, footprint=beside, mode="nearest") - z, 0.0)


def _free_way(
    z: np.ndarray, is_near: np.ndarray, beam_shift: tuple[float, float], pitch: tuple[float, ...]
) -> np.ndarray:
    """Compute how far back along the beam a point beside a wall stays at that wall or below its top [y, x], um."""
    is_top = z > z[nearest_known(is_near)] + _LEAST_RISE * max(pitch)
    x, y = (-shift / np.hypot(*beam_shift) for shift in beam_shift)
    way = distance_to_end(is_near | is_top, (x, y), (pitch[0], pitch[1]))
    return np.maximum(way - 0.5 * min(pitch), 0.0)


def with_cavities(body: Body, grid: tuple[np.ndarray, ...], behind: tuple[np.ndarray, ...]) -> Body:
    """Move the lower ends of a `surface_body`'s faces across occlusion edges; a strip of faces closes the gap.

    Args:
        body: its first vertices are the grid's.
        grid: x, y, z of the grid's points [y, x], um.
        behind: new lower ends, from `occluded_vertices`.
    """
    points, ends = (np.stack([field.ravel() for field in fields], -1) for fields in (grid, behind))
    foot, n = np.flatnonzero(np.any(points != ends, axis=1)), len(body.vertices)
    if not foot.size:
        return body
    hidden, rim = np.arange(n), np.full(n, np.inf)
    hidden[foot] = n + np.arange(foot.size)
    rim[foot] = 0.5 * (maximum_filter(grid[2], size=3).ravel() + points[:, 2])[foot]
    top = body.vertices[body.faces, 2].max(1)
    is_across = np.any(top[:, None] > rim[body.faces], axis=1)
    seen, across = body.faces[~is_across], body.faces[is_across]
    # edges shared by a face across an occlusion edge and another face, in the other's direction
    edge, other = (f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2) for f in (across[:, ::-1], seen))
    shared = other[np.isin(other @ [n, 1], edge @ [n, 1])]
    u, v = shared.T
    strip = with_area(np.concatenate([np.stack([v, u, hidden[u]], 1), np.stack([v, hidden[u], hidden[v]], 1)]))
    vertices, faces = np.concatenate([body.vertices, ends[foot]]), np.concatenate([seen, hidden[across], strip])
    return Body(vertices, faces)
