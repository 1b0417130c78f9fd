"""Ripples against closed forms: known waves in noise, on tilted planes, in micrographs; noise alone; scan lines."""

import json
import math

import numpy as np
import pytest
from scipy import stats
from stats import assert_likely
from test_measure import PITCH, make_rec

from helio_jax.errors import GuardError, SceneError
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.measure.regions import inside_polygon, parse_region
from helio_jax.measure.ripple import compare_with_images, height_ripple, image_spectra
from helio_jax.measure.spectrum import RippleSettings, make_blocks, take_spectrum, without_trend
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS
from helio_jax.workflows.measure import Wanted, measure_height_map

AXIS = (np.arange(60) - 29.5) * PITCH
TRIANGLE = inside_polygon(parse_region("-450,-450 430,-450 -450,430"), AXIS, AXIS)
WAVELENGTH, ANGLE = 95.0, math.radians(-38.0)
KX, KY = math.cos(ANGLE) / WAVELENGTH, math.sin(ANGLE) / WAVELENGTH


def wave(x, y, phase=0.4):
    return np.cos(2 * np.pi * (KX * x + KY * y) + phase)


def make_stack(response=(0.0, 0.0, 0.0), noise=0.01, seed=1) -> MicrographStack:
    """Three micrographs of signal 1 with a wave of the given factors; apertures at 0 and +-120 deg, 30 deg out."""
    detectors = tuple(
        Detector(name=n, center_um=(1732.0 * math.cos(a), 1732.0 * math.sin(a)), axes_um=(1000.0, 1000.0))
        for n, a in (("forward", 0.0), ("left", 2 * math.pi / 3), ("right", -2 * math.pi / 3))
    )
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=detectors)
    one = wave(*np.meshgrid(AXIS, AXIS))
    image = 1.0 + np.array(response)[:, None, None] * one
    image = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return MicrographStack(image, AXIS, AXIS, instrument, n_rays=1.0)


def surface_response(slope: float) -> tuple[float, ...]:
    """Factors of a wave of the surface: -slope u.d / d_z; d_xy / d_z is 1732 / 3000."""
    return tuple(-slope * 1732.0 / 3000.0 * math.cos(ANGLE - a) for a in (0.0, 2 * math.pi / 3, -2 * math.pi / 3))


def test_wavelength_amplitude_and_errors():
    """A wave of 0.3 um in heights with white noise, 48 seeds: the sum of the squared pulls is chi-square.

    Amplitude: half of crest to trough, corrected for the central difference (0.75 of the slope at 4.75 pixels).
    Catches that correction omitted (6 deviations of each), crest to trough for amplitude, errors wrong by a factor 2.
    """
    pulls = []
    for seed in range(48):
        rec = make_rec(lambda x, y: 0.3 * wave(x, y) + 0.02 * x, n=(60, 60))
        rec = rec.replace(height=rec.height + 0.15 * np.random.default_rng(seed).standard_normal(rec.height.shape))
        found, _, _ = height_ripple(rec, [TRIANGLE])
        assert found.peak_over_floor > 5.0 and found.false_alarm < 0.05
        pulls.append(
            [
                (found.wavelength_um - WAVELENGTH) / found.wavelength_std_um,
                (found.direction_deg - math.degrees(ANGLE)) / found.direction_std_deg,
                (found.amplitude - 0.3) / found.amplitude_std,
            ]
        )
    for name, z in zip(("wavelength", "direction", "amplitude"), np.array(pulls).T, strict=True):
        tail = stats.chi2(48).sf(np.sum(z**2))
        assert_likely(2 * min(tail, 1 - tail), f"pulls of the {name}: {np.sqrt(np.mean(z**2)):.2f} instead of 1")


def test_floating_regions_ripple_too():
    """The ripple of a region whose level floats is measured, that of a masked region is not.

    Catches floating pixels excluded: a crystal whose level is not determined then has no ripple.
    """
    rec = make_rec(lambda x, y: 0.3 * wave(x, y), n=(60, 60), noise=0.01)
    for name in ("floating", "masked in too many detectors"):
        reason = np.full(rec.height.shape, REASONS.index(name))
        unsure = rec.replace(reason=reason, is_valid=np.zeros(rec.height.shape, bool))
        if name == "floating":
            assert height_ripple(unsure, [TRIANGLE])[0].wavelength_um == pytest.approx(WAVELENGTH, rel=0.02)
        else:
            with pytest.raises(GuardError, match="64 or more known pixels"):
                height_ripple(unsure, [TRIANGLE])


def test_noise_alone():
    """White noise in an image, and in slopes of unequal noise, 60 each: false-alarm probability below 0.1 in about 6.

    Fewer are allowed (the probability is an upper limit), but some must be below 0.9. Catches the probability of a
    single wave vector instead of the whole range (below 0.1 in nearly all cases), and a floor too low by 1.5.
    """
    blocks = make_blocks([TRIANGLE], (PITCH, PITCH))
    rng = np.random.default_rng(3)
    for mix in (np.eye(1), np.array([[1.0, 0.5], [0.0, 0.6]])):
        alarms = []
        for _ in range(60):
            noise = np.tensordot(mix, rng.standard_normal((len(mix), 60, 60)), 1)
            fields = [without_trend(field, blocks) for field in noise]
            spectrum = take_spectrum(fields, blocks, RippleSettings())
            alarms.append(spectrum.false_alarm(float(spectrum.ratio[spectrum.is_searched].max())))
        assert_likely(float(stats.binom.sf(np.sum(np.array(alarms) < 0.1) - 1, 60, 0.1)), f"{sorted(alarms)[:8]}")
        assert np.min(alarms) < 0.9


