"""Cracks against closed forms and the tracer: slits, grooves, creases, steps, and other lines."""

import csv
import json
import math

import numpy as np
import pytest
from scipy import special, stats
from stats import assert_likely
from test_lines import AXIS, GRID_X, GRID_Y, NOISE, PITCH, SIZE, instrument, make_stack, nuisance

from helio_jax.errors import SceneError
from helio_jax.measure.crack_text import table
from helio_jax.measure.cracks import find_cracks
from helio_jax.reconstruction import REASONS, Reconstruction
from helio_jax.workflows.measure import Wanted, measure_height_map

EVERYWHERE = np.ones((SIZE, SIZE), bool)
TURN = math.radians(33.0)
ACROSS = -math.sin(TURN) * GRID_X + math.cos(TURN) * GRID_Y - 41.0
ALONG = math.cos(TURN) * GRID_X + math.sin(TURN) * GRID_Y
LENGTH = 700.0


def make_rec(height=0.0, noise=0.1, reason="valid") -> Reconstruction:
    """A height map with 12 posterior samples of white noise [um]."""
    shape, k = (SIZE, SIZE), REASONS.index(reason)
    up = np.zeros((*shape, 3)) + [0.0, 0.0, 1.0]
    samples = noise * np.random.default_rng(2).standard_normal((12, *shape))
    rec = Reconstruction(
        np.zeros(shape) + height, AXIS, AXIS, instrument(), "refine", up, np.ones(shape), np.full(shape, k == 0),
        np.full(shape, k), height_samples=samples,
    )  # fmt: skip
    return rec


def shaped(slope) -> np.ndarray:
    """Contrast of a surface with slope(ACROSS) along the normal of the lines here, to first order [detector, y, x]."""
    u = np.array([-math.sin(TURN), math.cos(TURN)])
    return np.stack([-slope * (u @ a.center) / instrument().sample_distance for a in instrument().apertures()])


def slit(depth=(0.5, 0.4, 0.6), width=40.0, length=LENGTH, blur=10.0) -> np.ndarray:
    """Contrast of a line that is darker by `depth` in each detector, `width` wide, blurred [detector, y, x]."""
    root = math.sqrt(2.0) * blur
    box = 0.5 * (special.erf((ACROSS + 0.5 * width) / root) - special.erf((ACROSS - 0.5 * width) / root))
    return -np.array(depth)[:, None, None] * box * (np.abs(ALONG) < 0.5 * length)


def test_a_slit_is_measured():
    """16 seeds of noise with drift, scan lines and ripple: one slit each, in its place; length and missing signal.

    True: 700 um long, 40 um wide, missing 20, 16 and 24 um. The pulls' sum of squares is chi-square for errors up to
    1.6 times the stated ones, the width is within 5 um. Catches the filter's length added to the line (+100 um), a
    missing signal without the pixel's size, errors of one pixel, and a fit of the line's bottom as its surroundings.
    """
    lengths, missing, widths = [], [], []
    for seed in range(16):
        found = find_cracks(make_rec(), make_stack(slit() + nuisance(seed), seed), EVERYWHERE)
        (c,) = found.counted
        assert c.kind == "slit" and c.dark_in == ("forward", "left", "right") and c.false_alarms < 1e-6
        assert c.direction_deg == pytest.approx(33.0, abs=3.0)
        x, y = c.points.T
        assert np.max(np.abs(-math.sin(TURN) * x + math.cos(TURN) * y - 41.0)) < 0.8 * PITCH
        lengths.append((c.length_um - LENGTH) / c.length_std_um)
        widths.append(c.width_um)
        missing += [
            (v - true) / c.missing_std_um[n] for (n, v), true in zip(c.missing_um.items(), (20, 16, 24), strict=True)
        ]
    for name, z in (("length", np.array(lengths)), ("missing signal", np.array(missing))):
        tail = stats.chi2(z.size).sf(np.sum(z**2) / 1.6**2)
        assert_likely(tail, f"pulls of the {name}: {np.sqrt(np.mean(z**2)):.2f} instead of 1")
        assert np.sqrt(np.mean(z**2)) > 0.3
    assert np.nanmean(widths) == pytest.approx(40.0, abs=5.0)


