"""The residuals of the fit: from whitened unknowns to residuals in standard deviations (JAX, differentiable, pure).

`FixedTerms` holds all that is constant during one least-squares solve: data and weights, corrections, edges, priors,
and the form factors, expanded about the surface and the optics at which the solve starts. So a solve evaluates no
contour integral, and one compilation serves every geometry. How the terms are made is `problem`'s matter, how the
residuals are minimised `solver`'s.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.fft import idctn

from helio_jax.forward.form_factor import form_factor_at
from helio_jax.forward.laws import Law, by_law, mean_over_aperture
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import Surface, one_sided, unit_normal
from helio_jax.inverse.edges import fourth_order_slopes, trapezoid_gap
from helio_jax.inverse.parameters import (
    NAMES,
    Parameters,
    Priors,
    albedo_of_patches,
    law_of,
    moved_optics,
    moves_of,
    readout_of,
    smooth_albedo,
    smooth_images,
    substrate_plane,
)

SLOPE_STD = 30.0
"""Prior standard deviation of the slopes: holds those that neither a datum nor an edge determines."""
GRADIENT_SHARE = 0.6
"""Share of white slope noise that remains when heights must explain the slopes: a half, and what the edges do not see
of changes from pixel to pixel (measured on a level surface: 0.57 to 0.61)."""


class Unknowns(eqx.Module):
    """Whitened heights above the substrate, which may be tilted, whitened slopes [y, x], and the parameters.

    Heights above a level plane would follow the tilt only together, against the prior of the border in every pixel:
    conjugate gradients would hardly move it.
    """

    height: Any
    slope_x: Any
    slope_y: Any
    parameters: Parameters


class FormFactors(eqx.Module):
    """Visible form factors, expanded about the heights and the optics of a surface.

    Attributes:
        height: about which [y, x], um.
        terms: visible form factor, and first and second derivative of the unmasked one by the height
            [3, detector, 3, y, x].
        moves: derivative of the visible form factor by distance, polar angle, azimuth, each detector by its own
            [move, detector, 3, y, x]; no moves where the geometry is known.
        moved: the moves about which [move, detector], um, rad.
        level_height: mean height about which a level facet's form factor is expanded [um].
        level: that form factor and its derivatives by the height [3, detector, 3].
        level_moves: its derivative by the moves [move, detector, 3].
        stated: its horizontal part at the substrate, by the optics as stated [detector, 2].
    """

    height: Any
    terms: Any
    moves: Any
    moved: Any
    level_height: Any
    level: Any
    level_moves: Any
    stated: Any

    def visible(self, height: jax.Array, moves: jax.Array) -> jax.Array:
        """Compute the visible form factors [detector, 3, y, x] at other heights and moves."""
        rise = height - self.height
        value = self.terms[0] + rise * (self.terms[1] + 0.5 * rise * self.terms[2])
        return value + jnp.einsum("mk,mkiyx->kiyx", moves - self.moved, self.moves)

    def level_at(self, height: jax.Array, moves: jax.Array) -> jax.Array:
        """Compute a level facet's form factor [detector, 3] at another mean height and moves."""
        rise = height - self.level_height
        value = self.level[0] + rise * (self.level[1] + 0.5 * rise * self.level[2])
        return value + jnp.einsum("mk,mki->ki", moves - self.moved, self.level_moves)


class CommonModes(eqx.Module):
    """How corrections follow what many pixels have in common, to first order.

    Attributes:
        weights: the sums of weights times heights are the modes' amplitudes [mode, y, x]; all 0 for unused modes.
        amplitude: at the surface of the corrections [mode].
        response: change of the data per unit of amplitude [mode, detector, y, x].
    """

    weights: Any
    amplitude: Any
    response: Any

    def change(self, height: jax.Array) -> jax.Array:
        """Compute the change of the data [detector, y, x] at other heights."""
        return jnp.tensordot(self.amplitudes(height) - self.amplitude, self.response, 1)

    def amplitudes(self, height: Any) -> Any:
        """Compute the amplitudes [mode] of heights."""
        return jnp.einsum("myx,yx->m", self.weights, height)


class LawResponse(eqx.Module):
    """How the multiple scattering follows the numbers of the law: alike in all pixels, as an exponential.

    Attributes:
        at: numbers of the law of the prediction, in prior standard deviations from their means [number].
        rate: derivative of the logarithm of the multiple scattering by them [number].
    """

    at: Any
    rate: Any

    def exponent(self, numbers: jax.Array) -> jax.Array:
        """Compute the change of that logarithm at other numbers."""
        return jnp.sum(self.rate * (numbers - self.at))


