"""Levels of regions that depth jumps part from their surroundings: many are tried, the best explanation is kept.

`search_levels` tries each region at a number of levels: flat, with the relief that was fitted, and with the wall that
the beam would see, within the region or beside it. All physics is predicted anew, nothing is fitted: masks that end
elsewhere than in the images are what tells the levels apart. The level is then fitted like every other height, and its
error bar says whether masks or the near field fix it; a region that something else explains about as well is undecided.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.optimize import minimize_scalar

from helio_jax.arrays import distance_to_end, nearest_known
from helio_jax.forward.surface import Surface
from helio_jax.inverse.quality import FLOATING

_LEVELS = (0.0625, 0.125, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Levels that are tried, up and down, in widths of the region ..."""
_SHIFTS = (0.03, 0.06, 0.125, 0.25)
"""... and by how much the relief that was fitted is shifted."""
GAIN = 30.0
"""By how much another level must lower the misfit [half chi-square] to be kept; what explains the images less than that
worse may be true as well."""
MOST_FITS = 2
"""So many surfaces with a region at the best levels are fitted shortly, and a rival that puts the region elsewhere."""
_LEVEL_STEPS = 5
"""Evaluations by which the best level of a kind of relief is refined ..."""
HOPELESS = 2.0
"""... unless its misfit is so many times that of the best kind."""

_NEAR, _LEAST_NEAR = 0.25, 3
"""A parabola goes through the places within this share of the range from the best one, if there are more than so
many."""
_UNPREDICTED = 1e100
"""Stands for an infinite misfit, of which no parabola can be made."""

SKIRT = 4
"""Pixels around a region that a fit without the jump may have raised."""
RELIEFS = "flat", "as fitted"
"""Relief of a region that is put to another level ..."""
WALLS = "flat, with a wall", "flat, beside a wall"
"""... and, where an oblique beam sees its wall, that wall within the region or outside it."""

Misfit = Callable[[Surface], float]
"""Half the chi-square of the data expected on a surface, nothing fitted; infinite where nothing can be predicted."""
ShortFit = Callable[[Surface], tuple[float, Surface]]
"""The same after a short fit from a surface, and the surface fitted."""


class Levels(NamedTuple):
    """What a search found: the surface, the regions that it moved, and those that other levels explain as well; both
    by their places among the regions."""

    surface: Surface
    moved: list[int]
    undecided: list[int]


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
        height = distance_to_end(inside, (x, y), pitch) / along
        is_wall = height < abs(level)
        wall = Surface(surroundings + sign * height, -sign * x / along, -sign * y / along)
        flat = jax.tree.map(lambda *fields: np.where(is_wall, *fields), wall, flat)
    return jax.tree.map(lambda *fields: np.where(inside, *fields), flat, surface)


def beside_wall(
    inside: np.ndarray,
    surface: Surface,
    level: float,
    surroundings: float,
    pitch: tuple[float, float],
    beam_shift: tuple[float, float],
) -> Surface:
    """Make a surface with a region flat at a level above its surroundings, and the wall that the beam sees outside it.

    The wall of a plateau that faces the beam is beside the plateau, where the micrographs show it as a region of its
    own; of a hollow, the beam sees the far wall, which is within (`at_level`). Arguments as those.
    """
    flat = at_level(inside, surface, level, surroundings, pitch, None)
    if level <= 0.0:
        return flat
    along = math.hypot(*beam_shift)
    x, y = (shift / along for shift in beam_shift)
    height = level - distance_to_end(~inside, (x, y), pitch) / along
    wall = Surface(surroundings + height, *(np.full(inside.shape, way / along) for way in (x, y)))
    is_wall = ~inside & (height > 0.0)
    return jax.tree.map(lambda *fields: np.where(is_wall, *fields), wall, flat)


