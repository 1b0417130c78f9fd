"""Sample geometry against closed forms, a brute-force ray caster and trimesh."""

import math
import time

import numpy as np
import pytest
import trimesh
from pydantic import TypeAdapter

from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.scene.sample import HeightMapSample, MeshSample, Sample, check_body
from helio_jax.scene.surfaces import WALL_SEGMENTS, Body, first_hit_spheres, surface_body
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings

TAN30 = math.tan(math.radians(30.0))
KINDS = {
    "flat": {"kind": "flat", "size_um": 500.0},
    "spheres": {"kind": "spheres", "spheres": [{"radius_um": 1000.0, "cap_height_um": 720.0}]},
    "moat": {
        "kind": "spheres",
        "spheres": [
            {"radius_um": 1000.0, "cap_height_um": 720.0, "moat": {"width_um": 80.0, "depth_um": 100.0}},
            {"radius_um": 300.0, "center_um": [2000.0, 1500.0], "moat": {"width_um": 90.0, "depth_um": 20.0}},
        ],
    },
    "step": {"kind": "step", "size_um": 900.0, "height_um": 100.0, "position_um": 30.0, "facing_deg": 20.0},
    "facet": {"kind": "step", "size_um": 900.0, "height_um": 100.0, "slope_deg": 35.0, "facing_deg": -110.0},
    "trench": {
        "kind": "trench",
        "size_um": 900.0,
        "width_um": 40.0,
        "length_um": 300.0,
        "depth_um": 70.0,
        "azimuth_deg": 25.0,
        "center_um": [50.0, -80.0],
    },
    "pyramid": {"kind": "pyramid", "size_um": 900.0, "base_um": 200.0, "height_um": 80.0, "azimuth_deg": 10.0},
    "truncated": {"kind": "pyramid", "size_um": 900.0, "base_um": 200.0, "height_um": 80.0, "top_um": 60.0},
}


def build(spec) -> Body:
    return TypeAdapter(Sample).validate_python(spec).build()


