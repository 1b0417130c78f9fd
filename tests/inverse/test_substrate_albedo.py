"""A substrate whose albedo is not 1: the flat border shows it, and no fit begins with the wrong one."""

import math

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.render import Corrections
from helio_jax.inverse.explanations import _Fits
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack

N, ATOMS, SNR = 25, 1e6, 60.0
ALBEDO = 0.8


@pytest.mark.parametrize(
    ("albedo", "border", "gain_std", "is_found"),
    [
        (ALBEDO, "flat", 0.02, True),
        (0.97, "flat", 0.02, False),
        (ALBEDO, "flat", 0.3, False),
        (ALBEDO, "free", 0.02, False),
    ],
)
def test_albedo_of_the_substrate_is_found_at_the_border(bshem, albedo, border, gain_std, is_found):
    """To 2 %, on a flat with noise; not what the gains may explain, nor with a free border, where nothing is flat.

    Catches fits that take every substrate for albedo 1: they are contradicted in all pixels, and pits and objects are
    searched in vain.
    """
    level = albedo * substrate_signal(hx.Optics.of(bshem))[:, None, None] * np.ones((3, N, N))
    noise = level / SNR * np.random.default_rng(3).standard_normal(level.shape)
    axis = 20.0 * (np.arange(N) - N // 2)
    variance = np.broadcast_to((ATOMS * level / SNR) ** 2, level.shape)
    stack = MicrographStack(ATOMS * (level + noise), axis, axis, bshem, variance=variance, n_rays=ATOMS)
    settings = ReconstructSettings.model_validate({"border": border, "refine": {"gain_std": gain_std}})
    none = Corrections.none(level.shape)
    substrate = _Fits(stack, settings, lambda paths: lambda *_, **__: none, None).substrate
    assert bool(substrate) is is_found and not substrate.objects
    if is_found:
        assert substrate.log_albedo == pytest.approx([math.log(albedo)], abs=0.02)
        assert np.all(substrate.number == 1)
