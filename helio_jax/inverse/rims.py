"""Rims: where a dome meets a level surface, steeper at its rim than further up.

Half balls, ellipsoids and caps rise in the edge that holds their rim by more than the trapezoid rule says. A row or
column cuts them in an ellipse: the slope at a distance t from the rim is c (1 - t / L) / sqrt(t (1 - t / 2 L) + r), L
the distance of the crest from the rim, r = 0 where the tangent at the rim is vertical, r = infinity on a parabola. Of a
cone or a wall the slope is constant (L and r infinite). Where in its edge a rim lies, and how steep the rim itself is,
follows to some extent from the slopes of the first pixels within; what they do not tell of r is common to a whole
outline. An oblique beam shears the sections along its azimuth, and moves the others off the middle: the sides of a dome
that rise and that fall along the beam then have an r each, and of the sheared sections each direction. What is not
known of these is counted as one error, for they are the sections of one dome.

The first pixel outside is level: masks and multiple scattering are not predicted well enough there to tell its slope.
Rows that leave the image before they reach a crest tell nothing.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.special import softmax

from helio_jax.forward.surface import Surface
from helio_jax.kernel import kernel

OFFSETS = np.r_[np.arange(0.0, 1.5, 0.05), np.arange(1.5, 3.0, 0.1), 3.0, 3.5, 4.0, 5.0, 100.0, 100.0] ** 2
"""Values of r that are compared, in pixels; the rise in an edge goes with the root of r, whose steps are finer than its
errors. The last two have no rim: a parabola and, with the crest at infinity, a constant slope."""
NO_RIM = 0.15
"""Prior probability of the last two together; of the others those of the root of r in equal ranges are alike."""
VERTICAL = 20.0
"""A tangent that is vertical at the rim (r = 0), as that of half a ball, is so many times as likely as r near it."""
_RANGES = np.gradient(np.sqrt(OFFSETS[:-2])) * np.where(OFFSETS[:-2] == 0.0, VERTICAL, 1.0)
LOG_PRIOR = np.log(np.r_[(1.0 - NO_RIM) * _RANGES / _RANGES.sum(), 0.5 * NO_RIM, 0.5 * NO_RIM])
"""Logarithm of the prior probability of each of `OFFSETS`."""
FAR = 1e6
"""Distance of a crest at infinity, in pixels."""
N_WITHIN = 4
"""So many pixels within a rim are compared."""
LEAST_CREST = 1.5
"""Least distance of the crest from the first pixel, in pixels: rows nearer to the edge of a dome are not used."""
NEAR_CREST = 0.8
"""Distance over that of the crest from which on slopes are not compared: ellipses fit domes at their rims."""
FIRST_ERROR = 0.25
"""Standard deviation of the first slope within over (1 + slope^2)^(3/2), besides noise: masks and multiple scattering
depend most on the place of the rim there. Steep first slopes hardly count: fits found 56 for 66 deg all along an
outline."""
SHAPE_ERROR = 0.05
"""Standard deviation of the other slopes, over the slope, besides noise: domes are not quite elliptic."""
N_DISTANCES = 24
"""Distances of the first pixel from the rim, equally likely, over which is averaged."""
LEVEL = 0.25, 0.8
"""Largest slopes of the second and of the first pixel outside, over that of the first within."""
LEVEL_STD, LEVEL_SHARE = 2.5, 0.12
"""Outside an outline the median slope of the second pixels is at most hypot(LEVEL_STD standard deviations, LEVEL_SHARE
of the first slope within): steep rims disturb the pixels beside them. Rough surfaces have no rims."""
LEAST_SLOPE = 4.0
"""Least slope of the first pixel within, in standard deviations."""
WALL = 0.25
"""Least slope of the second pixel within, over that of the first: below it the first is on a wall."""
RISING = 2.0
"""Where the slope rises from the first pixel to the second by more standard deviations, the rim is further within."""
LEAST_EDGES = 8
"""Shorter outlines have no rim."""
N_INDEPENDENT = 8.0
"""So many edges of an outline count as independent: errors of the fitted slopes agree along it."""
LEAST_SHEAR = 0.05
"""Beam shifts per height up to this (incidence of 3 deg) make no difference between the sides of a dome."""
ACROSS = 0.05
"""Slopes whose share along the beam is smaller do not fall along it."""
HIDING = 0.2, 0.3
"""Where a side falls along an oblique beam and the root of r is below the first number, with a probability above the
second, its foot may be hidden behind the limb: edges there may be depth jumps and count as no rims."""
LOW_FOOT = 0.2
"""A hidden foot that is lower is no depth jump [pixels]."""
FOOT_ERROR = 0.3
"""Standard deviation of the height of a hidden foot, over the height."""
DECISIVE = 0.75
"""Least logarithm of the evidence for a rim against a parabola and a constant slope."""


@dataclass(frozen=True)
class AxisRims:
    """The edges along one axis at and beside rims.

    Attributes:
        gap: by how much (height change / pitch) should exceed the mean of the two slopes [edge].
        sigma: standard deviation of it; 0: no rim [edge].
        common: change of it by one standard deviation of what is common to its outline [edge].
        outline: number of the outline, whose sides err alike; 0: no rim [edge].
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

        Of two outlines that share an edge the less certain one counts.

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
        sigma = np.sqrt(probability @ variance + between**2)
        is_new = sigma > self.sigma[place]
        place = tuple(index[is_new] for index in place)
        self.gap[place] = (sign * (mean - trapezoid))[is_new]
        self.sigma[place] = sigma[is_new]
        self.common[place] = (sign * between)[is_new]
        self.outline[place] = number


