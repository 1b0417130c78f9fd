"""A substrate that is tilted against the plate: found by the fit, continued beyond the image, no bias by noise."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward.render import Corrections
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.convergence import has_converged
from helio_jax.inverse.fit import fit_heights, without_noise_bias
from helio_jax.inverse.noise_bias import noise_bias
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.scene.surfaces import surface_body
from helio_jax.workflows.corrections import make_predictor

AXIS = 60.0 * (np.arange(61) - 30.0)
RASTER = hx.Raster(AXIS, AXIS)
TILT = math.radians(2.0), math.radians(-1.5)
SNR, WIDTH, HEIGHT = 50.0, 500.0, 400.0

CALIBRATED: dict[str, float] = {"gain_std": 0.3, "offset_std": 0.03, "drift_std": 0.08, "line_std": 0.03}
"""Priors of a measured scan."""


def nothing(height, normals, *_, **known):
    """Predict no masks and no multiple scattering; the fit says how the substrate is tilted."""
    assert len(known["tilt"]) == 2
    return Corrections.none((3, *height.shape))


def hill_on(tilt: tuple[float, float]) -> hx.Surface:
    """Make a hill on a substrate of these slopes, 0 in the middle."""
    x, y = np.meshgrid(AXIS, AXIS)
    with jax.enable_x64(True):
        surface = hx.surface_of_heights(HEIGHT * np.exp(-0.5 * (x**2 + y**2) / WIDTH**2), RASTER)
        flat = jax.tree.map(lambda f: np.asarray(f, float), surface)
    return hx.Surface(flat.height + tilt[0] * x + tilt[1] * y, flat.slope_x + tilt[0], flat.slope_y + tilt[1])


def height_share(height: np.ndarray) -> float:
    """Compute the share of the hill in heights."""
    hill = hill_on((0.0, 0.0)).height
    return float(np.sum(height * hill) / np.sum(hill**2))


@pytest.fixture(scope="module")
def fit(bshem):
    """Fit a hill on a tilted substrate from the same on a level one."""
    instrument = bshem.model_copy(
        update={"uncertainty": Uncertainty(tilt_deg=1.7, sample_distance_um=70.0, polar_deg=0.7)}
    )
    with jax.enable_x64(True):
        optics = jax.tree.map(jnp.asarray, hx.Optics.of(instrument))
        none = Corrections.none((3, *RASTER.shape))
        signal = np.asarray(hx.render(hill_on(TILT), optics, RASTER, corrections=none))
    std = np.median(signal, axis=(1, 2), keepdims=True) / SNR
    signal = signal + std * np.random.default_rng(5).standard_normal(signal.shape)
    variance = np.broadcast_to(std**2, signal.shape)
    settings = ReconstructSettings(refine=RefineSettings(max_rounds=6, **CALIBRATED))
    start = hill_on((0.0, 0.0))
    problem = FitProblem.of(signal, variance, instrument, RASTER, start, settings)
    return without_noise_bias(fit_heights(problem, start, nothing))


def test_the_tilt_is_found(fit):
    """Within 0.6 deg, and the hill's height within 5 %, by a fit that has converged: SNR 50, priors of a measured scan.

    Rejects heights above a level plane as unknowns, which follow the tilt only all together: conjugate gradients then
    stop at 0.9 and -0.6 deg instead of 2 and -1.5.
    """
    tilt = fit.problem.priors.tilt * fit.parameters.tilt
    assert np.degrees(tilt) == pytest.approx(np.degrees(TILT), abs=0.6)
    assert has_converged(fit.changes, fit.problem.settings.tolerance_um)
    assert height_share(fit.surface.height) == pytest.approx(1.0, abs=0.05)


def test_noise_does_not_bias_the_tilt(fit):
    """The simulated data of the bias are of a level substrate, heights and tilt alike.

    Heights with the tilt and an instrument without it contradict each other: the bias was then a tilt of its own.
    """
    surface, parameters = noise_bias(fit.problem, fit.state, 1)
    assert np.degrees(fit.problem.priors.tilt * parameters.tilt) == pytest.approx(0.0, abs=0.7)
    assert height_share(surface.height) == pytest.approx(0.0, abs=0.05)


def test_a_tilted_plane_goes_on_as_a_plane():
    """All faces of image and substrate have one normal; catches a step at the border."""
    x, y = np.meshgrid(AXIS + 30.0, AXIS)
    body = surface_body(x, y, 7.0 + TILT[0] * x + TILT[1] * y, 3000.0, level=7.0, beam_shift=(0.5, 0.1), tilt=TILT)
    corners = body.vertices[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal[np.linalg.norm(normal, axis=1) > 1e-6]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    expected = np.array([-TILT[0], -TILT[1], 1.0]) / math.sqrt(1.0 + TILT[0] ** 2 + TILT[1] ** 2)
    assert normal == pytest.approx(np.broadcast_to(expected, normal.shape), abs=1e-9)
    assert np.abs(body.vertices[:, :2]).max() == 3000.0


def test_a_tilted_plane_has_no_multiple_scattering(bshem):
    """A plane does not see itself, however it is tilted; with level surroundings it sees them."""
    x, y = np.meshgrid(AXIS, AXIS)
    height = TILT[0] * x + TILT[1] * y
    normal = hx.Surface(height, *(np.full(height.shape, t) for t in TILT)).normals(bshem.beam_shift)
    stack = hx.MicrographStack(np.ones((3, *height.shape)), AXIS, AXIS, bshem, n_rays=1.0, noise="none")
    predict = make_predictor(stack, 50_000)
    found = predict(height, normal, tilt=TILT).multiple
    wrong = predict(height, normal).multiple
    assert np.abs(found).max() <= 1e-12
    assert wrong.max() > 1e-6
