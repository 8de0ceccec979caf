"""A recurrent policy at work: trained, resumed, saved and blended, and the same on JAX, NumPy and ONNX Runtime."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from seeing import SENSORS, assert_controller_acts_as_agent, lived, save_sensing_policy, sensed_by_steps
from tiny import TINY, halt_after_one, session

from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.make import make_agent, make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.onnx_file import save_onnx
from cassie_mjx.agents.policy_file import learner_policy
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.law import second_step
from cassie_mjx.files import archive
from cassie_mjx.ppo import networks
from cassie_mjx.robot import cassie

RECURRENT = replace(TINY, network="gru", num_steps=4)


def saved(path, seed, speed=1.0):
    """Write a recurrent policy of random weights and biases."""
    save_sensing_policy(path, seed, speed, bias=0.1, network="gru", hidden_sizes=(24, 16))
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("policy") / "gru.npz", 0)


def test_numpy_acts_as_jax_does_for_300_steps(path):
    assert 100 < second_step(lived(300)[2]).sum() < 200, "in both steps of the stride"
    ours, theirs = assert_controller_acts_as_agent(path)
    np.testing.assert_allclose(ours.law.hidden, theirs.law.hidden, atol=1e-5)


def test_its_targets_depend_on_what_it_saw_longer_ago_than_its_observation(path):
    qpos, qvel, *_ = lived(9)
    targets = []
    for first in (qpos[0], qpos[0] + 0.1):
        controller = Controller.load(path)
        controller(first, qvel[0])
        targets.append([controller(qpos[k], qvel[k]) for k in range(1, 9)])
        controller.reset()
        targets[-1].append(controller(qpos[0], qvel[0]))
    *later, anew = [np.abs(a - b).max() for a, b in zip(*targets, strict=True)]
    # An observation has four steps.
    assert min(later[4:]) > 1e-6
    assert anew == 0, "a walk that begins anew knows nothing of the last"


def test_a_symmetric_policy_stays_symmetric(path):
    """Robots half a stride on, as in a mirror, are given the targets as in a mirror: 11 of 22 samples."""
    agent, (qpos, qvel, *_) = make_policy_agent(str(path)), lived(40)
    images = cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel)
    first = agent.init(Sensed(qpos[:1], qvel[:1]), np.array([0], np.int32))
    other = agent.init(Sensed(images[0][:1], images[1][:1]), np.array([11], np.int32))
    for k in range(40):
        ours, first = agent.step(first, Sensed(qpos[k : k + 1], qvel[k : k + 1]), None)
        theirs, other = agent.step(other, Sensed(images[0][k : k + 1], images[1][k : k + 1]), None)
        np.testing.assert_allclose(cassie.mirror_active(np.asarray(theirs)), ours, atol=1e-5)
        np.testing.assert_allclose(other.law.hidden, first.law.hidden, atol=1e-5)


def test_onnx_runtime_acts_as_numpy_does(path, tmp_path):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    policy = NumpyPolicy.load(path)
    save_onnx(tmp_path / "gru.onnx", policy, "gru")
    opened = runtime.InferenceSession(str(tmp_path / "gru.onnx"))
    assert [(taken.name, taken.shape) for taken in opened.get_inputs()] == [
        ("observation", ["batch", SENSORS.size]),
        ("hidden", ["batch", 24]),
    ]
    # Two robots, one of which began 10 steps ago.
    seen, hidden = sensed_by_steps(300), policy.start(2)
    _, hidden[1] = policy.step(seen[0], hidden[1])
    ours = theirs = hidden
    for k in range(290):
        given = seen[[k, k + 10]]
        expected, ours = policy.step(given, ours)
        action, theirs = opened.run(["action", "next_hidden"], {"observation": given, "hidden": theirs})
        np.testing.assert_allclose(action, expected, atol=1e-5)
        np.testing.assert_allclose(theirs, ours, atol=1e-5)
    assert "next_hidden" in opened.get_modelmeta().custom_metadata_map["usage"]


def test_the_learner_gets_the_same_policy_back(path):
    policy, seen = NumpyPolicy.load(path), sensed_by_steps(20)
    back, hidden, carried = learner_policy(policy), policy.start(1)[0], jnp.zeros(24)
    plain = replace(policy, mirror=None)
    for observation in seen:
        expected, hidden = plain.step(observation, hidden)
        action, carried = networks.mode(back, jnp.asarray(observation), carried)
        np.testing.assert_allclose(action, expected, atol=1e-5)


def test_the_file_says_what_it_is_and_a_call_without_memory_is_refused(path):
    policy = NumpyPolicy.load(path)
    with np.load(path, allow_pickle=False) as content:
        assert content["network"] == policy.kind == "GRU, perceptron, ReLU"
    with pytest.raises(ValueError, match=r"^hidden of shape \(1, 24\) was given; this observation takes \(24,\)\.$"):
        policy.step(np.zeros(SENSORS.size), policy.start(1))
    with pytest.raises(ValueError, match=r"^The policy is recurrent; call policy\.step\(observation, hidden\)"):
        policy(np.zeros(SENSORS.size))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"gru_bias": np.zeros(71)}, r"gru_bias has shape \(71,\) instead of \(72,\)"),
        ({"gru_recurrent": np.zeros((24, 48))}, r"gru_recurrent has shape \(24, 48\) instead of \(24, 72\)"),
        ({"weight_0": np.zeros((23, 16))}, r"weight_0 has shape \(23, 16\) instead of \(24, 16\)"),
        ({"gru_kernel": None}, "is damaged: gru_kernel missing or too much"),
        (
            {"network": "perceptron, ReLU"},
            "gru_bias, gru_kernel, gru_recurrent, gru_recurrent_bias missing or too much",
        ),
        ({"gru_recurrent_bias": np.full(24, np.nan)}, "gru_recurrent_bias holds NaN or infinity"),
    ],
)
def test_parts_that_do_not_fit_are_refused(path, tmp_path, change, sentence):
    found = archive.read(path, "cassie-mjx policy")
    arrays = {name: array for name, array in (found.arrays | change).items() if array is not None}
    archive.write(tmp_path / "other.npz", "cassie-mjx policy", arrays, {})
    with pytest.raises(ValueError, match=sentence):
        NumpyPolicy.load(tmp_path / "other.npz")


def test_each_policy_of_a_blend_remembers_for_itself(path, tmp_path):
    """At the start of the ramp a blend acts as its first policy; the second one remembers what it has seen itself."""
    other = saved(tmp_path / "2x.npz", 1, 2.0)
    blend = make_agent(f"blend:{path},{other}", schedule="ramp")
    alone, (qpos, qvel, *_) = make_policy_agent(str(path)), lived(12)
    carry, own = blend.init(Sensed(qpos[:1], qvel[:1])), alone.init(Sensed(qpos[:1], qvel[:1]))
    for k in range(12):
        sensed = Sensed(qpos[k : k + 1], qvel[k : k + 1])
        carry, (_, own) = blend.step(carry, sensed, None)[1], alone.step(own, sensed, None)
    np.testing.assert_allclose(carry.laws[0].hidden, own.law.hidden, atol=1e-5)
    assert np.abs(carry.laws[1].hidden - own.law.hidden).max() > 0.1
    first, second = blend.take_over(own).laws
    np.testing.assert_array_equal(first.hidden, own.law.hidden)
    np.testing.assert_array_equal(second.hidden, np.zeros((1, 24)))
    np.testing.assert_array_equal(second.sensing, own.law.sensing)


def test_a_run_resumes_exactly_with_what_it_carries(tmp_path):
    whole = session(tmp_path / "whole", ppo=RECURRENT)
    whole.train()
    halt_after_one(tmp_path / "halted", ppo=RECURRENT)
    resumed = session(tmp_path / "halted", ppo=RECURRENT, resume=True)
    assert resumed.done == 1
    assert np.abs(resumed.run.hidden).max() > 0.01, "robots in the middle of episodes"
    resumed.train()
    for a, b in zip(jax.tree.leaves(whole.run), jax.tree.leaves(resumed.run), strict=True):
        np.testing.assert_array_equal(a, b)
    assert json.loads((tmp_path / "whole" / "config.json").read_text())["config"]["ppo.network"] == "gru"

    begun = session(tmp_path / "again", ppo=RECURRENT, init=str(tmp_path / "whole"), seed=5)
    actor, loaded = begun.run.learner.policy.actor, NumpyPolicy.load(tmp_path / "whole" / "best.npz")
    assert loaded.gru
    np.testing.assert_array_equal(actor["gru"]["recurrent"], loaded.gru.recurrent)
    run = begun.trainer.gather_statistics(begun.run)
    seen, hidden = jnp.asarray(loaded.mean + 0.5 * loaded.std), jnp.asarray(loaded.gru.recurrent_bias)
    ours, theirs = (networks.mode(policy, seen, hidden)[0] for policy in (run.learner.policy, begun.run.learner.policy))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    with pytest.raises(ValueError, match=r"^init=.* is a GRU, perceptron, ReLU; set ppo\.network=gru\.$"):
        session(tmp_path / "other", init=str(tmp_path / "whole"))
    assert not (tmp_path / "other").exists()
