"""Profiles in the sample frame and step heights (ISO 5436-1 type A) against closed forms."""

import csv
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import GuardError, SceneError
from helio_jax.measure.profiles import COLUMNS, profile_table
from helio_jax.measure.sample_surface import FLAGS
from helio_jax.measure.step_height import measure_step
from helio_jax.workflows.measure import Wanted, measure_height_map
from tests.height_maps import PITCH, make_rec

LINE = (-900.0, 40.0), (900.0, 40.0)


def ridge(height, half=150.0, slope=0.05):
    """Return a ridge of 2 * half um (negative: a groove) on a slope."""
    return lambda x, y: slope * x + height * (np.abs(x) < half)


@pytest.mark.parametrize("height", [30.0, -12.0])
def test_type_a_on_a_slope(height):
    """A ridge of 30 um, a groove of -12 um on a slope of 0.05: exact height, slope, edges, and the standard's parts.

    Catches a factor 2 (the standard's delta of -1 and +1), sides that touch the edges, and the wrong third.
    """
    step = hx.measure_step_height(hx.measure_profile(make_rec(ridge(height)), *LINE))
    assert step.height == pytest.approx(height, abs=1e-9) and step.slope == pytest.approx(0.05, abs=1e-9)
    left, right = step.edges
    assert abs(left - 750.0) <= PITCH / 2 and abs(right - 1050.0) <= PITCH / 2
    w = right - left
    parts = ((left - w, left - w / 3), (left + w / 3, right - w / 3), (right + w / 3, right + w))
    np.testing.assert_allclose(step.parts, parts)


def test_rounded_edges_and_dirt_beside_them_do_not_count():
    """Within W/3 of the edges the surface may be anything. Catches a fit of the whole sides and the whole top."""
    clean = make_rec(ridge(30.0))
    x = np.broadcast_to(clean.raster_x, clean.height.shape)
    near = np.abs(np.abs(x) - 150.0) < 95.0
    dirty = clean.replace(height=clean.height + np.where(near, 2.0 * np.sin(x / 7.0), 0.0))
    step = hx.measure_step_height(hx.measure_profile(dirty, *LINE), edges=(750.0, 1050.0))
    assert step.height == pytest.approx(30.0, abs=1e-9) and step.rms < 1e-9


def test_standard_deviation_of_the_step():
    """Errors that all heights share cancel; a plateau that moves as one does not; independent ones by least squares.

    Catches errors taken as independent although samples exist: 0.3 um for a plateau that is known to 1 um.
    """
    rec = make_rec(ridge(30.0))
    top = np.broadcast_to(np.abs(rec.raster_x) < 150.0, rec.height.shape).astype(float)
    samples = np.array([1.0, -1.0])[:, None, None] * top + np.array([5.0, 5.0])[:, None, None]
    std = np.sqrt(np.mean(samples**2, axis=0))
    both = hx.measure_step_height(hx.measure_profile(replace(rec, height_samples=samples, height_std=std), *LINE))
    assert both.std == pytest.approx(1.0, rel=1e-9) and "2 posterior samples" in both.errors
    alone = hx.measure_step_height(hx.measure_profile(replace(rec, height_std=np.ones(rec.height.shape)), *LINE))
    n_top, n_sides = (
        sum(int((b - a) / PITCH + 1e-6) + 1 for a, b in part) for part in (alone.parts[1:2], alone.parts[::2])
    )
    assert alone.std == pytest.approx(math.sqrt(1 / n_top + 1 / n_sides), rel=0.1) and "independent" in alone.errors


def test_scatter_gives_the_standard_deviation_without_errors():
    """Noise of 1 um without stated errors: the fit's own scatter, and the height within three of them."""
    step = hx.measure_step_height(hx.measure_profile(make_rec(ridge(30.0), noise=1.0), *LINE))
    assert abs(step.height - 30.0) < 3 * step.std and 0.2 < step.std < 0.9 and "scatter" in step.errors


def test_refusals():
    """No side to spare, a gap in the plateau, edges that do not increase; no step across a ball."""
    profile = hx.measure_profile(make_rec(ridge(30.0)), (-260.0, 0.0), (260.0, 0.0))
    with pytest.raises(GuardError, match="needs a width of 300 um on either side"):
        hx.measure_step_height(profile)
    with pytest.raises(SceneError, match="edges must increase"):
        hx.measure_step_height(profile, edges=(300.0, 200.0))
    is_valid = np.ones((101, 101), bool)
    is_valid[:, 45:56] = False
    gap = hx.measure_profile(make_rec(ridge(30.0), is_valid=is_valid), *LINE)
    with pytest.raises(GuardError, match="3 or more known heights in each part, got 0"):
        hx.measure_step_height(gap, edges=(750.0, 1050.0))
    with pytest.raises(GuardError, match="no step"):
        measure_step(hx.measure_profile(make_rec(lambda x, y: np.sqrt(1000.0**2 - np.minimum(x**2, 1e6))), *LINE))