def test_scan_lines_are_no_ripple():
    """Offsets of whole rows, ten times the noise: excluded near the axes; with `along_axes` they are the peak.

    Catches line noise reported as a ripple, and an exclusion that `along_axes` does not lift.
    """
    stack = make_stack(noise=0.01)
    lines = stack.replace(counts=stack.counts + 0.1 * np.random.default_rng(9).standard_normal((3, 60, 1)))

    def strongest(along_axes: bool) -> tuple[float, float]:
        s = image_spectra(lines, [TRIANGLE], RippleSettings(along_axes=along_axes))["forward"]
        i, j = np.unravel_index(np.argmax(np.where(s.is_searched, s.ratio, -1.0)), s.ratio.shape)
        return s.false_alarm(float(s.ratio[i, j])), abs(math.degrees(math.atan2(s.ky[i], s.kx[j])))

    assert strongest(False)[0] > 1e-3
    false_alarm, direction = strongest(True)
    assert false_alarm < 1e-3 and 80.0 < direction < 100.0


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_wave_on_a_tilted_plane_at_oblique_incidence(slope):
    """z = slope x + 0.3 cos(k.x) at 30 deg: wavelength and amplitude of the sample, not of the raster.

    Without noise, to 1 %. Catches the raster's wavelength (19 % too long along x on this slope), and the amplitude
    along the beam taken for that along z.
    """
    rec = make_rec(lambda x, y: slope * x + 0.3 * wave(x, y), n=(60, 60), incidence=30.0)
    inside = inside_polygon(parse_region("-320,-320 320,320"), AXIS, AXIS)
    found, _, _ = height_ripple(rec, [inside])
    assert found.wavelength_um == pytest.approx(WAVELENGTH, rel=0.01)
    assert found.direction_deg == pytest.approx(math.degrees(ANGLE), abs=0.5)
    assert found.amplitude == pytest.approx(0.3, rel=0.03)


def test_micrographs_separate_a_surface_wave_from_others():
    """A wave by the first-order law in all three: agrees, with its height; in one alone: disagrees; in none: not shown.

    The heights have the same wave in all cases. Catches a response without its sign: amplitudes alone do not separate
    albedo (equal factors in all three) from slope.
    """
    found, _, _ = height_ripple(make_rec(lambda x, y: 0.3 * wave(x, y), n=(60, 60), noise=0.01), [TRIANGLE])
    slope = 0.3 * 2 * math.pi / WAVELENGTH
    agrees = compare_with_images(make_stack(surface_response(slope)), found, [TRIANGLE])
    assert "agree with" in agrees.verdict and agrees.misfit > 1e-3
    assert agrees.amplitude_um == pytest.approx(0.3, rel=0.1)
    for response in ((0.0, 0.02, 0.0), (0.02, 0.02, 0.02), tuple(map(abs, surface_response(slope)))):
        assert compare_with_images(make_stack(response), found, [TRIANGLE]).verdict.startswith("NOT")
    assert "do not show" in compare_with_images(make_stack(), found, [TRIANGLE]).verdict
    with pytest.raises(SceneError, match="helio calibrate"):
        compare_with_images(make_stack().replace(n_rays=None), found, [TRIANGLE])


def test_regions():
    """A triangle of 880 um legs has 22 x 44 pixels, two corners are a rectangle; wrong or empty regions are refused."""
    assert TRIANGLE.sum() == pytest.approx(44 * 44 / 2, abs=30) and TRIANGLE[10, 10] and not TRIANGLE[40, 40]
    assert inside_polygon(parse_region("-100,0 100,50"), AXIS, AXIS).sum() == pytest.approx(10 * 2.5, abs=6)
    for text in ("1,2", "1 2 3", "a,b c,d", "1,2 3,4,5", "nan,0 1,1"):
        with pytest.raises(SceneError, match="region is"):
            parse_region(text)
    with pytest.raises(SceneError, match="holds no pixel"):
        inside_polygon(parse_region("9000,0 9100,10"), AXIS, AXIS)
    with pytest.raises(GuardError, match="64 or more known pixels"):
        make_blocks([inside_polygon(parse_region("0,0 100,100"), AXIS, AXIS)], (PITCH, PITCH))


def test_measure_reports_ripples(tmp_path):
    """The record is JSON, the lines hold the numbers, the figure is drawn; options without their measurement fail."""
    rec = make_rec(lambda x, y: 0.3 * wave(x, y), n=(60, 60), noise=0.01)
    wanted = Wanted(ripple=True, regions=("-450,-450 430,-450 -450,430",))
    stack = make_stack(surface_response(0.02))
    found, lines = measure_height_map(rec, wanted, tmp_path / "r.png", stack)
    record = json.loads(json.dumps(found))["ripple"]
    assert record["wavelength_um"] == pytest.approx(WAVELENGTH, rel=0.02) and record["peak_over_floor"] > 5
    assert "agree" in record["micrographs"]["verdict"] and any("95." in line for line in lines)
    assert (tmp_path / "r.png").stat().st_size > 10_000
    for wrong, words in ((Wanted(facets=True, regions=("0,0 9,9",)), "--region"), (Wanted(texture=True), "--stack")):
        with pytest.raises(SceneError, match=words):
            measure_height_map(rec, wrong, None, stack)
