"""Pits in a flat substrate: their outlines, and their levels by trial.

A pit masks nothing of the substrate around it, which looks as if there were no pit. So the pixels that the flat
substrate does not explain are the pit, to the pixel; a pit in a pit is what the flat floor of the outer one does not
explain. The level of a floor is the one whose masks, wall and multiple scattering explain the micrographs.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, binary_opening, distance_transform_edt, median_filter

from helio_jax.arrays import BORDER_WIDTH, border_mask
from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse.levels import GAIN, at_level, least_between
from helio_jax.inverse.objects import LEAST_PIXELS, numbered
from helio_jax.inverse.quality import squares

LIMIT = 3.0
"""Mean square residual, over detectors, above which a flat floor does not explain a pixel."""
LEAST_FLOOR = 0.15
"""Least share of a pit's pixels that show its floor: a wall alone has no level."""
HOPELESS = 2.0
"""A region is no pit that with its floor at the best tried depth leaves so many times the misfit of another surface, if
that one explains it (`WELL_EXPLAINED`)."""
WELL_EXPLAINED = 1.5
"""Largest mean square of the residuals of a region that another surface explains."""
LEAST_EXPLAINED = 0.5
"""Least share of a visible floor that is explained once the pit has its level: what is not flat is no pit."""
MOST_PITS = 8
"""More pits are not looked for."""
DEPTHS = 0.0625, 0.125, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0
"""Depths that are tried, in widths of the pit ..."""
REFINEMENTS = 6
"""... and how many more around the best ones: a minimum may be narrower than their distance ..."""
MOST_MINIMA = 2
"""... so that around so many minima more are tried."""
NEAR = 0.15
"""The floor around a pit is then brought to the best level within this share of its depth."""
RIM = 1.0 / 3.0
"""Pixels of a region nearer to its outline than this share of its largest distance from there are its rim."""
MOST_OF_BORDER = 0.5
"""Largest share of the border's pixels in a pit."""
_SQUARE = np.ones((3, 3))


class Pits(NamedTuple):
    """Flat floors below a flat substrate at height 0.

    Attributes:
        surface: with floors and the walls that the beam sees.
        number: of every pixel's pit, 0: the substrate [y, x].
        squares: of the residuals of the data expected on it, limited [detector, y, x].
    """

    surface: Surface
    number: np.ndarray
    squares: np.ndarray

    @property
    def misfit(self) -> float:
        """Half the chi-square; infinite where nothing can be predicted."""
        return 0.5 * float(self.squares.sum())

    @property
    def is_unexplained(self) -> np.ndarray:
        """Pixels that the pits do not explain [y, x]."""
        return median_filter(self.squares.mean(0), 3) > LIMIT


class _Sunk(NamedTuple):
    """A region sunk to a level, perhaps with a pit in its floor.

    Attributes:
        pits: with this one.
        level: of its floor, um.
        floor: its flat part, without pits in it [y, x].
        places: regions that may be pits, with the level of the floor around them: those in the deepest floor first,
            of each floor the largest first.
    """

    pits: Pits
    level: float
    floor: np.ndarray
    places: list[tuple[np.ndarray, float]]

    @property
    def is_flat(self) -> bool:
        """Whether a flat floor explains most of what is seen of it."""
        is_unexplained = self.pits.is_unexplained[self.floor]
        return is_unexplained.size > 0 and bool(np.mean(is_unexplained) <= 1.0 - LEAST_EXPLAINED)


