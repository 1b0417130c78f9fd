"""Error bars of the photometric methods, which have no likelihood: their response to drawn data and instruments.

Each sample is the method's change of the heights when noise, gains, offsets and the apertures' places are drawn from
their standard deviations; drift and scan lines are known so well from the border that they hardly count. Here, too: the
signal that a method does not model, for the common-mode errors that `nearfield` adds.

Source: parametric bootstrap: Efron and Tibshirani, An Introduction to the Bootstrap (1993), ch. 6.5; of bias, ch. 10.
"""

from collections.abc import Callable

import jax
import numpy as np
from scipy.ndimage import gaussian_filter, median_filter

from helio_jax.arrays import border_mask, typical_signals
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import Corrections, single_scattering
from helio_jax.geometry_prior import GeometryPrior
from helio_jax.inverse.linear import PhotometricSolution
from helio_jax.inverse.parameters import smooth_images
from helio_jax.inverse.samples import on_raster, thinning
from helio_jax.inverse.settings import ReconstructSettings

MAX_PIXELS = 10_000
"""Larger rasters are thinned: every 2nd (4th, ...) row and column stands for the rest."""
MAX_UNMODELLED = 0.3
"""Largest correction of a datum, in the signal of a facet that faces the aperture: at the foot of a sphere and in a
trench multiple scattering comes near it."""
_ALBEDO_PIXELS = 5
"""Side of the square over which the albedo's median is taken for it [pixels]."""
PATCH = 0.1
"""Standard deviation of the Gaussian that smooths the misfit's amplitude, as a share of the image's side: about the
size of an object's flank. With 0.03 heights beside objects of random families err a third less in the samples."""
SEED = 11
"""Of the drawn readings and instruments."""

Solve = Callable[[np.ndarray, np.ndarray, Optics, int], np.ndarray]
"""(signal, variance [detector, y, x], optics, pitches between pixels) -> heights [y, x], um."""


def bootstrap_heights(
    signal: np.ndarray,
    variance: np.ndarray,
    optics: Optics,
    geometry: GeometryPrior,
    settings: ReconstructSettings,
    solve: Solve,
    misfit: np.ndarray | None = None,
    discrepancy: float = 0.0,
) -> np.ndarray:
    """Draw the errors of a method's heights by noise, calibration, misfit and discrepancy [sample, y, x], um.

    Where the border is flat, every drawn reading is scaled to the substrate's signal there, as calibration does: gains
    are not free. Of a thinned raster a pixel stands for stride^2 data, whose noise is less by the stride: heights along
    a path then err as much as on the full one. Of the misfit each patch of the image (`PATCH`) gets an amplitude of its
    own: what integration does with slopes that are wrong on one side of an object and right on the other.

    Args:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        optics: as stated.
        geometry: how far sample, apertures and beam may be elsewhere.
        settings: priors (table refine), border, number of samples.
        solve: the method.
        misfit: systematic error of the data [detector, y, x], of unknown sign and not everywhere the same share of it;
            NaN where not observed.
        discrepancy: smooth errors of the data, over their median (`Uncertainty.discrepancy`).
    """
    rng, smooth = np.random.default_rng(SEED), np.random.default_rng(SEED + 3)
    patches = np.random.default_rng(SEED + 2)
    shape = signal.shape[1:]
    stride = thinning(shape, MAX_PIXELS)
    data, spread = (field[:, ::stride, ::stride] for field in (signal, variance))
    height = solve(data, spread, optics, stride)
    stated = substrate_signal(optics)
    systematic = None if misfit is None else np.nan_to_num(misfit[:, ::stride, ::stride])
    drawn = []
    for _ in range(settings.samples):
        other = _drawn_optics(optics, geometry, rng)
        reading = _drawn_reading(data, np.sqrt(spread) / stride, settings, rng)
        if systematic is not None:
            reading = reading + patchy_amplitude(height.shape, patches) * systematic
        if discrepancy:
            reading = reading + _drawn_discrepancy(data, discrepancy, settings, smooth)
        reading = rescale_to_border(reading, data, settings) * (substrate_signal(other) / stated)[:, None, None]
        drawn.append(solve(reading, spread, other, stride) - height)
    return on_raster(np.array(drawn), shape, stride)


def rescale_to_border(data: np.ndarray, reference: np.ndarray, settings: ReconstructSettings) -> np.ndarray:
    """Scale each detector so that its median on the flat border equals the reference's [detector, y, x]."""
    if settings.border != "flat":
        return data
    frame = border_mask(data.shape[1:], settings.border_fraction)
    wanted, own = (typical_signals(d[:, None, frame]) for d in (reference, data))
    return data * (wanted / own)[:, None, None]


def patchy_amplitude(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Draw standard-normal amplitudes that are alike within a patch [y, x]: white noise, smoothed by a Gaussian."""
    smooth = gaussian_filter(rng.standard_normal(shape), PATCH * max(shape), mode="wrap")
    return smooth / np.sqrt(np.mean(smooth**2))


def _drawn_optics(optics: Optics, geometry: GeometryPrior, rng: np.random.Generator) -> Optics:
    """Draw the optics of an instrument within its prior."""
    distance, polar, azimuth, incidence = geometry.draw(rng)
    if not (distance or incidence or polar.any() or azimuth.any()):
        return optics
    moves = {"distance": distance, "polar": polar, "azimuth": azimuth} | ({"incidence": incidence} if incidence else {})
    return jax.tree.map(np.asarray, optics.moved(**moves))


def _drawn_reading(
    data: np.ndarray, noise: np.ndarray, settings: ReconstructSettings, rng: np.random.Generator
) -> np.ndarray:
    """Draw data [detector, y, x] as they might have been read, in the same units."""
    s, n = settings.refine, len(data)
    usual = typical_signals(data)
    offset = (usual * s.offset_std * rng.standard_normal(n))[:, None, None]
    gain = np.exp(s.gain_std * rng.standard_normal(n))[:, None, None]
    return gain * data + offset + noise * rng.standard_normal(data.shape)


def _drawn_discrepancy(
    data: np.ndarray, discrepancy: float, settings: ReconstructSettings, rng: np.random.Generator
) -> np.ndarray:
    """Draw smooth errors of data [detector, y, x], as `refine` has them for unknowns."""
    n = settings.refine.discrepancy_modes
    std = discrepancy * typical_signals(data)
    return np.asarray(smooth_images(rng.standard_normal((len(data), n, n)), data.shape[1:], std))


def unmodelled_signal(
    solution: PhotometricSolution, used: np.ndarray, near: np.ndarray, corrections: Corrections
) -> np.ndarray:
    """Compute the systematic signal error of a method [detector, y, x]: near field, masks, multiple scattering.

    Single pixels beside rims come out with any normal and albedo: the latter is a median over neighbours here, and no
    datum differs by more than `MAX_UNMODELLED` of the signal of a facet that faces the aperture.

    Args:
        solution: normals and albedo of the method [y, x].
        used, near: form factors that the method took, and at the heights that it found [detector, 3, y, x].
        corrections: masks and multiple scattering of that surface.

    Returns:
        Signal in units of the beam.
    """
    albedo = median_filter(np.nan_to_num(solution.albedo), _ALBEDO_PIXELS)
    normal = np.moveaxis(solution.normals, -1, 0)
    change = single_scattering(near - corrections.masked - used, normal) + corrections.multiple
    most = MAX_UNMODELLED * np.linalg.norm(used, axis=1)
    return albedo * np.clip(change, -most, most)
