"""Heights of steps whose mask bands are shorter than a pixel, from all pixels along the edge.

A pixel shows the surface at one point. Along an edge these points lie at all distances from it, up to half a pixel:
together they show the signal across the step finer than the raster, where wall, mask and lower level begin and end.
Place, direction and bend of the edge, height and width of the wall and the scattering at its foot are sampled from
their posterior. A line that no step explains, such as a scratch, has none.

Source: sampler: Goodman and Weare, Comm. Appl. Math. Comp. Sci. 5 (2010) 65.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from helio_jax.inverse.dash_lines import Line
from helio_jax.inverse.low_wall import LowWall
from helio_jax.inverse.wall_signal import Opening, WallSignal, wall_signal

_NEAR = 1.2
"""Pixels that are compared with the model: up to this distance from the line [pixels]."""
_SIDES = 1.2, 5.0, 3.0
"""Pixels that show the signal of a side: their least and largest distance from the line, and the standard deviation of
their weight along it [pixels]."""
_MODEL_ERROR = 0.03
"""Error of the modelled signal, in that of the level."""
_WALL_ERROR = 0.06
"""Relative error of the signal of a wall, added in square to the error above: it need not be a plane, nor what it sees
level."""
_FUZZ = 0.1
"""How straight an edge is: in a pixel it may be so far before its line, at it, or as far behind it [pixels]."""
_NODE, _LEAST_SPOT = math.sqrt(2.0), 0.05
"""Nodes of the mean across a disc, -1, 0 and 1 times this, with weights 1/4, 1/2 and 1/4 [standard deviations]
(Gauss-Chebyshev, second kind); and the smallest spot that is averaged over, as a standard deviation [pixels]."""
_BEND = 0.2
"""How far the middle of an edge is from the line between its ends: on a curved surface an oblique beam bends it
[pixels]."""
_OUTLIER = 3.0
"""Residual from which on a pixel loses weight [standard deviations]."""
_LONGEST = 0.02, 4.0
"""Range of the longest image of a step that is tried [pixels]."""
_WIDEST = 0.8
"""Greatest width of a wall [pixels]."""
_SCATTER = 1.0, 0.25, 2.0
"""Multiple scattering over the prediction: prior mean, standard deviation, and most. Nearly all helium leaves a surface
again; what stands around, and a curved level, change it."""
_LINE_WIDTHS, _LEAST_ON_LINE = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.2), 3
"""Widths of a line without a step that are tried [pixels], and the fewest pixels on it."""
_CREASES = np.append(np.arange(-1.0, 1.01, 0.25), (-np.inf, np.inf))
"""Places of a crease between the sides that are tried where no step is [pixels]; at infinity: one side only."""
_WALKERS = 32
_CHAINS = 3
"""Independent chains of samples."""
_ROUNDS = (4000, 40, 0.8, 0.03), (2000, 40, 0.2, 0.008), (1000, 160, 0.06, 0.003)
"""Random starts, of which the best become walkers; moves of each, of which the second half counts; range of the first
shifts [pixels] and turns [rad] of the line: in each round, about the best of the last one."""
_LOST = 12.0
"""Walkers whose cost is greater than the least one by more have not arrived [minus log likelihood]."""
_TEMPERATURE = 2.0
"""Factor on minus the logarithm of the likelihood: the model errs from pixel to pixel in common."""
_AGAINST = 25.0
"""Evidence against a step beyond the ends of its line, from which on it ends there: of three pixels or more that should
be dark [minus log likelihood]."""
_GAIN = 30.0
"""Least gain of a step that is believed [minus log likelihood]; of one that falls the other way half that of the first,
in every round."""
_SHAPE_STD, _SHAPE_STD_AWAY = 0.05, 0.8
"""Standard deviation of heights by the shape of the wall, as a fraction of the height found: 0.05, for staircases of
facets a quarter of a pixel wide come out 10 % too low. Of a wall that faces away from the beam 0.8 t . n min(1, width /
height) is added, t . n the tangent of the incidence across it: the beam sees little of a sloping one, and at 30 deg
those of two facets come out up to 40 % too low, which is 67 % of the height found."""

_Modelled = tuple[int, np.ndarray, np.ndarray]
"""A detector's number, and its signal and error of the model."""


