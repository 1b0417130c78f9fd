"""What an experiment would determine (`hx.fisher`), against scaling laws, a dense inverse and symmetry."""

import jax
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import SceneError
from helio_jax.instrument import Beam, Detector, Instrument, Plate, Uncertainty
from helio_jax.inverse.posterior import exact_height_covariance, linearise
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import freeze

EXACT = {"gain_std": 1e-6, "offset_std": 1e-6, "multiple_error": 0.0, "mask_error": 0.0}
KNOWN = {"settings": ReconstructSettings(border_std_um=0.01, refine=RefineSettings(**EXACT)), "n_samples": 3000}
"""Nothing but the heights is unknown, and the border lies on the substrate."""


def ring(n_detectors: int, polar_deg: float = 40.0) -> hx.Optics:
    """Detectors evenly around a beam along the normal."""
    detectors = tuple(
        Detector(name=f"d{k}", polar_deg=polar_deg, azimuth_deg=360.0 * k / n_detectors, half_angle_deg=8.0)
        for k in range(n_detectors)
    )
    return hx.Optics.of(Instrument(beam=Beam(), plate=Plate(working_distance_um=4000.0), detector=detectors))


def inner(std: np.ndarray) -> float:
    """Root mean square standard deviation away from the border, which is held."""
    return float(np.sqrt(np.mean(std[4:-4, 4:-4] ** 2)))


def test_noise_falls_with_the_root_of_the_dose():
    """Four times the atoms halve the standard deviation, to 3 %; a background as large as the signal costs sqrt(2).

    The slope noise stays well above the floor of the edges, which scale with it. Rejects a variance that lacks the
    background or has the wrong power of the dose (a factor of 2 or sqrt(2)).
    """
    raster, height, optics = hx.Raster.regular((17, 17), 30.0), np.zeros((17, 17)), ring(3)
    counts = 1e5 * float(np.asarray(hx.render(height, optics, raster))[0, 8, 8])
    base, more = (inner(hx.posterior_std(height, optics, raster, dose, **KNOWN)) for dose in (1e5, 4e5))
    assert base / more == pytest.approx(2.0, rel=0.03)
    dark = inner(hx.posterior_std(height, optics, raster, 1e5, **KNOWN, background=counts))
    assert dark / base == pytest.approx(np.sqrt(2.0), rel=0.03)


def test_more_detectors_count_as_more_dose():
    """Six detectors around the beam know as much as three with twice the atoms, to 5 %: information adds.

    Not exactly, for the floor of the edges' standard deviations goes with the noise of one detector. Rejects detectors
    that are not added (41 % off).
    """
    raster, height = hx.Raster.regular((15, 15), 30.0), np.zeros((15, 15))
    six = inner(hx.posterior_std(height, ring(6), raster, 1e5, **KNOWN))
    three = inner(hx.posterior_std(height, ring(3), raster, 2e5, **KNOWN))
    assert six == pytest.approx(three, rel=0.05)


def test_too_few_samples_are_refused(bshem):
    """None, which crashed, and one, of which no standard deviation follows."""
    raster = hx.Raster.regular((5, 5), 40.0)
    for n in (0, 1):
        with pytest.raises(SceneError, match=f"n_samples is {n}.*2 samples at least"):
            hx.fisher(np.zeros((5, 5)), hx.Optics.of(bshem), raster, 1e6, n_samples=n)


def test_samples_agree_with_the_dense_inverse(bshem):
    """The standard deviations of 2000 samples are those of the inverted information matrix: chi-square of their ratio.

    Each is known to 1 / sqrt(4000) = 1.6 %; all within 6 of these (false alarm below 1e-6). Rejects a lost prior or
    residual block, which changes them by more than 10 %.
    """
    n, rng = 9, np.random.default_rng(2)
    raster, optics = hx.Raster.regular((n, n), 40.0), hx.Optics.of(bshem)
    height = 5.0 * rng.normal(size=(n, n))
    stated = Uncertainty(sample_distance_um=100.0, polar_deg=1.0)
    settings = ReconstructSettings(refine=RefineSettings(mask_error=0.0, multiple_error=0.0))
    known = {"uncertainty": stated, "settings": settings, "corrections": "none"}
    found = hx.fisher(height, optics, raster, 1e6, n_samples=2000, **known)
    surface = jax.tree.map(np.asarray, hx.surface_of_heights(height, raster))
    probability = np.asarray(hx.render(surface, optics, raster, corrections="none"))
    problem = FitProblem.of(probability, probability / 1e6, optics, raster, surface, settings, uncertainty=stated)
    linear = linearise(*freeze(problem, FitState.at(problem, surface), 8.0, 4.0))
    exact = np.sqrt(np.diag(exact_height_covariance(linear))).reshape(n, n)
    assert np.abs(found.height_std / exact - 1.0).max() < 6.0 / np.sqrt(4000.0)


def test_parameters_are_reported_in_their_units(bshem):
    """Never above the prior; the distance in um, angles in degrees; a free border leaves the level to the near field.

    Catches a parameter in prior standard deviations, and a border that is flat whatever the settings say.
    """
    raster, optics = hx.Raster.regular((15, 15), 60.0), hx.Optics.of(bshem)
    x, y = np.meshgrid(raster.x, raster.y)
    height = 60.0 * np.exp(-(x**2 + y**2) / (2.0 * 200.0**2))
    stated = Uncertainty(sample_distance_um=100.0, polar_deg=2.0)
    found = hx.fisher(height, optics, raster, 1e6, uncertainty=stated)
    assert found.parameters["distance"][1:] == (100.0, "um") and found.parameters["polar 2"][1:] == (2.0, "deg")
    assert all(std <= 1.001 * prior for std, prior, _ in found.parameters.values())
    assert found.parameters["polar 0"][0] < 1.0  # the relief's data determine it better than the prior
    free = hx.posterior_std(height, optics, raster, 1e6, settings=ReconstructSettings(border="free"))
    assert inner(free) > 3.0 * inner(hx.posterior_std(height, optics, raster, 1e6))
