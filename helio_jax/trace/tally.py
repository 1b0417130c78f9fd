"""What the tracer counts: exact integer fates of all rays, analog hits, and sums of expected contributions."""

from dataclasses import dataclass

import numpy as np

DETECTED, ESCAPED, STOPPED, LOST = range(4)
FATES = ("detected", "escaped", "stopped", "lost")
"""Launched = detected + escaped + stopped + lost, per pixel, in exact integers (DESIGN.md section 2).

Stopped: ended by the cap on events, or stuck to a surface whose albedo is below 1."""


@dataclass(frozen=True)
class Tally:
    """Counts of a set of pixels.

    Attributes:
        fates: number of rays per fate (`FATES`) [4, pixels].
        hits: detected rays (analog) [order, detector, pixels]; the last order is "and above".
        sums: expected detections summed over the rays [order, replicate, detector, pixels] (no replicates: analog).
        n_rays: beam rays launched per pixel.
        n_branches: paths followed from the first hit of each beam ray; fates and hits count paths.
    """

    fates: np.ndarray
    hits: np.ndarray
    sums: np.ndarray
    n_rays: int
    n_branches: int = 1

    @classmethod
    def zeros(
        cls, n_orders: int, n_detectors: int, n_pixels: int, n_replicates: int, n_rays: int, n_branches: int
    ) -> "Tally":
        """Return an empty tally."""
        return cls(
            np.zeros((len(FATES), n_pixels), np.int64),
            np.zeros((n_orders, n_detectors, n_pixels), np.int64),
            np.zeros((n_orders, n_replicates, n_detectors, n_pixels)),
            n_rays,
            n_branches,
        )

    @classmethod
    def join(cls, parts: list["Tally"]) -> "Tally":
        """Put blocks of pixels side by side, in order."""
        return cls(
            np.concatenate([p.fates for p in parts], -1),
            np.concatenate([p.hits for p in parts], -1),
            np.concatenate([p.sums for p in parts], -1),
            parts[0].n_rays,
            parts[0].n_branches,
        )

    @property
    def n_unaccounted(self) -> int:
        """Launched minus all fates, summed over pixels; anything but 0 is a bug."""
        return int(np.abs(self.n_launched - self.fates.sum(0)).sum())

    @property
    def n_launched(self) -> int:
        """Paths launched per pixel: beam rays times branches."""
        return self.n_rays * self.n_branches

    def probability(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean detection probability per ray and its variance, both [order, detector, pixels].

        With replicates: mean over them, variance of the mean from their spread (R - 1 degrees of freedom).
        Analog: hits / rays with the Poisson variance hits / rays^2.
        """
        n_replicates = self.sums.shape[1]
        if n_replicates == 0:
            return self.hits / self.n_launched, self.hits / self.n_launched**2
        means = self.sums * (n_replicates / self.n_rays)
        return means.mean(1), means.var(1, ddof=1) / n_replicates

    def total(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the same for all orders together [detector, pixels]; orders of one path are correlated."""
        n_replicates = self.sums.shape[1]
        if n_replicates == 0:
            return self.hits.sum(0) / self.n_launched, self.hits.sum(0) / self.n_launched**2
        means = self.sums.sum(0) * (n_replicates / self.n_rays)
        return means.mean(0), means.var(0, ddof=1) / n_replicates
