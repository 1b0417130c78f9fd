"""Poisson integration on the edges of the raster: operators, exact cosine solve, preconditioned CG.

Heights live on pixels, slopes on *edges*: `x` edges join (i, j) with (i, j+1) and form `[y, x-1]`, `y` edges join
(i, j) with (i+1, j) and form `[y-1, x]`. An edge slope is the mean of its two pixel slopes, so a surface of second
degree is integrated exactly. Every solver here returns a height of mean zero; jumps are `integrate_jumps`' matter.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from helio_jax.errors import GuardError
from helio_jax.forward.surface import along

Image = Float[np.ndarray, "y x"]
EdgesX = Float[np.ndarray, "y x-1"]
EdgesY = Float[np.ndarray, "y-1 x"]


def mean_to_edges(a: Image, b: Image) -> tuple[EdgesX, EdgesY]:
    """Compute the slopes on the edges: the mean of the two pixel slopes (trapezoid rule).

    Exact for surfaces of second degree; the error is pitch^2 h''' / 12 otherwise.
    """
    return 0.5 * (a[:, 1:] + a[:, :-1]), 0.5 * (b[1:] + b[:-1])


def differentiate(height: Image, dx: float, dy: float) -> tuple[EdgesX, EdgesY]:
    """Compute the slopes of `height` along the edges [1], its differences divided by the pitch [um]."""
    return np.diff(height, axis=1) / dx, np.diff(height, axis=0) / dy


def differentiate_adjoint(edge_x: EdgesX, edge_y: EdgesY, dx: float, dy: float) -> Image:
    """Apply the adjoint of `differentiate`: <D h, e> = <h, D' e> for every h and e."""
    image = np.zeros((edge_x.shape[0], edge_y.shape[1]))
    image[:, 1:] += edge_x / dx
    image[:, :-1] -= edge_x / dx
    image[1:] += edge_y / dy
    image[:-1] -= edge_y / dy
    return image


def solve_poisson(source: Image, dx: float, dy: float) -> Image:
    """Solve D'D h = source exactly, where D is `differentiate`, by two cosine transforms.

    Valid for any source; its mean (not in the range of D'D) is dropped and the height has mean zero.

    Args:
        source: right-hand side [1/um].
        dx, dy: pitches [um], > 0.

    Returns:
        height [um].

    Source: Frankot and Chellappa, IEEE PAMI 10 (1988) 439, eq. 21, with the cosine basis of Simchony, Chellappa and
        Shao, IEEE PAMI 12 (1990) 435, sec. III (Neumann boundary): DCT-II diagonalises the path-graph Laplacian with
        eigenvalues (2 - 2 cos(pi k / n)) / pitch^2.
    """
    n_y, n_x = source.shape
    eigenvalues_x = (2 - 2 * np.cos(np.pi * np.arange(n_x) / n_x)) / dx**2
    eigenvalues_y = (2 - 2 * np.cos(np.pi * np.arange(n_y) / n_y)) / dy**2
    eigenvalues = eigenvalues_x[None, :] + eigenvalues_y[:, None]
    eigenvalues[0, 0] = np.inf
    spectrum = np.asarray(scipy.fft.dctn(source, norm="ortho")) / eigenvalues
    return np.asarray(scipy.fft.idctn(spectrum, norm="ortho"))


def integrate_poisson(a: Image, b: Image, dx: float, dy: float) -> Image:
    """Compute the height [um] that fits all edge slopes with equal weight; mean zero.

    Valid for surfaces without jumps: a jump is smeared over the whole raster.
    """
    slope_x, slope_y = mean_to_edges(a, b)
    return solve_poisson(differentiate_adjoint(slope_x, slope_y, dx, dy), dx, dy)


@dataclass(frozen=True)
class EdgeProblem:
    """The least-squares problem min_h sum_e w_e (D h - s)_e^2 on the edges of a raster.

    Attributes:
        slope_x, slope_y: wanted edge slopes s [1].
        weight_x, weight_y: edge weights w > 0, of any scale; their ratio to the largest sets the condition.
        dx, dy: pitches [um].
    """

    slope_x: EdgesX
    slope_y: EdgesY
    weight_x: EdgesX
    weight_y: EdgesY
    dx: float
    dy: float

    def apply(self, height: Image) -> Image:
        """Compute D' w D h, the weighted Laplacian."""
        slope_x, slope_y = differentiate(height, self.dx, self.dy)
        return differentiate_adjoint(self.weight_x * slope_x, self.weight_y * slope_y, self.dx, self.dy)

    def residual(self, height: Image) -> Image:
        """Compute D' w (s - D h), the negative half gradient of the objective, without cancellation at a good fit."""
        slope_x, slope_y = differentiate(height, self.dx, self.dy)
        rest_x, rest_y = self.slope_x - slope_x, self.slope_y - slope_y
        return differentiate_adjoint(self.weight_x * rest_x, self.weight_y * rest_y, self.dx, self.dy)


def _dot(f: Image, g: Image) -> float:
    """Compute <f, g>; without BLAS, whose idle threads would occupy the other cores."""
    return float(np.einsum("ij,ij->", f, g))


def solve_weighted(problem: EdgeProblem, start: Image, tolerance: float, max_steps: int) -> tuple[Image, bool]:
    """Solve an `EdgeProblem` by conjugate gradients, preconditioned by the unweighted Poisson solve.

    Few steps where the weights are equal almost everywhere: cut edges along a line of n pixels are a perturbation of
    rank n with a fast decaying spectrum.

    Args:
        problem: weights > 0 (a floor of 1e-6 of the largest is enough to hold every region).
        start: first height [um]; a flat one is taken if it has the smaller residual, as beside slopes of 1e8.
        tolerance: stop when the residual, in the norm of the preconditioner, is this part of that of a zero height.
        max_steps: at most this many steps.

    Returns:
        height [um], mean zero, and whether the tolerance was reached.

    Source: Hestenes and Stiefel, J. Res. NBS 49 (1952) 409, sec. 3; for phase unwrapping with a cosine
        preconditioner Ghiglia and Romero, J. Opt. Soc. Am. A 11 (1994) 107, sec. 3.B.
    """
    dx, dy = problem.dx, problem.dy
    height = start - start.mean()
    source, rest = problem.residual(np.zeros_like(start)), problem.residual(height)
    zero_step, step = solve_poisson(source, dx, dy), solve_poisson(rest, dx, dy)
    zero_size, size = _dot(source, zero_step), _dot(rest, step)
    limit = tolerance**2 * zero_size
    if size > zero_size:
        height, rest, step, size = np.zeros_like(start), source, zero_step, zero_size
    for _ in range(max_steps):
        if size <= limit:
            return height, True
        curved = problem.apply(step)
        length = size / _dot(step, curved)
        height = height + length * step
        rest = rest - length * curved
        preconditioned = solve_poisson(rest, dx, dy)
        old_size, size = size, _dot(rest, preconditioned)
        step = preconditioned + (size / old_size) * step
    return height - height.mean(), size <= limit


def solve_directly(problem: EdgeProblem) -> Image:
    """Solve an `EdgeProblem` by sparse factorisation: slower, needs memory, knows no bad condition; mean zero, um."""
    n_y, n_x = problem.weight_x.shape[0], problem.weight_y.shape[1]
    pixel = np.arange(n_y * n_x).reshape(n_y, n_x)
    first, second = (
        np.concatenate([x.ravel(), y.ravel()]) for x, y in zip(along(pixel, 1), along(pixel, 0), strict=True)
    )
    weight = np.concatenate([problem.weight_x.ravel() / problem.dx**2, problem.weight_y.ravel() / problem.dy**2])
    ends, others = np.concatenate([first, second]), np.concatenate([second, first])
    weight = np.concatenate([weight, weight])
    graph = coo_matrix((weight, (ends, others)), shape=(pixel.size, pixel.size))
    laplacian = diags(np.bincount(ends, weight, pixel.size)) - graph.tocsr()
    source = problem.residual(np.zeros((n_y, n_x))).ravel()
    height = np.zeros(pixel.size)  # the first pixel holds the piston
    height[1:] = splu(laplacian.tocsc()[1:, 1:]).solve(source[1:])
    return (height - height.mean()).reshape(n_y, n_x)


def solve_weighted_checked(problem: EdgeProblem, start: Image, tolerance: float, max_steps: int) -> Image:
    """Return `solve_weighted`'s height [um].

    Raises:
        GuardError: the tolerance was not reached.
    """
    height, is_converged = solve_weighted(problem, start, tolerance, max_steps)
    if not is_converged:
        raise GuardError(
            f"weighted Poisson integration must reach a relative residual of {tolerance:g}, not reached in {max_steps} "
            "steps: raise `max_steps` or `tolerance`, or raise the smallest weights"
        )
    return height
