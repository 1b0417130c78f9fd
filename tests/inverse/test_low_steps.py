"""Steps lower than a pixel's worth of mask: rasters drawn by an independent mask test, false alarms, scratches."""

import math

import manifold3d
import numpy as np
import pytest
import trimesh

import helio_jax as hx
from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.dash_lines import find_dashes, find_line
from helio_jax.inverse.low_wall import LowWall
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.inverse.measured_steps import anchors_of_steps, walls_of
from helio_jax.inverse.quality import floating, regions
from helio_jax.inverse.wall_signal import opening_of, wall_signal
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.scene_file import load_scene
from tests.inverse.test_mask_bands import NORMAL, OBLIQUE, unit

PITCH, N = 10.0, 61
SCAN = {"scan.nx": N, "scan.ny": N, "scan.pixel_size_um": PITCH, "scan.pitch": "sample"}


def ramp_share(aperture, instrument, normal, u, height, width):
    """Compute the direct signal of points of a ramp step, in that of the level [point], by segments and facets.

    Args:
        u: distance from the image of the upper edge along the normal [um].
        height, width: of the ramp [um].
    """
    shift = np.array(instrument.beam_shift) @ normal
    s, r = np.pi * (3.0 - math.sqrt(5.0)) * np.arange(400), np.sqrt((np.arange(400) + 0.5) / 400)
    local = r[:, None] * np.stack([np.cos(s), np.sin(s)], -1) * aperture.semi_axes
    turned = local @ np.stack([unit(math.degrees(aperture.rotation)), unit(math.degrees(aperture.rotation) + 90.0)])
    tau = (turned + aperture.center - instrument.spot_position(0.0)[:2]) / instrument.working_distance
    weight = (1.0 + np.sum(tau**2, -1)) ** -2.0
    weight, away = weight / weight.sum(), tau @ normal
    image = max(width - height * shift, 1e-9)
    is_wall = (u > 0.0) & (u < image)
    x = np.where(is_wall, width * u / image, u + height * shift)
    drop = np.where(u <= 0.0, 0.0, np.where(is_wall, height * u / image, height))
    size = math.hypot(height, width)
    facet = np.maximum(width + height * away, 0.0) / size
    is_seen = (x[:, None] + drop[:, None] * away >= 0.0) | (u <= 0.0)[:, None]
    return np.where(is_wall[:, None], facet, is_seen) @ weight


def stack_of(counts, noise, instrument=NORMAL) -> MicrographStack:
    axis = PITCH * (np.arange(N) - 0.5 * (N - 1))
    variance = np.full(counts.shape, noise**2)
    return MicrographStack(counts, axis, axis, instrument, variance=variance, background=np.zeros(3), noise="poisson")


@pytest.mark.parametrize("instrument", [NORMAL, OBLIQUE], ids=["normal", "oblique"])
def test_profile_of_a_ramp(instrument):
    """Direct signal of ramps of several inclinations as by segments; rejects a wall seen where the beam sees none."""
    u = np.linspace(-5.0, 25.0, 241)
    for turn in (10.0, 100.0, 190.0, 280.0):
        for aperture in instrument.apertures():
            opening = opening_of(aperture, instrument, 0.0)
            signal = wall_signal(opening, instrument.beam_shift, unit(turn))
            for height, width in ((6.0, 0.01), (6.0, 3.0), (4.0, 8.0)):
                expected = ramp_share(aperture, instrument, unit(turn), u, height, width)
                wall = LowWall.of(signal, opening, unit(turn))
                found = wall.profile(u[None], *(np.array([[a]]) for a in (height, width, 0.0)))[0][0]
                assert np.mean(np.abs(found - expected) < 0.03) > 0.98, (turn, height, width)


