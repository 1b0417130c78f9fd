"""Pits in a flat substrate: their outlines, and their levels by trial.

A pit masks nothing of the substrate around it, which looks as if there were no pit. So the pixels that the flat
substrate does not explain are the pit, to the pixel; a pit in a pit is what the flat floor of the outer one does not
explain. The level of a floor is the one whose masks, wall and multiple scattering explain the micrographs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, binary_opening, distance_transform_edt, median_filter

from helio_jax.arrays import BORDER_WIDTH, border_mask
from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse.levels import GAIN, at_level, least_between
from helio_jax.inverse.objects import LEAST_PIXELS, numbered
from helio_jax.inverse.quality import half_chi_square, squares

LIMIT = 3.0
"""Mean square residual, over detectors, above which a flat floor does not explain a pixel."""
LEAST_FLOOR = 0.15
"""Least share of a pit's pixels that show its floor: a wall alone has no level."""
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
MOST_OF_BORDER = 0.5
"""Largest share of the border's pixels in a pit."""
_SQUARE = np.ones((3, 3))


class Pits(NamedTuple):
    """Flat floors below a flat substrate at height 0.

    Attributes:
        surface: with floors and the walls that the beam sees.
        number: of every pixel's pit, 0: the substrate [y, x].
        misfit: of the data expected on it.
    """

    surface: Surface
    number: np.ndarray
    misfit: float


@dataclass(frozen=True)
class PitSearch:
    """Outlines and levels of pits by trial.

    Attributes:
        residuals: of a surface, (model - data) / standard deviation [detector, y, x].
        pitch: dy, dx, um.
        beam_shift: `Instrument.beam_shift`.
        report: called with what is tried next.
        hopeless: misfit above which no more pits are looked for once the largest one is sunk.
    """

    residuals: Callable[[Surface], np.ndarray]
    pitch: tuple[float, float]
    beam_shift: tuple[float, float]
    report: Callable[[str], None] = lambda said: None
    hopeless: float = np.inf

    def find(self, shape: tuple[int, int]) -> Pits | None:
        """Find the pits of an image; None where there is none, or where the search is hopeless."""
        flat = Surface(*np.zeros((3, *shape)))
        pits = Pits(flat, np.zeros(shape, int), self.misfit(flat))
        places = [(inside, 0.0) for inside in outlines(self.is_unexplained(flat))]
        for _ in range(MOST_PITS):
            if not places:
                break
            inside, above = places.pop(0)
            deeper, level = self.sunk(pits, inside, above)
            if deeper.misfit < pits.misfit - GAIN:
                floor, is_unexplained = floor_of(deeper.surface, inside), self.is_unexplained(deeper.surface)
                if np.mean(is_unexplained[floor]) <= 1.0 - LEAST_EXPLAINED:
                    pits = deeper
                    places = [(within, level) for within in outlines(floor & is_unexplained)] + places
            if pits.misfit > self.hopeless:
                return None
        return pits if pits.number.any() else None

    def misfit(self, surface: Surface) -> float:
        """Half the chi-square of the data expected on a surface; infinite where nothing can be predicted."""
        try:
            return half_chi_square(self.residuals(surface))
        except PredictionError:
            return np.inf

    def is_unexplained(self, surface: Surface) -> np.ndarray:
        """Mark the pixels that a surface does not explain [y, x]."""
        return median_filter(squares(self.residuals(surface)).mean(0), 3) > LIMIT

    def sunk(self, pits: Pits, inside: np.ndarray, above: float) -> tuple[Pits, float]:
        """Sink a region below the floor around it, to the level that explains the data best.

        Args:
            pits: found so far.
            inside: the region [y, x].
            above: height of the floor around it, um.

        Returns:
            The pits, and the level of the region, um; one whose floor the beam does not see is none.
        """
        beam = self.beam_shift if any(self.beam_shift) else None
        width = 2.0 * float(np.max(np.asarray(distance_transform_edt(np.pad(inside, 1), sampling=self.pitch))))

        def trial(depth: float) -> Surface:
            return at_level(inside, pits.surface, -depth, above, self.pitch, beam)

        def misfit(depth: float) -> float:
            self.report(f"trying a pit of {inside.sum()} pixels, {depth - above:.0f} um deep")
            surface = trial(depth)
            is_floor_seen = np.sum(floor_of(surface, inside)) >= max(LEAST_PIXELS, LEAST_FLOOR * inside.sum())
            return self.misfit(surface) if is_floor_seen else np.inf

        depths = [width * share for share in DEPTHS]
        tried = [misfit(depth) for depth in depths]
        value, depth = min(zip(tried, depths, strict=True))
        for place in minima(tried)[:MOST_MINIMA]:
            low, high = depths[max(place - 1, 0)], depths[min(place + 1, len(depths) - 1)]
            value, depth = min((value, depth), least_between(misfit, low, high, REFINEMENTS))
        number = np.where(inside, pits.number.max() + 1, pits.number)
        return Pits(trial(depth), number, value), above - depth


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
