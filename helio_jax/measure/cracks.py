"""Cracks: where they run, how long, wide and deep they are, with errors, and what is not known of them.

Lines are found (`lines`) and told apart by their profiles (`crack_profiles`). A *slit* is thin, and dark in two
detectors or more in a way that no step explains. The width of flat surface whose signal is missing needs no resolution,
and bounds its depth from below: a floor at depth d hides at most d times the tangent of a detector's lowest direction
across the slit, and the beam's slant as much again times its own; what scatters more often only adds. From above
nothing bounds the depth. Slits lack less signal than they are wide, for their walls give most atoms back, and may even
be bright in a detector that looks at the lit wall, or along them. A *groove* is open: its flanks are seen, and depth
and width are measured in the heights. Listed, but not counted as cracks, are a *crease*, a concave kink without two
flanks; a *step*; and a thin *line* that is none of these: perhaps a slit with lit walls, a scratch or a ridge.

Lengths and places are in beam positions. Sources of the formulas: own derivations, tests/unit/test_cracks.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from helio_jax.arrays import as_json, line_angle_deg, pitch
from helio_jax.errors import SceneError
from helio_jax.measure.crack_profiles import CrackSettings, measure_line
from helio_jax.measure.line_paths import Path, trace_lines
from helio_jax.measure.lines import ORDER, Found, contrast_of, find_lines
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

_SAME = 3.0
"""Lines of two kinds so near to one another are one [pixels]."""
_UM2_PER_MM2 = 1e6


@dataclass(frozen=True)
class Crack:
    """One crack.

    Attributes:
        number: in order of significance, from 1.
        kind: "slit", "groove", "crease", "step" or "line".
        start, end: its ends, beam positions (x, y) [um].
        points: along it [n, 2], um.
        length_um, length_std_um: along it.
        is_cut: it reaches the border of the region, and so may be longer.
        direction_deg: from end to end, from +x counter-clockwise, -90 to 90.
        width_um, width_std_um: of the dark line if its profile resolves it (slits, steps); of a groove at half its
            depth; else NaN.
        width_range_um: what the width of the line is at least and at most, by two deviations (slits, steps).
        missing_um, missing_std_um: width of flat surface whose signal is missing, by detector (slits, steps).
        change, change_std: of the signal across the line in shares of the flat's, by detector (grooves, creases).
        kink_deg, kink_std_deg: by how much the surface bends upward across the line, to first order (the same).
        dark_in, bright_in: detectors in which it is so by three deviations (slits, steps).
        depth_um, depth_std_um: of a groove, below the lower one of its shoulders; height of a step; else NaN.
        depth_at_least_um: of a slit, with three deviations allowed; 0: no bound.
        depth_note: what the depth is, or why it is not known.
        score: largest amplitude along it over its deviation.
        false_alarms: lines at least as significant that noise alone shows in the searched area.
        along_scan_deg: angle to the lines of the scan; near 0, drift within a scan line looks like a crack.
    """

    number: int
    kind: Literal["slit", "groove", "crease", "step", "line"]
    start: tuple[float, float]
    end: tuple[float, float]
    points: np.ndarray
    length_um: float
    length_std_um: float
    is_cut: bool
    direction_deg: float
    width_um: float
    width_std_um: float
    width_range_um: tuple[float, float]
    missing_um: dict[str, float]
    missing_std_um: dict[str, float]
    change: dict[str, float]
    change_std: dict[str, float]
    kink_deg: float
    kink_std_deg: float
    dark_in: tuple[str, ...]
    bright_in: tuple[str, ...]
    depth_um: float
    depth_std_um: float
    depth_at_least_um: float
    depth_note: str
    score: float
    false_alarms: float
    along_scan_deg: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record; what is not known is None."""
        return as_json(vars(self) | {"points": np.round(self.points, 1)})


