"""One solve of the fit: the problem lagged at the current surface, and Levenberg-Marquardt; only door to optimistix.

Unknowns: height and two slopes of every pixel, gain and offset of every detector, scale of the multiple scattering, a
smooth albedo. They are whitened so that plain conjugate gradients converge in a few steps: heights by the cosine
transform, h = DCT^-1(y / sqrt(lambda)), for the data fix slopes; slopes as deviations from the heights' one-sided
differences.
"""

from collections.abc import Callable
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
from helio_jax.reconstruct.model import INSTRUMENT, Lagged, Model, Prediction, Surface, Unknowns
from helio_jax.reconstruct.settings import ReconstructSettings

_FIRST_STEP_SIZE, _SHRINK = 1e3, 0.1
"""Inverse of the first Levenberg-Marquardt damping, in whitened variables, and its factor after a rejected step."""

_NOISY = 3.0
"""Deviation that slopes are credited with at most, in those of a pixel with median noise."""
_HELD = 1e-5
"""Least prior weight of a height, 1/um: holds a pixel that all edges part from the rest."""

Predict = Callable[[np.ndarray, np.ndarray], Prediction]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Prediction."""


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


def _whitening(shape: tuple[int, int], dx: float, dy: float, slope_noise: float) -> np.ndarray:
    """Return the deviation of each cosine mode of the heights that a slope noise per pixel leaves, um."""
    ky = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[0]) / shape[0]) / dy
    kx = 2.0 * np.sin(0.5 * np.pi * np.arange(shape[1]) / shape[1]) / dx
    eigenvalue = ky[:, None] ** 2 + kx[None, :] ** 2
    eigenvalue[0, 0] = eigenvalue.ravel()[1:].min()
    return slope_noise / np.sqrt(eigenvalue)


def _plateau_weights(region: np.ndarray) -> np.ndarray:
    """Return the weights [plateau, y, x] whose sum over the heights is a plateau's level above the ground, region 0."""
    numbers = np.unique(region[region > 0])[:, None, None]
    ground, plateau = ((region == n).astype(float) for n in (0, numbers))
    return plateau / plateau.sum((1, 2), keepdims=True) - ground / ground.sum()


def _border_weight(shape: tuple[int, int], settings: ReconstructSettings) -> np.ndarray:
    """Return the prior weight of each height: the outermost ring is flat, or just the mean height is held."""
    weight = np.full(shape, _HELD)
    if settings.border == "flat":
        weight[border_mask(shape, 1.0 / max(shape))] = 1.0 / settings.border_std_um
    else:
        weight[:] = 1e-3 / settings.border_std_um / np.sqrt(weight.size)
    return weight


class Solution(NamedTuple):
    """One solve: unknowns, surface, expected data, and the cost of every kind of residual."""

    unknowns: Unknowns
    surface: Surface
    counts: jax.Array
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
    return Solution(found.value, surface, counts, cost)


