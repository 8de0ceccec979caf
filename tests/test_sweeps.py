"""Trials, and the search for limits, on both ways of advancing an engine."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from acting import Swaying
from points import Still, compiled_points, points

from cassie_mjx.agents.types import AgentState
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation.record import motor_effort
from cassie_mjx.evaluation.scheduler import LimitSearch, run, run_trials
from cassie_mjx.evaluation.trial import Push, Trial, moved, placed, scenario_of
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import PhysicsState, Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import namespace
from cassie_mjx.robot.ground import Ground, Terrain

CONTROL_STEPS_OF_10_S = 313
ENGINES = pytest.mark.parametrize("engine", [points, compiled_points])


def turned(yaw, pitch=0.3):
    """Quaternion of a pelvis pitched, then turned about the vertical."""
    a, b = np.cos(yaw / 2), np.sin(yaw / 2)
    c, d = np.cos(pitch / 2), np.sin(pitch / 2)
    return np.array([a * c, -b * d, a * d, b * c])


def searched(search, survives, in_flight):
    """Run a search on an outcome function, `in_flight` trials at a time, last in first out; returns what was begun."""
    flying, begun = [], []
    while True:
        while len(flying) < in_flight and (job := search.next()):
            flying.append(job[0])
            begun.append(job[0])
        if not flying:
            return begun
        key = flying.pop()
        search.ended(key, SimpleNamespace(fell=not survives(*key)))
        flying = [other for other in flying if search.wanted(other)]


@pytest.mark.parametrize("in_flight", [1, 3, 20])
def test_a_failed_smaller_force_caps_the_limit(in_flight):
    first_failure = np.array([0, 3, 7, 12])
    # Group 1 fails at level 3 alone: a hole.
    search = LimitSearch(lambda group, level: Trial(0, 1.0), groups=4, levels=10)
    begun = searched(search, lambda g, k: k != 3 if g == 1 else k < first_failure[g], in_flight)
    np.testing.assert_array_equal(search.limit, [0, 3, 7, 10])
    assert len(set(begun)) == len(begun)
    if in_flight == 1:
        assert sorted(begun) == [(g, k) for g, n in enumerate([1, 4, 8, 10]) for k in range(n)]


def test_groups_together_stop_at_the_first_failure_of_any():
    search = LimitSearch(lambda group, level: Trial(0, 1.0), groups=3, levels=10, together=True)
    begun = searched(search, lambda g, k: not (g == 1 and k >= 4), 1)
    np.testing.assert_array_equal(search.limit, [4, 4, 4])
    assert max(k for _, k in begun) == 4


@ENGINES
@pytest.mark.parametrize("lanes", [1, 3, 64])
def test_limits_do_not_depend_on_the_number_of_lanes(engine, lanes):
    def falls(start, velocity, t, scenario):
        # Start 0 falls from 100 N on, start 1 only at 70 N, start 2 never, start 3 at once.
        force = velocity[:, 0] / 0.2
        down = ((start == 0) & (force > 95)) | ((start == 1) & (abs(force - 70) < 1)) | (start == 3)
        return down & (t > 0.5)

    physics = engine(falls=falls)
    search = LimitSearch(lambda g, k: Trial(g, 1.0, pushes=(Push(10.0 * (k + 1), 0.0),)), groups=4, levels=15)
    run(Still(), physics, Still().start(physics, np.zeros(4)), search, lanes)
    np.testing.assert_array_equal(search.limit, [9, 6, 15, 0])


def test_the_fallen_give_way_to_the_next():
    physics = points(falls=lambda start, velocity, t, scenario: t > 0)
    result = run_trials(Still(), physics, Still().start(physics, np.zeros(8)), [Trial(k, 10.0) for k in range(8)])
    assert result.fell.all()
    np.testing.assert_allclose(result.survived_s, 0.032)
    assert physics.flown == 8 * 64


@ENGINES
def test_a_robot_with_nan_has_fallen(engine):
    """Start 1 diverges after one second, start 2 at once."""

    def diverges(start, velocity, t, scenario):
        return namespace(t).where(((start == 1) & (t > 1.0)) | (start == 2), np.nan, 0.0)

    physics = engine(falls=diverges)
    result = run_trials(Still(), physics, Still().start(physics, np.zeros(3)), [Trial(k, 2.0) for k in range(3)])
    np.testing.assert_array_equal(result.fell, [False, True, True])
    np.testing.assert_allclose(result.survived_s, [2.0, 1.024, 0.032], rtol=1e-6)
    np.testing.assert_allclose(result.height_m, [0.9, 0.9 * 31 / 32, 0], rtol=1e-6)
    assert all(np.isfinite(values).all() for values in (result.distance_m, result.speed_mps, result.power_w))


@pytest.mark.parametrize("hertz", [1000, 2000])
def test_a_push_lasts_a_fifth_of_a_second_in_the_heading_frame(hertz):
    yaw = np.array([0.0, np.pi / 3, -np.pi / 2])
    physics, agent = points(hertz=hertz), Still()
    starts = agent.start(physics, np.zeros(3))
    starts.physics.qpos[:, 3:7] = [turned(angle) for angle in yaw]
    starts.physics.step[:] = (0, 128, 640)
    trials = [Trial(k, 1.0, pushes=(Push(100.0, 30.0),)) for k in range(3)]
    scenario = scenario_of(agent, trials, starts.physics, hertz)
    np.testing.assert_array_equal(scenario.push_stop - scenario.push_start, round(0.2 * hertz))
    np.testing.assert_array_equal(scenario.push_start[:, 0], starts.physics.step)
    np.testing.assert_allclose(scenario.push[0, 0], [100, 30, 0], atol=1e-12)
    np.testing.assert_allclose(scenario.push[1, 0], [50 - 15 * 3**0.5, 50 * 3**0.5 + 15, 0], atol=1e-12)
    np.testing.assert_allclose(scenario.push[2, 0], [30, -100, 0], atol=1e-12)
    impulses = []

    def watched(start, velocity, t, scenario):
        impulses.append(velocity)
        return t < 0

    physics.falls = watched
    run_trials(agent, physics, starts, trials)
    np.testing.assert_allclose(impulses[-1], 0.2 * scenario.push[:, 0], atol=1e-9)


def test_pushed_robots_are_pushed_for_400_steps_of_mujoco(model, standing_qpos):
    physics = NativePhysics(model)
    state = physics.init(standing_qpos[None], np.zeros((1, cassie.NV)))
    scenario = scenario_of(Still(), [Trial(0, 1.0, pushes=(Push(50.0, 0.0),))], state, 2000)
    shorter = replace(scenario, push_stop=scenario.push_stop - 1)
    targets = cassie.STANDING_TARGET[None]
    before = physics.advance(state, targets, scenario, 399)
    np.testing.assert_array_equal(before.qvel, physics.advance(state, targets, shorter, 399).qvel)
    at_400, after = (physics.advance(state, targets, scenario, n) for n in (400, 401))
    free = physics.advance(at_400, targets, Scenario.nominal(1), 1)
    np.testing.assert_array_equal(after.qvel, free.qvel)
    assert np.abs(at_400.qvel - physics.advance(state, targets, shorter, 400).qvel).max() > 1e-4


def test_a_fall_is_judged_over_the_ground_below():
    qpos = np.zeros((6, cassie.NQ))
    x = np.array([0.0, np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
    qpos[:, 0], qpos[:, 2] = x, [0.7, 0.7, 0.9, 0.5, 0.95, np.nan]
    # Over crest and trough of h = 0.2 the heights are 0.7, 0.5, 0.7, 0.7, 1.15 and nothing.
    np.testing.assert_array_equal(
        fallen(qpos, Ground.of([Terrain("sine", 0.2)] * 6)), [False, True, False, False, False, True]
    )
    np.testing.assert_array_equal(
        fallen(qpos, Ground.of([Terrain("sine", 0.3)] * 6)), [False, True, False, False, True, True]
    )
    np.testing.assert_array_equal(fallen(qpos, Ground.flat(6)), [False, False, False, True, False, True])


@ENGINES
def test_speed_is_that_of_the_last_five_seconds(engine):
    physics = engine(pull=0.1)
    result = run_trials(Still(), physics, Still().start(physics, np.zeros(1)), [Trial(0, 10.0)])
    end = CONTROL_STEPS_OF_10_S * 0.032
    # Mean speed from t1 to t2 under constant acceleration: a (t1 + t2) / 2; five seconds are 156 control steps.
    np.testing.assert_allclose(result.speed_mps, 0.1 * (end + end - 156 * 0.032) / 2, rtol=1e-5)
    np.testing.assert_allclose(result.distance_m, 0.1 * end**2 / 2, rtol=1e-5)
    np.testing.assert_allclose(result.survived_s, 10.0)
    np.testing.assert_allclose([*result.height_m, *result.lowest_m], 0.9, rtol=1e-5)


@ENGINES
def test_a_fall_ends_the_walk_at_its_control_step(engine):
    physics = engine(pull=0.1, falls=lambda start, velocity, t, scenario: (start == 1) & (t > 1.0))
    result = run_trials(Still(), physics, Still().start(physics, np.zeros(2)), [Trial(k, 10.0) for k in (0, 1)])
    np.testing.assert_array_equal(result.fell, [False, True])
    # The first control step that ends after 1 s ends at 32 x 0.032 s; the robot stays where it was then.
    np.testing.assert_allclose(result.survived_s, [10.0, 1.024])
    np.testing.assert_allclose(result.speed_mps[1], 0)
    np.testing.assert_allclose(result.distance_m[1], 0.1 * 1.024**2 / 2, rtol=1e-5)


def test_only_work_done_counts_as_power():
    qpos, qvel = np.zeros((1, cassie.NQ)), np.zeros((1, cassie.NV))
    qvel[0, cassie.ACTIVE_QVEL[:2]] = (2.0, -3.0)
    # P target - D qdot: 100 x 0.3 - 10 x 2 = 10 N·m at 2 rad/s; 100 x 0 + 10 x 3 = 30 N·m against -3 rad/s.
    target = np.array([[0.3] + [0.0] * 9])
    state = PhysicsState(qpos, qvel, qvel, np.zeros(1, np.int32), np.zeros((1, 0, 67)))
    np.testing.assert_allclose(motor_effort(state, target, Scenario.nominal(1)), [[(10 + 30) / 10, 20.0]])


@ENGINES
def test_effort_is_a_mean_over_time(engine):
    class Pushing(Still):
        """Asks for 0.5 rad and 0 rad of the first joint in turn: 50 N·m and none."""

        def step(self, carry, sensed, command):
            target = 0.5 * (carry % 2 == 0)[:, None] * (np.arange(cassie.NU) == 0)
            return target, carry + 1

    physics = engine()
    starts = Pushing().start(physics, np.zeros(1))
    starts.physics.qvel[0, cassie.ACTIVE_QVEL[0]] = 0.01
    result = run_trials(Pushing(), physics, starts, [Trial(0, 0.064), Trial(0, 0.032)])
    # Less 0.1 N·m by damping; at 0.01 rad/s. Half of the time the motor brakes.
    np.testing.assert_allclose(result.torque_nm, [(49.9 + 0.1) / 2 / 10, 49.9 / 10], rtol=1e-5)
    np.testing.assert_allclose(result.power_w, [0.499 / 2, 0.499], rtol=1e-5)


def test_terrain_begins_on_a_crest():
    agent = Still()
    starts = agent.start(None, np.zeros(2))
    robots = placed(agent, starts, [Trial(1, 1.0, terrain=Terrain("sine", 0.2)), Trial(0, 1.0)])
    np.testing.assert_allclose(robots.physics.qpos[:, :3], [[np.pi / 2, 0, 1.1], [0, 0, 0.9]])
    np.testing.assert_array_equal(robots.physics.qpos[:, -1], [1, 0])
    np.testing.assert_array_equal(starts.physics.qpos[:, 0], 0)


def test_subjects_see_the_state_of_a_delay_ago(model, standing_qpos):
    class Standing(Still):
        def step(self, carry, sensed, command):
            self.seen = sensed.qpos
            return np.tile(cassie.STANDING_TARGET, (len(carry), 1)), carry

    physics, agent = NativePhysics(model, max_delay=20), Standing()
    state = physics.init(np.tile(standing_qpos, (2, 1)), np.full((2, cassie.NV), 0.05))
    run_trials(agent, physics, AgentState(state, np.zeros(2)), [Trial(0, 0.064, delay=20), Trial(1, 0.064)])
    delay = replace(Scenario.nominal(2), delay=np.array([20, 0], np.int32))
    at_44 = physics.advance(state, np.tile(cassie.STANDING_TARGET, (2, 1)), delay, 44)
    at_64 = physics.advance(at_44, np.tile(cassie.STANDING_TARGET, (2, 1)), delay, 20)
    np.testing.assert_array_equal(agent.seen, [at_44.qpos[0], at_64.qpos[1]])
    carried = moved(agent, AgentState(at_64, np.zeros(2)), np.array([[1.0, 2.0, 3.0], [0, 0, 0]]))
    np.testing.assert_allclose(carried.physics.history[0, :, :3] - at_64.history[0, :, :3], np.tile([1, 2, 3], (21, 1)))
    np.testing.assert_array_equal(carried.physics.history[:, :, 3:], at_64.history[:, :, 3:])


def test_effort_and_motion_are_those_of_the_agents_own_pd_law(model):
    """With 0.3 of the D gains the motors brake less: by hand for one control step at 0.02 rad/s."""
    physics = NativePhysics(model)
    soft, full = (
        run_trials(agent, physics, agent.start(physics, np.zeros(1)), [Trial(0, 0.032)])
        for agent in (Swaying(kd_scale=0.3), Swaying())
    )
    assert soft.torque_nm < full.torque_nm


@ENGINES
def test_a_delay_longer_than_the_history_is_refused_at_the_door(engine):
    """Under jit nothing could be raised any more."""
    agent, physics = Still(), engine()
    with pytest.raises(ValueError, match="delay of 3 physics steps was asked of an engine made for 0 to 0"):
        run_trials(agent, physics, agent.start(physics, np.zeros(1)), [Trial(0, 1.0, delay=3)])


def test_a_period_that_does_not_divide_the_control_step_is_refused():
    agent, physics = Still(), points()
    agent.period_s = 0.01
    with pytest.raises(ValueError, match=r"still acts every 0\.01 s, which does not divide 0\.032 s"):
        run_trials(agent, physics, agent.start(physics, np.zeros(1)), [Trial(0, 1.0)])
