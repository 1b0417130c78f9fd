"""Length of the band beside an upper edge, and the wall's height from it, for one detector.

Pixels beside an edge (`edge_place`) are data of their distance from it. The height is fitted to each detector through
`wall_signal`, with free signal levels: heights follow from where signals change, not from how strong they are.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from helio_jax.inverse.edge_place import MARGIN, MODEL_ERROR, Images, band_coordinates, pixel_gap
from helio_jax.inverse.mask_edges import Edge
from helio_jax.inverse.wall_signal import WallSignal

_ABOVE = 2.6
"""Pixels of the upper side that are used, from the edge [pixels]."""
_BEYOND = (0.25, 2.6)
"""Pixels beyond the far end that are used: fraction of the band, and pixels."""
_BLUR = 0.15
"""Least standard deviation of the smoothing of sharp ends, which makes the model differentiable [pixels]."""
_SHARP = 0.08
"""The same where the place of an edge is compared [pixels]."""
LEAST_MASK = 0.2
"""Shortest mask band that tells a height [heights of the step]."""
_SLANT = 0.35
"""Least cosine of the angle between an edge's normal and the direction of its band."""
_SCATTER_STD = {"dark": 0.6, "lit": 0.6}
"""Prior standard deviation of multiple scattering, as a fraction of the prediction."""
_BASE_STD = 0.04
"""Prior standard deviation of a constant on the lower level, where it is not the pedestal [signal of the level]."""
_SLOPE_STD = 0.1
"""Prior standard deviation of a slope of the lower level's signal, over the range of the data."""
_WALL_STD = 0.3
"""Prior standard deviations of the signal of a masked wall and of its change over the wall, beyond the prediction: what
else the wall sees is not modelled [signal of the level]."""
_OUTLIER = 3.0
"""Residual from which on a pixel loses weight [standard deviations]."""
_PLACES = np.arange(-0.8, 0.81, 0.08)
"""Shifts of an edge that are compared [pixels]."""
_PIT_STD = 0.4
"""The same beside other walls, as in a pit."""
_TEMPERATURE = 5.0
"""Factor on the noise where the place of an edge is compared: the model errs from pixel to pixel in common."""
_LOW = 0.85, 1.2
"""Signal of the lower level beside a free wall, in that of the upper level."""
_STEEP = 0.13
"""Largest slope of the lower level's signal beside a free wall, over the range of the data."""
_LEAST_SCATTERED = -0.5
"""Least multiple scattering beside a free wall, in the prediction; 0 within its error where walls absorb."""
_PENUMBRA = 20.0
"""Least change of chi2 by which a resolved penumbra must fit better than an abrupt end."""
_FAR_MISFIT = 5.0
"""Mean square residual about the far end above which something else ends the band."""
_LEAST_HEIGHT = 0.1
"""Least height that is looked for, in pixels of the band."""
_SEARCH = 1.06, 1.01
"""Ratios of neighbouring heights of the first and the second search."""


@dataclass(frozen=True)
class Band:
    """Height from one detector's band at one edge.

    Attributes:
        kind: "dark": a mask band; "lit": the image of a wall that the detector sees.
        height, std: of the wall, from noise and signal levels [um].
        factor: mean length of the band along the edge's normal over the height.
        end_std: standard deviation of the far end's place, because pixels sample it [um].
        chi2, n_data: weighted squares of the residuals, number of data.
        far_chi2, n_far: the same about the far end.
        penumbra: length of the penumbra along the normal [pixels].
        abrupt: how much worse an abrupt far end fits than a penumbra, as a change of chi2; below 0: better.
        reach: how far from the edge data lie [um].
        least: height at least, if something else ends the band [um].
        levels: fitted signals of `_columns`, in that of `SignalLevels.lit`: upper and lower level, scattered, ...
    """

    kind: str
    height: float
    std: float
    factor: float
    end_std: float
    chi2: float
    n_data: int
    far_chi2: float
    n_far: int
    penumbra: float
    abrupt: float
    reach: float
    least: float
    levels: tuple[float, ...]


def kind_of(signal: WallSignal) -> str:
    """Return how a detector shows a wall: "dark", "lit", or "" where its signal does not determine the height."""
    if signal.dark_share >= 0.995 and signal.length >= LEAST_MASK and signal.slant[0] >= _SLANT:
        return "dark"
    if signal.shift < -0.1 and signal.q[-1] < 0.0 and signal.slant[1] >= _SLANT:
        return "lit"
    return ""