def cross2(u, v):
    """z component of the cross product of plane vectors."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def volume_above(body: Body, level: float) -> float:
    """Signed volume between the triangles and the plane z = level [um^3]."""
    t = body.triangles - [0.0, 0.0, level]
    area = 0.5 * cross2(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    return float(np.sum(area * t[:, :, 2].mean(1)))


def surface_area(body: Body) -> float:
    return float(trimesh.Trimesh(body.vertices, body.faces, process=False).area)


@pytest.mark.parametrize("name", KINDS)
def test_sheets_are_closed_and_face_up(name):
    """Inner edges are shared by exactly two faces that run along them in opposite directions; no normal points down.

    Catches: T-junctions and gaps where rays leak, flipped faces, faces without area, coincident faces.
    """
    body = build(KINDS[name])
    report = check_body(body)
    edges = np.sort(body.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, n_uses = np.unique(edges, axis=0, return_counts=True)
    rim = body.vertices[unique[n_uses == 1]]
    assert n_uses.max() == 2
    assert report["is_winding_consistent"] and report["n_duplicate_faces"] == report["n_faces_without_area"] == 0
    assert body.normals[:, 2].min() >= -1e-12
    size = KINDS[name].get("size_um", 8000.0)
    a = math.radians(KINDS[name].get("facing_deg", KINDS[name].get("azimuth_deg", 0.0)))
    local = rim[..., :2] @ np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    assert np.all(np.abs(local).max((-1, -2)) > 0.5 * size - 1e-6), "an open edge away from the border"
    footprint = 0.5 * np.sum(cross2(*np.moveaxis(np.diff(body.triangles, axis=1), 1, 0)))
    assert footprint == pytest.approx(size**2, rel=1e-9), "the sheet must cover its square exactly once"


def test_volumes_and_areas():
    """Volume over z = 0 and surface area of every analytic shape.

    Catches: depth for height, half widths, slope measured from the vertical, full for half pyramid base.
    """
    s2 = 900.0**2
    assert volume_above(build(KINDS["step"]), 0.0) == pytest.approx(900 * (450 + 30) * 100, rel=1e-12)
    run = 100.0 / math.tan(math.radians(35.0))
    facet = build(KINDS["facet"])
    assert volume_above(facet, 0.0) == pytest.approx(900 * 100 * (450 + run / 2), rel=1e-12)
    assert surface_area(facet) == pytest.approx(s2 - 900 * run + 900 * math.hypot(run, 100), rel=1e-12)
    trench = build(KINDS["trench"])
    assert len(trench.faces) == 18
    assert volume_above(trench, 0.0) == pytest.approx(-40 * 300 * 70, rel=1e-12)
    assert surface_area(trench) == pytest.approx(s2 + 2 * 70 * (40 + 300), rel=1e-12)
    assert volume_above(build(KINDS["pyramid"]), 0.0) == pytest.approx(200**2 * 80 / 3, rel=1e-12)
    frustum = build(KINDS["truncated"])
    assert volume_above(frustum, 0.0) == pytest.approx(80 / 3 * (200**2 + 200 * 60 + 60**2), rel=1e-12)
    slant = math.hypot(80, 70)
    assert surface_area(frustum) == pytest.approx(s2 - 200**2 + 60**2 + 2 * (200 + 60) * slant, rel=1e-12)
    assert frustum.max_height == 80.0 and trench.max_height == 0.0


def test_directions_of_step_trench_pyramid():
    """Azimuths are counter-clockwise from +x: the step's riser looks where the lower side lies.

    Catches: clockwise angles, upper and lower side swapped, trench across instead of along, unturned centres.
    """
    for facing in (0.0, 90.0, 200.0):
        body = build(KINDS["step"] | {"facing_deg": facing})
        riser = body.normals[np.abs(body.normals[:, 2]) < 1e-9]
        a = math.radians(facing)
        np.testing.assert_allclose(riser, [[math.cos(a), math.sin(a), 0.0]] * 2, atol=1e-12)
        edge = body.triangles[np.abs(body.normals[:, 2]) < 1e-9].reshape(-1, 3)
        np.testing.assert_allclose(edge[:, :2] @ [math.cos(a), math.sin(a)], 30.0, atol=1e-9)
    trench = build(KINDS["trench"])
    floor = trench.vertices[trench.vertices[:, 2] < -1]
    np.testing.assert_allclose(floor.mean(0), [50.0, -80.0, -70.0], atol=1e-9)
    long_side = floor[1] - floor[0]
    assert np.degrees(math.atan2(long_side[1], long_side[0])) == pytest.approx(25.0)
    assert np.linalg.norm(long_side) == pytest.approx(300.0)
    pyramid = build(KINDS["pyramid"])
    azimuths = np.degrees(np.arctan2(pyramid.normals[:, 1], pyramid.normals[:, 0]))[pyramid.normals[:, 2] < 0.99]
    np.testing.assert_allclose(np.sort(azimuths), [-170.0, -80.0, 10.0, 100.0], atol=1e-9)


def test_moat_dimensions():
    """The moat's wall is a vertical cylinder at rim radius + width, its floor level at -depth, its wall faces inwards.

    Catches: width measured from the sphere's equator, wall facing the solid, a polygon that is too coarse.
    """
    body = build(KINDS["moat"])
    outer = math.sqrt(1000.0**2 - 280.0**2) + 80.0
    near = np.hypot(body.vertices[:, 0], body.vertices[:, 1]) < 1100.0
    floor = near & np.isclose(body.vertices[:, 2], -100.0)
    radius = np.hypot(body.vertices[floor, 0], body.vertices[floor, 1])
    assert floor.sum() == WALL_SEGMENTS + 1 and np.sum(radius < 1e-9) == 1
    np.testing.assert_allclose(radius[radius > 1], outer, rtol=1e-12)
    middle = body.triangles.mean(1)
    wall = (np.abs(body.normals[:, 2]) < 1e-9) & (np.hypot(middle[:, 0], middle[:, 1]) < 1100.0)
    assert wall.sum() == 2 * WALL_SEGMENTS
    assert np.all(np.sum(body.normals[wall, :2] * middle[wall, :2], axis=1) < -0.99 * outer)
    assert outer - np.hypot(middle[wall, 0], middle[wall, 1]).min() < 3e-6 * outer  # the sagitta it promises
    pits = 0.5 * WALL_SEGMENTS * math.sin(2 * math.pi / WALL_SEGMENTS) * np.array([outer**2, 90.0**2])
    # the second sphere rests on the substrate: its rim radius is 0
    assert volume_above(body, 0.0) == pytest.approx(-pits @ [100.0, 20.0], rel=1e-9)


def cast_at_spheres(x, y, spheres, shift):
    """Trace one beam ray: distance along the unit ray to spheres and substrate, by the textbook quadratic."""
    u = np.array([shift[0], shift[1], -1.0])
    u /= np.linalg.norm(u)
    start = np.array([x, y, 0.0]) - 1e5 * u
    best = -start[2] / u[2]
    for *c, radius in spheres:
        oc = start - c
        b = oc @ u
        inside = b * b - oc @ oc + radius**2
        if inside >= 0:
            best = min(best, -b - math.sqrt(inside))
    return start + best * u


@pytest.mark.parametrize("shift", [(0.0, 0.0), (TAN30, 0.0), (-0.3, 0.8)])
def test_first_hits_match_brute_force(shift):
    """First hits of beam rays on two spheres and the substrate agree with a ray caster without a beam frame.

    Catches: the far root, a shift of the wrong sign, spheres not ordered along the beam, normals not at the hit.
    """
    spheres = np.array([[0.0, 0.0, -280.0, 1000.0], [900.0, 500.0, 200.0, 400.0]])
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-2500, 2500, (2, 400))
    height, normals = first_hit_spheres(x, y, spheres, shift)
    hits = np.array([cast_at_spheres(*p, spheres, shift) for p in zip(x, y, strict=True)])
    np.testing.assert_allclose(height, hits[:, 2], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    assert np.all(normals @ [shift[0], shift[1], -1.0] < 0), "a first hit faces the beam"
    on_first = np.isclose(np.linalg.norm(hits - spheres[0, :3], axis=1), 1000.0) & (height > 1e-6)
    assert on_first.sum() > 20
    np.testing.assert_allclose(normals[on_first], (hits[on_first] - spheres[0, :3]) / 1000.0, atol=1e-8)


def test_apex_of_sphere_a():
    """The apex of sphere A appears at X = +H tan t = +415.7 um, downstream of its axis, with a vertical normal.

    Catches: a beam that travels the other way.
    """
    spheres = build(KINDS["spheres"]).spheres
    height, normals = first_hit_spheres(np.array([720.0 * TAN30, -720.0 * TAN30]), np.zeros(2), spheres, (TAN30, 0.0))
    assert height[0] == pytest.approx(720.0, abs=1e-9) and abs(720.0 * TAN30 - 415.7) < 0.05
    np.testing.assert_allclose(normals[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert height[1] < 500.0
    np.testing.assert_allclose(spheres, [[0.0, 0.0, -280.0, 1000.0]])


@pytest.mark.parametrize("level", [None, 0.0, -30.0])
def test_surface_body_has_no_leak(level):
    """A beam-frame grid with jumps (points running backwards in x) and a skirt is one sheet, open only outside.

    Catches: gaps at the seam or the corners, flipped substrate, area counted twice, a sheet that the beam hits.
    """
    X, Y = np.meshgrid(np.arange(-60.0, 61.0, 10.0), np.arange(-40.0, 41.0, 10.0))
    z = np.where((np.abs(X) < 25) & (np.abs(Y) < 20), 60.0, 0.0)
    z[0, 3:6] = [7.0, 40.0, -11.0]
    z[2, -1] = 25.0
    body = surface_body(X - z * TAN30, Y, z, 300.0, level=level, beam_shift=(TAN30, 0.0))
    report = check_body(body)
    assert report["is_winding_consistent"] and report["n_inner_open_edges"] == 0
    assert report["n_edges_of_three_faces"] == report["n_faces_without_area"] == report["n_duplicate_faces"] == 0
    footprint = 0.5 * np.sum(cross2(*np.moveaxis(np.diff(body.triangles, axis=1), 1, 0)))
    assert footprint == pytest.approx(600.0**2, rel=1e-12)
    sheared = body.vertices + np.outer(body.vertices[:, 2], [TAN30, 0.0, 0.0])  # back to beam positions
    t = sheared[body.faces][..., :2]
    seen = cross2(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    assert seen.min() > -1e-9, "no face may turn its back to the beam"
    assert 0.5 * seen.sum() == pytest.approx(600.0**2, rel=1e-9)


def test_surface_body_takes_shorter_diagonal():
    """A cell with one high corner is split so that the edge joins the three low corners' diagonal.

    Catches: a fixed diagonal, which makes a ridge or a valley by chance.
    """
    x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0])
    for corner in ((0, 0), (0, 1)):
        z = np.zeros((2, 2))
        z[corner] = 1.0
        volume = volume_above(surface_body(x, y, z), 0.0)
        assert volume == pytest.approx(1.0 / 6.0)


def test_skirt_inside_the_surface_is_refused():
    """Catches: a skirt that folds back over the surface."""
    x, y = np.meshgrid(np.arange(-50.0, 51, 10), np.arange(-50.0, 51, 10))
    with pytest.raises(SceneError, match="enlarge size_um"):
        surface_body(x, y, np.zeros_like(x), 40.0)


def test_height_map_files(tmp_path):
    """An .npz, a .csv and a HeightMap in memory give the same surface; the first text row is the lowest y.

    Catches: transposed or upside-down grids, units applied to the heights only.
    """
    x, y = np.arange(5) * 2.0 - 4.0, np.arange(4) * 2.0 - 3.0
    height = np.arange(20.0).reshape(4, 5)
    np.savez(tmp_path / "map.npz", x=x / 1e3, y=y / 1e3, height=height / 1e3)
    np.savetxt(tmp_path / "map.csv", height, delimiter=",")
    bodies = [
        HeightMapSample(file="map.npz", unit="mm").build(tmp_path),
        HeightMapSample(file="map.csv", pixel_size_um=2.0).build(tmp_path),
        HeightMapSample.of(HeightMap(height, x, y)).build(),
    ]
    for body in bodies:
        np.testing.assert_allclose(body.vertices, np.stack([*np.meshgrid(x, y), height], -1).reshape(-1, 3), atol=1e-9)
    assert bodies[0].vertices[1, 2] == 1.0 and bodies[0].vertices[1, 0] == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.npz", None, "no such file"),
        ("a.npz", b"", "is empty"),
        ("b.npz", b"not a zip", "not a readable .npz"),
        ("c.csv", b"1,2\n3,x", "not a grid of numbers"),
        ("d.csv", b"1,2\n3", "not a grid of numbers"),
        ("e.png", b"1", "must be .npz"),
        ("f.csv", b"1,nan\n3,4", "must be finite, got 1 gaps"),
    ],
)
def test_bad_height_maps(tmp_path, name, content, message):
    """Every bad file is an InputFileError that names it. Catches: tracebacks of NumPy, NaN heights traced."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputFileError, match=message) as error:
        HeightMapSample(file=name, pixel_size_um=1.0).build(tmp_path)
    assert name in str(error.value)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_mesh_is_scaled_turned_moved(tmp_path, suffix):
    """A box of 1 x 2 x 3 mm, rotated by 90 deg about x, then z, then shifted, has the bounds computed by hand.

    Catches: rotations in another order or sense, translation before rotation, a unit applied twice.
    """
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / f"box.{suffix}")
    mesh = MeshSample(file=f"box.{suffix}", unit="mm", rotate_deg=(90, 0, 90), translate_um=(10, 0, 1000), scale=0.5)
    body = mesh.build(tmp_path)
    # (1, 2, 3) -> about x by 90: extents (1, 3, 2) -> about z by 90: (3, 1, 2); half-extents of 0.5 mm scale
    np.testing.assert_allclose(body.bounds, [[-740, -250, 500], [760, 250, 1500]], atol=1e-3)
    report = check_body(body)
    assert report["is_watertight"] and not report["is_inside_out"] and report["n_faces"] == 12


