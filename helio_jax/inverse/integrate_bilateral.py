"""Bilateral normal integration in slope form: every pixel trusts the one of its two sides that is smoother.

Written from the paper alone. Kept for comparison with `integrate_jumps`: it has no use for an error model and needs
none, but a jump whose two pixels both have moderate slopes is found only if the first solution shows it.
"""

import numpy as np
import scipy.special

from helio_jax.errors import SceneError
from helio_jax.inverse.integrate_poisson import (
    EdgeProblem,
    EdgesX,
    Image,
    differentiate,
    integrate_poisson,
    solve_weighted,
    solve_weighted_checked,
)

MEMBRANE = 1e-9  # weight, where a flat pixel of median confidence has 1, that draws every edge to a slope of zero


def _side_weights(slope: EdgesX, normal_z: Image, stiffness: float) -> tuple[EdgesX, EdgesX]:
    """Compute, for edges along the last axis, the weight of the edge to its left and to its right pixel.

    A pixel at the border has one side only and trusts it as an interior pixel does in a smooth place: 1/2.
    """
    change = (normal_z[:, 1:] * slope) ** 2  # seen from the right pixel, towards its left
    change_left = (normal_z[:, :-1] * slope) ** 2  # seen from the left pixel, towards its right
    trust_right = np.full(normal_z.shape, 0.5)  # w of the paper: trust in the pixel's right side
    trust_right[:, 1:-1] = scipy.special.expit(stiffness * (change[:, :-1] - change_left[:, 1:]))
    return trust_right[:, :-1], 1 - trust_right[:, 1:]


def _edges(
    slope: EdgesX, pixel_slope: Image, normal_z: Image, pixel_weight: Image, stiffness: float
) -> tuple[EdgesX, EdgesX]:
    """Compute the wanted slope and the weight of the edges along the last axis: both pixels' terms in one.

    A weak membrane (a wanted slope of zero) holds the edges that neither pixel trusts.
    """
    left, right = _side_weights(slope, normal_z, stiffness)
    strength = pixel_weight * normal_z**2
    left, right = left * strength[:, :-1], right * strength[:, 1:]
    total = left + right + MEMBRANE
    return (left * pixel_slope[:, :-1] + right * pixel_slope[:, 1:]) / total, total


def integrate_bilateral(
    a: Image,
    b: Image,
    dx: float,
    dy: float,
    weights: Image,
    *,
    stiffness: float = 2.0,
    n_rounds: int = 40,
    tolerance: float = 1e-4,
    max_steps: int = 2000,
) -> Image:
    """Compute the height [um] by bilaterally weighted one-sided differences; mean zero.

    Minimises sum over pixels of n_z^2 [w (D+ h - a)^2 + (1 - w) (D- h - a)^2] and the same along y, where
    w = sigmoid(k ((n_z D- h)^2 - (n_z D+ h)^2)) is held fixed in each round. Planes are exact; a curved surface has a
    first-order error where the two sides are not trusted alike. Valid for semi-smooth surfaces: each pixel must have a
    smooth side in both directions.

    Args:
        a, b: slopes dh/dX, dh/dY [1], finite; n_z = 1 / sqrt(1 + a^2 + b^2).
        dx, dy: pitches [um].
        weights: pixel confidences >= 0, relative.
        stiffness: k of the sigmoid, > 0; the paper's choice is 2.
        n_rounds: rounds of reweighting at most; fewer when the objective changes by less than `tolerance`.
        tolerance: relative change of the objective at which to stop, and relative residual of the last solve.
        max_steps: conjugate-gradient steps of the last solve at most.

    Raises:
        SceneError: `stiffness` not > 0, or `n_rounds` < 1.
        GuardError: the last solve did not reach `tolerance`.

    Source: Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022, eqs. 15-17 and sec. 4.
    """
    if not stiffness > 0 or n_rounds < 1:
        raise SceneError(f"stiffness must be > 0 and n_rounds >= 1, got {stiffness:g} and {n_rounds}")
    normal_z = 1 / np.sqrt(1 + a**2 + b**2)
    relative = np.maximum(weights / np.median(weights[weights > 0]), 1e-6)
    height = integrate_poisson(a, b, dx, dy)
    slope_x, slope_y = (
        np.zeros((a.shape[0], a.shape[1] - 1)),
        np.zeros((a.shape[0] - 1, a.shape[1])),
    )  # round 0: w = 1/2
    objective = np.inf
    for _ in range(n_rounds):
        wanted_x, weight_x = _edges(slope_x, a, normal_z, relative, stiffness)
        wanted_y, weight_y = (e.T for e in _edges(slope_y.T, b.T, normal_z.T, relative.T, stiffness))
        problem = EdgeProblem(wanted_x, wanted_y, weight_x, weight_y, dx, dy)
        height, _ = solve_weighted(problem, height, 10 * tolerance, 40)
        slope_x, slope_y = differentiate(height, dx, dy)
        old, objective = objective, _objective(problem, slope_x, slope_y)
        if abs(old - objective) <= tolerance * objective:
            break
    return solve_weighted_checked(problem, height, tolerance, max_steps)


def _objective(problem: EdgeProblem, slope_x: EdgesX, slope_y: Image) -> float:
    """Compute the weighted sum of squares of an edge problem at the given slopes."""
    rest_x, rest_y = slope_x - problem.slope_x, slope_y - problem.slope_y
    return float(np.sum(problem.weight_x * rest_x**2) + np.sum(problem.weight_y * rest_y**2))
