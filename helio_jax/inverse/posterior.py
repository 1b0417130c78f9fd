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
from scipy.sparse.linalg import splu

from helio_jax.forward.compiling import compiled
from helio_jax.forward.surface import Surface, along
from helio_jax.inverse.correlated_errors import Errors
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.residuals import (
    SLOPE_STD,
    FixedTerms,
    Unknowns,
    border_residuals,
    data_residuals,
    edge_residuals,
    edge_scale,
    surface_of,
)
from helio_jax.inverse.samples import add_common_modes, on_raster

MAX_PIXELS = 8_000
"""Largest raster whose information matrix is factorised; above, the raster is thinned."""
LEAST_EXPECTED = 0.1
"""Variance with which a combination of parameters is expected to deviate from the stated one, in prior variances, at
least: linear theory is not right to less."""


@dataclass(frozen=True)
class Linearised:
    """The residuals of a fit to first order, in standard deviations.

    Attributes:
        surface: derivative with respect to (height [um], slope x, slope y) of every pixel, [residual, 3 * pixel].
        instrument: derivative with respect to the instrument parameters, in prior deviations [residual, parameter].
        common: derivative with respect to what many heights have in common [residual, common]: the common modes, the
            held level and, as the last, the mean height through the scale of the edges; it adds common @ weights.T to
            `surface`.
        weights: derivative of those with respect to the surface [3 * pixel, common].
        names: of the instrument parameters.
        shape: of the raster (y, x).
        edge_scale: factor of the edges' weights (`residuals.edge_scale`).
    """

    surface: sparse.csr_matrix
    instrument: np.ndarray
    common: np.ndarray
    weights: np.ndarray
    names: tuple[str, ...]
    shape: tuple[int, int]
    edge_scale: float = 1.0

    def transposed(self, residuals: np.ndarray) -> np.ndarray:
        """Return the surface's whole derivative, transposed, times residuals [residual, ...]."""
        return self.surface.T @ residuals + self.weights @ (self.common.T @ residuals)

    def apply(self, surface: np.ndarray) -> np.ndarray:
        """Return the surface's whole derivative times changes of the surface [3 * pixel, ...]."""
        return self.surface @ surface + self.common @ (self.weights.T @ surface)

    def solver(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function that solves with the information matrix of the surface, for [3 * pixel, ...].

        The sparse part is factorised, the plateaus' part is added by the Woodbury identity.
        """
        information = (self.surface.T @ self.surface).tocsc()
        factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        n = self.common.shape[1]
        if n == 0:
            return factor.solve
        update = np.hstack([self.surface.T @ self.common, self.weights])
        middle = np.block([[np.zeros((n, n)), np.eye(n)], [np.eye(n), self.common.T @ self.common]])
        answer = factor.solve(update)
        small = np.linalg.inv(middle) + update.T @ answer
        return lambda right: (free := factor.solve(right)) - answer @ np.linalg.solve(small, update.T @ free)


@dataclass(frozen=True)
class SumsPosterior:
    """Covariance of sums of heights with all else, where all errors are independent.

    Attributes:
        surface: with height [um], slope x and slope y of every pixel [sum, field, y, x].
        instrument: with the instrument parameters, in prior deviations [sum, parameter].
        own: with one another [sum, sum].
        inflation: variance of each that correlated errors give, over that one [sum].
    """

    surface: np.ndarray
    instrument: np.ndarray
    own: np.ndarray
    inflation: np.ndarray


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
        inflation: factor by which all standard deviations were inflated, for the instrument contradicts what is stated.
        common_modes: fully correlated errors that were added for the same reason, or for a fit that has not converged,
            one standard deviation of each [error, y, x], um.
        sums: of the sums that were asked for, neither inflated nor with common modes.
        independent_covariance: that of the instrument were all errors independent, as the fit takes them, never
            inflated; None: `instrument_covariance`.
    """

    samples: np.ndarray
    instrument_samples: np.ndarray
    response: np.ndarray
    instrument_covariance: np.ndarray
    names: tuple[str, ...]
    stride: int = 1
    inflation: float = 1.0
    common_modes: np.ndarray | None = None
    sums: SumsPosterior | None = None
    independent_covariance: np.ndarray | None = None

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the unknowns that the instrument parameters are entries of, in their order."""
        return tuple(dict.fromkeys(name.partition("[")[0] for name in self.names))

    @property
    def height_std(self) -> np.ndarray:
        """Standard deviation of every height [y, x], um; itself known to 1 / sqrt(2 samples)."""
        return np.sqrt(np.mean(self.samples**2, axis=0))

    def levelled(self, planes: np.ndarray) -> "Posterior":
        """Refer the heights to a tilted substrate, by the parameters tilt[0] and tilt[1].

        Args:
            planes: heights of the substrate for one prior standard deviation of each [2, y, x], um.
        """
        tilts = tilts_of(self.names)
        if not tilts:
            return self
        response = self.response.copy()
        response[tilts] -= planes
        fallen = np.tensordot(self.instrument_samples[:, tilts], planes, 1)
        return replace(self, samples=self.samples - fallen, response=response)

    def inflated(self, parameters: Parameters, names: tuple[str, ...], min_ratio: float = 1.0) -> "Posterior":
        """Inflate the error bars by the Birge ratio of some parameters, for the model may be incomplete.

        Where the fitted parameters called `names` are farther from the stated ones than prior and data explain, all
        standard deviations are multiplied by the ratio f. What the model lacks may also have shifted these parameters:
        then heights are wrong by what they, and all that followed them, did to the heights. The share 1 - 1 / f^2 of
        that change's square is added to the heights' variance, as a common-mode error. Ratios below `min_ratio` are
        taken for chance.
        """
        of = [name for name in self.fields if name in names]
        if not of:
            return self
        mine = np.array([name.partition("[")[0] in of for name in self.names])
        flat = np.concatenate([np.ravel(getattr(parameters, name)) for name in of])
        own = self.instrument_covariance[np.ix_(mine, mine)]
        spread = own / self.inflation**2
        independent = spread if self.independent_covariance is None else self.independent_covariance[np.ix_(mine, mine)]
        factor = birge_ratio(flat, independent, spread)
        if factor < min_ratio:
            return self
        followed = self.instrument_covariance[:, mine] @ np.linalg.solve(own, flat)
        shifted = np.sqrt(1.0 - factor**-2) * np.tensordot(followed, self.response, 1)
        enlarged = replace(
            self,
            samples=factor * self.samples,
            instrument_samples=factor * self.instrument_samples,
            instrument_covariance=factor**2 * self.instrument_covariance,
            inflation=factor * self.inflation,
            common_modes=None if self.common_modes is None else factor * self.common_modes,
        )
        return enlarged.with_common_mode(shifted)

    def with_common_mode(self, error: np.ndarray) -> "Posterior":
        """Add a fully correlated error with a standard-normal amplitude [y, x], um, independent of the others."""
        before = np.zeros((0, *error.shape)) if self.common_modes is None else self.common_modes
        modes = np.concatenate([before, error[None]])
        return replace(self, samples=add_common_modes(self.samples, [error], len(modes)), common_modes=modes)

    def on_raster(self, shape: tuple[int, int], stride: int) -> "Posterior":
        """Resample to the full raster [y, x], by the nearest pixel."""
        if stride == 1:
            return self
        full = partial(on_raster, shape=shape, stride=stride)
        modes = None if self.common_modes is None else full(self.common_modes)
        sums = self.sums and replace(self.sums, surface=full(self.sums.surface))
        samples, response = full(self.samples), full(self.response)
        return replace(self, samples=samples, response=response, stride=stride, common_modes=modes, sums=sums)


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
        """Append `n_more` empty rows."""
        empty = sparse.csr_matrix((n_more, 3 * self._n))
        return sparse.csr_matrix(sparse.vstack([*self._blocks, empty]))


@compiled
def block_derivatives(unknowns: Unknowns, fixed: FixedTerms):
    """Compute the blocks of the Jacobian.

    In this order: data by surface field, data, edges and border by parameter, edges by mean height; and the factor of
    the edges' weights.
    """
    surface, at = surface_of(unknowns, fixed), unknowns.parameters
    names = ("height", "slope_x", "slope_y")
    one, zero = (jax.tree.map(f, surface) for f in (jnp.ones_like, jnp.zeros_like))
    directions = [Surface(**{n: getattr(one if n == name else zero, n) for n in names}) for name in names]
    still = eqx.tree_at(lambda f: f.modes.weights, fixed, jnp.zeros_like(fixed.modes.weights))
    still = eqx.tree_at(lambda f: f.modes.amplitude, still, jnp.zeros_like(fixed.modes.amplitude))
    data = [jax.jvp(lambda s: data_residuals(s, at, still), (surface,), (d,))[1] for d in directions]
    free = {name: getattr(at, name) for name in at.free()}
    data_by, edges_by, border_by = (
        jax.jacfwd(lambda values, f=f: f(surface, at.replaced(**values), fixed))(free)
        for f in (data_residuals, edge_residuals, border_residuals)
    )
    raised = jax.jvp(lambda s: edge_residuals(s, at, fixed), (surface,), (directions[0],))[1]
    return data, data_by, (*edges_by, border_by), raised, edge_scale(surface, at, fixed)


def linearise(unknowns: Unknowns, fixed: FixedTerms) -> Linearised:
    """Compute the Jacobian of the residuals, in terms of the surface itself instead of its whitened form.

    tests/gradients/test_model.py compares it with the automatic Jacobian of the residuals.
    """
    shape, edges = fixed.border.shape, fixed.edges
    pixel = np.arange(fixed.border.size).reshape(shape)
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, block_derivatives(unknowns, fixed))
    data, data_by, others_by, raised, scale = found
    free = unknowns.parameters.free()
    rows = _Rows(pixel.size)
    for k in range(data[0].shape[0]):
        rows.add(*((pixel, part, d[k]) for part, d in enumerate(data)))
    n_data = data[0].size
    for axis, part, step, weight, smooth in (
        (1, 1, float(fixed.dx), edges.inverse_std_x, edges.smooth_x),
        (0, 2, float(fixed.dy), edges.inverse_std_y, edges.smooth_y),
    ):
        w = scale * np.asarray(weight)
        of_slopes = []
        for end, share in zip(along(pixel, axis), along(np.asarray(smooth) / 24.0, axis), strict=True):
            stride = pixel.shape[1] if axis == 0 else 1
            beside = (np.clip(end + way, 0, pixel.size - 1) for way in (-stride, stride))  # at the border, share is 0
            of_slopes += [(end, part, -w * (0.5 + 2.0 * share)), *((p, part, w * share) for p in beside)]
        before, after = along(pixel, axis)
        rows.add((after, 0, w / step), (before, 0, -w / step), *of_slopes)
    rows.add((pixel, 0, np.asarray(fixed.border)))
    for part in (1, 2):
        rows.add((pixel, part, np.full(shape, 1.0 / SLOPE_STD)))
    # below: the anchors, which are of many heights, and the priors of the parameters
    n_rows, n_anchors = rows.n_rows, len(fixed.anchor_weight)
    names = [f"{n}{list(i)}" for n in free for i in np.ndindex(data_by[n].shape[data[0].ndim :])]

    def by_parameter(blocks: dict[str, np.ndarray], n: int) -> np.ndarray:
        return np.concatenate([blocks[name].reshape(n, -1) for name in free], 1)

    sizes = n_data, edges.inverse_std_x.size, edges.inverse_std_y.size, pixel.size
    columns = np.concatenate([by_parameter(b, n) for b, n in zip((data_by, *others_by), sizes, strict=True)])
    matrix = rows.stack(n_more=n_anchors + len(names))
    by_instrument = np.zeros((n_rows + n_anchors + len(names), len(names)))
    by_instrument[: len(columns)] = columns
    by_instrument[-len(names) :] = np.eye(len(names))
    is_used = np.any(np.asarray(fixed.modes.weights) != 0.0, axis=(1, 2))
    weights = np.asarray(fixed.modes.weights)[is_used]
    response = np.asarray(fixed.modes.response)[is_used] * np.asarray(fixed.inverse_sigma)
    n_modes, anchors = len(weights), np.asarray(fixed.anchor_weight).reshape(n_anchors, pixel.size)
    n_common = n_modes + n_anchors + 1
    common, of_surface = np.zeros((len(by_instrument), n_common)), np.zeros((3 * pixel.size, n_common))
    common[:n_data, :n_modes] = response.reshape(n_modes, n_data).T
    of_surface[::3, :n_modes] = weights.reshape(n_modes, pixel.size).T
    common[n_rows : n_rows + n_anchors, n_modes:-1], of_surface[::3, n_modes:-1] = np.eye(n_anchors), anchors.T
    by_height = np.concatenate([part.ravel() for part in raised])
    common[n_data : n_data + by_height.size, -1], of_surface[::3, -1] = by_height, 1.0 / pixel.size
    return Linearised(matrix, by_instrument, common, of_surface, tuple(names), shape, float(scale))


@dataclass(frozen=True)
class Marginal:
    """What linearised residuals tell of the instrument, the surface marginalised; all errors are independent.

    Attributes:
        linear: the residuals.
        solve: solves with the information matrix of the surface, for [3 * pixel, ...].
        answer: minus the change of the surface when a parameter is forced [3 * pixel, parameter].
        covariance: of the parameters, in prior deviations [parameter, parameter].
    """

    linear: Linearised
    solve: Callable[[np.ndarray], np.ndarray]
    answer: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, linear: Linearised) -> "Marginal":
        """Factorise the information.

        Source: Schur complement: Triggs et al., Bundle Adjustment (2000), sec. 6.1.
        """
        jc, solve = linear.instrument, linear.solver()
        border = linear.transposed(jc)
        answer = solve(border)
        return cls(linear, solve, answer, np.linalg.inv(jc.T @ jc - border.T @ answer))

    def influence(self) -> np.ndarray:
        """Compute minus the derivative of the fitted parameters by every residual [residual, parameter]."""
        return (self.linear.instrument - self.linear.apply(self.answer)) @ self.covariance

    def parameters_times(self, surface: np.ndarray, instrument: np.ndarray) -> np.ndarray:
        """Multiply the rows of the parameters in the joint covariance by vectors [parameter, ...].

        Args:
            surface, instrument: parts of the vectors [3 * pixel, ...], [parameter, ...].
        """
        return self.covariance @ (instrument - self.answer.T @ surface)

    def times(self, surface: np.ndarray, instrument: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multiply the joint covariance of surface and parameters by vectors, in parts as `parameters_times`."""
        of_parameters = self.parameters_times(surface, instrument)
        return self.solve(surface) - self.answer @ of_parameters, of_parameters


def sample_posterior(
    linear: Linearised,
    n_samples: int,
    seed: int = 0,
    errors: Errors = Errors(),
    sums: np.ndarray | None = None,
) -> Posterior:
    """Factorise the information and draw samples of the joint posterior.

    The fit is the one that takes all errors for independent, as it was done; its spread is that of data and edges with
    the errors that are assumed.

    Args:
        linear: residuals at the fit, from `linearise`, those of the data first, then those of the edges.
        n_samples: samples.
        seed: of the noise.
        errors: what is assumed of the errors of the residuals; default: independent.
        sums: derivative of sums whose covariance with all else is wanted, with respect to the surface and then the
            instrument [3 * pixel + parameter, sum].

    Source: numbers that are not fitted: Schmidt, Adv. Control Syst. 3 (1966) 293 (consider analysis); samples:
        Bardsley, Solonen, Haario and Laine, SIAM J. Sci. Comput. 36 (2014) A1895 (randomise-then-optimise), in its
        linear case; errors that the fit takes for independent: White, Econometrica 48 (1980) 817 (the sandwich).
    """
    found, rng = Marginal.of(linear), np.random.default_rng(seed)
    noise = errors.draw(rng, rng.standard_normal((len(linear.instrument), n_samples)))
    influence = found.influence()
    instrument = influence.T @ noise
    surface = found.solve(linear.transposed(noise)) - found.answer @ instrument
    to_height = lambda a: np.moveaxis(a[::3], 1, 0).reshape(-1, *linear.shape)  # noqa: E731
    posterior = Posterior(
        to_height(surface),
        instrument.T,
        -to_height(found.answer),
        errors.covariance(influence),
        linear.names,
        independent_covariance=found.covariance,
    )
    if sums is None:
        return posterior
    of_surface, of_instrument = found.times(*np.split(sums, [len(found.answer)]))
    together = linear.apply(of_surface) + linear.instrument @ of_instrument
    naive = together.T @ together
    fields = np.moveaxis(of_surface.T.reshape(-1, *linear.shape, 3), -1, 1)
    inflation = np.diag(errors.covariance(together)) / np.diag(naive)
    return replace(posterior, sums=SumsPosterior(fields, of_instrument.T, naive, inflation))


def tilts_of(names: tuple[str, ...]) -> list[int]:
    """Return the places of the substrate's tilts, along x and y, among parameters; none if it is not tilted."""
    return [names.index(name) for name in ("tilt[0]", "tilt[1]") if name in names]


def birge_ratio(values: np.ndarray, independent: np.ndarray, spread: np.ndarray) -> float:
    """Compute the Birge ratio of an instrument: its deviation over what prior and data explain; at least 1.

    Where the priors are right and the data leave the covariance C if their errors are independent, fitted values are
    found about the stated ones with the covariance 1 - C; errors that agree between pixels, by which the error is S,
    add S - C. A combination that the data tell next to nothing of should stay where it is stated: it counts only as far
    as it does not.

    Args:
        values: fitted, in prior deviations [parameter].
        independent: C, in prior deviations [parameter, parameter].
        spread: S, likewise.

    Source: Birge, Phys. Rev. 40 (1932) 207; as scale factor: Particle Data Group, Introduction, sec. 5.2.2.
    """
    expected, ways = np.linalg.eigh(np.eye(len(values)) - 2.0 * independent + spread)
    expected = np.maximum(expected, 0.0)
    floor = np.maximum(expected, LEAST_EXPECTED)
    square = np.sum((ways.T @ values) ** 2 / floor)
    return float(max(1.0, np.sqrt(square / max(1.0, np.sum(expected / floor)))))


def exact_height_covariance(linear: Linearised) -> np.ndarray:
    """Compute the posterior covariance of the heights [y * x, y * x], um^2, dense; for rasters of up to 32 x 32."""
    both = np.hstack([linear.surface.toarray() + linear.common @ linear.weights.T, linear.instrument])
    covariance = np.linalg.inv(both.T @ both)
    n = 3 * linear.shape[0] * linear.shape[1]
    return covariance[:n:3, :n:3]
