"""Adaptive number of rays per pixel, for a target standard error.

A pilot run estimates from the spread of its replicates how many rays each pixel needs; a second run with that many rays
and other random numbers gives the counts and their error. The pilot is discarded: stopping on the reported estimate
itself would stop early where its error happens to look small, which biases mean and error. So each pixel equals, bit
for bit, a run with its number of rays.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from helio_jax.trace.experiment import Experiment
from helio_jax.trace.run import N_REPLICATES, check_rays, pixels_per_block
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.source import PILOT, Sampling
from helio_jax.trace.tally import Estimate
from helio_jax.trace.transport import trace_block

SAFETY = 1.4
"""Factor on the rays that the pilot's variance suggests, which is known to 50 % only (7 degrees of freedom)."""
PILOT_BRANCHES = 4
"""Factor by which the pilot has fewer branches per beam ray."""


def trace_to_target(
    experiment: Experiment, settings: TraceSettings, ids: np.ndarray, x: np.ndarray, y: np.ndarray
) -> Estimate:
    """Trace pixels with enough rays for the target standard error in every detector, up to `max_rays`.

    A pure function of its arguments, pixel by pixel. Nine pixels in ten reach the target, most others come close;
    those limited by `max_rays`, mostly dark ones, have a larger error, which is reported.

    Args:
        experiment: with `settings.rays` rays per pixel, used by the pilot and as the minimum of the second run.
        settings: `target_error` or `target_atoms`, `max_rays`, `branches`, `seed`.
        ids, x, y: number and beam position [um] of each pixel [n].

    Raises:
        GuardError: rays of the pilot are unaccounted for.
    """
    n_rays, n_branches = experiment.sampling.n_rays, max(1, settings.branches // PILOT_BRANCHES)
    pilot = trace_block(
        replace(experiment, sampling=_sampling(n_rays, n_branches, settings.seed)), ids + PILOT, x, y
    ).estimate()
    check_rays(np.zeros(len(pilot.fates)), pilot.n_unaccounted, 1)
    doublings = doublings_needed(pilot, settings, n_branches / settings.branches)
    parts, order = [], []
    for k in np.unique(doublings):
        chosen = np.flatnonzero(doublings == k)
        finer = replace(experiment, sampling=_sampling(n_rays << int(k), settings.branches, settings.seed))
        size = pixels_per_block(finer)
        for start in range(0, chosen.size, size):
            block = chosen[start : start + size]
            part = trace_block(finer, ids[block], x[block], y[block]).estimate()
            parts.append(replace(part, n_rays=np.full(block.size, part.n_rays)))
            order.append(block)
    return Estimate.join(parts).take(np.argsort(np.concatenate(order)))


def doublings_needed(pilot: Estimate, settings: TraceSettings, share: float = 1.0) -> np.ndarray:
    """Compute how many times the pilot's rays must be doubled [pixels], within `max_rays`.

    The error is assumed to fall as the square root of the number of rays; low-discrepancy points do better. The pilot
    has the fraction `share` of the branches; more branches reduce the variance of the second and higher orders only,
    as the first order is scored where the beam's rays meet the sample.
    """
    first = pilot.variance[0]
    if settings.target_error is not None:
        variance = np.minimum(first, pilot.total_variance) * (1.0 - share) + share * pilot.total_variance
        target_variance = (settings.target_error * pilot.total_mean) ** 2
    else:  # Poisson variance of `target_atoms`; a mean below its own error counts as that error
        assert settings.target_atoms is not None
        least = np.maximum(pilot.mean, np.sqrt(pilot.variance))
        variance = np.concatenate([first, *(share * pilot.variance[1:])])
        target_variance = np.concatenate(least) / settings.target_atoms
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where(variance > 0, SAFETY * variance / target_variance, 0.0).max(0)
    most = int(np.floor(np.log2(max(1.0, settings.max_rays / float(np.max(pilot.n_rays))))))
    return np.ceil(np.log2(np.clip(times, 1.0, 2.0**most))).astype(np.int64)


@lru_cache(maxsize=64)
def _sampling(n_rays: int, n_branches: int, seed: int) -> Sampling:
    """Return the cached point sets of `n_rays` rays."""
    return Sampling.make(n_rays, n_branches, N_REPLICATES, seed)
