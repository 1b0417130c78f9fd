"""Placement of samples: one mechanism for all kinds, a distance by the sample's top, a reconstruction as sample."""

import numpy as np
import pytest
from stats import assert_likely

from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.hdf5 import write
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.surfaces import first_hit_spheres
from helio_jax.workflows.pipeline import simulate
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.truth import true_height

SCENE = """
[plate]
working_distance_um = 4000.0
{plate}
[beam]
incidence_deg = 30.0
[[detector]]
name = "a"
polar_deg = 35.0
azimuth_deg = 0.0
half_angle_deg = 9.0
[[detector]]
name = "b"
polar_deg = 35.0
azimuth_deg = 120.0
half_angle_deg = 9.0
[sample]
{sample}
[scan]
nx = 6
ny = 5
pixel_size_um = 150.0
[trace]
rays = 64
maps = false
"""
CAP = 'kind = "spheres"\nspheres = [{radius_um = 500.0, cap_height_um = 300.0}]\n'
STEP = 'kind = "step"\nsize_um = 900.0\nheight_um = 100.0\nposition_um = 30.0\n'


def scene_of(folder, sample, plate="", **overrides):
    (folder / "scene.toml").write_text(SCENE.format(sample=sample, plate=plate))
    return load_scene(folder / "scene.toml", {key.replace("__", "."): value for key, value in overrides.items()})


def z_scores(a, b):
    """Differences of two stacks' counts over their standard errors, and the p-value of the largest, Sidak-corrected."""
    from scipy.stats import norm

    z = (a.counts - b.counts) / np.sqrt(a.variance + b.variance + 1e-12 * a.counts**2)
    return float(-np.expm1(z.size * np.log1p(-2 * norm.sf(np.abs(z).max()))))


@pytest.mark.parametrize("sample", [CAP, STEP])
def test_any_sample_is_scaled_turned_and_moved(tmp_path, sample):
    """Triangles and exact spheres alike: scaled about the origin, then rotated about x, y, z, then shifted.

    Catches a radius that is not scaled, spheres left behind, and another order (translation first).
    """
    plain = scene_of(tmp_path, sample).build_body()
    keys = "scale = 2.0\nrotate_deg = [90, 0, 90]\ntranslate_um = [10, 20, -9000]\n"
    placed = scene_of(tmp_path, sample + keys).build_body()
    # about x by 90: (x, -z, y); then about z by 90: (z, x, y)
    np.testing.assert_allclose(placed.vertices, 2 * plain.vertices[:, [2, 0, 1]] + [10, 20, -9000], atol=1e-9)
    centers, radii = plain.spheres[:, :3], plain.spheres[:, 3:]
    expected = np.hstack([2 * centers[:, [2, 0, 1]] + [10, 20, -9000], 2 * radii])
    np.testing.assert_allclose(placed.spheres, expected, atol=1e-9)
    assert np.array_equal(scene_of(tmp_path, sample + "scale = 1.0\n").build_body().vertices, plain.vertices)


def test_place_does_not_matter(tmp_path):
    """A sphere 10 m off the origin, found there by the scan, and one drawn at a thousandth and scaled up: same counts.

    The same random numbers, so differences are float32 of Embree: 1e-6 of the counts is rejected where paths agree.
    Catches absolute restarts, a scan or plate that stays at the origin, and a scale that leaves the radius.
    """
    one = simulate(scene_of(tmp_path, CAP))
    keys = "translate_um = [1e7, -1e7, 0.0]\n"
    far = simulate(scene_of(tmp_path, CAP + keys, scan__center_um=[1e7, -1e7]))
    tiny = 'kind = "spheres"\nsize_um = 8.0\nscale = 1000.0\nspheres = [{radius_um = 0.5, cap_height_um = 0.3}]\n'
    large = simulate(scene_of(tmp_path, tiny))
    for other in (far, large):
        assert_likely(z_scores(one, other), "counts of a sample placed elsewhere")
        assert np.median(np.abs(other.counts / one.counts - 1.0)) < 1e-6
    moved = simulate(scene_of(tmp_path, CAP + "translate_um = [40.0, 0.0, 0.0]\n"))
    assert z_scores(one, moved) < 1e-12


