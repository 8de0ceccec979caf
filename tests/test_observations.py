"""Lists of terms: numbers worked by hand, mirror images, noise, the same on both engines."""

import jax
import numpy as np
import pytest

from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.types import StartOffset
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import sample
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.leg import pelvis_velocities
from cassie_mjx.robot.model import MJX_TRAINING

ROBOTS = 512
SENSORS, REMEMBERED = OBSERVATIONS["sensors"], OBSERVATIONS["sensors_history"]
ODOMETRY = 6
# Where MuJoCo's qpos and qvel have hip roll, yaw and pitch, knee, foot, shin and tarsus of the left and the right leg.
ANGLES = (7, 8, 9, 14, 20, 15, 16, 21, 22, 23, 28, 34, 29, 30)
SPEEDS = (6, 7, 8, 12, 18, 13, 14, 19, 20, 21, 25, 31, 26, 27)


def seen_of(qpos, qvel, ahead, ahead_v):
    return Seen(qpos, qvel, ahead, ahead_v)


def observe(terms, *states):
    seen = seen_of(*states)
    return np.asarray(terms.update(terms.init(seen), seen)[0])


def counted():
    """Numbers that say where they come from: of qpos 1 to 35, of qvel 101 to 132, of the reference 1000 more."""
    qpos, qvel = 1 + np.arange(35.0)[None], 101 + np.arange(32.0)[None]
    return qpos, qvel, 1000 + qpos, 1000 + qvel


ROBOT = [(4, 5, 6, 7), (104, 105, 106), tuple(1 + i for i in ANGLES), tuple(101 + i for i in SPEEDS)]
REFERENCE = [(4, 5, 6, 7), (101, 102, 103), *ROBOT[1:]]


def test_sensors_are_what_imu_and_encoders_tell():
    """Six numbers between the robot's and the reference's follow from them: see `test_leg.py`."""
    seen = observe(SENSORS, *counted())[0]
    odometry = pelvis_velocities(*counted()[:2]).ravel()
    robot, reference = ([number for term in half for number in term] for half in (ROBOT, REFERENCE))
    np.testing.assert_array_equal(seen, [*robot, *odometry, *(1000 + number for number in reference)])


def test_a_history_has_the_newest_first_and_of_the_robot_alone():
    """After steps that add 10,000 each: 4, 3, 2 and 1 of them, the fifth being forgotten."""
    steps = [seen_of(*(10_000 * k + numbers for numbers in counted())) for k in range(5)]
    carry, observation = REMEMBERED.init(steps[0]), np.zeros((1, 0))
    for seen in steps:
        observation, carry = REMEMBERED.update(carry, seen)
    newest_first = [steps[k] for k in (4, 3, 2, 1)]
    robot = [10_000 * k + number for term in ROBOT for k in (4, 3, 2, 1) for number in term]
    odometry = [number for seen in newest_first for number in pelvis_velocities(seen.qpos, seen.qvel).ravel()]
    np.testing.assert_array_equal(
        observation[0], [*robot, *odometry, *(41_000 + n for term in REFERENCE for n in term)]
    )


def test_a_history_begins_as_if_all_had_always_been_so():
    once, seen = observe(SENSORS, *counted())[0], observe(REMEMBERED, *counted())[0]
    parts = np.split(once, np.cumsum([term.size for term in SENSORS.terms])[:-1])
    repeated = [np.tile(part, term.history) for part, term in zip(parts, REMEMBERED.terms, strict=True)]
    np.testing.assert_array_equal(seen, np.concatenate(repeated))


def test_sensors_tell_neither_place_nor_velocity_of_the_pelvis():
    qpos, qvel, *reference = counted()
    elsewhere, faster = qpos.copy(), qvel.copy()
    elsewhere[:, :3], faster[:, :3] = np.nan, np.nan
    np.testing.assert_array_equal(observe(SENSORS, elsewhere, faster, *reference), observe(SENSORS, *counted()))


def test_an_estimate_is_the_full_state():
    """What the file of a policy says of them is the same: noise is of training alone."""
    estimated, full = OBSERVATIONS["estimated"], OBSERVATIONS["full"]
    np.testing.assert_array_equal(observe(estimated, *counted()), observe(full, *counted()))
    assert estimated.describe() == full.describe()
    assert estimated.noisy
    assert not full.noisy


@pytest.mark.parametrize("terms", OBSERVATIONS.values(), ids=OBSERVATIONS)
def test_a_mirror_image_is_seen_as_the_reflection(terms):
    rng, (ours, theirs) = np.random.default_rng(0), (None, None)
    for _ in range(5):
        qpos, qvel, ahead, ahead_v = (rng.normal(size=(20, n)) for n in 2 * (cassie.NQ, cassie.NV))
        states = seen_of(qpos, qvel, ahead, ahead_v)
        images = seen_of(
            cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel), cassie.mirror_qpos(ahead), cassie.mirror_qvel(ahead_v)
        )
        ours, theirs = (terms.init(each) if old is None else old for each, old in ((states, ours), (images, theirs)))
        (seen, ours), (image, theirs) = terms.update(ours, states), terms.update(theirs, images)
        np.testing.assert_array_equal(terms.mirrored(seen), image)


