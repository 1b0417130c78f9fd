"""Edge-preserving smoothing of traced images (joint bilateral filter with local polynomials)."""

import math
from typing import Literal

import numpy as np

from helio_jax.arrays import robust_std
from helio_jax.kernel import kernel

SMOOTH_PIXELS = 1.0
"""Gaussian width of one pass [pixels]."""
SMOOTH_NORMALS = 0.2
"""Gaussian width of the range weight: difference of unit normals."""
LEAST_SMOOTH_NORMALS, NORMAL_NOISES = 0.05, 4.0
"""Range weight for the surface itself: its least width, and its width in standard deviations of the normals' noise."""
_REACH = math.ceil(2.5 * SMOOTH_PIXELS)
_RIDGE = 0.1
"""Ridge penalty on the slopes and curvatures of the local polynomials, relative to the weight of the centre pixel."""
_N_TERMS = {1: 3, 2: 6}
"""Number of terms of a polynomial in two coordinates, by its degree."""
_VARIANCE = {1: 1.0, 2: 2.5}
"""Variance that a pass leaves, over that with planes, by the degree: integral of (2 - r^2 / 2)^2 exp(-r^2) over that of
exp(-r^2)."""
_SAME_LEVEL = 1.0, 0.25
"""Largest distance of a neighbour from the pixel's tangent plane: pitches, and more per pixel between them. A curved
surface whose normals turn by half a radian keeps below it."""


def smooth_along_surface(
    images: np.ndarray,
    normals: np.ndarray,
    points: np.ndarray,
    pitch: float,
    passes: int = 1,
    width: float = SMOOTH_NORMALS,
    degree: Literal[1, 2] = 1,
) -> np.ndarray:
    """Smooth images over neighbours with similar normals on the same level.

    A polynomial is fitted around each pixel with the weights of a joint bilateral filter. Edges stay sharp, and so does
    the rise of multiple scattering towards a sphere's rim, which a one-sided mean would flatten. A plane raises what
    falls off like 1 / distance: by 5 % of the multiple scattering 2 pixels from a vertical wall; a polynomial of degree
    2 does not, and leaves 1.6 times the noise. The top and the foot of a wall have the same normal: neighbours far from
    the pixel's tangent plane are left out. Each further pass doubles the spacing of the neighbours: with planes the
    Gaussian variance of `passes` passes is (4^passes - 1) / 3 squared pixels.

    Args:
        images: [image, y, x].
        normals: unit normals [y, x, 3].
        points: of the surface, sample frame [y, x, 3], um.
        pitch: of the raster, the larger of both, um.
        passes: at least 1.
        width: of the range weight.
        degree: of the polynomials.

    Source: weights: Petschnigg et al., ACM Trans. Graph. 23 (2004) 664, eq. 3; passes: Dammertz, Sewtz, Hanika and
        Lensch, High Performance Graphics 2010, sec. 3; local polynomials: Fan and Gijbels, Local Polynomial Modelling
        (1996), sec. 3.1.
    """
    smooth = np.ascontiguousarray(np.moveaxis(images, 0, -1), np.float64)
    about = np.ascontiguousarray(normals, np.float64), np.ascontiguousarray(points / pitch, np.float64)
    for number in range(passes):
        smooth = _fit_polynomials(smooth, *about, 2**number, width, _N_TERMS[degree])
    return np.moveaxis(smooth, -1, 0)


def passes_for(paths: float, wanted: float, degree: Literal[1, 2] = 1) -> int:
    """Return the number of passes that averages over at least `wanted` paths, with `paths` in each pixel."""
    passes = 1
    while paths * (4**passes - 1) / 3 / _VARIANCE[degree] < wanted:
        passes += 1
    return passes


def surface_width(normals: np.ndarray) -> float:
    """Return the width of the range weight for smoothing a surface itself, from the noise of its normals [y, x, 3].

    The noise is taken from second differences along rows and columns, which most of a surface leaves small. A wider
    weight would round the creases, and hollows would see less of themselves. Images need the full width: along a steep
    rim, normals differ between neighbours by more than noise.
    """
    bends = [np.diff(normals, 2, axis).ravel() for axis in (0, 1)]
    noise = robust_std(np.concatenate(bends)) / math.sqrt(6.0)
    return float(np.clip(NORMAL_NOISES * noise, LEAST_SMOOTH_NORMALS, SMOOTH_NORMALS))


@kernel
def _fit_polynomials(images, normals, points, spacing, width, n_terms):
    """Evaluate at each pixel the polynomial of `n_terms` terms fitted around it [y, x, image]."""
    ny, nx, n_images = images.shape
    out = np.empty_like(images)
    for row in range(ny):
        matrix, right, term = np.empty((n_terms, n_terms)), np.empty((n_terms, n_images)), np.ones(6)
        for column in range(nx):
            matrix[:] = 0.0
            right[:] = 0.0
            for a in range(1, n_terms):
                matrix[a, a] = _RIDGE
            for i in range(-_REACH, _REACH + 1):
                y = min(max(row + i * spacing, 0), ny - 1)
                for j in range(-_REACH, _REACH + 1):
                    x = min(max(column + j * spacing, 0), nx - 1)
                    change, off = 0.0, 0.0
                    for a in range(3):
                        change += (normals[y, x, a] - normals[row, column, a]) ** 2
                        off += normals[row, column, a] * (points[y, x, a] - points[row, column, a])
                    if abs(off) > _SAME_LEVEL[0] + _SAME_LEVEL[1] * spacing * math.hypot(i, j):
                        continue
                    weight = math.exp(-0.5 * ((i * i + j * j) / SMOOTH_PIXELS**2 + change / width**2))
                    term[1], term[2], term[3], term[4], term[5] = i, j, i * i, i * j, j * j
                    for a in range(n_terms):
                        for b in range(a, n_terms):
                            matrix[a, b] += weight * term[a] * term[b]
                        for k in range(n_images):
                            right[a, k] += weight * term[a] * images[y, x, k]
            for a in range(n_terms):
                for b in range(a):
                    matrix[a, b] = matrix[b, a]
            out[row, column] = np.linalg.solve(matrix, right)[0]
    return out
