"""Import of MATLAB files: what is where, in which unit and which way round.

Orientation is tested on the physics in the pictures (apex, form factors, overlay of rotated scans), so that a
flip in the reader cannot be matched by the same flip in the test.
"""

import json
import math

import numpy as np
import pytest
import scipy.io
from scipy import ndimage

from helio_jax.errors import InputFileError
from helio_jax.formats import matlab
from helio_jax.formats.matlab import import_micrographs
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.workflows.shipped import find_shipped

WD4_CENTERS = ((2309.4, 0.0), (-1154.7, -2000.0), (-1154.7, 2000.0))
ROTATIONS = (0.0, 60.0, -60.0)
PER_RAY = 1 / 35000


def make_bshem(scale: float = 1.0, channels=(4, 3, 2), beam=None, **plate) -> Instrument:
    """The B-SHeM plate at 4 mm times `scale`."""
    detectors = tuple(
        Detector(
            name=name,
            center_um=(c[0] * scale, c[1] * scale),
            axes_um=(1385.6 * scale, 1200.0 * scale),
            rotation_deg=rotation,
            channel=channel,
        )
        for name, c, rotation, channel in zip(
            ("forward", "right", "left"), WD4_CENTERS, ROTATIONS, channels, strict=False
        )
    )
    plate = {"working_distance_um": 4000.0 * scale, **plate}
    return Instrument(beam=beam or Beam(incidence_deg=30.0), plate=Plate(**plate), detector=detectors)


def make_ashem() -> Instrument:
    """One detector at +x."""
    detector = Detector(name="only", center_um=(3120.0, 0.0), axes_um=(1790.0, 1400.0))
    return Instrument(plate=Plate(working_distance_um=3000.0), detector=(detector,))


@pytest.fixture(scope="module")
def reference(shared):
    """The reference simulator's sphere A."""
    return import_micrographs(shared / "data" / "sphere_a_simulated.mat", make_bshem())


@pytest.fixture(scope="module")
def bshem_scan(shared):
    """The measured sphere A."""
    return import_micrographs(shared / "data" / "sc100351.mat", make_bshem(0.75))


@pytest.fixture(scope="module")
def ashem_scans(shared):
    """Three scans of the alum crystal, the first one unturned."""
    names = ("scan003259", "scan003248", "scan003250")
    return [import_micrographs(shared / "data" / f"{n}.mat", make_ashem()) for n in names]


@pytest.fixture
def import_tree(monkeypatch, tmp_path):
    """Import a tree as if a file had held it (no child process: fast)."""

    def run(tree, instrument):
        path = tmp_path / "made.mat"
        path.write_bytes(b"MATLAB 5.0 MAT-file")
        reduced = {k: matlab._reduce(k, v) for k, v in tree.items()}
        monkeypatch.setattr(matlab, "call_in_child", lambda *_, **__: reduced)
        return import_micrographs(path, instrument)

    return run


def make_bshem_tree(fast: str = "horizontal", **changes) -> dict:
    """A B-SHeM scan of 3 rows and 4 columns whose values are channel, row, column."""
    row, column = np.mgrid[:3, :4]
    images = [(1000 * c + 10 * row + column).astype("u2") for c in (1, 2, 3, 4)]
    scan = {
        "image": images,
        "inputs": ["dim", 2, "fast_axis", fast],
        "hori_range": np.array([9e7, 0.0]),
        "vert_range": np.array([0.0, 4e7]),
        "hori_res": 30000000,
        "vert_res": 20000000,
        "dwell_time": 1500,
        "labtemp": np.append(np.full(99, 21.0), np.nan),
        "view": np.zeros((50, 50, 3), np.uint8),
        "gauge": math.nan,
    }
    return {"meas_list": scan | changes}


def make_reference_tree(**param) -> dict:
    """A reference file of 2 x 3 pixels with full 8-bit multiple counts."""
    single = [np.array([[k, 1, 2], [3, 4, 65535]], np.uint16) for k in (10, 20, 30)]
    return {
        "im": {
            "single": single,
            "multiple": [np.full((2, 3), 255, np.uint8)] * 3,
            "raster_movement_x": 0.01,
            "raster_movement_y": 0.02,
        },
        "param": {
            "detector_position": [np.array(c) for c in ((2.3094, 0.0), (-1.1547, 2.0), (-1.1547, -2.0))],
            "detector_axes": [np.array([1.3856, 1.2])] * 3,
            "z_sample_to_detector": 4.72,
            "rays_per_pixel": 35000,
        }
        | param,
        "beam_param": {
            "init_angle": 30,
            "source_size": 0.0005,
            "source_model": "Uniform",
            "pinhole_r": 0.001,
            "pinhole_c": np.array([-2.30940108, 0.0, 0.0]),
        },
    }


