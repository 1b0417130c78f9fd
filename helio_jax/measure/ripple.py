"""Ripples: a wave on a surface or in a micrograph; wavelength, direction and amplitude with errors, and how sure it is.

Heights are looked at through their slopes along the wave: there the noise of photometric heights is nearly white, and
the large shape does not leak into the spectrum. A peak is told by its ratio to the floor (`spectrum`) and by the
probability that noise alone shows such a peak anywhere in the searched range. The wave itself is then fitted by least
squares, one wave vector for all blocks, each block with its own amplitude, phase and polynomial. Errors are those of
plane waves in the floor's noise: a ripple that bends or changes its wavelength is less well described than they say.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import ndimage, optimize, stats

from helio_jax.arrays import pitch
from helio_jax.errors import GuardError, SceneError
from helio_jax.measure.spectrum import (
    Blocks,
    RippleSettings,
    Spectrum,
    make_blocks,
    polynomial_basis,
    take_spectrum,
    without_trend,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

Pair = tuple[float, float]
_SURE = 1e-3
_UNLIKELY = 1e-2
"""What is less likely than this is taken for no accident: that there is a wave; that detectors disagree so much."""


@dataclass(frozen=True)
class Ripple:
    """A wave a cos(2 pi (kx x + ky y) + phase); the amplitude is the root mean square over the regions.

    Attributes:
        wavelength_um, wavelength_std_um: distance of its crests on the plane z = 0, and standard deviation.
        direction_deg, direction_std_deg: of the wave vector from +x, counter-clockwise, -90 to 90.
        amplitude, amplitude_std: a, half of crest to trough; `unit`.
        unit: of the amplitude.
        raster_k: wave vector in beam positions [cycles per um].
        axis_angle_deg: between the wave vector in beam positions and the nearer axis of the raster.
        peak_over_floor: ratio of powers.
        false_alarm: how likely noise alone shows such a ratio anywhere in the searched range.
        averages: how many spectra were averaged.
        resolution_um: what a wave number is resolved to, as the wavelength that it is a wave number of.
        n_pixels: pixels behind it.
    """

    wavelength_um: float
    wavelength_std_um: float
    direction_deg: float
    direction_std_deg: float
    amplitude: float
    amplitude_std: float
    unit: str
    raster_k: Pair
    axis_angle_deg: float
    peak_over_floor: float
    false_alarm: float
    averages: int
    resolution_um: float
    n_pixels: int

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        return asdict(self)


def height_ripple(
    rec: Reconstruction, regions: Sequence[np.ndarray], settings: RippleSettings | None = None
) -> tuple[Ripple, Spectrum, np.ndarray]:
    """Find the strongest ripple of a height map.

    Args:
        rec: heights; invalid pixels, and those beside them, take no part. Where only a region's level floats, they do:
            slopes know nothing of it.
        regions: True inside [y, x].
        settings: blocks, range of wavelengths.

    Returns:
        The ripple (amplitude in um along z; wavelength on the plane z = 0, corrected for oblique incidence on the
        regions' mean slope), its spectrum, and the slopes' component along the wave vector, without trend [y, x].

    Raises:
        GuardError: too little is known, or the spectrum has no peak.
    """
    settings = settings or RippleSettings()
    steps = pitch(rec.raster_x), pitch(rec.raster_y)
    shown = rec.has_relief
    known = ndimage.binary_erosion(shown & np.isfinite(rec.height))
    rows, columns = np.gradient(np.where(np.isfinite(rec.height), rec.height, 0.0), steps[1], steps[0])
    inside = [known & region for region in regions]
    blocks = make_blocks(inside, settings.block_px)
    slopes = [without_trend(s, blocks, settings.degree) for s in (columns, rows)]
    spectrum = take_spectrum(slopes, blocks, steps, settings)
    start, ratio = _peak(spectrum)
    unit = np.array(start) / math.hypot(*start)
    along = unit[0] * slopes[0] + unit[1] * slopes[1]
    fit = _fit_wave(along, spectrum, start, steps, settings.degree)
    # a central difference passes sin(2 pi k step) / step instead of 2 pi k
    passed = sum(u * math.sin(2.0 * math.pi * ki * step) / step for u, ki, step in zip(unit, fit.k, steps, strict=True))
    together = np.any(inside, axis=0)
    to_sample = np.eye(2) - np.outer(rec.instrument.beam_shift, (columns[together].mean(), rows[together].mean()))
    scale = abs(passed) * abs(float(np.linalg.det(to_sample)))  # x = X - h tan t: along z the wave is higher than seen
    return _ripple(spectrum, fit, ratio, scale, "um", to_sample, steps), spectrum, along


def image_spectra(
    stack: MicrographStack, regions: Sequence[np.ndarray], settings: RippleSettings | None = None
) -> dict[str, Spectrum]:
    """Return the spectrum of every micrograph of a stack over some regions, by the detector's name."""
    settings, steps = settings or RippleSettings(), (pitch(stack.x), pitch(stack.y))
    images = zip(stack.instrument.detector_names, stack.signal, stack.is_observed, strict=True)
    return {name: _image_spectrum(signal, steps, seen, regions, settings)[0] for name, signal, seen in images}


def _image_spectrum(
    signal: np.ndarray,
    steps: tuple[float, float],
    seen: np.ndarray,
    regions: Sequence[np.ndarray],
    settings: RippleSettings,
) -> tuple[Spectrum, np.ndarray]:
    """Return the spectrum of a detector's signal where it is `seen` [y, x], and its field without trend."""
    blocks = make_blocks([seen & region for region in regions], settings.block_px)
    field = without_trend(np.where(seen, signal, 0.0), blocks, settings.degree)
    return take_spectrum([field], blocks, steps, settings), field


def image_ripple(
    stack: MicrographStack, detector: int, regions: Sequence[np.ndarray], settings: RippleSettings | None = None
) -> Ripple:
    """Return the strongest ripple of a micrograph, in beam positions; its amplitude is in the stack's unit.

    Raises:
        GuardError: as `height_ripple`.
    """
    settings, steps = settings or RippleSettings(), (pitch(stack.x), pitch(stack.y))
    spectrum, field = _image_spectrum(stack.signal[detector], steps, stack.is_observed[detector], regions, settings)
    start, ratio = _peak(spectrum)
    fit = _fit_wave(field, spectrum, start, steps, settings.degree)
    return _ripple(spectrum, fit, ratio, 1.0, stack.unit, np.eye(2), steps)


@dataclass(frozen=True)
class Agreement:
    """How a wave shows in the micrographs, and whether these agree with a wave of the surface.

    Attributes:
        shares, shares_std: amplitude over the mean signal, by detector, root mean square over the regions.
        expected: the same of the wave of the surface that fits all detectors best.
        amplitude_um: of that wave, from the micrographs alone.
        false_alarm: how likely noise alone makes such a wave of the surface at this wave vector.
        misfit: how likely noise alone makes the detectors disagree as much with that wave.
    """

    shares: dict[str, float]
    shares_std: dict[str, float]
    expected: dict[str, float]
    amplitude_um: float
    false_alarm: float
    misfit: float

    @property
    def verdict(self) -> str:
        """What the micrographs say, in words."""
        if self.false_alarm > _SURE:
            return "the micrographs do not show it: noise, or left by the reconstruction"
        if self.misfit < _UNLIKELY:
            return (
                "NOT a wave of the surface alone: the detectors disagree (albedo, masks, drift, or one detector's own)"
            )
        return "the detectors agree with a wave of the surface"


def compare_with_images(
    stack: MicrographStack, ripple: Ripple, regions: Sequence[np.ndarray], settings: RippleSettings | None = None
) -> Agreement:
    """Ask the micrographs whether a ripple is one of the surface: amplitudes and phases in all detectors.

    To first order a slope e along the unit vector u changes the signal by -e u.d / d_z, with the direction d to the
    middle of the aperture, taken from the reference plane. What one detector alone sees, be it drift, a scan line or a
    change of its mask, does not fit.

    Args:
        stack: calibrated, on the ripple's raster.
        ripple: from `height_ripple`.
        regions: as there.
        settings: as there.

    Raises:
        SceneError: the stack is not calibrated, or of another raster.
    """
    settings, steps = settings or RippleSettings(), (pitch(stack.x), pitch(stack.y))
    if stack.n_rays is None:
        raise SceneError(f"{stack.name}: its background is not known: give the file that helio calibrate wrote")
    if stack.shape[1:] != regions[0].shape:
        raise SceneError(
            f"{stack.name} has {stack.shape[2]} x {stack.shape[1]} pixels, the height map {regions[0].shape[1]} x "
            f"{regions[0].shape[0]}: give the micrographs that it was made of"
        )
    every = np.all(stack.is_observed, axis=0)
    unit = np.array(ripple.raster_k) / math.hypot(*ripple.raster_k)
    waves, noises, response = [], [], []
    for signal, direction in zip(stack.signal, stack.instrument.directions(), strict=True):
        spectrum, field = _image_spectrum(signal, steps, every, regions, settings)
        blocks = spectrum.blocks
        n = np.array([b.rows.size for b in blocks.blocks])
        mean = np.array([signal[b.rows, b.columns].mean() for b in blocks.blocks])
        waves.append(_complex_amplitudes(field, blocks, ripple.raster_k, steps, settings.degree) / mean)
        noises.append(2.0 * spectrum.floor_at(*ripple.raster_k) / n / mean**2)
        response.append(-float(unit @ direction))
    z, variance, r = np.array(waves), np.array(noises), np.array(response)[:, None]
    slope = np.sum(r * z / variance, 0) / np.sum(r**2 / variance, 0)
    rms = lambda a: np.sqrt(np.sum(np.abs(a) ** 2 * n, -1) / n.sum())  # noqa: E731
    names = stack.instrument.detector_names
    return Agreement(
        dict(zip(names, rms(z).tolist(), strict=True)),
        dict(zip(names, np.sqrt(np.sum(variance * n**2, -1) / n.sum() ** 2).tolist(), strict=True)),
        dict(zip(names, rms(slope * r).tolist(), strict=True)),
        float(rms(slope)) / (2.0 * math.pi * math.hypot(*ripple.raster_k)),
        float(stats.chi2.sf(np.sum(np.abs(slope * r) ** 2 / variance), 2 * len(n))),
        float(stats.chi2.sf(np.sum(np.abs(z - slope * r) ** 2 / variance), 2 * (len(names) - 1) * len(n))),
    )


def _complex_amplitudes(field: np.ndarray, blocks: Blocks, k: Pair, steps: Pair, degree: int) -> np.ndarray:
    """Return a - i b of a cos + b sin of a wave vector in every block [block]."""
    bases = [polynomial_basis(block, degree) for block in blocks.blocks]
    return np.array([complex(a, -b) for _, (a, b) in _in_blocks(field, blocks, bases, k, steps)])


def _in_blocks(
    field: np.ndarray, blocks: Blocks, bases: Sequence[np.ndarray], k: Pair, steps: Pair
) -> list[tuple[float, np.ndarray]]:
    """Return the sum of squares that a wave explains beside polynomials (`bases`), and its factors, in every block."""
    out = []
    for block, basis in zip(blocks.blocks, bases, strict=True):
        values = field[block.rows, block.columns]
        phase = 2.0 * np.pi * (k[0] * steps[0] * block.columns + k[1] * steps[1] * block.rows)
        wave = np.stack([np.cos(phase), np.sin(phase)], -1)
        wave -= basis @ (basis.T @ wave)
        factors = np.linalg.solve(wave.T @ wave, wave.T @ values)
        out.append((float(factors @ (wave.T @ values)), factors))
    return out


def _peak(spectrum: Spectrum) -> tuple[Pair, float]:
    """Return wave vector and ratio of the highest maximum of the ratio.

    Raises:
        GuardError: there is no maximum.
    """
    is_top = spectrum.power == ndimage.maximum_filter(spectrum.power, 3, mode="wrap")
    candidates = np.where(is_top & spectrum.is_searched, spectrum.ratio, -1.0)
    i, j = (int(v) for v in np.unravel_index(np.argmax(candidates), candidates.shape))
    if candidates[i, j] <= 0.0:
        raise GuardError(
            "the spectrum has no maximum in the searched range: allow other wavelengths (shortest_um, longest_um)"
        )
    return (float(spectrum.kx[j]), float(spectrum.ky[i])), float(candidates[i, j])


@dataclass(frozen=True)
class _Wave:
    """A fitted wave vector, its covariance [2, 2] (cycles per um), amplitude of the field and its deviation."""

    k: Pair
    covariance: np.ndarray
    size: float
    size_std: float


def _fit_wave(field: np.ndarray, spectrum: Spectrum, start: Pair, steps: Pair, degree: int) -> _Wave:
    """Fit one wave vector to all blocks by least squares, each with its own amplitude, phase and polynomial.

    Source: least squares; the noise is the spectrum's floor there. tests/unit/test_ripple.py.
    """
    blocks = spectrum.blocks
    bases = [polynomial_basis(block, degree) for block in blocks.blocks]
    width = np.array([blocks.bandwidth / step for step in steps])

    def total(u: np.ndarray) -> float:
        kx, ky = np.array(start) + u * width
        return -sum(squares for squares, _ in _in_blocks(field, blocks, bases, (kx, ky), steps))

    grid = [np.array([a, b]) for a in np.linspace(-1, 1, 9) for b in np.linspace(-1, 1, 9) if a * a + b * b <= 1]
    best = min(grid, key=total)
    best = optimize.minimize(total, best, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 0.0, "maxiter": 200}).x
    h = 0.05
    e = np.eye(2) * h
    bend = np.array(
        [
            [total(best + a + b) - total(best + a - b) - total(best - a + b) + total(best - a - b) for b in e]
            for a in e
        ]
    ) / (4 * h * h)  # fmt: skip
    k = np.array(start) + best * width
    noise, n = spectrum.floor_at(k[0], k[1]), blocks.n_pixels
    covariance = 2.0 * noise * np.linalg.pinv(bend) * np.outer(width, width)
    square = 2.0 * (-total(best) - 2.0 * noise * len(blocks.blocks)) / n
    return _Wave((float(k[0]), float(k[1])), covariance, math.sqrt(max(square, 0.0)), math.sqrt(2.0 * noise / n))


