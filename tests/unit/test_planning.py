"""Planning of acquisitions: times, field after rotation, rotation centre, candidates; closed forms, then files."""

import json
import math
from typing import Any

import numpy as np
import pytest
import scipy.io
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from benchmarks.plan import times_and_speed_ups, windows_row
from helio_jax.commands.app import app
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.formats import matlab
from helio_jax.formats.acquisition import read_acquisitions
from helio_jax.planning.coverage import rotation_matrices, scans_per_pixel, shifts_about
from helio_jax.planning.stage import find_rotation_center
from helio_jax.planning.timing import Timing, measure_move, scans_needed, seconds_per_height
from helio_jax.workflows import plan as planning
from helio_jax.workflows.scene_file import SceneFile, load_scene

SCENE = """
[beam]
incidence_deg = 0.0
[plate]
working_distance_um = 3000.0
[[detector]]
name = "d"
polar_deg = 40.0
azimuth_deg = 10.0
half_angle_deg = 8.0
[sample]
kind = "flat"
size_um = 4000.0
[scan]
nx = 20
ny = 10
pixel_size_um = 30.0
atoms_per_pixel = 1e5
[noise]
dwell_s = 0.5
move_s = 0.2
flyback_s = 3.0
background_per_pixel = 40.0
"""


@pytest.fixture
def scene(tmp_path) -> SceneFile:
    """One detector above a flat sample, 20 x 10 pixels."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return load_scene(path)


def test_time_and_its_inverse():
    """3 scans of 5 lines of 7 pixels: 3 * 5 * (7 * 1.5 + 2) + 2 * 60 s. The move is what dwell and pause leave.

    Catches a time counted per pixel instead of per line, a change after the last scan, and a forgotten pause.
    """
    timing = Timing(1.0, 0.2, 0.3, flyback=2.0, change=60.0)
    assert timing.seconds(5, 7, 3) == pytest.approx(307.5)
    assert timing.at_dwell(2.0).seconds(5, 7) == pytest.approx(97.5)
    assert measure_move(52.5, 35, 1.0, 0.2) == pytest.approx(0.3)
    assert [scans_needed(n, 3) for n in (1, 3, 4)] == [1, 1, 2]
    assert seconds_per_height(60.0, 20, 0.75) == pytest.approx(4.0)
    with pytest.raises(InputFileError, match="42 s or more, got a scan of 40 s"):
        measure_move(40.0, 35, 1.0, 0.2)
    with pytest.raises(SceneError, match="pause must be a finite time >= 0 s, got -1"):
        Timing(1.0, -1.0)


@pytest.mark.parametrize(("n", "sides"), [(3, 12), (4, 4), (5, 20)])
def test_centred_squares_leave_a_regular_polygon(n, sides):
    """n squares rotated evenly about their centre share a regular polygon of inradius a / 2: sides / 4 tan(pi / sides).

    401 x 401 points know the area to 1e-3. Catches a window of the wrong size (half a pixel: 0.5 %) or shape.
    """
    axis = (np.arange(401) - 200.0) / 401
    angles = np.arange(n) * 2 * np.pi / n
    seen = np.mean(scans_per_pixel(axis, axis, angles, np.zeros((n, 2))) == n)
    assert seen == pytest.approx(0.25 * sides * math.tan(math.pi / sides), abs=1e-3)


def test_field_after_rotation_about_another_point():
    """By 180 deg about (d, 0): a window of half-width b keeps 1 - d / b. By +90 deg, a square: x, y >= d - b.

    There s = (d - y, x - d) must lie in the window. Catches a rotation about the centre of the window, a clockwise one
    (which keeps y <= b - d), and a shift of the wrong sign.
    """
    x, y = np.arange(100) - 49.5, np.arange(40) - 19.5
    angles = np.array([0.0, np.pi])
    count = scans_per_pixel(x, y, angles, shifts_about((10.0, 0.0), angles))
    assert np.mean(count == 2) == pytest.approx(1.0 - 10.0 / 50.0)
    angles = np.array([0.0, 0.5 * np.pi])
    both = scans_per_pixel(x, x, angles, shifts_about((10.0, 0.0), angles)) == 2
    assert np.array_equal(both, (x >= 10.0 - 50.0) & (x >= 10.0 - 50.0)[:, None])


def stage(rotations: np.ndarray, noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the stage positions of three points of a sample [view, point, 2], and those of a fourth [view, 2], um."""
    rng = np.random.default_rng(seed)
    points = np.array([[1700.0, -300.0], [1500.0, 400.0], [2100.0, 100.0], [1650.0, 50.0]])
    seen = np.array([-4000.0, 370.0]) + np.einsum("vij,pj->vpi", rotation_matrices(rotations), points)
    return seen[:, :3] + noise * rng.standard_normal((len(rotations), 3, 2)), seen[:, 3]


