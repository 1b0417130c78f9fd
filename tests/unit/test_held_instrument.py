"""What a solve leaves alone while the instrument is held, and what it does not."""

import numpy as np

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import step


def test_albedo_is_fitted_while_gains_are_held(bshem):
    """Catches an albedo that is held, too: its change over the image then becomes a step that is not there."""
    shape = (9, 11)
    surface = Surface(*np.zeros((3, *shape)))
    signal = form_factor(Optics.of(bshem), np.zeros(shape))[:, 2] * np.linspace(0.95, 1.05, shape[1])
    settings = ReconstructSettings(refine=RefineSettings(albedo_std=0.1, albedo_modes=3))
    raster = Raster.regular(shape, 30.0)
    problem = FitProblem.of(signal, (0.01 * signal) ** 2, bshem, raster, surface, settings)
    for is_free in (False, True):
        found = step(problem, FitState.at(problem, surface), 10.0, 5.0, is_free)[0].parameters
        assert np.abs(found.albedo).max() > 0.1
        assert np.any(found.log_gain != 0.0) == is_free
        assert np.any(found.offset != 0.0) == is_free
