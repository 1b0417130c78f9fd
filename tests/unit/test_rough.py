"""Random rough surfaces against their spectrum's closed forms: rms, correlation, slope of the spectrum, seeds."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.integrate import quad
from scipy.special import gamma, j0, kv
from stats import assert_mean

from helio_jax.scene.rough import RoughSample, rough_heights, spectrum
from helio_jax.scene.sample import Sample, check_body
from helio_jax.workflows.scene_file import load_scene

XI, N = 8.0, 384
PLAIN = {"kind": "rough", "size_um": 300.0, "rms_um": 2.0, "correlation_length_um": 30.0}


def autocorrelation(r: float, cutoff: float, hurst: float) -> float:
    """Hankel transform of the spectrum: 2 pi integral of W(k) J0(k r) k dk up to the cut-off, for xi = XI."""
    edges = np.concatenate([[0.0], np.geomspace(1e-3, cutoff, 60)])

    def ring(k):
        return 2 * np.pi * k * float(spectrum(np.array(k), cutoff, XI, hurst)) * j0(k * r)

    return sum(quad(ring, a, b, limit=400)[0] for a, b in itertools.pairwise(edges))


@pytest.mark.parametrize("hurst", [0.3, 0.5, 1.0])
def test_spectrum_is_normalised_and_falls_as_a_matern_correlation(hurst):
    """The integral of W is 1 at any cut-off; at a large one its transform is the Matern correlation, exp(-r/xi) at 1/2.

    Catches a (the roll-off) of another cut-off, an exponent of H or 1 + 2 H instead of 1 + H, and a density per |k|
    instead of per area.
    """
    for cutoff in (1.0, 30.0):
        assert autocorrelation(0.0, cutoff, hurst) == pytest.approx(1.0, abs=1e-6)
    for r in (0.5 * XI, 2.0 * XI):
        s = math.sqrt(2 * hurst) * r / XI
        exact = 2 ** (1 - hurst) / gamma(hurst) * s**hurst * kv(hurst, s)
        assert autocorrelation(r, 60.0, hurst) == pytest.approx(exact, abs=0.02)
        if hurst == 0.5:
            assert exact == pytest.approx(math.exp(-r / XI))


def test_surfaces_have_their_spectrum():
    """Over 60 surfaces: rms exact, correlation at three lags along x and y, slope of the spectrum at large k.

    Six standard errors are 1 % of the variance: a correlation length wrong by 5 % and H wrong by 0.05 are rejected.
    Catches axes that differ, a spectrum taken for its root, and a periodic surface (its opposite borders correlate).
    """
    hurst, lags = 0.7, (2, 8, 16)
    found, slopes, borders = [], [], []
    window = np.hanning(N)[:, None] * np.hanning(N)
    k = np.hypot(*np.meshgrid(2 * np.pi * np.fft.fftfreq(N), 2 * np.pi * np.fft.fftfreq(N)))
    ring = (k > 6.0 / XI) & (k < 0.8 * np.pi)
    for seed in range(60):
        h = rough_heights(N, 1.0, 3.0, XI, hurst, seed)
        assert abs(h.mean()) < 1e-12 and np.sqrt(np.mean(h**2)) == pytest.approx(3.0, rel=1e-12)
        found.append([[np.mean(h[:, d:] * h[:, :-d]), np.mean(h[d:] * h[:-d])] for d in lags])
        power = np.abs(np.fft.fft2(h * window))[ring] ** 2
        slopes.append(np.polyfit(np.log(k[ring]), np.log(power), 1)[0])
        borders.append(np.mean(h[:, 0] * h[:, -1]) / 9.0)
    mean, error = np.mean(found, 0) / 9.0, np.std(found, 0, ddof=1) / 9.0 / math.sqrt(60)
    assert error.max() < 0.004
    for i, d in enumerate(lags):
        for axis in range(2):
            assert_mean(mean[i, axis], autocorrelation(d, np.pi, hurst), error[i, axis], f"correlation at {d}")
    expected = np.polyfit(np.log(k[ring]), np.log(spectrum(k, np.pi, XI, hurst)[ring]), 1)[0]
    error = float(np.std(slopes, ddof=1)) / math.sqrt(60)
    assert_mean(float(np.mean(slopes)), expected, error, "slope of the spectrum")
    assert 6 * error < 0.1  # 0.05 in H
    assert abs(np.mean(borders)) < 0.1


def test_seeds_and_geometry():
    """One seed, one surface; the sheet has no hole, its heights are those drawn, a patch lies in the substrate z = 0.

    Catches a seed that is ignored, a patch of another size or resolution, and a leak at its border.
    """
    build = lambda **more: TypeAdapter(Sample).validate_python(PLAIN | more).build()  # noqa: E731
    whole = build()
    assert np.array_equal(whole.vertices, build().vertices)
    assert not np.allclose(whole.vertices[:, 2], build(seed=2).vertices[:, 2])
    assert np.std(whole.vertices[:, 2]) == pytest.approx(2.0) and len(whole.vertices) == 81**2
    patch = build(patch_um=120.0, resolution_um=1.0)
    report = check_body(patch)
    assert report["n_inner_open_edges"] == report["n_faces_without_area"] == 0 and report["is_winding_consistent"]
    x, y, z = patch.vertices.T
    is_flat = np.maximum(abs(x), abs(y)) > 61.0
    assert np.all(z[is_flat] == 0.0) and np.all(patch.bounds[:, :2] == [[-150.0] * 2, [150.0] * 2])
    inner = z[: 121**2]
    assert np.std(inner) == pytest.approx(2.0) and np.ptp(x[: 121**2]) == 120.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patch_um": 400.0}, "patch_um must be <= size_um = 300 um, got 400"),
        ({"resolution_um": 20.0}, "half of correlation_length_um = 30 um, got 20"),
        ({"resolution_um": 0.1}, "0.1 = 3000: set patch_um"),
        ({"hurst": 1.5}, "less than or equal to 1"),
    ],
)
def test_impossible_surfaces_are_refused(change, message):
    """Errors name limit and remedy. Catches a surface that is silently coarser than requested."""
    with pytest.raises(ValidationError, match=message):
        RoughSample.model_validate(PLAIN | change)


def test_validate_warns_of_a_truth_that_the_fit_could_represent():
    """Fewer than 4 points of the surface per pixel are called few. Catches a warning always or never given."""
    scenes = Path(__file__).resolve().parents[2] / "scenes"
    assert load_scene(scenes / "rough.toml").warnings() == []
    (warning,) = load_scene(scenes / "rough.toml", {"scan.pixel_size_um": 15.0}).warnings()
    assert "a point every 4 um" in warning and "sample.resolution_um to at most 3.75 um" in warning
