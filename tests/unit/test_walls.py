"""Vertical edges of height maps whose jumps, masked pixels and floating regions are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_lines import AXIS, GRID_X, GRID_Y, PITCH, SIZE, instrument

from helio_jax.measure.walls import find_walls
from helio_jax.reconstruction import REASONS, Reconstruction

TURN = math.radians(40.0)
ACROSS = -math.sin(TURN) * GRID_X + math.cos(TURN) * GRID_Y
ALONG = math.cos(TURN) * GRID_X + math.sin(TURN) * GRID_Y
JUMP, MASKED, FLOATING = (REASONS.index(r) for r in ("depth jump", "masked in too many detectors", "floating"))
LEVEL_STD = 1.5


def make_rec(height, reason, level=0.0) -> Reconstruction:
    """Heights with reasons; samples: white noise of 1 um, and `level` [y, x] times a common deviation of 1.5 um."""
    rng, shape, up = np.random.default_rng(3), (SIZE, SIZE), np.zeros((SIZE, SIZE, 3)) + [0.0, 0.0, 1.0]
    samples = rng.standard_normal((200, *shape)) + LEVEL_STD * rng.standard_normal((200, 1, 1)) * level
    return Reconstruction(
        height, AXIS, AXIS, instrument(), "refine", up, np.ones(shape), reason == 0, reason, height_samples=samples
    )


def terrace(floats: bool = False) -> Reconstruction:
    """A terrace of 50 um behind a straight wall at 40 deg, flagged over 900 um and over 60 um; single pixels."""
    high = ACROSS > 0.0
    reason = np.where(high & floats, FLOATING, 0)
    reason[(np.abs(ACROSS) < 15.0) & (np.abs(ALONG) < 450.0)] = JUMP
    reason[(np.abs(ACROSS) < 15.0) & (ALONG > 100.0) & (ALONG < 160.0)] = MASKED
    reason[(np.abs(ACROSS) < 15.0) & (np.abs(ALONG - 620.0) < 30.0)] = JUMP
    reason[5:70:9, 3] = JUMP
    return make_rec(np.where(high, 50.0, 0.0), reason, high.astype(float))


def test_a_wall_is_listed():
    """One edge of 900 um at 40 deg that falls at -50 deg by 50 +- 1.5 um; short pieces are discarded.

    The deviation is that of the difference of the two levels. Catches the direction of the rise, heights read on the
    flagged pixels, short pieces and single pixels reported as edges, and deviations averaged over pixels.
    """
    found = find_walls(terrace())
    (w,) = found.walls
    assert w.length_um == pytest.approx(900.0, abs=2.0 * PITCH) and w.direction_deg == pytest.approx(40.0, abs=2.0)
    assert w.falls_deg == pytest.approx(-50.0, abs=2.0)
    assert w.step_um == pytest.approx(50.0, abs=1e-6) and w.step_std_um == pytest.approx(LEVEL_STD, rel=0.2)
    assert w.is_determined and w.n_masked > 0 and w.n_jump > 5 * w.n_masked
    ends = sorted([math.cos(TURN) * x + math.sin(TURN) * y for x, y in (w.start, w.end)])
    assert ends == pytest.approx([-450.0, 450.0], abs=1.5 * PITCH)
    assert 0.7 < found.share < 1.0 and found.marked.sum() > w.n_jump + w.n_masked


def test_a_floating_side_is_not_determined():
    """A floating terrace: the step is not determined, the rim extends the edge; with both sides floating it is.

    Catches a step of a floating region reported as determined.
    """
    (w, *_) = find_walls(terrace(floats=True)).walls
    assert not w.is_determined and w.note.startswith("floating") and w.n_rim > 0
    assert w.length_um > 1000.0
    both = terrace()
    reason = np.where(both.reason == 0, FLOATING, both.reason)
    (w,) = find_walls(both.replace(reason=reason, is_valid=np.zeros_like(both.is_valid))).walls
    assert w.is_determined and w.note.startswith("both sides float")


def test_corners_separate_edges():
    """A square block of 800 um: four edges of about its side, falling outwards in four directions.

    Catches edges that run around corners.
    """
    inside = np.maximum(np.abs(GRID_X), np.abs(GRID_Y)) < 400.0
    ring = inside & (np.maximum(np.abs(GRID_X), np.abs(GRID_Y)) > 370.0)
    found = find_walls(make_rec(np.where(inside, 80.0, 0.0), np.where(ring, JUMP, 0)))
    assert len(found.walls) == 4
    assert sorted(round(w.falls_deg / 90.0) % 4 for w in found.walls) == [0, 1, 2, 3]
    assert all(700.0 < w.length_um < 840.0 and w.is_determined for w in found.walls)


def test_unknown_heights_beside_a_wall():
    """Masked above the wall: no step, a reason; in a region without wall: no edge; without samples: no deviation."""
    rec = terrace()
    reason = np.where((ACROSS > 15.0) & (ACROSS < 600.0), MASKED, rec.reason)
    hidden = find_walls(rec.replace(reason=reason, is_valid=reason == 0), np.abs(ACROSS) < 60.0)
    assert hidden.walls and all(not w.is_determined and "too few heights are known" in w.note for w in hidden.walls)
    assert math.isnan(hidden.walls[0].step_um)
    assert find_walls(rec, GRID_X > 600.0).walls == ()
    found = find_walls(rec.replace(height_samples=None))
    (w,) = found.walls
    assert math.isnan(w.step_std_um) and "no deviation" in w.note
    assert found.as_dict()["edges"][0]["step_std_um"] is None
    flat = find_walls(make_rec(np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE), int)))
    assert flat.walls == () and flat.share == 0.0


def test_a_wall_on_oblong_pixels():
    """The same wall on pixels 1.5 times as long along x. Catches lengths and directions counted in pixels."""
    rec = replace(terrace(), raster_x=1.5 * AXIS)
    (w,) = find_walls(rec).walls
    along = np.array([1.5 * math.cos(TURN), math.sin(TURN)])
    direction = math.degrees(math.atan2(along[1], along[0]))
    assert w.length_um == pytest.approx(900.0 * np.hypot(*along), abs=3.0 * PITCH)
    assert w.direction_deg == pytest.approx(direction, abs=2.0)
    assert w.falls_deg == pytest.approx(direction - 90.0, abs=2.0)
    assert math.dist(w.start, w.end) == pytest.approx(w.length_um, abs=2.0 * PITCH)
    assert w.step_um == pytest.approx(50.0, abs=1e-6)
