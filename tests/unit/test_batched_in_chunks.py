"""Batches that are computed a few elements at a time: values and derivatives are those of the plain function."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward import compiling
from helio_jax.forward.compiling import batched_in_chunks


def plain(arrays, number):
    """Compute two results, of 4 and 3 numbers, from nested arguments, one of them an index."""
    x, (y, index) = arrays
    return {"sum": jnp.cumsum(jnp.sin(x) * y), "taken": x[index] * number}


def inputs(n_batch):
    rng = np.random.default_rng(2)
    x, y, index = rng.normal(size=(n_batch, 4)), rng.normal(size=4), rng.integers(0, 4, (n_batch, 3))
    return jnp.asarray(x), jnp.asarray(y), jnp.asarray(index)


def agree(ours, exact):
    """Whether two trees agree to 1e-13."""
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(exact), strict=True)
    return all(np.allclose(a, b, rtol=1e-13, atol=1e-13) for a, b in pairs)


AXES = ((0, (None, 0)), None)
"""Batched: x and the index, not y."""


@pytest.mark.parametrize(("n_batch", "room", "length"), [(6, 9, 3), (7, 9, 7), (6, 1, 6), (5, 1000, 1)])
def test_batches(monkeypatch, n_batch, room, length):
    """Chunks of 2; of 1, as 7 is prime; of 1, as nothing fits; all at a time. Some arguments are not batched.

    Catches chunks that do not divide the batch, batched arguments taken for common ones, exchanged leaves, and a batch
    that is computed as a whole.
    """
    monkeypatch.setattr(compiling, "CHUNK", room)
    with jax.enable_x64(True):
        x, y, index = inputs(n_batch)
        batch = jax.vmap(batched_in_chunks(plain), in_axes=AXES)
        assert agree(batch((x, (y, index)), 2.0), jax.vmap(plain, in_axes=AXES)((x, (y, index)), 2.0))
        program = str(jax.make_jaxpr(batch)((x, (y, index)), 2.0))
        assert max([1, *map(int, re.findall(r" length=(\d+)", program))]) == length
        outer = ((0, (0, None)), None)
        pair = (jnp.stack([x, 2.0 * x]), (jnp.stack([y, -y]), index))
        nested, exact = (jax.vmap(jax.vmap(f, in_axes=AXES), in_axes=outer) for f in (batched_in_chunks(plain), plain))
        assert agree(nested(pair, 2.0), exact(pair, 2.0))


@pytest.mark.parametrize("argument", [0, 1, (0, 1)])
def test_derivatives_of_every_order_and_mode(argument):
    """Reverse, forward, reverse over forward and over reverse, and batches of them.

    Catches a rule that cannot be transposed, as that of `custom_vmap` alone, and tangents of the wrong argument.
    """
    with jax.enable_x64(True):
        x, y, index = inputs(3)

        def of(function):
            return lambda x, y: function((x, (y, index[0])), 2.0)["sum"] ** 2

        for first, second in ((jax.jacrev, None), (jax.jacfwd, None), (jax.jacfwd, jax.jacrev), (jax.jacrev,) * 2):
            ours, exact = (first(of(f), argument) for f in (batched_in_chunks(plain), plain))
            if second:
                ours, exact = second(ours, argument), second(exact, argument)
            assert agree(ours(x[0], y), exact(x[0], y))
            assert agree(*(jax.vmap(f, in_axes=(0, None))(x, y) for f in (ours, exact)))
