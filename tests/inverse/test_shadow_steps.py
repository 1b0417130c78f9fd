"""Steps that face away from an oblique beam: found by the glow beside them, and nothing else taken for one."""

import numpy as np
import pytest

from helio_jax.forward.optics import Raster
from helio_jax.inverse.shadow_steps import find_shadow_step
from tests.inverse.test_mask_bands import unit

N, NOISE, SHIFT = 61, 0.02, (0.577, 0.0)
RASTER = Raster.regular((N, N), 10.0)
PLACE = np.moveaxis(np.asarray(RASTER.centred_positions()), 0, -1) / 10.0


def beyond(turn: float, offset: float) -> np.ndarray:
    """Distance of the pixels from a line, along its normal [pixels]."""
    return PLACE @ unit(turn) - offset


def found_in(signal: np.ndarray, seed: int = 0, shift: tuple[float, float] = SHIFT) -> np.ndarray | None:
    """Find the upper side of a step in signals [detector, y, x] with noise."""
    noisy = signal * (1.0 + NOISE * np.random.default_rng(seed).standard_normal(signal.shape))
    return find_shadow_step(noisy, (NOISE * signal) ** 2, RASTER, shift)


def glow(u: np.ndarray, share: tuple[float, ...] = (0.25, 0.03, 0.1), reach: float = 5.0) -> np.ndarray:
    """Signals of level ground that a wall at u = 0 lights [detector, y, x]."""
    return 1.0 + np.multiply.outer(np.array(share), np.where(u > 0.0, 1.0 / (1.0 + np.abs(u) / reach), 0.0))


@pytest.mark.parametrize(("turn", "offset"), [(0.0, 0.3), (23.0, -8.6), (-71.0, 5.2), (40.0, 14.0)])
def test_a_step_is_found_to_the_pixel(turn, offset):
    """At most 8 of the 60 pixels along the line are on the wrong side. Rejects lines on the raster only, and the lower
    side."""
    u = beyond(turn, offset)
    upper = found_in(glow(u))
    assert upper is not None and np.sum(upper != (u < 0.0)) <= 8
    assert found_in(glow(u), shift=(0.0, 0.0)) is None, "seen straight down nothing is hidden"


def test_a_partial_mask_in_one_detector_does_not_hide_it():
    """One detector falls by 80 % at the foot and recovers within two pixels; pixels without data are left out."""
    u = beyond(-17.0, -2.0)
    signal = glow(u, (0.24, 0.0, 0.32))
    signal[1] *= np.where(u > 0.0, 1.0 - 0.8 * np.exp(-u), 1.0)
    signal[:, 20:24, 30:35] = np.nan
    upper = found_in(signal)
    assert upper is not None and np.sum(upper != (u < 0.0)) <= 8


def test_what_is_no_step():
    """A crease, a valley of slopes, rough relief, short waves, dashes, a step that ends half-way, one that faces the
    beam."""
    u = beyond(23.0, -3.0)
    tilts = np.array([0.25, -0.2, 0.1])[:, None, None]
    assert found_in(1.0 + tilts * (u > 0.0)) is None
    assert found_in(1.0 + 0.02 * tilts * np.abs(u)) is None
    relief = np.random.default_rng(3).normal(size=(N, N)) * 0.15
    assert found_in(1.0 + tilts / 0.25 * relief) is None
    assert found_in(1.0 + 0.15 * tilts * np.sin(2.6 * u)) is None
    waves = np.sin(2.6 * PLACE[..., 0]) + np.sin(2.5 * PLACE[..., 1])
    assert found_in(1.0 + 0.3 * tilts * waves) is None
    assert found_in(1.0 + tilts * ((u > 0.0) & (u < 1.0))) is None
    assert found_in(np.where(PLACE[..., 1] > 0.0, glow(u), 1.0)) is None
    assert found_in(glow(beyond(180.0, 4.0))) is None


def test_false_alarms():
    """None in 40 images of level ground; a rate of one in 20 would pass with a probability of 13 %."""
    assert all(found_in(np.ones((3, N, N)), seed) is None for seed in range(40))


def test_a_dead_detector_and_a_tiny_image():
    """A detector without data is left out; an image of 4 x 4 pixels shows no step."""
    signal = glow(beyond(23.0, -8.6))
    dead = np.append(signal, np.full_like(signal[:1], np.nan), axis=0)
    upper = found_in(dead)
    assert upper is not None and np.sum(upper != (beyond(23.0, -8.6) < 0.0)) <= 8
    tiny = np.ones((3, 4, 4))
    assert find_shadow_step(tiny, 1e-4 * tiny, Raster.regular((4, 4), 10.0), SHIFT) is None