@dataclass(frozen=True)
class PitSearch:
    """Outlines and levels of pits by trial.

    Attributes:
        residuals: of a surface, (model - data) / standard deviation [detector, y, x].
        pitch: dy, dx, um.
        beam_shift: `Instrument.beam_shift`.
        report: called with what is tried next.
        rival: residuals of another surface, the instrument as for the pits, which pits have to compete with
            [detector, y, x]; None: of none.
    """

    residuals: Callable[[Surface], np.ndarray]
    pitch: tuple[float, float]
    beam_shift: tuple[float, float]
    report: Callable[[str], None] = lambda said: None
    rival: np.ndarray | None = None

    def find(self, shape: tuple[int, int]) -> Pits | None:
        """Find the pits of an image; None where there is none."""
        flat = Surface(*np.zeros((3, *shape)))
        pits = Pits(flat, np.zeros(shape, int), self.squares(flat))
        places = [(inside, 0.0) for inside in outlines(pits.is_unexplained)]
        for _ in range(MOST_PITS):
            if not places:
                break
            found = self.sunk(pits, *places.pop(0))
            if found is not None:
                pits, places = found.pits, found.places + places
        return pits if pits.number.any() else None

    def squares(self, surface: Surface) -> np.ndarray:
        """Compute limited squares of residuals [detector, y, x]; infinite where nothing can be predicted."""
        try:
            return squares(self.residuals(surface))
        except PredictionError:
            return np.full((1, *surface.height.shape), np.inf)

    def sunk(self, pits: Pits, inside: np.ndarray, above: float) -> _Sunk | None:
        """Sink a region below the floor around it, and the largest pit in its own floor, where there is one.

        A floor with a pit in it is explained best by a level between the two, and then the outline of what is not
        explained is not that of the pit. Along its rim, a floor has its own level, at which the outline of the pit
        shows.

        Args:
            pits: found so far.
            inside: the region [y, x].
            above: height of the floor around it, um.

        Returns:
            None where a floor explains no more than no pit does, or less than half of its own pixels, or far less than
            the rival does.
        """
        region = _Region(self, pits, inside, above)
        if region.is_hopeless:
            return None
        found = [region.sunk(inside)]
        misfit = found[0].pits.misfit
        if found[0].places and np.isfinite(misfit):
            by_rim = self._deeper(region, region.sunk(region.rim))
            is_better = by_rim.is_flat and by_rim.pits.misfit < misfit - GAIN
            found = [by_rim] if is_better else [by_rim, self._deeper(region, found[0])]
        pit = [sunk for sunk in found if sunk.is_flat and sunk.pits.misfit < pits.misfit - GAIN]
        return min(pit, key=lambda sunk: sunk.pits.misfit, default=None)

    def _deeper(self, region: "_Region", outer: _Sunk) -> _Sunk:
        """Sink the largest unexplained part of a region's floor, if that is a pit, and bring the floor to its level."""
        if not outer.places:
            return outer
        (inside, _), *others = outer.places
        inner = _Region(self, outer.pits, inside, outer.level).sunk(inside)
        if inner.pits.misfit >= outer.pits.misfit - GAIN or not inner.is_flat:
            return outer._replace(places=others)
        found = [outer._replace(pits=inner.pits, floor=outer.floor & ~inside)]

        def misfit(level: float) -> float:
            """Of both pits, the floor of the outer one at a level."""
            self.report(f"trying the level {level:.0f} um of the floor around a pit")
            floor = outer.pits._replace(surface=region.at(region.above - level))
            surface = _Region(self, floor, inside, level).at(level - inner.level)
            pits = inner.pits._replace(surface=surface, squares=self.squares(surface))
            found.append(found[0]._replace(pits=pits, level=level))
            return pits.misfit

        change = NEAR * (region.above - outer.level)
        _, level = least_between(misfit, outer.level - change, outer.level + change, REFINEMENTS)
        least = next(sunk for sunk in found[1:] if sunk.level == level)
        best = min(found[0], least, key=lambda sunk: sunk.pits.misfit)
        return best._replace(places=inner.places + [(place, best.level) for place, _ in others])


