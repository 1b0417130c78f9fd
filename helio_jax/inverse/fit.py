"""Fit the heights themselves to the micrographs through the render model: the outer loop.

Every round: predict multiple scattering and hidden aperture parts on the current surface (a callable that the
pipeline supplies, so this stage knows no tracer), decide which edges are smooth, kinked or cut (`edges`), renew the
robust weights, then a few Levenberg-Marquardt steps (`refiner`). All of that is lagged: constant during a step.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.readout import ScanOrder
from helio_jax.instrument import Instrument
from helio_jax.inverse.convergence import aitken, contraction_of, left_to_go, status_of
from helio_jax.inverse.noise_bias import noise_bias
from helio_jax.inverse.posterior import MAX_PIXELS, ModelError, Posterior, linearise, sample_posterior
from helio_jax.inverse.problem import Predict, Refiner
from helio_jax.inverse.residuals import Surface, smooth_albedo
from helio_jax.inverse.samples import thinning
from helio_jax.inverse.settings import ReconstructSettings

GEOMETRY = "distance", "tilt", "aim"
"""Unknowns that tell of a model that lacks something where they come out farther off than stated: error bars widen."""
GAINS, OFF_BY_FAR = ("log_gain", "offset"), 2.0
"""The same, but only where they are off by more than this factor: it is they that usually differ by chance."""

Report = Callable[[int, int, str], None]
"""Called with (round, rounds in all, what is known so far)."""


@dataclass(frozen=True)
class Fit:
    """Result of the fit; arrays as in `Reconstruction`.

    Attributes:
        surface: heights and slopes.
        normals: unit normals [y, x, 3].
        albedo: relative reflectivity [y, x].
        gain, offset: per detector, data = gain * model + offset.
        instrument: with the geometry that was fitted.
        values: unknowns of the instrument, in prior deviations, by name.
        distance_std: prior deviation of the distance of the sample, um.
        residuals: (model - data) / standard deviation [detector, y, x].
        weight: what robust weighting left of each datum [detector, y, x].
        model_share: share of the prediction's assumed error in the variance of each datum [detector, y, x].
        intact_x, intact_y: what is left of the edges between pixels [y, x - 1], [y - 1, x]; 0 at a jump.
        posterior: error bars, or None where none were asked for.
        changes: root mean square height change of every round [um].
        contraction: ratio of the last two changes, or None.
        status: a sentence: how the fit ended.
        is_interrupted: whether it was stopped from the keyboard.
    """

    surface: Surface
    normals: np.ndarray
    albedo: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    instrument: Instrument
    values: dict[str, np.ndarray]
    distance_std: float
    residuals: np.ndarray
    weight: np.ndarray
    model_share: np.ndarray
    intact_x: np.ndarray
    intact_y: np.ndarray
    posterior: Posterior | None
    changes: tuple[float, ...]
    contraction: float | None
    status: str
    is_interrupted: bool = False

    @property
    def chi_square(self) -> list[float]:
        """Mean square residual of the data of every detector, each counted by its robust weight, squared."""
        total = np.sum((self.weight * self.residuals) ** 2, axis=(1, 2))
        return (total / np.maximum(np.sum(self.weight**2, axis=(1, 2)), 1e-300)).tolist()


def _posterior(refiner: Refiner, settings: ReconstructSettings, region: np.ndarray | None) -> Posterior | None:
    """Return the posterior at the fit, on a thinned raster where the full one is too large.

    There a pixel stands for stride^2 data. A kink lies in one of `stride` edges of each of `stride` parallel paths, so
    an edge of the thinned raster doubts the trapezoid rule stride^1.5 times less than the same kink would let it.
    """
    s, m = refiner.settings, refiner.model
    stride = thinning(refiner.signal.shape[1:], MAX_PIXELS)
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
        refiner.order.thinned(thin),
    )
    part.values = refiner.values | {"lines": refiner.values["lines"][:, ::stride]}
    part.drift = refiner.drift[:, :, *thin]
    part.residuals = refiner.residuals[:, *thin]
    predicted_on = Surface(*(field[thin] for field in refiner.predicted_on))
    part.adopt(refiner.prediction.thinned(thin), predicted_on)
    part.level_response = refiner.level_response[..., *thin]
    part.mode = refiner.mode[:, *thin] * stride**2
    part.mode_response = refiner.mode_response[..., *thin]
    unknowns, lagged = part.lag(s.robust_limits[-1], s.jump_limits[-1])
    lagged = lagged._replace(
        inverse_sigma=lagged.inverse_sigma * stride,
        edge_x=lagged.edge_x * stride**1.5,
        edge_y=lagged.edge_y * stride**1.5,
    )
    length = s.error_reach * float(np.ptp(refiner.surface.height))
    error = ModelError(part.model_share, (length / m.dy, length / m.dx), stride)
    linear = linearise(m.thinned(stride), unknowns, lagged)
    found = sample_posterior(linear, s.samples, error=error).levelled(part.tilt_std * part.across)
    found = found.widened(refiner.values, GEOMETRY).widened(refiner.values, GAINS, OFF_BY_FAR)
    return found.on_raster(refiner.signal.shape[1:], stride)


def misfit_on(
    signal: np.ndarray,
    variance: np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    surface: Surface,
    settings: ReconstructSettings,
    predict: Predict,
    order: ScanOrder = ScanOrder(),
    values: dict[str, np.ndarray] | None = None,
) -> tuple[float, Surface]:
    """Return half the robust chi-square that is left when a surface's relief is fitted to the data, and that surface.

    Counts data, with the logarithm of their assumed deviations, and edges; the instrument stays at `values`, or at its
    prior means. Arguments as those of `fit_heights`.
    """
    s = settings.refine
    with jax.enable_x64(True):
        refiner = Refiner(signal, variance, geometry, dx, dy, surface, settings, None, order)
        refiner.values |= values or {}
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
    order: ScanOrder = ScanOrder(),
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
        order: in which the pixels were recorded.

    Source: own derivation; Levenberg-Marquardt of optimistix; lagged robust weights (Geman and McClure, 1987).
    """
    s = settings.refine
    with jax.enable_x64(True):
        refiner = Refiner(signal, variance, geometry, dx, dy, start, settings, region, order)
        changes: list[float] = []
        last_change = np.zeros(start.height.shape)
        ahead = 1.0
        is_interrupted = False
        said = "start"
        n_fixed = 0 if refiner.is_unknown else s.fixed_rounds
        for number in range(s.max_rounds):
            before = refiner.surface
            try:
                if report:
                    report(number, s.max_rounds, said)
                refiner.predict(predict)
                if settings.border == "free":
                    refiner.follow_modes(predict)
                if number == n_fixed:
                    refiner.tear()
                stages = list(zip(s.robust_limits, s.jump_limits, strict=True))
                for limit, cut in stages if number == 0 else stages[-1:] * s.reweightings:
                    found = refiner.step(limit, cut, number >= n_fixed)
            except KeyboardInterrupt:
                if not changes:
                    raise
                refiner.surface, is_interrupted = before, True
                break
            refiner.torn = None
            change_before, last_change = last_change, np.asarray(refiner.surface.height - before.height)
            changes.append(float(np.sqrt(np.mean(last_change**2))))
            cost = sum(map(float, found.cost.values()))
            said = f"cost {cost:.4g}, height change {changes[-1]:.2f} um"
            if number:
                ahead = aitken(change_before, last_change)
            if changes[-1] < s.tolerance_um and number >= n_fixed:
                break
        if refiner.is_level_free and s.bias_pairs and not is_interrupted:
            try:
                if report:
                    report(len(changes) - 1, s.max_rounds, f"{said}; simulating the bias by noise")
                refiner.move_back(*noise_bias(refiner, s.bias_pairs))
            except KeyboardInterrupt:
                is_interrupted = True
        posterior = None if is_interrupted else _posterior(refiner, settings, region)
        if posterior is not None:
            posterior = posterior.also_off_by(left_to_go(changes, ahead) * last_change)
        return _finish(refiner, changes, is_interrupted, posterior)


def _finish(refiner: Refiner, changes: list[float], is_interrupted: bool, posterior: Posterior | None) -> Fit:
    s = refiner.settings
    refiner.weigh(s.robust_limits[-1], s.jump_limits[-1])
    surface = refiner.levelled
    return Fit(
        surface=surface,
        normals=surface.normals(refiner.shift),
        albedo=np.asarray(smooth_albedo(jnp.asarray(refiner.values["albedo"]), surface.height.shape, s.albedo_std)),
        gain=np.exp(s.gain_std * refiner.values["log_gain"]),
        offset=s.offset_std * refiner.mean_signal * refiner.values["offset"],
        instrument=refiner.instrument,
        values=refiner.values,
        distance_std=refiner.distance_std,
        residuals=refiner.residuals,
        weight=refiner.weight,
        model_share=refiner.model_share,
        intact_x=refiner.intact_x,
        intact_y=refiner.intact_y,
        posterior=posterior,
        changes=tuple(changes),
        contraction=contraction_of(changes),
        status=status_of(changes, s.tolerance_um, is_interrupted),
        is_interrupted=is_interrupted,
    )
