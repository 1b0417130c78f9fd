"""How masks and multiple scattering follow what many heights have in common: derivatives of the forward model.

Corrections are held fixed during a solve. Where the data determine something common to many pixels little better than
the priors, as the level of a plateau or, with a free border, level, scale and tilt of all heights, iterations that hold
the corrections would run away along it, or rest where the misfit is not least (relief came out 8 % too flat on
pyramids). So the corrections follow these changes to first order: masks by the derivative of the horizon march,
multiple scattering by that of the radiosity model.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

from helio_jax.forward.masking import masked_form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import Plan, plan_radiosity, radiosity
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import Surface, unit_normal
from helio_jax.inverse.samples import thinning

LEVEL_FACET = 0.9
"""Facets whose unit normal has a larger vertical part count as level."""
MAX_RADIOSITY_PIXELS = 2500
"""Raster on which the derivative of multiple scattering is computed; it is smooth."""


class Response(NamedTuple):
    """One common change of the heights.

    Attributes:
        weights: the sum of weights times heights is its amplitude [y, x].
        change: of the detection probabilities per unit of amplitude, own height and normal fixed [detector, y, x].
    """

    weights: np.ndarray
    change: np.ndarray

    def thinned(self, thin: tuple[slice, ...], stride: int) -> "Response":
        """Keep some rows and columns, each standing for stride^2 pixels."""
        return Response(self.weights[thin] * stride**2, self.change[:, *thin])


def normal_slope(multiple: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Estimate the fall of multiple scattering M per unit of a facet's vertical normal component [detector, y, x].

    A facet whose normal has the vertical part n_z sees its surroundings with the view factor (1 - n_z) / 2, so what
    they send it changes by -M / (1 - n_z) per unit of n_z; 0 for level facets. Source: own derivation.
    """
    return np.where(up < LEVEL_FACET, multiple / np.maximum(1.0 - up, 1.0 - LEVEL_FACET), 0.0)


@eqx.filter_jit
def _masked_change(surface: Surface, change: Surface, optics: Optics, raster: Raster) -> jax.Array:
    """Compute the change of single scattering by masks [detector, y, x] along a change of the surface."""
    slope = jax.jvp(lambda s: masked_form_factor(s, optics, raster), (surface,), (change,))[1]
    return -single_scattering(slope, unit_normal(surface.slope_x, surface.slope_y, optics.beam_shift))


@eqx.filter_jit
def _multiple_change(
    surface: Surface, change: Surface, optics: Optics, raster: Raster, plan: Plan
) -> tuple[jax.Array, jax.Array]:
    """Compute multiple scattering and its change along a change of the surface [detector, y, x]."""

    def normal(s):
        return unit_normal(s.slope_x, s.slope_y, optics.beam_shift)

    def multiple(s):
        return radiosity(s.height, jnp.moveaxis(normal(s), 0, -1), optics, raster, plan)

    return jax.jvp(multiple, (surface,), (change,))


def _as_jax(surface: Surface) -> Surface:
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), surface)


def region_responses(surface: Surface, optics: Optics, raster: Raster, region: np.ndarray) -> tuple[Response, ...]:
    """Compute how masks follow the levels of plateaus above the largest region, number 0.

    Args:
        surface: of the corrections.
        optics, raster: of the scan.
        region: number of the plateau of every pixel [y, x].
    """
    found, substrate = [], region == 0
    for number in np.unique(region[region > 0]):
        inside = region == number
        change = Surface(inside.astype(float), *np.zeros((2, *region.shape)))
        with jax.enable_x64(True):
            masked = _masked_change(_as_jax(surface), _as_jax(change), optics, raster)
        found.append(Response(inside / inside.sum() - substrate / substrate.sum(), np.asarray(masked)))
    return tuple(found)


def relief_responses(
    surface: Surface, optics: Optics, raster: Raster, has_enough_images: np.ndarray, distance: float
) -> tuple[Response, ...]:
    """Compute how masks and multiple scattering follow level, scale and tilt of all heights.

    Args:
        surface: of the corrections.
        optics, raster: of the scan.
        has_enough_images: where the data determine the surface [y, x].
        distance: of the sample from the plate, the scale of level changes, um.
    """
    changes = _relief_changes(surface, raster, has_enough_images, distance)
    weights = np.zeros((len(changes), *has_enough_images.shape))
    heights = np.stack([change.height[has_enough_images] for change in changes], 1)
    weights[:, has_enough_images] = np.linalg.pinv(heights)
    stride = thinning(has_enough_images.shape, MAX_RADIOSITY_PIXELS)
    thin = (slice(None, None, stride),) * 2
    coarse, coarse_raster = jax.tree.map(lambda f: np.asarray(f)[thin], surface), raster.thinned(stride)
    plan = plan_radiosity(coarse.height, coarse.normals(np.asarray(optics.beam_shift)), optics, coarse_raster)
    out = []
    for i, change in enumerate(changes):
        with jax.enable_x64(True):
            masked = np.asarray(_masked_change(_as_jax(surface), _as_jax(change), optics, raster))
            thinned = _as_jax(jax.tree.map(lambda f: f[thin], change))
            value, slope = _multiple_change(_as_jax(coarse), thinned, optics, coarse_raster, plan)
        own = _own_normal_change(np.asarray(value), coarse, thinned, np.asarray(optics.beam_shift))
        out.append(Response(weights[i], masked + _upsampled(np.asarray(slope) - own, masked.shape, stride)))
    return tuple(out)


def _relief_changes(surface: Surface, raster: Raster, has_enough_images: np.ndarray, distance: float) -> list[Surface]:
    """Return changes of a relief that keep its shape: lower, flatter, tilted about y, tilted about x."""
    none = np.zeros(has_enough_images.shape)
    mean = np.mean(surface.height[has_enough_images])
    centred = Raster.regular(raster.shape, raster.dx, raster.dy)
    x, y = np.meshgrid(centred.x, centred.y)
    return [
        Surface(none - distance, none, none),
        Surface(mean - surface.height, -surface.slope_x, -surface.slope_y),
        Surface(x, none + 1.0, none),
        Surface(y, none, none + 1.0),
    ]


def _own_normal_change(multiple: np.ndarray, surface: Surface, change: Surface, shift: np.ndarray) -> np.ndarray:
    """Compute the change of multiple scattering by a facet's own normal that a solve knows of [detector, y, x]."""
    with jax.enable_x64(True):
        at, along = (tuple(jnp.asarray(f) for f in (s.slope_x, s.slope_y)) for s in (surface, change))
        normal, turned = jax.jvp(lambda x, y: unit_normal(x, y, shift)[2], at, along)
    return -normal_slope(multiple, np.asarray(normal)) * np.asarray(turned)


def _upsampled(images: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """Interpolate images of every `stride`-th pixel to the full raster, bilinearly."""
    if stride == 1:
        return images
    places = np.meshgrid(*(np.arange(n) / stride for n in shape[1:]), indexing="ij")
    return np.stack([map_coordinates(image, places, order=1, mode="nearest") for image in images])