def test_top_at_working_distance(tmp_path):
    """The plate's distance is the working distance plus the sample's top, and so said in the scene; same bits.

    Catches the top placed at the substrate's height, an ignored scale or rotation, and an accepted contradiction.
    """
    place = 'place = "top-at-working-distance"\n'
    by_top = scene_of(tmp_path, CAP + place)
    assert by_top.plate.sample_distance_um == pytest.approx(4300.0) and by_top.instrument.sample_distance == 4300.0
    by_hand = scene_of(tmp_path, CAP, "sample_distance_um = 4300.0")
    assert np.array_equal(simulate(by_top).counts, simulate(by_hand).counts)
    tilted = scene_of(tmp_path, STEP + place + "scale = 0.5\nrotate_deg = [0, 10, 0]\n")
    assert tilted.sample_distance == pytest.approx(4000.0 + tilted.build_body().max_height)
    again = scene_of(tmp_path, STEP + place + "scale = 0.5\nrotate_deg = [0, 10, 0]\n", sample__scale=0.25)
    assert again.sample_distance < tilted.sample_distance
    with pytest.raises(SceneError, match=r"4000 um below the plate, plate.sample_distance_um = 4200 puts it 3900"):
        scene_of(tmp_path, CAP + place, "sample_distance_um = 4200.0").build_body()
    with pytest.raises(SceneError, match=r"place.*between|scale"):
        scene_of(tmp_path, CAP + place + "translate_um = [0, 0, -5000]\n")


def test_scan_beside_a_moved_flat_is_refused(tmp_path):
    """The substrate moves with its sample. Catches a scan checked against the unshifted substrate."""
    with pytest.raises(SceneError, match="wholly beside the sample"):
        scene_of(tmp_path, CAP + "translate_um = [20000.0, 0.0, 0.0]\n")


def make_reconstruction(**changes) -> Reconstruction:
    x, y = np.linspace(-600.0, 600.0, 31), np.linspace(-450.0, 450.0, 25)
    from helio_jax.instrument import Beam, Detector, Instrument, Plate

    detector = Detector(name="a", polar_deg=35.0, half_angle_deg=9.0)
    instrument = Instrument(
        beam=Beam(incidence_deg=30.0), plate=Plate(working_distance_um=4000.0), detector=(detector,)
    )
    sphere = np.array([[0.0, 0.0, -200.0, 500.0]])
    height, normals = first_hit_spheres(*np.meshgrid(x, y), sphere, instrument.beam_shift)
    flat = np.ones(height.shape)
    fields = {"height": height, "normals": normals, "albedo": flat, "is_valid": flat > 0, "reason": 0 * flat}
    return Reconstruction(raster_x=x, raster_y=y, instrument=instrument, method="linear", **(fields | changes))


def test_reconstruction_is_a_sample(tmp_path):
    """Seen again by the same beam, every pixel has the height that the file gives it, jumps at the rim included.

    Catches heights put at their beam position instead of at their own x and y: the sphere would be sheared by 170 um.
    """
    rec = make_reconstruction()
    write(rec, tmp_path / "height.h5")
    scene = scene_of(tmp_path, 'kind = "reconstruction"\nfile = "height.h5"\nsize_um = 3000.0\nlevel_um = 0.0\n')
    inner = rec.replace(
        **{name: getattr(rec, name)[1:-1, 1:-1] for name in ("height", "albedo", "is_valid", "reason", "normals")},
        raster_x=rec.raster_x[1:-1],
        raster_y=rec.raster_y[1:-1],
    )
    np.testing.assert_allclose(true_height(scene, inner).height, inner.height, atol=0.01)
    assert np.ptp(rec.height) == pytest.approx(300.0, abs=5.0)
    simulate(scene, rays=8)


def test_gaps_of_a_reconstruction(tmp_path):
    """Pixels without a height are refused or interpolated; those marked invalid count as gaps on request.

    Catches NaN heights traced, gaps filled unasked, and invalid heights used where only valid ones are wanted.
    """
    rec = make_reconstruction()
    is_gap = np.zeros(rec.height.shape, bool)
    is_gap[1:4, 1:6] = True
    keys = 'kind = "reconstruction"\nfile = "gaps.h5"\n'
    write(rec.replace(height=np.where(is_gap, np.nan, rec.height)), tmp_path / "gaps.h5")
    with pytest.raises(InputFileError, match=r"gaps.h5: 15 of 775 pixels have no height: set sample.gaps"):
        scene_of(tmp_path, keys).build_body()
    filled = scene_of(tmp_path, keys + 'gaps = "fill"\n').build_body()
    np.testing.assert_allclose(filled.vertices[:, 2].reshape(is_gap.shape)[is_gap], 0.0, atol=1e-9)
    write(rec.replace(height=np.where(is_gap, 77.0, rec.height), is_valid=~is_gap), tmp_path / "gaps.h5")
    assert scene_of(tmp_path, keys).build_body().vertices[:, 2].reshape(is_gap.shape)[2, 3] == 77.0
    valid = scene_of(tmp_path, keys + 'gaps = "fill"\nuse = "valid"\n').build_body()
    np.testing.assert_allclose(valid.vertices[:, 2].reshape(is_gap.shape)[is_gap], 0.0, atol=1e-9)
    write(simulate(scene_of(tmp_path, CAP), rays=8), tmp_path / "gaps.h5")
    with pytest.raises(InputFileError, match="holds micrographs, needed is a height map"):
        scene_of(tmp_path, keys).build_body()
