"""Lines, lists of positions, and several views of a sample: distances, rotations of the sample or of the detectors."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.hdf5 import read, write
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.trace.direct import form_factors
from helio_jax.trace.job import Job
from helio_jax.trace.units import trace_unit
from helio_jax.workflows.pipeline import Executor, SimulateOptions, reconstruct, run, simulate, simulate_file
from helio_jax.workflows.scene_file import load_scene

SCENE = """
[plate]
working_distance_um = 4000.0
[beam]
incidence_deg = 30.0
source = "pencil"
pinhole_radius_um = 0.0
[[detector]]
name = "ellipse"
center_um = [2300.0, 300.0]
axes_um = [1400.0, 1000.0]
rotation_deg = 25.0
[[detector]]
name = "cone"
polar_deg = 35.0
azimuth_deg = 120.0
half_angle_deg = 9.0
[sample]
{sample}
[trace]
rays = 16
maps = false
[scan]
"""
FLAT = 'kind = "flat"\n'
CAP = 'kind = "spheres"\nspheres = [{radius_um = 500.0, cap_height_um = 300.0, center_um = [100.0, 40.0]}]\n'
FACET = 'kind = "step"\nheight_um = 600.0\nslope_deg = 25.0\nposition_um = -600.0\nfacing_deg = 20.0\n'
RASTER = "nx = 5\nny = 3\npixel_size_um = 110.0\npitch = 'sample'\ncenter_um = [50.0, 20.0]\n"
ONE = "nx = 1\nny = 1\npixel_size_um = 10.0\n"


def scene_of(folder, sample, scan, **overrides):
    (folder / "scene.toml").write_text(SCENE.format(sample=sample) + scan)
    return load_scene(folder / "scene.toml", {key.replace("__", "."): value for key, value in overrides.items()})


def views_of(scene) -> tuple[MicrographStack, ...]:
    found = simulate(scene)
    assert isinstance(found, MicrographSet)
    return found.stacks


def single_probability(stack: MicrographStack) -> np.ndarray:
    """Detection probability of the only pixel by single scattering [detector]."""
    return stack.by_order[0, :, 0, 0] / stack.n_rays


def test_lines_and_lists_are_rasters_in_other_words(tmp_path):
    """A line and a list of the same positions give the raster's very bits; a list keeps its positions in its file.

    Catches x and y exchanged, positions numbered by column, and a line that is off by half a step.
    """
    raster = simulate(scene_of(tmp_path, CAP, RASTER))
    row = simulate(scene_of(tmp_path, CAP, RASTER, scan__ny=1))
    line = simulate(
        scene_of(tmp_path, CAP, "kind = 'line'\nalong = 'x'\nn = 5\nstep_um = 110.0\ncenter_um = [50, 20]\n")
    )
    assert np.array_equal(line.counts, row.counts) and np.array_equal(line.x, row.x)
    column = simulate(scene_of(tmp_path, CAP, "kind = 'line'\nalong = 'y'\nn = 4\nstep_um = 25.0\n"))
    assert column.shape == (2, 4, 1) and np.array_equal(column.y, [-37.5, -12.5, 12.5, 37.5])
    points = np.stack([a.ravel() for a in np.meshgrid(raster.x, raster.y)], -1)
    np.savetxt(tmp_path / "points.csv", points, delimiter=",", header="x_um,y_um", comments="", fmt="%.17g")
    listed = simulate(scene_of(tmp_path, CAP, "kind = 'list'\nfile = 'points.csv'\n"))
    assert np.array_equal(listed.counts.reshape(raster.shape), raster.counts) and listed.shape == (2, 1, 15)
    write(listed, tmp_path / "list.h5")
    assert np.array_equal(read(tmp_path / "list.h5").positions, points) and raster.positions is None
    inline = simulate(scene_of(tmp_path, CAP, f"kind = 'list'\npoints_um = {points.tolist()}\n"))
    assert np.array_equal(inline.counts, listed.counts)
    with pytest.raises(InputFileError, match="heights need a raster, this scan is a list of 15 positions"):
        reconstruct(listed)


@pytest.mark.parametrize("scan", [ONE + "sample_distances_um = [3000.0, 5000.0]\n", "kind = 'line'\nalong = 'beam'\n"])
def test_distances(tmp_path, scan):
    """Single scattering off a flat at each distance is its form factor at the point the beam meets, to 1e-6.

    Catches a distance that moves the plate but not the spot under the oblique beam, and views in another order.
    """
    distances = [3000.0, 5000.0] if "distances" in scan else [3960.0, 3980.0, 4000.0, 4020.0, 4040.0]
    scan = scan if "distances" in scan else scan + "n = 5\nstep_um = 20.0\n"
    views = views_of(scene_of(tmp_path, FLAT, scan))
    assert [v.instrument.sample_distance for v in views] == distances
    for view, distance in zip(views, distances, strict=True):
        drop = distance - 4000.0
        spot = np.array([[drop * math.tan(math.radians(30.0)), 0.0, -drop]])
        np.testing.assert_allclose(single_probability(view), form_factors(view.instrument, spot)[:, 0, 2], rtol=1e-6)
        assert f"{distance:g} um" in view.name and view.provenance["view"]["sample_distance_um"] == distance


def test_rotation_of_sample_and_detectors(tmp_path):
    """A facet's single scattering is n . Phi with its normal turned, or with the apertures turned the other way.

    To 1e-6. Catches clockwise rotations, an ellipse moved but not turned, and a beam that turns along.
    """
    a, b = math.radians(25.0), math.radians(20.0)
    normal = np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])
    beam = {"beam__incidence_deg": 0.0}
    scene = scene_of(tmp_path, FACET, ONE + "rotations_deg = [0.0, 72.0, -30.0]\n", **beam)
    height = float(simulate_height(scene))
    for view, angle in zip(views_of(scene), (0.0, 72.0, -30.0), strict=True):
        turned = Rotation.from_euler("z", angle, degrees=True).apply(normal)
        phi = form_factors(view.instrument, np.array([[0.0, 0.0, height]]))[:, 0]
        np.testing.assert_allclose(single_probability(view), phi @ turned, rtol=1e-6)
        assert view.sample_rotation == pytest.approx(math.radians(angle))
    scan = ONE + "rotations_deg = [-72.0]\nrotate = 'detectors'\n"
    other = simulate(scene_of(tmp_path, FACET, scan, **beam))
    np.testing.assert_allclose(single_probability(other), single_probability(views_of(scene)[1]), rtol=1e-6)
    assert other.sample_rotation == 0.0 and other.instrument.detector[1].azimuth_deg == pytest.approx(48.0)


def simulate_height(scene) -> np.ndarray:
    """Height of the facet at the origin, where it passes whatever its rotation."""
    from helio_jax.trace.intersect import Intersector
    from helio_jax.trace.run import first_hits

    return first_hits(Intersector(scene.build_body()), scene.instrument, np.zeros(1), np.zeros(1)).point[0, 2]


def test_rotation_about_an_oblique_beam(tmp_path):
    """A flat turned about the beam tilts: n . Phi with the normal turned about the axis from the spot to the source.

    To 1e-6. Catches a rotation about the plate normal, about the beam's own direction (clockwise), and about its foot.
    """
    scene = scene_of(tmp_path, FLAT, ONE + "rotations_deg = [10.0, -25.0]\nabout = 'beam'\n")
    for view, angle in zip(views_of(scene), (10.0, -25.0), strict=True):
        to_source = np.array([-math.sin(math.radians(30.0)), 0.0, math.cos(math.radians(30.0))])
        normal = Rotation.from_rotvec(math.radians(angle) * to_source).apply([0.0, 0.0, 1.0])
        phi = form_factors(view.instrument, np.zeros((1, 3)))[:, 0]
        np.testing.assert_allclose(single_probability(view), phi @ normal, rtol=1e-6)


def test_axis_of_rotation(tmp_path):
    """A sphere turns about the given axis. Catches the axis subtracted twice or with the wrong sign."""
    scan = ONE + "rotations_deg = [90.0]\naxis_um = [100.0, -50.0]\n"
    scene = scene_of(tmp_path, CAP, scan)
    (view,) = scene.views()
    np.testing.assert_allclose(view.rotated_body(scene.build_body()).spheres, [[10.0, -50.0, -200.0, 500.0]], atol=1e-9)


def test_views_in_units_shards_and_files(tmp_path):
    """Distances times rotations, by threads, by shards and unit by unit: the same bits, read back from one file too.

    Catches units across two views, a unit traced in the instrument of the first view, and views with the same noise.
    """
    scan = RASTER + "rotations_deg = [0.0, 40.0]\nsample_distances_um = [4000.0, 4400.0]\n"
    scene = scene_of(tmp_path, CAP, scan, trace__paths_per_unit=16 * 8 * 7)
    whole = simulate(scene)
    assert isinstance(whole, MicrographSet) and len(whole.stacks) == 4
    assert [v.provenance["view"]["sample_distance_um"] for v in whole.stacks] == [4000.0, 4400.0] * 2
    job = Job.of(scene, scene.trace, scene.build_body())
    cut = job.units()
    assert [(u.start, u.stop) for u in cut[:4]] == [(0, 7), (7, 14), (14, 15), (15, 22)] and len(cut) == 12
    unit_result = trace_unit(job, cut[10])
    counts = whole.stacks[3].counts.reshape(2, -1)[:, 7:14]
    assert np.array_equal(np.maximum(unit_result.total, 0.0) * scene.scan.atoms_per_pixel, counts)
    overrides = {"trace.paths_per_unit": 16 * 8 * 7}
    for shard in ("2/2", "1/2"):
        options = SimulateOptions(shard=shard, executor=Executor(1))
        simulate_file(tmp_path / "scene.toml", tmp_path / "set.h5", overrides=overrides, options=options)
    back = read(tmp_path / "set.h5")
    assert isinstance(back, MicrographSet)
    for ours, theirs in zip(whole.stacks, back.stacks, strict=True):
        assert np.array_equal(ours.counts, theirs.counts) and ours.instrument == theirs.instrument
        assert ours.sample_rotation == theirs.sample_rotation and ours.name == theirs.name
    first = simulate(scene_of(tmp_path, CAP, RASTER))
    assert np.array_equal(first.counts, whole.stacks[0].counts)
    still = scene_of(tmp_path, CAP, RASTER + "rotations_deg = [0.0, 0.0]\n")
    assert not np.array_equal(*(v.counts for v in views_of(still)))


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (ONE + "rotations_deg = [5.0]\nrotate = 'detectors'\nabout = 'beam'\n", "scan.about: detectors in the plate"),
        ("kind = 'list'\n", "either file or points_um"),
        ("kind = 'line'\nalong = 'z'\nn = 3\nstep_um = 1.0\n", "must be one of 'x', 'y' or 'beam'"),
        ("kind = 'line'\nalong = 'beam'\nn = 3\nstep_um = 1.0\nsample_distances_um = [1.0]\n", "remove them"),
        ("kind = 'liste'\n", "did you mean 'list'"),
        ("nx = 5\nny = 3\npixl_size_um = 2.0\n", r"scan.pixl_size_um.*did you mean 'pixel_size_um'"),
    ],
)
def test_wrong_scans_say_so(tmp_path, scan, message):
    """Every error names its place and the remedy, without `kind` too. Catches tags in the path of an error."""
    with pytest.raises(SceneError, match=message):
        scene_of(tmp_path, FLAT, scan)


def test_wrong_files_and_uses_say_so(tmp_path):
    """A list that is none, a view in which the sample touches the plate, and heights asked of several views."""
    (tmp_path / "points.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputFileError, match=r"points.csv: is not a list of positions"):
        simulate(scene_of(tmp_path, FLAT, "kind = 'list'\nfile = 'points.csv'\n"))
    (tmp_path / "points.csv").write_text("1,2,3\n")
    with pytest.raises(InputFileError, match="two finite numbers"):
        simulate(scene_of(tmp_path, FLAT, "kind = 'list'\nfile = 'points.csv'\n"))
    with pytest.raises(SceneError, match="in the view '100 um' the sample's top at 300 um touches the plate"):
        simulate(scene_of(tmp_path, CAP, ONE + "sample_distances_um = [4000.0, 100.0]\n"))
    wanted = {
        "sample_distances_um = [5000.0, 6000.0]": "heights come from rasters at one distance",
        "rotations_deg = [0.0, 90.0]\nrotate = 'detectors'": "need a sample that rotates about the plate normal",
    }
    for scan, message in wanted.items():
        scene_of(tmp_path, CAP, ONE + scan + "\n")
        with pytest.raises(SceneError, match=message):
            run(tmp_path / "scene.toml", tmp_path / "out")
    scene_of(tmp_path, CAP, ONE + "rotations_deg = [0.0, 90.0]\n")
    with pytest.raises(InputFileError, match=r"need rasters of 2 x 2 or more pixels, .* has 1 x 1"):
        run(tmp_path / "scene.toml", tmp_path / "out")
