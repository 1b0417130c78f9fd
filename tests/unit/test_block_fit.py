"""The elimination of per-pixel unknowns against a dense least-squares solve of the whole problem."""

import numpy as np
import pytest

from helio_jax.block_fit import eliminate, limit_steps
from helio_jax.robust import cauchy_weight

K, N, B, C = 5, 40, 3, 6


@pytest.mark.parametrize("damping", [0.0, 0.1])
@pytest.mark.parametrize("has_prior", [False, True])
def test_elimination_equals_the_dense_solution(damping, has_prior):
    """Steps and covariances of 6 common and 120 own unknowns: equal to those of the full normal matrix to 1e-9.

    Catches a Schur complement of the wrong sign, a prior that is left out of it, and pixel steps without the coupling.
    """
    rng = np.random.default_rng(1)
    residual, weight = rng.normal(size=(K, N)), rng.uniform(0.0, 2.0, (K, N))
    weight[0, :7] = 0.0
    by_own, by_common = rng.normal(size=(K, N, B)), rng.normal(size=(K, N, C))
    prior = (np.diag([1.0, 2.0, 0.5]), rng.normal(size=(N, B))) if has_prior else None
    found = eliminate(residual, weight, by_own, by_common, prior, damping)

    size = C + N * B
    rows = np.zeros((K * N, size))
    for k in range(K):
        for n in range(N):
            rows[k * N + n, :C] = by_common[k, n]
            rows[k * N + n, C + n * B : C + (n + 1) * B] = by_own[k, n]
    dense, right = rows.T @ (weight.reshape(-1, 1) * rows), rows.T @ (weight * residual).ravel()
    for n in range(N):
        own = slice(C + n * B, C + (n + 1) * B)
        if prior is not None:
            dense[own, own] += prior[0]
            right[own] += prior[1][n]
        dense[own, own] += damping * (np.trace(dense[own, own]) + 1.0) * np.eye(B)
    step, covariance = np.linalg.solve(dense, right), np.linalg.inv(dense)

    common = np.linalg.solve(found.information, found.right)
    np.testing.assert_allclose(common, step[:C], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(found.information), covariance[:C, :C], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.pixel_steps(common).ravel(), step[C:], rtol=1e-8, atol=1e-11)
    held = np.linalg.inv(dense[C : C + B, C : C + B])
    np.testing.assert_allclose(found.covariance[0], held, rtol=1e-9)
    alone = eliminate(residual, weight, by_own, None, prior, damping)
    np.testing.assert_allclose(alone.pixel_steps(), found.pixel_steps(np.zeros(C)), rtol=1e-12)


def test_weights_and_limits():
    """Half of the weight at the limit; long steps are shortened, short ones kept."""
    assert cauchy_weight(np.array([0.0, 2.5]), 2.5) == pytest.approx([1.0, 0.5])
    steps = np.array([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]])
    np.testing.assert_allclose(limit_steps(steps, 1.0), [[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]])
