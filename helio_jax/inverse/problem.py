"""The state of one fit: surface, instrument, and the problem lagged there that `leastsquares` solves.

Unknowns: height and two slopes of every pixel, gain and offset of every detector, scale of the multiple scattering, a
smooth albedo. They are whitened so that plain conjugate gradients converge in a few steps: heights by the cosine
transform, h = DCT^-1(y / sqrt(lambda)), for the data fix slopes; slopes as deviations from the heights' one-sided
differences.
"""

import copy
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.fft import dctn

from helio_jax.arrays import border_mask
from helio_jax.errors import GuardError
from helio_jax.forward.aiming import aimed_slopes
from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.readout import ScanOrder, drift_modes
from helio_jax.instrument import Instrument
from helio_jax.inverse.edges import Edges, bend_of, find_edges, geman_mcclure, one_sided, to_pixels
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.occlusion import shadow_edges
from helio_jax.inverse.residuals import INSTRUMENT, Lagged, Model, Prediction, Surface, Unknowns
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.solver import Solution, solve, whitened_instrument

LEVEL_STEP, SCALE_STEP, TILT_STEP = 0.02, 0.05, 0.03
"""How far a relief is lowered (share of the distance), flattened (share of itself) and tilted to see what follows."""
LEVEL_STD = 0.1
"""How firmly a level is held [um]."""
_NOISY = 3.0
"""Deviation that slopes are credited with at most, in those of a pixel with median noise."""
_HELD = 1e-5
"""Least prior weight of a height, 1/um: holds a pixel that all edges part from the rest."""

Predict = Callable[..., Prediction]
"""(heights [y, x] um, unit normals [y, x, 3]) -> Prediction; the instrument is given, too, where it is unknown."""


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


def _modes(surface: Surface, is_told: np.ndarray, across: np.ndarray, distance: float) -> list[Surface]:
    """Return small changes of a relief that leave its shape: lower, flatter, tilted about y, tilted about x.

    Args:
        surface: the relief.
        is_told: where the data tell of it [y, x].
        across: positions (x, y) [2, y, x], um.
        distance: of the sample from the plate, um.
    """
    none = np.zeros(is_told.shape)
    mean = np.mean(surface.height[is_told])
    flatter = (-SCALE_STEP * field for field in (surface.height - mean, surface.slope_x, surface.slope_y))
    return [
        Surface(none - LEVEL_STEP * distance, none, none),
        Surface(*flatter),
        Surface(TILT_STEP * across[0], none + TILT_STEP, none),
        Surface(TILT_STEP * across[1], none, none + TILT_STEP),
    ]


def _amplitudes(modes: list[Surface], is_told: np.ndarray) -> np.ndarray:
    """Return the weights [mode, y, x] whose sums over changes of the heights tell how often the modes are in them."""
    weights = np.zeros((len(modes), *is_told.shape))
    weights[:, is_told] = np.linalg.pinv(np.stack([mode.height[is_told] for mode in modes], 1))
    return weights


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