def start(engine, observation, key, symmetric=False):
    """Robots on the reference motion, as they begin."""
    config = WalkConfig(observation=observation, symmetric=symmetric)
    env = WalkEnv(make_physics(engine, MJX_TRAINING), load_motion("walk"), config, ROBOTS)
    return env.reset_at(np.arange(ROBOTS), Scenario.nominal(ROBOTS), key=key)


@pytest.mark.parametrize(
    ("name", "places", "widths"),
    [
        ("estimated", (2, 4, 3, 3, 14, 14), (0.02, 0.01, 0.1, 0.2, 0.01, 0.2)),
        ("sensors", (4, 3, 14, 14), (0.01, 0.2, 0.01, 0.2)),
        ("sensors_history", (4, 3, 14, 14), (0.01, 0.2, 0.01, 0.2)),
    ],
)
def test_noise_is_uniform_and_on_the_robot_alone(name, places, widths):
    clean, noisy = (start("native", name, key).observation for key in (None, jax.random.key(3)))
    noise = np.asarray(noisy) - np.asarray(clean)
    width, robot = np.repeat(widths, places), sum(places)
    now = np.concatenate([np.arange(0, term.size) + begin for term, begin in _beginnings(OBSERVATIONS[name])])
    follows = 0 if name == "estimated" else ODOMETRY
    np.testing.assert_array_equal(noise[:, now][:, robot + follows :], 0)
    noise = noise[:, now][:, :robot]
    assert (abs(noise) <= width + 1e-6).all()
    np.testing.assert_allclose(abs(noise).max(axis=0), width, rtol=0.05)
    # Half-width over sqrt 3 is the standard deviation of what is uniform.
    np.testing.assert_allclose(noise.std(axis=0), width / np.sqrt(3), rtol=0.15)


def test_odometry_has_the_noise_of_the_sensors_that_it_is_made_of():
    seen = np.asarray(start("native", "sensors", jax.random.key(3)).observation, float)
    qpos, qvel = np.zeros((ROBOTS, cassie.NQ)), np.zeros((ROBOTS, cassie.NV))
    qpos[:, [3, 4, 5, 6, *ANGLES]] = seen[:, [*range(4), *range(7, 21)]]
    qvel[:, [3, 4, 5, *SPEEDS]] = seen[:, [*range(4, 7), *range(21, 35)]]
    np.testing.assert_allclose(seen[:, 35:41], pelvis_velocities(qpos, qvel).reshape(-1, 6), atol=1e-5)


def _beginnings(terms):
    begin = 0
    for term in terms.terms:
        yield term, begin
        begin += term.size * term.history


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_both_engines_see_the_same_of_the_same_state(name):
    ours, theirs = (start(engine, name, jax.random.key(4), symmetric=True) for engine in ("native", "mjx"))
    np.testing.assert_allclose(ours.observation, theirs.observation, atol=1e-6)
    np.testing.assert_allclose(ours.sensing, theirs.sensing, atol=1e-6)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_critic_sees_the_true_state_against_the_reference(symmetric):
    """By hand: 40 numbers after how far ahead it is, in units of 0.1 m, 0.1, 0.5 m/s, 0.2 rad and 2 rad/s."""
    motion = load_motion("walk")
    config = WalkConfig(observation="sensors", symmetric=symmetric)
    env = WalkEnv(make_physics("native", MJX_TRAINING), motion, config, 22)
    offset = StartOffset(np.full((22, 2), [0.3, -0.2]), np.full((22, 2), [-0.05, 0.02]))
    state = env.reset_at(np.arange(22), Scenario.nominal(22), offset=offset, key=jax.random.key(7))
    (qpos, qvel), (ahead, ahead_v) = sample(motion, np.arange(22)), sample(motion, np.arange(22) + 1)
    qpos, qvel = np.add(qpos, [-0.05, 0.02, *33 * [0]]), np.add(qvel, [0.3, -0.2, *30 * [0]])
    image = symmetric & (ahead[:, cassie.HIP_PITCH_QPOS[0]] < ahead[:, cassie.HIP_PITCH_QPOS[1]])[:, None]
    off = np.where(image, cassie.mirror_qpos(qpos - ahead), qpos - ahead)
    off_v = np.where(image, cassie.mirror_qvel(qvel - ahead_v), qvel - ahead_v)
    parts = [off[:, 1:3] / 0.1, off[:, 3:7] / 0.1, off_v[:, :3] / 0.5, off_v[:, 3:6] / 2]
    parts += [off[:, list(ANGLES)] / 0.2, off_v[:, list(SPEEDS)] / 2]
    expected = np.concatenate([np.full((22, 1), -0.05 / 0.25), *parts], axis=1).clip(-10, 10)
    np.testing.assert_allclose(state.privileged, expected, atol=1e-4)


def test_a_critic_of_the_full_state_sees_no_more_than_before():
    assert start("native", "full", None).privileged.shape == (ROBOTS, 1)
