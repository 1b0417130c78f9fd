"""How masks follow common changes of the heights: by the albedo and the law of the pixels that they mask."""

from dataclasses import replace

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.campaign import CampaignLaw
from helio_jax.forward.render import masking_corrections
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState, set_corrections, with_responses
from helio_jax.inverse.steps import expected

N, PITCH, HEIGHT, RISE = 25, 40.0, 100.0, 2.0
RASTER = hx.Raster.regular((N, N), PITCH)
INSTRUMENT = Instrument(
    beam=Beam(),
    plate=Plate(working_distance_um=3000.0),
    detector=tuple(Detector(name=f"d{k}", polar_deg=45.0, azimuth_deg=120.0 * k, half_angle_deg=8.0) for k in range(3)),
)
BLOCK = np.zeros((N, N), int)
BLOCK[8:17, 8:17] = 1


def block(height: float) -> hx.Surface:
    """A level block on the substrate."""
    return hx.Surface(height * BLOCK.astype(float), *np.zeros((2, N, N)))


def change(exponent: float, albedo: float, *, anew: bool) -> np.ndarray:
    """Compute how expected data change where the block rises, masks predicted `anew` or by their response."""
    law = CampaignLaw(exponent=exponent, std=0.01) if exponent else None
    instrument, optics = INSTRUMENT.model_copy(update={"law": law}), hx.Optics.of(INSTRUMENT)
    patches = AlbedoPatches(1 - BLOCK, np.log([albedo]), True) if albedo != 1.0 else None
    signal = np.ones((3, N, N))
    given = instrument, RASTER, block(HEIGHT), ReconstructSettings()
    problem = FitProblem.of(signal, 1e-6 * signal, *given, region=BLOCK, patches=patches)
    masks = [masking_corrections(block(z), optics, RASTER) for z in (HEIGHT, HEIGHT + RISE)]
    start = set_corrections(problem, FitState.at(problem, block(HEIGHT)), masks[0], block(HEIGHT))
    start = with_responses(problem, start)
    risen = replace(start, surface=block(HEIGHT + RISE))
    if anew:
        risen = set_corrections(problem, risen, masks[1], block(HEIGHT + RISE))
    # of the substrate alone: the block's own signal changes with its height in either case
    return np.where(BLOCK, 0.0, expected(problem, risen, is_noisy=False) - expected(problem, start, is_noisy=False))


@pytest.mark.parametrize(("exponent", "albedo"), [(0.0, 1.0), (0.3, 1.0), (0.0, 0.6)])
def test_masks_follow_a_level_by_law_and_albedo(exponent, albedo):
    """What is masked more where a block rises by 2 um is that of masks predicted anew to 3 %.

    Rejects responses without the albedo of a dark substrate (1.66 times at 0.6), and without the law (0.9 times at
    m = 0.3).
    """
    by_response, anew = (change(exponent, albedo, anew=anew).sum() for anew in (False, True))
    assert 0.97 <= by_response / anew <= 1.03
