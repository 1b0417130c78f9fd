"""How many paths the fit asks for: enough for every pixel, fewer for what it only starts from."""

import numpy as np

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import Corrections
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.settings import (
    LEAST_PATHS,
    PATHS_PER_PIXEL,
    SEARCH_THRIFT,
    START_THRIFT,
    ReconstructSettings,
    RefineSettings,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.corrections import make_predictor


def test_paths_follow_the_pixels_but_for_small_images_and_given_numbers():
    """A large image gets as many paths per pixel as any other: a fixed number drowned sphere A's ring in noise."""
    large = 351 * 304
    assert RefineSettings().paths(large) == PATHS_PER_PIXEL * large > 10_000_000
    assert RefineSettings().paths(100) == LEAST_PATHS
    assert RefineSettings(rays=20_000).paths(large) == 20_000


def test_a_tiny_raster_takes_no_more_paths_than_the_tracer_has(bshem):
    """Nine pixels: most paths per pixel, not an error of the tracer's settings."""
    axis = 40.0 * np.arange(3.0)
    stack = MicrographStack(np.ones((3, 3, 3)), axis, axis, bshem, n_rays=1.0)
    found = make_predictor(stack, LEAST_PATHS, 2000.0)(np.zeros((3, 3)), np.broadcast_to([0.0, 0.0, 1.0], (3, 3, 3)))
    assert not found.multiple.any()  # a flat sees itself nowhere


def test_only_the_start_is_predicted_with_fewer_paths(bshem):
    """Photometric solutions with a quarter of the paths, the round of the fit with all, its test with an eighth."""
    n_paths = 4 * LEAST_PATHS
    axis = 40.0 * np.arange(8.0)
    counts = 35e3 * form_factor(Optics.of(bshem), np.zeros((8, 8)))[:, 2]
    stack = MicrographStack(counts, axis, axis, bshem, variance=counts, n_rays=35e3)
    used = []

    def make_predict(asked):
        def predict(height, normals, **known):
            used.append(asked)
            return Corrections.none(counts.shape)

        return predict

    refine = {"rays": n_paths, "samples": 0, "max_rounds": 1, "lm_steps": 1, "cg_steps": 2}
    reconstruct_stack(stack, ReconstructSettings.model_validate({"refine": refine}), make_predict)
    at = used.index(n_paths)
    assert at >= RefineSettings().photometric_rounds and set(used[:at]) == {n_paths // START_THRIFT}
    assert used[at + 1 :] == [n_paths // SEARCH_THRIFT]
