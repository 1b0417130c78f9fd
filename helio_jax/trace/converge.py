"""Trace every pixel until its error is small enough: rays are spent where they are needed.

Two passes. A pilot tells from the spread of its replicates how many rays a pixel needs; a second pass with that many,
and with other random numbers, gives the counts and their error. Nothing of the pilot is kept: whoever stops on the
estimate that he reports stops too early where it happens to be small, and his mean and his error are both biased. So
each pixel is what a run of its number of rays gives, to the bit, and its standard error is as honest as always.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from helio_jax.trace.run import N_REPLICATES, check_rays, pixels_per_block
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.source import Sampling
from helio_jax.trace.tally import Estimate
from helio_jax.trace.transport import Experiment, trace_block

SAFETY = 2.0
"""The pilot's variance is known to 50 % only (7 degrees of freedom): so many times the rays that it asks for."""
_PILOT = 1 << 62  # added to the pixels' numbers, the key of their random numbers


def trace_to_target(
    experiment: Experiment, settings: TraceSettings, ids: np.ndarray, x: np.ndarray, y: np.ndarray
) -> Estimate:
    """Trace pixels until every detector's standard error is at most the wanted share of its count; or to the cap.

    A pure function of its arguments, pixel by pixel. About nine pixels in ten reach the target, the others come close;
    those that the cap stops (dark ones, mostly) keep their larger, honest error.

    Args:
        experiment: with `settings.rays` rays per pixel: the pilot, and the smallest number of the second pass.
        settings: `target_error`, `max_rays`, `branches`, `seed`.
        ids, x, y: number and beam position [um] of every pixel [n].

    Raises:
        GuardError: rays of the pilot are unaccounted for.
    """
    pilot = trace_block(experiment, ids + _PILOT, x, y).estimate()
    check_rays(np.zeros(len(pilot.fates)), pilot.n_unaccounted, 1)
    doublings = doublings_needed(pilot, settings)
    parts, order = [], []
    for k in np.unique(doublings):
        chosen = np.flatnonzero(doublings == k)
        finer = replace(
            experiment, sampling=_sampling(experiment.sampling.n_rays << int(k), settings.branches, settings.seed)
        )
        size = pixels_per_block(finer)
        for start in range(0, chosen.size, size):
            some = chosen[start : start + size]
            part = trace_block(finer, ids[some], x[some], y[some]).estimate()
            parts.append(replace(part, n_rays=np.full(some.size, part.n_rays)))
            order.append(some)
    return Estimate.join(parts).take(np.argsort(np.concatenate(order)))


def doublings_needed(pilot: Estimate, settings: TraceSettings) -> np.ndarray:
    """Return how many times the pilot's rays must be doubled [pixels], the cap being kept.

    The error is taken to fall as the root of the number of rays, which low-discrepancy points better.
    """
    assert settings.target_error is not None
    wanted = (settings.target_error * pilot.total_mean) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(pilot.total_variance > 0, SAFETY * pilot.total_variance / wanted, 0.0).max(0)
    most = int(np.floor(np.log2(max(1.0, settings.max_rays / float(np.max(pilot.n_rays))))))
    return np.ceil(np.log2(np.clip(share, 1.0, 2.0**most))).astype(np.int64)


@lru_cache(maxsize=64)
def _sampling(n_rays: int, n_branches: int, seed: int) -> Sampling:
    """Return the point sets of so many rays."""
    return Sampling.make(n_rays, n_branches, N_REPLICATES, seed)
