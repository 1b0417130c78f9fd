"""One least-squares step of a fit: the terms that it holds fixed, the solve, and what follows from a state.

Unknowns are whitened so that plain conjugate gradients converge in few steps: heights by the cosine transform, h =
DCT^-1(y / sqrt(lambda)), for the data fix slopes; slopes as deviations from the heights' one-sided differences.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.fft import dctn

from helio_jax.forward.compiling import compiled
from helio_jax.forward.form_factor import form_factor_at
from helio_jax.forward.optics import Optics
from helio_jax.forward.surface import Surface, one_sided, to_pixels
from helio_jax.inverse.edges import AxisEdges, find_edges, smoothness_weight
from helio_jax.inverse.parameters import moved_optics, substrate_plane
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.residuals import (
    CommonModes,
    Edges,
    FixedTerms,
    FormFactors,
    LawResponse,
    Unknowns,
    expected_data,
    second_order_noise_bias,
    surface_of,
)
from helio_jax.inverse.responses import plane_changes
from helio_jax.inverse.rims import find_rims
from helio_jax.inverse.solver import CommonHeights, Solution, solve, whitened_parameters
from helio_jax.inverse.state import FitState, Held
from helio_jax.robust import cauchy_weight
from helio_jax.validity import FACET_IMAGES

MODE_BLOCK = 4
"""Common modes and anchors are filled up to a multiple of this."""
NOISY = 3.0
"""Largest standard deviation that slopes are credited with, in that of a pixel with median noise."""


def _whitening(shape: tuple[int, int], dx: float, dy: float, slope_noise: float) -> np.ndarray:
    """Compute the standard deviation of each cosine mode of the heights that a slope noise per pixel leaves, um."""
    ky = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[0]) / shape[0]) / dy
    kx = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[1]) / shape[1]) / dx
    eigenvalue = ky[:, None] ** 2 + kx[None, :] ** 2
    eigenvalue[0, 0] = eigenvalue.ravel()[1:].min()
    return slope_noise / np.sqrt(eigenvalue)


@compiled
def expand_form_factors(optics: Optics, moved: Any, height: Any, held: tuple) -> FormFactors:
    """Expand the visible form factors about heights [y, x] and moves [move, detector]."""
    masked, masked_moves, masked_at = held

    def derivatives(at, heights):
        here, one = moved_optics(optics, at), jnp.ones_like(heights)

        def value(h):
            return form_factor_at(here, h)

        def slope(h):
            return jax.jvp(value, (h,), (one,))[1]

        return jnp.stack([value(heights), slope(heights), jax.jvp(slope, (heights,), (one,))[1]])

    def by_moves(heights):
        if not len(moved):
            return jnp.zeros((0, optics.n_detectors, 3, *heights.shape))
        by = jax.jacfwd(lambda step: form_factor_at(moved_optics(optics, moved + step[:, None]), heights))(jnp.zeros(3))
        return jnp.moveaxis(by, -1, 0)

    mean = jnp.mean(height)
    terms, level = derivatives(moved, height), derivatives(moved, mean[None])
    masked = masked + jnp.einsum("mk,mkiyx->kiyx", moved - masked_at, masked_moves)
    return FormFactors(
        height,
        terms.at[0].add(-masked),
        by_moves(height) - masked_moves,
        moved,
        mean,
        level[..., 0],
        by_moves(mean[None])[..., 0],
        form_factor_at(optics, jnp.zeros(1))[:, :2, 0],
    )


_noise_bias = compiled(second_order_noise_bias)
_expected = compiled(lambda unknowns, fixed: expected_data(surface_of(unknowns, fixed), unknowns.parameters, fixed))


def edges_of(
    problem: FitProblem, surface: Surface, cut: float, occluded: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[AxisEdges, AxisEdges]:
    """Find the edges of a surface along x and along y; those at walls or `occluded` count as depth jumps."""
    is_seen = problem.is_observed.sum(0) >= FACET_IMAGES
    noise = np.where(is_seen, problem.pixel_noise, np.inf)
    rims_x, rims_y = find_rims(surface, noise, problem.shift)
    found = (
        find_edges(surface.height, surface.slope_x, problem.raster.dx, 1, problem.pixel_noise, cut, rims_x),
        find_edges(surface.height, surface.slope_y, problem.raster.dy, 0, problem.pixel_noise, cut, rims_y),
    )
    for cuts in (problem.walls, occluded):
        if cuts is not None:
            along_x, along_y = (replace(e, joined=np.where(c, 0.0, e.joined)) for e, c in zip(found, cuts, strict=True))
            found = along_x, along_y
    return found


class PixelTerms(NamedTuple):
    """Terms of every pixel that depend on no neighbour: form factors, and the noise bias [detector, y, x]."""

    factors: FormFactors
    noise_bias: np.ndarray

    def thinned(self, stride: int) -> "PixelTerms":
        """Keep every `stride`-th row and column."""
        if stride == 1:
            return self
        thin = (..., slice(None, None, stride), slice(None, None, stride))
        f = self.factors
        factors = FormFactors(
            f.height[thin],
            f.terms[thin],
            f.moves[thin],
            f.moved,
            f.level_height,
            f.level,
            f.level_moves,
            f.stated,
        )
        return PixelTerms(factors, self.noise_bias[thin])


def pixel_terms(problem: FitProblem, state: FitState, limit: float) -> PixelTerms:
    """Expand form factors and estimate the noise bias at a state; `limit` as in `freeze`."""
    held, slopes, noise = state.held, (state.surface.slope_x, state.surface.slope_y), problem.slope_noise
    largest = NOISY * noise * steepness(*slopes)
    inverse_sigma = cauchy_weight(state.residuals, limit) / held.sigma * problem.albedo_at(state.parameters)
    corrections, moves = (held.corrections.masked, held.moves, held.moved), problem.moves(state.parameters)
    with jax.enable_x64(True):
        factors = expand_form_factors(problem.optics, moves, state.surface.height, corrections)
        known = moved_optics(problem.optics, moves), problem.law_at(state.parameters)
        bias = _noise_bias(state.surface, factors.terms[0], held.multiple_slope, *known, inverse_sigma, largest)
    return PixelTerms(jax.tree.map(np.asarray, factors), np.asarray(bias))


def steepness(slope_x: Any, slope_y: Any) -> Any:
    """Compute by how much more the slopes of a facet follow its normal than those of a level one [y, x]."""
    return 1.0 + slope_x**2 + slope_y**2


def _or_nothing(image: np.ndarray | None, problem: FitProblem) -> np.ndarray:
    """Return a change of the data [detector, y, x]: 0 where there is none."""
    return np.zeros(problem.signal.shape) if image is None else image


def freeze(
    problem: FitProblem,
    state: FitState,
    limit: float,
    cut: float,
    occluded: tuple[np.ndarray, np.ndarray] | None = None,
    pixels: PixelTerms | None = None,
) -> tuple[Unknowns, FixedTerms]:
    """Fix corrections, edges and robust weights at a state; return the state as unknowns, too.

    Args:
        problem: the data.
        state: current surface and parameters.
        limit: residual at which a datum's weight falls to a half [standard deviations].
        cut: misfit at which an edge loses most of its weight [standard deviations].
        occluded: edges to cut along x and y.
        pixels: from `pixel_terms`; default: computed.
    """
    pixels = pixel_terms(problem, state, limit) if pixels is None else pixels
    held, noise = state.held, problem.slope_noise
    height, slope_x, slope_y = state.surface.height, state.surface.slope_x, state.surface.slope_y
    dx, dy = problem.raster.dx, problem.raster.dy
    along_x, along_y = edges_of(problem, state.surface, cut, occluded)
    # a kink lies in one of `stride` edges of each of `stride` parallel paths of a thinned raster
    strictness = problem.stride**1.5
    edges = Edges(
        along_x.joined,
        along_y.joined,
        along_x.weight * strictness,
        along_y.weight * strictness,
        smoothness_weight(along_x.smooth, slope_x, problem.pixel_noise, 1),
        smoothness_weight(along_y.smooth, slope_y, problem.pixel_noise, 0),
        along_x.rims.gap,
        along_y.rims.gap,
    )
    free = noise * steepness(slope_x, slope_y)
    scale_x, scale_y = (_slope_scale(e, axis, free) for e, axis in ((along_x, 1), (along_y, 0)))
    whitening = _whitening(problem.raster.shape, dx, dy, noise)
    plane = substrate_plane(state.parameters, problem.tilt_std, problem.position)
    inverse_sigma, priors = cauchy_weight(state.residuals, limit) / held.sigma, problem.priors
    anchors = problem.all_anchors.padded(MODE_BLOCK)
    fixed = FixedTerms(
        data=problem.data,
        patches=problem.patches.members,
        inverse_sigma=inverse_sigma * problem.stride,
        form_factors=pixels.factors,
        multiple=held.corrections.multiple,
        multiple_slope=held.multiple_slope,
        intercept=held.intercept,
        occluded=_or_nothing(held.corrections.occluded, problem),
        surroundings=_or_nothing(held.corrections.surroundings, problem),
        noise_bias=pixels.noise_bias,
        modes=_common_modes(held, np.exp(priors.gain * state.parameters.log_gain)),
        drift_modes=problem.drift_modes,
        parallax=problem.parallax,
        parallax_height=problem.parallax_height,
        position=problem.position,
        edges=edges,
        border=problem.border,
        anchor_weight=anchors.weight,
        anchored=anchors.value,
        whitening=whitening,
        slope_scale_x=scale_x,
        slope_scale_y=scale_y,
        priors=priors,
        optics=problem.optics,
        law_response=None if priors.law is None else LawResponse(held.law_at, held.law_rate),
        dx=dx,
        dy=dy,
        slow_axis=problem.order.slow_axis,
    )
    as_array = lambda a: np.asarray(a, float)  # noqa: E731
    unknowns = Unknowns(*_whitened(state.surface, height - plane, fixed), state.parameters)
    return jax.tree.map(as_array, unknowns), jax.tree.map(as_array, fixed)


def _whitened(surface: Surface, height: np.ndarray, fixed: FixedTerms) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whiten heights above the substrate [y, x], um, and the slopes of a surface, or a change of both."""
    base_x = one_sided(np.diff(surface.height, axis=1) / fixed.dx, fixed.edges.joined_x, 1)
    base_y = one_sided(np.diff(surface.height, axis=0) / fixed.dy, fixed.edges.joined_y, 0)
    return (
        dctn(height, norm="ortho") / fixed.whitening,
        np.asarray(surface.slope_x - base_x) / fixed.slope_scale_x,
        np.asarray(surface.slope_y - base_y) / fixed.slope_scale_y,
    )