class Edges(eqx.Module):
    """The edges between neighbouring pixels along x [y, x - 1] and y [y - 1, x], see `edges`.

    Attributes:
        joined_x, joined_y: weight that is left to the edge, 1 joined, 0 a depth jump.
        inverse_std_x, inverse_std_y: factor from an edge's misfit to standard deviations, robustly weighted.
        smooth_x, smooth_y: weight of the fourth-order term of the slopes of every pixel [y, x].
        gap_x, gap_y: expected misfits of the edges (`rims`).
    """

    joined_x: Any
    joined_y: Any
    inverse_std_x: Any
    inverse_std_y: Any
    smooth_x: Any
    smooth_y: Any
    gap_x: Any
    gap_y: Any


class FixedTerms(eqx.Module):
    """All that the residuals hold fixed during one least-squares solve.

    Attributes:
        data: readings in units of the beam, 0 where not observed [detector, y, x].
        patches: 1 in the pixels of each patch, 0 elsewhere [patch, y, x].
        inverse_sigma: robust weight over standard deviation, 0 where not observed [detector, y, x].
        form_factors: their expansion.
        multiple: multiple scattering as predicted, per albedo of the own patch [detector, y, x].
        multiple_slope, intercept: of its linear model in the own normal (`state.multiple_in_normal`), likewise
            [detector, y, x].
        occluded: change of the data by one standard deviation of where the occluded side stands, likewise
            [detector, y, x].
        surroundings: change of the data by one standard deviation of how the sample goes on beyond the image, likewise
            [detector, y, x].
        noise_bias: from `second_order_noise_bias` [detector, y, x].
        modes: how corrections follow common changes of the heights.
        drift_modes: shapes of the slow drift [detector or 1, mode, y, x].
        parallax, parallax_height: as in `FitProblem`.
        position: (x, y) by which a tilt raises the border [2, y, x], um.
        edges: between pixels.
        border: prior weight of each height above the substrate [y, x], 1/um.
        anchor_weight: the sums of these weights times the heights are known, over their standard deviations
            [anchor, y, x], 1/um; all 0 for unused anchors.
        anchored: those sums, over their standard deviations [anchor].
        whitening: standard deviation of each cosine mode of the heights [y, x], um.
        slope_scale_x, slope_scale_y: scale of the whitened slopes [y, x].
        priors: of the parameters.
        optics: as stated.
        law_response: how the multiple scattering follows the law; None where that is the cosine law.
        dx, dy: raster pitch, um.
        slow_axis: of the scan, static.
    """

    data: Any
    patches: Any
    inverse_sigma: Any
    form_factors: FormFactors
    multiple: Any
    multiple_slope: Any
    intercept: Any
    occluded: Any
    surroundings: Any
    noise_bias: Any
    modes: CommonModes
    drift_modes: Any
    parallax: Any
    parallax_height: Any
    position: Any
    edges: Edges
    border: Any
    anchor_weight: Any
    anchored: Any
    whitening: Any
    slope_scale_x: Any
    slope_scale_y: Any
    priors: Priors
    optics: Optics
    dx: Any
    dy: Any
    law_response: LawResponse | None
    slow_axis: int = eqx.field(static=True, default=0)


def surface_of(unknowns: Unknowns, fixed: FixedTerms) -> Surface:
    """Compute heights and slopes of whitened unknowns."""
    height = idctn(unknowns.height * fixed.whitening, norm="ortho")
    height = height + substrate_plane(unknowns.parameters, fixed.priors.tilt, fixed.position)
    base_x = one_sided(jnp.diff(height, axis=1) / fixed.dx, fixed.edges.joined_x, 1)
    base_y = one_sided(jnp.diff(height, axis=0) / fixed.dy, fixed.edges.joined_y, 0)
    return Surface(
        height, base_x + fixed.slope_scale_x * unknowns.slope_x, base_y + fixed.slope_scale_y * unknowns.slope_y
    )


