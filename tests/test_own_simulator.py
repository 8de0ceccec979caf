"""`Controller`: a policy in plain MuJoCo, in another MJCF of the robot, and beside the agent that is evaluated."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.agents.types import Sensed
from cassie_mjx.motion.reference import sample
from cassie_mjx.robot.model import xml_path


def walk(controller, model, seconds):
    """Height and way of the pelvis after `seconds`, in a loop of a user's own."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = controller.initial_state(data.qpos, data.qvel)
    joints = controller.joints
    while data.time < seconds:
        targets = controller.step(data.time, data.qpos, data.qvel)
        torque = controller.torque(targets, data.qpos, data.qvel)
        data.ctrl[joints.motors] = torque / model.actuator_gear[joints.motors, 0]
        mujoco.mj_step(model, data)
    return data.body("cassie-pelvis").xpos[[2, 0]]


def give_root(spec, *kinds):
    """Joints of these kinds for the pelvis, in this order; of slides there are three."""
    for key in list(spec.keys):
        spec.delete(key)
    pelvis = spec.body("cassie-pelvis")
    spec.delete(pelvis.joints[0])
    for kind in kinds:
        for name, axis in (
            zip("xyz", np.eye(3), strict=True) if kind == mujoco.mjtJoint.mjJNT_SLIDE else [("turn", [0, 0, 1])]
        ):
            pelvis.add_joint(name=f"pelvis-{name}", type=kind, axis=axis)


def test_a_walk_begins_anew_by_reset_alone():
    controller = Controller.load("1x")
    qpos, qvel = controller.motion.qpos[0], controller.motion.qvel[0]
    first = controller.step(0.0, qpos, qvel)
    held = controller.step(0.01, qpos, qvel)
    held += 1.0
    np.testing.assert_array_equal(controller.step(0.02, qpos, qvel), first)
    with pytest.raises(ValueError, match=r"The time went back from 0.02 to 0 s; call reset\(\)"):
        controller.step(0.0, qpos, qvel)
    controller.reset()
    np.testing.assert_array_equal(controller.step(0.0, qpos, qvel), first)


@pytest.fixture(scope="module")
def scene():
    return mujoco.MjModel.from_xml_path(str(xml_path("flat")))


@pytest.fixture(scope="module")
def other_root():
    """Another MJCF of the robot: three slides and a ball for its root, and a swinging body before it."""
    spec = mujoco.MjSpec.from_file(str(xml_path("flat")))
    give_root(spec, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_BALL)
    bell = spec.worldbody.add_body(name="bell", pos=[0, 5, 2])
    bell.add_joint(name="swing", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1, 0, 0])
    bell.add_geom(size=[0.1, 0, 0], pos=[0, 0, -0.5])
    return spec.compile()


@pytest.mark.parametrize("name", sorted(shipped_policies()))
def test_every_policy_that_we_ship_walks_in_plain_mujoco(scene, name):
    height, way = walk(Controller.load(name, scene), scene, 3.0)
    assert 0.85 < height < 1.05
    speed = {"0x": 0.0, "2x": 1.42, "3x": 2.13, "4x": 2.84}.get(name, 0.71)
    assert way == pytest.approx(3 * speed, abs=0.25)


def test_another_root_and_another_order_make_no_difference(scene, other_root):
    controller = Controller.load("1x", other_root)
    assert controller.joints.qpos[:7].tolist() != list(range(7)) or other_root.nq == scene.nq + 1
    height, way = walk(controller, other_root, 3.0)
    assert 0.85 < height < 1.05
    assert way == pytest.approx(3 * 0.71, abs=0.25)


