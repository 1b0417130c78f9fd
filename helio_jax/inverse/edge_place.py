"""Where an upper edge lies between the pixels, and whether the signal falls abruptly there.

An edge is laid between lit and dark pixels of all detectors by logistic regression of their distance from a line.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, ndtr

from helio_jax.inverse.mask_edges import MIN_LENGTH, Edge

MARGIN = (1.2, 0.2)
"""Pixels left out at both ends of an edge: in pixels, and as a fraction of the distance from it."""
MODEL_ERROR = 0.015
"""Error of the modelled signal, as a fraction of the signal of the level surface."""
_SOFT = 0.15
"""Width of the transition between lit and dark pixels, with which an edge is laid [pixels]."""
_CUT = 0.25
"""Darkness up to which a pixel counts as lit, and from one minus which on as dark."""
LEAST_ARC = 8.0
"""Shorter edges count as straight: a few pixels do not tell an arc from the steps of the raster [pixels]."""
ARC_GAIN = 0.7
"""By how much the log likelihood of lit and dark pixels must be better for an arc: straight edges reach 0.5."""
_RIGHT = 0.75
"""Least fraction of pixels on the right side of an edge, near each of its points."""
_WIDTHS = np.array([0.1, 0.25, 0.4, 0.9, 1.3, 1.8, 2.5, 3.5])
_ABRUPT = 0.6
"""Widths of a fall that are compared, and the one above which it is gradual [pixels]."""
_FUZZ = 0.15
"""Error of the signal within the pixel at a sharp edge, in that of the level surface."""


@dataclass(frozen=True)
class Images:
    """Data of a stack.

    Attributes:
        signal, variance: [detector, y, x]; NaN where not observed.
        place: beam positions [y, x, 2], um.
        lit, floor, floor_std: signals of `SignalLevels` [detector].
        side: of a pixel [um].
        spot: standard deviation of the beam's spot [um].
    """

    signal: np.ndarray
    variance: np.ndarray
    place: np.ndarray
    lit: np.ndarray
    floor: np.ndarray
    floor_std: np.ndarray
    side: float
    spot: float


def band_coordinates(edge: Edge, images: Images, drift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute distance from the edge, and place along it of the point from which `drift` leads to a pixel [y, x].

    Each point of the edge casts its mask along `drift`: the far end of the band is curved as the edge is.
    """
    rel = images.place - edge.middle
    u, w = rel @ edge.normal, rel @ edge.along
    w = w - np.maximum(u, 0.0) * (drift @ edge.along) / (drift @ edge.normal)
    return u + 0.5 * edge.curvature * (np.minimum(w**2, 0.25 * edge.length**2) - edge.length**2 / 12.0), w


def lay_edge(edge: Edge, images: Images, dark: list[int], v: np.ndarray) -> tuple[Edge, float] | None:
    """Lay an edge between lit and dark pixels; return it with the gap between these along the normal [um].

    Logistic regression of the darkness by the distance from a line: convex, and between separable pixels the line of
    largest margin. Repeated, because pixels and signal levels are taken by their distance from the line. Parts
    of a round outline are arcs: taken for straight, they made bands of discs 0.1 pixel too long, 1 to 3 % of their
    height.

    Args:
        edge: as found.
        images: data.
        dark: numbers of the detectors whose bands begin at the edge.
        v: direction of each detector plus beam shift [detector, 2].
    """
    gap = images.side
    for i in range(8):
        if (laid := _lay_once(edge, images, dark, v)) is None:
            return None
        moved = float(np.abs((laid[0].middle - edge.middle) @ edge.normal))
        edge, gap = laid
        if moved < 0.02 * images.side and i > 1:
            break
        if i in (1, 4):
            if (short := _trimmed(edge, images, dark, v)) is None:
                return None
            edge = short
    return edge, gap


