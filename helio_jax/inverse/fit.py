"""Fit the heights themselves to the micrographs through the render model: the outer iterations.

Every iteration: predict multiple scattering and masked aperture parts on the current surface (a callable that
`workflows` supplies, so this stage knows no tracer), decide which edges are smooth, kinked or cut (`edges`), renew the
robust weights, then a few Gauss-Newton steps (`steps.step`). All of that is constant during a step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from helio_jax.errors import PredictionError
from helio_jax.forward.compiling import compiled
from helio_jax.forward.surface import Surface
from helio_jax.instrument import Instrument
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.backtracking import with_backtracking
from helio_jax.inverse.convergence import contraction_of, extrapolation, remaining_error, status_of
from helio_jax.inverse.correlated_errors import EdgeError, Errors, ModelError
from helio_jax.inverse.edges import AxisEdges
from helio_jax.inverse.geometry_change import GeometryScore
from helio_jax.inverse.growth import Growth
from helio_jax.inverse.noise_bias import noise_bias, subtract_bias
from helio_jax.inverse.occlusion import find_occlusion_edges
from helio_jax.inverse.parameters import HELD, Parameters
from helio_jax.inverse.posterior import MAX_PIXELS, Linearised, Posterior, linearise, sample_posterior, tilts_of
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.quality import half_chi_square
from helio_jax.inverse.residuals import FixedTerms, Unknowns, data_by_incidence
from helio_jax.inverse.samples import thinning
from helio_jax.inverse.state import FitState, Predict, between, predict_corrections, update_corrections
from helio_jax.inverse.steps import edges_of, freeze, levelled, model_share, pixel_terms, step, with_residuals
from helio_jax.inverse.verdict import residuals_of_state
from helio_jax.robust import cauchy_weight

ALTERNATING, LEAST_RELAXATION = 0.6, 0.3
"""Extrapolation below which the next iteration is relaxed: each change undoes two thirds of the last (iterates that
only Monte Carlo noise moves have 2/3: a half); and the least share of a change that is kept."""
INFLATING = (
    (("distance", "tilt", "aim"), 1.0),
    (("discrepancy",), 1.3),
    (("log_gain", "offset"), 2.0),
    (("log_multiple",), 2.0),
)
"""Parameters that show an incomplete model where they come out farther off than stated, and the Birge ratio above which
they inflate the error bars: that of modes, gains and multiple scattering is often larger than 1 by chance."""

Report = Callable[[int, int, str], None]
"""Called with (iteration, iterations in all, what is known so far)."""


@dataclass(frozen=True)
class Fit:
    """Result of the fit; arrays as in `Reconstruction`.

    Attributes:
        problem, state: what was fitted, and where the fit ended.
        surface: heights and slopes.
        normals: unit normals [y, x, 3].
        albedo: relative reflectivity [y, x].
        gain, offset: per detector, data = gain * model + offset.
        instrument: with the geometry that was fitted.
        parameters: all unknowns but the surface, in prior standard deviations.
        residuals: (model - data) / standard deviation [detector, y, x].
        weight: robust weight of each datum [detector, y, x].
        model_share: share of the prediction errors in the variance of each datum [detector, y, x].
        joined_x, joined_y: weight left to the edges between pixels [y, x - 1], [y - 1, x]; 0 at a jump.
        remaining: how far the heights still are from where further iterations would take them [y, x], um.
        posterior: error bars, or None: not computed (`with_posterior`).
        changes: root mean square height change of every iteration [um].
        contraction: ratio of the last two changes, or None.
        status: a sentence: how the fit ended.
        is_interrupted: whether it, or what followed it, was stopped from the keyboard.
        is_bias_subtracted: whether the bias by noise was subtracted.
        prior_widths: standard deviations of the priors of gains and offsets over those stated, by the names of the
            parameters; empty: as stated.
        geometry_score: what the data say of a geometry that is stated as exact, where another one is likely.
        rival_change: by how much another instrument that explains the data about as well changes the heights [y, x],
            um; None: no other one was fitted, or none does.
        is_rival_contained: whether the error bars contain `rival_change`; of changes by other instruments they contain
            one (`instrument_change`).
    """

    problem: FitProblem
    state: FitState
    surface: Surface
    normals: np.ndarray
    albedo: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    instrument: Instrument
    parameters: Parameters
    residuals: np.ndarray
    weight: np.ndarray
    model_share: np.ndarray
    joined_x: np.ndarray
    joined_y: np.ndarray
    remaining: np.ndarray
    posterior: Posterior | None
    changes: tuple[float, ...]
    contraction: float | None
    status: str
    is_interrupted: bool = False
    is_bias_subtracted: bool = False
    prior_widths: Mapping[str, float] = field(default_factory=dict)
    geometry_score: GeometryScore | None = None
    rival_change: np.ndarray | None = None
    is_rival_contained: bool = False

    @property
    def is_geometry_fitted(self) -> bool:
        """Whether the geometry, stated as exact, was fitted for what the data say of it."""
        return self.geometry_score is not None and self.problem.geometry.is_aimed

    @property
    def instrument_change(self) -> np.ndarray | None:
        """Change of the heights by an instrument that may be right as well [y, x], um: for the error bars to contain.

        That of a geometry that the data ask for and that was not fitted, or that of another fit: the one with the
        larger mean square, as both may be one and the same. None: there is none.
        """
        of_score = None if self.geometry_score is None or self.is_geometry_fitted else self.geometry_score.height_change
        changes = [change for change in (of_score, self.rival_change) if change is not None]
        return largest_change(changes) if changes else None

    @property
    def chi_square(self) -> list[float]:
        """Mean square residual of the data of every detector, each counted by its robust weight, squared."""
        total = np.sum((self.weight * self.residuals) ** 2, axis=(1, 2))
        return (total / np.maximum(np.sum(self.weight**2, axis=(1, 2)), 1e-300)).tolist()


def posterior_at(problem: FitProblem, state: FitState, n_samples: int, sums: Anchors | None = None) -> Posterior:
    """Compute the posterior at a state, on a thinned raster where the full one is too large.

    `sums` of heights above the substrate, which may be tilted: their covariance with all else is computed, too.
    """
    at = linearised_at(problem, state)
    thin = (slice(None, None, at.stride),) * 2
    of_sums = None if sums is None else derivative_of_sums(sums.thinned(thin), at.planes, at.linear)
    found = sample_posterior(at.linear, n_samples, errors=at.errors, sums=of_sums)
    return inflated(found.levelled(at.planes), state).on_raster(problem.raster.shape, at.stride)


class LinearisedFit(NamedTuple):
    """A fit to first order at a state, on a thinned raster where the full one is too large.

    Attributes:
        linear: its residuals.
        errors: what is assumed of the errors of the residuals.
        planes: heights of the substrate for one prior standard deviation of each tilt [2, y, x], um.
        problem, state: on the thinned raster.
        stride: thinning.
    """

    linear: Linearised
    errors: Errors
    planes: np.ndarray
    problem: FitProblem
    state: FitState
    stride: int


def linearised_at(problem: FitProblem, state: FitState) -> LinearisedFit:
    """Linearise a fit at a state."""
    s = problem.settings
    stride = thinning(problem.raster.shape, MAX_PIXELS)
    length = s.error_reach * float(np.ptp(state.surface.height))
    part = problem.thinned(stride)
    there = state.thinned(part, stride)
    limits = s.robust_limits[-1], s.jump_limits[-1]
    unknowns, fixed = freeze(part, there, *limits, pixels=pixel_terms(problem, state, limits[0]).thinned(stride))
    error = ModelError(model_share(part, there), (length / problem.raster.dy, length / problem.raster.dx), stride)
    edges, linear = edges_of(part, there.surface, limits[1]), linearise(unknowns, fixed)
    edge_error = EdgeError.of(there.surface, *edges)
    planes = part.priors.tilt * part.position
    rim_errors = _rim_errors(edges, fixed, linear.edge_scale)
    of_data = np.hstack([_incidence_error(part, unknowns, fixed), _law_error(part, linear)])
    unfitted = np.asarray(block_diag(of_data, rim_errors))
    return LinearisedFit(linear, Errors(error, edge_error, unfitted), planes, part, there, stride)


def inflated(posterior: Posterior, state: FitState) -> Posterior:
    """Inflate the error bars where a state's instrument, or what the model lacks, contradicts what is stated."""
    for names, min_ratio in INFLATING:
        posterior = posterior.inflated(state.parameters, names, min_ratio)
    return posterior