@dataclass(frozen=True)
class LowStep:
    """A step lower than a pixel's worth of mask; lengths in pixels.

    Attributes:
        line: the upper edge.
        height, std: of the step.
        width: horizontal width of the wall.
        bend: of the edge, as in `_Strip.distance`.
        gain: by how much a step explains the pixels better than none [minus log likelihood].
        signals: of a vertical wall along the line [detector].
    """

    line: Line
    height: float
    std: float
    width: float
    bend: float
    gain: float
    signals: tuple[WallSignal, ...]

    @property
    def shape_std(self) -> float:
        """Standard deviation of the height by the shape of the wall, as a fraction."""
        slopes = min(1.0, self.width / self.height)
        return _SHAPE_STD + _SHAPE_STD_AWAY * slopes * max(self.signals[0].shift, 0.0)


def _longest_image(signals: Sequence[WallSignal]) -> float:
    """Return the longest mask band, wall or shadow of a vertical wall [heights], of the signals of all detectors."""
    return max(max(s.length, abs(s.shift)) for s in signals)


@dataclass(frozen=True)
class Scan:
    """Data; lengths in pixels.

    Attributes:
        place: of the pixels, about the middle of the image [y, x, 2].
        signal, variance: NaN where not observed [detector, y, x].
        openings: of the detectors.
        beam_shift: `Instrument.beam_shift` [2].
        spot: standard deviation of the beam's spot.
    """

    place: np.ndarray
    signal: np.ndarray
    variance: np.ndarray
    openings: Sequence[Opening]
    beam_shift: np.ndarray
    spot: float


