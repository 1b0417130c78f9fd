"""The state of a fit, and its corrections: all that changes, as frozen records and pure functions.

Masks and multiple scattering are predicted on the surface of an outer iteration and held until the next one (`Held`),
but follow, to first order, the geometry, the own normal, and common changes of the heights (`responses`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from helio_jax.forward.compiling import compiled
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.masking import choose_horizons, masked_form_factor
from helio_jax.forward.optics import Optics, Raster, cast
from helio_jax.forward.render import Corrections, single_scattering
from helio_jax.forward.surface import Surface
from helio_jax.inverse.parameters import Parameters, moved_optics
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.responses import (
    Response,
    normal_slope,
    region_responses,
    relief_responses,
    without_levels,
)
from helio_jax.inverse.settings import RefineSettings

LAW_STEP = 0.5
"""Step of a number of the law by which the derivative of the multiple scattering is taken [prior s.d.]."""
LEAST_RATIO = 0.5
"""Least ratio of the multiple scattering after and before such a step that is believed: a smaller one is noise."""
Predict = Callable[..., Corrections]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Corrections; the instrument is given, too, where it is unknown, and by
their names the albedo [y, x] where it is not 1, the law where it is not the cosine law, and the slopes of the substrate
along x and y where it may be tilted. The corrections are per albedo of the own pixel."""


@dataclass(frozen=True)
class Held:
    """Corrections and what follows from them, held fixed until the next outer iteration.

    Attributes:
        corrections: made for `surface`.
        surface: heights and slopes.
        multiple_slope, intercept: of the multiple scattering (`multiple_in_normal`) [detector, y, x].
        sigma: standard deviation of the data, prediction errors included, infinite where not observed [detector, y, x].
        moves: derivative of the masked form factors by distance, polar angle, azimuth [move, detector, 3, y, x].
        moved: the moves at which they were made [move, detector].
        responses: how they follow common changes of the heights.
        law_rate: how the logarithm of the multiple scattering follows the numbers of the law [number].
        law_at: numbers of the law of the corrections, in prior standard deviations from their means [number].
    """

    corrections: Corrections
    surface: Surface
    multiple_slope: np.ndarray
    intercept: np.ndarray
    sigma: np.ndarray
    moves: np.ndarray
    moved: np.ndarray
    responses: tuple[Response, ...] = ()
    law_rate: np.ndarray = field(default_factory=lambda: np.zeros(0))
    law_at: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class FitState:
    """All that changes during a fit.

    Attributes:
        surface: heights and slopes.
        parameters: unknowns that are not the surface.
        residuals: (model - data) / standard deviation [detector, y, x].
        held: corrections of this outer iteration.
    """

    surface: Surface
    parameters: Parameters
    residuals: np.ndarray
    held: Held

    @classmethod
    def at(cls, problem: FitProblem, start: Surface, parameters: Parameters | None = None) -> "FitState":
        """Start at a surface, without corrections; default of `parameters`: as stated."""
        surface = Surface(*(np.asarray(f) for f in (start.height, start.slope_x, start.slope_y)))
        parameters = problem.stated_parameters() if parameters is None else parameters
        held = _held(problem, Corrections.none(problem.signal.shape), surface, parameters)
        return cls(surface, parameters, np.zeros(problem.signal.shape), held)

    @classmethod
    def starting(cls, problem: FitProblem, start: Surface, parameters: Parameters | None = None) -> "FitState":
        """Start a fit or a search at a surface; default of `parameters`: `FitProblem.start_parameters`."""
        return cls.at(problem, start, problem.start_parameters() if parameters is None else parameters)

    def thinned(self, problem: FitProblem, stride: int) -> "FitState":
        """Keep every `stride`-th row and column, for `problem`, which is thinned."""
        if stride == 1:
            return self
        thin = (slice(None, None, stride),) * 2
        h, c = self.held, self.held.corrections
        held = _held(
            problem,
            Corrections(
                c.masked[:, :, *thin],
                c.multiple[:, *thin],
                None if c.occluded is None else c.occluded[:, *thin],
                None if c.normals is None else c.normals[thin],
                None if c.surroundings is None else c.surroundings[:, *thin],
            ),
            jax.tree.map(lambda f: f[thin], h.surface),
            self.parameters,
        )
        held = replace(
            held,
            moves=h.moves[..., *thin],
            moved=h.moved,
            responses=tuple(r.thinned(thin, stride) for r in h.responses),
            law_rate=h.law_rate,
            law_at=h.law_at,
        )
        lines = self.parameters.lines[:, ::stride]
        surface = jax.tree.map(lambda f: f[thin], self.surface)
        return FitState(surface, self.parameters.replaced(lines=lines), self.residuals[:, *thin], held)


