"""Standing: the reference, the way to it and back, and robots of the task."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.control import command as motions
from cassie_mjx.control.command import STEP_OUT_MPS, SWAY_MPS, MotionState, onward, toward
from cassie_mjx.control.path import Path, into, stay_beside
from cassie_mjx.envs import command
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.make import make_env
from cassie_mjx.evaluation.standing import soles_of
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import sample
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model

DT = 0.032
STAND = (0.0, 0.0, 0.0, 1.0)
AT_REST = np.zeros((1, 32))


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


def told(*numbers, robots=1):
    return Command(*(np.full(robots, number) for number in numbers))


def test_the_standing_pose_is_the_keyframe():
    np.testing.assert_allclose(cassie.STANDING_QPOS, load_model(ModelConfig()).key("standing").qpos, atol=1e-8)


@pytest.mark.parametrize("xp", [np, jnp])
def test_a_standing_reference_is_the_pose_and_a_walking_one_is_as_it_was(motion, xp):
    time = np.arange(22)
    walking = sample(motion, time, told(0.3, 0.1, 0.2, 0.0, robots=22))
    without = sample(motion, time, Command(*(np.full(22, number) for number in (0.3, 0.1, 0.2))))
    for ours, theirs in zip(walking, without, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    qpos, qvel = sample(motion, xp.asarray(time), jax.tree.map(xp.asarray, told(*STAND, robots=22)))
    np.testing.assert_array_equal(qvel, 0)
    np.testing.assert_allclose(qpos, np.tile(cassie.STANDING_QPOS, (22, 1)), atol=1e-6)
    half, velocity = sample(motion, time, told(0.0, 0.0, 0.0, 0.5, robots=22))
    stepping, speed = sample(motion, time, told(0.0, 0.0, 0.0, 0.0, robots=22))
    np.testing.assert_allclose(half[:, 2], (0.988208798 + stepping[:, 2]) / 2)
    np.testing.assert_allclose(velocity, speed / 2)
    np.testing.assert_allclose(np.linalg.norm(half[:, 3:7], axis=1), 1)


def test_strides_begin_with_both_feet_down(motion):
    soles = soles_of(load_model(ModelConfig()), np.asarray(motion.qpos))[..., 2]
    assert (soles[[0, 11]] < 0.03).all()
    assert (soles.max(axis=1)[[4, 5, 6, 7, 15, 16, 17, 18]] > 0.1).all()


def test_a_robot_stands_once_it_steps_on_the_spot_and_a_foot_has_landed(motion):
    """From 0.5 m/s at sample 3: at rest after 11 steps, in sample 14; in half of the step that follows it stands."""
    command, time, stands, forward, times = told(0.5, 0.0, 0.2, 0.0), np.array([3]), [], [], []
    for _ in range(60):
        times.append(int(time[0]))
        command = toward(motion, command, told(*STAND), time, AT_REST)
        stands.append(float(np.asarray(command.stand)[0]))
        forward.append(float(command.forward[0]))
        time = onward(motion, time, command)
    assert forward.index(0) == 10, "0.5 m/s at 1.5 m/s² takes 10.4 control steps"
    assert times[stands.index(0.2)] == 22, "a foot lands"
    np.testing.assert_allclose(stands[19:24], np.arange(1, 6) / 5)
    assert set(stands[24:]) == {1.0}
    assert times[19:31] == list(range(22, 34))
    assert set(times[30:]) == {33}, "the clock rests as the other foot lands"
    backwards = []
    for _ in range(7):
        command = toward(motion, command, told(-0.5, 0.0, 0.0, 0.0), time, AT_REST)
        backwards.append((float(np.asarray(command.stand)[0]), float(command.forward[0])))
        time = onward(motion, time, command)
    np.testing.assert_allclose([stand for stand, _ in backwards], [*np.arange(4, -1, -1) / 5, 0, 0], atol=1e-9)
    assert [speed for _, speed in backwards[:4]] == [0] * 4, "it walks only when it no longer stands"
    assert backwards[-1][1] < 0
    assert time == 33 + len(backwards), "the clock goes on at once"


def moved_at(speed):
    """Velocities [1, 32] of a robot that moves at a speed, m/s, forward and to the right."""
    moved = np.zeros((1, 32))
    moved[0, :2] = 0.6 * speed, -0.8 * speed
    return moved


def test_a_standing_robot_that_something_moves_takes_whole_steps(motion):
    """It leaves above STEP_OUT_MPS, and comes to stand again, as a foot lands, below SWAY_MPS."""
    command, time, stands = told(*STAND), np.array([11]), []
    too_fast = STEP_OUT_MPS + 0.01, SWAY_MPS + 0.01
    speeds = [STEP_OUT_MPS - 0.01] * 3 + [too_fast[0]] + [0.0] * 9 + [too_fast[1]] * 12 + [SWAY_MPS - 0.01] + [9.0] * 10
    for speed in speeds:
        command = toward(motion, command, told(*STAND), time, moved_at(speed))
        stands.append(float(np.asarray(command.stand)[0]))
        time = onward(motion, time, command)
    np.testing.assert_allclose(stands[:9], [1, 1, 1, 0.8, 0.6, 0.4, 0.2, 0, 0], atol=1e-9)
    np.testing.assert_allclose(stands[9:25], 0, atol=1e-9, err_msg="at sample 22 it is too fast to stand")
    np.testing.assert_allclose(stands[25:], [0.2, 0.4, 0.6, 0.8, *[1] * 7], err_msg="from sample 33 to 44")
    assert time == 44


def test_a_standing_robot_pushed_aside_takes_its_path_along(motion):
    zeros = np.zeros(1)
    state = MotionState(np.array([0]), np.array([0]), told(*STAND), told(*STAND), zeros, Path(zeros, zeros, zeros))
    np.testing.assert_allclose(motions.follow(state, np.array([0.2]), np.array([0.5]), 0.3).path.y, 0.2)
    qpos, qvel = np.zeros((1, 35)), np.zeros((1, 32))
    qpos[0, :7] = 4, 0.5, 1, 1, 0, 0, 0
    now, _ = sample(motion, np.array([0]), told(*STAND))
    beside = stay_beside(Path(zeros, zeros, zeros), told(*STAND), now, qpos, qvel)
    np.testing.assert_allclose(into(beside, qpos, qvel)[0][:, 1], 0.3)
    np.testing.assert_array_equal(stay_beside(Path(zeros, zeros, zeros), told(0.7, 0, 0, 0), now, qpos, qvel), 0)


def test_robots_told_to_stand_are_not_paid_for_steps_on_the_spot(motion):
    """Told to walk, braking, stepping on the spot, half way, on the way from standing to walking."""
    forward, stand = np.array([0.7, 0.7, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 0.5, 0.5])
    target = np.array([0.0, 1.0, 1.0, 1.0, 0.0])
    zeros = np.zeros(5)
    now, goal = Command(forward, zeros, zeros, stand), Command(zeros, zeros, zeros, target)
    state = MotionState(np.full(5, 5), np.full(5, 5), now, goal, zeros, Path(zeros, zeros, zeros))
    np.testing.assert_array_equal(command.paid(state), [1, 1, 0, 0.5, 1])
    env = make_env(robots=1, physics_hz=500, config=WalkConfig(min_reward=None), command="joystick")
    stands, steps = (
        env.reset_at(np.array([5], np.int32), Scenario.nominal(1), jax.tree.map(jnp.float32, told(0.0, 0.0, 0.0, 0.0)))
        for _ in range(2)
    )
    to_stand = jax.tree.map(jnp.float32, told(*STAND))
    stands = replace(stands, motion=stands.motion._replace(target_command=to_stand))
    ends = [env.step(state, np.zeros((1, 10)), jax.random.key(0)) for state in (stands, steps)]
    np.testing.assert_array_equal(ends[0].physics.qpos, ends[1].physics.qpos)
    assert ends[0].reward[0] == 0
    assert ends[1].reward[0] == pytest.approx(ends[1].metrics["weighted"][0])
    assert ends[0].metrics["weighted"][0] == ends[1].metrics["weighted"][0] > 0.5, "what is measured is the same"


def test_a_robot_that_is_not_paid_goes_on():
    """`min_reward` is about how near it is to the reference, whatever it is paid."""
    env = make_env(robots=1, physics_hz=500, command="joystick")
    assert env.config.min_reward
    state = env.reset_at(np.array([5]), Scenario.nominal(1), jax.tree.map(jnp.float32, told(0.0, 0.0, 0.0, 0.0)))
    to_stand = jax.tree.map(jnp.float32, told(*STAND))
    after = env.step(
        replace(state, motion=state.motion._replace(target_command=to_stand)), np.zeros((1, 10)), jax.random.key(0)
    )
    assert after.reward[0] == 0
    assert not after.metrics["low_reward"][0]
    assert after.motion.step[0] == 1


def test_episodes_begin_with_steps_or_with_a_whole_stance(motion):
    """Robots half way to standing, and one too fast to stand, begin with steps, where they are in the stride."""
    stand = jnp.array([0.0, 0.4, 1.0, 1.0])
    speed = jnp.array([0.0, 0.0, 0.0, STEP_OUT_MPS])
    zeros = jnp.zeros(4)
    state = command.start_motion(
        motion, jnp.full(4, 15), Command(zeros, zeros, zeros, stand), Scenario.nominal(4).ground, speed
    )
    np.testing.assert_array_equal(state.command.stand, [0, 0, 1, 0])
    np.testing.assert_array_equal(state.target_command.stand, stand)
    np.testing.assert_array_equal(state.time, [15, 15, 11, 15])


def test_robots_of_the_task_stand_from_the_first_moment_and_their_clock_rests():
    task = WalkConfig(start_velocity_mps=0, min_reward=None, max_position_error_m=None, command_s=3600)
    env = make_env(robots=22, physics_hz=500, config=task, command="joystick")
    command = jax.tree.map(jnp.float32, told(*STAND, robots=22))
    state = env.reset_at(np.arange(22, dtype=np.int32), Scenario.nominal(22), command)
    np.testing.assert_array_equal(state.motion.time, [0] * 11 + [11] * 11)
    np.testing.assert_allclose(
        np.asarray(state.physics.qpos)[:, 2:], np.tile(cassie.STANDING_QPOS[2:], (22, 1)), atol=1e-6
    )
    hold = np.tile(cassie.STANDING_TARGET - cassie.STANDING_QPOS[cassie.ACTIVE_QPOS], (22, 1))
    for k in range(15):
        state = env.step(state, hold, jax.random.key(k))
    assert not np.asarray(state.terminated).any()
    np.testing.assert_array_equal(state.motion.time, [0] * 11 + [11] * 11)
    np.testing.assert_array_equal(state.motion.step, 15)
    assert np.asarray(state.metrics["weighted"]).min() > 0.9, "the published standing targets hold the pose"
