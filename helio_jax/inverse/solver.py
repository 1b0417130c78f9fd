"""One least-squares solve of the fit by Levenberg-Marquardt; only door to optimistix and lineax."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from helio_jax.inverse.residuals import Lagged, Model, Surface, Unknowns

_FIRST_STEP_SIZE, _SHRINK = 1e3, 0.1
"""Inverse of the first Levenberg-Marquardt damping, in whitened variables, and its factor after a rejected step."""


class _TruncatedCG(lx.CG):
    """Conjugate gradients from 0, until the norm of the residual has fallen by `rtol` or the steps are up.

    An inexact Newton step. The operator is compiled once, where `lx.CG` has three copies of it.

    Source: Hestenes and Stiefel, J. Res. NBS 49 (1952) 409; Dembo, Eisenstat and Steihaug, SINUM 19 (1982) 400.
    """

    def compute(self, state, vector, options):
        operator, _ = state
        square = jnp.vdot(vector, vector)

        def is_unfinished(carry):
            _, _, _, now, step = carry
            return (now > self.rtol**2 * square) & (step < self.max_steps)

        def body(carry):
            x, r, p, now, step = carry
            image = operator.mv(p)
            size = now / jnp.vdot(p, image)
            x, r = x + size * p, r - size * image
            new = jnp.vdot(r, r)
            return x, r, r + new / now * p, new, step + 1

        x, _, _, _, steps = jax.lax.while_loop(is_unfinished, body, (jnp.zeros_like(vector), vector, vector, square, 0))
        return x, lx.RESULTS.successful, {"num_steps": steps, "max_steps": self.max_steps}


class _NearlyNewton(optx.ClassicalTrustRegion):
    """Trust region that starts with little damping: the start is good, and damping would freeze weak modes."""

    def init(self, y, f_info_struct):
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, jnp.asarray(_FIRST_STEP_SIZE))


class Solution(NamedTuple):
    """One solve: unknowns, surface, expected data, and the cost of every kind of residual."""

    unknowns: Unknowns
    surface: Surface
    counts: jax.Array
    cost: dict[str, jax.Array]


@eqx.filter_jit
def whitened_instrument(model: Model, start: Unknowns, lagged: Lagged, is_level_free: np.ndarray) -> jax.Array:
    """Return the matrix whose columns are instruments and levels that the data tell apart, by one standard deviation.

    Gains, offsets, drift, angles and the level of all heights [um], the last row, have much the same effect on the
    data, and by far more than one pixel's height: as they are, conjugate gradients would take many steps for them
    alone. The level takes part 1 or 0 times; a flat border holds it.
    """
    names = model.instrument_fields(start)
    surface = model.surface(start, lagged)
    flat, restore = ravel_pytree(({name: getattr(start, name) for name in names}, jnp.zeros(1)))

    def residuals(values):
        instrument, level = restore(values)
        unknowns, raised = start._replace(**instrument), surface._replace(height=surface.height + is_level_free * level)
        parts = model.data_residuals(raised, unknowns, lagged), model.border_residuals(raised, unknowns, lagged)
        return jnp.concatenate([part.ravel() for part in parts])

    jacobian = jax.jacfwd(residuals)(flat)
    prior = jnp.ones(flat.size).at[-1].add(-is_level_free)
    factor = jnp.linalg.cholesky(jacobian.T @ jacobian + jnp.diag(prior))
    mixing = jax.scipy.linalg.solve_triangular(factor, jnp.eye(flat.size), lower=True).T
    return mixing.at[-1].multiply(is_level_free)


@eqx.filter_jit
def solve(
    model: Model,
    start: Unknowns,
    lagged: Lagged,
    max_steps: int,
    cg_steps: int,
    mixing: jax.Array | np.ndarray,
    is_instrument_free: np.ndarray,
) -> Solution:
    """Solve from `start`; the instrument, 1 or 0 times free, and the sample's albedo move along `mixing`'s columns."""
    solver = optx.LevenbergMarquardt(
        rtol=1e-4, atol=1e-6, linear_solver=lx.Normal(_TruncatedCG(rtol=1e-2, atol=0.0, max_steps=cg_steps))
    )
    solver = eqx.tree_at(
        lambda s: s.search, solver, _NearlyNewton(low_constant=_SHRINK), is_leaf=lambda n: n is solver.search
    )
    names = model.instrument_fields(start)
    flat, restore = ravel_pytree(({name: getattr(start, name) for name in names}, jnp.zeros(1)))
    seen = jnp.sum(lagged.inverse_sigma**2, 2 - model.slow_axis) * lagged.lines_std[:, None] ** 2
    line_scale = is_instrument_free / jnp.sqrt(1.0 + seen)
    is_free = {n: jnp.full_like(getattr(start, n), 1.0 if n == "albedo" else is_instrument_free) for n in names}
    mixing = ravel_pytree((is_free, jnp.full(1, is_instrument_free)))[0][:, None] * mixing

    def decoded(variables: jax.Array) -> Unknowns:
        surface, mixed, lines = split(variables)
        instrument, level = restore(flat + mixing @ mixed)
        unknowns = start._replace(**surface, **instrument)
        unknowns = unknowns._replace(height=unknowns.height.at[0, 0].add(level[0] * level_mode))
        return unknowns._replace(lines=start.lines + line_scale * lines) if start.lines.size else unknowns

    level_mode = jnp.sqrt(lagged.border.size) / lagged.whitening[0, 0]
    surface = {name: getattr(start, name) for name in Surface._fields}
    # one vector each, for every array of a tree is compiled by itself
    variables, split = ravel_pytree((surface, jnp.zeros_like(flat), jnp.zeros_like(start.lines)))
    found = optx.least_squares(
        lambda v, args: ravel_pytree(model.residuals(decoded(v), args))[0],
        solver,
        variables,
        args=lagged,
        max_steps=max_steps,
        throw=False,
    )
    unknowns = decoded(found.value)
    surface = model.surface(unknowns, lagged)
    counts = model.counts(surface, unknowns, lagged)
    cost = {name: 0.5 * jnp.sum(r**2) for name, r in model.residuals(unknowns, lagged).items()}
    return Solution(unknowns, surface, counts, cost)
