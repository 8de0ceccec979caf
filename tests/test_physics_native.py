"""MuJoCo C in batch against plain MuJoCo, closed forms and itself."""

from collections import deque
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from cassie_mjx.physics import native
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario, delayed
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Ground, Terrain, set_terrain
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import ModelConfig, load_model, servo_model


def start(physics, qpos, batch, seed=0):
    """`batch` robots near `qpos`, moving a little, each with targets of its own."""
    rng = np.random.default_rng(seed)
    qvel = 0.3 * rng.normal(size=(batch, cassie.NV))
    targets = cassie.STANDING_TARGET + 0.1 * rng.normal(size=(batch, cassie.NU))
    return physics.init(np.tile(qpos, (batch, 1)), qvel), targets


def steps(*values):
    return np.array(values, np.int32)


def pushes(*counts):
    return steps(*counts)[:, None]


def test_standing_stays_up_with_its_loops_closed(model, standing_qpos):
    physics = NativePhysics(model)
    state = physics.init(standing_qpos[None], np.zeros((1, cassie.NV)))
    for _ in range(63):
        state = physics.advance(state, cassie.STANDING_TARGET[None], Scenario.nominal(1), 64)
        assert state.qpos[0, 2] == pytest.approx(standing_qpos[2], abs=0.002)
        assert loop_error(model, state.qpos)[0] < 1e-3
    assert state.step[0] == 63 * 64


def test_advance_is_plain_mujoco(model, standing_qpos):
    physics = NativePhysics(model)
    state, targets = start(physics, standing_qpos, 3)
    servo = servo_model(model)
    expected = []
    for robot_index in range(3):
        data = mujoco.MjData(servo)
        data.qpos[:], data.qvel[:] = state.qpos[robot_index], state.qvel[robot_index]
        data.ctrl[:] = targets[robot_index]
        for _ in range(100):
            mujoco.mj_step(servo, data)
        expected.append(data.qpos.copy())
    moved = physics.advance(state, targets, Scenario.nominal(3), 100)
    np.testing.assert_array_equal(moved.qpos, expected)


def test_pieces_equal_the_whole_and_inputs_are_kept(model, standing_qpos):
    physics = NativePhysics(model)
    state, targets = start(physics, standing_qpos, 4)
    scenario = replace(
        Scenario.nominal(4),
        push=np.full((4, 1, 3), 50.0),
        push_start=pushes(0, 7, 20, 90),
        push_stop=pushes(5, 30, 40, 99),
    )
    before = state.qpos.copy()
    whole = physics.advance(state, targets, scenario, 64)
    pieces = state
    for n in (1, 9, 22, 32):
        pieces = physics.advance(pieces, targets, scenario, n)
    np.testing.assert_array_equal(pieces.qpos, whole.qpos)
    np.testing.assert_array_equal(state.qpos, before)


@pytest.mark.parametrize("kd_scale", [1.0, 0.3])
def test_both_paths_give_the_same_trajectory(model, standing_qpos, kd_scale):
    held, stepwise = NativePhysics(model), NativePhysics(model, max_delay=3)
    a, targets = start(held, standing_qpos, 5)
    b, _ = start(stepwise, standing_qpos, 5)
    scenario = replace(
        Scenario.nominal(5),
        push=np.full((5, 1, 3), 80.0),
        push_start=pushes(0, 3, 10, 64, 70),
        push_stop=pushes(*[90] * 5),
    )
    scenario = replace(scenario, kd_scale=np.full(5, kd_scale))
    for _ in range(4):
        a = held.advance(a, targets, scenario, 32)
        b = stepwise.advance(b, targets, scenario, 32)
    np.testing.assert_allclose(b.qpos, a.qpos, atol=1e-10)
    np.testing.assert_allclose(b.qvel, a.qvel, atol=1e-8)


