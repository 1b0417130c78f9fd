"""Dwell times that minimise a variance within a given time, against closed forms and scipy; lists of positions."""

import numpy as np
import pytest
from scipy.optimize import minimize

from helio_jax.errors import SceneError
from helio_jax.planning.dwell import Cost, Groups, spend
from helio_jax.planning.positions import Positions, block_size, nearest_pixels, number_blocks, round_dwell


def independent(a: np.ndarray, n: np.ndarray, before: np.ndarray | float = 0.0):
    """Sum of the variances a / t of independent pixels, n of them in each group, with counts so far."""

    def variance(dwell: np.ndarray) -> tuple[float, np.ndarray]:
        t = dwell + before + 1e-15
        return float(np.sum(n * a / t)), -n * a / t**2

    return variance


def test_independent_pixels_get_the_root_of_their_noise():
    """Variances a_i / t_i: the A-optimal dwell time is proportional to sqrt(a_i), whatever the size of its group.

    Closed form by Lagrange: a_i / t_i^2 is equal. Rejects times proportional to a_i (D-optimal or naive), and groups
    whose cost is not their number of positions.
    """
    rng = np.random.default_rng(0)
    a, n = rng.uniform(0.1, 10.0, 200), rng.integers(1, 5, 200)
    found = spend(independent(a, n), Groups.of(n), 100.0)
    assert found.dwell == pytest.approx(100.0 * np.sqrt(a) / np.sum(n * np.sqrt(a)), rel=1e-3)
    assert found.variance == pytest.approx(np.sum(n * np.sqrt(a)) ** 2 / 100.0)
    assert np.sum(n * found.dwell) == pytest.approx(100.0) and found.gap < 0.01


def test_water_is_filled_over_what_is_there():
    """With times so far s_i: t_i = max(0, c sqrt(a_i) - s_i), c by bisection. Rejects a design that forgets them."""
    rng = np.random.default_rng(1)
    a, before, n = rng.uniform(0.1, 10.0, 50), rng.uniform(0.0, 4.0, 50), np.ones(50, int)
    low, high = 0.0, 100.0
    for _ in range(100):
        c = 0.5 * (low + high)
        low, high = (c, high) if np.sum(np.maximum(c * np.sqrt(a) - before, 0.0)) < 30.0 else (low, c)
    exact = np.maximum(c * np.sqrt(a) - before, 0.0)
    variance = independent(a, n, before)
    found = spend(variance, Groups.of(n), 30.0, tolerance=1e-4)
    assert found.variance == pytest.approx(variance(exact)[0], rel=2e-4)
    assert np.abs(found.dwell - exact).max() < 0.1 and np.any(exact == 0.0)


def test_coupled_pixels_against_an_independent_optimiser():
    """Trace of the inverse of a coupled information matrix: SLSQP finds no lower variance, the gap bounds what is left.

    Catches a step that stalls, and a bound that is too small.
    """
    rng = np.random.default_rng(2)
    rows, prior = rng.normal(size=(12, 6)), 0.1 * np.eye(6)

    def variance(dwell):
        covariance = np.linalg.inv(rows.T @ (dwell[:, None] * rows) + prior)
        return float(np.trace(covariance)), -np.sum((rows @ covariance) ** 2, axis=1)

    found = spend(variance, Groups.of(np.ones(12, int)), 5.0, tolerance=1e-3)
    limits = {"bounds": [(0.0, None)] * 12, "constraints": {"type": "eq", "fun": lambda t: t.sum() - 5.0}}
    best = minimize(lambda t: variance(t)[0], np.full(12, 5.0 / 12), method="SLSQP", **limits, options={"ftol": 1e-12})
    assert best.fun <= found.variance * (1.0 + 1e-9) and found.variance * (1.0 - found.gap) <= best.fun
    assert found.gap <= 1e-3


def test_moves_cost_time():
    """Where a move takes as long as the mean dwell time, fewer positions are visited, within the time, and better so.

    Rejects a list that forgets the moves (over the time), and one that visits all positions whatever they cost.
    """
    a = np.concatenate([np.full(20, 10.0), np.full(80, 0.01)])
    n, before = np.ones(100, int), 1.0
    variance = independent(a, n, before)
    found = spend(variance, Groups.of(n), 100.0, Cost(move=0.9))
    visited = found.dwell > 0.0
    assert visited[:20].all() and visited.sum() < 60
    assert found.dwell.sum() + 0.9 * visited.sum() <= 100.0 + 1e-9
    assert found.variance < 0.8 * variance(np.full(100, 0.1))[0]  # all of them, evenly


