"""Encoders, filters and motors: the maker's formulas worked by hand, and both engines with them."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from cassie_mjx.agents.make import make_agent
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import make_env
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.evaluation.film import begin
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import LIMIT_PHASES, EvalSetup
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario, motor_torque, sensed
from cassie_mjx.robot import cassie, electronics
from cassie_mjx.robot.dynamics import Dynamics
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_model

ROLL, PITCH, KNEE, FOOT = 0, 2, 3, 4
SPRUNG = cassie.qpos_index(*cassie.SPRUNG_NAMES)
SPRUNG_V = cassie.qvel_index(*cassie.SPRUNG_NAMES)
POSES = cassie.STANDING_TARGET
REAL = ModelConfig(electronics=True)


def robots(count=1):
    return np.zeros((count, cassie.NQ)), np.zeros((count, cassie.NV))


def turning(speeds, cycles):
    """What is shown cycle by cycle of the 14 joints with encoders, which turn at these rad/s from rest at 0."""
    qpos, qvel = robots()
    memory, seen = electronics.init(qpos, qvel), []
    for cycle in range(1, cycles + 1):
        after = qpos.copy()
        after[:, cassie.ENCODER_QPOS] = np.asarray(speeds) * cycle / 2000
        memory = electronics.update(memory, qpos, after, 1)
        qpos = after
        seen.append([part[0] for part in electronics.shown(memory, qpos, qvel)])
    return [np.array(each) for each in zip(*seen, strict=True)]


def test_positions_are_whole_counts_towards_zero():
    """A hip roll's motor turns 25 times as far and has 8192 counts a turn: 32594.93 a rad. A shin has 41721.5."""
    qpos, qvel = robots(2)
    hip, foot = cassie.ACTIVE_QPOS[[ROLL, FOOT]]
    qpos[:, hip], qpos[:, foot], qpos[:, SPRUNG[0]] = (0.1, -0.1), (0.1, -0.1), (0.1, -0.1)
    shown, _ = electronics.shown(electronics.init(qpos, qvel), qpos, qvel)
    np.testing.assert_allclose(shown[:, hip], np.array([3259, -3259]) * 2 * np.pi / 8192 / 25, rtol=1e-12)
    # Gear 50 and 2^18 counts a turn: 208607.57 of 0.1 rad. 4172.15 of the shin's.
    np.testing.assert_allclose(shown[:, foot], np.array([208607, -208607]) * 2 * np.pi / 262144 / 50, rtol=1e-12)
    np.testing.assert_allclose(shown[:, SPRUNG[0]], np.array([4172, -4172]) * 2 * np.pi / 262144, rtol=1e-12)


def test_a_motor_that_turns_by_a_count_once_shows_its_filters_taps():
    """A step of 100 counts, from rest: sums of the taps newest first, times 100 x 2 pi / 8192 / 25 / pi."""
    taps = [2727, 534, -2658, -795, 72, 110, 19, -6, -3]
    qpos, qvel = robots()
    memory = electronics.init(qpos, qvel)
    stepped = qpos.copy()
    hip = cassie.ACTIVE_QPOS[ROLL]
    stepped[:, hip] = 100.5 * 2 * np.pi / 8192 / 25
    speeds, before = [], qpos
    for _ in range(10):
        memory = electronics.update(memory, before, stepped, 1)
        before = stepped
        speeds.append(electronics.shown(memory, stepped, qvel)[1][0, cassie.ACTIVE_QVEL[ROLL]])
    expected = [sum(taps[: k + 1]) * 100 * 2 / 8192 / 25 for k in range(9)]
    np.testing.assert_allclose(speeds, [*expected, 0.0], rtol=1e-9, atol=1e-12)
    assert expected[0] == pytest.approx(2.663086, rel=1e-6)


