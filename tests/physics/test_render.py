"""The differentiable render model against the tracer, and its derivative against differences.

The two share no kernel: the tracer follows rays to exact spheres in NumPy and numba, the model evaluates the contour
form factor on quads of corner heights in JAX.
"""

import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import single_scattering
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.shapes import Sphere, SpheresSample
from helio_jax.scene.surfaces import first_hit_spheres
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings

PITCH = 10.0
CAP = Sphere(radius_um=1000.0, cap_height_um=300.0)
"""Seen within 300 um of its axis: no pixel there is masked, shadowed or on the flat."""


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    """Oblique pencil beam along an odd azimuth, three different ellipses, sample away from the working distance."""
    ellipses = (((2300.0, 100.0), 20.0), ((-1200.0, -1900.0), 60.0), ((-1100.0, 2000.0), -40.0))
    return Instrument(
        beam=Beam(incidence_deg=25.0, azimuth_deg=35.0, source="pencil", pinhole_radius_um=0.0),
        plate=Plate(working_distance_um=4000.0, sample_distance_um=4400.0),
        detector=tuple(
            Detector(name=f"{i}", center_um=center, axes_um=(1300.0, 900.0), rotation_deg=turn)
            for i, (center, turn) in enumerate(ellipses)
        ),
    )


def cap(instrument: Instrument, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the true heights [y, x], um, and unit normals [3, y, x] at the beam positions."""
    height, normal = first_hit_spheres(*np.meshgrid(x, y), np.array([CAP.row]), instrument.beam_shift)
    return height, np.moveaxis(normal, -1, 0)


def test_render_is_the_tracers_single_scattering(instrument):
    """Agree to 1e-9 on a cap of 1 mm radius, point by point: both take the spot for a point.

    Rejected wrong models: columns and rows exchanged (several %); the height's near field left out (1 % per 40 um).
    Catches: a wrong near field, sign of the beam shift, exchanged slopes, rotation of the ellipses.
    """
    x = np.arange(-150.0, 151.0, PITCH) + 120.0  # the cap's top is seen downstream of its axis
    y = np.arange(-140.0, 141.0, PITCH) + 80.0
    body = SpheresSample(spheres=(CAP,), size_um=4000.0).build()
    grid_x, grid_y = (g.ravel() for g in np.meshgrid(x, y))
    tally = trace_pixels(make_experiment(body, instrument, TraceSettings(rays=8)), grid_x, grid_y)
    traced = tally.probability()[0][0].reshape(-1, y.size, x.size)
    optics = Optics.of(instrument)
    height, normal = cap(instrument, x, y)
    rendered = single_scattering(form_factor(optics, height), normal)
    mirrored = single_scattering(form_factor(optics, height.T), normal[[1, 0, 2]].swapaxes(1, 2))
    far = single_scattering(form_factor(optics, np.zeros_like(height)), normal)
    assert np.abs(rendered / traced - 1.0).max() < 1e-9
    assert np.abs(mirrored.swapaxes(1, 2) / traced - 1.0).max() > 0.03
    assert np.abs(far / traced - 1.0).max() > 0.03
