"""Variance of heights as a function of the dwell time of every pixel: what more counts would determine.

The linearisation is that of a fit (`fit.linearised_at`). With the time t of a datum its variance is u / t + m^2: u of
the counts in one second, m of the predicted masks and multiple scattering, which no counting reduces. Information is
then a concave function of the dwell times, so that the mean variance of the heights is a convex one, with an exact
derivative. Masks, edges and robust weights stay as they are at the fit: renew the linearisation after more data.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from helio_jax.inverse.edges import noise_of_edges
from helio_jax.inverse.fit import LinearisedFit, inflated, linearised_at
from helio_jax.inverse.posterior import Linearised, Marginal, Posterior, sample_posterior, tilts_of
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.samples import on_raster
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import edges_of

EDGE_NOISE = 0.26
"""Part of an edge's standard deviation that comes from the noise of the slopes, in units of that noise: the floor of
`edges.find_edges`, and the noise in the kinks and curvatures that it finds (measured on a level surface)."""
N_PROBES = 64
"""Random sums of heights that stand for all heights of a larger region: the mean variance is known to some per cent,
its fall by more dwell time, for which the sums are the same, far better."""


@dataclass(frozen=True)
class DwellInformation:
    """A fit whose data may be counted longer.

    Attributes:
        at: the fit to first order, on a raster that may be thinned.
        seconds: dwell time of every datum at which it was linearised, > 0 where it is known [detector, y, x].
        present: dwell time of every datum so far, 0 where there is none yet [detector, y, x].
        state: of the fit on the full raster.
        shape: of the full raster.
        edge_noise: standard deviation of the edges that the noise of the slopes makes, in units of that noise.
    """

    at: LinearisedFit
    seconds: np.ndarray
    present: np.ndarray
    state: FitState
    shape: tuple[int, int]
    edge_noise: float = EDGE_NOISE

    @classmethod
    def of(
        cls,
        problem: FitProblem,
        state: FitState,
        seconds: np.ndarray,
        present: np.ndarray | None = None,
        edge_noise: float = EDGE_NOISE,
    ) -> "DwellInformation":
        """Linearise a fit.

        Args:
            problem, state: its variance of the counts is that of `seconds`.
            seconds: dwell times [detector, y, x], > 0 where there are data, s.
            present: those of the data so far; default: the same.
            edge_noise: see there; `edges.NOISE_FLOOR` for a surface without noise.
        """
        at = linearised_at(problem, state)
        thin = (..., slice(None, None, at.stride), slice(None, None, at.stride))
        given = seconds if present is None else present
        shape = problem.raster.shape[0], problem.raster.shape[1]
        return cls(at, seconds[thin], given[thin], state, shape, edge_noise)

    @property
    def counting(self) -> np.ndarray:
        """Variance of the counts of one second [detector, y, x], in units of the beam; 1 where not observed."""
        return np.where(self.is_observed, self.at.problem.variance * self.seconds, 1.0)

    @property
    def is_observed(self) -> np.ndarray:
        """Where data are, or may be recorded [detector, y, x]."""
        return self.at.problem.is_observed & (self.seconds > 0.0)

    @property
    def model(self) -> np.ndarray:
        """Variance of the predicted masks and multiple scattering [detector, y, x]."""
        total = np.where(self.is_observed, self.at.state.held.sigma, 0.0) ** 2
        return np.maximum(total - np.where(self.is_observed, self.at.problem.variance, 0.0), 0.0)

    def information(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the information of data over that at the linearisation, and its derivative by the dwell time [1/s].

        Args:
            seconds: dwell times [detector, y, x], s; 0: not recorded.
        """
        u, m = self.counting, self.model
        at_fit = np.where(self.is_observed, self.at.state.held.sigma, 0.0) ** 2
        return at_fit * seconds / (u + m * seconds), at_fit * u / (u + m * seconds) ** 2

    def thinned(self, image: np.ndarray) -> np.ndarray:
        """Take the pixels of the linearisation from images [..., y, x]."""
        return image[..., :: self.at.stride, :: self.at.stride]

    def full(self, image: np.ndarray) -> np.ndarray:
        """Put derivatives [..., y, x] of a thinned raster where its pixels are on the full one, 0 elsewhere."""
        out = np.zeros((*image.shape[:-2], *self.shape))
        out[..., :: self.at.stride, :: self.at.stride] = image
        return out

    def linear_at(self, seconds: np.ndarray, edge_factor: np.ndarray | float = 1.0) -> Linearised:
        """Compute the linearisation at other dwell times [detector, y, x] of its raster.

        Args:
            seconds: dwell times.
            edge_factor: by which edges between pixels weigh more, scalar or [edge], from `edge_factor`.
        """
        linear = self.at.linear
        factor, known = np.ones(len(linear.instrument)), self.residual_factor(seconds, edge_factor)
        factor[: known.size] = known
        return replace(
            linear,
            surface=sparse.csr_matrix(sparse.diags_array(factor) @ linear.surface),
            instrument=factor[:, None] * linear.instrument,
            common=factor[:, None] * linear.common,
        )

    def residual_factor(self, seconds: np.ndarray, edge_factor: np.ndarray | float) -> np.ndarray:
        """Compute the factor of the residuals of data, then of edges [residual]; arguments as `linear_at`."""
        of_edges = np.broadcast_to(edge_factor, self._n_edges)
        return np.concatenate([np.sqrt(self.information(seconds)[0]).ravel(), of_edges])

    @property
    def _n_edges(self) -> int:
        ny, nx = self.at.linear.shape
        return ny * (nx - 1) + (ny - 1) * nx

    def noise_ratio(self, seconds: np.ndarray) -> np.ndarray:
        """Compute how much less noise every pixel has than so far, by all of its images [y, x]; 1 without such."""
        before, after = (np.sum(t / self.counting, axis=0) for t in (self.present, seconds))
        return np.where((before > 0.0) & (after > 0.0), np.sqrt(after / np.maximum(before, 1e-300)), 1.0)

    def edge_factor(self, seconds: np.ndarray) -> np.ndarray:
        """Compute by how much the weights of edges grow with the dwell times [edge].

        Of an edge's standard deviation a part goes with the noise of the slopes at its ends; kinks and curvature stay.
        """
        problem, factors = self.at.problem, []
        noise = np.broadcast_to(np.asarray(problem.pixel_noise), problem.raster.shape)
        less = noise / self.noise_ratio(seconds)
        for edges, axis in zip(edges_of(problem, self.at.state.surface, self._cut), (1, 0), strict=True):
            before, after = (self.edge_noise * np.asarray(noise_of_edges(n, axis)) for n in (noise, less))
            of_noise = np.minimum(before**2, edges.sigma**2)
            fallen = edges.sigma**2 - of_noise * (1.0 - (after / before) ** 2)
            factors.append((edges.sigma / np.sqrt(fallen)).ravel())
        return np.concatenate(factors)

    @property
    def _cut(self) -> float:
        return self.at.problem.settings.jump_limits[-1]

    def posterior(self, seconds: np.ndarray, n_samples: int) -> Posterior:
        """Compute the posterior that dwell times [detector, y, x] of the full raster would leave.

        As that of a fit: prediction errors agree between neighbours, numbers that are not fitted err as before, and
        error bars are inflated alike.
        """
        t = self.thinned(seconds)
        edge_factor = self.edge_factor(t)
        linear = self.linear_at(t, edge_factor)
        share = np.where(self.is_observed, self.model * t / (self.counting + self.model * t), 0.0)
        # of data with smaller standard deviations the same error is more of them
        before = self.at.errors
        assert before.model is not None and before.unfitted is not None
        unfitted = self.residual_factor(t, edge_factor)[:, None] * before.unfitted
        errors = replace(before, model=replace(before.model, share=share), unfitted=unfitted)
        found = sample_posterior(linear, n_samples, errors=errors)
        return inflated(found.levelled(self.at.planes), self.state).on_raster(self.shape, self.at.stride)


