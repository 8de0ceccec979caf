"""The return by hand: an environment whose rewards and falls are written down."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.evaluation.returns import STARTS, walk_returns
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.types import Scenario


class Scripted:
    """Robot b earns 0.5 plain and 0.25 weighted a step and falls in steps b + 1 and b + 3; robot 0 never falls."""

    def __init__(self, robots, steps=8, early_end=None):
        self.phase = np.zeros(robots, int)
        self.robots, self.samples = robots, 22
        self.config = WalkConfig(min_reward=early_end, max_position_error_m=None, episode_steps=steps)

    def reset_at(self, phase, scenario):
        self.phase, self.steps, self.scenario = phase, 0, scenario
        return self._state()

    def step(self, state, action, key):
        assert action.shape == (self.robots, 10)
        self.steps += 1
        return self._state()

    def _state(self):
        robots = np.arange(self.robots)
        fallen = (robots > 0) & ((self.steps == robots + 1) | (self.steps == robots + 3))
        ones = np.ones(self.robots)
        metrics = {"plain": 0.5 * ones, "weighted": 0.25 * ones}
        return SimpleNamespace(observation=np.zeros((self.robots, 80)), metrics=metrics, terminated=fallen)


def scripted(robots, early_end=None) -> Any:
    return Scripted(robots, early_end=early_end)


def act(observation):
    return np.zeros((len(observation), 10))


def test_rewards_count_up_to_the_first_fall():
    # Robots 0, 1, 2 earn for 8, 2 and 3 steps, the last of which is the fall.
    returns = walk_returns(act, scripted(3))
    assert returns["return_plain"] == pytest.approx(0.5 * (8 + 2 + 3) / 3)
    assert returns["return_weighted"] == pytest.approx(0.25 * (8 + 2 + 3) / 3)
    assert returns["steps"] == pytest.approx((8 + 1 + 2) / 3)


def test_starts_are_tenths_of_the_stride():
    env = scripted(10)
    walk_returns(act, env)
    # round(2.2 k)
    assert env.phase.tolist() == [0, 2, 4, 7, 9, 11, 13, 15, 18, 20]


def test_a_disturbance_acts_from_the_start():
    env, late = scripted(3), replace(Scenario.nominal(3), delay=np.full(3, 10, np.int32))
    walk_returns(act, env, late)
    assert env.scenario is late
    walk_returns(act, env)
    assert not env.scenario.delay.any()


def test_early_ends_are_refused():
    with pytest.raises(ValueError, match="without early ends"):
        walk_returns(act, scripted(3, early_end=0.6))


def test_the_referee_is_mujoco_c_at_2_khz_and_a_limp_robot_falls_there():
    env = referee(load_motion("walk"))
    assert env.physics.model.opt.timestep == 1 / 2000
    assert (env.robots, env.config.episode_steps, env.config.ends_early) == (STARTS, 300, False)
    returns = walk_returns(lambda seen: np.full((len(seen), 10), [0, 0, 1, 1, 1] * 2), env)
    assert 1 < returns["steps"] < 60
    assert 0 < returns["return_weighted"] < returns["return_plain"] < returns["steps"] + 1
