"""Averaged two-dimensional power spectra of regions of any shape, and their floor.

Multitaper: a region is looked at through several orthogonal weights whose spectra lie within a small disc of wave
vectors (the Slepian functions of that region), and the power spectra are averaged; so all pixels count up to an
irregular border, and what is strong elsewhere hardly leaks in. The floor of a wave number is the median over all
directions of about the same wavelength. Knows nothing of what the fields mean; `ripple` does.

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

_SHANNON = 8.0
"""Pixels of a block times area of the disc of wave vectors: about how many weights there are."""
_CONCENTRATED = 0.9
"""Share of a weight's power that lies within the disc, at least."""
_MOST_TAPERS = 12
_FULLEST = 0.4
"""Blocks of less than this share of the largest one's pixels are left out."""
_FEWEST_PIXELS = 64
_RING = 0.3
"""Half width of a ring of the floor, in the logarithm of the wave number."""
_RING_CELLS = 6.0
"""Independent values that a ring holds at least."""
_RADII = 48
_MEDIAN = 0.6
"""A median knows a mean as well as the mean of so many times as few values."""
_MAXIMA = 3.0
"""Maxima of a smooth spectrum exceed those of its independent points: so many times more chances for noise."""


class RippleSettings(Settings):
    """How ripples are looked for."""

    block_px: int = Field(default=32, ge=12, le=64)
    """Regions larger than the square of this are cut into blocks of about this side [pixels]."""
    degree: int = Field(default=3, ge=0, le=6)
    """Degree of the polynomial that is taken off each block first."""
    shortest_um: float | None = Field(default=None, gt=0.0)
    """Shortest wavelength that is looked for; default: 3 pixels [um]."""
    longest_um: float | None = Field(default=None, gt=0.0)
    """Longest one; default: that of 1.5 times the resolution [um]."""
    along_axes: bool = False
    """Whether wave vectors along the raster's axes count, too, where scan lines look like ripples."""


@dataclass(frozen=True)
class Block:
    """A piece of a region: its pixels and weights.

    Attributes:
        rows, columns: of its pixels [pixel].
        tapers: orthonormal weights [taper, pixel].
    """

    rows: np.ndarray
    columns: np.ndarray
    tapers: np.ndarray


@dataclass(frozen=True)
class Blocks:
    """All blocks, and the half width of their weights' spectra [cycles per pixel]."""

    blocks: tuple[Block, ...]
    bandwidth: float

    @property
    def averages(self) -> int:
        """How many independent spectra are averaged."""
        return sum(len(block.tapers) for block in self.blocks)

    @property
    def n_pixels(self) -> int:
        """Pixels of all blocks."""
        return sum(block.rows.size for block in self.blocks)

    @property
    def cells(self) -> float:
        """Independent values in the whole plane of wave vectors: one for each disc."""
        return 1.0 / (math.pi * self.bandwidth**2)


def make_blocks(regions: Sequence[np.ndarray], side: int) -> Blocks:
    """Cut regions into blocks and find their weights.

    Args:
        regions: True inside [y, x].
        side: of a block where a region is larger than its square [pixels].

    Raises:
        GuardError: there are too few pixels.
    """
    pieces = [piece for region in regions for piece in _pieces(region, side)]
    largest = max((rows.size for rows, _ in pieces), default=0)
    if largest < _FEWEST_PIXELS:
        raise GuardError(f"a ripple needs {_FEWEST_PIXELS} or more known pixels side by side, got {largest}")
    pieces = [piece for piece in pieces if piece[0].size >= _FULLEST * largest]
    bandwidth = math.sqrt(_SHANNON / (math.pi * float(np.median([rows.size for rows, _ in pieces]))))
    blocks = []
    for rows, columns in pieces:
        tapers = _slepian(np.stack([rows - rows.min(), columns - columns.min()]).astype(float).tobytes(), bandwidth)
        if len(tapers):
            blocks.append(Block(rows, columns, tapers))
    if not blocks:
        raise GuardError("the regions are too ragged for a spectrum: take larger or fuller ones")
    return Blocks(tuple(blocks), bandwidth)


