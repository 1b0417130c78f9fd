"""A substrate darker than albedo 1: the flat border shows it, and albedos are tried before pits and objects."""

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.inverse.explanations import _Fits
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack

N, ATOMS, SNR = 25, 1e6, 60.0
ALBEDO = 0.8


@pytest.mark.parametrize(
    ("albedo", "border", "gain_std", "is_dark"),
    [
        (ALBEDO, "flat", 0.02, True),
        (0.97, "flat", 0.02, False),
        (1.3, "flat", 0.02, False),
        (ALBEDO, "flat", 0.3, False),
        (ALBEDO, "free", 0.02, False),
    ],
)
def test_a_dark_substrate_shows_at_the_border(bshem, albedo, border, gain_std, is_dark):
    """Not by what the gains may explain, nor with a free border, where nothing is flat; a bright one is none.

    Catches searches for pits and objects in vain, and background taken for albedo above 1.
    """
    level = albedo * substrate_signal(hx.Optics.of(bshem))[:, None, None] * np.ones((3, N, N))
    noise = level / SNR * np.random.default_rng(3).standard_normal(level.shape)
    axis = 20.0 * (np.arange(N) - N // 2)
    variance = np.broadcast_to((ATOMS * level / SNR) ** 2, level.shape)
    stack = MicrographStack(ATOMS * (level + noise), axis, axis, bshem, variance=variance, n_rays=ATOMS)
    settings = ReconstructSettings.model_validate({"border": border, "refine": {"gain_std": gain_std}})
    assert _Fits(stack, settings, None, None).is_substrate_dark is is_dark
