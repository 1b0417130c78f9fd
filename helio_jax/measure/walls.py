"""Vertical edges: straight pieces of what is marked as a jump or masked, and of the rims of floating regions.

Marked pixels whose heights fall in nearly the same direction are grown together to a region about a line, which gives
its length, direction and width. Across it the difference of height is read beside the marked pixels and has the
deviation of the posterior's samples. Where one side's level floats relative to the other's, or one side is not known,
the difference is not determined, and the edge says so. Where the fit has bridged a wall by a slope, no pixel is marked
and no edge listed: facets are for that.

Source: regions grown by direction are those of von Gioi et al., IEEE PAMI 32 (2010) 722. tests/unit/test_walls.py.
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


class WallSettings(Settings):
    """How vertical edges are put together."""

    blur_px: float = Field(default=1.5, gt=0.0, le=10.0)
    """Standard deviation by which heights are smoothed before the direction of their fall is taken [pixels]."""
    turn_deg: float = Field(default=22.5, gt=0.0, le=90.0)
    """Directions of fall that belong to one edge differ from its mean by this at most [deg]."""
    min_length_px: float = Field(default=6.0, ge=2.0)
    """Shorter edges are left out [pixels]."""
    beside_px: int = Field(default=4, ge=1, le=50)
    """Pixels beside the edge, on either side, whose heights are compared [pixels]."""


@dataclass(frozen=True)
class Wall:
    """A straight vertical edge.

    Attributes:
        number: from 1, the longest first.
        start, end: beam positions (x, y) [um].
        length_um, length_std_um: along it; the ends are known to a pixel.
        direction_deg: of the edge, from +x counter-clockwise, -90 to 90.
        falls_deg: direction in which the surface falls, -180 to 180.
        width_um: of the marked pixels across it.
        step_um, step_std_um: height above minus height below; NaN where nothing is known.
        is_determined: whether that difference may be used.
        note: why not.
        n_jump, n_masked, n_rim: marked pixels by reason; rim: of a floating region.
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

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record; what is not known is None."""
        return as_json(vars(self))


@dataclass(frozen=True)
class Walls:
    """All vertical edges; the marked pixels [y, x], and the share of them that belongs to an edge."""

    walls: tuple[Wall, ...]
    marked: np.ndarray
    share: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        return {
            "edges": [w.as_dict() for w in self.walls],
            "n_marked": int(self.marked.sum()),
            "share_in_edges": self.share,
            "n_determined": sum(w.is_determined for w in self.walls),
        }


def rim_of_floating(rec: Reconstruction) -> np.ndarray:
    """Return the pixels of floating regions beside pixels that do not float [y, x]."""
    floats = rec.reason == _FLOATING
    return floats & ndimage.binary_dilation(rec.reason == 0, _EIGHT)


def find_walls(rec: Reconstruction, inside: np.ndarray | None = None, settings: WallSettings | None = None) -> Walls:
    """Find the vertical edges of a height map.

    Args:
        rec: heights with reasons.
        inside: where [y, x]; default: everywhere.
        settings: how.
    """
    s = settings or WallSettings()
    rim = rim_of_floating(rec)
    marked = (rec.reason == _JUMP) | (rec.reason == _MASKED) | rim
    if inside is not None:
        marked &= inside
    height = np.where(np.isfinite(rec.height), rec.height, np.nanmedian(rec.height))
    smooth = ndimage.gaussian_filter(height, s.blur_px)
    upward, rightward = np.gradient(smooth, *_sides(rec)[::-1])
    fall = np.stack([-rightward, -upward], -1)
    left, walls, used = marked.copy(), [], 0
    steepest = np.argsort(-np.hypot(*np.moveaxis(fall, -1, 0)), axis=None)
    for start in steepest[marked.ravel()[steepest]]:
        seed = np.unravel_index(start, marked.shape)
        if not left[seed]:
            continue
        region, direction = _grow(seed, left, fall, math.cos(math.radians(s.turn_deg)))
        left &= ~region
        wall = _measure(rec, region, direction, rim, s)
        if wall is not None:
            walls.append(wall)
            used += int(region.sum())
    walls.sort(key=lambda w: -w.length_um)
    numbered = tuple(replace(w, number=i) for i, w in enumerate(walls, 1))
    return Walls(numbered, marked, used / max(int(marked.sum()), 1))


def _grow(seed: tuple, left: np.ndarray, fall: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels joined to a seed whose heights fall as their mean does [y, x], and that direction [2].

    The mean is that of the directions so far, taken anew after every ring of neighbours.
    """
    unit = fall / np.maximum(np.hypot(fall[..., 0], fall[..., 1]), 1e-12)[..., None]
    region = np.zeros(left.shape, bool)
    region[seed] = True
    while True:
        mean = unit[region].mean(0)
        mean /= np.hypot(*mean) or 1.0
        # over a gap of one pixel, too: what the fit has marked is ragged
        ring = ndimage.binary_dilation(region, _EIGHT, iterations=2) & left & ~region
        new = ring & (unit @ mean >= near)
        if not new.any():
            return region, mean
        region |= new


