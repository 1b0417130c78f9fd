"""How well one surface explains all images: a quick test of whether images and geometry belong together.

With three detectors the photometric solution fits every pixel exactly, whatever the geometry. But its slopes must be
those of a surface: they are integrated to heights, the heights give slopes again, and these predict the images. Two
unknowns per pixel are left, height and albedo, so every detector beyond the second is a test. In the far field it is
blind to the sign of the heights, for all slopes reversed are a surface, too: near field, masks and multiple scattering
alone tell hills from hollows.
"""

from collections.abc import Callable

import numpy as np

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import Corrections, single_scattering
from helio_jax.forward.surface import unit_normal
from helio_jax.inverse.linear import MIN_IMAGES, signal_of
from helio_jax.inverse.nearfield import limited, solve_nearfield
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack

UNKNOWNS = 2
"""Per pixel: height and albedo."""


def degrees_of_freedom(stack: MicrographStack) -> int:
    """Count the degrees of freedom: data beyond two per pixel that is seen in three or more images."""
    n = stack.is_observed.sum(0)
    return int(np.sum(n[n >= MIN_IMAGES] - UNKNOWNS))


def misfit(
    stack: MicrographStack,
    optics: Optics,
    settings: ReconstructSettings,
    predict: Callable[[np.ndarray, np.ndarray], Corrections] | None = None,
) -> float:
    """Compute the chi-square per degree of freedom of the images that the integrated near-field surface predicts.

    The albedo of every pixel is the one that fits best, so that patches of another material cost nothing.

    Args:
        stack: images in units of the beam, or with one unknown gain common to all detectors.
        optics: of the stack's instrument.
        settings: integrator and rounds of the near-field method.
        predict: masks and multiple scattering of a surface (heights, normals); default: there are none.

    Source: own derivation, tests/unit/test_orient.py.
    """
    signal, variance = signal_of(stack)
    raster = Raster.of(stack)
    height = limited(solve_nearfield(signal, variance, optics, raster, settings, settings.rounds)[0], optics)
    down, along = np.gradient(height, raster.dy, raster.dx)
    normal = unit_normal(along, down, optics.beam_shift)
    phi, multiple = form_factor(optics, height), 0.0
    if predict is not None:
        found = predict(height, np.moveaxis(normal, 0, -1))
        phi, multiple = phi - found.masked, found.multiple
    model = np.maximum(single_scattering(phi, normal), 0.0) + multiple
    is_used = np.isfinite(signal) & (stack.is_observed.sum(0) >= MIN_IMAGES)
    weight, data = np.where(is_used, 1.0 / variance, 0.0), np.where(is_used, signal, 0.0)
    power = (weight * model**2).sum(0)
    albedo = np.maximum((weight * data * model).sum(0), 0.0) / np.where(power > 0, power, 1.0)
    return float(np.sum(weight * (data - albedo * model) ** 2)) / degrees_of_freedom(stack)
