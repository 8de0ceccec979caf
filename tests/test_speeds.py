"""The experiments on speed: what a ride's figures mean, the profile, and robots that follow it."""

import json
import shutil

import numpy as np
import pytest

from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.control.step import policy_step
from cassie_mjx.evaluation.setup import SuiteResult
from experiments import interpolation, speeds, studies
from experiments.interpolation import InterpolationConfig, Ride, draw
from experiments.speeds import SpeedsConfig, follow, profile


def test_speeds_are_means_over_a_stride():
    # Commanded 1 m/s, then 2 m/s; robot 0 goes at 1 m/s throughout, robot 1 as commanded until it falls.
    dt = 0.032
    commanded = np.cumsum([0, *[1 * dt] * 4, *[2 * dt] * 4])
    x = np.stack([dt * np.arange(9), commanded], axis=1)
    ride = Ride.of(list(commanded), list(x), np.array([False, True]), stride=4)
    np.testing.assert_allclose(ride.time_s, dt * np.arange(4, 9))
    np.testing.assert_allclose(ride.commanded_mps, [1, 1.25, 1.5, 1.75, 2])
    np.testing.assert_allclose(ride.measured_mps, [[1] * 5, [1, 1.25, 1.5, 1.75, 2]])
    rows = {row["quantity"]: (row["value"], row["n"]) for row in ride.rows("x")}
    assert rows == {
        "starts_up": (1, 2),
        "speed_error_rms_mps": (pytest.approx(np.sqrt((0 + 1 + 4 + 9 + 16) / 16 / 5)), 2),
        "lowest_speed_mps": (pytest.approx(1), 2),
        "highest_speed_mps": (pytest.approx(1), 2),
    }
    assert ride.curve() == {
        **{"time_s": [0.128, 0.256], "commanded_mps": [1, 2]},
        **{"mean_mps": [1, 1], "least_mps": [1, 1], "greatest_mps": [1, 1]},
    }


def test_a_ride_on_which_all_fall_has_no_speeds():
    ride = Ride.of([0.0] * 6, [np.zeros(2)] * 6, np.array([True, True]), stride=4)
    assert [row["quantity"] for row in ride.rows("x")] == ["starts_up"]
    assert ride.rows("x")[0]["value"] == 0
    assert ride.curve().keys() == {"time_s", "commanded_mps"}
    assert draw({"all fall": ride}).axes[0].get_title() == "all fall\n0 of 2 up"


STOOD = Ride.of([0.0] * 6, [np.zeros(2)] * 6, np.array([False, False]), stride=4)


def test_the_file_says_which_policies_kept_their_speeds(tmp_path, monkeypatch):
    shipped = shipped_policies()["1x"]
    free = str(shutil.copy(shipped, tmp_path / "any.npz"))
    monkeypatch.setattr(speeds, "keep", lambda policy: [{"quantity": "speed_mps", "value": 1}])
    monkeypatch.setattr(speeds, "follow", lambda policy, factors: STOOD)
    monkeypatch.setattr(speeds, "COMMANDS", [0.5, 2.0])
    speeds.main(SpeedsConfig(("1x",), free, profile_seed=3, out=str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    walked = dict.fromkeys(row["agent"] for row in content["rows"])
    assert list(walked) == [f"{free} profile", "1x", f"{free} speed=0.5x", f"{free} speed=2x"]
    policy = NumpyPolicy.load(shipped)
    assert content["provenance"]["agent"] == {"1x": policy.provenance, free: policy.provenance}
    assert content["provenance"]["profile_seed"] == 3


@pytest.mark.parametrize(("policy", "study"), [("1x", "walking"), ("4x", "learning_speeds")])
def test_a_run_that_is_not_there_is_asked_of_its_study(tmp_path, policy, study):
    config = SpeedsConfig((policy,), None, runs=str(tmp_path), training_seeds=(1,), out=str(tmp_path / "a.json"))
    with pytest.raises(ValueError, match=rf"no run {tmp_path}/{policy}-seed1; make it with .* study={study} runs="):
        speeds.main(config)


def test_the_policies_of_training_runs_are_measured_under_name_and_seed(tmp_path, monkeypatch):
    for seed in (0, 4):
        run = tmp_path / f"1x-seed{seed}"
        run.mkdir()
        shutil.copy(shipped_policies()["1x"], run / "best.npz")
        held = studies.expected(studies.DEFAULT, seed, tmp_path)
        (run / "checkpoints" / f"step_{held['ppo.iterations']:06}").mkdir(parents=True)
        (run / "config.json").write_text(json.dumps({"config": held}))
    monkeypatch.setattr(speeds, "keep", lambda policy: [{"quantity": "speed_mps", "value": 1}])
    config = SpeedsConfig(("1x",), None, str(tmp_path), (0, 4), out=str(tmp_path / "a.json"))
    speeds.main(config)
    content = json.loads((tmp_path / "a.json").read_text())
    assert [(row["agent"], row["seed"]) for row in content["rows"]] == [("1x", 0), ("1x", 4)]
    assert list(content["provenance"]["agent"]) == [f"{tmp_path}/1x-seed0", f"{tmp_path}/1x-seed4"]

    (tmp_path / "1x-seed4" / "config.json").write_text(json.dumps({"config": held | {"walk.reward": "plain"}}))
    with pytest.raises(ValueError, match="1x-seed4 was trained with walk.reward=plain, unlike 1x"):
        speeds.main(config)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"policies": (), "any_speed": None}, "policies and any_speed are empty"),
        ({"runs": "runs", "training_seeds": ()}, "training_seeds is empty"),
        ({"runs": "runs", "policies": ("1x", "5x")}, "policies=5x: runs has 1x, 0x, 2x, 3x, 4x"),
    ],
)
def test_nothing_to_measure_is_said_at_once(arguments, why):
    with pytest.raises(ValueError, match=why):
        SpeedsConfig(**arguments)