@dataclass
class _Pixels:
    """Pixels of one detector beside an edge, in units of the signal of the level surface; distances u [um]."""

    kind: str
    signal: WallSignal
    u: np.ndarray
    data: np.ndarray
    variance: np.ndarray
    base_std: float


def _select(edge: Edge, images: Images, k: int, signal: WallSignal, drift: np.ndarray, far: float) -> _Pixels | None:
    """Take the pixels of a detector that belong to an edge, up to the distance `far` [um]."""
    u, w = band_coordinates(edge, images, drift)
    side = images.side
    room = 0.5 * edge.length - MARGIN[0] * side - MARGIN[1] * np.maximum(u, 0.0)
    data, variance = images.signal[k], images.variance[k]
    use = (u > -_ABOVE * side) & (u < far) & (np.abs(w) <= room) & np.isfinite(data) & (variance > 0)
    if use.sum() < 8:
        return None
    lit = images.lit[k] - images.floor[k]
    base = float(np.hypot(_BASE_STD, images.floor_std[k] / lit))
    return _Pixels(kind_of(signal), signal, u[use], (data[use] - images.floor[k]) / lit, variance[use] / lit**2, base)


def _columns(pixels: _Pixels, height: float, blur: float) -> np.ndarray:
    """Compute the signals of which the model is a sum [column, pixel]: upper level, lower level, scattered, ...

    Args:
        pixels: of one detector.
        height: of the wall [um].
        blur: standard deviation of the smoothing of sharp ends [um].
    """
    s, u = pixels.signal, pixels.u
    strip = s.strip * height
    below = ndtr(u / blur)
    is_low = ndtr((u - strip) / blur) if strip > 0 else below
    is_wall = below - is_low
    z, d = np.clip(1.0 - u / max(strip, 1e-9), 0.0, 1.0), np.maximum(u / height + s.shift, max(s.shift, 0.0))
    scattered, slope = is_low * s.on_level(d), is_low * np.maximum(u, 0.0) / (u.max() + 1e-9)
    if pixels.kind == "dark":
        direct = is_low * (1.0 - s.masked(d))
        on_wall = [is_wall, is_wall * (z - 0.5)]
        return np.stack([1.0 - below, direct, scattered + is_wall * s.on_wall(z), below, slope, *on_wall])
    return np.stack([1.0 - below, is_low, scattered, slope, is_wall, is_wall * (z - 0.5)])


_CENTER = {"dark": np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), "lit": np.array([1.0, 1.0, 1.0, 0.0, 1.0, 0.0])}
"""Prior means of the levels."""


