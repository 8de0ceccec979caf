"""The constraint solver: Newton's method with a fixed number of steps, so that an accelerator has no loop to wait for.

It minimises MuJoCo's cost of an acceleration a (its documentation, "Computation: Constraint solver"),
1/2 a'Ma - a'f + sum_i 1/2 D_i (J a - aref)_i^2 over the rows that are active, which is convex and piecewise quadratic.
MJX has the same in a loop that runs until every robot of the batch has converged.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from cassie_mjx.physics.constraints import Rows

UNROLLED = 8
"""Up to this many steps are written out one after another; more, for checks of convergence, are a loop."""


class Solution(NamedTuple):
    """An acceleration [nv] and the joint forces of the constraints [nv] that go with it."""

    qacc: jax.Array
    force: jax.Array


def solve(
    mass: jax.Array, force: jax.Array, rows: Rows, loops: int, start: jax.Array, steps: int, search_steps: int
) -> Solution:
    """The acceleration of one robot.

    Args:
      mass: inertia M, [nv, nv].
      force: joint forces f of all but the constraints, [nv].
      rows: constraints; the first `loops` are always active, the others where they push.
      loops: number of those.
      start: acceleration to start from, [nv]; the last one is a good one.
      steps: Newton steps.
      search_steps: steps of each line search.
    """
    free = rows.J[loops:], rows.D[loops:]
    held = mass + (rows.J[:loops].T * rows.D[:loops]) @ rows.J[:loops]

    def active(x: jax.Array) -> jax.Array:
        return rows.D * jnp.concatenate([jnp.ones(loops, x.dtype), (x[loops:] < 0).astype(x.dtype)])

    def step(_: int, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        a, x, inertial = carry
        weight = active(x)
        gradient = inertial - force + rows.J.T @ (weight * x)
        hessian = held + (free[0].T * weight[loops:]) @ free[0]
        p = -solve_positive(hessian, gradient)
        along, inertial_p = rows.J @ p, mass @ p
        alpha = _line_search(active, x, along, p @ (inertial - force), p @ inertial_p, search_steps)
        return a + alpha * p, x + alpha * along, inertial + alpha * inertial_p

    begin = (start, rows.J @ start - rows.aref, mass @ start)
    a, x, _ = jax.lax.fori_loop(0, steps, step, begin, unroll=steps <= UNROLLED or 1)
    return Solution(a, -rows.J.T @ (active(x) * x))


def _line_search(
    active: Callable[[jax.Array], jax.Array],
    x: jax.Array,
    along: jax.Array,
    slope: jax.Array,
    curvature: jax.Array,
    steps: int,
) -> jax.Array:
    """How far to go along p, []: Newton's method on the cost's derivative, kept inside a bracket.

    Args:
      active: weight of each row, [rows], for residuals [rows].
      x: residuals J a - aref, [rows].
      along: what they change by along p, [rows].
      slope: derivative along p of the cost without constraints, [].
      curvature: its second derivative, [].
      steps: how often to improve on the whole step, 1.
    """

    def step(_: int, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        alpha, low, high = carry
        weight = active(x + alpha * along)
        first = slope + alpha * curvature + (weight * along * (x + alpha * along)).sum()
        second = curvature + (weight * along * along).sum()
        low, high = jnp.where(first < 0, alpha, low), jnp.where(first > 0, alpha, high)
        better = alpha - first / jnp.maximum(second, jnp.finfo(x.dtype).tiny)
        return jnp.where((low <= better) & (better <= high), better, (low + high) / 2), low, high

    begin = tuple(jnp.asarray(value, x.dtype) for value in (1, 0, jnp.inf))
    return jax.lax.fori_loop(0, steps, step, begin, unroll=steps <= UNROLLED or 1)[0]


def solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Solve A x = b for a positive definite A [n, n] and b [n]."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), vector)
