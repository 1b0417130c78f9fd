"""The patches of a measurement: those of its photometric solution, corrected for masks and multiple scattering."""

from typing import NamedTuple

import numpy as np

from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import Corrections
from helio_jax.inverse.albedo_patches import AlbedoPatches, find_albedo_patches
from helio_jax.inverse.bootstrap import unmodelled_signal
from helio_jax.inverse.border_level import levelled_signal
from helio_jax.inverse.linear import PhotometricSolution
from helio_jax.inverse.nearfield import limited, solve_nearfield
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import Predict, prediction_std
from helio_jax.micrograph import MicrographStack

CORRECTIONS = 2
"""How often masks and multiple scattering are predicted: the first time with the albedo that they change."""


class AlbedoSearch(NamedTuple):
    """What a photometric solution with an albedo of its own in every pixel shows.

    Attributes:
        patches: of other albedo.
        height: of the solution [y, x], um.
        solution: albedo and normals.
        is_corrected: whether masks and multiple scattering could be predicted and were subtracted.
    """

    patches: AlbedoPatches
    height: np.ndarray
    solution: PhotometricSolution
    is_corrected: bool = True


def albedo_std(solution: PhotometricSolution, variance: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Compute the standard deviation of the logarithm of a photometric solution's albedo [y, x].

    That of the vector albedo x normal along the normal, over the albedo; infinite where there is no solution.

    Args:
        solution: albedo and normals [y, x].
        variance: of the data, NaN where not observed [detector, y, x].
        phi: form factors [detector, 3, y, x].
    """
    weight = np.where(np.isfinite(variance), 1.0 / np.where(np.isfinite(variance), variance, 1.0), 0.0)
    information = np.einsum("kyx,kiyx,kjyx->yxij", weight, phi, phi)
    scale = np.trace(information, axis1=-2, axis2=-1)
    scale = np.where(scale > 0.0, scale, 1.0)
    answer = np.linalg.solve(information / scale[..., None, None] + 1e-12 * np.eye(3), solution.normals[..., None])
    along = np.einsum("yxi,yxi->yx", solution.normals, answer[..., 0]) / scale
    is_solved = np.isfinite(solution.albedo) & (solution.albedo > 0.0)
    return np.where(is_solved, np.sqrt(along) / np.where(is_solved, solution.albedo, 1.0), np.inf)


def search_albedo_patches(stack: MicrographStack, settings: ReconstructSettings, predict: Predict) -> AlbedoPatches:
    """Find the patches of other albedo in micrographs; none where masks and multiple scattering are not predictable."""
    return search_albedo(stack, settings, predict).patches


def search_albedo(stack: MicrographStack, settings: ReconstructSettings, predict: Predict) -> AlbedoSearch:
    """Solve for heights and the albedo of every pixel, and find the patches of other albedo.

    Args:
        stack: micrographs.
        settings: of the reconstruction.
        predict: predicts masks and multiple scattering.
    """
    optics, raster = Optics.of(stack.instrument), Raster.of(stack)
    signal, variance = levelled_signal(stack, settings, is_albedo_known=False)
    height, solution = solve_nearfield(signal, variance, optics, raster, settings, settings.rounds)
    border = settings.border_fraction if settings.border == "flat" else None
    patches = AlbedoPatches.none(height.shape)
    for _ in range(CORRECTIONS):
        near = limited(height, optics)
        try:
            found = predict(near, solution.normals, **patches.known)
        except PredictionError:
            return AlbedoSearch(AlbedoPatches.none(height.shape), height, solution, False)
        multiple = settings.refine.multiple_error * found.multiple if stack.is_without_multiple else found.multiple
        phi = form_factor(optics, near)
        rest = unmodelled_signal(solution, phi, phi, Corrections(found.masked, multiple))
        sigma = prediction_std(found, solution.normals, settings.refine) * patches.albedo
        spread = variance + sigma**2
        height, solution = solve_nearfield(signal - rest, spread, optics, raster, settings, settings.rounds)
        std = albedo_std(solution, spread, form_factor(optics, limited(height, optics)))
        with np.errstate(invalid="ignore", divide="ignore"):
            patches = find_albedo_patches(np.log(solution.albedo), std, border)
    return AlbedoSearch(patches, height, solution)
