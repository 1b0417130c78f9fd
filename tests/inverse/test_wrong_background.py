"""Background that was not subtracted: gains and offsets far from what is stated are found, and named."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import PredictionError
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.wider_readout import (
    FREEDOM,
    fit_wider_readout,
    heavy_tailed_penalty,
    normal_widths,
    with_widths,
)
from tests.inverse.test_strained_instrument import parameters_with

ADDED = 0.3
"""Background over the median signal."""


def pulled(offset: float) -> Parameters:
    return parameters_with(log_gain=np.array([0.5, -0.2, 0.1]), offset=np.full(3, offset))


@pytest.mark.parametrize("width", [1.0, 4.0])
def test_the_wider_prior_has_the_gradient_of_the_heavy_tailed_one(width):
    """At the fitted offsets, by finite differences; inside the stated deviation nothing gets wider."""
    factors, step = {"log_gain": 1.0, "offset": width}, 1e-5
    ends = [heavy_tailed_penalty(pulled(7.0 + s), factors) for s in (-step, step)]
    pull = 7.0 * width  # in stated standard deviations
    wide = normal_widths(pulled(7.0), factors)
    assert wide["log_gain"] == 1.0
    scaled = (FREEDOM + 3) / (FREEDOM + 3 * pull**2)
    assert wide["offset"] == pytest.approx(1.0 / math.sqrt(scaled))
    # the normal prior of that width: half the sum of squares over width^2, three offsets
    assert (ends[1] - ends[0]) / (2.0 * step * width) == pytest.approx(3.0 * pull / wide["offset"] ** 2, rel=1e-6)


def test_a_prior_may_be_wider_than_a_scene_may_state():
    """0 +- 90 % made three times wider: refused as a setting above its limit of 1, it ended the reconstruction."""
    stated = ReconstructSettings(refine=RefineSettings(offset_std=0.9))
    found = with_widths(stated, {"offset": 3.0}).refine
    assert found.offset_std == pytest.approx(2.7) and found.gain_std == stated.refine.gain_std


@dataclass(frozen=True)
class StandIn:
    """What is read of a fit: offsets [stated standard deviations], half its chi-square, priors, and how it ended."""

    off: float
    misfit: float
    prior_widths: dict[str, float] = field(default_factory=dict)
    is_interrupted: bool = False
    status: str = "converged"
    state: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(surface=None))

    @property
    def parameters(self) -> Parameters:
        return parameters_with(offset=np.full(3, self.off / self.prior_widths.get("offset", 1.0)))

    @property
    def residuals(self) -> np.ndarray:
        return np.ones(round(2.0 * self.misfit))

    @property
    def problem(self) -> SimpleNamespace:
        return SimpleNamespace(held=())


HELD = StandIn(10.0, 600.0)


def with_wider_priors(*ends):
    """Fit stand-ins one after another: offset, misfit and whether interrupted; None: nothing can be predicted."""
    left = list(ends)

    def fitted(start, smoothed, wider):
        end = left.pop(0)
        if end is None:
            raise PredictionError("no surface")
        return StandIn(*end[:2], wider, *end[2:])

    return fit_wider_readout(HELD, (None, None), fitted, lambda said: None)  # type: ignore[arg-type]


def test_the_fit_that_explains_most_is_kept():
    """The second is better than the first, the third is worse. One that is no better at all is not kept."""
    found = with_wider_priors((20.0, 300.0), (28.0, 200.0), (30.0, 250.0), (29.0, 210.0), (29.0, 210.0), (29.0, 210.0))
    assert found is not None and found.misfit == 200.0
    assert with_wider_priors((20.0, 900.0), (20.0, 900.0)) is None


def test_a_fit_that_fails_does_not_take_an_earlier_one_with_it():
    """Nothing can be predicted in the second fit with wider offsets, nor with wider gains: the first is kept."""
    found = with_wider_priors((20.0, 300.0), None, None)
    assert found is not None and found.misfit == 300.0


@pytest.mark.parametrize(("misfit", "kept"), [(250.0, 250.0), (900.0, 300.0)])
def test_an_interrupted_fit_ends_the_search(misfit, kept):
    """The better one is kept, marked as interrupted. Catches an interrupt that is lost with the worse fit."""
    found = with_wider_priors((20.0, 300.0), (28.0, misfit, True, "interrupted"))
    assert found is not None and found.misfit == kept and found.is_interrupted
    assert found.status.startswith("interrupted")


@pytest.mark.slow
def test_the_height_is_right_and_the_offsets_are_named():
    """A cap of 720 um under a background of 30 % that nobody subtracted; gains and offsets stated to 2 and 1 %.

    Within 5 % of its height (noise: 1 %). With normal priors it comes out 17 % too low, its error bar a third of the
    height, and nothing names the offsets.
    """
    size = {"scan.nx": 41, "scan.ny": 41, "scan.pixel_size_um": 70.0}
    scene = hx.load_scene("sphere_a", size)
    stack = hx.simulate(scene, seed=4).only()
    level = ADDED * np.median(stack.counts, axis=(1, 2), keepdims=True)
    counts = stack.counts + np.random.default_rng(5).poisson(np.broadcast_to(level, stack.counts.shape))
    stack = stack.replace(counts=counts, variance=np.maximum(counts, 1.0))
    quick = scene.reconstruct.refine.changed(objects=False, albedo_patches=False, samples=8)
    rec = hx.reconstruct(stack, settings=scene.reconstruct.changed(refine=quick))
    assert rec.height.max() == pytest.approx(720.0, rel=0.05)
    named = [text for text in rec.warnings if "not what is stated" in text]
    assert len(named) == 1
    assert all(f"offset of {name!r} +2" in named[0] for name in rec.instrument.detector_names), named