def test_other_lines_are_not_counted():
    """Noise, drift, scan lines and ripple alone: nothing. A bright line, a ridge: not counted.

    A line in one detector only is rejected. Catches lines judged by their score alone, the sign of the kink, and the
    sign of the contrast.
    """
    for seed in range(4):
        assert find_cracks(make_rec(), make_stack(nuisance(seed), 50 + seed), EVERYWHERE).counted == ()
    alone = find_cracks(make_rec(), make_stack(slit((0.0, 0.5, 0.0)), 1), EVERYWHERE)
    assert alone.cracks == () and alone.left_out >= 1
    bright = find_cracks(make_rec(), make_stack(slit((-0.5, -0.5, -0.5)), 1), EVERYWHERE)
    assert bright.counted == () and [c.kind for c in bright.cracks][:1] == ["line"]
    ridge = find_cracks(make_rec(), make_stack(shaped(-0.3 * np.tanh(ACROSS / 20.0)), 1), EVERYWHERE)
    assert ridge.counted == () and ridge.n_ridges >= 1


def groove_height(width: float, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights of a groove across the field, -slope width exp(-|t| / width), and its slope along the normal."""
    t = ACROSS / width
    return -slope * width * np.exp(-np.abs(t)), slope * np.sign(t) * np.exp(-np.abs(t))


@pytest.mark.parametrize("reason", ["valid", "floating"])
def test_a_groove_is_measured(reason):
    """Depth 18 um, kink 2 x 0.2, also where the level floats; depth below shoulders 12 pixels away 16.2 um.

    Full width at half of that depth 83 um (both closed forms). Catches heights discarded where only their level
    floats, the depth below one shoulder, and the slope of one flank reported as the kink.
    """
    height, slope = groove_height(90.0, 0.2)
    found = find_cracks(make_rec(height, reason=reason), make_stack(shaped(slope), 4), EVERYWHERE)
    c = found.cracks[0]
    assert c.kind == "groove" and c.direction_deg == pytest.approx(33.0, abs=2.0)
    at_bottom, at_shoulder = math.exp(-0.05), math.exp(-240.0 / 90.0)  # mean over the bin at the bottom
    assert c.depth_um == pytest.approx(18.0 * (at_bottom - at_shoulder), rel=0.06)
    half = -90.0 * math.log(0.5 * (at_bottom + at_shoulder))
    assert c.width_um == pytest.approx(2.0 * half, abs=2.0 * c.width_std_um + 6.0)
    assert c.kink_deg == pytest.approx(math.degrees(math.atan(0.4)), abs=4.0 * c.kink_std_deg + 2.5)
    assert [k for k in found.counted if k.number != c.number] == []


def test_a_crease_and_a_step_are_not_counted():
    """The foot of a slope is a crease; a sharp edge of 15 um between planes is a step of that height; neither counts.

    Catches a step classified as a slit (it is dark in one or two detectors), a foot classified as a groove, also for
    rough heights without deviations.
    """
    foot = np.where(ACROSS > 0.0, 0.3, 0.0)
    found = find_cracks(make_rec(np.maximum(ACROSS, 0.0) * 0.3), make_stack(shaped(foot), 5), EVERYWHERE)
    assert found.counted == () and found.cracks[0].kind == "crease"
    rough = np.maximum(ACROSS, 0.0) * 0.3 + 5.0 * np.random.default_rng(8).standard_normal((SIZE, SIZE))
    found = find_cracks(make_rec(rough).replace(height_samples=None), make_stack(shaped(foot), 5), EVERYWHERE)
    assert found.counted == () and found.cracks[0].kind == "crease"
    edge = 15.0 * np.exp(-0.5 * (ACROSS / 12.0) ** 2) / (12.0 * math.sqrt(2.0 * math.pi))
    found = find_cracks(make_rec(), make_stack(shaped(edge), 6), EVERYWHERE)
    assert found.counted == () and found.cracks[0].kind == "step"
    assert found.cracks[0].depth_um == pytest.approx(15.0, abs=3.0 * found.cracks[0].depth_std_um + 0.7)


@pytest.mark.parametrize(("azimuth", "kind"), [(45.0, "slit"), (90.0, "slit"), (120.0, "slit"), (75.0, "line")])
def test_traced_slits(azimuth, kind):
    """Traced slits of 40 x 200 x 500 um, noise of the measured salt: detected with their length and direction.

    The bound of the depth is below the depth, and no detector lacks more than the opening. Illuminated walls make one
    of them bright in two detectors: it is a line, not a slit. Length: within 3 deviations. Catches a slit's brightness
    assumed constant along it (400 instead of 500 um at 120 deg), a bound without the beam's slant, and a detection that
    works for the synthetic profiles of the tests only.
    """
    from pathlib import Path

    import helio_jax as hx

    scene = hx.load_scene(
        Path(__file__).resolve().parents[2] / "scenes" / "measured_salt.toml",
        {
            "sample": {"kind": "trench", "width_um": 40.0, "length_um": 500.0, "depth_um": 200.0, "size_um": 8000.0},
            "sample.azimuth_deg": azimuth,
            "sample.center_um": [7.0, 3.0],
            "scan.nx": 61,
            "scan.ny": 61,
            "trace.rays": 64,
        },
    )
    stack = hx.simulate(scene)
    std = np.array(NOISE)[:, None, None] * np.median(stack.counts, axis=(1, 2), keepdims=True)
    noisy = stack.counts + std * np.random.default_rng(1).standard_normal(stack.shape)
    stack = stack.replace(counts=noisy, variance=np.broadcast_to(std**2, stack.shape), n_rays=1.0, by_order=None)
    shape = stack.shape[1:]
    up = np.zeros((*shape, 3)) + [0.0, 0.0, 1.0]
    flat = Reconstruction(
        np.zeros(shape), stack.x, stack.y, stack.instrument, "linear", up, np.ones(shape), np.ones(shape, bool),
        np.zeros(shape, int),
    )  # fmt: skip
    c = find_cracks(flat, stack, np.ones(shape, bool)).cracks[0]
    assert c.kind == kind and c.false_alarms < 1e-20
    turned = (c.direction_deg - azimuth + 90.0) % 180.0 - 90.0
    assert abs(turned) < 4.0
    assert c.length_um == pytest.approx(500.0, abs=3.0 * c.length_std_um)
    assert 0.0 <= c.depth_at_least_um < 200.0
    assert all(v < 40.0 + 3.0 * c.missing_std_um[n] for n, v in c.missing_um.items())
    if kind == "slit":
        assert c.depth_at_least_um > 1.0


def test_command_reports_cracks(tmp_path):
    """Record, lines, figure and table of cracks and edges; wrong combinations of options are refused with a remedy.

    The length per area is that of the one slit over the region; a region that ends across the slit cuts it. Catches the
    area of the whole raster, and a line that runs out of the region.
    """
    stack = make_stack(slit(), 2)
    wanted = Wanted(cracks=True, vertical_edges=True, regions=("-600,-600 600,600",), table=True)
    found, lines = measure_height_map(make_rec(), wanted, tmp_path / "c.png", stack)
    record = json.loads(json.dumps(found))["cracks"]
    assert record["n_cracks"] == 1 and record["area_mm2"] == pytest.approx(1.2**2, rel=0.05)
    assert record["length_per_area_per_mm"] == pytest.approx(0.7 / 1.44, rel=0.15)
    assert any("slit" in line for line in lines) and (tmp_path / "c.png").stat().st_size > 10_000
    assert not record["lines"][0]["is_cut"]
    half, lines = measure_height_map(make_rec(), Wanted(cracks=True, regions=("-600,-600 0,600",)), None, stack)
    cut = half["cracks"]["lines"][0]
    assert cut["is_cut"] and 250.0 < cut["length_um"] < 400.0 and any("cut by the region" in line for line in lines)
    rows = list(csv.DictReader(table(found).splitlines()))
    assert rows[0]["kind"] == "slit" and float(rows[0]["length_um"]) == pytest.approx(700.0, abs=60.0)
    assert float(rows[0]["left"]) == pytest.approx(16.0, abs=4.0) and rows[0]["depth_um"] == ""
    for wrong, has_stack, words in (
        (Wanted(cracks=True), False, "--stack"),
        (Wanted(texture=True, table=True), False, "--table"),
        (Wanted(vertical_edges=True), True, "--stack"),
        (Wanted(), False, "--cracks"),
    ):
        with pytest.raises(SceneError, match=words):
            measure_height_map(make_rec(), wrong, None, stack if has_stack else None)
    with pytest.raises(SceneError, match="--figure"):
        measure_height_map(make_rec(), Wanted(cracks=True, ripple=True), tmp_path / "d.png", stack)
    smaller = stack.replace(
        counts=stack.counts[:, 1:], variance=np.ones((3, SIZE - 1, SIZE)), y=AXIS[1:], is_observed=None
    )
    with pytest.raises(SceneError, match="80 x 79 pixels"):
        find_cracks(make_rec(), smaller, EVERYWHERE)