@dataclass(frozen=True)
class RimEdges:
    """Rises in the edge of the rim and in the next one [edge]: means, variances, for each of `OFFSETS` [offset, edge].

    Attributes:
        rise, variance: in the edge of the rim.
        next_rise, next_variance: in the next.
        evidence: logarithm of the probability of the slopes within.
    """

    rise: np.ndarray
    variance: np.ndarray
    next_rise: np.ndarray
    next_variance: np.ndarray
    evidence: np.ndarray

    def parts(self, sizes: Sequence[int]) -> Iterator["RimEdges"]:
        """Split into parts of so many edges."""
        ends = np.cumsum(sizes)
        for start, end in zip(ends - sizes, ends, strict=True):
            yield RimEdges(*(getattr(self, f.name)[:, start:end] for f in fields(self)))


def rises(slope: np.ndarray, std: np.ndarray, crest: np.ndarray, typical: np.ndarray) -> RimEdges:
    """Compute the rises beside rims from the slopes of the pixels within.

    The distance d of the first pixel from the rim is uniform in (0, 1) pixels, c has a scale-free prior. Parallel
    sections of an ellipsoid share the product of r and L.

    Args:
        slope: slopes away from the rim, of the first and the following pixels [edge, pixel].
        std: their standard deviations; infinite: not known [edge, pixel].
        crest: distance of the crest from the first pixel, in pixels [edge].
        typical: r of an edge is one of `OFFSETS` times `typical` / L, in pixels [edge].

    Source: own derivation, tests/inverse/test_rims.py.
    """
    ahead = np.arange(slope.shape[1])
    inverse = np.where((ahead < 2) | (ahead < NEAR_CREST * crest[:, None]), 1.0 / std, 0.0)
    found = np.empty((5, len(OFFSETS), len(slope)))
    _compare(slope, inverse, crest, typical, OFFSETS, N_DISTANCES, found)
    return RimEdges(*found)


