"""Tallies of the tracer: integer fates of all rays, analog hits, and sums of expected contributions."""

from dataclasses import dataclass, fields, replace

import numpy as np

DETECTED, ESCAPED, STOPPED, LOST = range(4)
FATES = ("detected", "escaped", "stopped", "lost")
"""Launched = detected + escaped + stopped + lost, per pixel, in integers.

Stopped: ended by `max_events`, or adsorbed on a surface whose albedo is below 1. Lost: hit a surface from behind."""


@dataclass(frozen=True)
class Tally:
    """Counts of a set of pixels.

    Attributes:
        fates: number of paths per fate (`FATES`) [4, pixels].
        hits: detected paths (analog) [order, detector, pixels]; the last order includes all higher ones.
        sums: expected detections summed over the rays [order, replicate, detector, pixels] (no replicates: analog).
        plate_hits, plate_sums: parts of `hits` [detector, pixels] and `sums` [replicate, detector, pixels] by paths
            that a plate has scattered.
        n_rays: beam rays per pixel.
        n_branches: paths from the first hit of each beam ray.
        weights: of the paths in `sums` [pixels, path]; length 0: all are 1.
        lost: sum of the weights of lost paths [pixels].
    """

    fates: np.ndarray
    hits: np.ndarray
    sums: np.ndarray
    plate_hits: np.ndarray
    plate_sums: np.ndarray
    n_rays: int
    n_branches: int
    weights: np.ndarray
    lost: np.ndarray

    @classmethod
    def zeros(
        cls,
        n_orders: int,
        n_detectors: int,
        n_pixels: int,
        n_replicates: int,
        n_rays: int,
        n_branches: int,
        weights: np.ndarray | None = None,
    ) -> "Tally":
        """Make an empty tally."""
        return cls(
            np.zeros((len(FATES), n_pixels), np.int64),
            np.zeros((n_orders, n_detectors, n_pixels), np.int64),
            np.zeros((n_orders, n_replicates, n_detectors, n_pixels)),
            np.zeros((n_detectors, n_pixels), np.int64),
            np.zeros((n_replicates, n_detectors, n_pixels)),
            n_rays,
            n_branches,
            np.zeros((0, 0)) if weights is None else weights,
            np.zeros(n_pixels),
        )

    def estimate(self) -> "Estimate":
        """Reduce the replicates to means and variances.

        With R replicates: their mean, and the variance of the mean from their spread (R - 1 degrees of freedom). The
        orders of one path are correlated, so the variance of the total is that of the replicates' totals. Analog:
        hits / rays with the Poisson variance hits / rays^2.
        """
        kept = (self.fates, self.hits, self.plate_hits, self.n_rays, self.n_branches)
        n_replicates, n = self.sums.shape[1], self.n_rays * self.n_branches
        if n_replicates == 0:
            orders, total, plate = ((c / n, c / n**2) for c in (self.hits, self.hits.sum(0), self.plate_hits))
        else:
            sums = (self.sums, self.sums.sum(0), self.plate_sums)
            orders, total, plate = (_mean_and_variance(s * (n_replicates / self.n_rays)) for s in sums)
        return Estimate(*orders, *total, *plate, *kept)


def _mean_and_variance(replicates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean over the replicates (third axis from the end) and the variance of that mean."""
    return replicates.mean(-3), replicates.var(-3, ddof=1) / replicates.shape[-3]


@dataclass(frozen=True)
class Estimate:
    """Detection probabilities per beam ray: a tally without its replicates.

    Attributes:
        mean, variance: by order; variance of the mean [order, detector, pixels].
        total_mean, total_variance: sum of all orders [detector, pixels].
        plate_mean, plate_variance: part of the total by paths that a plate has scattered [detector, pixels].
        fates, hits, plate_hits, n_branches: as in `Tally`.
        n_rays: beam rays per pixel: one number, or one for each pixel [pixels].
    """

    mean: np.ndarray
    variance: np.ndarray
    total_mean: np.ndarray
    total_variance: np.ndarray
    plate_mean: np.ndarray
    plate_variance: np.ndarray
    fates: np.ndarray
    hits: np.ndarray
    plate_hits: np.ndarray
    n_rays: int | np.ndarray
    n_branches: int

    @classmethod
    def join(cls, parts: list["Estimate"]) -> "Estimate":
        """Concatenate blocks of pixels, in order."""
        joined = {name: np.concatenate([getattr(p, name) for p in parts], -1) for name in parts[0]._arrays()}
        return replace(parts[0], **joined)

    def take(self, pixels: np.ndarray | slice) -> "Estimate":
        """Select pixels, in the given order."""
        return replace(self, **{name: getattr(self, name)[..., pixels] for name in self._arrays()})

    def _arrays(self) -> list[str]:
        """Return the names of the attributes that are per pixel."""
        return [f.name for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)]

    @property
    def n_launched(self) -> int | np.ndarray:
        """Paths launched per pixel: beam rays times branches."""
        return self.n_rays * self.n_branches

    @property
    def n_unaccounted(self) -> int:
        """Absolute difference of launched paths and all fates, summed over pixels; 0 unless there is a bug."""
        return int(np.abs(self.n_launched - self.fates.sum(0)).sum())

    def probability(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `mean` and `variance`."""
        return self.mean, self.variance

    def total(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `total_mean` and `total_variance`."""
        return self.total_mean, self.total_variance