def _trimmed(edge: Edge, images: Images, dark: list[int], v: np.ndarray) -> Edge | None:
    """Cut an edge to its longest run, where lit pixels lie above dark ones."""
    side = images.side
    n = int(np.ceil(edge.length / side)) + 6
    good, seen = np.zeros(n), np.zeros(n)
    for k in dark:
        u, w = band_coordinates(edge, images, v[k])
        data = (images.signal[k] - images.floor[k]) / (images.lit[k] - images.floor[k])
        near = (np.abs(u) > 0.3 * side) & (np.abs(u) < 1.2 * side) & np.isfinite(data)
        top, low = near & (u < 0) & (np.abs(w) < 0.4 * edge.length), near & (u > 0) & (np.abs(w) < 0.4 * edge.length)
        if top.sum() < 2 or low.sum() < 2:
            continue
        middle = 0.5 * (np.median(data[top]) + np.quantile(data[low], 0.3))
        is_right = np.where(u < 0, data > middle, data < middle)
        bins = np.floor(w / side + 0.5 * n).astype(int)
        use = near & (bins >= 0) & (bins < n)
        good += np.bincount(bins[use], is_right[use], n)
        seen += np.bincount(bins[use], minlength=n)
    share = np.convolve(good, np.ones(3), "same") / np.maximum(np.convolve(seen, np.ones(3), "same"), 1)
    is_good = np.concatenate([[False], share > _RIGHT, [False]])
    ends = np.flatnonzero(np.diff(is_good.astype(int)))
    if not ends.size:
        return None
    first, last = max(zip(ends[::2], ends[1::2], strict=True), key=lambda run: run[1] - run[0])
    if last - first < MIN_LENGTH:
        return None
    a, b = (np.array([first + 0.7, last - 0.7]) - 0.5 * n) * side
    return replace(edge, start=edge.middle + a * edge.along, end=edge.middle + b * edge.along)


def _lay_once(edge: Edge, images: Images, dark: list[int], v: np.ndarray) -> tuple[Edge, float] | None:
    side = images.side
    us, ws, fs = [], [], []
    for k in dark:
        u, w = band_coordinates(edge, images, v[k])
        data = (images.signal[k] - images.floor[k]) / (images.lit[k] - images.floor[k])
        near = (np.abs(w) <= 0.5 * edge.length - 0.5 * side) & (np.abs(u) < 2.0 * side) & np.isfinite(data)
        top, low = near & (u < -0.8 * side), near & (u > 0.4 * side) & (u < 1.4 * side)
        if top.sum() < 2 or low.sum() < 2:
            continue
        lit, shade = np.median(data[top]), np.quantile(data[low], 0.3)
        if lit - shade < 0.2:
            continue
        # a narrow band ends within the range: lit pixels beyond are not the upper level's
        use = near & (u < 0.9 * side)
        us.append(u[use])
        ws.append(w[use])
        # noise and unequal levels on either side are cut off: they would pull at the line
        fs.append(np.clip(((lit - data[use]) / (lit - shade) - _CUT) / (1.0 - 2.0 * _CUT), 0.0, 1.0))
    if not us:
        return None
    u, w, f = map(np.concatenate, (us, ws, fs))
    half = max(0.5 * edge.length, side)
    along = w / half
    straight, bulged = np.stack([np.ones_like(w), along], 1), along**2 - 1.0 / 3.0
    line = u - 0.5 * edge.curvature * half**2 * bulged
    (place, as_line), bulge = _regression(straight, line, f, side), 0.0
    if edge.length >= LEAST_ARC * side:
        arc, as_arc = _regression(np.column_stack([straight, bulged]), line, f, side)
        if as_line - as_arc > ARC_GAIN:
            place, bulge = arc[:2], float(arc[2])
    shift = place[0] + np.array([-1.0, 1.0]) * place[1] * 0.5 * edge.length / half
    start, end = (ends + by * edge.normal for ends, by in zip((edge.start, edge.end), shift, strict=True))
    laid = replace(edge, start=start, end=end, curvature=-2.0 * bulge / half**2)
    return laid, pixel_gap(line - bulge * bulged - straight @ place, 0.0, side)


