"""The walking task without an engine: where episodes begin, what a policy sees, and what a critic may see.

Xie et al. 2018: every 32 ms a policy sees robot and reference and adds a residual to the reference angles of the ten
active joints (`control.law`). The reward says how near the robot stays to the reference motion (`outcome`).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.control import command as motions
from cassie_mjx.control.command import MotionState
from cassie_mjx.control.law import ControlLaw, second_step, target
from cassie_mjx.control.observation import OBSERVATIONS, Seen, with_noise
from cassie_mjx.control.path import Path, into, out_of
from cassie_mjx.envs import command, privileged
from cassie_mjx.envs.command import CommandRange
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import grown
from cassie_mjx.envs.start import draw_offset
from cassie_mjx.envs.types import Start, StartOffset
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import encoded
from cassie_mjx.robot.ground import Ground, height_below
from cassie_mjx.robot.model import steps_per_control

# What the key of a step or reset is folded with for all but phases, which it draws as it is: `randint` splits it in
# two, and folding with 0 or 1 would give those halves again.
SPEED_KEY, SCENARIO_KEY, VELOCITY_KEY, COMMAND_KEY, OFFSET_KEY, NOISE_KEY, FRESH_NOISE_KEY = range(2, 9)


@dataclass(frozen=True)
class Task:
    """What a task asks for; its methods are functions of arrays that can be traced, on any engine.

    Attributes:
      config: the task's parameters.
      motion: what to imitate, of JAX arrays.
      law: what the policy observes and what its actions mean.
      commands: what is commanded.
      timestep: of the physics, s.
      mass_share: of the bodies in the mass of the whole, [26].
    """

    config: WalkConfig
    motion: ReferenceMotion
    law: ControlLaw
    commands: CommandRange
    timestep: float
    mass_share: np.ndarray

    @property
    def samples(self) -> int:
        """Control steps of the motion."""
        return self.motion.qpos.shape[0]

    @property
    def physics_hz(self) -> int:
        """Physics steps a second."""
        return round(1 / self.timestep)

    @property
    def substeps(self) -> int:
        """Physics steps in a control step. Raises ValueError if they are no whole number."""
        return steps_per_control(self.physics_hz)

    @property
    def command_s(self) -> float | None:
        """Mean time from one command to the next, s, four times that after one to stand; None for one an episode."""
        slowest, fastest = self.commands.speeds
        return self.config.command_s if slowest < fastest else None

    def target(self, state: MotionState, action: jax.Array) -> jax.Array:
        """PD targets [B, 10], rad, of actions [B, 10], rad."""
        reference, _ = motions.reference(self.motion, state, ahead=1)
        return target(reference, self.law.residual(reference, action))

    def draw(self, key: jax.Array, level: jax.Array) -> tuple[jax.Array, Command, StartOffset]:
        """Phase [B], command and offset from the reference of new episodes of robots at these levels [B].

        B are a device's share of the robots if there are several.
        """
        robots = len(level)
        time = jax.random.randint(key, (robots,), 0, self.samples)
        speed_key = jax.random.fold_in(key, SPEED_KEY)
        told = command.draw_command(self.motion, speed_key, robots, self.commands, grown(level))
        velocity_key, place_key = (jax.random.fold_in(key, number) for number in (VELOCITY_KEY, OFFSET_KEY))
        return time, told, draw_offset(self.config, velocity_key, place_key, robots)

    def start(
        self,
        time: jax.Array,
        told: Command,
        offset: StartOffset,
        scenario: Scenario,
        key: jax.Array | None,
    ) -> Start:
        """The first moment of episodes at control steps `time` [B] of the motion; without a key there is no noise."""
        speed = jnp.linalg.norm(jnp.asarray(offset.velocity), axis=1)
        state = command.start_motion(self.motion, time, told, scenario.ground, speed)
        qpos, qvel = motions.reference(self.motion, state)
        qpos = qpos.at[:, cassie.PELVIS_POSITION[:2]].add(offset.position)
        qpos = qpos.at[:, cassie.PELVIS_Z].add(scenario.ground.sine)
        qvel = qvel.at[:, cassie.HORIZONTAL_VELOCITY].add(offset.velocity)
        qpos, qvel = out_of(state.path, qpos, qvel)
        noise_key = None if key is None else jax.random.fold_in(key, FRESH_NOISE_KEY)
        observation, sensing = self.observe(state, None, encoded(qpos, scenario.dynamics), qvel, noise_key)
        known = self.privileged(state, scenario, offset.position[:, 0], qpos, qvel)
        return Start(qpos, qvel, state, observation, sensing, known)

    def observe(
        self, state: MotionState, sensing: jax.Array | None, qpos: jax.Array, qvel: jax.Array, key: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """What the policy sees of robots at qpos [B, 35] and qvel [B, 32], [B, O], and what the observation carries on.

        `sensing` is what it carries, None as an episode begins; without a key there is no noise.
        """
        ahead = motions.reference(self.motion, state, ahead=1)
        if key is not None and self.law.observation.noisy:
            noise = jax.random.uniform(key, (len(qpos), cassie.NQ + cassie.NV), minval=-1.0)
            qpos, qvel = with_noise(qpos, qvel, noise)
        seen = Seen(*into(state.path, qpos, qvel), *ahead, state.command)
        return self.law.observe(self.law.init(seen) if sensing is None else sensing, seen)

    def privileged(
        self, state: MotionState, scenario: Scenario, lead: Array, qpos: jax.Array, qvel: jax.Array
    ) -> jax.Array:
        """What a critic sees of robots at qpos [B, 35] and qvel [B, 32], `lead` [B], m, ahead of the motion, [B, P].

        Where the policy does not observe the true state, it sees how far that is from the reference. Where the task
        disturbs robots, it sees what disturbs them, and what they are like where robots differ. All of it is in a
        mirror where the policy sees one.
        """
        seen = [privileged.ahead(lead)]
        if self.law.observation is OBSERVATIONS["full"] and not self.config.draws:
            return seen[0]
        reference = motions.reference(self.motion, state, ahead=1)
        mirrored = second_step(reference[0]) & self.law.symmetric
        if self.law.observation is not OBSERVATIONS["full"]:
            walked = on_the_path(state.path, qpos, qvel, scenario.ground)
            seen.append(privileged.errors(Seen(walked, into(state.path, qpos, qvel)[1], *reference), mirrored))
        if self.config.draws:
            step = state.step * self.substeps
            seen.append(privileged.disturbances(scenario, step, self.timestep, state.path.heading, mirrored))
            if scenario.dynamics is not None:
                seen.append(privileged.dynamics(scenario.dynamics, self.mass_share, self.timestep, mirrored))
        return jnp.concatenate(seen, axis=1)


def on_the_path(path: Path, qpos: jax.Array, qvel: jax.Array, ground: Ground) -> jax.Array:
    """World states' qpos [B, 35] in the path's frame and as on flat ground, where the reference walks."""
    height = height_below(ground, qpos[:, cassie.PELVIS_X], qpos[:, cassie.PELVIS_Y])
    return into(path, qpos, qvel)[0].at[:, cassie.PELVIS_Z].add(-height)
