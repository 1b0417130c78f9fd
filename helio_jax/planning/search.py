"""Local minimum of a smooth function with constraints, by SciPy's SLSQP. Numbers in, numbers out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, minimize

ValueAndSlope = Callable[[np.ndarray], tuple[float, np.ndarray]]
TOLERANCE = 1e-4
"""Change of the function at which a search has converged."""


@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Attributes:
        x: point [unknown].
        value: of the function.
        least_room: of the constraints, which must be >= 0.
        status: a sentence that says how the search ended.
        n_steps: steps taken.
    """

    x: np.ndarray
    value: float
    least_room: float
    status: str
    n_steps: int


def minimise(
    function: ValueAndSlope,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    room: Callable[[np.ndarray], np.ndarray],
    room_slope: Callable[[np.ndarray], np.ndarray],
    max_steps: int,
) -> Minimum:
    """Minimise a function from a start; of all points that keep the constraints the best one is returned.

    Args:
        function: value and gradient [unknown].
        start: that keeps the constraints [unknown].
        bounds: least and largest values [unknown].
        room: constraints, >= 0 where they are kept [constraint].
        room_slope: their derivative [constraint, unknown].
        max_steps: most steps.

    Source: Kraft, DFVLR-FB 88-28 (1988), as in scipy.optimize.
    """
    best = np.asarray(start, float), np.inf

    def followed(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        value, slope = function(x)
        if value < best[1] and room(x).min(initial=np.inf) >= 0.0:
            best = x.copy(), value
        return value, slope

    kept = {"type": "ineq", "fun": room, "jac": room_slope}
    options = {"maxiter": max_steps, "ftol": TOLERANCE}
    limits = Bounds(*bounds)  # type: ignore[arg-type]  # SciPy's stubs know single numbers only
    found = minimize(followed, start, jac=True, method="SLSQP", bounds=limits, constraints=[kept], options=options)
    status = {0: "converged", 9: f"stopped after {max_steps} steps: allow more"}.get(
        found.status, f"stopped early ({found.message}); the best point is kept"
    )
    return Minimum(best[0], float(best[1]), float(room(best[0]).min(initial=np.inf)), status, int(found.nit))
