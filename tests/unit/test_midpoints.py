"""Points between those of a grid, by its heights and slopes."""

import numpy as np
import pytest

from helio_jax.scene.midpoints import first_of_halves, with_midpoints

DX, DY, SHIFT = 30.0, 20.0, (0.5, -0.1)


def raster(n_x: int, n_y: int) -> tuple[np.ndarray, np.ndarray]:
    """Beam positions [y, x], um."""
    x, y = np.meshgrid(DX * np.arange(n_x), DY * np.arange(n_y))
    return x, y


def seen(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of heights seen along the beam."""
    return x - SHIFT[0] * z, y - SHIFT[1] * z, z


def test_a_quadratic_surface_is_met():
    """Also in the middle of four points, and along an oblique beam. Catches a wrong sign, pitch or axis."""

    def height(x, y):
        return 1e-3 * (2.0 * x**2 - 3.0 * y**2 + x * y) + 0.1 * x, 1e-3 * (4.0 * x + y) + 0.1, 1e-3 * (x - 6.0 * y)

    x, y = raster(6, 5)
    z, slope_x, slope_y = height(x, y)
    found = with_midpoints(seen(x, y, z), slope_x, slope_y, (DX, DY), SHIFT)
    fine = np.meshgrid(0.5 * DX * np.arange(11), 0.5 * DY * np.arange(9))
    corners = np.ix_((1, -2), (1, -2))
    for got, wanted in zip(found, seen(*fine, height(*fine)[0]), strict=True):
        got[corners] = wanted[corners]  # nothing is known of the change of slope along one of their diagonals
        assert np.allclose(got, wanted, atol=1e-9)


@pytest.mark.parametrize("place", [1.2, 1.5, 1.9])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_crease_is_met_wherever_it_lies(place, sign):
    """A foot or an edge between two columns, level on one side; also in the middles of cells, seen by an oblique beam.

    Rejects straight lines and cubic interpolation, off by up to d / 4 and d / 8. Across a depth jump, and where slopes
    are not known, the lines stay straight.
    """

    def height(x):
        return sign * np.maximum(x - place * DX, 0.0), np.where(x > place * DX, sign, 0.0)

    x, y = raster(4, 3)
    (z, slope), flat = height(x), np.zeros(x.shape)
    found = with_midpoints(seen(x, y, z), slope, flat, (DX, DY), SHIFT)
    fine = np.meshgrid(0.5 * DX * np.arange(7), 0.5 * DY * np.arange(5))
    for got, wanted in zip(found, seen(*fine, height(fine[0])[0]), strict=True):
        assert np.allclose(got, wanted, atol=1e-9)
    jump = with_midpoints((x, y, z + 2.0 * DX * np.abs(slope)), slope, flat, (DX, DY), (0.0, 0.0))[2]
    assert np.allclose(jump[:, 3], 0.5 * (z[0, 1] + z[0, 2] + 2.0 * DX))
    unknown = with_midpoints((x, y, z), np.full(x.shape, np.nan), flat, (DX, DY), (0.0, 0.0))[2]
    assert np.allclose(unknown[:, 3], 0.5 * (z[0, 1] + z[0, 2]))


def test_number_of_the_first_of_halves():
    assert first_of_halves(3).tolist() == [0, 0, 1, 1, 2]
