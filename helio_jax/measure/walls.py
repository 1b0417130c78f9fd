"""Vertical edges: straight pieces of the pixels flagged as jump or masked, and of the rims of floating regions.

Flagged pixels whose heights fall in nearly the same direction are grown to a region, which gives length, direction and
width of the edge. The height difference across it is read beside the flagged pixels, with the deviation of the
posterior's samples. It is not determined where the level of one side floats relative to the other's, or where one side
is not known. A wall that the fit has bridged by a slope is not flagged and not listed: `facets` measures slopes.

Source: region growing by direction after von Gioi et al., IEEE PAMI 32 (2010) 722. tests/unit/test_walls.py.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field
from scipy import ndimage

from helio_jax.arrays import as_json, line_angle_deg, pitch
from helio_jax.reconstruction import REASONS, Reconstruction
from helio_jax.settings import Settings

_MASKED, _JUMP, _FLOATING = (REASONS.index(name) for name in ("masked in too many detectors", "depth jump", "floating"))
_EIGHT = np.ones((3, 3), bool)
_BLUR = 1.5
"""Standard deviation by which heights are smoothed for the direction of their fall [pixels]."""
_SPREAD_DEG = 22.5
"""Largest angle between the direction of fall of a pixel and the mean of its edge [deg]."""
_BESIDE = 4
"""Pixels beside the edge, on either side, whose heights are compared."""


class WallSettings(Settings):
    """Search for vertical edges."""

    min_length_px: float = Field(default=6.0, ge=2.0)
    """Shorter edges are discarded [pixels]."""


@dataclass(frozen=True)
class Wall:
    """A straight vertical edge.

    Attributes:
        number: from 1, the longest first.
        start, end: beam positions (x, y) [um].
        length_um, length_std_um: along it; each end is known to a pixel.
        direction_deg: of the edge, from +x counter-clockwise, -90 to 90.
        falls_deg: direction in which the surface falls, -180 to 180.
        width_um: of the flagged pixels across it.
        step_um, step_std_um: height above minus height below; NaN where not known.
        is_determined: whether the step is determined.
        note: the reason if it is not.
        n_jump, n_masked, n_rim: flagged pixels by reason; rim: of a floating region.
    """

    number: int
    start: tuple[float, float]
    end: tuple[float, float]
    length_um: float
    length_std_um: float
    direction_deg: float
    falls_deg: float
    width_um: float
    step_um: float
    step_std_um: float
    is_determined: bool
    note: str
    n_jump: int
    n_masked: int
    n_rim: int


@dataclass(frozen=True)
class Walls:
    """All vertical edges; the flagged pixels [y, x], and the fraction of them that belongs to an edge."""

    walls: tuple[Wall, ...]
    marked: np.ndarray
    share: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        return {
            "edges": [as_json(vars(w)) for w in self.walls],
            "n_marked": int(self.marked.sum()),
            "share_in_edges": self.share,
            "n_determined": sum(w.is_determined for w in self.walls),
        }


def find_walls(rec: Reconstruction, inside: np.ndarray | None = None, settings: WallSettings = WallSettings()) -> Walls:
    """Find the vertical edges of a height map.

    Args:
        rec: heights with reasons.
        inside: True in the searched region [y, x]; default: everywhere.
        settings: shortest edge.
    """
    rim = (rec.reason == _FLOATING) & ndimage.binary_dilation(rec.reason == 0, _EIGHT)
    marked = (rec.reason == _JUMP) | (rec.reason == _MASKED) | rim
    if inside is not None:
        marked &= inside
    height = np.where(np.isfinite(rec.height), rec.height, np.nanmedian(rec.height))
    upward, rightward = np.gradient(ndimage.gaussian_filter(height, _BLUR), *_sides(rec)[::-1])
    fall = np.stack([-rightward, -upward], -1)
    is_free, walls, used = marked.copy(), [], 0
    steepest = np.argsort(-np.hypot(*np.moveaxis(fall, -1, 0)), axis=None)
    for start in steepest[marked.ravel()[steepest]]:
        seed = np.unravel_index(start, marked.shape)
        if not is_free[seed]:
            continue
        region, direction = _grow(seed, is_free, fall)
        is_free &= ~region
        wall = _measure(rec, region, direction, rim, settings.min_length_px)
        if wall is not None:
            walls.append(wall)
            used += int(region.sum())
    walls.sort(key=lambda w: -w.length_um)
    numbered = tuple(replace(w, number=i) for i, w in enumerate(walls, 1))
    return Walls(numbered, marked, used / max(int(marked.sum()), 1))


def _grow(seed: tuple, is_free: np.ndarray, fall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grow a region of pixels whose heights fall in its mean direction [y, x]; return that direction [2], too.

    The mean is updated after every ring of neighbours.
    """
    unit = fall / np.maximum(np.hypot(fall[..., 0], fall[..., 1]), 1e-12)[..., None]
    region = np.zeros(is_free.shape, bool)
    region[seed] = True
    while True:
        mean = unit[region].mean(0)
        mean /= np.hypot(*mean) or 1.0
        # two iterations bridge gaps of one pixel, because flagged pixels are ragged
        ring = ndimage.binary_dilation(region, _EIGHT, iterations=2) & is_free & ~region
        new = ring & (unit @ mean >= math.cos(math.radians(_SPREAD_DEG)))
        if not new.any():
            return region, mean
        region |= new


