"""Cracks of a surface: course, length, width and depth, with errors.

Lines are detected (`lines`) and classified by their profiles (`crack_profiles`). A *slit* is thin, and dark in two or
more detectors in a way that no step explains. Its missing signal, given as a width of substrate, needs no resolution
and bounds its depth from below: a floor at depth d masks at most d times the tangent of a detector's lowest direction
across the slit, and shadows at most d times that of the beam; multiple scattering only adds signal. There is no bound
from above. Slits lack less signal than they are wide, because their walls scatter most atoms back, and may be bright in
a detector that faces the illuminated wall or looks along them. A *groove* is open: its flanks are visible, and depth
and width are measured in the heights. Listed, but not counted as cracks, are a *crease* (a concave kink without two
flanks), a *step*, and a thin *line* of neither kind: perhaps a slit with illuminated walls, a scratch or a ridge.

Lengths and places are in beam positions. Sources of the formulas: own derivations, tests/unit/test_cracks.py.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from helio_jax.arrays import as_json, line_angle_deg, pitch
from helio_jax.errors import SceneError
from helio_jax.measure.crack_profiles import measure_line
from helio_jax.measure.line_paths import Path, trace_lines
from helio_jax.measure.lines import ORDER, Found, LineSettings, contrast_of, find_lines
from helio_jax.measure.regions import check_micrographs
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

_SAME = 3.0
"""Distance below which lines of two kinds are the same [pixels]."""


@dataclass(frozen=True, kw_only=True)
class Crack:
    """One crack; NaN or empty where a quantity is not defined for its kind, or not known.

    Attributes:
        number: in order of significance, from 1.
        kind: "slit", "groove", "crease", "step" or "line".
        start, end: beam positions (x, y) [um].
        points: along it [n, 2], um.
        length_um, length_std_um: along it.
        is_cut: it reaches the border of the region, and may be longer.
        direction_deg: from end to end, from +x counter-clockwise, -90 to 90.
        width_um, width_std_um: of the dark line if its profile resolves it (slits, steps); of a groove at half depth.
        width_range_um: limits of the width at two deviations (slits, steps, lines).
        missing_um, missing_std_um: width of substrate whose signal is missing, by detector (slits, steps, lines).
        change, change_std: of the signal across the line over the substrate's, by detector (grooves, creases).
        kink_deg, kink_std_deg: upward change of the slope across the line, to first order (grooves, creases).
        dark_in, bright_in: detectors in which it is dark or bright by two deviations (the same).
        depth_um, depth_std_um: of a groove, below the lower of its shoulders; height of a step.
        depth_at_least_um: lower bound for a slit, by two deviations; 0: no bound.
        depth_note: meaning of the depth, or the reason why it is not known.
        score: largest amplitude along it over its deviation.
        false_alarms: mean number of lines at least as significant that noise alone shows in the searched area.
        along_scan_deg: angle to the scan lines; near 0, drift within a scan line looks like a crack.
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
    width_um: float = math.nan
    width_std_um: float = math.nan
    width_range_um: tuple[float, float] = (math.nan, math.nan)
    missing_um: dict[str, float] = field(default_factory=dict)
    missing_std_um: dict[str, float] = field(default_factory=dict)
    change: dict[str, float] = field(default_factory=dict)
    change_std: dict[str, float] = field(default_factory=dict)
    kink_deg: float = math.nan
    kink_std_deg: float = math.nan
    dark_in: tuple[str, ...] = ()
    bright_in: tuple[str, ...] = ()
    depth_um: float = math.nan
    depth_std_um: float = math.nan
    depth_at_least_um: float = 0.0
    depth_note: str
    score: float
    false_alarms: float
    along_scan_deg: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record; unknown numbers are None."""
        return as_json(vars(self) | {"points": np.round(self.points, 1)})


@dataclass(frozen=True)
class Cracks:
    """All cracks of some regions.

    Attributes:
        cracks: the most significant first, creases, steps and lines included.
        area_um2: searched area, without a margin at unknown pixels and the border.
        n_ridges: convex kinks detected in the same way, a measure of the roughness.
        left_out: detected lines that their profiles do not confirm.
        threshold: score that a line had to exceed, by kind.
        allowed: allowed false alarms.
    """

    cracks: tuple[Crack, ...]
    area_um2: float
    n_ridges: int
    left_out: int
    threshold: dict[str, float]
    allowed: float

    @property
    def counted(self) -> tuple[Crack, ...]:
        """Slits and grooves."""
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
            "area_mm2": self.area_um2 / 1e6,
            "length_mm": density * self.area_um2 / 1e3,
            "length_per_area_per_mm": density * 1e3,
            "length_per_area_std_per_mm": std * 1e3,
            "n_ridges": self.n_ridges,
            "left_out": self.left_out,
            "threshold": self.threshold,
            "false_alarms_allowed": self.allowed,
        }


def find_cracks(
    rec: Reconstruction, stack: MicrographStack, inside: np.ndarray, settings: LineSettings = LineSettings()
) -> Cracks:
    """Find and measure the cracks of a surface.

    Args:
        rec: heights; regions whose level floats are included, because only differences across a crack are used.
        stack: the calibrated micrographs of these heights.
        inside: True in the searched region [y, x].
        settings: false alarms, shortest line.

    Raises:
        SceneError: another raster, pixels that are not square, or a stack that is not calibrated.
        GuardError: no pixel can be searched.
    """
    check_micrographs(stack, rec.height.shape)
    steps = pitch(rec.raster_x), pitch(rec.raster_y)
    if not math.isclose(*steps, rel_tol=1e-3):
        raise SceneError(f"the search for cracks needs square pixels, the raster has {steps[0]:g} x {steps[1]:g} um")
    contrast = contrast_of(stack)
    cracks: list[Crack] = []
    threshold, left_out, n = {}, 0, 0
    for kind in ORDER:
        found = find_lines(contrast, inside, kind, settings)
        threshold[kind], n = found.threshold, found.n_pixels
        for path in trace_lines(found, settings):
            measured = measure_line(path, contrast, inside, rec, settings.min_length_px)
            left_out += measured is None
            if measured is not None:
                cracks.append(_crack(path, found, rec, stack, measured))
    n_ridges = len(trace_lines(find_lines(contrast, inside, "groove", settings, sign=-1.0), settings))
    cracks = _without_duplicates(sorted(cracks, key=lambda c: -c.score), _SAME * steps[0])
    numbered = tuple(replace(c, number=i) for i, c in enumerate(cracks, 1))
    return Cracks(numbered, n * steps[0] * steps[1], n_ridges, left_out, threshold, settings.false_alarms)


def _without_duplicates(cracks: list[Crack], near: float) -> list[Crack]:
    """Discard lines of which more than half lies beside a stronger one."""
    kept: list[Crack] = []
    for crack in cracks:
        trees = [cKDTree(other.points) for other in kept]
        if all(np.mean(tree.query(crack.points)[0] <= near) <= 0.5 for tree in trees):
            kept.append(crack)
    return kept


def _crack(path: Path, found: Found, rec: Reconstruction, stack: MicrographStack, measured: dict[str, Any]) -> Crack:
    """Make a crack from the result of `measure_line` (points in pixels)."""
    points = rec.beam_positions(measured.pop("points"))
    direction = line_angle_deg(points[-1] - points[0])
    return Crack(
        number=0,
        start=(float(points[0, 0]), float(points[0, 1])),
        end=(float(points[-1, 0]), float(points[-1, 1])),
        points=points,
        direction_deg=direction,
        score=path.score,
        false_alarms=found.false_alarms(path.score),
        along_scan_deg=abs(direction) if stack.fast_axis == "x" else 90.0 - abs(direction),
        **measured,
    )
