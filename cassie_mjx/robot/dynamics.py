"""What robots of one design differ in: masses, springs, friction, motors and encoders; for NumPy and JAX alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np

from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace

# Which of the encoders shows each number of qpos, and which numbers have one.
_ENCODER_OF, _HAS_ENCODER = np.zeros(cassie.NQ, int), np.zeros(cassie.NQ, bool)
_ENCODER_OF[cassie.ENCODER_QPOS], _HAS_ENCODER[cassie.ENCODER_QPOS] = np.arange(len(cassie.ENCODERS)), True


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dynamics:
    """How each robot differs from the model, each field [B] and a factor unless said otherwise.

    Attributes:
      mass: on mass and inertia of each body, [B, 26], the world first.
      com: how far the pelvis' centre of mass is from the model's, [B, 3], m, pelvis frame.
      friction: coefficient between the feet and the floor, 1 in our model.
      damping: on the damping of all joints.
      stiffness: on the stiffness of the leaf springs.
      strength: on the torque of the motors, its limit included.
      p_gain: on the P gains of the PD law.
      d_gain: on the D gains of the PD law, on top of `Scenario.kd_scale`.
      encoder_offset: by how much the encoders show too large an angle, [B, 14], rad, in the order `cassie.ENCODERS`.
      torque_delay: how late the motors give the torque that the PD law asks of them, physics steps, int32; -1 for as
        late as they are in the model, which is not at all without electronics.
    """

    mass: Array
    com: Array
    friction: Array
    damping: Array
    stiffness: Array
    strength: Array
    p_gain: Array
    d_gain: Array
    encoder_offset: Array
    torque_delay: Array

    @classmethod
    def of(cls, robots: "Sequence[Dynamics | None]") -> "Dynamics":
        """Robots side by side, [B], of one each without that axis; None is one that is as the model has it."""
        each = [cls.nominal() if robot is None else robot for robot in robots]
        return jax.tree.map(lambda *values: np.stack(values), *each)

    @classmethod
    def nominal(cls, *shape: int, **changes: Array) -> "Dynamics":
        """Robots [shape] that are as the model has them, but for what is given, in its field's shape or one value."""
        ones = np.ones(shape)
        names = ("friction", "damping", "stiffness", "strength", "p_gain", "d_gain")
        values = {
            "mass": np.ones((*shape, len(cassie.BODIES))),
            "com": np.zeros((*shape, 3)),
            "encoder_offset": np.zeros((*shape, len(cassie.ENCODERS))),
            "torque_delay": np.full(shape, -1, np.int32),
            **dict.fromkeys(names, ones),
        }
        return cls(**values | {name: np.broadcast_to(value, values[name].shape) for name, value in changes.items()})


def varied(model: Any, dynamics: Dynamics) -> dict[str, Array]:
    """The fields of a model that the dynamics of one robot change, by name, with what they are then.

    Args:
      model: of MuJoCo or of MJX.
      dynamics: of one robot, without the axis B.
    """
    xp = namespace(dynamics.mass)
    pelvis = (np.arange(model.nbody) == cassie.PELVIS_BODY)[:, None]
    touching = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    feet = np.isin(touching, cassie.FOOT_BODIES).any(axis=0) & (touching == 0).any(axis=0)
    tangential = feet[:, None] & (np.arange(5) < 2)
    return {
        "body_mass": model.body_mass * dynamics.mass,
        "body_inertia": model.body_inertia * dynamics.mass[:, None],
        "body_ipos": model.body_ipos + pelvis * dynamics.com,
        "dof_damping": model.dof_damping * dynamics.damping,
        "jnt_stiffness": model.jnt_stiffness * dynamics.stiffness,
        "pair_friction": xp.where(tangential, dynamics.friction, model.pair_friction),
    }


def set_dynamics(model: mujoco.MjModel, dynamics: Dynamics, data: mujoco.MjData) -> None:
    """Write the dynamics of one robot into a model, in place, and all that MuJoCo derives from them.

    Args:
      model: a nominal one.
      dynamics: of one robot, without the axis B.
      data: of any model of its sizes; what is in it is lost.
    """
    for name, value in varied(model, dynamics).items():
        getattr(model, name)[:] = value
    mujoco.mj_setConst(model, data)


def encoded(qpos: Array, dynamics: Dynamics | None) -> Array:
    """Positions qpos [B, 35] as the encoders show them."""
    if dynamics is None:
        return qpos
    return qpos + namespace(qpos).where(_HAS_ENCODER, dynamics.encoder_offset[:, _ENCODER_OF], 0)