@dataclass(frozen=True)
class Region:
    """A region whose level is poorly determined.

    Attributes:
        inside: its pixels [y, x].
        height: measured height above the ground (`Steps.ground`), um; None: not known.
        std: standard deviation of that, um.
        step: measured height above the surface around the region, um; None: not known.
        skirt: pixels around it that a fit without the jump may have raised: as far as its masks reach.
    """

    inside: np.ndarray
    height: float | None = None
    std: float = 0.0
    step: float | None = None
    skirt: int = SKIRT

    def heights(self, surroundings: float, pitch: tuple[float, float], max_width: float) -> list[float]:
        """Choose the heights to be tried, um; arguments as in `search_levels`."""
        if self.step is not None:
            return [surroundings + self.step]
        room = np.pad(self.inside, 1, mode="edge")
        width = min(2.0 * float(np.max(np.asarray(distance_transform_edt(room, sampling=pitch)))), max_width)
        return [surroundings + sign * width * share for share in sorted(_LEVELS) for sign in (-1.0, 1.0)]


@dataclass(frozen=True)
class _RegionSearch:
    """Levels tried for one region; `tried` maps the surface of each trial to its misfit."""

    name: str
    region: Region
    base: Surface
    pitch: tuple[float, float]
    max_width: float
    beam_shift: tuple[float, float]
    misfit: Misfit
    report: Callable[[str], None]
    tried: dict[bytes, float] = field(default_factory=dict)

    @property
    def inside(self) -> np.ndarray:
        return self.region.inside

    @cached_property
    def surroundings(self) -> float:
        """Height of the surface around the region, um."""
        return float(np.median(self.base.height[grown(self.inside, SKIRT) & ~self.inside]))

    def trial(self, level: float, kind: str) -> Surface:
        """Make the surface with the region at a level above the surroundings, um."""
        if kind == "as fitted":
            rise = level + self.surroundings - float(np.median(self.base.height[self.inside]))
            return Surface(self.base.height + rise * self.inside, self.base.slope_x, self.base.slope_y)
        if kind == "flat, beside a wall":
            return beside_wall(self.inside, self.base, level, self.surroundings, self.pitch, self.beam_shift)
        shift = self.beam_shift if kind == "flat, with a wall" else None
        return at_level(self.inside, self.base, level, self.surroundings, self.pitch, shift)

    def misfit_at(self, level: float, kind: str) -> float:
        """Compute the misfit with the region at a level above the surroundings, um."""
        trial = self.trial(level, kind)
        key = _key(trial)  # deeper than the beam reaches, levels are one surface
        if key not in self.tried:
            self.report(f"{self.name}: trying the level {level:+.0f} um, {kind}")
            self.tried[key] = self.misfit(trial)
        return self.tried[key]

    def search(self) -> list[tuple[float, Surface]]:
        """Find the best level of each kind of relief: its misfit and surface, each surface once."""
        heights = self.region.heights(self.surroundings, self.pitch, self.max_width)
        levels, out = [height - self.surroundings for height in heights], {}
        kinds = RELIEFS + (WALLS if any(self.beam_shift) else ())
        levels_of = {kind: sorted(self.shifts(levels) if kind == "as fitted" else levels) for kind in kinds}
        misfits = {kind: [self.misfit_at(level, kind) for level in tried] for kind, tried in levels_of.items()}
        limit = HOPELESS * min(min(found) for found in misfits.values())
        for kind, tried in levels_of.items():
            i = int(np.argmin(misfits[kind]))
            best = tried[i]
            if len(tried) > 1 and misfits[kind][i] < limit:
                at = lambda level, kind=kind: self.misfit_at(level, kind)  # noqa: E731
                low, high, known = tried[max(i - 1, 0)], tried[min(i + 1, len(tried) - 1)], {best: misfits[kind][i]}
                _, best = least_between(at, low, high, _LEVEL_STEPS, known)
            surface = self.trial(best, kind)
            out.setdefault(_key(surface), (self.misfit_at(best, kind), surface))
        return list(out.values())

    def shifts(self, levels: list[float]) -> list[float]:
        """Choose the levels to which the relief that was fitted is shifted: about its own, unless one is known, um."""
        own = float(np.median(self.base.height[self.inside])) - self.surroundings
        reach = max(abs(level) for level in levels) / max(_LEVELS)
        return levels if len(levels) == 1 else [own, *(own + sign * reach * s for s in _SHIFTS for sign in (-1, 1))]


