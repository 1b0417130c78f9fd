"""Convergence of the outer iterations of a fit: the error that remains, and how the fit ended."""

from collections.abc import Sequence

import numpy as np

SLOWEST = 0.9
"""Largest contraction per iteration that a fit is credited with: without convergence the error is nine last changes."""


def extrapolation(step: np.ndarray, change_before: np.ndarray, change: np.ndarray) -> float:
    """Estimate by what share of the last change an iteration reaches its limit, if it is linear along the last step.

    Above 1 where changes keep their sign, below where they alternate (a mask that is predicted too wide raises the
    surface in it, and the next one is predicted too narrow), 1 where the change has nothing to do with the one before.
    Changes that agree, or grow, give infinity or less than 0.

    Args:
        step: between the starts of the last two iterations.
        change_before, change: by these iterations.

    Source: secant method along the step, as Aitken's Delta^2 for vectors (Irons and Tuck, Int. J. Numer. Meth. Eng. 1
        (1969) 275; Kuettler and Wall, Comput. Mech. 43 (2008) 61, eq. 44), which takes any change that is larger than
        the one before, or square to it, for one that alternates.
    """
    falls = float(np.sum(step * (change_before - change)))
    return float(np.sum(step**2)) / falls if falls else np.inf


def contraction_of(changes: Sequence[float]) -> float | None:
    """Compute the ratio of the last two changes, or None where there are not two."""
    return changes[-1] / changes[-2] if len(changes) > 1 and changes[-2] > 0 else None


def remaining_error(changes: Sequence[float], extrapolated: float) -> float:
    """Estimate the distance of the heights from the limit of further iterations, in units of the last change.

    The larger of two: the distance to the extrapolation, nine changes at most; and, for iterates that oscillate or are
    limited by Monte Carlo noise, one change, or the rest of the geometric series if changes fall at the slower of their
    last two rates: one small change after larger ones proves nothing. The change of a single iteration is taken to
    halve.

    Args:
        changes: root mean square of the height changes of every iteration.
        extrapolated: `extrapolation` by the last two; unused with fewer.
    """
    known = [c for c in (contraction_of(changes), contraction_of(changes[:-1])) if c is not None]
    if not known:
        return 1.0
    contraction, most = max(known), SLOWEST / (1.0 - SLOWEST)
    linear = abs(extrapolated - 1.0) if 0.0 < extrapolated < 1.0 + most else most
    oscillating = contraction / (1.0 - contraction) if contraction < 0.5 else 1.0
    return max(linear, oscillating)


def has_converged(changes: Sequence[float], tolerance: float) -> bool:
    """Return whether the last change of the heights is below the tolerance [um]."""
    return changes[-1] < tolerance


def status_of(
    changes: Sequence[float], tolerance: float, is_interrupted: bool = False, is_traceable: bool = True
) -> str:
    """Describe how a fit ended, in a sentence.

    A last change above the one before is noise unless it also exceeds half of the largest one: then the fit diverges.

    Args:
        changes: of the heights in every iteration, um.
        tolerance: below which the fit has converged, um.
        is_interrupted: whether the user stopped it.
        is_traceable: whether the surface of the last iteration could be traced; if not, the one before is the result.
    """
    last = f"the last of {len(changes)} iterations changed the heights by {changes[-1]:.2f} um (limit {tolerance:g} um)"
    if is_interrupted:
        return f"interrupted: best so far; {last}"
    if not is_traceable:
        rough = "to a surface too rough or steep to be traced, which is not kept"
        return f"stopped: {last}, {rough}; check background and gains"
    if has_converged(changes, tolerance):
        return f"converged: {last}"
    if len(changes) > 1 and changes[-1] > max(changes[-2], 0.5 * max(changes)):
        contraction = contraction_of(changes)
        growth = "after none before" if contraction is None else f"{contraction:.2f} times the iteration before"
        return f"diverging: {last}, {growth}; raise mask_error or use nearfield"
    return f"stopped: {last}; raise max_rounds for more"
