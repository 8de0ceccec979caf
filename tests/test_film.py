"""Trials as films: the very trials that are measured, seen frame by frame."""

import numpy as np
import pytest
from acting import Swaying

from cassie_mjx.evaluation.film import film
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.trial import Push, Trial, placed
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot.ground import Terrain
from cassie_mjx.robot.model import ModelConfig, load_model

HILLS = Terrain("sine", 0.05)


@pytest.mark.parametrize(
    "disturbed",
    [{}, {"pushes": (Push(60.0, -20.0),)}, {"delay": 7}, {"terrain": HILLS}, {"terrain": HILLS, "delay": 3}],
)
def test_a_film_shows_the_trial_that_is_measured(disturbed):
    """Thirty control steps, filmed at 100 frames a second, end in the state that `run_trials` measures."""
    agent, trial = Swaying(), Trial(0, 0.96, **disturbed)
    physics = NativePhysics(load_model(ModelConfig(scene=trial.terrain.ground.scene)), trial.delay)
    starts = agent.start(physics, np.zeros(1))
    result = run_trials(agent, physics, starts, [trial])
    first, *_, last = film(agent, Trial(0, 0.97, **disturbed), fps=100)
    assert last.time_s == 0.96
    np.testing.assert_array_equal(first.qpos, placed(agent, starts, [trial]).physics.qpos[0])
    np.testing.assert_array_equal(last.qpos[:2] - first.qpos[:2], [result.distance_m[0], result.drift_m[0]])
    assert np.ptp([last.qpos[2], first.qpos[2]]) > 1e-5


@pytest.mark.parametrize("fps", [31.25, 24.0, 60.0])
def test_frames_come_at_their_times_whatever_the_rate(fps):
    """A robot at the same moment is in the same state at any rate; moments are whole steps of 0.5 ms."""
    every_step = list(film(Swaying(), Trial(0, 0.2), fps=2000))
    shots = list(film(Swaying(), Trial(0, 0.2), fps=fps))
    assert len(shots) == np.ceil(0.2 * fps)
    for k, shot in enumerate(shots):
        assert shot.time_s == k / fps
        np.testing.assert_array_equal(shot.qpos, every_step[round(2000 * k / fps)].qpos)


def test_a_push_acts_for_a_fifth_of_a_second_from_the_next_act_on():
    trial = Trial(0, 0.4, pushes=(Push(0.0, 80.0),))
    shots = list(film(Swaying(), trial, push_at=0.05, fps=1000))
    pushed = [shot.time_s for shot in shots if shot.push_w.any()]
    np.testing.assert_allclose([pushed[0], pushed[-1]], [0.064, 0.263])
    assert len(pushed) == 200
    np.testing.assert_allclose(shots[100].push_w, [0, 80, 0], atol=1)
    free = list(film(Swaying(), Trial(0, 0.4), push_at=0.05, fps=1000))
    np.testing.assert_array_equal(shots[64].qpos, free[64].qpos)
    assert not np.array_equal(shots[65].qpos, free[65].qpos)
    assert shots[300].qpos[1] > free[300].qpos[1] + 0.02


def test_the_film_goes_on_for_a_second_after_the_fall():
    *_, before, last = film(Swaying(hold=0.0), Trial(0, 9.0), fps=50)
    assert last.fell_s is not None
    assert 0.2 < last.fell_s < 2
    np.testing.assert_allclose(last.time_s - last.fell_s, 1.0)
    assert before.fell_s == last.fell_s
    fell = [shot for shot in film(Swaying(hold=0.0), Trial(0, 9.0), fps=50) if shot.fell_s is None]
    assert fell[-1].qpos[2] >= 0.6
    np.testing.assert_allclose(fell[-1].time_s, last.fell_s - 0.02)
