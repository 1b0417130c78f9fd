"""Areal surface texture (ISO 25178-2) against closed forms, direct sums and known errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

import helio_jax as hx
from helio_jax.errors import GuardError, SceneError
from helio_jax.measure.autocorrelation import autocorrelation, decay_lengths
from helio_jax.measure.material_ratio import material_ratio_parameters
from helio_jax.measure.sample_surface import FLAGS, sample_surface
from helio_jax.measure.texture_parameters import PARAMETERS, texture_parameters
from tests.height_maps import make_rec

EXACT = 1e-3
"""Largest relative error against a closed form."""


def height_map(z, step=1.0, **fields) -> hx.HeightMap:
    """Put heights on a square grid."""
    return hx.HeightMap(z, step * np.arange(z.shape[1]), step * np.arange(z.shape[0]), **fields)


def middles(low, high, n):
    """Return the middles of n equal parts."""
    return low + (high - low) * (np.arange(n) + 0.5) / n


def test_sine():
    """z = a cos(kx): Sa = 2a/pi, Sq = a/sqrt 2, Ssk = 0, Sku = 3/2, Sp = Sv = a, Sdq = ak/sqrt 2, Sdr by elliptic
    integral. Catches excess kurtosis, peak to valley for a peak, slopes of half the step, Sdr as a ratio of 1."""
    a, n = 7.0, 4000
    x = middles(0.0, 400.0, n)
    z = np.broadcast_to(a * np.cos(2 * math.pi * x / 100.0), (60, n))
    found = hx.measure_texture(hx.HeightMap(z, x, 0.1 * np.arange(60)), form="none")
    k = 2 * math.pi / 100.0
    length = integrate.quad(lambda t: math.sqrt(1 + (a * k * math.sin(k * t)) ** 2), 0, 100)[0] / 100.0
    true = {"Sa": 2 * a / math.pi, "Sq": a / math.sqrt(2), "Sku": 1.5, "Sp": a, "Sv": a, "Sz": 2 * a}
    true |= {"Sdq": a * k / math.sqrt(2), "Sdr": 100 * (length - 1)}
    for name, value in true.items():
        assert getattr(found, name) == pytest.approx(value, rel=EXACT), name
    assert abs(found.Ssk) < 1e-9


def test_plane_waves():
    """Two crossed waves a cos(kx) + b cos(my): squares of Sq and Sdq add up. Catches slopes of one axis only."""
    x = middles(0.0, 300.0, 1500)
    a, b, k, m = 3.0, 2.0, 2 * math.pi / 100.0, 2 * math.pi / 60.0
    z = a * np.cos(k * x)[None, :] + b * np.cos(m * x)[:, None]
    found = hx.measure_texture(hx.HeightMap(z, x, x), form="none")
    assert found.Sq == pytest.approx(math.sqrt((a**2 + b**2) / 2), rel=EXACT)
    assert found.Sdq == pytest.approx(math.sqrt(((a * k) ** 2 + (b * m) ** 2) / 2), rel=EXACT)
    sku = (1.5 * a**4 + 6 * a**2 * b**2 + 1.5 * b**4) / (a**2 + b**2) ** 2
    assert found.Sku == pytest.approx(sku, rel=EXACT)


def test_half_cylinder():
    """z = sqrt(R^2 - x^2), |x| < R: mean pi R / 4, Sq = R sqrt(2/3 - pi^2/16); over |x| < R/2 the area is the arc's."""
    r, n, y = 50.0, 4001, 0.05 * np.arange(40)
    x = middles(-r, r, n)
    found = hx.measure_texture(hx.HeightMap(np.tile(np.sqrt(r**2 - x**2), (40, 1)), x, y), form="none")
    mean = math.pi * r / 4
    cross = math.sqrt(r**2 - mean**2)
    under = lambda t: t * math.sqrt(r**2 - t**2) / 2 + r**2 / 2 * math.asin(t / r)  # noqa: E731
    true = {"Sq": r * math.sqrt(2 / 3 - math.pi**2 / 16), "Sp": r - mean, "Sa": 2 * (under(cross) - mean * cross) / r}
    for name, value in true.items():
        assert getattr(found, name) == pytest.approx(value, rel=EXACT), name
    third = integrate.quad(lambda t: (math.sqrt(r**2 - t**2) - mean) ** 3, -r, r)[0] / (2 * r)
    assert found.Ssk == pytest.approx(third / true["Sq"] ** 3, rel=EXACT)
    x = np.linspace(-r / 2, r / 2, n)
    found = hx.measure_texture(hx.HeightMap(np.tile(np.sqrt(r**2 - x**2), (40, 1)), x, y))
    assert found.Sdr == pytest.approx(100 * (2 * math.asin(0.5) - 1), rel=EXACT)