@dataclass(frozen=True)
class _Region:
    """A region that may be a pit; arguments as those of `PitSearch.sunk`."""

    search: PitSearch
    pits: Pits
    inside: np.ndarray
    above: float
    tried: dict[float, np.ndarray] = field(default_factory=dict)

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance of every pixel of the region from the outside [y, x], um."""
        padded = np.asarray(distance_transform_edt(np.pad(self.inside, 1), sampling=self.search.pitch))
        return padded[1:-1, 1:-1]

    @property
    def rim(self) -> np.ndarray:
        """The pixels of the region along its outline [y, x]."""
        return self.inside & (self.distance <= max(RIM * self.distance.max(), *self.search.pitch))

    def at(self, depth: float) -> Surface:
        """Make the surface with the region's floor at a depth below the floor around it, um."""
        beam = self.search.beam_shift if any(self.search.beam_shift) else None
        return at_level(self.inside, self.pits.surface, -depth, self.above, self.search.pitch, beam)

    def squares(self, depth: float) -> np.ndarray:
        """Compute the squares of the residuals at a depth; infinite for a pit whose floor the beam does not see."""
        if depth not in self.tried:
            search, n_pixels = self.search, self.inside.sum()
            search.report(f"trying a pit of {n_pixels} pixels, {depth - self.above:.0f} um deep")
            surface = self.at(depth)
            is_seen = np.sum(floor_of(surface, self.inside)) >= max(LEAST_PIXELS, LEAST_FLOOR * n_pixels)
            self.tried[depth] = search.squares(surface) if is_seen else np.full_like(self.pits.squares, np.inf)
        return self.tried[depth]

    @cached_property
    def depths(self) -> list[float]:
        """Depths that are tried at first, um."""
        return [2.0 * float(self.distance.max()) * share for share in DEPTHS]

    @property
    def is_hopeless(self) -> bool:
        """Whether the rival surface explains the region's pixels, and far better than a pit of any depth."""
        if self.search.rival is None:
            return False
        rival = np.mean(squares(self.search.rival)[:, self.inside])
        if rival > WELL_EXPLAINED:
            return False
        return bool(min(np.mean(self.squares(depth)[:, self.inside]) for depth in self.depths) > HOPELESS * rival)

    def sunk(self, where: np.ndarray) -> _Sunk:
        """Sink the region to the depth that explains the data best in some of its pixels [y, x] and around it."""
        is_weighed = where | ~self.inside

        def misfit(depth: float) -> float:
            return 0.5 * float(np.sum(self.squares(depth), where=is_weighed))

        tried = [misfit(depth) for depth in self.depths]
        found = []
        for place in minima(tried)[:MOST_MINIMA]:
            low, high = self.depths[max(place - 1, 0)], self.depths[min(place + 1, len(tried) - 1)]
            found.append(least_between(misfit, low, high, REFINEMENTS, {self.depths[place]: tried[place]}))
        _, depth = min(found, default=(math.inf, self.depths[0]))
        number = np.where(self.inside, self.pits.number.max() + 1, self.pits.number)
        pits, level = Pits(self.at(depth), number, self.squares(depth)), self.above - depth
        floor = floor_of(pits.surface, self.inside)
        return _Sunk(pits, level, floor, [(within, level) for within in outlines(floor & pits.is_unexplained)])


def outlines(is_unexplained: np.ndarray) -> list[np.ndarray]:
    """Find the regions of pixels that a surface does not explain, the largest first [y, x]."""
    closed = binary_closing(np.pad(binary_opening(is_unexplained, np.ones((2, 2))), 1), _SQUARE)[1:-1, 1:-1]
    number = numbered(closed, LEAST_PIXELS)
    found = [number == n for n in 1 + np.argsort(-np.bincount(number.ravel())[1:], kind="stable")]
    # what holds most of the border is no pit in a substrate: the whole image is unexplained
    return [inside for inside in found if np.mean(inside[border_mask(inside.shape, BORDER_WIDTH)]) < MOST_OF_BORDER]


def minima(values: Sequence[float]) -> list[int]:
    """List the places of local minima, the least first."""
    from scipy.signal import find_peaks

    places, _ = find_peaks(np.pad(-np.asarray(values, float), 1, constant_values=-np.inf))
    return sorted((places - 1).tolist(), key=lambda place: values[place])


def floor_of(surface: Surface, inside: np.ndarray) -> np.ndarray:
    """Mark the pixels of a region at its lowest level: its flat floor, without the walls that the beam sees [y, x]."""
    lowest = surface.height[inside].min()
    return inside & (surface.height <= lowest + 1e-6 * abs(lowest))
