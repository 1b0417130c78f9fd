"""The level of a flat border's signal, and the starts of fits where it is off."""

import numpy as np
import pytest

from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.laws import PowerLaw, level_ratio
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.border_level import MOST, OFF, border_levels
from helio_jax.inverse.parameters import LawPrior
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState
from helio_jax.inverse.steps import with_residuals

SHAPE = 21, 31


def signal_of(bshem, levels):
    """Return the signal of a level substrate times a level [detector, y, x], something else in the middle."""
    signal = np.ones((3, *SHAPE)) * (substrate_signal(Optics.of(bshem)) * np.array(levels))[:, None, None]
    signal[:, 5:15, 5:25] *= 0.3
    return signal


def test_levels_are_those_of_the_border(bshem):
    """Medians over the substrate's signal, whatever is in the middle; without data there 1; limited; a law's own."""
    optics, settings = Optics.of(bshem), ReconstructSettings()
    signal = signal_of(bshem, (1.0, 1.2, 0.9))
    np.testing.assert_allclose(border_levels(signal, optics, settings), (1.0, 1.2, 0.9))
    signal[1] = np.nan
    signal[2] *= -1.0
    np.testing.assert_allclose(border_levels(signal, optics, settings), (1.0, 1.0, 1.0 / MOST))
    law = LawPrior(PowerLaw(0.5), PowerLaw(0.1))
    by_law = signal_of(bshem, level_ratio(law.mean, optics) * np.array((1.0, 1.2, 0.9)))
    np.testing.assert_allclose(border_levels(by_law, optics, settings, law), (1.0, 1.2, 0.9), rtol=1e-6)


def test_levels_relative_to_an_unknown_albedo(bshem):
    """Of a dark substrate: their mean is 1, and a detector without data on the border, of which nothing is known, is
    left as it is. Catches a mean that counts it as measured."""
    optics, settings = Optics.of(bshem), ReconstructSettings()
    signal = signal_of(bshem, (0.7, 0.7 * 1.2, 0.7 / 1.2))
    np.testing.assert_allclose(border_levels(signal, optics, settings, is_albedo_known=False), (1.0, 1.2, 1.0 / 1.2))
    dark = signal_of(bshem, (0.7, 0.7, 0.7))
    dark[1, :4] = dark[1, -4:] = dark[1, :, :4] = dark[1, :, -4:] = np.nan
    assert np.array_equal(border_levels(dark, optics, settings, is_albedo_known=False), np.ones(3))
    dark[0] *= 1.44
    np.testing.assert_allclose(border_levels(dark, optics, settings, is_albedo_known=False), (1.2, 1.0, 1.0 / 1.2))


@pytest.mark.parametrize(("border", "off"), [("flat", 0.9 * OFF), ("free", 0.3)])
def test_levels_that_may_be_the_samples_count_as_right(bshem, border, off):
    """All within some per cent, as multiple scattering; or a border that is not the substrate."""
    settings = ReconstructSettings().changed(border=border)
    found = border_levels(signal_of(bshem, (1.0, 1.0 + off, 1.0 - off)), Optics.of(bshem), settings)
    assert np.array_equal(found, np.ones(3))


def test_a_fit_starts_where_the_border_is_explained(bshem):
    """Flat images are explained; gain and offset share the level in proportion to their variances, that of the offset
    in units of the median signal; a dark substrate that is a patch needs none."""
    settings, flat = ReconstructSettings(), Surface(*np.zeros((3, *SHAPE)))
    levels = np.array((1.0, 1.5, 0.3))
    signal = np.ones((3, *SHAPE)) * (substrate_signal(Optics.of(bshem)) * levels)[:, None, None]
    known = bshem, Raster.regular(SHAPE, 40.0), flat, settings
    problem = FitProblem.of(signal, (0.01 * signal) ** 2, *known)
    assert np.abs(with_residuals(problem, FitState.at(problem, flat)).residuals[1:]).min() > 30.0
    state = with_residuals(problem, FitState.starting(problem, flat))
    assert np.abs(state.residuals).max() < 1.0
    start, s = problem.start_parameters(), settings.refine
    of_offset, of_gain = (s.offset_std * start.offset * levels)[1:], np.expm1(s.gain_std * start.log_gain)[1:]
    np.testing.assert_allclose(of_offset / of_gain, (s.offset_std * levels[1:] / s.gain_std) ** 2, rtol=1e-6)
    dark = AlbedoPatches(np.ones(SHAPE, int), np.log([0.7]), True)
    signal = signal_of(bshem, (0.7,) * 3)
    problem = FitProblem.of(signal, (0.01 * signal) ** 2, *known, patches=dark)
    assert not problem.start_parameters().log_gain.any()


@pytest.mark.parametrize("border", ["flat", "free"])
def test_a_detector_with_few_counts_has_a_start(bshem, border):
    """More than half of its pixels have none: their mean says how large its offset may be, and the start is finite."""
    signal = signal_of(bshem, (1.0, 1.0, 1.0))
    signal[0] *= np.random.default_rng(1).random(SHAPE) < 0.3
    surface, settings = Surface(*np.zeros((3, *SHAPE))), ReconstructSettings().changed(border=border)
    problem = FitProblem.of(signal, np.full_like(signal, 1e-6), bshem, Raster.regular(SHAPE, 40.0), surface, settings)
    assert problem.priors.offset[0] == pytest.approx(settings.refine.offset_std * signal[0].mean())
    start = problem.start_parameters()
    assert np.isfinite(start.offset).all() and np.isfinite(start.log_gain).all()
