"""Height profiles along a straight line in the sample frame. Heights in, columns out."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.arguments import checked
from helio_jax.heightmap import HeightMap
from helio_jax.measure.sample_surface import FLAGS, check_line, sample_surface
from helio_jax.reconstruction import Reconstruction

COLUMNS = ("distance_um", "x_um", "y_um", "height_um", "height_std_um", "flag")
"""Columns of a profile as a table."""


@dataclass(frozen=True)
class Profile:
    """Heights along a straight line, at equal distances.

    Attributes:
        distance: from the start [point], um.
        x, y: positions in the sample frame [point], um.
        height: above the substrate [point], um; NaN where not valid.
        height_std: standard deviation of each height [point], um; None: unknown.
        height_samples: joint posterior deviations of the heights [sample, point], um; None: unknown.
        flag: index into `sample_surface.FLAGS` [point]: 0 valid, else why not.
        how: one sentence on the frame.
    """

    distance: np.ndarray
    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    height_std: np.ndarray | None
    height_samples: np.ndarray | None
    flag: np.ndarray
    how: str

    def as_dict(self) -> dict[str, Any]:
        """Return the columns by name; flags in words."""
        std = np.full(self.height.shape, np.nan) if self.height_std is None else self.height_std
        columns = (self.distance, self.x, self.y, self.height, std, np.array(FLAGS)[self.flag])
        return dict(zip(COLUMNS, columns, strict=True))

    def lines(self) -> list[str]:
        """Format the columns for a terminal, with a header."""
        heads = ("distance (um)", "x (um)", "y (um)", "height (um)", "s.d. (um)", "flag")
        out = [f"profile: {self.height.size} points, {np.isfinite(self.height).sum()} valid; {self.how}"]
        out.append("".join(f"{head:>14}" for head in heads[:-1]) + f"  {heads[-1]}")
        for *numbers, flag in zip(*self.as_dict().values(), strict=True):
            out.append("".join(f"{v:>14.3f}" if math.isfinite(v) else f"{'-':>14}" for v in numbers) + f"  {flag}")
        return out


def profile_table(columns: Mapping[str, Sequence[Any]]) -> str:
    """Format the columns of `Profile.as_dict` as CSV with a header; unknown (NaN or None): empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for *numbers, flag in zip(*(columns[name] for name in COLUMNS), strict=True):
        writer.writerow([*("" if v is None or math.isnan(v) else f"{v:.6g}" for v in numbers), flag])
    return text.getvalue()


@checked
def measure_profile(
    heights: Reconstruction | HeightMap,
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    grid_um: float | None = None,
) -> Profile:
    """Read heights between two points of the sample frame, bilinearly, a pitch apart.

    Where posterior samples are known, standard deviations are those of the interpolated heights; else the stated ones
    are interpolated, which is their largest possible value.

    Example:
        >>> profile = hx.measure_profile(rec, (-900.0, 0.0), (900.0, 0.0))  # doctest: +SKIP
        >>> profile.x, profile.height, profile.height_std  # doctest: +SKIP

    Args:
        heights: a reconstruction, or a height map on a regular grid.
        start, end: (x, y) in the sample frame [um].
        grid_um: pitch of the grid of the sample frame, at oblique incidence [um]; default: the raster's smaller pitch.

    Raises:
        SceneError: a point outside the field, or equal points.
        GuardError: no height is valid.
    """
    surface = sample_surface(heights, grid_um=grid_um)
    length = check_line(surface, start, end)
    n = max(math.ceil(length / min(surface.steps) - 1e-9) + 1, 2)
    share = np.linspace(0.0, 1.0, n)
    x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
    height = surface.read(surface.height, x, y)
    is_known = np.isfinite(height)
    samples, std = None, None
    if surface.height_samples is not None:
        samples = np.array([np.where(is_known, surface.read(d, x, y), np.nan) for d in surface.height_samples])
        std = np.sqrt(np.mean(samples**2, axis=0))
    elif surface.height_std is not None:
        std = np.where(is_known, surface.read(surface.height_std, x, y), np.nan)
    worst = _worst_flag(surface.flag, surface, x, y)
    return Profile(share * length, x, y, height, std, samples, np.where(is_known, 0, worst), surface.how)


def _worst_flag(flag: np.ndarray, surface: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the flag of the nearest point that has one, of the four around each position [point]."""
    out = surface.read(flag, x, y, order=0)
    dy, dx = surface.steps
    for sy in (-0.5, 0.5):
        for sx in (-0.5, 0.5):
            out = np.where(out == 0, surface.read(flag, x + sx * dx, y + sy * dy, order=0), out)
    return out
