"""How masks and multiple scattering follow what many heights have in common: derivatives of the forward model.

Corrections are held fixed during a solve. Where the data determine something common to many pixels little better than
the priors, as the level of a plateau or, with a free border, level, scale and tilt of all heights, iterations that hold
the corrections would run away along it, or rest where the misfit is not least (relief came out 8 % too flat on
pyramids). So the corrections follow these changes to first order: masks by the derivative of the horizon march,
multiple scattering by that of the radiosity model. The substrate around a free border moves with its lowest part.
Changes of the heights that grow, or hardly fall, from iteration to iteration are followed, too (`growth`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

from helio_jax.arrays import substrate_mask
from helio_jax.forward.compiling import compiled
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.laws import Law, by_law
from helio_jax.forward.masking import choose_horizons, masked_form_factor
from helio_jax.forward.optics import Optics, Raster, cast
from helio_jax.forward.radiosity import Plan, plan_radiosity, radiosity
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import Surface, slopes_of_normal, unit_normal
from helio_jax.inverse.samples import thinning

STEEP_FACET, LEVEL_FACET = 0.9, 0.98
"""Vertical parts of the unit normal: below the first, facets answer to their own normal by all that they see; between
the two as at the first; from the second on less and less, down to nothing at 1: the normals of flat parts are noise."""
MAX_RADIOSITY_PIXELS = 2500
"""Raster on which the derivative of multiple scattering is computed; it is smooth."""
_ROUNDING = 1e-9
"""Heights below this share of a change are rounding errors."""


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


def normal_slope(multiple: np.ndarray, up: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Estimate the fall of multiple scattering M per unit of a facet's vertical normal component [detector, y, x].

    A facet whose normal has the vertical part n_z sees level surroundings with the view factor (1 - n_z) / 2, so what
    they send it changes by -M / (1 - n_z) per unit of n_z, by at most half of the substrate's signal. Beside a ball
    or a wall M is larger than that view factor allows: most of it comes from above the substrate and remains where the
    facet is level. Without the limit the noise of normals beside spheres lowered the gains by 2 % and raised the
    spheres by as much. Continuous: a threshold makes fits of facets near it cycle.

    Args:
        multiple: multiple scattering M [detector, y, x].
        up: n_z [y, x].
        level: single-scattering detection probability of the level substrate [detector].

    Source: own derivation; view factor of a tilted facet: Liu and Jordan, Solar Energy 4 (1960) 1.
    """
    tilted = 1.0 - up
    share = np.minimum(1.0, tilted / (1.0 - LEVEL_FACET)) / np.maximum(tilted, 1.0 - STEEP_FACET)
    return np.minimum(multiple * share, 0.5 * level[:, None, None])


def _masked_change(surface: Surface, change: Surface, optics: Optics, raster: Raster, law: Law | None) -> jax.Array:
    """Compute the change of single scattering by masks [detector, y, x] along a change of the surface."""
    horizons = choose_horizons(surface, optics, raster)
    return _masked_change_by(horizons, surface, change, optics, raster, law)


@compiled
def _masked_change_by(horizons: jax.Array, surface: Surface, change: Surface, optics, raster, law) -> jax.Array:
    slope = jax.jvp(lambda s: masked_form_factor(s, optics, raster, horizons=horizons), (surface,), (change,))[1]
    normal = unit_normal(surface.slope_x, surface.slope_y, optics.beam_shift)
    return -by_law(law, single_scattering(slope, normal), optics, surface.height, normal)


@compiled
def _multiple_change(
    surface: Surface,
    change: Surface,
    level: jax.Array,
    level_change: jax.Array,
    optics: Optics,
    raster: Raster,
    plan: Plan,
) -> tuple[jax.Array, jax.Array]:
    """Compute multiple scattering [detector, y, x] and its change with the surface and the substrate's level."""

    def multiple(s, level):
        normals = jnp.moveaxis(unit_normal(s.slope_x, s.slope_y, optics.beam_shift), 0, -1)
        return radiosity(s.height - level, normals, _with_substrate_at(optics, level), raster, plan)

    return jax.jvp(multiple, (surface, level), (change, level_change))


def _with_substrate_at(optics: Optics, level: Any) -> Optics:
    """Move the substrate of optics to a level above the stated one, um."""
    return eqx.tree_at(lambda o: o.sample_distance, optics, optics.sample_distance - level)


def region_responses(
    surface: Surface, optics: Optics, raster: Raster, region: np.ndarray, law: Law | None = None
) -> tuple[Response, ...]:
    """Compute how masks follow the levels of plateaus above the largest region, number 0, at albedo 1.

    Args:
        surface: of the corrections.
        optics, raster: of the scan.
        region: number of the plateau of every pixel [y, x].
        law: of the scattering; None: the cosine law.
    """
    found, substrate = [], region == 0
    for number in np.unique(region[region > 0]):
        inside = region == number
        change = Surface(inside.astype(float), *np.zeros((2, *region.shape)))
        with jax.enable_x64(True):
            at, along = cast((surface, change), jnp.float64)
            masked = _masked_change(at, along, optics, raster, law)
        found.append(Response(inside / inside.sum() - substrate / substrate.sum(), np.asarray(masked)))
    return tuple(found)


