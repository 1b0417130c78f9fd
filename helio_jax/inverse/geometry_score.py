"""Whether the micrographs ask for another geometry than an instrument file states as known exactly.

What a wrong direction or distance does to the data, heights, gains and offsets make good in part: the fit looks well
and its heights are wrong. Rao's score test tells without another fit: the gradient of the fit's misfit by the geometry
gives, by the linearised model, the change of geometry that the data ask for, and how well they know it.
"""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.compiling import compiled
from helio_jax.forward.surface import Surface
from helio_jax.geometry_prior import GeometryPrior
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.fit import Fit, linearised_at
from helio_jax.inverse.geometry_change import GeometryScore, largest_changes
from helio_jax.inverse.instrument_report import describe_instrument, plain_name, units_of
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.posterior import Marginal, tilts_of
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.quality import half_chi_square
from helio_jax.inverse.residuals import FixedTerms, Unknowns, residuals, residuals_at, surface_of
from helio_jax.inverse.samples import on_raster
from helio_jax.inverse.state import FitState, set_corrections
from helio_jax.inverse.steps import freeze
from helio_jax.inverse.strain import INSTRUMENT

USUAL_DEG = 3.0
"""Prior standard deviation of polar angles and azimuths of a file that may be wrong [deg]."""
USUAL_DISTANCE = 0.05
"""The same of the sample distance, over that distance."""
_DETERMINED = 0.99
"""A combination of which the data leave more of the prior variance decides nothing."""
FITTED = (
    "the geometry is not what the instrument file states as exact, and was fitted: {named}; background that was not "
    "subtracted can look alike: check it, calibrate the instrument (helio calibrate) or state its [uncertainty]"
)
"""Warning of a fit whose geometry was fitted for what the data say of it."""
DOUBTFUL = (
    "the micrographs may ask for another geometry than the instrument file states as exact: {named}; no fit with an "
    "uncertain geometry was kept{held}: calibrate the instrument (helio calibrate) or state its [uncertainty]"
)
"""Warning of a fit of which the data say so, and whose geometry is as stated."""
RIVAL = (
    "another geometry, gains or offsets explain the micrographs about as well, with heights that differ by up to "
    "{most:.3g} um{contained}: calibrate the instrument (helio calibrate)"
)
"""Warning of a fit with a `Fit.rival_change`."""


NOTABLE = 0.25
"""Heights that another instrument changes by a smaller share of its largest change are not looked at."""


def geometry_warnings(fit: Fit) -> tuple[str, ...]:
    """Say what the data of a fit say of the geometry, where they ask for another one than is stated as exact, and
    whether other instruments explain them about as well."""
    return _of_geometry(fit) + _of_rival(fit)


def _of_rival(fit: Fit) -> tuple[str, ...]:
    """Warn of another instrument; not where the error bars without it are wider than the heights differ."""
    rival, contained = fit.rival_change, ""
    if rival is None:
        return ()
    size = np.abs(rival)
    counts = size >= NOTABLE * size.max()
    if fit.posterior is not None:
        if not fit.is_rival_contained:
            return ()
        counts &= 2.0 * rival**2 > fit.posterior.height_std**2
        contained = "; the error bars contain the difference"
    return (RIVAL.format(most=float(size[counts].max()), contained=contained),) if counts.any() else ()


def _of_geometry(fit: Fit) -> tuple[str, ...]:
    score = fit.geometry_score
    if score is None:
        return ()
    if not fit.is_geometry_fitted:
        is_held = fit.posterior is not None and not fit.is_rival_contained
        held = ", but the error bars hold what it would change" if is_held else ""
        return (DOUBTFUL.format(named=largest_changes(score.values), held=held),)
    if fit.posterior is None:
        return (FITTED.format(named=f"{largest_changes(score.values)}, an estimate from before the fit"),)
    fitted = describe_instrument(fit)["values"]
    values = {name: tuple(fitted[name][i] for i in (0, 1, 3)) for name in score.values if name in fitted}
    return (FITTED.format(named=largest_changes(values or score.values)),)


def usual_uncertainty(problem: FitProblem) -> Uncertainty:
    """Make the uncertainty of an instrument whose file may be wrong by as much as they often are.

    What the file states as uncertain stays as it is.
    """
    stated = Uncertainty() if problem.instrument is None else problem.instrument.uncertainty
    distance = problem.geometry.distance_std or USUAL_DISTANCE * float(problem.optics.sample_distance)
    usual = {"polar_deg": USUAL_DEG, "azimuth_deg": USUAL_DEG, "sample_distance_um": distance}
    return stated.model_copy(update=usual)