def form_factors(instrument: Instrument, height: float) -> np.ndarray:
    """Phi of every aperture from the spot at `height` [detector, 3], by the contour integral (docs/conventions.md)."""
    x, y, z = instrument.spot_position(height)
    out = []
    for aperture in instrument.apertures():
        rim, tangent = aperture.rim(48)
        r = np.column_stack([rim - [x, y], np.full(48, instrument.working_distance - z)])
        t = np.column_stack([tangent, np.zeros(48)])
        out.append((np.cross(r, t) / (r**2).sum(1)[:, None]).sum(0) / 48)
    return np.array(out)


def correlate(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    """Largest normalised cross-correlation of two pictures over all shifts."""
    a, b = ((image - image[mask].mean()) * mask for image in (a, b))
    fa, fb = (np.fft.fft2(image, (256, 256)) for image in (a, b))
    return float(np.fft.ifft2(fa * fb.conj()).real.max() / math.sqrt((a**2).sum() * (b**2).sum()))


# --- reference simulator ---------------------------------------------------------------------------------------------


def test_reference_arrays_are_the_files(reference, shared):
    """Catches rows reversed, columns kept, detectors swapped, orders swapped; against SciPy's reader."""
    im = scipy.io.loadmat(shared / "data" / "sphere_a_simulated.mat", simplify_cells=True)["im"]
    assert reference.shape == (3, 351, 304) and reference.by_order.shape == (2, 3, 351, 304)
    for k in range(3):
        np.testing.assert_array_equal(reference.by_order[0, k], im["single"][k][:, ::-1])
        np.testing.assert_array_equal(reference.by_order[1, k], im["multiple"][k][:, ::-1])
    np.testing.assert_array_equal(reference.counts, reference.by_order.sum(0))


def test_reference_variance_is_free_of_the_pixels_own_noise(reference):
    """The mean of the 8 neighbours; the weighted mean of a flat corner is then the plain one, to 3e-4 (3 s.d.: 1.5e-4).

    Rejects the count itself as its variance: the weighted mean is one count in 420 too low, 2.4e-3.
    """
    counts, variance = reference.counts, reference.variance
    around = counts[1, 99:102, 49:52].sum() - counts[1, 100, 50]
    assert variance[1, 100, 50] == pytest.approx(max(around / 8.0, 1.0))
    flat = counts[:, :60, :60], variance[:, :60, :60]
    means = [(flat[0] / v).sum((1, 2)) / (1.0 / v).sum((1, 2)) / flat[0].mean((1, 2)) for v in (flat[1], flat[0])]
    assert np.abs(means[0] - 1.0).max() < 3e-4
    assert means[1].max() < 1.0 - 1.5e-3


def test_reference_raster_and_instrument(reference):
    """Catches the x pitch without 1/cos t, a raster that is not centred, mm for um, half axes, the wrong handedness."""
    np.testing.assert_allclose(reference.x, (np.arange(304) - 151.5) * 10 / math.cos(math.radians(30)), rtol=1e-12)
    np.testing.assert_allclose(reference.y, (np.arange(351) - 175) * 10.0, rtol=1e-12)
    instrument = reference.instrument
    assert (instrument.working_distance, instrument.sample_distance) == (4000.0, 4720.0)
    assert tuple(d.center_um for d in instrument.detector) == WD4_CENTERS
    assert tuple(d.rotation_deg for d in instrument.detector) == ROTATIONS
    assert {d.axes_um for d in instrument.detector} == {(1385.6, 1200.0)}
    assert (reference.n_rays, reference.noise) == (35000.0, "poisson")


def test_reference_flat_has_the_closed_form_counts(reference):
    """Catches lost counts, wrong axes or distances: far corners show Phi_z N = 480.37, 390.91, 390.91 single counts.

    Four corners of 40 x 40 pixels: standard error 0.06 % (0.04 % found); the sphere hides nothing there. Tolerance
    0.3 %; half axes would be wrong by a factor 4, the substrate at 4 mm by 30 %, detectors 1 and 2 swapped by 20 %.
    """
    expected = form_factors(reference.instrument, 0.0)[:, 2] / PER_RAY
    np.testing.assert_allclose(expected, [480.3705, 390.9079, 390.9079], rtol=1e-6)
    corners = reference.by_order[0][:, np.r_[:40, -40:0]][:, :, np.r_[:40, -40:0]]
    np.testing.assert_allclose(corners.mean((1, 2)), expected, rtol=0.003)


def test_reference_apex_is_downstream(reference):
    """Catches any flip: the surface is level at X = +H tan t = +415.7 um, Y = 0, and slopes as a sphere on both sides.

    Normals by solving P = n . Phi with Phi at the apex' height; the zero of each slope along its axis: found at 416.4
    and 1.5 um, a few um of noise. Flipped columns give -416 um, flipped rows turn the sign of dn_y/dY (1 / 1000 um).
    """
    phi = form_factors(reference.instrument, 720.0)
    n = np.linalg.solve(phi, reference.by_order[0].reshape(3, -1) * PER_RAY).reshape(reference.shape)
    x, y, apex = reference.x, reference.y, 720.0 * math.tan(math.radians(30))
    near_x, near_y = np.abs(x - apex) < 150, np.abs(y) < 150
    along_x = np.polyfit(x[near_x], (n[0] / n[2])[np.abs(y) < 60][:, near_x].mean(0), 1)
    along_y = np.polyfit(y[near_y], (n[1] / n[2])[near_y][:, np.abs(x - apex) < 60].mean(1), 1)
    assert -along_x[1] / along_x[0] == pytest.approx(apex, abs=12)
    assert -along_y[1] / along_y[0] == pytest.approx(0.0, abs=12)
    assert along_x[0] == pytest.approx(1e-3, rel=0.15) and along_y[0] == pytest.approx(1e-3, rel=0.15)


def test_reference_counts_do_not_wrap(import_tree):
    """Catches 16- or 8-bit arithmetic: 65535 + 255, and the order of rows and columns on a readable array."""
    stack = import_tree(make_reference_tree(), make_bshem())
    np.testing.assert_array_equal(stack.counts[0] - 255, [[2, 1, 10], [65535, 4, 3]])
    np.testing.assert_allclose(np.diff(stack.y), 20.0)


def test_reference_detectors_follow_the_given_order(import_tree):
    """Catches detectors paired by number: an instrument that lists its apertures otherwise gets their images."""
    given = make_bshem()
    turned = given.model_copy(update={"detector": given.detector[::-1]})
    stack = import_tree(make_reference_tree(), turned)
    assert stack.instrument.detector_names == ("left", "right", "forward")
    np.testing.assert_array_equal(stack.counts[:, 0, 2] - 255, [30, 20, 10])


@pytest.mark.parametrize(
    ("instrument", "match"),
    [
        (make_bshem(beam=Beam(incidence_deg=25.0)), r"beam.incidence_deg is 30.0 in the file but 25.0"),
        (make_bshem(sample_distance_um=5040.0), r"plate.sample_distance_um is 4720.0 in the file but 5040.0"),
        (make_bshem(0.75), r"plate.working_distance_um is 4000.0 in the file but 3000.0"),
        (make_bshem(0.75, working_distance_um=4000.0), r"centre in the file is .*2309.4.* in the instrument .*1732"),
        (make_bshem(channels=(1, 2)), "has 3 detectors, the instrument 2"),
        (make_bshem(beam=Beam(incidence_deg=30.0, source="gaussian")), "source is uniform in the file but gaussian"),
        (None, r"--instrument bshem_wd4"),
    ],
)
def test_reference_contradictions_are_named(instrument, match, import_tree):
    """Catches a file or an instrument that silently wins over the other."""
    with pytest.raises(InputFileError, match=match):
        import_tree(make_reference_tree(), instrument)


def test_reference_fills_what_the_instrument_leaves_open(import_tree):
    """Catches defaults (distance W, source 0.5 mrad) taken for statements of the user."""
    tree = make_reference_tree()
    tree["beam_param"] |= {"source_size": 0.002, "source_model": "Gaussian"}
    stack = import_tree(tree, make_bshem())
    assert (stack.instrument.beam.source, stack.instrument.beam.source_size_mrad) == ("gaussian", 2.0)
    assert stack.instrument.sample_distance == 4720.0


# --- B-SHeM ----------------------------------------------------------------------------------------------------------


def test_bshem_map_units_and_metadata(import_tree):
    """Catches a missing reversal or transpose, channels by position, axes' steps swapped, pm and ms taken otherwise."""
    stack = import_tree(make_bshem_tree(), make_bshem(0.75))
    assert stack.shape == (3, 4, 3)
    # our x is the raw row and our y the raw column, both reversed: value = 1000 channel + 10 row + column
    np.testing.assert_array_equal(stack.counts[0], [[4023, 4013, 4003], [4022, 4012, 4002], [4021, 4011, 4001], [4020, 4010, 4000]])  # fmt: skip  # noqa: E501
    np.testing.assert_array_equal(stack.counts[:, 0, 0], [4023, 3023, 2023])
    np.testing.assert_allclose(stack.x, [-20.0, 0.0, 20.0])
    np.testing.assert_allclose(stack.y, [-45.0, -15.0, 15.0, 45.0])
    assert (stack.dwell, stack.fast_axis, stack.unit, stack.noise, stack.name) == (
        1.5,
        "y",
        "counts",
        "measured",
        "made",
    )
    found = stack.provenance["metadata"]["meas_list"]
    assert found["labtemp"] == {"mean": 21.0, "min": 21.0, "max": 21.0} and found["gauge"] is None
    assert "view" not in found and "image" not in found
    assert len(json.dumps(stack.provenance, allow_nan=False)) < 5000
    assert import_tree(make_bshem_tree("vertical"), make_bshem(0.75)).fast_axis == "x"


@pytest.mark.parametrize(
    ("changes", "channels", "match"),
    [
        ({}, (4, 3, 5), "'left' must name its channel, 1 to 4, got 5"),
        ({}, (4, 3, 3), "channels must differ"),
        ({"hori_res": 20000000}, (4, 3, 2), "hori range must be 4 pixels"),
        ({"image": [np.zeros((3, 4), "u2")] * 4}, (4, 3, 2), "not connected"),
        ({"image": [np.ones((3, 4), "u2")] * 4, "dwell_time": -1}, (4, 3, 2), "dwell_time must be one number > 0"),
        ({"vert_range": "wide"}, (4, 3, 2), "vert_range must be an array of numbers with 1 axes, got 'wide'"),
        ({"image": ["no", 1, 2, {}]}, (4, 3, 2), "must be an array of numbers"),
    ],
)
def test_bshem_faults_are_named(changes, channels, match, import_tree):
    """Catches a dead channel taken for an image, a cut scan, and raw exceptions on odd content."""
    with pytest.raises(InputFileError, match=match):
        import_tree(make_bshem_tree(**changes), make_bshem(0.75, channels))


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        (np.array([1.0, 2.0, -1.66e9, 0.0]), [-20.0, -45.0, -1660.0]),
        (None, None),
        ("unknown", None),
        (np.array([1.0, 2.0]), None),
        (np.array([1.0, 2.0, np.nan]), None),
    ],
)
def test_bshem_stage_position(place, expected, import_tree):
    """x = -vert, y = -hori, the third axis is the height. Catches other axes, signs, units, and a crash without any."""
    found = import_tree(make_bshem_tree(**({} if place is None else {"pos": place})), make_bshem(0.75)).stage_position
    assert (found is None) if expected is None else found == pytest.approx(expected)


