"""Steps from mask bands: closed forms, rasters drawn by an independent mask test, traced terraces, false alarms."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner

import helio_jax.__main__  # noqa: F401 (registers the commands)
from benchmarks.shapes import members
from helio_jax.commands.app import app
from helio_jax.errors import SceneError
from helio_jax.formats.hdf5 import write
from helio_jax.inverse.mask_edges import Edge
from helio_jax.inverse.mask_patches import find_patches, solve_levels
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.inverse.step_parts import steps_in_parts
from helio_jax.inverse.step_records import Steps
from helio_jax.inverse.wall_signal import opening_of, wall_signal
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_instrument, load_scene
from helio_jax.workflows.steps import measure_steps, steps_table
from tests.stats import assert_likely
from tests.terraces import ROOT, draw, trace

INSTRUMENTS = ROOT / "scenes" / "instruments"
OBLIQUE = load_instrument(INSTRUMENTS / "bshem_wd4.toml")
NORMAL = OBLIQUE.model_copy(update={"beam": OBLIQUE.beam.model_copy(update={"incidence_deg": 0.0})})
PITCH = 10.0
NOISE = 0.02


def unit(degrees: float) -> np.ndarray:
    return np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])


def mesa(
    height: float, turn: float, n: int = 61, width: float = 260.0, center=(0.0, 0.0), seed: int = 0, sign: float = 1.0
) -> MicrographStack:
    """Draw a square mesa for a normal beam: a point sees an aperture's part unless a segment to it meets the mesa.

    Segments against a rectangle by slabs, without the code under test; no multiple scattering. `sign` -1 puts the masks
    on the wrong side.
    """
    rng = np.random.default_rng(seed)
    axis = PITCH * (np.arange(n) - 0.5 * (n - 1)) + rng.uniform(-0.5, 0.5) * PITCH
    x, y = np.meshgrid(axis, axis)
    rotation = np.stack([unit(turn), unit(turn + 90.0)])
    place = (np.stack([x, y], -1) - center) @ rotation.T
    is_top = np.max(np.abs(place), -1) < 0.5 * width
    images = []
    for aperture in NORMAL.apertures():
        tau = sign * directions(aperture)
        enter, leave = np.zeros((n, n, len(tau))), np.full((n, n, len(tau)), height)
        for k in (0, 1):
            rate = (tau @ rotation.T)[:, k]
            ends = np.sort([(e - place[..., k, None]) / rate for e in (-0.5 * width, 0.5 * width)], 0)
            enter, leave = np.maximum(enter, ends[0]), np.minimum(leave, ends[1])
        images.append(image(is_top, enter >= leave, tau, rng))
    return noisy(np.stack(images), axis)


def directions(aperture) -> np.ndarray:
    """Horizontal directions to 300 points of an aperture per unit of height [point, 2]."""
    s, r = np.pi * (3.0 - math.sqrt(5.0)) * np.arange(300), np.sqrt((np.arange(300) + 0.5) / 300)  # sunflower
    local = r[:, None] * np.stack([np.cos(s), np.sin(s)], -1) * aperture.semi_axes
    turned = local @ np.stack([unit(math.degrees(aperture.rotation)), unit(math.degrees(aperture.rotation) + 90.0)])
    return (turned + aperture.center) / NORMAL.working_distance


def image(is_top: np.ndarray, is_lit: np.ndarray, tau: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw a detector's image with noise [y, x], of the points that are lit from each direction [y, x, point]."""
    weight = (1.0 + np.sum(tau**2, -1)) ** -2.0
    lit = np.where(is_lit, weight, 0.0).sum(-1) / weight.sum()
    return np.where(is_top, 1.0, lit) + NOISE * rng.standard_normal(is_top.shape)


def noisy(counts: np.ndarray, axis: np.ndarray) -> MicrographStack:
    """Make a stack of drawn images [detector, y, x]."""
    return MicrographStack(
        counts, axis, axis, NORMAL, variance=np.full(counts.shape, NOISE**2), background=np.zeros(3), noise="poisson"
    )


