"""Weighted Poisson integration that finds depth jumps and cuts the edges across them.

Under an oblique beam the height falls by hundreds of um from one pixel to the next while both slopes are moderate
(a shadow edge). Least squares smears such a jump over the raster; here edges whose misfit is not explained by noise
or by the trapezoid rule lose their weight step by step (graduated non-convexity). What is *not* done: nothing is
assumed about the jump's size where a jump closes around a region: that region's level is then unknown.
"""

import numpy as np

from helio_jax.arrays import robust_std
from helio_jax.errors import SceneError
from helio_jax.inverse.integrate_poisson import (
    EdgeProblem,
    EdgesX,
    EdgesY,
    Image,
    differentiate,
    integrate_poisson,
    mean_to_edges,
    solve_directly,
    solve_weighted,
    solve_weighted_checked,
)

Edges = tuple[EdgesX, EdgesY]
COARSE = 1e-3, 40  # relative residual and largest number of steps of the solves between two reweightings
MOST_DIRECT = 250_000  # pixels up to which a last solve that does not converge is done by factorisation instead
MEMBRANE = 1e-7  # weight, of the largest edge weight, that draws every edge to a slope of zero: no region floats


def edge_confidence(weights: Image, floor: float = 1e-6) -> tuple[EdgesX, EdgesY]:
    """Compute edge confidences relative to the median pixel: harmonic means of the pixels' weights.

    If a pixel's weight is the inverse variance of its slope, the variance of the mean of two is half the inverse of
    the harmonic mean (own derivation, tests/inverse/test_integrate.py).

    Args:
        weights: pixel weights >= 0, not all zero.
        floor: smallest confidence; an edge to a pixel of unknown slope has it.
    """
    w = weights / np.median(weights[weights > 0])
    with np.errstate(divide="ignore", over="ignore"):
        inverse = 1 / w
    mean_x, mean_y = mean_to_edges(inverse, inverse)
    return np.maximum(1 / mean_x, floor), np.maximum(1 / mean_y, floor)


def estimate_slope_noise(a: Image, b: Image, dx: float, dy: float, weights: Image) -> float:
    """Estimate the noise [1] of one pixel's slope, estimated from the circulation around squares of four pixels.

    Circulation is free of the surface's shape up to h'''' terms. Each edge slope is a mean of two pixels, which gives
    the circulation the variance (dx^2 + dy^2) sigma^2; the median of its absolute value, over squares whose four
    pixels have a known slope, disregards jumps. Valid for independent noise; own derivation,
    tests/inverse/test_integrate.py.
    """
    slope_x, slope_y = mean_to_edges(a, b)
    circulation = np.diff(slope_x * dx, axis=0) - np.diff(slope_y * dy, axis=1)
    is_known = weights > 0
    is_known = is_known[1:, 1:] & is_known[1:, :-1] & is_known[:-1, 1:] & is_known[:-1, :-1]
    if not is_known.any():
        return 0.0
    return float(robust_std(circulation[is_known]) / np.hypot(dx, dy))


def edge_noise(a: Image, b: Image, confidence_x: EdgesX, confidence_y: EdgesY, noise: float) -> tuple[EdgesX, EdgesY]:
    """Compute the standard deviation [1] expected of each edge slope.

    Two parts: the pixels' noise, sigma^2 / (2 confidence), and the trapezoid rule's error at a kink somewhere within
    the edge. With slopes s1, s2 on the two sides of a kink that lies uniformly within the edge, the mean slope's
    error is (u - 1/2)(s2 - s1) with u uniform in (0, 1): a variance of (s2 - s1)^2 / 12. So a misfit is cheap where
    the slopes on the two sides disagree, which they do at most jumps. Own derivation, tests/inverse/test_integrate.py.
    """
    kink_x, kink_y = np.diff(a, axis=1) ** 2 / 12, np.diff(b, axis=0) ** 2 / 12
    return np.sqrt(noise**2 / (2 * confidence_x) + kink_x), np.sqrt(noise**2 / (2 * confidence_y) + kink_y)


def _doubt_guesses(sigma: Edges, slopes: Edges, weights: Image) -> Edges:
    """Compute sigma with the slope itself added in quadrature on edges that touch a pixel of unknown slope.

    Such a slope was copied from a neighbour; without this, copies of a grazing pixel's slope would be believed.
    """
    is_unknown = weights == 0
    guess_x = np.where(is_unknown[:, 1:] | is_unknown[:, :-1], slopes[0], 0.0)
    guess_y = np.where(is_unknown[1:] | is_unknown[:-1], slopes[1], 0.0)
    return np.hypot(sigma[0], guess_x), np.hypot(sigma[1], guess_y)


def _problem(slopes: Edges, sigma: Edges, jump: Edges, dx: float, dy: float) -> EdgeProblem:
    """Make the edge problem of weights jump / sigma^2 (largest 1), plus a weak membrane on every edge.

    The membrane, `MEMBRANE` (D h)^2, ties regions that are cut off. It draws towards a slope of zero and not to the
    edge's own, or one grazing pixel with a slope of 1e8 would outweigh the rest.
    """
    weight_x, weight_y = jump[0] / sigma[0] ** 2, jump[1] / sigma[1] ** 2
    largest = max(weight_x.max(), weight_y.max())
    total_x, total_y = weight_x / largest + MEMBRANE, weight_y / largest + MEMBRANE
    slope_x, slope_y = slopes[0] * (1 - MEMBRANE / total_x), slopes[1] * (1 - MEMBRANE / total_y)
    return EdgeProblem(slope_x, slope_y, total_x, total_y, dx, dy)