def _pieces(region: np.ndarray, side: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows and columns of the pieces of a region."""
    rows, columns = np.nonzero(region)
    if rows.size <= side**2:
        return [(rows, columns)] if rows.size else []
    tile = np.zeros(rows.size, int)
    for place in (rows, columns):
        n = max(round(np.ptp(place) / side), 1)
        tile = tile * (n + 1) + np.minimum((place - place.min()) * n // (np.ptp(place) + 1), n - 1)
    return [(rows[tile == t], columns[tile == t]) for t in np.unique(tile)]


@lru_cache(maxsize=64)
def _slepian(places: bytes, bandwidth: float) -> np.ndarray:
    """Return the orthonormal weights of some pixels whose spectra lie best within a disc [taper, pixel].

    Args:
        places: rows and columns [2, pixel], as bytes: blocks of one shape share their weights, which take seconds.
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


@dataclass(frozen=True)
class Spectrum:
    """An averaged power spectrum and its floor; white noise of variance s^2 has the power s^2.

    Attributes:
        kx, ky: wave numbers, increasing [cycles per um].
        power: mean over all weights [ky, kx].
        floor: of that power [ky, kx].
        is_searched: True where a wave may be [ky, kx]: one half of the plane, within limits.
        ring: independent values behind the floor.
        blocks: behind it.
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
        """Return how likely noise alone exceeds a ratio at one of the wave vectors searched."""
        n = self.is_searched.sum() * self.blocks.cells / self.power.size
        averages = self.blocks.averages
        single = float(stats.f.sf(ratio, 2 * averages, 2 * averages * self.ring))
        return float(-np.expm1(max(_MAXIMA * n, 1.0) * np.log1p(-min(single, 1.0 - 1e-15))))

    def floor_at(self, kx: float, ky: float) -> float:
        """Return the floor at the wave vector of the grid nearest to one [cycles per um]."""
        return float(self.floor[np.argmin(np.abs(self.ky - ky)), np.argmin(np.abs(self.kx - kx))])


def take_spectrum(
    fields: Sequence[np.ndarray], blocks: Blocks, steps: tuple[float, float], settings: RippleSettings
) -> Spectrum:
    """Return the averaged spectrum of one field, or of the part along the wave vector of a field of slopes (x, y).

    Args:
        fields: [y, x]; only the blocks' pixels are looked at, less a polynomial.
        blocks: from `make_blocks`.
        steps: pitch along x and y [um].
        settings: range of wavelengths.

    Raises:
        GuardError: no wave vector is left to search.
    """
    width = blocks.bandwidth / steps[0], blocks.bandwidth / steps[1]
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
            f"no wavelength between {shortest:g} and {longest:g} um can be told from the raster's axes with a "
            f"resolution of {1e3 * max(width):.2g} cycles per mm: enlarge the region, or "
            "look along the axes, too (along_axes)"
        )
    floor, ring = _floor(power, k, half, searched, blocks)
    found = Spectrum(kx, ky, power, floor, searched, ring, blocks)
    i, j = np.unravel_index(np.argmax(np.where(searched, found.ratio, -1.0)), power.shape)
    lobe = np.hypot((kx - kx[j]) / width[0], ((ky - ky[i]) / width[1])[:, None]) < 1.5
    if found.false_alarm(float(found.ratio[i, j])) <= 1e-3:  # a wave that is certain is no part of its own floor
        half &= ~lobe
        floor, ring = _floor(power, k, half, searched, blocks)
    if len(fields) == 2:
        floor = floor * _by_direction(power / floor, np.arctan2(ky[:, None], kx), half & (k >= 1.0 / longest), blocks)
    return Spectrum(kx, ky, power, floor, searched, ring, blocks)


def _by_direction(ratio: np.ndarray, theta: np.ndarray, use: np.ndarray, blocks: Blocks) -> np.ndarray:
    """Return the noise of slopes by direction over its mean [ky, kx]: u' S u for a unit wave vector u.

    White noise of two slopes with the covariance S has that power along u, whatever the wave number. S is fitted
    to the ratios, cut at three times their median; where there are too few, noise is taken as equal.
    """
    if use.sum() * blocks.cells / ratio.size < _RING_CELLS:
        return np.ones_like(ratio)
    cut = np.minimum(ratio[use], 3.0 * np.median(ratio[use]))
    basis = np.stack([np.ones_like(theta), np.cos(2.0 * theta), np.sin(2.0 * theta)], -1)
    level, b, c = np.linalg.lstsq(basis[use], cut, rcond=None)[0]
    return np.maximum(1.0 + (basis[..., 1] * b + basis[..., 2] * c) / level, 0.3)


def _power(fields: Sequence[np.ndarray], blocks: Blocks, kx: np.ndarray, ky: np.ndarray) -> np.ndarray:
    """Return the mean power over all weights [ky, kx]."""
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
    """Return the mean of the noise at every wave number [ky, kx], from the median over rings; and what that is worth in
    independent values."""
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
    to_mean = blocks.averages / special.gammaincinv(blocks.averages, 0.5)
    log_all = np.log(np.where(k > 0, k, np.exp(radii[0])))
    floor = np.exp(np.interp(log_all, radii, np.log(np.maximum(floors, 1e-300)))) * to_mean
    return floor, max(_MEDIAN * float(np.median(counts)), 1.0)


def polynomial_basis(block: Block, degree: int) -> np.ndarray:
    """Return an orthonormal basis of the polynomials over a block's pixels [pixel, term]."""
    u, v = (2.0 * (a - a.min()) / max(int(np.ptp(a)), 1) - 1.0 for a in (block.columns, block.rows))
    terms = [u**i * v**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.linalg.qr(np.stack(terms, -1))[0]


def without_trend(field: np.ndarray, blocks: Blocks, degree: int) -> np.ndarray:
    """Return a field less a polynomial on each block; 0 outside all blocks [y, x]."""
    out = np.zeros(field.shape)
    for block in blocks.blocks:
        basis, values = polynomial_basis(block, degree), field[block.rows, block.columns]
        out[block.rows, block.columns] = values - basis @ (basis.T @ values)
    return out
