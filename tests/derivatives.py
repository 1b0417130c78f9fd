"""The only place with Taylor and adjoint tests: their numbers, for functions of any tree of arrays to another."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def dot(a: Any, b: Any) -> float:
    """Return the inner product of two trees of arrays."""
    return sum(float(jnp.sum(x * y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def taylor_remainders(
    function: Callable[[Any], Any], start: Any, direction: Any, steps: Sequence[float]
) -> list[float]:
    """Return |f(x + s v) - f(x) - s J v| for every step s: it falls as s^2 if J is the derivative, as s if not."""
    value, slope = jax.jvp(function, (start,), (direction,))
    rest = []
    for step in steps:
        moved = function(jax.tree.map(lambda x, v, s=step: x + s * v, start, direction))
        gap = jax.tree.map(lambda m, f, j, s=step: m - f - s * j, moved, value, slope)
        rest.append(float(np.sqrt(dot(gap, gap))))
    return rest


def adjoint_products(
    function: Callable[[Any], Any], start: Any, direction: Any, weigh: Callable[[Any], Any]
) -> tuple[float, float]:
    """Return <J v, w> and <v, J' w>, w being made by `weigh` from the value."""
    value, slope = jax.jvp(function, (start,), (direction,))
    weight = weigh(value)
    (back,) = jax.vjp(function, start)[1](weight)
    return dot(slope, weight), dot(direction, back)
