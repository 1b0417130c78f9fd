"""The sentences of helio_jax/arrays.py, in their order: each is pinned by a test against an independent statement.

Small scenes, expected estimator. The tracer works with rays and surfaces and knows no raster formula, so its first
hits are the independent side for the beam frame.
"""

import math

import numpy as np
import pytest
from pydantic import BaseModel

import helio_jax as hx
from helio_jax.forward.surface import normal_of_slopes, slopes_of_normal
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS, Reconstruction
from helio_jax.scene.scan import Raster
from helio_jax.scene.scene import Scene
from helio_jax.scene.shapes import FlatSample, Sphere, SpheresSample, TrenchSample
from helio_jax.scene.surfaces import first_hit_spheres
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.run import first_hits
from helio_jax.trace.scan import trace_scene
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows.scene_file import SceneFile

TAN = math.tan(math.radians(30.0))
CENTER = (350.0, 200.0)
"""Axis of the bump: at +x, +y, and at another distance along x than along y."""


def make_instrument(azimuth=0.0) -> Instrument:
    return Instrument(
        beam=Beam(incidence_deg=30.0, azimuth_deg=azimuth),
        plate=Plate(working_distance_um=4000.0, sample_distance_um=4720.0),
        detector=(Detector(name="a", polar_deg=30.0, half_angle_deg=9.0),),
    )


def turned(vector: tuple[float, float]) -> tuple[float, float]:
    """Rotate by +90 degrees about z, counter-clockwise seen from above."""
    return -vector[1], vector[0]


def bump_scene(is_turned: bool = False, **changes) -> Scene:
    """A spherical cap at +x, +y on an oblong raster; sample, beam, detectors and raster rotate together on request."""
    ellipses = [((2309.0, 0.0), 0.0), ((-1155.0, -2000.0), 60.0), ((-1155.0, 2000.0), -40.0)]
    turn = turned if is_turned else lambda vector: vector
    angle = 90.0 if is_turned else 0.0
    detectors = tuple(
        Detector(name=name, center_um=turn(center), axes_um=(1500.0, 1000.0), rotation_deg=rotation + angle)
        for name, (center, rotation) in zip(("forward", "right", "left"), ellipses, strict=True)
    )
    nx, ny = (21, 31) if is_turned else (31, 21)
    cap = Sphere(radius_um=400.0, cap_height_um=150.0, center_um=turn(CENTER))
    table = {
        "beam": Beam(incidence_deg=30.0, azimuth_deg=angle, source="pencil", pinhole_radius_um=0.0),
        "plate": Plate(working_distance_um=4000.0),
        "detector": detectors,
        "sample": SpheresSample(spheres=(cap,), size_um=6000.0),
        "scan": Raster(nx=nx, ny=ny, pixel_size_um=60.0, pitch="sample"),
    }
    return Scene(**(table | changes))


def simulate(scene: Scene, **changes) -> MicrographStack:
    return trace_scene(scene, TraceSettings(rays=64, branches=4, **changes))


@pytest.fixture(scope="module")
def bump() -> MicrographStack:
    return simulate(bump_scene())


@pytest.fixture(scope="module")
def bump_height(bump) -> Reconstruction:
    return hx.reconstruct(bump, method="nearfield")


def hits_on(scene: Scene, x: np.ndarray, y: np.ndarray):
    """Return the first hits of the beam axis on a grid of beam positions: points [y, x, 3] and normals [y, x, 3]."""
    grid_x, grid_y = np.meshgrid(x, y)
    hits = first_hits(Intersector(scene.build_body()), scene.instrument, grid_x.ravel(), grid_y.ravel())
    return hits.point.reshape(*grid_x.shape, 3), hits.normal.reshape(*grid_x.shape, 3)