def _misfits(height: Image, slopes: Edges, sigma: Edges, dx: float, dy: float) -> Edges:
    """Compute (D h - s) / sigma on the edges."""
    slope_x, slope_y = differentiate(height, dx, dy)
    return (slope_x - slopes[0]) / sigma[0], (slope_y - slopes[1]) / sigma[1]


def integrate_weighted(
    a: Image,
    b: Image,
    dx: float,
    dy: float,
    weights: Image,
    *,
    tolerance: float = 1e-8,
    max_steps: int = 2000,
) -> Image:
    """Compute the height [um] that fits the edge slopes with the pixels' weights, no edge being cut; mean zero.

    Valid for surfaces without jumps.

    Raises:
        GuardError: conjugate gradients did not reach `tolerance` in `max_steps`.
    """
    problem = EdgeProblem(*mean_to_edges(a, b), *edge_confidence(weights), dx, dy)
    return solve_weighted_checked(problem, integrate_poisson(a, b, dx, dy), tolerance, max_steps)


def integrate_cutting_jumps(
    a: Image,
    b: Image,
    dx: float,
    dy: float,
    weights: Image,
    *,
    cut: float = 3.0,
    min_noise: float = 0.05,
    tolerance: float = 1e-4,
    max_steps: int = 2000,
) -> tuple[Image, EdgesX, EdgesY]:
    """Find the height and the edges that stayed intact, by a robust fit of the edge slopes.

    Minimises sum_e rho(r_e), r = (D h - s) / sigma, with Geman and McClure's rho = r^2 c^2 / (r^2 + c^2), by
    reweighting; c falls by halves from the largest misfit of the fit without cuts to `cut` (graduated
    non-convexity) and stays there for three more rounds. sigma: `edge_noise`, of `estimate_slope_noise`'s noise.
    Valid where each region is tied to the rest through intact edges, and the slopes on the two sides of a jump differ,
    as at a shadow edge, above which the surface grazes the beam. A step between two planes of equal slope leaves a
    trace only where its height changes along it, and is smeared in part.

    Args:
        a, b: slopes dh/dX, dh/dY [1], finite.
        dx, dy: pitches [um].
        weights: pixel confidences >= 0, proportional to the inverse variance of the slopes.
        cut: misfit, in standard deviations of an edge, at which its weight has fallen to a quarter; > 0.
        min_noise: least noise of one pixel's slope [1]; with less, errors of the trapezoid rule become jumps.
        tolerance, max_steps: relative residual and largest number of steps of the last solve; a raster of
            `MOST_DIRECT` pixels or fewer is solved directly where they are not enough.

    Returns:
        height [um], mean zero; and jump_x, jump_y in (0, 1]: 1 intact, 0 cut, 1/4 at a misfit of `cut`.

    Raises:
        SceneError: `cut` or `min_noise` not > 0.
        GuardError: the last solve of a larger raster did not reach `tolerance`.

    Source: Geman and McClure, Bull. ISI 52 (1987) 5; Black and Rangarajan, IJCV 19 (1996) 57, sec. 4 (reweighting);
        Blake and Zisserman, Visual Reconstruction (1987), ch. 3 (graduated non-convexity).
    """
    for name, value in (("cut", cut), ("min_noise", min_noise)):
        if not value > 0:
            raise SceneError(f"{name} must be > 0, got {value:g}")
    noise = max(estimate_slope_noise(a, b, dx, dy, weights), min_noise)
    slopes = mean_to_edges(a, b)
    sigma = _doubt_guesses(edge_noise(a, b, *edge_confidence(weights), noise), slopes, weights)
    jump = np.ones_like(sigma[0]), np.ones_like(sigma[1])
    start = integrate_poisson(a, b, dx, dy)
    height, _ = solve_weighted(_problem(slopes, sigma, jump, dx, dy), start, COARSE[0], COARSE[1])
    largest = max(float(np.abs(r).max()) for r in _misfits(height, slopes, sigma, dx, dy))
    n_halvings = int(np.ceil(np.log2(max(largest / cut, 1.0))))
    scales = [cut * 2.0**k for k in range(n_halvings, 0, -1)] + [cut] * 4
    for i, scale in enumerate(scales):
        misfit_x, misfit_y = _misfits(height, slopes, sigma, dx, dy)
        jump = (1 + (misfit_x / scale) ** 2) ** -2, (1 + (misfit_y / scale) ** 2) ** -2
        problem = _problem(slopes, sigma, jump, dx, dy)
        if i < len(scales) - 1:
            height, _ = solve_weighted(problem, height, COARSE[0], COARSE[1])
        elif height.size <= MOST_DIRECT:
            height, is_converged = solve_weighted(problem, height, tolerance, max_steps)
            height = height if is_converged else solve_directly(problem)
        else:
            height = solve_weighted_checked(problem, height, tolerance, max_steps)
    return height, jump[0], jump[1]
