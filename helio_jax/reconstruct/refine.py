"""Fit the heights themselves to the micrographs through the render model (the only door to optimistix).

Unknowns: height and two slopes of every pixel, gain and offset of every detector, a smooth albedo. Outer loop:
predict multiple scattering and hidden aperture parts on the current surface (a callable that the pipeline supplies,
so this stage knows no tracer), decide which edges are smooth, kinked or cut (`edges`), renew the robust weights, then
a few Levenberg-Marquardt steps. All of that is lagged: constant during a step.

The unknowns are whitened so that plain conjugate gradients converge in a few steps: heights by the cosine transform,
h = DCT^-1(y / sqrt(lambda)), for the data fix slopes; slopes as deviations from the heights' one-sided differences.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from scipy.fft import dctn

from helio_jax.arrays import border_mask
from helio_jax.reconstruct.edges import Edges, find_edges, geman_mcclure, one_sided, to_pixels
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.model import Lagged, Model, Prediction, Surface, Unknowns, smooth_albedo
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.uncertainty import MAX_PIXELS, Posterior, linearise, sample_posterior

_FIRST_STEP_SIZE, _SHRINK = 1e3, 0.1
"""Inverse of the first Levenberg-Marquardt damping, in whitened variables, and its factor after a rejected step."""

Predict = Callable[[np.ndarray, np.ndarray], Prediction]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Prediction."""
Report = Callable[[int, int, str], None]
"""Called with (round, rounds in all, what is known so far)."""


class _TruncatedCG(lx.CG):
    """Conjugate gradients whose best iterate counts when the step limit is met (an inexact Newton step)."""

    def compute(self, state, vector, options):
        solution, _, stats = super().compute(state, vector, options)
        return solution, lx.RESULTS.successful, stats


class _NearlyNewton(optx.ClassicalTrustRegion):
    """Trust region that starts with little damping: the start is good, and damping would freeze weak modes."""

    def init(self, y, f_info_struct):
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, jnp.asarray(_FIRST_STEP_SIZE))


@dataclass(frozen=True)
class Fit:
    """Result of the fit; arrays as in `Reconstruction`.

    Attributes:
        surface: heights and slopes.
        normals: unit normals [y, x, 3].
        albedo: relative reflectivity [y, x].
        gain, offset: per detector, data = gain * model + offset.
        residuals: (model - data) / standard deviation [detector, y, x].
        weight: what robust weighting left of each datum [detector, y, x].
        intact_x, intact_y: what is left of the edges between pixels [y, x - 1], [y - 1, x]; 0 at a jump.
        posterior: error bars, or None where none were asked for.
        changes: root mean square height change of every round [um].
        contraction: ratio of the last two changes, or None.
        status: a sentence: how the fit ended.
        is_converged: whether it reached its tolerance.
        is_interrupted: whether it was stopped from the keyboard.
    """

    surface: Surface
    normals: np.ndarray
    albedo: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    residuals: np.ndarray
    weight: np.ndarray
    intact_x: np.ndarray
    intact_y: np.ndarray
    posterior: Posterior | None
    changes: tuple[float, ...]
    contraction: float | None
    status: str
    is_converged: bool
    is_interrupted: bool = False


def _whitening(shape: tuple[int, int], dx: float, dy: float, slope_noise: float) -> np.ndarray:
    """Return the deviation of each cosine mode of the heights that a slope noise per pixel leaves, um."""
    ky = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[0]) / shape[0]) / dy
    kx = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[1]) / shape[1]) / dx
    eigenvalue = ky[:, None] ** 2 + kx[None, :] ** 2
    eigenvalue[0, 0] = eigenvalue.ravel()[1:].min()
    return slope_noise / np.sqrt(eigenvalue)


class Solution(NamedTuple):
    """One solve: unknowns, surface, expected data, steps taken, and the cost of every kind of residual."""

    unknowns: Unknowns
    surface: Surface
    counts: jax.Array
    n_steps: jax.Array
    cost: dict[str, jax.Array]


@eqx.filter_jit
def _solve(model: Model, start: Unknowns, lagged: Lagged, max_steps: int, cg_steps: int) -> Solution:
    solver = optx.LevenbergMarquardt(
        rtol=1e-4, atol=1e-6, linear_solver=lx.Normal(_TruncatedCG(rtol=1e-2, atol=1e-12, max_steps=cg_steps))
    )
    solver = eqx.tree_at(
        lambda s: s.search, solver, _NearlyNewton(low_constant=_SHRINK), is_leaf=lambda n: n is solver.search
    )
    found = optx.least_squares(
        lambda u, args: model.residuals(u, args), solver, start, args=lagged, max_steps=max_steps, throw=False
    )
    surface = model.surface(found.value, lagged)
    counts = model.counts(surface, found.value, lagged)
    cost = {name: 0.5 * jnp.sum(r**2) for name, r in model.residuals(found.value, lagged).items()}
    return Solution(found.value, surface, counts, found.stats["num_steps"], cost)