@dataclass(frozen=True)
class Cracks:
    """All cracks of some regions.

    Attributes:
        cracks: the most significant first; creases among them.
        area_um2: that was searched: five pixels beside unknown ones and the border are not.
        n_ridges: convex kinks found in the same way: how rough the surface is.
        left_out: lines that their profiles do not bear out, and bright ones.
        threshold: score that a line had to exceed, by kind.
        allowed: false alarms that noise alone was allowed.
    """

    cracks: tuple[Crack, ...]
    area_um2: float
    n_ridges: int
    left_out: int
    threshold: dict[str, float]
    allowed: float

    @property
    def counted(self) -> tuple[Crack, ...]:
        """Those that are cracks: slits and grooves."""
        return tuple(c for c in self.cracks if c.kind in ("slit", "groove"))

    @property
    def density(self) -> tuple[float, float]:
        """Length of all cracks per area, and its standard deviation [um per um2]."""
        total = sum(c.length_um for c in self.counted)
        return total / self.area_um2, math.sqrt(sum(c.length_std_um**2 for c in self.counted)) / self.area_um2

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        density, std = self.density
        return {
            "lines": [c.as_dict() for c in self.cracks],
            "n_cracks": len(self.counted),
            "area_mm2": self.area_um2 / _UM2_PER_MM2,
            "length_mm": density * self.area_um2 / 1e3,
            "length_per_area_per_mm": density * 1e3,
            "length_per_area_std_per_mm": std * 1e3,
            "n_ridges": self.n_ridges,
            "left_out": self.left_out,
            "threshold": self.threshold,
            "false_alarms_allowed": self.allowed,
        }


def find_cracks(
    rec: Reconstruction,
    stack: MicrographStack,
    regions: Sequence[np.ndarray],
    settings: CrackSettings | None = None,
) -> Cracks:
    """Find and measure the cracks of a surface.

    Args:
        rec: heights; where a region's level floats they count, for only differences across a crack are used.
        stack: the calibrated micrographs that they were made of.
        regions: where to look: True inside [y, x].
        settings: how.

    Raises:
        SceneError: another raster, or a stack that is not calibrated.
        GuardError: no pixel can be searched.
    """
    s, inside = settings or CrackSettings(), np.any(regions, axis=0)
    if stack.shape[1:] != rec.height.shape:
        raise SceneError(
            f"{stack.name} has {stack.shape[2]} x {stack.shape[1]} pixels, the height map {rec.height.shape[1]} x "
            f"{rec.height.shape[0]}: give the micrographs that it was made of"
        )
    steps = pitch(rec.raster_x), pitch(rec.raster_y)
    if not math.isclose(*steps, rel_tol=1e-3):
        raise SceneError(f"cracks are looked for on square pixels, the raster has {steps[0]:g} x {steps[1]:g} um")
    contrast = contrast_of(stack)
    cracks: list[Crack] = []
    threshold, left_out, n = {}, 0, 0
    for kind in ORDER:
        found = find_lines(contrast, inside, kind, s)
        threshold[kind], n = found.threshold, found.n_pixels
        for path in trace_lines(found, s):
            seen = measure_line(path, contrast, inside, rec, stack, s)
            left_out += seen is None
            if seen is not None:
                cracks.append(_crack(path, found, rec, stack, seen))
    n_ridges = len(trace_lines(find_lines(contrast, inside, "groove", s, sign=-1.0), s))
    cracks = _without_doubles(sorted(cracks, key=lambda c: -c.score), _SAME * steps[0])
    numbered = tuple(replace(c, number=i) for i, c in enumerate(cracks, 1))
    return Cracks(numbered, n * steps[0] * steps[1], n_ridges, left_out, threshold, s.false_alarms)


def _without_doubles(cracks: list[Crack], near: float) -> list[Crack]:
    """Leave out lines of which more than half lies beside a stronger one."""
    kept: list[Crack] = []
    for crack in cracks:
        trees = [cKDTree(other.points) for other in kept]
        if all(np.mean(tree.query(crack.points)[0] <= near) <= 0.5 for tree in trees):
            kept.append(crack)
    return kept


def _crack(path: Path, found: Found, rec: Reconstruction, stack: MicrographStack, seen: dict[str, Any]) -> Crack:
    """Return a crack from its path [pixels] and what was measured across it."""
    points = rec.beam_positions(seen.pop("points"))
    direction = line_angle_deg(points[-1] - points[0])
    unknown: dict[str, Any] = {
        "width_um": math.nan,
        "width_std_um": math.nan,
        "width_range_um": (math.nan, math.nan),
        "missing_um": {},
        "missing_std_um": {},
        "change": {},
        "change_std": {},
        "kink_deg": math.nan,
        "kink_std_deg": math.nan,
        "dark_in": (),
        "bright_in": (),
        "depth_um": math.nan,
        "depth_std_um": math.nan,
        "depth_at_least_um": 0.0,
    }
    score = path.score
    return Crack(
        number=0,
        start=(float(points[0, 0]), float(points[0, 1])),
        end=(float(points[-1, 0]), float(points[-1, 1])),
        points=points,
        direction_deg=direction,
        score=score,
        false_alarms=found.false_alarms(score),
        along_scan_deg=abs(direction) if stack.fast_axis == "x" else 90.0 - abs(direction),
        **(unknown | seen),
    )
