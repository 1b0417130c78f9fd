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
from jax.flatten_util import ravel_pytree
from scipy.fft import dctn

from helio_jax.arrays import border_mask
from helio_jax.instrument import Instrument
from helio_jax.reconstruct.aiming import aimed_slopes
from helio_jax.reconstruct.background import drift_modes
from helio_jax.reconstruct.edges import Edges, bend_of, find_edges, geman_mcclure, one_sided, to_pixels
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.model import INSTRUMENT, Lagged, Model, Prediction, Surface, Unknowns
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.shadows import shadow_edges

_FIRST_STEP_SIZE, _SHRINK = 1e3, 0.1
"""Inverse of the first Levenberg-Marquardt damping, in whitened variables, and its factor after a rejected step."""

_NOISY = 3.0
"""Deviation that slopes are credited with at most, in those of a pixel with median noise."""
_HELD = 1e-5
"""Least prior weight of a height, 1/um: holds a pixel that all edges part from the rest."""

Predict = Callable[..., Prediction]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Prediction; the instrument is given, too, where it is unknown."""


class _TruncatedCG(lx.CG):
    """Conjugate gradients from 0, until the norm of the residual has fallen by `rtol` or the steps are up.

    An inexact Newton step. The operator is compiled once, where `lx.CG` has three copies of it.

    Source: Hestenes and Stiefel, J. Res. NBS 49 (1952) 409; Dembo, Eisenstat and Steihaug, SINUM 19 (1982) 400.
    """

    def compute(self, state, vector, options):
        operator, _ = state
        square = jnp.vdot(vector, vector)

        def is_unfinished(carry):
            _, _, _, now, step = carry
            return (now > self.rtol**2 * square) & (step < self.max_steps)

        def body(carry):
            x, r, p, now, step = carry
            image = operator.mv(p)
            size = now / jnp.vdot(p, image)
            x, r = x + size * p, r - size * image
            new = jnp.vdot(r, r)
            return x, r, r + new / now * p, new, step + 1

        x, _, _, _, steps = jax.lax.while_loop(is_unfinished, body, (jnp.zeros_like(vector), vector, vector, square, 0))
        return x, lx.RESULTS.successful, {"num_steps": steps, "max_steps": self.max_steps}


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
    """Return the prior weight of each height: the border is flat, or just the mean height is held.

    The outermost ring is enough to level the heights; what drifts is told from relief by all of the border.
    """
    weight = np.full(shape, _HELD)
    if settings.border == "flat":
        width = settings.border_fraction if settings.refine.drift_std > 0 else 1.0 / max(shape)
        weight[border_mask(shape, width)] = 1.0 / settings.border_std_um
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
def _mixing(model: Model, start: Unknowns, lagged: Lagged) -> jax.Array:
    """Return the matrix whose columns are instruments that the data tell apart, each by one standard deviation.

    Gains, offsets, drift and angles have much the same effect on the data, and by far more than one pixel's height:
    as they are, conjugate gradients would take many steps for them alone.
    """
    names = model.instrument_fields(start)
    surface = model.surface(start, lagged)
    flat, restore = ravel_pytree({name: getattr(start, name) for name in names})

    def residuals(values):
        unknowns = start._replace(**restore(values))
        parts = model.data_residuals(surface, unknowns, lagged), model.border_residuals(surface, unknowns, lagged)
        return jnp.concatenate([part.ravel() for part in parts])

    jacobian = jax.jacfwd(residuals)(flat)
    factor = jnp.linalg.cholesky(jacobian.T @ jacobian + jnp.eye(flat.size))
    return jax.scipy.linalg.solve_triangular(factor, jnp.eye(flat.size), lower=True).T


@eqx.filter_jit
def _solve(
    model: Model,
    start: Unknowns,
    lagged: Lagged,
    max_steps: int,
    cg_steps: int,
    mixing: jax.Array | np.ndarray,
    is_instrument_free: np.ndarray,
) -> Solution:
    """Solve from `start`; the instrument, 1 or 0 times free, and the sample's albedo move along `mixing`'s columns."""
    solver = optx.LevenbergMarquardt(
        rtol=1e-4, atol=1e-6, linear_solver=lx.Normal(_TruncatedCG(rtol=1e-2, atol=0.0, max_steps=cg_steps))
    )
    solver = eqx.tree_at(
        lambda s: s.search, solver, _NearlyNewton(low_constant=_SHRINK), is_leaf=lambda n: n is solver.search
    )
    names = model.instrument_fields(start)
    flat, restore = ravel_pytree({name: getattr(start, name) for name in names})
    seen = jnp.sum(lagged.inverse_sigma**2, 2 - model.slow_axis) * lagged.lines_std[:, None] ** 2
    line_scale = is_instrument_free / jnp.sqrt(1.0 + seen)
    is_free = {n: jnp.full_like(getattr(start, n), 1.0 if n == "albedo" else is_instrument_free) for n in names}
    mixing = ravel_pytree(is_free)[0][:, None] * mixing

    def decoded(variables: jax.Array) -> Unknowns:
        surface, mixed, lines = split(variables)
        unknowns = start._replace(**surface)
        unknowns = unknowns._replace(**restore(flat + mixing @ mixed))
        return unknowns._replace(lines=start.lines + line_scale * lines) if start.lines.size else unknowns

    surface = {name: getattr(start, name) for name in Surface._fields}
    # one vector each, for every array of a tree is compiled by itself
    variables, split = ravel_pytree((surface, jnp.zeros_like(flat), jnp.zeros_like(start.lines)))
    found = optx.least_squares(
        lambda v, args: ravel_pytree(model.residuals(decoded(v), args))[0],
        solver,
        variables,
        args=lagged,
        max_steps=max_steps,
        throw=False,
    )
    unknowns = decoded(found.value)
    surface = model.surface(unknowns, lagged)
    counts = model.counts(surface, unknowns, lagged)
    cost = {name: 0.5 * jnp.sum(r**2) for name, r in model.residuals(unknowns, lagged).items()}
    return Solution(unknowns, surface, counts, cost)


@eqx.filter_jit
def _noise_change(model: Model, surface: Surface, hidden, inverse_sigma, largest, moves) -> jax.Array:
    return model.noise_change(Surface(*map(jnp.asarray, surface)), hidden, inverse_sigma, largest, moves)


@eqx.filter_jit
def _aimed_slopes(geometry: SpotGeometry, height, aim):
    return aimed_slopes(geometry, jnp.asarray(height), jnp.asarray(aim))


class Refiner:
    """State of one fit: the data, the current surface and instrument, and the lagged quantities."""

    def __init__(
        self,
        signal,
        variance,
        geometry,
        dx,
        dy,
        start: Surface,
        settings: ReconstructSettings,
        region=None,
        slow_axis=0,
    ) -> None:
        s = settings.refine
        self.signal, self.variance, self.settings = signal, variance, s
        self.model = Model(geometry, dx, dy, s.albedo_std, slow_axis)
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
        self.drift = drift_modes(shape, slow_axis, s.drift_degrees) if s.drift_std else np.zeros((0, *shape))
        sides = (d * (np.arange(n) - 0.5 * (n - 1)) for d, n in ((dx, shape[1]), (dy, shape[0])))
        self.across = np.stack(np.meshgrid(*sides))
        self.values = self._at_prior_means(geometry.instrument)
        nothing = np.zeros(signal.shape)
        self.adopt(Prediction(nothing, np.stack([nothing] * 3, 1)), self.surface)
        self.level_response = np.zeros((len(self.plateau), len(signal), 3, *shape))
        self.torn: tuple[np.ndarray, np.ndarray] | None = None
        self.residuals = np.zeros(signal.shape)
        self.weight = np.ones(signal.shape)

    def _at_prior_means(self, instrument: Instrument) -> dict[str, np.ndarray]:
        """Return the unknowns of the instrument, all 0; those that are known have no entries."""
        s, sure = self.settings, instrument.uncertainty
        k, n = self.signal.shape[0], s.albedo_modes
        lines = self.signal.shape[1 + self.model.slow_axis] if s.line_std else 0
        shapes = {"log_gain": k, "offset": k, "log_multiple": k, "unseen": (), "albedo": (n, n)}
        shapes |= {"drift": (k, len(self.drift)), "lines": (k, lines), "law": 1 if s.law_std else 0}
        is_aimed = s.geometry and (sure.polar_deg or sure.azimuth_deg)
        shapes["distance"] = 1 if s.geometry and sure.sample_distance_um else 0
        shapes |= {"tilt": 2 if s.geometry and sure.tilt_deg else 0, "aim": (k, 2) if is_aimed else 0}
        return {name: np.zeros(shape) for name, shape in shapes.items()}

    @property
    def aim_std(self) -> np.ndarray:
        """Prior deviations of polar angle and azimuth [2], rad."""
        sure = self.model.geometry.instrument.uncertainty
        return np.radians([sure.polar_deg, sure.azimuth_deg])

    @property
    def moves(self) -> np.ndarray | None:
        """Distance [um], polar angle and azimuth [rad] beyond the stated ones [move, detector], if unknown."""
        distance, aim = self.values["distance"], self.values["aim"]
        if not distance.size and not aim.size:
            return None
        k = len(self.signal)
        moved = self.model.geometry.instrument.uncertainty.sample_distance_um * distance.sum()
        return np.stack([np.full(k, moved), *((self.aim_std * aim).T if aim.size else np.zeros((2, k)))])

    @property
    def instrument(self) -> Instrument:
        """The instrument with the geometry fitted so far."""
        stated = self.model.geometry.instrument
        return stated if self.moves is None else stated.moved(self.moves[1:].T, float(self.moves[0, 0]))

    def predict(self, predict: Predict) -> None:
        """Predict masks and multiple scattering on the current surface, and how masks follow the plateaus' levels."""
        about = () if self.moves is None else (self.instrument,)
        self.adopt(predict(self.surface.height, self.surface.normals(self.shift), *about), self.surface)
        if self.prediction.response is not None:
            for i, weights in enumerate(self.plateau):
                self.level_response[i] = self.prediction.response((weights > 0).astype(float))

    def adopt(self, prediction: Prediction, surface: Surface) -> None:
        """Take a prediction, made on a surface, for all solves until the next one."""
        s, normals = self.settings, surface.normals(self.shift)
        self.prediction, self.predicted_on = prediction, surface
        self.hidden_moves, self.predicted_moves = self._hidden_moves(prediction.hidden, surface.height)
        self.near = prediction.about(normals)
        doubt = prediction.doubt(normals, s.mask_error, s.multiple_error)
        self.sigma = np.where(self.observed, np.sqrt(self.variance + doubt**2), np.inf)

    def _hidden_moves(self, hidden: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how the hidden form factor follows the geometry, and the moves at which it is given.

        A share of the aperture that is hidden is taken to stay hidden: of a wholly hidden one nothing comes into view.
        """
        moves = self.moves
        if moves is None:
            return np.zeros((0, *hidden.shape)), np.zeros((0, len(hidden)))
        with jax.enable_x64(True):
            phi, slopes = map(np.asarray, _aimed_slopes(self.model.geometry, height - moves[0, 0], moves[1:].T))
        share = np.clip(np.sum(hidden * phi, 1) / np.sum(phi**2, 1), 0.0, 1.0)
        return share[:, None] * slopes * np.array([-1.0, 1.0, 1.0])[:, None, None, None, None], moves

    @property
    def model_share(self) -> np.ndarray:
        """Share of the prediction's assumed error in the assumed variance of every datum; 0 where not observed."""
        return np.where(self.observed, np.maximum(1.0 - self.variance / self.sigma**2, 0.0), 0.0)

    def edges(self, cut: float) -> tuple[Edges, Edges]:
        """Return the edges of the current surface along x and along y."""
        (height, slope_x, slope_y), m = self.surface, self.model
        found = (
            find_edges(height, slope_x, m.dx, 1, self.slope_noise, cut),
            find_edges(height, slope_y, m.dy, 0, self.slope_noise, cut),
        )
        if self.torn is None:
            return found
        edges_x, edges_y = (Edges(e.doubt, np.where(t, 0.0, e.intact)) for e, t in zip(found, self.torn, strict=True))
        return edges_x, edges_y

    @property
    def is_unknown(self) -> bool:
        """Whether more is unknown of the instrument than gains and offsets: drift or geometry."""
        return self.moves is not None or len(self.drift) > 0

    def _mixing(self, problem: tuple[Model, Unknowns, Lagged], is_instrument_free: bool) -> jax.Array | np.ndarray:
        """Return the instruments that are fitted: as they are where it is held or hardly anything of it is unknown."""
        if self.is_unknown and is_instrument_free:
            return _mixing(*problem)
        model, start, _ = problem
        return np.eye(sum(getattr(start, name).size for name in model.instrument_fields(start)))

    def tear(self) -> None:
        """Cut all edges that may lie behind a rim, until `torn` is None again; only where the instrument is unknown."""
        if not self.is_unknown:
            return
        about = self.signal, self.variance, self.surface, self.shift
        self.torn = shadow_edges(*about, 1), shadow_edges(*about, 0)

    def lag(self, limit: float, cut: float) -> tuple[Unknowns, Lagged]:
        """Freeze prediction, edges and robust weights at the current surface; return it as unknowns, too."""
        s, m, p = self.settings, self.model, self.near
        sure = m.geometry.instrument.uncertainty
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
            *(self.values[name] for name in INSTRUMENT),
        )
        inverse_sigma = self.weight / self.sigma
        largest = _NOISY * self.slope_noise * self._steepness()
        lagged = Lagged(
            data=self.data,
            inverse_sigma=inverse_sigma,
            multiple=p.multiple,
            hidden=p.hidden,
            unseen=np.zeros(self.data.shape) if p.unseen is None else p.unseen,
            noise_change=_noise_change(m, self.surface, p.hidden, inverse_sigma, largest, self.moves),
            plateau=self.plateau,
            level=np.einsum("ryx,yx->r", self.plateau, self.predicted_on.height),
            level_response=self.level_response,
            hidden_moves=self.hidden_moves,
            predicted_moves=self.predicted_moves,
            drift=self.drift,
            across=self.across,
            intact_x=edges_x.intact,
            intact_y=edges_y.intact,
            edge_x=edges_x.weight,
            edge_y=edges_y.weight,
            bend_x=bend_of(edges_x.intact, slope_x, self.slope_noise, 1),
            bend_y=bend_of(edges_y.intact, slope_y, self.slope_noise, 0),
            border=self.border,
            whitening=self.whitening,
            slope_scale_x=scale_x,
            slope_scale_y=scale_y,
            gain_std=s.gain_std * np.ones(len(self.signal)),
            offset_std=s.offset_std * self.mean_signal,
            multiple_std=s.multiple_error * np.ones(len(self.signal)),
            drift_std=s.drift_std * self.mean_signal[:, None],
            lines_std=s.line_std * self.mean_signal,
            law_std=s.law_std,
            distance_std=sure.sample_distance_um,
            tilt_std=np.radians(sure.tilt_deg),
            aim_std=self.aim_std,
        )
        return Unknowns(*map(np.asarray, unknowns)), Lagged(*map(np.asarray, lagged))

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
        problem = self.model, *self.lag(limit, cut)
        mixing = self._mixing(problem, is_instrument_free)
        # an array: one compilation serves both cases
        found = _solve(*problem, s.lm_steps, s.cg_steps, mixing, np.asarray(float(is_instrument_free)))
        self.surface = Surface(*map(np.asarray, found.surface))
        self.values = {name: np.asarray(getattr(found.unknowns, name)) for name in INSTRUMENT}
        self.residuals = (np.asarray(found.counts) - self.data) / self.sigma
        return found

    @property
    def tilt(self) -> np.ndarray:
        """Slopes (x, y) of the reference plane that have been fitted [2]."""
        std = np.radians(self.model.geometry.instrument.uncertainty.tilt_deg)
        return std * self.values["tilt"] if self.values["tilt"].size else np.zeros(2)

    @property
    def levelled(self) -> Surface:
        """The surface above the reference plane, which may be tilted."""
        (height, slope_x, slope_y), tilt = self.surface, self.tilt
        return Surface(height - np.tensordot(tilt, self.across, 1), slope_x - tilt[0], slope_y - tilt[1])

    def misfit(self, limit: float, cut: float) -> float:
        """Return half the robust chi-square of data and edges, with the data's normalisation."""
        weight = geman_mcclure(self.residuals, limit)
        data = 0.5 * limit**2 * np.sum(1.0 - weight) + np.sum(np.log(self.sigma[self.observed]))
        return float(data + sum(0.5 * cut**2 * np.sum(1.0 - np.sqrt(e.intact)) for e in self.edges(cut)))
