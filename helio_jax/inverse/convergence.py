"""How the rounds of a fit come to rest: how far there is left to go, how it ended."""

from collections.abc import Sequence

import numpy as np

SLOWEST = 0.9
"""Contraction per round that a fit is credited with at least: what does not converge is off by nine last changes."""


def aitken(change_before: np.ndarray, change: np.ndarray) -> float:
    """Return after how many times the last change of the heights, by it and the one before, rounds would be at rest.

    It is above 1 where changes creep, below where they swing: a wall's shadow that is predicted too wide raises what
    lies in it, and the next one is predicted too narrow. Changes that agree, or grow, give infinity, or less than 0.

    Source: Aitken's Delta^2 for vectors: Irons and Tuck, Int. J. Numer. Meth. Eng. 1 (1969) 275; Kuettler and Wall,
        Comput. Mech. 43 (2008) 61, eq. 44.
    """
    apart = change_before - change
    square = float(np.sum(apart**2))
    return float(np.sum(change_before * apart)) / square if square else np.inf


def contraction_of(changes: Sequence[float]) -> float | None:
    """Return by what factor the last round's change is that of the round before, or None where there is none."""
    return changes[-1] / changes[-2] if len(changes) > 1 and changes[-2] > 0 else None


def remaining_error(changes: Sequence[float], extrapolation: float) -> float:
    """Return how far the heights are from where further rounds would take them, in changes of the last one.

    Rounds that creep have as far to go as `aitken` says, nine changes at most. Those that swing, or tremble for their
    predictions are noisy, are off by one change, or by what is left of it if changes go on to fall as the last two did,
    by the lesser fall: one that happens to be small after others that were not says nothing. A single round's change is
    taken to halve.

    Args:
        changes: root mean square of the changes of the heights in every round.
        extrapolation: from `aitken` by the last two; of no use with fewer.
    """
    known = [c for c in (contraction_of(changes), contraction_of(changes[:-1])) if c is not None]
    if not known:
        return 1.0
    contraction, most = max(known), SLOWEST / (1.0 - SLOWEST)
    creeps = extrapolation - 1.0 if 0.0 < extrapolation < 1.0 + most else most
    swings = contraction / (1.0 - contraction) if contraction < 0.5 else 1.0
    return max(creeps, swings)


def status_of(changes: Sequence[float], tolerance: float, is_interrupted: bool = False) -> str:
    """Return how a fit ended, in a sentence.

    A last change that is larger than the one before is a jitter about the result unless it is also more than half of
    the largest one: then the fit diverges.

    Args:
        changes: of the heights in every round, um.
        tolerance: below which a change counts as none, um.
        is_interrupted: whether the user stopped it.
    """
    last = f"the last of {len(changes)} rounds changed the heights by {changes[-1]:.2f} um (limit {tolerance:g} um)"
    if is_interrupted:
        return f"interrupted: best so far; {last}"
    if changes[-1] < tolerance:
        return f"converged: {last}"
    if len(changes) > 1 and changes[-1] > max(changes[-2], 0.5 * max(changes)):
        contraction = contraction_of(changes)
        growth = "after none before" if contraction is None else f"{contraction:.2f} times the round before"
        return f"diverging: {last}, {growth}; raise mask_error or use nearfield"
    return f"stopped: {last}; raise max_rounds for more"