class RegionVariance:
    """Mean variance of the heights of a region as a function of dwell times, with its derivative.

    Exact for regions of up to `n_probes` pixels; for larger ones that many random sums with the signs +1 and -1 stand
    for it, the same ones in every call.

    Source: A-optimal design: Pukelsheim, Optimal Design of Experiments (1993), ch. 6; random signs: Hutchinson, Commun.
        Stat. Simul. Comput. 18 (1989) 1059; derivative: own derivation, tests/inverse/test_dwell_information.py.
    """

    def __init__(
        self,
        about: DwellInformation,
        region: np.ndarray,
        edge_factor: np.ndarray | float = 1.0,
        n_probes: int = N_PROBES,
        seed: int = 0,
    ) -> None:
        """Choose the sums.

        Args:
            about: a fit and its dwell times.
            region: True in its pixels, on the full raster [y, x].
            edge_factor: as in `DwellInformation.linear_at`.
            n_probes: largest number of sums.
            seed: of the random signs.
        """
        self.about, self.edge_factor = about, edge_factor
        inside = np.flatnonzero(about.thinned(region))
        if not inside.size:  # smaller than the thinning: the nearest pixels stand for it
            near = on_raster(np.arange(about.thinned(region).size).reshape(about.thinned(region).shape), about.shape,
                             about.at.stride)  # fmt: skip
            inside = np.unique(near[region])
        n_fields = 3 * about.thinned(region).size
        linear = about.at.linear
        if inside.size <= n_probes:
            sums = np.eye(inside.size)
        else:
            sums = np.random.default_rng(seed).choice([-1.0, 1.0], (inside.size, n_probes)) / np.sqrt(n_probes)
        self.of_surface = np.zeros((n_fields, sums.shape[1]))
        self.of_surface[3 * inside] = sums / np.sqrt(inside.size)
        self.of_instrument = np.zeros((len(linear.names), sums.shape[1]))
        for tilt, plane in zip(tilts_of(linear.names), about.at.planes, strict=False):
            self.of_instrument[tilt] = -plane.ravel()[inside] @ self.of_surface[3 * inside]

    def __call__(self, seconds: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute the mean variance [um^2] and its derivative by the dwell times [um^2/s], [detector, y, x].

        Args:
            seconds: dwell times on the full raster [detector, y, x], s.
        """
        about = self.about
        t = about.thinned(seconds)
        left = Marginal.of(about.linear_at(t, self.edge_factor))
        surface, instrument = left.times(self.of_surface, self.of_instrument)
        value = float(np.sum(self.of_surface * surface) + np.sum(self.of_instrument * instrument))
        at_fit = about.at.linear
        seen = _data_rows(at_fit, surface, instrument, t.size)
        slope = -about.information(t)[1] * np.sum(seen**2, axis=1).reshape(t.shape)
        return value, about.full(slope)


def _data_rows(linear: Linearised, surface: np.ndarray, instrument: np.ndarray, n_data: int) -> np.ndarray:
    """Compute how the data follow changes of surface and instrument [datum, change], in deviations at the fit."""
    of_surface = linear.surface[:n_data] @ surface + linear.common[:n_data] @ (linear.weights.T @ surface)
    return of_surface + linear.instrument[:n_data] @ instrument