@pytest.mark.parametrize(("slope", "limit"), [(90.0, 0.05), (45.0, 0.1)])
def test_glow_below_a_wall(slope, limit):
    """Multiple scattering on the level beside a wall that faces away, as traced: noise 1 %.

    Beside a slope of 45 deg it rejects that of a vertical wall times 1 - cos from its foot on: 0.2 to 0.4 too low.
    """
    height, run = 20.0, 20.0 / math.tan(math.radians(slope))
    step = {"sample.height_um": height, "sample.position_um": 0.0, "sample.slope_deg": slope}
    scene = load_scene("step", step | {"scan.nx": 161, "scan.ny": 1, "scan.pixel_size_um": 1.0, "scan.pitch": "sample"})
    image = hx.simulate(scene, rays=512, branches=16, seed=1).only()
    shift = np.array(OBLIQUE.beam_shift)
    u = image.x - height * shift[0]
    beside = (u > max(run - height * shift[0], 0.0) + 0.25 * height) & (u < 2.5 * height)
    level = np.median(image.counts[:, 0, :60], axis=1)
    for k, aperture in enumerate(scene.instrument.apertures()):
        opening = opening_of(aperture, scene.instrument, 0.0)
        wall = LowWall.of(wall_signal(opening, tuple(shift), unit(0.0)), opening, unit(0.0))
        model = [wall.profile(u[None], *(np.array([[a]]) for a in (height, run, m)))[0][0] for m in (1.0, 0.0)]
        found = (image.by_order[1:, k, 0].sum(0) / level[k])[beside]
        assert (model[0] - model[1])[beside].mean() == pytest.approx(found.mean(), rel=limit)


@pytest.mark.parametrize("slope", [30.0, 45.0, 60.0])
def test_multiple_scattering_on_a_wall_that_faces_the_beam(slope):
    """As traced, within 3 % of the level's signal everywhere on the wall; noise 1 %.

    It rejects that of a vertical wall times 1 - cos: 0.05 to 0.15 too dark above the foot in the detector that the wall
    faces away from, for a mask that a slope does not cast, and too bright in the others.
    """
    height, run = 20.0, 20.0 / math.tan(math.radians(slope))
    step = {"sample.height_um": height, "sample.position_um": 0.0, "sample.slope_deg": slope}
    step |= {"sample.facing_deg": 180.0}
    scene = load_scene("step", step | {"scan.nx": 161, "scan.ny": 1, "scan.pixel_size_um": 1.0, "scan.pitch": "sample"})
    image = hx.simulate(scene, rays=512, branches=16, seed=1).only()
    shift, normal = np.array(OBLIQUE.beam_shift), unit(180.0)
    width = run - height * float(shift @ normal)
    level = np.median(image.counts[:, 0, -40:], axis=1)
    direct = image.by_order[0, 0, 0] / level[0]
    is_wall = np.flatnonzero(direct < 0.5 * (1.0 + direct.min()))
    assert len(is_wall) == pytest.approx(width, abs=2.5)
    inside = is_wall[3:-3]
    above = (inside - is_wall[0] + 0.5) / len(is_wall)  # the wall's foot is on the side of negative x
    for k, aperture in enumerate(scene.instrument.apertures()):
        opening = opening_of(aperture, scene.instrument, 0.0)
        wall = LowWall.of(wall_signal(opening, tuple(shift), normal), opening, normal)
        at, one = (1.0 - above[None]) * width, np.array([[1.0]])
        model = [wall.profile(at, height * one, run * one, m * one)[0][0] for m in (1.0, 0.0)]
        found = image.by_order[1:, k, 0].sum(0)[inside] / level[k]
        np.testing.assert_allclose(model[0] - model[1], found, atol=0.03)
        assert (model[0] - model[1]).mean() == pytest.approx(found.mean(), rel=0.08)


def traced(turn, height, width=0.0, instrument=OBLIQUE) -> MicrographStack:
    """Trace a straight ramp step [pixels] through the image that falls towards `turn` [deg]; SNR 60."""
    slope = math.degrees(math.atan2(height, width))
    step = {"sample.height_um": PITCH * height, "sample.slope_deg": slope, "sample.facing_deg": turn % 360.0}
    more = {"sample.position_um": 0.3 * PITCH, "beam.incidence_deg": instrument.beam.incidence_deg}
    return counts_of(load_scene("step", SCAN | step | more), turn, instrument)


def counts_of(scene, turn, instrument) -> MicrographStack:
    """Trace a scene; SNR 60, its noise by the direction of the step [deg]."""
    image = hx.simulate(scene, rays=8, branches=32, seed=1).only()
    signal = image.counts / np.median(image.counts, axis=(1, 2), keepdims=True)
    noise = 1.0 / 60.0
    counts = signal + noise * np.random.default_rng(int(turn) % 360).standard_normal(signal.shape)
    return stack_of(counts, noise, instrument)


CASES = [
    (20.0, 0.45, 0.0, NORMAL),
    (203.0, 0.25, 0.25, NORMAL),
    (91.5, 0.4, 0.0, NORMAL),
    (138.0, 0.3, 0.1, OBLIQUE),
    (160.0, 0.6, 0.3, OBLIQUE),
    (195.0, 0.3, 0.45, OBLIQUE),
    (205.0, 0.3, 0.45, OBLIQUE),
    (165.0, 0.3, 0.6, OBLIQUE),
]


