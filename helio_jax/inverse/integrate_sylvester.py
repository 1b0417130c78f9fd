"""Harker and O'Leary's least-squares integration: a Sylvester equation with accurate derivative matrices.

Written from the papers alone. Slopes are derivatives of the height at the pixels, taken by multi-point formulas, so
smooth surfaces are integrated to high order; a jump is smeared, and patterns at the pixel period are weakly held
because centred formulas do not see them. Kept for comparison with `integrate_jumps`.
"""

from math import factorial

import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Float

from helio_jax.errors import SceneError
from helio_jax.inverse.integrate_poisson import Image

Matrix = Float[np.ndarray, "n n"]


def derivative_matrix(n: int, pitch: float, points: int = 5, order: int = 1) -> Matrix:
    """Make the matrix that differentiates n equally spaced samples, exact for degree < `points` up to the ends.

    Rows near an end use the outermost `points` samples, so no sample outside is needed.

    Args:
        n: number of samples, >= points.
        pitch: spacing [um].
        points: samples in a formula, odd, > order.
        order: order of the derivative.

    Source: Fornberg, Math. Comp. 51 (1988) 699 (Taylor conditions); use in integration: Harker and O'Leary,
        CVPR 2008, sec. 3, and J. Math. Imaging Vis. 51 (2015) 46, sec. 4.
    """
    matrix = np.zeros((n, n))
    for i in range(n):
        first = min(max(i - points // 2, 0), n - points)
        offsets = np.arange(first, first + points) - i
        conditions = np.vander(offsets.astype(float), increasing=True).T
        wanted = np.zeros(points)
        wanted[order] = factorial(order)
        matrix[i, first : first + points] = np.linalg.solve(conditions, wanted) / pitch**order
    return matrix


def cosine_basis(n: int, n_modes: int) -> np.ndarray:
    """Return the first `n_modes` orthonormal cosine modes (DCT-II) of n samples as columns; the first is constant."""
    return np.asarray(scipy.fft.idct(np.eye(n)[:, :n_modes], axis=0, norm="ortho"))


def solve_symmetric_sylvester(left: np.ndarray, right: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Solve left H + H right = source for symmetric positive semi-definite `left` and `right`.

    By diagonalising both. Where both have an eigenvalue of zero (to rounding) the solution is not determined; that
    part is set to zero, which gives the H of least norm.
    """
    eigenvalues_left, vectors_left = scipy.linalg.eigh(left)
    eigenvalues_right, vectors_right = scipy.linalg.eigh(right)
    total = eigenvalues_left[:, None] + eigenvalues_right[None, :]
    total[total <= 1e-13 * total.max()] = np.inf
    return vectors_left @ ((vectors_left.T @ source @ vectors_right) / total) @ vectors_right.T


def integrate_sylvester(
    a: Image,
    b: Image,
    dx: float,
    dy: float,
    *,
    variant: str = "plain",
    points: int = 5,
    strength: float = 0.0,
    order: int = 2,
    modes: tuple[int, int] | None = None,
) -> Image:
    """Compute the height [um] of least ||H Dx' - A||^2 + ||Dy H - B||^2, the norms over all pixels.

    Valid for smooth surfaces on a full raster of equally trusted slopes. Mean zero, except `dirichlet`: zero on the
    border.

    Args:
        a, b: slopes dh/dX, dh/dY [1], finite.
        dx, dy: pitches [um].
        variant: `plain`; `dirichlet` (the border pixels have height zero); `tikhonov` (adds strength^2 times the sum
            of the squares of the height's derivatives of `order` along x and y); `spectral` (only the lowest cosine
            modes).
        points: samples in a derivative formula, odd, 3 to the raster's size.
        strength: weight of the regularisation [um^(order - 1)], >= 0; `tikhonov` only.
        order: 0, 1 or 2, the derivative that is kept small; `tikhonov` only.
        modes: number of cosine modes along y and x; `spectral` only, a quarter of the raster by default.

    Raises:
        SceneError: an unknown variant, or a setting out of range.

    Source: Harker and O'Leary, CVPR 2008, eqs. 12-19 (Sylvester equation and its null space); CVPR 2011, secs. 3-5,
        and J. Math. Imaging Vis. 51 (2015) 46 (Dirichlet, spectral and Tikhonov regularisation).
    """
    n_y, n_x = a.shape
    if points % 2 == 0 or not 3 <= points <= min(n_y, n_x):
        raise SceneError(f"points must be odd and from 3 to the raster's size {min(n_y, n_x)}, got {points}")
    diff_y, diff_x = derivative_matrix(n_y, dy, points), derivative_matrix(n_x, dx, points)
    basis_y, basis_x = _bases(variant, n_y, n_x, modes)
    left = (diff_y @ basis_y).T @ (diff_y @ basis_y)
    right = (diff_x @ basis_x).T @ (diff_x @ basis_x)
    if variant == "tikhonov":
        if order not in (0, 1, 2) or not strength >= 0:
            raise SceneError(f"order must be 0, 1 or 2 and strength >= 0, got {order} and {strength:g}")
        left = left + strength**2 * _penalty(n_y, dy, order)
        right = right + strength**2 * _penalty(n_x, dx, order)
    source = basis_y.T @ (diff_y.T @ b + a @ diff_x) @ basis_x
    height = basis_y @ solve_symmetric_sylvester(left, right, source) @ basis_x.T
    return height if variant == "dirichlet" else height - height.mean()


def _bases(variant: str, n_y: int, n_x: int, modes: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns that span the allowed heights along y and x (orthonormal)."""
    if variant in ("plain", "tikhonov"):
        return np.eye(n_y), np.eye(n_x)
    if variant == "dirichlet":
        return np.eye(n_y)[:, 1:-1], np.eye(n_x)[:, 1:-1]
    if variant == "spectral":
        m_y, m_x = modes or (max(n_y // 4, 2), max(n_x // 4, 2))
        if not (1 <= m_y <= n_y and 1 <= m_x <= n_x):
            raise SceneError(f"modes must be from 1 to the raster's size {n_y} x {n_x}, got {m_y} x {m_x}")
        return cosine_basis(n_y, m_y), cosine_basis(n_x, m_x)
    raise SceneError(f"variant must be plain, dirichlet, tikhonov or spectral, got {variant!r}")


def _penalty(n: int, pitch: float, order: int) -> Matrix:
    """Compute L'L for the derivative L of `order`; for order 0 half of it, so that x and y together make ||H||^2."""
    if order == 0:
        return 0.5 * np.eye(n)
    matrix = derivative_matrix(n, pitch, 3, order)
    return matrix.T @ matrix