def expected_data(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> jax.Array:
    """Compute the expected data [detector, y, x] in units of the beam."""
    p, factors = fixed.priors, fixed.form_factors
    moves, law = moves_of(parameters, p, len(fixed.data)), law_of(parameters, p)
    normal = unit_normal(surface.slope_x, surface.slope_y, fixed.optics.beam_shift)
    single = single_scattering(factors.visible(surface.height, moves), normal)
    single = by_law(law, single, moved_optics(fixed.optics, moves), surface.height, normal)
    albedo = smooth_albedo(parameters.albedo, surface.height.shape, p.albedo)
    exponent = p.multiple * parameters.log_multiple
    if fixed.law_response is not None:
        exponent = exponent + fixed.law_response.exponent(parameters.law)
    # its own scale only: intercept and slope are several times the multiple scattering
    multiple = fixed.intercept - fixed.multiple_slope * normal[2] + jnp.expm1(exponent)[:, None, None] * fixed.multiple
    signal = single - fixed.noise_bias + multiple + parameters.occluded * fixed.occluded
    if parameters.surroundings.size:
        signal = signal + jnp.sum(parameters.surroundings) * fixed.surroundings
    signal = albedo * signal  # the first scattering of every order is by the own pixel
    if parameters.patch.size:
        signal = albedo_of_patches(parameters.patch, p.patch, fixed.patches) * signal
    read = readout_of(parameters, p, fixed.drift_modes, fixed.slow_axis)(signal) + fixed.modes.change(surface.height)
    if parameters.discrepancy.size:
        read = read + smooth_images(parameters.discrepancy, surface.height.shape, p.discrepancy)
    # a higher point's data stand elsewhere in an oblique beam's image: linear within about a pixel
    return read - fixed.parallax * jnp.clip(surface.height - fixed.parallax_height, -fixed.dx, fixed.dx)


def second_order_noise_bias(
    surface: Surface,
    visible: Any,
    multiple_slope: Any,
    optics: Optics,
    law: Law | None,
    inverse_sigma: Any,
    largest: Any,
) -> jax.Array:
    """Compute the bias of the mean signal of facets by the noise of their fitted slopes [detector, y, x].

    A facet's signal is curved in its slopes: that of noisy slopes is too low in the mean, by tr(c'' V) / 2. With
    two slopes more in every pixel the gains would compensate it, however many pixels there are. V is the covariance
    that the facet's own data leave, times `GRADIENT_SHARE`.

    Args:
        surface: fitted.
        visible: form factors [detector, 3, y, x].
        multiple_slope: fall of the multiple scattering with n_z [detector, y, x].
        optics: of these.
        law: of the scattering; None: the cosine law.
        inverse_sigma: of the data [detector, y, x].
        largest: standard deviation of the slopes that more noise does not exceed [y, x].

    Source: Neyman and Scott, Econometrica 16 (1948) 1; second order: Box, J. R. Stat. Soc. B 33 (1971) 171.
    """

    def signal(x: jax.Array, y: jax.Array) -> jax.Array:
        normal = unit_normal(x, y, optics.beam_shift)
        single = by_law(law, single_scattering(visible, normal), optics, surface.height, normal)
        return single - multiple_slope * normal[2]

    def along(function, way):
        return lambda *slopes: jax.jvp(function, slopes, way)[1]

    surface = Surface(*(jnp.asarray(part) for part in (surface.height, surface.slope_x, surface.slope_y)))
    at, one = (surface.slope_x, surface.slope_y), jnp.ones_like(surface.slope_x)
    ways = (one, 0.0 * one), (0.0 * one, one)
    first = [along(signal, way) for way in ways]
    c_xx, c_xy, c_yy = (along(first[i], ways[j])(*at) for i, j in ((0, 0), (0, 1), (1, 1)))
    x, y = (f(*at) * inverse_sigma for f in first)
    xx, xy, yy = jnp.sum(x * x, 0) + largest**-2, jnp.sum(x * y, 0), jnp.sum(y * y, 0) + largest**-2
    return 0.5 * GRADIENT_SHARE * (c_xx * yy - 2.0 * c_xy * xy + c_yy * xx) / (xx * yy - xy**2)


def data_residuals(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> jax.Array:
    """Compute (model - data) / standard deviation, robustly weighted [detector, y, x]."""
    return (expected_data(surface, parameters, fixed) - fixed.data) * fixed.inverse_sigma


def data_by_incidence(unknowns: Unknowns, fixed: FixedTerms) -> jax.Array:
    """Compute the derivative of the data's residuals by the beam's incidence [detector, y, x], per rad.

    Heights and slopes at the beam positions stay; what they mean turns with the beam. Masks are held.
    """
    surface, factors = surface_of(unknowns, fixed), fixed.form_factors
    moves = moves_of(unknowns.parameters, fixed.priors, len(fixed.data))
    optics = moved_optics(fixed.optics, moves)

    def at(step: jax.Array) -> jax.Array:
        moved = optics.moved(incidence=step)
        change = form_factor_at(moved, surface.height) - form_factor_at(optics, surface.height)
        terms, stated = factors.terms.at[0].add(change), fixed.optics.moved(incidence=step)
        there = eqx.tree_at(lambda f: (f.form_factors.terms, f.optics), fixed, (terms, stated))
        return data_residuals(surface, unknowns.parameters, there)

    return jax.jvp(at, (jnp.zeros(()),), (jnp.ones(()),))[1]


def edge_scale(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> jax.Array:
    """Compute the factor of the edges' weights: sensitivity of the data to slopes, relative to the stated one.

    Edges count in units of the slope noise that the data's noise makes, which falls with the gain and, near the
    plate, with the height: else a larger gain or level would explain the noise by smaller slopes, which the edges
    would prefer, however many pixels there are. For a level facet at the mean height, whose signal changes with its
    slopes by the horizontal part of the form factor, and by the law. So does the mean albedo of patches.
    """
    weight = jnp.sqrt(jnp.mean(fixed.inverse_sigma**2, (1, 2)))[:, None]
    gain = jnp.exp(fixed.priors.gain * parameters.log_gain)[:, None]
    moves = moves_of(parameters, fixed.priors, len(fixed.data))
    here = _level_sensitivity(jnp.mean(surface.height), moves, law_of(parameters, fixed.priors), fixed)
    scale = jnp.sqrt(jnp.sum((weight * gain * here) ** 2) / jnp.sum((weight * fixed.form_factors.stated) ** 2))
    if parameters.patch.size:
        scale = scale * jnp.mean(albedo_of_patches(parameters.patch, fixed.priors.patch, fixed.patches))
    return scale


def _level_sensitivity(height: jax.Array, moves: jax.Array, law: Law | None, fixed: FixedTerms) -> jax.Array:
    """Compute by how much a level facet's signal falls with its slopes [detector, 2]."""
    factor = fixed.form_factors.level_at(height, moves)
    if law is None:
        return factor[:, :2]
    optics = moved_optics(fixed.optics, moves)

    def value(slopes: jax.Array) -> jax.Array:
        normal = unit_normal(slopes[:1], slopes[1:], optics.beam_shift)
        return mean_over_aperture(law, optics, height[None], normal)[:, 0]

    level = jnp.zeros(2, height.dtype)
    return factor[:, :2] * value(level)[:, None] - factor[:, 2:] * jax.jacfwd(value)(level)


def edge_residuals(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> tuple[jax.Array, jax.Array]:
    """Compute the edges' residuals [y, x - 1], [y - 1, x]."""
    scale, e = edge_scale(surface, parameters, fixed), fixed.edges
    gap_x = trapezoid_gap(surface.height, fourth_order_slopes(surface.slope_x, e.smooth_x, 1), fixed.dx, 1)
    gap_y = trapezoid_gap(surface.height, fourth_order_slopes(surface.slope_y, e.smooth_y, 0), fixed.dy, 0)
    return (gap_x - e.gap_x) * e.inverse_std_x * scale, (gap_y - e.gap_y) * e.inverse_std_y * scale


def border_residuals(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> jax.Array:
    """Compute the heights above the substrate, which may be tilted, by their prior weight [y, x]."""
    return (surface.height - substrate_plane(parameters, fixed.priors.tilt, fixed.position)) * fixed.border


def residuals(unknowns: Unknowns, fixed: FixedTerms) -> dict[str, jax.Array]:
    """Compute all residuals in standard deviations."""
    return residuals_at(surface_of(unknowns, fixed), unknowns.parameters, fixed)


def residuals_at(surface: Surface, parameters: Parameters, fixed: FixedTerms) -> dict[str, jax.Array]:
    """Compute the residuals of a surface, in standard deviations."""
    edge_x, edge_y = edge_residuals(surface, parameters, fixed)
    return {
        "data": data_residuals(surface, parameters, fixed),
        "edge_x": edge_x,
        "edge_y": edge_y,
        "border": border_residuals(surface, parameters, fixed),
        "anchors": jnp.einsum("ayx,yx->a", fixed.anchor_weight, surface.height) - fixed.anchored,
        "slope_x": surface.slope_x / SLOPE_STD,
        "slope_y": surface.slope_y / SLOPE_STD,
        **{name: getattr(parameters, name) for name in NAMES},
    }
