"""The suites' questions, put to agents and engines whose outcomes are written down."""

from types import SimpleNamespace

import numpy as np
import pytest
from points import Still, never, points

from cassie_mjx.agents.make import make_agent
from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.evaluation import pushes, suites
from cassie_mjx.evaluation import trial as trials
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import EvalSetup
from cassie_mjx.evaluation.trial import Metric, Push, Trial
from cassie_mjx.physics.make import ENGINES


class Settled(EvalSetup):
    """A setting whose engine is one of points that fall by a rule."""

    falls = staticmethod(never)

    def physics(self, scene="flat", longest_delay_s=0.0):
        physics = points(falls=self.falls)
        physics.max_delay = round(2000 * longest_delay_s)
        return physics

    def starts(self, agent, phases, longest_delay_s=0.0):
        return agent.start(points(), phases)


class Imitating(Still):
    """Its return falls by 10 with each step of delay."""


@pytest.fixture(autouse=True)
def returns(monkeypatch):
    def by_hand(agent, physics, phases, delay=0):
        imitates = isinstance(agent, Imitating)
        return [Metric("return_plain", 300.0 - 10 * delay, "of 300", 10)] if imitates else []

    monkeypatch.setattr(suites, "agent_returns", by_hand)


def values(result):
    return {metric.quantity: metric.value for metric in result.metrics}


def test_the_longest_delay_has_no_gap_below_it():
    class Late(Settled):
        @staticmethod
        def falls(start, velocity, t, scenario):
            # Start 3 cannot bear 6.5 ms, all others bear up to 12 ms, and start 1 no more than 2 ms after 30 s.
            alone = (start == 3) & (scenario.delay == 13)
            weary = (start == 1) & (scenario.delay > 4) & (t > 30)
            return ((scenario.delay > 24) & (t > 9)) | alone | weary

    found = values(suites.delay(Imitating(), Late(long=True)))
    assert found == {
        **{"delay_5ms_return_plain": 200, "delay_10ms_return_plain": 100},
        **{"delay_5ms_survived_s": 10, "delay_10ms_survived_s": 10},
        **{"delay_max_ms": 6, "delay_max_ms_60s": 2},
    }


def test_survival_under_delay_is_that_of_the_worst_start():
    class Late(Settled):
        @staticmethod
        def falls(start, velocity, t, scenario):
            return (start == 7) & (scenario.delay == 20) & (t > 2)

    found = values(suites.delay(Imitating(), Late()))
    assert found["delay_5ms_survived_s"] == 10
    assert found["delay_10ms_survived_s"] == pytest.approx(2.016)
    assert found["delay_max_ms"] == 9.5


@pytest.mark.parametrize(("highest", "expected"), [(0.155, 0.15), (0.005, 0.0), (1.0, 0.8)])
def test_the_highest_terrain_is_survived_from_all_phases(highest, expected):
    class Hilly(Settled):
        @staticmethod
        def falls(start, velocity, t, scenario):
            return (start == 5) & (scenario.ground.sine > highest)

    assert values(suites.terrain(Still(), Hilly())) == {"terrain_h_m": expected}


def test_the_map_has_every_cell(monkeypatch):
    """Pushes up to 100 N are survived; those to the left up to 50 N, and at phase 3 also 80 N."""

    def survives(trial):
        (push,) = trial.pushes
        force, angle = np.hypot(push.forward, push.left), np.arctan2(push.left, push.forward)
        if np.isclose(angle, np.pi / 2):
            return force < 55 or (trial.start == 3 and np.isclose(force, 80))
        return force < 105

    flown = []

    def judged(agent, physics, starts, listed, progress, num_envs):
        flown.extend(listed)
        return SimpleNamespace(fell=np.array([not survives(trial) for trial in listed]))

    monkeypatch.setattr(pushes, "run_trials", judged)
    result = suites.push_map(Still(), Settled())
    assert len(flown) == 16 * 8 * 40
    assert {trial.seconds for trial in flown} == {PUSH_S + trials.AFTER_PUSH_S}
    cells, found = result.cells, values(result)
    assert cells is not None
    assert (len(cells["directions_deg"]), len(cells["phases"]), len(cells["forces_N"])) == (16, 8, 40)
    assert cells["directions_deg"][4] == 90
    assert cells["survived"][0][3] == "1" * 10 + "0" * 30
    assert cells["survived"][4][2] == "1" * 5 + "0" * 35
    assert cells["survived"][4][3] == "11111001" + "0" * 32
    assert (found["push_0deg_N"], found["push_90deg_N"], found["push_90deg_median_N"]) == (100, 50, 50)
    assert found["push_worst_N"] == 50
    assert found["push_22.5deg_survived"] == 0.25
    assert found["push_90deg_survived"] == pytest.approx((5 * 8 + 1) / 320)
    assert found["push_map_survived"] == pytest.approx((15 * 80 + 41) / 5120)


def test_the_limits_of_pushes_are_those_of_each_direction_and_phase():
    class Pushed(Settled):
        @staticmethod
        def falls(start, velocity, t, scenario):
            # Points of 1 kg gain 0.2 m/s for each newton of 0.2 s.
            forward, left = velocity[:, 0] / 0.2, velocity[:, 1] / 0.2
            along = (forward > 105 + 10 * start) | (forward < -55 - 10 * start)
            return along | (left > 205) | (left < -35 - 10 * start)

    # Phases 0 to 7: the median is 35 N over the worst where a limit grows by 10 N from phase to phase.
    assert values(suites.push(Still(), Pushed())) == {
        **{"push_forward_N": 100, "push_backward_N": 50, "push_left_N": 200, "push_right_N": 30},
        **{"push_forward_median_N": 135, "push_backward_median_N": 85},
        **{"push_left_median_N": 200, "push_right_median_N": 65},
    }


