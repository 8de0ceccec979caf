"""What a control step of the walking task has led to once physics has moved the robots: reward, ends, what is next."""

import jax
import jax.numpy as jnp

from cassie_mjx.control import command as motions
from cassie_mjx.control.command import MotionState
from cassie_mjx.control.path import out_of
from cassie_mjx.envs import command, reward
from cassie_mjx.envs.scenario import grown, is_disturbed, next_level, renew_scenario
from cassie_mjx.envs.task import COMMAND_KEY, NOISE_KEY, SCENARIO_KEY, Task, on_the_path
from cassie_mjx.envs.termination import Ends, ends
from cassie_mjx.envs.types import Start, StepOutcome
from cassie_mjx.motion.command import STRAIGHT
from cassie_mjx.physics.types import Scenario, merge
from cassie_mjx.robot import cassie

METRICS = (*reward.SCALES, *reward.Terms._fields, *Ends._fields)
"""Names of what is measured of each control step."""


def post_physics(
    task: Task,
    before: MotionState,
    sensing: jax.Array,
    push_level: jax.Array,
    scenario: Scenario,
    qpos: jax.Array,
    qvel: jax.Array,
    sensed_qpos: jax.Array,
    sensed_qvel: jax.Array,
    key: jax.Array,
) -> StepOutcome:
    """Reward, ends, and what comes next, for robots that physics has taken to qpos [B, 35] and qvel [B, 32]."""
    state = motions.tick(task.motion, before)
    reference = motions.reference(task.motion, state)
    in_world = out_of(state.path, *reference)
    nan = ~(jnp.isfinite(qpos).all(axis=1) & jnp.isfinite(qvel).all(axis=1))
    qpos, qvel, sensed_qpos, sensed_qvel = merge(nan, (*in_world, *in_world), (qpos, qvel, sensed_qpos, sensed_qvel))
    walked = on_the_path(state.path, qpos, qvel, scenario.ground)
    rewards, terms = _rewards(task, walked, reference[0], nan)
    kept = jnp.where(nan, 0.0, reward.total(terms))
    earned = command.paid(state) * kept
    lead, aside = ((walked - reference[0])[:, axis] for axis in (cassie.PELVIS_X, cassie.PELVIS_Y))
    causes = _ends(task, nan, walked[:, cassie.PELVIS_Z], kept, lead, aside)
    terminated = jnp.stack(causes).any(axis=0)
    truncated = ~terminated & _is_last(task, state)
    ended = terminated | truncated
    known = task.privileged(state, scenario, lead, qpos, qvel)
    state = _leashed(task, state, lead, aside)
    scenario, push_level = _renew(task, scenario, push_level, state, terminated, truncated, key)
    state = _told(task, state, push_level, sensed_qvel, key)
    start = _begin_anew(task, state, push_level, scenario, key)
    noise_key = jax.random.fold_in(key, NOISE_KEY)
    observation, sensing = task.observe(state, sensing, sensed_qpos, sensed_qvel, noise_key)
    causes = {name: cause.astype(earned.dtype) for name, cause in causes._asdict().items()}
    return StepOutcome(
        start=start,
        scenario=scenario,
        push_level=push_level,
        motion=merge(ended, start.motion, state),
        observation=merge(ended, start.observation, observation),
        final_observation=observation,
        sensing=merge(ended, start.sensing, sensing),
        privileged=merge(ended, start.privileged, known),
        final_privileged=known,
        reward=earned,
        terminated=terminated,
        truncated=truncated,
        metrics={**rewards, **terms._asdict(), **causes},
    )


def _rewards(
    task: Task, walked: jax.Array, reference: jax.Array, nan: jax.Array
) -> tuple[dict[str, jax.Array], reward.Terms]:
    """Both rewards as they are measured, and the terms that are learned from."""
    terms = {name: reward.terms(scale, walked, reference) for name, scale in reward.SCALES.items()}
    rewards = {name: jnp.where(nan, 0.0, reward.total(values)) for name, values in terms.items()}
    learned = reward.SCALES[task.config.reward]._replace(orientation=task.config.orientation_scale)
    return rewards, reward.terms(learned, walked, reference)


def _ends(task: Task, nan: jax.Array, height: jax.Array, kept: jax.Array, lead: jax.Array, aside: jax.Array) -> Ends:
    """Why episodes end of robots at a height, `lead` ahead of the reference and `aside` to its left, m, all [B]."""
    # Where robots are steered, one must not do without the position's share of the reward to the side either.
    away = lead if task.commands.steering == STRAIGHT else jnp.maximum(abs(lead), abs(aside))
    return ends(nan, height, kept, away, task.config.min_reward, task.config.max_position_error_m)


def _is_last(task: Task, state: MotionState) -> jax.Array:
    """Whether this control step is the last of an episode: its time is up, or the motion has ended."""
    timed_out = state.step >= task.config.episode_steps
    return timed_out if task.motion.periodic else timed_out | (state.time >= task.samples - 1)


def _leashed(task: Task, state: MotionState, lead: jax.Array, aside: jax.Array) -> MotionState:
    """The same moment, with the reference within the leash of disturbed robots; see `motions.follow`."""
    if task.config.leash_m is None:
        return state
    leash_m = jnp.where(is_disturbed(task.config.scenario, len(lead)), task.config.leash_m, jnp.inf)
    return motions.follow(state, lead, aside, leash_m)


def _renew(
    task: Task,
    scenario: Scenario,
    level: jax.Array,
    state: MotionState,
    terminated: jax.Array,
    truncated: jax.Array,
    key: jax.Array,
) -> tuple[Scenario, jax.Array]:
    """What acts on robots from now on, and their levels of the curriculum."""
    config, step = task.config.scenario, state.step * task.substeps
    if not task.config.draws:
        return scenario, level
    level = next_level(config, level, scenario, step, terminated)
    scenario_key = jax.random.fold_in(key, SCENARIO_KEY)
    ended = terminated | truncated
    hz, span = task.physics_hz, task.config.span
    return renew_scenario(config, scenario_key, scenario, step, ended, hz, level, span), level


def _told(task: Task, state: MotionState, level: jax.Array, qvel: jax.Array, key: jax.Array) -> MotionState:
    """The same moment, with the command on its way to a target that may be a new one; qvel [B, 32] is sensed."""
    if task.command_s is None and task.commands.steering == STRAIGHT:
        return state
    if task.command_s is not None:
        target_key = jax.random.fold_in(key, COMMAND_KEY)
        state = command.redraw_target(task.motion, state, target_key, task.commands, task.command_s, grown(level))
    return motions.approach(task.motion, state, qvel)


def _begin_anew(task: Task, state: MotionState, level: jax.Array, scenario: Scenario, key: jax.Array) -> Start:
    """New episodes, one a robot. Where commands change on the way, they go on with that of the last.

    So how long a speed is walked does not depend on how early its episodes end.
    """
    time, drawn, offset = task.draw(key, level)
    told = drawn if task.command_s is None else state.command
    start = task.start(time, told, offset, scenario, key)
    if task.command_s is None:
        return start
    return start._replace(motion=start.motion._replace(target_command=state.target_command))
