"""MJX: the same physics as pure functions of one robot, vmapped and jitted; made for accelerators."""

import contextlib
import io
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx.physics.types import BodyState, PhysicsState, Scenario, check_batch, check_delay, check_start, delayed
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array

# MJX announces on stdout that its optional Warp backend is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx


class MjxPhysics:
    """Steps robots with MJX; implements `Physics` on JAX arrays. Its methods can be traced: jit or scan over them."""

    traceable = True

    def __init__(self, model: mujoco.MjModel, max_delay: int = 0) -> None:
        """Put the model on the device.

        Args:
          model: from `robot.model.load_mjx_model`. Flat floor and terrain are one model here: the floor under each
            leg and the pelvis is a plane that follows the tangent of z = h sin x.
          max_delay: longest delay that a scenario will ask for, physics steps.
        """
        # By itself, MJX takes the first device of all, which may be another host's.
        self._device = jax.local_devices()[0]
        self.model, self._mjx = model, mjx.put_model(model, self._device)
        self.max_delay = max_delay
        self._loops = _LoopBias(self._mjx)
        self._floors = _Floors(model)
        # Accelerators would round the factors of a product to 8 or 11 bits: the loops' Jacobians do not bear that.
        exact = jax.default_matmul_precision("highest")
        self._advance = jax.jit(exact(self._scan), static_argnums=3)
        self._bodies = jax.jit(exact(self._kinematics))

    def init(self, qpos: Array, qvel: Array) -> PhysicsState:
        """See `Physics.init`."""
        if not isinstance(qpos, jax.core.Tracer):
            check_start(qpos, qvel)
        qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
        slots = self.max_delay + 1 if self.max_delay else 0
        history = jnp.repeat(jnp.concatenate([qpos, qvel], axis=1)[:, None], slots, axis=1)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), jnp.zeros(len(qpos), jnp.int32), history)

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        """See `Physics.advance`."""
        check_batch(state, target, scenario)
        if not isinstance(scenario.delay, jax.core.Tracer):
            check_delay(scenario, self.max_delay)
        return self._advance(state, target, scenario, n_steps)

    def bodies(self, state: PhysicsState) -> BodyState:
        """See `Physics.bodies`."""
        return self._bodies(state)

    def _scan(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        dtype = state.qpos.dtype
        target, scenario = jax.tree.map(partial(_as_floats, dtype), (target, scenario))
        kd_scale = scenario.kd_scale[:, None]

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            qpos, qvel = delayed(state, scenario)
            q, qdot = qpos[:, cassie.ACTIVE_QPOS], qvel[:, cassie.ACTIVE_QVEL]
            torque = cassie.pd_torque(target, q, qdot, kd_scale).astype(dtype)
            pushed = (scenario.push_start <= state.step) & (state.step < scenario.push_stop)
            push = scenario.push * pushed[:, None]
            moved = jax.vmap(self._step)(state.qpos, state.qvel, state.qacc_warmstart, torque, push, scenario)
            return self._record(PhysicsState(*moved, state.step + 1, state.history)), None

        return jax.lax.scan(substep, state, None, length=n_steps)[0]

    def _record(self, state: PhysicsState) -> PhysicsState:
        if not self.max_delay:
            return state
        now = jnp.concatenate([state.qpos, state.qvel], axis=1)
        slot = state.step % (self.max_delay + 1)
        history = state.history.at[jnp.arange(len(slot)), slot].set(now)
        return PhysicsState(state.qpos, state.qvel, state.qacc_warmstart, state.step, history)

    def _step(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        warmstart: jax.Array,
        torque: jax.Array,
        push: jax.Array,
        scenario: Scenario,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """One physics step of one robot: `mjx.step` less what Cassie has not, plus the loops' bias acceleration."""
        m = self._mjx
        d = mjx.make_data(m, self._device).replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        d = self.dynamics(m, d, torque, push, scenario.ground)
        d = mjx.euler(m, d)
        return d.qpos, d.qvel, d.qacc_warmstart

    def dynamics(self, m: mjx.Model, d: mjx.Data, torque: jax.Array, push: jax.Array, h: jax.Array) -> mjx.Data:
        """Forward dynamics of one robot under joint torques [10] and a push [3]: `d.qacc` and all that leads to it."""
        d = mjx.kinematics(m, d)
        d = self._floors.place(d, h)
        d = mjx.com_pos(m, d)
        d = mjx.crb(m, d)
        d = mjx.factor_m(m, d)
        d = mjx.collision(m, d)
        d = mjx.make_constraint(m, d)
        d = mjx.com_vel(m, d)
        d = self._loops.add(d)
        d = mjx.passive(m, d)
        d = mjx.rne(m, d)
        d = d.replace(
            qfrc_actuator=jnp.zeros_like(d.qvel).at[cassie.ACTIVE_QVEL].set(torque),
            xfrc_applied=jnp.zeros_like(d.xfrc_applied).at[cassie.PELVIS_BODY, :3].set(push),
        )
        d = mjx.fwd_acceleration(m, d)
        return mjx.solve(m, d)

    def _kinematics(self, state: PhysicsState) -> BodyState:
        def one(qpos: jax.Array, qvel: jax.Array) -> BodyState:
            d = mjx.make_data(self._mjx, self._device).replace(qpos=qpos, qvel=qvel)
            d = mjx.com_vel(self._mjx, mjx.com_pos(self._mjx, mjx.kinematics(self._mjx, d)))
            return BodyState(d.xpos, d.xmat, d.xipos, d.ximat, d.cvel, d.subtree_com[cassie.PELVIS_BODY])

        return jax.vmap(one)(state.qpos, state.qvel)


def _as_floats(dtype: jnp.dtype, x: Array) -> jax.Array:
    """Floating-point values in the state's precision, integers as they are."""
    return jnp.asarray(x, dtype) if jnp.issubdtype(x.dtype, jnp.floating) else jnp.asarray(x)


class _LoopBias:
    """The term J̇v of the four `connect` constraints, which MJX 3.17 leaves out and MuJoCo C has.

    A loop's constraint asks for J qacc + J̇v = aref; MJX solves J qacc = aref. The term is the difference of the
    anchors' accelerations at qacc = 0, and it matters as soon as the rods turn.
    """

    def __init__(self, m: mjx.Model) -> None:
        ancestors = np.zeros((m.nbody, m.nbody), bool)
        for body in range(1, m.nbody):
            ancestors[body] = ancestors[m.body_parentid[body]]
            ancestors[body, body] = True
        self.bodies = np.stack([m.eq_obj1id, m.eq_obj2id])
        self.moves = ancestors[self.bodies][:, :, m.dof_bodyid].astype(np.float64)
        self.anchors = np.stack([np.asarray(m.eq_data[:, :3]), np.asarray(m.eq_data[:, 3:6])])

    def add(self, d: mjx.Data) -> mjx.Data:
        """Subtract J̇v from the reference acceleration of the loops, the first rows of the constraints."""
        offset = jnp.einsum("...ij,...j->...i", d.xmat[self.bodies], self.anchors.astype(d.qpos.dtype))
        # Spatial quantities refer to the robot's centre of mass, c: r = p - c.
        r = d.xpos[self.bodies] + offset - d.subtree_com[cassie.PELVIS_BODY]
        omega, v_c = jnp.split(d.cvel[self.bodies], 2, axis=-1)
        bias = jnp.einsum("slv,vk->slk", self.moves.astype(d.qpos.dtype), d.cdof_dot * d.qvel[:, None])
        alpha, a_c = jnp.split(bias, 2, axis=-1)
        # a_p = a_c + alpha x r + omega x v_p, with v_p = v_c + omega x r
        acceleration = a_c + jnp.cross(alpha, r) + jnp.cross(omega, v_c + jnp.cross(omega, r))
        jdot_v = (acceleration[0] - acceleration[1]).ravel()
        aref = d._impl.efc_aref.at[: jdot_v.size].add(-jdot_v)
        return cast(mjx.Data, d.tree_replace({"_impl.efc_aref": aref}))


class _Floors:
    """The planes under the left leg, the right leg and the pelvis as tangents of the terrain z = h sin x."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.geoms = np.array([model.geom(f"{part}-floor").id for part in ("left", "right", "pelvis")])
        self.feet = cassie.FOOT_BODIES
        self.foot_centre = (cassie.TOE + cassie.HEEL) / 2

    def place(self, d: mjx.Data, h: jax.Array) -> mjx.Data:
        feet = d.xpos[self.feet] + d.xmat[self.feet] @ self.foot_centre.astype(d.qpos.dtype)
        x = jnp.append(feet[:, 0], d.qpos[0])
        slope, zero = h * jnp.cos(x), jnp.zeros_like(x)
        position = jnp.stack([x, zero, h * jnp.sin(x)], axis=1)
        # Columns of each rotation: the tangent (1, 0, h cos x) / n, the y axis, the normal (-h cos x, 0, 1) / n.
        n = jnp.sqrt(1 + slope**2)
        one = jnp.ones_like(x)
        rotation = jnp.stack([1 / n, zero, -slope / n, zero, one, zero, slope / n, zero, 1 / n], axis=1).reshape(
            -1, 3, 3
        )
        return d.replace(
            geom_xpos=d.geom_xpos.at[self.geoms].set(position), geom_xmat=d.geom_xmat.at[self.geoms].set(rotation)
        )
