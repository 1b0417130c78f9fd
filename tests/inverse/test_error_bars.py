"""The two studies of repeated noise at a size for every run: benchmarks/error_bars.py holds them and the full ones."""

import json

import numpy as np
import pytest
from scipy import stats

from benchmarks import error_bars as study
from benchmarks.reconstruction import Record
from helio_jax.inverse.settings import ReconstructSettings
from tests.stats import assert_likely

SIZE = 24


@pytest.fixture(scope="module")
def case(bshem):
    """A bump on a flat border; gains and offsets drawn from their priors."""
    settings = ReconstructSettings.model_validate({"refine": {"samples": 64}})
    return study.Coverage("bump", bshem, study.bump(study.raster(SIZE), 20.0, 110.0), settings, bshem)


def test_cosine_modes_and_their_exact_slopes():
    """Orthonormal, and each slope column the analytic derivative of its mode between the pixels, too.

    Catches a wrong factor or sign, and one-sided differences taken for derivatives.
    """
    n, step = 7, 3.0
    modes, slopes = study.cosine_basis(n, step)
    assert np.allclose(modes.T @ modes, np.eye(n))
    position = (np.arange(n) + 0.5) * step
    scale = np.sqrt(np.where(np.arange(n) == 0, 1.0, 2.0) / n)
    series = lambda x: scale * np.cos(np.outer(x, np.pi * np.arange(n) / (n * step)))  # noqa: E731
    assert np.allclose(modes, series(position))
    assert np.allclose(slopes, (series(position + 1e-4) - series(position - 1e-4)) / 2e-4, atol=1e-8)


def test_reliefs_have_exact_slopes():
    """Sums and products against central differences of 1 % of the pitch; catches a forgotten term of the product."""
    axis, step = study.raster(9), 0.4

    def relief(dx, dy):
        hill = study.bump(axis + 0.0, 5.0, 100.0, (-dx, -dy))
        return hill.plus(study.bump(axis, 3.0, 80.0, (20.0 - dx, -dy))).times(hill)

    here = relief(0.0, 0.0)
    along_x = (relief(step, 0.0).height - relief(-step, 0.0).height) / (2 * step)
    along_y = (relief(0.0, step).height - relief(0.0, -step).height) / (2 * step)
    assert np.allclose(here.slope_x, along_x, atol=1e-5) and np.allclose(here.slope_y, along_y, atol=1e-5)
    waves = study.random_waves(study.raster(200), 0, 0.07, 400.0)
    numeric = np.gradient(waves.height, study.PITCH_UM, axis=1)[1:-1, 1:-1]
    assert np.abs(numeric - waves.slope_x[1:-1, 1:-1]).max() < 0.01
    assert np.sqrt(np.mean(waves.slope_x**2 + waves.slope_y**2)) == pytest.approx(0.07, rel=0.1)


def test_jackknife_of_a_mean():
    """The standard error of a plain mean is the textbook one."""
    x = np.random.default_rng(0).normal(size=(30, 2))
    value, error = study.jackknife(lambda m: m, x)
    assert np.allclose(value, x.mean(0)) and np.allclose(error, x.std(0, ddof=1) / np.sqrt(30))


def test_error_bars_of_the_coarse_modes(case):
    """10 fits: the squared pulls of tilt and bowl, 50 nearly independent ones, against chi-square.

    Only these bands, for there the data count more than the trapezoid rule. Two-sided, false alarm 2e-8 if the error
    bars are exact. A standard deviation halved gives 4 times the sum: p = 1e-19; doubled, a quarter: p = 1e-9.
    """
    done = case.batch(range(10))["pulls"]
    for group in ("tilt", "bowl"):
        assert {one[group][0] for one in done} == {2 if group == "tilt" else 3}
    total = sum(one[group][0] * one[group][2] for one in done for group in ("tilt", "bowl"))

    def p_value(sum_of_squares: float) -> float:
        return float(2 * min(stats.chi2.cdf(sum_of_squares, 50), stats.chi2.sf(sum_of_squares, 50)))

    assert_likely(p_value(total), "squared pulls of tilt and bowl")
    assert p_value(4 * total) < 1e-8 and p_value(total / 4) < 1e-6


def test_errors_reach_the_cramer_rao_bound(bshem):
    """5 fits without prior: the variance of the 138 mid modes is that of the bound to 0.75-1.3.

    690 nearly independent squares: a standard deviation of 5.4 %, so false alarms are below 4e-6 about 1.0. Rejects
    errors that are 20 % larger than need be, and a bound without one of the detectors.
    """
    done = study.Efficiency(bshem, SIZE, per_batch=5).batch(range(5))
    mid = study.BANDS.index("mid")
    assert 0.75 < np.mean(done["error"], axis=0)[mid] / done["bound"][mid] < 1.3


def test_killed_study_goes_on_after_its_last_batch(case, tmp_path, monkeypatch):
    """Killed in the second batch and started again, the first is read from the file and not fitted again."""
    calls = []

    def fake(self, realisations):
        calls.append(realisations.start)
        if len(calls) == 2:
            raise KeyboardInterrupt
        pulls = {name: [4, 0.1 * i, 1.0, 0.6, 0.9] for i, name in enumerate(("heights", *study.BANDS))}
        return {"pulls": [pulls] * len(realisations), "valid": [1.0] * len(realisations)}

    monkeypatch.setattr(study.Coverage, "batch", fake)
    monkeypatch.setattr(study, "coverage_cases", lambda instrument, size: ([case], []))
    path = tmp_path / "study.json"
    with pytest.raises(KeyboardInterrupt):
        study.coverage_row(Record(path, 1), case.instrument, 4, SIZE, per_batch=2)
    study.coverage_row(Record(path, 1), case.instrument, 4, SIZE, per_batch=2)
    assert calls == [0, 2, 2]
    assert [row["row"] for row in json.loads(path.read_text())["rows"]] == ["4 batch", "4 batch", "4"]


def test_noise_alone_moves_neither_gain_nor_offset(bshem):
    """On a noisy flat (5 % per pixel) mean gain and offset are 1 and 0 to within 0.18 % of the signal.

    Six flats; standard errors 0.01-0.035 %: 5 of them. Slopes are two unknowns more with every pixel (Neyman and
    Scott), so rejects, at any size of the raster: edges that do not count in the unit of the gain, and mean signals of
    noisy slopes taken for those of the true ones.
    """
    settings = ReconstructSettings.model_validate({"refine": {"samples": 0}})
    flat = study.bump(study.raster(36), 0.0, 100.0)
    signal = study.expected_signal(bshem, flat)
    n_rays = 3.5e4
    found = []
    for seed in range(6):
        counts = np.random.default_rng([5, seed]).poisson(n_rays * signal).astype(float)
        rec = study.fit(counts, n_rays * signal, bshem, settings, n_rays)
        found.append([rec.gain.mean() - 1.0, rec.offset.mean() / np.median(signal)])
    mean = np.mean(found, axis=0)
    assert np.all(np.abs(mean) < 0.0018), mean
