"""Profiles across cracks: how wide a slit is and what signal it lacks, how a groove kinks and how deep it is.

Every pixel beside a line takes part with its own distance from it, so that a line which runs obliquely through the
raster is sampled far more finely than the pitch. Source: own derivations, tests/unit/test_cracks.py.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field
from scipy import special, stats
from scipy.spatial import cKDTree

from helio_jax.arrays import pitch
from helio_jax.measure.groove_depth import HeightProfile
from helio_jax.measure.line_paths import Path
from helio_jax.measure.lines import Contrast, LineSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

_SURE = 3.0
"""Deviations from which on a kink is sure, and a groove's two flanks are."""
_SEEN = 2.0
"""Deviations from which on a detector counts as dark or bright; so many are allowed in bounds."""
_BEYOND = 6.0
"""How far beyond a path its ends are looked for [pixels]."""
_AT_END = 1.0
"""A line that reaches so near to the end of where it may be goes on beyond it [pixels]."""
_CORE = 3.0
"""Distance to both sides that tells whether a line is there [pixels]."""
_EXPLAINED = 0.01
"""A step explains a line where noise alone makes its misfit worse in more than this share of all cases."""
_FEWEST = 24
"""Pixels that a profile needs."""
_WIDEST = 4.0
"""Lines are thinner than this [pixels]."""
_ASIDE = 1.5
"""A line may lie so far from where its filter answered most [pixels]: edges answer to line filters beside them."""


class CrackSettings(LineSettings):
    """How cracks are looked for and measured."""

    reach_px: float = Field(default=6.0, ge=4.0, le=50.0)
    """Distance to both sides that a line's profile is fitted in [pixels]."""
    blurs_px: tuple[float, ...] = Field(default=(0.3, 0.5, 0.7, 1.0), min_length=1)
    """Blurs of a profile across a line that may be, of the beam's spot and of the line's course [pixels]."""
    piece_px: float = Field(default=10.0, ge=5.0)
    """Length of the pieces in which a groove's depth is looked for [pixels]."""
    flank_px: int = Field(default=12, ge=4, le=100)
    """Distance to both sides in which a groove's shoulders are looked for [pixels]."""


def _across(path: Path, shape: tuple[int, ...], reach: float) -> tuple[np.ndarray, ...]:
    """Return rows and columns of the pixels beside a path, their distance from it (signed), place along it, its normal.

    Pixels beyond its ends are left out.
    """
    at, fine = path.sampled(max(int(10 * path.length), 8))
    y, x = np.mgrid[: shape[0], : shape[1]]
    away, nearest = cKDTree(fine.points).query(np.stack([x.ravel(), y.ravel()], -1), distance_upper_bound=reach + 1.0)
    use = np.isfinite(away) & (nearest > 0) & (nearest < at.size - 1)
    pixel, near = np.flatnonzero(use), nearest[use]
    normal = fine.normals[near]
    offset = np.stack([x.ravel()[pixel], y.ravel()[pixel]], -1) - fine.points[near]
    t = np.sum(offset * normal, -1)
    close = np.abs(t) <= reach
    rows, columns = np.unravel_index(pixel[close], shape)
    return rows, columns, t[close], at[near][close], normal[close]


def _line(t: np.ndarray, width: float, blur: float) -> np.ndarray:
    """Return a dark box of a width about 0, depth 1, blurred by a Gaussian."""
    root = math.sqrt(2.0) * blur
    return -0.5 * (special.erf((t + 0.5 * width) / root) - special.erf((t - 0.5 * width) / root))


def _edge(t: np.ndarray, _: float, blur: float) -> np.ndarray:
    """Return a step at 0 from -1/2 to 1/2, blurred by a Gaussian."""
    return 0.5 * special.erf(t / (math.sqrt(2.0) * blur))


_Shape = Callable[[np.ndarray, float, float], np.ndarray]


@dataclass(frozen=True)
class _Fit:
    """Where a profile lies beside its path, its width and blur [pixels]; chi-square per degree of freedom, >= 1."""

    aside: float
    width: float
    blur: float
    excess: float


