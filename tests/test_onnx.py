"""A policy as an ONNX file: ONNX Runtime acts as NumPy does, and the metadata is all that a robot needs besides."""

import json
import sys

import mujoco
import numpy as np
import pytest

from cassie_mjx import export as export_command
from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.onnx_file import save_onnx
from cassie_mjx.agents.shipped import load_policy, shipped_policies
from cassie_mjx.control.observation import Seen
from cassie_mjx.export import ExportConfig
from cassie_mjx.motion.reference import sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import xml_path

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


def export(name, folder):
    out = folder / f"{name}.onnx"
    export_command.main(ExportConfig(policy=name, out=str(out)))
    return out


def opened(path):
    session = onnxruntime.InferenceSession(str(path))
    return session, session.get_modelmeta().custom_metadata_map


def acted(session, observation):
    return session.run(["action"], {"observation": np.asarray(observation, np.float32)})[0]


@pytest.fixture(scope="module")
def scene():
    return mujoco.MjModel.from_xml_path(str(xml_path("flat")))


def walk(model, policy, steps):
    """What a policy observes on a walk, [steps, O], each step by its own action."""
    controller, data = Controller(policy, None), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = controller.initial_state(data.qpos, data.qvel)
    substeps = round(cassie.CONTROL_PERIOD_S / model.opt.timestep)
    for k in range(steps):
        seen = Seen(data.qpos[None], data.qvel[None], *sample(controller.motion, np.array([k + 1])))
        yield controller.law.observation.update(controller.law.init(seen), seen)[0][0]
        targets = controller(data.qpos, data.qvel)
        for _ in range(substeps):
            data.ctrl[:] = controller.torque(targets, data.qpos, data.qvel) / model.actuator_gear[:, 0]
            mujoco.mj_step(model, data)


@pytest.mark.parametrize("name", sorted(shipped_policies()))
def test_onnx_runtime_acts_as_numpy_does_all_along_a_walk(name, scene, tmp_path):
    policy, (session, _) = load_policy(name), opened(export(name, tmp_path))
    observed = np.array(list(walk(scene, policy, 300)))
    # The height of the pelvis, m, or w of its quaternion where it is not told that.
    upright = 0 if name == "1x-sensors" else 1
    assert observed[-1, upright] > 0.8, "it walks to the end"
    expected = policy(observed)
    assert np.abs(acted(session, observed) - expected).max() < 1e-5
    assert np.abs(acted(session, observed[7:8]) - expected[7:8]).max() < 1e-5
    if policy.mirror:
        second = policy.mirror.second_step(observed)
        assert 100 < second.sum() < 200


def test_far_inputs_are_bounded_and_nan_is_not_hidden(tmp_path):
    policy, (session, _) = load_policy("1x-robust"), opened(export("1x-robust", tmp_path))
    seen = np.tile(policy.mean, (3, 1))
    seen[0], seen[1, 5], seen[2, 3] = 1e6, np.inf, np.nan
    np.testing.assert_allclose(acted(session, seen), policy(seen), atol=1e-5)
    assert np.isnan(acted(session, seen)[2]).all()


def test_the_metadata_walks_without_a_file_of_ours(scene, tmp_path):
    """Targets from ONNX Runtime and the metadata alone are those of `Controller`."""
    session, about = opened(export("1x-robust", tmp_path))
    policy, controller = load_policy("1x-robust"), Controller.load("1x-robust", scene)
    columns = [int(number) for number in about["reference_joint_columns"].split(",")]
    qpos = np.array(json.loads(about["reference_qpos"]))
    for k, seen in enumerate(walk(scene, policy, 30)):
        action = acted(session, seen[None])[0]
        target = qpos[(k + 1) % len(qpos), columns] + action
        robot_qpos, robot_qvel = np.zeros(35), np.zeros(32)
        robot_qpos[cassie.PELVIS_QUATERNION] = seen[2:6]
        robot_qpos[[cassie.PELVIS_Y, cassie.PELVIS_Z]] = seen[:2]
        robot_qvel[:6] = seen[6:12]
        sensed = next(line for line in json.loads(about["observation"]) if line.startswith("12:"))
        names = sensed.partition(": ")[2].partition(" [")[0].split(", ")
        robot_qpos[cassie.qpos_index(*names)], robot_qvel[cassie.qvel_index(*names)] = seen[12:26], seen[26:40]
        np.testing.assert_allclose(controller(robot_qpos, robot_qvel), target, atol=1e-5)