@kernel
def _compare(slope, inverse, crest, typical, offsets, n_distances, found):
    """Compute the attributes of `RimEdges` [5, offset, edge]; `inverse` of the standard deviations [edge, pixel]."""
    last = offsets.shape[0] - 1
    log_weight, scale, in_edge, in_next, spread = np.empty((5, n_distances))
    for i in range(slope.shape[0]):
        for number in range(offsets.shape[0]):
            for n in range(n_distances):
                d = (n + 0.5) / n_distances
                length = crest[i] + d
                r = offsets[number] * typical[i] / length
                far = FAR if number == last else length
                information = along = square = 0.0
                for k in range(slope.shape[1]):
                    at = inverse[i, k] * _slope(d + k, r, far)
                    measured = inverse[i, k] * slope[i, k]
                    information, along, square = information + at * at, along + at * measured, square + measured**2
                c = along / information
                chi_square = max(square - c * along, 0.0)
                log_weight[n] = -0.5 * (chi_square + math.log(information)) - math.log(abs(c) + 1e-12)
                to_rim, to_first, to_second = _rise(0.0, r, far), _rise(d, r, far), _rise(1.0 + d, r, far)
                scale[n], in_edge[n], in_next[n] = c, to_first - to_rim, to_second - to_first
                spread[n] = 1.0 / information
            largest = log_weight.max()
            weight = np.exp(log_weight - largest)
            total = weight.sum()
            weight /= total
            for place, rise in ((0, in_edge), (2, in_next)):
                mean = (weight * scale * rise).sum()
                found[place, number, i] = mean
                found[place + 1, number, i] = (weight * ((scale * rise - mean) ** 2 + rise**2 * spread)).sum()
            found[4, number, i] = largest + math.log(total / n_distances)


@kernel
def _slope(t, r, crest):
    """Compute the slope of a section of a dome at a distance t from its rim, up to the crest, for c = 1.

    Args:
        t: the distance.
        r: offset.
        crest: distance L of the crest from the rim.
    """
    t = min(t, crest)
    return (1.0 - t / crest) / math.sqrt(t * (1.0 - 0.5 * t / crest) + r)


@kernel
def _rise(t, r, crest):
    """Compute the height of the section there (`_slope`), above one that does not depend on t."""
    t = min(t, crest)
    return 2.0 * math.sqrt(t * (1.0 - 0.5 * t / crest) + r)


class _Candidates(NamedTuple):
    """First pixels within rims, seen along an axis in one direction; slopes rise away from the rim [candidate].

    Attributes:
        y, x: rows and columns.
        slope: slopes of the first pixels within [candidate, pixel].
        std: their standard deviations [candidate, pixel].
        crest: distance of the crest from the first, in pixels.
        outer: slope of the first pixel outside.
        beyond: size of the slope of the second pixel outside, over the largest of level pixels.
        falls: whether the first pixel within falls along the beam.
        shear: of the beam along the slope there, over the cosine of the slope's angle to the axis.
    """

    y: np.ndarray
    x: np.ndarray
    slope: np.ndarray
    std: np.ndarray
    crest: np.ndarray
    outer: np.ndarray
    beyond: np.ndarray
    falls: np.ndarray
    shear: np.ndarray

    @property
    def steepness(self) -> np.ndarray:
        """c^2 of a tangent that is vertical at the rim, by the second pixel, 1.5 within on average [candidate]."""
        t = 1.5 / (self.crest + 0.5)
        return 1.5 * self.slope[:, 1] ** 2 * (1.0 - 0.5 * t) / (1.0 - t) ** 2

    @property
    def foot(self) -> np.ndarray:
        """Height that a vertical tangent, sheared by k, hides behind the limb: 2 c^2 k [candidate], pixels."""
        return np.where(self.falls, 2.0 * self.steepness * np.abs(self.shear), 0.0)

    def only(self, which: np.ndarray) -> "_Candidates":
        """Keep some of them [candidate]."""
        return _Candidates(*(values[which] for values in self))