def test_bshem_shows_the_same_side_as_the_reference(bshem_scan, reference):
    """Catches each of the other 7 orientations of the pictures, and swapped detectors.

    Sphere A measured and simulated, correlation over 3 x 3 mm with the shift left free, mean of the detectors: 0.84 as
    imported; the best other one has 0.67. (A mirror image with detectors 2 and 3 swapped is indistinguishable.)
    """
    grid = np.arange(-1500.0, 1501.0, 30.0)
    mask = np.ones((grid.size, grid.size), bool)

    def score(turn) -> float:
        found = []
        for measured, simulated in zip(bshem_scan.counts, reference.counts, strict=True):
            rows = np.interp(grid, reference.y, np.arange(reference.y.size))
            columns = np.interp(grid, reference.x, np.arange(reference.x.size))
            smooth = ndimage.gaussian_filter(simulated, 3)
            picture = ndimage.map_coordinates(smooth, np.meshgrid(rows, columns, indexing="ij"), order=1)
            found.append(correlate(picture, ndimage.gaussian_filter(turn(measured), 1)[10:-10, 10:-10], mask))
        return float(np.mean(found))

    turns = [lambda a, i=i, f=f: np.rot90(a[::f], i) for i in range(4) for f in (1, -1)]
    scores = [score(turn) for turn in turns]
    assert scores[0] > 0.8 and max(scores[1:]) < scores[0] - 0.1, scores


