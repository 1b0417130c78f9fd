"""Detectors that show no signal where the others do: a channel that was off, and no image of a dark surface."""

import numpy as np

from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.inverse.linear import signal_of
from helio_jax.micrograph import MicrographStack

SEEN, NOTHING = 10.0, 3.0
"""A detector is dead whose signal would be so many standard deviations, by the others, and is below so many ..."""
LEAST_SHARE = 0.005
"""... or below this share of what it would be: a background is not known better than that."""


def dead_detectors(stack: MicrographStack) -> list[str]:
    """Name the detectors whose signal, summed over the observed pixels, is no more than noise.

    What it would be is taken from the median of the other detectors, each by the signal of a level substrate; its noise
    from the stated variance, with that of one atom added, as zero counts have a Poisson variance of zero. Where no
    detector shows more than noise, all are named.
    """
    names = stack.instrument.detector_names
    if _are_all_dead(stack):
        return list(names)
    signal, variance = signal_of(stack)
    of_level = substrate_signal(Optics.of(stack.instrument))
    is_known = np.isfinite(signal)
    n = is_known.sum((1, 2))
    total, spread = (np.where(is_known, image, 0.0).sum((1, 2)) for image in (signal, variance))
    dead = []
    for k, name in enumerate(names):
        others = (np.arange(len(n)) != k) & (n > 0) & (total > 0.0)
        if n[k] and others.any():
            expected = n[k] * of_level[k] * np.median(total[others] / (n * of_level)[others])
            of_one = np.median(spread[others] / total[others])  # what an atom adds to the variance, over the signal
            is_seen = expected > SEEN * np.sqrt(spread[k] + of_one * expected)
            if is_seen and total[k] < max(NOTHING * np.sqrt(spread[k] + of_one**2), LEAST_SHARE * expected):
                dead.append(name)
    return dead


def _are_all_dead(stack: MicrographStack) -> bool:
    """Whether nothing was counted, or in no detector more than the noise of its background."""
    seen = stack.is_observed
    if not np.any(stack.counts[seen]):
        return True
    if stack.variance is None or np.array_equal(stack.signal[seen], stack.counts[seen]):
        return False
    total, spread = (np.where(seen, image, 0.0).sum((1, 2)) for image in (stack.signal, stack.variance))
    return bool(np.all(total <= NOTHING * np.sqrt(spread)))