def search_levels(
    regions: Sequence[Region],
    surface: Surface,
    pitch: tuple[float, float],
    max_width: float,
    misfit: Misfit,
    short_fit: ShortFit,
    beam_shift: tuple[float, float] = (0.0, 0.0),
    report: Callable[[str], None] = lambda said: None,
    is_substrate_flat: bool = False,
) -> Levels:
    """Find the surface with all regions at the levels that explain the images best.

    For every kind of relief the best level is found with nothing fitted. The best of these are fitted shortly, and one
    that puts a region elsewhere whose level is not measured. What then explains the images best is kept.

    A fit that bridged jumps raised the surroundings, and their masks and multiple scattering let it stay so: the foot
    of a mesa came to rest at 15 % of its height, at twice the chi-square. So regions are also tried on a flat
    substrate: at height 0, or on the plane of the slopes around where the border is free or the level is not measured.

    Args:
        regions: one after the other; they may overlap.
        surface: to begin with.
        pitch: dy, dx, um.
        max_width: levels up to twice the width of a region are tried, and of this width at most, um.
        misfit, short_fit: see `Misfit`, `ShortFit`.
        beam_shift: `Instrument.beam_shift`: where it is not 0, levels are tried with and without the wall it sees.
        report: called with what is tried next.
        is_substrate_flat: whether the substrate is flat at height 0, not any plane.
    """
    best, found = short_fit(surface)
    moved, undecided = [], []
    for i, region in enumerate(regions):
        inside = region.inside
        done = covered(regions, moved) & ~inside
        base, name = without_skirt(region, done, found), f"region {i + 1} of {len(regions)}, {inside.sum()} pixels"
        search = _RegionSearch(name, region, base, pitch, max_width, beam_shift, misfit, report)
        trials = search.search()
        if is_substrate_flat and region.step is not None:
            plane, kept = Surface(*np.zeros((3, *inside.shape))), done | inside
        else:
            plane, kept = plane_around(region, done, found if moved else surface, pitch), done
        flat = jax.tree.map(lambda f, p, kept=kept: np.where(kept, f, p), found, plane)
        on_flat = replace(search, name=f"{name}, on a flat substrate", base=flat).search()
        starts = _best_surfaces(trials + on_flat)[:MOST_FITS]
        if region.step is None:
            starts += _rivals(_best_surfaces(trials), starts, inside, search.surroundings)[:1]
        explanations = [(best, found), *map(short_fit, starts)]
        value, better = min(explanations, key=lambda entry: entry[0])
        if value < best - GAIN:
            best, found = value, better
            moved.append(i)
        as_good = [other for value, other in explanations if value < best + GAIN]
        if any(_differ(found, other, inside, search.surroundings) for other in as_good):
            undecided.append(i)
    return Levels(found, moved, undecided)


def least_between(
    misfit: Callable[[float], float],
    low: float,
    high: float,
    evaluations: int,
    known: Mapping[float, float] | None = None,
) -> tuple[float, float]:
    """Find the least misfit between two places: the misfit, and where it is, in one evaluation more than so many.

    Predictions are noisy, and the least value is that of a lucky place. So the place is that of the least of a parabola
    through all that is tried near it, where that explains the images no worse than by `GAIN`. `known`: misfits by
    place, of places tried before.
    """
    tried = dict(known or {})

    def at(place: float) -> float:
        tried[place] = min(misfit(place), _UNPREDICTED)
        return tried[place]

    minimize_scalar(at, bounds=(low, high), method="bounded", options={"maxiter": evaluations})
    least = min(tried, key=lambda place: tried[place])
    is_near = lambda place: abs(place - least) <= _NEAR * (high - low) and tried[place] < _UNPREDICTED  # noqa: E731
    near = np.array([place for place in tried if is_near(place)])
    if near.size > _LEAST_NEAR:
        second, first, _ = np.polyfit(near - least, [tried[place] for place in near], 2)
        vertex = least - 0.5 * first / second if second > 0.0 else least
        if near.min() < vertex < near.max() and at(float(vertex)) < tried[least] + GAIN:
            least = float(vertex)
    return tried[least], least