@pytest.mark.parametrize(("turn", "height", "width", "instrument"), CASES)
def test_a_step_that_only_dashes_show_is_measured(turn, height, width, instrument):
    """Height within 3 standard deviations, of at most 35 %; the image is parted from border to border.

    Catches a line that turns the wrong way, ends at its last dash, or falls to the wrong side, a vertical wall in
    place of a ramp, and ramps that are taken for lines without a step, or come out a third too low, because errors of
    a quarter are allowed on a wall.
    """
    found = find_steps(traced(turn, height, width, instrument))
    (step,) = [s for s in found.steps if s.is_used]
    off = (step.falls_deg - turn + 180.0) % 360.0 - 180.0
    assert abs(off) < 1.0
    assert abs(step.height_um - PITCH * height) < 3.0 * step.height_std_um < 3.0 * 0.35 * PITCH * height
    raster = Raster.regular((N, N), PITCH, PITCH)
    assert np.sum(np.bincount(regions(*(~cut for cut in walls_of(found, raster))).ravel()) > 100) == 2


@pytest.mark.parametrize(("turn", "height"), [(15.0, 0.25), (-28.0, 0.3), (2.5, 0.35)])
def test_a_low_step_that_faces_away_is_measured(turn, height):
    """Traced counts: no mask shows, but the foot is brighter. Height within 3 standard deviations of at most 35 %.

    Catches a search among dark pixels alone, which finds none of them, the wrong side, which explains the pixels worse,
    and a range of heights set by the masks, which these steps lack.
    """
    found = find_steps(traced(turn, height))
    (step,) = [s for s in found.steps if s.is_used]
    assert abs((step.falls_deg - turn + 180.0) % 360.0 - 180.0) < 1.0
    assert abs(step.height_um - PITCH * height) < 3.0 * step.height_std_um < 3.0 * 0.35 * PITCH * height
    raster = Raster.regular(found.patch.shape, PITCH, PITCH)
    flat = Surface(*np.zeros((3, *found.patch.shape)))
    region = regions(*(~cut for cut in walls_of(found, raster)))
    assert np.sum(np.bincount(region.ravel()) > 100) == 2
    numbers, anchors = anchors_of_steps(found, flat, raster, region)
    ((height_um, _),) = anchors.known_steps(np.where(found.patch == step.above, 1, 0)).values()
    assert numbers == (step.number,) and abs(height_um) == pytest.approx(step.height_um)


def test_a_wall_of_two_facets_that_faces_away_has_wide_error_bars(tmp_path):
    """Traced counts: the beam sees the upper facet at a glancing angle. Within 3 standard deviations of at most 40 %.

    Catches error bars for plane walls alone: 0.178 +- 0.029 pixels, truly 0.3.
    """
    turn, height, width = 20.0, 0.3, 0.4
    profile = [(-70.0, 0.0), (0.0, 0.0), (0.3 * width, -0.65 * height), (width, -height), (70.0, -height)]
    outline = PITCH * np.array([(70.0, -10.0), *profile[::-1], (-70.0, -10.0)])
    prism = manifold3d.Manifold.extrude(manifold3d.CrossSection([outline]), 140.0 * PITCH)
    solid = prism.translate([0.0, 0.0, -70.0 * PITCH]).rotate([90.0, 0.0, 0.0]).rotate([0.0, 0.0, turn]).to_mesh64()
    mesh = trimesh.Trimesh(np.asarray(solid.vert_properties)[:, :3], np.asarray(solid.tri_verts))
    mesh.export(tmp_path / "facets.ply")
    sample = {"kind": "mesh", "file": str(tmp_path / "facets.ply"), "unit": "um"}
    found = find_steps(counts_of(load_scene("step", SCAN | {"sample": sample}), turn, OBLIQUE))
    (step,) = [s for s in found.steps if s.is_used]
    assert abs(step.height_um - PITCH * height) < 3.0 * step.height_std_um < 3.0 * 0.4 * PITCH * height


def test_a_high_step_that_faces_away_is_not_measured_by_its_glow():
    """2 pixels high: its glow is wider than a low step's, by which it would be 1.6 +- 0.2 pixels high."""
    assert not [s for s in find_steps(traced(-33.0, 2.0)).steps if s.is_used]


