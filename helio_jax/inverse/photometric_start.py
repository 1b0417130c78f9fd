"""Surfaces that a fit starts from: photometric solutions, corrected by masks and multiple scattering predicted on them.

With gains and albedo as stated, two slopes are solved from all images of a pixel, again on every solution. Where they
are not known well, what they do to the signal becomes relief: about the measured sphere A a moat of 280 um. Then the
solution with an albedo of its own in every pixel (`albedo_search`) is a start, too. Where the level of a flat border
shows that they are off, the signals are divided by that level first.
"""

import numpy as np

from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface, slopes_of_normal
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.backtracking import with_backtracking
from helio_jax.inverse.border_level import levelled_signal
from helio_jax.inverse.integrate import integrate_slopes
from helio_jax.inverse.linear import PhotometricSolution, solve_known_albedo
from helio_jax.inverse.nearfield import level, limited, solve_nearfield
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import Predict, multiple_in_normal, prediction_std
from helio_jax.micrograph import MicrographStack


def _corrected(stack, settings, patches: AlbedoPatches, surface: Surface, normals: np.ndarray, predict) -> Surface:
    """Solve photometrically with the albedo of patches and the corrections predicted on a surface."""
    signal, variance = (f / patches.albedo**n for n, f in enumerate(levelled_signal(stack, settings, patches), 1))
    optics, raster = Optics.of(stack.instrument), Raster.of(stack)
    corrections = predict(surface.height, normals, **patches.known)
    sigma = prediction_std(corrections, normals, settings.refine)
    slope, multiple = multiple_in_normal(corrections, normals, optics)
    visible = form_factor(optics, surface.height) - corrections.masked
    visible[:, 2] -= slope
    spread = variance + sigma**2
    (a, b), _ = solve_known_albedo(signal - multiple, spread, visible, normals, stack.instrument.beam_shift)
    weight = np.ones(stack.shape[1:])
    height = integrate_slopes(a, b, raster.dx, raster.dy, "weighted", weight)
    return Surface(limited(level(height, settings, weight), optics), a, b)


def start_of_known_albedo(
    stack: MicrographStack, settings: ReconstructSettings, patches: AlbedoPatches, predict: Predict
) -> tuple[Surface, Surface]:
    """Find the photometric solution of known gains and albedo, and a smoother one."""
    optics, raster, shift = Optics.of(stack.instrument), Raster.of(stack), stack.instrument.beam_shift
    levelled = levelled_signal(stack, settings, patches)
    height, solution = solve_nearfield(*levelled, optics, raster, settings, settings.rounds)

    def correct(surface: Surface) -> Surface:
        return _corrected(stack, settings, patches, surface, surface.normals(shift), predict)

    smoothed = Surface(*np.zeros((3, *height.shape)))
    try:
        near = Surface(limited(height, optics), *np.zeros((2, *height.shape)))
        start = _corrected(stack, settings, patches, near, solution.normals, predict)
    except PredictionError:
        start = correct(smoothed)
    for _ in range(settings.refine.photometric_rounds - 1):
        start, smoothed = with_backtracking(correct, start, smoothed)
    return start, smoothed


def start_of_free_albedo(stack: MicrographStack, height: np.ndarray, solution: PhotometricSolution) -> Surface:
    """Make a start of heights [y, x], um, and the photometric solution that they follow."""
    slope_x, slope_y, _ = slopes_of_normal(solution.normals, stack.instrument.beam_shift)
    return Surface(limited(height, Optics.of(stack.instrument)), slope_x, slope_y)
