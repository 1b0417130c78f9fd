"""Ripples: a plane wave on a surface; wavelength, direction, amplitude, their errors, and a false-alarm probability.

The spectrum is that of the slopes along the wave vector: the noise of photometric slopes is nearly white, and the large
shape leaks little into it. A peak is judged by its ratio to the noise floor (`spectrum`). The wave is then fitted by
least squares: one wave vector for all blocks, an amplitude, phase and polynomial for each block. The errors hold for
plane waves in noise of that floor; they are too small for a ripple that bends or changes its wavelength.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize, stats

from helio_jax.arrays import pitch
from helio_jax.errors import GuardError
from helio_jax.measure.regions import check_micrographs
from helio_jax.measure.spectrum import Blocks, RippleSettings, Spectrum, make_blocks, take_spectrum, without_trend
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

Pair = tuple[float, float]
_DETECTED = 1e-3
"""False-alarm probability below which the micrographs show the wave."""
_INCONSISTENT = 1e-2
"""Probability of the misfit below which the detectors disagree."""


@dataclass(frozen=True)
class Ripple:
    """A wave a cos(2 pi (kx x + ky y) + phase); the amplitude is the root mean square over the regions.

    Attributes:
        wavelength_um, wavelength_std_um: distance of its crests on the substrate plane, and standard deviation.
        direction_deg, direction_std_deg: of the wave vector from +x, counter-clockwise, -90 to 90.
        amplitude, amplitude_std: a, half of crest to trough [um].
        raster_k: wave vector in beam positions [cycles per um].
        axis_angle_deg: between the wave vector in beam positions and the nearer axis of the raster.
        peak_over_floor: ratio of powers.
        false_alarm: probability that noise alone shows such a ratio anywhere in the searched range.
        averages: number of averaged spectra.
        resolution_um: inverse of the resolution in wave number.
        n_pixels: pixels of all blocks.
    """

    wavelength_um: float
    wavelength_std_um: float
    direction_deg: float
    direction_std_deg: float
    amplitude: float
    amplitude_std: float
    raster_k: Pair
    axis_angle_deg: float
    peak_over_floor: float
    false_alarm: float
    averages: int
    resolution_um: float
    n_pixels: int


def height_ripple(
    rec: Reconstruction, regions: Sequence[np.ndarray], settings: RippleSettings = RippleSettings()
) -> tuple[Ripple, Spectrum, np.ndarray]:
    """Find the strongest ripple of a height map.

    Args:
        rec: heights; invalid pixels and their neighbours are excluded. Regions whose level floats are included: slopes
            do not depend on the level.
        regions: True inside [y, x].
        settings: range of wavelengths.

    Returns:
        The ripple (amplitude along z; wavelength on the substrate plane, corrected for oblique incidence on the
        regions' mean slope), its spectrum, and the slopes along the wave vector, without trend [y, x].

    Raises:
        GuardError: too few heights are known, or the spectrum has no peak.
    """
    steps = pitch(rec.raster_x), pitch(rec.raster_y)
    known = ndimage.binary_erosion(rec.has_relief & np.isfinite(rec.height))
    rows, columns = np.gradient(np.where(np.isfinite(rec.height), rec.height, 0.0), steps[1], steps[0])
    inside = [known & region for region in regions]
    blocks = make_blocks(inside, steps)
    slopes = [without_trend(s, blocks) for s in (columns, rows)]
    spectrum = take_spectrum(slopes, blocks, settings)
    start, ratio = _peak(spectrum)
    unit = np.array(start) / math.hypot(*start)
    along = unit[0] * slopes[0] + unit[1] * slopes[1]
    raster_k, covariance, size, size_std = _fit_wave(along, spectrum, start)
    # a central difference passes sin(2 pi k step) / step instead of 2 pi k
    passed = sum(u * math.sin(2.0 * math.pi * k * s) / s for u, k, s in zip(unit, raster_k, steps, strict=True))
    together = np.any(inside, axis=0)
    to_sample = np.eye(2) - np.outer(rec.instrument.beam_shift, (columns[together].mean(), rows[together].mean()))
    scale = abs(passed) * abs(float(np.linalg.det(to_sample)))  # x = X - h tan t: the wave is higher along z
    back = np.linalg.inv(to_sample).T
    kx, ky = back @ np.array(raster_k)
    covariance = back @ covariance @ back.T
    length = math.hypot(kx, ky)
    to_crest, across = np.array([kx, ky]) / length, np.array([-ky, kx]) / length
    angle = math.degrees(math.atan2(raster_k[1], raster_k[0])) % 90.0
    ripple = Ripple(
        wavelength_um=float(1.0 / length),
        wavelength_std_um=float(math.sqrt(max(to_crest @ covariance @ to_crest, 0.0)) / length**2),
        direction_deg=math.degrees(math.atan(ky / kx)) if kx else 90.0,
        direction_std_deg=math.degrees(math.sqrt(max(across @ covariance @ across, 0.0)) / length),
        amplitude=size / scale,
        amplitude_std=size_std / scale,
        raster_k=raster_k,
        axis_angle_deg=min(angle, 90.0 - angle),
        peak_over_floor=ratio,
        false_alarm=spectrum.false_alarm(ratio),
        averages=blocks.averages,
        resolution_um=max(steps) / blocks.bandwidth,
        n_pixels=blocks.n_pixels,
    )
    return ripple, spectrum, along


def image_spectra(
    stack: MicrographStack, regions: Sequence[np.ndarray], settings: RippleSettings = RippleSettings()
) -> dict[str, Spectrum]:
    """Compute the spectrum of every micrograph over some regions, by the detector's name."""
    images = zip(stack.instrument.detector_names, stack.signal, stack.is_observed, strict=True)
    return {name: _image_spectrum(stack, signal, seen, regions, settings)[0] for name, signal, seen in images}


def _image_spectrum(
    stack: MicrographStack,
    signal: np.ndarray,
    seen: np.ndarray,
    regions: Sequence[np.ndarray],
    settings: RippleSettings,
) -> tuple[Spectrum, np.ndarray]:
    """Compute the spectrum of a signal where it is `seen` [y, x], and return the signal without trend."""
    blocks = make_blocks([seen & region for region in regions], (pitch(stack.x), pitch(stack.y)))
    field = without_trend(np.where(seen, signal, 0.0), blocks)
    return take_spectrum([field], blocks, settings), field


@dataclass(frozen=True)
class MicrographCheck:
    """Signal of a wave in the micrographs, tested against a wave of the surface.

    Attributes:
        shares, shares_std: amplitude over the mean signal, by detector, root mean square over the regions.
        expected: the same for the surface wave that fits all detectors best.
        amplitude_um: of that surface wave, from the micrographs alone.
        false_alarm: probability that noise alone makes such a surface wave at this wave vector.
        misfit: probability that noise alone makes the detectors disagree as much with that wave.
    """

    shares: dict[str, float]
    shares_std: dict[str, float]
    expected: dict[str, float]
    amplitude_um: float
    false_alarm: float
    misfit: float

    @property
    def verdict(self) -> str:
        """Conclusion in words."""
        if self.false_alarm > _DETECTED:
            return "the micrographs do not show the wave: noise, or an artefact of the reconstruction"
        if self.misfit < _INCONSISTENT:
            return "NOT a wave of the surface alone: the detectors disagree (albedo, masking, drift, or one detector)"
        return "the detectors agree with a wave of the surface"


def compare_with_images(
    stack: MicrographStack, ripple: Ripple, regions: Sequence[np.ndarray], settings: RippleSettings = RippleSettings()
) -> MicrographCheck:
    """Test whether all micrographs show a ripple with the amplitudes and phases of a surface wave.

    To first order a slope e along the unit vector u changes the relative signal by -e u.d / d_z, with the direction d
    from the substrate plane to the middle of the aperture. Drift, scan lines or masking in one detector do not fit.

    Args:
        stack: calibrated, on the ripple's raster.
        ripple: from `height_ripple`.
        regions, settings: as for `height_ripple`.

    Raises:
        SceneError: the stack is not calibrated, or on another raster.
    """
    check_micrographs(stack, regions[0].shape)
    every = np.all(stack.is_observed, axis=0)
    unit = np.array(ripple.raster_k) / math.hypot(*ripple.raster_k)
    waves, noises = [], []
    for signal in stack.signal:
        spectrum, field = _image_spectrum(stack, signal, every, regions, settings)
        blocks = spectrum.blocks
        n = np.array([b.rows.size for b in blocks.blocks])
        mean = np.array([signal[b.rows, b.columns].mean() for b in blocks.blocks])
        waves.append(np.array([complex(a, -b) for _, (a, b) in _fit_blocks(field, blocks, ripple.raster_k)]) / mean)
        noises.append(2.0 * spectrum.floor_at(*ripple.raster_k) / n / mean**2)
    z, variance = np.array(waves), np.array(noises)
    r = np.array([[-float(unit @ d)] for d in stack.instrument.directions()])
    slope = np.sum(r * z / variance, 0) / np.sum(r**2 / variance, 0)
    rms = lambda a: np.sqrt(np.sum(np.abs(a) ** 2 * n, -1) / n.sum())  # noqa: E731
    names = stack.instrument.detector_names
    return MicrographCheck(
        dict(zip(names, rms(z).tolist(), strict=True)),
        dict(zip(names, np.sqrt(np.sum(variance * n**2, -1) / n.sum() ** 2).tolist(), strict=True)),
        dict(zip(names, rms(slope * r).tolist(), strict=True)),
        float(rms(slope)) / (2.0 * math.pi * math.hypot(*ripple.raster_k)),
        float(stats.chi2.sf(np.sum(np.abs(slope * r) ** 2 / variance), 2 * len(n))),
        float(stats.chi2.sf(np.sum(np.abs(z - slope * r) ** 2 / variance), 2 * (len(names) - 1) * len(n))),
    )


def _fit_blocks(field: np.ndarray, blocks: Blocks, k: Pair) -> list[tuple[float, np.ndarray]]:
    """Fit a cos + b sin of a wave vector to every block: the explained sum of squares, and (a, b)."""
    out = []
    for block in blocks.blocks:
        phase = 2.0 * np.pi * (k[0] * blocks.steps[0] * block.columns + k[1] * blocks.steps[1] * block.rows)
        wave = block.detrend(np.stack([np.cos(phase), np.sin(phase)], -1))
        projected = wave.T @ field[block.rows, block.columns]
        factors = np.linalg.solve(wave.T @ wave, projected)
        out.append((float(factors @ projected), factors))
    return out


def _peak(spectrum: Spectrum) -> tuple[Pair, float]:
    """Find the wave vector of the highest local maximum of power over floor, and that ratio.

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


def _fit_wave(field: np.ndarray, spectrum: Spectrum, start: Pair) -> tuple[Pair, np.ndarray, float, float]:
    """Fit one wave vector to all blocks by least squares, with amplitude, phase and polynomial for each block.

    Returns:
        Wave vector, its covariance [2, 2] (cycles per um), amplitude of the field, its deviation.

    Source: least squares; the noise is the spectrum's floor there. tests/unit/test_ripple.py.
    """
    blocks, width = spectrum.blocks, np.array(spectrum.blocks.widths)

    def cost(u: np.ndarray) -> float:
        kx, ky = np.array(start) + u * width
        return -sum(squares for squares, _ in _fit_blocks(field, blocks, (kx, ky)))

    grid = [np.array([a, b]) for a in np.linspace(-1, 1, 9) for b in np.linspace(-1, 1, 9) if a * a + b * b <= 1]
    options = {"xatol": 1e-4, "fatol": 0.0, "maxiter": 200}
    best = optimize.minimize(cost, min(grid, key=cost), method="Nelder-Mead", options=options).x
    h = 0.05
    e = np.eye(2) * h
    second = [[cost(best + a + b) - cost(best + a - b) - cost(best - a + b) + cost(best - a - b) for b in e] for a in e]
    hessian = np.array(second) / (4 * h * h)
    k = np.array(start) + best * width
    noise, n = spectrum.floor_at(k[0], k[1]), blocks.n_pixels
    covariance = 2.0 * noise * np.linalg.pinv(hessian) * np.outer(width, width)
    square = 2.0 * (-cost(best) - 2.0 * noise * len(blocks.blocks)) / n
    return (float(k[0]), float(k[1])), covariance, math.sqrt(max(square, 0.0)), math.sqrt(2.0 * noise / n)
