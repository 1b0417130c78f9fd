"""Levels of plateaus: regions of which slopes do not say how high they lie are tried at many; what fits best is kept.

`search_levels` tries each region at a number of levels, flat and with the wall that the beam would see, all physics
predicted anew, and keeps what explains the images best. The level is then fitted like every other height, and its error
bar says whether masks or the near field fix it; a region that something else explains about as well is undecided.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import minimize_scalar

from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse.quality import FLOATING
from helio_jax.inverse.regions import grown

_LEVELS = (0.0625, 0.125, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Levels that are tried, up and down, in widths of the region."""
GAIN = 30.0
"""By how much another level must lower the misfit [half chi-square] to be kept; what explains the images less than that
worse may be true as well."""
_LEVEL_STEPS = 8
"""Evaluations by which the best level is refined."""

Misfit = Callable[[Surface], tuple[float, Surface]]
"""Half the robust chi-square of a surface after its slopes have been fitted, and that surface."""


class Levels(NamedTuple):
    """What a search found: the surface, the regions that it moved, and those that other levels explain as well."""

    surface: Surface
    moved: list[int]
    undecided: list[int]


def _distance_to_region_edge(inside: np.ndarray, way: tuple[float, float], pitch: tuple[float, float]) -> np.ndarray:
    """Compute the distance from every pixel of a region to its end in a direction (x, y) [y, x], um; 0 outside.

    A region that reaches the image's border does not end there.
    """
    step = min(pitch)
    room = np.pad(inside, 1, mode="edge")
    row, column = (index + 1.0 for index in np.nonzero(inside))
    left, is_in = np.zeros(row.size), np.ones(row.size, bool)
    for n in range(1, int(math.hypot(*(np.array(inside.shape) * pitch)) / step) + 2):
        at_row = np.clip(np.rint(row + n * step * way[1] / pitch[0]), 0, room.shape[0] - 1).astype(int)
        at_column = np.clip(np.rint(column + n * step * way[0] / pitch[1]), 0, room.shape[1] - 1).astype(int)
        is_in &= room[at_row, at_column]
        if not is_in.any():
            break
        left[is_in] = n * step
    distance = np.zeros(inside.shape)
    distance[inside] = left + 0.5 * step
    return distance


def at_level(
    inside: np.ndarray,
    surface: Surface,
    level: float,
    surroundings: float,
    pitch: tuple[float, float],
    beam_shift: tuple[float, float] | None,
) -> Surface:
    """Make a surface with a region flat at a level above its surroundings, and with the wall that the beam sees.

    The beam sees the wall that faces it: at the far side of a hollow, at the near side of a plateau. In the beam frame
    a vertical wall rises by the cotangent of the incidence along the beam. Deeper than the beam reaches, there is
    nothing but that wall.

    Args:
        inside: the region [y, x].
        surface: to begin with.
        level: above the surroundings, um.
        surroundings: height of the surface around the region, um.
        pitch: dy, dx, um.
        beam_shift: `Instrument.beam_shift`; None: no wall, as where the region ends undercut.
    """
    flat = Surface(*(np.full(inside.shape, value) for value in (surroundings + level, 0.0, 0.0)))
    if beam_shift is not None:
        along, sign = math.hypot(*beam_shift), np.sign(level)
        x, y = (-sign * shift / along for shift in beam_shift)
        height = _distance_to_region_edge(inside, (x, y), pitch) / along
        is_wall = height < abs(level)
        wall = Surface(surroundings + sign * height, -sign * x / along, -sign * y / along)
        flat = jax.tree.map(lambda *fields: np.where(is_wall, *fields), wall, flat)
    return jax.tree.map(lambda *fields: np.where(inside, *fields), flat, surface)


@dataclass(frozen=True)
class _RegionSearch:
    """Levels tried for one region; `tried` maps the heights of each trial to its misfit and fitted surface."""

    number: int
    inside: np.ndarray
    base: Surface
    surroundings: float
    pitch: tuple[float, float]
    beam_shift: tuple[float, float]
    misfit: Misfit
    report: Callable[[str], None]
    tried: dict[bytes, tuple[float, Surface]] = field(default_factory=dict)

    def misfit_at(self, level: float, has_wall: bool) -> float:
        """Fit the region at a level above the surroundings, um, and compute the misfit; infinite if not predictable."""
        said = " and a wall" if has_wall else ""
        self.report(f"region {self.number} of {self.inside.sum()} pixels: trying the level {level:+.0f} um{said}")
        shift = self.beam_shift if has_wall else None
        trial = at_level(self.inside, self.base, level, self.surroundings, self.pitch, shift)
        key = trial.height.tobytes()  # deeper than the beam reaches, levels are one surface
        if key not in self.tried:
            try:
                self.tried[key] = self.misfit(trial)
            except PredictionError:  # no level of a wall that nothing can be predicted of
                self.tried[key] = np.inf, trial
        return self.tried[key][0]


def search_levels(
    region: np.ndarray,
    surface: Surface,
    pitch: tuple[float, float],
    max_width: float,
    misfit: Misfit,
    beam_shift: tuple[float, float] = (0.0, 0.0),
    report: Callable[[str], None] = lambda said: None,
) -> Levels:
    """Find the surface with all regions at the levels that explain the images best.

    A moved region starts flat; its own relief is the fit's matter.

    Args:
        region: number of the region of every pixel, 0: none [y, x].
        surface: to begin with.
        pitch: dy, dx, um.
        max_width: levels up to twice the width of a region are tried, and of this width at most, um.
        misfit: see `Misfit`.
        beam_shift: `Instrument.beam_shift`: where it is not 0, levels are tried with and without the wall it sees.
        report: called with what is tried next.
    """
    best, found = misfit(surface)
    moved, undecided = [], []
    for number in np.unique(region[region > 0]):
        inside = region == number
        around = grown(inside) & ~inside
        surroundings = float(np.median(found.height[around]))
        room = np.pad(inside, 1, mode="edge")
        width = min(2.0 * float(np.max(np.asarray(distance_transform_edt(room, sampling=pitch)))), max_width)
        search = _RegionSearch(int(number), inside, found, surroundings, pitch, beam_shift, misfit, report)
        levels = sorted(sign * width * share for share in _LEVELS for sign in (-1.0, 1.0))
        kinds = (False, True) if any(beam_shift) else (False,)
        has_wall, i = min(
            product(kinds, range(len(levels))), key=lambda trial: search.misfit_at(levels[trial[1]], trial[0])
        )
        bracket = levels[max(i - 1, 0)], levels[min(i + 1, len(levels) - 1)]
        options = {"maxiter": _LEVEL_STEPS}
        minimize_scalar(search.misfit_at, bounds=bracket, args=(has_wall,), method="bounded", options=options)
        explanations = [(best, found), *search.tried.values()]
        value, better = min(search.tried.values(), key=lambda entry: entry[0])
        if value < best - GAIN:
            best, found = value, better
            moved.append(int(number))
        if any(_differ(found, other, inside, surroundings) for value, other in explanations if value < best + GAIN):
            undecided.append(int(number))
    return Levels(found, moved, undecided)


def _differ(surface: Surface, other: Surface, inside: np.ndarray, surroundings: float) -> bool:
    """Whether two surfaces' heights in a region differ by a large share of its step to the surroundings."""
    heights, others = surface.height[inside], other.height[inside]
    step = max(abs(float(np.median(h)) - surroundings) for h in (heights, others))
    return float(np.median(np.abs(heights - others))) > FLOATING * step