def disc(height: float, radius: float, n: int = 81, seed: int = 0) -> MicrographStack:
    """Draw a round mesa as `mesa`: segments against a cylinder."""
    rng = np.random.default_rng(seed)
    axis = PITCH * (np.arange(n) - 0.5 * (n - 1))
    x, y = np.meshgrid(*(axis - shift for shift in rng.uniform(-0.5, 0.5, 2) * PITCH))
    images = []
    for aperture in NORMAL.apertures():
        tau = directions(aperture)
        square = np.sum(tau**2, -1)
        along = x[..., None] * tau[:, 0] + y[..., None] * tau[:, 1]
        inside = along**2 - square * (x**2 + y**2 - radius**2)[..., None]
        enter, leave = ((-along + way * np.sqrt(np.maximum(inside, 0.0))) / square for way in (-1.0, 1.0))
        is_masked = (inside > 0.0) & (leave > 0.0) & (enter < height)
        images.append(image(np.hypot(x, y) < radius, ~is_masked, tau, rng))
    return noisy(np.stack(images), axis)


def flat(seed: int, noise: float = 0.05, n: int = 61) -> MicrographStack:
    """Return noise on a level surface."""
    counts = 1.0 + noise * np.random.default_rng(seed).standard_normal((3, n, n))
    axis = PITCH * np.arange(n)
    return MicrographStack(counts, axis, axis, OBLIQUE, variance=np.full(counts.shape, noise**2))


@pytest.mark.parametrize("instrument", [NORMAL, OBLIQUE], ids=["normal", "oblique"])
def test_mean_length_is_height_times_v(instrument):
    """Where the whole aperture is masked at the foot, the band along n is -v . n long at any orientation.

    Catches the sign of the beam shift, of the detector's direction, and the wall's image forgotten or counted twice.
    """
    found = 0
    for aperture in instrument.apertures():
        opening = opening_of(aperture, instrument, 0.0)
        v = opening.mean + instrument.beam_shift
        assert np.hypot(*opening.mean) == pytest.approx(math.tan(math.radians(30.0)), rel=0.03)
        for degrees in range(0, 360, 7):
            signal = wall_signal(opening, instrument.beam_shift, unit(degrees))
            if signal.dark_share > 0.9999:
                found += 1
                assert signal.length == pytest.approx(-v @ unit(degrees), rel=1e-9)
    assert found > 30


def test_forward_detector_of_an_oblique_beam():
    """Upstream wall: the wall's image (tan 30 deg) and the mask (about tan 30 deg) add up; downstream: no band."""
    opening = opening_of(OBLIQUE.apertures()[0], OBLIQUE, 0.0)
    upstream, downstream = (wall_signal(opening, OBLIQUE.beam_shift, unit(a)) for a in (180.0, 0.0))
    assert upstream.strip == pytest.approx(math.tan(math.radians(30.0)))
    assert upstream.length == pytest.approx(2.0 * math.tan(math.radians(30.0)), rel=0.02)
    assert downstream.dark_share == 0.0 and downstream.length == pytest.approx(0.0, abs=1e-12)


def test_multiple_scattering_beside_a_wall():
    """Close to the foot a fully lit level sends half of its atoms onto the wall, which is as bright as (1 + 1/2 + ...).

    A wall that no detector sees directly, on a level that is lit up to its foot: first order 1/2 on the wall. The
    radiosity of a right angle is largest at the corner and vanishes far away. Catches a wrong kernel.
    """
    opening = opening_of(NORMAL.apertures()[0], NORMAL, 0.0)
    grazing = replace(opening, tau=1e-4 * opening.tau)
    signal = wall_signal(grazing, (0.0, 0.0), unit(180.0))
    assert 0.5 < signal.on_wall(np.array([0.5])).item() < 0.65
    level = signal.on_level(np.array([0.05, 0.5, 2.0, 10.0]))
    assert np.all(np.diff(level) < 0) and level[-1] < 0.005


def used(found: Steps) -> list:
    return [s for s in found.steps if s.is_used]


