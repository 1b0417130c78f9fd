"""Robust weights: how much a datum counts whose residual is too large for normal noise. NumPy or JAX arrays."""

from typing import Any


def cauchy_weight(misfit: Any, limit: Any) -> Any:
    """Compute 1 / (1 + (misfit / limit)^2), which is 1/2 at a misfit of `limit`.

    It is the weight of Cauchy's likelihood; its square is the redescending weight of Geman and McClure.

    Source: Geman and McClure, Bull. ISI 52 (1987) 5; as weights: Black and Rangarajan, IJCV 19 (1996) 57, sec. 4.
    """
    return 1.0 / (1.0 + (misfit / limit) ** 2)