@pytest.mark.parametrize(
    ("angles", "where"),
    [((90, 0, 0), (0, 0, 10)), ((0, 0, 90), (-10, 0, 0)), ((90, 90, 0), (10, 0, 0)), ((0, 90, 90), (-10, 0, 0))],
)
def test_mesh_rotation_sense_and_order(tmp_path, angles, where):
    """The corner at +y is moved by right-handed rotations about the fixed x, then y, then z axis.

    Catches: clockwise rotation, the order z, y, x, axes that rotate with the sample.
    """
    trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [0, 10, 0]], [[0, 1, 2]]).export(tmp_path / "t.stl")
    body = MeshSample(file="t.stl", unit="um", rotate_deg=angles).build(tmp_path)
    far = body.vertices[np.argmax(np.linalg.norm(body.vertices, axis=1))]
    np.testing.assert_allclose(far, where, atol=1e-5)


def test_mesh_on_flat_has_no_coincident_face(tmp_path):
    """A box on an added substrate loses its bottom. Catches: two coincident faces at z = 0."""
    trimesh.creation.box((100.0, 100.0, 100.0)).export(tmp_path / "box.stl")
    body = MeshSample(file="box.stl", unit="um", translate_um=(0, 0, 50), flat_size_um=400.0).build(tmp_path)
    assert len(body.faces) == 10 + 2
    assert np.all(body.normals[np.all(np.abs(body.triangles[..., 2]) < 1e-6, axis=1), 2] == 1.0)


