"""Measurements on height maps against closed forms: a truncated octahedron, planes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from helio_jax.errors import SceneError
from helio_jax.measure.facets import find_facets
from helio_jax.measure.planes import fit_planes
from helio_jax.workflows.measure import Wanted, measure_height_map, reconstructed_area
from tests.height_maps import PITCH, make_rec

TILT = math.degrees(math.acos(1 / math.sqrt(3)))
"""Angle between the faces {100} and {111} of a cube's lattice: 54.7356 deg."""


def octahedron(x, y):
    """Top 440 x 260 um at z = 600 um, four {111} sides, lowest at 0; turned by 20 deg."""
    c, s = math.cos(0.35), math.sin(0.35)
    u, v, steep = c * x + s * y, c * y - s * x, math.tan(math.radians(TILT))
    return np.maximum(600.0 - steep * np.maximum(np.maximum(np.abs(u) - 220.0, np.abs(v) - 130.0), 0.0), 0.0)


@pytest.mark.parametrize(("noise", "limit"), [(0.0, 0.5), (4.0, 1.5)])
def test_angles_of_a_truncated_octahedron(noise, limit):
    """Top to side 125.26 deg, side to side 109.47 deg, side to floor 234.74 deg, from planes and from profiles.

    Catches the angle between normals reported as the interior one, convex for concave, a profile across a climbing edge
    without the edge's slope (side to side would be 98.5 deg), and facets that absorb their neighbours.
    """
    found = find_facets(make_rec(octahedron, noise=noise))
    tilts = {f.number: f.tilt_deg for f in found.facets}
    flat = [n for n, t in tilts.items() if t < 5]
    sides = [n for n, t in tilts.items() if abs(t - TILT) < 1.5]
    assert len(sides) == 4 and len(flat) == 2
    top = max(flat, key=lambda n: found.facets[n - 1].level)
    kinds = {"top": 0, "side": 0, "foot": 0}
    for edge in found.edges:
        pair = set(edge.facets)
        if pair <= set(sides):
            kind, exact = "side", 2 * math.degrees(math.asin(math.sqrt(2 / 3)))
        elif top in pair:
            kind, exact = "top", 180 - TILT
        else:
            kind, exact = "foot", 180 + TILT
        kinds[kind] += 1
        assert abs(edge.angle_deg - exact) < limit, (edge, exact)
        if edge.n_profiles >= 5:
            assert abs(edge.profile_angle_deg - exact) < 2 * limit, (edge, exact)
    assert kinds == {"top": 4, "side": 4, "foot": 4}


def test_planes_by_least_squares_and_without_outliers():
    """Several surfaces at a time, each as if alone; a fifth of the pixels far off changes nothing; far from the origin.

    Catches weights that are shared, and normal equations that lose the digits of coordinates of centimetres.
    """
    rec = make_rec(lambda x, y: 0.3 * x - 0.2 * y + 7.0)
    rec = replace(rec, raster_x=rec.raster_x + 4e4, raster_y=rec.raster_y - 1e4)
    rng = np.random.default_rng(2)
    region = rng.random(rec.height.shape) < 0.5
    noise = rng.standard_normal(rec.height.shape)
    plane = 0.3 * rec.x - 0.2 * rec.y + 7.0
    far = np.where(rng.random(rec.height.shape) < 0.2, plane + 500.0, plane)
    planes, misfit = fit_planes(rec, region, np.stack([plane, plane + noise, far]))
    np.testing.assert_allclose(planes[[0, 2]], [[0.3, -0.2, 7.0]] * 2, rtol=1e-6)
    np.testing.assert_allclose(planes[1], fit_planes(rec, region, (plane + noise)[None])[0][0], rtol=1e-6)
    design = np.stack([rec.x[region], rec.y[region], np.ones(region.sum())], -1)
    plain = np.linalg.lstsq(design, (plane + noise)[region], rcond=None)[0]
    std = 1.0 / np.sqrt(region.sum()) / rec.raster_x.std()
    assert np.abs(planes[1] - plain)[:2].max() < std  # the biweight deviates from least squares by 0.23 of it
    assert misfit.shape == (3, region.sum()) and np.abs(misfit[2]).max() == pytest.approx(500.0, rel=1e-6)


@pytest.mark.parametrize("along", ["x", "y", "diagonal"])
def test_a_line_of_pixels_has_no_slope_across(along):
    """Its slope along is right; across it is 0, not the ratio of two rounding errors."""
    rec = make_rec(lambda x, y: 0.3 * x + 0.3 * y)
    region = np.zeros(rec.height.shape, bool)
    region[{"x": (10, slice(5, 25)), "y": (slice(5, 25), 10), "diagonal": (np.arange(20), np.arange(20))}[along]] = True
    (plane,), _ = fit_planes(rec, region, rec.height[None])
    expected = {"x": (0.3, 0.0), "y": (0.0, 0.3), "diagonal": (0.3, 0.3)}[along]
    np.testing.assert_allclose(plane[:2], expected, atol=1e-6)