def test_the_file_says_which_policies_were_blended(tmp_path, monkeypatch):
    monkeypatch.setattr(interpolation, "ride", lambda blend: STOOD)
    out, plot = tmp_path / "a.json", tmp_path / "a.png"
    for path in (out, plot):
        path.symlink_to(f"{path.stem} {path.suffix[1:]} without a suffix")
    policies = ("1x", "1x", "1x", "1x", "1x")
    interpolation.main(InterpolationConfig(policies, terrain=False, out=str(out), plot=str(plot)))
    assert out.is_symlink()
    assert plot.read_bytes().startswith(b"\x89PNG")
    content = json.loads((tmp_path / "a.json").read_text())
    assert list(content["rides"]) == ["blend:1x,1x schedule=ramp", "blend:1x,1x,1x,1x,1x schedule=ramp"]
    policy = NumpyPolicy.load(shipped_policies()["1x"])
    assert content["provenance"]["agent"] == {"1x": policy.provenance}


def test_a_policy_keeps_the_speed_of_its_own_motion(monkeypatch):
    monkeypatch.setattr(speeds.suites, "walk", lambda policy, setup: SuiteResult([]))
    (commanded,) = speeds.keep(make_policy_agent("2x"))
    # Two strides of 0.5 m in 0.704 s.
    assert commanded["quantity"] == "commanded_mps"
    assert commanded["value"] == pytest.approx(1.0 / 0.704, rel=1e-3)


def test_the_profile_jumps_every_two_seconds_for_a_minute():
    factors = profile(0)
    assert len(factors) == 1875
    changes = np.flatnonzero(np.diff(factors)) + 1
    # The first control step that begins at 2 s or later is the 63rd, at 2.016 s.
    np.testing.assert_array_equal(changes, np.ceil(np.arange(2, 60, 2) / 0.032 - 1e-9))
    assert factors.min() >= 0
    assert 3 < factors.max() <= 4
    np.testing.assert_array_equal(factors, profile(0))


def test_the_reference_moves_to_the_speed_commanded():
    """A policy that asks for the reference angles alone, and is told to walk three times as fast after 20 steps."""
    shipped = make_policy_agent("1x")
    layers = tuple((0 * np.asarray(w), 0 * np.asarray(b)) for w, b in shipped.network.layers)
    told = []

    def step(network, carry, qpos, qvel, command):
        told.append(np.asarray(command.forward))
        return policy_step(shipped.law, shipped.motion, network, carry, qpos, qvel, command)

    agent = PolicyAgent("still", shipped.law, shipped.motion, shipped.network._replace(layers=layers), step=step)
    ride = follow(agent, np.repeat([1.0, 3.0], 20), starts=2)
    assert ride.fell.all(), "the reference angles alone do not walk"
    commanded = 0.5001 / 0.704
    # From the 21st step on, the speed rises by 0.02 a step: 0.625 a second.
    first, last = 20 + 1.02 + 1.04, 2 + np.arange(1.02, 1.41, 0.02).sum()
    np.testing.assert_allclose(ride.commanded_mps[[0, -1]] / commanded, [first / 22, last / 22], rtol=1e-3)
    factors = np.append(np.ones(20), 1 + 0.02 * np.arange(1, 21))
    np.testing.assert_allclose(told, commanded * np.stack([factors, factors], axis=1), rtol=1e-3)