def test_single_step_on_a_slope():
    """A step of 30 um on a slope of 0.1: between parallel lines. Catches the difference of the sides' means."""
    step = measure_step(hx.measure_profile(make_rec(lambda x, y: 0.1 * x + 30.0 * (x > 5.0)), *LINE))
    assert step.height == pytest.approx(30.0, abs=1e-6) and step.slope == pytest.approx(0.1, abs=1e-9)
    assert abs(step.edges[0] - 905.0) < PITCH


def test_profile_leaves_gaps_and_refuses_what_is_outside():
    """Invalid pixels are NaN and flagged, not bridged; a point out of the field is named."""
    valid = np.ones((101, 101), bool)
    valid[:, 40:60] = False
    profile = hx.measure_profile(make_rec(lambda x, y: x, is_valid=valid), (-1000.0, 0.0), (1000.0, 0.0))
    known = np.isfinite(profile.height)
    np.testing.assert_allclose(profile.height[known], profile.distance[known] - 1000.0)
    assert 18 <= np.sum(~known) <= 22 and np.array_equal(profile.flag == 0, known)
    assert {FLAGS[f] for f in profile.flag} == {"valid", "too few images"}
    for end, words in (((2000.0, 0.0), r"profile end \(2000, 0\)"), ((0.0, 0.0), "must differ")):
        with pytest.raises(SceneError, match=words):
            hx.measure_profile(make_rec(lambda x, y: x), (0.0, 0.0), end)


def test_profile_of_an_oblique_view_is_in_the_sample_frame():
    """A cone stands where it is in the sample, not 35 um beside; the point behind it was not seen. Diagonal profile.

    Catches a profile along the raster, which is sheared, and x, y that are beam positions.
    """
    cone = lambda x, y: np.maximum(60.0 - 0.4 * np.hypot(x - 100.0, y + 50.0), 0.0)  # noqa: E731
    rec = make_rec(cone, n=(121, 121), incidence=30.0, pitch=5.0)
    profile = hx.measure_profile(rec, (-50.0, -200.0), (230.0, 80.0))
    np.testing.assert_allclose(profile.height, cone(profile.x, profile.y), atol=0.6)
    top = np.argmax(profile.height)
    assert math.hypot(profile.x[top] - 100.0, profile.y[top] + 50.0) < 8.0
    behind = make_rec(lambda x, y: 80.0 * (np.abs(x) < 100.0), n=(31, 201), incidence=30.0, pitch=5.0)
    flags = {FLAGS[f] for f in hx.measure_profile(behind, (-300.0, 0.0), (300.0, 0.0)).flag}
    assert flags <= {"valid", "depth jump", "not seen by the beam"} and len(flags) > 1


def test_table_and_lines():
    """Header, units, x, y, height, s.d., flags: the same in the lines, the record and the CSV; unknown is empty."""
    rec = make_rec(ridge(30.0), is_valid=np.arange(101)[None, :].repeat(101, 0) != 30)
    rec = replace(rec, height_std=np.full(rec.height.shape, 0.25))
    found, lines = measure_height_map(rec, Wanted(profile=(*LINE[0], *LINE[1]), table=True))
    record = json.loads(json.dumps(found))["profile"]
    rows = list(csv.DictReader(io.StringIO(profile_table(record))))
    assert tuple(rows[0]) == COLUMNS and len(rows) == len(record["x_um"]) == 91
    assert float(rows[10]["x_um"]) == -700.0 and float(rows[10]["height_um"]) == pytest.approx(-35.0)
    assert float(rows[10]["height_std_um"]) == 0.25 and rows[10]["flag"] == "valid"
    gap = next(row for row in rows if row["x_um"] == "-400")
    assert gap["height_um"] == gap["height_std_um"] == "" and gap["flag"] == "too few images"
    head = next(line for line in lines if "distance (um)" in line)
    assert all(word in head for word in ("x (um)", "y (um)", "height (um)", "s.d. (um)", "flag"))
    assert sum(line.rstrip().endswith("too few images") for line in lines) == sum(
        row["flag"] != "valid" for row in rows
    )
    _, lines = measure_height_map(rec, Wanted(profile=(*LINE[0], *LINE[1]), step_height=True))
    assert any("step height (ISO 5436-1 type A): 30.000 +- " in line for line in lines)
    with pytest.raises(SceneError, match="--step-edges"):
        measure_height_map(rec, Wanted(profile=(*LINE[0], *LINE[1]), edges=(1.0, 2.0)))
