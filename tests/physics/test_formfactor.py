"""Form factors: closed forms and area quadrature, the tracer's (numba) and the reconstruction's (JAX) apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.form_factor import form_factor, form_factor_at
from helio_jax.forward.optics import Optics
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.trace.direct import form_factors


def random_instrument(seed: int) -> Instrument:
    rng = np.random.default_rng(seed)
    detector = Detector(
        name="d", center_um=tuple(rng.uniform(-3000, 3000, 2)), axes_um=tuple(rng.uniform(300, 1800, 2)),
        rotation_deg=float(rng.uniform(-90, 90)),
    )  # fmt: skip
    return Instrument(plate=Plate(working_distance_um=4000.0), detector=(detector,))


def area_quadrature(instrument: Instrument, point: np.ndarray) -> np.ndarray:
    """Integrate cos(theta_d) r / (pi r^3) over the ellipse: Gauss-Legendre in radius, trapezoid in angle."""
    aperture = instrument.apertures()[0]
    node, weight = np.polynomial.legendre.leggauss(60)
    radius, angle = 0.5 * (node + 1), 2 * np.pi * np.arange(240) / 240
    r, s = np.meshgrid(radius, angle, indexing="ij")
    p, q = aperture.semi_axes[0] * r * np.cos(s), aperture.semi_axes[1] * r * np.sin(s)
    c, d = np.cos(aperture.rotation), np.sin(aperture.rotation)
    to = np.stack([aperture.center[0] + c * p - d * q, aperture.center[1] + d * p + c * q, np.full_like(p, 4000.0)], -1)
    to = to - point
    distance = np.linalg.norm(to, axis=-1)
    area = np.prod(aperture.semi_axes) * r * (0.5 * weight)[:, None] * 2 * np.pi / 240
    return np.sum((area * to[..., 2] / distance**4 / np.pi)[..., None] * to, axis=(0, 1))


@pytest.mark.parametrize("seed", range(12))
def test_against_area_quadrature(seed):
    """Both kernels within 1e-9 of the area integral at 1-8 mm; catches a wrong sign, rim order, rotation or 1/pi."""
    instrument = random_instrument(seed)
    rng = np.random.default_rng([seed, 1])
    depth = rng.uniform(1000.0, 8000.0)
    point = np.array([*rng.uniform(-500, 500, 2), 4000.0 - depth])
    exact = area_quadrature(instrument, point)
    ours = form_factors(instrument, point[None])[0, 0]
    assert np.linalg.norm(ours - exact) <= 1e-9 * np.linalg.norm(exact)
    optics = Optics.of(instrument)
    height = -point[2] * -1.0  # normal incidence: the spot stays on the z axis, lab z = height
    on_axis = np.array([0.0, 0.0, height])
    ours = form_factor(optics, np.array([height]))[0, :, 0]
    exact = area_quadrature(instrument, on_axis)
    assert np.linalg.norm(ours - exact) <= 1e-9 * np.linalg.norm(exact)


@pytest.mark.parametrize(("polar", "half"), [(0.0, 5.0), (30.0, 10.0), (60.0, 20.0)])
def test_disc_closed_form(polar, half):
    """|Phi| of a circular cone is sin^2 b along its axis; catches the ellipse of a cone being wrong."""
    detector = Detector(name="c", polar_deg=polar, azimuth_deg=37.0, half_angle_deg=half)
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(detector,))
    phi = form_factors(instrument, np.zeros((1, 3)))[0, 0]
    t, a = np.radians([polar, 37.0])
    axis = np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
    assert np.allclose(phi, np.sin(np.radians(half)) ** 2 * axis, rtol=0, atol=1e-9)


def test_derivative_in_height():
    """The custom derivative agrees with central differences to their order; catches a stale or missing slope."""
    instrument = random_instrument(3).model_copy(update={"beam": Beam(incidence_deg=30.0)})
    optics = Optics.of(instrument)
    with jax.enable_x64(True):
        h = jnp.array([0.0, 300.0, 700.0])
        value, slope = jax.jvp(lambda z: form_factor_at(optics, z), (h,), (jnp.ones(3),))
    central = (form_factor(optics, np.asarray(h) + 0.5) - form_factor(optics, np.asarray(h) - 0.5)) / 1.0
    assert np.allclose(slope, central, rtol=1e-6, atol=1e-12)
    assert np.allclose(value, form_factor(optics, np.asarray(h)))


def test_flat_of_sphere_a_geometry(bshem):
    """480.37 and 390.91 expected counts on the flat, 5 digits; catches a wrong plate, distance or apertures."""
    phi = form_factors(bshem, np.array([bshem.spot_position(0.0)], float))
    assert 35_000 * phi[:, 0, 2] == pytest.approx([480.3705, 390.9079, 390.9079], rel=2e-6)