def test_noise_and_dirt_make_no_line():
    """Dark and bright pixels anywhere, 0.2 to 3 % of each: no line in 60 images at either incidence, expected are 0.12.

    Rejects a count alone.
    """
    place = np.stack(np.meshgrid(*(np.arange(N) - 0.5 * (N - 1),) * 2), -1)
    v = np.stack([opening_of(a, NORMAL, 0.0).mean for a in NORMAL.apertures()])
    n_dark, n_bright = 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        counts = 1.0 + 0.03 * rng.standard_normal((3, N, N))
        counts[rng.random(counts.shape) < rng.choice([0.002, 0.01, 0.03])] *= 0.2
        counts[rng.random(counts.shape) < rng.choice([0.002, 0.01, 0.03])] *= 1.25
        dashes = find_dashes(counts, np.full(counts.shape, 0.03**2), np.ones(3), np.zeros(counts.shape, bool))
        n_dark, n_bright = n_dark + int(dashes.is_dark.sum()), n_bright + int(dashes.is_bright.sum())
        for shift in (np.zeros(2), np.array(OBLIQUE.beam_shift)):
            assert not find_line(dashes, place, v + shift, shift), seed
    assert n_dark > 1000 and n_bright > 1000


def test_a_scratch_is_no_step():
    """A line that is dark in all detectors, or in opposite ones in turn, is a groove: no step."""
    noise = 0.02
    stack = stack_of(1.0 + noise * np.random.default_rng(3).standard_normal((3, N, N)), noise)
    u = np.stack(np.meshgrid(stack.x, stack.y), -1) @ unit(20.0)
    groove = np.abs(u) < 0.25 * PITCH
    assert groove.sum() > 20
    counts = np.where(groove, 0.2, 1.0) * stack.counts
    assert not [s for s in find_steps(stack.replace(counts=counts)).steps if s.is_used]


@pytest.mark.parametrize("turn", [15.0, 200.0])
@pytest.mark.parametrize("line", ["narrow", "a pixel wide", "one detector", "ridge", "on a crease"])
def test_a_bright_line_is_no_step(turn, line):
    """Dirt, brighter in all detectors or in one, between sides of other signals, and a ridge whose sides face and turn
    from them: no step.

    Catches a step that explains such a line better than nothing: 0.03 to 0.8 pixels high, with errors of a fifth.
    """
    noise, normal, axis = 1.0 / 60.0, unit(turn), np.arange(N) - 0.5 * (N - 1)
    u = np.stack(np.meshgrid(axis, axis), -1) @ normal - 0.3
    counts = 1.0 + noise * np.random.default_rng(3).standard_normal((3, N, N))
    for k, aperture in enumerate(OBLIQUE.apertures()):
        toward = 0.25 * opening_of(aperture, OBLIQUE, 0.0).mean @ normal
        excess, half = {
            "narrow": (0.15, 0.25),
            "a pixel wide": (0.12, 0.5),
            "one detector": (0.15 * (k == 0), 0.3),
            "ridge": (toward * np.sign(u), 0.3),
            "on a crease": (0.2, 0.3),
        }[line]
        if line == "on a crease":
            counts[k] *= 1.0 + np.array([0.1, 0.1, 0.05])[k] * (u > 0.0)
        counts[k] *= 1.0 + excess * (np.abs(u) < half)
    assert not [s for s in find_steps(stack_of(counts, noise, OBLIQUE)).steps if s.is_used]


def test_a_region_tied_by_a_known_step_does_not_float_on_a_slope():
    """Two halves of equal medians, 4 um apart at their step: floating if nothing ties them, not if that is known.

    Tilts of both, which move their means but not what they are apart at the step, count for nothing.
    """
    x = np.arange(20.0)
    height = np.broadcast_to(np.where(x < 10, x, x - 10.0), (20, 20))
    region = np.broadcast_to(np.where(x < 10, 0, 1), (20, 20))
    samples = np.array([1.0, -1.0])[:, None, None] * (np.where(region == 1, 0.4, 0.0) + 0.3 * (x - 9.5))
    weight = ((x == 9) / 20.0 - (x == 10) / 20.0) * np.ones((20, 1)) / 0.8
    known = Anchors(weight[None], np.array([4.0 / 0.8]))
    (tied,) = known.known_steps(region).values()
    assert tied[0] == pytest.approx(4.0) and tied[1].sum(where=region == 0) == pytest.approx(1.0)
    assert floating(height, samples, region)[:, 10:].all()
    assert not floating(height, samples, region, steps=known.known_steps(region))[:, 10:].any()
    assert floating(height, 2.0 * samples, region, steps=known.known_steps(region))[:, 10:].all()
    assert known.known_steps(np.zeros_like(region)) == {}