def test_a_shin_shows_the_recursion_of_its_filter():
    """A step of 1000 counts, u = 0.0239684 rad: y_1 = 12.348 u, and from then on what goes in is 2 u, u, 0 times it."""
    qpos, qvel = robots()
    memory = electronics.init(qpos, qvel)
    stepped, before, seen = qpos.copy(), qpos, []
    stepped[:, SPRUNG[0]] = 1000.5 * 2 * np.pi / 262144
    for _ in range(5):
        memory = electronics.update(memory, before, stepped, 1)
        before = stepped
        seen.append(electronics.shown(memory, stepped, qvel)[1][0, SPRUNG_V[0]])
    u = 0.0239684
    y1 = 12.348 * u
    y2 = 12.348 * 2 * u + 1.7658 * y1
    y3 = 12.348 * u + 1.7658 * y2 - 0.79045 * y1
    y4 = 1.7658 * y3 - 0.79045 * y2
    y5 = 1.7658 * y4 - 0.79045 * y3
    np.testing.assert_allclose(seen, [y1, y2, y3, y4, y5], rtol=1e-5)


def test_filters_show_the_speed_of_what_turns_evenly():
    """Taps x 0..8 sum to -6281: 6281 / pi / 2000 of it in the end, and 12.348 x 4 / (1 - 1.7658 + 0.79045) / 2000."""
    _, qvel = turning(np.full(14, 2.0), 400)
    assert 6281 / np.pi / 2000 == pytest.approx(0.99965, abs=1e-5)
    np.testing.assert_allclose(qvel[-100:, cassie.ACTIVE_QVEL].mean(axis=0), 2 * 0.99965, rtol=1e-3)
    np.testing.assert_allclose(qvel[-100:, SPRUNG_V].mean(axis=0), 2 * 49.392 / 0.02465 / 2000, rtol=1e-3)
    # At first they lag behind.
    assert (qvel[0, cassie.ACTIVE_QVEL] < 1.2).all()
    assert (qvel[5, SPRUNG_V] < 1.5).all()


def test_robots_that_begin_in_motion_show_it():
    qpos, qvel = robots()
    qvel[:] = 1.5
    _, shown = electronics.shown(electronics.init(qpos, qvel), qpos, qvel)
    np.testing.assert_allclose(shown, 1.5, atol=0.05)


def test_rest_is_shown_as_rest_and_the_pelvis_as_it_is(standing_qpos):
    qpos, qvel = standing_qpos[None], np.zeros((1, cassie.NV))
    qvel[:, :6] = np.arange(1, 7)
    shown, shown_v = electronics.shown(electronics.init(qpos, qvel), qpos, qvel)
    np.testing.assert_array_equal(shown_v, qvel)
    np.testing.assert_array_equal(shown[:, :7], qpos[:, :7])
    np.testing.assert_allclose(shown, qpos, atol=4.8e-5)


def test_motors_give_less_at_speed():
    """Hip roll: 112.5 N·m at most, 2900 rpm over 25 is 12.147 rad/s; it gives all of it up to half of that."""
    qdot = np.zeros((4, 10))
    qdot[:, ROLL] = 0, 6.0, -9.1106, 13
    torque = electronics.limited(np.full((4, 10), -300.0), qdot)
    np.testing.assert_allclose(torque[:, ROLL], [-112.5, -112.5, -56.25, 0], rtol=1e-4)
    # Knee: 1300 rpm over 16 is 8.5085 rad/s; foot: 5500 over 50 is 11.519 rad/s.
    qdot[:, KNEE], qdot[:, FOOT] = 0.75 * 8.5085, 0.9 * 11.519
    torque = electronics.limited(np.full((4, 10), 300.0), qdot)
    np.testing.assert_allclose(torque[:, KNEE], 195.2 / 2, rtol=1e-4)
    np.testing.assert_allclose(torque[:, FOOT], 45 * 0.2, rtol=1e-3)
    np.testing.assert_array_equal(electronics.limited(np.full((4, 10), 5.0), 0 * qdot), 5)


