"""The inverse problem: frozen records of data, state and corrections, and the terms that one solve holds fixed.

`FitProblem` does not change during a fit; `FitState` is all that does; `freeze` makes `FixedTerms` of both. Unknowns
are heights and two slopes of every pixel and the `Parameters`. They are whitened so that plain conjugate gradients
converge in a few steps: heights by the cosine transform, h = DCT^-1(y / sqrt(lambda)), for the data fix slopes; slopes
as deviations from the heights' one-sided differences. Pure functions; nothing is changed in place.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.fft import dctn
from scipy.ndimage import maximum_filter, minimum_filter

from helio_jax.arrays import border_mask
from helio_jax.forward.form_factor import form_factor_at
from helio_jax.forward.masking import masked_form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.readout import ScanOrder, drift_modes
from helio_jax.forward.render import Corrections, single_scattering
from helio_jax.forward.surface import Surface, one_sided, to_pixels
from helio_jax.instrument import Instrument, Uncertainty
from helio_jax.inverse.edges import AxisEdges, find_edges, smoothness_weight
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.residuals import (
    CommonModes,
    Edges,
    FixedTerms,
    FormFactors,
    Parameters,
    Priors,
    Unknowns,
    expected_data,
    moves_of,
    second_order_noise_bias,
    surface_of,
)
from helio_jax.inverse.responses import Response, normal_slope, region_responses, relief_responses
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.solver import Solution, solve, whitened_parameters
from helio_jax.robust import cauchy_weight

LEVEL_STD = 0.1
"""Standard deviation of a held mean height [um]."""
_NOISY = 3.0
"""Largest standard deviation that slopes are credited with, in that of a pixel with median noise."""
MODE_BLOCK = 4
"""Common modes are filled up to a multiple of this."""
_HELD = 1e-5
"""Least prior weight of a height, 1/um: holds a pixel that all edges separate from the others."""

Predict = Callable[..., Corrections]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Corrections; the instrument is given, too, where it is unknown."""