def _ripple(
    spectrum: Spectrum, fit: _Wave, ratio: float, passed: float, unit: str, to_sample: np.ndarray, steps: Pair
) -> Ripple:
    """Return a ripple from its fit.

    Args:
        spectrum: with the peak.
        fit: in beam positions.
        ratio: peak over floor.
        passed: field per amplitude.
        unit: of the amplitude.
        to_sample: d(x, y) / d(X, Y) [2, 2].
        steps: pitch along x and y [um].
    """
    back = np.linalg.inv(to_sample).T
    kx, ky = back @ np.array(fit.k)
    covariance = back @ fit.covariance @ back.T
    length = math.hypot(kx, ky)
    along, across = np.array([kx, ky]) / length, np.array([-ky, kx]) / length
    angle = math.degrees(math.atan2(fit.k[1], fit.k[0])) % 90.0
    return Ripple(
        wavelength_um=float(1.0 / length),
        wavelength_std_um=float(math.sqrt(max(along @ covariance @ along, 0.0)) / length**2),
        direction_deg=math.degrees(math.atan(ky / kx)) if kx else 90.0,
        direction_std_deg=math.degrees(math.sqrt(max(across @ covariance @ across, 0.0)) / length),
        amplitude=fit.size / passed,
        amplitude_std=fit.size_std / passed,
        unit=unit,
        raster_k=fit.k,
        axis_angle_deg=min(angle, 90.0 - angle),
        peak_over_floor=ratio,
        false_alarm=spectrum.false_alarm(ratio),
        averages=spectrum.blocks.averages,
        resolution_um=max(steps) / spectrum.blocks.bandwidth,
        n_pixels=spectrum.blocks.n_pixels,
    )
