"""Heights of steps in a profile: ISO 5436-1 type A (a ridge or groove between two sides), and a single step.

Both fit straight lines of one common slope to parts of the profile that keep away from the edges.
"""

import math
from dataclasses import dataclass

import numpy as np

from helio_jax.arguments import checked
from helio_jax.errors import GuardError, SceneError
from helio_jax.measure.profiles import Profile

_GAP = 0.1
"""Share of a profile's length that is left out around a single step."""
_FEWEST = 3
"""Fewest known heights in each part of a fit."""
_CURVED = 0.05
"""Rms about the lines over the step height, above which it is no step if a parabola explains more than half of it."""
_MOST = 3000
"""Most heights in which edges are searched: all pairs are tried."""


@dataclass(frozen=True)
class StepHeight:
    """A step height.

    Attributes:
        height: of the ridge above its sides, or of what follows a single step above what precedes it [um]; negative:
            a groove, a step down.
        std: its standard deviation [um].
        slope: common slope of the lines.
        edges: places along the profile [um]: the two edges of type A, or the one of a single step.
        parts: first and last distance of each part that was fitted [um]: A, C, B, or the two sides.
        rms: of the heights about the lines [um].
        errors: where the standard deviation comes from.
    """

    height: float
    std: float
    slope: float
    edges: tuple[float, ...]
    parts: tuple[tuple[float, float], ...]
    rms: float
    errors: str


@checked
def measure_step_height(profile: Profile, edges: tuple[float, float] | None = None) -> StepHeight:
    """Measure the height of a ridge, or the depth of a groove, as ISO 5436-1 type A.

    With the width W between the edges, Z = a X + b + h delta is fitted by least squares, with delta = 1 over the middle
    third C of the ridge and delta = 0 on the sides A and B, which reach from W/3 to W beyond the edges. The standard
    writes -1 and +1 for a groove and takes twice the h; the height is the same.

    Example:
        >>> profile = hx.measure_profile(rec, (-300.0, 0.0), (300.0, 0.0))  # doctest: +SKIP
        >>> step = hx.measure_step_height(profile)  # doctest: +SKIP

    Args:
        profile: across the ridge, with a width W to spare on either side.
        edges: places of the edges along the profile [um]; default: those of the top hat on a straight line that fits
            the profile best.

    Raises:
        SceneError: edges that do not increase or lie outside the profile.
        GuardError: the profile is too short, or too few of its heights are known; or it has no such step.

    Source: ISO 5436-1:2000, type A1 (wide grooves with a flat bottom); tests/unit/test_step_height.py.
    """
    first, last = (float(d) for d in profile.distance[[0, -1]])
    if edges is not None and not first <= edges[0] < edges[1] <= last:
        raise SceneError(f"edges must increase from {first:g} to {last:g} um, got {edges[0]:g} and {edges[1]:g}")
    left, right = edges or _find_edges(profile)
    width, spare = right - left, float(profile.distance[1] - profile.distance[0])
    if left - width < first - spare or right + width > last + spare:
        raise GuardError(
            f"type A needs a width of {width:.4g} um on either side of the edges at {left:.4g} and {right:.4g} um, the "
            f"profile reaches from {first:g} to {last:.4g} um: choose a longer profile, or state the edges"
        )
    parts = (
        (left - width, left - width / 3.0),
        (left + width / 3.0, right - width / 3.0),
        (right + width / 3.0, right + width),
    )
    return _fit(profile, parts, (0.0, 1.0, 0.0), (left, right))


def measure_step(profile: Profile) -> StepHeight:
    """Fit two parallel lines to the sides of a profile's steepest place; their distance is the step.

    A tenth of the profile around the step is left out.

    Raises:
        GuardError: too few heights are known on a side, or the profile has no step.
    """
    known = np.isfinite(profile.height)
    d, z = profile.distance[known], profile.height[known]
    if d.size < 8:
        raise GuardError(f"a step needs 8 or more known heights along the profile, got {d.size}")
    gap = 0.5 * _GAP * float(d[-1] - d[0])
    inner = [i for i in range(3, d.size - 3) if d[0] + 2.0 * gap < d[i] < d[-1] - 2.0 * gap]
    jumps = [abs(np.median(z[i : i + 4]) - np.median(z[max(i - 4, 0) : i])) for i in inner]
    if not jumps:
        raise GuardError("a step needs known heights along the middle of the profile: choose another place")
    i = inner[int(np.argmax(jumps))]
    position = float(0.5 * (d[i - 1] + d[i]))
    parts = (float(d[0]), position - gap), (position + gap, float(d[-1]))
    return _fit(profile, parts, (0.0, 1.0), (position,))


