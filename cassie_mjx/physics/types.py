"""What both physics engines take and give: states, scenarios and body poses, batched over robots (axis B)."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import jax
import mujoco
import numpy as np

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.dynamics import Dynamics, encoded
from cassie_mjx.robot.electronics import Electronics, limited
from cassie_mjx.robot.ground import SCENES, Ground

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PhysicsState:
    """Everything that physics carries from one step to the next.

    Attributes:
      qpos: generalised positions in MuJoCo's order, [B, 35]: m, unit quaternions w x y z, rad.
      qvel: generalised velocities, [B, 32]: m/s world frame, rad/s body frame for the pelvis, rad/s for the joints.
      qacc_warmstart: the solver's starting point, [B, 32], m/s² and rad/s².
      step: physics steps since `init`, [B], int32.
      history: the last states, (qpos, qvel) side by side with the torque asked for in the step that led to them,
        [B, max_delay + 1, 77]; slot `step % (max_delay + 1)` is the present one. [B, 0, 77] on an engine without delay.
        With electronics, states are as those show them.
      electronics: what encoders and filters remember, [B]; None on an engine without electronics.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    step: Array
    history: Array
    electronics: Electronics | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scenario:
    """What differs from robot to robot: what the world does to each, and what each is made of.

    Attributes:
      push: forces at the pelvis' centre of mass, P of them, [B, P, 3], N, world frame.
      push_start: first physics step under each push, [B, P], int32, counted as `PhysicsState.step`.
      push_stop: first physics step after each push, [B, P], int32.
      delay: age of the state that the PD loop and the agent sense, [B], int32, physics steps.
      ground: what each robot walks on, [B].
      kd_scale: factor on the D gains of the PD law, [B].
      dynamics: how each robot differs from the model, [B]; None if none does, which costs an engine nothing.
    """

    push: Array
    push_start: Array
    push_stop: Array
    delay: Array
    ground: Ground
    kd_scale: Array
    dynamics: Dynamics | None = None

    @classmethod
    def nominal(
        cls,
        robots: int,
        pushes: int = 1,
        ground: Ground | None = None,
        dynamics: Dynamics | None = None,
        **changes: Array,
    ) -> "Scenario":
        """Undisturbed walking of nominal robots on a flat floor, but for what is given.

        Args:
          robots: B.
          pushes: P, how many pushes there is room for.
          ground: of each robot, [B].
          dynamics: of each robot, [B].
          changes: other fields, [B, ...] or one value.
        """
        steps = np.zeros((robots, pushes), np.int32)
        values = {
            "push": np.zeros((robots, pushes, 3)),
            "push_start": steps,
            "push_stop": steps,
            "delay": steps[:, 0],
            "kd_scale": np.ones(robots),
        }
        given = {name: np.broadcast_to(value, values[name].shape) for name, value in changes.items()}
        return cls(**(values | given), ground=Ground.flat(robots) if ground is None else ground, dynamics=dynamics)

    def force(self, step: Array) -> Array:
        """Sum of the pushes that act in physics step `step` [B], [B, 3], N, world frame."""
        now = step[:, None]
        acting = (self.push_start <= now) & (now < self.push_stop)
        return (self.push * acting[..., None]).sum(axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BodyState:
    """Poses and velocities of all bodies (26, the world first) in the world frame.

    Attributes:
      xpos: origins of the body frames, [B, 26, 3], m.
      xmat: rotations from body to world, [B, 26, 3, 3].
      xipos: centres of mass, [B, 26, 3], m.
      ximat: rotations from the inertia's principal frame to world, [B, 26, 3, 3].
      cvel: angular velocity (rad/s), then the velocity (m/s) of the body's point at `com`, [B, 26, 6].
      com: centre of mass of the robot, [B, 3], m.
    """

    xpos: Array
    xmat: Array
    xipos: Array
    ximat: Array
    cvel: Array
    com: Array


class Physics(Protocol):
    """One engine: advances a batch of robots under PD targets, each in its scenario. It keeps no state of theirs.

    Arrays are NumPy's, of float64, on MuJoCo C, and JAX's on MJX.
    """

    model: mujoco.MjModel
    max_delay: int
    """Longest delay of a scenario, of what is sensed and of torques, physics steps."""
    traceable: bool
    """Whether its methods may be called under `jax.jit`; robots are then stepped on JAX's device."""

    def init(self, qpos: Array, qvel: Array) -> PhysicsState:
        """The state at physics step 0, with a history that has always been this state.

        Raises ValueError for shapes other than [B, 35] and [B, 32], and for values that are not finite.
        """
        ...

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        """Advance `n_steps` physics steps with the PD targets [B, 10] (rad) held.

        The torque follows the joint state at every physics step, or, on an engine with `max_delay` > 0, the state
        `scenario.delay` steps old. Raises ValueError for shapes that do not fit together.
        """
        ...

    def bodies(self, state: PhysicsState) -> BodyState:
        """Forward kinematics of the present state."""
        ...


def delayed(state: PhysicsState, scenario: Scenario) -> tuple[Array, Array]:
    """State (qpos [B, 35], qvel [B, 32]) `scenario.delay` physics steps ago, if there is a history."""
    slots = state.history.shape[1]
    if slots == 0:
        return state.qpos, state.qvel
    slot = (state.step - scenario.delay) % slots
    seen = state.history[np.arange(len(state.history)), slot]
    return seen[:, : cassie.NQ], seen[:, cassie.NQ : cassie.NQ + cassie.NV]


def sensed(state: PhysicsState, scenario: Scenario) -> tuple[Array, Array]:
    """State as sensed, (qpos [B, 35], qvel [B, 32]): as old as the delay has it, as encoders and filters show it."""
    qpos, qvel = delayed(state, scenario)
    return encoded(qpos, scenario.dynamics), qvel


def motor_torque(state: PhysicsState, target: Array, scenario: Scenario) -> Array:
    """Torques at the joints, [B, 10], N·m, with which motors answer PD targets [B, 10], rad, on what is sensed."""
    qpos, qvel = sensed(state, scenario)
    q, qdot = qpos[:, cassie.ACTIVE_QPOS], qvel[:, cassie.ACTIVE_QVEL]
    kd_scale, dynamics = scenario.kd_scale[:, None], scenario.dynamics
    if dynamics is None:
        return _given(state, cassie.pd_torque(target, q, qdot, kd_scale))
    strength, p_gain, d_gain = (x[:, None] for x in (dynamics.strength, dynamics.p_gain, dynamics.d_gain))
    return strength * _given(state, cassie.pd_torque(target, q, qdot, d_gain * kd_scale, p_gain))


def _given(state: PhysicsState, torque: Array) -> Array:
    """What motors give of torques [B, 10], N·m: with electronics, less at speed."""
    return torque if state.electronics is None else limited(torque, state.qvel[:, cassie.ACTIVE_QVEL])


def begin_history(qpos: Array, qvel: Array, max_delay: int) -> Array:
    """The `PhysicsState.history` of robots that have always been in the state qpos [B, 35], qvel [B, 32]."""
    xp = namespace(qpos)
    now = xp.concatenate([qpos, qvel, xp.zeros((len(qpos), cassie.NU), qpos.dtype)], axis=1)
    return xp.repeat(now[:, None], max_delay + 1 if max_delay else 0, axis=1)


def merge(chosen: Array, these: T, those: T) -> T:
    """Robot by robot, the state `these` where `chosen` [B] and `those` elsewhere; for pytrees of either engine."""

    def pick(a: Array, b: Array) -> Array:
        return namespace(b).where(chosen.reshape(-1, *[1] * (b.ndim - 1)), a, b)

    return jax.tree.map(pick, these, those)


def to_backend(state: PhysicsState, tree: T) -> T:
    """`tree` where the robots are: as NumPy arrays if their engine runs on the host."""
    return jax.tree.map(np.asarray, tree) if isinstance(state.qpos, np.ndarray) else tree


def check_batch(state: PhysicsState, target: Array, scenario: Scenario) -> None:
    """Raise ValueError unless state, targets and scenario describe the same number of robots."""
    robots = state.qpos.shape[0]
    pushes = scenario.push.shape[1] if scenario.push.ndim == 3 else 1
    tails = {
        "push": (pushes, 3),
        "push_start": (pushes,),
        "push_stop": (pushes,),
        "slope": (2,),
        "target": (cassie.NU,),
        "mass": (len(cassie.BODIES),),
        "com": (3,),
        "encoder_offset": (len(cassie.ENCODERS),),
    }
    given = {"target": target} | {f"scenario.{name}": value for name, value in vars(scenario).items()}
    for part in ("scenario.ground", "scenario.dynamics"):
        if (nested := given.pop(part)) is not None:
            given |= {f"{part}.{name}": value for name, value in vars(nested).items()}
    for name, array in given.items():
        expected = robots, *tails.get(name.split(".")[-1], ())
        if array.shape != expected:
            raise ValueError(f"{name} has shape {array.shape}; for {robots} robots it must be {expected}.")


def check_ground(scenario: Scenario, scene: str) -> None:
    """Raise ValueError unless an engine of this scene has the ground of all robots."""
    needed = scenario.ground.scene
    if SCENES.index(needed) > SCENES.index(scene):
        raise ValueError(f"The ground of scene={needed!r} was asked of an engine made with scene={scene!r}.")


def check_start(qpos: Array, qvel: Array) -> None:
    """Raise ValueError unless qpos is [B, 35], qvel [B, 32] and all values are finite."""
    if qpos.ndim != 2 or qvel.ndim != 2 or qpos.shape[1] != 35 or qvel.shape != (qpos.shape[0], 32):
        raise ValueError(f"qpos and qvel have shapes {qpos.shape} and {qvel.shape}; they must be [B, 35] and [B, 32].")
    for name, array in (("qpos", qpos), ("qvel", qvel)):
        bad = np.argwhere(~np.isfinite(np.asarray(array)))
        if len(bad):
            row, index = bad[0]
            raise ValueError(f"{name}[{row}, {index}] is {array[row, index]}; a starting state must be finite.")


def check_delay(scenario: Scenario, max_delay: int) -> None:
    """Raise ValueError for a delay, of what is sensed or of torques, outside 0..max_delay physics steps."""
    delays = [scenario.delay]
    if scenario.dynamics is not None:
        late = scenario.dynamics.torque_delay
        # -1 is as late as the engine has it.
        delays.append(late + (late == -1))
    shortest, worst = (find([find(delay, initial=0) for delay in delays]) for find in (np.min, np.max))
    if shortest < 0:
        raise ValueError(f"A delay of {shortest} physics steps looks into the future; it must be at least 0.")
    if worst > max_delay:
        raise ValueError(
            f"A delay of {worst} physics steps was asked of an engine made for 0 to {max_delay}; "
            f"make it with max_delay={worst}."
        )
