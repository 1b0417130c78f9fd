"""Work on a surface that may be too rough to be traced: the step towards it is halved until one can."""

from collections.abc import Callable
from typing import Any

import jax

from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface

MAX_BACKTRACKS = 4
"""How often a surface is smoothed when masks and multiple scattering cannot be predicted for it."""


def with_backtracking(work: Callable[[Surface], Any], surface: Surface, smoothed: Surface) -> tuple[Any, Surface]:
    """Run `work` on a surface; on PredictionError, halve the step from a smoothed one to it (`MAX_BACKTRACKS`)."""
    for _ in range(MAX_BACKTRACKS):
        try:
            return work(surface), surface
        except PredictionError:
            surface = jax.tree.map(lambda rough, smooth: 0.5 * (rough + smooth), surface, smoothed)
    return work(surface), surface