@eqx.filter_jit
def _counts(model: Model, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
    return model.counts(model.surface(unknowns, lagged), unknowns, lagged)


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
        order=ScanOrder(),
    ) -> None:
        s = settings.refine
        self.signal, self.variance, self.settings, self.order = signal, variance, s, order
        self.model = Model(geometry, dx, dy, s.albedo_std, order.slow_axis)
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
        self.is_level_held = settings.border == "free" and s.level_std_um is not None
        self.is_level_free = settings.border == "free" and not self.is_level_held
        self.plateau = _plateau_weights(np.zeros(shape, int) if region is None else region)
        self.surface = Surface(*map(np.asarray, start))
        self.level_weight = self._level_weight()
        self.held_level = float(np.sum(self.level_weight * self.surface.height))
        self.drift = drift_modes(shape, order, s.drift_degrees) if s.drift_std else np.zeros((1, 0, *shape))
        sides = (d * (np.arange(n) - 0.5 * (n - 1)) for d, n in ((dx, shape[1]), (dy, shape[0])))
        self.across = np.stack(np.meshgrid(*sides))
        self.values = self._at_prior_means(geometry.instrument)
        nothing = np.zeros(signal.shape)
        self.adopt(Prediction(nothing, np.stack([nothing] * 3, 1)), self.surface)
        self.level_response = np.zeros((len(self.plateau), len(signal), 3, *shape))
        self.mode = np.zeros((0, *shape))
        self.mode_response = np.zeros((0, *signal.shape))
        self.torn: tuple[np.ndarray, np.ndarray] | None = None
        self.residuals = np.zeros(signal.shape)
        self.weight = np.ones(signal.shape)

    @property
    def is_told(self) -> np.ndarray:
        """Where the data tell of the surface [y, x]."""
        return self.observed.sum(0) >= MIN_IMAGES

    def _level_weight(self) -> np.ndarray:
        """Return the weights [y, x] of the mean height over its deviation, or 0 where nothing holds it."""
        return self.is_level_held * self.is_told / np.maximum(self.is_told.sum(), 1) / LEVEL_STD

    def _at_prior_means(self, instrument: Instrument) -> dict[str, np.ndarray]:
        """Return the unknowns of the instrument, all 0; those that are known have no entries."""
        s, sure = self.settings, instrument.uncertainty
        k, n = self.signal.shape[0], s.albedo_modes
        lines = self.signal.shape[1 + self.model.slow_axis] if s.line_std else 0
        shapes = {"log_gain": k, "offset": k, "log_multiple": k, "unseen": (), "albedo": (n, n)}
        shapes |= {"drift": (k, self.drift.shape[1]), "lines": (k, lines), "law": 1 if s.law_std else 0}
        is_aimed = s.geometry and (sure.polar_deg or sure.azimuth_deg)
        shapes["distance"] = 1 if s.geometry and self.distance_std else 0
        shapes |= {"tilt": 2 if s.geometry and sure.tilt_deg else 0, "aim": (k, 2) if is_aimed else 0}
        return {name: np.zeros(shape) for name, shape in shapes.items()}

    @property
    def distance_std(self) -> float:
        """Prior deviation of the distance of the plate [um]: a level that is held stands for what is known of it."""
        held = self.settings.level_std_um if self.is_level_held else None
        return held or self.model.geometry.instrument.uncertainty.sample_distance_um

    @property
    def tilt_std(self) -> float:
        """Prior deviation of the tilt of the reference plane, rad."""
        return math.radians(self.model.geometry.instrument.uncertainty.tilt_deg)

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
        moved = self.distance_std * distance.sum()
        return np.stack([np.full(k, moved), *((self.aim_std * aim).T if aim.size else np.zeros((2, k)))])

    @property
    def instrument(self) -> Instrument:
        """The instrument with the geometry fitted so far."""
        stated = self.model.geometry.instrument
        return stated if self.moves is None else stated.moved(self.moves[1:].T, float(self.moves[0, 0]))

    def predict(self, predict: Predict) -> None:
        """Predict masks and multiple scattering on the current surface, and how masks follow the plateaus' levels."""
        self.adopt(self._predicted(predict), self.surface)
        if self.prediction.response is not None:
            for i, weights in enumerate(self.plateau):
                self.level_response[i] = self.prediction.response((weights > 0).astype(float))

    def _predicted(self, predict: Predict) -> Prediction:
        """Return the prediction on the current surface, by the instrument found so far."""
        about = () if self.moves is None else (self.instrument,)
        return predict(self.surface.height, self.surface.normals(self.shift), *about)

    def follow_modes(self, predict: Predict) -> None:
        """Find how what is lagged follows level, scale and tilt of the relief, by predictions on changed surfaces.

        With a free border these are known so little better than by the priors that rounds that hold what is scattered
        several times would run away along them, or come to rest where the misfit is not least: relief came out 8 % too
        flat on pyramids. What cannot be predicted on a changed surface does not follow.
        """
        limits = self.settings.robust_limits[-1], self.settings.jump_limits[-1]
        is_told = self.is_told
        modes = _modes(self.predicted_on, is_told, self.across, self.model.geometry.instrument.sample_distance)
        self.mode, self.mode_response = _amplitudes(modes, is_told), np.zeros((len(modes), *self.signal.shape))
        at_prediction = copy.copy(self)
        at_prediction.surface = self.predicted_on
        noise_change = at_prediction.lag(*limits)[1].noise_change
        for i, change in enumerate(modes):
            twin = copy.copy(self)
            twin.mode_response = np.zeros_like(self.mode_response)
            twin.surface = Surface(*(now + by for now, by in zip(self.predicted_on, change, strict=True)))
            unknowns, held = twin.lag(*limits)
            before = _counts(self.model, unknowns, held._replace(noise_change=noise_change))
            try:
                twin.adopt(twin._predicted(predict), twin.surface)
            except GuardError:
                continue
            self.mode_response[i] = np.asarray(_counts(self.model, *twin.lag(*limits)) - before)

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
        return self.moves is not None or self.drift.shape[1] > 0

    def _mixing(self, problem: tuple[Model, Unknowns, Lagged], is_instrument_free: bool) -> jax.Array | np.ndarray:
        """Return the instruments and levels that are fitted: as they are where they are held or little is unknown."""
        if is_instrument_free and (self.is_unknown or self.is_level_free):
            return whitened_instrument(*problem, np.asarray(float(self.is_level_free)))
        model, start, _ = problem
        n = sum(getattr(start, name).size for name in model.instrument_fields(start))
        return np.diag([1.0] * n + [0.0])

    def tear(self) -> None:
        """Cut all edges that may lie behind a rim, until `torn` is None again; only where the instrument is unknown."""
        if not self.is_unknown:
            return
        about = self.signal, self.variance, self.surface, self.shift
        self.torn = shadow_edges(*about, 1), shadow_edges(*about, 0)

    def weigh(self, limit: float, cut: float) -> tuple[Edges, Edges]:
        """Find robust weights and edges at the current surface, and keep them; return the edges."""
        self.weight = geman_mcclure(self.residuals, limit)
        edges_x, edges_y = self.edges(cut)
        self.intact_x, self.intact_y = edges_x.intact, edges_y.intact
        return edges_x, edges_y

    def lag(self, limit: float, cut: float) -> tuple[Unknowns, Lagged]:
        """Freeze prediction, edges and robust weights at the current surface; return it as unknowns, too."""
        s, m, p = self.settings, self.model, self.near
        height, slope_x, slope_y = self.surface
        edges_x, edges_y = self.weigh(limit, cut)
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
            mode=self.mode,
            amplitude=np.einsum("ryx,yx->r", self.mode, self.predicted_on.height),
            mode_response=self.mode_response,
            drift=self.drift,
            across=self.across,
            intact_x=edges_x.intact,
            intact_y=edges_y.intact,
            edge_x=edges_x.weight,
            edge_y=edges_y.weight,
            bend_x=bend_of(edges_x.intact, slope_x, self.slope_noise, 1),
            bend_y=bend_of(edges_y.intact, slope_y, self.slope_noise, 0),
            border=self.border,
            level_weight=self.level_weight,
            held_level=self.held_level,
            whitening=self.whitening,
            slope_scale_x=scale_x,
            slope_scale_y=scale_y,
            gain_std=s.gain_std * np.ones(len(self.signal)),
            offset_std=s.offset_std * self.mean_signal,
            multiple_std=s.multiple_error * np.ones(len(self.signal)),
            drift_std=s.drift_std * self.mean_signal[:, None],
            lines_std=s.line_std * self.mean_signal,
            law_std=s.law_std,
            distance_std=self.distance_std,
            tilt_std=self.tilt_std,
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
        found = solve(*problem, s.lm_steps, s.cg_steps, mixing, np.asarray(float(is_instrument_free)))
        self.surface = Surface(*map(np.asarray, found.surface))
        self.values = {name: np.asarray(getattr(found.unknowns, name)) for name in INSTRUMENT}
        self.residuals = (np.asarray(found.counts) - self.data) / self.sigma
        return found

    def simulated(self) -> "Refiner":
        """Return a fit that starts from its own truth: this surface, the instrument at its prior means, no noise."""
        twin = copy.copy(self)
        twin.values = self._at_prior_means(self.model.geometry.instrument)
        twin.data, twin.residuals = twin._expected(is_noisy=False), np.zeros(self.data.shape)
        return twin

    def move_back(self, surface: Surface, values: dict[str, np.ndarray]) -> None:
        """Subtract a change of the surface and one of the instrument."""
        self.surface = Surface(*(field - by for field, by in zip(self.surface, surface, strict=True)))
        self.values = {name: value - values[name] for name, value in self.values.items()}
        self.residuals = (self._expected(is_noisy=True) - self.data) / self.sigma

    def _expected(self, is_noisy: bool) -> np.ndarray:
        """Return the data expected at the current surface, whose slopes may be noisy ones; 0 where not observed."""
        unknowns, lagged = self.lag(self.settings.robust_limits[-1], self.settings.jump_limits[-1])
        if not is_noisy:
            lagged = lagged._replace(noise_change=np.zeros(self.data.shape))
        return np.where(self.observed, _counts(self.model, unknowns, lagged), 0.0)

    @property
    def tilt(self) -> np.ndarray:
        """Slopes (x, y) of the reference plane that have been fitted [2]."""
        return self.tilt_std * self.values["tilt"] if self.values["tilt"].size else np.zeros(2)

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
