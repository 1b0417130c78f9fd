"""What the noise of the data does to a fit in the mean: simulated from the fit itself, and subtracted.

Two slopes in every pixel follow the noise, and the signal is curved in them: however many pixels there are, their
noise moves what all of them have in common. `Model.noise_change` and `Model.edge_scale` make up for most of it.
What is left hardly matters where a flat border holds the level. With a free one, a combination of level, gains and
offsets is known little better than their priors, and a hundredth of what is made up for moves it by its error bar.
"""

import copy
import zlib

import jax
import numpy as np

from helio_jax.inverse.problem import Refiner
from helio_jax.inverse.residuals import Surface


def noise_bias(refiner: Refiner, n_pairs: int) -> tuple[Surface, dict[str, np.ndarray]]:
    """Return the mean change of surface and instrument when a fit's own expected data are fitted with noise.

    Noise comes in pairs of opposite sign, so that all of its odd powers cancel. It is drawn by a generator that the
    data seed: the same each time, another for other data. The instrument of the simulated data is at its prior means,
    so that what priors draw towards them is not taken for bias.

    Args:
        refiner: the fit, converged.
        n_pairs: pairs of simulated data sets.

    Source: bootstrap estimate of bias: Efron and Tibshirani, An Introduction to the Bootstrap (1993), ch. 10;
        antithetic draws: Hammersley and Morton, Proc. Camb. Phil. Soc. 52 (1956) 449.
    """
    s, truth = refiner.settings, refiner.simulated()
    rng = np.random.default_rng(zlib.crc32(refiner.data.tobytes()))
    found = []
    for _ in range(n_pairs):
        noise = np.where(refiner.observed, np.sqrt(refiner.variance) * rng.standard_normal(truth.data.shape), 0.0)
        for own in (noise, -noise):
            fit = copy.copy(truth)
            fit.data, fit.residuals = truth.data + own, own / fit.sigma
            for _ in range(s.reweightings):
                fit.step(s.robust_limits[-1], s.jump_limits[-1], True)
            found.append((fit.surface, fit.values))
    mean = jax.tree.map(lambda *drawn: np.mean(drawn, axis=0), *found)
    return jax.tree.map(np.subtract, mean, (truth.surface, truth.values))