def test_numpy_and_jax_show_the_same():
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=(3, cassie.NQ)), rng.normal(size=(3, cassie.NV))
    ours, theirs = electronics.init(qpos, qvel), jax.jit(electronics.init)(qpos, qvel)
    update = jax.jit(electronics.update, static_argnums=3)
    for _ in range(20):
        after = qpos + 0.001 * rng.normal(size=qpos.shape)
        ours, theirs = electronics.update(ours, qpos, after, 2), update(theirs, qpos, after, 2)
        qpos = after
    for a, b in zip(electronics.shown(ours, qpos, qvel), jax.jit(electronics.shown)(theirs, qpos, qvel), strict=True):
        # Of angles of 1 rad, float32 takes some for the count beside theirs.
        np.testing.assert_allclose(a, b, atol=1e-4 if a.shape[1] == cassie.NQ else 0.2)
    np.testing.assert_allclose(electronics.shown(ours, qpos, qvel)[0], qpos, atol=4.8e-5)


# In the engines


@pytest.mark.parametrize(("engine", "hz", "late"), [("native", 2000, 6), ("native", 500, 2), ("mjx", 1000, 3)])
def test_torques_act_three_milliseconds_late(engine, hz, late, standing_qpos):
    """A target that jumps is felt by nothing for 3 ms, at 500 Hz for 4."""
    physics = make_physics(engine, replace(MJX_TRAINING, physics_hz=hz, electronics=True))
    start = np.tile(standing_qpos, (2, 1))
    start[:, cassie.PELVIS_Z] += 1
    state = physics.init(start.astype(np.float32), np.zeros((2, cassie.NV), np.float32))
    scenario = Scenario.nominal(2)
    jumped = np.tile(POSES, (2, 1))
    for _ in range(8):
        state = physics.advance(state, jumped, scenario, 1)
    jumped[1, KNEE] += 0.2
    apart = []
    for _ in range(late + 1):
        state = physics.advance(state, jumped, scenario, 1)
        apart.append(abs(state.qvel[1] - state.qvel[0]).max())
    np.testing.assert_allclose(apart[:-1], 0, atol=1e-5)
    assert apart[-1] > 0.01


def test_an_engine_without_room_for_the_torque_delay_is_refused():
    with pytest.raises(ValueError, match="max_delay=3 has no room .* it must be 6 or more"):
        NativePhysics(load_model(REAL), 3, electronics=True)


def test_counts_of_a_state_that_has_diverged_are_0():
    qpos = np.full((1, cassie.NQ), np.nan)
    memory = electronics.init(qpos, np.zeros((1, cassie.NV)))
    np.testing.assert_array_equal(memory.counts, 0)


def test_dynamics_have_a_torque_delay_of_their_own_and_nominal_ones_the_engines(standing_qpos):
    physics = make_physics("native", REAL, max_delay=12)
    start = np.tile(standing_qpos, (4, 1))
    start[:, cassie.PELVIS_Z] += 1
    state = physics.init(start, np.zeros((4, cassie.NV)))
    for late, acts_at in (([2, 2, 12, 12], (3, 13)), ([-1, -1, 12, 12], (7, 13))):
        scenario = Scenario.nominal(4, dynamics=Dynamics.nominal(4, torque_delay=np.array(late, np.int32)))
        settled = physics.advance(state, np.tile(POSES, (4, 1)), scenario, 16)
        jumped = np.tile(POSES, (4, 1))
        jumped[1::2, KNEE] += 0.2
        for k, first in enumerate(acts_at):
            for steps in (first - 1, first):
                qvel = physics.advance(settled, jumped, scenario, steps).qvel
                assert (abs(qvel[2 * k + 1] - qvel[2 * k]).max() > 1e-9) == (steps == first)


def test_law_and_agents_act_on_what_is_shown(standing_qpos):
    physics = make_physics("native", REAL)
    state = physics.init(standing_qpos[None], np.zeros((1, cassie.NV)))
    state = physics.advance(state, POSES[None] + 0.1, Scenario.nominal(1), 40)
    qpos, qvel = sensed(state, Scenario.nominal(1))
    memory = state.electronics or pytest.fail("there are no electronics")
    expected = electronics.shown(memory, state.qpos, state.qvel)
    np.testing.assert_array_equal(qpos, expected[0])
    np.testing.assert_array_equal(qvel, expected[1])
    off = abs(qvel - state.qvel)[0]
    assert off[cassie.ACTIVE_QVEL].min() > 0
    assert off[SPRUNG_V].min() > 0
    torque = cassie.P_GAIN * (POSES - qpos[:, cassie.ACTIVE_QPOS]) - cassie.D_GAIN * qvel[:, cassie.ACTIVE_QVEL]
    np.testing.assert_allclose(motor_torque(state, POSES[None], Scenario.nominal(1)), torque, rtol=1e-12)
    # Senses that are a step late besides show what was shown before.
    late = replace(Scenario.nominal(1), delay=np.array([1], np.int32))
    before = sensed(state, late)
    after = physics.advance(state, POSES[None], Scenario.nominal(1), 1)
    np.testing.assert_array_equal(sensed(after, late)[1], qvel)
    assert np.abs(before[1] - qvel).max() > 0


