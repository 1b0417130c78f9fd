"""Slopes that `surface_of_heights` estimates from heights alone, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx

STEP = 10.0
X = STEP * np.arange(-20, 21.0)
GX, GY = np.meshgrid(X, X[:31])
RASTER = hx.Raster(jnp.asarray(X), jnp.asarray(X[:31]))


def slopes(height):
    """Slopes [2, y, x] of heights [y, x] in double precision."""
    with jax.enable_x64():
        surface = hx.surface_of_heights(jnp.asarray(height, jnp.float64), RASTER)
        return np.stack([np.asarray(surface.slope_x), np.asarray(surface.slope_y)])


@pytest.mark.parametrize(("width", "most"), [(2.75, 0.04), (2.0, 0.12)])
def test_shoulders_of_a_steep_hill(width, most):
    """Gaussian that is 0.8 steep, its top at a pixel or, 0.01 less exact, between two; `width`: its standard deviation
    in pixels.

    A limiter between the two one-sided differences takes the flatter one at the shoulders: up to 0.3 too flat.
    """
    w = width * STEP
    top = 0.83 * np.exp(0.5) * w
    for place in (0.0, *PLACES):
        x, y = GX - place, GY + 50
        height = top * np.exp(-0.5 * (x**2 + y**2) / w**2)
        true = np.stack([-x, -y]) / w**2 * height
        assert np.abs(true).max() > 0.8
        assert np.abs(slopes(height) - true).max() < most + 0.01 * (place > 0.0)


@pytest.mark.parametrize(
    ("height", "slope"),
    [(0.2 * np.abs(GX - 3.0), 0.2 * np.sign(GX - 3.0)), (2.0 * (GX > 5.0), 0.0), (5.0 * (GX > 5.0), 0.0)],
)
def test_weak_kinks_and_steps_blur(height, slope):
    """By no more than 0.1 in slope, where the vertex is well between two pixels."""
    assert np.abs(slopes(height)[0] - slope).max() < 0.1


PLACES = np.arange(0.5, STEP)
"""Of a vertex or a top, between two pixels."""


@pytest.mark.parametrize("change", [0.2, 1.0])
def test_kinks_blur(change):
    """By no more than half of the change of slope, wherever the vertex is, and at one pixel only."""
    for place in PLACES:
        x = GX - place
        off = np.abs(slopes(change * np.maximum(x, 0.0))[0] - change * (x > 0.0))[0]
        assert off.max() < 0.5 * change and np.sort(off)[-2] < 0.35 * change


@pytest.mark.parametrize(("depth", "most"), [(0.2, 0.1), (0.5, 0.04), (2.0, 0.01)])
def test_steps_blur(depth, most):
    """By no more than the docstring says; depth in pixels."""
    assert np.abs(slopes(depth * STEP * (GX > 5.0))).max() < most


@pytest.mark.parametrize(
    ("depth", "most"), [(0.2, 0.15), (0.5, 0.6), (1.0, 0.6), (2.0, 0.6), (2.5, 0.6), (3.0, 0.15), (4.0, 0.15)]
)
def test_narrow_slots_blur(depth, most):
    """Two pixels wide, by no more than the docstring says; depth in pixels."""
    assert np.abs(slopes(-depth * STEP * (np.abs(GX - 5.0) < STEP))).max() < most


def test_a_height_that_is_not_finite_spoils_two_pixels():
    """To either side in its row and column. Catches differences that go round the raster's border."""
    height = 0.1 * GX
    height[0, 0] = np.nan
    assert set(np.flatnonzero(np.isnan(slopes(height)[0][0]))) <= set(range(3))
    assert set(np.flatnonzero(np.isnan(slopes(height)[1][:, 0]))) <= set(range(3))


def test_fourth_order():
    """Half the pixel size, a sixteenth of the error: of gentle relief, away from the border."""

    def error(period):
        k = 2 * np.pi / period
        found = slopes(0.1 * np.sin(k * GX))[0]
        return np.abs(found - 0.1 * k * np.cos(k * GX))[:, 3:-3].max()

    assert error(200.0) / error(400.0) > 2**4.5  # a slope half as large, too: 2^5 in all


@pytest.mark.parametrize("tilt", [0.0, 0.3])
@pytest.mark.parametrize("width", [2, 3, 100])
def test_steps_and_slots(width, tilt):
    """Each side of a depth jump of 6 pixels keeps its own slope, to 0.06 also in a slot two pixels wide."""
    inside = np.abs(GX - 5.0 - 0.5 * width * STEP) < 0.5 * width * STEP
    found = slopes(tilt * GX - 60.0 * inside)
    np.testing.assert_allclose(found[0], tilt, atol=0.06 if width == 2 else 1e-3)
    np.testing.assert_allclose(found[1], 0.0, atol=1e-9)


def test_ridge():
    """Two flanks that meet between pixels: each pixel has the slope of its flank."""
    np.testing.assert_allclose(slopes(-np.abs(GX - 3.0))[0], -np.sign(GX - 3.0), atol=0.02)


def test_border_and_small_rasters():
    """A plane is exact up to the border, on two pixels, too; on one the slope is 0, with finite derivatives."""
    np.testing.assert_allclose(slopes(0.7 * GX - 0.2 * GY), np.array([0.7, -0.2])[:, None, None] + 0 * GX, atol=1e-9)
    small = hx.Raster(jnp.asarray(X[:2]), jnp.asarray(X[:1]))
    height = jnp.array([[0.0, 7.0]])
    surface = hx.surface_of_heights(height, small)
    np.testing.assert_allclose(surface.slope_x, 0.7, rtol=1e-6)
    np.testing.assert_array_equal(surface.slope_y, 0.0)
    assert np.isfinite(jax.grad(lambda h: hx.surface_of_heights(h, small).slope_x.sum())(height)).all()
