"""The sentences of helio_jax/arrays.py that concern the beam frame and the raster, one test each."""

import math

import numpy as np
import pytest

from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.scan import Raster
from helio_jax.scene.surfaces import first_hit_spheres


def make_instrument(azimuth=0.0) -> Instrument:
    return Instrument(
        beam=Beam(incidence_deg=30.0, azimuth_deg=azimuth),
        plate=Plate(working_distance_um=4000.0, sample_distance_um=4720.0),
        detector=(Detector(name="a", polar_deg=30.0, half_angle_deg=9.0),),
    )


def test_surface_point_lies_upstream_of_its_raster_position():
    """A point of height h seen at X lies at X - h tan t: upstream for h > 0; the y of a beam along x is untouched.

    Catches: + h tan t, or x and y exchanged.
    """
    x, y = make_instrument().surface_position(1000.0, 50.0, 100.0)
    assert x == pytest.approx(1000.0 - 100.0 * math.tan(math.radians(30.0))) and y == 50.0
    x, y = make_instrument(azimuth=90.0).surface_position(1000.0, 50.0, 100.0)
    assert x == pytest.approx(1000.0) and y == pytest.approx(50.0 - 100.0 * math.tan(math.radians(30.0)))


def test_height_goes_up_towards_the_plate():
    """A higher point is nearer to the plate in the lab frame. Catches: depth for height."""
    low, high = (make_instrument().spot_position(h)[2] for h in (0.0, 100.0))
    assert high - low == pytest.approx(100.0) and high < 4000.0


def test_bump_at_plus_x_plus_y_appears_there():
    """A sphere at (+1000, +500) is seen in the upper right quarter of a raster drawn origin lower.

    Catches: exchanged axes, rows counted downwards.
    """
    x, y = Raster(nx=41, ny=21, pixel_size_um=100.0).positions(Beam(incidence_deg=30.0))
    shift = make_instrument().beam_shift
    height, _ = first_hit_spheres(x[None, :], y[:, None], np.array([[1000.0, 500.0, 0.0, 150.0]]), shift)
    assert height.shape == (21, 41)
    row, column = np.unravel_index(np.argmax(height), height.shape)
    assert y[row] == pytest.approx(500.0, abs=51) and 1000.0 < x[column] < 1150.0


@pytest.mark.parametrize("azimuth", [0.0, 40.0])
def test_slopes_per_pixel(azimuth):
    """On a plane, dh/dX = p / (1 + p tx + q ty) for p = dz/dx, q = dz/dy (tx, ty: the beam shift), also for dh/dY.

    Formula: h = p (X - h tx) + q (Y - h ty). Catches: 1 - p tan t.
    """
    instrument, p, q = make_instrument(azimuth), 0.3, -0.2
    tx, ty = instrument.beam_shift
    slope = np.array([p, q]) / (1.0 + p * tx + q * ty)
    X, Y = 700.0, -300.0
    h = slope @ [X, Y]
    x, y = instrument.surface_position(X, Y, h)
    assert h == pytest.approx(p * x + q * y)


def test_beam_pitch_is_stretched_along_the_beam():
    """`beam` pitch: pixel / cos t along the beam's azimuth only; `sample`: equal.

    Catches: multiplied by cos t, stretched across the beam, stretched at azimuth 90 along x.
    """
    step = lambda axis: float(np.diff(axis).mean())  # noqa: E731
    for azimuth, pitch, expected in (
        (0.0, "beam", (11.547, 10.0)),
        (180.0, "beam", (11.547, 10.0)),
        (90.0, "beam", (10.0, 11.547)),
        (-90.0, "beam", (10.0, 11.547)),
        (33.0, "sample", (10.0, 10.0)),
    ):
        raster = Raster(nx=4, ny=3, pixel_size_um=10.0, pitch=pitch)
        x, y = raster.positions(Beam(incidence_deg=30.0, azimuth_deg=azimuth))
        assert (step(x), step(y)) == pytest.approx(expected, abs=1e-3)
        assert x.size == 4 and y.size == 3 and x.mean() == pytest.approx(0.0) and y[1] == 0.0
