"""The forward model of the fit: from whitened unknowns to residuals in standard deviations (JAX, differentiable).

What is known of the surface: the data, the edges between pixels, the flat border. What is known of the rest: priors of
gain, offset, the scale of the predicted multiple scattering, and of where the side that the beam does not see stands.
`Lagged` holds all that is constant during one least-squares solve. How it is solved is `refiner`'s matter.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.fft import idctn
from scipy.ndimage import maximum_filter, minimum_filter

from helio_jax.forward.beam_frame import unit_normal
from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.forward.render import render_single
from helio_jax.inverse.edges import bent, one_sided, trapezoid_gap

SLOPE_STD = 30.0
"""Prior deviation of the slopes: holds those that neither datum nor edge fixes."""
GRADIENT = 0.6
"""Share of white slope noise that is left when heights must explain it: a half, and what the edges do not see of
changes from pixel to pixel (measured on a flat: 0.57 to 0.61)."""
_LEVEL = 0.9
"""Facets whose unit normal has a larger vertical part count as level."""


@dataclass(frozen=True)
class Prediction:
    """What the current surface does beyond direct single scattering, per beam atom.

    Attributes:
        multiple: detection probability of order 2 and above [detector, y, x].
        hidden: hidden part of the vector form factor [detector, 3, y, x].
        response: change of `hidden` per change of the heights in a given way [y, x], or None where not known.
        unseen: change of the probabilities by one standard deviation of where the side of the sample that the beam does
            not see stands [detector, y, x], or None where not known. It errs as one: no number of pixels averages it.
        normals: unit normals [y, x, 3] that `multiple` is for, where they are not the surface's own.
    """

    multiple: np.ndarray
    hidden: np.ndarray
    response: Callable[[np.ndarray], np.ndarray] | None = None
    unseen: np.ndarray | None = None
    normals: np.ndarray | None = None

    def thinned(self, thin: tuple[slice, ...]) -> "Prediction":
        """Return it on some rows and columns, without how `hidden` responds."""
        unseen = None if self.unseen is None else self.unseen[:, *thin]
        normals = None if self.normals is None else self.normals[thin]
        return Prediction(self.multiple[:, *thin], self.hidden[:, :, *thin], None, unseen, normals)

    def about(self, normals: np.ndarray) -> "Prediction":
        """Return it as a linear model of the own normal, about the surface's unit normals [y, x, 3] or its own ones.

        A facet whose normal has the vertical part n_z sees the ground around it with the view factor (1 - n_z) / 2, so
        what the ground sends it changes by -M / (1 - n_z) per unit of n_z. This goes where `hidden` goes and changes
        nothing at the facet's own normal: it only makes the rounds converge faster beside steep walls, where slope and
        multiple scattering depend on one another. Level facets get no correction. Source: own derivation.
        """
        up = (normals if self.normals is None else self.normals)[..., 2]
        slope = np.where(up < _LEVEL, self.multiple / np.maximum(1.0 - up, 1.0 - _LEVEL), 0.0)
        hidden = self.hidden.copy()
        hidden[:, 2] += slope
        return replace(self, multiple=self.multiple + slope * up, hidden=hidden)

    def doubt(self, normals: np.ndarray, mask_error: float, multiple_error: float) -> np.ndarray:
        """Return the standard deviation to be expected of it [detector, y, x], for unit normals [y, x, 3].

        Two parts of each term: a share of its own size, and its change over half a pixel, for the surface that
        it was made for is only known from pixel to pixel.
        """
        hidden = np.einsum("kiyx,yxi->kyx", self.hidden, normals)
        parts = [
            share * image + 1j * 0.5 * _largest_change(image)
            for image, share in ((hidden, mask_error), (self.multiple, multiple_error))
        ]
        return np.hypot(*map(np.abs, parts))


def _largest_change(image: np.ndarray) -> np.ndarray:
    """Return the largest difference of every pixel [detector, y, x] from its neighbours in the row and the column."""
    high, low = (f(image, size=(1, 3, 3)) for f in (maximum_filter, minimum_filter))
    return np.maximum(high - image, image - low)


class Surface(NamedTuple):
    """Heights [um] and beam-frame slopes dh/dX, dh/dY at the beam positions [y, x]."""

    height: Any
    slope_x: Any
    slope_y: Any

    def normals(self, shift: tuple[float, float]) -> np.ndarray:
        """Return the unit normals [y, x, 3]."""
        return np.moveaxis(unit_normal(np.asarray(self.slope_x), np.asarray(self.slope_y), shift), 0, -1)


class Lagged(NamedTuple):
    """Everything the residuals hold fixed during one least-squares solve.

    What is hidden follows the levels of the plateaus: `plateau` [plateau, y, x] are the weights whose sum over the
    heights is a plateau's level above the ground, `level` [plateau] its value at the prediction and `level_response`
    [plateau, detector, 3, y, x] the change of `hidden` per um of it. All that is lagged follows the modes of the
    relief: `mode` [mode, y, x] are the weights whose sum over the heights is a mode's amplitude, `amplitude` [mode] its
    value at the prediction and `mode_response` [mode, detector, y, x] the change of the data per unit of it.
    `noise_change` is from `Model.noise_change`. What is hidden also follows the geometry: `hidden_moves`
    [move, detector, 3, y, x] is its change per unit of a move (distance, polar angle, azimuth; um, rad), from where it
    was predicted, `predicted_moves` [move, detector]; both have no moves where the geometry is known. `drift`
    [detector or 1, mode, y, x] are the shapes of the slow drift, and `across` (x, y) [2, y, x] the positions [um] by
    which a tilt raises the border. `level_weight` [y, x] are the weights whose sum over the heights is to be
    `held_level`, both over its deviation; 0 where the level is not held.
    """

    data: Any
    inverse_sigma: Any
    multiple: Any
    hidden: Any
    unseen: Any
    noise_change: Any
    plateau: Any
    level: Any
    level_response: Any
    mode: Any
    amplitude: Any
    mode_response: Any
    hidden_moves: Any
    predicted_moves: Any
    drift: Any
    across: Any
    intact_x: Any
    intact_y: Any
    edge_x: Any
    edge_y: Any
    bend_x: Any
    bend_y: Any
    border: Any
    level_weight: Any
    held_level: Any
    whitening: Any
    slope_scale_x: Any
    slope_scale_y: Any
    gain_std: Any
    offset_std: Any
    multiple_std: Any
    drift_std: Any
    lines_std: Any
    law_std: Any
    distance_std: Any
    tilt_std: Any
    aim_std: Any


INSTRUMENT = (
    "log_gain",
    "offset",
    "log_multiple",
    "unseen",
    "albedo",
    "drift",
    "lines",
    "law",
    "distance",
    "tilt",
    "aim",
)
"""Names of the unknowns that are not the surface, as the last fields of `Unknowns`."""


class Unknowns(NamedTuple):
    """Whitened heights and slopes [y, x]; gain, offset, scale of the multiple scattering [detector]; one for the unseen
    side; albedo modes; slow drift [detector, mode]; offsets of the scan lines [detector, line]; power of the scattering
    law [1]; distance of the sample [1], its tilt [2: x, y]; polar angle and azimuth of the apertures [detector, 2].

    All but the surface in prior deviations. Unknowns that are known have no entries.
    """

    height: Any
    slope_x: Any
    slope_y: Any
    log_gain: Any
    offset: Any
    log_multiple: Any
    unseen: Any
    albedo: Any
    drift: Any
    lines: Any
    law: Any
    distance: Any
    tilt: Any
    aim: Any


def smooth_albedo(modes: jax.Array, shape: tuple[int, ...], std: float) -> jax.Array:
    """Return the smooth albedo exp(sum of cosine modes); the constant mode is left to the gains."""
    if std == 0.0:
        return jnp.ones(shape)
    n = modes.shape[0]
    rank = jnp.hypot(*jnp.meshgrid(jnp.arange(n), jnp.arange(n), indexing="ij"))
    scale = std * jnp.sqrt(shape[0] * shape[1]) / jnp.maximum(rank, 1.0) ** 2
    spectrum = jnp.zeros(shape).at[:n, :n].set((modes * scale).at[0, 0].set(0.0))
    return jnp.exp(idctn(spectrum, norm="ortho"))


class Model(eqx.Module):
    """Static part of the residual function."""

    geometry: SpotGeometry = eqx.field(static=True)
    dx: float = eqx.field(static=True)
    dy: float = eqx.field(static=True)
    albedo_std: float = eqx.field(static=True)
    slow_axis: int = eqx.field(static=True, default=0)

    def surface(self, unknowns: Unknowns, lagged: Lagged) -> Surface:
        """Return heights and slopes of whitened unknowns."""
        height = idctn(unknowns.height * lagged.whitening, norm="ortho")
        base_x = one_sided(jnp.diff(height, axis=1) / self.dx, lagged.intact_x, 1)
        base_y = one_sided(jnp.diff(height, axis=0) / self.dy, lagged.intact_y, 0)
        return Surface(
            height,
            base_x + lagged.slope_scale_x * unknowns.slope_x,
            base_y + lagged.slope_scale_y * unknowns.slope_y,
        )

    def thinned(self, stride: int) -> "Model":
        """Return the model of every `stride`-th row and column."""
        return Model(self.geometry, self.dx * stride, self.dy * stride, self.albedo_std, self.slow_axis)

    def instrument_fields(self, unknowns: Unknowns) -> tuple[str, ...]:
        """Return the names of the unknowns of the instrument that are not known.

        Without the scan lines' offsets: a line has so many pixels that its own noise tells nothing of the others.
        """
        free = tuple(name for name in INSTRUMENT if name != "lines" and getattr(unknowns, name).size)
        return tuple(name for name in free if name != "albedo" or self.albedo_std > 0)

    def normal(self, surface: Surface) -> jax.Array:
        """Return the unit normals [3, y, x]."""
        return unit_normal(surface.slope_x, surface.slope_y, self.geometry.instrument.beam_shift)

    def counts(self, surface: Surface, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
        """Return the expected data [detector, y, x] in units of the beam."""
        rise = jnp.einsum("ryx,yx->r", lagged.plateau, surface.height) - lagged.level
        hidden = lagged.hidden + jnp.tensordot(rise, lagged.level_response, 1)
        moves = self.moves(unknowns, lagged)
        if moves is not None:
            hidden = hidden + jnp.einsum("mk,mkiyx->kiyx", moves - lagged.predicted_moves, lagged.hidden_moves)
        power = jnp.sum(lagged.law_std * unknowns.law) if unknowns.law.size else None
        single = self.single(surface, self.normal(surface), hidden, moves, power)
        albedo = smooth_albedo(unknowns.albedo, surface.height.shape, self.albedo_std)
        gain = jnp.exp(lagged.gain_std * unknowns.log_gain)[:, None, None]
        multiple = lagged.multiple * jnp.exp(lagged.multiple_std * unknowns.log_multiple)[:, None, None]
        single = single - lagged.noise_change
        read = gain * (albedo * single + multiple + unknowns.unseen * lagged.unseen)
        followed = jnp.einsum("ryx,yx->r", lagged.mode, surface.height) - lagged.amplitude
        return read + jnp.tensordot(followed, lagged.mode_response, 1) + self.background(unknowns, lagged)

    def background(self, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
        """Return what the detectors read without signal: offset, slow drift, scan lines ([detector, y, x] or less)."""
        offset = (lagged.offset_std * unknowns.offset)[:, None, None]
        if unknowns.drift.size:
            offset = offset + jnp.sum((lagged.drift_std * unknowns.drift)[:, :, None, None] * lagged.drift, 1)
        if unknowns.lines.size:
            offset = offset + jnp.expand_dims(lagged.lines_std[:, None] * unknowns.lines, 2 - self.slow_axis)
        return offset

    def moves(self, unknowns: Unknowns, lagged: Lagged) -> jax.Array | None:
        """Return distance [um], polar angle and azimuth [rad] beyond the stated ones [move, detector], if unknown."""
        if not lagged.hidden_moves.size:
            return None
        k = lagged.data.shape[0]
        distance = jnp.broadcast_to(jnp.sum(lagged.distance_std * unknowns.distance), (1, k))
        aim = (lagged.aim_std * unknowns.aim).T if unknowns.aim.size else jnp.zeros((2, k))
        return jnp.concatenate([distance, aim])

    def single(
        self,
        surface: Surface,
        normal: jax.Array,
        hidden: jax.Array,
        moves: jax.Array | None,
        power: jax.Array | None = None,
    ) -> jax.Array:
        """Return the single-scattering probabilities [detector, y, x]; the geometry as stated, or moved."""
        lower, aim = (0.0, None) if moves is None else (moves[0, 0], moves[1:].T)
        return render_single(surface.height - lower, normal, hidden, self.geometry, aim, power)

    def noise_change(
        self,
        surface: Surface,
        hidden: jax.Array,
        inverse_sigma: jax.Array,
        largest: jax.Array,
        moves: jax.Array | None = None,
    ) -> jax.Array:
        """Return by how much the noise of the fitted slopes changes the mean signal of their facets [detector, y, x].

        A facet's signal is curved in its slopes: that of noisy slopes is too low in the mean, by tr(c'' V) / 2. With
        two slopes more in every pixel the gains would make up for it, however many pixels there are. V is the
        covariance that the facet's own data leave, times `GRADIENT`.

        Args:
            surface: the fitted one.
            hidden: as in `Lagged`.
            inverse_sigma: of the data [detector, y, x].
            largest: deviation of the slopes that more noise does not exceed [y, x].
            moves: as from `moves`.

        Source: Neyman and Scott, Econometrica 16 (1948) 1; second order: Box, J. R. Stat. Soc. B 33 (1971) 171.
        """

        def signal(x: jax.Array, y: jax.Array) -> jax.Array:
            normal = self.normal(surface._replace(slope_x=x, slope_y=y))
            return self.single(surface, normal, hidden, moves)

        def along(function, way):
            return lambda *slopes: jax.jvp(function, slopes, way)[1]

        at, one = (surface.slope_x, surface.slope_y), jnp.ones_like(surface.height)
        ways = (one, 0.0 * one), (0.0 * one, one)
        first = [along(signal, way) for way in ways]
        c_xx, c_xy, c_yy = (along(first[i], ways[j])(*at) for i, j in ((0, 0), (0, 1), (1, 1)))
        x, y = (f(*at) * inverse_sigma for f in first)
        xx, xy, yy = jnp.sum(x * x, 0) + largest**-2, jnp.sum(x * y, 0), jnp.sum(y * y, 0) + largest**-2
        return 0.5 * GRADIENT * (c_xx * yy - 2.0 * c_xy * xy + c_yy * xx) / (xx * yy - xy**2)

    def data_residuals(self, surface: Surface, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
        """Return (model - data) / standard deviation, robustly weighted [detector, y, x]."""
        return (self.counts(surface, unknowns, lagged) - lagged.data) * lagged.inverse_sigma

    def edge_scale(self, surface: Surface, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
        """Return the factor of the edges' weights: how sensitive the data are to slopes, relative to what is stated.

        Edges count in units of the slope noise that the data's noise makes, which falls with the gain and, near the
        plate, with the height: else a larger gain or level would explain the noise by smaller slopes, which the edges
        would prefer, however many pixels there are. For a level facet at the mean height.
        """
        weight = jnp.sqrt(jnp.mean(lagged.inverse_sigma**2, (1, 2)))
        gain = jnp.exp(lagged.gain_std * unknowns.log_gain)
        moves = self.moves(unknowns, lagged)
        here = self.sensitivity(jnp.mean(surface.height), moves)
        stated = self.sensitivity(jnp.zeros(()), None)
        return jnp.sqrt(jnp.sum((weight * gain * here) ** 2) / jnp.sum((weight * stated) ** 2))

    def sensitivity(self, height: jax.Array, moves: jax.Array | None) -> jax.Array:
        """Return by how much the signal of a level facet changes with its slopes [2, detector]."""
        height = jnp.reshape(height, (1, 1))
        hidden = jnp.zeros((len(self.geometry.rims), 3, 1, 1))
        level = Surface(height, jnp.zeros_like(height), jnp.zeros_like(height))

        def signal(x, y):
            normal = self.normal(level._replace(slope_x=x, slope_y=y))
            return self.single(level, normal, hidden, moves)[:, 0, 0]

        at, one = (level.slope_x, level.slope_y), jnp.ones_like(height)
        return jnp.stack([jax.jvp(signal, at, way)[1] for way in ((one, 0.0 * one), (0.0 * one, one))])

    def edge_residuals(self, surface: Surface, unknowns: Unknowns, lagged: Lagged) -> tuple[jax.Array, jax.Array]:
        """Return the edges' residuals [y, x - 1], [y - 1, x]."""
        scale = self.edge_scale(surface, unknowns, lagged)
        gap_x = trapezoid_gap(surface.height, bent(surface.slope_x, lagged.bend_x, 1), self.dx, 1)
        gap_y = trapezoid_gap(surface.height, bent(surface.slope_y, lagged.bend_y, 0), self.dy, 0)
        return gap_x * lagged.edge_x * scale, gap_y * lagged.edge_y * scale

    def residuals(self, unknowns: Unknowns, lagged: Lagged) -> dict[str, jax.Array]:
        """Return all residuals in standard deviations."""
        surface = self.surface(unknowns, lagged)
        edge_x, edge_y = self.edge_residuals(surface, unknowns, lagged)
        return {
            "data": self.data_residuals(surface, unknowns, lagged),
            "edge_x": edge_x,
            "edge_y": edge_y,
            "border": self.border_residuals(surface, unknowns, lagged),
            "level": jnp.sum(lagged.level_weight * surface.height) - lagged.held_level,
            "slope_x": surface.slope_x / SLOPE_STD,
            "slope_y": surface.slope_y / SLOPE_STD,
            **{name: getattr(unknowns, name) for name in INSTRUMENT},
        }

    def border_residuals(self, surface: Surface, unknowns: Unknowns, lagged: Lagged) -> jax.Array:
        """Return the heights' deviations from the reference plane, which may be tilted, where they are known [y, x]."""
        height = surface.height
        if unknowns.tilt.size:
            height = height - jnp.tensordot(lagged.tilt_std * unknowns.tilt, lagged.across, 1)
        return height * lagged.border