def test_forces_of_other_durations_are_limited_by_their_impulse():
    class Pushed(Settled):
        @staticmethod
        def falls(start, velocity, t, scenario):
            # Points of 1 kg: whoever has gained more than 45 m/s forward or 25 m/s to the right falls.
            return (velocity[:, 0] > 45 + 1e-9) | (velocity[:, 1] < -25 - 1e-9)

    found = values(suites.forces(Still(), Pushed()))
    assert {name: value for name, value in found.items() if "forward" in name and "median" not in name} == {
        **{"push_0.1s_forward_N": 440, "push_0.5s_forward_N": 90, "push_1s_forward_N": 40},
        **{"push_twice_forward_N": 110, "steady_forward_N": 0},
    }
    assert (found["push_0.1s_right_N"], found["push_twice_right_median_N"]) == (240, 60)
    assert (found["push_0.1s_left_N"], found["push_twice_backward_N"], found["steady_left_N"]) == (800, 400, 200)


def test_random_pushes_come_every_two_seconds_from_everywhere():
    trials_60s = pushes.random_pushes()
    drawn = np.array([trial.pushes for trial in trials_60s])
    assert drawn.shape == (100, 30, 4)
    assert {trial.seconds for trial in trials_60s} == {60.0}
    assert {trial.start for trial in trials_60s} == set(range(8))
    np.testing.assert_array_equal(drawn[..., 2], np.tile(np.arange(0, 60, 2), (100, 1)))
    force = np.hypot(drawn[..., 0], drawn[..., 1])
    assert 299 < force.max() <= 300
    assert abs(force.mean() - 150) < 5
    assert np.abs(drawn[..., :2].mean(axis=(0, 1))).max() < 6


def test_the_share_that_bears_random_pushes_counts_robots(monkeypatch):
    monkeypatch.setattr(pushes, "FORCES", {})
    weak = SimpleNamespace(fell=np.arange(100) < 7)
    monkeypatch.setattr(pushes, "run_trials", lambda *_: weak)
    assert values(suites.forces(Still(), Settled())) == {"push_random_survived_60s": 0.93}


def test_a_walker_that_falls_in_the_warm_up_has_returns_and_a_survival_of_nothing():
    class Unsteady(Imitating):
        def start(self, physics, phases):
            raise trials.NeverSteady("falls")

    assert values(suites.walk(Unsteady(), Settled(long=True))) == {
        **{"return_plain": 300, "survived_s": 0, "survived_s_60s": 0}
    }
    with pytest.raises(ValueError, match="falls"):
        suites.push(Unsteady(), Settled())


def test_pushes_along_the_axes_are_those_of_the_limit_search():
    assert [pushes.towards(degrees) for degrees in (0, 180, 90, 270)] == list(pushes.DIRECTIONS.values())
    assert pushes.towards(30) == pytest.approx((3**0.5 / 2, 0.5))
    assert pushes.pushed(3, (0, -1), 70).pushes == (Push(0, -70),)


def test_push_figures_are_worst_and_median_phase():
    limits = np.array([[40, 10, 30, 20], [50, 50, 50, 60], [0, 10, 10, 10], [400, 400, 400, 400]])
    rows = {row.quantity: row.value for row in pushes.push_metrics(limits, list(pushes.DIRECTIONS))}
    assert rows == {
        **{"push_forward_N": 10, "push_backward_N": 50, "push_left_N": 0, "push_right_N": 400},
        **{"push_forward_median_N": 25, "push_backward_median_N": 50},
        **{"push_left_median_N": 10, "push_right_median_N": 400},
    }


def test_walking_figures_take_the_worst_survival():
    physics = points(falls=lambda start, velocity, t, scenario: (start == 1) & (t > 1.0))
    result = run_trials(Still(), physics, Still().start(physics, np.zeros(2)), [Trial(k, 10.0) for k in (0, 1)])
    rows = {row.quantity: row for row in suites.walking_metrics(result, "_60s")}
    assert rows["survived_s_60s"] == ("survived_s_60s", pytest.approx(1.024), "s", 2)
    assert {"speed_mps_60s", "pelvis_height_m_60s", "power_w_60s", "drift_m_60s"} < rows.keys()


def test_mjx_gives_the_verdicts_of_mujoco_c():
    """Where they are clear: undisturbed, a light and a hopeless push, delays of 1 and 20 ms."""
    agent = make_agent("1x")
    cells = [
        Trial(0, 1.6),
        Trial(1, 1.6, pushes=(Push(0.0, 20.0),)),
        Trial(1, 1.6, pushes=(Push(0.0, 400.0),)),
        Trial(0, 1.6, delay=2),
        Trial(0, 1.6, delay=40),
    ]
    results = {}
    for engine in ENGINES:
        setting = EvalSetup(engine)
        starts = setting.starts(agent, np.array([0.0, 0.5]), suites.LONGEST_DELAY_S)
        results[engine] = run_trials(agent, setting.physics(longest_delay_s=suites.LONGEST_DELAY_S), starts, cells)
    native, mjx = results["native"], results["mjx"]
    np.testing.assert_array_equal(native.fell, [False, False, True, False, True])
    np.testing.assert_array_equal(mjx.fell, native.fell)
    np.testing.assert_allclose(mjx.distance_m[~native.fell], native.distance_m[~native.fell], atol=0.05)
    np.testing.assert_allclose(mjx.power_w[~native.fell], native.power_w[~native.fell], rtol=0.05)
    np.testing.assert_allclose(mjx.survived_s, native.survived_s, atol=0.1)