def test_another_scan_costs_its_change():
    """A scan that is slightly better is not worth a change that takes most of the time. Catches a free change."""
    a = np.array([1.0] * 10 + [0.9] * 10)
    groups = Groups(np.ones(20, int), np.repeat([0, 1], 10))

    def variance(dwell):  # either scan shows the same ten pixels
        rate = dwell / a
        total = rate[:10] + rate[10:] + 1e-3
        return float(np.sum(1.0 / total)), -np.tile(total**-2, 2) / a

    stays = spend(variance, groups, 10.0, Cost(change=8.0))
    assert stays.dwell[10:].sum() == 0.0 and stays.dwell[:10].sum() == pytest.approx(10.0)
    goes = spend(variance, groups, 10.0, Cost(change=0.1))
    assert goes.dwell[10:].sum() > 9.0


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf])
def test_impossible_times_are_refused(seconds):
    """Catches a division by it."""
    with pytest.raises(SceneError, match="finite time > 0 s"):
        spend(independent(np.ones(3), np.ones(3)), Groups.of([1, 1, 1]), seconds)


def test_too_short_a_time_is_refused():
    """Not even one position can be reached. Catches a list that takes longer than it may."""
    with pytest.raises(SceneError, match="cheapest group of positions takes 5 s"):
        spend(independent(np.ones(3), np.ones(3), 1.0), Groups.of([1, 1, 1]), 2.0, Cost(move=5.0))


@pytest.mark.parametrize("fast", ["x", "y"])
def test_positions_are_in_scan_order(fast):
    """Line by line along the fast axis, low to high, only visited pixels, scan by scan. Catches swapped axes."""
    x, y = np.array([10.0, 20.0, 30.0]), np.array([1.0, 2.0])
    dwell = np.array([[0.1, 0.0, 0.3], [0.4, 0.5, 0.0]])
    found = Positions.of([dwell, dwell], [(x, y), (x + 5.0, y)], fast)
    by_x = [(10, 1, 0.1), (30, 1, 0.3), (10, 2, 0.4), (20, 2, 0.5)]
    by_y = [(10, 1, 0.1), (10, 2, 0.4), (20, 2, 0.5), (30, 1, 0.3)]
    expected = np.array(by_x if fast == "x" else by_y)
    assert np.array_equal(np.column_stack([found.xy, found.dwell])[:4], expected)
    assert np.array_equal(found.xy[4:, 0], expected[:, 0] + 5.0) and found.scan.tolist() == [0] * 4 + [1] * 4
    assert found.seconds(move=1.0, change=10.0) == pytest.approx(2.6 + 8.0 + 10.0)


def test_blocks():
    """Every pixel that may be visited is in one block, numbered without gaps. Catches blocks that cross lines."""
    may_visit = np.ones((5, 4), bool)
    may_visit[:2, :2] = False
    found = number_blocks(may_visit, 2)
    assert (found >= 0).sum() == 16 and sorted(set(found[found >= 0])) == [0, 1, 2, 3, 4]
    assert np.all(found[:2, 2:] == 0) and np.all(found[2:4, :2] == 1) and np.all(found[4, 2:] == 4)
    assert block_size((31, 31), None) == 1 and block_size((121, 121), None) == 4 and block_size((9, 9), 3) == 3
    with pytest.raises(SceneError, match="block must be 2 to 9 pixels"):
        block_size((9, 9), 1, least=2)


def test_rounding_never_adds_time():
    """Catches lists that take longer than they may."""
    times = np.random.default_rng(3).uniform(0.0, 1.0, 1000)
    found = round_dwell(times, 1e-3)
    assert np.all(found <= times + 1e-12) and np.all(times - found < 1e-3)
    assert round_dwell(np.array([0.3]), 0.1) == pytest.approx([0.3])


def test_nearest_pixels():
    """Row by row; outside of the raster none. Catches places that wrap around."""
    x, y = np.arange(4.0), np.arange(3.0)
    places = np.array([[0.4, 0.6], [3.4, 2.4], [3.6, 0.0], [-0.6, 0.0], [1.0, 2.6]])
    assert nearest_pixels(places, x, y).tolist() == [4, 11, -1, -1, -1]