def find_rims(
    surface: Surface, noise: float | np.ndarray, shift: tuple[float, float] | np.ndarray = (0.0, 0.0)
) -> tuple[AxisRims, AxisRims]:
    """Find the rims of a surface in its edges along x and along y.

    Args:
        surface: heights and slopes.
        noise: slope noise of a level pixel, or of every pixel [y, x]; infinite: not observed, has no rim.
        shift: how far the beam moves sideways per unit of height, along x and y; sections along it are sheared.
    """
    slopes = np.asarray(surface.slope_x), np.asarray(surface.slope_y)
    steep = np.hypot(*slopes)
    std = np.broadcast_to(noise * (1.0 + steep**2), steep.shape)
    size, along = math.hypot(*shift), shift[0] * slopes[0] + shift[1] * slopes[1]
    falls = (along < -ACROSS * size * steep) & (size > LEAST_SHEAR)
    ways = [(axis, sign) for axis in (1, 0) for sign in (1, -1)]
    found = {way: _candidates(slopes[1 - way[0]], steep, std, along, falls, *way) for way in ways}
    out = {axis: AxisRims.none(np.diff(steep, axis=axis).shape) for axis in (1, 0)}
    numbers = _outlines(found, steep.shape)
    is_sheared = {1: abs(shift[0]) > LEAST_SHEAR, 0: abs(shift[1]) > LEAST_SHEAR}
    groups = [[way for way in ways if not is_sheared[way[0]]], *([way] for way in ways if is_sheared[way[0]])]
    outlines = []
    for number in np.unique(np.concatenate(list(numbers.values()))):
        mine = {way: c.only(numbers[way] == number) for way, c in found.items()}
        beyond = np.concatenate([c.beyond for c in mine.values()])
        if len(beyond) < LEAST_EDGES or np.median(beyond) > 1.0:
            continue
        sides = []
        for group, is_falling in itertools.product(groups, (False, True)):
            parts = {way: mine[way].only(mine[way].falls == is_falling) for way in group}
            sides.append({way: part for way, part in parts.items() if len(part.y)})
        outlines.append([side for side in sides if side])
    n_outlines, beside = 0, _rises_of([side for sides in outlines for side in sides])
    for sides in outlines:
        judged = [_Side.of(side, next(beside)) for side in sides]
        if sum(side.gain for side in judged) < DECISIVE:
            continue
        n_outlines += 1
        for side in judged:
            if not side.may_hide_its_foot:
                side.set_edges(out, n_outlines)
    return out[1], out[0]


def _outlines(found: dict[tuple[int, int], _Candidates], shape: tuple[int, ...]) -> dict[tuple[int, int], np.ndarray]:
    """Number the outline of every candidate [candidate].

    Those of neighbouring domes, of domes and bowls, and of the two sides of a wide ring differ.

    Args:
        found: candidates along each axis in each direction.
        shape: of the image.
    """
    within, body = np.zeros(shape, bool), np.zeros((2, *shape), bool)  # of bowls, of domes
    kinds = {way: (c.slope[:, 0] > 0.0).astype(int) for way, c in found.items()}
    for (axis, sign), c in found.items():
        within[c.y, c.x] = True
        up = sign * np.arange(0.5 + np.max(c.crest, initial=0.0), dtype=int)
        y, x = (c.y[:, None], c.x[:, None] + up) if axis == 1 else (c.y[:, None] + up, c.x[:, None])
        is_part = np.abs(up) <= 0.5 + c.crest[:, None]
        at = np.broadcast_arrays(kinds[axis, sign][:, None], y, x)
        body[tuple(index[is_part] for index in at)] = True
    eight, four = np.ones((3, 3)), np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])
    rim, n_rims = label(binary_dilation(within, eight), eight)  # type: ignore[misc]  # SciPy's stubs
    part, _ = label(body, four * np.array([0, 1, 0])[:, None, None])  # type: ignore[misc]
    return {way: rim[c.y, c.x] + (n_rims + 1) * part[kinds[way], c.y, c.x] for way, c in found.items()}


