"""When physics diverges in training: the model and the state before it, such that plain MuJoCo shows it again.

    model = mujoco.MjModel.from_binary_path("nan/model.mjb")
    before = np.load("nan/before.npz")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = before["qpos"], before["qvel"]
    data.qacc_warmstart[:], data.ctrl[:] = before["qacc_warmstart"], before["target"]
    for step in range(before["step"], before["step"] + before["n_steps"]):
        pushed = (before["push_start"] <= step) & (step < before["push_stop"])
        data.body("cassie-pelvis").xfrc_applied[:3] = pushed @ before["push"]
        mujoco.mj_step(model, data)

The motors are position servos on the present state: what diverged on senses `delay` steps old, with late torques, or on
MJX, need not do so again in MuJoCo C.
"""

import copy
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.physics.types import Physics, PhysicsState, Scenario
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.ppo.rollout import collect_on_host
from cassie_mjx.ppo.types import Policy, Robots
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics, set_dynamics
from cassie_mjx.robot.ground import Ground, set_terrain
from cassie_mjx.robot.model import ModelConfig, load_model, servo_model

Divergence = dict[str, Any]
"""One robot's `PhysicsState` and `Scenario`, field by field, its PD targets `target` and `n_steps`."""


def replay(env: WalkEnv, config: PPOConfig, policy: Policy, robots: Robots, key: jax.Array) -> Divergence | None:
    """What led to the first divergence in a rollout, which is collected again, on either engine step by step.

    Args:
      env: the task.
      config: of the learner.
      policy: that collected the rollout.
      robots: before the rollout.
      key: that the rollout was collected with.

    Returns:
      The divergence; None if it does not recur, as can be on MJX, where a single loop is compiled differently.
    """
    again = copy.copy(env)
    again.physics = watched = _WatchedPhysics(env.physics)
    collect_on_host(again.step, config, policy, robots, key)
    return watched.divergence


def dump(folder: Path, physics: Physics, divergence: Divergence) -> None:
    """Write `model.mjb` and `before.npz` into a new folder.

    Raises:
      OSError: they cannot be written.
    """
    folder.mkdir(parents=True)
    model, ground = (
        physics.model,
        Ground(**{field.name: divergence[f"ground_{field.name}"] for field in fields(Ground)}),
    )
    if ground.uneven and not model.nhfield:  # on MJX the terrain is planes that move
        model = load_model(ModelConfig(physics_hz=round(1 / model.opt.timestep), scene=ground.scene))
    dynamics = None
    if "dynamics_mass" in divergence:
        dynamics = Dynamics(**{field.name: divergence[f"dynamics_{field.name}"] for field in fields(Dynamics)})
    model = servo_model(model, float(divergence["kd_scale"]), dynamics)
    if dynamics is not None:
        set_dynamics(model, dynamics, mujoco.MjData(model))
    if model.nhfield:
        set_terrain(model, ground)
    mujoco.mj_saveModel(model, str(folder / "model.mjb"))
    np.savez(folder / "before.npz", **divergence)


class _WatchedPhysics:
    """An engine that remembers what it was asked for when a robot's state first stopped being finite."""

    def __init__(self, physics: Physics) -> None:
        self.model, self.max_delay, self.traceable = physics.model, physics.max_delay, False
        self.init, self.bodies, self._advance = physics.init, physics.bodies, physics.advance
        self.divergence: Divergence | None = None

    def advance(self, state: PhysicsState, target: Array, scenario: Scenario, n_steps: int) -> PhysicsState:
        after = self._advance(state, target, scenario, n_steps)
        lost = np.flatnonzero(~np.isfinite(np.concatenate([after.qpos, after.qvel], axis=1)).all(axis=1))
        if len(lost) and self.divergence is None:
            given = asdict(state) | asdict(scenario) | {"target": target}
            given["electronics"] = state.electronics and state.electronics._asdict()
            for part in ("ground", "dynamics", "electronics"):
                given |= {f"{part}_{name}": value for name, value in (given.pop(part) or {}).items()}
            self.divergence = {name: np.asarray(value)[lost[0]] for name, value in given.items()}
            self.divergence["n_steps"] = n_steps
        return after
