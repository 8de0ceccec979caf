"""Trials, searches for limits, and the evaluation file."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx import cli, evaluate, reference, robot, subjects
from cassie_mjx.config import PPO_PRESETS
from cassie_mjx.envs import observation
from cassie_mjx.evaluate import EvaluateConfig, LimitSearch
from cassie_mjx.export import save_policy
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Disturbance, PhysicsState
from cassie_mjx.ppo import learner
from cassie_mjx.subjects import ControllerSubject
from cassie_mjx.sweeps import Measured, Trial, Walker, carried, conduct, disturbances, fallen, fly, motor_power, placed

CONTROL_STEPS_OF_10_S = 313


class _Sliding:
    """An engine of points that slide along x with acceleration `pull`; `falls(start, impulse, t)` drops them."""

    max_delay = 0

    def __init__(self, hertz=2000, pull=0.0, falls=lambda start, impulse, t: False):
        self.model = SimpleNamespace(opt=SimpleNamespace(timestep=1 / hertz))
        self.pull, self.falls = pull, falls
        self.flown = 0

    def advance(self, state, target, disturbance, n_steps):
        dt = self.model.opt.timestep
        self.flown += n_steps * len(target)
        pushed = np.clip(disturbance.push_stop - state.step, 0, n_steps)
        step = state.step + np.int32(n_steps)
        t = step * dt
        qpos, qvel = state.qpos.copy(), state.qvel.copy()
        qvel[:, :3] += disturbance.push * (pushed * dt)[:, None]
        qpos[:, 0] = self.pull * t**2 / 2
        down = [self.falls(int(q[-1]), v[:3], now) for q, v, now in zip(qpos, qvel, t, strict=True)]
        qpos[:, 2] = np.where(down, 0.5, 0.9)
        return replace(state, qpos=qpos, qvel=qvel, step=step)


def sliding(**how) -> Any:
    """The engine, typed as any."""
    return _Sliding(**how)


class Still:
    """A subject that asks for zero angles; it remembers how often it acted."""

    name, period_s = "still", 0.032

    def start(self, physics, phases):
        robots = len(phases)
        qpos = np.zeros((robots, robot.NQ))
        qpos[:, 2], qpos[:, 3], qpos[:, -1] = 0.9, 1.0, np.arange(robots)
        zero = np.zeros((robots, robot.NV))
        state = PhysicsState(qpos, zero, zero, np.zeros(robots, np.int32), np.zeros((robots, 0, 67)))
        return Walker(state, np.zeros(robots))

    def returns(self):
        return []

    def act(self, physics, seen, memory):
        return np.zeros((len(memory), robot.NU)), memory + 1

    def carried(self, memory, offset):
        return memory


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


@pytest.mark.parametrize("lanes", [1, 3, 64])
def test_limits_do_not_depend_on_the_number_of_lanes(lanes):
    # Start 0 falls from 100 N on, start 1 only at 70 N, start 2 never, start 3 at once.
    rules = [lambda f: f > 95, lambda f: abs(f - 70) < 1, lambda f: False, lambda f: True]
    physics = sliding(falls=lambda start, v, t: t > 0.5 and rules[start](v[0] / 0.2))
    search = LimitSearch(lambda g, k: Trial(g, 1.0, push=(10.0 * (k + 1), 0.0)), groups=4, levels=15)
    conduct(Still(), physics, Still().start(physics, np.zeros(4)), search, lanes)
    np.testing.assert_array_equal(search.limit, [9, 6, 15, 0])


def test_the_fallen_give_way_to_the_next():
    physics = sliding(falls=lambda start, v, t: True)
    result = fly(Still(), physics, Still().start(physics, np.zeros(8)), [Trial(k, 10.0) for k in range(8)])
    assert result.fell.all()
    np.testing.assert_allclose(result.survived_s, 0.032)
    assert physics.flown == 8 * 64


@pytest.mark.parametrize("hertz", [1000, 2000])
def test_a_push_lasts_a_fifth_of_a_second_in_the_heading_frame(hertz):
    yaw = np.array([0.0, np.pi / 3, -np.pi / 2])
    physics, subject = sliding(hertz=hertz), Still()
    starts = subject.start(physics, np.zeros(3))
    starts.physics.qpos[:, 3:7] = [turned(angle) for angle in yaw]
    starts.physics.step[:] = (0, 128, 640)
    trials = [Trial(k, 1.0, push=(100.0, 30.0)) for k in range(3)]
    disturbance = disturbances(trials, starts.physics, round(0.2 * hertz))
    np.testing.assert_array_equal(disturbance.push_stop - disturbance.push_start, round(0.2 * hertz))
    np.testing.assert_array_equal(disturbance.push_start, starts.physics.step)
    np.testing.assert_allclose(disturbance.push[0], [100, 30, 0], atol=1e-12)
    np.testing.assert_allclose(disturbance.push[1], [50 - 15 * 3**0.5, 50 * 3**0.5 + 15, 0], atol=1e-12)
    np.testing.assert_allclose(disturbance.push[2], [30, -100, 0], atol=1e-12)
    impulses = []
    physics.falls = lambda start, v, t: impulses.append((start, *v))
    fly(subject, physics, starts, trials)
    last = {int(start): impulse for start, *impulse in impulses}
    for k in range(3):
        np.testing.assert_allclose(last[k], 0.2 * disturbance.push[k], atol=1e-9)


def test_pushed_robots_are_pushed_for_400_steps_of_mujoco(model, standing_qpos):
    physics = NativePhysics(model)
    state = physics.init(standing_qpos[None], np.zeros((1, robot.NV)))
    disturbance = disturbances([Trial(0, 1.0, push=(50.0, 0.0))], state, 400)
    shorter = replace(disturbance, push_stop=disturbance.push_stop - 1)
    targets = robot.STANDING_TARGET[None]
    before = physics.advance(state, targets, disturbance, 399)
    np.testing.assert_array_equal(before.qvel, physics.advance(state, targets, shorter, 399).qvel)
    at_400, after = (physics.advance(state, targets, disturbance, n) for n in (400, 401))
    free = physics.advance(at_400, targets, Disturbance.none(1), 1)
    np.testing.assert_array_equal(after.qvel, free.qvel)
    assert np.abs(at_400.qvel - physics.advance(state, targets, shorter, 400).qvel).max() > 1e-4


def test_a_fall_is_judged_over_the_ground_below():
    qpos = np.zeros((6, robot.NQ))
    x = np.array([0.0, np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0])
    qpos[:, 0], qpos[:, 2] = x, [0.7, 0.7, 0.9, 0.5, 0.95, np.nan]
    # Over crest and trough of h = 0.2 the heights are 0.7, 0.5, 0.7, 0.7, 1.15 and nothing.
    np.testing.assert_array_equal(fallen(qpos, np.full(6, 0.2)), [False, True, False, False, False, True])
    np.testing.assert_array_equal(fallen(qpos, np.full(6, 0.3)), [False, True, False, False, True, True])
    np.testing.assert_array_equal(fallen(qpos, np.zeros(6)), [False, False, False, True, False, True])


def test_speed_is_that_of_the_last_five_seconds():
    physics = sliding(pull=0.1)
    result = fly(Still(), physics, Still().start(physics, np.zeros(1)), [Trial(0, 10.0)])
    end = CONTROL_STEPS_OF_10_S * 0.032
    # Mean speed from t1 to t2 under constant acceleration: a (t1 + t2) / 2; five seconds are 156 control steps.
    np.testing.assert_allclose(result.speed_mps, 0.1 * (end + end - 156 * 0.032) / 2)
    np.testing.assert_allclose(result.distance_m, 0.1 * end**2 / 2)
    np.testing.assert_allclose(result.survived_s, 10.0)
    np.testing.assert_allclose([*result.height_m, *result.lowest_m], 0.9)


def test_a_fall_ends_the_walk_at_its_control_step():
    physics = sliding(pull=0.1, falls=lambda start, v, t: start == 1 and t > 1.0)
    result = fly(Still(), physics, Still().start(physics, np.zeros(2)), [Trial(k, 10.0) for k in (0, 1)])
    np.testing.assert_array_equal(result.fell, [False, True])
    # The first control step that ends after 1 s ends at 32 x 0.032 s.
    np.testing.assert_allclose(result.survived_s, [10.0, 1.024])
    np.testing.assert_allclose(result.speed_mps[1], 0)


def test_only_work_done_counts_as_power():
    qpos, qvel = np.zeros((1, robot.NQ)), np.zeros((1, robot.NV))
    qvel[0, robot.ACTIVE_QVEL[:2]] = (2.0, -3.0)
    # P target - D qdot: 100 x 0.3 - 10 x 2 = 10 N·m at 2 rad/s; 100 x 0 + 10 x 3 = 30 N·m against -3 rad/s.
    target = np.array([[0.3] + [0.0] * 9])
    state = PhysicsState(qpos, qvel, qvel, np.zeros(1, np.int32), np.zeros((1, 0, 67)))
    np.testing.assert_allclose(motor_power(state, target, Disturbance.none(1)), 20.0)


def test_terrain_begins_on_a_crest():
    subject = Still()
    starts = subject.start(None, np.zeros(2))
    walker = placed(subject, starts, [Trial(1, 1.0, terrain=0.2), Trial(0, 1.0)])
    np.testing.assert_allclose(walker.physics.qpos[:, :3], [[np.pi / 2, 0, 1.1], [0, 0, 0.9]])
    np.testing.assert_array_equal(walker.physics.qpos[:, -1], [1, 0])
    np.testing.assert_array_equal(starts.physics.qpos[:, 0], 0)


def test_subjects_see_the_state_of_a_delay_ago(model, standing_qpos):
    class Standing(Still):
        def act(self, physics, seen, memory):
            self.seen = seen.qpos
            return np.tile(robot.STANDING_TARGET, (len(memory), 1)), memory

    physics, subject = NativePhysics(model, max_delay=20), Standing()
    state = physics.init(np.tile(standing_qpos, (2, 1)), np.full((2, robot.NV), 0.05))
    fly(subject, physics, Walker(state, np.zeros(2)), [Trial(0, 0.064, delay=20), Trial(1, 0.064)])
    delay = replace(Disturbance.none(2), delay=np.array([20, 0], np.int32))
    at_44 = physics.advance(state, np.tile(robot.STANDING_TARGET, (2, 1)), delay, 44)
    at_64 = physics.advance(at_44, np.tile(robot.STANDING_TARGET, (2, 1)), delay, 20)
    np.testing.assert_array_equal(subject.seen, [at_44.qpos[0], at_64.qpos[1]])
    moved = carried(subject, Walker(at_64, np.zeros(2)), np.array([[1.0, 2.0, 3.0], [0, 0, 0]]))
    np.testing.assert_allclose(moved.physics.history[0, :, :3] - at_64.history[0, :, :3], np.tile([1, 2, 3], (21, 1)))
    np.testing.assert_array_equal(moved.physics.history[:, :, 3:], at_64.history[:, :, 3:])


def test_a_period_that_does_not_divide_the_control_step_is_refused():
    subject, physics = Still(), sliding()
    subject.period_s = 0.01
    with pytest.raises(ValueError, match=r"still acts every 0\.01 s, which does not divide 0\.032 s"):
        fly(subject, physics, subject.start(physics, np.zeros(1)), [Trial(0, 1.0)])


def test_the_controller_starts_along_its_stride_and_walks_on(model):
    physics, subject = NativePhysics(model), ControllerSubject("stiff")
    phases = np.array([0.0, 0.25, 0.5, 0.875])
    starts = subject.start(physics, phases)
    np.testing.assert_allclose(starts.physics.qpos[:, 0], 0, atol=1e-12)
    # At phase 0 the clock of the right leg's step is over, and the next call gives the left leg its turn.
    memory = starts.memory.state
    off_phase = (memory.stance * 0.352 + memory.phase - 0.704 * phases + 0.1) % 0.704 - 0.1
    np.testing.assert_allclose(off_phase, 0, atol=1e-3)
    # The foot in the air, or about to leave the ground, left it within half a stride of the pelvis.
    assert (np.abs(memory.liftoff_w[:, 0]) < 0.5).all()
    result = fly(subject, physics, starts, [Trial(k, 3.0) for k in range(4)])
    assert not result.fell.any()
    np.testing.assert_allclose(result.distance_m / 3.0, 0.7, atol=0.07)
    moved = subject.carried(starts.memory, np.tile([1.0, 2.0, 3.0], (4, 1))).state
    np.testing.assert_allclose(moved.liftoff_w - memory.liftoff_w, np.tile([1, 2, 3], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.line_w - memory.line_w, np.tile([1, 2, 0], (4, 1)), atol=1e-6)


def test_push_figures_are_worst_and_median_phase():
    limits = np.array([[40, 10, 30, 20], [50, 50, 50, 60], [0, 10, 10, 10], [400, 400, 400, 400]])
    rows = {row.quantity: row.value for row in evaluate.push_figures(limits)}
    assert rows == {
        **{"push_forward_N": 10, "push_backward_N": 50, "push_left_N": 0, "push_right_N": 400},
        **{"push_forward_median_N": 25, "push_backward_median_N": 50},
        **{"push_left_median_N": 10, "push_right_median_N": 400},
    }


def test_the_file_has_rows_and_provenance(tmp_path, monkeypatch):
    figures = {"walk": Measured("speed_mps", 0.7, "m/s", 10), "terrain": Measured("terrain_h_m", 0.1, "m", 8)}
    monkeypatch.setattr(evaluate, "walk", lambda subject, long, watch: [figures["walk"]])
    monkeypatch.setattr(evaluate, "push", lambda subject, watch: [])
    monkeypatch.setattr(evaluate, "terrain", lambda subject, watch: watch(3, 5) or [figures["terrain"]])
    evaluate.main(EvaluateConfig(policy="controller:stiff", out=str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    assert content.keys() == {"rows", "provenance"}
    assert content["rows"] == [
        {"subject": "controller:stiff", "quantity": "speed_mps", "value": 0.7, "unit": "m/s", "n": 10},
        {"subject": "controller:stiff", "quantity": "terrain_h_m", "value": 0.1, "unit": "m", "n": 8},
    ]
    assert content["provenance"]["policy"] == "controller:stiff"


def test_walking_figures_take_the_worst_survival():
    physics = sliding(falls=lambda start, v, t: start == 1 and t > 1.0)
    result = fly(Still(), physics, Still().start(physics, np.zeros(2)), [Trial(k, 10.0) for k in (0, 1)])
    rows = {row.quantity: row for row in evaluate.walking_figures(result, "_60s")}
    assert rows["survived_s_60s"] == ("survived_s_60s", pytest.approx(1.024), "s", 2)
    assert {"speed_mps_60s", "pelvis_height_m_60s", "power_w_60s", "drift_m_60s"} < rows.keys()


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("suite=jump", "suite='jump' is not known; choose one of walk, push, terrain, all"),
        ("physics=mjx", "physics='mjx' is not known; choose one of native"),
        ("speed=2", "'speed' is not a key; the keys are policy, suite, long, physics, out"),
    ],
)
def test_bad_input_gets_one_sentence(argument, sentence):
    with pytest.raises(ValueError, match=sentence):
        cli.parse(EvaluateConfig, [argument])


@pytest.mark.parametrize("name", ["stiff", "controller:soft", "runs/none"])
def test_an_unknown_policy_gets_one_sentence(name):
    with pytest.raises(ValueError, match=f"policy={name} is none of controller:stiff, controller:compliant, nor"):
        subjects.resolve(name)


def test_a_policy_walks_as_its_targets_say(tmp_path, model):
    """A zero residual holds the next sample of the reference: the PD targets of `act`, step after step."""
    motion = reference.resolve("walk")
    state = learner.init(jax.random.key(0), PPO_PRESETS["parallel"], observation.SIZE, robot.NU)
    zero = state.policy._replace(actor=jax.tree.map(jnp.zeros_like, state.policy.actor))
    save_policy(tmp_path / "zero.npz", zero, motion, 1.0, {})
    subject = subjects.resolve(str(tmp_path / "zero.npz"))
    physics = NativePhysics(model)
    walker = Walker(physics.init(np.asarray(motion.qpos[[3, 21]]), np.asarray(motion.qvel[[3, 21]])), np.array([3, 21]))
    target, memory = subject.act(physics, walker.physics, walker.memory)
    np.testing.assert_allclose(target, np.asarray(motion.qpos)[[4, 0]][:, robot.ACTIVE_QPOS], atol=1e-6)
    np.testing.assert_array_equal(memory, [4, 0])
    with pytest.raises(ValueError, match="falls before it walks steadily"):
        subject.start(physics, np.zeros(1))


def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    with pytest.raises(ValueError, match="cannot be written"):
        evaluate.main(EvaluateConfig(out=str(tmp_path / "missing" / "a.json")))
