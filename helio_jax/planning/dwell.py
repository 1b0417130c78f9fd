"""Where to spend counting time: the dwell times of groups of positions that minimise a variance (A-optimal design).

Numbers in, numbers out: the variance and its derivative by the dwell times are given as a function, so that nothing
here knows heights or optics. Minimised is a convex, falling function of the dwell times, at a given total time.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from helio_jax.errors import SceneError

TOLERANCE = 0.01
"""Dwell times are found when the variance is within this share of the least possible one."""
MAX_STEPS = 60
"""Largest number of multiplicative steps on one set of groups."""
LEAST_SHARE = 1e-9
"""Share of the time below which no group falls, so that it can come back."""
SHARES = (1.0, 0.6, 0.35, 0.2, 0.1, 0.05)
"""Shares of the groups, the most useful first, that are tried where moving to a position takes time."""
SHORT = (0.25, 1.0)
"""Groups are then left out whose dwell time is below these multiples of the time to move, if that helps."""

Variance = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""Dwell time of each position of every group [s] -> variance, and its derivative by those dwell times (all <= 0)."""


@dataclass(frozen=True)
class Groups:
    """Positions that share a dwell time.

    Attributes:
        n_positions: of every group.
        scan: number of the scan that every group belongs to, from 0; a change of scan takes time.
    """

    n_positions: np.ndarray
    scan: np.ndarray

    @classmethod
    def of(cls, n_positions: Sequence[int] | np.ndarray) -> "Groups":
        """Make groups of one scan."""
        n = np.asarray(n_positions, int)
        return cls(n, np.zeros(n.size, int))


@dataclass(frozen=True)
class Cost:
    """Times beside counting [s], >= 0: to move to a position, to change to another scan than number `present`."""

    move: float = 0.0
    change: float = 0.0
    present: int = 0

    def seconds(self, groups: Groups, is_used: np.ndarray) -> float:
        """Compute the time beside counting where these groups are used."""
        scans = np.unique(groups.scan[is_used])
        return self.move * float(groups.n_positions[is_used].sum()) + self.change * int(np.sum(scans != self.present))


@dataclass(frozen=True)
class DwellTimes:
    """Dwell times that were found.

    Attributes:
        dwell: of each position of every group [s]; 0: not visited.
        variance: with them.
        gap: the least possible variance of the visited groups is at most this share lower.
        seconds: counting and all else.
    """

    dwell: np.ndarray
    variance: float
    gap: float
    seconds: float


def spend(
    variance: Variance, groups: Groups, seconds: float, cost: Cost = Cost(), tolerance: float = TOLERANCE
) -> DwellTimes:
    """Find the dwell times of groups of positions that minimise a variance within a given time.

    Without times to move or change the result is the optimum, to `tolerance`. With them the choice of the groups to
    visit is not convex: sets of the most useful groups are tried, then groups of short dwell times are left out.

    Args:
        variance: convex and falling in the dwell times.
        groups: what is to be visited.
        seconds: time of all, counting and moving [s].
        cost: times beside counting.
        tolerance: relative, of the variance.

    Raises:
        SceneError: the time does not even allow to visit one group.

    Source: Silvey, Titterington and Torsney, Commun. Stat. Theory Methods 7 (1978) 1379 (multiplicative algorithm);
        bound on the gain that remains: the function's tangent, as in Frank and Wolfe, Nav. Res. Logist. Q. 3 (1956) 95.
    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise SceneError(f"the time to spend must be a finite time > 0 s, got {seconds:g}: correct it")
    found: list[DwellTimes] = []
    for is_used in _sets(variance, groups, seconds, cost):
        best = _on(variance, groups, is_used, seconds, cost, tolerance)
        found.append(best)
        for short in SHORT if cost.move else ():
            kept = best.dwell > short * cost.move
            if not kept.any() or np.array_equal(kept, best.dwell > 0.0):
                continue
            fewer = _on(variance, groups, kept, seconds, cost, tolerance, start=best.dwell)
            found.append(fewer)
            best = min(best, fewer, key=lambda f: f.variance)
    if not found:
        least = min(cost.seconds(groups, np.arange(groups.scan.size) == i) for i in range(groups.scan.size))
        raise SceneError(
            f"{seconds:g} s are too short: the cheapest group of positions takes {least:g} s of moving alone: give "
            "more time or smaller blocks"
        )
    return min(found, key=lambda f: f.variance)


def _sets(variance: Variance, groups: Groups, seconds: float, cost: Cost) -> list[np.ndarray]:
    """List sets of groups to try [set: group], each of which leaves time to count."""
    scans = [np.ones(groups.scan.size, bool)]
    if cost.change and np.unique(groups.scan).size > 1:
        scans += [groups.scan == s for s in np.unique(groups.scan)]
    if not cost.move:
        return [s for s in scans if cost.seconds(groups, s) < seconds]
    _, slope = variance(np.zeros(groups.scan.size))
    gain = -slope / groups.n_positions
    out = []
    for inside in scans:
        order = np.argsort(np.where(inside, -gain, np.inf), kind="stable")[: int(inside.sum())]
        for share in SHARES:
            is_used = np.zeros(groups.scan.size, bool)
            is_used[order[: max(1, round(share * order.size))]] = True
            if cost.seconds(groups, is_used) < seconds and not any(np.array_equal(is_used, o) for o in out):
                out.append(is_used)
        if not any(np.any(o & inside) for o in out):
            n = int(np.searchsorted(np.cumsum(cost.move * groups.n_positions[order]), 0.5 * seconds))
            is_used = np.zeros(groups.scan.size, bool)
            is_used[order[:n]] = True
            if n and cost.seconds(groups, is_used) < seconds:
                out.append(is_used)
    return out


def _on(
    variance: Variance,
    groups: Groups,
    is_used: np.ndarray,
    seconds: float,
    cost: Cost,
    tolerance: float,
    start: np.ndarray | None = None,
) -> DwellTimes:
    """Minimise on a set of groups [group]; `start`: dwell times to start from."""
    n = groups.n_positions[is_used].astype(float)
    counting = seconds - cost.seconds(groups, is_used)

    def at(share: np.ndarray) -> tuple[float, np.ndarray]:
        dwell = np.zeros(groups.scan.size)
        dwell[is_used] = counting * share / n
        value, slope = variance(dwell)
        return value, -slope[is_used] * counting / n

    share = n / n.sum() if start is None else n * start[is_used]
    share = np.maximum(share / share.sum(), LEAST_SHARE)
    share /= share.sum()
    value, gain = at(share)
    power = 0.5
    for _ in range(MAX_STEPS):
        if _gap(share, gain) <= tolerance * value or power < 0.01:
            break
        trial = share * (np.maximum(gain, 0.0) / max(float(share @ gain), 1e-300)) ** power
        trial = np.maximum(trial / trial.sum(), LEAST_SHARE)
        trial /= trial.sum()
        new_value, new_gain = at(trial)
        if new_value > value:
            power *= 0.5
            continue
        share, value, gain = trial, new_value, new_gain
        power = min(1.5 * power, 1.0)
    dwell = np.zeros(groups.scan.size)
    dwell[is_used] = counting * share / n
    return DwellTimes(dwell, value, max(_gap(share, gain), 0.0) / max(value, 1e-300), seconds)


def _gap(share: np.ndarray, gain: np.ndarray) -> float:
    """Compute by how much the variance could fall at most: by its tangent, all time to the most useful group."""
    return float(gain.max() - share @ gain)