def covered(regions: Sequence[Region], numbers: Iterable[int]) -> np.ndarray:
    """Mark the pixels of the regions of some numbers [y, x]."""
    return np.any([np.zeros_like(regions[0].inside), *(regions[i].inside for i in numbers)], axis=0)


def without_skirt(region: Region, others: np.ndarray, surface: Surface) -> Surface:
    """Continue the surroundings up to a region: a fit that bridged a jump raised the pixels beside it.

    Args:
        region: that jumps part from its surroundings.
        others: pixels that stay as they are [y, x].
        surface: to begin with.
    """
    is_known = _beyond_skirt(region, others)
    skirt = ~(is_known | region.inside | others)
    if not is_known.any():
        return surface
    nearest = nearest_known(is_known)
    return jax.tree.map(lambda f: np.where(skirt, f[nearest], f), surface)


def plane_around(region: Region, others: np.ndarray, surface: Surface, pitch: tuple[float, float]) -> Surface:
    """Make the plane of the median slopes beyond the skirt of a region, through its median height there.

    Slopes of a photometric solution are right beyond a jump that it has bridged, where its heights are not. Arguments
    as those of `without_skirt`.
    """
    is_known = _beyond_skirt(region, others)
    if not is_known.any():
        return surface
    slopes = [float(np.median(slope[is_known])) for slope in (surface.slope_x, surface.slope_y)]
    y, x = (step * index for step, index in zip(pitch, np.indices(is_known.shape, float), strict=True))
    tilt = slopes[0] * x + slopes[1] * y
    level = np.median((surface.height - tilt)[is_known])
    return Surface(level + tilt, *(np.full(tilt.shape, slope) for slope in slopes))


def _beyond_skirt(region: Region, others: np.ndarray) -> np.ndarray:
    """Mark the pixels beyond the skirt of a region [y, x], or beyond `SKIRT` where nothing is; not those of others."""
    for width in (region.skirt, SKIRT):
        is_known = ~(grown(region.inside, width) | others)
        if is_known.any():
            break
    return is_known


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Grow a mask [y, x] by so many pixels."""
    return np.asarray(binary_dilation(mask, np.ones((3, 3)), iterations=pixels))


def _best_surfaces(trials: list[tuple[float, Surface]]) -> list[Surface]:
    """Sort the surfaces of trials by their misfits, each surface once."""
    ordered = sorted(trials, key=lambda entry: entry[0])
    return list({_key(surface): surface for _, surface in ordered}.values())


def _key(surface: Surface) -> bytes:
    """Return what tells a surface from others."""
    return b"".join(np.asarray(field).tobytes() for field in jax.tree.leaves(surface))


def _rivals(trials: list[Surface], chosen: list[Surface], inside: np.ndarray, surroundings: float) -> list[Surface]:
    """Select the trials that put a region elsewhere than all that are chosen."""
    return [trial for trial in trials if all(_differ(trial, other, inside, surroundings) for other in chosen)]


def _differ(surface: Surface, other: Surface, inside: np.ndarray, surroundings: float) -> bool:
    """Whether two surfaces' heights in a region differ by a large share of its step to the surroundings."""
    heights, others = surface.height[inside], other.height[inside]
    step = max(abs(float(np.median(h)) - surroundings) for h in (heights, others))
    return float(np.median(np.abs(heights - others))) > FLOATING * step
