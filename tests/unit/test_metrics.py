"""Scores in closed form, on a sphere cap (R = 1000 um, H = 720 um) under a beam of 30 deg along +x."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sphere_case import CAP, TAN, first_hit, make_case

from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.scores.metrics import (
    SCORE_ROWS,
    Region,
    Truth,
    axis_distance,
    evaluate_height,
    fit_center,
    height_error,
    normal_angle,
)


@pytest.fixture(scope="module")
def case():
    return make_case()


def in_region(rec, truth):
    return axis_distance(rec, truth.height, truth.region.center) <= truth.region.radius


def test_truth_scores_zero(case):
    """Catches: any offset between the two rasters, a level determined on the sphere, H taken from the pixels."""
    _, rec, truth = case
    s = evaluate_height(rec, truth)
    for name in ("rms_region", "rms_image", "rms_valid", "ring_error", "mean_error", "p95_error", "max_error"):
        assert getattr(s, name) == 0.0, name
    assert (s.slope_rms, s.slope_median, s.level_um, s.H_um) == (0.0, 0.0, 0.0, CAP)
    # the apex of the sphere is sampled to 20 um in X and Y: h falls short by at most (20^2 + 20^2)/(2 R) = 0.4 um
    assert 1 - 0.4 / CAP <= s.recovered_height <= 1.0
    assert s.shape_error < 0.4 / CAP
    assert s.pull_std is None and s.coverage_1 is None


def test_scaled_height_has_analytic_errors(case):
    """rec = 0.85 true: RMS = 0.15 sqrt(mean(true^2)) / H. Catches: RMS without the square or the root, a mean over
    the wrong pixels, a shape error that is fitted to something else than flat and top (here it must vanish)."""
    _, rec, truth = case
    s = evaluate_height(rec.replace(height=0.85 * truth.height), truth)
    part = truth.height[in_region(rec, truth)]
    assert s.recovered_height == pytest.approx(0.85, abs=0.4 / CAP)
    assert s.recovered_height_um == pytest.approx(0.85 * truth.height.max())
    assert s.rms_region == pytest.approx(0.15 * np.sqrt(np.mean(part**2)) / CAP)
    assert s.rms_image == pytest.approx(0.15 * np.sqrt(np.mean(truth.height**2)) / CAP)
    assert s.rms_valid == pytest.approx(0.15 * np.sqrt(np.mean(truth.height[rec.is_valid] ** 2)) / CAP)
    assert s.mean_error == pytest.approx(-0.15 * part.mean() / CAP)
    assert s.lowest_error == pytest.approx(-0.15 * part.max() / CAP) and s.highest_error == pytest.approx(0.0)
    assert s.max_error == -s.lowest_error
    assert s.p95_error == pytest.approx(0.15 * np.percentile(part, 95) / CAP)
    assert s.shape_error < 0.4 / CAP
    assert s.n_pixels == part.size


def test_piston_does_not_count(case):
    """Catches: a level that is not subtracted, or subtracted with the wrong sign."""
    _, rec, truth = case
    a = evaluate_height(rec.replace(height=0.9 * truth.height), truth)
    b = evaluate_height(rec.replace(height=0.9 * truth.height + 37.5), truth)
    assert b.level_um == pytest.approx(37.5)
    names = ("rms_region", "rms_image", "shape_error", "recovered_height", "mean_error", "ring_error")
    assert all(getattr(a, n) == pytest.approx(getattr(b, n), abs=1e-12) for n in names)


def test_level_is_of_the_substrate_only(case):
    """A skirt of +50 um between 1.05 and 1.4 mm must not move the level. Catches: a level from the whole image or
    from outside the scored region."""
    _, rec, truth = case
    r = axis_distance(rec, truth.height, (0.0, 0.0))
    skirt = np.where((r > 1050) & (r <= 1400), 50.0, 0.0)
    assert evaluate_height(rec.replace(height=truth.height + skirt), truth).level_um == 0.0


def test_error_map_has_orientation(case):
    """A bump at +x, +y appears there. Catches: a transposed, flipped or sign-changed error map."""
    _, rec, truth = case
    bump = np.zeros_like(truth.height)
    bump[-5, -9] = 12.0
    error, _ = height_error(rec.replace(height=truth.height + bump), truth)
    row, column = np.unravel_index(np.argmax(error), error.shape)
    assert (rec.raster_x[column], rec.raster_y[row]) == (rec.raster_x[-9], rec.raster_y[-5])
    assert rec.raster_x[column] > 0 and rec.raster_y[row] > 0 and error[row, column] == 12.0


def test_region_follows_the_true_hit(case):
    """The apex is seen at X = +H tan t, and the region is a circle in the sample, not in the raster. Catches: a
    region from raster positions, from the reconstructed heights, or with the shift's sign wrong."""
    _, rec, truth = case
    truth = replace(truth, region=Region(CAP, radius=600.0))
    gx, gy = np.meshgrid(rec.raster_x, rec.raster_y)
    wanted = np.hypot(gx - truth.height * TAN, gy) <= 600.0
    assert np.array_equal(in_region(rec, truth), wanted)
    assert gx[wanted].mean() > 250.0  # the raster positions' own circle would have its middle at 0
    row, column = np.unravel_index(np.argmax(truth.height), truth.height.shape)
    assert rec.raster_x[column] == pytest.approx(CAP * TAN, abs=20.0) and rec.raster_y[row] == pytest.approx(0, abs=20)
    far = rec.replace(
        height=np.where(wanted, truth.height - 900.0, truth.height)
    )  # reconstructed heights do not move the region
    scores = evaluate_height(far, truth)
    assert scores.n_pixels == wanted.sum() and scores.mean_error == pytest.approx(-900.0 / CAP)


