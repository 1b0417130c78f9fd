"""Facets that face away from an aperture: what it reads there must not flatten them (linear solution)."""

import numpy as np
import pytest

from helio_jax.inverse.linear import solve_linear

POLAR, LEAN = np.radians(46.0), np.radians(60.0)


@pytest.mark.parametrize("turn_deg", [0.0, 10.0, 20.0, 157.0])
@pytest.mark.parametrize("scattered", [0.0, 0.1])
def test_steep_facet_keeps_its_slope(turn_deg, scattered):
    """A face of 60 deg by five turned apertures, one or two of them below its horizon, found within half a degree.

    These read 0, or multiple scattering, where n . Phi is negative. Catches least squares over all images (9 to 21
    degrees too flat). The bound allows for the weight that is left to them.
    """
    azimuth = np.radians(np.arange(0.0, 360.0, 72.0))
    phi = np.stack([np.sin(POLAR) * np.cos(azimuth), np.sin(POLAR) * np.sin(azimuth), np.full(5, np.cos(POLAR))], -1)
    turn = np.radians(turn_deg)
    normal = np.array([np.sin(LEAN) * np.cos(turn), np.sin(LEAN) * np.sin(turn), np.cos(LEAN)])
    cosine = phi @ normal
    assert np.sum(cosine < 0) >= 1  # or the test tests nothing
    signal = np.where(cosine > 0, cosine, scattered)[:, None, None]
    found = solve_linear(signal, np.full((5, 1, 1), 0.02**2), phi[:, :, None, None])
    assert np.degrees(np.arccos(found.normals[0, 0] @ normal)) < 0.5


def test_three_images_keep_them():
    """With three images the normal is solved from all of them, as ever: the equations are met exactly."""
    azimuth = np.radians([0.0, 120.0, 240.0])
    phi = np.stack([np.sin(POLAR) * np.cos(azimuth), np.sin(POLAR) * np.sin(azimuth), np.full(3, np.cos(POLAR))], -1)
    signal = np.array([0.9, 0.5, 0.05])[:, None, None]
    found = solve_linear(signal, np.full((3, 1, 1), 0.02**2), phi[:, :, None, None])
    assert np.allclose(phi @ found.normals[0, 0] * found.albedo[0, 0], signal[:, 0, 0], atol=1e-6)