def test_rotation_center_and_windows():
    """Two exact scans give the centre and predict where a fourth point is at other rotations; one point suffices.

    Catches rotations of the wrong sense, and windows about the origin of the stage.
    """
    rotations = np.radians([0.0, 72.0])
    seen, fourth = stage(rotations)
    for n_points in (3, 1):
        found = find_rotation_center(seen[:, :n_points], rotations)
        assert found.center == pytest.approx((-4000.0, 370.0), abs=1e-6) and found.n_points == n_points
        others = np.radians([-110.0, 31.0])
        assert np.allclose(found.windows(fourth[1], rotations[1], others), stage(others)[1], atol=1e-6)
    with pytest.raises(GuardError, match="reverse the sign of the rotations"):
        find_rotation_center(seen, -rotations)
    for alone in (np.where(np.eye(2)[:, :2, None] > 0, seen[:, :2], np.nan), seen):
        same = rotations if alone is not seen else np.zeros(2)
        with pytest.raises(InputFileError, match="seen at two rotations"):
            find_rotation_center(alone, same)


def test_error_of_the_rotation_center():
    """Points picked to 20 um: the mean square error of the centre is the mean of the stated variances.

    800 draws, 1600 coordinates: known to sqrt(2 / 1600) = 3.5 %, the stated one to sqrt(2 / 10 / 800) = 1.6 %; within 6
    of both, 23 %. Rejects a standard deviation that is wrong by a factor of 1.25, and residuals over all numbers (18)
    instead of the degrees of freedom (10).
    """
    rotations = np.radians([0.0, 72.0, 144.0])
    found = [find_rotation_center(stage(rotations, 20.0, seed)[0], rotations) for seed in range(800)]
    errors = np.array([np.subtract(f.center, (-4000.0, 370.0)) for f in found])
    assert np.mean(errors**2) / np.mean([f.std**2 for f in found]) == pytest.approx(1.0, abs=0.23)
    assert np.mean([f.residual**2 for f in found]) == pytest.approx(400.0, rel=0.1)


@pytest.fixture
def without_child(monkeypatch):
    """Read .mat files in this process, which is fast."""
    monkeypatch.setattr(matlab, "call_in_child", lambda name, path, **_: matlab.load_tree(path))


@pytest.fixture
def scanned(tmp_path, without_child):
    """A made A-SHeM file of 21 x 11 pixels."""

    def make(name: str, **changes):
        scan = {
            "image": np.ones((11, 21)),
            "hori_range": np.array([-500.0, -900.0]) * 1e3,
            "vert_range": np.array([300.0, 100.0]) * 1e3,
            "hori_res": 20e3,
            "vert_res": 20e3,
            "sampling_period": 15,
            "N_dwell": 40,
            "sample_orientation": np.array([0.0, -72e6, 0.0]),
            "scan_time": 231 * 1.1,
            "inputs": np.array(["pause", 0.25], object),
        } | changes
        path = tmp_path / f"{name}.mat"
        scipy.io.savemat(path, {"meas_list": {k: v for k, v in scan.items() if v is not None}})
        return path

    return make


def test_acquisition_of_a_file(scanned):
    """Times, window in the frame of the imported stack (x = hori, y = -vert), rotation.

    Catches milliseconds, a dwell in samples, swapped lines and columns, and a stage axis of the wrong sign.
    """
    (found,) = read_acquisitions(scanned("a"))
    assert (found.n_lines, found.n_per_line, found.dwell, found.pause) == (11, 21, 0.6, 0.25)
    assert found.center == (-700.0, -200.0) and found.size == (400.0, 200.0) and found.axes == ("+hori", "-vert")
    assert math.degrees(found.rotation) == pytest.approx(-72.0)
    assert planning.measured_timing(scanned("a")).move == pytest.approx(0.25)
    with pytest.raises(InputFileError, match="states no duration"):
        planning.measured_timing(scanned("b", scan_time=None))
    for changes in ({"inputs": np.array(["pause", "x"], object)}, {"hori_range": np.zeros(3)}, {"N_dwell": 0}):
        with pytest.raises(InputFileError, match="must be"):
            read_acquisitions(scanned("c", **changes))


