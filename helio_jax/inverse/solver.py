"""One least-squares solve of the fit by inexact Gauss-Newton steps; the only door to optimistix."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from helio_jax.forward.compiling import compiled
from helio_jax.forward.surface import Surface
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.residuals import FixedTerms, Unknowns, border_residuals, data_residuals, residuals, surface_of

OF_SAMPLE = "albedo", "patch"
"""Parameters that are free even while the instrument is held."""
WEAK = 1e-6
"""Prior weight of common changes of the heights where they are whitened, or one that the data do not show would be
infinite. A part of the preconditioner, not of the solution."""
CG_TOLERANCE = 1e-2
"""Relative residual of the normal equations at which conjugate gradients stop."""


def conjugate_gradients(
    operator: Callable[[jax.Array], jax.Array], vector: jax.Array, max_steps: int
) -> tuple[jax.Array, jax.Array]:
    """Solve operator(x) = vector from x = 0, to `CG_TOLERANCE` or `max_steps`; return x and the relative residual.

    Source: Hestenes and Stiefel, J. Res. NBS 49 (1952) 409.
    """
    square = jnp.vdot(vector, vector)

    def is_unfinished(carry):
        _, _, _, now, step = carry
        return (now > CG_TOLERANCE**2 * square) & (step < max_steps)

    def body(carry):
        x, r, p, now, step = carry
        image = operator(p)
        size = now / jnp.vdot(p, image)
        x, r = x + size * p, r - size * image
        new = jnp.vdot(r, r)
        return x, r, r + new / now * p, new, step + 1

    x, _, _, now, _ = jax.lax.while_loop(is_unfinished, body, (jnp.zeros_like(vector), vector, vector, square, 0))
    return x, jnp.sqrt(now / jnp.maximum(square, 1e-300))


class _Direction(NamedTuple):
    """The Gauss-Newton step from the accepted point, and the relative residual of its normal equations."""

    newton: jax.Array
    residual: jax.Array


class InexactNewton(optx.AbstractDescent):
    """Gauss-Newton direction by truncated conjugate gradients, whose number of steps also regularises.

    Source: Dembo, Eisenstat and Steihaug, SINUM 19 (1982) 400.
    """

    cg_steps: int

    def init(self, y, f_info_struct):
        return _Direction(jnp.zeros_like(y), jnp.ones((), y.dtype))

    def query(self, y, f_info, state):
        along, back = f_info.jac.mv, f_info.jac.transpose().mv
        return _Direction(*conjugate_gradients(lambda v: back(along(v)), back(f_info.residual), self.cg_steps))

    def step(self, step_size, state):
        return -step_size * state.newton, optx.RESULTS.successful


class GaussNewton(optx.AbstractGaussNewton):
    """optimistix's Gauss-Newton method with inexact directions and Armijo's backtracking."""

    rtol: float
    atol: float
    norm: Callable[[Any], Any]
    descent: InexactNewton
    search: optx.AbstractSearch
    verbose: Callable[..., None]

    def __init__(self, cg_steps: int) -> None:
        self.rtol, self.atol, self.norm, self.verbose = 1e-4, 1e-6, optx.max_norm, lambda **_: None
        self.descent, self.search = InexactNewton(cg_steps), optx.BacktrackingArmijo(decrease_factor=0.25)


class Solution(NamedTuple):
    """One solve.

    Attributes:
        parameters, surface: found.
        data: expected there, as measured where not observed [detector, y, x].
        cost: half the sum of squares of all residuals.
        is_converged: whether optimistix met its tolerances within its steps.
        next_step_um: root mean square height change of the next Gauss-Newton step from there.
        cg_residual: relative residual of that step's normal equations; above `CG_TOLERANCE` they are truncated.
    """

    parameters: Parameters
    surface: Surface
    data: jax.Array
    cost: jax.Array
    is_converged: jax.Array
    next_step_um: jax.Array
    cg_residual: jax.Array

    @property
    def status(self) -> str:
        """How the optimiser ended, in a sentence."""
        steps = "met its tolerances" if self.is_converged else "stopped at its number of steps"
        cg = "converged" if self.cg_residual <= CG_TOLERANCE else "truncated"
        return (
            f"Gauss-Newton {steps}, its next step would change the heights by {self.next_step_um:.2g} um "
            f"(conjugate gradients {cg} at a relative residual of {self.cg_residual:.1g})"
        )


def free_parameters(parameters: Parameters) -> tuple[jax.Array, Callable[[jax.Array], Parameters]]:
    """Return the unknown parameters, scan lines excepted, as one vector, and the function that puts such back."""
    names = parameters.free()
    flat, restore = ravel_pytree([getattr(parameters, name) for name in names])
    return flat, lambda vector: parameters.replaced(**dict(zip(names, restore(vector), strict=True)))


def _is_free(parameters: Parameters, is_instrument_free: Any) -> jax.Array:
    """Make 1 for what is of the sample, `is_instrument_free` for all else, in the order of `free_parameters`."""
    sizes = ((name, getattr(parameters, name).size) for name in parameters.free())
    return jnp.concatenate([jnp.full(n, 1.0 if name in OF_SAMPLE else is_instrument_free) for name, n in sizes])


class CommonHeights(eqx.Module):
    """Changes of the surface that all heights have in common, as changes of the whitened unknowns [change, y, x].

    They are nearly degenerate with gains and geometry. By single heights alone, conjugate gradients would take many
    steps for them.
    """

    height: Any
    slope_x: Any
    slope_y: Any

    def moved(self, unknowns: Unknowns, amplitude: jax.Array) -> Unknowns:
        """Move unknowns by amplitudes [change] of the changes."""
        return Unknowns(
            unknowns.height + jnp.tensordot(amplitude, self.height, 1),
            unknowns.slope_x + jnp.tensordot(amplitude, self.slope_x, 1),
            unknowns.slope_y + jnp.tensordot(amplitude, self.slope_y, 1),
            unknowns.parameters,
        )


@compiled
def whitened_parameters(
    start: Unknowns, fixed: FixedTerms, common: CommonHeights, is_instrument_free: np.ndarray
) -> jax.Array:
    """Compute the matrix whose columns are combinations of parameters and changes that all heights have in common.

    Moved along them, the residuals change by one standard deviation each, and in ways that are orthogonal. The last
    rows are the amplitudes of `common`. Held parameters of the instrument do not take part.

    Source: coarse space of a two-level preconditioner: Nicolaides, SIAM J. Numer. Anal. 24 (1987) 355.
    """
    flat, restore = free_parameters(start.parameters)

    def misfit(values):
        parameters = restore(values[: flat.size])
        moved = common.moved(Unknowns(start.height, start.slope_x, start.slope_y, parameters), values[flat.size :])
        surface = surface_of(moved, fixed)
        parts = data_residuals(surface, parameters, fixed), border_residuals(surface, parameters, fixed)
        return jnp.concatenate([part.ravel() for part in parts])

    n_common = len(common.height)
    is_free = jnp.append(_is_free(start.parameters, is_instrument_free), jnp.ones(n_common))
    jacobian = jax.jacfwd(misfit)(jnp.append(flat, jnp.zeros(n_common))) * is_free
    prior = jnp.append(jnp.ones(flat.size), jnp.full(n_common, WEAK))
    factor = jnp.linalg.cholesky(jacobian.T @ jacobian + jnp.diag(prior))
    return jax.scipy.linalg.solve_triangular(factor, jnp.eye(is_free.size), lower=True).T


@compiled
def solve(
    start: Unknowns,
    fixed: FixedTerms,
    common: CommonHeights,
    max_steps: int,
    cg_steps: int,
    mixing: jax.Array | np.ndarray,
    is_instrument_free: np.ndarray,
) -> Solution:
    """Solve from `start`; parameters and what all heights have in common move along `mixing`'s columns, too.

    The instrument is 1 or 0 times free.
    """
    flat, restore = free_parameters(start.parameters)
    lines = start.parameters.lines
    seen = jnp.sum(fixed.inverse_sigma**2, 2 - fixed.slow_axis) * fixed.priors.lines[:, None] ** 2
    line_scale = is_instrument_free / jnp.sqrt(1.0 + seen)
    is_free = jnp.append(_is_free(start.parameters, is_instrument_free), jnp.ones(len(common.height)))
    mixing = is_free[:, None] * mixing

    def decoded(variables: jax.Array) -> Unknowns:
        (height, slope_x, slope_y), mixed, of_lines = split(variables)
        moved = mixing @ mixed
        parameters = restore(flat + moved[: flat.size])
        if lines.size:
            parameters = parameters.replaced(lines=lines + line_scale * of_lines)
        return common.moved(Unknowns(height, slope_x, slope_y, parameters), moved[flat.size :])

    # one vector, for every array of a tree is compiled by itself
    fields = (start.height, start.slope_x, start.slope_y)
    variables, split = ravel_pytree((fields, jnp.zeros(len(mixing)), jnp.zeros_like(lines)))

    def misfit(v: jax.Array, args: FixedTerms) -> jax.Array:
        parts = residuals(decoded(v), args)
        return jnp.concatenate([parts.pop("data").ravel(), *(jnp.ravel(part) for part in parts.values())])

    found = optx.least_squares(misfit, GaussNewton(cg_steps), variables, args=fixed, max_steps=max_steps, throw=False)
    unknowns, state = decoded(found.value), found.state
    data = state.f_info.residual[: fixed.data.size].reshape(fixed.data.shape)
    is_used = fixed.inverse_sigma > 0.0
    return Solution(
        unknowns.parameters,
        surface_of(unknowns, fixed),
        fixed.data + jnp.where(is_used, data / jnp.where(is_used, fixed.inverse_sigma, 1.0), 0.0),
        0.5 * jnp.sum(state.f_info.residual**2),
        found.result == optx.RESULTS.successful,
        # the cosine transform keeps the norm
        jnp.sqrt(jnp.mean((split(state.descent_state.newton)[0][0] * fixed.whitening) ** 2)),
        state.descent_state.residual,
    )
