"""What the edges count: slopes in units of the noise that the data leave, wherever gain and level are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface, normal_of_slopes
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.residuals import edge_scale
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import freeze


def noise(optics, height, gain, sigma):
    """Return a level facet's slope noise: one over the root of the trace of the normal equations, by differences."""

    def signal(x, y):
        normal = np.array(normal_of_slopes(np.array(x), np.array(y), optics.beam_shift))
        return gain * (form_factor(optics, np.array(height)) @ normal) / np.linalg.norm(normal) / sigma

    step = 1e-5
    by = [(signal(*way) - signal(*(-w for w in way))) / (2 * step) for way in ((step, 0.0), (0.0, step))]
    return 1.0 / np.sqrt(np.sum(np.square(by)))


def test_edges_count_in_slope_noise(bshem):
    """Half a millimetre nearer to the plate, and with other gains, edges weigh as much more as slopes are less noisy.

    A factor of the gains alone (as it was) would be 23 % too low: fits on a free border then came out some 60 um too
    near to the plate, where their slopes were less noisy.
    """
    optics, shape = Optics.of(bshem), (4, 5)
    sigma = np.array([0.4, 0.5, 0.6]) * 1e-3
    level = Surface(np.full(shape, 500.0), np.zeros(shape), np.zeros(shape))
    signal = np.broadcast_to(form_factor(optics, np.array(0.0))[:, 2, None, None], (3, *shape))
    variance = np.broadcast_to(sigma[:, None, None] ** 2, signal.shape)
    problem = FitProblem.of(signal, variance, bshem, Raster.regular(shape, 30.0), level, ReconstructSettings())
    with jax.enable_x64(True):
        start = freeze(problem, FitState.at(problem, level), 1e9, 1e9)
        unknowns, fixed, level = jax.tree.map(jnp.asarray, (*start, level))
        log_gain = jnp.array([2.0, -1.0, 1.0])
        gain = np.exp(np.asarray(fixed.priors.gain * log_gain))
        found = edge_scale(level, unknowns.parameters.replaced(log_gain=log_gain), fixed)
    expected = noise(optics, 0.0, np.ones(3), sigma) / noise(optics, 500.0, gain, sigma)
    assert float(found) == pytest.approx(expected, rel=1e-6)
    assert expected > 1.05 * gain.mean()