def _rises_of(sides: list[dict[tuple[int, int], _Candidates]]) -> Iterator[dict[tuple[int, int], RimEdges]]:
    """Compute the rises of sides, all at once.

    Between the sections of an ellipsoid along its axes the product of r and L goes with the square of L, of which
    the crests of rows and columns tell.
    """
    all_of = [c for side in sides for c in side.values()]
    if not all_of:
        return
    typical = []
    for side in sides:
        crests = {
            axis: np.concatenate([np.zeros(0), *(c.crest for way, c in side.items() if way[0] == axis)])
            for axis in (1, 0)
        }
        middle = 0.5 + float(np.median(np.concatenate(list(crests.values()))))
        of_axis = {axis: (0.5 + float(np.median(c))) ** 2 / middle for axis, c in crests.items() if len(c)}
        typical += [np.full(len(c.y), of_axis[axis]) for (axis, _), c in side.items()]
    slope, std, crest = (np.concatenate([getattr(c, name) for c in all_of]) for name in ("slope", "std", "crest"))
    found = rises(slope, std, crest, np.concatenate(typical)).parts([len(c.y) for c in all_of])
    for side in sides:
        yield {way: next(found) for way in side}


class _Side(NamedTuple):
    """Candidates that share an r, by axis and direction.

    Attributes:
        mine: them.
        beside: their rises.
        evidence: of each of `OFFSETS`, logarithm, without their prior probability [offset].
    """

    mine: dict[tuple[int, int], _Candidates]
    beside: dict[tuple[int, int], RimEdges]
    evidence: np.ndarray

    @classmethod
    def of(cls, mine: dict[tuple[int, int], _Candidates], beside: dict[tuple[int, int], RimEdges]) -> "_Side":
        """Sum up the evidence."""
        evidence = np.sum([b.evidence.sum(1) for b in beside.values()], axis=0)
        return cls(mine, beside, evidence * min(1.0, N_INDEPENDENT / sum(len(c.y) for c in mine.values())))

    @property
    def probability(self) -> np.ndarray:
        """Probability of each of `OFFSETS` [offset]."""
        return softmax(self.evidence + LOG_PRIOR)

    @property
    def may_hide_its_foot(self) -> bool:
        """Whether the side falls along the beam, and perhaps so steeply that its foot is not seen."""
        if not all(c.falls.all() for c in self.mine.values()):
            return False
        root, probability = HIDING
        is_steep = self.probability[np.sqrt(OFFSETS) < root].sum() > probability
        return bool(is_steep and np.median(np.concatenate([c.foot for c in self.mine.values()])) > LOW_FOOT)

    @property
    def gain(self) -> float:
        """Logarithm of the evidence for a rim against a parabola and a constant slope."""
        return float(np.max(self.evidence[:-2]) - np.max(self.evidence[-2:]))

    def set_edges(self, out: dict[int, AxisRims], number: int) -> None:
        """Set the edges at and beside the rim along each axis; `number`: of the outline."""
        probability = self.probability
        for (axis, sign), b in self.beside.items():
            c = self.mine[axis, sign]
            first, second, level = c.slope[:, 0], c.slope[:, 1], np.zeros((len(OFFSETS), len(c.y)))
            parts = (
                (-1, c.outer, level, level + c.outer**2 / 12.0),
                (0, c.outer + first, *_with_hidden_foot(b, c)),
                (1, first + second, b.next_rise, b.next_variance),
            )
            for step, sum_of_ends, rise, variance in parts:
                # edges are numbered by their first pixel along the axis
                move = step - 1 if sign > 0 else -step
                place = (c.y + move * (axis == 0), c.x + move * (axis == 1))
                out[axis].fill(place, number, sign, 0.5 * sum_of_ends, probability, rise, variance)