def test_slides_count_from_where_the_pelvis_stands_in_the_file(scene):
    """The published MJCF has its pelvis at a height of 1.01 m, and its slides at 0 there."""
    raised = mujoco.MjSpec.from_file(str(xml_path("flat")))
    give_root(raised, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_BALL)
    raised.joint("pelvis-z").ref = 0.3
    model = raised.compile()
    controller, usual = Controller.load("1x", model), Controller.load("1x", scene)
    np.testing.assert_allclose(controller.joints.origin, [0, 0, 0.71])
    qpos, qvel = controller.initial_state(np.zeros(35), np.zeros(32))
    same, same_v = usual.initial_state(np.zeros(35), np.zeros(32))
    assert qpos[2] == pytest.approx(same[2] - 0.71)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    assert data.body("cassie-pelvis").xpos[2] == pytest.approx(same[2])
    np.testing.assert_allclose(controller(qpos, qvel), usual(same, same_v), atol=1e-6)


@pytest.mark.parametrize(
    ("kinds", "found"), [(("BALL", "SLIDE"), "ball, slide, slide, slide"), (("SLIDE",), "slide, slide, slide")]
)
def test_a_root_of_another_kind_is_refused(kinds, found):
    spec = mujoco.MjSpec.from_file(str(xml_path("flat")))
    give_root(spec, *(getattr(mujoco.mjtJoint, f"mjJNT_{kind}") for kind in kinds))
    with pytest.raises(ValueError, match=f"three slides along x, y, z and then a ball; it has {found}."):
        Controller.load("1x", spec.compile())


def test_a_joint_without_an_actuator_is_named_when_motors_are_asked_for():
    spec = mujoco.MjSpec.from_file(str(xml_path("flat")))
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for actuator in list(spec.actuators)[1:]:
        spec.delete(actuator)
    controller = Controller.load("1x", spec.compile())
    controller(*controller.initial_state(np.zeros(35), np.zeros(32)))
    with pytest.raises(ValueError, match="no actuator on left-hip-yaw, .*right-foot; it has them on left-hip-roll."):
        _ = controller.joints.motors


def test_its_targets_are_the_agents(scene):
    controller, agent = Controller.load("1x-robust"), make_policy_agent("1x-robust")
    qpos, qvel = (np.array(x, float) for x in sample(agent.motion, np.arange(3)))
    carry = agent.init(Sensed(qpos[:1], qvel[:1]))
    for k in range(3):
        expected, carry = agent.step(carry, Sensed(qpos[k : k + 1], qvel[k : k + 1]), None)
        np.testing.assert_allclose(controller(qpos[k], qvel[k]), np.asarray(expected)[0], atol=1e-5)


def test_targets_are_held_for_32_ms_at_any_rate(scene):
    controller = Controller.load("1x")
    qpos, qvel = controller.initial_state(np.zeros(35), np.zeros(32))
    seen = [controller.step(0.7 + k * 0.002, qpos, qvel + 0.001 * k).copy() for k in range(33)]
    changes = [k for k in range(1, 33) if not np.array_equal(seen[k], seen[k - 1])]
    assert changes == [16, 32]


def test_a_command_stretches_the_reference(scene):
    slow, fast = Controller.load("any"), Controller.load("any")
    qpos, qvel = slow.initial_state(np.zeros(35), np.zeros(32))
    assert np.abs(slow(qpos, qvel, command=0.3) - fast(qpos, qvel, command=2.0)).max() > 1e-3
    own = 0.5001 / 0.704
    np.testing.assert_allclose(
        Controller.load("any")(qpos, qvel, command=own), Controller.load("any")(qpos, qvel), atol=1e-4
    )


def test_a_full_turn_changes_nothing():
    one, other = Controller.load("1x"), Controller.load("1x")
    qpos, qvel = one.initial_state(np.zeros(35), np.zeros(32))
    turned = qpos.copy()
    turned[3:7] *= -1
    np.testing.assert_array_equal(one(qpos, qvel), other(turned, qvel))


def test_a_model_without_a_joint_is_refused():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=r"The model lacks the joints left-hip-roll, .*"):
        Controller.load("1x", spec.compile())


def test_it_imports_numpy_alone():
    program = """
import sys
import cassie_mjx
cassie_mjx.Controller.load("1x")
print(sorted({"jax", "flax", "mujoco", "brax", "orbax"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