@dataclass(frozen=True)
class FitProblem:
    """What is constant during a fit.

    Attributes:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        optics: as stated.
        uncertainty: prior standard deviations of the geometry.
        raster: beam positions.
        settings: of the fit.
        order: in which the pixels were recorded.
        border: prior weight of each height above the substrate [y, x], 1/um.
        is_level_held, is_level_free: whether the mean height is held, or unknown; a flat border does neither.
        held_level: mean height that is held, over its standard deviation.
        region: number of the plateau of every pixel, whose masks are to follow their levels, 0: none [y, x].
        drift_modes: shapes of the slow drift [detector or 1, mode, y, x].
        median_signal: of every detector, 1 without data [detector].
        slope_noise: typical standard deviation of the slopes of one pixel.
        instrument: that the optics are of, None where they are given alone.
        stride: thinning of the raster; every datum stands for stride^2.
    """

    signal: np.ndarray
    variance: np.ndarray
    optics: Optics
    uncertainty: Uncertainty
    raster: Raster
    settings: RefineSettings
    order: ScanOrder
    border: np.ndarray
    is_level_held: bool
    is_level_free: bool
    held_level: float
    region: np.ndarray
    drift_modes: np.ndarray
    median_signal: np.ndarray
    slope_noise: float
    instrument: Instrument | None = None
    stride: int = 1

    @classmethod
    def of(
        cls,
        signal: np.ndarray,
        variance: np.ndarray,
        instrument: Instrument | Optics,
        raster: Raster,
        start: Surface,
        settings: ReconstructSettings,
        region: np.ndarray | None = None,
        order: ScanOrder = ScanOrder(),
        uncertainty: Uncertainty | None = None,
    ) -> "FitProblem":
        """Pose the problem; `start` fixes the level that is held, where the settings ask for it.

        `uncertainty` replaces the instrument's; optics alone are known exactly by default.
        """
        given, optics = (None, instrument) if isinstance(instrument, Optics) else (instrument, Optics.of(instrument))
        stated = uncertainty or (Uncertainty() if given is None else given.uncertainty)
        s, shape = settings.refine, signal.shape[1:]
        is_free = settings.border == "free"
        is_held = is_free and s.level_std_um is not None
        modes = drift_modes(shape, order, s.drift_degrees) if s.drift_std else np.zeros((1, 0, *shape))
        observed = [d[np.isfinite(d)] for d in signal]
        median = np.array([np.median(d) if d.size else 1.0 for d in observed])
        noise = float(np.clip(np.sqrt(np.nanmedian(variance / median[:, None, None] ** 2)), 1e-3, 1.0))
        problem = cls(
            signal, variance, optics, stated, raster, s, order, _border_weight(shape, settings), is_held,
            is_free and not is_held, 0.0, np.zeros(shape, int) if region is None else region, modes, median,
            noise, given,
        )  # fmt: skip
        return replace(problem, held_level=float(np.sum(problem.level_weight * start.height)))

    @property
    def shift(self) -> np.ndarray:
        """Beam shift [2]."""
        return np.asarray(self.optics.beam_shift)

    @property
    def is_observed(self) -> np.ndarray:
        """Where there are data [detector, y, x]."""
        return np.isfinite(self.signal)

    @property
    def data(self) -> np.ndarray:
        """The signal, 0 where not observed [detector, y, x]."""
        return np.where(self.is_observed, self.signal, 0.0)

    @property
    def has_enough_images(self) -> np.ndarray:
        """Where enough images show the surface [y, x]."""
        return self.is_observed.sum(0) >= MIN_IMAGES

    @property
    def level_weight(self) -> np.ndarray:
        """Weights [y, x] of the mean height over its standard deviation, or 0 where nothing holds it."""
        enough = self.has_enough_images
        return self.is_level_held * enough / np.maximum(enough.sum(), 1) / LEVEL_STD

    @property
    def position(self) -> np.ndarray:
        """Positions (x, y) about the middle of the raster [2, y, x], um."""
        centred = Raster.regular(self.raster.shape, self.raster.dx, self.raster.dy)
        return np.stack(np.meshgrid(centred.x, centred.y))

    @property
    def priors(self) -> Priors:
        """Prior standard deviations of the parameters; a held level stands for the distance."""
        s, stated, median = self.settings, self.uncertainty, self.median_signal
        held = s.level_std_um if self.is_level_held else None
        numbers = {
            "gain": s.gain_std,
            "offset": s.offset_std * median,
            "multiple": s.multiple_error,
            "albedo": s.albedo_std,
            "drift": s.drift_std * median,
            "lines": s.line_std * median,
            "law": s.law_std,
            "distance": held or stated.sample_distance_um,
            "tilt": math.radians(stated.tilt_deg),
            "aim": np.radians([stated.polar_deg, stated.azimuth_deg]),
        }
        return Priors(**{name: np.asarray(value, float) for name, value in numbers.items()})

    def prior_means(self) -> Parameters:
        """Make the parameters at their prior means, all 0; those that are known have no entries."""
        s, stated = self.settings, self.uncertainty
        k, n = self.signal.shape[0], s.albedo_modes if s.albedo_std else 0
        lines = self.signal.shape[1 + self.order.slow_axis] if s.line_std else 0
        is_aimed = s.geometry and (stated.polar_deg or stated.azimuth_deg)
        shapes = {
            "log_gain": k,
            "offset": k,
            "log_multiple": k,
            "occluded": (),
            "albedo": (n, n),
            "drift": (k, self.drift_modes.shape[1]),
            "lines": (k, lines),
            "law": 1 if s.law_std else 0,
            "distance": 1 if s.geometry and float(self.priors.distance) else 0,
            "tilt": 2 if s.geometry and stated.tilt_deg else 0,
            "aim": (k, 2) if is_aimed else 0,
        }
        return Parameters(**{name: np.zeros(shape) for name, shape in shapes.items()})

    @property
    def is_instrument_unknown(self) -> bool:
        """Whether more is unknown of the instrument than gains and offsets: drift or geometry."""
        p = self.prior_means()
        return bool(p.distance.size or p.aim.size or p.drift.shape[1])

    def moves(self, parameters: Parameters) -> np.ndarray:
        """Compute distance [um], polar angle and azimuth [rad] beyond the stated ones [move, detector]."""
        with jax.enable_x64(True):
            return np.asarray(moves_of(jax.tree.map(jnp.asarray, parameters), self.priors, len(self.signal)))

    def fitted_instrument(self, parameters: Parameters) -> Instrument:
        """Return the instrument with the geometry that parameters stand for."""
        assert self.instrument is not None  # of a measurement
        moves = self.moves(parameters)
        return self.instrument.moved(moves[1:].T, float(moves[0, 0])) if len(moves) else self.instrument

    def thinned(self, stride: int) -> "FitProblem":
        """Keep every `stride`-th row and column, each standing for stride^2 data."""
        thin = (slice(None, None, stride),) * 2
        return replace(
            self,
            signal=self.signal[:, *thin],
            variance=self.variance[:, *thin],
            raster=Raster.regular(self.signal[0][thin].shape, self.raster.dx * stride, self.raster.dy * stride),
            order=self.order.thinned(thin),
            border=self.border[thin],
            region=self.region[thin],
            drift_modes=self.drift_modes[:, :, *thin],
            stride=stride,
        )


