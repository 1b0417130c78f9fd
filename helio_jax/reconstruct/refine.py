"""Fit the heights themselves to the micrographs through the render model (the only door to optimistix).

Outer loop: predict multiple scattering and hidden aperture parts on the current surface (a callable that the
pipeline supplies, so this stage knows no tracer), update the robust weights, then a few Levenberg-Marquardt steps
on corner heights, gain, offset and a smooth albedo. The heights are whitened by the cosine transform,
z = DCT^-1(y / sqrt(lambda)): the data fix slopes, so in y the Hessian is near the identity and plain
conjugate gradients converge in a few steps. Masked and multiply scattered counts are lagged constants.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.scipy.fft import idctn
from scipy.fft import dctn

from helio_jax.arrays import border_mask
from helio_jax.reconstruct.beamframe import normal_of_slopes
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.render import Quads, quads_of_corners, render_single
from helio_jax.reconstruct.settings import ReconstructSettings


@dataclass(frozen=True)
class Prediction:
    """What the current surface does beyond direct single scattering, per beam atom.

    Attributes:
        multiple: detection probability of order 2 and above [detector, y, x].
        hidden: hidden part of the vector form factor [detector, 3, y, x].
    """

    multiple: np.ndarray
    hidden: np.ndarray


_FIRST_STEP_SIZE = 1e4
"""Inverse of the first Levenberg-Marquardt damping, in whitened variables."""

_EDGE_BENDS = 4.0
"""Changes of slope above this many prior deviations are edges: their smoothness weight falls off."""
_MAX_STEEPNESS = 20.0
"""Largest 1 + slope^2 by which the smoothness prior is relaxed."""

Predict = Callable[[np.ndarray, np.ndarray], Prediction]
"""(pixel heights [y, x] um, unit normals [y, x, 3]) -> Prediction."""
Report = Callable[[int, int, str], None]
"""Called with (round, rounds in all, what is known so far)."""


class _Lagged(NamedTuple):
    """Everything the residuals hold fixed during one least-squares solve."""

    data: jax.Array
    inverse_sigma: jax.Array
    multiple: jax.Array
    hidden: jax.Array
    smooth_x: jax.Array
    smooth_y: jax.Array
    border: jax.Array
    whitening: jax.Array
    prior: jax.Array


class _Unknowns(NamedTuple):
    """Unknowns of the fit: whitened corner heights, gain and offset in prior deviations, albedo modes."""

    heights: jax.Array
    log_gain: jax.Array
    offset: jax.Array
    albedo: jax.Array


class _TruncatedCG(lx.CG):
    """Conjugate gradients whose best iterate counts when the step limit is met (an inexact Newton step)."""

    def compute(self, state, vector, options):
        solution, _, stats = super().compute(state, vector, options)
        return solution, lx.RESULTS.successful, stats


@dataclass(frozen=True)
class Fit:
    """Result of the fit; arrays as in `Reconstruction`, plus the history of the outer rounds."""

    corners: np.ndarray
    height: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    residuals: np.ndarray
    weight: np.ndarray
    changes: tuple[float, ...]
    status: str
    is_converged: bool


def _whitening(shape: tuple[int, int], dx: float, dy: float, slope_noise: float) -> np.ndarray:
    """Return the deviation of each cosine mode of the corner heights that a slope noise per pixel leaves, um."""
    ky = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[0]) / shape[0]) / dy
    kx = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[1]) / shape[1]) / dx
    eigenvalue = ky[:, None] ** 2 + kx[None, :] ** 2
    eigenvalue[0, 0] = eigenvalue.ravel()[1:].min()
    return slope_noise / np.sqrt(eigenvalue)


def _heights(unknowns: _Unknowns, lagged: _Lagged) -> jax.Array:
    return idctn(unknowns.heights * lagged.whitening, norm="ortho")


def _albedo(modes: jax.Array, shape: tuple[int, ...], std: float) -> jax.Array:
    """Return the smooth albedo exp(sum of cosine modes); the constant mode is left to the gains."""
    if std == 0.0:
        return jnp.ones(shape)
    n = modes.shape[0]
    rank = jnp.hypot(*jnp.meshgrid(jnp.arange(n), jnp.arange(n), indexing="ij"))
    scale = std * jnp.sqrt(shape[0] * shape[1]) / jnp.maximum(rank, 1.0) ** 2
    spectrum = jnp.zeros(shape).at[:n, :n].set((modes * scale).at[0, 0].set(0.0))
    return jnp.exp(idctn(spectrum, norm="ortho"))


class _Model(eqx.Module):
    """Static part of the residual function."""

    geometry: SpotGeometry = eqx.field(static=True)
    dx: float = eqx.field(static=True)
    dy: float = eqx.field(static=True)
    gain_std: float = eqx.field(static=True)
    offset_std: float = eqx.field(static=True)
    albedo_std: float = eqx.field(static=True)

    def counts(self, unknowns: _Unknowns, lagged: _Lagged) -> jax.Array:
        """Return the expected data [detector, y, x] in units of the beam."""
        corners = _heights(unknowns, lagged)
        single = render_single(corners, lagged.hidden, self.geometry, self.dx, self.dy)
        albedo = _albedo(unknowns.albedo, single.shape[1:], self.albedo_std)
        gain = jnp.exp(self.gain_std * unknowns.log_gain)[:, None, None]
        offset = (self.offset_std * lagged.prior * unknowns.offset)[:, None, None]
        return gain * (albedo * single + lagged.multiple) + offset

    def residuals(self, unknowns: _Unknowns, lagged: _Lagged) -> dict[str, jax.Array]:
        """Return all residuals in standard deviations."""
        corners = _heights(unknowns, lagged)
        return {
            "data": (self.counts(unknowns, lagged) - lagged.data) * lagged.inverse_sigma,
            "smooth_x": jnp.diff(corners, n=2, axis=1) * lagged.smooth_x,
            "smooth_y": jnp.diff(corners, n=2, axis=0) * lagged.smooth_y,
            "border": corners * lagged.border,
            "gain": unknowns.log_gain,
            "offset": unknowns.offset,
            "albedo": unknowns.albedo,
        }


class _NearlyNewton(optx.ClassicalTrustRegion):
    """Trust region that starts with little damping: the start is good, and damping would freeze weak modes."""

    def init(self, y, f_info_struct):
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, jnp.asarray(_FIRST_STEP_SIZE))


@eqx.filter_jit
def _solve(model: _Model, start: _Unknowns, lagged: _Lagged, max_steps: int, cg_steps: int):
    solver = optx.LevenbergMarquardt(
        rtol=1e-4, atol=1e-6, linear_solver=lx.Normal(_TruncatedCG(rtol=1e-2, atol=1e-12, max_steps=cg_steps))
    )
    solver = eqx.tree_at(lambda s: s.search, solver, _NearlyNewton(), is_leaf=lambda n: n is solver.search)
    solution = optx.least_squares(
        lambda u, args: model.residuals(u, args), solver, start, args=lagged, max_steps=max_steps, throw=False
    )
    return solution.value, model.counts(solution.value, lagged), solution.stats["num_steps"]


def _curvature_weight(corners: np.ndarray, axis: int, pitch: float, scale: np.ndarray) -> np.ndarray:
    """Return edge-preserving weights of the second differences: Geman-McClure, deviation `scale` per pixel."""
    bend = np.diff(corners, n=2, axis=axis) / pitch
    middle = (slice(None), slice(1, -1)) if axis == 1 else (slice(1, -1), slice(None))
    local = scale[middle]
    return 1.0 / (pitch * local) / (1.0 + (bend / (_EDGE_BENDS * local)) ** 2)


def _bend_scale(quads: Quads, scale: float) -> np.ndarray:
    """Return the prior deviation of slope changes at every corner, for equal changes of the surface's angle.

    A change of angle d theta changes a slope by (1 + slope^2) d theta: steep parts may bend more, as do round ones.
    """
    steepness = 1.0 + np.asarray(quads.slope_x) ** 2 + np.asarray(quads.slope_y) ** 2
    padded = np.pad(np.minimum(steepness, _MAX_STEEPNESS), 1, mode="edge")
    return scale * 0.25 * (padded[1:, 1:] + padded[:-1, 1:] + padded[1:, :-1] + padded[:-1, :-1])


def _robust_inverse_sigma(residual: np.ndarray, sigma: np.ndarray, limit: float) -> np.ndarray:
    """Return Geman-McClure weighted 1 / sigma for standardised residuals (0 where nothing was observed)."""
    return np.where(
        np.isfinite(sigma), 1.0 / (1.0 + (residual / limit) ** 2) / np.where(np.isfinite(sigma), sigma, 1), 0.0
    )


class _Refiner:
    """State of one fit: the data, the current unknowns, and the lagged quantities."""

    def __init__(self, signal, variance, geometry, dx, dy, corners, settings: ReconstructSettings) -> None:
        s = settings.refine
        self.signal, self.variance, self.settings = signal, variance, s
        self.model = _Model(geometry, dx, dy, s.gain_std, s.offset_std, s.albedo_std)
        self.dx, self.dy = dx, dy
        observed = np.isfinite(signal)
        self.observed = observed
        self.mean_signal = np.array(
            [np.median(s[o]) if o.any() else 1.0 for s, o in zip(signal, observed, strict=True)]
        )
        relative = np.sqrt(np.nanmedian(variance / self.mean_signal[:, None, None] ** 2))
        self.slope_noise = float(np.clip(relative, 1e-3, 1.0))
        self.whitening = _whitening(corners.shape, dx, dy, self.slope_noise)
        self.border = _border_weight(corners.shape, settings)
        k, n = signal.shape[0], s.albedo_modes
        self.unknowns = _Unknowns(
            jnp.asarray(_forward_whitened(corners, self.whitening)), jnp.zeros(k), jnp.zeros(k), jnp.zeros((n, n))
        )
        self.residuals = np.zeros(signal.shape)

    def lag(self, prediction: Prediction, limit: float) -> _Lagged:
        """Freeze prediction, robust weights and edge weights at the current surface."""
        s = self.settings
        corners = self.corners()
        quads = quads_of_corners(corners, self.dx, self.dy)
        normal = _unit_normals(quads, self.model.geometry.instrument.beam_shift)
        hidden_signal = np.einsum("kiyx,yxi->kyx", prediction.hidden, normal)
        sigma = np.sqrt(
            self.variance + (s.mask_error * hidden_signal) ** 2 + (s.multiple_error * prediction.multiple) ** 2
        )
        sigma = np.where(self.observed, sigma, np.nan)
        self.sigma = sigma
        scale = _bend_scale(quads, s.smoothness * self.slope_noise)
        return _Lagged(
            data=jnp.asarray(np.where(self.observed, self.signal, 0.0)),
            inverse_sigma=jnp.asarray(_robust_inverse_sigma(self.residuals, sigma, limit)),
            multiple=jnp.asarray(prediction.multiple),
            hidden=jnp.asarray(prediction.hidden),
            smooth_x=jnp.asarray(_curvature_weight(corners, 1, self.dx, scale)),
            smooth_y=jnp.asarray(_curvature_weight(corners, 0, self.dy, scale)),
            border=jnp.asarray(self.border),
            whitening=jnp.asarray(self.whitening),
            prior=jnp.asarray(self.mean_signal),
        )

    def corners(self) -> np.ndarray:
        """Return the current corner heights [y + 1, x + 1], um."""
        return np.asarray(idctn(self.unknowns.heights * self.whitening, norm="ortho"))

    def step(self, lagged: _Lagged) -> None:
        """Solve one weighted least-squares problem from the current unknowns."""
        s = self.settings
        self.unknowns, counts, _ = _solve(self.model, self.unknowns, lagged, s.lm_steps, s.cg_steps)
        difference = np.asarray(counts) - np.asarray(lagged.data)
        self.residuals = np.where(self.observed, difference / np.where(self.observed, self.sigma, 1.0), 0.0)
        self.weight = np.asarray(lagged.inverse_sigma) * np.where(self.observed, self.sigma, 0.0)


def _border_weight(shape: tuple[int, int], settings: ReconstructSettings) -> np.ndarray:
    """Return the prior weight of each corner height: the outermost ring is flat, or just the mean height is held."""
    weight = np.zeros(shape)
    if settings.border == "flat":
        weight[border_mask(shape, 1.0 / max(shape))] = 1.0 / settings.border_std_um
    else:
        weight[:] = 1e-3 / settings.border_std_um / np.sqrt(weight.size)
    return weight


def _forward_whitened(corners: np.ndarray, whitening: np.ndarray) -> np.ndarray:
    return dctn(corners, norm="ortho") / whitening


def _unit_normals(quads: Any, shift: tuple[float, float]) -> np.ndarray:
    normal = np.stack([np.asarray(c) for c in normal_of_slopes(quads.slope_x, quads.slope_y, shift)], -1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def fit_heights(
    signal: np.ndarray,
    variance: np.ndarray,
    geometry: SpotGeometry,
    dx: float,
    dy: float,
    corners: np.ndarray,
    settings: ReconstructSettings,
    predict: Predict,
    report: Report | None = None,
) -> Fit:
    """Fit corner heights, gains, offsets and a smooth albedo to the micrographs.

    Args:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        geometry: near-field geometry of the scan.
        dx, dy: raster pitch, um.
        corners: start [y + 1, x + 1], um.
        settings: priors, steps, rounds.
        predict: multiple scattering and hidden form factor on a surface.
        report: called before each outer round.

    Source: own derivation; Levenberg-Marquardt of optimistix; lagged robust weights (Geman and McClure, 1987).
    """
    with jax.enable_x64(True):
        refiner = _Refiner(signal, variance, geometry, dx, dy, corners, settings)
        shift = geometry.instrument.beam_shift
        changes: list[float] = []
        rounds = settings.refine.max_rounds
        for number in range(rounds):
            before = Quads(*map(np.asarray, quads_of_corners(refiner.corners(), dx, dy)))
            if report:
                last = f"height change {changes[-1]:.2f} um" if changes else "start"
                report(number, rounds, last)
            prediction = predict(before.height, _unit_normals(before, shift))
            all_limits = settings.refine.robust_limits
            limits = all_limits if number == 0 else all_limits[-1:] * 2
            for limit in limits:
                refiner.step(refiner.lag(prediction, limit))
            after = quads_of_corners(refiner.corners(), dx, dy)
            changes.append(float(np.sqrt(np.mean((after.height - before.height) ** 2))))
            if changes[-1] < settings.refine.tolerance_um:
                break
        return _finish(refiner, changes, dx, dy)


def _finish(refiner: _Refiner, changes: list[float], dx: float, dy: float) -> Fit:
    s, u = refiner.settings, refiner.unknowns
    quads = quads_of_corners(refiner.corners(), dx, dy)
    is_converged = changes[-1] < s.tolerance_um
    is_diverging = len(changes) > 2 and changes[-1] > 1.5 * changes[-2] > 0
    if is_converged:
        status = f"converged: the last round changed the heights by {changes[-1]:.2f} um (limit {s.tolerance_um:g} um)"
    elif is_diverging:
        status = f"diverging: height changes per round grew to {changes[-1]:.2f} um; lower mask_error or use nearfield"
    else:
        status = (
            f"stopped after {len(changes)} rounds: the last one changed the heights by {changes[-1]:.2f} um "
            f"(limit {s.tolerance_um:g} um); raise max_rounds for more"
        )
    return Fit(
        corners=refiner.corners(),
        height=np.asarray(quads.height),
        normals=_unit_normals(quads, refiner.model.geometry.instrument.beam_shift),
        albedo=np.asarray(_albedo(u.albedo, refiner.signal.shape[1:], s.albedo_std)),
        gain=np.exp(s.gain_std * np.asarray(u.log_gain)),
        offset=s.offset_std * refiner.mean_signal * np.asarray(u.offset),
        residuals=refiner.residuals,
        weight=refiner.weight,
        changes=tuple(changes),
        status=status,
        is_converged=is_converged,
    )
