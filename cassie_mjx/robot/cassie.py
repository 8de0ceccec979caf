"""Cassie's names, gains, limits, standing pose and left/right mirror; names become indices here and nowhere else.

Figures: the public MuJoCo model of the Dynamic Robotics Laboratory (osudrl/cassie-mujoco-sim)
and, for the PD gains, osudrl/apex.
"""

from collections.abc import Iterable

import numpy as np

from cassie_mjx.robot.arrays import Array

CONTROL_PERIOD_S = 0.032
"""Time for which a policy's PD targets are held, s (Xie et al. 2018)."""

SIDES = ("left", "right")
ACTIVE = ("hip-roll", "hip-yaw", "hip-pitch", "knee", "foot")
SPRUNG = ("shin", "tarsus")

# One leg's joints in qpos order with their number of coordinates (qpos, qvel).
_LEG_JOINTS = (
    ("hip-roll", 1, 1),
    ("hip-yaw", 1, 1),
    ("hip-pitch", 1, 1),
    ("achilles-rod", 4, 3),
    ("knee", 1, 1),
    ("shin", 1, 1),
    ("tarsus", 1, 1),
    ("heel-spring", 1, 1),
    ("foot-crank", 1, 1),
    ("plantar-rod", 1, 1),
    ("foot", 1, 1),
)
_LEG_BODIES = (
    "hip-roll",
    "hip-yaw",
    "hip-pitch",
    "achilles-rod",
    "knee",
    "knee-spring",
    "shin",
    "tarsus",
    "heel-spring",
    "foot-crank",
    "plantar-rod",
    "foot",
)

JOINTS = (("pelvis", 7, 6), *((f"{side}-{name}", nq, nv) for side in SIDES for name, nq, nv in _LEG_JOINTS))
BODIES = ("world", "cassie-pelvis", *(f"{side}-{name}" for side in SIDES for name in _LEG_BODIES))
ACTUATORS = tuple(f"{side}-{name}" for side in SIDES for name in ACTIVE)
NQ, NV, NU = 35, 32, 10

_ENDS_Q = np.cumsum([nq for _, nq, _ in JOINTS])
_ENDS_V = np.cumsum([nv for _, _, nv in JOINTS])
_QPOS = {name: np.arange(end - nq, end) for (name, nq, _), end in zip(JOINTS, _ENDS_Q, strict=True)}
_QVEL = {name: np.arange(end - nv, end) for (name, _, nv), end in zip(JOINTS, _ENDS_V, strict=True)}


def _gather(table: dict[str, np.ndarray], what: str, names: Iterable[str]) -> np.ndarray:
    names = list(names)
    missing = [name for name in names if name not in table]
    if missing:
        raise ValueError(f"Cassie has no {what} named {', '.join(missing)}; it has {', '.join(table)}.")
    return np.concatenate([table[name] for name in names])


def qpos_index(*names: str) -> np.ndarray:
    """Indices into qpos of the named joints, in the order given. Raises ValueError for a name Cassie lacks."""
    return _gather(_QPOS, "joint", names)


def qvel_index(*names: str) -> np.ndarray:
    """Indices into qvel of the named joints, in the order given. Raises ValueError for a name Cassie lacks."""
    return _gather(_QVEL, "joint", names)


def body_index(*names: str) -> np.ndarray:
    """Indices of the named bodies, in the order given. Raises ValueError for a name Cassie lacks."""
    return _gather({name: np.array([i]) for i, name in enumerate(BODIES)}, "body", names)


ACTIVE_QPOS = qpos_index(*ACTUATORS)
ACTIVE_QVEL = qvel_index(*ACTUATORS)
SPRUNG_NAMES = tuple(f"{side}-{name}" for side in SIDES for name in SPRUNG)
SHIN_QPOS = qpos_index("left-shin", "right-shin")
ENCODERS = (*ACTUATORS, *SPRUNG_NAMES)
"""Joints with an encoder, in the order of what they are off by."""
ENCODER_QPOS = qpos_index(*ENCODERS)
# A robot whose pelvis is lower or higher than this over the ground below it has fallen, m (Xie et al. 2018).
FALL_LOW_M, FALL_HIGH_M = 0.6, 1.2

# The pelvis in qpos: x y z, quaternion w x y z; in qvel: velocity (world), turning (own frame).
PELVIS_POSITION, PELVIS_QUATERNION = np.split(qpos_index("pelvis"), [3])
PELVIS_X, PELVIS_Y, PELVIS_Z = PELVIS_POSITION.tolist()
PELVIS_VELOCITY, PELVIS_ANGULAR_VELOCITY = np.split(qvel_index("pelvis"), [3])
HORIZONTAL_VELOCITY = slice(PELVIS_VELOCITY[0], PELVIS_VELOCITY[2])
HIP_PITCH_QPOS = qpos_index("left-hip-pitch", "right-hip-pitch")
PELVIS_BODY = int(body_index("cassie-pelvis")[0])
FOOT_BODIES = body_index("left-foot", "right-foot")

# Joints that the closed loops determine, once hips, knees, feet and springs are given.
LOOP_QVEL = qvel_index(
    *(f"{side}-{name}" for side in SIDES for name in ("achilles-rod", "tarsus", "foot-crank", "plantar-rod"))
)

