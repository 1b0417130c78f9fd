"""Heights of steps whose mask bands are shorter than a pixel, from the pixels along the whole edge.

A pixel shows one point of the surface. Along an edge these points lie at all distances from it, up to half a pixel, so
that together they show the signal across the step at a fraction of a pixel: where the upper level, the wall, its mask
and the lower level begin and end. Place and direction of the edge, height and width of the wall (which may slope, and
is seen as far as the beam reaches it), and how much is scattered at its foot are sampled from their posterior.

The model is that of `wall_signal`, with a wall that falls by its height h over a horizontal width w: the point at the
distance u from the upper edge in the raster lies at the horizontal distance x = u + (t . n) drop, and is masked from
the part of the aperture with q > x / drop.

Source: sampler: Goodman and Weare, Comm. Appl. Math. Comp. Sci. 5 (2010) 65.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from helio_jax.inverse.dash_lines import Line
from helio_jax.inverse.wall_signal import Opening, WallSignal, wall_signal

_NEAR = 1.2
"""Pixels that are compared with the model: up to this distance from the line [pixels]."""
_SIDES = 1.2, 5.0, 3.0
"""Pixels that show the level of a side: their least and largest distance from the line, and the standard deviation of
the weight along it [pixels]."""
_MODEL_ERROR = 0.03
"""Error of the modelled signal, as a fraction of the level's."""
_WALL_ERROR = 0.25
"""The same on the wall: how it is inclined and what it is seen from is modelled roughly."""
_FUZZ = 0.1
"""How straight an edge is [pixels]."""
_OUTLIER = 3.0
"""Residual from which on a pixel loses weight [standard deviations]."""
_HEIGHTS = 0.02, 4.0
"""Heights that are tried: the band of the detector with the longest one [pixels]."""
_WIDEST = 0.8
"""Greatest width of a wall [pixels]."""
_NODES = 256
"""Nodes of tables."""
_WALKERS, _TRIES, _MOVES = 48, 2000, (120, 300)
"""Number of walkers; of random starts, of which the best become walkers; of moves of each, of which half count."""
_TEMPERATURE = 2.0
"""Factor on minus the logarithm of the likelihood: the model errs from pixel to pixel in common."""


@dataclass(frozen=True)
class LowStep:
    """A step lower than a pixel's worth of mask; lengths in pixels.

    Attributes:
        line: the upper edge.
        height, std: of the step.
        width: of the wall.
        gain: by how much the model is better than a surface without a step: difference of minus the logarithm of the
            likelihood.
        misfit: mean robust square of the residuals [standard deviations squared].
        darkened: share of the pixels that the model darkens most in which the signal is dark.
        bands: mean length of the band along the normal of every detector over the height; 0: none [detector].
    """

    line: Line
    height: float
    std: float
    width: float
    gain: float
    misfit: float
    bands: tuple[float, ...]


@dataclass(frozen=True)
class _Strip:
    """Pixels along a line.

    Attributes:
        place: (column, row) [pixel, 2].
        data, std: signal and its noise [detector, pixel].
        upper, lower: signal of each side there [detector, pixel].
        signals: of a vertical wall along the line [detector].
        openings: of the detectors.
        beam_shift: along x and y [2].
        spot: standard deviation of the beam's spot [pixels].
    """

    place: np.ndarray
    data: np.ndarray
    std: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    signals: tuple[WallSignal, ...]
    openings: tuple[Opening, ...]
    beam_shift: np.ndarray
    spot: float


def _strip_of(
    line: Line, signal: np.ndarray, variance: np.ndarray, openings: tuple[Opening, ...], shift: np.ndarray, spot: float
) -> _Strip | None:
    """Take the pixels along a line, and the levels of its sides from those farther away."""
    row, column = np.indices(signal.shape[1:])
    place = np.stack([column, row], -1).reshape(-1, 2).astype(float)
    u, w = place @ line.normal - line.offset, place @ line.along
    known = np.isfinite(signal).all(0).ravel()
    inside = known & (np.abs(u) < _NEAR) & (w >= line.start - 0.5) & (w <= line.end + 0.5)
    values, errors = signal.reshape(len(signal), -1), variance.reshape(len(signal), -1)
    sides = []
    for way in (-1.0, 1.0):
        beside = known & (way * u > _SIDES[0]) & (way * u < _SIDES[1])
        if beside.sum() < 2 * int(line.end - line.start) or not inside.any():
            return None
        weight = np.exp(-0.5 * ((w[inside, None] - w[None, beside]) / _SIDES[2]) ** 2)
        # lines across the strip: the sides may slope
        sides.append(values[:, beside] @ weight.T / weight.sum(1))
    normal = line.normal
    return _Strip(
        place[inside],
        values[:, inside],
        np.sqrt(np.maximum(errors[:, inside], 0.0)),
        sides[0],
        sides[1],
        tuple(wall_signal(o, (float(shift[0]), float(shift[1])), normal) for o in openings),
        openings,
        shift,
        spot,
    )