def test_roof_on_a_tilted_plane():
    """Slopes +-0.5 on a plane of slope 0.3: the F-operator removes the plane, Sdr = sqrt(1.25) - 1, Sdq = 0.5."""
    x = np.arange(-100.0, 101.0)
    found = hx.measure_texture(hx.HeightMap(0.5 * np.abs(x)[None, :] + 0.3 * x[:, None], x, x))
    assert found.Sdr == pytest.approx(100 * (math.sqrt(1.25) - 1), rel=1e-9) and found.Sdq == pytest.approx(0.5)
    flat = hx.measure_texture(hx.HeightMap(0.5 * x[None, :] + 0.3 * x[:, None], x, x))
    assert flat.Sq < 1e-9 and flat.Sdr < 1e-9


def core(quantile, low):
    """Return the ends of the least-squares line of a curve over low to low + 0.4, and its Spk, Svk, Smr1, Smr2."""
    t = lambda m: m - low - 0.2  # noqa: E731
    mean = integrate.quad(quantile, low, low + 0.4)[0] / 0.4
    slope = integrate.quad(lambda m: t(m) * quantile(m), low, low + 0.4)[0] / (0.4**3 / 12)
    return mean + slope * t(0.0), mean + slope * t(1.0)


def test_core_of_gaussian_heights():
    """Gaussian heights: the core lies from 30 to 70 %; Spk and Svk from the tails' closed form.

    Catches the secant for the line (Sk 2.62 Sq in place of 2.57), and areas that are not doubled.
    """
    n, sigma = 400_000, 3.0
    z = sigma * stats.norm.ppf((np.arange(n) + 0.5) / n)
    found = material_ratio_parameters(np.random.default_rng(0).permutation(z))
    upper, lower = core(lambda m: -sigma * stats.norm.ppf(m), 0.3)
    u = upper / sigma
    tail = stats.norm.sf(u)
    spk = 2 * sigma * (stats.norm.pdf(u) - u * tail) / tail
    true = {"Sk": upper - lower, "Spk": spk, "Svk": spk, "Smr1": 100 * tail, "Smr2": 100 * (1 - tail)}
    for name, value in true.items():
        assert found[name] == pytest.approx(value, rel=EXACT), name
    heights = texture_parameters(np.random.default_rng(0).permutation(z).reshape(400, 1000), (1.0, 1.0))
    assert heights["Sa"] == pytest.approx(sigma * math.sqrt(2 / math.pi), rel=EXACT)
    assert heights["Sku"] == pytest.approx(3.0, rel=EXACT) and abs(heights["Ssk"]) < 1e-9


def test_core_of_a_sawtooth():
    """Uniform heights: the curve is its own line, so that Sk is the whole height, Spk = Svk = 0, Smr 0 and 100 %."""
    z = np.tile(middles(0.0, 8.0, 2000), (50, 1))
    found = hx.measure_texture(height_map(z), form="none")
    assert found.Sk == pytest.approx(8.0, rel=EXACT) and found.Sku == pytest.approx(1.8, rel=EXACT)
    assert abs(found.Spk) < 1e-2 and abs(found.Svk) < 1e-2 and found.Smr1 < 0.1 and found.Smr2 > 99.9