def _rim_errors(edges: tuple[AxisEdges, AxisEdges], fixed: FixedTerms, scale: float) -> np.ndarray:
    """Compute what one standard deviation of the steepness of every rim does to the edges [edge, outline]."""
    outline, common = (np.concatenate([getattr(e.rims, n).ravel() for e in edges]) for n in ("outline", "common"))
    inverse_std = np.concatenate([np.ravel(w) for w in (fixed.edges.inverse_std_x, fixed.edges.inverse_std_y)])
    change = -scale * inverse_std * common
    return np.where(outline[:, None] == np.unique(outline[outline > 0]), change[:, None], 0.0)


def _incidence_error(problem: FitProblem, unknowns: Unknowns, fixed: FixedTerms) -> np.ndarray:
    """Compute what one standard deviation of the incidence does to the data [residual, 1], [residual, 0] if known."""
    std = problem.geometry.incidence_std
    if not std or problem.optics.beam_shifts is not None:
        return np.zeros((problem.signal.size, 0))
    with jax.enable_x64(True):
        return std * np.asarray(_data_by_incidence(*jax.tree.map(jnp.asarray, (unknowns, fixed)))).reshape(-1, 1)


_data_by_incidence = compiled(data_by_incidence)


def _law_error(problem: FitProblem, linear: Linearised) -> np.ndarray:
    """Compute what one standard deviation of a law that is held does to the data [residual, number].

    Multiple scattering counts as it is: how it follows a law that is held is not computed.
    """
    names = linear.names if problem.is_law_held else ()
    of_law = [i for i, name in enumerate(names) if name.startswith("law[")]
    return linear.instrument[: problem.signal.size, of_law] / HELD


