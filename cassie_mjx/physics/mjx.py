"""MJX: the same physics as pure functions of one robot, vmapped and jitted; made for accelerators."""

import contextlib
import io
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx.physics import newton
from cassie_mjx.physics.constraints import Constraints
from cassie_mjx.physics.memory import begin_memory, late_torque, remembered, rhythm
from cassie_mjx.physics.tree import Tree, cross
from cassie_mjx.physics.types import (
    BodyState,
    PhysicsState,
    Scenario,
    check_batch,
    check_delay,
    check_ground,
    check_start,
    motor_torque,
)
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics, varied
from cassie_mjx.robot.ground import Ground, height_below, smooth_height_below

# MJX announces on stdout that its optional Warp backend is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx


class MjxPhysics:
    """Steps robots with MJX; implements `Physics` on JAX arrays. Its methods can be traced: jit or scan over them."""

    traceable = True

    def __init__(
        self,
        model: mujoco.MjModel,
        max_delay: int = 0,
        scene: str = "rough",
        precision: str = "highest",
        electronics: bool = False,
    ) -> None:
        """Put the model on the device.

        Args:
          model: from `robot.model.load_mjx_model`. Flat floor and terrain are one model here: the floor under each
            leg and the pelvis is a plane that follows the ground's tangent.
          max_delay: longest delay that a scenario will ask for, physics steps.
          scene: the ground that scenarios can have; with less, a step is shorter.
          precision: of matrix products, by the names of `jax.default_matmul_precision`. By default, accelerators
            round factors to 8 or 11 bits, which the loops' Jacobians do not bear.
          electronics: whether encoders, filters and motors are the robot's; `max_delay` has room for their delay then.

        Raises:
          ValueError: the electronics have no whole number of cycles in a physics step, or `max_delay` no room for them.
        """
        self._rhythm = rhythm(model, electronics, max_delay)
        # By itself, MJX takes the first device of all, which may be another host's.
        self._device = jax.local_devices()[0]
        self.model, self._mjx = model, mjx.put_model(model, self._device)
        self.max_delay = max_delay
        self._scene, self._floors, self._tree = scene, _Floors(model, scene), Tree(model)
        self._motors = np.eye(model.nv)[:, cassie.ACTIVE_QVEL]
        self._pushed = self._tree.moves[cassie.PELVIS_BODY]
        self._constraints = Constraints(model, self._tree, *self._touching())
        exact = jax.default_matmul_precision(precision)
        self._advance = jax.jit(exact(self._scan), static_argnums=3)
        self._bodies = jax.jit(exact(self._kinematics))

    def init(self, qpos: Array, qvel: Array) -> PhysicsState:
        """See `Physics.init`."""
        if not isinstance(qpos, jax.core.Tracer):
            check_start(qpos, qvel)
        qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
        history, memory = begin_memory(qpos, qvel, self.max_delay, self._rhythm)
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), jnp.zeros(len(qpos), jnp.int32), history, memory)

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        """See `Physics.advance`."""
        check_batch(state, target, scenario)
        if not isinstance(scenario.delay, jax.core.Tracer):
            check_delay(scenario, self.max_delay)
        if not isinstance(scenario.ground.sine, jax.core.Tracer):
            check_ground(scenario, self._scene)
        return self._advance(state, target, scenario, n_steps)

    def bodies(self, state: PhysicsState) -> BodyState:
        """See `Physics.bodies`."""
        return self._bodies(state)

    def _scan(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        dtype = state.qpos.dtype
        target, scenario = jax.tree.map(partial(_as_floats, dtype), (target, scenario))
        changes = {} if scenario.dynamics is None else jax.vmap(self._changes)(scenario.dynamics)

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            asked = motor_torque(state, target, scenario).astype(dtype)
            torque = late_torque(state, asked, scenario, self._rhythm.torque_delay)
            push, ground = scenario.force(state.step), scenario.ground
            moved = jax.vmap(self._step)(state.qpos, state.qvel, state.qacc_warmstart, torque, push, ground, changes)
            return self._record(state, PhysicsState(*moved, state.step + 1, state.history), asked), None

        return jax.lax.scan(substep, state, None, length=n_steps)[0]

    def _changes(self, dynamics: Dynamics) -> dict[str, jax.Array]:
        """The fields of the model that the dynamics of one robot change, and those that MuJoCo derives from them."""
        changes = varied(self._mjx, dynamics)
        m = self._mjx.replace(**changes)
        return changes | self._constraints.inverse_weights(m, mjx.make_data(self._mjx, self._device))

    def _record(self, before: PhysicsState, state: PhysicsState, asked: jax.Array) -> PhysicsState:
        if not self.max_delay:
            return state
        now, memory = remembered(before, state.qpos, state.qvel, asked, self._rhythm)
        slot = state.step % (self.max_delay + 1)
        history = state.history.at[jnp.arange(len(slot)), slot].set(now)
        return replace(state, history=history, electronics=memory)

    def _step(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        warmstart: jax.Array,
        torque: jax.Array,
        push: jax.Array,
        ground: Ground,
        changes: dict[str, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """One physics step of one robot: `mjx.step` less what Cassie has not, plus the loops' bias acceleration."""
        m = self._mjx.replace(**changes)
        d = mjx.make_data(self._mjx, self._device).replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        mass, force, solution = self.dynamics(m, d, torque, push, ground)
        # Dampers count with the velocity after the step: (M + dt B) qacc = f
        implicit = mass + jnp.diag(m.opt.timestep * m.dof_damping)
        qvel = qvel + m.opt.timestep * newton.solve_positive(implicit, force + solution.force)
        return self._tree.integrate(qpos, qvel, m.opt.timestep), qvel, solution.qacc

    def _touching(self) -> tuple[np.ndarray, np.ndarray]:
        """The two geoms of each contact that MJX looks for, [2, contacts], and its dimension, [contacts]."""

        @jax.jit
        def geoms() -> tuple[jax.Array, jax.Array]:
            contact = mjx.collision(self._mjx, mjx.make_data(self._mjx, self._device))._impl.contact
            return contact.geom1, contact.geom2

        return np.stack(geoms()), mjx.make_data(self._mjx, self._device)._impl.contact.dim

    def dynamics(
        self, m: mjx.Model, d: mjx.Data, torque: jax.Array, push: jax.Array, ground: Ground
    ) -> tuple[jax.Array, jax.Array, newton.Solution]:
        """Forward dynamics of one robot under joint torques [10] and a push [3] on its ground.

        Returns the inertia [nv, nv], the joint forces [nv] of all but the constraints, and what the constraints make of
        them.
        """
        # At the origin, for far from it float32 would take rounding for gaps in the loops.
        origin, d = d.qpos[:2], d.replace(qpos=jnp.concatenate([jnp.zeros(2, d.qpos.dtype), d.qpos[2:]]))
        d = self._tree.kinematics(m, d)
        d = mjx.collision(m, self._floors.place(d, origin, ground))
        motion = self._tree.motion(m, d)
        mass = self._tree.mass_matrix(m, motion)
        arm = d.xipos[cassie.PELVIS_BODY] - motion.com
        pushing = motion.cdof @ jnp.concatenate([cross(arm, push), push]) * self._pushed.astype(push.dtype)
        force = self._tree.passive_and_bias_force(m, d, motion) + pushing + self._motors.astype(torque.dtype) @ torque
        rows = self._constraints.rows(m, d, motion)
        option = self.model.opt
        solution = newton.solve(
            mass, force, rows, self._constraints.loops, d.qacc_warmstart, option.iterations, option.ls_iterations
        )
        return mass, force, solution

    def _kinematics(self, state: PhysicsState) -> BodyState:
        def one(qpos: jax.Array, qvel: jax.Array) -> BodyState:
            d = mjx.make_data(self._mjx, self._device).replace(qpos=qpos, qvel=qvel)
            d = self._tree.kinematics(self._mjx, d)
            motion = self._tree.motion(self._mjx, d)
            return BodyState(d.xpos, d.xmat, d.xipos, d.ximat, motion.cvel, motion.com)

        return jax.vmap(one)(state.qpos, state.qvel)


def _as_floats(dtype: jnp.dtype, x: Array) -> jax.Array:
    """Floating-point values in the state's precision, integers as they are."""
    return jnp.asarray(x, dtype) if jnp.issubdtype(x.dtype, jnp.floating) else jnp.asarray(x)


class _Floors:
    """The planes under the left leg, the right leg and the pelvis as tangents of the ground.

    On steps they are level, so that a foot on an edge stands on the tread under its middle.
    """

    def __init__(self, model: mujoco.MjModel, scene: str) -> None:
        self.count = 3
        self.height_below = {"flat": None, "terrain": smooth_height_below, "rough": height_below}[scene]
        if [model.geom(i).name for i in range(self.count)] != ["left-floor", "right-floor", "pelvis-floor"]:
            raise ValueError("The model does not begin with the three floors; robot.model.load_mjx_model makes it.")
        self.foot_centre = cassie.SOLE_AXIS

    def place(self, d: mjx.Data, origin: jax.Array, ground: Ground) -> mjx.Data:
        """The planes where the robot stands whose x and y count from `origin` [2], m."""
        if self.height_below is None:
            return d
        height = self.height_below
        foot_centre = self.foot_centre.astype(d.qpos.dtype)
        feet = [(d.xpos[body] + d.xmat[body] @ foot_centre)[:2] for body in cassie.FOOT_BODIES]
        near = jnp.stack([*feet, d.qpos[:2]])
        z, slope = jax.vmap(jax.value_and_grad(lambda xy: height(ground, *xy)))(origin + near)
        zx, zy = slope.T
        # Columns of each rotation: the tangent (1, 0, z_x) / m, the normal (-z_x, -z_y, 1) / n times it, the normal.
        m, n = jnp.sqrt(1 + zx**2), jnp.sqrt(1 + zx**2 + zy**2)
        rows = [1 / m, -zx * zy / (m * n), -zx / n, jnp.zeros_like(z), m / n, -zy / n, zx / m, zy / (m * n), 1 / n]
        rotation = jnp.stack(rows, axis=1)
        return d.replace(
            geom_xpos=jnp.concatenate([jnp.column_stack([near, z]), d.geom_xpos[self.count :]]),
            geom_xmat=jnp.concatenate([rotation.reshape(-1, 3, 3), d.geom_xmat[self.count :]]),
        )
