"""The only place with sigmas: the statistical checks of the whole suite.

One family-wise false-alarm rate for the suite, FALSE_ALARM = 1e-6, shared by at most N_CHECKS statistical checks.
"""

import numpy as np
from scipy import stats

FALSE_ALARM = 1e-6
N_CHECKS = 50
P_MIN = FALSE_ALARM / N_CHECKS


def pooled_chi2(observed: np.ndarray, expected: np.ndarray, variance: np.ndarray, smallest: float = 10.0) -> float:
    """Return the p-value of Poisson counts against expectations that have a variance of their own.

    Cells whose expectation is below `smallest` are pooled in order of expectation until it is reached.
    """
    order = np.argsort(expected.ravel())
    o, e, v = (np.asarray(a, float).ravel()[order] for a in (observed, expected, variance))
    groups, total = np.zeros(o.size, int), 0.0
    for i in range(o.size):
        if i and total >= smallest:
            groups[i], total = groups[i - 1] + 1, 0.0
        elif i:
            groups[i] = groups[i - 1]
        total += e[i]
    o, e, v = (np.bincount(groups, a) for a in (o, e, v))
    if e[-1] < smallest and e.size > 1:
        o, e, v = (np.append(a[:-2], a[-2] + a[-1]) for a in (o, e, v))
    return float(stats.chi2.sf(np.sum((o - e) ** 2 / (e + v)), o.size))


def smallest_tail(observed: np.ndarray, expected: np.ndarray) -> float:
    """Return the Sidak-corrected p of the most unlikely Poisson count (exact two-sided tails)."""
    o, e = np.ravel(observed), np.maximum(np.ravel(expected), 1e-12)
    tail = np.minimum(1.0, 2.0 * np.minimum(stats.poisson.cdf(o, e), stats.poisson.sf(o - 1, e)))
    return float(-np.expm1(o.size * np.log1p(-np.min(tail) * (1 - 1e-16))))


def assert_likely(p: float, what: str) -> None:
    """Fail where a p-value is below the suite's limit per check."""
    assert p >= P_MIN, f"{what}: p = {p:.2e} is below {P_MIN:.0e}, the suite's false-alarm rate per check"


def assert_mean(value: float, expected: float, std_error: float, what: str) -> None:
    """Fail where a normal mean is further from its expectation than P_MIN allows."""
    assert_likely(float(2 * stats.norm.sf(abs(value - expected) / std_error)), f"{what}: {value:g} against {expected:g}")