def derivative_of_sums(sums: Anchors, planes: np.ndarray, linear: Linearised) -> np.ndarray:
    """Compute the derivative of sums of heights above the substrate [3 * pixel + parameter, sum]."""
    n, n_pixels = len(sums.value), sums.weight[0].size
    out = np.zeros((3 * n_pixels + len(linear.names), n))
    out[: 3 * n_pixels : 3] = sums.weight.reshape(n, n_pixels).T
    for tilt, plane in zip(tilts_of(linear.names), planes, strict=False):
        out[3 * n_pixels + tilt] = -np.einsum("ayx,yx->a", sums.weight, plane)
    return out


def misfit_of(problem: FitProblem, state: FitState, predict: Predict) -> float:
    """Compute half the chi-square of the data expected at a state; a few data far off count for little.

    Raises:
        PredictionError: nothing can be predicted of the surface.
    """
    return half_chi_square(residuals_of_state(problem, state, predict))


def short_fit(problem: FitProblem, surface: Surface, predict: Predict) -> tuple[float, Surface]:
    """Fit a surface's relief to the data in a few steps, the instrument as at the start of a fit.

    Returns:
        The misfit of what comes out (`misfit_of`), and its surface.

    Raises:
        PredictionError: nothing can be predicted of a surface.
    """
    s, state = problem.settings, predict_corrections(problem, FitState.starting(problem, surface), predict)
    for _ in range(s.reweightings):
        state, _ = step(problem, state, s.robust_limits[-1], s.jump_limits[-1], False)
    return misfit_of(problem, state, predict), state.surface


def after_one_solve(problem: FitProblem, state: FitState) -> np.ndarray:
    """Compute the residuals after one solve from a state, whose corrections are held [detector, y, x]."""
    s = problem.settings
    return step(problem, state, s.robust_limits[-1], s.jump_limits[-1], True)[0].residuals