def _residuals(
    pixels: _Pixels, height: float, side: float, spot: float, least: float = _BLUR
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the free signal levels; return residuals with those of the priors, and the levels.

    Sharp ends are smoothed by `least` pixels at least.
    """
    u, kind, s = pixels.u, pixels.kind, pixels.signal
    spot = spot * math.hypot(1.0, s.shift)  # the raster stretches it along the beam's azimuth
    blur = max(least * side, spot)
    columns = _columns(pixels, height, blur)
    error = np.zeros(u.shape)
    for end in {0.0, s.strip * height}:
        error += ndtr(-np.abs(u - end) / blur) - ndtr(-np.abs(u - end) / spot)
    sigma = np.sqrt(pixels.variance + MODEL_ERROR**2 + error**2)
    more = (pixels.base_std, _SLOPE_STD, _WALL_STD, _WALL_STD) if kind == "dark" else (_SLOPE_STD, 2.0, 1.0)
    std = np.array([0.3, 0.3, _SCATTER_STD[kind], *more])
    a = np.concatenate([(columns / sigma).T, np.diag(1.0 / std)])
    b = np.concatenate([pixels.data / sigma, _CENTER[kind] / std])
    levels = np.linalg.lstsq(a, b, rcond=None)[0]
    return b - a @ levels, levels


def fit_band(
    edge: Edge,
    images: Images,
    k: int,
    signal: WallSignal,
    v: np.ndarray,
    beam_shift: np.ndarray,
    start: float | None = None,
) -> Band | None:
    """Fit the height of the wall below an edge to one detector.

    Args:
        edge: from `lay_edge`.
        images: data.
        k: number of the detector.
        signal: its model for the edge's normal.
        v: its direction plus the beam shift [2].
        beam_shift: `Instrument.beam_shift` [2].
        start: first height [um]; default: from the deficit of the band.

    Returns:
        The fit, or None where this detector shows no band, or pixels do not suffice.
    """
    kind = kind_of(signal)
    if not kind:
        return None
    side, drift = images.side, v if kind == "dark" else beam_shift
    factor = signal.length if kind == "dark" else signal.strip
    most = max(signal.strip, signal.strip + signal.q[-1] - max(signal.shift, 0.0)) if kind == "dark" else signal.strip
    height = _first_height(edge, images, k, signal, drift) if start is None else start
    pixels = plain = None
    for i, step in enumerate(_SEARCH):
        ratios = step ** np.arange(-10, 11)
        far = height * most
        new = _select(edge, images, k, signal, drift, far + max(_BEYOND[0] * far, _BEYOND[1] * side))
        if new is None:
            return None
        pixels, plain = new, replace(new)
        if i > 0:
            pixels.base_std = _base_std(pixels, height, side, images.spot)
            residuals = _residuals(pixels, height, side, images.spot)[0][: len(pixels.u)]
            pixels.variance = pixels.variance * np.maximum(1.0, np.abs(residuals) / _OUTLIER) ** 2
        tries = height * ratios
        cost = [float(np.sum(_residuals(pixels, h, side, images.spot)[0] ** 2)) for h in tries]
        height = float(tries[int(np.argmin(cost))])
    assert pixels is not None and plain is not None
    plain.base_std = pixels.base_std
    height, curvature = _polish(pixels, height, side, images.spot)
    residuals, levels = _residuals(pixels, height, side, images.spot)
    own = residuals[: len(pixels.u)]
    end = factor * height
    is_far = np.abs(pixels.u - end) < max(0.3 * end, 1.2 * side)
    spread = signal.q[-1] - max(signal.q[0], signal.shift, 0.0) if kind == "dark" else 0.0
    soft = np.hypot(0.3 * spread * height, images.spot)
    end_std = pixel_gap(pixels.u, end, side) / np.sqrt(12.0) * np.exp(-0.5 * (2.0 * np.pi * soft / side) ** 2)
    birge = max(1.0, float(own @ own) / max(len(own) - 4, 1))
    return Band(
        kind=kind,
        height=height,
        std=float(np.sqrt(birge / max(curvature, 1e-12))),
        factor=factor,
        end_std=float(end_std),
        chi2=float(own @ own),
        n_data=len(own),
        far_chi2=float(own[is_far] @ own[is_far]),
        n_far=int(is_far.sum()),
        penumbra=spread * height / side,
        abrupt=_abrupt_end(plain, height, side, images.spot) if kind == "dark" else math.inf,
        reach=float(pixels.u.max()),
        least=_first_height(edge, images, k, signal, drift) * signal.length / most if kind == "dark" else 0.0,
        levels=tuple(levels.tolist()),
    )


def place_edge(
    edge: Edge, images: Images, signals: list[WallSignal], v: np.ndarray, beam_shift: np.ndarray, bands: dict[int, Band]
) -> tuple[float, float]:
    """Compute by how much an edge should move along its normal, and the standard deviation of its place [um].

    The model of `fit_band`, with the spot's own width, at every place of the edge; each detector's height follows so
    that the far end of its band stays where it is. Mean and deviation over the places by their likelihood.

    Args:
        edge: from `lay_edge`.
        images: data.
        signals: model of every detector.
        v: direction of each detector plus the beam shift [detector, 2].
        beam_shift: `Instrument.beam_shift` [2].
        bands: fits to the detectors, by number.
    """
    side, places = images.side, _PLACES * images.side
    cost = np.zeros(places.size)
    n_data = 0
    for k, band in bands.items():
        signal = signals[k]
        drift = v[k] if band.kind == "dark" else beam_shift
        far = band.factor * band.height
        # up to the middle of the band's far end: what lies beyond does not depend on the edge's place
        pixels = _select(edge, images, k, signal, drift, far + side)
        if pixels is None:
            continue
        n_data += len(pixels.u)
        u = pixels.u
        for i, place in enumerate(places):
            pixels.u = u - place
            height = max((far - place) / band.factor, 0.2 * band.height)
            tries = [_residuals(pixels, height * f, side, images.spot, _SHARP)[0] for f in (0.98, 1.0, 1.02)]
            cost[i] += min(map(_robust, tries))
    cost -= cost.min()
    weight = np.exp(-0.5 * cost / _TEMPERATURE)
    weight /= weight.sum()
    mean = float(weight @ places)
    return mean, math.sqrt(float(weight @ (places - mean) ** 2) + (0.03 * side) ** 2)


def _robust(residuals: np.ndarray) -> float:
    """Return the sum of squares of residuals, in which outliers count less (Cauchy)."""
    return float(np.sum(_OUTLIER**2 * np.log1p((residuals / _OUTLIER) ** 2)))


def _abrupt_end(pixels: _Pixels, height: float, side: float, spot: float) -> float:
    """Compute how much worse an abrupt far end fits than a penumbra: what ends abruptly, something else ends."""
    s = pixels.signal
    mean = float(s.weight @ s.q)
    sharp = replace(pixels, signal=replace(s, q=mean + 1e-3 * (s.q - mean)))
    factors = np.linspace(0.85, 1.15, 16)
    soft, hard = (min(_robust(_residuals(p, height * f, side, spot)[0]) for f in factors) for p in (pixels, sharp))
    return hard - soft


def _base_std(pixels: _Pixels, height: float, side: float, spot: float) -> float:
    """Choose between a lower level without and with signal from other walls, by evidence [signal of the level]."""
    found = []
    for base in (1.0, _PIT_STD / _BASE_STD):
        trial = replace(pixels, base_std=pixels.base_std * base)
        cost = min(_robust(_residuals(trial, height * f, side, spot)[0]) for f in (0.9, 0.95, 1.0, 1.05, 1.1))
        found.append((cost + 2.0 * math.log(base), trial.base_std))
    return min(found)[1]


def _polish(pixels: _Pixels, height: float, side: float, spot: float) -> tuple[float, float]:
    """Minimise the squares by Newton steps with Gauss-Newton curvature; return height and curvature [1/um^2]."""
    curvature = 0.0
    for _ in range(12):
        step = max(0.01 * height, 0.02 * side)
        plus, minus = (_residuals(pixels, height + s, side, spot)[0] for s in (step, -min(step, 0.5 * height)))
        slope = (plus - minus) / (step + min(step, 0.5 * height))
        here = _residuals(pixels, height, side, spot)[0]
        curvature = float(slope @ slope)
        change = -float(slope @ here) / max(curvature, 1e-12)
        change = float(np.clip(change, -0.05 * height, 0.05 * height))
        if np.sum(_residuals(pixels, height + change, side, spot)[0] ** 2) > here @ here:
            change *= 0.3
        height += change
        if abs(change) < 1e-4 * height:
            break
    return height, curvature


def _first_height(edge: Edge, images: Images, k: int, signal: WallSignal, drift: np.ndarray) -> float:
    """Estimate the height from the mean deficit along the normal, up to where the signal is half back [um]."""
    u, w = band_coordinates(edge, images, drift)
    side = images.side
    use = (np.abs(w) < 0.5 * edge.length - 0.5 * side) & (u > 0.0) & np.isfinite(images.signal[k])
    if not use.any():
        return side
    fraction = (images.signal[k][use] - images.floor[k]) / (images.lit[k] - images.floor[k])
    bins = np.floor(u[use] / side).astype(int)
    size = np.bincount(bins)
    mean = np.bincount(bins, fraction) / np.maximum(size, 1)
    mean[size == 0] = np.nan
    floor = float(np.nanmin(mean[:4])) if np.isfinite(mean[:4]).any() else 0.0
    depth = np.clip((1.0 - mean) / max(1.0 - floor, 0.1), 0.0, 1.0)
    deepest = int(np.nanargmax(depth[:4])) if np.isfinite(depth[:4]).any() else 0
    end = np.flatnonzero(depth[deepest + 1 :] < 0.4)
    n = deepest + 1 + int(end[0]) if end.size else len(mean)
    length = float(np.nansum(depth[:n])) * side
    return max(length, _LEAST_HEIGHT * side) / max(signal.length, 0.1)


def disturbance(band: Band) -> str:
    """Return how a band ends or is filled otherwise than beside a free wall: "interrupted", "no free wall", or "".

    A band that another wall or the border ends is at least as long as its dark part. Free walls of simulated mesas give
    fitted levels within these limits in 99 of 100 bands.
    """
    top, low, scattered, *rest = band.levels
    if band.kind == "dark":
        is_odd = not _LOW[0] < low / top < _LOW[1] or scattered < _LEAST_SCATTERED or abs(rest[1]) > _STEEP
        is_abrupt = band.abrupt < (_PENUMBRA if band.penumbra > 1.5 else 0.0)
    else:
        is_odd, is_abrupt = not 0.7 < low / top < 1.4, False
    is_cut = band.n_far < 3 or band.reach < band.factor * band.height
    if is_cut or is_abrupt:
        return "interrupted"
    return "no free wall" if is_odd or band.far_chi2 > _FAR_MISFIT * max(band.n_far, 1) else ""