def _measure(
    rec: Reconstruction, region: np.ndarray, falls: np.ndarray, rim: np.ndarray, min_length: float
) -> Wall | None:
    """Measure one edge; None where it is too short, or nearly as wide as long."""
    rows, columns = np.nonzero(region)
    if rows.size < 3:
        return None
    step, sides, middle = pitch(rec.raster_x), _sides(rec), np.array([columns.mean(), rows.mean()])
    offset = (np.stack([columns, rows], -1) - middle) * sides
    along = np.linalg.eigh(offset.T @ offset / rows.size)[1][:, 1]
    across = np.array([along[1], -along[0]])
    across *= 1.0 if across @ falls >= 0 else -1.0
    if abs(across @ falls) < math.cos(math.radians(2.0 * _SPREAD_DEG)):
        return None  # a patch, not an edge: it does not fall across its long side
    u, v = offset @ along, offset @ across
    length, width = float(np.ptp(u)) + 1.0, math.sqrt(12.0 * float(np.var(v)) + 1.0)
    if length < min_length or length < 1.5 * width:
        return None
    ends = rec.beam_positions(middle + np.outer([u.min(), u.max()], along) / sides)
    y, x = np.mgrid[: rec.height.shape[0], : rec.height.shape[1]]
    place = (np.stack([x, y], -1) - middle) * sides
    value, std, is_determined, note = _difference(rec, place @ along, place @ across, u, v)
    reason = rec.reason[region]
    return Wall(
        number=0,
        start=(float(ends[0, 0]), float(ends[0, 1])),
        end=(float(ends[1, 0]), float(ends[1, 1])),
        length_um=length * step,
        length_std_um=step * math.sqrt(2.0),
        direction_deg=line_angle_deg(along),
        falls_deg=math.degrees(math.atan2(across[1], across[0])),
        width_um=width * step,
        step_um=value,
        step_std_um=std,
        is_determined=is_determined,
        note=note,
        n_jump=int(np.sum(reason == _JUMP)),
        n_masked=int(np.sum(reason == _MASKED)),
        n_rim=int(np.sum(rim[region])),
    )


def _sides(rec: Reconstruction) -> np.ndarray:
    """Return the sides of a pixel along x and y [2] over that along x, the unit of lengths here."""
    return np.array([1.0, pitch(rec.raster_y) / pitch(rec.raster_x)])


def _difference(
    rec: Reconstruction, along: np.ndarray, across: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[float, float, bool, str]:
    """Compute the height above minus below an edge, its deviation, whether it is determined, and if not, why.

    Args:
        rec: heights.
        along, across: coordinates of all pixels along the edge and across, downhill [y, x].
        u, v: the same of the edge's own pixels [pixel].
    """
    near = (along >= u.min()) & (along <= u.max()) & np.isfinite(rec.height) & rec.has_relief
    above = near & (across < v.min()) & (across >= v.min() - _BESIDE)
    below = near & (across > v.max()) & (across <= v.max() + _BESIDE)
    least = max(3.0, float(np.ptp(u)))
    if above.sum() < least or below.sum() < least:
        side = "above" if above.sum() < least else "below"
        return math.nan, math.nan, False, f"not determined: too few heights are known beside it, {side}"
    value, std = rec.spread(lambda h: float(h[above].mean() - h[below].mean()))
    floats = [float(np.mean(rec.reason[side] == _FLOATING)) for side in (above, below)]
    if (floats[0] > 0.5) != (floats[1] > 0.5):
        return value, std, False, "floating: not determined, the levels of its two sides are independent"
    if not math.isfinite(std):
        return value, std, True, "no deviation: this method gives none"
    if abs(value) < 2.0 * std:
        return value, std, False, "not determined: less than two deviations"
    return value, std, True, "both sides float together" if floats[0] > 0.5 else ""