def between(first: FitState, second: FitState, share: float) -> FitState:
    """Return a state whose surface and parameters are at a share of the way from one to another.

    Corrections and residuals are those of the second: the residuals have to be computed anew.
    """
    parts = ((s.surface, s.parameters) for s in (first, second))
    surface, parameters = jax.tree.map(lambda a, b: np.asarray(a + share * (b - a)), *parts)
    return replace(second, surface=surface, parameters=parameters)


def multiple_in_normal(corrections: Corrections, normals: np.ndarray, optics: Optics) -> tuple[np.ndarray, np.ndarray]:
    """Make multiple scattering a linear model of the own normal, intercept - slope * n_z: the slope, the intercept.

    The slope changes nothing at the normals of the corrections. It makes the iterations converge faster beside steep
    walls, where slope and multiple scattering depend on one another (`responses.normal_slope`). Corrections are made
    for denoised normals: the noise of the fitted ones enters by this slope, and biases the gains where it is too large.

    Args:
        corrections: of a surface.
        normals: its unit normals [y, x, 3], unless the corrections name their own.
        optics: of the scan.

    Returns:
        [detector, y, x] each.
    """
    up = (normals if corrections.normals is None else corrections.normals)[..., 2]
    slope = normal_slope(corrections.multiple, up, substrate_signal(optics))
    return slope, corrections.multiple + slope * up


def prediction_std(corrections: Corrections, normals: np.ndarray, settings: RefineSettings) -> np.ndarray:
    """Estimate the standard deviation of masks and multiple scattering [detector, y, x], for unit normals [y, x, 3].

    Two parts of each term: a share of its own size, and its change over half a pixel, for the surface that
    it was made for is only known from pixel to pixel.
    """
    masked = single_scattering(corrections.masked, np.moveaxis(normals, -1, 0))
    terms = (masked, settings.mask_error), (corrections.multiple, settings.multiple_error)
    parts = [share * image + 1j * 0.5 * _largest_change(image) for image, share in terms]
    return np.hypot(*map(np.abs, parts))


def _largest_change(image: np.ndarray) -> np.ndarray:
    """Compute the largest difference of every pixel [detector, y, x] from its neighbours in the row and the column."""
    high, low = (f(image, size=(1, 3, 3)) for f in (maximum_filter, minimum_filter))
    return np.maximum(high - image, image - low)


def _held(problem: FitProblem, corrections: Corrections, surface: Surface, parameters: Parameters) -> Held:
    """Derive what a solve needs of corrections made for a surface, without responses."""
    normals, moved = surface.normals(problem.shift), problem.moves(parameters)
    slope, intercept = multiple_in_normal(corrections, normals, problem.optics)
    albedo = problem.albedo_at(parameters)
    variance = problem.variance + (prediction_std(corrections, normals, problem.settings) * albedo) ** 2
    sigma = np.where(problem.is_observed, np.sqrt(variance), np.inf)
    moves = np.zeros((len(moved), *corrections.masked.shape))
    law = np.asarray(parameters.law)
    return Held(corrections, surface, slope, intercept, sigma, moves, moved, (), np.zeros(law.size), law)


