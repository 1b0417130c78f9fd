"""Beyond the image a sample with a free border goes on as it does at the border: what that sends back into it."""

from pathlib import Path

import numpy as np
import pytest

from helio_jax import pipeline
from helio_jax.config import load_scene
from helio_jax.predict import make_predictor

STEP = Path(__file__).parents[2] / "scenes" / "step.toml"


@pytest.mark.parametrize("border, low, high", [("free", 0.8, 1.5), ("flat", 0.0, 0.6)])
def test_a_wall_across_the_image_goes_on_beyond_it(border, low, high):
    """A step of 100 um, seen over 0.28 mm of its 6 mm: multiple scattering of the lower terrace as simulated.

    The beam does not see the wall, so what it sends is known to a third; a fifth of a millimetre and more away from it,
    noise is 5 %. With a flat outside the image the wall ends there and sends less than half, and fits ran away.
    """
    scene = load_scene(STEP, {"scan.nx": 25, "scan.ny": 7, "scan.pixel_size_um": 40.0})
    stack = pipeline.simulate(scene, seed=1)
    assert stack.multiple is not None and stack.n_rays is not None
    is_lower = np.arange(25) > 13  # the beam sees none of the wall: its foot is where the shadow ends
    height = np.where(is_lower, 0.0, 100.0) * np.ones((7, 1))
    normals = np.broadcast_to([0.0, 0.0, 1.0], (7, 25, 3))
    predicted = make_predictor(stack, 400_000, 6000.0, border=border)(height, normals)
    true = stack.multiple[:, :, 19:].sum((1, 2)) / stack.n_rays
    ratio = predicted.multiple[:, :, 19:].sum((1, 2)) / true
    assert np.all((low < ratio) & (ratio < high)), ratio
