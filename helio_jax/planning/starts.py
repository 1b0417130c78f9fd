"""Where searches of aperture layouts start, and which apertures are tied to one another. Numbers in, numbers out.

A layout is a vector: polar angles, azimuths [rad] and logarithms of the areas of all apertures, and of the working
distance over the stated one [3 * aperture + 1]. A pattern says by which unknowns it may change.
"""

import math
from dataclasses import dataclass

import numpy as np

PAIR_POLAR = math.radians(40.0)
"""Polar angle of rings and pairs at the start, where it is allowed [rad]."""


@dataclass(frozen=True)
class Pattern:
    """How unknowns make a layout: base + matrix @ unknowns.

    Attributes:
        base: layout at unknowns 0 [3 * aperture + 1].
        matrix: derivative of the layout by the unknowns [3 * aperture + 1, unknown].
        low, high: bounds of the unknowns [unknown].
        kind: what the apertures have in common.
    """

    base: np.ndarray
    matrix: np.ndarray
    low: np.ndarray
    high: np.ndarray
    kind: str

    def unknowns_of(self, layout: np.ndarray) -> np.ndarray:
        """Compute the unknowns of a layout of this pattern, within their bounds [unknown]."""
        found = np.linalg.lstsq(self.matrix, layout - self.base, rcond=None)[0]
        return np.clip(found, self.low, self.high)


@dataclass(frozen=True)
class Ranges:
    """Least and largest polar angle [rad], logarithm of the area about its mean, logarithm of the working distance over
    the stated one; equal where it is fixed."""

    polar: tuple[float, float]
    log_area: tuple[float, float]
    log_distance: tuple[float, float]


def free_pattern(n: int, ranges: Ranges) -> Pattern:
    """Make the pattern of n apertures that are not tied."""
    columns = [(i, (1.0,), ranges.polar) for i in range(n)]
    columns += [(n + i, (1.0,), (-3.0 * math.pi, 3.0 * math.pi)) for i in range(n)]
    columns += [(2 * n + i, (1.0,), ranges.log_area) for i in range(n)]
    return _pattern(n, np.zeros(3 * n + 1), [([i], s, b) for i, s, b in columns], ranges, "free")


def paired_pattern(n: int, beam_azimuth: float, single: float, ranges: Ranges) -> Pattern:
    """Make the pattern of symmetric pairs about the plane of the beam, and of one aperture in it where n is odd.

    Args:
        n: apertures.
        beam_azimuth: of the beam [rad].
        single: azimuth of the single aperture from the beam's [rad], 0 or pi.
        ranges: of the numbers.
    """
    base, columns, first = np.zeros(3 * n + 1), [], n % 2
    base[n : 2 * n] = beam_azimuth
    if first:
        base[n] += single
        columns += [([0], (1.0,), ranges.polar), ([2 * n], (1.0,), ranges.log_area)]
    for i in range(first, n, 2):
        columns += [
            ([i, i + 1], (1.0, 1.0), ranges.polar),
            ([n + i, n + i + 1], (1.0, -1.0), (0.0, math.pi)),
            ([2 * n + i, 2 * n + i + 1], (1.0, 1.0), ranges.log_area),
        ]
    return _pattern(n, base, columns, ranges, "pairs")


def _pattern(n: int, base: np.ndarray, columns: list, ranges: Ranges, kind: str) -> Pattern:
    """Drop the unknowns that are fixed; add the working distance."""
    columns = [*columns, ([3 * n], (1.0,), ranges.log_distance)]
    matrix = np.zeros((3 * n + 1, len(columns)))
    for k, (rows, signs, _) in enumerate(columns):
        matrix[rows, k] = signs
    low, high = np.array([bounds for _, _, bounds in columns]).T
    is_free = high > low
    base = base + matrix[:, ~is_free] @ low[~is_free]
    return Pattern(base, matrix[:, is_free], low[is_free], high[is_free], kind)


def ring(n: int, turn: float, ranges: Ranges) -> np.ndarray:
    """Make a layout of n equal apertures, evenly spaced from the azimuth `turn` [rad]."""
    polar = float(np.clip(PAIR_POLAR, *ranges.polar))
    return np.concatenate([np.full(n, polar), turn + 2.0 * np.pi * np.arange(n) / n, np.zeros(n + 1)])


def paired(n: int, pattern: Pattern, single: float, ranges: Ranges) -> np.ndarray:
    """Make the unknowns of a paired pattern whose apertures are evenly spaced."""
    turn = 0.0 if n % 2 else math.pi / n
    azimuths = single * (n % 2) + turn + 2.0 * np.pi * np.arange(n) / n
    half = np.sort(np.mod(azimuths, 2.0 * np.pi)[np.sin(azimuths) > 1e-9])
    polar, middle = float(np.clip(PAIR_POLAR, *ranges.polar)), pattern.base[n : 2 * n].copy()
    middle[n % 2 :: 2] += half
    middle[n % 2 + 1 :: 2] -= half
    return pattern.unknowns_of(np.concatenate([np.full(n, polar), middle, np.zeros(n + 1)]))


def random_layout(n: int, ranges: Ranges, rng: np.random.Generator) -> np.ndarray:
    """Draw a layout of n equal apertures."""
    polar, azimuth = rng.uniform(*ranges.polar, n), rng.uniform(0.0, 2.0 * np.pi, n)
    return np.concatenate([polar, azimuth, np.zeros(n + 1)])