def test_core_of_a_plateau_with_deep_dales():
    """Heights 5 ln(1 - m), a plateau with dales: the core begins at 0 %. Catches peaks and dales exchanged."""
    m = middles(0.0, 1.0, 400_000)
    found = material_ratio_parameters(5.0 * np.log(1.0 - m))
    upper, lower = core(lambda s: 5.0 * math.log(1.0 - s), 0.0)
    smr2 = 1.0 - math.exp(lower / 5.0)
    assert found["Sk"] == pytest.approx(upper - lower, rel=EXACT)
    assert found["Smr2"] == pytest.approx(100 * smr2, rel=EXACT)
    assert found["Svk"] == pytest.approx(2 * 5.0, rel=EXACT)  # what lies below a level is exponential, too
    assert found["Spk"] < 0.1 * found["Svk"]


def test_autocorrelation_is_that_of_pairs():
    """Mean product of all pairs at each lag, with gaps, over the mean square. Catches wrap-around, gaps as zeros."""
    rng = np.random.default_rng(7)
    z = rng.standard_normal((9, 12))
    z[rng.uniform(size=z.shape) < 0.15] = np.nan
    found = autocorrelation(z)
    assert found.shape == (9, 13)
    for dy in range(-4, 5):
        for dx in range(-6, 7):
            products = [
                z[i, j] * z[i + dy, j + dx]
                for i in range(9)
                for j in range(12)
                if 0 <= i + dy < 9 and 0 <= j + dx < 12 and np.isfinite(z[i, j] + z[i + dy, j + dx])
            ]
            assert found[dy + 4, dx + 6] == pytest.approx(np.mean(products) / np.nanmean(z**2), rel=1e-9)


@pytest.mark.parametrize("turn", [0.0, 27.3, 90.0])
def test_decay_lengths_of_a_gaussian(turn):
    """exp(-(u/l)^2 - (v/m)^2), turned: Sal = l sqrt(ln 5), Str = l/m. Catches 1/e for 0.2, one pitch for both."""
    steps, l, m = (2.0, 3.0), 20.0, 55.0
    y, x = np.meshgrid(steps[0] * np.arange(-80, 81), steps[1] * np.arange(-60, 61), indexing="ij")
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    found = decay_lengths(np.exp(-(((c * x + s * y) / l) ** 2) - ((c * y - s * x) / m) ** 2), steps)
    assert found["Sal"] == pytest.approx(l * math.sqrt(math.log(5)), rel=EXACT)
    assert found["Str"] == pytest.approx(l / m, rel=EXACT)