@pytest.mark.parametrize(("height", "turn"), [(60.0, 15.0), (110.0, 40.0), (35.0, 73.0)])
def test_drawn_mesa(height, turn):
    """Edges that fall outwards, by the height drawn, and one patch of that level.

    All four, but for one that may be "no free wall": the images lack the multiple scattering that the model expects.
    Catches wrong directions of bands, half-level lengths in place of integrated ones, and leaking patches.
    """
    found = find_steps(mesa(height, turn))
    assert len(used(found)) >= 3 and {s.note for s in found.steps} <= {"", "curved", "not determined"}
    sides = [(s.falls_deg - turn) / 90.0 for s in used(found)]
    assert len({round(side) % 4 for side in sides}) == len(sides)
    assert sides == pytest.approx([round(side) for side in sides], abs=0.025)
    for s in used(found):
        assert abs(s.height_um - height) < max(4.0 * s.height_std_um, 0.03 * height)
    assert [p.pixels > 9 for p in found.patches] == [True, True]
    top = found.patches[1]
    assert top.pixels == pytest.approx((260.0 / PITCH) ** 2, rel=0.04) and top.is_determined
    assert top.level_um == pytest.approx(height, rel=0.02) and abs(top.level_um - height) < 4.0 * top.level_std_um
    assert np.nanmax(found.level) == top.level_um and found.level_std.min() == 0.0
    assert found.is_masked.any((1, 2)).all()


def test_round_outlines_have_right_heights():
    """12 discs of 12 to 32 pixels' radius: the mean error is below 0.9 % of the height; measured 0.7 %.

    Rejects edges taken for straight: the bands of their chords are 0.1 pixel too long, heights 1.6 % too high.
    """
    rng, error = np.random.default_rng(7), []
    for seed in range(12):
        height = rng.uniform(60.0, 120.0)
        found = find_steps(disc(height, rng.uniform(120.0, 320.0), seed=seed))
        levels = [p for p in found.patches[1:] if p.is_determined]
        assert len(levels) == 1 and abs(levels[0].level_um - height) < 4.0 * levels[0].level_std_um
        error.append(levels[0].level_um / height - 1.0)
    assert abs(np.mean(error)) < 0.009, error


def test_parts_of_an_edge_have_their_own_heights():
    """Edges of a mesa 60 um high in images where one end is 80 um high: part by part, to 4 standard deviations.

    Parts near the joint and the corners do not count. Rejects the height of the whole edge.
    """
    low, high = (mesa(height, 0.0, n=91, width=600.0, seed=3) for height in (60.0, 80.0))
    counts = np.where(low.y[:, None] < 0.0, low.counts, high.counts)
    stack = replace(low, counts=counts)
    measured = set()
    for parts in steps_in_parts(find_steps(low), stack):
        for part in parts.steps:
            y = 0.5 * (part.start[1] + part.end[1])
            if abs(math.cos(math.radians(part.falls_deg))) < 0.9 or not 80.0 < abs(y) < 250.0:
                continue
            measured.add(y < 0.0)
            height, std = 60.0 if y < 0.0 else 80.0, part.height_std_um
            assert abs(part.height_um - height) < 4.0 * std and std < 5.0, (y, part.height_um, std)
            assert {b.step for b in parts.bands} == {s.number for s in parts.steps}
    assert measured == {True, False}


def test_heights_have_honest_error_bars():
    """12 mesas without multiple scattering, which the model expects: deviations from the truth over the stated ones."""
    rng = np.random.default_rng(4)
    pulls = []
    for seed in range(12):
        height = rng.uniform(30.0, 120.0)
        found = find_steps(mesa(height, rng.uniform(0.0, 360.0), seed=seed, n=55, width=rng.uniform(180.0, 280.0)))
        pulls += [(s.height_um - height) / s.height_std_um for s in used(found)]
    z = np.array(pulls)
    assert len(z) > 30
    assert_likely(float(chi2.sf(np.sum(np.minimum(np.abs(z), 3.0) ** 2), len(z))), "pulls of step heights")
    assert 0.4 < np.median(np.abs(z)) / 0.674 < 1.5 and np.mean(np.abs(z) < 3.0) > 0.95


def test_masks_on_the_wrong_side_give_no_steps():
    """Masks mirrored about the apertures' foot point: nothing is used. Catches a test that any dark band passes."""
    for turn in (15.0, 40.0):
        found = find_steps(mesa(60.0, turn, sign=-1.0))
        assert not any(p.is_determined for p in found.patches[1:])
        assert all(abs(s.height_um - 60.0) > 10.0 for s in used(found))