def test_ring_is_the_outer_part_of_the_region(case):
    """An error at the rim only shows in the ring fully. Catches: a ring outside of, or all over, the region."""
    _, rec, truth = case
    r = axis_distance(rec, truth.height, (0.0, 0.0))
    rim = (r <= 1050) & (r >= 0.85 * 1050)
    s = evaluate_height(rec.replace(height=truth.height + 7.2 * rim), truth)
    assert s.ring_error == pytest.approx(0.01)
    assert s.rms_region == pytest.approx(0.01 * np.sqrt(rim.sum() / s.n_pixels))


def test_missing_heights_are_left_out_and_counted(case):
    """Catches: NaN in a score, or missing pixels counted as correct or as valid."""
    _, rec, truth = case
    height = 0.85 * truth.height
    height[40:45, 45:50] = np.nan
    s = evaluate_height(rec.replace(height=height), truth)
    full = evaluate_height(rec.replace(height=0.85 * truth.height), truth)
    assert s.n_pixels == full.n_pixels - 25
    has = rec.is_valid & np.isfinite(height)
    assert s.valid_fraction == pytest.approx(has.mean())
    use = in_region(rec, truth) & np.isfinite(height)
    assert s.rms_region == pytest.approx(0.15 * np.sqrt(np.mean(truth.height[use] ** 2)) / CAP)
    assert all(v is None or np.isfinite(v) for v in s.as_dict().values())


def test_slopes_are_angles_between_normals(case):
    """Normals turned by 2 deg about x give 2 deg. Catches: acos round-off at small angles, degrees for radians."""
    _, rec, truth = case
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    turned = truth.normals @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    flat = np.array([0.0, 0.0, 1.0])
    scores = evaluate_height(rec.replace(normals=turned), replace(truth, height=truth.height))
    expected = normal_angle(turned, truth.normals)[in_region(rec, truth)]
    assert scores.slope_rms == pytest.approx(np.sqrt(np.mean(expected**2)))
    assert np.degrees(expected.max()) == pytest.approx(2.0, abs=1e-6)
    assert normal_angle(flat, np.array([1e-9, 0.0, 1.0])) == pytest.approx(1e-9, rel=1e-6)


def test_calibrated_error_bars_have_the_nominal_coverage(case):
    """Normal errors of the stated size: coverage 68.3 / 95.4 %, pull 0 +- 1, each within 5 standard errors of 7371
    pixels. Catches: variance for standard deviation, a pull before levelling, coverage over invalid pixels."""
    _, rec, truth = case
    std = np.linspace(1.0, 8.0, truth.height.size).reshape(truth.height.shape)
    error = np.random.default_rng(3).normal(size=std.shape) * std
    noisy = np.where(rec.is_valid, truth.height + error, truth.height + 500.0) + 11.0
    s = evaluate_height(rec.replace(height=noisy, height_std=std), truth)
    n = rec.is_valid.sum()
    assert abs(s.coverage_1 - 0.6827) < 5 * np.sqrt(0.6827 * 0.3173 / n)
    assert abs(s.coverage_2 - 0.9545) < 5 * np.sqrt(0.9545 * 0.0455 / n)
    assert abs(s.pull_std - 1) < 5 / np.sqrt(2 * n)
    assert abs(s.pull_mean) < 5 / np.sqrt(n) + 0.05  # the level has an error of its own, 0.05 std here
    assert s.recovered_height_std_um == std[np.unravel_index(np.argmax(truth.height), std.shape)]