def fit_heights(
    problem: FitProblem,
    start: Surface,
    predict: Predict,
    report: Report | None = None,
    parameters: Parameters | None = None,
) -> Fit:
    """Fit heights, slopes, gains, offsets and a smooth albedo to the micrographs, without error bars.

    Where changes alternate, the next iteration starts between the last two surfaces (relaxed by `extrapolation`), or
    masks and multiple scattering that overshoot would swing for ever. Where they keep their sign and grow, or
    hardly fall, masks and multiple scattering follow them from then on (`growth`).

    Interrupted from the keyboard after the first iteration, it returns what the last whole one ended in. Where a solve
    ends in a surface that cannot be traced, the step is halved; where that does not help, the one before it is kept.

    Args:
        problem: data, instrument, priors.
        start: heights and slopes, e.g. of the photometric solution.
        predict: multiple scattering and masked form factors on a surface.
        report: called before each outer iteration.
        parameters: to start from; default: `FitProblem.start_parameters`.

    Source: own derivation; Gauss-Newton of optimistix; robust weights (Geman and McClure, 1987).
    """
    s, state = problem.settings, FitState.starting(problem, start, parameters)
    changes: list[float] = []
    reached: FitState | None = None
    solved = state
    last_start, last_change, extrapolated = start.height, np.zeros(start.height.shape), 1.0
    is_interrupted, is_traceable = False, True
    relaxed: float | None = None
    growth = Growth(problem)
    said, before = "start", state
    n_fixed = 0 if problem.is_instrument_unknown else s.fixed_rounds
    for number in range(s.max_rounds):
        try:
            if relaxed is not None:
                state = with_residuals(problem, between(before, state, relaxed))
            before, relaxed = state, None
            if report:
                report(number, s.max_rounds, said)
            growth, state = growth.checked(_updated(problem, state, reached, predict, growth.changes))
            before = reached = state
            occluded = _occlusion_edges(problem, state) if number == n_fixed else None
            stages = list(zip(s.robust_limits, s.jump_limits, strict=True))
            for limit, cut in stages if number == 0 else stages[-1:] * s.reweightings:
                state, found = step(problem, state, limit, cut, number >= n_fixed, occluded)
            state = replace(state, surface=problem.within_neighbours(state.surface))
        except KeyboardInterrupt:
            if not changes:
                raise
            state, is_interrupted = solved, True
            break
        except PredictionError:
            if reached is None:
                raise
            state, is_traceable = with_residuals(problem, reached), False
            break
        step_before, last_start = before.surface.height - last_start, before.surface.height
        change_before, last_change = last_change, state.surface.height - last_start
        solved = state
        changes.append(float(np.sqrt(np.mean(last_change**2))))
        said = f"cost {found.cost:.4g}, height change {changes[-1]:.2f} um"
        if number:
            extrapolated = extrapolation(step_before, change_before, last_change)
        if changes[-1] < s.tolerance_um and number >= n_fixed:
            break
        if n_fixed < number < s.max_rounds - 1 and 0.0 < extrapolated < ALTERNATING:
            relaxed = max(extrapolated, LEAST_RELAXATION)
        if n_fixed < number < s.max_rounds - 1:
            growth = growth.following(before.surface, state.surface, extrapolated)
    undone = 0.0 if is_traceable else 1.0  # the last change is not part of the result
    remaining = (remaining_error(changes, extrapolated) + undone) * last_change
    return Fit(
        problem=problem,
        **_shown(problem, state),
        **_explained(problem, state),
        remaining=remaining,
        posterior=None,
        changes=tuple(changes),
        contraction=contraction_of(changes),
        status=f"{status_of(changes, s.tolerance_um, is_interrupted, is_traceable)}; {found.status}",
        is_interrupted=is_interrupted,
    )


def _updated(
    problem: FitProblem, state: FitState, reached: FitState | None, predict: Predict, growing: Sequence[Surface]
) -> FitState:
    """Predict corrections at a state, or at one nearer to the surface that an iteration `reached` before it; they
    follow `growing` changes."""

    def at(surface: Surface) -> FitState:
        return update_corrections(problem, replace(state, surface=surface), predict, growing)

    return at(state.surface) if reached is None else with_backtracking(at, state.surface, reached.surface)[0]


