"""Errors that agree between neighbours: of predicted data, and of the edges between pixels at kinks.

A fit takes all errors for independent. What is drawn here in the place of white noise tells how wrong its heights are
where they are not (`posterior.sample_posterior`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, label

from helio_jax.forward.surface import Surface
from helio_jax.inverse.edges import AxisEdges, kink_size

KINKED = 0.5
"""An edge is at a kink if the kink makes more than this share of its variance."""


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
        """Average white noise to errors of variance 1 that agree between neighbours; its own transpose."""
        lengths = [n / self.stride for n in self.length]
        smooth = gaussian_filter(white, lengths, axes=(-2, -1))
        return smooth / np.prod([averaged_std(n) for n in lengths])

    def draw(self, rng: np.random.Generator, white: np.ndarray) -> np.ndarray:
        """Draw errors of the data [detector * y * x, sample], in deviations assumed of them.

        `white` is the counts' noise; what the model has of the variance is taken from it.
        """
        n, shape = white.shape[1], self.share.shape
        model = self.deviation * self.average(rng.standard_normal((n, *shape)))
        counts = np.sqrt(1.0 - self.share) * white.T.reshape(n, *shape)
        return (model + counts).reshape(n, -1).T

    def covariance(self, influence: np.ndarray) -> np.ndarray:
        """Compute the covariance of the sums of such errors weighted by `influence` [detector * y * x, parameter]."""
        images = influence.T.reshape(-1, *self.share.shape)
        model, counts = self.average(self.deviation * images), np.sqrt(1.0 - self.share) * images
        both = np.concatenate([model, counts], axis=1)
        return np.einsum("pkyx,qkyx->pq", both, both)


def averaged_std(length: float) -> float:
    """Compute the standard deviation of white noise after a Gaussian average over `length` pixels."""
    impulse = np.zeros(2 * int(4.0 * length + 1.0) + 1)
    impulse[impulse.size // 2] = 1.0
    return float(np.sqrt(np.sum(gaussian_filter(impulse, length) ** 2)))


@dataclass(frozen=True)
class EdgeError:
    """What is assumed of errors of the trapezoid rule at the edges along x and then along y.

    Where in its edge a kink lies is unknown, and much the same for neighbours along a straight rim: their errors add
    up to a wrong level beyond the rim, however long it is. Those of a run of edges, side by side in one row or column,
    are taken for equal, those of different runs for independent.

    Attributes:
        share: of the variance of every edge that its run has in common [edge].
        run: number of the run of every edge; 0: of none [edge].
    """

    share: np.ndarray
    run: np.ndarray

    @classmethod
    def of(cls, surface: Surface, along_x: AxisEdges, along_y: AxisEdges) -> "EdgeError":
        """Find the runs of edges at kinks of a surface; edges as from `edges.find_edges`."""
        shares, runs, n_runs = [], [], 0
        for edges, slope, axis in ((along_x, surface.slope_x, 1), (along_y, surface.slope_y, 0)):
            # at rims sigma may be below that of a kink
            share = np.minimum(kink_size(slope, axis) ** 2 / 12.0 / edges.sigma**2, 1.0)
            beside = np.zeros((3, 3), int)
            beside[:, 1] = 1
            number, n = label(share > KINKED, beside if axis == 1 else beside.T)  # type: ignore[misc]  # SciPy's stubs
            shares.append(np.where(number > 0, share, 0.0).ravel())
            runs.append(np.where(number > 0, number + n_runs, 0).ravel())
            n_runs += n
        return cls(np.concatenate(shares), np.concatenate(runs))

    def draw(self, rng: np.random.Generator, white: np.ndarray) -> np.ndarray:
        """Draw errors of the edges [edge, sample], in deviations assumed of them; `white` is independent noise."""
        common = rng.standard_normal((self.run.max(initial=0) + 1, white.shape[1]))[self.run]
        return np.sqrt(1.0 - self.share)[:, None] * white + np.sqrt(self.share)[:, None] * common

    def covariance(self, influence: np.ndarray) -> np.ndarray:
        """Compute the covariance of the sums of such errors weighted by `influence` [edge, parameter]."""
        own = np.sqrt(1.0 - self.share)[:, None] * influence
        common = np.zeros((self.run.max(initial=0) + 1, influence.shape[1]))
        np.add.at(common, self.run, np.sqrt(self.share)[:, None] * influence)
        return own.T @ own + common.T @ common


@dataclass(frozen=True)
class Errors:
    """What is assumed of the errors of a fit's residuals; those of which nothing is said are independent.

    Attributes:
        model: of the predicted data, the first residuals.
        edges: of the edges between pixels, the next ones.
        unfitted: change of the first residuals, those of the data and then of the edges, by one standard deviation of
            each number that is uncertain but not fitted [residual, number]: a fit that takes it as stated answers to
            its error as to noise.
    """

    model: ModelError | None = None
    edges: EdgeError | None = None
    unfitted: np.ndarray | None = None

    def _parts(self) -> tuple[list[tuple[ModelError | EdgeError, slice]], int]:
        """The errors with their rows, and the number of these."""
        parts: list[tuple[ModelError | EdgeError, slice]] = []
        n = 0
        for assumed in (self.model, self.edges):
            if assumed is not None:
                parts.append((assumed, slice(n, n + assumed.share.size)))
                n += assumed.share.size
        return parts, n

    def _considered(self, n_residuals: int) -> np.ndarray:
        """Return `unfitted` for all residuals [residual, number]."""
        considered = np.zeros((n_residuals, 0 if self.unfitted is None else self.unfitted.shape[1]))
        if self.unfitted is not None:
            considered[: len(self.unfitted)] = self.unfitted
        return considered

    def draw(self, rng: np.random.Generator, white: np.ndarray) -> np.ndarray:
        """Draw errors of all residuals from independent ones [residual, sample]."""
        noise = white.copy()
        for assumed, rows in self._parts()[0]:
            noise[rows] = assumed.draw(rng, noise[rows])
        considered = self._considered(len(noise))
        return noise + considered @ rng.standard_normal((considered.shape[1], noise.shape[1]))

    def covariance(self, influence: np.ndarray) -> np.ndarray:
        """Compute the covariance of the sums of the residuals' errors weighted by `influence` [residual, parameter]."""
        parts, n = self._parts()
        by_unfitted = influence.T @ self._considered(len(influence))
        of_parts = [assumed.covariance(influence[rows]) for assumed, rows in parts]
        return sum(of_parts, influence[n:].T @ influence[n:]) + by_unfitted @ by_unfitted.T
