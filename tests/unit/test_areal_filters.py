"""S-filter, L-filter and F-operator against closed forms and a direct sum. Source: ISO 16610-61, ISO 25178-3."""

import math

import numpy as np
import pytest

from helio_jax.measure.areal_filters import Form, form_surface, gaussian_mean

STEPS = (2.0, 3.0)


def grid(ny=241, nx=161):
    """Return positions y, x [um] on a grid whose pitches differ."""
    return np.meshgrid(STEPS[0] * np.arange(ny), STEPS[1] * np.arange(nx), indexing="ij")


def direct_mean(z, nesting):
    """Sum the weights pixel by pixel, exp(-pi r^2 / (alpha L)^2), over the known heights."""
    alpha = 0.4697186393498257
    y, x = grid(*z.shape)
    known, out = np.isfinite(z), np.full(z.shape, np.nan)
    for i, j in np.argwhere(known):
        weight = np.exp(-math.pi * ((x - x[i, j]) ** 2 + (y - y[i, j]) ** 2) / (alpha * nesting) ** 2)[known]
        out[i, j] = np.sum(weight * z[known]) / weight.sum()
    return out


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("angle", [0.0, 50.0, 90.0])
def test_transmission_of_a_plane_wave(ratio, angle):
    """A wave of `ratio` times the nesting index is transmitted by 2^(-1/ratio^2), in every direction: 50 % at 1.

    Catches the profile filter's two passes (25 %), a wrong alpha, and a pitch of the wrong axis.
    """
    y, x = grid()
    nesting = 40.0
    k = 2.0 * math.pi / (ratio * nesting)
    wave = np.cos(k * (math.cos(math.radians(angle)) * x + math.sin(math.radians(angle)) * y))
    inner = (slice(60, -60), slice(45, -45))
    found, true = gaussian_mean(wave, nesting, STEPS)[inner], 2.0 ** (-1.0 / ratio**2) * wave[inner]
    assert np.abs(found - true).max() < 1e-4


def test_wave_at_the_smallest_nesting_index():
    """At three pitches a wave of that length is still transmitted by 50 %; a sampled Gaussian would pass 56 %."""
    wave = np.cos(2.0 * math.pi / 9.0 * grid()[1])
    assert np.abs(gaussian_mean(wave, 9.0, STEPS) - 0.5 * wave)[30:-30, 30:-30].max() < 2e-3


def test_direct_sum_with_gaps():
    """Border and gaps as the direct sum: weights of what is unknown are nil. Catches zeros that count as heights."""
    rng = np.random.default_rng(4)
    y, x = grid(30, 25)
    z = 50.0 + 0.3 * x - 0.2 * y + rng.standard_normal(x.shape)
    z[rng.uniform(size=z.shape) < 0.2] = np.nan
    z[8:15, 5:12] = np.nan
    np.testing.assert_allclose(gaussian_mean(z, 30.0, STEPS), direct_mean(z, 30.0), rtol=1e-6)
    np.testing.assert_allclose(gaussian_mean(np.where(np.isnan(z), z, 7.0), 30.0, STEPS)[np.isfinite(z)], 7.0)


def test_forms():
    """A plane and a paraboloid with gaps are removed exactly; of x^2 a plane leaves x^2 less its mean, no tilt."""
    y, x = grid(40, 41)
    plane, bowl = 3.0 + 0.2 * x - 0.1 * y, 3.0 + 0.2 * x - 0.1 * y + 0.003 * x**2 - 0.002 * x * y + 0.001 * y**2
    pairs: tuple[tuple[Form, np.ndarray], ...] = (("plane", plane), ("quadratic", bowl))
    for form, z in pairs:
        z = np.where((x > 30) & (y < 20), np.nan, z)
        rest = z - form_surface(z, form, STEPS)
        assert np.nanmax(np.abs(rest)) < 1e-9
    square = (x - x.mean()) ** 2
    np.testing.assert_allclose(square - form_surface(square, "plane", STEPS), square - square.mean(), atol=1e-9)
    np.testing.assert_allclose(form_surface(bowl, "none", STEPS), bowl.mean())
