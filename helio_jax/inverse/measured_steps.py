"""What mask bands tell a fit (`mask_steps`): edges of the raster that walls cut, levels, and sums of heights.

A band's length tells the height of an upper edge above the lower surface at the band's far end, whatever gain and law
are; a fit, which holds its masks fixed in every iteration, learns little of it.
"""

import math
from dataclasses import replace

import numpy as np

from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from helio_jax.forward.surface import along as along_axis
from helio_jax.inverse.anchors import Anchors, most_frequent
from helio_jax.inverse.levels import SKIRT, Region, grown
from helio_jax.inverse.mask_edges import Edge
from helio_jax.inverse.mask_patches import COMMON_STD
from helio_jax.inverse.mask_steps import CERTAIN_WALL
from helio_jax.inverse.step_records import Step, Steps

ABOVE = -2.6, -0.6
"""Pixels that show the height of an upper edge: their distances from it [pixels]."""
BEYOND = 2.6
"""Pixels that show the lower surface: so far beyond the far end of the longest band [pixels]."""
MIN_PIXELS = 3
"""Fewer pixels show no height."""
MAX_LEVEL_SLOPE = 0.3
"""Steeper pixels of a region do not count for its level: they are its wall."""
LEAST_SHARE = 0.01
"""Smaller patches, in shares of the image, are tried at no levels but measured ones: a search takes as long for them as
for others, and they are mostly no patches."""
CERTAINLY_OFF = 3.0
"""A region's level is not the ground's where it differs by so many standard deviations."""
PLACES = -0.3, 0.0, 0.3
"""Places of an edge that are allowed for: a pixel between them may be on either side; it is joined to none [pixels]."""


def walls_of(found: Steps | None, raster: Raster) -> tuple[np.ndarray, np.ndarray]:
    """Find the edges between neighbouring pixels, along x and along y, that cross the upper edge of a measured wall.

    A fit that joins the pixels on both sides bridges a low wall where no pixel shows its mask. Edges whose height is
    not measured may be those of steep facets.

    Args:
        found: steps, or None.
        raster: of the heights.

    Returns:
        Whether a wall parts pixels [y, x - 1], [y - 1, x].
    """
    ny, nx = raster.shape
    cuts = np.zeros((ny, nx - 1), bool), np.zeros((ny - 1, nx), bool)
    side = math.sqrt(float(raster.dx) * float(raster.dy))
    for step in () if found is None else found.steps:
        if not step.is_used or step.p_wall < CERTAIN_WALL or step.above == step.below:
            continue
        distance, along, length = _beside(step, raster)
        is_beside = np.abs(along) <= 0.5 * (length + side)
        for shift in PLACES:
            is_low = distance > shift * side
            for axis, cut in zip((1, 0), cuts, strict=True):
                cut |= np.diff(is_low, axis=axis) & np.logical_and(*along_axis(is_beside, axis))
    return cuts


def anchors_of_steps(
    found: Steps, surface: Surface, raster: Raster, region: np.ndarray
) -> tuple[tuple[int, ...], Anchors]:
    """Express the heights of measured steps by the heights of the pixels beside them.

    The sum of heights is that of the upper edge above the far end of the band, to which the slopes of the surface
    carry the heights of the pixels.

    Args:
        found: steps.
        surface: near the one sought.
        raster: of the heights.
        region: number of the region of every pixel (`quality.regions`): single pixels that jumps part from all others
            show no height [y, x].

    Returns:
        Numbers of the steps, and an anchor for each.
    """
    numbers, weight, value = [], [], []
    for step in found.steps:
        sides = _sides(step, found, raster, region) if step.is_used and step.above != step.below else None
        if sides is None:
            continue
        upper, lower, distance, end = sides
        way = _edge(step).normal
        slope = surface.slope_x * way[0] + surface.slope_y * way[1]
        rise = np.mean((slope * distance)[upper]) - np.mean((slope * (distance - end))[lower])
        std = math.hypot(step.height_std_um, COMMON_STD * step.height_um)
        numbers.append(step.number)
        weight.append((upper / upper.sum() - lower / lower.sum()) / std)
        value.append((step.height_um + float(rise)) / std)
    if not numbers:
        return (), Anchors.none(raster.shape)
    return tuple(numbers), Anchors(np.stack(weight), np.array(value))


