"""Walls half-way between pixels: levels, closure and places of the refined grid."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from helio_jax.scene.surfaces import surface_body
from helio_jax.scene.wall_grid import GAP, has_level_rims, refined_grid, wall_links, with_upright_walls

PITCH = 2.0
SHIFT = 0.3, -0.2
Y, X = (PITCH * a for a in np.mgrid[:12, :15].astype(float))


def grid(z: np.ndarray):
    return X - SHIFT[0] * z, Y - SHIFT[1] * z, z


def refined(z: np.ndarray):
    """Refine heights with all points."""
    return refined_grid(grid(z), grid(z), SHIFT, *wall_links(X, Y, z))


def used(z: np.ndarray):
    """Refine heights as predictions use them, without the lines that no wall needs."""
    return with_upright_walls(grid(z), grid(z), SHIFT)


def test_without_walls_nothing_changes():
    """Neither of noise nor of a facet of 72 degrees, three pixels wide."""
    z = np.random.default_rng(0).normal(0.0, 0.1, X.shape) + 3.0 * np.clip(X - 10.0, 0.0, 3.0 * PITCH)
    points = grid(z)
    fine, behind, number = with_upright_walls(points, points, SHIFT)
    assert fine is points and behind is points and np.array_equal(number.ravel(), np.arange(z.size))


def test_far_points_around_the_image_are_no_wall():
    """The substrate 100 um away and 60 um lower: a slope. Rejects a limit of the height alone."""
    place = np.array([0.0, 2.0, 4.0, 104.0, 5000.0])
    x, y = np.meshgrid(place, place)
    z = np.where(np.maximum(x, y) > 10.0, 0.0, 60.0)
    assert not any(walls.any() for walls in wall_links(x, y, z))
    assert all(walls.any() for walls in wall_links(x / 50.0, y / 50.0, z))


def test_walls_stand_half_way():
    """A block with a wall along the raster and a corner: its levels are kept, and its edges are where pixels meet.

    To an eighth of a pixel, for the outline is smoothed about its corner. Rejects a ramp from point to point: its
    heights are between the levels.
    """
    is_high = (X > 9.0) & (Y > 5.0)
    for refine in (used, refined):
        (x, y, z), _, number = refine(20.0 * is_high)
        assert set(np.unique(z)) == {0.0, 20.0}
        assert np.array_equal(z > 0.0, is_high.ravel()[number])
        on_raster = x + SHIFT[0] * z, y + SHIFT[1] * z
        assert on_raster[0][z > 0].min() == pytest.approx(9.0, abs=0.125 * PITCH)
        assert on_raster[1][z > 0].min() == pytest.approx(5.0, abs=0.125 * PITCH)
    assert z.shape == (34, 43)
    assert np.array_equal(z[::3, ::3], 20.0 * is_high)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, 18.4, 30.0, 45.0, 71.0])
def test_wall_at_an_angle_is_straight(angle_deg):
    """A straight wall: its area to 2.5 %, no face turned over, and no pixel on the wrong side.

    Rejects the sides of the pixels, whose area is 1.07 to 1.41 times as large at 7 to 45 degrees (1.37 at 30).
    """
    way = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    y, x = np.mgrid[:41, :41].astype(float)
    is_high = (x - 19.8) * way[0] + (y - 20.3) * way[1] > 0.0
    at = x, y, 10.0 * is_high
    area, is_upright, z, (fine, number) = faces_of(at)
    assert area[is_upright].sum() / 10.0 == pytest.approx(40.0 / max(way), rel=0.025)
    assert z[~is_upright].min() > 0.0
    assert np.array_equal(fine[2] > 5.0, is_high.ravel()[number])


def test_outline_keeps_what_it_encloses():
    """A disc of 9.3 pixels: the area of its top is that of its pixels to 0.5 %; that of its wall, the circle's to 5 %.

    Rejects smoothing by plain means, which shrinks it by 2 %, and stairs (1.27 times the circle).
    """
    y, x = np.mgrid[:41, :41].astype(float)
    is_high = np.hypot(x - 19.8, y - 20.3) < 9.3
    area, is_upright, z, (fine, _) = faces_of((x, y, 10.0 * is_high))
    top = surface_body(*fine).vertices[surface_body(*fine).faces][..., 2].min(1) > 5.0
    assert area[top].sum() == pytest.approx(is_high.sum(), rel=0.005)
    assert area[is_upright].sum() / 10.0 == pytest.approx(2.0 * np.pi * 9.3, rel=0.05)
    assert z[~is_upright].min() > 0.0


def faces_of(at):
    """Compute areas, whether upright, and twice the area's z component of faces; and the grid and number of pixels."""
    fine, _, number = with_upright_walls(at, at, (0.0, 0.0))
    body = surface_body(*fine)
    a, b, c = np.moveaxis(body.vertices[body.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(normal, axis=1)
    return area, np.abs(normal[:, 2]) < 0.1 * area, normal[:, 2], (fine, number)


def test_surface_stays_closed_and_tilted_levels_plane():
    """A tilted plane with a ring-shaped wall: one sheet, both levels plane up to the wall but in its single corners."""
    is_high = np.abs(np.hypot(X - 14.0, Y - 11.0) - 6.0) < 2.5
    plane = 0.2 * X - 0.1 * Y
    z = plane + 18.0 * is_high
    for refine in (used, refined):
        fine, _, number = refine(z)
        x, y = fine[0] + SHIFT[0] * fine[2], fine[1] + SHIFT[1] * fine[2]
        off = fine[2] - (0.2 * x - 0.1 * y) - 18.0 * is_high.ravel()[number]
        assert np.abs(off).max() <= 0.5 * PITCH * 0.3 + 1e-9 and np.mean(np.abs(off) > 1e-9) < 0.03
        edges = np.sort(surface_body(*fine).faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, times = np.unique(edges, axis=0, return_counts=True)
        assert times.max() == 2 and np.sum(times == 1) == 2 * (np.sum(fine[2].shape) - 2)


def test_wall_that_ends():
    """A slit that becomes shallower: where a cell has a wall on one side only, all its four inner corners meet.

    Rejects corners that belong to the pixels beside the wall: they leave a hole.
    """
    depth = np.where((X < 22.0) & (np.abs(Y - 10.0) < 0.1), 1.5 * np.clip(22.0 - X, 0.0, None), 0.0)
    along_x, along_y = wall_links(X, Y, -depth)
    n_walls = along_y[:, :-1] + along_y[:, 1:].astype(int) + along_x[:-1] + along_x[1:]
    assert (n_walls == 1).any() and (n_walls == 2).any()
    z = refined(-depth)[0][2]
    corners = np.stack([z[i::3, j::3] for i in (1, 2) for j in (1, 2)])
    spread = np.ptp(corners, axis=0)
    assert spread[n_walls <= 1].max() < 2.0 * GAP * depth.max() < 1.0 < spread[n_walls == 2].min()


def test_foot_of_a_hidden_side_is_moved():
    """Points moved below an edge: in the refined grid those at the foot of its wall move, the seen pixel does not."""
    z = np.where(X > 13.0, 0.0, 20.0)
    at = grid(z)
    behind = tuple(np.where(np.isclose(X, 14.0), f - 3.0, f) for f in at)
    for results in (with_upright_walls(at, behind, SHIFT), refined_grid(at, behind, SHIFT, *wall_links(X, Y, z))):
        fine, moved, number = results
        change = np.any([a != b for a, b in zip(fine, moved, strict=True)], axis=0)
        assert change.any() and np.all(np.isclose(X.ravel()[number[change]], 14.0))
        assert np.all(fine[0][change] - moved[0][change] == pytest.approx(3.0))
    assert not change[::3, ::3].any()


def test_lines_that_no_wall_needs_are_left_out():
    """A block in one corner and a bump elsewhere: far fewer points, and the same surface between them.

    Rejects a line that is left out although a wall ends there, or crosses it: the wall would slant.
    """
    z = np.where((X > 20.0) & (Y > 13.0), 30.0, 0.5 * np.exp(-0.1 * ((X - 8.0) ** 2 + (Y - 6.0) ** 2)))
    fine, _, _ = refined(z)
    few, _, number = used(z)
    assert few[2].size < 0.3 * fine[2].size and set(range(z.size)) == set(number.ravel())
    y, x = (np.ravel(np.arange(n)[:, None] + [GAP - 0.5, 0.0, 0.5 - GAP])[1:-1] for n in z.shape)
    lines = y[np.isin(fine[1][:, 0], few[1][:, 0])], x[np.isin(fine[0][0], few[0][0])]
    at = np.stack(np.meshgrid(y, x, indexing="ij"), -1)
    for every, kept in zip(fine, few, strict=True):
        assert np.abs(RegularGridInterpolator(lines, kept)(at) - every).max() < 0.05 * PITCH


@pytest.mark.parametrize(("tilt_deg", "is_level"), [(20.0, True), (50.0, False)])
def test_limb_of_a_round_body_is_no_rim(tilt_deg, is_level):
    """The rim's normal decides, not that of the foot."""
    z, up = np.where(X > 13.0, 0.0, 20.0), np.broadcast_to([0.0, 0.0, 1.0], (*X.shape, 3))
    tilted = [np.sin(np.deg2rad(tilt_deg)), 0.0, np.cos(np.deg2rad(tilt_deg))]
    normals = np.where(np.isclose(X, 12.0)[..., None], tilted, up)
    assert has_level_rims(z, normals, np.isclose(X, 14.0)) == is_level
    assert has_level_rims(z, normals, np.zeros(X.shape, bool))