def score_geometry(fit: Fit) -> GeometryScore | None:
    """Test the geometry of a fit; None where directions are uncertain already, or not to be fitted.

    The fit is taken to have converged: its misfit does not fall with surface and parameters.

    Source: Rao, Proc. Camb. Phil. Soc. 44 (1948) 50; the Bayes factor is that of the estimate, which is normal with
        and without the change (as Wakefield, Genet. Epidemiol. 33 (2009) 79, eq. 2, in several dimensions).
    """
    p, s = fit.problem, fit.problem.settings
    if not s.geometry or p.geometry.is_aimed:
        return None
    free = replace(p, geometry=GeometryPrior.of_uncertainty(usual_uncertainty(p), len(p.signal)))
    state = _with_geometry(fit, free)
    at = linearised_at(free, state)
    unknowns, fixed = freeze(free, state, s.robust_limits[-1], s.jump_limits[-1])
    with jax.enable_x64(True):
        by_surface, by = jax.tree.map(np.asarray, _gradient(unknowns, fixed))
    found, names = Marginal.of(at.linear), at.linear.names
    gradient = np.concatenate([np.ravel(getattr(by, name)) for name in unknowns.parameters.free()])
    surface, estimate = found.times(-_of_kept(by_surface, at.stride), -gradient)
    exact = [name for name in ("distance", "aim") if not getattr(fit.parameters, name).size]
    own = np.array([name.partition("[")[0] in exact for name in names])
    spread = at.errors.covariance(found.influence()[:, own])
    log_bayes = _log_bayes(estimate[own], found.covariance[np.ix_(own, own)], spread)
    matrix, units = units_of(free, names)
    matrix = matrix[np.ix_(own, own)]
    height_change = on_raster(surface[::3].reshape(at.linear.shape), p.raster.shape, at.stride)
    tilts = tilts_of(names)
    height_change -= np.tensordot(estimate[tilts], (free.priors.tilt * free.position)[: len(tilts)], 1)
    changes, std = matrix @ estimate[own], np.sqrt(np.diag(matrix @ spread @ matrix.T))
    shown = (plain_name(names[i], fit.instrument.detector_names) for i in np.flatnonzero(own))
    values = zip(changes.tolist(), std.tolist(), np.array(units)[own].tolist(), strict=True)
    return GeometryScore(
        log_bayes,
        dict(zip(shown, values, strict=True)),
        _moved(state.parameters, estimate),
        height_change,
    )


def _moved(parameters: Parameters, change: np.ndarray) -> Parameters:
    """Add a change to the free parameters, in their order [parameter]."""
    own, moved = [np.asarray(getattr(parameters, name)) for name in parameters.free()], {}
    parts = np.split(change, np.cumsum([value.size for value in own])[:-1])
    for name, value, part in zip(parameters.free(), own, parts, strict=True):
        moved[name] = value + part.reshape(value.shape)
    return parameters.replaced(**moved)


def surface_misfit(fit: Fit) -> float:
    """Compute half the sum of the squared residuals of a fit's last solve, the instrument's pulls left out.

    Those of the data, limited as elsewhere, and of what holds the surface together: a wrong geometry shows in slopes
    that no surface has.
    """
    s = fit.problem.settings
    unknowns, fixed = freeze(fit.problem, fit.state, s.robust_limits[-1], s.jump_limits[-1])
    with jax.enable_x64(True):
        found = residuals(unknowns, fixed)
        of_surface = sum(np.sum(np.square(r)) for name, r in found.items() if name not in ("data", *INSTRUMENT))
    return half_chi_square(fit.residuals) + 0.5 * float(of_surface)


def _with_geometry(fit: Fit, free: FitProblem) -> FitState:
    """Return a fit's state in a problem whose geometry is uncertain: at the stated one."""
    held, means = fit.state.held, free.prior_means()
    before = fit.state.parameters
    parameters = before.replaced(aim=means.aim, distance=before.distance if before.distance.size else means.distance)
    state = set_corrections(free, replace(fit.state, parameters=parameters), held.corrections, held.surface)
    now = replace(state.held, responses=held.responses, law_rate=held.law_rate, law_at=held.law_at)
    return replace(state, held=now)


@compiled
def _gradient(unknowns: Unknowns, fixed: FixedTerms) -> tuple[Surface, Parameters]:
    """Compute the gradient of half the sum of the squared residuals by surface and parameters."""

    def misfit(at: tuple[Surface, Parameters]) -> jax.Array:
        return 0.5 * jnp.sum(jnp.stack([jnp.sum(r**2) for r in residuals_at(*at, fixed).values()]))

    return jax.grad(misfit)((surface_of(unknowns, fixed), unknowns.parameters))


def _of_kept(gradient: Surface, stride: int) -> np.ndarray:
    """Compute the gradient by the kept pixels of a thinned raster [3 * pixel], linear interpolation between them."""
    fields = np.stack([gradient.height, gradient.slope_x, gradient.slope_y], -1)
    of_rows, of_columns = (
        np.stack([np.interp(np.arange(n), np.arange(0, n, stride), one) for one in np.eye(-(-n // stride))])
        for n in fields.shape[:2]
    )
    return np.einsum("iy,yxf,jx->ijf", of_rows, fields, of_columns).ravel()


def _log_bayes(estimate: np.ndarray, covariance: np.ndarray, spread: np.ndarray) -> float:
    """Compute the logarithm of the Bayes factor of uncertain parameters over exact ones.

    An estimate m, drawn towards 0 by the prior, is normal about 0 with the covariance N = C - C^2 + (S - C) if the
    parameters are 0, and with N + (1 - C)^2 if they are as uncertain as the prior says.

    Args:
        estimate: m, in prior deviations [parameter].
        covariance: C, that it has were all errors independent [parameter, parameter].
        spread: S, that it has with errors that agree between pixels.
    """
    left, ways = np.linalg.eigh(covariance)
    ways = ways[:, left < _DETERMINED]
    size, along = np.linalg.eigh(spread - covariance)
    more = along * np.maximum(size, 0.0) @ along.T  # errors that agree tell no more than independent ones
    m, c = ways.T @ estimate, ways.T @ covariance @ ways
    exact = ways.T @ (covariance - covariance @ covariance + more) @ ways
    uncertain = exact + (np.eye(len(m)) - c) @ (np.eye(len(m)) - c)
    return _log_density(m, uncertain) - _log_density(m, exact)


def _log_density(value: np.ndarray, covariance: np.ndarray) -> float:
    """Compute the logarithm of a normal density about 0."""
    size = np.linalg.slogdet(covariance)[1]
    return -0.5 * float(value @ np.linalg.solve(covariance, value) + size + len(value) * math.log(2.0 * math.pi))
