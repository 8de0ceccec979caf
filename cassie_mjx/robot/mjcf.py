"""What an MJCF must have for this package to step it as Cassie, and what one that has not lacks."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from cassie_mjx.robot import cassie

# In undisturbed walking nothing else touches anything; after a push of 60 N the legs do meet, by up to 2 mm
# (`experiments.contacts`). Full contacts have that, and what touches the floor in a fall.
WALKING_PAIRS = ("floor:left-foot", "floor:right-foot")
TOUCHING = ("floor", "left-foot-collision", "right-foot-collision")
LOOPS = tuple(
    (f"{side}-{rod}", f"{side}-{end}")
    for side in cassie.SIDES
    for rod, end in (("plantar-rod", "foot"), ("achilles-rod", "heel-spring"))
)
"""Bodies that the four loops connect."""

_SLIDE, _BALL, _FREE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE
_JOINT_TYPES = {7: _FREE, 4: _BALL, 1: mujoco.mjtJoint.mjJNT_HINGE}


def free_root(spec: mujoco.MjSpec) -> None:
    """Give the pelvis a free joint named "pelvis" in place of what it has, if that is the same mechanism.

    Three slides along x, y, z and a ball are; keyframes then count the position from the world's origin.
    """
    pelvis = spec.body("cassie-pelvis")
    joints = list(pelvis.joints) if pelvis else []
    if [joint.type for joint in joints] == [_FREE]:
        joints[0].name = "pelvis"
    if not _slides_and_ball(joints) or not _floats(pelvis, joints):
        return
    for key in spec.keys:
        qpos = np.array(key.qpos)
        # Slides count from where the body stands in the file, less their reference.
        qpos[:3] += np.array(pelvis.pos) - [joint.ref for joint in joints[:3]]
        key.qpos = qpos
    for joint in joints:
        spec.delete(joint)
    pelvis.add_freejoint(name="pelvis")


def _slides_and_ball(joints: Sequence[mujoco.MjsJoint]) -> bool:
    return [joint.type for joint in joints] == [_SLIDE, _SLIDE, _SLIDE, _BALL]


def _floats(pelvis: mujoco.MjsBody, joints: Sequence[mujoco.MjsJoint]) -> bool:
    """Whether slides and a ball move as a free joint does: along x, y, z, and without a force of their own."""
    axes = np.array([joint.axis for joint in joints[:3]])
    forces = [(*joint.damping, *joint.stiffness, joint.armature, joint.frictionloss, *joint.pos) for joint in joints]
    return np.array_equal(axes, np.eye(3)) and np.array_equal(pelvis.quat, [1, 0, 0, 0]) and not np.any(forces)


def missing(spec: mujoco.MjSpec, scene: str) -> list[str]:
    """What a specification lacks, or has too much, before it is compiled; a phrase each."""
    phrases = []
    for what, wanted, found in (
        ("joint", [name for name, *_ in cassie.JOINTS], [joint.name for joint in spec.joints]),
        ("body", cassie.BODIES, [body.name for body in spec.bodies]),
        ("actuator", cassie.ACTUATORS, [actuator.name for actuator in spec.actuators]),
        ("loop", [_edge(*loop) for loop in LOOPS], [_edge(eq.name1, eq.name2) for eq in _connects(spec)]),
    ):
        phrases += _compared(what, wanted, found)
    for what, wanted, found in (
        ("geom", TOUCHING, [geom.name for geom in spec.geoms]),
        ("contact pair", WALKING_PAIRS, [pair.name for pair in spec.pairs]),
    ):
        phrases += _compared(what, wanted, set(found) & set(wanted))
    pelvis = spec.body("cassie-pelvis")
    if pelvis and _slides_and_ball(pelvis.joints):
        phrases.append("its slides and ball are no free joint: they have forces of their own, or not the axes x, y, z")
    if scene != "flat" and not list(spec.hfields):
        phrases.append(f"it lacks the height field of scene={scene!r}")
    # Geoms without a use in the simulation are deleted, and with them what they would weigh.
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        phrases.append("its compiler takes inertia from geoms")
    weightless = [body.name for body in spec.bodies if body.name in cassie.BODIES[1:] and not body.explicitinertial]
    if weightless:
        phrases.append(f"it lacks the inertial of {', '.join(weightless)}")
    return phrases


def differing(model: mujoco.MjModel) -> list[str]:
    """In what a compiled model that has everything differs from the one that is stepped here; a phrase each."""
    phrases = []
    for what, wanted, found in (
        ("joint", [name for name, *_ in cassie.JOINTS], [model.joint(i).name for i in range(model.njnt)]),
        ("body", cassie.BODIES, [model.body(i).name for i in range(model.nbody)]),
        ("actuator", cassie.ACTUATORS, [model.actuator(i).name for i in range(model.nu)]),
    ):
        if list(wanted) != found:
            phrases.append(f"its {what} order is {', '.join(found)} instead of {', '.join(wanted)}")
    if phrases:
        return phrases
    types = zip(cassie.JOINTS, model.jnt_type, strict=True)
    kinds = [name for (name, nq, _), found in types if found != _JOINT_TYPES[nq]]
    if kinds:
        phrases.append(f"it has joints of another type at {', '.join(kinds)}")
    wrong = [name for name, right in zip(cassie.ACTUATORS, _motors(model), strict=True) if not right]
    if wrong:
        phrases.append(
            f"its actuators {', '.join(wrong)} are not the torque motors of Cassie, of gears "
            f"{', '.join(f'{gear:g}' for gear in cassie.GEAR[:5])} and as strong"
        )
    return phrases


def _motors(model: mujoco.MjModel) -> np.ndarray:
    """Which actuators are motors, on the joint of their name, of Cassie's gear and no weaker, [10]."""
    torque = model.actuator_ctrlrange[:, 1] * model.actuator_gear[:, 0]
    return (
        (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        & (model.actuator_trnid[:, 0] == [model.joint(name).id for name in cassie.ACTUATORS])
        & (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE)
        & (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (model.actuator_gainprm[:, 0] == 1)
        & np.isclose(model.actuator_gear[:, 0], cassie.GEAR)
        & (~model.actuator_ctrllimited.astype(bool) | (torque >= 0.999 * cassie.TORQUE_LIMIT))
        & ~model.actuator_forcelimited.astype(bool)
    )


def _connects(spec: mujoco.MjSpec) -> list[mujoco.MjsEquality]:
    return [eq for eq in spec.equalities if eq.type == mujoco.mjtEq.mjEQ_CONNECT and eq.active]


def _edge(one: str, other: str) -> str:
    return "–".join(sorted((one, other)))


def _compared(what: str, wanted: Iterable[str], found: Iterable[str]) -> list[str]:
    """Phrases about names that are missing, and about those that are there instead."""
    wanted, found = list(wanted), list(found)
    lacking = [name for name in wanted if name not in found]
    surplus = [name or "one without a name" for name in found if name not in wanted]
    phrases = []
    if lacking:
        phrases.append(f"it lacks the {what} {', '.join(lacking)}")
    if surplus:
        phrases.append(f"it has the {what} {', '.join(dict.fromkeys(surplus))}{' instead' if lacking else ' besides'}")
    return phrases
