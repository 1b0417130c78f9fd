"""Error bars of the photometric methods, which have no likelihood: their answer to data and instruments drawn anew.

Each sample is the method's change of the heights when noise, gains, offsets and the apertures' places are drawn from
their deviations; drift and scan lines have been read at the border so well that they hardly count. To it comes one
error of all heights together: what a further correction for shadows and multiple scattering would change, or, where
nothing is corrected, what all that the method leaves out would do once more.

Source: parametric bootstrap: Efron and Tibshirani, An Introduction to the Bootstrap (1993), ch. 6.5; of bias, ch. 10.
"""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import median_filter

from helio_jax.arrays import border_mask
from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.inverse.linear import PhotometricSolution
from helio_jax.inverse.residuals import Prediction
from helio_jax.inverse.samples import on_raster, thinning
from helio_jax.inverse.settings import ReconstructSettings

MAX_PIXELS = 10_000
"""Larger rasters are thinned: every 2nd (4th, ...) row and column stands for the rest."""
MOST_LEFT_OUT = 0.3
"""Largest correction of a datum, in the signal of a facet that faces the aperture: at the foot of a sphere and in a
trench multiple scattering comes near it."""
_ALBEDO_PIXELS = 5
"""Side of the square over which the albedo's median is taken for it [pixels]."""
SEED = 11
"""Of the drawn readings and instruments."""

Solve = Callable[[np.ndarray, np.ndarray, SpotGeometry, int], np.ndarray]
"""(signal, variance [detector, y, x], geometry, pitches between pixels) -> heights [y, x], um."""


def bootstrap_heights(
    signal: np.ndarray,
    variance: np.ndarray,
    geometry: SpotGeometry,
    settings: ReconstructSettings,
    solve: Solve,
) -> np.ndarray:
    """Return what noise and calibration may do to the heights of a method [sample, y, x], um.

    Where the border is flat, every drawn reading is brought to the signal of the flat there, as calibration does: gains
    are not free. Of a thinned raster a pixel stands for stride^2 data, whose noise is less by the stride: heights along
    a path then err as much as on the full one.

    Args:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        geometry: of the stated instrument, whose uncertainty tells how far the apertures may be elsewhere.
        settings: priors (table refine), border, number of samples.
        solve: the method.
    """
    rng = np.random.default_rng(SEED)
    shape = signal.shape[1:]
    stride = thinning(shape, MAX_PIXELS)
    data, spread = (field[:, ::stride, ::stride] for field in (signal, variance))
    height = solve(data, spread, geometry, stride)
    told = geometry.flat_signal()
    drawn = []
    for _ in range(settings.samples):
        other = _drawn_geometry(geometry, rng)
        reading = _drawn_reading(data, np.sqrt(spread) / stride, settings, rng)
        reading = as_at_border(reading, data, settings) * (other.flat_signal() / told)[:, None, None]
        drawn.append(solve(reading, spread, other, stride) - height)
    return on_raster(np.array(drawn), shape, stride)


def as_at_border(data: np.ndarray, told: np.ndarray, settings: ReconstructSettings) -> np.ndarray:
    """Return data times what makes them those of the told at the image's border, if that is flat [detector, y, x]."""
    if settings.border != "flat":
        return data
    frame = border_mask(data.shape[1:], settings.border_fraction)
    flat, mine = (np.nanmedian(d[:, frame], axis=1) for d in (told, data))
    return data * (flat / mine)[:, None, None]


def _drawn_geometry(geometry: SpotGeometry, rng: np.random.Generator) -> SpotGeometry:
    """Return the geometry of an instrument within its uncertainty."""
    sure = geometry.instrument.uncertainty
    aim = np.radians([sure.polar_deg, sure.azimuth_deg]) * rng.standard_normal((len(geometry.rims), 2))
    distance = sure.sample_distance_um * float(rng.standard_normal())
    return SpotGeometry(geometry.instrument.moved(aim, distance)) if aim.any() or distance else geometry


def _drawn_reading(
    data: np.ndarray, noise: np.ndarray, settings: ReconstructSettings, rng: np.random.Generator
) -> np.ndarray:
    """Return data [detector, y, x] as they might have been read, in the same units."""
    s, n = settings.refine, len(data)
    usual = np.nanmedian(data, axis=(1, 2))
    offset = (usual * s.offset_std * rng.standard_normal(n))[:, None, None]
    gain = np.exp(s.gain_std * rng.standard_normal(n))[:, None, None]
    return gain * data + offset + noise * rng.standard_normal(data.shape)


def what_is_left_out(
    solution: PhotometricSolution, used: np.ndarray, near: np.ndarray, prediction: Prediction
) -> np.ndarray:
    """Return by how much the signal of a solution's own surface differs from what the method takes it for.

    Single pixels beside rims come out with any normal and albedo: the latter is a median over neighbours here, and no
    datum differs by more than `MOST_LEFT_OUT` of what a facet that faces the aperture sends it.

    Args:
        solution: normals and albedo of the method [y, x].
        used, near: form factors that the method took, and at the heights that it found [detector, 3, y, x].
        prediction: shadows and multiple scattering of that surface.

    Returns:
        Signal [detector, y, x], in units of the beam.
    """
    albedo = median_filter(np.nan_to_num(solution.albedo), _ALBEDO_PIXELS)
    change = np.einsum("kiyx,yxi->kyx", near - prediction.hidden - used, solution.normals) + prediction.multiple
    most = MOST_LEFT_OUT * np.linalg.norm(used, axis=1)
    return albedo * np.clip(change, -most, most)
