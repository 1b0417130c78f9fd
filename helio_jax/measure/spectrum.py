"""Multitaper power spectra of regions of any shape in two dimensions, and their noise floor.

Each block of a region is weighted by several orthogonal tapers whose spectra lie within a small disc of wave vectors
(the Slepian functions of that block), and the power spectra are averaged. All pixels up to an irregular border count,
and leakage from distant wave vectors is small. The noise floor at a wave number is a median over all directions of
about the same wavelength. `ripple` interprets the spectra.

Source: Slepian, Bell Syst. Tech. J. 43 (1964) 3009; Thomson, Proc. IEEE 70 (1982) 1055.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pydantic import Field
from scipy import fft, special, stats
from scipy.sparse.linalg import eigsh

from helio_jax.errors import GuardError
from helio_jax.settings import Settings

_BLOCK = 32
"""Regions larger than the square of this side are cut into blocks of about this side [pixels]."""
_DEGREE = 3
"""Degree of the polynomial trend that is subtracted from each block."""
_SHANNON = 8.0
"""Shannon number: pixels of a block times the area of the disc of wave vectors, about the number of tapers."""
_CONCENTRATED = 0.9
"""Smallest fraction of a taper's power within the disc."""
_MOST_TAPERS = 12
_FULLEST = 0.4
"""Blocks with fewer pixels than this fraction of the largest block's are skipped."""
_FEWEST_PIXELS = 64
_RING = 0.3
"""Half width of a ring of the noise floor, in the logarithm of the wave number."""
_RING_CELLS = 6.0
"""Smallest number of independent values in a ring."""
_RADII = 48
_MEDIAN = 0.6
"""Statistical efficiency of a median relative to a mean."""
_MAXIMA = 3.0
"""Ratio of the false alarms of a smooth spectrum's maxima to those of its independent values."""
_CERTAIN = 1e-3
"""False-alarm probability below which the highest peak is excluded from the noise floor."""


class RippleSettings(Settings):
    """Search range of ripples."""

    shortest_um: float | None = Field(default=None, gt=0.0)
    """Shortest wavelength; default: 3 pixels [um]."""
    longest_um: float | None = Field(default=None, gt=0.0)
    """Longest wavelength; default: that of 1.5 times the resolution [um]."""
    along_axes: bool = False
    """Whether wave vectors along the raster's axes are searched, where scan lines look like ripples."""


@dataclass(frozen=True)
class Block:
    """A piece of a region.

    Attributes:
        rows, columns: of its pixels [pixel].
        tapers: orthonormal weights [taper, pixel].
        trend: orthonormal basis of the polynomials over the pixels [pixel, term].
    """

    rows: np.ndarray
    columns: np.ndarray
    tapers: np.ndarray
    trend: np.ndarray

    def detrend(self, values: np.ndarray) -> np.ndarray:
        """Subtract the least-squares polynomial from values [pixel, ...]."""
        return values - self.trend @ (self.trend.T @ values)


@dataclass(frozen=True)
class Blocks:
    """All blocks, the half width of their tapers' spectra [cycles per pixel], and the pitches along x and y [um]."""

    blocks: tuple[Block, ...]
    bandwidth: float
    steps: tuple[float, float]

    @property
    def averages(self) -> int:
        """Number of averaged spectra."""
        return sum(len(block.tapers) for block in self.blocks)

    @property
    def n_pixels(self) -> int:
        """Pixels of all blocks."""
        return sum(block.rows.size for block in self.blocks)

    @property
    def cells(self) -> float:
        """Independent values in the whole plane of wave vectors: one for each disc."""
        return 1.0 / (math.pi * self.bandwidth**2)

    @property
    def widths(self) -> tuple[float, float]:
        """Resolution along kx and ky [cycles per um]."""
        return self.bandwidth / self.steps[0], self.bandwidth / self.steps[1]


def make_blocks(regions: Sequence[np.ndarray], steps: tuple[float, float]) -> Blocks:
    """Cut regions into blocks and compute their tapers.

    Args:
        regions: True inside [y, x].
        steps: pitch along x and y [um].

    Raises:
        GuardError: there are too few pixels.
    """
    pieces = [piece for region in regions for piece in _pieces(region)]
    largest = max((rows.size for rows, _ in pieces), default=0)
    if largest < _FEWEST_PIXELS:
        raise GuardError(f"a ripple needs {_FEWEST_PIXELS} or more known pixels side by side, got {largest}")
    pieces = [piece for piece in pieces if piece[0].size >= _FULLEST * largest]
    bandwidth = math.sqrt(_SHANNON / (math.pi * float(np.median([rows.size for rows, _ in pieces]))))
    blocks = []
    for rows, columns in pieces:
        tapers = _slepian(np.stack([rows - rows.min(), columns - columns.min()]).astype(float).tobytes(), bandwidth)
        if len(tapers):
            blocks.append(Block(rows, columns, tapers, _polynomials(rows, columns)))
    if not blocks:
        raise GuardError("the regions are too ragged for a spectrum: choose larger or more compact ones")
    return Blocks(tuple(blocks), bandwidth, steps)