def test_bshem_real_scan(bshem_scan):
    """Catches another pitch or extent, and a noise estimate that takes the sphere's shape for noise."""
    assert bshem_scan.shape == (3, 121, 121)
    np.testing.assert_allclose(bshem_scan.x, (np.arange(121) - 60) * 30.0)
    np.testing.assert_allclose(bshem_scan.y, (np.arange(121) - 60) * 30.0)
    assert (bshem_scan.dwell, bshem_scan.fast_axis) == (1.0, "y")
    np.testing.assert_allclose(bshem_scan.stage_position, [26_600.0, 0.0, -1660.0], atol=0.01)
    # noise per pixel of channels 4, 3, 2 is 111, 88, 107
    np.testing.assert_allclose(bshem_scan.std_error[:, 0, 0], [111, 88, 107], rtol=0.06)


@pytest.mark.parametrize("fast", ["horizontal", "vertical"])
def test_noise_variance_of_known_noise(fast):
    """Catches a wrong factor, the slow axis used, and a mean instead of a median.

    White noise of variance 25 on a slope, every line offset (variance 25), 1 % of pixels spoilt. The estimate's
    standard error is 2 %; the slow axis would give twice the variance, a mean of squares far more. Tolerance 10 %.
    """
    rng = np.random.default_rng(2)
    image = rng.normal(0, 5, (200, 200)) + rng.normal(0, 5, (200, 1)) + 0.5 * np.arange(200)
    image[rng.random(image.shape) < 0.01] += 1000
    estimate = matlab._noise_variance(image if fast == "horizontal" else image.T, fast)
    assert estimate == pytest.approx(25.0, rel=0.1)


