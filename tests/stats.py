"""The only place with sigmas: the statistical checks of the whole suite.

One family-wise false-alarm rate for the suite, FALSE_ALARM = 1e-6, shared by at most N_CHECKS statistical checks.
"""

import numpy as np
from scipy import stats

FALSE_ALARM = 1e-6
N_CHECKS = 400
P_MIN = FALSE_ALARM / N_CHECKS


def pooled_chi2(
    observed: np.ndarray, expected: np.ndarray, variance: np.ndarray, smallest: float = 10.0, dof: float = np.inf
) -> float:
    """Return the p-value of Poisson counts against expectations that have a variance of their own.

    Cells are pooled with their neighbours in scan order (not by our noisy expectation) until a block expects `smallest`
    on average; blocks that still expect less are pooled into one. Where `variance` is itself an estimate, of `dof`
    degrees of freedom, the deviations are Student's with the dof of Welch and Satterthwaite.
    """
    o, e, v = (np.asarray(a, float).ravel() for a in (observed, expected, variance))
    block = np.arange(o.size) // max(1, int(np.ceil(smallest / max(e.mean(), smallest / o.size))))
    o, e, v, v2 = (np.bincount(block, a) for a in (o, e, v, v**2))
    is_small = e < smallest
    if is_small.any():
        o, e, v, v2 = (np.append(a[~is_small], a[is_small].sum()) for a in (o, e, v, v2))
    if e[-1] + v[-1] <= 0.0:  # nothing expected here (our estimate may be below 0): any count at all is impossible
        if o[-1] > 0:
            return 0.0
        o, e, v, v2 = o[:-1], e[:-1], v[:-1], v2[:-1]
    if e.size == 0:
        return 1.0
    t = np.abs(o - e) / np.sqrt(e + v)
    of_all = np.where(v2 > 0, dof * (e + v) ** 2 / np.maximum(v2, 1e-300), np.inf)
    z = stats.norm.isf(np.maximum(stats.t.sf(t, np.minimum(of_all, 1e9)), 1e-300))
    return float(stats.chi2.sf(np.sum(z**2), o.size))


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
    assert_likely(
        float(2 * stats.norm.sf(abs(value - expected) / std_error)), f"{what}: {value:g} against {expected:g}"
    )
