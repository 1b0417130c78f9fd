"""Profiles across a line: width and missing signal of a slit, kink of a groove, depth and width in the heights.

Every pixel beside a line enters with its own distance from the line, so that a line oblique to the raster is sampled
far more finely than the pitch. Source: own derivations, tests/unit/test_cracks.py.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special, stats
from scipy.spatial import cKDTree

from helio_jax.arrays import pitch
from helio_jax.measure.groove_depth import FLANK, HeightProfile
from helio_jax.measure.line_paths import Path
from helio_jax.measure.lines import Contrast
from helio_jax.reconstruction import Reconstruction

_SIGNIFICANT = 3.0
"""Deviations by which a kink, and the flanks of a groove, must differ from zero."""
_SEEN = 2.0
"""Deviations by which a detector is dark or bright; also the allowance in bounds."""
_BEYOND = 6.0
"""Length beyond a path in which its ends are searched [pixels]."""
_AT_END = 1.0
"""Distance to the end of the searched length below which a line counts as cut [pixels]."""
_REACH = 6.0
"""Distance to both sides in which a profile is fitted [pixels]."""
_CORE = 3.0
"""Distance to both sides in which the ends of an edge are searched [pixels]."""
_BLURS = (0.3, 0.5, 0.7, 1.0)
"""Standard deviations tried for the blur of a profile, by the beam's spot and the line's course [pixels]."""
_EXPLAINED = 0.01
"""A step explains a line if noise alone gives a larger misfit with at least this probability."""
_FEWEST = 24
"""Fewest pixels of a profile."""
_WIDEST = 4.0
"""Largest width of a thin line [pixels]."""
_ASIDE = 1.5
"""Largest offset of a line from the maximum of its filter: line filters respond beside edges, too [pixels]."""
_PIECE = 10.0
"""Length of the pieces in which a groove's depth is measured [pixels]."""


def _pixels_beside(path: Path, shape: tuple[int, ...], reach: float) -> tuple[np.ndarray, ...]:
    """Find the pixels beside a path but not beyond its ends.

    Returns:
        Rows, columns, signed distance from the path, place along it, and its normal [pixel, 2].
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
    """Compute a dark box about 0 of depth 1, blurred by a Gaussian."""
    root = math.sqrt(2.0) * blur
    return -0.5 * (special.erf((t + 0.5 * width) / root) - special.erf((t - 0.5 * width) / root))


def _edge(t: np.ndarray, _: float, blur: float) -> np.ndarray:
    """Compute a step at 0 from -1/2 to 1/2, blurred by a Gaussian."""
    return 0.5 * special.erf(t / (math.sqrt(2.0) * blur))


_Shape = Callable[[np.ndarray, float, float], np.ndarray]


@dataclass(frozen=True)
class _Fit:
    """Offset of a profile from its path, width and blur [pixels]; chi-square per degree of freedom, >= 1."""

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
        """Collect the known pixels within reach of a path."""
        rows, columns, t, along, normal = _pixels_beside(path, contrast.is_known.shape, reach)
        use = contrast.is_known[rows, columns]
        rows, columns = rows[use], columns[use]
        middle = np.median(normal, axis=0)
        return cls(contrast.values[:, rows, columns], contrast.variance[:, rows, columns], t[use], along[use], middle)

    def fit(self, shape: _Shape, *, aside: float, width: float, blur: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Fit level, slope and a shape to every detector; return the shape's factors, their deviations, chi-square."""
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


def _gain_of_edge(beside: _Beside, factors: np.ndarray, fit: _Fit) -> np.ndarray:
    """Compute the log-likelihood of an edge of known change over none, by pixel."""
    profile = _edge(beside.t - fit.aside, fit.width, fit.blur)
    base = np.stack([np.ones(beside.t.size), beside.t], -1)
    profile = profile - base @ np.linalg.lstsq(base, profile, rcond=None)[0]
    change = factors[:, None] * profile
    level = np.median(beside.values, axis=1, keepdims=True)
    return np.sum((change * (beside.values - level) - 0.5 * change**2) / (beside.variance * fit.excess), axis=0)