def test_flat_noise_has_no_steps():
    """40 level images, SNR 20 and 6: no edge at all; a false alarm takes three connected pixels 6 deviations low."""
    for seed in range(20):
        assert find_steps(flat(seed)).steps == ()
        found = find_steps(flat(seed, noise=0.05, n=31))
        assert found.steps == () and found.patch.max() == 0 and not found.is_masked.any()


def test_border_cuts_a_band():
    """A band that leaves the image is a lower bound, or not used; never a wrong height."""
    stack = mesa(120.0, 15.0, center=(-130.0, 0.0))
    found = find_steps(stack)
    left = [s for s in found.steps if abs(s.falls_deg) > 150.0]
    assert left
    for s in left:
        assert not s.is_used or abs(s.height_um - 120.0) < 4.0 * s.height_std_um
        assert not s.is_lower_bound or s.height_um < 123.0


def test_unknown_pedestal_and_gain():
    """Gains 0.7-1.4 and pedestals of 10-30 % of the signal, not stated: the same heights."""
    stack = mesa(80.0, 25.0)
    gain, pedestal = np.array([1.0, 0.7, 1.4])[:, None, None], np.array([0.3, 0.1, 0.2])[:, None, None]
    assert stack.variance is not None
    changed = stack.replace(counts=gain * (stack.counts + pedestal), variance=gain**2 * stack.variance, background=None)
    (top,) = find_steps(changed).patches[1:]
    assert top.level_um == pytest.approx(80.0, rel=0.03) and abs(top.level_um - 80.0) < 4.0 * top.level_std_um


@pytest.mark.parametrize(
    "fixed",
    [
        {"outline": "square", "incidence": 30.0, "turn": 15.0, "height": 60.0, "width": 300.0},
        {"outline": "two", "incidence": 0.0, "turn": 25.0, "height": 120.0, "width": 360.0, "second": 0.55},
        {"outline": "L", "incidence": 0.0, "turn": 33.0, "height": -50.0, "width": 360.0},
    ],
    ids=["oblique mesa", "two levels", "pit"],
)
def test_traced_terraces(fixed, tmp_path):
    """The tracer's own masks, shadows and multiple scattering: every determined level to 2 % and 4 deviations."""
    member = draw(np.random.default_rng(7), n=65, pixel=10.0, snr=60.0, **fixed)
    found = find_steps(trace(member, tmp_path, rays=96))
    true = sorted({round(z, 6) for z in member["levels"]}, key=abs)
    levels = sorted((p for p in found.patches[1:] if p.pixels > 20), key=lambda p: abs(p.level_um))
    assert [p.is_determined for p in levels] == [True] * len(true)
    for patch, z in zip(levels, true, strict=True):
        assert patch.level_um == pytest.approx(z, rel=0.02) and abs(patch.level_um - z) < 4.0 * patch.level_std_um


def test_traced_sphere_is_no_wall(tmp_path):
    """A half ball on the substrate: its limb is gradual. Catches any dark region taken for a wall's mask."""
    path = tmp_path / "ball.toml"
    path.write_text(
        (INSTRUMENTS / "bshem_wd4.toml").read_text() + '\n[sample]\nkind = "spheres"\n[[sample.spheres]]\n'
        "radius_um = 150.0\ncap_height_um = 150.0\n[scan]\nnx = 61\nny = 61\npixel_size_um = 10.0\n"
        "atoms_per_pixel = 200000.0\n[trace]\nrays = 64\n"
    )
    scene = load_scene(path)
    found = find_steps(pipeline.record(scene, pipeline.simulate(scene)))
    assert used(found) == [] and not any(p.is_determined and p.number for p in found.patches)
    assert found.is_masked.any()


def test_levels_from_steps():
    """Two patches above the first; one step disagrees grossly and loses weight; a patch without a step stays open."""
    above, below = np.array([1, 1, 2, 2, 1]), np.array([0, 0, 1, 0, 0])
    found = solve_levels(4, above, below, np.array([10.0, 10.2, 5.0, 15.0, 30.0]), np.full(5, 0.2))
    assert found.level[:3] == pytest.approx([0.0, 10.1, 15.1], abs=0.4) and found.std[0] == 0.0
    assert math.isnan(found.level[3]) and math.isnan(found.std[3])
    assert found.dof == 3 and found.chi2 > 1000.0


