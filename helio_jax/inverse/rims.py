"""Rims: where a dome meets a level surface, steeper at its rim than further up.

Half balls, ellipsoids and caps rise in the edge that holds their rim by more than the trapezoid rule says: the slope at
a distance t from the rim is c / sqrt(t + r), r = 0 where the tangent at the rim is vertical, r = infinity where the
slope is constant (a cone, a wall). Where in its edge a rim lies, and how steep the rim itself is, follows to some
extent from the slopes of the first two pixels within; what they do not tell of r is common to a whole outline.

The first pixel outside is level: masks and multiple scattering are not predicted well enough there to tell its slope.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.special import logsumexp, softmax

from helio_jax.forward.surface import Surface

OFFSETS = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.1, 1.5, 2.0, 3.0, 5.0, 100.0]) ** 2
"""Values of r that are compared, in pixels; the rise in an edge goes with the root of r, and the last stands for a
constant slope."""
N_DISTANCES = 24
"""Distances of the first pixel from the rim, equally likely, over which is averaged."""
LEVEL = 0.25, 0.8
"""Largest slopes of the second and of the first pixel outside, over that of the first within."""
LEVEL_STD = 2.5
"""Largest median slope of the second pixels outside an outline, in standard deviations: rough surfaces have no rims."""
LEAST_SLOPE = 4.0
"""Least slope of the first pixel within, in standard deviations."""
WALL = 0.25
"""Least slope of the second pixel within, over that of the first: below it the first is on a wall."""
RISING = 2.0
"""Where the slope rises from the first pixel to the second by more standard deviations, the rim is further within."""
LEAST_EDGES = 8
"""Shorter outlines have no rim."""
N_INDEPENDENT = 2.0
"""So many edges of an outline count as independent: errors of the fitted slopes agree along it."""
DECISIVE = 0.75
"""Least logarithm of the evidence for a rim against a constant slope."""


@dataclass(frozen=True)
class AxisRims:
    """The edges along one axis at and beside rims.

    Attributes:
        gap: by how much (height change / pitch) should exceed the mean of the two slopes [edge].
        sigma: standard deviation of it; 0: no rim [edge].
        common: change of it by one standard deviation of what is common to its outline [edge].
        outline: number of the outline; 0: no rim [edge].
    """

    gap: np.ndarray
    sigma: np.ndarray
    common: np.ndarray
    outline: np.ndarray

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "AxisRims":
        """Make edges without rims."""
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape, int))

    @property
    def is_rim(self) -> np.ndarray:
        """Whether the edge is at a rim, or next to one [edge]."""
        return self.outline > 0

    def fill(
        self, place: Any, number: int, sign: int, trapezoid: Any, probability: Any, rise: Any, variance: Any
    ) -> None:
        """Set the edges of an outline at a place, seen along the axis in the direction `sign`.

        Args:
            place: index of the edges.
            number: of the outline.
            sign: 1 or -1.
            trapezoid: mean slope of their two ends [edge].
            probability: of each of `OFFSETS` [offset].
            rise, variance: of the edges where that offset is right [offset, edge].
        """
        mean = probability @ rise
        between = np.sqrt(probability @ (rise - mean) ** 2)
        self.gap[place] = sign * (mean - trapezoid)
        self.sigma[place] = np.sqrt(probability @ variance + between**2)
        self.common[place] = sign * between
        self.outline[place] = number


@dataclass(frozen=True)
class RimEdges:
    """Rises in the edge of the rim and in the next one [edge]: means, variances, for each of `OFFSETS` [offset, edge].

    Attributes:
        rise, variance: in the edge of the rim.
        next_rise, next_variance: in the next.
        evidence: logarithm of the probability of the two slopes.
    """

    rise: np.ndarray
    variance: np.ndarray
    next_rise: np.ndarray
    next_variance: np.ndarray
    evidence: np.ndarray


def rises(first: np.ndarray, second: np.ndarray, first_std: np.ndarray, second_std: np.ndarray) -> RimEdges:
    """Compute the rises beside rims from the slopes of the first and the second pixel within [edge].

    The distance d of the first pixel from the rim is uniform in (0, 1) pixels, c has a scale-free prior.

    Args:
        first, second: slopes away from the rim [edge].
        first_std, second_std: their standard deviations [edge].

    Source: own derivation, tests/inverse/test_rims.py.
    """
    d = (np.arange(N_DISTANCES) + 0.5) / N_DISTANCES
    per_offset = []
    s1, s2, i1, i2 = (a[:, None] for a in (first, second, first_std**-2, second_std**-2))
    for r in OFFSETS:
        at_rim, at_first, at_second = np.sqrt(r), np.sqrt(d + r), np.sqrt(1.0 + d + r)
        information = i1 / at_first**2 + i2 / at_second**2
        c = (i1 * s1 / at_first + i2 * s2 / at_second) / information
        chi_square = i1 * (s1 - c / at_first) ** 2 + i2 * (s2 - c / at_second) ** 2
        log_weight = -0.5 * (chi_square + np.log(information)) - np.log(np.abs(c) + 1e-12)
        weight = softmax(log_weight, axis=1)
        moments = []
        for length in (2.0 * (at_first - at_rim), 2.0 * (at_second - at_first)):
            mean = np.sum(weight * c * length, axis=1)
            variance = np.sum(weight * ((c * length - mean[:, None]) ** 2 + length**2 / information), axis=1)
            moments += [mean, variance]
        per_offset.append((*moments, logsumexp(log_weight, axis=1) - np.log(N_DISTANCES)))
    return RimEdges(*(np.array(part) for part in zip(*per_offset, strict=True)))


class _Candidates(NamedTuple):
    """First pixels within rims, seen along an axis in one direction; slopes rise away from the rim [candidate].

    Attributes:
        y, x: rows and columns.
        first, second: slopes of the first and the second pixel within.
        first_std, second_std: their standard deviations.
        outer: slope of the first pixel outside.
        beyond: size of the slope of the second pixel outside, in standard deviations.
    """

    y: np.ndarray
    x: np.ndarray
    first: np.ndarray
    second: np.ndarray
    first_std: np.ndarray
    second_std: np.ndarray
    outer: np.ndarray
    beyond: np.ndarray

    def only(self, which: np.ndarray) -> "_Candidates":
        """Keep some of them [candidate]."""
        return _Candidates(*(values[which] for values in self))


def find_rims(surface: Surface, noise: float | np.ndarray) -> tuple[AxisRims, AxisRims]:
    """Find the rims of a surface in its edges along x and along y.

    Args:
        surface: heights and slopes.
        noise: slope noise of a level pixel, or of every pixel [y, x].
    """
    slopes = np.asarray(surface.slope_x), np.asarray(surface.slope_y)
    steep = np.hypot(*slopes)
    std = np.broadcast_to(noise * (1.0 + steep**2), steep.shape)
    ways = [(axis, sign) for axis in (1, 0) for sign in (1, -1)]
    found = {way: _candidates(slopes[1 - way[0]], steep, std, *way) for way in ways}
    out = {axis: AxisRims.none(np.diff(steep, axis=axis).shape) for axis in (1, 0)}
    within = np.zeros(steep.shape, bool)
    for c in found.values():
        within[c.y, c.x] = True
    eight = np.ones((3, 3))
    outlines, n_outlines = label(binary_dilation(within, eight), eight)  # type: ignore[misc]  # SciPy's stubs
    for number in range(1, n_outlines + 1):
        mine = {way: c.only(outlines[c.y, c.x] == number) for way, c in found.items()}
        beyond = np.concatenate([c.beyond for c in mine.values()])
        if len(beyond) < LEAST_EDGES or np.median(beyond) > LEVEL_STD:
            continue
        beside = {way: rises(c.first, c.second, c.first_std, c.second_std) for way, c in mine.items()}
        evidence = np.sum([b.evidence.sum(1) for b in beside.values()], axis=0)
        evidence = evidence * min(1.0, N_INDEPENDENT / len(beyond))
        if np.max(evidence) - evidence[-1] < DECISIVE:
            continue
        probability = softmax(evidence)
        for (axis, sign), c in mine.items():
            b, level = beside[axis, sign], np.zeros((len(OFFSETS), len(c.y)))
            parts = (
                (-1, c.outer, level, level + c.outer**2 / 12.0),
                (0, c.outer + c.first, b.rise, b.variance),
                (1, c.first + c.second, b.next_rise, b.next_variance),
            )
            for step, sum_of_ends, rise, variance in parts:
                # edges are numbered by their first pixel along the axis
                move = step - 1 if sign > 0 else -step
                place = (c.y + move * (axis == 0), c.x + move * (axis == 1))
                out[axis].fill(place, number, sign, 0.5 * sum_of_ends, probability, rise, variance)
    return out[1], out[0]


def _candidates(slope: np.ndarray, steep: np.ndarray, std: np.ndarray, axis: int, sign: int) -> _Candidates:
    """Find the first pixels within rims along an axis (0: y, 1: x), upwards or downwards (`sign`)."""
    way = (slice(None), slice(None, None, sign)) if axis == 1 else (slice(None, None, sign), slice(None))
    turned = (lambda a: a[way]) if axis == 1 else (lambda a: a[way].T)
    s, t, e = sign * turned(slope), turned(steep), turned(std)
    far, near, first, second = (slice(k, s.shape[1] - 3 + k) for k in range(4))
    size = np.abs(s[:, first])
    is_rim = (t[:, far] < LEVEL[0] * size) & (t[:, near] < LEVEL[1] * size) & (size > LEAST_SLOPE * e[:, first])
    further = np.sign(s[:, first]) * s[:, second]
    is_rim &= (further > WALL * size) & (further < size + RISING * np.hypot(e[:, first], e[:, second]))
    row, column = np.nonzero(is_rim)
    at, after = (row, column + 2), (row, column + 3)
    along = column + 2 if sign > 0 else s.shape[1] - 1 - (column + 2)
    place = (row, along) if axis == 1 else (along, row)
    return _Candidates(*place, s[at], s[after], e[at], e[after], s[row, column + 1], (t / e)[row, column])