@eqx.filter_jit
def _noise_change(model: Model, surface: Surface, hidden, inverse_sigma, largest) -> jax.Array:
    return model.noise_change(Surface(*map(jnp.asarray, surface)), hidden, inverse_sigma, largest)


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
        self.data = np.where(self.observed, signal, 0.0)
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
        self.log_gain, self.offset, self.log_multiple = np.zeros((3, k))
        self.unseen, self.albedo = np.zeros(()), np.zeros((n, n))
        nothing = np.zeros(signal.shape)
        self.adopt(Prediction(nothing, np.stack([nothing] * 3, 1)), self.surface)
        self.level_response = np.zeros((len(self.plateau), k, 3, *shape))
        self.residuals = np.zeros(signal.shape)
        self.weight = np.ones(signal.shape)

    def predict(self, predict: Predict) -> None:
        """Predict masks and multiple scattering on the current surface, and how masks follow the plateaus' levels."""
        self.adopt(predict(self.surface.height, self.surface.normals(self.shift)), self.surface)
        if self.prediction.response is not None:
            for i, weights in enumerate(self.plateau):
                self.level_response[i] = self.prediction.response((weights > 0).astype(float))

    def adopt(self, prediction: Prediction, surface: Surface) -> None:
        """Take a prediction, made on a surface, for all solves until the next one."""
        s, normals = self.settings, surface.normals(self.shift)
        self.prediction, self.predicted_on = prediction, surface
        self.near = prediction.about(normals)
        doubt = prediction.doubt(normals, s.mask_error, s.multiple_error)
        self.sigma = np.where(self.observed, np.sqrt(self.variance + doubt**2), np.inf)

    @property
    def model_share(self) -> np.ndarray:
        """Share of the prediction's assumed error in the assumed variance of every datum; 0 where not observed."""
        return np.where(self.observed, np.maximum(1.0 - self.variance / self.sigma**2, 0.0), 0.0)

    def edges(self, cut: float) -> tuple[Edges, Edges]:
        """Return the edges of the current surface along x and along y."""
        (height, slope_x, slope_y), m = self.surface, self.model
        return (
            find_edges(height, slope_x, m.dx, 1, self.slope_noise, cut),
            find_edges(height, slope_y, m.dy, 0, self.slope_noise, cut),
        )

    def lag(self, limit: float, cut: float, is_instrument_free: bool = True) -> tuple[Unknowns, Lagged]:
        """Freeze prediction, edges and robust weights at the current surface; return it as unknowns, too."""
        s, m, p = self.settings, self.model, self.near
        height, slope_x, slope_y = self.surface
        self.weight = geman_mcclure(self.residuals, limit)
        edges_x, edges_y = self.edges(cut)
        self.intact_x, self.intact_y = edges_x.intact, edges_y.intact
        scale_x, scale_y = (self._slope_scale(e, axis) for e, axis in ((edges_x, 1), (edges_y, 0)))
        base_x = one_sided(np.diff(height, axis=1) / m.dx, edges_x.intact, 1)
        base_y = one_sided(np.diff(height, axis=0) / m.dy, edges_y.intact, 0)
        unknowns = Unknowns(
            dctn(height, norm="ortho") / self.whitening,
            (slope_x - base_x) / scale_x,
            (slope_y - base_y) / scale_y,
            *(getattr(self, name) for name in INSTRUMENT),
        )
        inverse_sigma = self.weight / self.sigma
        largest = _NOISY * self.slope_noise * self._steepness()
        lagged = Lagged(
            data=self.data,
            inverse_sigma=inverse_sigma,
            multiple=p.multiple,
            hidden=p.hidden,
            unseen=np.zeros(self.data.shape) if p.unseen is None else p.unseen * float(is_instrument_free),
            noise_change=_noise_change(m, self.surface, p.hidden, inverse_sigma, largest),
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
        free = self.slope_noise * self._steepness()
        return 1.0 / np.sqrt(0.25 * to_pixels(edges.weight**2, axis) + 1.0 / free**2)

    def _steepness(self) -> np.ndarray:
        """Return by how much more the slopes of a facet follow its normal than those of a level one [y, x]."""
        return 1.0 + self.surface.slope_x**2 + self.surface.slope_y**2

    def step(self, limit: float, cut: float, is_instrument_free: bool) -> Solution:
        """Solve one weighted least-squares problem from the current surface."""
        s = self.settings
        found = _solve(self.model, *self.lag(limit, cut, is_instrument_free), s.lm_steps, s.cg_steps)
        self.surface = Surface(*map(np.asarray, found.surface))
        for name in INSTRUMENT:
            setattr(self, name, np.asarray(getattr(found.unknowns, name)))
        self.residuals = (np.asarray(found.counts) - self.data) / self.sigma
        return found

    def misfit(self, limit: float, cut: float) -> float:
        """Return half the robust chi-square of data and edges, with the data's normalisation."""
        weight = geman_mcclure(self.residuals, limit)
        data = 0.5 * limit**2 * np.sum(1.0 - weight) + np.sum(np.log(self.sigma[self.observed]))
        return float(data + sum(0.5 * cut**2 * np.sum(1.0 - np.sqrt(e.intact)) for e in self.edges(cut)))