def _with_hidden_foot(beside: RimEdges, c: _Candidates) -> tuple[np.ndarray, np.ndarray]:
    """Add to the rises in the edge of the rim, and to their variances, what the limb hides [offset, edge].

    Seen along the beam, a section with the root of r below c k begins at the limb with a vertical tangent, as if its r
    were 0, and hides 2 c (c k - sqrt(r)). Of its r is known what the prior says: that it is 0, or any other.
    """
    vertical, others = _RANGES[0], np.sqrt(c.steepness) * np.abs(c.shear)
    first, second = ((vertical + others / (power + 1)) / (vertical + others) for power in (1, 2))
    mean, variance = c.foot * first, c.foot**2 * (second - first**2 + (FOOT_ERROR * first) ** 2)
    is_limb = (OFFSETS == 0.0)[:, None]
    return beside.rise + is_limb * mean, beside.variance + is_limb * variance


def _candidates(
    slope: np.ndarray,
    steep: np.ndarray,
    std: np.ndarray,
    along: np.ndarray,
    falls: np.ndarray,
    axis: int,
    sign: int,
) -> _Candidates:
    """Find the first pixels within rims along an axis (0: y, 1: x), upwards or downwards (`sign`).

    Rows and columns of less than four pixels have none.

    Args:
        slope: along the axis [y, x].
        steep, std: size of the slope, and standard deviation of each component [y, x].
        along: slope times the shift of the beam along it [y, x].
        falls: whether the surface falls along the beam [y, x].
        axis, sign: see above.
    """
    way = (slice(None), slice(None, None, sign)) if axis == 1 else (slice(None, None, sign), slice(None))
    turned = (lambda a: a[way]) if axis == 1 else (lambda a: a[way].T)
    s, t, e, beam, falling = sign * turned(slope), turned(steep), turned(std), turned(along), turned(falls)
    far, near, first, second = (slice(k, max(0, s.shape[1] - 3) + k) for k in range(4))
    size, is_known = np.abs(s[:, first]), np.isfinite(e)
    is_rim = np.logical_and.reduce([is_known[:, k] for k in (far, near, first, second)])
    is_rim &= (t[:, far] < LEVEL[0] * size) & (t[:, near] < LEVEL[1] * size) & (size > LEAST_SLOPE * e[:, first])
    further = np.sign(s[:, first]) * s[:, second]
    is_rim &= (further > WALL * size) & (further < size + RISING * np.hypot(e[:, first], e[:, second]))
    row, column = np.nonzero(is_rim)
    first = column + 2
    crest = _crest(np.sign(s[row, first])[:, None] * s[row], first, is_known[row])
    ahead = np.minimum(first[:, None] + np.arange(N_WITHIN), s.shape[1] - 1)  # beyond the border is beyond the crest
    at = row[:, None], ahead
    error = SHAPE_ERROR * np.abs(s[at])
    error[:, 0] = FIRST_ERROR * (1.0 + t[row, first] ** 2) ** 1.5
    std = np.hypot(e[at], error)
    position = first if sign > 0 else s.shape[1] - 1 - first
    place = (row, position) if axis == 1 else (position, row)
    level = np.hypot(LEVEL_STD * e[row, column], LEVEL_SHARE * s[row, first])
    shear = beam[row, first] / np.abs(s[row, first])
    outer, beyond = s[row, column + 1], t[row, column] / level
    found = _Candidates(*place, s[at], std, crest, outer, beyond, falling[row, first], shear)
    return found.only(crest > LEAST_CREST)


def _crest(slope: np.ndarray, first: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Compute the distance from the first pixels to where the slope changes sign [candidate]; 0: that is not observed.

    Args:
        slope: of whole rows, positive in the first pixel within [candidate, pixel].
        first: number of that pixel [candidate].
        is_known: where the slope is observed [candidate, pixel].
    """
    n = slope.shape[1]
    is_ahead = np.arange(n) > first[:, None]
    after, end = (
        np.where((is_ahead & is_so).any(axis=1), (is_ahead & is_so).argmax(axis=1), n)
        for is_so in (slope <= 0.0, ~is_known)
    )
    rising, falling = (slope[np.arange(len(first)), np.minimum(k, n - 1)] for k in (after - 1, after))
    return np.where(after < end, after - first + falling / np.maximum(rising - falling, 1e-12), 0.0)