class _Tables(NamedTuple):
    """Signal across a wall of one detector at evenly spaced arguments from 0 to 1.

    Attributes:
        masked: fraction of the aperture masked from the lower level, by distance from the upper edge over `reach`.
        reach: least distance that no point of the aperture is masked from [heights].
        level: multiple scattering at the distance d from the foot of a vertical wall, by d / (1 + d) [heights].
        wall: the same on the wall, by height above the foot over that of the wall.
        facet: direct signal of a wall, in that of the level, by its inclination over 90 deg.
        shift: t . n.
    """

    masked: np.ndarray
    reach: float
    level: np.ndarray
    wall: np.ndarray
    facet: np.ndarray
    shift: float

    @classmethod
    def of(cls, s: WallSignal, opening: Opening, normal: np.ndarray) -> "_Tables":
        """Tabulate the signal of a wall that falls along a normal."""
        t = np.linspace(0.0, 1.0, _NODES + 1)
        reach = max(float(s.q[-1]), 1e-6)
        tilt = 0.5 * np.pi * t[:, None]
        facet = np.maximum(np.cos(tilt) + np.sin(tilt) * (opening.tau @ normal), 0.0) @ opening.weight
        distance = t / np.maximum(1.0 - t, 1e-3)
        return cls(s.masked(reach * t), reach, s.on_level(distance), s.on_wall(t), facet, s.shift)


