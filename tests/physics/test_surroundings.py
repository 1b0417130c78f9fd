"""How far the ground around the image goes on: a steep flank sees what lies below the aperture that it faces."""

from pathlib import Path

import numpy as np

from helio_jax.micrograph import MicrographStack
from helio_jax.scene.surfaces import pyramid_body
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows.corrections import make_predictor
from helio_jax.workflows.scene_file import load_instrument

ASHEM = Path(__file__).parents[2] / "scenes" / "instruments" / "ashem_normal.toml"


def test_flanks_see_the_ground_below_the_aperture():
    """Flanks of 55 degrees on a ground 12 cm wide: multiple scattering predicted on what is near, to 1.5 %, as traced.

    Half of the limit is Monte Carlo noise of both, three standard deviations; what lies farther away than the ground is
    taken for is 0.2 %. Catches ground that ends as far beyond the image as the plate is away: 8 % are missing.
    """
    instrument = load_instrument(ASHEM)
    axis = 50.0 * (np.arange(30) - 14.5)
    x, y = np.meshgrid(axis, axis)
    away, slope = np.maximum(abs(x), abs(y)), np.tan(np.radians(55.0))
    height = np.clip((650.0 - away) * slope, 0.0, 500.0 * slope)
    is_flank = (away > 200.0) & (away < 600.0) & (x > 1.5 * abs(y))  # faces the detector
    normals = np.where(is_flank[..., None], [np.sin(np.radians(55.0)), 0.0, np.cos(np.radians(55.0))], [0.0, 0.0, 1.0])
    counts = np.ones((1, 30, 30))
    stack = MicrographStack(counts, axis, axis, instrument, n_rays=1.0)
    predicted = make_predictor(stack, 4_000_000)(height, normals).multiple[0, is_flank].mean()
    body = pyramid_body(1.2e5, 1300.0, 500.0 * slope, 300.0, 0.0, (0.0, 0.0))
    settings = TraceSettings(rays=4096, seed=5)
    traced = trace_pixels(make_experiment(body, instrument, settings), x[is_flank], y[is_flank])
    true = traced.mean[1:, 0].sum(0).mean()
    error = np.sqrt(traced.variance[1:, 0].sum(0).sum()) / is_flank.sum()
    assert error < 0.0025 * true
    assert abs(predicted / true - 1.0) < 0.015, predicted / true