def relief_responses(
    surface: Surface,
    normals: np.ndarray,
    optics: Optics,
    raster: Raster,
    has_enough_images: np.ndarray,
    distance: float | None,
    law: Law | None = None,
    growing: Sequence[Surface] = (),
) -> tuple[Response, ...]:
    """Compute how masks and multiple scattering follow changes that many heights have in common, at albedo 1.

    That of multiple scattering is by the cosine law.

    Args:
        surface: of the corrections.
        normals: unit normals for which multiple scattering was predicted, without the noise of the slopes [y, x, 3].
        optics, raster: of the scan.
        has_enough_images: where the data determine the surface [y, x].
        distance: of the sample from the plate, the scale of level changes, um: level, scale and tilt of all heights
            count, and the substrate around moves with the lowest part; None: they are held by a flat border.
        law: of the single scattering; None: the cosine law.
        growing: further changes of the surface.
    """

    def changes_of(s: Surface) -> list[Surface]:
        whole = [] if distance is None else _relief_changes(s, raster, has_enough_images, distance)
        return [*whole, *growing]

    changes = changes_of(surface)
    weights = np.zeros((len(changes), *has_enough_images.shape))
    heights = np.stack([change.height[has_enough_images] for change in changes], 1)
    weights[:, has_enough_images] = np.linalg.pinv(heights)
    stride = thinning(has_enough_images.shape, MAX_RADIOSITY_PIXELS)
    thin = (slice(None, None, stride),) * 2
    optics = jax.tree.map(np.asarray, optics)  # JAX would round differences to float32
    shift = optics.beam_shift
    smooth = Surface(surface.height, *slopes_of_normal(normals, shift)[:2])
    coarse, coarse_raster = jax.tree.map(lambda f: np.asarray(f)[thin], smooth), raster.thinned(stride)
    is_substrate = substrate_mask(coarse.height) & (distance is not None)

    def level_of(height: np.ndarray) -> Any:
        return np.mean(height, where=is_substrate) if is_substrate.any() else np.zeros(())

    level = level_of(coarse.height)
    with_level = _with_substrate_at(optics, level)
    plan = plan_radiosity(coarse.height - level, coarse.normals(shift), with_level, coarse_raster)
    out, signal = [], substrate_signal(optics)
    for i, (change, smooth_change) in enumerate(zip(changes, changes_of(smooth), strict=True)):
        with jax.enable_x64(True):
            at, along = cast((surface, change), jnp.float64)
            masked = np.asarray(_masked_change(at, along, optics, raster, law))
            thinned = jax.tree.map(lambda f: f[thin], smooth_change)
            levels = jnp.asarray(level), jnp.asarray(level_of(thinned.height))
            at, along = cast((coarse, thinned), jnp.float64)
            value, slope = _multiple_change(at, along, *levels, optics, coarse_raster, plan)
        sharp, sharp_change = (jax.tree.map(lambda f: np.asarray(f)[thin], s) for s in (surface, change))
        vertical = _vertical_change(sharp, sharp_change, shift)
        own = -normal_slope(np.asarray(value), coarse.normals(shift)[..., 2], signal) * vertical
        out.append(Response(weights[i], masked + _upsampled(np.asarray(slope) - own, masked.shape, stride)))
    return tuple(out)


def without_levels(change: Surface, region: np.ndarray) -> Surface:
    """Subtract the mean change of each plateau, and of the region around them, from a change of a surface.

    What follows a plateau's level above that region (`region_responses`) follows nothing of the rest. Without plateaus
    nothing is subtracted. A change of levels alone leaves 0, not what rounding does.

    Args:
        change: of the surface.
        region: number of the plateau of every pixel, 0: around them [y, x].
    """
    if not region.any():
        return change
    height = np.array(change.height)
    for number in np.unique(region):
        inside = region == number
        height[inside] -= height[inside].mean()
    height[np.abs(height) < _ROUNDING * np.abs(change.height).max(initial=0.0)] = 0.0
    return Surface(height, change.slope_x, change.slope_y)


def _relief_changes(surface: Surface, raster: Raster, has_enough_images: np.ndarray, distance: float) -> list[Surface]:
    """Make the changes of a relief that keep its shape: lower, flatter, tilted about y, tilted about x."""
    mean = np.mean(surface.height[has_enough_images])
    lower, *tilts = plane_changes(raster, distance)
    return [lower, Surface(mean - surface.height, -surface.slope_x, -surface.slope_y), *tilts]


def plane_changes(raster: Raster, distance: float) -> list[Surface]:
    """Make the changes of all heights by a plane: lower by `distance` [um], tilted about y, tilted about x."""
    none, (x, y) = np.zeros(raster.shape), raster.centred_positions()
    return [Surface(none - distance, none, none), Surface(x, none + 1.0, none), Surface(y, none, none + 1.0)]


def _vertical_change(surface: Surface, change: Surface, shift: np.ndarray) -> np.ndarray:
    """Compute the change of the normals' vertical part along a change of the surface [y, x].

    A solve knows how multiple scattering follows it, see `normal_slope`.
    """
    with jax.enable_x64(True):
        at, along = (tuple(jnp.asarray(f) for f in (s.slope_x, s.slope_y)) for s in (surface, change))
        return np.asarray(jax.jvp(lambda x, y: unit_normal(x, y, shift)[2], at, along)[1])


def _upsampled(images: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """Interpolate images of every `stride`-th pixel to the full raster, bilinearly."""
    if stride == 1:
        return images
    places = np.meshgrid(*(np.arange(n) / stride for n in shape[1:]), indexing="ij")
    return np.stack([map_coordinates(image, places, order=1, mode="nearest") for image in images])