def interrupted(fit: Fit, when: str) -> Fit:
    """Mark a fit as interrupted in what followed it, unless it was interrupted itself; `when`: "while ..."."""
    return fit if fit.is_interrupted else replace(fit, is_interrupted=True, status=f"interrupted {when}; {fit.status}")


def without_noise_bias(fit: Fit, report: Report | None = None) -> Fit:
    """Subtract the bias by noise from a fit where it matters; `report`: called before that."""
    problem, n_pairs = fit.problem, fit.problem.settings.bias_pairs
    if fit.is_interrupted or not n_pairs or not problem.is_biased_by_noise:
        return fit
    try:
        if report:
            report(len(fit.changes) - 1, problem.settings.max_rounds, "simulating the bias by noise")
        state = subtract_bias(problem, fit.state, *noise_bias(problem, fit.state, n_pairs))
    except KeyboardInterrupt:
        return interrupted(fit, "while the bias by noise was simulated")
    return replace(fit, **_shown(problem, state), **_explained(problem, state), is_bias_subtracted=True)


def with_posterior(fit: Fit, sums: Anchors | None = None) -> Fit:
    """Compute the error bars of a fit, if it was not interrupted and its settings ask for them; `sums`: see above.

    They contain what another instrument that may be right changes of the heights (`Fit.instrument_change`).
    """
    n_samples = fit.problem.settings.samples
    if fit.is_interrupted or not n_samples:
        return fit
    posterior, change = posterior_at(fit.problem, fit.state, n_samples, sums), fit.instrument_change
    posterior = posterior.with_common_mode(fit.remaining)
    if change is not None:
        posterior = posterior.with_common_mode(change)
    return replace(fit, posterior=posterior, is_rival_contained=change is not None and change is fit.rival_change)


def largest_change(changes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the change of heights [y, x] with the largest mean square."""
    return max(changes, key=lambda change: float(np.mean(change**2)))


def at_state(fit: Fit, state: FitState, posterior: Posterior) -> Fit:
    """Move a fit to another state nearby: what follows from surface and parameters, residuals too, is computed anew.

    Predicted masks and multiple scattering stay as they are.
    """
    problem = fit.problem
    state = replace(state, surface=problem.within_neighbours(state.surface))
    state = with_residuals(problem, state)
    weight = cauchy_weight(state.residuals, problem.settings.robust_limits[-1])
    return replace(fit, **_shown(problem, state), residuals=state.residuals, weight=weight, posterior=posterior)


def _shown(problem: FitProblem, state: FitState) -> dict[str, Any]:
    """Compute the fields of a `Fit` that follow from its state."""
    s, parameters, surface = problem.settings, state.parameters, levelled(problem, state)
    return {
        "state": state,
        "surface": surface,
        "normals": surface.normals(problem.shift),
        "albedo": problem.albedo_at(parameters),
        "gain": np.exp(s.gain_std * parameters.log_gain),
        "offset": problem.priors.offset * parameters.offset,
        "instrument": problem.fitted_instrument(parameters),
        "parameters": parameters,
    }


def _occlusion_edges(problem: FitProblem, state: FitState) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the edges that may be occlusion edges; None where the instrument is known."""
    if not problem.is_instrument_unknown:
        return None
    known = problem.signal, problem.variance, state.surface, problem.shift
    return find_occlusion_edges(*known, 1), find_occlusion_edges(*known, 0)


def _explained(problem: FitProblem, state: FitState) -> dict[str, Any]:
    """Compute the fields of a `Fit` that say how a state explains the data, and where it has depth jumps."""
    s = problem.settings
    edges_x, edges_y = edges_of(problem, state.surface, s.jump_limits[-1])
    return {
        "residuals": state.residuals,
        "weight": cauchy_weight(state.residuals, s.robust_limits[-1]),
        "model_share": model_share(problem, state),
        "joined_x": edges_x.joined,
        "joined_y": edges_y.joined,
    }