def models_of(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """Return a settings model and all models within it."""
    if model not in seen:
        seen.add(model)
        for field in model.model_fields.values():
            for kind in _parts(field.annotation):
                models_of(kind, seen)
    return seen


def _parts(annotation) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [kind for part in getattr(annotation, "__args__", ()) for kind in _parts(part)]


# Lengths are micrometres, angles radians, numbers float64. Names with a suffix (`_deg`, `_nm`) hold other units.


def test_micrometres_radians_float64(bump):
    """The raster's pitch is the file's 60 um, an aperture's 60 deg are pi / 3, and all numbers are float64.

    Catches: millimetres or degrees inside, float32 counts from Embree's own precision.
    """
    assert np.diff(bump.x) == pytest.approx(60.0)
    apertures = bump.instrument.apertures()
    assert apertures[1].rotation == pytest.approx(math.pi / 3) and apertures[0].semi_axes == (750.0, 500.0)
    assert bump.instrument.beam_direction == pytest.approx([0.5, 0.0, -math.sqrt(0.75)])
    assert {a.dtype for a in (bump.counts, bump.variance, bump.by_order, bump.x, bump.y, bump.masked)} == {
        np.dtype(np.float64)
    }


def test_settings_names_carry_their_unit():
    """A setting described in [um], [deg] or [mrad] ends in that unit, and the other way round.

    Catches: `working_distance` without a unit, `incidence_deg` described in radians.
    """
    n_checked = 0
    for model in models_of(SceneFile, set()):
        for name, field in model.model_fields.items():
            for unit in ("um", "deg", "mrad"):
                if f"[{unit}]" in (field.description or "") or name.endswith(f"_{unit}"):
                    assert name.endswith(f"_{unit}") and f"[{unit}]" in (field.description or ""), (model, name)
                    n_checked += 1
    assert n_checked > 25


# Images are [detector, y, x]; x increases with the column, y with the row; pictures have their origin lower left.


def test_bump_at_plus_x_plus_y_appears_there(bump, bump_height):
    """In the simulated pictures and the reconstructed heights; that they are drawn origin lower is in test_figures.

    The cap's rim has a radius of 313 um. Catches: exchanged axes, rows counted downwards, a mirrored column.
    """
    assert bump.counts.shape == (3, 21, 31) and bump_height.height.shape == (21, 31)
    flat = np.median(bump.counts, axis=(1, 2), keepdims=True)
    differs = np.abs(bump.counts / flat - 1.0).max(0) > 0.1
    height = bump_height.height
    for image in (differs, np.maximum(height - 0.3 * height.max(), 0.0)):
        assert np.average(bump.y, weights=image.sum(1)) == pytest.approx(CENTER[1], abs=45.0)
        # seen obliquely the cap lies between its rim and its top, which is seen 150 tan 30 = 87 um further along x
        assert CENTER[0] - 60.0 < np.average(bump.x, weights=image.sum(0)) < CENTER[0] + 150.0
    assert 100.0 < height.max() < 200.0 and np.median(height) == pytest.approx(0.0, abs=5.0)


def test_raster_of_a_sphere():
    """A sphere at (+1000, +500) is seen in the upper right quarter of a raster drawn origin lower.

    Catches: exchanged axes, rows counted downwards.
    """
    x, y = Raster(nx=41, ny=21, pixel_size_um=100.0).positions(Beam(incidence_deg=30.0))
    shift = make_instrument().beam_shift
    height, _ = first_hit_spheres(x[None, :], y[:, None], np.array([[1000.0, 500.0, 0.0, 150.0]]), shift)
    assert height.shape == (21, 41)
    row, column = np.unravel_index(np.argmax(height), height.shape)
    assert y[row] == pytest.approx(500.0, abs=51) and 1000.0 < x[column] < 1150.0


@pytest.mark.parametrize("detector", [0, 1, 2])
def test_a_slope_that_faces_a_detector_is_bright(bump, detector):
    """The side of the cap that looks towards an aperture is brighter than the side that looks away.

    Catches: detectors mirrored in x or y, or in another order than their names.
    """
    aperture = np.array(bump.instrument.apertures()[detector].center)
    towards = aperture / np.hypot(*aperture)
    flat = np.median(bump.counts[detector])
    for side in (1.0, -1.0):
        # 200 um from the axis the cap is 96 um high
        x, y = CENTER[0] + side * 200.0 * towards[0] + 96.0 * TAN, CENTER[1] + side * 200.0 * towards[1]
        count = bump.counts[detector, np.argmin(abs(bump.y - y)), np.argmin(abs(bump.x - x))]
        assert side * (count / flat - 1.0) > 0.05


def test_masks_lie_behind_the_sphere():
    """A hemisphere masks an aperture from the substrate on the side away from that aperture.

    Catches: a mask drawn towards the detector, mirrored, or in another order of the detectors.
    """
    dome = Sphere(radius_um=400.0, cap_height_um=400.0, center_um=CENTER)
    scene = bump_scene(sample=SpheresSample(spheres=(dome,), size_um=6000.0), beam=Beam(incidence_deg=0.0))
    stack = simulate(scene)
    x, y = np.meshgrid(stack.x - CENTER[0], stack.y - CENTER[1])
    is_beside = np.hypot(x, y) > 410.0
    for aperture, masked in zip(stack.instrument.apertures(), stack.masked, strict=True):
        towards = np.array(aperture.center) / np.hypot(*aperture.center)
        hidden = np.where(is_beside, masked, 0.0)
        assert hidden.max() > 0.3
        center = np.array([np.average(x, weights=hidden), np.average(y, weights=hidden)])
        assert center @ towards / np.hypot(*center) < -0.85  # the raster ends about 600 um from the axis


# Pixel (i, j) has beam position (x[j], y[i]), where the beam axis meets z = 0; its surface point lies at
# (x - h tan t, y, h): height increases upwards, towards the plate.


@pytest.mark.parametrize("distance", [4000.0, 4720.0])
def test_beam_position_is_on_the_reference_plane(distance):
    """On the bare substrate the first hit of the axis is (x[j], y[i], 0), at any sample distance.

    Catches: positions taken on the plane at the design working distance, or on the plate.
    """
    plate = Plate(working_distance_um=4000.0, sample_distance_um=distance)
    scene = bump_scene(sample=FlatSample(size_um=6000.0), plate=plate)
    x, y = scene.positions()
    point, _ = hits_on(scene, x, y)
    grid = np.stack([*np.meshgrid(x, y), np.zeros((y.size, x.size))], -1)
    assert point == pytest.approx(grid, abs=1e-2)


def test_surface_point_lies_upstream_of_its_raster_position():
    """A point of height h seen at X lies at X - h tan t: upstream for h > 0; the y of a beam along x is untouched.

    Against traced hits on the cap and on a trench floor (h < 0). Catches: + h tan t, or x and y exchanged.
    """
    trench = TrenchSample(width_um=700.0, length_um=3000.0, depth_um=200.0, size_um=6000.0, azimuth_deg=90.0)
    for scene, lowest, highest in ((bump_scene(), 0.0, 150.0), (bump_scene(sample=trench), -200.0, 0.0)):
        x, y = scene.positions()
        point, _ = hits_on(scene, x, y)
        h = point[..., 2]
        assert h.min() == pytest.approx(lowest, abs=8.0) and h.max() == pytest.approx(highest, abs=8.0)
        assert point[..., 0] == pytest.approx(x[None, :] - h * TAN, abs=1e-2)
        assert point[..., 1] == pytest.approx(np.broadcast_to(y[:, None], h.shape), abs=1e-2)
        claimed = scene.instrument.surface_position(*np.meshgrid(x, y), h)
        assert np.stack(claimed, -1) == pytest.approx(point[..., :2], abs=1e-2)
    x, y = make_instrument(azimuth=90.0).surface_position(1000.0, 50.0, 100.0)
    assert x == pytest.approx(1000.0) and y == pytest.approx(50.0 - 100.0 * TAN)


def test_height_goes_up_towards_the_plate():
    """A higher point is nearer to the plate in the lab frame. Catches: depth for height."""
    low, high = (make_instrument().spot_position(h)[2] for h in (0.0, 100.0))
    assert high - low == pytest.approx(100.0) and high < 4000.0


# Slopes in the beam frame: a = p / (1 + p tan t), b = q / (1 + p tan t). Surface normals point up: n ~ (-p, -q, 1).


def test_slopes_and_normals_of_a_traced_cap():
    """Differences of the traced heights along the raster agree with the slopes of the traced normals.

    Formula: a = p / (1 + p tan t), b = q / (1 + p tan t), p = -nx / nz, q = -ny / nz. Bias of central differences over
    2 um on a sphere of 400 um: 1e-5. Catches: 1 - p tan t, slopes per um of sample, normals pointing down.
    """
    scene, step = bump_scene(), 1.0
    x = CENTER[0] + 90.0 + np.array([-150.0, -60.0, 30.0, 120.0])
    y = CENTER[1] + np.array([-120.0, 0.0, 120.0])
    point, normal = hits_on(scene, x, y)
    assert point[..., 2].min() > 10.0  # all on the cap
    p, q = -normal[..., 0] / normal[..., 2], -normal[..., 1] / normal[..., 2]
    height = lambda dx, dy: hits_on(scene, x + dx, y + dy)[0][..., 2]  # noqa: E731
    a = (height(step, 0.0) - height(-step, 0.0)) / (2 * step)
    b = (height(0.0, step) - height(0.0, -step)) / (2 * step)
    assert a == pytest.approx(p / (1 + p * TAN), abs=2e-4) and b == pytest.approx(q / (1 + p * TAN), abs=2e-4)
    assert np.all(normal[..., 2] > 0.0)
    right, left = normal[1, -1], normal[1, 0]
    assert right[0] > 0.0 > left[0]  # the side at +x falls towards +x: p < 0, so the normal leans towards +x
    for found, wanted in zip(slopes_of_normal(normal, scene.instrument.beam_shift)[:2], (a, b), strict=True):
        assert found == pytest.approx(wanted, abs=2e-4)
    n = np.stack(normal_of_slopes(a, b, scene.instrument.beam_shift), -1)
    assert n / np.linalg.norm(n, axis=-1, keepdims=True) == pytest.approx(normal, abs=5e-4)


@pytest.mark.parametrize("azimuth", [0.0, 40.0])
def test_slopes_per_pixel(azimuth):
    """On a plane, dh/dX = p / (1 + p tx + q ty) for p = dz/dx, q = dz/dy (tx, ty: the beam shift), also for dh/dY.

    Formula: h = p (X - h tx) + q (Y - h ty). Catches: 1 - p tan t.
    """
    instrument, p, q = make_instrument(azimuth), 0.3, -0.2
    tx, ty = instrument.beam_shift
    slope = np.array([p, q]) / (1.0 + p * tx + q * ty)
    X, Y = 700.0, -300.0
    h = slope @ [X, Y]
    x, y = instrument.surface_position(X, Y, h)
    assert h == pytest.approx(p * x + q * y)


def test_reconstructed_normals_lean_downhill(bump, bump_height):
    """On the reconstructed cap the normal leans to +x at its +x side, to +y at its +y side, and up everywhere.

    Catches: slopes for normals (sign), exchanged components.
    """
    n, h = bump_height.normals, bump_height.height
    x, y = bump_height.x, bump_height.y
    is_cap = h > 40.0
    assert is_cap.sum() > 30 and np.all(n[..., 2] > 0.0)
    for axis, position, center in ((0, x, CENTER[0]), (1, y, CENTER[1])):
        lean = n[..., axis][is_cap]
        offset = (position - center)[is_cap]
        assert np.corrcoef(lean, offset)[0, 1] > 0.9
        # on a sphere of 400 um the normal is the offset / 400
        assert np.polyfit(offset, lean, 1)[0] == pytest.approx(1 / 400.0, rel=0.3)


# The name of a mask states the meaning of True: is_observed, is_valid.


def test_masks_say_what_true_means(bump):
    """A pixel that one of three detectors did not record is not `is_valid`; the others are, unless contradicted.

    Catches: inverted masks, a count in an unobserved pixel (here 1e9) that enters the fit.
    """
    is_observed = np.ones(bump.shape, bool)
    is_observed[1, 4, 7] = False
    counts = bump.counts.copy()
    counts[1, 4, 7] = 1e9
    rec = hx.reconstruct(bump.replace(counts=counts, is_observed=is_observed), method="linear")
    others = np.delete(rec.reason.ravel(), 4 * 31 + 7)
    allowed = {0, REASONS.index("floating"), REASONS.index("contradicts the data")}
    assert not rec.is_valid[4, 7] and set(np.unique(others)) <= allowed
    assert np.mean(others == 0) > 0.7 and np.array_equal(rec.is_valid, rec.reason == 0)
    assert REASONS[rec.reason[4, 7]] == "too few images"
    assert np.abs(rec.height[4, 7]) < 20.0  # on the flat


@pytest.mark.slow
def test_two_images_do_where_the_albedo_is_known(bump):
    """`refine`, whose albedo is smooth, takes pixels of two images: valid, and no higher than they are; none of one.

    Catches the photometric rule of three images in a fit of two slopes; what a masked pixel reads (1e9) in the fit.
    """
    is_observed = np.ones(bump.shape, bool)
    is_observed[1, 4:7, 15] = is_observed[:2, 14, 4] = False
    counts = np.where(is_observed, bump.counts, 1e9)
    rec, full = (
        hx.reconstruct(b, method="refine") for b in (bump.replace(counts=counts, is_observed=is_observed), bump)
    )
    assert rec.is_valid[4:7, 15].all() and not rec.is_valid[14, 4]
    assert REASONS[rec.reason[14, 4]] == "too few images"
    assert np.abs(rec.height - full.height)[4:7, 15].max() < 3.0 * rec.height_std[4:7, 15].max()


# Scattering orders: index 0 is single scattering (order 1); the last index holds its order and all above.


def test_orders_start_at_single_and_end_with_the_rest(bump):
    """A substrate has single scattering only, index 0; with fewer orders the last index is the sum of the rest.

    Catches: index = order, a last order that drops what lies above, multiple scattering counted into index 0.
    """
    flat = simulate(bump_scene(sample=FlatSample(size_um=6000.0)), n_orders=3)
    assert flat.by_order.shape[0] == 3
    assert np.all(flat.by_order[0] > 100.0) and np.all(flat.by_order[1:] == 0.0)
    few = simulate(bump_scene(), n_orders=2)
    assert bump.by_order.shape[0] == 4 and few.by_order.shape[0] == 2
    assert few.by_order[0] == pytest.approx(bump.by_order[0], rel=1e-12)
    assert few.by_order[1] == pytest.approx(bump.by_order[1:].sum(0), rel=1e-9, abs=1e-9)
    assert bump.by_order[1].sum() > bump.by_order[2].sum() > 0.0
    assert bump.multiple == pytest.approx(bump.counts - bump.by_order[0], abs=1e-6)


# Symmetries that hold only if every array keeps to one convention.


def test_detectors_permute_with_their_images(bump, bump_height):
    """Another order of the detectors is the same images in that order, and the same heights.

    Single scattering to 1e-12; multiple within 6 standard errors of its mean. Catches: an aperture tied to an index.
    """
    order = [2, 0, 1]
    scene = bump_scene()
    permuted = simulate(scene.model_copy(update={"detector": tuple(scene.detector[i] for i in order)}))
    assert permuted.by_order[0] == pytest.approx(bump.by_order[0][order], rel=1e-12)
    assert permuted.masked == pytest.approx(bump.masked[order], abs=1e-12)
    error = np.sqrt((permuted.variance + bump.variance[order]).sum((1, 2)))
    assert np.all(np.abs((permuted.counts - bump.counts[order]).sum((1, 2))) < 6 * error + 1e-9)
    assert not np.allclose(permuted.by_order[0], bump.by_order[0], rtol=1e-3)
    again = bump.replace(
        counts=bump.counts[order],
        variance=bump.variance[order],
        by_order=None,
        masked=None,
        is_observed=bump.is_observed[order],
        instrument=permuted.instrument,
    )
    assert hx.reconstruct(again, method="nearfield").height == pytest.approx(bump_height.height, abs=1e-6)


def test_turning_everything_turns_the_image(bump, bump_height):
    """Sample, beam, detectors and raster rotated by +90 degrees together give the rotated images and heights.

    (x, y) -> (-y, x), so image'[i, j] = image[ny - 1 - j, i] = rot90(image, -1) (drawn origin lower, it turns
    counter-clockwise). Catches: x and y treated differently, a rotation or azimuth of the wrong sign.
    """
    other = simulate(bump_scene(is_turned=True))
    wanted = np.rot90(bump.by_order[0], -1, axes=(1, 2))
    assert other.by_order[0].shape == (3, 31, 21)
    differs = lambda image: np.quantile(np.abs(other.by_order[0] / image - 1.0), 0.98)  # noqa: E731
    assert differs(wanted) < 1e-4
    # wrong models: rotated the other way, mirrored
    assert differs(np.rot90(bump.by_order[0], 1, axes=(1, 2))) > 0.05 and differs(wanted[:, :, ::-1]) > 0.05
    height = hx.reconstruct(other, method="nearfield").height
    assert height == pytest.approx(np.rot90(bump_height.height, -1), abs=3.0)


def test_beam_pitch_is_stretched_along_the_beam():
    """`beam` pitch: pixel / cos t along the beam's azimuth only; `sample`: equal.

    Catches: multiplied by cos t, stretched across the beam, stretched at azimuth 90 along x.
    """
    step = lambda axis: float(np.diff(axis).mean())  # noqa: E731
    for azimuth, pitch, expected in (
        (0.0, "beam", (11.547, 10.0)),
        (180.0, "beam", (11.547, 10.0)),
        (90.0, "beam", (10.0, 11.547)),
        (-90.0, "beam", (10.0, 11.547)),
        (33.0, "sample", (10.0, 10.0)),
    ):
        raster = Raster(nx=4, ny=3, pixel_size_um=10.0, pitch=pitch)
        x, y = raster.positions(Beam(incidence_deg=30.0, azimuth_deg=azimuth))
        assert (step(x), step(y)) == pytest.approx(expected, abs=1e-3)
        assert x.size == 4 and y.size == 3 and x.mean() == pytest.approx(0.0) and y[1] == 0.0


def test_ellipse_turns_counter_clockwise():
    """The long axis of an ellipse rotated by +30 deg points to +x, +y seen from above; catches the opposite sense."""
    plate = Plate(working_distance_um=4000.0)
    detector = Detector(name="d", center_um=(0.0, 0.0), axes_um=(2000.0, 500.0), rotation_deg=30.0)
    rim = Instrument(plate=plate, detector=(detector,)).apertures()[0].rim(64)[0]
    tip = rim[np.argmax(rim[:, 0])]
    assert tip[0] > 800.0 and tip[1] > 400.0
