"""Commands over time as people write them, and a policy that follows them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig, make_agent, make_policy_agent
from cassie_mjx.agents.steered import Scheduled, SteeredAgent
from cassie_mjx.agents.types import Sensed
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import mean_speed
from cassie_mjx.motion.schedule import CommandSchedule, constant, parse_schedule

DT = 0.032


def at(schedule, step):
    return np.ravel(schedule.at(np.array([step]))).tolist()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1.4", {0: [1.4, 0, 0], 9999: [1.4, 0, 0]}),
        ("-0.7,0.4,-0.8", {0: [-0.7, 0.4, -0.8]}),
        # 156 control steps of 32 ms are 4.992 s; 62.5 are 2 s.
        ("0:1,0,0 5:1,0,0.5", {0: [1, 0, 0], 156: [1, 0, 0], 157: [1, 0, 0.5], 1000: [1, 0, 0.5]}),
        ("stand", {0: [0, 0, 0, 1]}),
        ("0:2 2:stand 3:0", {62: [2, 0, 0], 63: [0, 0, 0, 1], 94: [0, 0, 0]}),
        ("0:2 2:0.7,0.1,0  8:0", {62: [2, 0, 0], 63: [0.7, 0.1, 0], 249: [0.7, 0.1, 0], 250: [0, 0, 0]}),
    ],
)
def test_a_text_says_what_is_commanded_when(text, expected, tmp_path):
    file = tmp_path / "drive.txt"
    file.write_text("\n".join(text.split()) + "\n")
    for schedule in map(parse_schedule, (text, str(file))):
        for step, command in expected.items():
            np.testing.assert_allclose(at(schedule, step), [*command, 0] if len(command) < 4 else command, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fast", r"command=fast is not known; give a command such as 1\.4, 0\.7,0,0\.5 or stand, commands at times"),
        ("understand", "command=understand is not known"),
        ("0:stand,0,0", "has 0:stand,0,0 in it"),
        ("nan", "command=nan is not known"),
        ("1e-1", "command=1e-1 is not known"),
        ("0.7,0", "command=0.7,0 has 0:0.7,0 in it; give a command such as"),
        ("0.7,,0", "has 0:0.7,,0 in it"),
        ("0:1,0,0 5", "has 5 in it"),
        ("0:1 2:3:4", "has 2:3:4 in it"),
        ("3", r"command=3 has a forward velocity of 3 m/s; it must be from -0\.7 to 2\.8 m/s\."),
        ("-1", "a forward velocity of -1 m/s"),
        ("0:1 4:1,-0.5,0", r"a lateral velocity of -0\.5 m/s; it must be from -0\.4 to 0\.4 m/s\."),
        ("1,0,0.9", r"a yaw rate of 0\.9 rad/s; it must be from -0\.8 to 0\.8 rad/s\."),
        ("0:1 5:2 3:1", "command=0:1 5:2 3:1 goes back in time, from 5 to 3 s; let its times rise."),
        ("0:1 0:2", "goes back in time, from 0 to 0 s"),
        ("1:1", "must begin at 0 s, as in '0:1,0,0 5:1,0,0.5'."),
        ("", "must begin at 0 s"),
        ("0:1 4000:1", "has a time of 4000 s; it must be from 0 to 3600 s."),
        ("-1:1", "has a time of -1 s"),
    ],
)
def test_bad_commands_get_one_sentence(text, sentence):
    with pytest.raises(ValueError, match=sentence):
        parse_schedule(text)


def test_bad_files_get_one_sentence(tmp_path):
    file = tmp_path / "drive.txt"
    for content, sentence in ((b"0:nan", "a forward velocity of nan"), (b"inf:1", "a time of inf"), (b"\xff", "read")):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=rf"command=.*drive\.txt .*{sentence}"):
            parse_schedule(str(file))
    with pytest.raises(ValueError, match="is not known; give"):
        parse_schedule(str(tmp_path))


def test_robots_have_schedules_of_their_own_on_numpy_and_jax():
    commands = np.arange(12.0).reshape(2, 2, 3)
    schedule = CommandSchedule.of(np.array([[0, 1], [0, 2]]), commands)
    for each in (schedule, jax.tree.map(jnp.asarray, schedule)):
        found = np.stack(each.at(np.array([40, 40])), axis=1)
        # 40 steps are 1.28 s.
        np.testing.assert_array_equal(found, [[*commands[0, 1], 0], [*commands[1, 0], 0]])
    np.testing.assert_array_equal(jax.jit(CommandSchedule.at)(schedule, np.array([0, 63])).forward, [0, 9])


@pytest.fixture(scope="module")
def policy():
    return make_policy_agent("any")


def states(policy, steps, robots=3):
    """What is sensed of robots near the reference at each of the steps."""
    rng, (qpos, qvel) = np.random.default_rng(0), policy.initial_state(robots)
    for _ in range(steps):
        yield Sensed(qpos + 0.05 * rng.normal(size=qpos.shape), qvel + 0.2 * rng.normal(size=qvel.shape))


def own_speed(policy):
    return float(mean_speed(policy.motion)), 0.0, 0.0


def test_straight_ahead_at_its_own_speed_no_bit_changes(policy):
    agent = SteeredAgent(policy, constant(own_speed(policy)), "steered")
    sensed = list(states(policy, 60))
    plain, steered = policy.init(sensed[0]), agent.init(sensed[0])
    for each in sensed:
        expected, plain = policy.step(plain, each, None)
        found, steered = agent.step(steered, each, None)
        np.testing.assert_array_equal(found, expected)
    for ours, theirs in zip(jax.tree.leaves(steered.walk), jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_command_goes_to_its_target_at_the_pace_of_training(policy):
    agent = SteeredAgent(policy, parse_schedule("0:2,0.4,-0.8 1.6:0.5"), "steered")
    sensed = next(states(policy, 1))
    carry, (own, *_) = agent.init(sensed), own_speed(policy)
    # 0.625 of its own speed, 0.4 m/s and 1.6 rad/s in a second.
    paces = np.array([0.625 * own, 0.4, 1.6]) * DT
    for k in range(1, 51):
        _, carry = agent.step(carry, sensed, None)
        told = np.stack(carry.command[:3], axis=1)
        expected = np.array([own, 0, 0]) + k * paces * [1, 1, -1]
        np.testing.assert_allclose(told, np.tile(np.clip(expected, [-1, -1, -0.8], [2, 0.4, 1]), (3, 1)), atol=1e-4)
    # After 1.6 s it comes back; a command that is given comes before the schedule.
    _, back = agent.step(carry, sensed, None)
    np.testing.assert_allclose(back.command.yaw_rate, -0.8 + paces[2], atol=1e-4)
    _, live = agent.step(carry, sensed, Command(*np.array([[0.4] * 3] * 3 + [[0.0] * 3], np.float32)))
    np.testing.assert_allclose(live.command.lateral, 0.4, atol=1e-6)
    np.testing.assert_array_equal(live.pilot.step, 51)


def test_traced_it_walks_as_on_the_host(policy):
    agent = SteeredAgent(policy, parse_schedule("0:1,0.2,0.4 0.32:0.4,-0.2,0"), "steered")
    sensed = list(states(policy, 30))
    carry = agent.init(sensed[0])
    targets = []
    for each in sensed:
        target, carry = agent.step(carry, each, None)
        targets.append(target)
    qpos, qvel = (jnp.asarray([each[k] for each in sensed], jnp.float32) for k in range(2))

    def step(carry, state):
        target, carry = agent.step(carry, Sensed(*state), None)
        return carry, target

    last, traced = jax.lax.scan(step, agent.init(sensed[0]), (qpos, qvel))
    np.testing.assert_allclose(traced, np.stack(targets), atol=1e-4)
    np.testing.assert_allclose(last.walk.path.heading, carry.walk.path.heading, atol=1e-5)
    assert np.abs(carry.walk.path.heading).min() > 0.03


def test_its_lead_walks_straight_at_the_first_speed_and_then_the_schedule_begins(policy):
    agent = SteeredAgent(policy, parse_schedule("0:1,0.2,0.4 3:0"), "steered")
    sensed = next(states(policy, 1))
    lead, carry = agent.lead, agent.lead.init(sensed)
    for _ in range(100):
        _, carry = lead.step(carry, sensed, None)
    np.testing.assert_allclose(np.stack(carry.command, axis=1), np.tile([1, 0, 0, 0], (3, 1)), atol=1e-6)
    np.testing.assert_array_equal(carry.walk.path, np.zeros((3, 3)))
    taken = agent.take_over(carry)
    np.testing.assert_array_equal(taken.pilot.step, 0)
    assert taken.pilot.schedule.starts.shape == (3, 2)
    np.testing.assert_array_equal(taken.command, carry.command)
    moved = agent.moved(taken, np.tile([1.0, 2.0, 0.0], (3, 1)))
    np.testing.assert_array_equal(moved.walk.path.y, 2)


def test_each_robot_can_be_told_its_own(policy):
    agent = SteeredAgent(policy, constant(own_speed(policy)), "steered")
    sensed = next(states(policy, 1))
    carry = agent.init(sensed)._replace(pilot=Scheduled.begin(constant((1, 0, 0), (0.5, 0.4, 0), (0.7, 0, -0.8))))
    _, carry = agent.step(carry, sensed, None)
    np.testing.assert_array_equal(np.sign(carry.command.lateral), [0, 1, 0])
    np.testing.assert_array_equal(np.sign(carry.command.yaw_rate), [0, 0, -1])


def test_a_command_line_commands_a_policy():
    agent = cli.parse(AgentConfig, ["policy=any", "command=0.7,0,0.5"]).agent()
    assert isinstance(agent, SteeredAgent)
    assert (agent.name, agent.provenance) == ("any command=0.7,0,0.5", make_agent("any").provenance)
    np.testing.assert_allclose(at(agent.schedule, 0), [0.7, 0, 0.5, 0], atol=1e-7)
    for arguments, sentence in (
        (["speed=2x"], "speed=2x with command=1: a command has the speed in it; leave one out."),
        (["policy=controller:stiff"], "policy=controller:stiff with command=1: a single policy takes a command, and"),
        (["policy=blend:1x,2x", "schedule=ramp"], "policy=blend:1x,2x with command=1: a single policy takes a command"),
        (["policy=0x"], "policy=0x steps on the spot; choose one that walks to command it."),
    ):
        with pytest.raises(ValueError, match=sentence):
            cli.parse(AgentConfig, ["command=1", *arguments]).agent()


def test_the_record_of_a_result_keeps_the_whole_command_line():
    assert cli.provenance(command=None, speed="2x")["command"].startswith("python -m ")
    assert cli.provenance(speed="2x")["speed"] == "2x"