def _find_edges(profile: Profile) -> tuple[float, float]:
    """Find the edges of the top hat on a straight line that leaves the smallest sum of squares.

    All pairs of edges are tried; both sides and the top have three or more heights.

    Raises:
        GuardError: too few heights are known.
    """
    known = np.isfinite(profile.height)
    d, z = profile.distance[known], profile.height[known]
    n = d.size
    if n < 3 * _FEWEST:
        raise GuardError(f"a step height needs {3 * _FEWEST} or more known heights along the profile, got {n}")
    if n > _MOST:
        raise GuardError(f"edges are searched in at most {_MOST} heights, the profile has {n}: state the edges")
    line = np.stack([np.ones(n), d - d.mean()], -1) / [math.sqrt(n), math.sqrt(np.sum((d - d.mean()) ** 2))]
    rest = z - line @ (line.T @ z)
    total = lambda a: np.concatenate([[0.0], np.cumsum(a)])  # noqa: E731
    sum_z, sum_line = total(rest), [total(a) for a in line.T]
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    ok = (i >= _FEWEST) & (j - i >= _FEWEST) & (n - j >= _FEWEST)
    norm = (j - i) - sum((s[j] - s[i]) ** 2 for s in sum_line)  # of the top hat without its part along the line
    gain = np.where(ok, (sum_z[j] - sum_z[i]) ** 2 / np.where(ok, norm, 1.0), -1.0)
    i, j = np.unravel_index(np.argmax(gain), gain.shape)
    return float(0.5 * (d[i - 1] + d[i])), float(0.5 * (d[j - 1] + d[j]))


def _fit(
    profile: Profile, parts: tuple[tuple[float, float], ...], deltas: tuple[float, ...], edges: tuple[float, ...]
) -> StepHeight:
    """Fit Z = a X + b + h delta to parts of a profile.

    Raises:
        GuardError: fewer than `_FEWEST` heights in a part, or the surface is curved.
    """
    d, z = profile.distance, profile.height
    slack = 1e-9 * float(d[-1] - d[0])
    member = np.array([(d >= low - slack) & (d <= high + slack) & np.isfinite(z) for low, high in parts])
    if member.sum(axis=1).min() < _FEWEST:
        k = int(np.argmin(member.sum(axis=1)))
        raise GuardError(
            f"a step height needs {_FEWEST} or more known heights in each part, got {member[k].sum()} from "
            f"{parts[k][0]:.4g} to {parts[k][1]:.4g} um: choose a longer profile, or another place"
        )
    use = member.any(axis=0)
    delta = np.einsum("k,kn->n", np.array(deltas), member)[use]
    design = np.stack([delta, d[use] - d[use].mean(), np.ones(use.sum())], -1)
    solve = np.linalg.pinv(design)
    found = solve @ z[use]
    misfit = z[use] - design @ found
    rms = float(np.sqrt(np.mean(misfit**2)))
    bowl = design[:, 1] ** 2
    bowl = bowl - design @ (solve @ bowl)
    is_curved = np.sum(bowl * misfit) ** 2 > 0.5 * np.sum(bowl**2) * np.sum(misfit**2)
    if abs(found[0]) > 1.001 * float(np.ptp(z[use])) or (is_curved and rms > _CURVED * abs(found[0])):
        raise GuardError(
            f"no step: straight lines {found[0]:.4g} um apart leave {rms:.4g} um rms of heights that span "
            f"{np.ptp(z[use]):.4g} um, because the surface is curved: choose a profile of flat parts"
        )
    if profile.height_samples is not None and len(profile.height_samples) > 1:
        std = float(np.sqrt(np.mean((profile.height_samples[:, use] @ solve[0]) ** 2)))
        errors = f"{len(profile.height_samples)} posterior samples of the heights, correlated errors"
    elif profile.height_std is not None and np.isfinite(profile.height_std[use]).all():
        std = float(np.sqrt(np.sum((solve[0] * profile.height_std[use]) ** 2)))
        errors = "standard deviation of each height, errors taken as independent"
    else:
        std = float(np.linalg.norm(solve[0]) * np.sqrt(np.sum(misfit**2) / max(use.sum() - 3, 1)))
        errors = "scatter about the lines, errors taken as independent"
    return StepHeight(float(found[0]), std, float(found[1]), edges, parts, rms, errors)
