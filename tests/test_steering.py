"""Steering: the path that a command bends, and robots, rewards, observations and policies along it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from seeing import FULL, observe
from tiny import config, session

from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.agents.steered import SteeredAgent
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control import command as motions
from cassie_mjx.control.command import MotionState
from cassie_mjx.control.path import Path, into, out_of, shift
from cassie_mjx.envs.command import (
    STANDING_SHARE,
    STILL_SHARE,
    CommandRange,
    command_range,
    draw_command,
    redraw_target,
)
from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.envs.make import make_env
from cassie_mjx.envs.outcome import post_physics
from cassie_mjx.evaluation import returns
from cassie_mjx.motion.command import JOYSTICK, STRAIGHT, Command
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import ReferenceMotion, mean_speed, sample
from cassie_mjx.motion.schedule import constant
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model
from cassie_mjx.robot.rotation import yaw

DT = 0.032


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


@pytest.fixture(scope="module")
def gliding(motion):
    """1 m/s along x without any sway: every sample is the first one, further along."""
    qpos, qvel = np.tile(motion.qpos[0], (22, 1)), np.zeros((22, 32))
    qpos[:, :7] = [0, 0, 1, 1, 0, 0, 0]
    qpos[:, 0] = DT * np.arange(22)
    qvel[:, 0] = 1
    return ReferenceMotion(qpos, qvel, np.float64(22 * DT))


def begin(*told):
    """A robot at the origin with this command, by NumPy."""
    zeros = np.zeros(1)
    command = Command(*(np.array([number]) for number in (*told, *[0.0] * (4 - len(told)))))
    return MotionState(np.array([0]), np.array([0]), command, command, zeros, Path(zeros, zeros, zeros))


def walk(motion, state, steps):
    """World states of the reference from now on, [steps + 1, 35], and the last moment."""
    places, last = [], state
    for _ in range(steps + 1):
        places.append(out_of(state.path, *motions.reference(motion, state))[0][0])
        last, state = state, motions.tick(motion, state)
    return np.array(places), last


def test_a_turning_reference_goes_round_a_circle_and_comes_back(gliding):
    # 1 m/s and 0.5 rad/s to the left: 2 m around (0, 2), once in 4 pi s; 393 steps of 0.032 s are 0.2 steps more.
    places, _ = walk(gliding, begin(1.0, 0.0, 0.5), 393)
    np.testing.assert_allclose(np.linalg.norm(places[:, :2] - [0, 2], axis=1), 2, atol=1e-3)
    np.testing.assert_allclose(places[-1, :2], [0, 0], atol=0.02)
    np.testing.assert_allclose(places[98, :2], [2, 2], atol=0.02)
    np.testing.assert_allclose(yaw(places[98, 3:7]), 98 * DT * 0.5, atol=1e-9)
    right, _ = walk(gliding, begin(1.0, 0.0, -0.5), 98)
    np.testing.assert_allclose(right[-1, :2], [2, -2], atol=0.02)


def test_sideways_and_backwards_and_on_the_spot(gliding):
    places, last = walk(gliding, begin(-0.5, 0.4, 0.0), 100)
    np.testing.assert_allclose(places[-1, :2], [-1.6, 1.28], atol=1e-9)
    velocity = sample(gliding, last.time, last.command)[1][0]
    np.testing.assert_allclose(velocity[:6], [-0.5, 0.4, 0, 0, 0, 0], atol=1e-12)
    spun, _ = walk(gliding, begin(0.0, 0.0, 0.8), 100)
    np.testing.assert_allclose(spun[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(yaw(spun[-1, 3:7]), 2.56, atol=1e-9)


def test_the_velocities_are_those_of_the_places(motion):
    """What `reference` says of pelvis velocity and turning is how fast place and heading change, half a step on."""
    own = float(mean_speed(motion))
    straight, steered = (walk(motion, begin(2 * own, *told), 44)[0] for told in ((0, 0), (0.4, 0.8)))
    _, last = walk(motion, begin(2 * own, 0.4, 0.8), 44)
    qpos, qvel = motions.reference(motion, last)
    without = sample(motion, last.time, Command.ahead(last.command.forward))[1]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(qpos[0, 3:7], float))
    turning = rotation.reshape(3, 3) @ (qvel - without)[0, 3:6]
    np.testing.assert_allclose(turning, [0, 0, 0.8], atol=1e-6)
    np.testing.assert_allclose((qvel - without)[0, :3], [0, 0.4, 0], atol=1e-6)
    np.testing.assert_array_equal((qvel - without)[0, 6:], 0)
    # A stride later it has turned by 0.704 * 0.8 rad, and height and joints are those of the straight walk.
    np.testing.assert_allclose(yaw(steered[22, 3:7]) - yaw(straight[22, 3:7]), 0.704 * 0.8, atol=1e-6)
    np.testing.assert_array_equal(steered[:, [2, *range(7, 35)]], straight[:, [2, *range(7, 35)]])


def test_the_frame_is_left_and_entered_without_loss(motion):
    rng = np.random.default_rng(0)
    path = Path(*rng.normal(size=(3, 22)))
    seen = into(path, motion.qpos, motion.qvel)
    for ours, theirs in zip(out_of(path, *seen), (motion.qpos, motion.qvel), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    for xp in (np, jnp):
        qpos, qvel = xp.asarray(motion.qpos), xp.asarray(motion.qvel)
        for ours, theirs in zip(into(Path.world(22), qpos, qvel), (qpos, qvel), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    # A quarter turn to the left at (1, 2): what is at (1, 5) and looks along y is 3 m ahead and looks ahead.
    quarter = np.sqrt(0.5)
    qpos, qvel = np.zeros((1, 35)), np.arange(32.0)[None]
    qpos[0, :7] = 1, 5, 1, quarter, 0, 0, quarter
    found, velocity = into(Path(*np.array([[1.0], [2.0], [np.pi / 2]])), qpos, qvel)
    np.testing.assert_allclose(found[0, :7], [3, 0, 1, 1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(velocity[0], [1, 0, *range(2, 32)], atol=1e-12)


@pytest.mark.parametrize("preset", ["undisturbed", "robust"])
def test_straight_ahead_no_bit_of_the_frame_changes(preset):
    """Robots see themselves, bit for bit, as in the world: by the formulas without a path."""
    env = make_env("any", 16, "native", 500, replace(WALK_PRESETS[preset], symmetric=False, leash_m=0.2, command_s=0.3))
    state = env.reset(jax.random.key(0))
    for step in range(20):
        np.testing.assert_array_equal(state.motion.path, np.zeros((3, 16)))
        ahead = [np.asarray(x) for x in motions.reference(env.motion, state.motion, ahead=1)]
        qpos, qvel = (np.asarray(x, np.float32) for x in (state.physics.qpos, state.physics.qvel))
        if preset == "undisturbed":
            seen = np.asarray(observe(qpos, qvel, *ahead))
            np.testing.assert_array_equal(state.observation[:, :40], seen[:, :40])
            # Compiled alone, the stretched reference has another last bit.
            np.testing.assert_allclose(state.observation[:, 40:], seen[:, 40:], rtol=1e-6)
        state = env.step(state, np.full((16, 10), 0.02, np.float32), jax.random.key(step))


def steering_env(robots, **changes):
    task = WalkConfig(start_velocity_mps=0, symmetric=False, min_reward=None, max_position_error_m=None, command_s=None)
    return make_env(robots=robots, physics_hz=500, config=replace(task, **changes), command="joystick")


def test_a_robot_on_the_circle_is_rewarded_and_sees_as_straight_ahead(motion):
    env, robots = steering_env(8), 8
    own, time = float(mean_speed(motion)), np.arange(robots, dtype=np.int32)
    told = Command(*(jnp.full(robots, number, jnp.float32) for number in (own, 0.2, 0.5)))
    bent = env.reset_at(time, Scenario.nominal(robots), told)
    straight = env.reset_at(time, Scenario.nominal(robots), Command.ahead(told.forward))
    lying = Path(*(jnp.linspace(0, end, robots) for end in (3.0, -2.0, 6.0)))
    moment = bent.motion._replace(path=lying)
    key, sensing = jax.random.key(0), bent.sensing
    after = motions.tick(env.motion, moment)
    qpos, qvel = map(jnp.asarray, out_of(after.path, *motions.reference(env.motion, after)))
    outcome = post_physics(env.task, moment, sensing, bent.push_level, bent.scenario, qpos, qvel, qpos, qvel, key)
    np.testing.assert_allclose(outcome.metrics["weighted"], 1, atol=1e-5)
    np.testing.assert_allclose(outcome.final_privileged, 0, atol=1e-4)
    moment = motions.tick(env.motion, straight.motion)
    states = [motions.reference(env.motion, moment, ahead=k) for k in (0, 1)]
    expected = np.array(observe(*map(np.asarray, (*states[0], *states[1]))))
    difference = np.asarray(outcome.final_observation) - expected
    # Pelvis velocity along y is 0.2 m/s more, and it turns by 0.5 rad/s about the vertical; twice: robot, reference.
    for half in (0, 40):
        np.testing.assert_allclose(difference[:, half + 6 : half + 9], np.tile([0, 0.2, 0], (robots, 1)), atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(difference[:, half + 9 : half + 12], axis=1), 0.5, atol=1e-5)
        rest = [*range(6), *range(12, 40)]
        np.testing.assert_allclose(difference[:, half:][:, rest], 0, atol=1e-5)


def test_a_mirrored_robot_under_the_mirrored_command_sees_the_reflection(motion):
    """Robots a little off the reference, anywhere on the bends of their paths, and all of it reflected in y = 0."""
    rng = np.random.default_rng(1)
    numbers, zeros, time = rng.uniform(-0.4, 0.4, (3, 22)), np.zeros(22), np.arange(22)
    image_motion = motion._replace(qpos=cassie.mirror_qpos(motion.qpos), qvel=cassie.mirror_qvel(motion.qvel))
    command = Command(0.7 + numbers[0], numbers[1], numbers[2])
    state = MotionState(time, time, command, command, zeros, Path(1 + zeros, 2 + zeros, 3 * numbers[0]))
    image = state._replace(
        command=command._replace(lateral=-command.lateral, yaw_rate=-command.yaw_rate),
        path=Path(state.path.x, -state.path.y, -state.path.heading),
    )
    for _ in range(5):
        state, image = motions.tick(motion, state), motions.tick(image_motion, image)
    np.testing.assert_allclose(np.array(image.path), np.array(state.path) * [[1], [-1], [-1]], atol=1e-9)
    assert np.abs(state.path.heading - 3 * numbers[0]).max() > 0.05
    qpos, qvel = out_of(state.path, *motions.reference(motion, state))
    qpos, qvel = qpos + 0.1 * rng.normal(size=qpos.shape), qvel + 0.1 * rng.normal(size=qvel.shape)
    ours = observe(*into(state.path, qpos, qvel), *motions.reference(motion, state, ahead=1))
    reflected = into(image.path, cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel))
    theirs = observe(*reflected, *motions.reference(image_motion, image, ahead=1))
    np.testing.assert_allclose(theirs, FULL.mirrored(ours), atol=1e-9)


def test_commands_change_at_a_limited_pace_and_the_reference_does_not_jump(motion):
    state = begin(0.7, 0.0, 0.0)._replace(target_command=Command(*np.array([[2.8], [-0.4], [0.8]])))
    own = float(mean_speed(motion))
    steps = np.array([0.625 * own, 0.4, 1.6]) * DT
    for k in range(1, 16):
        before = out_of(state.path, *motions.reference(motion, state))[0]
        state = motions.approach(motion, state, np.zeros((1, 32)))
        np.testing.assert_allclose(out_of(state.path, *motions.reference(motion, state))[0], before, atol=1e-6)
        told = np.array(state.command)[:, 0]
        np.testing.assert_allclose(told, [0.7 + k * steps[0], -k * steps[1], min(0.8, k * steps[2]), 0], atol=1e-9)
        state = motions.tick(motion, state)
    # It brakes at 1.5 m/s²; the way to a higher speed backwards is none of braking.
    now = state.command.forward
    for target, expected in ((0.1, now - 1.5 * DT), (-2.0, now - steps[0])):
        told = Command(*np.array([[target], [0.0], [0.0], [0.0]]))
        later = motions.toward(motion, state.command, told, state.time, np.zeros((1, 32)))
        np.testing.assert_allclose(later.forward, expected)


def test_commands_grow_about_the_motions_own_speed(motion):
    """Half of a range from -0.7 to 2.8 m/s about 0.71, of 0.4 m/s and of 0.8 rad/s, and half as many to stand."""
    commands, own = command_range(motion, "1x", "joystick"), float(mean_speed(motion))
    told = draw_command(motion, jax.random.key(0), 3000, commands, np.repeat([0.0, 0.5, 1.0], 1000))
    none, half, whole = (np.asarray(told)[:, k * 1000 : (k + 1) * 1000] for k in range(3))
    np.testing.assert_allclose(none, np.tile([[own], [0], [0], [0]], 1000), rtol=1e-6)
    limits = [((own - 0.7) / 2, (own + 2.8) / 2), (-0.2, 0.2), (-0.4, 0.4)]
    walks = half[:3].any(axis=0)
    np.testing.assert_allclose([(part.min(), part.max()) for part in half[:3, walks]], limits, atol=1e-6)
    assert abs(half[3].mean() - STILL_SHARE * STANDING_SHARE / 2) < 0.03
    np.testing.assert_array_equal(whole, np.asarray(draw_command(motion, jax.random.key(0), 3000, commands))[:, 2000:])


def test_the_leash_holds_to_the_side_where_the_command_steers(motion):
    lead, aside = np.array([0.5]), np.array([-0.7])
    for told, expected in (((0.7, 0.0, 0.0), 0.0), ((0.7, 0.1, 0.0), -0.4), ((0.7, 0.0, 0.1), -0.4)):
        state = motions.follow(begin(*told), lead, aside, 0.3)
        np.testing.assert_allclose(state.origin_x, 0.2)
        np.testing.assert_allclose(np.ravel(state.path), [0, expected, 0], atol=1e-12)
    to_the_north = Path(np.zeros(1), np.zeros(1), np.array([np.pi / 2]))
    found = shift(to_the_north, Command(*np.ones((3, 1))), np.array([0.4]))
    np.testing.assert_allclose(np.ravel(found), [-0.4, 0, np.pi / 2], atol=1e-12)


def test_a_joystick_draws_all_ranges_but_not_the_corners(motion):
    commands = command_range(motion, "1x", "joystick")
    told = draw_command(motion, jax.random.key(0), 20_000, commands)
    still, stands = np.all(np.array(told)[:3] == 0, axis=0), np.asarray(told.stand) == 1
    assert abs(still.mean() - STILL_SHARE) < 0.01
    assert abs(stands.mean() - STILL_SHARE * STANDING_SHARE) < 0.01
    assert set(np.asarray(told.stand).tolist()) == {0, 1}
    assert still[stands].all()
    forward, lateral, yaw_rate = np.array(told)[:3, ~still]
    for values, low, high in ((forward, -0.7, 2.8), (lateral, -0.4, 0.4), (yaw_rate, -0.8, 0.8)):
        assert (values.min(), values.max()) == (pytest.approx(low, abs=1e-6), pytest.approx(high, abs=1e-6))
        assert abs(values.mean() - (low + high) / 2) < 0.02
    assert abs(np.corrcoef([forward, lateral, yaw_rate])[np.triu_indices(3, 1)]).max() < 0.03
    # From all of it at 2.1 m/s to half of it at 2.8 m/s.
    share = np.clip(1 - 0.5 * (forward - 2.1) / 0.7, 0.5, 1)
    assert (np.abs(lateral) <= 0.4 * share + 1e-6).all()
    assert (np.abs(yaw_rate) <= 0.8 * share + 1e-6).all()
    assert np.abs(lateral[forward > 2.7]).max() > 0.2
    assert command_range(motion, "any", "speed") == CommandRange((0.0, 4.0), STRAIGHT)
    with pytest.raises(ValueError, match="this one does not walk"):
        command_range(motion._replace(stride_length=np.float64(0)), "1x", "joystick")
    for samples in (8, 21):
        with pytest.raises(
            ValueError, match=f"an even number of samples, 10 or more, and this reference has {samples};"
        ):
            command_range(motion._replace(qpos=motion.qpos[:samples]), "1x", "joystick")


def test_robots_are_told_to_stand_for_longer_than_to_walk(motion):
    """Commands of 0.32 s, ten control steps, and of four times as long; no drawn one has the yaw rate of these."""
    commands, zeros = command_range(motion, "1x", "joystick"), jnp.zeros(20_000)
    stand = (jnp.arange(20_000) % 2).astype(jnp.float32)
    now = Command(zeros, zeros, zeros + 0.123, stand)
    state = MotionState(zeros, zeros, now, now, zeros, Path(zeros, zeros, zeros))
    told = redraw_target(motion, state, jax.random.key(0), commands, 0.32).target_command
    changed = np.asarray(told.yaw_rate != now.yaw_rate)
    assert abs(changed[::2].mean() - 1 / 10) < 0.01
    assert abs(changed[1::2].mean() - 1 / 40) < 0.005


def test_robots_in_training_are_told_anew_and_bend_their_paths():
    env = steering_env(64, command_s=0.32, leash_m=0.3)
    state, changes = env.reset(jax.random.key(0)), 0
    for step in range(12):
        after = env.step(state, np.zeros((64, 10)), jax.random.key(step))
        changes += int((after.motion.target_command.yaw_rate != state.motion.target_command.yaw_rate).sum())
        state = after
        assert np.isfinite(state.observation).all()
    assert 40 < changes < 120, "12 steps of 64 robots, one in ten of which is told something new"
    assert (np.asarray(state.motion.path.heading) != 0).mean() > 0.5


def test_a_robot_far_to_the_side_ends_its_episode_where_it_is_steered():
    env = steering_env(4, max_position_error_m=0.3)
    state = env.reset_at(np.zeros(4, np.int32), Scenario.nominal(4))
    state.physics.qpos[:, 1] += [-0.5, -0.1, 0.1, 0.5]
    after = env.step(state, np.zeros((4, 10)), jax.random.key(0))
    np.testing.assert_array_equal(after.metrics["position_error"], [1, 0, 0, 1])


@pytest.fixture(scope="module")
def agent():
    return make_policy_agent("any")


def test_a_controller_that_is_told_nothing_begins_the_next_command_at_its_own_speed():
    controller = Controller.load("any")
    qpos, qvel = np.array(controller.motion.qpos[0]), np.zeros(32)
    for command in ["stand"] * 60:
        controller(qpos, qvel, command=command)
    assert controller._told
    np.testing.assert_array_equal(controller._told.stand, 1)
    controller(qpos, qvel)
    controller(qpos, qvel, command=0.7)
    assert controller._told
    np.testing.assert_array_equal(controller._told.stand, 0)
    np.testing.assert_allclose(controller._told.forward, 0.7, atol=0.05)


def test_policy_and_controller_bend_the_same_path(agent):
    rng, controller = np.random.default_rng(0), Controller.load("any")
    qpos, qvel = (np.array(x) for x in agent.initial_state(1))
    steered = SteeredAgent(agent, constant((0.7, 0.0, 0.0)), "steered")
    carry = steered.init(Sensed(qpos, qvel))
    for k in range(60):
        told = (0.7 + 0.1 * k, 0.3, -0.6) if k < 8 else "stand"
        command = Command(*np.array([0, 0, 0, 1.0] if isinstance(told, str) else [*told, 0.0], np.float32)[:, None])
        target, carry = steered.step(carry, Sensed(qpos, qvel), command)
        np.testing.assert_allclose(controller(qpos[0], qvel[0], command=told), np.asarray(target)[0], atol=1e-4)
        qpos, qvel = qpos + 0.02 * rng.normal(size=qpos.shape), qvel + 0.1 * rng.normal(size=qvel.shape)
        # Slow enough to stand.
        qvel[:, :2] *= 0.5
    # To -0.41 rad/s in 8 steps at 1.6 rad/s², and back.
    np.testing.assert_allclose(carry.walk.path.heading, -8 * 8 * 1.6 * DT**2, atol=1e-5)
    assert np.asarray(carry.command.stand) > 0
    carried = steered.moved(carry, np.array([[1.0, 2.0, 3.0]])).walk.path
    np.testing.assert_allclose(np.subtract(carried, carry.walk.path)[:, 0], [1, 2, 0], atol=1e-6)
    controller.reset()
    for wrong in ((1, 2), "sit"):
        with pytest.raises(ValueError, match=r'must be a forward velocity, three numbers .* or "stand"\.'):
            controller(qpos[0], qvel[0], command=wrong)


def test_a_robot_that_lags_turns_about_its_own_place(agent):
    """It stays where it is: the path turns about the place beside it, however far the reference would be by then."""
    qpos, qvel = (np.array(x) for x in agent.initial_state(1))
    carry = agent.init(Sensed(qpos, qvel))
    for _ in range(100):
        _, carry = agent.step(carry, Sensed(qpos, qvel), Command(*np.array([[2.0], [0.0], [0.8]], np.float32)))
    away = into(carry.path, qpos, qvel)[0][0, 1]
    # The reference is 6 m on by now; half a step of it, 3 cm, is all that the path is beside the robot.
    assert abs(away) < 0.1


def test_the_agent_stays_with_its_reference(agent, monkeypatch):
    """A steered walk of a second under no feedback is measured on the path that the reference goes."""
    monkeypatch.setattr(returns, "EPISODE_STEPS", 25)
    physics = NativePhysics(load_model(ModelConfig()))
    found = returns.walk_returns(agent, physics, (0.8, 1.2), steering=JOYSTICK._replace(lateral=0.1, yaw_rate=0.2))
    straight = returns.walk_returns(agent, physics, (0.8, 1.2))
    assert found["steps"] == straight["steps"] == 25
    assert 0.9 * straight["return_plain"] < found["return_plain"] < straight["return_plain"]


def test_a_run_steers_and_its_policy_says_so(tmp_path):
    session(tmp_path, command="joystick").train()
    saved = NumpyPolicy.load(tmp_path / "best.npz")
    assert saved.commands is not None
    np.testing.assert_allclose(saved.commands, [[-0.7, 2.8], [-0.4, 0.4], [-0.8, 0.8], [0, 1]], atol=1e-6)
    assert saved.speed == 1
    assert NumpyPolicy.load(shipped_policies()["1x-robust"]).commands is None, "of before files said so"
    assert config(None, run_dir=None, command="joystick").folder.name == "joystick-seed0"
    with pytest.raises(ValueError, match="command=joystick commands the speed too; leave out speed=2x"):
        config(tmp_path, command="joystick", speed="2x")
    with pytest.raises(ValueError, match="command=wheel is not known; choose one of speed, joystick"):
        config(tmp_path, command="wheel")
    with pytest.raises(ValueError, match="command=wheel is not known; choose one of speed, joystick"):
        make_env(command="wheel")
