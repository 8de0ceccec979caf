"""Disturbances as part of the task: their ranges, when they act, when they are drawn anew, on both engines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.envs import reward
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import (
    LEVEL_DOWN,
    LEVEL_UP,
    ScenarioConfig,
    draw_scenario,
    first_level,
    next_level,
    renew_scenario,
)
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import sample
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Ground, Terrain
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model, load_model

ROBOTS, HZ, SUBSTEPS = 8, 1000, 32
MODEL = replace(MJX_TRAINING, iterations=100, ls_iterations=50)
ALL = ScenarioConfig(push_n=200, push_pause_s=1.0, terrain_m=0.24, delay_s=0.0045)
NO_ACTION = np.zeros((ROBOTS, 10), np.float32)


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


@pytest.fixture(scope="module")
def hills():
    return NativePhysics(load_model(replace(MODEL, scene="terrain")), max_delay=5)


def make(physics, motion, scenario, **config):
    return WalkEnv(physics, motion, WalkConfig(scenario=scenario, symmetric=False, **config), ROBOTS)


def of_robots(tree, chosen):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], tree)


def assert_same(these, those):
    jax.tree.map(np.testing.assert_array_equal, these, those)


def test_draws_are_uniform_over_their_ranges():
    robots = 20_000
    drawn = jax.tree.map(np.asarray, draw_scenario(ALL, jax.random.key(0), robots, HZ))
    push = drawn.push[:, 0]
    force = np.linalg.norm(push, axis=1)
    np.testing.assert_allclose([force.min(), force.mean(), force.max()], [0, 100, 200], atol=1.5)
    # The second moments of a horizontal vector of uniform direction: E F² / 2 = 200² / 6 each, uncorrelated.
    np.testing.assert_allclose(push.T @ push / robots, np.diag([200**2 / 6] * 2 + [0]), atol=150)
    np.testing.assert_allclose(push.mean(axis=0), 0, atol=3)
    # 1 s is 31.25 control steps.
    values, counts = np.unique(drawn.push_start, return_counts=True)
    np.testing.assert_array_equal(values, np.arange(33) * SUBSTEPS)
    np.testing.assert_allclose(counts / robots, 1 / 33, atol=0.006)
    np.testing.assert_array_equal(drawn.push_stop - drawn.push_start, 200)
    for array, expected in ((drawn.ground.sine, np.arange(9) * 0.03), (drawn.delay, np.arange(6))):
        values, counts = np.unique(array, return_counts=True)
        np.testing.assert_allclose(values, expected, atol=1e-7)
        np.testing.assert_allclose(counts / robots, 1 / len(expected), atol=0.012)


def test_the_backward_part_of_pushes_can_be_less():
    full = draw_scenario(ALL, jax.random.key(0), 1000, HZ).push
    weak = draw_scenario(replace(ALL, push_backward=0.7), jax.random.key(0), 1000, HZ).push
    np.testing.assert_allclose(weak, np.where((full < 0) & (np.arange(3) == 0), 0.7 * full, full), rtol=1e-5)


def test_a_share_of_the_robots_can_be_left_alone():
    drawn = draw_scenario(replace(ALL, undisturbed_share=0.25), jax.random.key(0), 1000, HZ)
    disturbed = np.stack([drawn.push.any(axis=(1, 2)), drawn.ground.uneven, drawn.delay > 0])
    assert not disturbed[:, :250].any()
    assert (disturbed[:, 250:].mean(axis=1) > 0.8).all()
    full = draw_scenario(ALL, jax.random.key(0), 1000, HZ)
    assert_same(drawn.push[250:], full.push[250:])


def test_a_curriculum_pushes_each_robot_in_a_direction_and_up_to_a_level_of_its_own():
    config = replace(ALL, push_curriculum=True, undisturbed_share=0.5)
    level = jnp.tile(jnp.array([0.1, 1.0]), 8)
    keys = jax.random.split(jax.random.key(0), 500)
    push = np.asarray(jax.vmap(lambda key: draw_scenario(config, key, 16, HZ, level=level).push[:, 0])(keys))
    force, angle = np.hypot(push[..., 0], push[..., 1])[:, 8:], np.arctan2(push[..., 1], push[..., 0])[:, 8:]
    assert not push[:, :8].any()
    np.testing.assert_allclose(force.max(axis=0), np.tile([20, 200], 4), rtol=0.02)
    # The eight that are disturbed have an eighth of the circle each.
    eighth = np.floor(angle / (np.pi / 4)).astype(int) % 8
    np.testing.assert_array_equal(eighth, np.tile(np.arange(8), (500, 1)))


def test_terrain_and_delay_grow_with_the_level_of_the_curriculum():
    """From none at 0.1 to all at 0.4: at 0.25 half of both, four levels of eight and ten steps of twenty."""
    config = replace(ALL, push_curriculum=True, terrain_m=0.8, delay_s=0.04)
    level = jnp.repeat(jnp.array([0.1, 0.25, 0.4, 1.0]), 500)
    drawn = draw_scenario(config, jax.random.key(0), 2000, 500, level=level)
    highest, latest = (np.asarray(each).reshape(4, 500).max(axis=1) for each in (drawn.ground.sine, drawn.delay))
    np.testing.assert_allclose(highest, [0, 0.4, 0.8, 0.8], rtol=1e-6)
    np.testing.assert_array_equal(latest, [0, 10, 20, 20])


def test_a_level_rises_with_a_push_that_is_over_and_drops_with_a_fall():
    present = replace(Scenario.nominal(4), push_stop=np.full((4, 1), 100, np.int32))
    level, step = jnp.array([0.5, 0.5, 0.12, 0.995]), np.array([99, 100, 99, 100])
    fallen = np.array([False, False, True, False])
    curriculum = ScenarioConfig(push_n=100, push_curriculum=True)
    np.testing.assert_allclose(next_level(curriculum, level, present, step, fallen), [0.5, 0.51, 0.1, 1.0], rtol=1e-6)
    alone = ScenarioConfig(push_curriculum=True)
    np.testing.assert_array_equal(next_level(alone, level, present, step, fallen), level, "nothing raises it")
    assert (first_level(alone, 4) == 1).all()
    # Four pushes borne and one not: the level is where it was.
    np.testing.assert_allclose(4 * LEVEL_UP, LEVEL_DOWN)


def test_robots_carry_their_level_from_episode_to_episode(hills, motion):
    config = ScenarioConfig(push_n=600, push_pause_s=0.0, push_curriculum=True)
    env = make(hills, motion, config, min_reward=None, max_position_error_m=None)
    state, levels = env.reset(jax.random.key(0)), []
    falls = np.zeros(ROBOTS)
    for i in range(60):
        state = env.step(state, NO_ACTION, jax.random.key(i))
        falls += np.asarray(state.terminated)
        levels.append(np.asarray(state.push_level))
    assert (falls > 0).all()
    assert (levels[6] == np.float32(0.11)).all(), "0.2 s are 6.25 control steps"
    assert np.abs(np.diff(levels, axis=0)).max() <= 0.04 + 1e-6
    assert (levels[-1] < 0.2).all()


@pytest.mark.parametrize("name", ["push_n", "terrain_m", "delay_s"])
def test_what_is_not_asked_for_does_not_act(name):
    config = replace(ScenarioConfig(), **{name: getattr(ALL, name)})
    drawn = draw_scenario(config, jax.random.key(1), 1000, HZ)
    acting = {"push_n": drawn.push.any(), "terrain_m": drawn.ground.uneven.any(), "delay_s": drawn.delay.any()}
    assert acting == {other: other == name for other in acting}
    assert config.active
    assert not ScenarioConfig().active


def test_a_push_over_is_followed_by_the_next_and_an_episode_over_by_all_anew():
    present = Scenario(
        push=jnp.ones((4, 1, 3)),
        push_start=jnp.array([[64], [96], [64], [96]]),
        push_stop=jnp.array([[264], [296], [264], [296]]),
        delay=jnp.full(4, 7),
        ground=Ground.of([Terrain("sine", 0.5)] * 4),
        kd_scale=jnp.full(4, 0.3),
    )
    ended = jnp.array([False, False, True, True])
    key, step = jax.random.key(2), jnp.array([288, 288, 288, 288])
    fresh = draw_scenario(ALL, key, 4, HZ)
    now = renew_scenario(ALL, key, present, step, ended, HZ)
    np.testing.assert_array_equal(now.delay, [7, 7, *fresh.delay[2:]])
    np.testing.assert_array_equal(now.ground.sine, [0.5, 0.5, *fresh.ground.sine[2:]])
    np.testing.assert_array_equal(now.push, [fresh.push[0], present.push[1], *fresh.push[2:]])
    np.testing.assert_array_equal(now.push_start, [288 + fresh.push_start[0], [96], *fresh.push_start[2:]])
    np.testing.assert_array_equal(now.push_stop, now.push_start + 200)


def test_pushes_act_when_and_as_drawn_one_after_the_other(hills, motion):
    config = ScenarioConfig(push_n=50, push_pause_s=0.032)
    env = make(hills, motion, config, min_reward=None, max_position_error_m=None)
    state = env.reset(jax.random.key(3))
    pushes = []
    for i in range(10):
        before, state = state, env.step(state, NO_ACTION, jax.random.key(i))
        target = sample(motion, np.asarray(before.motion.time) + 1)[0]
        target = np.asarray(target, float)[:, 7:]
        assert not np.asarray(state.terminated).any()
        pushes.append(before.scenario)
        over = before.scenario.push_stop[:, 0] <= SUBSTEPS * (i + 1)
        assert_same(state.scenario.push[~over], before.scenario.push[~over])
        assert (state.scenario.push[over] != before.scenario.push[over]).any(axis=(1, 2)).all()
        assert (state.scenario.push_start[over] - SUBSTEPS * (i + 1) <= SUBSTEPS).all()
    # 0.2 s are 6.25 control steps, so that the second push begins within 8 or 9 of them.
    assert all((pushes[-1].push != pushes[0].push).any(axis=(1, 2)))
    assert (pushes[-1].push_start >= 7 * SUBSTEPS).all()


def test_a_step_is_the_physics_under_the_drawn_disturbance(hills, motion):
    env = make(hills, motion, replace(ALL, push_pause_s=0.0))
    state = env.reset(jax.random.key(4))
    assert_same(
        state.scenario, draw_scenario(env.config.scenario, jax.random.fold_in(jax.random.key(4), 3), ROBOTS, HZ)
    )
    assert state.scenario.delay.any()
    assert state.scenario.ground.uneven.any()
    after = env.step(state, NO_ACTION, jax.random.key(5))
    target = np.asarray(env._target(state.motion, NO_ACTION), float)
    moved = hills.advance(state.physics, target, state.scenario, SUBSTEPS)
    going = ~np.asarray(after.terminated)
    assert going.sum() >= ROBOTS // 2
    assert_same(after.physics.qpos[going], moved.qpos[going])
    slots = (moved.step - state.scenario.delay) % 6
    sensed = moved.history[np.arange(ROBOTS), slots]
    np.testing.assert_allclose(after.final_observation[:, :6], sensed[:, 1:7], atol=1e-6)


def test_robots_start_on_a_crest_and_are_judged_from_there(hills, motion):
    env = make(hills, motion, ScenarioConfig(terrain_m=0.3), start_velocity_mps=0)
    state = env.reset(jax.random.key(10))
    height = state.scenario.ground.sine
    phase = np.asarray(state.motion.time)
    first = np.asarray(motion.qpos)[phase]
    on_terrain = height > 0
    assert 0 < on_terrain.sum() < ROBOTS
    np.testing.assert_allclose(state.physics.qpos[:, 0], np.where(on_terrain, np.pi / 2, first[:, 0]), atol=1e-6)
    np.testing.assert_allclose(state.physics.qpos[:, 2], first[:, 2] + height, atol=1e-6)

    for i in range(2):
        state = env.step(state, NO_ACTION, jax.random.key(i))
        assert not np.asarray(state.terminated).any()
    walked = state.physics.qpos.copy()
    walked[:, 2] -= height * np.sin(walked[:, 0])
    walked[:, 0] -= np.where(on_terrain, np.pi / 2 - first[:, 0], 0)
    expected = reward.total(reward.terms(reward.SCALES["weighted"], walked, sample(motion, phase + 2)[0]))
    np.testing.assert_allclose(state.reward, expected, atol=1e-5)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_critic_sees_the_scenario_in_the_mirror_of_the_policy(hills, motion, symmetric):
    ground = Ground.of(
        [Terrain("sine", 0.2), Terrain("slope", 0.1), Terrain("across", 0.3), Terrain("steps", 0.05)] * 2
    )
    scenario = Scenario.nominal(
        8, ground=ground, push=[[50.0, 30.0, 0.0]], push_start=0, push_stop=[[40], [0]] * 4, delay=np.arange(8) % 4
    )
    env = WalkEnv(hills, motion, WalkConfig(scenario=ALL, symmetric=symmetric), 8)
    # Half a stride apart, where one control step later is in the other step: that is what the policy sees.
    state = env.reset_at(np.repeat([3, 14], 4).astype(np.int32), scenario)
    second = np.asarray(motion.qpos)[np.asarray(state.motion.time) + 1][:, cassie.HIP_PITCH_QPOS]
    side = np.where(symmetric & (second[:, 0] < second[:, 1]), -1, 1)
    assert set(side.tolist()) == ({-1, 1} if symmetric else {1})
    pushed = np.array([1, 0] * 4)
    expected = [
        *(0 * pushed, 0.5 * pushed, 0.3 * pushed * side, ground.slope[:, 0] / 0.2, ground.slope[:, 1] / 0.2 * side),
        *(np.arange(8) % 4 / HZ / 0.01, ground.sine / 0.1, ground.steps / 0.1, ground.rough / 0.1),
    ]
    np.testing.assert_allclose(state.privileged, np.stack(expected, axis=1), atol=1e-6)


def test_a_reset_draws_everything_anew(hills, motion):
    env = make(hills, motion, ALL)
    state = env.reset(jax.random.key(7))
    for i in range(40):
        before, state = state, env.step(state, NO_ACTION, jax.random.key(i))
        ended = np.asarray(state.terminated)
        fresh = draw_scenario(ALL, jax.random.fold_in(jax.random.key(i), 3), ROBOTS, HZ)
        for name in ("push", "push_start", "push_stop", "delay", "ground"):
            now, drawn = (of_robots(getattr(each, name), ended) for each in (state.scenario, fresh))
            assert_same(now, drawn)
        assert_same(of_robots(state.scenario.ground, ~ended), of_robots(before.scenario.ground, ~ended))
        assert_same(state.scenario.delay[~ended], before.scenario.delay[~ended])
        if ended.any():
            return
    pytest.fail("the reference angles alone do not walk")


@pytest.mark.parametrize("engine", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_a_new_episode_senses_nothing_of_the_old_under_delay(hills, motion, engine):
    """On MJX all of it is one compiled scan, as in training."""
    physics = hills if engine == "native" else MjxPhysics(load_mjx_model(MJX_TRAINING), max_delay=5)
    task = ScenarioConfig(delay_s=0.0045)
    env = make(physics, motion, task, episode_steps=2, start_velocity_mps=0.0, start_offset_m=0.0)
    action = 0.1 * jax.random.normal(jax.random.key(3), (ROBOTS, 10))

    def step(state, key):
        state = env.step(state, action, key)
        return state, state

    state, keys = env.reset(jax.random.key(0)), jax.random.split(jax.random.key(1), 3)
    if engine == "mjx":
        _, after = jax.jit(lambda state: jax.lax.scan(step, state, keys))(state)
        _, renewed, onward = (jax.tree.map(lambda x, k=k: x[k], after) for k in range(3))
    else:
        _, renewed, onward = (state := step(state, key)[0] for key in keys)
    assert np.asarray(renewed.truncated).all()
    assert len(set(np.asarray(renewed.scenario.delay).tolist())) > 2
    now = np.concatenate([renewed.physics.qpos, renewed.physics.qvel], axis=1)
    np.testing.assert_array_equal(renewed.physics.history[:, :, :-10], np.repeat(now[:, None], 6, axis=1))
    clean = env.reset_at(renewed.motion.time, renewed.scenario)
    np.testing.assert_allclose(renewed.observation, clean.observation, atol=1e-6)
    clean, _ = step(clean, keys[2])
    np.testing.assert_allclose(onward.observation, clean.observation, atol=1e-3)
    np.testing.assert_allclose(onward.physics.history[:, :, :-10], clean.physics.history[:, :, :-10], atol=1e-3)


def test_without_disturbances_keys_draw_what_they_always_drew(hills, motion):
    env = make(hills, motion, ScenarioConfig(), episode_steps=1)
    state = env.reset(jax.random.key(8))
    np.testing.assert_array_equal(
        state.motion.time, jax.random.randint(jax.random.key(8), (ROBOTS,), 0, env.task.samples)
    )
    state = env.step(state, NO_ACTION, jax.random.key(9))
    assert np.asarray(state.truncated).all()
    np.testing.assert_array_equal(
        state.motion.time, jax.random.randint(jax.random.key(9), (ROBOTS,), 0, env.task.samples)
    )
    assert_same(state.scenario, Scenario.nominal(ROBOTS))


def test_both_engines_draw_and_live_the_same(hills, motion):
    config = ScenarioConfig(push_n=200, push_pause_s=0.0, terrain_m=0.24)
    states = []
    for physics in (hills, MjxPhysics(load_mjx_model(MJX_TRAINING))):
        env = make(physics, motion, config)
        state = env.reset(jax.random.key(10))
        for i in range(3):
            state = env.step(state, NO_ACTION, jax.random.key(i))
        states.append(state)
    assert_same(states[0].scenario, states[1].scenario)
    np.testing.assert_allclose(states[1].physics.qpos, states[0].physics.qpos, atol=0.02)
    np.testing.assert_allclose(states[1].reward, states[0].reward, atol=5e-3)


def test_bad_configurations(motion):
    for name in ("push_n", "push_backward", "push_pause_s", "terrain_m", "delay_s"):
        with pytest.raises(ValueError, match=f"{name}=-1 must be from 0 to "):
            replace(ScenarioConfig(), **{name: -1})
    for name, value in {
        "push_backward": 1.1,
        "delay_s": 0.2,
        "terrain_m": 2.0,
        "push_n": 1001,
        "push_pause_s": 61,
    }.items():
        with pytest.raises(ValueError, match=rf"{name}={value} must be from 0 to [\d.,]+\."):
            replace(ScenarioConfig(), **{name: value})
    with pytest.raises(
        ValueError, match=r"delay_s=0.01 with dynamics=none is up to 10 physics steps; .* made for 0 to 0\."
    ):
        make(NativePhysics(load_model(MODEL)), motion, ScenarioConfig(delay_s=0.01))
