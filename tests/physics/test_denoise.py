"""Averaging of traced images: planes and edges are kept, noise falls as stated."""

import numpy as np
import pytest

from helio_jax.trace.denoise import (
    LEAST_SMOOTH_NORMALS,
    SMOOTH_NORMALS,
    passes_for,
    smooth_along_surface,
    surface_width,
)

SHAPE = (40, 50)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]]


def on_slope(normals: np.ndarray) -> np.ndarray:
    """Return points [y, x, 3] of a surface of pitch 1, level or falling to the right by 45 degrees."""
    fall = -np.cumsum(normals[..., 0] / normals[..., 2], axis=1)
    return np.stack([*np.mgrid[: normals.shape[0], : normals.shape[1]][::-1], fall], -1).astype(float)


def bent(column: int) -> np.ndarray:
    """Return unit normals [y, x, 3] of a flat up to a column, a slope of 45 degrees from there on."""
    return np.where((column > COLUMN)[..., None], [0.0, 0.0, 1.0], [np.sqrt(0.5), 0.0, np.sqrt(0.5)])


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_planes_and_edges_are_kept(passes):
    """A plane on either side of a bend comes out to 0.3 % of the step between them, also in the last column before it.

    Rejects a Gaussian mean, which is off by half the step there.
    """
    image = np.where(COLUMN < 20, 3.0 + 0.01 * ROW, -5.0 + 0.02 * COLUMN)
    found = smooth_along_surface(image[None], bent(20), on_slope(bent(20)), 1.0, passes)[0]
    inner = slice(7 * passes, -7 * passes), slice(12, 30)
    np.testing.assert_allclose(found[inner], image[inner], atol=0.02)


def test_levels_are_kept_apart():
    """A wall 5 pixels high between two levels with the same normal: nothing is averaged across it.

    Rejects weights of normals alone, which put 13 % of a pit's multiple scattering on its rim; the noise still falls.
    """
    up = np.broadcast_to([0.0, 0.0, 1.0], (*SHAPE, 3))
    points = on_slope(up) + np.where(COLUMN < 20, 5.0, 0.0)[..., None] * [0.0, 0.0, 1.0]
    image = np.where(COLUMN < 20, 0.0, 1.0) + 0.05 * np.random.default_rng(0).normal(size=SHAPE)
    found = smooth_along_surface(image[None], up, points, 1.0, 2)[0]
    assert np.abs(found[:, :20]).max() < 0.1 and np.abs(found[:, 20:] - 1.0).max() < 0.1
    assert found[8:-8, :14].std() < 0.3 * image[8:-8, :14].std()


def test_noise_falls_with_the_passes():
    """White noise on a flat: of p passes the deviation is 1 / (2 sqrt(pi) sigma) with sigma^2 = (4^p - 1) / 3, to 15 %.

    Rejects passes of the same spacing (sigma^2 = p) from 2 on, and passes that are not applied.
    """
    noise = np.random.default_rng(0).normal(size=(4, 100, 120))
    up = np.broadcast_to([0.0, 0.0, 1.0], (100, 120, 3))
    for passes in (1, 2, 3):
        found = smooth_along_surface(noise, up, on_slope(up), 1.0, passes)[:, 20:-20, 20:-20].std()
        assert found == pytest.approx(0.5 / np.sqrt(np.pi * (4**passes - 1) / 3), rel=0.15)


@pytest.mark.parametrize("passes", [1, 2])
def test_degree_2_keeps_curvature(passes):
    """A polynomial of degree 2 comes out to 0.5 %, with sqrt(2.5) times the noise that planes leave, to 20 %.

    Rejects planes, which raise it by half its Laplacian in one pass, 0.3, and by 1.5 in two.
    """
    up = np.broadcast_to([0.0, 0.0, 1.0], (*SHAPE, 3))
    inner = slice(8, -8), slice(8, -8)
    curved = 0.3 * (ROW - 20.0) ** 2 - 0.2 * (ROW - 20.0) * (COLUMN - 20.0) + COLUMN
    noise = np.random.default_rng(0).normal(size=SHAPE)
    found = smooth_along_surface(np.array([curved, noise]), up, on_slope(up), 1.0, passes, degree=2)
    planes = smooth_along_surface(noise[None], up, on_slope(up), 1.0, passes)[0]
    np.testing.assert_allclose(found[0][inner], curved[inner], rtol=0.005, atol=0.02)
    assert found[1][inner].std() == pytest.approx(np.sqrt(2.5) * planes[inner].std(), rel=0.2)


def test_passes_average_enough_paths():
    assert [passes_for(n, 40) for n in (100, 40, 39, 8, 7, 2)] == [1, 1, 2, 2, 3, 3]
    assert [passes_for(n, 40, 2) for n in (100, 99, 20, 19)] == [1, 2, 2, 3]


def test_weights_are_as_wide_as_the_noise_of_the_normals():
    """Four deviations of 0.03, known to 5 %; a bend of 45 degrees in every fifth column counts for nothing.

    Rejects a standard deviation, which the bends make four times as large, and a fixed width.
    """
    noise = 0.03 * np.random.default_rng(5).normal(size=(*SHAPE, 3))
    zigzag = np.where((COLUMN // 5 % 2 == 0)[..., None], bent(-1), [0.0, 0.0, 1.0])
    assert surface_width(np.zeros((*SHAPE, 3)) + noise) == pytest.approx(4.0 * 0.03, rel=0.05)
    assert surface_width(zigzag + noise) < 0.2
    assert surface_width(zigzag) == LEAST_SMOOTH_NORMALS and surface_width(20.0 * noise) == SMOOTH_NORMALS


def test_a_gentle_crease_stays():
    """A roof of 13 degrees on both sides, without noise: its ridge stays to 1.5 % of the change of slope, in pitches.

    Rejects weights as wide as noisy normals need, which round the ridge and lower it by 7 %.
    """
    slope = np.where(COLUMN < 25, 0.23, -0.23)
    normals = np.stack([-slope, 0.0 * slope, np.ones(SHAPE)], -1) / np.sqrt(1.0 + 0.23**2)
    height = 0.23 * (24.5 - np.abs(COLUMN - 24.5))
    points = np.stack([COLUMN, ROW, height], -1).astype(float)
    found = smooth_along_surface(height[None], normals, points, 1.0, width=surface_width(normals))[0]
    assert np.abs(found - height)[:, 8:-8].max() < 0.015 * 0.46
