"""How the large JAX functions are compiled: with XLA's older fusion code on CPUs, in about two thirds of the time.

Results and run time are the same (jaxlib 0.10). Where XLA does not know the option, it is left out.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax

P = ParamSpec("P")
R = TypeVar("R")
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


@cache
def _options() -> dict[str, Any]:
    """Return keyword arguments of `jax.jit`: the options, if this XLA knows them."""
    try:
        jax.jit(lambda x: x, compiler_options=_OPTIONS).lower(0.0).compile()
    except Exception:  # jaxlib has no error of its own for an unknown option
        return {}
    return {"compiler_options": _OPTIONS}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function at its first call for each structure and shape of its arguments; decorator.

    Arrays, NumPy's too, are traced; everything else is static.
    """

    @cache
    def jitted() -> Callable[P, R]:
        return eqx.filter_jit(function, **_options())

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        return jitted()(*args, **kwargs)

    return wrapped