def set_corrections(problem: FitProblem, state: FitState, corrections: Corrections, surface: Surface) -> FitState:
    """Take corrections, made on a surface, for all solves until the next ones."""
    held = _held(problem, corrections, surface, state.parameters)
    if len(held.moved):
        with jax.enable_x64(True):
            moves = masked_moves(cast(surface, jnp.float64), problem.optics, problem.raster, held.moved)
        held = replace(held, moves=np.asarray(moves))
    return replace(state, held=held)


def predict_corrections(problem: FitProblem, state: FitState, predict: Predict) -> FitState:
    """Predict masks and multiple scattering on the current surface, which follow no common changes of heights."""
    corrections = _predicted(problem, state, predict, state.parameters)
    return set_corrections(problem, state, corrections, state.surface)


def _predicted(problem: FitProblem, state: FitState, predict: Predict, p: Parameters) -> Corrections:
    surface, is_geometry_known = state.surface, not p.distance.size and not p.aim.size
    instrument = () if is_geometry_known else (problem.fitted_instrument(p),)
    known = problem.patches_at(p).known | problem.known_law(p) | problem.known_tilt(p)
    return predict(surface.height, surface.normals(problem.shift), *instrument, **known)


def update_corrections(
    problem: FitProblem, state: FitState, predict: Predict, growing: Sequence[Surface] = ()
) -> FitState:
    """Predict masks and multiple scattering on the current surface, and how they follow common changes of heights and
    the law; `growing`: further changes of the surface that they follow.

    Multiple scattering that did not follow the law would drive it away: a narrower law has less of it, and what is then
    missing the next solve would take for a still narrower one.
    """
    state = with_responses(problem, predict_corrections(problem, state, predict), growing)
    p, base = state.parameters, np.mean(state.held.corrections.multiple)
    rate = np.zeros(p.law.size)
    for i in range(0 if problem.is_law_held or base <= 0.0 else rate.size):
        stepped = p.replaced(law=p.law + LAW_STEP * (np.arange(rate.size) == i))
        found = np.mean(_predicted(problem, state, predict, stepped).multiple)
        rate[i] = np.log(max(found / base, LEAST_RATIO)) / LAW_STEP
    return replace(state, held=replace(state.held, law_rate=rate))


def with_responses(problem: FitProblem, state: FitState, growing: Sequence[Surface] = ()) -> FitState:
    """Compute how the corrections follow the levels of plateaus, with a free border changes of all heights, and
    `growing` changes of the surface."""
    surface, raster, law = state.held.surface, problem.raster, problem.law_at(state.parameters)
    optics = moved_optics(problem.optics, state.held.moved)
    responses = region_responses(surface, optics, raster, problem.region, law)
    if problem.follows_relief or growing:
        smooth = state.held.corrections.normals
        normals = surface.normals(problem.shift) if smooth is None else smooth
        known = problem.has_enough_images, float(problem.optics.sample_distance) if problem.follows_relief else None
        growing = [without_levels(change, problem.region) for change in growing]
        responses += relief_responses(surface, normals, optics, raster, *known, law, growing)
    albedo = problem.albedo_at(state.parameters)  # of the own pixel, which scatters first
    responses = tuple(r._replace(change=albedo * r.change) for r in responses)
    return replace(state, held=replace(state.held, responses=responses))


def masked_moves(surface: Surface, optics: Optics, raster: Raster, moved: Any) -> jax.Array:
    """Compute the derivative of the masked form factors by distance, polar angle and azimuth, each detector by its own.

    Each aperture depends on its own polar angle and azimuth only, so that one derivative serves all detectors.
    """
    horizons = choose_horizons(surface, moved_optics(optics, moved), raster)
    return _masked_moves(surface, optics, raster, moved, horizons)


@compiled
def _masked_moves(surface: Surface, optics: Optics, raster: Raster, moved: Any, horizons: jax.Array) -> jax.Array:
    def masked(step):
        there = moved_optics(optics, moved + step[:, None])
        return masked_form_factor(surface, there, raster, horizons=horizons)

    return jnp.moveaxis(jax.jacfwd(masked)(jnp.zeros(3)), -1, 0)
