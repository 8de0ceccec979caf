"""A policy that needs what Cassie senses alone, with a history of it: trained, resumed, and run on NumPy and ONNX."""

import json

import jax
import mujoco
import numpy as np
import pytest
from seeing import REMEMBERED, assert_controller_acts_as_agent, lived, save_sensing_policy, sensed_by_steps
from tiny import TINY, halt_after_one, session

from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.onnx_file import save_onnx
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import xml_path

TASK = {"ppo": TINY, "walk": WalkConfig(observation="sensors_history", electronics=True)}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "sensors.npz"
    save_sensing_policy(path, terms=REMEMBERED)
    return path


def test_numpy_acts_as_jax_does_with_its_memory(path):
    assert_controller_acts_as_agent(path)


def test_its_targets_depend_on_what_it_saw_before(path):
    qpos, qvel, *_ = lived(6)
    targets = []
    for first in (qpos[0], qpos[0] + 0.1):
        controller = Controller.load(path)
        controller(first, qvel[0])
        targets.append([controller(qpos[k], qvel[k]) for k in range(1, 6)])
    # The fourth step after it is the first that has forgotten it.
    assert [np.abs(a - b).max() > 1e-6 for a, b in zip(*targets, strict=True)] == [True] * 3 + [False] * 2


def test_neither_place_nor_velocity_of_the_pelvis_matters(path):
    qpos, qvel, *_ = lived(20)
    ours, theirs = Controller.load(path), Controller.load(path)
    nowhere = np.where(np.arange(cassie.NQ) < 3, 0.0, qpos), np.where(np.arange(cassie.NV) < 3, 0.0, qvel)
    for k in range(20):
        command = (0.8, 0.2, 0.4)
        np.testing.assert_array_equal(ours(qpos[k], qvel[k], command), theirs(nowhere[0][k], nowhere[1][k], command))


def test_onnx_runtime_acts_as_numpy_does(path, tmp_path):
    pytest.importorskip("onnx")
    runtime = pytest.importorskip("onnxruntime")
    policy = NumpyPolicy.load(path)
    save_onnx(tmp_path / "sensors.onnx", policy, "sensors")
    opened = runtime.InferenceSession(str(tmp_path / "sensors.onnx"))
    given = sensed_by_steps(300, REMEMBERED)
    (action,) = opened.run(["action"], {"observation": given})
    assert np.abs(action - policy(given)).max() < 1e-5
    described = json.loads(opened.get_modelmeta().custom_metadata_map["observation"])
    assert described[0] == "0:16 robot pelvis orientation (w, x, y, z), 4 control steps [1]"


def test_a_run_resumes_exactly_and_its_policy_walks(tmp_path):
    whole = session(tmp_path / "whole", **TASK)
    whole.train()
    halt_after_one(tmp_path / "halted", **TASK)
    resumed = session(tmp_path / "halted", resume=True, **TASK)
    assert resumed.done == 1
    resumed.train()
    for a, b in zip(jax.tree.leaves(whole.run), jax.tree.leaves(resumed.run), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.asarray(whole.run.env.sensing).shape == (TINY.num_robots, 3, 79)
    model = mujoco.MjModel.from_xml_path(str(xml_path("flat")))
    controller, data = Controller.load(tmp_path / "whole", model), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = controller.initial_state(data.qpos, data.qvel)
    targets = controller.step(0.0, data.qpos, data.qvel)
    np.testing.assert_allclose(targets, controller.motion.qpos[1, cassie.ACTIVE_QPOS], atol=0.1)
