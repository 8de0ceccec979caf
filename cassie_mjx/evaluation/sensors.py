"""The suite of sensors: what errors of IMU and encoders an agent bears, on a robot with electronics."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.delegating import Delegating
from cassie_mjx.agents.types import Agent, AgentState, Carry, Sensed
from cassie_mjx.control.observation import with_noise
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, LONG_WALK_S, WALK_S, EvalSetup, SuiteResult
from cassie_mjx.evaluation.trial import Metric, Trial, take
from cassie_mjx.motion.command import Command
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.dynamics import Dynamics
from cassie_mjx.robot.rotation import in_frame, tilted, turned_orientation

ROBOTS = 40
NOISE_FACTORS = (0, 1, 2, 4)
TILTS_RAD, OFFSETS_RAD = (0.02, 0.05, 0.1), (0.01, 0.03)
DRIFT_RADPS = float(np.deg2rad(1))

_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


class SensorErrors(NamedTuple):
    """How far the agent's senses are off; the PD law in the motors has its own."""

    noise: Array
    """Factor on the noise that `control.observation.NOISE` has, uniform and another one each control step, [B]."""
    tilt: Array
    """By how much the IMU leans about the pelvis' x and y, [B, 2], rad."""
    drift: Array
    """How fast its heading turns to the left of the true one, [B], rad/s."""
    seed: Array
    """Of the noise, [B], int32."""
    step: Array
    """Control steps since the trial began, [B], int32."""

    @classmethod
    def none(cls, robots: int) -> "SensorErrors":
        """Of robots whose senses are right, each with a seed of its own."""
        zeros, number = np.zeros(robots), np.arange(robots, dtype=np.int32)
        return cls(zeros, np.zeros((robots, 2)), zeros, number, 0 * number)

    def misread(self, qpos: Array, qvel: Array) -> tuple[jax.Array, jax.Array]:
        """What is sensed of qpos [B, 35] and qvel [B, 32] with these errors.

        An IMU that leans has its gyro lean as well. A drifting heading leaves place and velocity of the pelvis as they
        are in the world; policies that observe those have them contradict it.
        """

        def noise(seed: Array, step: Array) -> jax.Array:
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), seed), step)
            return jax.random.uniform(key, (cassie.NQ + cassie.NV,), minval=-1.0)

        off = self.noise[:, None] * jax.vmap(noise)(self.seed, self.step)
        quaternion = tilted(qpos[:, cassie.PELVIS_QUATERNION], self.tilt)
        quaternion = turned_orientation(quaternion, self.drift * self.step * cassie.CONTROL_PERIOD_S)
        before, after = (qpos[:, : cassie.PELVIS_QUATERNION[0]], qpos[:, cassie.PELVIS_QUATERNION[-1] + 1 :])
        leaning = jnp.concatenate([before, quaternion, after], axis=1)
        gyro = in_frame(tilted(_UPRIGHT, self.tilt), qvel[:, cassie.PELVIS_ANGULAR_VELOCITY])
        first, *_, last = cassie.PELVIS_ANGULAR_VELOCITY
        turning = jnp.concatenate([qvel[:, :first], gyro, qvel[:, last + 1 :]], axis=1)
        return with_noise(leaning, turning, off)


class MisledCarry(NamedTuple):
    """What a misled agent carries."""

    walk: Carry
    errors: SensorErrors


class MisledAgent(Delegating[Agent]):
    """An agent whose senses are off, as an `Agent` in steady walking."""

    def __init__(self, agent: Agent) -> None:
        """Take an agent. Raises ValueError for one that acts on the poses of bodies, of which there are no errors."""
        if agent.needs_bodies:
            raise ValueError(f"suite=sensors is for policies, and {agent.name} acts on more than sensors tell.")
        super().__init__(agent.name, agent)
        self._misread = jax.jit(SensorErrors.misread)

    def init(self, sensed: Sensed) -> MisledCarry:
        """See `Agent.init`: its senses are right."""
        return self.take_over(self.inner.init(sensed))

    def step(self, carry: MisledCarry, sensed: Sensed, command: Command | None) -> tuple[Array, MisledCarry]:
        """See `Agent.step`."""
        errors = carry.errors
        target, walk = self.inner.step(carry.walk, Sensed(*self._misread(errors, sensed.qpos, sensed.qvel)), command)
        return target, MisledCarry(walk, errors._replace(step=errors.step + 1))

    def moved(self, carry: MisledCarry, offset: np.ndarray) -> MisledCarry:
        """See `Agent.moved`."""
        return carry._replace(walk=self.inner.moved(carry.walk, offset))

    def take_over(self, carry: Carry) -> MisledCarry:
        """See `Agent.take_over`: its senses are right."""
        return MisledCarry(carry, SensorErrors.none(len(jax.tree.leaves(carry)[0])))


def sensors(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """The share of 40 robots with electronics up for 10 s, from eight phases, with errors of what is sensed.

    Noise of training scaled; on top of that noise, an IMU that leans in five directions, encoders that are off, and a
    heading that drifts by 1 deg/s, for 60 s.
    """
    setup = replace(setup, electronics=True)
    physics, misled, starts = setup.physics(), MisledAgent(agent), setup.starts(agent, LIMIT_PHASES)
    phase = np.arange(ROBOTS) % len(LIMIT_PHASES)
    metrics = []
    for quantity, (errors, offset, seconds) in cases().items():
        robots = AgentState(take(starts.physics, phase), MisledCarry(take(starts.carry, phase), errors))
        made = [None] * ROBOTS
        if offset.any():
            made = [Dynamics.nominal(encoder_offset=each) for each in offset]
        trials = [Trial(robot, seconds, dynamics=dynamics) for robot, dynamics in enumerate(made)]
        result = run_trials(misled, physics, robots, trials, setup.progress, setup.num_envs)
        metrics.append(Metric(quantity, float((~result.fell).mean()), "1", ROBOTS))
    return SuiteResult(metrics)


def cases() -> dict[str, tuple[SensorErrors, np.ndarray, float]]:
    """Errors of the 40 robots, offsets of their encoders, [40, 14], rad, and how long they walk, s, by quantity."""
    right, straight = SensorErrors.none(ROBOTS), np.zeros((ROBOTS, len(cassie.ENCODERS)))
    noisy = right._replace(noise=np.ones(ROBOTS))
    found = {
        f"sensors_noise_x{factor}_survived": (right._replace(noise=np.full(ROBOTS, float(factor))), straight, WALK_S)
        for factor in NOISE_FACTORS
    }
    angle = np.arange(ROBOTS) // len(LIMIT_PHASES) * 2 * np.pi * len(LIMIT_PHASES) / ROBOTS
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for tilt in TILTS_RAD:
        found[f"sensors_tilt_{tilt:g}rad_survived"] = noisy._replace(tilt=tilt * direction), straight, WALK_S
    drawn = np.asarray(jax.random.uniform(jax.random.key(0), straight.shape, minval=-1.0), float)
    for offset in OFFSETS_RAD:
        found[f"sensors_offset_{offset:g}rad_survived"] = noisy, offset * drawn, WALK_S
    drifting = noisy._replace(drift=np.full(ROBOTS, DRIFT_RADPS))
    found["sensors_drift_survived_60s"] = drifting, straight, LONG_WALK_S
    return found
