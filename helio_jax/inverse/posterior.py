"""Error bars of the fit: the Laplace posterior of heights and slopes, with the instrument marginalised.

At the minimum the whitened residuals are linear in the unknowns, r = J_s ds + J_c dc, with the surface s (height and
two slopes of every pixel, coupled to neighbours only) and the few instrument parameters c (gains, offsets, albedo
modes, or whatever is added later). The information of the surface, A = J_s' J_s, is sparse and factorised once; it
is bordered by B = J_s' J_c. The Schur complement S = J_c' J_c - B' A^-1 B is the instrument's marginal information, and
-A^-1 B is what the surface does when an instrument parameter is forced: the sensitivity to calibration. A sample of
the joint posterior is the answer to noise in every residual, so each derived number (area, angle, step) gets its error
bar from the same samples. Noise of the counts is independent; what is assumed of errors in the predicted masks and
multiple scattering agrees between neighbours (`ModelError`), so that no number of pixels averages it away.

On rasters above `MAX_PIXELS` every 2nd (4th, ...) row and column stands for the rest, which is stated in the result.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import splu

from helio_jax.inverse.edges import along
from helio_jax.inverse.residuals import SLOPE_STD, Lagged, Model, Surface, Unknowns
from helio_jax.inverse.samples import also_off_by, on_raster

MAX_PIXELS = 30_000
"""Largest raster whose information matrix is factorised; above, the raster is thinned."""


@dataclass(frozen=True)
class Linearised:
    """The residuals of a fit to first order, in standard deviations.

    Attributes:
        surface: derivative with respect to (height [um], slope x, slope y) of every pixel, [residual, 3 * pixel].
        instrument: derivative with respect to the instrument parameters, in prior deviations [residual, parameter].
        far: derivative with respect to what all heights have in common [residual, common]: the levels of the plateaus
            through what they hide, the modes through the prediction, the level that is held and, as the last, the mean
            height through what the edges count; it adds far @ plateau.T to `surface`.
        plateau: derivative of those with respect to the surface [3 * pixel, common].
        names: of the instrument parameters.
        shape: of the raster (y, x).
    """

    surface: sparse.csr_matrix
    instrument: np.ndarray
    far: np.ndarray
    plateau: np.ndarray
    names: tuple[str, ...]
    shape: tuple[int, int]

    def transposed(self, residuals: np.ndarray) -> np.ndarray:
        """Return the surface's whole derivative, transposed, times residuals [residual, ...]."""
        return self.surface.T @ residuals + self.plateau @ (self.far.T @ residuals)

    def apply(self, surface: np.ndarray) -> np.ndarray:
        """Return the surface's whole derivative times changes of the surface [3 * pixel, ...]."""
        return self.surface @ surface + self.far @ (self.plateau.T @ surface)

    def solver(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function that solves with the information matrix of the surface, for [3 * pixel, ...].

        The sparse part is factorised, the plateaus' part is added by the Woodbury identity.
        """
        information = (self.surface.T @ self.surface).tocsc()
        factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        n = self.far.shape[1]
        if n == 0:
            return factor.solve
        update = np.hstack([self.surface.T @ self.far, self.plateau])
        middle = np.block([[np.zeros((n, n)), np.eye(n)], [np.eye(n), self.far.T @ self.far]])
        answer = factor.solve(update)
        small = np.linalg.inv(middle) + update.T @ answer
        return lambda right: (free := factor.solve(right)) - answer @ np.linalg.solve(small, update.T @ free)


@dataclass(frozen=True)
class Posterior:
    """What the data leave open.

    Attributes:
        samples: deviations of the heights [sample, y, x], um.
        instrument_samples: of the instrument parameters, in prior deviations [sample, parameter].
        response: what the heights do when a parameter is forced by one prior deviation [parameter, y, x], um.
        instrument_covariance: in prior deviations [parameter, parameter].
        names: of the instrument parameters.
        stride: thinning of the raster at which it was computed (1: none).
        widening: factor by which all deviations were enlarged, for the instrument disagrees with what it says.
        bent: errors of all heights together that were added for the same reason, or for a fit that has not converged,
            one standard deviation of each [error, y, x], um.
    """

    samples: np.ndarray
    instrument_samples: np.ndarray
    response: np.ndarray
    instrument_covariance: np.ndarray
    names: tuple[str, ...]
    stride: int = 1
    widening: float = 1.0
    bent: np.ndarray | None = None

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the unknowns that the instrument parameters are entries of, in their order."""
        return tuple(dict.fromkeys(name.partition("[")[0] for name in self.names))

    @property
    def height_std(self) -> np.ndarray:
        """Standard deviation of every height [y, x], um; itself known to 1 / sqrt(2 samples)."""
        return np.sqrt(np.mean(self.samples**2, axis=0))

    def levelled(self, planes: np.ndarray) -> "Posterior":
        """Return it for the heights above a reference plane that is tilted, by the parameters tilt[0] and tilt[1].

        Args:
            planes: what one prior deviation of each raises the reference plane by [2, y, x], um.
        """
        tilts = [self.names.index(name) for name in ("tilt[0]", "tilt[1]") if name in self.names]
        if not tilts:
            return self
        response = self.response.copy()
        response[tilts] -= planes
        fallen = np.tensordot(self.instrument_samples[:, tilts], planes, 1)
        return replace(self, samples=self.samples - fallen, response=response)

    def widened(self, values: dict[str, np.ndarray], names: tuple[str, ...], least: float = 1.0) -> "Posterior":
        """Return it with error bars that allow for a model that lacks something.

        Where the fitted `values` of the unknowns called `names` are farther from what was stated than prior and data
        explain (`disagreement`), all deviations are multiplied by that factor f. And something else may have bent them:
        then heights are wrong by what they, and all that followed them, did to the heights. The share 1 - 1 / f^2 of
        that change's square is added to the heights' variance, one error for all of the surface. Factors below `least`
        are taken for chance.
        """
        of = [name for name in self.fields if name in names]
        if not of:
            return self
        mine = np.array([name.partition("[")[0] in of for name in self.names])
        flat = np.concatenate([np.ravel(values[name]) for name in of])
        own = self.instrument_covariance[np.ix_(mine, mine)]
        factor = disagreement(flat, own)
        if factor < least:
            return self
        followed = self.instrument_covariance[:, mine] @ np.linalg.solve(own, flat)
        bent = np.sqrt(1.0 - factor**-2) * np.tensordot(followed, self.response, 1)
        enlarged = replace(
            self,
            samples=factor * self.samples,
            instrument_samples=factor * self.instrument_samples,
            instrument_covariance=factor**2 * self.instrument_covariance,
            widening=factor * self.widening,
            bent=None if self.bent is None else factor * self.bent,
        )
        return enlarged.also_off_by(bent)

    def also_off_by(self, error: np.ndarray) -> "Posterior":
        """Return it with one error more, of all heights together, known up to a factor of deviation 1 [y, x], um.

        The factors of several errors are drawn independently of one another.
        """
        n_before = 0 if self.bent is None else len(self.bent)
        bent = error[None] if self.bent is None else np.concatenate([self.bent, error[None]])
        return replace(self, samples=also_off_by(self.samples, error, 1 + n_before), bent=bent)

    def on_raster(self, shape: tuple[int, int], stride: int) -> "Posterior":
        """Return it on the full raster [y, x], each pixel taking the values of its nearest one."""
        if stride == 1:
            return self
        full = partial(on_raster, shape=shape, stride=stride)
        bent = None if self.bent is None else full(self.bent)
        return replace(self, samples=full(self.samples), response=full(self.response), stride=stride, bent=bent)


@dataclass(frozen=True)
class ModelError:
    """What is assumed of errors in the predicted data: Gaussian averages of independent ones.

    Attributes:
        share: of the variance assumed of every datum [detector, y, x].
        length: standard deviation of the Gaussian average along y and x, in pixels of the full raster.
        stride: thinning of the raster; each datum then stands for stride x stride ones.
    """

    share: np.ndarray
    length: tuple[float, float]
    stride: int = 1

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of the mean error of a datum's pixels, in deviations assumed of it [detector, y, x]."""
        apart = np.subtract.outer(np.arange(self.stride), np.arange(self.stride))
        agreement = [np.mean(np.exp(-0.25 * (apart / max(n, 1e-3)) ** 2)) for n in self.length]
        return self.stride * np.sqrt(self.share * np.prod(agreement))

    def average(self, white: np.ndarray) -> np.ndarray:
        """Return errors of variance 1 that agree between neighbours, from white noise; its own transpose."""
        lengths = [n / self.stride for n in self.length]
        smooth = gaussian_filter(white, lengths, axes=(-2, -1))
        return smooth / np.prod([_left_of_white(n) for n in lengths])

    def draw(self, rng: np.random.Generator, white: np.ndarray) -> np.ndarray:
        """Return errors of the data [detector * y * x, sample], in deviations assumed of them.

        `white` is the counts' noise; what the model has of the variance is taken from it.
        """
        n, shape = white.shape[1], self.share.shape
        model = self.deviation * self.average(rng.standard_normal((n, *shape)))
        counts = np.sqrt(1.0 - self.share) * white.T.reshape(n, *shape)
        return (model + counts).reshape(n, -1).T

    def covariance(self, influence: np.ndarray) -> np.ndarray:
        """Return the covariance of the sums of such errors weighted by `influence` [detector * y * x, parameter]."""
        images = influence.T.reshape(-1, *self.share.shape)
        model, counts = self.average(self.deviation * images), np.sqrt(1.0 - self.share) * images
        both = np.concatenate([model, counts], axis=1)
        return np.einsum("pkyx,qkyx->pq", both, both)


def _left_of_white(length: float) -> float:
    """Return the standard deviation that a Gaussian average over `length` pixels leaves of white noise."""
    impulse = np.zeros(2 * int(4.0 * length + 1.0) + 1)
    impulse[impulse.size // 2] = 1.0
    return float(np.sqrt(np.sum(gaussian_filter(impulse, length) ** 2)))


class _Rows:
    """Collects sparse rows block by block."""

    def __init__(self, n_pixels: int) -> None:
        self._blocks: list[sparse.csr_matrix] = []
        self._n = n_pixels

    def add(self, *terms: tuple[np.ndarray, int, np.ndarray]) -> None:
        """Add one row per pixel of the terms: (pixel index, 0 height, 1 slope x or 2 slope y, value)."""
        count = terms[0][0].size
        row = np.tile(np.arange(count), len(terms))
        column = np.concatenate([3 * pixel.ravel() + part for pixel, part, _ in terms])
        value = np.concatenate([np.broadcast_to(v, p.shape).ravel() for p, _, v in terms])
        self._blocks.append(sparse.csr_matrix((value, (row, column)), shape=(count, 3 * self._n)))

    @property
    def n_rows(self) -> int:
        return sum(block.shape[0] for block in self._blocks)  # type: ignore[index]  # SciPy's stubs allow no shape

    def stack(self, n_more: int) -> sparse.csr_matrix:
        """Return all rows, and `n_more` empty ones below."""
        empty = sparse.csr_matrix((n_more, 3 * self._n))
        return sparse.csr_matrix(sparse.vstack([*self._blocks, empty]))


@eqx.filter_jit
def _derivatives(model: Model, unknowns: Unknowns, lagged: Lagged):
    """Return how data residuals follow their pixel's surface, how they and edges follow the instrument, and the levels.

    In this order: data by surface field, data by instrument, edges and border by instrument, data by level, edges by
    mean height; and the factor of the edges' weights.
    """
    surface = model.surface(unknowns, lagged)
    one, zero = (jax.tree.map(f, surface) for f in (jnp.ones_like, jnp.zeros_like))
    directions = [zero._replace(**{name: getattr(one, name)}) for name in surface._fields]

    def derivative(function, direction):
        return jax.jvp(function, (surface,), (direction,))[1]

    def own(changed: Surface) -> jax.Array:  # while levels and modes, which are of many pixels, stay as they are
        level, amplitude = (
            at + jnp.einsum("ryx,yx->r", weights, changed.height - surface.height)
            for at, weights in ((lagged.level, lagged.plateau), (lagged.amplitude, lagged.mode))
        )
        return model.data_residuals(changed, unknowns, lagged._replace(level=level, amplitude=amplitude))

    data = [derivative(own, d) for d in directions]
    free = {name: getattr(unknowns, name) for name in model.instrument_fields(unknowns)}
    instrument, edges, border = (
        jax.jacfwd(lambda v, f=f: f(surface, unknowns._replace(**v), lagged))(free)
        for f in (model.data_residuals, model.edge_residuals, model.border_residuals)
    )

    def followed(rise: jax.Array, grown: jax.Array) -> jax.Array:
        raised = lagged._replace(level=lagged.level - rise, amplitude=lagged.amplitude - grown)
        return model.data_residuals(surface, unknowns, raised)

    still = jnp.zeros_like(lagged.level), jnp.zeros_like(lagged.amplitude)
    levels = jnp.concatenate(jax.jacfwd(followed, (0, 1))(*still), -1)
    raised = jax.jvp(lambda s: model.edge_residuals(s, unknowns, lagged), (surface,), (directions[0],))[1]
    return data, instrument, (*edges, border), levels, raised, model.edge_scale(surface, unknowns, lagged)


def linearise(model: Model, unknowns: Unknowns, lagged: Lagged) -> Linearised:
    """Return the Jacobian of `model.residuals` at the fit, in terms of the surface itself instead of its whitened form.

    tests/gradients/test_model.py compares it with the automatic Jacobian of the residuals.
    """
    shape = lagged.border.shape
    pixel = np.arange(lagged.border.size).reshape(shape)
    found = jax.tree.map(np.asarray, _derivatives(model, unknowns, lagged))
    data, instrument, of_edges, levels, raised, scale = found
    by_parameter = {name: instrument[name] for name in model.instrument_fields(unknowns)}
    rows = _Rows(pixel.size)
    for k in range(data[0].shape[0]):
        rows.add(*((pixel, part, d[k]) for part, d in enumerate(data)))
    n_data = data[0].size
    for axis, part, pitch, weight, bend in (
        (1, 1, model.dx, lagged.edge_x, lagged.bend_x),
        (0, 2, model.dy, lagged.edge_y, lagged.bend_y),
    ):
        w = scale * np.asarray(weight)
        of_slopes = []
        for end, share in zip(along(pixel, axis), along(np.asarray(bend) / 24.0, axis), strict=True):
            step = pixel.shape[1] if axis == 0 else 1
            around = (np.clip(end + way, 0, pixel.size - 1) for way in (-step, step))  # at the border, the share is 0
            of_slopes += [(end, part, -w * (0.5 + 2.0 * share)), *((p, part, w * share) for p in around)]
        before, after = along(pixel, axis)
        rows.add((after, 0, w / pitch), (before, 0, -w / pitch), *of_slopes)
    rows.add((pixel, 0, np.asarray(lagged.border)))
    for part in (1, 2):
        rows.add((pixel, part, np.full(shape, 1.0 / SLOPE_STD)))
    n_rows = rows.n_rows  # below: the held level, which is of all heights, and the priors of the instrument
    names = [f"{n}{list(i)}" for n, block in by_parameter.items() for i in np.ndindex(block.shape[data[0].ndim :])]

    def of_instrument(blocks: dict[str, np.ndarray], n: int) -> np.ndarray:
        return np.concatenate([blocks[name].reshape(n, -1) for name in by_parameter], 1)

    of_x, of_y, of_border = of_edges
    parts = (instrument, n_data), (of_x, lagged.edge_x.size), (of_y, lagged.edge_y.size), (of_border, pixel.size)
    columns = np.concatenate([of_instrument(blocks, n) for blocks, n in parts])
    matrix = rows.stack(n_more=1 + len(names))
    by_instrument = np.zeros((n_rows + 1 + len(names), len(names)))
    by_instrument[: len(columns)] = columns
    by_instrument[-len(names) :] = np.eye(len(names))
    weights = np.concatenate([lagged.plateau, lagged.mode])
    n_far = len(weights) + 2
    far, of_surface = np.zeros((len(by_instrument), n_far)), np.zeros((3 * pixel.size, n_far))
    far[:n_data, :-2] = levels.reshape(n_data, len(weights))
    of_surface[::3, :-2] = weights.reshape(len(weights), pixel.size).T
    far[n_rows, -2], of_surface[::3, -2] = 1.0, np.ravel(lagged.level_weight)
    edges = np.concatenate([part.ravel() for part in raised])
    far[n_data : n_data + edges.size, -1], of_surface[::3, -1] = edges, 1.0 / pixel.size
    return Linearised(matrix, by_instrument, far, of_surface, tuple(names), shape)


def sample_posterior(linear: Linearised, n_samples: int, seed: int = 0, error: ModelError | None = None) -> Posterior:
    """Factorise the information and draw samples of the joint posterior.

    With a `ModelError` the fit is still the one that takes all errors of the data for independent, as it was done; its
    spread is that of data whose errors are not.

    Args:
        linear: residuals at the fit, from `linearise`, those of the data first.
        n_samples: samples.
        seed: of the noise.
        error: what is assumed of the predicted data.

    Source: Schur complement: Triggs et al., Bundle Adjustment (2000), sec. 6.1; samples: Bardsley, Solonen, Haario and
        Laine, SIAM J. Sci. Comput. 36 (2014) A1895 (randomise-then-optimise), in its linear case; errors that the fit
        takes for independent: White, Econometrica 48 (1980) 817 (the sandwich).
    """
    jc, solve = linear.instrument, linear.solver()
    border = linear.transposed(jc)
    answer = solve(border)
    influence = (jc - linear.apply(answer)) @ np.linalg.inv(jc.T @ jc - border.T @ answer)
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((jc.shape[0], n_samples))
    n_data = 0
    covariance = np.zeros((jc.shape[1],) * 2)
    if error is not None:
        n_data = error.share.size
        noise[:n_data] = error.draw(rng, noise[:n_data])
        covariance = error.covariance(influence[:n_data])
    covariance = covariance + influence[n_data:].T @ influence[n_data:]
    instrument = influence.T @ noise
    surface = solve(linear.transposed(noise)) - answer @ instrument
    to_height = lambda a: np.moveaxis(a[::3], 1, 0).reshape(-1, *linear.shape)  # noqa: E731
    return Posterior(to_height(surface), instrument.T, -to_height(answer), covariance, linear.names)


def disagreement(values: np.ndarray, covariance: np.ndarray) -> float:
    """Return by what factor an instrument is farther from what was stated than prior and data explain; at least 1.

    Where the priors are right, a combination that the data leave with the variance c is found with the variance 1 - c
    about the stated one. The factor is the Birge ratio of the combinations of which the data tell more than the prior.

    Args:
        values: fitted, in prior deviations [parameter].
        covariance: posterior, in prior deviations [parameter, parameter].

    Source: Birge, Phys. Rev. 40 (1932) 207; as scale factor: Particle Data Group, Introduction, sec. 5.2.2.
    """
    left, ways = np.linalg.eigh(covariance)
    is_told = left < 0.5
    if not is_told.any():
        return 1.0
    square = (ways.T @ values)[is_told] ** 2 / (1.0 - left[is_told])
    return float(max(1.0, np.sqrt(square.mean())))


def exact_height_covariance(linear: Linearised) -> np.ndarray:
    """Return the posterior covariance of the heights [y * x, y * x], um^2, dense; for rasters of up to 32 x 32."""
    both = np.hstack([linear.surface.toarray() + linear.far @ linear.plateau.T, linear.instrument])
    covariance = np.linalg.inv(both.T @ both)
    n = 3 * linear.shape[0] * linear.shape[1]
    return covariance[:n:3, :n:3]
