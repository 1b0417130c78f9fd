"""Apertures and frames of the instrument: closed forms only."""

import math

import numpy as np
import pytest

from helio_jax.detector import Aperture, Detector, cone_ellipse
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.instrument import POLAR_STD_DEG, Beam, Instrument, Plate, Uncertainty


def make_instrument(incidence=30.0, azimuth=0.0, sample_distance=4720.0) -> Instrument:
    return Instrument(
        beam=Beam(incidence_deg=incidence, azimuth_deg=azimuth),
        plate=Plate(working_distance_um=4000.0, sample_distance_um=sample_distance),
        detector=(Detector(name="a", polar_deg=30.0, azimuth_deg=40.0, half_angle_deg=9.0),),
    )


@pytest.mark.parametrize(("polar", "azimuth", "half"), [(0.0, 0.0, 20.0), (30.0, 120.0, 9.0), (60.0, -75.0, 15.0)])
def test_cone_ellipse_is_seen_under_half_angle(polar, azimuth, half):
    """Every rim point makes exactly the half-angle with the cone's axis, seen from the nominal spot.

    Catches: the cone's axis taken through the ellipse's centre, minor axis D tan(half), full for semi-axes.
    """
    p, a, h = map(math.radians, (polar, azimuth, half))
    rim = cone_ellipse(p, a, h, 4000.0).rim(97)[0]
    axis = np.array([math.sin(p) * math.cos(a), math.sin(p) * math.sin(a), math.cos(p)])
    r = np.column_stack([rim, np.full(len(rim), 4000.0)])
    angle = np.arccos(r @ axis / np.linalg.norm(r, axis=1))
    np.testing.assert_allclose(angle, h, rtol=0, atol=1e-12)


def test_rim_is_counter_clockwise_and_tangent():
    """The rim's signed area is +pi a b and its tangents are the derivative of its positions.

    Catches: a clockwise rim (Phi would change sign), tangents of the unrotated ellipse, full axes used as semi-axes.
    """
    aperture = Aperture((100.0, -50.0), (692.8, 600.0), math.radians(60.0))
    points, tangents = aperture.rim(64)
    r = points - aperture.center
    area = 0.5 * np.sum(r[:, 0] * tangents[:, 1] - r[:, 1] * tangents[:, 0]) * 2 * np.pi / 64
    assert area == pytest.approx(np.pi * 692.8 * 600.0, rel=1e-12)
    np.testing.assert_allclose(points.mean(0), aperture.center, atol=1e-9)
    spectrum = np.fft.fft(points, axis=0) * (1j * np.fft.fftfreq(64, 1 / 64))[:, None]
    np.testing.assert_allclose(np.fft.ifft(spectrum, axis=0).real, tangents, atol=1e-9)


def test_rotation_turns_first_axis_counter_clockwise():
    """With rotation +90 deg the first (long) axis lies along +y, at parameter zero.

    Catches: rotation with the wrong sign or about x.
    """
    points = Aperture((0.0, 0.0), (3.0, 1.0), math.pi / 2).rim(4)[0]
    np.testing.assert_allclose(points[0], [0.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(points[1], [-1.0, 0.0], atol=1e-12)
    tilted = Aperture((0.0, 0.0), (3.0, 1.0), math.radians(30.0)).rim(4)[0]
    assert tilted[0, 0] > 0 and tilted[0, 1] > 0


def test_full_axes_are_halved():
    """`axes_um` are full axes. Catches: apertures four times too large."""
    detector = Detector(name="d", center_um=(2309.4, 0.0), axes_um=(1385.6, 1200.0))
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(detector,))
    rim = instrument.apertures()[0].rim(4)[0]
    np.testing.assert_allclose(np.ptp(rim, axis=0), [1385.6, 1200.0], rtol=1e-12)


@pytest.mark.parametrize("azimuth", [0.0, 35.0, 90.0, 180.0])
def test_beam_runs_from_pinhole_to_spot(azimuth):
    """The beam axis goes from the pinhole through the lab origin, and a raster point lies on it.

    Catches: the pinhole on the wrong side, spot_position without the height, azimuth ignored.
    """
    instrument = make_instrument(azimuth=azimuth)
    u, pinhole = instrument.beam_direction, instrument.pinhole_center
    np.testing.assert_allclose(pinhole + u * np.linalg.norm(pinhole), 0.0, atol=1e-9)
    for height in (0.0, 720.0, -100.0):
        spot = np.array(instrument.spot_position(height))
        assert np.linalg.norm(np.cross(spot - pinhole, u)) < 1e-9
        assert spot[2] == pytest.approx(height - 720.0)


def test_sample_and_lab_frames_agree():
    """surface_position = spot_position + sample_origin for any raster position and height.

    Catches: a drop of D instead of D - W, or a shift of the wrong sign in one of the three.
    """
    instrument = make_instrument(azimuth=25.0)
    x, y, height = 123.0, -456.0, 310.0
    lab = np.array(instrument.spot_position(height))
    origin = np.array(instrument.sample_origin(x, y))
    expected = [*instrument.surface_position(x, y, height), height]
    np.testing.assert_allclose(lab + origin, expected, atol=1e-9)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"center_um": (0, 0)},
        {"polar_deg": 3},
        {"center_um": (0, 0), "axes_um": (1, 1), "polar_deg": 3},
        {"polar_deg": 3, "half_angle_deg": 4, "rotation_deg": 0},
        {"center_um": (0, 0), "axes_um": (1, 0)},
        {"polar_deg": 80, "half_angle_deg": 10},
    ],
)
def test_detector_refuses_mixtures(keys):
    """A detector is an ellipse or a cone that meets the plate. Catches: half-given apertures that pass silently."""
    with pytest.raises(ValueError, match="detector 'd'"):
        Detector(name="d", **keys)


@pytest.mark.parametrize("sample_distance", [4000.0, 4720.0])
def test_directions_are_those_of_the_form_factor(sample_distance):
    """From the spot on the substrate to a small aperture: the form factor's direction, to its size squared.

    Catches directions from the origin, which the beam meets at the working distance only.
    """
    wide = make_instrument(sample_distance=sample_distance)
    small = wide.model_copy(update={"detector": (wide.detector[0].model_copy(update={"half_angle_deg": 0.5}),)})
    phi = form_factor(Optics.of(small), np.zeros((1, 1)))[0, :, 0, 0]
    np.testing.assert_allclose(small.directions()[0], phi[:2] / phi[2], atol=2e-4)


def test_prior_of_polar_angles_for_a_calibration():
    """The stated uncertainty, else the default. Catches a calibration that ignores what the instrument file states."""
    detector = (Detector(name="d", polar_deg=30.0, half_angle_deg=5.0),)
    plate = Plate(working_distance_um=3000.0)
    assert Instrument(plate=plate, detector=detector).polar_std_deg == POLAR_STD_DEG
    stated = Instrument(plate=plate, detector=detector, uncertainty=Uncertainty(polar_deg=2.0))
    assert stated.polar_std_deg == 2.0
