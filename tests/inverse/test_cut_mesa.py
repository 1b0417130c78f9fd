"""A mesa that the image's border cuts, on a border stated to be flat: it is not pulled down to the substrate."""

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward.optics import Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from tests import terraces

HEIGHT = 100.0


def test_what_known_steps_part_from_the_substrate_is_not_held_to_it(bshem):
    """The weight of the border's prior is as before in the other pixels, and next to nothing in these."""
    shape = 12, 15
    about = (np.ones((3, *shape)), np.ones((3, *shape)), bshem, Raster.regular(shape, 10.0, 10.0))
    flat, settings = Surface(*np.zeros((3, *shape))), ReconstructSettings()
    off = np.zeros(shape, bool)
    off[3:8, 9:] = True
    plain = FitProblem.of(*about, flat, settings).border
    found = FitProblem.of(*about, flat, settings, off_substrate=off).border
    assert np.array_equal(found[~off], plain[~off])
    assert plain[3:8, -1].min() == 1.0 / settings.border_std_um and found[off].max() < 1e-4


@pytest.mark.slow
def test_a_mesa_that_the_border_cuts_has_its_level(tmp_path):
    """100 um high, a third of it beyond the image, SNR 60: median of its top to 4 % (1 % measured), most of it valid.

    Held to the substrate at the border, it came out 6 um high, invalid all over.
    """
    fixed = {"outline": "square", "n": 49, "pixel": 12.0, "incidence": 30.0, "width": 260.0, "height": HEIGHT}
    member = terraces.draw(np.random.default_rng(3), **fixed, turn=20.0, snr=60.0, place=(260.0, 10.0))
    stack = terraces.trace(member, tmp_path, rays=64)
    top = terraces.seen_level(member, *np.meshgrid(stack.x, stack.y)) == HEIGHT
    assert top[:, -1].sum() > 8
    rec = hx.reconstruct(stack, "refine", refine={"samples": 8, "objects": False, "albedo_patches": False})
    assert np.median(rec.height[top]) == pytest.approx(HEIGHT, rel=0.04)
    assert rec.is_valid[top].mean() > 0.6
