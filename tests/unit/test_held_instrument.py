"""What a solve leaves alone while the instrument is held, and what it does not."""

import jax
import numpy as np

from helio_jax.forward.form_factor import SpotGeometry
from helio_jax.inverse.problem import Refiner
from helio_jax.inverse.residuals import Surface
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings


def test_albedo_is_fitted_while_gains_are_held(bshem):
    """Catches an albedo that is held, too: its change over the image then becomes a step that is not there."""
    shape = (9, 11)
    geometry, surface = SpotGeometry(bshem), Surface(*np.zeros((3, *shape)))
    signal = geometry.form_factor(np.zeros(shape))[:, 2] * np.linspace(0.95, 1.05, shape[1])
    settings = ReconstructSettings(refine=RefineSettings(albedo_std=0.1, albedo_modes=3))
    for is_free in (False, True):
        refiner = Refiner(signal, (0.01 * signal) ** 2, geometry, 30.0, 30.0, surface, settings)
        with jax.enable_x64(True):
            refiner.step(10.0, 5.0, is_free)
        assert np.abs(refiner.values["albedo"]).max() > 0.1
        assert np.any(refiner.values["log_gain"] != 0.0) == is_free
        assert np.any(refiner.values["offset"] != 0.0) == is_free
