"""Alignment of rotated scans from control points: the same points of the sample picked in several pictures.

Every point has an unknown place in the common frame and every view an unknown rigid motion; all are fitted together
(generalised Procrustes), so a point need not be visible in every view. The accuracy follows from the picks: residuals,
and the leave-one-out error, the distance of a pick from its place predicted by all others.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from helio_jax.alignment.rigid import Rigid, fit_rigid
from helio_jax.errors import InputFileError

Picks = Mapping[str, Mapping[str, tuple[float, float]]]
"""Control points: {view: {point: (x, y) [um]}}, beam positions of that view."""
MIN_POINTS = 3
"""Points per view: two determine a rigid motion, a third one tests it."""
_MAX_ITERATIONS = 200
_CONVERGED_UM = 1e-7


@dataclass(frozen=True)
class PointFit:
    """Result of the fit.

    Attributes:
        motions: of each view, in the order of the given names.
        places: of every point in the common frame [um].
        residuals: distance of each pick from its fitted place [um]: {view: {point: distance}}.
        left_out: the same for a fit without this pick, the leave-one-out error [um].
        std_um: standard deviation of one coordinate of a pick, from the residuals and the degrees of freedom [um].
    """

    motions: tuple[Rigid, ...]
    places: dict[str, tuple[float, float]]
    residuals: dict[str, dict[str, float]]
    left_out: dict[str, dict[str, float]]
    std_um: float


def fit_points(picks: Picks, views: tuple[str, ...], source: str = "the control points") -> PointFit:
    """Fit one rigid motion per view; the first view is the common frame.

    Args:
        picks: of every view, 3 or more points that other views share.
        views: names of the views, in order.
        source: name of the file, for messages.

    Raises:
        InputFileError: a view without picks, with too few shared points, or with points on top of each other.
    """
    shared = _shared(picks, views, source)
    motions, places = _solve(shared, views, source)
    residuals = {
        v: {p: float(np.hypot(*(motions[i].apply(places[p]) - at))) for p, at in shared[v].items()}
        for i, v in enumerate(views)
    }
    left_out = {v: {p: _left_out(shared, views, v, p) for p in shared[v]} for v in views}
    n_picks = sum(len(named) for named in shared.values())
    freedom = 2 * n_picks - 2 * len(places) - 3 * (len(views) - 1)
    total = sum(r * r for named in residuals.values() for r in named.values())
    std = math.sqrt(total / freedom) if freedom > 0 else math.nan
    return PointFit(motions, {p: (float(r[0]), float(r[1])) for p, r in places.items()}, residuals, left_out, std)


def rms(errors: Mapping[str, Mapping[str, float]]) -> float:
    """Compute the root mean square of all finite distances."""
    values = np.array([e for named in errors.values() for e in named.values()])
    return float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2))) if np.isfinite(values).any() else math.nan


def _shared(picks: Picks, views: tuple[str, ...], source: str) -> dict[str, dict[str, np.ndarray]]:
    """Select the points that two or more views share, and check that they suffice."""
    if unknown := sorted(set(picks) - set(views)):
        raise InputFileError(f"{source}: view {unknown[0]!r} is none of the scans ({', '.join(views)}): rename it")
    count: dict[str, int] = {}
    for named in picks.values():
        for point in named:
            count[point] = count.get(point, 0) + 1
    shared = {v: {p: np.asarray(at, float) for p, at in picks.get(v, {}).items() if count[p] > 1} for v in views}
    for view, named in shared.items():
        if len(named) < MIN_POINTS:
            raise InputFileError(
                f"{source}: view {view!r} must have {MIN_POINTS} or more points that other views have too, got "
                f"{len(named)}: pick more (helio pick), under the same names"
            )
        places = np.stack(list(named.values()))
        if np.hypot(*np.ptp(places, axis=0)) == 0.0:
            raise InputFileError(f"{source}: view {view!r}: all points are in one place: pick them far apart")
    return shared


def _solve(
    shared: dict[str, dict[str, np.ndarray]], views: tuple[str, ...], source: str
) -> tuple[tuple[Rigid, ...], dict]:
    """Alternate between places and motions, starting from the view that shares most points; first view fixed."""
    motions: dict[str, Rigid] = {views[0]: Rigid(0.0, (0.0, 0.0))}
    places = dict(shared[views[0]])
    while len(motions) < len(views):
        waiting = [v for v in views if v not in motions]
        view = max(waiting, key=lambda v: len(shared[v].keys() & places.keys()))
        common = sorted(shared[view].keys() & places.keys())
        if len(common) < 2:
            raise InputFileError(
                f"{source}: view {view!r} shares {len(common)} points with the views before it, 2 are needed: "
                "pick more (helio pick), under the same names"
            )
        motions[view] = _fitted(places, shared[view], common)
        back = motions[view].inverse()
        places |= {p: back.apply(at) for p, at in shared[view].items() if p not in places}
    for _ in range(_MAX_ITERATIONS):
        seen: dict[str, list[np.ndarray]] = {}
        for view in views:
            back = motions[view].inverse()
            for point, at in shared[view].items():
                seen.setdefault(point, []).append(back.apply(at))
        places = {p: np.mean(at, axis=0) for p, at in seen.items()}
        fitted = {v: _fitted(places, shared[v], sorted(shared[v])) for v in views}
        first = fitted[views[0]]
        new = {v: fitted[v].after(first.inverse()) for v in views}
        change = max(abs(new[v].rotation - motions[v].rotation) * 1e3 + _gap(new[v], motions[v]) for v in views)
        motions, places = new, {p: first.apply(at) for p, at in places.items()}
        if change < _CONVERGED_UM:
            break
    return tuple(motions[v] for v in views), places


def _gap(a: Rigid, b: Rigid) -> float:
    return math.dist(a.shift, b.shift)


def _fitted(places: dict[str, np.ndarray], picked: dict[str, np.ndarray], names: list[str]) -> Rigid:
    return fit_rigid(np.stack([places[p] for p in names]), np.stack([picked[p] for p in names]))


def _left_out(shared: dict[str, dict[str, np.ndarray]], views: tuple[str, ...], view: str, point: str) -> float:
    """Compute the distance of a pick from its place predicted by all others; NaN where they do not determine it."""
    rest = {v: {p: at for p, at in named.items() if (v, p) != (view, point)} for v, named in shared.items()}
    if len(rest[view]) < 2 or sum(point in named for named in rest.values()) < 1:
        return math.nan
    try:
        motions, places = _solve(rest, views, "without it")
    except InputFileError:
        return math.nan
    return float(np.hypot(*(motions[views.index(view)].apply(places[point]) - shared[view][point])))