def test_windows_command(scanned, tmp_path):
    """A point 400 um from the axis in two made files: the centre, and the window for the picked point at 180 deg.

    The axis is at the stage position hori = -700, vert = 200 um: windows there do not move. Catches a stage axis of the
    wrong sign in the output, and picks that are not added to the centre of the window.
    """
    files = [scanned("a", sample_orientation=np.zeros(3)), scanned("b", sample_orientation=np.array([0, 90e6, 0]))]
    (tmp_path / "p.csv").write_text("view,point,x_um,y_um\na,A,150,0\nb,A,0,150\na,B,0,50\nb,B,-50,0\n")
    line = ["plan-windows", *map(str, files), "--points", str(tmp_path / "p.csv"), "--rotations", "0,180"]
    done = CliRunner().invoke(app, [*line, "--center", "150", "10", "-o", str(tmp_path / "w.csv"), "--json"])
    record = json.loads(done.stdout)
    assert record["rotation_center"]["center"] == pytest.approx([-700.0, -200.0])
    first, opposite = record["windows"]
    assert (first["hori_center_um"], first["vert_center_um"]) == pytest.approx((-550.0, 190.0))
    assert (opposite["hori_low_um"], opposite["vert_high_um"]) == pytest.approx((-1050.0, 310.0))
    assert (tmp_path / "w.csv").read_text().splitlines()[0].startswith("rotation_deg,hori_center_um,hori_low_um")


def by_law(monkeypatch, errors: list[SceneFile]) -> None:
    """Let the errors follow a law: 3 um at 1 s and 30 um pixels, with the root of dwell, pixel area and images."""

    def expect(scene: SceneFile, n_samples: int) -> planning.Expected:
        errors.append(scene)
        shape, dwell, pixel = scene.image_shape, scene.noise.dwell_s, scene.scan.spacing
        assert dwell and pixel
        std = 3.0 * (30.0 / pixel) * math.sqrt(3.0 / len(scene.detector) / dwell)
        samples = std * np.random.default_rng(0).standard_normal((n_samples, *shape))
        return planning.Expected(np.zeros(shape), samples, np.ones(3))

    monkeypatch.setattr(planning, "expect", expect)


def test_fastest_candidate(scene, monkeypatch):
    """Errors that fall with 1 / sqrt(dwell): 2 um takes (3 / 2)^2 s with 3 images of 30 um pixels, 6 images half of it.

    Four times the area of a pixel a quarter. Then the fastest is known; the interpolation is exact for a power law.
    Catches an interpolation that is linear, a sort by error, and times with the wrong dwell.
    """
    by_law(monkeypatch, [])
    views = [(0, 120, 240), (0, 60, 120, 180, 240, 300)]
    found = planning.plan(
        scene, dwell_s=[8, 0.125], pixel_size_um=[30.0, 60.0], rotations_deg=views, wanted_um=2.0, n_samples=400
    )
    assert len(found.candidates) == 8 and [c.dwell_s for c in found.curves[0]] == [0.125, 8]
    dwells = {(c.n_images, c.pixel_size_um): c.dwell_s for c in found.reaching}
    assert dwells == pytest.approx({(3, 30.0): 2.25, (6, 30.0): 1.125, (3, 60.0): 0.5625, (6, 60.0): 0.28125}, rel=0.03)
    c = found.chosen
    assert (c.n_images, c.pixel_size_um, c.shape) == (3, 60.0, (5, 10))
    assert c.seconds == pytest.approx(3 * 5 * (10 * (c.dwell_s + 0.2) + 3.0))
    unreached = planning.plan(scene, dwell_s=[0.1], rotations_deg=views[:1], wanted_um=0.01)
    assert unreached.reaching == () and unreached.chosen is unreached.candidates[0]
    json.dumps(found.as_dict(), allow_nan=False)