# --- A-SHeM ----------------------------------------------------------------------------------------------------------


def test_ashem_units(ashem_scans, shared):
    """Catches rows not reversed, MATLAB's index 2 taken as ours, 1e-6 deg read as 1e-9 or as radians, pm for nm."""
    raw = scipy.io.loadmat(shared / "data" / "scan003248.mat", simplify_cells=True)["meas_list"]["image"]
    unturned, scan, other = ashem_scans
    np.testing.assert_array_equal(scan.counts[0], raw[::-1])
    np.testing.assert_allclose(scan.x, (np.arange(101) - 50) * 20.0)
    assert scan.counts.max() < 1e-9 and scan.unit == "A" and scan.fast_axis == "x"
    rotations = [math.degrees(s.sample_rotation) for s in (unturned, scan, other)]
    np.testing.assert_allclose(rotations, [0, -72, -144], atol=2e-5)
    np.testing.assert_allclose([s.dwell for s in (unturned, scan, other)], [0.495, 0.75, 0.75])


def test_ashem_scans_overlay_when_turned_back(ashem_scans):
    """Catches the other sign of the rotation or a mirrored picture: edges coincide only for the right sense.

    Each picture is turned back by its sample rotation (counter-clockwise positive, y up) and its edges are correlated
    with those of the unturned scan: 0.42, 0.43; in the other sense 0.16, 0.20.
    """
    row, column = np.mgrid[-50:51, -50:51]
    mask = row**2 + column**2 < 46**2

    def edges(stack, sense: int) -> np.ndarray:
        picture = (stack.counts[0] - np.median(stack.counts)) / stack.counts.std()
        strength = ndimage.gaussian_gradient_magnitude(picture, 1.5)
        # ndimage turns from the first axis to the second for negative angles: with y up that is clockwise
        angle = sense * math.degrees(stack.sample_rotation)
        return ndimage.rotate(strength, angle, reshape=False, order=1, mode="nearest")

    first = edges(ashem_scans[0], 1)
    for scan in ashem_scans[1:]:
        right, wrong = (correlate(first, edges(scan, sense), mask) for sense in (1, -1))
        assert right > 0.35 and right > wrong + 0.15


def test_ashem_needs_one_detector(import_tree):
    """Catches a three-detector instrument accepted for one picture, and a scan without its rotation."""
    scan = make_bshem_tree()["meas_list"] | {"image": np.ones((3, 4)), "N_dwell": 50}
    with pytest.raises(InputFileError, match="1 detector, the instrument has 3"):
        import_tree({"meas_list": scan}, make_bshem())
    with pytest.raises(InputFileError, match="sample_orientation must be an array"):
        import_tree({"meas_list": scan}, make_ashem())
    with pytest.raises(InputFileError, match=r"--instrument ashem_normal"):
        import_tree({"meas_list": scan}, None)


def test_named_instruments_exist():
    """Catches an error message that recommends an instrument which is not shipped."""
    for name in matlab._EXAMPLE_INSTRUMENT.values():
        assert find_shipped(name).kind == "instrument"
