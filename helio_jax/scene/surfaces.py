"""Build the surfaces of samples as triangles and exact spheres; closed-form first hits of the beam. Pure NumPy.

Sample frame: z up, z = 0 on the substrate, um. Faces are counter-clockwise seen from the vacuum, so normals point out
of the solid. A sample is an open sheet: neighbouring faces share their vertices, so no ray leaks between them, and only
the outer border of the substrate is open.
"""

from dataclasses import replace

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.scene.body import Body

WALL_SEGMENTS = 1440
"""Segments of a moat's outer wall: the polygon lies at most 2.4e-6 of its radius inside the circle."""


def flat_body(size: float, height: float = 0.0) -> Body:
    """Build a horizontal square of side `size` [um] about the z axis."""
    s = 0.5 * size
    return Body(np.array([[-s, -s, height], [s, -s, height], [s, s, height], [-s, s, height]]), _quads([[0, 1, 2, 3]]))


def step_body(size: float, height: float, position: float, facing: float, slope: float) -> Body:
    """Build an upper terrace at z = `height` above a lower one at z = 0, joined by a straight facet.

    Valid for |position| and position + height / tan(slope) inside the substrate.

    Args:
        size: side of the square substrate, which rotates with `facing` [um].
        height: of the upper terrace [um].
        position: of the upper edge along the facing direction, from the z axis [um].
        facing: azimuth of the lower side, counter-clockwise from +x [rad].
        slope: angle of the facet to the horizontal; pi/2 is vertical [rad].
    """
    s = 0.5 * size
    foot = position + (0.0 if slope >= np.pi / 2 else height / np.tan(slope))
    profile = [(-s, height), (position, height), (foot, 0.0), (s, 0.0)]
    vertices = np.array([[u, v, z] for u, z in profile for v in (-s, s)])
    faces = _quads([[2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1] for k in range(3)])
    return Body(_rotate(vertices, facing), faces)


