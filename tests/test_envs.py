"""The walking task: observation table, rewards by hand, reset and step on both engines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from seeing import FULL, observe

from cassie_mjx.control import command as control_command
from cassie_mjx.control import command as motions
from cassie_mjx.envs import command, reward
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import make_env
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.envs.termination import Ends
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import QUATERNIONS, mean_speed, sample, stretch
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model, load_model

ROBOTS = 8
MODEL = replace(MJX_TRAINING, iterations=100, ls_iterations=50)
ON_THE_REFERENCE = WalkConfig(start_velocity_mps=0, symmetric=False)


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


@pytest.fixture(scope="module")
def native():
    return NativePhysics(load_model(MODEL))


@pytest.fixture(scope="module")
def env(native, motion):
    return WalkEnv(native, motion, ON_THE_REFERENCE, ROBOTS)


def factor_of(env, command):
    """Commanded speed over that of the motion, [B]."""
    return np.asarray(command.forward) / float(mean_speed(env.motion))


def test_observation_is_eighty_numbers_of_the_table():
    qpos, qvel = np.arange(35.0)[None], 100 + np.arange(32.0)[None]
    seen = np.asarray(observe(qpos, qvel, -qpos, -qvel))[0]
    assert seen.shape == (FULL.size,) == (80,)
    expected = [
        *(1, 2, 3, 4, 5, 6),
        *range(100, 106),
        *(7, 8, 9, 14, 20, 15, 16, 21, 22, 23, 28, 34, 29, 30),
        *(106, 107, 108, 112, 118, 113, 114, 119, 120, 121, 125, 131, 126, 127),
    ]
    # The quaternion has the sign that is nearer to the reference's.
    expected[2:6] = (-3, -4, -5, -6)
    np.testing.assert_array_equal(seen[:40], expected)
    np.testing.assert_array_equal(seen[42:46], seen[2:6])
    np.testing.assert_array_equal(np.delete(seen[40:], range(2, 6)), -np.delete(seen[:40], range(2, 6)))


def test_the_description_covers_the_observation():
    slices = [line.split()[0].split(":") for line in FULL.describe()]
    covered = [i for start, stop in slices for i in range(int(start), int(stop))]
    assert covered == list(range(80))


@pytest.mark.parametrize(
    ("name", "joint", "spring"),
    [
        ("plain", np.exp(-(0.1**2 + 0.2**2)), np.exp(-(0.03**2))),
        ("weighted", np.exp(-30 * (0.15 * 0.01 + 0.05 * 0.04)), np.exp(-0.9)),
    ],
)
def test_rewards_by_hand(standing_qpos, name, joint, spring):
    qpos = standing_qpos.copy()
    qpos[cassie.qpos_index("left-hip-roll", "right-foot", "left-shin")] += [0.1, 0.2, 0.03]
    qpos[:3] += [0.3, 0.0, -0.1]
    qpos[4] += 0.2
    terms = reward.terms(reward.SCALES[name], qpos, standing_qpos)
    expected = (joint, np.exp(-0.1), np.exp(-0.04), spring)
    np.testing.assert_allclose(terms, expected, rtol=1e-6)
    total = 0.5 * joint + 0.3 * np.exp(-0.1) + 0.1 * np.exp(-0.04) + 0.1 * spring
    np.testing.assert_allclose(reward.total(terms), total, rtol=1e-6)


def test_the_orientation_that_is_learned_from_has_a_scale_of_its_own():
    """exp(-30 e) = exp(-e)^30, a tenth of the reward learned from; what is measured stays."""
    after = {}
    for scale in (1, 30):
        env = make_env(robots=2, physics_hz=500, config=WalkConfig(orientation_scale=scale, min_reward=None))
        state = env.reset_at(np.array([0, 5], np.int32), Scenario.nominal(2))
        # Turned to the left by 0.2 rad: the reference's own pelvis rolls and pitches by less than 0.05 rad.
        state.physics.qpos[:, 3:7] = np.cos(0.1), 0, 0, np.sin(0.1)
        after[scale] = env.step(state, np.zeros((2, 10)), jax.random.key(0))
    measured, (one, thirty) = after[1].metrics["weighted"], (after[scale].metrics["orientation"] for scale in (1, 30))
    np.testing.assert_allclose(after[30].metrics["weighted"], measured, rtol=1e-6)
    np.testing.assert_allclose(thirty, one**30, rtol=1e-4)
    assert thirty.max() < 0.85
    np.testing.assert_allclose(after[1].reward, measured, rtol=1e-6)
    np.testing.assert_allclose(after[30].reward, measured + 0.1 * (thirty - one), rtol=1e-5)


def test_reset_puts_robots_on_the_reference(env, motion):
    state = env.reset(jax.random.key(0))
    phase = np.asarray(state.motion.time)
    assert len(set(phase.tolist())) > 2
    np.testing.assert_allclose(state.physics.qpos, np.asarray(motion.qpos)[phase], atol=1e-6)
    ahead, _ = sample(motion, phase + 1)
    np.testing.assert_allclose(state.observation[:, 40:42], np.asarray(ahead)[:, 1:3], atol=1e-6)


def test_a_step_follows_the_pd_law_to_the_next_sample(env, native, motion):
    state = env.reset(jax.random.key(1))
    action = 0.1 * np.random.default_rng(0).normal(size=(ROBOTS, 10))
    after = env.step(state, action, jax.random.key(2))
    ahead, _ = sample(motion, np.asarray(state.motion.time) + 1)
    target = np.asarray(ahead)[:, cassie.ACTIVE_QPOS] + action
    moved = native.advance(state.physics, np.asarray(target, float), Scenario.nominal(ROBOTS), 32)
    going = ~np.asarray(after.terminated)
    assert going.any()
    np.testing.assert_allclose(after.physics.qpos[going], moved.qpos[going], atol=1e-5)
    expected = reward.total(reward.terms(reward.SCALES["weighted"], moved.qpos, np.asarray(ahead)))
    np.testing.assert_allclose(after.reward, expected, atol=1e-4)


def test_quaternions_of_the_other_sign_are_the_same_robot(env):
    """q and -q are one orientation: the same step, observation, reward and end."""
    state = env.reset(jax.random.key(1))
    opposite = state.physics.qpos * np.where(np.isin(np.arange(cassie.NQ), QUATERNIONS), -1, 1)
    negated = replace(state, physics=replace(state.physics, qpos=opposite))
    action = np.full((ROBOTS, 10), 0.1)
    ours, theirs = (env.step(each, action, jax.random.key(2)) for each in (state, negated))
    for name in ("observation", "final_observation", "reward", "terminated", "truncated"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=1e-5, err_msg=name)
    np.testing.assert_allclose(theirs.physics.qvel, ours.physics.qvel, atol=1e-5)
    going = ~np.asarray(ours.terminated)
    assert (theirs.physics.qpos[going][:, QUATERNIONS] * ours.physics.qpos[going][:, QUATERNIONS]).sum() < 0


def test_every_episode_has_a_speed_of_its_own(native, motion):
    env = WalkEnv(native, motion, replace(ON_THE_REFERENCE, episode_steps=2, command_s=None), 64, speeds=(0.0, 4.0))
    key = jax.random.key(4)
    state = env.reset(key)
    speed = factor_of(env, state.motion.command)
    assert (speed.min(), speed.max()) == (0, pytest.approx(4, abs=1e-5))
    assert len(set(speed.tolist())) > 40
    phase = np.asarray(state.motion.time)
    ahead, ahead_velocity = sample(motion, phase + 1)
    np.testing.assert_allclose(state.physics.qvel[:, 0], speed * motion.qvel[phase, 0], atol=1e-5)
    np.testing.assert_allclose(state.observation[:, 46], speed * ahead_velocity[:, 0], atol=1e-5)
    after = env.step(state, np.zeros((64, 10)), jax.random.key(5))
    going = ~np.asarray(after.terminated)
    np.testing.assert_allclose(factor_of(env, after.motion.command)[going], speed[going], atol=1e-5)
    # The reward compares x with the stretched reference's.
    position = np.exp(-np.square(after.physics.qpos[:, :3] - np.c_[speed * ahead[:, 0], ahead[:, 1:3]]).sum(axis=1))
    np.testing.assert_allclose(np.asarray(after.metrics["position"])[going], position[going], atol=1e-4)
    anew = env.step(after, np.zeros((64, 10)), jax.random.key(6))
    assert anew.truncated[going].any()
    assert (abs(factor_of(env, anew.motion.command) - speed) > 1e-4)[np.asarray(anew.truncated)].mean() > 0.9


def test_speeds_are_drawn_from_the_whole_range_and_its_ends():
    speed = np.asarray(command.draw_factor(jax.random.key(0), 10_000, (0.0, 4.0)))
    assert (speed.min(), speed.max()) == (0, 4)
    for end in (0, 4):
        assert abs((speed == end).mean() - 0.1) < 0.01
    inside = speed[(speed > 0) & (speed < 4)]
    assert abs(inside.mean() - 2) < 0.05
    assert abs(inside.std() - 4 / np.sqrt(12)) < 0.05
    np.testing.assert_array_equal(command.draw_factor(jax.random.key(0), 8, (1.5, 1.5)), np.full(8, 1.5))


def test_new_speeds_are_commanded_and_reached_slowly(native, motion):
    task = WalkConfig(command_s=0.32, max_position_error_m=None)
    env = WalkEnv(native, motion, task, 64, speeds=(0.0, 4.0))
    state = env.reset(jax.random.key(4))
    changes, ends, kept, own = 0, 0, 0, float(mean_speed(motion))
    for i in range(30):
        after = env.step(state, np.zeros((64, 10)), jax.random.key(i))
        speed, told = factor_of(env, state.motion.command), factor_of(env, after.motion.target_command)
        moved = factor_of(env, after.motion.command) - speed
        # 1.5 m/s² are 0.0676 of the motion's speed in a control step.
        np.testing.assert_allclose(moved, np.clip(told - speed, -motions.BRAKING * 0.032 / own, 0.02), atol=1e-5)
        going = ~np.asarray(after.terminated | after.truncated)
        # What robots are compared with goes on from where it was, at the speed that they were told before.
        (now, _), (then, _) = (motions.reference(env.motion, each.motion) for each in (state, after))
        gained = (motions.reference(env.motion, state.motion, ahead=1)[0] - now)[:, 0]
        np.testing.assert_allclose((then - now)[going, 0], gained[going], atol=1e-5)
        before = factor_of(env, state.motion.target_command)
        kept += (told == before)[~going].sum()
        changes += (told != before).sum()
        ends += (~going).sum()
        state = after
    assert 100 < changes < 300, "30 steps of 64 robots, one in ten of which tells a robot something new"
    assert ends > 64
    assert kept > 0.8 * ends, "a new episode goes on with the command of the last"


def test_robots_start_at_velocities_of_their_own(native, motion):
    env = WalkEnv(native, motion, WalkConfig(start_velocity_mps=1.2, episode_steps=1, symmetric=False), 256)
    first = env.reset(jax.random.key(7))
    for state in (first, env.step(first, np.zeros((256, 10)), jax.random.key(8))):
        extra = state.physics.qvel - motion.qvel[np.asarray(state.motion.time)]
        np.testing.assert_allclose(extra[:, 2:], 0, atol=1e-6)
        size = np.linalg.norm(extra[:, :2], axis=1)
        assert 1.1 < size.max() <= 1.2
        assert abs(size.mean() - 0.4) < 0.05, "the mean of u^2 is a third"
        assert np.abs(extra[:, :2].mean(axis=0)).max() < 0.08, "any direction is as likely as its opposite"
        np.testing.assert_allclose(state.observation[:, 6:8], state.physics.qvel[:, :2], atol=1e-6)
        # sqrt(1 m / g) = 0.32 s: the capture point is that of the reference.
        aside = state.physics.qpos[:, :2] - motion.qpos[np.asarray(state.motion.time)][:, :2]
        np.testing.assert_allclose(aside, -0.3193 * extra[:, :2], atol=1e-3)
        np.testing.assert_allclose(state.privileged[:, 0], aside[:, 0] / 0.25, atol=1e-5)


def test_robots_start_beside_the_line_as_far_as_the_task_says(native, motion):
    env = WalkEnv(native, motion, replace(ON_THE_REFERENCE, start_offset_m=1.0, episode_steps=1), 256)
    first = env.reset(jax.random.key(7))
    for state in (first, env.step(first, np.zeros((256, 10)), jax.random.key(8))):
        reference = motion.qpos[np.asarray(state.motion.time)]
        offset = state.physics.qpos[:, 1] - reference[:, 1]
        assert offset.min() < -0.9
        assert offset.max() > 0.9
        assert np.abs(offset).max() <= 1 + 1e-6
        assert abs(offset.mean()) < 0.1, "either side is as likely"
        np.testing.assert_allclose(np.delete(state.physics.qpos, 1, axis=1), np.delete(reference, 1, axis=1), atol=1e-6)
        np.testing.assert_allclose(state.observation[:, 0], state.physics.qpos[:, 1], atol=1e-6)


def test_one_speed_for_all_is_the_stretched_motion_from_the_same_phases(native, motion):
    key = jax.random.key(7)
    fast = WalkEnv(native, motion, ON_THE_REFERENCE, ROBOTS, speeds=(2.0, 2.0)).reset(key)
    stretched = WalkEnv(native, stretch(motion, 2.0), ON_THE_REFERENCE, ROBOTS).reset(key)
    np.testing.assert_array_equal(fast.motion.time, jax.random.randint(key, (ROBOTS,), 0, 22))
    np.testing.assert_allclose(stretched.motion.command.forward, 2 * 0.5 / 0.704, rtol=2e-3)
    np.testing.assert_allclose(fast.physics.qpos, stretched.physics.qpos, atol=1e-6)
    np.testing.assert_allclose(fast.observation, stretched.observation, atol=1e-6)


def test_given_no_speeds_robots_go_evenly_from_the_lowest_to_the_highest(native, motion):
    env = WalkEnv(native, motion, WalkConfig(), 5, speeds=(0.0, 4.0))
    state = env.reset_at(np.zeros(5, np.int32), Scenario.nominal(5))
    np.testing.assert_allclose(factor_of(env, state.motion.command), [0, 1, 2, 3, 4], atol=1e-6)


def test_episodes_end_by_falls_low_rewards_and_length(native, motion):
    def run(config, steps, action=0.0):
        env = WalkEnv(native, motion, config, ROBOTS)
        state = env.reset_at(jnp.arange(ROBOTS), Scenario.nominal(ROBOTS))
        ends = []
        for i in range(steps):
            state = env.step(state, np.full((ROBOTS, 10), action), jax.random.key(i))
            ends.append((np.asarray(state.terminated), np.asarray(state.truncated), np.asarray(state.reward)))
            causes = np.any([np.asarray(state.metrics[name]) for name in Ends._fields], axis=0)
            np.testing.assert_array_equal(causes, state.terminated)
        return [np.array(x) for x in zip(*ends, strict=True)], state

    (terminated, truncated, rewards), _ = run(WalkConfig(min_reward=0.6), 40)
    assert terminated.any(), "the reference angles alone do not walk"
    assert (rewards[terminated] < 0.6).all()
    (late, _, _), _ = run(WalkConfig(min_reward=None, max_position_error_m=None), 40)
    assert late.argmax(axis=0).min() > terminated.argmax(axis=0).min(), "without the early end only a fall ends"
    (terminated, truncated, _), state = run(WalkConfig(episode_steps=3), 3)
    assert truncated[-1].sum() == ROBOTS - terminated.any(axis=0).sum()
    assert (np.asarray(state.motion.step)[truncated[-1]] == 0).all()


def test_robots_far_from_the_reference_end_their_episode_and_the_critic_is_told_how_far(native, motion):
    env = WalkEnv(native, motion, WalkConfig(min_reward=None, max_position_error_m=0.3, start_velocity_mps=0), ROBOTS)
    state = env.reset_at(jnp.zeros(ROBOTS, jnp.int32), Scenario.nominal(ROBOTS))
    np.testing.assert_array_equal(state.privileged, np.zeros((ROBOTS, 1)))
    moved = np.linspace(-0.6, 0.6, ROBOTS)
    state.physics.qpos[:, 0] += moved
    after = env.step(state, np.zeros((ROBOTS, 10)), jax.random.key(0))
    ended = np.asarray(after.terminated)
    np.testing.assert_array_equal(ended, abs(moved) > 0.3)
    np.testing.assert_array_equal(after.metrics["position_error"], ended)
    np.testing.assert_allclose(after.final_privileged[:, 0], moved / 0.25, atol=0.05)
    np.testing.assert_array_equal(after.privileged, np.where(ended[:, None], 0, after.final_privileged))


def test_the_path_waits_for_robots_on_a_leash(native, motion):
    free = WalkConfig(min_reward=None, max_position_error_m=None, start_velocity_mps=0)
    moved = np.array([-1.0, -0.2, 0.0, 0.25, 0.9])
    leads = []
    for leash_m, share in ((None, 0.0), (0.3, 0.0), (0.3, 0.4)):
        config = replace(free, leash_m=leash_m, scenario=ScenarioConfig(undisturbed_share=share))
        env = WalkEnv(native, motion, config, 5)
        state = env.reset_at(np.zeros(5, np.int32), Scenario.nominal(5))
        state.physics.qpos[:, 0] += moved
        after = env.step(state, np.zeros((5, 10)), jax.random.key(0))
        np.testing.assert_allclose(after.final_privileged[:, 0], moved / 0.25, atol=0.05)
        reference = control_command.reference(env.motion, after.motion)[0]
        leads.append(after.physics.qpos[:, 0] - np.asarray(reference)[:, 0])
    np.testing.assert_allclose(leads[0], moved, atol=0.02)
    np.testing.assert_allclose(leads[1], np.clip(leads[0], -0.3, 0.3), atol=1e-6)
    np.testing.assert_allclose(leads[2], [*leads[0][:2], *leads[1][2:]], atol=1e-6)


def test_a_nan_ends_its_episode_and_is_counted(env):
    state = env.reset(jax.random.key(3))
    state.physics.qvel[2, 7] = np.nan
    after = env.step(state, np.zeros((ROBOTS, 10)), jax.random.key(4))
    np.testing.assert_array_equal(np.asarray(after.metrics["nan"]), np.arange(ROBOTS) == 2)
    assert after.terminated[2]
    assert after.reward[2] == 0
    for name in ("observation", "final_observation"):
        assert np.isfinite(np.asarray(getattr(after, name))).all()
    assert np.isfinite(after.physics.qpos).all()


@pytest.mark.filterwarnings("error")
def test_a_velocity_beyond_single_precision_ends_its_episode_without_a_warning(env, monkeypatch):
    state, advance = env.reset(jax.random.key(3)), env.physics.advance

    def diverge(*args):
        after = advance(*args)
        after.qvel[2, 7] = 1e300
        return after

    monkeypatch.setattr(env.physics, "advance", diverge)
    after = env.step(state, np.zeros((ROBOTS, 10)), jax.random.key(4))
    np.testing.assert_array_equal(np.asarray(after.metrics["nan"]), np.arange(ROBOTS) == 2)
    assert np.isfinite(np.asarray(after.observation)).all()


def test_both_engines_step_the_same_task(native, motion):
    mjx = MjxPhysics(load_mjx_model(MJX_TRAINING))
    phases = jnp.arange(ROBOTS) * 2
    states, envs = [], [WalkEnv(physics, motion, WalkConfig(), ROBOTS) for physics in (native, mjx)]
    for env in envs:
        state = env.reset_at(phases, Scenario.nominal(ROBOTS))
        for i in range(3):
            state = env.step(state, np.zeros((ROBOTS, 10), np.float32), jax.random.key(i))
        states.append(state)
    np.testing.assert_allclose(states[1].observation, states[0].observation, atol=0.05)
    np.testing.assert_allclose(states[1].reward, states[0].reward, atol=2e-3)
    np.testing.assert_array_equal(states[1].motion.time, states[0].motion.time)


def test_bad_configurations():
    with pytest.raises(ValueError, match="reward=sparse is not known; choose one of plain, weighted"):
        WalkConfig(reward="sparse")
    with pytest.raises(ValueError, match="min_reward=1.5 must be"):
        WalkConfig(min_reward=1.5)
    with pytest.raises(ValueError, match="max_position_error_m=0 must be from 0.001 to 1,000, or null"):
        WalkConfig(max_position_error_m=0)
    with pytest.raises(ValueError, match="start_velocity_mps=-1 must be from 0 to 3"):
        WalkConfig(start_velocity_mps=-1)
    with pytest.raises(ValueError, match=r"start_velocity_mps=1.6 .* 0.51 m behind .* must be less than 1.56"):
        WalkConfig(start_velocity_mps=1.6)
    with pytest.raises(ValueError, match="start_offset_m=4 must be from 0 to 3"):
        WalkConfig(start_offset_m=4)
    with pytest.raises(ValueError, match=r"command_s=0 must be from 0\.032 to 3,600, or null"):
        WalkConfig(command_s=0)
    with pytest.raises(ValueError, match="episode_steps=0 must be a whole number from 1 to 1,073,741,824"):
        WalkConfig(episode_steps=0)