def _gain_of_line(beside: _Beside, is_inner: np.ndarray, fit: _Fit) -> np.ndarray:
    """Compute the log-likelihood of a thin line of random brightness over none, by pixel.

    Walls and floor of a slit may be bright and dark alternately, so only variance beyond the noise is tested. With m
    times the noise's variance in addition, the logarithm is (z^2 m / (1 + m) - log(1 + m)) / 2. Source: own derivation.

    Args:
        beside: pixels.
        is_inner: those well between the ends [pixel].
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
        more = max(float(np.mean(z[core & is_inner] ** 2)) / noise - 1.0, 0.0)
        gain[core] += 0.5 * (z[core] ** 2 / noise * more / (1.0 + more) - math.log1p(more))
    return gain


def find_ends(along: np.ndarray, gain: np.ndarray, length: float) -> tuple[float, float, float, float]:
    """Locate the ends of a line along its extended path: start, deviation, end, deviation [pixels].

    The log-likelihood of an end is the sum of the gains from the middle up to it; returned are mean and deviation under
    a flat prior.

    Args:
        along: places of pixels along the path.
        gain: log-likelihood of the line over none, by pixel.
        length: of the path.
    """
    ends: list[float] = []
    middle = 0.5 * length
    for side in (-1.0, 1.0):
        place = side * (along - middle)
        order = np.argsort(place)
        order = order[place[order] >= 0]
        at, total = np.r_[0.0, place[order], middle], np.r_[0.0, np.cumsum(gain[order])]
        gap = np.diff(at)  # the end lies between two pixels, the first of them on the line
        weight = gap * np.exp(total - total.max())
        center = 0.5 * (at[1:] + at[:-1])
        mean = float(np.sum(weight * center) / np.sum(weight))
        variance = float(np.sum(weight * ((center - mean) ** 2 + gap**2 / 12.0)) / np.sum(weight))
        ends += [middle + side * mean, math.sqrt(variance + 1.0 / 12.0)]  # 1/12: pixels are treated as points
    return ends[0], ends[1], ends[2], ends[3]


def measure_line(
    path: Path, contrast: Contrast, inside: np.ndarray, rec: Reconstruction, min_length: float
) -> dict[str, Any] | None:
    """Measure a path as a thin line or as an edge, whichever fits the micrographs better.

    Args:
        path: of the line.
        contrast: of the micrographs.
        inside: True where its ends may lie [y, x].
        rec: heights.
        min_length: shortest line [pixels].

    Returns:
        Attributes of `cracks.Crack`; None for a line in one detector only, a kink that is not concave, or a short line.
    """
    beside = _Beside.of(path, contrast, _REACH)
    if beside.t.size < _FEWEST:
        return None
    blur = float(np.median(_BLURS))
    places = np.arange(-_ASIDE, _ASIDE + 0.1, 0.25)
    lines = [(beside.fit(_line, aside=d, width=w, blur=blur)[2], d, w) for d in places for w in (1.0, 2.0, 3.0)]
    edges = [(beside.fit(_edge, aside=d, width=0.0, blur=b)[2], d, b) for d in places for b in _BLURS]
    is_thin = min(lines)[0] < min(edges)[0]
    chi2, aside, size = min(lines) if is_thin else min(edges)
    fit = _Fit(aside, *((size, blur) if is_thin else (0.0, size)), max(chi2 / beside.freedom, 1.0))
    longer = path.extended(_BEYOND).within(inside)
    wide = _Beside.of(longer, contrast, _REACH if is_thin else _CORE)
    factors, std, _ = beside.fit(_line if is_thin else _edge, aside=fit.aside, width=fit.width, blur=fit.blur)
    if is_thin:
        inner = np.abs(wide.along - 0.5 * longer.length) < 0.5 * path.length - _BEYOND / 3.0
        gain = _gain_of_line(wide, inner, fit)
    else:
        gain = _gain_of_edge(wide, factors, fit)
    start, start_std, end, end_std = find_ends(wide.along, gain, longer.length)
    path = longer.between(start, end).moved(fit.aside)
    if path.length < min_length:
        return None
    if is_thin:
        found = _measure_thin(beside, aside, pitch(rec.raster_x), contrast)
    else:
        found = _measure_kink(path, factors, std * math.sqrt(fit.excess), beside.normal, rec, contrast)
    if found is None:
        return None
    step = pitch(rec.raster_x)
    return found | {
        "points": path.points,
        "is_cut": bool(start < _AT_END or end > longer.length - _AT_END),
        "length_um": step * path.length,
        "length_std_um": step * math.hypot(start_std, end_std),
    }


def _by_name(contrast: Contrast, values: np.ndarray) -> dict[str, float]:
    return dict(zip(contrast.instrument.detector_names, values.tolist(), strict=True))


def _measure_thin(beside: _Beside, aside: float, step: float, contrast: Contrast) -> dict[str, Any] | None:
    """Measure a thin line with one width and a contrast for each detector, and classify it as slit, step or line."""
    names = contrast.instrument.detector_names
    widths = np.arange(0.25, _WIDEST + 0.1, 0.25)
    blurs = np.arange(min(_BLURS), max(_BLURS) + 0.05, 0.1)
    fits = [min((beside.fit(_line, aside=aside, width=w, blur=b) for b in blurs), key=lambda f: f[2]) for w in widths]
    chi2 = np.array([f[2] for f in fits])
    excess = max(float(chi2.min()) / beside.freedom, 1.0)
    dark, std = np.array([f[0] for f in fits]), np.array([f[1] for f in fits]) * math.sqrt(excess)
    possible = np.all(dark - _SEEN * std <= 1.0, axis=1)  # no more signal can be missing than there is
    if not possible.any():
        return None
    best = int(np.argmin(np.where(possible, chi2, np.inf)))
    missing, missing_std = dark[best] * widths[best] * step, std[best] * widths[best] * step
    is_dark, is_bright = missing > _SEEN * missing_std, missing < -_SEEN * missing_std
    if np.sum(is_dark | is_bright) < 2:
        return None  # a line in one detector only is not on the surface
    one, two = (widths[possible & (chi2 - chi2[best] <= k * k * excess)] * step for k in (1.0, 2.0))
    is_resolved = two[0] > widths[possible][0] * step and two[-1] < widths[-1] * step
    found: dict[str, Any] = {
        "width_um": float(widths[best]) * step if is_resolved else math.nan,
        "width_std_um": max(0.5 * float(one[-1] - one[0]), 0.25 * step) if is_resolved else math.nan,
        "width_range_um": (float(two[0]), float(two[-1])),
        "missing_um": _by_name(contrast, missing),
        "missing_std_um": _by_name(contrast, missing_std),
        "dark_in": tuple(n for n, d in zip(names, is_dark, strict=True) if d),
        "bright_in": tuple(n for n, b in zip(names, is_bright, strict=True) if b),
    }
    r, weight = contrast.directions @ beside.normal, missing_std**-2.0
    rise, rise_std = float(np.sum(weight * r * missing) / np.sum(weight * r * r)), float(np.sum(weight * r * r)) ** -0.5
    misfit = float(np.sum(weight * (missing - rise * r) ** 2))
    if stats.chi2.sf(misfit, len(names) - 1) > _EXPLAINED:
        return found | {
            "kind": "step",
            "depth_um": abs(rise),
            "depth_std_um": rise_std,
            "depth_note": "a step within about a pixel, to first order in its slope, from the micrographs",
        }
    if is_dark.sum() < 2:
        return found | {"kind": "line", "depth_note": "neither dark as a slit nor bright and dark as a step"}
    instrument = contrast.instrument
    slant = abs(float(np.dot(instrument.beam_shift, beside.normal)))
    spot = np.array(instrument.spot_position(0.0)[:2])
    rims = [float(np.max(np.abs((a.rim(64) - spot) @ beside.normal))) for a in instrument.apertures()]
    reaches = np.array(rims) / instrument.sample_distance + slant
    bound = max(0.0, float(np.max((missing - _SEEN * missing_std) / reaches)))
    return found | {
        "kind": "slit",
        "depth_at_least_um": bound,
        "depth_note": f"not determined: shadowed; at least {bound:.0f} um if of the same material",
    }


def _measure_kink(
    path: Path, change: np.ndarray, std: np.ndarray, normal: np.ndarray, rec: Reconstruction, contrast: Contrast
) -> dict[str, Any] | None:
    """Measure the kink of a groove in the micrographs, depth and width in the heights; None unless it is concave.

    Depth and width are those of the deepest piece of the line; without a piece that has two significant flanks it is a
    crease.
    """
    surface = np.stack([-contrast.directions @ normal, np.ones(std.size)], -1) / std[:, None]
    covariance = np.linalg.inv(surface.T @ surface)
    kink, kink_std = float((covariance @ surface.T @ (change / std))[0]), math.sqrt(covariance[0, 0])
    if not kink > _SIGNIFICANT * kink_std:
        return None
    found: dict[str, Any] = {
        "change": _by_name(contrast, change),
        "change_std": _by_name(contrast, std),
        "kink_deg": math.degrees(math.atan(kink)),
        "kink_std_deg": math.degrees(kink_std) / (1.0 + kink * kink),
    }
    rows, columns, t, along, _ = _pixels_beside(path, rec.height.shape, FLANK)
    n_pieces = max(1, round(path.length / _PIECE))
    piece = np.minimum((along / path.length * n_pieces).astype(int), n_pieces - 1)
    known = (rec.has_relief & np.isfinite(rec.height))[rows, columns]
    pieces = [
        HeightProfile.of(rec, rows[use], columns[use], t[use])
        for use in ((piece == i) & known for i in range(n_pieces))
    ]
    deep = [(*q.depth_and_std(rec), q) for q in pieces if q is not None]
    significant = [d for d in deep if d[0] > _SIGNIFICANT * d[1]]
    if not significant:
        most = f"{max(d[0] for d in deep):.1f} um" if deep else "no heights"
        return found | {
            "kind": "crease",
            "depth_note": f"no two flanks in the heights (deepest piece: {most}): a kink, or the foot of a step",
        }
    depth, depth_std, profile = max(significant, key=lambda d: d[0])
    width, width_std = rec.spread(profile.width)
    step = pitch(rec.raster_x)
    return found | {
        "kind": "groove",
        "depth_um": depth,
        "depth_std_um": depth_std,
        "width_um": width * step,
        "width_std_um": math.hypot(width_std, 1.0 / math.sqrt(12.0)) * step,
        "depth_note": f"of the deepest piece; two flanks on {len(significant)} of {n_pieces} pieces of its length",
    }
