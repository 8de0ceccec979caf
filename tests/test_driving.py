"""The suite of commands: tracks, what is measured of them, and the figure of eight."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from points import Still, compiled_points, points

from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.command import toward
from cassie_mjx.evaluation import driving, eight
from cassie_mjx.evaluation.eight import Pursuit
from cassie_mjx.evaluation.setup import EvalSetup
from cassie_mjx.evaluation.standing import PoseRecord, soles_of, standing_result
from cassie_mjx.evaluation.steady import begin
from cassie_mjx.evaluation.suites import SUITES
from cassie_mjx.evaluation.track import TrackRecord, drive, over_strides, velocities
from cassie_mjx.evaluation.trial import NeverSteady
from cassie_mjx.motion.command import Command
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model

DT = 0.032


@pytest.fixture(scope="module")
def agent():
    return make_policy_agent("any")


def values(result):
    return {metric.quantity: metric.value for metric in result.metrics}


def test_a_robot_on_a_circle_has_the_velocities_of_the_circle():
    """2 m around (0, 2) at 1 m/s, for more than a turn, looking 0.3 rad to the right of its way."""
    angle = 0.5 * DT * np.arange(500)
    heading = (angle - 0.3 + np.pi) % (2 * np.pi) - np.pi
    places = np.stack([2 * np.sin(angle), 2 - 2 * np.cos(angle), heading], axis=1)[None]
    expected = [np.cos(0.3), np.sin(0.3), 0.5]
    np.testing.assert_allclose(velocities(places), np.tile(expected, (1, 499, 1)), atol=1e-4)
    np.testing.assert_allclose(velocities(places, DT / 2), np.tile(expected, (1, 499, 1)) * 2, atol=1e-4)


def test_means_over_a_stride_begin_when_it_is_full():
    velocity = np.array([1.0, 2, 3, 5])[None, :, None] * [1, 0, -1]
    np.testing.assert_allclose(over_strides(velocity, 3)[0, 2:], [[2, 0, -2], [10 / 3, 0, -10 / 3]])
    assert np.isinf(over_strides(velocity, 3)[0, :2]).all()


@pytest.mark.parametrize("engine", [points, compiled_points])
def test_tracks_are_of_each_control_step_and_end_with_a_fall(engine):
    """Points with 1 m/s² along x; the second falls after half a second."""
    physics = engine(pull=1.0, falls=lambda start, velocity, t, scenario: (start == 1) & (t > 0.5))
    said = []
    starts = Still().start(points(), np.zeros(3))
    track = drive(Still(), physics, starts, 1.28, 2, lambda *how: said.append(how))
    assert track.places.shape == (3, 41, 3)
    np.testing.assert_array_equal(track.fell, [False, True, False])
    np.testing.assert_array_equal(track.steps, [40, 16, 40])
    x = (DT * np.arange(41)) ** 2 / 2
    np.testing.assert_allclose(track.places[[0, 2], :, 0], [x, x], atol=1e-5)
    np.testing.assert_allclose(track.places[1, :, 0], np.append(x[:16], [x[16]] * 25), atol=1e-5)
    np.testing.assert_array_equal(track.places[:, :, 1:], 0)
    assert said == [(2, 1), (3, 0)]


def test_a_track_of_diverged_physics_stays_finite():
    state = Still().start(points(), np.zeros(2)).physics
    record = TrackRecord.begin(state.qpos, 2)
    qpos = np.array(state.qpos)
    qpos[0, 5] = np.nan
    qpos[1, :7] = 1, 2, 0.9, np.sqrt(0.5), 0, 0, np.sqrt(0.5)
    record = record.update(replace(state, qpos=qpos), Scenario.nominal(2))
    np.testing.assert_array_equal(record.fell, [True, False])
    np.testing.assert_allclose(record.places, [np.zeros((3, 3)), [[0, 0, 0], *2 * [[1, 2, np.pi / 2]]]], atol=1e-12)


def test_the_grid_has_118_commands():
    commands = driving.command_grid()
    assert commands.shape == (118, 3)
    assert len(np.unique(commands, axis=0)) == 118
    fast = commands[commands[:, 0] >= 2.1]
    assert len(fast) == 18
    np.testing.assert_array_equal(np.abs(fast).max(axis=0), [2.8, 0.2, 0.4])
    np.testing.assert_array_equal(np.abs(commands[:-18]).max(axis=0), [1.4, 0.4, 0.8])


def test_errors_are_those_of_the_robots_that_stay_up():
    commands = np.array([[0.7, 0, 0.5], [1.4, 0, 0], [-0.7, 0.2, 0]])
    fell = np.array([[False, False], [False, True], [True, True]])
    off = np.array([[[0.1, 0, -0.2], [-0.3, 0, 0]], [[0, 0.4, 0], [9, 9, 9]], [[9, 9, 9], [9, 9, 9]]])
    result = driving.grid_result(commands, fell, commands[:, None] + off)
    assert values(result) == {
        "command_survived": 0.5,
        "command_error_forward_mps": pytest.approx((0.2 + 0) / 2),
        "command_error_lateral_mps": pytest.approx((0 + 0.4) / 2),
        "command_error_yaw_radps": pytest.approx((0.1 + 0) / 2),
    }
    assert [metric.n for metric in result.metrics] == [6, 2, 2, 2]
    assert result.cells is not None
    assert result.cells["survived"] == ["11", "10", "00"]
    np.testing.assert_allclose(result.cells["errors"][:2], [[0.2, 0, 0.1], [0, 0.4, 0]], atol=1e-9)
    assert result.cells["errors"][2] is None
    assert result.cells["largest"]["lateral_mps"] == {"error": pytest.approx(0.4), "command": [1.4, 0, 0]}
    assert result.cells["largest"]["yaw_radps"]["command"] == [0.7, 0, 0.5]
    nobody = driving.grid_result(commands, np.ones((3, 2), bool), np.zeros((3, 2, 3)))
    assert values(nobody) == {"command_survived": 0}


def test_random_commands_change_every_two_seconds_within_the_range():
    schedule = driving.random_schedule()
    assert schedule.starts.shape == (100, 30)
    np.testing.assert_array_equal(schedule.starts[7, :3], [0, 63, 125])
    forward, lateral, yaw_rate, stand = map(np.asarray, schedule.targets)
    assert not stand.any()
    for component, low, high in ((forward, -0.7, 2.8), (lateral, -0.4, 0.4), (yaw_rate, -0.8, 0.8)):
        assert low <= component.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < component.max() <= high
    assert np.abs(lateral[forward > 2.7]).max() < 0.23
    np.testing.assert_array_equal(driving.random_schedule().targets.forward, forward)


def test_a_time_is_the_longest_of_those_that_get_there():
    reached = np.zeros((4, 100), bool)
    reached[0, 9:], reached[1, 49:], reached[2, 3:] = True, True, True
    metrics = driving.timed("stop", reached, np.array([False, False, True, False]))
    assert [metric[:2] + metric[3:] for metric in metrics] == [
        ("stop_survived", 0.5, 4),
        ("stop_s", pytest.approx(50 * DT), 2),
    ]
    (nobody,) = driving.timed("stop", reached, np.ones(4, bool))
    assert nobody[:2] == ("stop_survived", 0)


def test_places_of_the_figure_of_eight():
    quarter = np.pi
    found = eight.point(quarter * np.array([0.0, 1, 2, 3, 4, 5, 6, 7, 8, 9]))
    left, right = [[0, 0], [2, 2], [0, 4], [-2, 2]], [[0, 0], [2, -2], [0, -4], [-2, -2]]
    np.testing.assert_allclose(found, [*left, *right, *left[:2]], atol=1e-9)
    assert pytest.approx(25.1327, abs=1e-4) == eight.LENGTH_M
    places = np.array([[0, 0], [2.5, 2], [0, 1], [0, -4.25], [-2, -2]])
    np.testing.assert_allclose(eight.distance(places), [0, 0.5, 1, 0.25, 0], atol=1e-9)
    # From the crossing, the second circle is met only after the first.
    found = eight.onwards(np.array([[0.1, -0.01], [2.0, 2.0]]), np.array([0.0, np.pi - 0.1]))
    np.testing.assert_allclose(found, [0.1, np.pi], atol=0.01)


def test_the_pursuit_keeps_to_the_circle_that_a_robot_is_on():
    way = np.array([1.0, 4.0, 14.0, 20.0])
    heading = np.where(way < 4 * np.pi, way / 2, -way / 2)
    for xp in (np, jnp):
        found = eight.pursuit(xp.asarray(eight.point(way)), xp.asarray(heading), xp.asarray(eight.point(way + 0.6)))
        np.testing.assert_allclose(found.yaw_rate, [0.35, 0.35, -0.35, -0.35], atol=1e-5)
        np.testing.assert_allclose(found.forward, 0.7, atol=1e-6)
    behind = eight.pursuit(np.zeros((1, 2)), np.array([1.0]), np.array([[0.1, -0.1]]))
    np.testing.assert_allclose(behind.yaw_rate, -0.8)


def ideal(agent, setup, forward_mps, phases, pilot, seconds, kind=TrackRecord):
    """Tracks of points that do what they are commanded, at the pace of commands."""
    robots = len(phases)
    place, heading, steps = np.zeros((robots, 2)), np.zeros(robots), np.arange(robots)
    command = Command.ahead(np.full(robots, forward_mps))
    motion = jax.tree.map(np.asarray, agent.motion)
    qpos, qvel, places = np.zeros((robots, cassie.NQ)), np.zeros((robots, cassie.NV)), []
    for _ in range(round(seconds / DT) + 1):
        places.append(np.column_stack([place, (heading + np.pi) % (2 * np.pi) - np.pi]))
        qpos[:, :2], qpos[:, 3], qpos[:, 6] = place, np.cos(heading / 2), np.sin(heading / 2)
        target, pilot = pilot.target(Sensed(qpos, qvel))
        command = toward(motion, command, target, steps, qvel)
        steps = steps + 1
        middle = heading + DT / 2 * command.yaw_rate
        cos, sin = np.cos(middle), np.sin(middle)
        way = [command.forward * cos - command.lateral * sin, command.forward * sin + command.lateral * cos]
        place, heading = place + DT * np.stack(way, axis=1), heading + DT * command.yaw_rate
    track = TrackRecord(np.full(robots, len(places) - 1), np.zeros(robots, bool), np.stack(places, axis=1))
    if kind is TrackRecord:
        return track
    poses = np.tile(cassie.STANDING_QPOS, (robots, len(places), 1))
    poses[..., :2] = track.places[..., :2]
    torque = np.full((robots, len(places) - 1), 6.0 if pilot.schedule.targets.stand.any() else 8.0)
    return PoseRecord(**vars(track), qpos=poses, torque=torque, pending=np.zeros(robots))


def test_points_that_do_as_they_are_told_have_no_errors(agent, monkeypatch):
    monkeypatch.setattr(driving, "_drive", ideal)
    result = SUITES["command"](agent, EvalSetup())
    found = values(result)
    errors = [found.pop(f"command_error_{name}") for name in driving.COMPONENTS]
    assert max(errors) < 1e-4
    # 1.5 m/s² from 2 m/s to 0, and 0.625 of 0.71 m/s a second, 6.3 s, from 0 to 2.8 m/s; the mean over a stride of
    # 0.704 s is within 0.1 m/s of that some 0.14 s later, or 0.4 s as it brakes. 0.8 rad/s is there after 0.5 s.
    pace = 0.625 * float(agent.motion.stride_length) / (22 * DT)
    late = {rate: 0.704 - np.sqrt(2 * 0.704 * 0.1 / rate) for rate in (1.5, pace)}
    assert found.pop("stop_s") == pytest.approx(2 / 1.5 + late[1.5], abs=DT)
    assert found.pop("sprint_s") == pytest.approx(2.8 / pace + late[pace], abs=DT)
    assert found.pop("stand_foot_slip_m") < 1e-6
    assert found.pop("stand_torque_share") == pytest.approx(0.75)
    assert found.pop("turn_s") == pytest.approx(0.25 + 2 * np.pi / 0.8, abs=DT)
    assert found.pop("figure_eight_error_m") < 0.05
    assert set(found.values()) == {1}
    assert found.keys() == {
        "command_survived",
        "command_random_survived_60s",
        "stand_survived_60s",
        *(f"{name}_survived" for name in ("turn", "stop", "sprint", "figure_eight")),
    }
    assert result.cells is not None
    paths = np.array(result.cells["figure_eight"]["paths"])
    assert paths.shape == (8, 176, 2)
    assert np.ptp(paths[0], axis=0) == pytest.approx([4, 8], abs=0.1)


def test_who_does_not_complete_the_eight_has_no_error():
    standing = TrackRecord(np.zeros(2, int), np.zeros(2, bool), np.zeros((2, 1403, 3)))
    assert values(driving.eight_result(standing)) == {"figure_eight_survived": 0}


@pytest.mark.parametrize("engine", [points, compiled_points])
def test_poses_and_torques_are_of_each_control_step(engine):
    """Points with 1 m/s² along x; the second falls after half a second."""
    physics = engine(pull=1.0, falls=lambda start, velocity, t, scenario: (start == 1) & (t > 0.5))
    starts = Still().start(points(), np.zeros(2))
    stood = drive(Still(), physics, starts, 1.28, 2, kind=PoseRecord)
    track = drive(Still(), physics, starts, 1.28, 2)
    np.testing.assert_array_equal(stood.places, track.places)
    np.testing.assert_array_equal(stood.qpos[:, :, 0], track.places[:, :, 0])
    np.testing.assert_array_equal(stood.torque[1, 17:], 0)
    asked = cassie.pd_torque(np.zeros(10), stood.qpos[:, 5, cassie.ACTIVE_QPOS], np.zeros(10))
    np.testing.assert_allclose(stood.torque[:, 5], abs(asked).mean(axis=1), rtol=1e-5)


def test_a_sole_that_creeps_is_found_and_who_falls_does_not_count():
    model = load_model(ModelConfig())
    stood, stepped = (PoseRecord.begin(np.tile(cassie.STANDING_QPOS, (2, 1)), steps) for steps in (1969, 312))
    qpos = stood.qpos.copy()
    left, right = soles_of(model, qpos[0, 0])
    np.testing.assert_allclose(right, left * [1, -1, 1], atol=1e-9)
    assert 0.01 < left[2] < 0.03
    # Before 6 s it may go anywhere; then the first one creeps by 3 cm and comes back.
    qpos[0, :187, 0] = 1.0
    qpos[0, 900, :2] = 0.018, 0.024
    qpos[1, 500, 0] = 1.0
    fell = np.array([False, True])
    stood = replace(stood, qpos=qpos, fell=fell, torque=np.array([[3.0], [90.0]]) + np.zeros((2, 1969)))
    torque = np.concatenate([np.full((2, 156), 50.0), np.full((2, 156), 4.0)], axis=1)
    found = values(standing_result(model, stood, replace(stepped, torque=torque)))
    assert found.pop("stand_survived_60s") == 0.5
    assert found == {"stand_foot_slip_m": pytest.approx(0.03), "stand_torque_share": pytest.approx(0.75)}
    fallen = PoseRecord.fallen(2, 63.0)
    assert values(standing_result(model, fallen, stepped)) == {"stand_survived_60s": 0}


def test_what_cannot_be_commanded_is_refused(agent):
    with pytest.raises(ValueError, match="suite=command commands a single policy, which still is not."):
        SUITES["command"](Still(), EvalSetup())
    with pytest.raises(ValueError, match="policy=0x steps on the spot"):
        SUITES["command"](make_policy_agent("0x"), EvalSetup())


class Short(EvalSetup):
    """Robots in the start of the motion, and none at 2 m/s."""

    def starts(self, agent, phases, longest_delay_s=0.0):
        if float(agent.schedule.targets.forward[0, 0]) == 2:
            raise NeverSteady("falls")
        return begin(agent, self.physics(), *agent.initial_state(len(phases)))


def test_robots_of_mujoco_are_steered_from_the_origin(agent, monkeypatch):
    monkeypatch.setattr(driving, "STOP_S", 3.2)
    assert values(driving.stop(agent, Short())) == {"stop_survived": 0}
    pilot = Pursuit(np.zeros(2, np.float32))
    track = driving._drive(agent, Short(), 0.7, np.array([0.25, 0.75]), pilot, 0.32)
    np.testing.assert_array_equal(track.places[:, 0, :2], 0)
    assert (track.places[:, -1, 0] > 0.1).all()