def inside_out() -> bytes:
    box = trimesh.creation.box()
    box.invert()
    return box.export(file_type="stl")  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.step", b"x", "must be .stl"),
        ("missing.stl", None, "no such file"),
        ("b.stl", b"", "is empty"),
        ("c.stl", b"\0" * 40, "cannot be read|no triangles"),
        ("d.obj", b"v 0 0 0\nv 1 0 0\n", "cannot be read|no triangles"),
        ("e.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "non-finite"),
        ("f.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "has an area"),
        ("g.glb", b"glTF" + b"\xff" * 40, "cannot be read"),
        ("h.stl", inside_out(), "inside out"),
        ("i.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read|do not exist"),
        ("j.obj", b"v 0 0 0\nv 1e9 0 0\nv 0 1e9 0\nf 1 2 3\n", "check sample.unit"),
    ],
)
def test_bad_meshes(tmp_path, name, content, message):
    """Every bad mesh is an InputFileError that names the file. Catches: tracebacks of trimesh, silent repairs."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputFileError, match=message) as error:
        MeshSample(file=name, unit="um").build(tmp_path)
    assert name in str(error.value)


def test_noise_as_a_mesh_is_refused(tmp_path):
    """50 MB of noise as STL: an InputFileError that names the file, soon. Catches a reader that hangs or trusts it."""
    (tmp_path / "noise.stl").write_bytes(np.random.default_rng(0).bytes(50_000_000))
    start = time.monotonic()
    with pytest.raises(InputFileError, match=r"noise\.stl"):
        MeshSample(file="noise.stl", unit="um").build(tmp_path)
    assert time.monotonic() - start < 60.0


def test_a_mesh_with_holes_is_counted_and_refused(tmp_path, bshem):
    """100 faces missing from a closed ball: `validate` counts the open edges, the tracer refuses the lost atoms.

    Catches a silent wrong number: atoms that fly into the ball meet its wall from behind.
    """
    ball = trimesh.creation.icosphere(subdivisions=4, radius=300.0)
    rng = np.random.default_rng(1)
    up = np.flatnonzero(ball.triangles_center[:, 2] > 100.0)
    ball.update_faces(~np.isin(np.arange(len(ball.faces)), rng.choice(up, 100, replace=False)))
    ball.export(tmp_path / "ball.stl")
    body = MeshSample(file="ball.stl", unit="um").build(tmp_path)
    assert check_body(body)["n_inner_open_edges"] > 100 and not check_body(body)["is_watertight"]
    axis = np.linspace(-150.0, 150.0, 15)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    with pytest.raises(GuardError, match="met a surface from behind"):
        trace_pixels(make_experiment(body, bshem, TraceSettings(rays=64)), x, y)


def test_large_mesh_is_refused(tmp_path):
    """Catches: a size limit that is checked after reading."""
    (tmp_path / "big.stl").write_bytes(b"\0" * 2000)
    with pytest.raises(InputFileError, match=r"the limit is 0\.001 MB"):
        MeshSample(file="big.stl", unit="um", max_file_mb=0.001).build(tmp_path)


def test_body_refuses_nonsense():
    """Catches: face indices out of range, which Embree reads out of bounds."""
    v = np.zeros((3, 3))
    with pytest.raises(SceneError, match="index the 3 vertices"):
        Body(v, np.array([[0, 1, 3]]))
    with pytest.raises(SceneError, match="finite"):
        Body(v * np.nan, np.array([[0, 1, 2]]))
    with pytest.raises(SceneError, match="integers"):
        Body(v, np.array([[0.0, 1.0, 2.0]]))