@dataclass(frozen=True)
class Held:
    """Corrections and what follows from them, held fixed until the next outer iteration.

    Attributes:
        corrections: made for `surface`.
        surface: heights and slopes.
        masked: masked form factors as a linear model in the own normal [detector, 3, y, x].
        multiple: the multiple scattering that goes with it [detector, y, x].
        sigma: standard deviation of the data, prediction errors included, infinite where not observed [detector, y, x].
        moves: derivative of the masked form factors by distance, polar angle, azimuth [move, detector, 3, y, x].
        moved: the moves at which they were made [move, detector].
        responses: how they follow common changes of the heights.
    """

    corrections: Corrections
    surface: Surface
    masked: np.ndarray
    multiple: np.ndarray
    sigma: np.ndarray
    moves: np.ndarray
    moved: np.ndarray
    responses: tuple[Response, ...] = ()


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
    def at(cls, problem: FitProblem, start: Surface) -> "FitState":
        """Start at a surface, parameters at their prior means, without corrections."""
        surface = Surface(*(np.asarray(f) for f in (start.height, start.slope_x, start.slope_y)))
        held = _held(problem, Corrections.none(problem.signal.shape), surface, problem.prior_means())
        return cls(surface, problem.prior_means(), np.zeros(problem.signal.shape), held)

    def thinned(self, problem: FitProblem, stride: int) -> "FitState":
        """Keep every `stride`-th row and column, for `problem`, which is thinned."""
        thin = (slice(None, None, stride),) * 2
        h, c = self.held, self.held.corrections
        held = _held(
            problem,
            Corrections(
                c.masked[:, :, *thin],
                c.multiple[:, *thin],
                None if c.occluded is None else c.occluded[:, *thin],
                None if c.normals is None else c.normals[thin],
            ),
            jax.tree.map(lambda f: f[thin], h.surface),
            self.parameters,
        )
        held = replace(
            held,
            moves=h.moves[..., *thin],
            moved=h.moved,
            responses=tuple(r.thinned(thin, stride) for r in h.responses),
        )
        lines = self.parameters.lines[:, ::stride]
        surface = jax.tree.map(lambda f: f[thin], self.surface)
        return FitState(surface, self.parameters.replaced(lines=lines), self.residuals[:, *thin], held)


