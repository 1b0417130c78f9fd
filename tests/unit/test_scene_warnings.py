"""Probable mistakes that show when the sample is built; mirrored and inside-out meshes."""

import numpy as np
import pytest
import trimesh

from helio_jax.errors import InputFileError
from helio_jax.instrument import Beam
from helio_jax.scene.sample import MeshSample
from helio_jax.scene.scan import Raster
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.scene_warnings import scene_warnings

SCENE = """
[plate]
working_distance_um = 3000.0
[[detector]]
name = "a"
polar_deg = 40.0
half_angle_deg = 10.0
[sample]
kind = "mesh"
file = "wedge.stl"
unit = "um"
flat_size_um = 2000.0
[scan]
nx = 21
ny = 21
pixel_size_um = 20.0
"""
CORNERS = np.array([[0, 0, 0], [300, 0, 0], [0, 100, 0], [0, 0, 60.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
"""A corner of a box, outside out: unlike its mirror image."""


@pytest.fixture
def scene(tmp_path):
    """A scene of a wedge of 300 x 100 x 60 um on a substrate, 400 um of it in the raster."""
    trimesh.Trimesh(CORNERS, FACES, process=False).export(tmp_path / "wedge.stl")
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path / "scene.toml"


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        ({}, None),
        ({"sample.unit": "nm"}, "structure is 0.3 um across, less than a pixel (20 um)"),
        ({"sample.scale": 0.5, "scan.nx": 99, "scan.pixel_size_um": 90.0}, "less than 5% of the raster"),
        ({"sample.flat_size_um": None, "scan.center_um": [5000.0, 0.0]}, "meets the sample at none of the beam"),
        ({"scan.center_um": [1010.0, 0.0]}, "meets the sample at only 47.6% of the beam positions"),
        (
            {"scan.center_um": [600.0, 300.0]},
            "the beam meets only the substrate, not what stands on it (0 to 60 um high)",
        ),
        ({"trace.estimator": "analog"}, "the analog estimator counts these 256 atoms per pixel"),
        ({"trace.estimator": "analog", "trace.rays": 35_000}, None),
    ],
)
def test_probable_mistakes(scene, overrides, told):
    """A wrong unit, a beam that misses (10 of 21 columns lie on the substrate), analog rays; right scenes say nothing.

    Catches a flat picture without a word, and a warning of every scene.
    """
    loaded = load_scene(scene, overrides)
    found = scene_warnings(loaded, loaded.build_body())
    assert any(told in text for text in found) if told else not found, found


def test_mirror_and_flip(scene):
    """The volume (1/6 of the box) stays positive, the long side points to -x; an inside-out file needs flip_normals.

    Catches a mirrored mesh whose faces look inward, a flip of the coordinates, and the wrong axis.
    """
    folder = scene.parent

    def solid(file: str = "wedge.stl", **options) -> trimesh.Trimesh:
        body = MeshSample(file=file, unit="um", **options).build(folder)
        return trimesh.Trimesh(body.vertices, body.faces, process=False)

    plain, mirrored = solid(), solid(mirror="x")
    assert plain.volume == pytest.approx(300 * 100 * 60 / 6) == mirrored.volume
    np.testing.assert_allclose(mirrored.bounds, [[-300, 0, 0], [0, 100, 60]])
    np.testing.assert_allclose(solid(mirror="y").bounds, [[0, -100, 0], [300, 0, 60]])
    trimesh.Trimesh(CORNERS, FACES[:, ::-1], process=False).export(folder / "inside.stl")
    with pytest.raises(InputFileError, match=r"set sample\.flip_normals = true"):
        solid("inside.stl")
    found = solid("inside.stl", flip_normals=True)
    assert found.volume == pytest.approx(plain.volume)
    np.testing.assert_allclose(found.bounds, plain.bounds)
    with pytest.raises(InputFileError, match=r"set sample\.flip_normals = false"):
        solid(flip_normals=True)


def test_pitch_of_rows():
    """Rows 7 um apart, columns 5 um across the beam, 5 / cos 60 on the sample; with the beam along y the rows stretch.

    Catches a pitch that is stretched along the wrong axis, or one for both.
    """
    scan = Raster(nx=3, ny=2, pixel_size_um=5.0, pixel_size_y_um=7.0)
    for azimuth, steps in ((0.0, (10.0, 7.0)), (90.0, (5.0, 14.0))):
        x, y = scan.positions(Beam(incidence_deg=60.0, azimuth_deg=azimuth))
        np.testing.assert_allclose([*np.diff(x), *np.diff(y)], [steps[0], steps[0], steps[1]])
    assert scan.spacing == 5.0 and Raster(nx=3, ny=2, pixel_size_um=5.0).positions(Beam())[1][1] == 2.5