def _regression(design: np.ndarray, u: np.ndarray, dark: np.ndarray, side: float) -> tuple[np.ndarray, float]:
    """Place an edge between lit and dark pixels: its distance is a sum of columns [coefficient], um; and the misfit.

    Args:
        design: columns [pixel, coefficient]; all but the first have a prior about 0.
        u: distance of the pixels from the edge so far, um.
        dark: their darkness, 0 to 1.
        side: of a pixel, um.
    """
    place = np.zeros(design.shape[1])
    prior = np.array([0.0, *[0.02] * (place.size - 1)])
    for soft in (0.6, 0.3, _SOFT):
        for _ in range(30):
            p = expit((u - design @ place) / (soft * side))
            slope = design.T @ (p - dark) / (soft * side) * -1.0 + place * prior / side**2
            curve = (design * (p * (1 - p))[:, None]).T @ design / (soft * side) ** 2
            curve += np.diag(np.maximum(prior, 1e-6)) / side**2
            step = np.linalg.solve(curve + 1e-4 * np.trace(curve) * np.eye(place.size), slope)
            size = np.abs(step).max()
            place = place - step * min(1.0, 0.3 * side / max(size, 1e-12))
            if size < 1e-3 * side:
                break
    log_odds = (u - design @ place) / (_SOFT * side)
    return place, float(np.sum(np.logaddexp(0.0, log_odds) - dark * log_odds))


def pixel_gap(u: np.ndarray, at: float, side: float) -> float:
    """Return the distance of the pixels next to a place on either side [um]: a sharp end within it looks the same."""
    above, below = u[u >= at], u[u < at]
    if not above.size or not below.size:
        return side
    return float(min(above.min() - below.max(), 2.0 * side))


def abruptness(edge: Edge, images: Images, k: int, v: np.ndarray, band: float) -> float:
    """Return the probability that a signal falls abruptly at an edge, rather than over a pixel or more.

    Likelihoods of an error function of any width below and above `_ABRUPT`, at the best widths.

    Args:
        edge: from `lay_edge`.
        images: data.
        k: number of the detector.
        v: its direction plus the beam shift [2].
        band: length of its band along the normal [um].
    """
    side = images.side
    u, w = band_coordinates(edge, images, v)
    lit = images.lit[k] - images.floor[k]
    use = (np.abs(w) <= 0.5 * edge.length - MARGIN[0] * side) & np.isfinite(images.signal[k])
    use &= (u > -4.0 * side) & (u < min(2.5 * side, max(0.6 * band, side)))
    data, variance = images.signal[k][use] / lit, images.variance[k][use] / lit**2 + MODEL_ERROR**2
    cost = []
    for width in _WIDTHS * side:
        best = np.inf
        for shift in np.linspace(-0.5, 0.5, 5) * max(width, 0.3 * side):
            shape = ndtr((u[use] - shift) / np.hypot(width, images.spot))
            # half a pixel of freedom for where a sharp edge lies between the pixels
            error = variance + (_FUZZ * np.exp(-0.5 * (u[use] / (0.35 * side)) ** 2)) ** 2
            columns = np.stack([np.ones_like(shape), shape, shape * np.maximum(u[use], 0.0) / side], 1)
            a = columns / np.sqrt(error)[:, None]
            rest = data / np.sqrt(error) - a @ np.linalg.lstsq(a, data / np.sqrt(error), rcond=None)[0]
            best = min(best, float(rest @ rest))
        cost.append(best)
    sharp, wide = min(np.array(cost)[_WIDTHS < _ABRUPT]), min(np.array(cost)[_WIDTHS >= _ABRUPT])
    birge = max(1.0, min(sharp, wide) / max(use.sum() - 4, 1))
    return float(expit(0.5 * (wide - sharp) / birge))