# Ends of the foot's contact capsule in the foot body's frame, and its radius, m.
TOE = np.array([-0.052821, 0.092622, 0.0])
HEEL = np.array([0.069746, -0.010224, 0.0])
FOOT_RADIUS_M = 0.02
SOLE_AXIS = (TOE + HEEL) / 2
"""Middle of that capsule, m."""

# Published PD gains and torque limits of the ten active joints, joint side: N·m/rad, N·m·s/rad, N·m.
P_GAIN = np.tile([100.0, 100.0, 88.0, 96.0, 50.0], 2)
D_GAIN = np.tile([10.0, 10.0, 8.0, 9.6, 5.0], 2)
TORQUE_LIMIT = np.tile([112.5, 112.5, 195.2, 195.2, 45.0], 2)
GEAR = np.tile([25.0, 25.0, 16.0, 16.0, 50.0], 2)

# Targets under which the PD law holds the keyframe "standing": the published standing angles for hips and knees, with
# what gravity takes, and the foot angle that puts the centre of mass over the feet.
STANDING_TARGET = np.array(
    [
        *(0.02215507, 0.0, 0.43555917, -0.77139378, -1.63988603),
        *(-0.02215507, 0.0, 0.43555917, -0.77139378, -1.63988603),
    ]
)

_STANDING_LEG = np.array(
    [
        *(0.00448994449, 0.000294577564, 0.498152781, 0.975411886, 0.000860253264, 0.0153150458, -0.219855322),
        *(-1.1996935, -0.037464824, 1.49473969, -0.0268933949, -1.51999333, 1.50158967, -1.627734),
    ]
)
_OTHER_LEG = _STANDING_LEG * [-1, -1, 1, 1, -1, -1, 1, 1, 1, 1, 1, 1, 1, 1]
STANDING_QPOS = np.concatenate([[0, 0, 0.988208798, 1, 0, 0, 0], _STANDING_LEG, _OTHER_LEG])
"""The keyframe "standing", [35]: m, unit quaternions w x y z, rad."""


def pd_torque(
    target: Array, q: Array, qdot: Array, kd_scale: Array | float = 1.0, kp_scale: Array | float = 1.0
) -> Array:
    """Joint torque of the PD law, N·m, for NumPy and JAX arrays alike.

    Args:
      target: PD target of the active joints, [..., 10], rad.
      q: active joint angles, [..., 10], rad.
      qdot: active joint velocities, [..., 10], rad/s.
      kd_scale: s, factor on all D gains, one number or [..., 1].
      kp_scale: k, factor on all P gains, one number or [..., 1].

    Returns:
      tau = clip(k P (target - q) - s D qdot, -limit, limit), [..., 10].
    """
    return (kp_scale * P_GAIN * (target - q) - kd_scale * D_GAIN * qdot).clip(-TORQUE_LIMIT, TORQUE_LIMIT)


def torque_as_target(torque: Array, q: Array, qdot: Array) -> Array:
    """The PD target, rad, [..., 10], whose PD law, undiminished, gives `torque` (N·m) at joint state (q, qdot)."""
    return q + (torque + D_GAIN * qdot) / P_GAIN


def _mirror_table(root: list[int], ball: list[int], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Permutation and signs that take a state to its mirror image in the plane y = 0."""
    table, joint_size = (_QPOS, 4) if size == NQ else (_QVEL, 3)
    order, sign = np.arange(size), np.ones(size, int)
    sign[: len(root)] = root
    for (name, *_), (side, other) in ((j, s) for j in _LEG_JOINTS for s in (SIDES, SIDES[::-1])):
        order[table[f"{side}-{name}"]] = table[f"{other}-{name}"]
        if name in ("hip-roll", "hip-yaw"):
            sign[table[f"{side}-{name}"]] = -1
        elif len(table[f"{side}-{name}"]) == joint_size:
            sign[table[f"{side}-{name}"]] = ball
    return order, sign


_QPOS_ORDER, _QPOS_SIGN = _mirror_table([1, -1, 1, 1, -1, 1, -1], [1, -1, -1, 1], NQ)
_QVEL_ORDER, _QVEL_SIGN = _mirror_table([1, -1, 1, -1, 1, -1], [-1, -1, 1], NV)
_ACTIVE_ORDER = np.roll(np.arange(NU), NU // 2)
_ACTIVE_SIGN = np.tile([-1, -1, 1, 1, 1], 2)


def mirror_qpos(qpos: Array) -> Array:
    """Reflect qpos [..., 35] in the plane y = 0: the left leg's state becomes the right's."""
    return qpos[..., _QPOS_ORDER] * _QPOS_SIGN


def mirror_qvel(qvel: Array) -> Array:
    """Reflect qvel [..., 32] in the plane y = 0."""
    return qvel[..., _QVEL_ORDER] * _QVEL_SIGN


def mirror_active(values: Array) -> Array:
    """Reflect values of the ten active joints [..., 10] (targets, torques, actions) in the plane y = 0."""
    return values[..., _ACTIVE_ORDER] * _ACTIVE_SIGN
