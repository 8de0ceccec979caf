"""Another MJCF of the robot as `load_model` takes it: what is the same mechanism, and what is missing or other."""

import mujoco
import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig, load_model, standing, xml_path


def slides_and_ball(spec, damping=0.0):
    """The root that the published MJCF has, its slides counted from where the pelvis stands in the file."""
    pelvis = spec.body("cassie-pelvis")
    spec.delete(pelvis.joints[0])
    for axis in np.eye(3):
        slide = pelvis.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        slide.damping = damping * np.ones(3)
    ball = pelvis.add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
    ball.damping = np.zeros(3)
    for key in spec.keys:
        qpos = np.array(key.qpos)
        qpos[:3] -= pelvis.pos
        key.qpos = qpos


def deleted(*groups):
    def change(spec):
        for group, name in groups:
            spec.delete(next(each for each in getattr(spec, group) if each.name == name))

    return change


def without_keys(spec):
    for key in list(spec.keys):
        spec.delete(key)


def load(tmp_path, *changes, **config):
    spec = mujoco.MjSpec.from_file(str(xml_path(config.get("scene", "flat"))))
    for change in changes:
        change(spec)
    path = tmp_path / "own.xml"
    path.write_text(spec.to_xml())
    return load_model(ModelConfig(**config), path)


def after_a_step(model):
    motion, physics = load_motion("walk"), NativePhysics(model)
    state = physics.init(motion.qpos[:2], motion.qvel[:2])
    return physics.advance(state, motion.qpos[1:3, cassie.ACTIVE_QPOS], Scenario.nominal(2), 64)


def renamed_root(spec):
    spec.joint("pelvis").name = "root"


@pytest.mark.parametrize("change", [slides_and_ball, renamed_root])
def test_another_root_is_the_same_robot(tmp_path, change):
    # A written file has six digits.
    ours, theirs = load(tmp_path), load(tmp_path, change)
    assert [theirs.joint(i).name for i in range(theirs.njnt)] == [name for name, *_ in cassie.JOINTS]
    np.testing.assert_allclose(standing(theirs), standing(ours), atol=1e-6)
    ours, theirs = after_a_step(ours), after_a_step(theirs)
    np.testing.assert_allclose(theirs.qpos, ours.qpos, atol=1e-9)
    np.testing.assert_allclose(theirs.qvel, ours.qvel, atol=1e-6)


def test_an_own_file_may_have_other_figures_and_no_keyframe(tmp_path):
    def heavier(spec):
        spec.body("cassie-pelvis").mass = 12.0
        spec.option.timestep = 0.002

    own = load(tmp_path, heavier, without_keys)
    assert own.body("cassie-pelvis").mass == 12.0
    assert own.opt.timestep == 0.0005
    with pytest.raises(ValueError, match='has no keyframe "standing"; it has none'):
        standing(own)


def bell(spec):
    body = spec.worldbody.add_body(name="bell", pos=[0, 5, 2], mass=1.0, inertia=[1, 1, 1])
    body.add_joint(name="swing", axis=[1, 0, 0])


def servos(spec):
    for actuator in spec.actuators:
        actuator.set_to_position(kp=100)


def weaker(spec):
    spec.actuator("left-knee").ctrlrange = [-5, 5]


def geared(spec):
    for actuator in spec.actuators:
        actuator.gear = [1, 0, 0, 0, 0, 0]
        actuator.ctrlrange = [-300, 300]


def crossed(spec):
    spec.actuator("left-knee").target = "right-knee"
    spec.actuator("right-knee").target = "left-knee"


def other_order(spec):
    first = spec.actuators[0]
    spec.delete(first)
    last = spec.add_actuator(name="left-hip-roll", target="left-hip-roll", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    last.gear = [25, 0, 0, 0, 0, 0]


def nameless_geoms(spec):
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in spec.geoms:
        geom.name = ""


def of_geoms(spec):
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE


def no_sensors(spec):
    for sensor in list(spec.sensors):
        spec.delete(sensor)


@pytest.mark.parametrize(
    ("changes", "config", "sentence"),
    [
        (
            [no_sensors, deleted(("actuators", "left-knee"))],
            {},
            "it lacks the actuator left-knee. In a loop of your own",
        ),
        (
            [no_sensors, other_order],
            {},
            "its actuator order is left-hip-yaw, .*, left-hip-roll instead of left-hip-roll",
        ),
        ([servos], {}, "its actuators left-hip-roll, .* are not the torque motors of Cassie, of gears 25, 25, 16"),
        ([weaker], {}, "its actuators left-knee are not the torque motors"),
        ([geared], {}, "its actuators left-hip-roll, .* are not the torque motors"),
        ([crossed], {}, "its actuators left-knee, right-knee are not the torque motors"),
        ([deleted(("equalities", "left-achilles"))], {}, "it lacks the loop left-achilles-rod–left-heel-spring. In"),
        ([deleted(("pairs", "floor:left-foot"))], {}, "it lacks the contact pair floor:left-foot. In"),
        ([nameless_geoms], {}, "lacks the geom floor, left-foot-collision, right-foot-collision; it lacks the contact"),
        ([bell, without_keys], {}, "it has the joint swing besides; it has the body bell besides. In"),
        ([of_geoms], {}, "it lacks the inertial of cassie-pelvis, .*In"),
        (
            [lambda spec: slides_and_ball(spec, 1.0)],
            {},
            "it lacks the joint pelvis; .*slides and ball are no free joint",
        ),
    ],
)
def test_what_cannot_be_simulated_is_listed_with_the_way_out(tmp_path, changes, config, sentence):
    with pytest.raises(ValueError, match=rf"own.xml cannot be simulated here: .*{sentence}") as error:
        load(tmp_path, *changes, **config)
    assert "cassie_mjx.Controller.load(policy, model) runs a policy in any model" in str(error.value)


def test_a_flat_scene_has_no_terrain(tmp_path):
    with pytest.raises(ValueError, match="it lacks the height field of scene='terrain'"):
        load_model(ModelConfig(scene="terrain"), xml_path("flat"))


@pytest.mark.parametrize("scene", ["flat", "terrain"])
def test_the_packages_own_scenes_are_what_is_asked_of_others(scene):
    assert load_model(ModelConfig(scene=scene), xml_path(scene)).nbody == len(cassie.BODIES)