def test_sides_and_area_of_the_top_face():
    """440 x 260 um, 0.1144 mm2, within a pixel or two stated deviations. Catches half for full sides."""
    top = max(find_facets(make_rec(octahedron)).facets, key=lambda f: f.level if f.tilt_deg < 5 else -1e9)
    assert abs(top.long_um - 440) < 0.8 * PITCH and abs(top.short_um - 260) < 0.8 * PITCH
    assert abs(top.area_um2 - 440 * 260) < 2 * top.area_std_um2 + 1e-9 and top.area_std_um2 < 0.1 * 440 * 260
    assert not top.is_cut


def test_small_holes_do_not_cut_a_facet():
    """A top face with a few pixels not reconstructed at its rim is whole; beside a strip wider than a facet it is cut.

    Catches holes treated as the border of the field: then no facet of a measured crystal is whole.
    """
    top_of = lambda rec: max(find_facets(rec).facets, key=lambda f: f.level if f.tilt_deg < 5 else -1e9)  # noqa: E731
    for lost, is_cut in ((slice(46, 54), False), (slice(0, 101), True)):
        is_valid = np.ones((101, 101), bool)
        is_valid[lost, 60:64] = False  # the face ends at column 61.5
        assert top_of(make_rec(octahedron, is_valid=is_valid)).is_cut == is_cut


def test_a_top_face_keeps_its_size_beside_bent_flanks():
    """Flanks that get steeper downwards, 52 to 58 deg over 500 um: area within 5 %, sides within a pixel.

    Catches borders where the planes of whole flanks meet the top: these pass 20 um above the rim (area +20 %).
    """

    def bent(x, y):
        u, v = np.abs(x) - 230.0, np.abs(y) - 130.0
        out = np.maximum(np.maximum(u, v), 0.0)
        return 900.0 - 1.28 * out - 3.2e-4 * out**2

    top = max(find_facets(make_rec(bent)).facets, key=lambda f: f.level if f.tilt_deg < 5 else -1e9)
    assert abs(top.long_um - 460) < PITCH and abs(top.short_um - 260) < PITCH, top
    assert abs(top.area_um2 / (460 * 260) - 1.0) < 0.05, top


@pytest.mark.parametrize("incidence", [0.0, 30.0])
def test_area_of_a_tilted_plane(incidence):
    """A plane that climbs along x by 30 deg: area in the plane is 1 / cos 30 deg times the projected one.

    At oblique incidence the raster is not the surface's x, y; catches its cells used as areas in x, y (15 % here).
    """
    slope = math.tan(math.radians(30.0))
    rec = make_rec(lambda x, y: slope * x, incidence=incidence)
    (facet,) = find_facets(rec).facets
    tx, _ = rec.instrument.beam_shift
    projected = rec.height.size * PITCH**2 / (1 + slope * tx)
    assert facet.tilt_deg == pytest.approx(30.0, abs=1e-6) and facet.is_cut
    assert facet.projected_um2 == pytest.approx(projected, rel=1e-9)
    assert facet.area_um2 == pytest.approx(projected / math.cos(math.radians(30.0)), rel=1e-9)
    wide, deep = 101 * PITCH / (1 + slope * tx) / math.cos(math.radians(30.0)), 101 * PITCH
    assert sorted((facet.long_um, facet.short_um)) == pytest.approx(sorted((wide, deep)), rel=2e-3)


def test_measure_reports_json(tmp_path):
    """All parts at once are JSON, and the figure is drawn; no measurement is an error."""
    wanted = Wanted(facets=True, profile=(-900.0, 0.0, 900.0, 0.0), texture=True)
    found, lines = measure_height_map(make_rec(octahedron), wanted, tmp_path / "f.png")
    assert set(json.loads(json.dumps(found))) == {"trust", "reconstructed", "facets", "profile", "texture"}
    assert len(found["facets"]["edges"]) == 12 and any("125." in line for line in lines)
    assert (tmp_path / "f.png").stat().st_size > 5000
    with pytest.raises(SceneError, match="--facets"):
        measure_height_map(make_rec(octahedron), Wanted())


@pytest.mark.parametrize("border, share", [("free", 0.75), ("flat", 0.0)])
def test_reconstructed_area_of_a_free_border_counts_from_the_median(border, share):
    """Heights with a common error of 50 um and independent ones of 5 um (30 um for a quarter), at a limit of 20 um.

    Catches the common error counted although the level is not determined: nothing would count as reconstructed.
    """
    rng, shape = np.random.default_rng(1), (20, 20)
    own = np.where(np.arange(20) < 5, 30.0, 5.0)[:, None]
    samples = 50.0 * rng.standard_normal((400, 1, 1)) + own * rng.standard_normal((400, *shape))
    rec = replace(
        make_rec(lambda x, y: 0.0 * x, n=shape),
        height_std=np.sqrt(np.mean(samples**2, axis=0)),
        height_samples=samples,
        border=border,
    )
    assert reconstructed_area(rec)["share"] == share