def test_patch_without_one_side():
    """Three sides of a square of jumps: the fourth side is closed straight. Catches a patch that leaks."""
    edges = [s for s in find_steps(mesa(60.0, 15.0)).steps if abs(s.falls_deg - 15.0) > 5.0]
    place = np.stack(np.meshgrid(*(PITCH * (np.arange(61) - 30.0),) * 2), -1)
    lines = [Edge(np.array(s.start), np.array(s.end), (0,)) for s in edges]
    patch = find_patches(lines, np.full(3, 60.0), place, PITCH)
    assert np.sum(patch == 1) == pytest.approx((260.0 / PITCH) ** 2, rel=0.08)


def test_strip_beside_an_edge_is_no_patch():
    """A wall found twice, 1.6 pixels apart, with half of its height each. Catches a level for the strip between."""
    x, half = PITCH * (np.arange(41) - 20.0), 100.0
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    lines = [Edge(a, b, (0,)) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    lines.append(Edge(corners[0] + [0.0, 1.6 * PITCH], corners[1] + [0.0, 1.6 * PITCH], (0,)))
    patch = find_patches(lines, np.array([30.0, 60.0, 60.0, 60.0, 30.0]), np.stack(np.meshgrid(x, x), -1), PITCH)
    assert set(np.unique(patch)) == {0, 1}
    assert np.sum(patch == 1) == pytest.approx((2.0 * half / PITCH) ** 2, rel=0.15)


def test_command(tmp_path):
    """Text, JSON, table and picture; nothing of a height map goes with --steps (exit code 2)."""
    file = tmp_path / "mesa.h5"
    write(mesa(60.0, 15.0), file)
    run = CliRunner().invoke
    table, picture = tmp_path / "steps.csv", tmp_path / "steps.png"
    found = run(app, ["measure", "--steps", str(file), "--json", "--table", str(table), "--figure", str(picture)])
    assert found.exit_code == 0, found.output
    record = json.loads(found.stdout)
    assert len(record["steps"]) == 4 and record["patches"][1]["level_um"] == pytest.approx(60.0, rel=0.03)
    rows = table.read_text().splitlines()
    assert rows[0].startswith("step,x0_um") and len(rows) == 1 + max(len(record["bands"]), 4)
    assert picture.stat().st_size > 20_000
    text = run(app, ["measure", "--steps", str(file)])
    assert "4 with a measured height" in text.stdout and "+- " in text.stdout
    wrong = run(app, ["measure", "--steps", "--facets", str(file)])
    assert isinstance(wrong.exception, SceneError) and "--steps measures micrographs" in str(wrong.exception)


def test_table_of_no_steps_and_small_rasters():
    """A stack without steps has a table of a header; a raster of a few pixels is refused."""
    record, lines = measure_steps(flat(0))
    assert steps_table(record).count("\n") == 1 and lines[0].startswith("steps: 0 edges")
    with pytest.raises(SceneError, match="8 x 8"):
        find_steps(flat(0, n=6))


def test_images_of_several_beams_are_refused():
    """A mesa, one image of which another beam took: its bands run elsewhere. Catches heights by the wrong beam."""
    stack = mesa(60.0, 15.0)
    other = stack.instrument.detector[0].model_copy(update={"beam_deg": (30.0, 90.0)})
    instrument = stack.instrument.model_copy(update={"detector": (other, *stack.instrument.detector[1:])})
    with pytest.raises(SceneError, match="one beam"):
        find_steps(stack.replace(instrument=instrument))


def test_a_band_narrower_than_a_pixel_does_not_hide_an_edge(tmp_path):
    """A traced step 10 pixels high, whose band is 7 pixels wide in one detector and half a pixel in another.

    Catches points of the narrow band, whose normals follow the raster, that break up the edge of the wide one.
    """
    (member,) = members("slot", 6021, range(1), (61, 61))
    scene = load_scene(member.write(tmp_path), {"trace.rays": 64})
    stack = pipeline.record(scene, pipeline.simulate(scene))
    assert isinstance(stack, MicrographStack)
    (step,) = used(find_steps(stack))
    assert abs(step.height_um - member.about["height_um"]) < 4.0 * step.height_std_um < 0.15 * step.height_um