def trench_body(
    size: float, width: float, length: float, depth: float, azimuth: float, center: tuple[float, float]
) -> Body:
    """Cut a trench with vertical walls and closed ends into a substrate: 18 triangles that share all their edges.

    Args:
        size: side of the square substrate, which rotates with `azimuth` [um].
        width, length, depth: of the trench [um].
        azimuth: direction of the trench's length, counter-clockwise from +x [rad].
        center: of the trench, sample frame [um].
    """
    top = _rectangle(length, width, 0.0) + _local(center, azimuth)
    vertices = np.concatenate([_rectangle(size, size, 0.0), top, top - [0.0, 0.0, depth]])
    ring = [[k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    walls = [[8 + k, 4 + k, 4 + (k + 1) % 4, 8 + (k + 1) % 4] for k in range(4)]
    return Body(_rotate(vertices, azimuth), _quads([*ring, *walls, [8, 9, 10, 11]]))


def pyramid_body(
    size: float, base: float, height: float, top: float, azimuth: float, center: tuple[float, float]
) -> Body:
    """Build a square (truncated) pyramid on a substrate; no face lies under it.

    Args:
        size: side of the square substrate, which rotates with `azimuth` [um].
        base, top: sides of the base and of the top square; 0 <= top < base [um].
        height: of the top above the substrate [um].
        azimuth: of one of the four faces, counter-clockwise from +x [rad].
        center: of the base, sample frame [um].
    """
    shift = _local(center, azimuth)
    parts = [_rectangle(size, size, 0.0), _rectangle(base, base, 0.0) + shift]
    ring = _quads([[k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)])
    if top > 0:
        parts.append(_rectangle(top, top, height) + shift)
        sides = _quads([[4 + k, 4 + (k + 1) % 4, 8 + (k + 1) % 4, 8 + k] for k in range(4)] + [[8, 9, 10, 11]])
    else:
        parts.append(np.array([[0.0, 0.0, height]]) + shift)
        sides = np.array([[4 + k, 4 + (k + 1) % 4, 8] for k in range(4)])
    return Body(_rotate(np.concatenate(parts), azimuth), np.concatenate([ring, sides]))


def moated_body(size: float, moats: np.ndarray, spheres: np.ndarray) -> Body:
    """Build spheres on a substrate with round pits; the gap between a sphere and its pit wall is the moat.

    A pit has a vertical wall of `WALL_SEGMENTS` segments and a level floor; the sphere stands in it.

    Args:
        size: side of the square substrate [um].
        moats: x, y, outer radius and depth of each pit [m, 4]; pits are disjoint and inside the substrate, um.
        spheres: x, y, z and radius [s, 4], um.
    """
    flat = flat_body(size)
    if not len(moats):
        return Body(flat.vertices, flat.faces, spheres)
    from scipy.spatial import Delaunay

    n, s = WALL_SEGMENTS, 2 * np.pi * np.arange(WALL_SEGMENTS) / WALL_SEGMENTS
    circles = moats[:, None, :2] + moats[:, None, 2:3] * np.stack([np.cos(s), np.sin(s)], -1)
    # With each pit's centre as a vertex the rim's edges are strictly Delaunay: the triangulation contains all of them,
    # and the pit is the fan of triangles about its centre.
    plane = np.concatenate([flat.vertices[:, :2], circles.reshape(-1, 2), moats[:, :2]])
    faces = Delaunay(plane).simplices.astype(np.int64)
    first_center = 4 + n * len(moats)
    faces = faces[faces.max(1) < first_center]
    a, b, c = (plane[faces[:, k]] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[area < 0] = faces[area < 0][:, ::-1]
    _check_cut(size, moats, 0.5 * np.abs(area).sum())
    vertices, all_faces, k = [_lift(plane[:first_center], 0.0)], [faces], np.arange(n)
    for m, (x, y, _, depth) in enumerate(moats):
        start = sum(map(len, vertices))
        rim, below, center = 4 + m * n + k, start + k, np.full(n, start + n)
        vertices += [_lift(circles[m], -depth), np.array([[x, y, -depth]])]
        after, below_after = np.roll(rim, -1), np.roll(below, -1)
        all_faces += [
            np.stack([below, rim, after], 1),
            np.stack([below, after, below_after], 1),
            np.stack([center, below, below_after], 1),
        ]
    return Body(np.concatenate(vertices), np.concatenate(all_faces), spheres)


def surface_body(
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    reach: float | None = None,
    *,
    level: float | None = None,
    beam_shift: tuple[float, float] = (0.0, 0.0),
    tilt: tuple[float, float] = (0.0, 0.0),
) -> Body:
    """Triangulate points on a grid, with a substrate around them, for height maps and reconstructions.

    Each cell is split along the diagonal with the smaller height difference. Points of a beam-frame grid may run
    backwards in x or y (sheets along the beam at depth jumps): orientation follows the grid, so normals stay on the
    vacuum's side. A sheet along the beam, shadowed by the surface, joins the border to the substrate, whose inner edge
    is then the raster. Without `beam_shift` this sheet is vertical.

    Args:
        x, y, z: sample-frame positions [y, x], um; finite; x increases with the column and y with the row.
        reach: half the side of the square substrate about the z axis; None: no substrate [um].
        level: height of the substrate on the z axis; default: the median height of the border above it [um].
        beam_shift: `Instrument.beam_shift` of a beam-frame grid.
        tilt: slopes of the substrate along x and y.

    Returns:
        A sheet whose only open edges are the outer border of the substrate, or of the grid.

    Raises:
        SceneError: fewer than 2 x 2 points, or the substrate ends inside the grid.
    """
    if any(tilt):
        body = surface_body(x, y, z - tilt[0] * x - tilt[1] * y, reach, level=level, beam_shift=beam_shift)
        at = body.vertices
        return replace(body, vertices=np.column_stack([at[:, :2], at[:, 2] + at[:, :2] @ np.asarray(tilt)]))
    if z.ndim != 2 or min(z.shape) < 2:
        raise SceneError(f"a surface needs at least 2 x 2 points, got {z.shape}: enlarge the raster")
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float64)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    heights = points[:, 2]
    along_ac = (np.abs(heights[a] - heights[c]) <= np.abs(heights[b] - heights[d]))[:, None]
    first = np.where(along_ac, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(along_ac, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    faces = np.concatenate([first, second])
    if reach is None:
        return Body(points, faces)
    extra, extra_faces = _surround(points, index, reach, level, beam_shift)
    return Body(np.concatenate([points, extra]), np.concatenate([faces, extra_faces]))


def first_hit_spheres(
    x: np.ndarray, y: np.ndarray, spheres: np.ndarray, beam_shift: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the first hit of the beam axis on spheres on an infinite substrate z = 0, in closed form.

    The point of height h at beam position (X, Y) is (X - h tx, Y - h ty, h). The sphere's equation is then quadratic in
    h, and a beam from above hits the larger root first.

    Args:
        x, y: beam positions of any common (broadcast) shape [um].
        spheres: x, y, z of the centres and radii [s, 4], um.
        beam_shift: (tx, ty) = tan t (cos phi, sin phi), `Instrument.beam_shift`.

    Returns:
        Height above the substrate [...], um, and unit normals [..., 3].

    Source: own derivation, tests/unit/test_sample.py.
    """
    tx, ty = beam_shift
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    height = np.zeros(x.shape)
    normals = np.zeros((*x.shape, 3))
    normals[..., 2] = 1.0
    square = 1.0 + tx**2 + ty**2
    for cx, cy, cz, radius in np.asarray(spheres, np.float64):
        half = tx * (x - cx) + ty * (y - cy) + cz
        rest = (x - cx) ** 2 + (y - cy) ** 2 + cz**2 - radius**2
        inside = half**2 - square * rest
        root = np.where(inside >= 0, (half + np.sqrt(np.maximum(inside, 0.0))) / square, -np.inf)
        is_first = root > height
        height = np.where(is_first, root, height)
        h = np.where(is_first, root, 0.0)
        n = np.stack([x - h * tx - cx, y - h * ty - cy, h - cz], -1) / radius
        normals = np.where(is_first[..., None], n, normals)
    return height, normals


def _surround(
    points: np.ndarray, index: np.ndarray, reach: float, level: float | None, beam_shift: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Build further vertices and faces: the sheet below the grid's border and the substrate around it."""
    sides = [index[0, :], index[:, -1], index[-1, ::-1], index[::-1, 0]]
    loop = np.concatenate([side[:-1] for side in sides])
    z_level = float(np.median(points[loop, 2])) if level is None else level
    rise = points[loop, 2] - z_level
    inner = _lift(points[loop, :2] + rise[:, None] * np.asarray(beam_shift), z_level)
    if np.abs(inner[:, :2]).max() >= reach:
        raise SceneError(
            f"the substrate around the surface must reach beyond it: half its side is {reach:g} um, the surface "
            f"extends to {np.abs(inner[:, :2]).max():g} um: enlarge size_um"
        )
    at_level = np.abs(rise) <= 1e-6
    ring = np.where(at_level, loop, len(points) + np.arange(len(loop)))
    extra, faces = [inner], [_strip(loop, ring)]
    start, first_corner = len(points) + len(loop), 0
    outward = [(1, -reach), (0, reach), (1, reach), (0, -reach)]
    ends = []
    for side, (axis, value) in zip(sides, outward, strict=True):
        members = np.arange(first_corner, first_corner + len(side)) % len(loop)
        outer = inner[members].copy()
        outer[:, axis] = value
        outer_index = start + np.arange(len(side))
        faces.append(_strip(ring[members], outer_index, is_closed=False))
        extra.append(outer)
        ends.append((ring[members[0]], outer_index[0], outer_index[-1]))
        start, first_corner = start + len(side), first_corner + len(side) - 1
    extra.append(_rectangle(2 * reach, 2 * reach, z_level)[[1, 2, 3, 0]])
    corners = [[ends[(k + 1) % 4][0], ends[k][2], start + k, ends[(k + 1) % 4][1]] for k in range(4)]
    return np.concatenate(extra), np.concatenate([*faces, _quads(corners)])


def _strip(inner: np.ndarray, outer: np.ndarray, is_closed: bool = True) -> np.ndarray:
    """Triangulate between two counter-clockwise polylines of equal length."""
    i1, o1 = np.roll(inner, -1), np.roll(outer, -1)
    faces = np.stack([np.stack([i1, inner, outer], 1), np.stack([i1, outer, o1], 1)], 1)
    return with_area((faces if is_closed else faces[:-1]).reshape(-1, 3))


def with_area(faces: np.ndarray) -> np.ndarray:
    """Select the faces [m, 3] whose three vertices differ."""
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return faces[has_area]


def _check_cut(size: float, moats: np.ndarray, area: float) -> None:
    """Check that the area of the substrate minus the pits is right."""
    pits = 0.5 * WALL_SEGMENTS * np.sin(2 * np.pi / WALL_SEGMENTS) * np.sum(moats[:, 2] ** 2)
    if abs(area - (size**2 - pits)) > 1e-9 * size**2:
        raise SceneError("the moats could not be cut out of the substrate: they must be disjoint and lie inside it")


def _rectangle(length: float, width: float, z: float) -> np.ndarray:
    """Construct the corners of a rectangle about the z axis, counter-clockwise from (-, -) [4, 3]."""
    a, b = 0.5 * length, 0.5 * width
    return np.array([[-a, -b, z], [a, -b, z], [a, b, z], [-a, b, z]])


def _quads(quads: list) -> np.ndarray:
    """Split quadrilaterals [m, 4] along their first diagonal into faces [2 m, 3]."""
    q = np.asarray(quads, np.int64)
    return np.stack([q[:, [0, 1, 2]], q[:, [0, 2, 3]]], 1).reshape(-1, 3)


def _lift(points: np.ndarray, z: float) -> np.ndarray:
    """Append the height z to points [n, 2]."""
    return np.column_stack([points, np.full(len(points), z)])


def _rotate(vertices: np.ndarray, azimuth: float) -> np.ndarray:
    """Rotate vertices about the z axis, counter-clockwise seen from above; quarter turns are exact."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    if abs(np.sin(2 * azimuth)) < 1e-12:
        c, s = np.round(c), np.round(s)
    return vertices @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T


def _local(center: tuple[float, float], azimuth: float) -> np.ndarray:
    """Transform a position of the sample frame to the frame before `_rotate` [3]."""
    return _rotate(np.array([[center[0], center[1], 0.0]]), -azimuth)[0]