def test_candidate_as_one_scan(scene, monkeypatch):
    """Rotations of the sample become detectors rotated the other way; counts and background go with the dwell.

    A sample rotated by +90 deg sees the detector at 10 deg from -80 deg. Catches the wrong sign, a background that
    stays, and a field that pixels change.
    """
    scenes: list[SceneFile] = []
    by_law(monkeypatch, scenes)
    (c,) = planning.plan(scene, dwell_s=[2.0], pixel_size_um=[15.0], rotations_deg=[(0, 90, 180)]).candidates
    (one,) = scenes
    assert [d.azimuth_deg for d in one.detector] == pytest.approx([10.0, -80.0, -170.0])
    assert len({d.name for d in one.detector}) == 3
    assert one.scan.atoms_per_pixel == 4e5 and one.noise.background_per_pixel == (160.0,) * 3
    assert one.image_shape == (20, 40) == c.shape and c.seen_by_all == pytest.approx(0.5)  # of 600 x 300 um
    fixed = scene.model_copy(update={"scan": scene.scan.model_copy(update={"rotate": "detectors"})})
    (c,) = planning.plan(fixed, rotations_deg=[(0, 90, 180)]).candidates
    assert [d.azimuth_deg for d in scenes[-1].detector] == pytest.approx([10.0, 100.0, -170.0])
    assert c.seen_by_all == 1.0


def test_speed_up_of_several_detectors(scene, monkeypatch):
    """Four detectors over one that sees half of a 2 : 1 field in all of four rotations: 4 / 0.5; rotating takes time t.

    Then (4 t + 3 t) / t / 0.5. One detector that does just that has 1. Catches a share on the wrong side of the ratio.
    """
    by_law(monkeypatch, [])
    d = scene.detector[0]
    many = tuple(d.model_copy(update={"name": f"d{k}", "azimuth_deg": 90.0 * k}) for k in range(4))
    (c,) = planning.plan(scene.model_copy(update={"detector": many})).candidates
    assert c.speed_up == pytest.approx(4.0 / 0.5)
    slow = Timing(0.5, 0.0, 0.2, 3.0, change=c.seconds)
    (c,) = planning.plan(scene.model_copy(update={"detector": many}), timing=slow).candidates
    assert c.speed_up == pytest.approx(7.0 / 0.5)
    (c,) = planning.plan(scene, rotations_deg=[(0, 90, 180, 270)]).candidates
    assert c.speed_up == pytest.approx(1.0) and c.seen_by_all == pytest.approx(0.5)


def test_refusals(scene):
    """Each says what is missing. Catches a plan for two images, and one that takes the counts for those of 1 s."""
    timeless = scene.model_copy(update={"noise": scene.noise.model_copy(update={"dwell_s": None})})
    oblique = scene.model_copy(update={"beam": scene.beam.model_copy(update={"incidence_deg": 30.0})})
    cases: tuple[tuple[SceneFile, dict[str, Any], str], ...] = (
        (timeless, {}, "noise.dwell_s is needed"),
        (scene, {}, "3 images or more, got 1 scans of 1 detectors"),
        (oblique, {"rotations_deg": [(0, 120, 240)]}, "normal incidence, got a beam at 30 deg"),
        (scene, {"dwell_s": [0.0]}, "every dwell of a plan must be > 0, got 0"),
        (scene, {"wanted_um": 0.0}, "every error of a plan must be > 0, got 0"),
        (scene, {"rotations_deg": [(0, 120, 360)]}, "must differ, got .0, 120, 360. deg"),
        (scene, {"rotations_deg": [(0, 1, 2)], "pixel_size_um": [0.01]}, "nx \\* ny must be <= 16777216 pixels"),
    )
    for wrong, options, message in cases:
        with pytest.raises(SceneError, match=message):
            planning.plan(wrong, **options)


def test_measured_acquisitions(shared, monkeypatch, without_child):
    """One file of each instrument predicts the times of the others and the speed-ups within 1 %.

    Two scans of the crystal predict where its points are in the other three within 5 % of the window (2 mm). Catches a
    frame of the stage that differs from that of the images: then points miss by millimetres.
    """
    monkeypatch.setattr("benchmarks.plan.DATA", shared / "data")
    rows = times_and_speed_ups()
    assert [r["row"] for r in rows] == ["1"] * 3 + ["2"] * 5 and all(r["reached"] for r in rows)
    assert float(str(windows_row()["value"]).split()[0]) < 100.0