def _sides(
    step: Step, found: Steps, raster: Raster, region: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float] | None:
    """Find the pixels above and below a step [y, x], the distance of all from its edge [y, x], and that of the band's
    end [um], 0 of a step without one; None where too few pixels show a side."""
    bands = [b for b in found.bands if b.step == step.number and b.is_clear_mask]
    side = math.sqrt(float(raster.dx) * float(raster.dy))
    end = max((b.length_um * abs(math.cos(math.radians(b.runs_deg - step.falls_deg))) for b in bands), default=0.0)
    distance, along, length = _beside(step, raster)
    beside = np.abs(along) <= 0.5 * length
    upper = beside & (distance > ABOVE[0] * side) & (distance < ABOVE[1] * side) & (found.patch == step.above)
    is_low = beside & (distance > 0.5 * side) & (distance < end + BEYOND * side) & (found.patch == step.below)
    lower = is_low & (distance > end)
    lower = lower if lower.sum() >= MIN_PIXELS else is_low
    upper, lower = (side & (region == most_frequent(region[side])) for side in (upper, lower))
    return (upper, lower, distance, end) if min(upper.sum(), lower.sum()) >= MIN_PIXELS else None


def _beside(step: Step, raster: Raster) -> tuple[np.ndarray, np.ndarray, float]:
    """Compute the distance of every pixel from an edge, towards the lower side, and its place along the edge from the
    middle [y, x]; and the length of the edge; um."""
    edge = _edge(step)
    rel = np.stack(np.meshgrid(np.asarray(raster.x), np.asarray(raster.y)), -1) - edge.middle
    return rel @ edge.normal, rel @ edge.along, edge.length


def _edge(step: Step) -> Edge:
    """Return the upper edge of a step."""
    return Edge(np.array(step.start), np.array(step.end), ())


def measured_regions(found: Steps | None, raster: Raster) -> list[Region]:
    """List the patches between measured steps but for the ground (`Steps.ground`), the largest first.

    A measured level is tried above the patch around it: a surface with a free border may bend so far that the
    substrate elsewhere is no reference. Where the ground's own level is not determined, heights above it are not known.
    """
    if found is None:
        return []
    by_number, ground, out = {p.number: p for p in found.patches}, found.ground, []
    for p in sorted(found.patches, key=lambda patch: -patch.pixels):
        is_searched = p.is_determined or p.pixels >= LEAST_SHARE * found.patch.size
        if p.number == ground.number or not is_searched:
            continue
        inside = found.patch == p.number
        beside = found.patch[grown(inside, SKIRT) & ~inside]
        around = by_number[most_frequent(beside)]
        step = p.level_um - around.level_um if around.number == 0 or around.is_determined else None
        level, std = p.level_um - ground.level_um, math.hypot(p.level_std_um, ground.level_std_um)
        height = (level, std) if ground.number == 0 or ground.is_determined else (None, 0.0)
        region = Region(inside, *height, step) if p.is_determined else Region(inside)
        out.append(replace(region, skirt=_reach(found, p.number, raster)))
    return out


def off_ground(regions: list[Region], shape: tuple[int, int], border_std: float) -> np.ndarray:
    """Find the pixels [y, x] of regions (`measured_regions`) that a flat border must not hold to the ground's level.

    Those that are certainly off it (`CERTAINLY_OFF`), and those that are likely off, by steps that contradict one
    another: the hold by the border's standard deviation [um] would win.
    """
    known = [(r, abs(r.height)) for r in regions if r.height is not None]
    off = [
        r.inside for r, height in known if height > CERTAINLY_OFF * r.std or height > r.std > CERTAINLY_OFF * border_std
    ]
    return np.any([np.zeros(shape, bool), *off], axis=0)


def _reach(found: Steps, patch: int, raster: Raster) -> int:
    """Find how many pixels the longest mask band of a patch's edges reaches around it; `SKIRT` at least."""
    steps = {step.number for step in found.steps if patch == step.above}
    bands = (b for b in found.bands if b.step in steps and b.is_clear_mask)
    longest = max((b.length_um for b in bands), default=0.0)
    return max(SKIRT, math.ceil(longest / min(raster.dx, raster.dy)))


def level_anchors(labels: np.ndarray, regions: list[Region], surface: Surface) -> Anchors:
    """Anchor the regions whose heights are measured, where the surface is level in them.

    Args:
        labels: 1, 2, ... in the regions [y, x].
        regions: that were moved, in this order.
        surface: with the regions at their levels.
    """
    is_level = np.hypot(surface.slope_x, surface.slope_y) < MAX_LEVEL_SLOPE
    known = {i: (r.height, r.std) for i, r in enumerate(regions, 1) if r.height is not None}
    return Anchors.of_levels(labels, known, is_level, SKIRT)


def labelled(regions: list[Region]) -> np.ndarray:
    """Number the pixels of regions 1, 2, ... [y, x]; 0 outside of all."""
    out = np.zeros(regions[0].inside.shape, int)
    for number, region in enumerate(regions, 1):
        out[region.inside] = number
    return out