def test_the_metadata_has_mjlabs_keys_and_every_digit(tmp_path):
    policy, (_, about) = load_policy("1x-robust"), opened(export("1x-robust", tmp_path))
    mjlabs = "run_path joint_names joint_stiffness joint_damping default_joint_pos command_names observation_names"
    assert {*mjlabs.split(), "action_scale"} <= about.keys()
    assert tuple(about["joint_names"].split(",")) == policy.joints
    numbers = {key: np.array(about[key].split(","), float) for key in ("joint_stiffness", "joint_damping")}
    np.testing.assert_array_equal(numbers["joint_stiffness"], policy.p_gain)
    np.testing.assert_array_equal(numbers["joint_damping"], policy.d_gain)
    np.testing.assert_array_equal(json.loads(about["reference_qpos"]), policy.reference_qpos)
    np.testing.assert_array_equal(json.loads(about["reference_qvel"]), policy.reference_qvel)
    start = policy.reference_qpos[0, cassie.ACTIVE_QPOS]
    np.testing.assert_array_equal(np.array(about["default_joint_pos"].split(","), float), start)
    assert float(about["reference_stride_length"]) == policy.reference_stride_length
    assert float(about["control_period_s"]) == 0.032
    assert json.loads(about["observation"]) == list(policy.observation)
    assert len(about["observation_names"].split(",")) == len(policy.observation)
    assert json.loads(about["provenance"]) == policy.provenance
    assert sum(joint["qpos"] for joint in json.loads(about["reference_joints"])) == cassie.NQ


def test_the_model_is_one_that_old_runtimes_read(tmp_path):
    path = export("1x", tmp_path)
    model, session = onnx.load(path), opened(path)[0]
    (taken,), (given,) = session.get_inputs(), session.get_outputs()
    assert (taken.name, taken.type, taken.shape) == ("observation", "tensor(float)", ["batch", 80])
    assert (given.name, given.type, given.shape) == ("action", "tensor(float)", ["batch", 10])
    onnx.checker.check_model(model, full_check=True)
    assert (model.ir_version, model.opset_import[0].version) == (8, 17)
    assert (model.producer_name, model.domain) == ("cassie-mjx", "")


def test_a_shipped_policy_is_exported_as_npz_too(tmp_path):
    export_command.main(ExportConfig(policy="2x", out=str(tmp_path / "mine.npz")))
    assert NumpyPolicy.load(tmp_path / "mine.npz").speed == 2.0


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({}, "Either run or policy must be given, as in run=runs/1x-seed0 or policy=1x."),
        ({"run": "a", "policy": "1x"}, "Either run or policy must be given"),
        (
            {"policy": "1x", "which": "last"},
            "which=last is for a run's directory; give run=DIRECTORY, or leave which out.",
        ),
        ({"policy": "1x", "out": "a.pt"}, "out=a.pt is no policy's file; name one that ends in .npz or .onnx."),
        ({"policy": "9x"}, "policy=9x is none of 0x, 1x"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, given, sentence):
    with pytest.raises(ValueError, match=sentence):
        export_command.main(ExportConfig(**{"out": str(tmp_path / "a.onnx"), **given}))
    assert not list(tmp_path.iterdir())


def test_without_onnx_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"needs the package onnx; pip install 'cassie-mjx\[onnx\]'.$"):
        save_onnx(tmp_path / "a.onnx", load_policy("1x"), "1x")
    assert not list(tmp_path.iterdir())