def test_both_engines_walk_alike_with_electronics():
    """From the reference's first poses under its own angles for two control steps, at 1 kHz."""
    motion, ends = load_motion("walk"), []
    for engine in ("native", "mjx"):
        physics = make_physics(engine, replace(MJX_TRAINING, iterations=30, ls_iterations=20, electronics=True))
        state = physics.init(motion.qpos[:4].astype(np.float32), motion.qvel[:4].astype(np.float32))
        for k in (1, 2):
            state = physics.advance(state, motion.qpos[k : k + 4, cassie.ACTIVE_QPOS], Scenario.nominal(4), 32)
        ends.append((state.qpos, *sensed(state, Scenario.nominal(4))))
    (ours, seen, seen_v), (theirs, seen_x, seen_xv) = ends
    np.testing.assert_allclose(ours, theirs, atol=2e-3)
    np.testing.assert_allclose(seen[:, cassie.ENCODER_QPOS], seen_x[:, cassie.ENCODER_QPOS], atol=2e-3)
    np.testing.assert_allclose(seen_v, seen_xv, atol=0.3)


def test_robots_begin_anew_with_a_memory_of_their_own():
    env = make_env(robots=4, config=WalkConfig(electronics=True, min_reward=0.9, start_velocity_mps=0.0))
    state = env.reset(jax.random.key(0))
    for k in range(3):
        state = env.step(state, np.full((4, 10), 0.5), jax.random.key(k))
    assert np.asarray(state.terminated).all()
    memory = state.physics.electronics or pytest.fail("there are no electronics")
    expected = electronics.init(state.physics.qpos, state.physics.qvel)
    for now, anew in zip(memory, expected, strict=True):
        np.testing.assert_array_equal(now, anew)


def test_suites_walk_with_electronics():
    """Noise-free counts and 3 ms cost 1x little, and change its walk."""
    agent, found = make_agent("1x"), []
    for on in (False, True):
        setup = EvalSetup(electronics=on)
        starts = setup.starts(agent, LIMIT_PHASES[:2])
        assert (starts.physics.electronics is not None) == on
        found.append(run_trials(agent, setup.physics(), starts, [Trial(0, 3.0), Trial(1, 3.0)]))
    assert not found[1].fell.any()
    np.testing.assert_allclose(found[1].speed_mps, found[0].speed_mps, atol=0.1)
    assert np.abs(found[1].distance_m - found[0].distance_m).max() > 1e-4


def test_films_have_electronics_too():
    for on in (False, True):
        _, robots = begin(make_agent("1x"), Trial(0, 1.0), 0.0, on)
        assert (robots.physics.electronics is not None) == on


def test_without_electronics_nothing_is_remembered():
    motion = load_motion("walk")
    physics = NativePhysics(load_model(ModelConfig()))
    assert physics.init(motion.qpos[:1], motion.qvel[:1]).electronics is None


def test_bad_configurations():
    with pytest.raises(ValueError, match="physics_hz=4000 with electronics, whose cycles come at 2000 Hz: use 500"):
        ModelConfig(physics_hz=4000, electronics=True)
    plain = make_physics("native", MJX_TRAINING)
    env = WalkEnv(plain, load_motion("walk"), WalkConfig(electronics=True), 2)
    with pytest.raises(ValueError, match="electronics=True is not what this engine was made for"):
        env.reset(jax.random.key(0))
