"""The return that learning curves and headline figures are made of: a deterministic walk, ended by a fall alone."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.types import Agent, AgentState, Sensed
from cassie_mjx.control.path import Path, bend, into, out_of
from cassie_mjx.envs import reward
from cassie_mjx.envs.command import steered
from cassie_mjx.envs.termination import has_fallen, height_over_ground
from cassie_mjx.evaluation.simulate import Simulation, run_to_end
from cassie_mjx.evaluation.trial import Metric
from cassie_mjx.motion.command import STRAIGHT, Command, Steering
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed, nearest_sample, sample
from cassie_mjx.physics.types import Physics, PhysicsState, Scenario, merge, to_backend
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import PELVIS_X, PELVIS_Y, PELVIS_Z
from cassie_mjx.robot.ground import Ground, height_below

CHOOSING_PHASES = np.arange(10) / 10
"""Phases of the stride that training measures from, and by which it chooses its best policy."""

EPISODE_STEPS = 300

_GOLDEN_ANGLE = np.float32(np.pi * (3 - np.sqrt(5)))
"""From the direction in which one robot is steered to that of the next, rad: they are spread evenly."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ReturnRecord:
    """Sums of rewards so far; those of a robot that has fallen do not change any more.

    Attributes:
      time: control step of the motion, [B].
      steps: control steps survived, [B].
      fell: whether the robot has fallen, [B], bool.
      plain: sum of the plain reward, [B].
      weighted: sum of the weighted reward, [B].
      command: of the robots; None for the motion's own speed.
      motion: what is imitated, from x = 0 on.
      path: where the path that it goes along lies in the world, leaves [B].
    """

    time: Array
    steps: Array
    fell: Array
    plain: Array
    weighted: Array
    command: Command | None
    motion: ReferenceMotion
    path: Path

    @property
    def finished(self) -> Array:
        """Whether the walk is over, [B]."""
        return self.fell | (self.steps >= EPISODE_STEPS)

    def sample(self, state: PhysicsState, target: Array, scenario: Scenario, share: float) -> "ReturnRecord":
        """See `simulate.Record.sample`: rewards are of whole control steps."""
        return self

    def update(self, state: PhysicsState, scenario: Scenario) -> "ReturnRecord":
        """See `simulate.Record.update`."""
        xp = namespace(state.qpos)
        rewarded = _rewards(self.motion, self.time, self.command, self.path, state.qpos, state.qvel, scenario.ground)
        plain, weighted, path = to_backend(state, rewarded)
        fell = has_fallen(height_over_ground(state.qpos, scenario.ground)) | ~xp.isfinite(state.qvel).all(axis=1)
        up = ~self.finished
        return replace(
            self,
            time=self.time + 1,
            path=path,
            steps=self.steps + (up & ~fell),
            fell=self.fell | (up & fell),
            plain=self.plain + up * plain,
            weighted=self.weighted + up * weighted,
        )


@jax.jit
def _rewards(
    motion: ReferenceMotion,
    time: Array,
    command: Command | None,
    path: Path,
    qpos: Array,
    qvel: Array,
    ground: Ground,
) -> tuple[jax.Array, jax.Array, Path]:
    """Plain and weighted reward at the end of a control step that began at `time`, [B], and the path from then on.

    A robot whose physics diverged earns 0.
    """
    reference, velocity = sample(motion, time + 1, command)
    if command is not None:
        path = bend(path, command, sample(motion, time, command)[0], reference)
    nan = ~jnp.isfinite(qpos).all(axis=1)
    qpos = merge(nan, out_of(path, reference, velocity)[0], qpos)
    # The reference walks on flat ground: its z counts from the ground below.
    height = height_below(ground, qpos[:, PELVIS_X], qpos[:, PELVIS_Y])
    walked = into(path, qpos, qvel)[0].at[:, PELVIS_Z].add(-height)
    totals = (reward.total(reward.terms(reward.SCALES[name], walked, reference)) for name in ("plain", "weighted"))
    plain, weighted = (jnp.where(nan, 0.0, total) for total in totals)
    return plain, weighted, path


def walk_returns(
    agent: PolicyAgent,
    physics: Physics,
    speeds: tuple[float, float] = (1.0, 1.0),
    steering: Steering = STRAIGHT,
    phases: np.ndarray = CHOOSING_PHASES,
    delay: int = 0,
) -> dict[str, float]:
    """Walk one episode of 300 control steps from each of several phases of the stride; rewards after a fall are 0.

    Args:
      agent: the policy.
      physics: the engine.
      speeds: lowest and highest factor on the motion's speed; the B commands go from the one to the other.
      steering: how far robots are steered off straight ahead, each to another side.
      phases: of the stride at the start, 0 to 1, [B].
      delay: age of what is sensed, physics steps.

    Returns:
      Means over the starts: `return_plain`, `return_weighted`, and `steps` survived, of 300.
    """
    samples, starts = agent.motion.qpos.shape[0], len(phases)
    time = (nearest_sample(phases, samples) % samples).astype(np.int32)
    command = None
    if (speeds, steering) != ((1.0, 1.0), STRAIGHT):
        forward = np.float32(mean_speed(agent.motion)) * np.linspace(*speeds, starts, dtype=np.float32)
        direction = _GOLDEN_ANGLE * np.arange(starts, dtype=np.float32)
        command = steered(forward, steering, np.cos(direction), np.sin(direction))
    qpos, qvel = sample(agent.motion, time, command)
    state = physics.init(np.asarray(qpos, float), np.asarray(qvel, float))
    scenario = Scenario.nominal(starts, kd_scale=np.asarray(agent.kd_scale), delay=np.int32(delay))
    carry = agent.init(Sensed(state.qpos, state.qvel), time)
    zeros = np.zeros(starts)
    sums = (np.zeros(starts, int), zeros > 0, zeros, zeros)
    record = ReturnRecord(time, *sums, command, agent.motion, Path.world(starts))
    simulation = Simulation(AgentState(state, carry), scenario, record, command)
    record = run_to_end(agent, physics, simulation).record
    sums = {"return_plain": record.plain, "return_weighted": record.weighted, "steps": record.steps}
    return {name: float(np.mean(values)) for name, values in sums.items()}


def agent_returns(agent: Agent, physics: Physics, phases: np.ndarray, delay: int = 0) -> list[Metric]:
    """Returns of walking on the flat, sensing what was `delay` physics steps ago; none if it imitates nothing."""
    if not isinstance(agent, PolicyAgent):
        return []
    found = walk_returns(agent, physics, phases=phases, delay=delay)
    unit = f"of {EPISODE_STEPS}"
    return [Metric(name, found[name], unit, len(phases)) for name in ("return_plain", "return_weighted")]
