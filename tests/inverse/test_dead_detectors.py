"""A channel that was off is refused; few pixels, few atoms and small apertures are not."""

import numpy as np
import pytest

from helio_jax.errors import GuardError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.inverse.dead_detectors import dead_detectors
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows import pipeline


def flat(instrument, atoms: float = 1e5, seed: int = 1, size: int = 15) -> MicrographStack:
    """Return Poisson counts of so many atoms per pixel on a level surface."""
    axis = 40.0 * np.arange(float(size))
    expected = atoms * form_factor(Optics.of(instrument), np.zeros((size, size)))[:, 2]
    counts = np.random.default_rng(seed).poisson(expected).astype(float)
    return MicrographStack(counts, axis, axis, instrument, variance=counts, n_rays=atoms)


def with_counts(stack: MicrographStack, counts: np.ndarray, **known) -> MicrographStack:
    """Return a stack with the second detector's counts replaced, and their Poisson variance."""
    new = stack.counts.copy()
    new[1] = counts
    return stack.replace(counts=new, variance=new, **known)


def test_a_channel_that_was_off(bshem):
    """Zero counts, and dark counts of a known background."""
    stack = flat(bshem)
    assert dead_detectors(stack) == []
    assert dead_detectors(with_counts(stack, np.zeros((15, 15)))) == [bshem.detector_names[1]]
    dark = np.random.default_rng(2).poisson(5.0, (15, 15))
    background = np.array([0.0, 5.0, 0.0])
    assert dead_detectors(with_counts(stack, dark, background=background)) == [bshem.detector_names[1]]
    with pytest.raises(GuardError, match="shows no signal beyond its background"):
        pipeline.reconstruct(with_counts(stack, dark, background=background), "linear")


@pytest.mark.parametrize("size", [15, 121])
def test_a_background_that_is_slightly_wrong_does_not_revive_it(bshem, size):
    """Dark counts of 5 with a background of 4.9 and 5.1, 0.01 % of the level's signal.

    Rejects a limit in standard deviations alone, which such a difference passes in many pixels.
    """
    stack = flat(bshem, size=size)
    dark = np.random.default_rng(4).poisson(5.0, (size, size))
    for stated in (4.9, 5.1):
        background = np.array([0.0, stated, 0.0])
        assert dead_detectors(with_counts(stack, dark, background=background)) == [bshem.detector_names[1]]


def test_nothing_counted_at_all(bshem):
    """Zeros, or dark counts of a known background in all detectors: an error that says so, not one of the solver."""
    stack = flat(bshem)
    empty = stack.replace(counts=np.zeros(stack.shape), variance=np.zeros(stack.shape))
    dark = np.random.default_rng(5).poisson(5.0, stack.shape).astype(float)
    counts = stack.replace(counts=dark, variance=dark, background=np.full(3, 5.0))
    for nothing in (empty, empty.replace(n_rays=None), counts, counts.replace(n_rays=None)):
        with pytest.raises(GuardError, match="no detector shows a signal beyond its background"):
            pipeline.reconstruct(nothing, "linear")


def test_what_is_not_dead(bshem):
    """An image observed in two pixels, so few atoms that nothing is expected, and a signal of a fiftieth."""
    stack = flat(bshem)
    seldom = np.full((15, 15), np.nan)
    seldom[3, 3:5] = 0.0
    assert dead_detectors(with_counts(flat(bshem, 600.0), seldom)) == []
    few = flat(bshem, 3.0, size=5)
    assert dead_detectors(with_counts(few, np.zeros((5, 5)))) == []
    weak = np.random.default_rng(3).poisson(0.02 * np.nanmean(stack.counts[1]), (15, 15))
    assert dead_detectors(with_counts(stack, weak)) == []


@pytest.mark.parametrize("seed", range(8))
def test_a_detector_with_counts_in_few_pixels_does_not_end_the_search_for_steps(bshem, seed):
    """Its median is 0. Catches a division by it, which ended in a LinAlgError for one seed in three."""
    stack = flat(bshem, 1e4, seed, 25)
    seldom = np.random.default_rng(10 + seed).poisson(0.2, (25, 25))
    assert find_steps(with_counts(stack, seldom)).steps == ()