def correlated(shape, lengths, seed=2):
    """Draw a random surface of mean square 1 whose autocorrelation is exp(-(x/lx)^2 - (y/ly)^2)."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    f = [np.fft.fftfreq(n) for n in shape]
    power = np.exp(-((math.pi * lengths[0] * f[0][:, None]) ** 2) - (math.pi * lengths[1] * f[1]) ** 2)
    z = np.fft.ifft2(np.fft.fft2(noise) * np.sqrt(power)).real
    return z / z.std()


def test_correlated_surfaces():
    """Sal and Str of random surfaces, isotropic and 1 : 4, within the statistics of 400 and more correlation areas."""
    same = hx.measure_texture(height_map(correlated((512, 512), (10.0, 10.0))))
    assert same.Sal == pytest.approx(10.0 * math.sqrt(math.log(5)), rel=0.05) and same.Str > 0.85
    long = hx.measure_texture(height_map(correlated((512, 512), (8.0, 32.0))))
    assert long.Sal == pytest.approx(8.0 * math.sqrt(math.log(5)), rel=0.07)
    assert long.Str == pytest.approx(0.25, rel=0.15)


def test_ridges_have_no_aspect_ratio():
    """Endless ridges do not decay along themselves: Str is not defined; Sal = arccos(0.2)/k across them."""
    x = middles(0.0, 2000.0, 2000)
    found = hx.measure_texture(height_map(np.tile(np.cos(2 * math.pi * x / 50.0), (200, 1))), form="none")
    assert math.isnan(found.Str) and found.Sal == pytest.approx(math.acos(0.2) * 50.0 / (2 * math.pi), rel=5e-3)


def test_filters_select_waves():
    """Waves of 10, 40 and 400 um: an S-filter of 20 um and an L-filter of 130 um leave the middle one.

    Its amplitude is changed by the two transmissions in closed form. Catches exchanged filters and L before S.
    """
    x = np.arange(0.0, 1200.0, 2.0)
    wave = lambda w: np.cos(2 * math.pi * x / w)  # noqa: E731
    z = np.tile(3.0 * wave(10.0) + 5.0 * wave(40.0) + 20.0 * wave(400.0), (600, 1))
    found = hx.measure_texture(height_map(z, 2.0), s_filter_um=20.0, l_filter_um=130.0)
    left = 5.0 * 2.0 ** (-((20 / 40) ** 2)) * (1 - 2.0 ** (-((130 / 40) ** 2)))
    short, long = 3.0 * 2.0**-4, 20.0 * (1 - 2.0 ** (-((130 / 400) ** 2))) * 2.0 ** (-((20 / 400) ** 2))
    assert found.Sq == pytest.approx(math.sqrt((left**2 + short**2 + long**2) / 2), rel=0.01)  # the border adds a bit
    assert found.surface == "S-L surface" and hx.measure_texture(height_map(z, 2.0)).surface == "S-F surface"


def test_invalid_heights_are_left_out():
    """Heights of 1e6 um that are not valid change nothing; the share of the valid ones is stated."""
    rec = make_rec(lambda x, y: 5.0 * np.cos(x / 60.0) * np.cos(y / 80.0))
    is_valid = np.random.default_rng(1).uniform(size=rec.height.shape) < 0.8
    is_valid[[0, -1], [0, -1]] = True
    spoilt = rec.replace(is_valid=is_valid, height=np.where(is_valid, rec.height, 1e6))
    found, whole = hx.measure_texture(spoilt, form="none"), hx.measure_texture(rec, form="none")
    assert found.share == pytest.approx(is_valid.mean()) and found.n_pixels == is_valid.sum()
    for name in ("Sa", "Sq", "Sal", "Sk", "Sdq"):
        assert getattr(found, name) == pytest.approx(getattr(whole, name), rel=0.05), name


def test_correlated_errors_give_the_standard_deviation():
    """Errors that scale all heights by 3 % move Sq by 3 %; independent ones of the same size would by 0.03 %.

    Catches errors taken as independent although samples of them exist, and says which were used.
    """
    rec = make_rec(lambda x, y: 20.0 * np.cos(x / 60.0) * np.cos(y / 80.0))
    c = 0.03 * np.array([1.0, -1.0, 0.5, -1.5, 0.8])
    samples = c[:, None, None] * rec.height
    rec = replace(rec, height_samples=samples, height_std=np.sqrt(np.mean(samples**2, axis=0)))
    found = hx.measure_texture(rec, form="none")
    rms = math.sqrt(np.mean(c**2))
    for name in ("Sq", "Sa", "Sz", "Sdq", "Sk"):
        p = found.parameters[name]
        assert p.std == pytest.approx(rms * p.value, rel=1e-2), name
    assert found.parameters["Ssk"].std < 1e-9 and "5 posterior samples" in found.errors
    alone = hx.measure_texture(replace(rec, height_samples=None), form="none")
    assert "independent" in alone.errors and alone.parameters["Sq"].std < 0.1 * found.parameters["Sq"].std
    none = hx.measure_texture(replace(rec, height_samples=None, height_std=None))
    assert math.isnan(none.parameters["Sq"].std) and math.isnan(none.parameters["Sq"].noise_bias)


def test_noise_bias():
    """White noise of 1 um on a correlated surface of 3 um: Sq^2 is 1 um^2 too large, and right when it is subtracted.

    Catches a bias of the wrong sign, and one subtracted from Sq in place of its square.
    """
    rng, shape = np.random.default_rng(5), (160, 160)
    true = 3.0 * correlated(shape, (12.0, 12.0), seed=9)
    noisy = height_map(true + rng.standard_normal(shape), height_std=np.ones(shape))
    clean, plain = hx.measure_texture(height_map(true)), hx.measure_texture(noisy)
    better = hx.measure_texture(noisy, subtract_noise=True)
    for name, rel in {"Sq": 0.005, "Sa": 0.005, "Sk": 0.02, "Sdq": 0.03}.items():
        assert getattr(better, name) == pytest.approx(getattr(clean, name), rel=rel), name
        assert getattr(plain, name) > 1.04 * getattr(clean, name)
        p = plain.parameters[name]
        assert p.value - p.noise_bias == pytest.approx(better.parameters[name].value)


@pytest.mark.parametrize("incidence", [30.0, 45.0])
def test_oblique_beam_is_measured_in_the_sample_frame(incidence):
    """A sine along x seen by an oblique beam: height and Sdq of the surface, not of its sheared view.

    A common error d of the beam's heights moves the surface along the beam: by d (1 + p tan t) at a fixed x. Catches
    slopes of the raster (Sdq 8 % off at 45 deg), and errors that stay on the raster.
    """
    a, k = 18.0, 2 * math.pi / 400.0
    rec = make_rec(lambda x, y: a * np.cos(k * x), n=(21, 301), incidence=incidence, pitch=5.0)
    rec = rec.replace(height_samples=np.stack([np.full(rec.height.shape, d) for d in (0.5, -1.0)]))
    surface = sample_surface(rec)
    assert surface.height_samples is not None
    assert "sample frame" in surface.how and "sample frame" in hx.measure_texture(rec).grid
    inner = np.abs(surface.x) <= 600.0  # three waves
    x, height = surface.x[inner], surface.height[:, inner]
    np.testing.assert_allclose(height, np.tile(a * np.cos(k * x), (21, 1)), atol=0.02)
    part = texture_parameters(height - height.mean(), surface.steps)
    assert part["Sdq"] == pytest.approx(a * k / math.sqrt(2), rel=2e-3)
    tan = rec.instrument.beam_shift[0]
    moved = 0.5 * (1.0 - a * k * np.sin(k * x) * tan)
    assert np.ptp(moved) > 0.1
    np.testing.assert_allclose(surface.height_samples[0][:, inner], np.tile(moved, (21, 1)), atol=0.015)
    np.testing.assert_allclose(surface.height_samples[1], -2.0 * surface.height_samples[0], atol=1e-9)


def test_flags_of_an_oblique_view():
    """Behind a wall the surface is not seen; a pixel that is not valid keeps its reason."""
    rec = make_rec(lambda x, y: 60.0 * (np.abs(x) < 100), n=(31, 101), incidence=30.0)
    is_valid = np.ones(rec.height.shape, bool)
    is_valid[:, 80:90] = False
    rec = rec.replace(is_valid=is_valid, reason=np.where(is_valid, 0, 2))
    surface = sample_surface(rec)
    seen = {FLAGS[f] for f in np.unique(surface.flag)}
    assert "masked in too many detectors" in seen and "valid" in seen
    assert np.all((surface.flag == 0) == np.isfinite(surface.height))


def test_refusals():
    """Too few heights, nesting indices that do not fit, misspelt settings."""
    rec = make_rec(lambda x, y: 0.01 * x**2)
    with pytest.raises(GuardError, match="100 or more valid heights, got 0"):
        hx.measure_texture(rec, region=np.zeros(rec.height.shape, bool))
    for changes, words in (
        ({"s_filter_um": 30.0}, "at least 3 pitches of 20 um, got 30"),
        ({"l_filter_um": 9000.0}, "shorter side of the field, 2000 um"),
        ({"s_filter_um": 300.0, "l_filter_um": 200.0}, "no waves would be left"),
        ({"l_fitler_um": 200.0}, "did you mean 'l_filter_um'"),
        ({"form": "cubic"}, "form"),
    ):
        with pytest.raises(SceneError, match=words):
            hx.measure_texture(rec, **changes)
    with pytest.raises(SceneError, match="has its grid already"):
        hx.measure_texture(height_map(np.zeros((30, 30))), grid_um=2.0)
    with pytest.raises(AttributeError, match="its parameters are Sa, Sq"):
        hx.measure_texture(rec).Sxx  # noqa: B018
    assert PARAMETERS.keys() == hx.measure_texture(rec).as_dict()["parameters"].keys()
