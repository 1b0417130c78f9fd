"""How the large JAX functions are compiled and batched.

`compiled`: with XLA's older fusion code on CPUs, in about two thirds of the time. Results and run time are the same
(jaxlib 0.10). Where XLA does not know the option, it is left out. `batched_in_chunks`: so that batches fit the cache.
"""

import os
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from helio_jax.cpus import n_cpus

P = ParamSpec("P")
R = TypeVar("R")
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
CHUNK = 1 << 17
"""Most numbers of a result that are computed at a time in a batch, unless one element of the batch has more."""

if n_cpus() == 1:
    # XLA has a thread for every core: a callback to the host would wait for ever for large arguments on a single one
    os.environ.setdefault("NPROC", "2")


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

    Arrays, NumPy's too, are traced; everything else is static. Within another JAX transformation the options are those
    of the outermost one.
    """

    @cache
    def jitted(*, is_outermost: bool) -> Callable[P, R]:
        return eqx.filter_jit(function, **(_options() if is_outermost else {}))

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        is_traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs)))
        return jitted(is_outermost=not is_traced)(*args, **kwargs)

    return wrapped


def is_zero(tangent: Any) -> bool:
    """Whether a tangent of a `custom_jvp` rule with symbolic zeros is one."""
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def batched_in_chunks(function: Callable[P, R]) -> Callable[P, R]:
    """Let `jax.vmap` compute few elements of a batch at a time; decorator for functions of arrays, without keywords.

    All at a time, sums over many terms would be limited by the memory instead of the processor. Derivatives are those
    of the function, of every order and mode; batches of derivatives are computed at a time.
    """

    @jax.custom_batching.custom_vmap
    def value(*args):
        return function(*args)  # type: ignore[call-arg]

    @value.def_vmap
    def _(axis_size, is_batched, *args):
        leaves, tree = jax.tree.flatten(args)
        number = [i for i, batched in enumerate(jax.tree.leaves(is_batched)) if batched]

        def of_element(own):
            return function(*jax.tree.unflatten(tree, _replaced(leaves, number, own)))  # type: ignore[call-arg]

        batch = [leaves[i] for i in number]
        out = jax.eval_shape(of_element, [leaf[0] for leaf in batch])
        most = max(1, CHUNK // max(leaf.size for leaf in jax.tree.leaves(out)))
        chunk = max(n for n in range(1, axis_size + 1) if axis_size % n == 0 and n <= most)
        found = jax.lax.map(of_element, batch, batch_size=chunk)
        return found, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def differentiable(*args):
        return value(*args)

    @partial(differentiable.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        leaves, tree = jax.tree.flatten(primals)
        changes = jax.tree.leaves(tangents, is_leaf=is_zero)
        number = [i for i, change in enumerate(changes) if not is_zero(change)]

        def of_changing(*own):
            return function(*jax.tree.unflatten(tree, _replaced(leaves, number, own)))  # type: ignore[call-arg]

        if not number:
            found = of_changing()
            return found, jax.tree.map(jnp.zeros_like, found)
        return jax.jvp(of_changing, [leaves[i] for i in number], [changes[i] for i in number])

    return wraps(function)(differentiable)


def _replaced(items: list[Any], number: list[int], other: Any) -> list[Any]:
    """Copy a list with other items at some places."""
    out = list(items)
    for i, item in zip(number, other, strict=True):
        out[i] = item
    return out
