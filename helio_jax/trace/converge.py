"""Trace every pixel until its error is small enough: rays are spent where they are needed.

Two passes. A pilot tells from the spread of its replicates how many rays a pixel needs; a second pass with that many,
and with other random numbers, gives the counts and their error. Nothing of the pilot is kept: who stops on the very
estimate that is reported stops too early where its error happens to look small, which biases mean and error. So each
pixel is what a run of its number of rays gives, to the bit, and its standard error is as honest as always.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from helio_jax.trace.experiment import Experiment
from helio_jax.trace.run import N_REPLICATES, check_rays, pixels_per_block
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.source import Sampling
from helio_jax.trace.tally import Estimate
from helio_jax.trace.transport import trace_block

SAFETY = 1.4
"""The pilot's variance is known to 50 % only (7 degrees of freedom): so many times the rays that it asks for."""
PILOT_BRANCHES = 4
"""The pilot follows so many times fewer paths from each beam ray."""
_PILOT = 1 << 62  # added to the pixels' numbers, the key of their random numbers


def trace_to_target(
    experiment: Experiment, settings: TraceSettings, ids: np.ndarray, x: np.ndarray, y: np.ndarray
) -> Estimate:
    """Trace pixels until every detector's standard error is as small as wanted; or to the cap.

    A pure function of its arguments, pixel by pixel. Nine pixels in ten reach the target, most others come close;
    those that the cap stops (dark ones, mostly) keep their larger, honest error.

    Args:
        experiment: with `settings.rays` rays per pixel: the pilot, and the smallest number of the second pass.
        settings: `target_error` or `target_atoms`, `max_rays`, `branches`, `seed`.
        ids, x, y: number and beam position [um] of every pixel [n].

    Raises:
        GuardError: rays of the pilot are unaccounted for.
    """
    n_rays, n_branches = experiment.sampling.n_rays, max(1, settings.branches // PILOT_BRANCHES)
    pilot = trace_block(
        replace(experiment, sampling=_sampling(n_rays, n_branches, settings.seed)), ids + _PILOT, x, y
    ).estimate()
    check_rays(np.zeros(len(pilot.fates)), pilot.n_unaccounted, 1)
    doublings = doublings_needed(pilot, settings, n_branches / settings.branches)
    parts, order = [], []
    for k in np.unique(doublings):
        chosen = np.flatnonzero(doublings == k)
        finer = replace(experiment, sampling=_sampling(n_rays << int(k), settings.branches, settings.seed))
        size = pixels_per_block(finer)
        for start in range(0, chosen.size, size):
            some = chosen[start : start + size]
            part = trace_block(finer, ids[some], x[some], y[some]).estimate()
            parts.append(replace(part, n_rays=np.full(some.size, part.n_rays)))
            order.append(some)
    return Estimate.join(parts).take(np.argsort(np.concatenate(order)))


def doublings_needed(pilot: Estimate, settings: TraceSettings, share: float = 1.0) -> np.ndarray:
    """Return how many times the pilot's rays must be doubled [pixels], the cap being kept.

    The error is taken to fall as the root of the number of rays, which low-discrepancy points better. With more
    branches than the pilot (which has this `share` of them) only atoms of the second order and above have less
    variance: those of the first one leave where the beam's rays meet the sample.
    """
    first = pilot.variance[0]
    if settings.target_error is not None:
        variance = np.minimum(first, pilot.total_variance) * (1.0 - share) + share * pilot.total_variance
        wanted = (settings.target_error * pilot.total_mean) ** 2
    else:  # a count of so many atoms, a mean below its own error being no smaller than that
        assert settings.target_atoms is not None
        least = np.maximum(pilot.mean, np.sqrt(pilot.variance))
        variance = np.concatenate([first, *(share * pilot.variance[1:])])
        wanted = np.concatenate(least) / settings.target_atoms
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(variance > 0, SAFETY * variance / wanted, 0.0).max(0)
    most = int(np.floor(np.log2(max(1.0, settings.max_rays / float(np.max(pilot.n_rays))))))
    return np.ceil(np.log2(np.clip(times, 1.0, 2.0**most))).astype(np.int64)


@lru_cache(maxsize=64)
def _sampling(n_rays: int, n_branches: int, seed: int) -> Sampling:
    """Return the point sets of so many rays."""
    return Sampling.make(n_rays, n_branches, N_REPLICATES, seed)
