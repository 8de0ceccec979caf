"""What holds a robot together and up, as rows J qacc = aref of a soft constraint: loops, joint limits, contacts.

The formulas are MuJoCo's (its documentation, "Computation: Constraint model"). The loops' rows have the bias J̇v, which
MJX 3.17 leaves out and MuJoCo C has.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx.physics.tree import Motion, Tree, cross
from cassie_mjx.robot.arrays import Array


class Rows(NamedTuple):
    """Constraint rows: the loops', which hold always; then limits and contacts, which only push.

    Attributes:
      J: Jacobian, [rows, nv].
      D: inverse of each row's regularisation, [rows]; 0 for a limit or contact that is not reached.
      aref: reference acceleration, [rows].
    """

    J: jax.Array
    D: jax.Array
    aref: jax.Array


class Constraints:
    """The constraints of a model: `connect` loops, limits of hinges, and the contacts that MJX looks for.

    Attributes:
      loops: rows of the loops, the first ones.
    """

    def __init__(self, model: mujoco.MjModel, tree: Tree, geoms: np.ndarray, dim: np.ndarray) -> None:
        """Read them from a compiled model.

        Args:
          model: its equality constraints are `connect` between bodies; only hinges have limits.
          tree: of the same model.
          geoms: the two geoms of each contact in the order of `mjx.collision`, [2, contacts].
          dim: 1 for a contact without friction, 3 with, [contacts]; those without come first.
        """
        self._tree, self.loops = tree, 3 * model.neq
        self._ends = np.concatenate([model.eq_obj1id, model.eq_obj2id])
        limited = np.flatnonzero(model.jnt_limited)
        self._limited, self._limited_dofs = limited, np.eye(model.nv)[model.jnt_dofadr[limited]]
        self._touching, self._frictional = model.geom_bodyid[geoms], dim > 1

    def rows(self, m: Array, d: Array, motion: Motion) -> Rows:
        """All rows of a robot, after `mjx.collision`."""
        parts = [self._loops(m, d, motion), self._limits(m, d), *self._contacts(m, d, motion)]
        return Rows(*(jnp.concatenate(part) for part in zip(*parts, strict=True)))

    def inverse_weights(self, m: Array, d: Array) -> dict[str, jax.Array]:
        """The inverse masses that rows are softened by, fields of a model that MuJoCo C derives as it compiles one.

        They are those of hinges, and of bodies along straight lines, at `qpos0`; no row asks for others.

        Args:
          m: the model, whose own inverse masses may be another's.
          d: data of it.
        """
        d = self._tree.kinematics(m, d.replace(qpos=m.qpos0))
        motion = self._tree.motion(m, d)
        mass = self._tree.mass_matrix(m, motion)
        inverse = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(mass), jnp.eye(len(mass), dtype=mass.dtype))
        j = _point_jacobians(self._tree.moves.astype(mass.dtype), d.xipos - motion.com, motion.cdof)
        # A third of the trace of J M^-1 J'
        straight = ((j @ inverse) * j).sum(axis=(1, 2)) / 3
        return {"body_invweight0": m.body_invweight0.at[:, 0].set(straight), "dof_invweight0": jnp.diag(inverse)}

    def _loops(self, m: Array, d: Array, motion: Motion) -> Rows:
        loops = len(self._ends) // 2
        offset = jnp.concatenate([m.eq_data[:, :3], m.eq_data[:, 3:6]])
        xpos, xmat, cvel, bias = (_pick(x, self._ends) for x in (d.xpos, d.xmat, motion.cvel, motion.bias))
        anchors = xpos + (xmat * offset[:, None, :]).sum(axis=-1)
        r = anchors - motion.com
        jacobians = _point_jacobians(self._tree.moves[self._ends].astype(r.dtype), r, motion.cdof)
        # With v_p = v_c + omega x r: a_p = a_c + alpha x r + omega x v_p
        omega, alpha = cvel[:, :3], bias[:, :3]
        jdot_v = bias[:, 3:] + cross(alpha, r) + cross(omega, cvel[:, 3:] + cross(omega, r))
        j, gap, jdot_v = (x[:loops] - x[loops:] for x in (jacobians, anchors, jdot_v))
        weight = self._weight(m, self._ends[:loops], self._ends[loops:])
        distance = jnp.sqrt((gap * gap).sum(axis=1))
        rows = _soften(m, j, j @ d.qvel, gap, distance, weight, m.eq_solref, m.eq_solimp)
        return rows._replace(aref=rows.aref - jdot_v.reshape(-1))

    def _limits(self, m: Array, d: Array) -> Rows:
        dofs = self._limited_dofs.astype(d.qpos.dtype)
        angles = dofs @ (self._tree.hinge_angles.astype(d.qpos.dtype) @ d.qpos)
        span = m.jnt_range[self._limited]
        below, above = angles - span[:, 0], span[:, 1] - angles
        j = jnp.where(below < above, 1.0, -1.0).astype(angles.dtype)[:, None] * dofs
        gap = jnp.minimum(below, above) - m.jnt_margin[self._limited]
        weight = dofs @ m.dof_invweight0
        solref, solimp = m.jnt_solref[self._limited], m.jnt_solimp[self._limited]
        return _pushing(_soften(m, j[:, None], (j @ d.qvel)[:, None], gap[:, None], gap, weight, solref, solimp), gap)

    def _contacts(self, m: Array, d: Array, motion: Motion) -> list[Rows]:
        """Rows of the contacts without friction, and of the edges of the friction pyramids of the others."""
        contact, rows = d._impl.contact, []
        for chosen in (np.flatnonzero(~self._frictional), np.flatnonzero(self._frictional)):
            if not len(chosen):
                continue
            c = jax.tree.map(lambda x, chosen=chosen: x[chosen[0] : chosen[-1] + 1], contact)
            first, second = self._touching[:, chosen]
            apart = (self._tree.moves[second] - self._tree.moves[first]).astype(d.qpos.dtype)
            across = c.frame @ _point_jacobians(apart, c.pos - motion.com, motion.cdof)
            weight, gap = self._weight(m, first, second), c.dist - c.includemargin
            if self._frictional[chosen[0]]:
                # Edges n ± mu_1 t_1 and n ± mu_2 t_2
                mu = c.friction[:, [0, 0, 1, 1]] * np.array([1, -1, 1, -1], np.float32)
                j = across[:, :1] + mu[:, :, None] * jnp.repeat(across[:, 1:], 2, axis=1)
                square = c.friction[:, 0] ** 2
                weight = weight * (1 + square) * 2 * square / m.opt.impratio
            else:
                j = across[:, :1]
            gaps = jnp.broadcast_to(gap[:, None], j.shape[:2])
            rows.append(_pushing(_soften(m, j, j @ d.qvel, gaps, gap, weight, c.solref, c.solimp), gap))
        return rows

    @staticmethod
    def _weight(m: Array, first: np.ndarray, second: np.ndarray) -> jax.Array:
        return m.body_invweight0[first, 0] + m.body_invweight0[second, 0]


def _pick(x: jax.Array, rows: np.ndarray) -> jax.Array:
    """Rows of an array as slices, which fuse where a gather would not."""
    return jnp.stack([x[row] for row in rows.tolist()])


def _point_jacobians(moves: np.ndarray, r: jax.Array, cdof: jax.Array) -> jax.Array:
    """Velocities [points, 3, nv] of points at r [points, 3] from c, per unit of the joint velocities that move them."""
    linear = cdof[:, 3:] + cross(cdof[None, :, :3], r[:, None])
    return (linear * moves[:, :, None]).swapaxes(1, 2)


def _soften(
    m: Array,
    j: jax.Array,
    velocity: jax.Array,
    gap: jax.Array,
    distance: jax.Array,
    weight: jax.Array,
    solref: jax.Array,
    solimp: jax.Array,
) -> Rows:
    """Rows of constraints with `dim` rows each.

    Args:
      m: the model, for its timestep.
      j: Jacobians, [constraints, dim, nv].
      velocity: J v, [constraints, dim].
      gap: what each row is to bring to 0, [constraints, dim], m or rad.
      distance: what the impedance depends on, [constraints].
      weight: inverse mass that a constraint feels, [constraints].
      solref: time constant (s) and damping ratio, [constraints, 2].
      solimp: of the impedance: at 0, from the width on, width, middle, power, [constraints, 5].
    """
    low, high, width, middle, power = solimp.T
    x = jnp.minimum(jnp.abs(distance) / width, 1.0)
    rising = x**power / middle ** (power - 1)
    levelling = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    impedance = (low + jnp.where(x < middle, rising, levelling) * (high - low))[:, None]
    time, ratio = jnp.maximum(solref[:, 0], 2 * m.opt.timestep)[:, None], solref[:, 1][:, None]
    damping, stiffness = 2 / (high[:, None] * time), 1 / (high[:, None] * time * ratio) ** 2
    aref = -damping * velocity - stiffness * impedance * gap
    inverse = impedance / (weight[:, None] * (1 - impedance))
    return Rows(j.reshape(-1, j.shape[-1]), jnp.broadcast_to(inverse, gap.shape).reshape(-1), aref.reshape(-1))


def _pushing(rows: Rows, gap: jax.Array) -> Rows:
    """Rows that hold only where the gap [constraints] is closed."""
    reached = jnp.repeat(gap < 0, len(rows.D) // len(gap))
    return rows._replace(D=rows.D * reached)