@dataclass(frozen=True)
class _Beside:
    """Pixels beside a line [pixel]: contrast and variance by detector, distance t, place along; its median normal."""

    values: np.ndarray
    variance: np.ndarray
    t: np.ndarray
    along: np.ndarray
    normal: np.ndarray

    @classmethod
    def of(cls, path: Path, contrast: Contrast, reach: float) -> "_Beside":
        """Return the known pixels within reach of a path."""
        rows, columns, t, along, normal = _across(path, contrast.is_known.shape, reach)
        use = contrast.is_known[rows, columns]
        rows, columns = rows[use], columns[use]
        middle = np.median(normal, axis=0)
        return cls(contrast.values[:, rows, columns], contrast.variance[:, rows, columns], t[use], along[use], middle)

    def fit(self, shape: _Shape, *, aside: float, width: float, blur: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Fit level, slope and a shape to every detector; return its factors, their deviations, and chi-square."""
        design = np.stack([np.ones(self.t.size), self.t, shape(self.t - aside, width, blur)], -1)
        found, std, chi2 = [], [], 0.0
        for values, variance in zip(self.values, self.variance, strict=True):
            root = 1.0 / np.sqrt(variance)
            a, b = design * root[:, None], values * root
            covariance = np.linalg.pinv(a.T @ a)
            factors = covariance @ (a.T @ b)
            found.append(factors[-1])
            std.append(math.sqrt(covariance[-1, -1]))
            chi2 += float(np.sum((b - a @ factors) ** 2))
        return np.array(found), np.array(std), chi2

    @property
    def freedom(self) -> int:
        """Degrees of freedom of such a fit."""
        return self.values.size - 3 * len(self.values)


def _gain_of_edge(beside: "_Beside", factors: np.ndarray, fit: _Fit) -> np.ndarray:
    """Return how much likelier every pixel is with an edge of known change than without [pixel]."""
    profile = _edge(beside.t - fit.aside, fit.width, fit.blur)
    base = np.stack([np.ones(beside.t.size), beside.t], -1)
    profile = profile - base @ np.linalg.lstsq(base, profile, rcond=None)[0]
    change = factors[:, None] * profile
    level = np.median(beside.values, axis=1, keepdims=True)
    return np.sum((change * (beside.values - level) - 0.5 * change**2) / (beside.variance * fit.excess), axis=0)


def _gain_of_line(beside: "_Beside", is_sure: np.ndarray, fit: _Fit) -> np.ndarray:
    """Return how much likelier every pixel is with a thin line of random brightness than without [pixel].

    Walls and floor of a slit may be bright and dark in turns: only that more than noise is there is looked at. With m
    times the noise's variance more, the logarithm is (z^2 m / (1 + m) - log(1 + m)) / 2. Source: own derivation.

    Args:
        beside: pixels.
        is_sure: those that surely lie between the ends [pixel].
        fit: of the line.
    """
    t = beside.t - fit.aside
    core = np.abs(t) <= 0.5 * fit.width + fit.blur
    base = np.stack([np.ones(t.size), t, beside.along, t * beside.along], -1)
    gain = np.zeros(t.size)
    for values, variance in zip(beside.values, beside.variance, strict=True):
        flank = np.linalg.lstsq(base[~core], values[~core], rcond=None)[0]
        z = (values - base @ flank) / np.sqrt(variance)
        noise = max(float(np.mean(z[~core] ** 2)), 1.0)
        more = max(float(np.mean(z[core & is_sure] ** 2)) / noise - 1.0, 0.0)
        gain[core] += 0.5 * (z[core] ** 2 / noise * more / (1.0 + more) - math.log1p(more))
    return gain


def find_ends(along: np.ndarray, gain: np.ndarray, length: float) -> tuple[float, float, float, float]:
    """Return where a line begins along its extended path, the deviation, where it ends, the deviation [pixels].

    Gains summed from the middle outwards are the log-likelihood of an end there; returned are mean and deviation under
    a flat prior.

    Args:
        along: places of pixels along the path.
        gain: how much likelier each is with the line than without.
        length: of the path.
    """
    ends: list[float] = []
    middle = 0.5 * length
    for side in (-1.0, 1.0):
        place = side * (along - middle)
        order = np.argsort(place)
        order = order[place[order] >= 0]
        at, total = np.r_[0.0, place[order], middle], np.r_[0.0, np.cumsum(gain[order])]
        gap = np.diff(at)  # the end lies between two pixels, the first of them within
        weight = gap * np.exp(total - total.max())
        center = 0.5 * (at[1:] + at[:-1])
        mean = float(np.sum(weight * center) / np.sum(weight))
        variance = float(np.sum(weight * ((center - mean) ** 2 + gap**2 / 12.0)) / np.sum(weight))
        ends += [middle + side * mean, math.sqrt(variance + 1.0 / 12.0)]  # and pixels are points, not areas
    return ends[0], ends[1], ends[2], ends[3]


def measure_line(
    path: Path,
    contrast: Contrast,
    inside: np.ndarray,
    rec: Reconstruction,
    stack: MicrographStack,
    s: CrackSettings,
) -> dict[str, Any] | None:
    """Measure what runs along a path: as a thin line or as an edge, whichever explains the micrographs better.

    Its ends are looked for where `inside` is True [y, x].

    Returns:
        Attributes of `cracks.Crack`, or None where it is one detector's alone, or no kink that is concave.
    """
    beside = _Beside.of(path, contrast, s.reach_px)
    if beside.t.size < _FEWEST:
        return None
    middle = float(np.median(s.blurs_px))
    places = np.arange(-_ASIDE, _ASIDE + 0.1, 0.25)
    lines = [(beside.fit(_line, aside=d, width=w, blur=middle)[2], d, w) for d in places for w in (1.0, 2.0, 3.0)]
    edges = [(beside.fit(_edge, aside=d, width=0.0, blur=b)[2], d, b) for d in places for b in s.blurs_px]
    is_thin = min(lines)[0] < min(edges)[0]
    shape = _line if is_thin else _edge
    chi2, aside, size = min(lines) if is_thin else min(edges)
    fit = _Fit(aside, *((size, middle) if is_thin else (0.0, size)), max(chi2 / beside.freedom, 1.0))
    factors, std, _ = beside.fit(shape, aside=fit.aside, width=fit.width, blur=fit.blur)
    longer = path.extended(_BEYOND).within(inside)
    wide = _Beside.of(longer, contrast, s.reach_px if is_thin else _CORE)
    inner = np.abs(wide.along - 0.5 * longer.length) < 0.5 * path.length - _BEYOND / 3.0
    gain = _gain_of_line(wide, inner, fit) if is_thin else _gain_of_edge(wide, factors, fit)
    start, start_std, end, end_std = find_ends(wide.along, gain, longer.length)
    path = longer.between(start, end).moved(fit.aside)
    if path.length < s.min_length_px:
        return None
    seen: dict[str, Any] | None
    if is_thin:
        seen = _measure_thin(beside, aside, rec, stack, contrast, s)
    else:
        seen = _measure_kink(path, factors, std * math.sqrt(fit.excess), beside, rec, stack, contrast, s)
    step = pitch(rec.raster_x)
    place = {
        "points": path.points,
        "is_cut": bool(start < _AT_END or end > longer.length - _AT_END),
        "length_um": step * path.length,
        "length_std_um": step * math.hypot(start_std, end_std),
    }
    return None if seen is None else seen | place


def _measure_thin(
    beside: _Beside, aside: float, rec: Reconstruction, stack: MicrographStack, contrast: Contrast, s: CrackSettings
) -> dict[str, Any] | None:
    """Measure a thin line: one width, a darkness of its own in every detector; a slit, a step, a line, or None."""
    step, names = pitch(rec.raster_x), stack.instrument.detector_names
    widths = np.arange(0.25, _WIDEST + 0.1, 0.25)
    blurs = np.arange(min(s.blurs_px), max(s.blurs_px) + 0.05, 0.1)
    fits = [min((beside.fit(_line, aside=aside, width=w, blur=b) for b in blurs), key=lambda f: f[2]) for w in widths]
    chi2 = np.array([f[2] for f in fits])
    excess = max(float(chi2.min()) / beside.freedom, 1.0)
    dark, std = np.array([f[0] for f in fits]), np.array([f[1] for f in fits]) * math.sqrt(excess)
    possible = np.all(dark - _SEEN * std <= 1.0, axis=1)  # no darker than dark
    if not possible.any():
        return None
    best = int(np.argmin(np.where(possible, chi2, np.inf)))
    missing, missing_std = dark[best] * widths[best] * step, std[best] * widths[best] * step
    is_dark, is_bright = missing > _SEEN * missing_std, missing < -_SEEN * missing_std
    if np.sum(is_dark | is_bright) < 2:
        return None  # one detector alone: no surface does that
    within = [possible & (chi2 - chi2[best] <= k * k * excess) for k in (1.0, 2.0)]
    one, two = (widths[w] * step for w in within)
    is_resolved = two[0] > widths[possible][0] * step and two[-1] < widths[-1] * step
    seen: dict[str, Any] = {
        "width_um": float(widths[best]) * step if is_resolved else math.nan,
        "width_std_um": max(0.5 * float(one[-1] - one[0]), 0.25 * step) if is_resolved else math.nan,
        "width_range_um": (float(two[0]), float(two[-1])),
        "missing_um": dict(zip(names, missing.tolist(), strict=True)),
        "missing_std_um": dict(zip(names, missing_std.tolist(), strict=True)),
        "dark_in": tuple(n for n, d in zip(names, is_dark, strict=True) if d),
        "bright_in": tuple(n for n, b in zip(names, is_bright, strict=True) if b),
    }
    r, weight = contrast.directions @ beside.normal, missing_std**-2.0
    rise, rise_std = float(np.sum(weight * r * missing) / np.sum(weight * r * r)), float(np.sum(weight * r * r)) ** -0.5
    misfit = float(np.sum(weight * (missing - rise * r) ** 2))
    if stats.chi2.sf(misfit, len(names) - 1) > _EXPLAINED:
        return seen | {
            "kind": "step",
            "depth_um": abs(rise),
            "depth_std_um": rise_std,
            "depth_note": "a step within about a pixel, to first order in its slope, from the micrographs",
        }
    if is_dark.sum() < 2:
        return seen | {"kind": "line", "depth_note": "neither dark as a slit nor bright and dark as a step"}
    slant = abs(float(np.dot(stack.instrument.beam_shift, beside.normal)))
    spot = np.array(stack.instrument.spot_position(0.0)[:2])
    rims = [float(np.max(np.abs((a.rim(64) - spot) @ beside.normal))) for a in stack.instrument.apertures()]
    reaches = np.array(rims) / stack.instrument.sample_distance + slant
    bound = max(0.0, float(np.max((missing - _SEEN * missing_std) / reaches)))
    return seen | {
        "kind": "slit",
        "depth_at_least_um": bound,
        "depth_note": f"not determined: shadowed; at least {bound:.0f} um if of the same material",
    }


def _measure_kink(
    path: Path,
    change: np.ndarray,
    std: np.ndarray,
    beside: _Beside,
    rec: Reconstruction,
    stack: MicrographStack,
    contrast: Contrast,
    s: CrackSettings,
) -> dict[str, Any] | None:
    """Measure a groove: its kink in the micrographs, and depth and width in the heights; None without a sure kink.

    Depth and width are those of the deepest of the pieces that the line is cut into; it is a crease where none has
    two flanks that are sure.
    """
    names, step = stack.instrument.detector_names, pitch(rec.raster_x)
    surface = np.stack([-contrast.directions @ beside.normal, np.ones(len(names))], -1) / std[:, None]
    covariance = np.linalg.inv(surface.T @ surface)
    kink, kink_std = float((covariance @ surface.T @ (change / std))[0]), math.sqrt(covariance[0, 0])
    if not kink > _SURE * kink_std:
        return None
    seen: dict[str, Any] = {
        "change": dict(zip(names, change.tolist(), strict=True)),
        "change_std": dict(zip(names, std.tolist(), strict=True)),
        "kink_deg": math.degrees(math.atan(kink)),
        "kink_std_deg": math.degrees(kink_std) / (1.0 + kink * kink),
    }
    rows, columns, t, along, _ = _across(path, rec.height.shape, s.flank_px)
    n_pieces = max(1, round(path.length / s.piece_px))
    piece = np.minimum((along / path.length * n_pieces).astype(int), n_pieces - 1)
    known = (rec.has_relief & np.isfinite(rec.height))[rows, columns]
    pieces = [
        HeightProfile.of(rec, rows[use], columns[use], t[use], s.flank_px)
        for use in ((piece == i) & known for i in range(n_pieces))
    ]
    deep = [(*q.depth_and_std(rec), q) for q in pieces if q is not None]
    sure = [d for d in deep if d[0] > _SURE * d[1]]
    if not sure:
        most = f"{max(d[0] for d in deep):.1f} um" if deep else "no heights"
        return seen | {
            "kind": "crease",
            "depth_note": f"no two flanks in the heights (deepest piece: {most}): a kink, or the foot of a step",
        }
    depth, depth_std, profile = max(sure, key=lambda d: d[0])
    width, width_std = rec.spread(profile.width)
    return seen | {
        "kind": "groove",
        "depth_um": depth,
        "depth_std_um": depth_std,
        "width_um": width * step,
        "width_std_um": math.hypot(width_std, 1.0 / math.sqrt(12.0)) * step,
        "depth_note": f"where it is deepest; two flanks on {len(sure)} of {n_pieces} pieces of its length",
    }
