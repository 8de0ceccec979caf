"""A saved policy as the controller of a Cassie in any simulator: state in, PD targets out. NumPy alone.

controller = Controller.load("1x", model)
targets = controller.step(data.time, data.qpos, data.qvel)
"""

import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.saved_law import control_law
from cassie_mjx.agents.shipped import load_policy
from cassie_mjx.control.command import toward
from cassie_mjx.control.step import begin, policy_step
from cassie_mjx.motion.command import STAND, Command
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed
from cassie_mjx.robot import cassie

Told: TypeAlias = float | Sequence[float] | np.ndarray | str
"""A commanded forward velocity, m/s; or three numbers, forward and lateral velocity, m/s, and yaw rate, rad/s; or the
word "stand"."""

# MuJoCo's numbers of the kinds of joints, and of transmissions to a joint.
_KINDS = ("free", "ball", "slide", "hinge")
_ON_JOINT = (0, 1)


class Joints:
    """Where a model's qpos, qvel and actuators have Cassie's joints, matched by name."""

    def __init__(
        self,
        root: tuple[Iterable[int], Iterable[int]],
        addresses: Mapping[str, tuple[int, int]],
        motors: Mapping[str, int],
        origin: Iterable[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Match names.

        Args:
          root: addresses of the pelvis' position and quaternion in qpos (7), and of its velocities in qvel (6): linear
            in the world, angular in the pelvis.
          addresses: joint name to its first address in qpos and in qvel.
          motors: joint name to the index of the actuator that drives it.
          origin: where in the world the pelvis is when its position in qpos is 0, m.

        Raises:
          ValueError: a joint that is observed or driven is not there.
        """
        _check_names(addresses)
        own_q, own_v, their_q, their_v = [], [], [], []
        for name, nq, nv in cassie.JOINTS:
            if name == "pelvis":
                theirs = tuple(np.array(list(part)) for part in root)
            elif name in addresses:
                theirs = tuple(start + np.arange(n) for start, n in zip(addresses[name], (nq, nv), strict=True))
            else:
                continue
            own_q.append(cassie.qpos_index(name))
            own_v.append(cassie.qvel_index(name))
            their_q.append(theirs[0])
            their_v.append(theirs[1])
        self.own_qpos, self.own_qvel = np.concatenate(own_q), np.concatenate(own_v)
        self.qpos, self.qvel = np.concatenate(their_q), np.concatenate(their_v)
        self.active_qpos, self.active_qvel = (
            np.array([addresses[name][i] for name in cassie.ACTUATORS]) for i in range(2)
        )
        self.origin, self._motors = np.array(list(origin)), dict(motors)

    @property
    def motors(self) -> np.ndarray:
        """Indices of the actuators of the ten active joints, [10]. Raises ValueError if one has none."""
        missing = [name for name in cassie.ACTUATORS if name not in self._motors]
        if missing:
            raise ValueError(
                f"The model has no actuator on {', '.join(missing)}; it has them on {_list(self._motors)}."
            )
        return np.array([self._motors[name] for name in cassie.ACTUATORS])

    @classmethod
    def of(cls, model: Any) -> "Joints":
        """Of a `mujoco.MjModel` whose joints have the published names; its root is a free joint, or slides and a ball.

        Raises:
          ValueError: a joint is missing, or the pelvis does not float.
        """
        names = [model.joint(i).name for i in range(model.njnt)]
        addresses = {
            name: (int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])) for i, name in enumerate(names) if name
        }
        _check_names(addresses)
        pelvis = model.body_parentid[model.jnt_bodyid[names.index(cassie.ACTUATORS[0])]]
        root = [i for i in range(model.njnt) if model.jnt_bodyid[i] == pelvis]
        kinds = [_KINDS[int(model.jnt_type[i])] for i in root]
        straight = np.array_equal(model.jnt_axis[root[:3]], np.eye(3)) or kinds == ["free"]
        if kinds not in (["free"], ["slide", "slide", "slide", "ball"]) or not straight:
            raise ValueError(
                "The pelvis does not float: it needs a free joint, or three slides along x, y, z and then a ball; "
                f"it has {_list(kinds)}."
            )
        # They follow each other in qpos and in qvel.
        qpos, qvel = model.jnt_qposadr[root[0]] + np.arange(7), model.jnt_dofadr[root[0]] + np.arange(6)
        on_joints = [i for i in range(model.nu) if model.actuator_trntype[i] in _ON_JOINT]
        motors = {names[model.actuator_trnid[i, 0]]: i for i in on_joints}
        return cls((qpos, qvel), addresses, motors, model.body_pos[pelvis] - model.qpos0[qpos[:3]])

    @classmethod
    def own(cls) -> "Joints":
        """Of this package's own model."""
        addresses = {
            name: (int(cassie.qpos_index(name)[0]), int(cassie.qvel_index(name)[0])) for name, *_ in cassie.JOINTS[1:]
        }
        motors = {name: i for i, name in enumerate(cassie.ACTUATORS)}
        return cls((cassie.qpos_index("pelvis"), cassie.qvel_index("pelvis")), addresses, motors)


def _list(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _check_names(addresses: Mapping[str, tuple[int, int]]) -> None:
    """Raise ValueError unless there is every joint that is observed or driven."""
    missing = [name for name in (*cassie.ACTUATORS, *cassie.SPRUNG_NAMES) if name not in addresses]
    if missing:
        raise ValueError(f"The model lacks the joints {', '.join(missing)}; it has {_list(addresses)}.")


def _command(told: Told) -> Command:
    """The command of one robot, leaves [1]."""
    if isinstance(told, str) and told == STAND:
        return Command(*np.array([[0.0], [0.0], [0.0], [1.0]]))
    try:
        numbers = np.array(told, float)
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape not in ((), (3,)):
        raise ValueError(
            f"command={told} must be a forward velocity, three numbers (forward and lateral velocity and yaw rate) or "
            f'"{STAND}".'
        )
    return Command(*np.append(numbers, np.zeros(4 - numbers.size)).reshape(4, 1))


class Controller:
    """One robot's policy: it keeps its own time along the reference motion."""

    def __init__(self, policy: NumpyPolicy, joints: Joints | None = None) -> None:
        """Take a policy and where its robot has which joint; without `joints` that of this package's model.

        Raises:
          ValueError: the policy's observation or mirror is not this version's.
        """
        self.policy, self.joints, self.law = policy, joints or Joints.own(), control_law(policy)
        stride_length = np.asarray(policy.reference_stride_length)
        self.motion = ReferenceMotion(policy.reference_qpos, policy.reference_qvel, stride_length)
        self._network = policy.network
        self.reset()

    @classmethod
    def load(cls, name: str | pathlib.Path, model: Any = None) -> "Controller":
        """The controller of a policy that we ship, of a policy's file or of a run, for a `mujoco.MjModel`.

        Raises:
          ValueError: there is no such policy, its file is damaged, or the model lacks a joint.
        """
        return cls(load_policy(name), None if model is None else Joints.of(model))

    def reset(self) -> None:
        """Begin anew, at the start of the reference motion."""
        self._step, self._carry, self._start_s, self._last_s = 0, None, None, -np.inf
        self._targets, self._told = np.zeros(cassie.NU), None

    def initial_state(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copies of a model's qpos [nq] and qvel [nv] with the robot at the start of the reference motion."""
        qpos, qvel = np.array(qpos, float), np.array(qvel, float)
        qpos[self.joints.qpos] = self.motion.qpos[0, self.joints.own_qpos]
        qpos[self.joints.qpos[:3]] -= self.joints.origin
        qvel[self.joints.qvel] = self.motion.qvel[0, self.joints.own_qvel]
        return qpos, qvel

    def __call__(self, qpos: np.ndarray, qvel: np.ndarray, command: Told | None = None) -> np.ndarray:
        """PD targets of the ten active joints for the next 32 ms, rad, in the order of `policy.joints`.

        Args:
          qpos: of the model, [nq].
          qvel: of the model, [nv].
          command: commanded forward velocity, m/s; or forward and lateral velocity, m/s, and yaw rate, rad/s, left
            positive; or "stand". The policy's own speed straight ahead unless given. Velocities are along a path that
            begins as the world's x axis and that the yaw rate turns. The robot is brought from what it was told before
            to a new command at a limited pace (`control.command.toward`).

        Raises:
          ValueError: the command is neither a number, nor three, nor "stand".
        """
        own_qpos, own_qvel = np.zeros((1, cassie.NQ)), np.zeros((1, cassie.NV))
        own_qpos[0, self.joints.own_qpos] = np.asarray(qpos)[self.joints.qpos]
        own_qpos[0, cassie.PELVIS_POSITION] += self.joints.origin
        own_qvel[0, self.joints.own_qvel] = np.asarray(qvel)[self.joints.qvel]
        carry = self._carry or begin(self.law, self.motion, self._network, np.zeros(1, np.int32), own_qpos, own_qvel)
        last, self._told = self._told or Command.ahead(np.full(1, mean_speed(self.motion))), None
        if command is not None:
            self._told = toward(self.motion, last, _command(command), carry.time, own_qvel)
        targets, self._carry = policy_step(self.law, self.motion, self._network, carry, own_qpos, own_qvel, self._told)
        self._step += 1
        self._targets = targets[0]
        return self._targets.copy()

    def step(self, time: float, qpos: np.ndarray, qvel: np.ndarray, command: Told | None = None) -> np.ndarray:
        """PD targets at a time, s, for loops of any rate: new ones every 32 ms, else those held; see `__call__`.

        Raises:
          ValueError: the time is before that of the last call, or the command is none.
        """
        if time < self._last_s:
            raise ValueError(
                f"The time went back from {self._last_s:g} to {time:g} s; call reset() as a walk begins anew."
            )
        self._start_s, self._last_s = time if self._start_s is None else self._start_s, time
        if time - self._start_s >= self._step * cassie.CONTROL_PERIOD_S - 1e-9:
            self(qpos, qvel, command)
        return self._targets.copy()

    def torque(self, targets: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Joint torques [10] of the PD law, N·m, clipped to the motors' limits: P (target - q) - D qdot."""
        q, qdot = np.asarray(qpos)[self.joints.active_qpos], np.asarray(qvel)[self.joints.active_qvel]
        torque = self.policy.p_gain * (targets - q) - self.policy.d_gain * qdot
        return torque.clip(-cassie.TORQUE_LIMIT, cassie.TORQUE_LIMIT)