def _border_weight(shape: tuple[int, ...], settings: ReconstructSettings) -> np.ndarray:
    """Compute the prior weight of each height: the border is flat, or just the mean height is held.

    The outermost ring is enough to level the heights; drift needs all of the border to be distinguished from relief.
    """
    weight = np.full(shape, _HELD)
    if settings.border == "flat":
        width = settings.border_fraction if settings.refine.drift_std > 0 else 1.0 / max(shape)
        weight[border_mask((shape[0], shape[1]), width)] = 1.0 / settings.border_std_um
    else:
        weight[:] = 1e-3 / settings.border_std_um / np.sqrt(weight.size)
    return weight


def _whitening(shape: tuple[int, int], dx: float, dy: float, slope_noise: float) -> np.ndarray:
    """Compute the standard deviation of each cosine mode of the heights that a slope noise per pixel leaves, um."""
    ky = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[0]) / shape[0]) / dy
    kx = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[1]) / shape[1]) / dx
    eigenvalue = ky[:, None] ** 2 + kx[None, :] ** 2
    eigenvalue[0, 0] = eigenvalue.ravel()[1:].min()
    return slope_noise / np.sqrt(eigenvalue)


def linearised_in_normal(corrections: Corrections, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make masks and multiple scattering a linear model of the own normal, about the corrections' or given ones.

    The slope of multiple scattering is added to the masked form factor and changes nothing at the facet's own normal:
    it only makes the iterations converge faster beside steep walls, where slope and multiple scattering depend on one
    another (`responses.normal_slope`).

    Args:
        corrections: of a surface.
        normals: its unit normals [y, x, 3].
    """
    up = (normals if corrections.normals is None else corrections.normals)[..., 2]
    slope = normal_slope(corrections.multiple, up)
    masked = np.array(corrections.masked)
    masked[:, 2] += slope
    return masked, corrections.multiple + slope * up


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
    masked, multiple = linearised_in_normal(corrections, normals)
    variance = problem.variance + prediction_std(corrections, normals, problem.settings) ** 2
    sigma = np.where(problem.is_observed, np.sqrt(variance), np.inf)
    moves = np.zeros((len(moved), *corrections.masked.shape))
    return Held(corrections, surface, masked, multiple, sigma, moves, moved)


def set_corrections(problem: FitProblem, state: FitState, corrections: Corrections, surface: Surface) -> FitState:
    """Take corrections, made on a surface, for all solves until the next ones."""
    held = _held(problem, corrections, surface, state.parameters)
    if len(held.moved):
        optics, fields = problem.optics, (surface.height, surface.slope_x, surface.slope_y)
        with jax.enable_x64(True):
            moves = _masked_moves(Surface(*map(jnp.asarray, fields)), optics, problem.raster, held.moved)
        held = replace(held, moves=np.asarray(moves))
    return replace(state, held=held)


def update_corrections(problem: FitProblem, state: FitState, predict: Predict) -> FitState:
    """Predict masks and multiple scattering on the current surface, and how they follow common changes of heights."""
    surface, is_known = state.surface, not len(problem.moves(state.parameters))
    instrument = () if is_known else (problem.fitted_instrument(state.parameters),)
    corrections = predict(surface.height, surface.normals(problem.shift), *instrument)
    return with_responses(problem, set_corrections(problem, state, corrections, surface))


def with_responses(problem: FitProblem, state: FitState) -> FitState:
    """Compute how the corrections follow the levels of plateaus and, with a free border, changes of all heights."""
    surface, raster = state.held.surface, problem.raster
    optics = moved_optics(problem.optics, problem.moves(state.parameters))
    responses = region_responses(surface, optics, raster, problem.region)
    if problem.is_level_free or problem.is_level_held:
        distance = float(problem.optics.sample_distance)
        responses += relief_responses(surface, optics, raster, problem.has_enough_images, distance)
    return replace(state, held=replace(state.held, responses=responses))


def moved_optics(optics: Optics, moves: Any) -> Optics:
    """Move a stated geometry by distance, polar angle and azimuth [move, detector]; no moves: as stated."""
    return optics if not len(moves) else optics.moved(distance=moves[0, 0], polar=moves[1], azimuth=moves[2])


@eqx.filter_jit
def _masked_moves(surface: Surface, optics: Optics, raster: Raster, moved: Any) -> jax.Array:
    """Compute the derivative of the masked form factors by distance, polar angle and azimuth, each detector by its own.

    Each aperture depends on its own polar angle and azimuth only, so that one derivative serves all detectors.
    """

    def masked(step):
        return masked_form_factor(surface, moved_optics(optics, moved + step[:, None]), raster)

    return jnp.moveaxis(jax.jacfwd(masked)(jnp.zeros(3)), -1, 0)


@eqx.filter_jit
def _form_factors(optics: Optics, moved: Any, height: Any, held: tuple) -> FormFactors:
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
    direction = terms[0] / jnp.sqrt(jnp.sum(terms[0] ** 2, 1, keepdims=True))
    masked = masked + jnp.einsum("mk,mkiyx->kiyx", moved - masked_at, masked_moves)
    return FormFactors(
        height,
        terms.at[0].add(-masked),
        direction,
        by_moves(height) - masked_moves,
        moved,
        mean,
        level[:, :, :2, 0],
        by_moves(mean[None])[:, :, :2, 0],
        form_factor_at(optics, jnp.zeros(1))[:, :2, 0],
    )


_noise_bias = eqx.filter_jit(second_order_noise_bias)
_expected = eqx.filter_jit(
    lambda unknowns, fixed: expected_data(surface_of(unknowns, fixed), unknowns.parameters, fixed)
)


def edges_of(
    problem: FitProblem, surface: Surface, cut: float, occluded: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[AxisEdges, AxisEdges]:
    """Find the edges of a surface along x and along y; those that are `occluded` count as depth jumps."""
    found = (
        find_edges(surface.height, surface.slope_x, problem.raster.dx, 1, problem.slope_noise, cut),
        find_edges(surface.height, surface.slope_y, problem.raster.dy, 0, problem.slope_noise, cut),
    )
    if occluded is None:
        return found
    along_x, along_y = (replace(e, joined=np.where(o, 0.0, e.joined)) for e, o in zip(found, occluded, strict=True))
    return along_x, along_y


def freeze(
    problem: FitProblem,
    state: FitState,
    limit: float,
    cut: float,
    occluded: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Unknowns, FixedTerms]:
    """Fix corrections, edges and robust weights at a state; return the state as unknowns, too.

    Args:
        problem: the data.
        state: current surface and parameters.
        limit: residual at which a datum's weight falls to a half [standard deviations].
        cut: misfit at which an edge loses most of its weight [standard deviations].
        occluded: edges to cut along x and y.
    """
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
        smoothness_weight(along_x.joined, slope_x, noise, 1),
        smoothness_weight(along_y.joined, slope_y, noise, 0),
    )
    steepness = 1.0 + slope_x**2 + slope_y**2  # of slopes against normals
    scale_x, scale_y = (_slope_scale(e, axis, noise * steepness) for e, axis in ((along_x, 1), (along_y, 0)))
    whitening = _whitening(problem.raster.shape, dx, dy, noise)
    unknowns = Unknowns(
        dctn(height, norm="ortho") / whitening,
        (slope_x - one_sided(np.diff(height, axis=1) / dx, along_x.joined, 1)) / scale_x,
        (slope_y - one_sided(np.diff(height, axis=0) / dy, along_y.joined, 0)) / scale_y,
        state.parameters,
    )
    inverse_sigma = cauchy_weight(state.residuals, limit) / held.sigma
    priors, moved = problem.priors, problem.moves(state.parameters)
    with jax.enable_x64(True):
        factors = _form_factors(problem.optics, moved, height, (held.masked, held.moves, held.moved))
        largest = _NOISY * noise * steepness
        bias = _noise_bias(slope_x, slope_y, factors.terms[0], problem.shift, inverse_sigma, largest)
    occluded_std = held.corrections.occluded
    fixed = FixedTerms(
        data=problem.data,
        inverse_sigma=inverse_sigma * problem.stride,
        form_factors=factors,
        multiple=held.multiple,
        occluded=np.zeros(problem.signal.shape) if occluded_std is None else occluded_std,
        noise_bias=bias,
        modes=_common_modes(held, np.exp(priors.gain * state.parameters.log_gain)),
        drift_modes=problem.drift_modes,
        position=problem.position,
        edges=edges,
        border=problem.border,
        level_weight=problem.level_weight,
        held_level=problem.held_level,
        whitening=whitening,
        slope_scale_x=scale_x,
        slope_scale_y=scale_y,
        priors=priors,
        beam_shift=problem.shift,
        dx=dx,
        dy=dy,
        slow_axis=problem.order.slow_axis,
    )
    as_array = lambda a: np.asarray(a, float)  # noqa: E731
    return jax.tree.map(as_array, unknowns), jax.tree.map(as_array, fixed)


def _common_modes(held: Held, gain: np.ndarray) -> CommonModes:
    """Stack the responses, filled up with empty ones, so that one compilation serves different numbers of them."""
    n, shape = len(held.responses), held.multiple.shape
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
    free, mixing_is_whitened = np.asarray(float(is_instrument_free)), problem.is_instrument_unknown
    with jax.enable_x64(True):
        if is_instrument_free and (mixing_is_whitened or problem.is_level_free):
            mixing = whitened_parameters(start, fixed, np.asarray(float(problem.is_level_free)))
        else:  # as they are, where they are held or little is unknown
            n = sum(getattr(start.parameters, name).size for name in start.parameters.free())
            mixing = np.diag([1.0] * n + [0.0])
        # the switch is an array: one compilation serves both cases
        found = jax.tree.map(np.asarray, solve(start, fixed, s.lm_steps, s.cg_steps, mixing, free))
    residuals = (found.data - problem.data) / state.held.sigma
    return replace(state, surface=found.surface, parameters=found.parameters, residuals=residuals), found


def expected(problem: FitProblem, state: FitState, *, is_noisy: bool) -> np.ndarray:
    """Compute the data expected at a state, whose slopes may be noisy ones; 0 where not observed."""
    unknowns, fixed = freeze(problem, state, problem.settings.robust_limits[-1], problem.settings.jump_limits[-1])
    if not is_noisy:
        fixed = eqx.tree_at(lambda f: f.noise_bias, fixed, np.zeros(problem.signal.shape))
    with jax.enable_x64(True):
        return np.where(problem.is_observed, np.asarray(_expected(unknowns, fixed)), 0.0)


def levelled(problem: FitProblem, state: FitState) -> Surface:
    """Return the surface above the substrate, which may be tilted."""
    s, tilt = state.surface, problem.priors.tilt * state.parameters.tilt
    if not tilt.size:
        return s
    return Surface(s.height - np.tensordot(tilt, problem.position, 1), s.slope_x - tilt[0], s.slope_y - tilt[1])


def misfit(problem: FitProblem, state: FitState, limit: float, cut: float) -> float:
    """Compute half the robust chi-square of data and edges, with the data's normalisation."""
    data = 0.5 * limit**2 * np.sum(1.0 - cauchy_weight(state.residuals, limit))
    data += np.sum(np.log(state.held.sigma[problem.is_observed]))
    edges = edges_of(problem, state.surface, cut)
    return float(data + sum(0.5 * cut**2 * np.sum(1.0 - np.sqrt(e.joined)) for e in edges))


def model_share(problem: FitProblem, state: FitState) -> np.ndarray:
    """Compute the share of prediction errors in the variance of every datum; 0 where not observed [detector, y, x]."""
    share = np.maximum(1.0 - problem.variance / state.held.sigma**2, 0.0)
    return np.where(problem.is_observed, share, 0.0)
