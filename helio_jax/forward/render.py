"""The render model: heights, optics and read-out -> expected micrographs, differentiable in all of them (JAX).

The spot is small against a pixel, so a count belongs to one surface point: single scattering is n . (Phi - masked),
the near-field vector form factor at the point's height less the part that the sample masks. Multiple scattering comes
from radiosity or is given. Compared with the tracer, with which this shares no kernel, in tests/physics/test_render.py.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from helio_jax.arguments import checked
from helio_jax.errors import SceneError
from helio_jax.forward.compiling import batched_in_chunks, compiled
from helio_jax.forward.form_factor import form_factor_at
from helio_jax.forward.laws import Law, by_law
from helio_jax.forward.masking import N_SLICES, choose_horizons, masked_form_factor
from helio_jax.forward.optics import Optics, Raster, cast, in_own_precision
from helio_jax.forward.radiosity import Plan, plan_radiosity, radiosity
from helio_jax.forward.readout import Readout
from helio_jax.forward.surface import Surface, surface_of_heights, unit_normal


class Corrections(eqx.Module):
    """What a surface does beyond unmasked single scattering, per beam atom.

    Attributes:
        masked: part of each aperture's vector form factor that the sample masks.
        multiple: detection probability of scattering orders 2 and above.
        occluded: change of the probabilities by one standard deviation of where the side of the sample that the beam
            does not see stands, or None where not known. It errs as one: no number of pixels averages it.
        normals: unit normals that `multiple` is for, where they are not the surface's own.
        surroundings: change of the probabilities by one standard deviation of how the sample goes on beyond the image,
            or None where known. It errs as one, too.

    Example:
        >>> hx.render(height, optics, raster, corrections=hx.Corrections(masked, multiple))
    """

    masked: Float[Any, "detector 3 y x"]
    multiple: Float[Any, "detector y x"]
    occluded: Float[Any, "detector y x"] | None = None
    normals: Float[Any, "y x 3"] | None = None
    surroundings: Float[Any, "detector y x"] | None = None

    @classmethod
    def none(cls, shape: tuple[int, int, int]) -> "Corrections":
        """Make those of an unmasked surface without multiple scattering; shape: (detectors, rows, columns)."""
        nothing = np.zeros(shape)
        return cls(np.stack([nothing] * 3, 1), nothing)


def single_scattering(form_factor: Any, normal: Any) -> Any:
    """Compute the detection probability of single scattering, n . Phi [detector, ...]; NumPy or JAX arrays.

    Args:
        form_factor: visible vector form factors, Phi less its masked part [detector, 3, ...].
        normal: unit normals, times the albedo where that is to be included [3, ...].
    """
    return form_factor.__array_namespace__().einsum("ki...,i...->k...", form_factor, normal)


def detection_probability(
    surface: Surface, optics: Optics, corrections: Corrections, albedo: Any = 1.0, law: Law | None = None
) -> jax.Array:
    """Compute the detection probability per beam atom [detector, y, x] of a surface with given corrections.

    `law`: of the single scattering; None: the cosine law.
    """
    phi = form_factor_at(optics, surface.height)
    normal = unit_normal(surface.slope_x, surface.slope_y, optics.beam_shift)
    single = by_law(law, single_scattering(phi - corrections.masked, normal), optics, surface.height, normal)
    return albedo * single + corrections.multiple


@checked
@in_own_precision
def render(
    height: Any,
    optics: Optics,
    raster: Raster,
    *,
    readout: Readout | None = None,
    corrections: Corrections | Plan | Literal["none", "masking", "radiosity"] = "masking",
    albedo: Any = 1.0,
    law: Law | None = None,
    edges: tuple[Any, Any] | None = None,
    n_slices: int = N_SLICES,
) -> jax.Array:
    """Compute the expected micrographs of a surface [detector, y, x].

    A spot much smaller than a pixel, nothing outside of the raster but the substrate. Works under
    `jax.jit`, `grad`, `jvp`, `vmap`, `jacfwd` and `jacrev` in every argument that is a number; one compilation serves
    every geometry, surface and read-out of the same shapes. Float64 NumPy heights are computed in float64, JAX arrays
    in their own precision. More: docs/gradients.md.

    Args:
        height: above the substrate at the beam positions [y, x], um; or a `Surface` with known slopes. Slopes of
            heights alone are estimated and wrong beside kinks (`hx.surface_of_heights`).
        optics: beam and apertures, `hx.Optics.of(instrument)`, or moved.
        raster: beam positions, `hx.Raster.of(stack)`.
        readout: detector gain, offset, drift, stage pedestal, scan lines; default: the detection probability per beam
            atom.
        corrections: "none": single scattering without masks; "masking": single scattering with masks; "radiosity":
            both and multiple scattering, planned on the given surface (not under a JAX transformation of the heights or
            the optics); a plan of `hx.plan_radiosity`: the same, differentiable; `Corrections`: masks and multiple
            scattering as given.
        albedo: relative reflectivity of single scattering, scalar or [y, x].
        law: of the single scattering, `hx.PowerLaw`, `hx.LobeLaw`, `hx.RoughLaw` or `hx.MonotoneLaw`; default: the
            cosine law, which the radiosity takes in either case.
        edges: weights of the edges between pixels along x [y, x - 1] and y [y - 1, x], 1 joined, 0 a depth jump, for
            the slopes of heights alone.
        n_slices: vertical slices per aperture by which masks are integrated.

    Returns:
        Counts, or probabilities without a read-out.

    Raises:
        SceneError: "radiosity" under a JAX transformation: there is no surface to plan on.

    Example:
        >>> optics, raster = hx.Optics.of(stack.instrument), hx.Raster.of(stack)
        >>> image = hx.render(rec.height, optics, raster)
        >>> by_distance = jax.jacfwd(lambda d: hx.render(rec.height, optics.moved(distance=d), raster))(0.0)

    Source: form factor and masks: docs/conventions.md; radiosity: Goral et al., SIGGRAPH 1984.
    """
    surface = height if isinstance(height, Surface) else surface_of_heights(height, raster, edges)
    if isinstance(corrections, str) and corrections == "radiosity":
        corrections = _planned(surface, optics, raster)
    kind = corrections if isinstance(corrections, str) else ""
    given = None if kind else corrections
    is_masked = kind != "none" and not isinstance(given, Corrections)
    horizons = choose_horizons(surface, optics, raster, n_slices) if is_masked else None
    return _rendered(surface, optics, raster, readout, given, albedo, law, horizons, kind, n_slices)


def _planned(surface: Surface, optics: Optics, raster: Raster) -> Plan:
    """Plan the radiosity on a surface that is no tracer."""
    leaves = jax.tree.leaves((surface, optics, raster))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise SceneError(
            "corrections = 'radiosity' plans on the surface's values, which are unknown under a JAX transformation: "
            "plan before it, plan = hx.plan_radiosity(height, normals, optics, raster), and pass corrections=plan"
        )
    return plan_radiosity(surface.height, surface.normals(np.asarray(optics.beam_shift)), optics, raster)


def _corrections(surface, optics, raster, plan, horizons, kind: str, n_slices: int) -> Corrections:
    dtype = jnp.asarray(surface.height).dtype
    surface, optics, raster = (cast(part, dtype) for part in (surface, optics, raster))
    multiple = jnp.zeros((optics.n_detectors, *surface.height.shape), dtype)
    if kind == "none":
        return Corrections(jnp.stack([multiple] * 3, 1), multiple)
    masked = masked_form_factor(surface, optics, raster, n_slices=n_slices, horizons=horizons)
    if plan is not None:
        normals = jnp.moveaxis(unit_normal(surface.slope_x, surface.slope_y, optics.beam_shift), 0, -1)
        multiple = radiosity(surface.height, normals, optics, raster, plan)
    return Corrections(masked, multiple)


_jitted_corrections = compiled(_corrections)


def masking_corrections(surface: Surface, optics: Optics, raster: Raster) -> Corrections:
    """Compute the masks of a surface, without multiple scattering, as NumPy arrays in float64."""
    return _corrections_by(surface, optics, raster, None, "masking")


def radiosity_corrections(surface: Surface, optics: Optics, raster: Raster, plan: Plan) -> Corrections:
    """Compute masks and multiple scattering of a surface by a plan, as NumPy arrays in float64."""
    return _corrections_by(surface, optics, raster, plan, "radiosity")


def _corrections_by(surface: Surface, optics: Optics, raster: Raster, plan: Plan | None, kind: str) -> Corrections:
    with jax.enable_x64(True):
        horizons = choose_horizons(surface, optics, raster)
        found = _jitted_corrections(surface, optics, raster, plan, horizons, kind, N_SLICES)
        return jax.tree.map(np.asarray, found)


@eqx.filter_jit
def _rendered(
    surface, optics, raster, readout, corrections, albedo, law, horizons, kind: str, n_slices: int
) -> jax.Array:
    dtype = jnp.asarray(surface.height).dtype
    given, plan = (corrections, None) if isinstance(corrections, Corrections) else (None, corrections)

    def probability_of(surface, optics, raster, given, plan, albedo, law, horizons):
        if given is None:
            given = _corrections(surface, optics, raster, plan, horizons, kind, n_slices)
        return detection_probability(surface, optics, given, albedo, law)

    surface, optics, raster, given, plan, albedo, law = (
        cast(part, dtype) for part in (surface, optics, raster, given, plan, albedo, law)
    )
    probability = batched_in_chunks(probability_of)(surface, optics, raster, given, plan, albedo, law, horizons)
    return probability if readout is None else cast(readout, dtype)(probability)