class Refiner:
    """State of one fit: the data, the current surface and instrument, and the lagged quantities."""

    def __init__(
        self, signal, variance, geometry, dx, dy, start: Surface, settings: ReconstructSettings, region=None
    ) -> None:
        s = settings.refine
        self.signal, self.variance, self.settings = signal, variance, s
        self.model = Model(geometry, dx, dy, s.albedo_std)
        self.shift = geometry.instrument.beam_shift
        self.observed = np.isfinite(signal)
        self.mean_signal = np.array(
            [np.median(d[o]) if o.any() else 1.0 for d, o in zip(signal, self.observed, strict=True)]
        )
        relative = np.sqrt(np.nanmedian(variance / self.mean_signal[:, None, None] ** 2))
        self.slope_noise = float(np.clip(relative, 1e-3, 1.0))
        shape = start.height.shape
        self.whitening = _whitening(shape, dx, dy, self.slope_noise)
        self.border = _border_weight(shape, settings)
        self.plateau = _plateau_weights(np.zeros(shape, int) if region is None else region)
        self.surface = Surface(*map(np.asarray, start))
        k, n = signal.shape[0], s.albedo_modes
        self.log_gain, self.offset, self.log_multiple, self.albedo = (
            np.zeros(k),
            np.zeros(k),
            np.zeros(k),
            np.zeros((n, n)),
        )
        nothing = np.zeros(signal.shape)
        self.prediction, self.predicted_on = Prediction(nothing, np.stack([nothing] * 3, 1)), self.surface
        self.level_response = np.zeros((len(self.plateau), k, 3, *shape))
        self.residuals = np.zeros(signal.shape)
        self.weight = np.ones(signal.shape)

    def predict(self, predict: Predict) -> None:
        """Predict masks and multiple scattering on the current surface, and how masks follow the plateaus' levels."""
        self.predicted_on = self.surface
        self.prediction = predict(self.surface.height, self.surface.normals(self.shift))
        if self.prediction.response is not None:
            for i, weights in enumerate(self.plateau):
                self.level_response[i] = self.prediction.response((weights > 0).astype(float))

    def lag(self, limit: float, cut: float, is_instrument_free: bool = True) -> tuple[Unknowns, Lagged]:
        """Freeze prediction, edges and robust weights at the current surface; return it as unknowns, too."""
        s, m = self.settings, self.model
        height, slope_x, slope_y = self.surface
        predicted_normals = self.predicted_on.normals(self.shift)
        doubt = self.prediction.doubt(predicted_normals, s.mask_error, s.multiple_error)
        sigma = np.sqrt(self.variance + doubt**2)
        self.sigma = np.where(self.observed, sigma, np.inf)
        self.weight = geman_mcclure(self.residuals, limit)
        prediction = self.prediction.about(predicted_normals)
        edges_x = find_edges(height, slope_x, m.dx, 1, self.slope_noise, cut)
        edges_y = find_edges(height, slope_y, m.dy, 0, self.slope_noise, cut)
        self.intact_x, self.intact_y = edges_x.intact, edges_y.intact
        scale_x, scale_y = (self._slope_scale(e, axis) for e, axis in ((edges_x, 1), (edges_y, 0)))
        base_x = one_sided(np.diff(height, axis=1) / m.dx, edges_x.intact, 1)
        base_y = one_sided(np.diff(height, axis=0) / m.dy, edges_y.intact, 0)
        unknowns = Unknowns(
            dctn(height, norm="ortho") / self.whitening,
            (slope_x - base_x) / scale_x,
            (slope_y - base_y) / scale_y,
            self.log_gain,
            self.offset,
            self.log_multiple,
            self.albedo,
        )
        lagged = Lagged(
            data=np.where(self.observed, self.signal, 0.0),
            inverse_sigma=self.weight / self.sigma,
            multiple=prediction.multiple,
            hidden=prediction.hidden,
            plateau=self.plateau,
            level=np.einsum("ryx,yx->r", self.plateau, self.predicted_on.height),
            level_response=self.level_response,
            intact_x=edges_x.intact,
            intact_y=edges_y.intact,
            edge_x=edges_x.weight,
            edge_y=edges_y.weight,
            border=self.border,
            whitening=self.whitening,
            slope_scale_x=scale_x,
            slope_scale_y=scale_y,
            gain_std=s.gain_std * np.full(len(self.signal), float(is_instrument_free)),
            offset_std=s.offset_std * self.mean_signal * float(is_instrument_free),
            multiple_std=s.multiple_error * np.full(len(self.signal), float(is_instrument_free)),
        )
        return Unknowns(*map(jnp.asarray, unknowns)), Lagged(*map(jnp.asarray, lagged))

    def _slope_scale(self, edges: Edges, axis: int) -> np.ndarray:
        """Return how far a slope may move from its one-sided difference: what edges and datum leave of it."""
        steepness = 1.0 + self.surface.slope_x**2 + self.surface.slope_y**2
        return 1.0 / np.sqrt(0.25 * to_pixels(edges.weight**2, axis) + 1.0 / (self.slope_noise * steepness) ** 2)

    def step(self, limit: float, cut: float, is_instrument_free: bool) -> Solution:
        """Solve one weighted least-squares problem from the current surface."""
        s = self.settings
        found = _solve(self.model, *self.lag(limit, cut, is_instrument_free), s.lm_steps, s.cg_steps)
        self.surface = Surface(*map(np.asarray, found.surface))
        self.log_gain, self.offset = np.asarray(found.unknowns.log_gain), np.asarray(found.unknowns.offset)
        self.log_multiple = np.asarray(found.unknowns.log_multiple)
        self.albedo = np.asarray(found.unknowns.albedo)
        difference = np.asarray(found.counts) - np.where(self.observed, self.signal, 0.0)
        self.residuals = difference / self.sigma
        return found

    def misfit(self, limit: float, cut: float) -> float:
        """Return half the robust chi-square of data and edges, with the data's normalisation."""
        weight = geman_mcclure(self.residuals, limit)
        data = 0.5 * limit**2 * np.sum(1.0 - weight) + np.sum(np.log(self.sigma[self.observed]))
        edges = (
            find_edges(self.surface.height, slope, pitch, axis, self.slope_noise, cut)
            for slope, pitch, axis in (
                (self.surface.slope_x, self.model.dx, 1),
                (self.surface.slope_y, self.model.dy, 0),
            )
        )
        return float(data + sum(0.5 * cut**2 * np.sum(1.0 - np.sqrt(e.intact)) for e in edges))