def _measure(
    rec: Reconstruction, region: np.ndarray, falls: np.ndarray, rim: np.ndarray, s: WallSettings
) -> Wall | None:
    """Measure one edge; None where it is too short, or as wide as long."""
    rows, columns = np.nonzero(region)
    if rows.size < 3:
        return None
    step, sides, middle = pitch(rec.raster_x), _sides(rec), np.array([columns.mean(), rows.mean()])
    offset = (np.stack([columns, rows], -1) - middle) * sides
    moments = offset.T @ offset / rows.size
    along = np.linalg.eigh(moments)[1][:, 1]
    across = np.array([along[1], -along[0]])
    across *= 1.0 if across @ falls >= 0 else -1.0
    if abs(across @ falls) < math.cos(math.radians(2.0 * s.turn_deg)):
        return None  # a patch, not an edge: it is not long across its fall
    u, v = offset @ along, offset @ across
    length, width = float(np.ptp(u)) + 1.0, math.sqrt(12.0 * float(np.var(v)) + 1.0)
    if length < s.min_length_px or length < 1.5 * width:
        return None
    ends = rec.beam_positions(middle + np.outer([u.min(), u.max()], along) / sides)
    value, std, is_determined, note = _difference(rec, middle, along, across, (u.min(), u.max()), (v.min(), v.max()), s)
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
    """Return the sides of a pixel along x and y [2], in those along x: in such units edges are measured."""
    return np.array([1.0, pitch(rec.raster_y) / pitch(rec.raster_x)])


def _difference(
    rec: Reconstruction,
    middle: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    extent: tuple[float, float],
    thickness: tuple[float, float],
    s: WallSettings,
) -> tuple[float, float, bool, str]:
    """Return height above minus below, its deviation, whether it is determined, and why not."""
    y, x = np.mgrid[: rec.height.shape[0], : rec.height.shape[1]]
    offset = (np.stack([x, y], -1) - middle) * _sides(rec)
    u, v = offset @ along, offset @ across
    known = np.isfinite(rec.height) & rec.has_relief
    near = (u >= extent[0]) & (u <= extent[1]) & known
    above = near & (v < thickness[0]) & (v >= thickness[0] - s.beside_px)
    below = near & (v > thickness[1]) & (v <= thickness[1] + s.beside_px)
    least = max(3.0, extent[1] - extent[0])
    if above.sum() < least or below.sum() < least:
        side = "above" if above.sum() < least else "below"
        return math.nan, math.nan, False, f"not determined: too little is known beside it, {side}"
    value, std = rec.spread(lambda h: float(h[above].mean() - h[below].mean()))
    floats = [float(np.mean(rec.reason[side] == _FLOATING)) for side in (above, below)]
    if (floats[0] > 0.5) != (floats[1] > 0.5):
        return value, std, False, "floating: not determined, nothing ties the levels of its two sides"
    if not math.isfinite(std):
        return value, std, True, "no deviation: this method gives none"
    if abs(value) < 2.0 * std:
        return value, std, False, "not determined: less than two deviations"
    return value, std, True, "both sides float together" if floats[0] > 0.5 else ""