def _pieces(region: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows and columns of the pieces of a region."""
    rows, columns = np.nonzero(region)
    if rows.size <= _BLOCK**2:
        return [(rows, columns)] if rows.size else []
    tile = np.zeros(rows.size, int)
    for place in (rows, columns):
        n = max(round(np.ptp(place) / _BLOCK), 1)
        tile = tile * (n + 1) + np.minimum((place - place.min()) * n // (np.ptp(place) + 1), n - 1)
    return [(rows[tile == t], columns[tile == t]) for t in np.unique(tile)]


@lru_cache(maxsize=64)
def _slepian(places: bytes, bandwidth: float) -> np.ndarray:
    """Compute the Slepian tapers [taper, pixel] of pixels for a disc of wave vectors.

    Args:
        places: rows and columns [2, pixel], as bytes: blocks of one shape share their tapers, which take seconds.
        bandwidth: radius of the disc [cycles per pixel].
    """
    rows, columns = np.frombuffer(places).reshape(2, -1)
    r = np.hypot(rows[:, None] - rows, columns[:, None] - columns)
    with np.errstate(invalid="ignore"):
        kernel = np.where(r > 0, bandwidth * special.j1(2.0 * np.pi * bandwidth * r) / r, np.pi * bandwidth**2)
    share, weights = eigsh(kernel, k=min(_MOST_TAPERS, rows.size - 2), which="LA", v0=np.ones(rows.size))
    tapers = np.ascontiguousarray(weights[:, share >= _CONCENTRATED].T)
    tapers.flags.writeable = False
    return tapers


def _polynomials(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Compute an orthonormal basis of the polynomials over pixels [pixel, term]."""
    u, v = (2.0 * (a - a.min()) / max(int(np.ptp(a)), 1) - 1.0 for a in (columns, rows))
    terms = [u**i * v**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    return np.linalg.qr(np.stack(terms, -1))[0]


def without_trend(field: np.ndarray, blocks: Blocks) -> np.ndarray:
    """Subtract a polynomial from a field on each block; 0 outside all blocks [y, x]."""
    out = np.zeros(field.shape)
    for block in blocks.blocks:
        out[block.rows, block.columns] = block.detrend(field[block.rows, block.columns])
    return out


@dataclass(frozen=True)
class Spectrum:
    """An averaged power spectrum and its noise floor; white noise of variance s^2 has the power s^2.

    Attributes:
        kx, ky: wave numbers, increasing [cycles per um].
        power: mean over all tapers [ky, kx].
        floor: expected power of the noise [ky, kx].
        is_searched: True at the searched wave vectors [ky, kx]: one half of the plane, within limits.
        ring: independent values behind the floor.
        blocks: of the fields.
    """

    kx: np.ndarray
    ky: np.ndarray
    power: np.ndarray
    floor: np.ndarray
    is_searched: np.ndarray
    ring: float
    blocks: Blocks

    @property
    def ratio(self) -> np.ndarray:
        """Power over floor [ky, kx]."""
        return self.power / self.floor

    def false_alarm(self, ratio: float) -> float:
        """Compute the probability that noise alone exceeds a ratio at any searched wave vector."""
        n = self.is_searched.sum() * self.blocks.cells / self.power.size
        averages = self.blocks.averages
        single = float(stats.f.sf(ratio, 2 * averages, 2 * averages * self.ring))
        return float(-np.expm1(max(_MAXIMA * n, 1.0) * np.log1p(-min(single, 1.0 - 1e-15))))

    def floor_at(self, kx: float, ky: float) -> float:
        """Return the floor at the grid point nearest to a wave vector [cycles per um]."""
        return float(self.floor[np.argmin(np.abs(self.ky - ky)), np.argmin(np.abs(self.kx - kx))])


def take_spectrum(fields: Sequence[np.ndarray], blocks: Blocks, settings: RippleSettings) -> Spectrum:
    """Compute the spectrum of one field, or of the component along the wave vector of a field of slopes (x, y).

    Args:
        fields: without trend [y, x].
        blocks: from `make_blocks`.
        settings: range of wavelengths.

    Raises:
        GuardError: no wave vector is left to search.
    """
    steps, width = blocks.steps, blocks.widths
    extent = max(int(max(np.ptp(b.rows), np.ptp(b.columns))) for b in blocks.blocks) + 1
    n = fft.next_fast_len(max(extent, math.ceil(6.0 / blocks.bandwidth)))
    kx, ky = (fft.fftshift(fft.fftfreq(n, step)) for step in steps)
    k = np.hypot(kx, ky[:, None])
    power = _power(fields, blocks, kx, ky)
    half = (kx > 0) | ((kx == 0) & (ky[:, None] > 0))
    if not settings.along_axes:
        half &= (np.abs(kx) > 1.2 * width[0]) & (np.abs(ky) > 1.2 * width[1])[:, None]
    shortest, longest = settings.shortest_um or 3.0 * max(steps), settings.longest_um or 1.0 / (1.5 * max(width))
    searched = half & (k >= 1.0 / longest) & (k <= 1.0 / shortest)
    if not searched.any():
        raise GuardError(
            f"no wavelength between {shortest:g} and {longest:g} um can be separated from the raster's axes at a "
            f"resolution of {1e3 * max(width):.2g} cycles per mm: enlarge the region, or search along the axes "
            "(along_axes)"
        )
    floor, ring = _floor(power, k, half, searched, blocks)
    found = Spectrum(kx, ky, power, floor, searched, ring, blocks)
    i, j = np.unravel_index(np.argmax(np.where(searched, found.ratio, -1.0)), power.shape)
    if found.false_alarm(float(found.ratio[i, j])) <= _CERTAIN:
        half &= np.hypot((kx - kx[j]) / width[0], ((ky - ky[i]) / width[1])[:, None]) >= 1.5
        floor, ring = _floor(power, k, half, searched, blocks)
    if len(fields) == 2:
        floor = floor * _by_direction(power / floor, np.arctan2(ky[:, None], kx), half & (k >= 1.0 / longest), blocks)
    return Spectrum(kx, ky, power, floor, searched, ring, blocks)


def _by_direction(ratio: np.ndarray, theta: np.ndarray, use: np.ndarray, blocks: Blocks) -> np.ndarray:
    """Fit the noise of slopes by direction, relative to its mean [ky, kx]: u' S u for a unit wave vector u.

    White noise of two slopes with the covariance S has that power along u at every wave number. S is fitted to the
    ratios, clipped at three times their median; isotropic noise is assumed where there are too few.
    """
    if use.sum() * blocks.cells / ratio.size < _RING_CELLS:
        return np.ones_like(ratio)
    clipped = np.minimum(ratio[use], 3.0 * np.median(ratio[use]))
    basis = np.stack([np.ones_like(theta), np.cos(2.0 * theta), np.sin(2.0 * theta)], -1)
    level, b, c = np.linalg.lstsq(basis[use], clipped, rcond=None)[0]
    return np.maximum(1.0 + (basis[..., 1] * b + basis[..., 2] * c) / level, 0.3)


def _power(fields: Sequence[np.ndarray], blocks: Blocks, kx: np.ndarray, ky: np.ndarray) -> np.ndarray:
    """Compute the mean power over all tapers [ky, kx]."""
    n, k = kx.size, np.hypot(kx, ky[:, None])
    unit = [np.ones_like(k)] if len(fields) == 1 else [kx / (k + (k == 0)), ky[:, None] / (k + (k == 0))]
    power = np.zeros((n, n))
    for block in blocks.blocks:
        at = block.rows - block.rows.min(), block.columns - block.columns.min()
        for taper in block.tapers:
            total = np.zeros((n, n), complex)
            for along, field in zip(unit, fields, strict=True):
                part = np.zeros((n, n))
                part[at] = taper * field[block.rows, block.columns]
                total += along * fft.fftshift(fft.fft2(part))
            power += np.abs(total) ** 2
    return power / blocks.averages


def _floor(
    power: np.ndarray, k: np.ndarray, use: np.ndarray, searched: np.ndarray, blocks: Blocks
) -> tuple[np.ndarray, float]:
    """Compute the noise's mean power [ky, kx] from medians over rings, and the independent values behind it."""
    order = np.argsort(k[use])
    log_k, values = np.log(k[use][order]), power[use][order]
    per_point = blocks.cells / power.size
    fewest = min(math.ceil(_RING_CELLS / per_point), values.size)
    limits = np.log(k[searched])
    radii = np.linspace(limits.min(), limits.max(), _RADII)
    floors, counts = [], []
    for r in radii:
        low, high = np.searchsorted(log_k, (r - _RING, r + _RING))
        if high - low < fewest:
            low = min(max(int(np.searchsorted(log_k, r)) - fewest // 2, 0), values.size - fewest)
            high = low + fewest
        floors.append(np.median(values[low:high]))
        counts.append((high - low) * per_point)
    mean_over_median = blocks.averages / special.gammaincinv(blocks.averages, 0.5)
    log_all = np.log(np.where(k > 0, k, np.exp(radii[0])))
    floor = np.exp(np.interp(log_all, radii, np.log(np.maximum(floors, 1e-300)))) * mean_over_median
    return floor, max(_MEDIAN * float(np.median(counts)), 1.0)