def _thinning(shape: tuple[int, int]) -> int:
    """Return the power of two by which rows and columns are thinned for the posterior."""
    stride = 1
    while (shape[0] // stride) * (shape[1] // stride) > MAX_PIXELS:
        stride *= 2
    return stride


def _posterior(refiner: Refiner, settings: ReconstructSettings, region: np.ndarray | None) -> Posterior | None:
    """Return the posterior at the fit, on a thinned raster where the full one is too large.

    There a pixel stands for stride^2 data. A kink lies in one of `stride` edges of each of `stride` parallel paths, so
    an edge of the thinned raster doubts the trapezoid rule stride^1.5 times less than the same kink would let it.
    """
    s, m = refiner.settings, refiner.model
    stride = _thinning(refiner.signal.shape[1:])
    if s.samples == 0:
        return None
    thin = (slice(None, None, stride),) * 2
    part = Refiner(
        refiner.signal[:, *thin],
        refiner.variance[:, *thin],
        m.geometry,
        m.dx * stride,
        m.dy * stride,
        Surface(*(field[thin] for field in refiner.surface)),
        settings,
        None if region is None else region[thin],
    )
    for name in ("log_gain", "offset", "log_multiple", "albedo"):
        setattr(part, name, getattr(refiner, name))
    part.residuals = refiner.residuals[:, *thin]
    p = refiner.prediction
    part.predicted_on = Surface(*(field[thin] for field in refiner.predicted_on))
    part.prediction = Prediction(p.multiple[:, *thin], p.hidden[:, :, *thin])
    part.level_response = refiner.level_response[..., *thin]
    unknowns, lagged = part.lag(s.robust_limits[-1], s.jump_limits[-1])
    lagged = lagged._replace(
        inverse_sigma=lagged.inverse_sigma * stride,
        edge_x=lagged.edge_x * stride**1.5,
        edge_y=lagged.edge_y * stride**1.5,
    )
    found = sample_posterior(linearise(m.thinned(stride), unknowns, lagged), s.samples)
    return found.on_raster(refiner.signal.shape[1:], stride)


def _plateau_weights(region: np.ndarray) -> np.ndarray:
    """Return the weights [plateau, y, x] whose sum over the heights is a plateau's level above the ground, region 0."""
    numbers = np.unique(region[region > 0])[:, None, None]
    ground, plateau = ((region == n).astype(float) for n in (0, numbers))
    return plateau / plateau.sum((1, 2), keepdims=True) - ground / ground.sum()


def _border_weight(shape: tuple[int, int], settings: ReconstructSettings) -> np.ndarray:
    """Return the prior weight of each height: the outermost ring is flat, or just the mean height is held."""
    weight = np.zeros(shape)
    if settings.border == "flat":
        weight[border_mask(shape, 1.0 / max(shape))] = 1.0 / settings.border_std_um
    else:
        weight[:] = 1e-3 / settings.border_std_um / np.sqrt(weight.size)
    return weight


def misfit_on(
    signal: np.ndarray,
    variance: np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    surface: Surface,
    settings: ReconstructSettings,
    predict: Predict,
) -> tuple[float, Surface]:
    """Return half the robust chi-square that is left when a surface's relief is fitted to the data, and that surface.

    Counts data, with the logarithm of their assumed deviations, and edges; the instrument is at its prior means.
    Arguments as those of `fit_heights`.
    """
    s = settings.refine
    with jax.enable_x64(True):
        refiner = Refiner(signal, variance, geometry, dx, dy, surface, settings)
        refiner.predict(predict)
        for _ in range(s.reweightings):
            refiner.step(s.robust_limits[-1], s.jump_limits[-1], False)
    return refiner.misfit(s.robust_limits[-1], s.jump_limits[-1]), refiner.surface


def fit_heights(
    signal: np.ndarray,
    variance: np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    start: Surface,
    settings: ReconstructSettings,
    predict: Predict,
    report: Report | None = None,
    region: np.ndarray | None = None,
) -> Fit:
    """Fit heights, slopes, gains, offsets and a smooth albedo to the micrographs.

    Interrupted from the keyboard after the first round, it returns the best so far.

    Args:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        geometry: near-field geometry of the scan.
        dx, dy: raster pitch, um.
        start: heights and slopes, e.g. of the photometric solution.
        settings: priors, steps, rounds.
        predict: multiple scattering and hidden form factor on a surface.
        report: called before each outer round.
        region: plateaus, from `find_plateaus` [y, x], whose masks are to follow their levels.

    Source: own derivation; Levenberg-Marquardt of optimistix; lagged robust weights (Geman and McClure, 1987).
    """
    s = settings.refine
    with jax.enable_x64(True):
        refiner = Refiner(signal, variance, geometry, dx, dy, start, settings, region)
        changes: list[float] = []
        is_interrupted = False
        said = "start"
        for number in range(s.max_rounds):
            before = refiner.surface
            try:
                if report:
                    report(number, s.max_rounds, said)
                refiner.predict(predict)
                stages = list(zip(s.robust_limits, s.jump_limits, strict=True))
                for limit, cut in stages if number == 0 else stages[-1:] * s.reweightings:
                    found = refiner.step(limit, cut, number >= s.fixed_rounds)
            except KeyboardInterrupt:
                if not changes:
                    raise
                refiner.surface, is_interrupted = before, True
                break
            changes.append(float(np.sqrt(np.mean((refiner.surface.height - before.height) ** 2))))
            cost = float(sum(found.cost.values()))
            said = f"cost {cost:.4g}, height change {changes[-1]:.2f} um"
            if changes[-1] < s.tolerance_um:
                break
        posterior = None if is_interrupted else _posterior(refiner, settings, region)
        return _finish(refiner, changes, is_interrupted, posterior)


def _finish(refiner: Refiner, changes: list[float], is_interrupted: bool, posterior: Posterior | None) -> Fit:
    s, surface = refiner.settings, refiner.surface
    contraction = changes[-1] / changes[-2] if len(changes) > 1 and changes[-2] > 0 else None
    is_converged = changes[-1] < s.tolerance_um and not is_interrupted
    last = (
        f"the last of {len(changes)} rounds changed the heights by {changes[-1]:.2f} um (limit {s.tolerance_um:g} um)"
    )
    if is_interrupted:
        status = f"interrupted: best so far; {last}"
    elif is_converged:
        status = f"converged: {last}"
    elif contraction is not None and contraction > 1.0:
        status = f"diverging: {last}, {contraction:.2f} times the round before; raise mask_error or use nearfield"
    else:
        status = f"stopped: {last}; raise max_rounds for more"
    return Fit(
        surface=surface,
        normals=surface.normals(refiner.shift),
        albedo=np.asarray(smooth_albedo(jnp.asarray(refiner.albedo), surface.height.shape, s.albedo_std)),
        gain=np.exp(s.gain_std * refiner.log_gain),
        offset=s.offset_std * refiner.mean_signal * refiner.offset,
        residuals=refiner.residuals,
        weight=refiner.weight,
        intact_x=refiner.intact_x,
        intact_y=refiner.intact_y,
        posterior=posterior,
        changes=tuple(changes),
        contraction=contraction,
        status=status,
        is_converged=is_converged,
        is_interrupted=is_interrupted,
    )