def test_generic_sample_uses_the_border_and_the_range(case):
    """A trench 300 um deep, without a region: H is its depth, the border levels, the floor is the extreme. Catches:
    a level from the mean of the image, a recovered depth with the wrong sign."""
    _, rec, _ = case
    true = np.zeros_like(rec.height)
    true[:, 30:50] = -300.0
    s = evaluate_height(rec.replace(height=0.8 * true + 5.0), Truth(true))
    assert s.level_um == pytest.approx(5.0) and s.H_um == 300.0
    assert s.recovered_height == pytest.approx(0.8) and s.recovered_height_um == pytest.approx(240.0)
    assert s.shape_error == pytest.approx(0.0, abs=1e-12) and s.ring_error is None
    assert s.rms_region == s.rms_image == pytest.approx(0.2 * np.sqrt(np.mean(true**2)) / 300.0)


def test_scores_can_be_printed_and_stored(case):
    """Catches: NaN or numpy numbers in the JSON, a score without a row, a table in other units than it says."""
    _, rec, truth = case
    s = evaluate_height(rec.replace(height=0.85 * truth.height), truth)
    stored = json.loads(json.dumps(s.as_dict(), allow_nan=False))
    assert set(stored) == set(SCORE_ROWS) and stored["n_pixels"] == s.n_pixels
    rows = {label: (value, unit) for label, value, unit in s.as_table()}
    assert rows["height recovered at the true apex"] == ("85.0", "%")
    assert rows["known height H"] == ("720.0", "um")
    assert s.as_table(["slope_rms"])[0][2] == "deg" and s.as_table(["coverage_1"]) == []


def test_refusals_name_the_remedy(case):
    """Catches: scores of nothing (an empty region gives NaN, not zero), silent broadcasting of another raster."""
    _, rec, truth = case
    with pytest.raises(InputFileError, match="same raster"):
        evaluate_height(rec, Truth(truth.height[:-1]))
    with pytest.raises(GuardError, match="enlarge the scan"):
        evaluate_height(rec, replace(truth, region=Region(CAP, substrate_radius=9000.0)))
    with pytest.raises(GuardError, match="centre and radius"):
        evaluate_height(rec, replace(truth, region=Region(CAP, center=(9000.0, 0.0))))
    with pytest.raises(GuardError, match="nothing in common"):
        evaluate_height(rec.replace(height=np.full_like(rec.height, np.nan)), truth)
    with pytest.raises(SceneError, match="must be > 0 um"):
        Region(-1.0)
    with pytest.raises(SceneError, match="outside the scored region"):
        Region(CAP, radius=2000.0)


def test_center_of_a_measured_sphere_is_found():
    """A sphere at (70, -90) um, 90 % high, noisy, lifted, with 2 % wild pixels: found to half a raster pitch, level
    and height not fitted. Catches: x and y exchanged, the shift's sign, a cost that outliers rule."""
    _, rec, truth = make_case()
    true, _ = first_hit(rec.raster_x, rec.raster_y, (70.0, -90.0))
    rng = np.random.default_rng(5)
    height = 0.9 * true + 20.0 + rng.normal(size=true.shape) * 10.0
    height[rng.random(true.shape) < 0.02] += 600.0
    found = fit_center(
        rec.replace(height=height), lambda x, y: first_hit(rec.raster_x, rec.raster_y, (x, y))[0], truth.region
    )
    assert np.abs(np.subtract(found.center, (70.0, -90.0))).max() < 20.0
    assert (found.height, found.radius) == (CAP, 1050.0)


def test_center_out_of_reach_is_refused():
    """Catches: a centre at the limit of the search returned as a result."""
    _, rec, truth = make_case()
    height, _ = first_hit(rec.raster_x, rec.raster_y, (150.0, 0.0))
    with pytest.raises(GuardError, match="state a centre that is nearer"):
        fit_center(
            rec.replace(height=height),
            lambda x, y: first_hit(rec.raster_x, rec.raster_y, (x, y))[0],
            truth.region,
            reach_um=50.0,
        )