def _common_modes(held: Held, gain: np.ndarray) -> CommonModes:
    """Stack the responses, filled up with empty ones, so that one compilation serves different numbers of them."""
    n, shape = len(held.responses), held.intercept.shape
    room = MODE_BLOCK * max(1, -(-n // MODE_BLOCK))
    weights, change = np.zeros((room, *shape[1:])), np.zeros((room, *shape))
    for i, response in enumerate(held.responses):
        weights[i], change[i] = response.weights, gain[:, None, None] * response.change
    return CommonModes(weights, np.einsum("myx,yx->m", weights, held.surface.height), change)


def _slope_scale(edges: AxisEdges, axis: int, free: np.ndarray) -> np.ndarray:
    """Compute the scale of whitened slopes: the deviation from one-sided differences that edges and data leave."""
    return 1.0 / np.sqrt(0.25 * to_pixels(edges.weight**2, axis) + 1.0 / free**2)


def step(
    problem: FitProblem,
    state: FitState,
    limit: float,
    cut: float,
    is_instrument_free: bool,
    occluded: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[FitState, Solution]:
    """Solve one weighted least-squares problem from a state; arguments as those of `freeze`."""
    s = problem.settings
    start, fixed = freeze(problem, state, limit, cut, occluded)
    common, free = _common_heights(problem, state, fixed), np.asarray(float(is_instrument_free))
    with jax.enable_x64(True):
        is_mixed = (
            problem.is_instrument_unknown
            or problem.is_level_free
            or (problem.priors.law is not None and not problem.is_law_held)
            or problem.discrepancy_std > 0.0
        )
        if (is_instrument_free and is_mixed) or start.parameters.patch.size:
            mixing = whitened_parameters(start, fixed, common, free)
        else:  # as they are, where they are held or little is unknown
            n = sum(getattr(start.parameters, name).size for name in start.parameters.free())
            mixing = np.diag([1.0] * n + [0.0] * len(common.height))
        # the switch is an array: one compilation serves both cases
        found = jax.tree.map(np.asarray, solve(start, fixed, common, s.lm_steps, s.cg_steps, mixing, free))
    residuals = (found.data - problem.data) / state.held.sigma
    return replace(state, surface=found.surface, parameters=found.parameters, residuals=residuals), found


def _common_heights(problem: FitProblem, state: FitState, fixed: FixedTerms) -> CommonHeights:
    """Make the changes that all heights have in common: the relief's scale; with a free level, that and tilts, too."""
    changes = [levelled(problem, state)]
    if problem.is_level_free:
        changes += plane_changes(problem.raster, float(problem.optics.sample_distance))
    whitened = [_whitened(change, change.height, fixed) for change in changes]
    return CommonHeights(*(np.stack(parts) for parts in zip(*whitened, strict=True)))


def expected(problem: FitProblem, state: FitState, *, is_noisy: bool) -> np.ndarray:
    """Compute the data expected at a state, whose slopes may be noisy ones; 0 where not observed."""
    unknowns, fixed = freeze(problem, state, problem.settings.robust_limits[-1], problem.settings.jump_limits[-1])
    if not is_noisy:
        fixed = eqx.tree_at(lambda f: f.noise_bias, fixed, np.zeros(problem.signal.shape))
    with jax.enable_x64(True):
        return np.where(problem.is_observed, np.asarray(_expected(unknowns, fixed)), 0.0)


def with_residuals(problem: FitProblem, state: FitState) -> FitState:
    """Compute the residuals of a state anew, its corrections held."""
    residuals = (expected(problem, state, is_noisy=True) - problem.data) / state.held.sigma
    return replace(state, residuals=residuals)


def levelled(problem: FitProblem, state: FitState) -> Surface:
    """Compute the surface above the substrate, which may be tilted."""
    s, tilt = state.surface, problem.tilt_std * state.parameters.tilt
    if not tilt.size:
        return s
    plane = substrate_plane(state.parameters, problem.tilt_std, problem.position)
    return Surface(s.height - plane, s.slope_x - tilt[0], s.slope_y - tilt[1])


def model_share(problem: FitProblem, state: FitState) -> np.ndarray:
    """Compute the share of prediction errors in the variance of every datum; 0 where not observed [detector, y, x]."""
    share = np.maximum(1.0 - problem.variance / state.held.sigma**2, 0.0)
    return np.where(problem.is_observed, share, 0.0)