@dataclass(frozen=True)
class _Strip:
    """Pixels along a line.

    Attributes:
        u, w: distance from the line, and place along it from the middle [pixel].
        data, std: signal and its noise [detector, pixel].
        upper, lower: signal of the two sides there [detector, pixel].
        half: half the length of the line.
        walls: signal across a wall along the line [detector].
        spot: standard deviation of the beam's spot across the line; the raster stretches it along the beam's azimuth.
    """

    u: np.ndarray
    w: np.ndarray
    data: np.ndarray
    std: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    half: float
    walls: tuple[LowWall, ...]
    spot: float

    @classmethod
    def of(cls, line: Line, scan: Scan, signals: Sequence[WallSignal], beyond: float = 0.5) -> "_Strip | None":
        """Take the pixels along a line and `beyond` its ends; None where too few pixels show its sides."""
        place = scan.place.reshape(-1, 2)
        u, w = place @ line.normal - line.offset, place @ line.along - 0.5 * (line.start + line.end)
        half = 0.5 * (line.end - line.start)
        values, noise = (a.reshape(len(a), -1) for a in (scan.signal, scan.variance))
        known = np.isfinite(values).all(0)
        inside, sides = known & (np.abs(u) < _NEAR) & (np.abs(w) <= half + beyond), []
        for way in (-1.0, 1.0):
            beside = known & (way * u > _SIDES[0]) & (way * u < _SIDES[1])
            weight = np.exp(-0.5 * ((w[inside, None] - w[None, beside]) / _SIDES[2]) ** 2)
            if not weight.size or weight.sum(1).min() < 1.0:
                return None
            sides.append(values[:, beside] @ weight.T / weight.sum(1))
        walls = tuple(LowWall.of(s, o, line.normal) for s, o in zip(signals, scan.openings, strict=True))
        std = np.sqrt(np.maximum(noise[:, inside], 0.0))
        spot = scan.spot * math.hypot(1.0, float(scan.beam_shift @ line.normal))
        return cls(u[inside], w[inside], values[:, inside], std, sides[0], sides[1], half, walls, spot)

    def distance(self, shift: float | np.ndarray, turn: float | np.ndarray, bend: float | np.ndarray) -> np.ndarray:
        """Compute the distance from the line, shifted, turned and curved [..., pixel]."""
        return self.u - shift - turn * self.w - bend * ((self.w / self.half) ** 2 - 1.0 / 3.0)

    def costs(self, walkers: np.ndarray) -> np.ndarray:
        """Compute minus the logarithm of the likelihood of every pixel [walker, pixel]; walkers as in `_prior`."""
        shift, turn, log_height, width, scatter, bend = (walkers[:, i, None] for i in range(6))
        height, width = np.exp(log_height), np.maximum(width, 1e-3)
        walls = range(len(self.walls))
        return self._over_edges(
            self.distance(shift, turn, bend),
            lambda at: ((k, *self._signal(k, at, height, width, scatter)) for k in walls),
        )

    def _over_edges(self, u: np.ndarray, signals: Callable[[np.ndarray], Iterable[_Modelled]]) -> np.ndarray:
        """Compute minus the logarithm of the likelihood, averaged over where the edge is in a pixel [..., pixel].

        Args:
            u: distance from the edge's line [..., pixel].
            signals: each detector's number, signal and error of the model [..., pixel] at distances from the edge.
        """
        places = []
        for place, share in ((-_FUZZ, 0.25), (0.0, 0.5), (_FUZZ, 0.25)):
            total = np.full(u.shape, -math.log(share))
            for k, model, error in signals(u + place):
                std = np.sqrt(self.std[k] ** 2 + error**2)
                rest = (self.data[k] - model) / std
                total += 0.5 * _OUTLIER**2 * np.log1p((rest / _OUTLIER) ** 2) + np.log(std / self.lower[k])
            places.append(-total)
        total = -np.logaddexp(np.logaddexp(places[0], places[1]), places[2])
        return total / _TEMPERATURE

    def _signal(self, k: int, u: np.ndarray, *wall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the signal of detector k and the error of the model, averaged over the spot [walker, pixel].

        Args:
            k: detector.
            u: distance from the edge [walker, pixel].
            wall: height, width and scattering, as of `LowWall.profile`.
        """
        signal, error = np.zeros(u.shape), np.zeros(u.shape)
        nodes = ((-_NODE, 0.25), (0.0, 0.5), (_NODE, 0.25)) if self.spot > _LEAST_SPOT else ((0.0, 1.0),)
        for node, weight in nodes:
            at = u + self.spot * node
            model, is_wall = self.walls[k].profile(at, *wall)
            side = weight * self._side(k, at)
            signal += side * model
            error += side * _model_error(model, is_wall)
        return signal, error

    def gain_of_line(self, bend: float) -> float:
        """Compute by how much a line of other signals, without a step, explains the pixels better than none.

        Dirt and narrow ridges are such lines: each detector's signal in it is free, and as uncertain as on a wall.
        """
        u, least = self.distance(0.0, 0.0, bend), np.inf
        for start in np.arange(-1.0, 1.0, 0.05):
            for width in _LINE_WIDTHS:
                middle = start + 0.5 * width
                inside = np.abs(u - middle) < 0.5 * width
                if inside.sum() < _LEAST_ON_LINE:
                    continue
                share = [(data / self._side(k, u - middle))[inside] for k, data in enumerate(self.data)]

                def signals(at: np.ndarray, level=np.median(share, 1), middle=middle, half=0.5 * width):
                    is_line = np.abs(at - middle) < half
                    for k, brightness in enumerate(level):
                        model, side = np.where(is_line, brightness, 1.0), self._side(k, at - middle)
                        yield k, side * model, side * _model_error(model, is_line)

                least = min(least, float(self._over_edges(u, signals).sum()))
        return float(self.without().sum()) - least

    def without(self) -> np.ndarray:
        """Compute the same of a surface without a step: one side, or the two with a crease between them [pixel]."""

        def costs(place: float) -> np.ndarray:
            sides = [self._side(k, self.u - place) for k in range(len(self.walls))]
            return self._over_edges(self.u, lambda _: ((k, s, _MODEL_ERROR * s) for k, s in enumerate(sides)))

        return min((costs(float(place)) for place in _CREASES), key=np.sum)

    def _side(self, k: int, u: np.ndarray) -> np.ndarray:
        """Return detector k's signal of the upper side where u < 0, and of the lower elsewhere [..., pixel]."""
        return np.where(u < 0.0, self.upper[k], self.lower[k])


def _model_error(model: np.ndarray, is_wall: np.ndarray) -> np.ndarray:
    """Return the error of a modelled signal [..., pixel]; both over the signal of the level."""
    return np.where(is_wall, np.hypot(_MODEL_ERROR, _WALL_ERROR * model), _MODEL_ERROR)


def _prior(walkers: np.ndarray, longest: float) -> np.ndarray:
    """Compute minus the logarithm of the prior [walker].

    Args:
        walkers: shift of the line [pixels], turn [rad], logarithm of the height, width of the wall [pixels], scattering
            over the prediction, and bend [pixels] [walker, 6].
        longest: `_longest_image`.
    """
    _, _, log_height, width, scatter, bend = walkers.T
    image = np.exp(log_height) * longest
    mean, std, most = _SCATTER
    is_out = (image < _LONGEST[0]) | (image > _LONGEST[1]) | (width < 0.0) | (width > _WIDEST)
    is_out |= (scatter < 0.0) | (scatter > most)
    # all inclinations of the wall are equally likely
    inclined = np.log1p((width * np.exp(-log_height)) ** 2) + log_height
    return np.where(is_out, np.inf, inclined + 0.5 * (((scatter - mean) / std) ** 2 + (bend / _BEND) ** 2))


def _starts(rng: np.random.Generator, n: int, longest: float, shift: float, turn: float) -> np.ndarray:
    """Draw n random walkers as in `_prior`, half of them without a bend, half of vertical walls.

    `longest` as there; `shift` [pixels] and `turn` [rad]: the largest.
    """
    height = np.exp(rng.uniform(math.log(0.05), math.log(2.0), n)) / longest
    width = height * np.tan(0.45 * np.pi * rng.random(n)) * rng.integers(0, 2, n)
    columns = (
        rng.uniform(-shift, shift, n),
        rng.uniform(-turn, turn, n),
        np.log(height),
        np.minimum(width, _WIDEST * rng.random(n)),
        rng.uniform(0.0, 1.5, n),
        rng.normal(0.0, _BEND, n) * rng.integers(0, 2, n),
    )
    return np.stack(columns, -1)


def _sampled(
    cost: Callable[[np.ndarray], np.ndarray], first: np.ndarray, moves: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Sample a posterior by the stretch move, from the best of some starts.

    Args:
        cost: minus the logarithm of the posterior of points [point, n] -> [point].
        first: starts [start, n].
        moves: of every walker; the second half counts.
        rng: random numbers.

    Returns:
        Samples [sample, n] and their costs [sample].
    """
    value = cost(first)
    best = np.argsort(value)[:_WALKERS]
    at, value, kept = first[best].copy(), value[best].copy(), []
    half, n = _WALKERS // 2, first.shape[1]
    groups = np.arange(half), np.arange(half, _WALKERS)
    for move in range(moves):
        for mine, others in (groups, groups[::-1]):
            z = (1.0 + rng.random(half)) ** 2 / 2.0
            other = at[rng.choice(others, half)]
            new = other + z[:, None] * (at[mine] - other)
            moved = cost(new)
            is_taken = np.log(rng.random(half)) < (n - 1) * np.log(z) + value[mine] - moved
            at[mine[is_taken]], value[mine[is_taken]] = new[is_taken], moved[is_taken]
        if move >= moves // 2:
            kept.append((at.copy(), value.copy()))
    points, values = zip(*kept, strict=True)
    return np.concatenate(points), np.concatenate(values)


def _moved(line: Line, shift: float, turn: float) -> Line:
    """Return a line shifted along its normal [pixels] and turned about its middle [rad]."""
    middle = line.normal * (line.offset + shift) + line.along * 0.5 * (line.start + line.end)
    half, turned = 0.5 * (line.end - line.start), line._replace(angle=line.angle - math.atan(turn))
    at = float(middle @ turned.along)
    return Line(turned.angle, float(middle @ turned.normal), at - half, at + half)


def _extended(line: Line, scan: Scan, signals: Sequence[WallSignal], walker: np.ndarray) -> Line:
    """Extend a line at both ends up to where the pixels speak against a step.

    Where no pixel lies in its band nothing tells whether a step goes on: it does, for a step rarely ends.
    """
    reach = float(np.hypot(scan.place[..., 0], scan.place[..., 1]).max())
    strip = _Strip.of(line, scan, signals, beyond=2.0 * reach)
    if strip is None:
        return line
    flat = walker.copy()
    flat[5] = 0.0  # a bend is not to be extrapolated
    gain = strip.costs(flat[None])[0] - strip.without()
    ends = []
    for way in (-1.0, 1.0):
        beyond = way * strip.w > strip.half
        order = np.argsort(way * strip.w[beyond])
        place, against = (way * strip.w[beyond])[order], np.cumsum(gain[beyond][order])
        stop = np.flatnonzero(against - np.minimum.accumulate(np.minimum(against, 0.0)) > _AGAINST)
        if stop.size:
            best = int(np.argmin(against[: stop[0] + 1]))
            ends.append(float(place[best]) if against[best] < 0.0 else strip.half)
        else:
            ends.append(float(place.max(initial=strip.half)))
    middle = 0.5 * (line.start + line.end)
    return line._replace(start=middle - ends[0], end=middle + ends[1])


def fit_step(ways: Sequence[Line], scan: Scan) -> LowStep | None:
    """Measure the step along a line of dashes.

    The posterior may have several maxima, and a chain finds one: several are run, and differences between those that
    explain the pixels about as well are part of the standard deviation.

    Args:
        ways: a line near the upper edge; or one that shows as bright pixels, and its reverse: the way that explains the
            pixels best is taken, if it explains them better than a line of other signals.
        scan: data.

    Returns:
        The step; None where too few pixels show its sides, or no step explains them.
    """
    first, chosen = None, ways[0]
    for way in ways:
        low = _one_chain(way, scan, 0, _GAIN if first is None else max(_GAIN, 0.5 * first.gain))
        if low is not None and (first is None or low.gain > first.gain):
            first, chosen = low, way
    if first is None:
        return None
    if len(ways) > 1:
        strip = _Strip.of(first.line, scan, first.signals)
        if strip is None or strip.gain_of_line(first.bend) > first.gain:
            return None
    further = (_one_chain(chosen, scan, seed, _GAIN) for seed in range(1, _CHAINS))
    chains = [first, *(low for low in further if low is not None)]
    best = max(chains, key=lambda low: low.gain)
    height, std = np.array([(low.height, low.std) for low in chains if low.gain > best.gain - _LOST]).T
    spread = height.var(ddof=1) if height.size > 1 else 0.0
    return replace(best, height=float(height.mean()), std=float(np.sqrt(np.mean(std**2) + spread)))


def _one_chain(line: Line, scan: Scan, seed: int, least_gain: float) -> LowStep | None:
    """Measure the step along a line of dashes by one chain of samples, as `fit_step`; None below a gain."""
    rng, found = np.random.default_rng(seed), None
    for tries, moves, *spread in _ROUNDS:
        shift = float(scan.beam_shift[0]), float(scan.beam_shift[1])
        signals = tuple(wall_signal(o, shift, line.normal) for o in scan.openings)
        strip, longest = _Strip.of(line, scan, signals), _longest_image(signals)
        if strip is None or longest <= 0.0:
            return None
        points, costs = _sampled(
            lambda p, strip=strip, longest=longest: _prior(p, longest) + strip.costs(p).sum(1),
            _starts(rng, int(tries), longest, *spread),
            moves,
            rng,
        )
        best = points[np.argmin(costs)]
        gain = float(strip.without().sum() - strip.costs(best[None]).sum())
        if gain < least_gain:
            return None
        drawn = points[costs < costs.min() + _LOST]
        height, width = np.exp(drawn[:, 2]), float(drawn[:, 3].mean())
        line = _moved(line, float(best[0]), float(best[1]))
        found = LowStep(line, float(height.mean()), float(height.std()), width, float(best[5]), gain, signals)
        line = _extended(line, scan, signals, np.array([0.0, 0.0, *best[2:]]))
    return found