def _at(table: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Interpolate a table of evenly spaced arguments from 0 to 1."""
    place = np.clip(t, 0.0, 1.0) * _NODES
    i = np.minimum(place.astype(np.intp), _NODES - 1)
    return table[i] + (place - i) * np.diff(table)[i]


def _profile(
    s: _Tables, u: np.ndarray, h: np.ndarray, w: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the signal across a wall of one detector, in that of the level, and where the wall is [walker, pixel].

    Args:
        s: of the detector.
        u: distance from the upper edge [walker, pixel].
        h, w: height and width of the wall [walker, 1].
        c: multiple scattering, over that of the cosine law [walker, 1].
    """
    image = np.maximum(w - h * s.shift, 0.0)
    x = np.maximum(u + h * s.shift, 0.0)
    tilt = np.arctan2(h, w)
    c = c * (1.0 - np.cos(tilt))  # solid angle of an inclined wall over that of a vertical one, at the foot
    away = np.maximum(x - w, 0.0)
    low = 1.0 - _at(s.masked, x / (h * s.reach)) + c * _at(s.level, away / (away + h))
    wall = _at(s.facet, tilt / (0.5 * np.pi)) + c * _at(s.wall, 1.0 - u / np.maximum(image, 1e-9))
    is_wall = (u > 0.0) & (u < image)
    return np.where(u <= 0.0, 1.0, np.where(is_wall, wall, low)), is_wall


def _cost(strip: _Strip, line: Line) -> Callable[[np.ndarray], np.ndarray]:
    """Make the function that computes minus the logarithm of the posterior of walkers [walker, 5] -> [walker].

    Their coordinates: shift of the line [pixels], turn [rad], logarithm of the height, width [pixels], scattering.
    """
    u0, w0 = strip.place @ line.normal - line.offset, strip.place @ line.along - 0.5 * (line.start + line.end)
    tables = [_Tables.of(s, o, line.normal) for s, o in zip(strip.signals, strip.openings, strict=True)]
    longest, fuzz = max(s.length for s in strip.signals), float(np.hypot(_FUZZ, strip.spot))

    def cost(walkers: np.ndarray) -> np.ndarray:
        shift, turn, log_h, w, c = (walkers[:, i, None] for i in range(5))
        h = np.exp(log_h)
        u = u0 - shift - turn * w0
        total = np.zeros(len(walkers))
        bad = (h * longest < _HEIGHTS[0]) | (h * longest > _HEIGHTS[1]) | (w < 0.0) | (w > _WIDEST)
        bad = (bad | (c < 0.0) | (c > 2.0))[:, 0]
        w = np.clip(w, 1e-3, None)
        for k, s in enumerate(tables):
            (before, on_wall), (after, is_next) = (_profile(s, u + d, h, w, c) for d in (-fuzz, fuzz))
            level = np.where(u < 0.0, strip.upper[k], strip.lower[k])
            model = 0.5 * (before + after)
            rough = np.where(on_wall | is_next, _WALL_ERROR * np.maximum(model, 0.3), _MODEL_ERROR)
            std = np.sqrt(strip.std[k] ** 2 + level**2 * (rough**2 + (0.5 * (after - before)) ** 2))
            r = (strip.data[k] - level * model) / std
            total += np.sum(0.5 * _OUTLIER**2 * np.log1p((r / _OUTLIER) ** 2) + np.log(std / level), 1)
        return np.where(bad, np.inf, total / _TEMPERATURE + 0.5 * ((c[:, 0] - 1.0) / 0.6) ** 2)

    return cost


def _sampled(cost: Callable[[np.ndarray], np.ndarray], first: np.ndarray, moves: int, rng: np.random.Generator) -> np.ndarray:
    """Sample a posterior by the stretch move from the best of some starts [start, n] -> [sample, n]."""
    value = cost(first)
    best = np.argsort(value)[:_WALKERS]
    at, value, kept = first[best].copy(), value[best].copy(), []
    half, n = _WALKERS // 2, first.shape[1]
    groups = np.arange(half), np.arange(half, _WALKERS)
    for move in range(moves):
        for mine, others in (groups, groups[::-1]):
            z = (1.0 + rng.random(half)) ** 2 / 2.0  # 1/sqrt(z) on [1/2, 2]
            other = at[rng.choice(others, half)]
            new = other + z[:, None] * (at[mine] - other)
            moved = cost(new)
            is_taken = np.log(rng.random(half)) < (n - 1) * np.log(z) + value[mine] - moved
            at[mine[is_taken]], value[mine[is_taken]] = new[is_taken], moved[is_taken]
        if move >= moves // 2:
            kept.append(np.concatenate([at, value[:, None]], 1))
    return np.concatenate(kept)


def fit_step(
    line: Line, signal: np.ndarray, variance: np.ndarray, openings: tuple[Opening, ...], shift: np.ndarray, spot: float
) -> LowStep | None:
    """Measure a step along a line of dashes.

    Args:
        line: near the upper edge [pixels].
        signal, variance: [detector, y, x].
        openings: of the detectors.
        shift: `Instrument.beam_shift` [2].
        spot: standard deviation of the beam's spot [pixels].

    Returns:
        The step; None where too few pixels show its sides.
    """
    rng = np.random.default_rng(0)
    spread = 0.8, 0.03
    for moves in _MOVES:  # once more with the line as found
        strip = _strip_of(line, signal, variance, openings, shift, spot)
        if strip is None:
            return None
        longest = max(s.length for s in strip.signals)
        if longest <= 0.0:
            return None
        cost = _cost(strip, line)
        n = _TRIES
        first = np.stack(
            [
                rng.uniform(-1.0, 1.0, n) * spread[0],
                rng.uniform(-1.0, 1.0, n) * spread[1],
                rng.uniform(np.log(0.05), np.log(2.0), n) - np.log(longest),
                rng.uniform(0.0, _WIDEST, n),
                rng.uniform(0.3, 1.5, n),
            ],
            -1,
        )
        drawn = _sampled(cost, first, moves, rng)
        mean = drawn[np.argmin(drawn[:, -1])]
        middle = 0.5 * (line.start + line.end)
        angle = line.angle + float(np.arctan(mean[1]))
        turned = Line(angle, 0.0, line.start, line.end)
        through = line.normal * (line.offset + mean[0]) + line.along * middle
        half = 0.5 * (line.end - line.start)
        w = float(through @ turned.along)
        line = Line(angle, float(through @ turned.normal), w - half, w + half)
        spread = 0.25, 0.01
    height = np.exp(drawn[:, 2])
    none = np.array([[10.0, 0.0, np.log(0.3 / longest), 0.1, 1.0]])  # the line lies beyond the strip
    return LowStep(
        line,
        float(height.mean()),
        float(height.std()),
        float(drawn[:, 3].mean()),
        float(cost(none)[0] - drawn[:, -1].min()),
        float(drawn[:, -1].min()) / strip.data.size,
        tuple(s.length if s.dark_share > 0.995 else 0.0 for s in strip.signals),
    )
