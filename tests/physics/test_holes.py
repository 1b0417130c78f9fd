"""Meshes that are not closed: where their holes are, holes that are closed, and sheets of two sides."""

from typing import Literal

import numpy as np
import pytest
import trimesh
from stats import assert_mean
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from helio_jax.commands.app import app
from helio_jax.errors import GuardError, InputFileError
from helio_jax.figures.summary import body_lines
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.body import Body
from helio_jax.scene.holes import close_holes, find_edges, find_holes
from helio_jax.scene.placement import rotation_matrix
from helio_jax.scene.sample import MeshSample, check_body
from helio_jax.scene.surfaces import flat_body
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings

RADIUS = 100.0
INSTRUMENT = Instrument(
    beam=Beam(source="pencil"),
    plate=Plate(working_distance_um=3000.0),
    detector=tuple(Detector(name=str(a), polar_deg=40.0, azimuth_deg=a, half_angle_deg=20.0) for a in (0.0, 120.0)),
)
SCENE = """
[plate]
working_distance_um = 3000.0
[[detector]]
name = "a"
polar_deg = 40.0
half_angle_deg = 10.0
[sample]
kind = "mesh"
file = "ball.stl"
unit = "um"
flat_size_um = 900.0
[scan]
nx = 21
ny = 21
pixel_size_um = 20.0
"""


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    """A ball on the substrate, closed."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    ball.apply_translation([0.0, 0.0, RADIUS])
    return ball


def without(ball: trimesh.Trimesh, *faces: int) -> trimesh.Trimesh:
    """Return the ball without some faces."""
    return trimesh.Trimesh(ball.vertices, np.delete(ball.faces, faces, 0), process=False)


def facing_up(ball: trimesh.Trimesh, n: int) -> np.ndarray:
    """Return faces on its upper half that share no vertex."""
    found, used = [], set()
    for face in np.flatnonzero(ball.triangles_center[:, 2] > 1.2 * RADIUS):
        if not used & set(ball.faces[face]):
            found.append(int(face))
            used |= set(ball.faces[face])
    return np.random.default_rng(3).permutation(found)[:n]


def trace(
    body: Body, seed: int, reach: float = 80.0, estimator: Literal["analog", "expected"] = "expected"
) -> tuple[np.ndarray, np.ndarray]:
    """Trace 21 x 21 pixels with 64 rays each; return the mean signal of each detector and its standard error [2]."""
    axis = np.linspace(-reach, reach, 21)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    settings = TraceSettings(rays=64, seed=seed, estimator=estimator)
    estimate = trace_pixels(make_experiment(body, INSTRUMENT, settings), x, y)
    return estimate.total_mean.mean(-1), np.sqrt(estimate.total_variance.sum(-1)) / len(x)


def assert_same(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray], largest_error: float) -> None:
    """Two independent runs agree; the standard error of their ratio is at most `largest_error`."""
    for detector, (mean, error, other, its_error) in enumerate(zip(*a, *b, strict=True)):
        std = float(np.hypot(error, its_error))
        assert std < largest_error * other
        assert_mean(mean - other, 0.0, std, f"signal of detector {detector}")


def test_places_of_holes(ball, tmp_path):
    """One face, and two neighbours elsewhere, are missing from a ball on a substrate: two holes at their middles.

    Catches the outer border taken for a hole, and holes of one mesh taken together.
    """
    one = 77
    two = [int(f) for f in ball.face_adjacency[200]]
    without(ball, one, *two).export(tmp_path / "ball.stl")
    found = check_body(MeshSample(file="ball.stl", unit="um", flat_size_um=900.0).build(tmp_path), has_substrate=True)
    assert (found["n_inner_open_edges"], found["n_open_edges"], found["n_holes"]) == (7, 11, 2)
    large, small = found["holes"]
    assert (large["n_edges"], small["n_edges"]) == (4, 3)
    np.testing.assert_allclose(small["middle_um"], ball.triangles[one].mean(0), atol=1e-3)
    corners = ball.vertices[np.unique(ball.faces[two])]
    np.testing.assert_allclose(large["middle_um"], corners.mean(0), atol=1e-3)
    assert large["size_um"] == pytest.approx(np.ptp(corners, axis=0).max(), abs=1e-3)


def test_holes_that_touch_are_parted(ball):
    """Two missing faces that share one vertex: two holes of three edges. 300 faces at random: all closed.

    Catches one fan over both, which would leave neither surface; and edges that are lost where borders cross.
    """
    first = 77
    around = ball.vertex_faces[ball.faces[first][0]]
    touching = next(f for f in around if f >= 0 and len(set(ball.faces[f]) & set(ball.faces[first])) == 1)
    holes = find_holes(*_open(without(ball, first, int(touching))))
    assert holes.n_edges.tolist() == [3, 3] and holes.is_loop.all()
    some = np.random.default_rng(1).choice(len(ball.faces), 300, replace=False)
    open_ball = without(ball, *some)
    holes = find_holes(*_open(open_ball))
    assert holes.is_loop.all() and holes.n_edges.sum() == len(_open(open_ball)[1])
    mesh = np.asarray(open_ball.vertices), np.asarray(open_ball.faces)
    vertices, faces, _, closed = close_holes(*mesh, np.zeros(len(mesh[1]), int), RADIUS, np.array([0.0, 0.0, 1.0]))
    mended = trimesh.Trimesh(vertices, faces, process=False)
    assert mended.is_watertight and mended.is_winding_consistent and len(closed) == len(holes.size)
    assert mended.volume == pytest.approx(ball.volume, rel=1e-2)


def test_no_ray_leaks_where_a_mesh_stands_on_the_substrate(tmp_path):
    """A box loses its bottom to the substrate: no hole. Catches "rays leak" said of every box on a substrate."""
    trimesh.creation.box((100.0, 100.0, 100.0)).export(tmp_path / "box.stl")
    body = MeshSample(file="box.stl", unit="um", translate_um=(0, 0, 50), flat_size_um=400.0).build(tmp_path)
    assert check_body(body, has_substrate=True)["n_holes"] == 0
    assert check_body(body)["n_holes"] == 1


def test_closed_holes_count_as_the_closed_ball(ball, tmp_path):
    """20 missing faces of a ball, closed: the same surface, and the counts of the closed ball.

    The ratio has a standard error of 0.02 %: a bias of 0.2 % would be rejected. Holes left open, and fans with their
    faces inward, lose every atom that meets them.
    """
    ball.export(tmp_path / "closed.stl")
    without(ball, *facing_up(ball, 20)).export(tmp_path / "open.stl")
    closed = MeshSample(file="closed.stl", unit="um").build(tmp_path)
    with pytest.raises(GuardError, match=r"met a surface from behind.*sample\.close_holes_um"):
        trace(MeshSample(file="open.stl", unit="um").build(tmp_path), seed=1)
    mended = MeshSample(file="open.stl", unit="um", close_holes_um=30.0).build(tmp_path)
    found = check_body(mended)
    assert found["is_watertight"] and found["is_winding_consistent"] and found["n_holes"] == 0
    assert trimesh.Trimesh(mended.vertices, mended.faces, process=False).volume == pytest.approx(ball.volume, rel=1e-6)
    assert_same(trace(mended, seed=1), trace(closed, seed=2), 0.0004)


def test_which_holes_are_closed(ball, tmp_path):
    """Sizes count after unit and scale; a larger hole stays open; new faces have the material beside them.

    Catches a size in the file's unit, and a fan that takes the first material.
    """
    two = [int(f) for f in ball.face_adjacency[200]]
    without(ball, 77, *two).export(tmp_path / "ball.stl")
    between = float(find_holes(*_open(without(ball, 77, *two))).size.mean())
    options = {"file": "ball.stl", "unit": "um", "close_holes_um": between}
    for changes in ({}, {"unit": "mm", "scale": 1e-3}, {"scale": 2.0, "close_holes_um": 2.0 * between}):
        body = MeshSample.model_validate(options | changes).build(tmp_path)
        assert check_body(body)["n_holes"] == 1, changes
    lines = [*(f"v {a} {b} {c}" for a, b, c in ball.vertices), "g low"]
    low = ball.triangles_center[:, 2] < RADIUS
    faces = np.concatenate([ball.faces[low], ball.faces[~low & (np.arange(len(ball.faces)) != facing_up(ball, 1)[0])]])
    lines += [f"f {a} {b} {c}" for a, b, c in faces[: low.sum()] + 1] + ["g high"]
    lines += [f"f {a} {b} {c}" for a, b, c in faces[low.sum() :] + 1]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    body = MeshSample(file="ball.obj", unit="um", materials={"high": "shiny"}, close_holes_um=30.0).build(tmp_path)
    assert [body.materials[i] for i in body.face_material[-3:]] == ["shiny"] * 3
    ball.invert()
    without(ball, 77).export(tmp_path / "inside.stl")
    ball.invert()
    with pytest.raises(InputFileError, match=r"set sample\.flip_normals = true"):
        MeshSample(file="inside.stl", unit="um", close_holes_um=30.0).build(tmp_path)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (20.0, 90.0, 0.0)])
def test_outer_border_and_rim(turn, tmp_path):
    """The border of a sheet with an uneven edge is no hole, whatever its size; the rim of an open cup is one.

    The sheet lacks its corners, as an export of heights may: its border leaves the sides of the bounding box. A box
    without a side has a hole there. Catches a lid below a sheet, a cup that is left open, and an axis of the file taken
    for the vertical.
    """
    back = np.linalg.inv(rotation_matrix(turn))
    n = 7
    x, y = np.meshgrid(10.0 * np.arange(n), 10.0 * np.arange(n))
    points = np.column_stack([x.ravel(), y.ravel(), 2.0 * np.cos(x.ravel())])
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (v.ravel() for v in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    cells = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    corners = np.isin(cells, [at[0, 0], at[0, -1], at[-1, 0], at[-1, -1], at[3, 3]]).any(1)
    cup = trimesh.creation.box((60.0, 60.0, 40.0))
    side = cup.copy()
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    side.update_faces(side.face_normals[:, 0] < 0.5)
    solids = [(f"{name}.stl", solid.vertices, solid.faces) for name, solid in (("cup", cup), ("side", side))]
    for name, vertices, faces in [("sheet.stl", points, cells[~corners]), *solids]:
        trimesh.Trimesh(vertices @ back.T, faces, process=False).export(tmp_path / name)
        sample = MeshSample(file=name, unit="um", rotate_deg=turn)
        assert check_body(sample.build(tmp_path))["n_holes"] == 1
        closed = check_body(sample.model_copy(update={"close_holes_um": 1000.0}).build(tmp_path))
        assert closed["n_holes"] == 0 and closed["is_watertight"] == (name != "sheet.stl")


def _open(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    edges = find_edges(np.asarray(mesh.faces))
    return np.asarray(mesh.vertices), edges.ends[edges.is_open]


def test_two_sided_sheets(tmp_path):
    """A sheet 60 um above the substrate counts as a plate of 0.1 um there; turned over, it counts the same atoms.

    Half of the beam passes beside it, and atoms between sheet and substrate meet its lower side. Catches a face
    that loses what comes from behind, and one that sends it through to the other side: the ratio has a standard error
    of 0.2 %, a bias of 2 % would be rejected.
    """
    corners = np.array([[-50, -50, 60], [50, -50, 60], [50, 50, 60], [-50, 50, 60.0]])
    up = np.array([[0, 1, 2], [0, 2, 3]])
    for name, faces in (("up.stl", up), ("down.stl", up[:, ::-1])):
        trimesh.Trimesh(corners, faces, process=False).export(tmp_path / name)
    thick = trimesh.creation.box((100.0, 100.0, 0.1))
    thick.apply_translation([0.0, 0.0, 60.0])
    thick.export(tmp_path / "thick.stl")

    def build(name: str, **options) -> Body:
        return MeshSample(file=name, unit="um", flat_size_um=2000.0, **options).build(tmp_path)

    with pytest.raises(GuardError, match=r"sample\.two_sided"):
        trace(build("up.stl"), seed=1)
    sheet = build("up.stl", two_sided=True)
    assert check_body(sheet, has_substrate=True)["n_holes"] == 0
    assert check_body(sheet)["n_two_sided_faces"] == 2
    for estimator in ("analog", "expected"):
        turned = trace(build("down.stl", two_sided=True), 1, estimator=estimator)
        np.testing.assert_allclose(trace(sheet, 1, estimator=estimator), turned, rtol=1e-6)
    assert_same(trace(sheet, seed=1), trace(build("thick.stl"), seed=2), 0.004)


def test_validate_says_where_and_what_was_closed(ball, tmp_path):
    """Places, sizes and remedies on the terminal; what was closed is a warning. Catches a silent repair."""
    without(ball, 77).export(tmp_path / "ball.stl")
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    said = CliRunner().invoke(app, ["validate", str(scene)], catch_exceptions=False).output
    place = ", ".join(f"{v:g}" for v in ball.triangles[77].mean(0).round(4))
    assert "rays leak through 1 hole: close them in the mesh, or set sample.close_holes_um" in said
    assert f"middle at {place} um, 3 edges" in said
    line = ["validate", str(scene), "--set", "sample.close_holes_um=40"]
    said = CliRunner().invoke(app, line, catch_exceptions=False).output
    assert "rays leak" not in said and "ball.stl: 1 hole is closed (sample.close_holes_um)" in said
    assert "holes" in CliRunner().invoke(app, ["info", str(tmp_path / "ball.stl")]).output


def test_flat_is_no_hole():
    """A sheet alone has an outer border and no hole."""
    assert check_body(flat_body(100.0))["n_holes"] == 0


def test_validate_names_size_and_faults(ball, tmp_path):
    """One line for a sound mesh, faults in words, and no "ok" where rays leak.

    Catches a verdict that the tracer contradicts, and a fault that is not named.
    """
    (tmp_path / "scene.toml").write_text(SCENE)
    for missing, ends in (
        ((), "ok, a scene (21 x 21 pixels, 1 detector)"),
        ((77,), "of the rays leak through its mesh"),
    ):
        without(ball, *missing).export(tmp_path / "ball.stl")
        done = CliRunner().invoke(app, ["validate", str(tmp_path / "scene.toml")], catch_exceptions=False)
        lines = done.stdout.splitlines()
        assert done.exit_code == 0 and lines[-1].endswith(ends)
        assert sum("triangles; 900 x 900 x 200 um, z from 0 to 200 um" in line for line in lines) == 1
    sound = check_body(MeshSample(file="ball.stl", unit="um").build(tmp_path))
    faults = sound | {"is_inside_out": True, "is_winding_consistent": False, "n_duplicate_faces": 3}
    assert len(body_lines(sound, "")) == 1 and body_lines(faults, "")[1:] == [
        "inside out: set sample.flip_normals = true",
        "neighbouring triangles face opposite ways: repair the mesh",
        "triangles that are there twice: 3",
    ]