@pytest.mark.parametrize("physics_hz", [500, 1000, 2000])
def test_a_push_of_a_fifth_of_a_second_gives_its_momentum(physics_hz, standing_qpos):
    """Floating without gravity, F t = M v, whatever the motors do."""
    model = load_model(ModelConfig(physics_hz=physics_hz))
    model.opt.gravity[:] = 0
    physics = NativePhysics(model)
    qpos = standing_qpos + np.array([0, 0, 5.0] + [0] * 32)
    state = physics.init(np.tile(qpos, (2, 1)), np.zeros((2, cassie.NV)))
    duration = round(0.2 * physics_hz)
    force = np.array([[100.0, -40.0, 20.0], [0.0, 60.0, 0.0]])
    scenario = replace(
        Scenario.nominal(2),
        push=force[:, None],
        push_start=pushes(13, 57),
        push_stop=pushes(13 + duration, 57 + duration),
    )
    state = physics.advance(state, np.tile(qpos[cassie.ACTIVE_QPOS], (2, 1)), scenario, physics_hz // 2)
    data = mujoco.MjData(model)
    for i in range(2):
        data.qpos[:], data.qvel[:] = state.qpos[i], state.qvel[i]
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        # Damping and loop forces act between bodies, so only the push changes the momentum.
        np.testing.assert_allclose(33.312 * data.subtree_linvel[0], force[i] * 0.2, atol=2e-2)


def test_pushes_at_the_same_time_add_up(model, standing_qpos):
    physics = NativePhysics(model)
    state, targets = start(physics, standing_qpos, 1)
    two = Scenario.nominal(1, 2, push=[[30.0, 0, 0], [30.0, 50.0, 0]], push_start=[0, 20], push_stop=[40, 60])
    moved = physics.advance(state, targets, two, 80)
    piece = state
    for force, first, last in (([30.0, 0, 0], 0, 20), ([60.0, 50.0, 0], 20, 40), ([30.0, 50.0, 0], 40, 60)):
        one = Scenario.nominal(1, push=force, push_start=first, push_stop=last)
        piece = physics.advance(piece, targets, one, 20)
    piece = physics.advance(piece, targets, Scenario.nominal(1), 20)
    np.testing.assert_array_equal(moved.qpos, piece.qpos)


def test_delayed_pd_is_the_pd_law_on_old_states(model, standing_qpos):
    delays = (0, 1, 7)
    physics = NativePhysics(model, max_delay=10)
    state, targets = start(physics, standing_qpos, len(delays))
    scenario = replace(Scenario.nominal(len(delays)), delay=steps(*delays))
    expected = []
    for i, delay in enumerate(delays):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = state.qpos[i], state.qvel[i]
        seen = deque([(data.qpos.copy(), data.qvel.copy())] * (delay + 1), maxlen=delay + 1)
        for _ in range(80):
            q, qdot = seen[0]
            torque = cassie.P_GAIN * (targets[i] - q[cassie.ACTIVE_QPOS]) - cassie.D_GAIN * qdot[cassie.ACTIVE_QVEL]
            data.ctrl[:] = torque / model.actuator_gear[:, 0]
            mujoco.mj_step(model, data)
            seen.append((data.qpos.copy(), data.qvel.copy()))
        expected.append((data.qpos.copy(), seen[0][0].copy()))
    state = physics.advance(state, targets, scenario, 80)
    np.testing.assert_allclose(state.qpos, [qpos for qpos, _ in expected], atol=1e-12)
    np.testing.assert_allclose(delayed(state, scenario)[0], [old for _, old in expected], atol=1e-12)


def test_one_and_two_threads_agree_to_the_bit(model, standing_qpos):
    results = []
    for threads in (1, 2):
        physics = NativePhysics(model, threads=threads)
        state, targets = start(physics, standing_qpos, 33)
        results.append(physics.advance(state, targets, Scenario.nominal(33), 200))
    np.testing.assert_array_equal(results[0].qpos, results[1].qpos)
    np.testing.assert_array_equal(results[0].qvel, results[1].qvel)


def test_each_robot_has_its_own_terrain(standing_qpos):
    model = load_model(ModelConfig(scene="terrain"))
    physics = NativePhysics(model)
    qpos = np.tile(standing_qpos, (3, 1))
    heights = np.array([0.0, 0.1, 0.3])
    # The crest of sin x at pi / 2 is level.
    qpos[:, 0] += np.pi / 2
    qpos[:, 2] += heights
    state = physics.init(qpos, np.zeros((3, cassie.NV)))
    targets = np.tile(cassie.STANDING_TARGET, (3, 1))
    scenario = replace(Scenario.nominal(3), ground=Ground.of([Terrain("sine", h) for h in heights]))
    moved = physics.advance(state, targets, scenario, 400)
    np.testing.assert_allclose(moved.qpos[:, 2], qpos[:, 2], atol=0.01)
    for i, height in enumerate(heights):
        alone = load_model(ModelConfig(scene="terrain"))
        set_terrain(alone, Terrain("sine", height).ground)
        servo = servo_model(alone)
        data = mujoco.MjData(servo)
        data.qpos[:], data.ctrl[:] = qpos[i], cassie.STANDING_TARGET
        for _ in range(400):
            mujoco.mj_step(servo, data)
        np.testing.assert_allclose(moved.qpos[i], data.qpos, atol=1e-12)


def test_grounds_that_come_back_are_not_made_again(monkeypatch, standing_qpos):
    physics, made = NativePhysics(load_model(ModelConfig(scene="terrain"))), []
    monkeypatch.setattr(native, "set_terrain", lambda model, ground: made.append(ground.sine))
    state, targets = start(physics, standing_qpos, 1)

    def walk_over(*heights):
        for height in heights:
            ground = Ground.of([Terrain("sine", height)])
            physics.advance(state, targets, Scenario.nominal(1, ground=ground), 1)

    walk_over(0.1, 0.2, 0.1, 0.2)
    assert made == [0.1, 0.2]
    monkeypatch.setattr(native, "MOST_MODELS", 2)
    walk_over(0.3, 0.2)
    assert made == [0.1, 0.2, 0.3, 0.2], "where there is no room, those in use alone are kept"


def test_bodies_are_those_of_mujoco(model, standing_qpos):
    physics = NativePhysics(model)
    state, _ = start(physics, standing_qpos, 2)
    bodies = physics.bodies(state)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.qpos[1], state.qvel[1]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(bodies.xpos[1], data.xpos, atol=1e-12)
    np.testing.assert_allclose(bodies.ximat[1].reshape(-1, 9), data.ximat, atol=1e-12)
    np.testing.assert_allclose(bodies.cvel[1], data.cvel, atol=1e-12)
    np.testing.assert_allclose(bodies.com[1], data.subtree_com[0], atol=1e-12)


def test_a_nan_stays_with_its_robot(model, standing_qpos):
    physics = NativePhysics(model)
    state, targets = start(physics, standing_qpos, 3)
    alone = physics.advance(state, targets, Scenario.nominal(3), 64)
    state.qvel[1, 4] = np.nan
    moved = physics.advance(state, targets, Scenario.nominal(3), 64)
    assert np.isnan(moved.qpos[1]).any()
    np.testing.assert_array_equal(moved.qpos[[0, 2]], alone.qpos[[0, 2]])


def test_bad_input_gets_one_sentence(model, standing_qpos):
    physics = NativePhysics(model)
    qpos, qvel = np.tile(standing_qpos, (2, 1)), np.zeros((2, cassie.NV))
    with pytest.raises(ValueError, match=r"shapes \(35,\) and \(32,\); they must be \[B, 35\] and \[B, 32\]"):
        physics.init(qpos[0], qvel[0])
    broken = qpos.copy()
    broken[1, 9] = np.nan
    with pytest.raises(ValueError, match=r"qpos\[1, 9\] is nan; a starting state must be finite"):
        physics.init(broken, qvel)
    state = physics.init(qpos, qvel)
    targets = np.tile(cassie.STANDING_TARGET, (2, 1))
    with pytest.raises(ValueError, match=r"target has shape \(3, 10\); for 2 robots it must be \(2, 10\)"):
        physics.advance(state, np.zeros((3, 10)), Scenario.nominal(2), 1)
    with pytest.raises(ValueError, match=r"scenario.push has shape \(5, 1, 3\)"):
        physics.advance(state, targets, Scenario.nominal(5), 1)
    late = replace(Scenario.nominal(2), delay=steps(0, 4))
    with pytest.raises(ValueError, match="delay of 4 physics steps .* 0 to 0; make it with max_delay=4"):
        physics.advance(state, targets, late, 1)
    with pytest.raises(ValueError, match="delay of -2 physics steps looks into the future"):
        physics.advance(state, targets, replace(late, delay=steps(0, -2)), 1)
    hilly = replace(Scenario.nominal(2), ground=Ground.of([Terrain("sine", h) for h in (0.0, 0.1)]))
    with pytest.raises(ValueError, match="ground of scene='terrain' was asked of an engine made with scene='flat'"):
        physics.advance(state, targets, hilly, 1)
