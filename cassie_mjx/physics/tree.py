"""Smooth dynamics of one robot on JAX: sums over the tree of bodies are products with constant matrices of 0 and 1.

MJX walks the tree level by level, with a gather and a scatter each time, which accelerators are slow at. The tree of a
robot never changes, so which joints move which bodies is a matrix. Spatial vectors have the angular part first and
refer to the robot's centre of mass c, as in MuJoCo (Featherstone, "Rigid Body Dynamics Algorithms", 2008).
"""

from itertools import groupby
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cassie_mjx.robot.arrays import Array

_FREE, _BALL, _HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "HINGE"))


class Motion(NamedTuple):
    """What of a robot's motion its forces follow from.

    Attributes:
      com: centre of mass c, [3], m, world frame.
      cdof: spatial velocity of what a joint velocity moves, per unit of it, [nv, 6].
      cvel: spatial velocities of the bodies, [nbody, 6].
      bias: spatial accelerations of the bodies at qacc = 0 and without gravity, [nbody, 6].
      inertia: of the bodies about c, [nbody, 13]: rotational (9), mass times position (3), mass.
    """

    com: jax.Array
    cdof: jax.Array
    cvel: jax.Array
    bias: jax.Array
    inertia: jax.Array


class Tree:
    """The structure of a model: which joint velocities move which bodies, and where the positions of hinges are.

    Attributes:
      moves: whether a joint velocity moves a body, [nbody, nv], 0 or 1.
      hinge_angles: picks the angle of each joint velocity's hinge out of qpos, [nv, nq], 0 or 1.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Read it from a compiled model with one root, a free joint, and at most one joint a body, balls and hinges."""
        ancestors = np.eye(model.nbody)
        for body in range(1, model.nbody):
            ancestors[body] += ancestors[model.body_parentid[body]]
        self.moves = ancestors[:, model.dof_bodyid]
        # Whether joint velocity j carries the axis of i along; MuJoCo's free joint moves before it turns.
        self._carries = self.moves[model.body_parentid[model.dof_bodyid]]
        self._carries[3:6, :3] = 1
        self._coupled = np.tril(self.moves[model.dof_bodyid])
        self._joint_of_dof = np.eye(model.njnt)[model.dof_jntid]
        self._translation = np.eye(model.nv, 3)
        self._parents, self._geom_bodies = model.body_parentid, model.geom_bodyid
        self._joint_bodies = model.jnt_bodyid
        self._joint_of_body = (model.jnt_bodyid == np.arange(model.nbody)[:, None]).astype(float)
        self._balls = [
            (int(model.jnt_bodyid[j]), int(model.jnt_qposadr[j])) for j in np.flatnonzero(model.jnt_type == _BALL)
        ]
        self.hinge_angles = np.zeros((model.nv, model.nq))
        hinges = model.jnt_type == _HINGE
        self.hinge_angles[model.jnt_dofadr[hinges], model.jnt_qposadr[hinges]] = 1
        joints = zip(range(model.njnt), model.jnt_type.tolist(), model.jnt_bodyid.tolist(), strict=True)
        # Hinges that follow each other are one slice.
        self._joints = [(kind, list(run)) for kind, run in groupby(joints, key=lambda joint: joint[1])]

    def kinematics(self, m: Array, d: Array) -> Array:
        """Where bodies, joints and geoms are; what `mjx.kinematics` does, in slices alone."""
        dtype = d.qpos.dtype
        joint = self._joint_of_body.astype(dtype)
        angles = (self._joint_of_body @ self._joint_of_dof.T @ self.hinge_angles).astype(dtype)
        anchor, half = joint @ m.jnt_pos, angles @ (d.qpos - m.qpos0) / 2
        turns = jnp.concatenate([jnp.cos(half)[:, None], jnp.sin(half)[:, None] * (joint @ m.jnt_axis)], axis=1)
        turns = [*turns]
        for body, q in [(1, 3), *self._balls]:
            turns[body] = d.qpos[q : q + 4] / jnp.sqrt((d.qpos[q : q + 4] ** 2).sum())
        turn, frame = rotation_matrix(jnp.stack(turns)), rotation_matrix(m.body_quat)
        # Of each body in its parent's frame; the root's joint is free.
        local = times(frame, turn)
        offset = m.body_pos + rotated(frame, anchor - rotated(turn, anchor))
        xpos, xmat = [jnp.zeros(3, dtype), d.qpos[:3]], [jnp.eye(3, dtype=dtype), turn[1]]
        for body in range(2, len(self._parents)):
            parent = self._parents[body]
            xpos.append(xpos[parent] + rotated(xmat[parent], offset[body]))
            xmat.append(times(xmat[parent], local[body]))
        of_joints, of_geoms = (
            [jnp.stack([x[b] for b in bodies]) for x in (xpos, xmat)]
            for bodies in (self._joint_bodies, self._geom_bodies)
        )
        places, turned = jnp.stack(xpos), jnp.stack(xmat)
        return d.replace(
            xpos=places,
            xmat=turned,
            xipos=places + rotated(turned, m.body_ipos),
            ximat=times(turned, rotation_matrix(m.body_iquat)),
            xanchor=of_joints[0] + rotated(of_joints[1], m.jnt_pos),
            xaxis=rotated(of_joints[1], m.jnt_axis),
            geom_xpos=of_geoms[0] + rotated(of_geoms[1], m.geom_pos),
            geom_xmat=times(of_geoms[1], rotation_matrix(m.geom_quat)),
        )

    def motion(self, m: Array, d: Array) -> Motion:
        """Axes, velocities and inertias about the centre of mass, after `kinematics`."""
        moves, carries = (x.astype(d.qpos.dtype) for x in (self.moves, self._carries))
        com = (m.body_mass @ d.xipos) / m.body_mass.sum()
        cdof = self._axes(d, com)
        flow = cdof * d.qvel[:, None]
        cdof_dot = cross_motion(carries @ flow, cdof)
        return Motion(com, cdof, moves @ flow, moves @ (cdof_dot * d.qvel[:, None]), _inertia(m, d, com))

    def mass_matrix(self, m: Array, motion: Motion) -> jax.Array:
        """Inertia M [nv, nv]: M_ij = cdof_i' I cdof_j with the inertia I of all that i moves, for i at or below j."""
        moves, coupled = (x.astype(motion.cdof.dtype) for x in (self.moves, self._coupled))
        lower = (momentum(moves.T @ motion.inertia, motion.cdof) @ motion.cdof.T) * coupled
        return lower + jnp.tril(lower, -1).T + jnp.diag(m.dof_armature)

    def passive_and_bias_force(self, m: Array, d: Array, motion: Motion) -> jax.Array:
        """Joint forces [nv] of springs and dampers, less those that hold against gravity and for the velocities."""
        moves, hinge_angles, joint = (
            x.astype(d.qpos.dtype) for x in (self.moves, self.hinge_angles, self._joint_of_dof)
        )
        spring = -(joint @ m.jnt_stiffness) * (hinge_angles @ (d.qpos - m.qpos_spring))
        acceleration = motion.bias - jnp.concatenate([jnp.zeros(3), m.opt.gravity])
        force = momentum(motion.inertia, acceleration) + cross_force(motion.cvel, momentum(motion.inertia, motion.cvel))
        return spring - m.dof_damping * d.qvel - (motion.cdof * (moves.T @ force)).sum(axis=1)

    def integrate(self, qpos: jax.Array, qvel: jax.Array, seconds: jax.Array) -> jax.Array:
        """Positions [nq] after moving at velocities [nv]; quaternions turn, and stay of length 1."""
        parts, q, v = [], 0, 0
        for kind, run in self._joints:
            if kind == _HINGE:
                parts.append(qpos[q : q + len(run)] + seconds * qvel[v : v + len(run)])
                q, v = q + len(run), v + len(run)
                continue
            if kind == _FREE:
                parts.append(qpos[q : q + 3] + seconds * qvel[v : v + 3])
                q, v = q + 3, v + 3
            parts.append(_turn(qpos[q : q + 4], seconds * qvel[v : v + 3]))
            q, v = q + 4, v + 3
        return jnp.concatenate(parts)

    def _axes(self, d: Array, com: jax.Array) -> jax.Array:
        axes, anchors = [], []
        for kind, run in self._joints:
            first, last, body = run[0][0], run[-1][0], run[0][2]
            if kind == _HINGE:
                axes.append(d.xaxis[first : last + 1])
                anchors.append(d.xanchor[first : last + 1])
                continue
            if kind == _FREE:
                axes.append(jnp.zeros((3, 3), com.dtype))
            axes.append(d.xmat[body].T)
            anchors += [jnp.broadcast_to(d.xanchor[first], (3, 3))] * (2 if kind == _FREE else 1)
        angular = jnp.concatenate(axes)
        linear = cross(angular, com - jnp.concatenate(anchors)) + self._translation.astype(com.dtype)
        return jnp.concatenate([angular, linear], axis=1)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Product a x b over the last axis, in slices alone."""
    (a1, a2, a3), (b1, b2, b3) = (tuple(x[..., i] for i in range(3)) for x in (a, b))
    return jnp.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], axis=-1)


def times(a: jax.Array, b: jax.Array) -> jax.Array:
    """Products of matrices [..., 3, 3] as sums, which fuse where calls into a library would not."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(axis=-2)


def rotated(rotation: jax.Array, vector: jax.Array) -> jax.Array:
    """Vectors [..., 3] turned by rotations [..., 3, 3]."""
    return (rotation * vector[..., None, :]).sum(axis=-1)


def rotation_matrix(quaternion: jax.Array) -> jax.Array:
    """Rotations [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def cross_motion(velocity: jax.Array, axis: jax.Array) -> jax.Array:
    """Rate of change of spatial axes [..., 6] that are carried along at spatial velocities [..., 6]."""
    (omega, v), (angular, linear) = (jnp.split(x, 2, axis=-1) for x in (velocity, axis))
    return jnp.concatenate([cross(omega, angular), cross(omega, linear) + cross(v, angular)], axis=-1)


def cross_force(velocity: jax.Array, force: jax.Array) -> jax.Array:
    """Rate of change of spatial momenta or forces [..., 6] that are carried along at spatial velocities [..., 6]."""
    (omega, v), (torque, f) = (jnp.split(x, 2, axis=-1) for x in (velocity, force))
    return jnp.concatenate([cross(omega, torque) + cross(v, f), cross(omega, f)], axis=-1)


def momentum(inertia: Array, velocity: jax.Array) -> jax.Array:
    """Spatial momenta [..., 6] of inertias [..., 13] at spatial velocities [..., 6]."""
    rotational, h, mass = inertia[..., :9].reshape(*inertia.shape[:-1], 3, 3), inertia[..., 9:12], inertia[..., 12:]
    omega, v = jnp.split(velocity, 2, axis=-1)
    angular = (rotational * omega[..., None, :]).sum(axis=-1) + cross(h, v)
    return jnp.concatenate([angular, mass * v - cross(h, omega)], axis=-1)


def _inertia(m: Array, d: Array, com: jax.Array) -> jax.Array:
    r, mass = d.xipos - com, m.body_mass[:, None]
    # R diag(i) R' + m (r'r 1 - r r')
    turned = times(d.ximat * m.body_inertia[:, None, :], d.ximat.swapaxes(1, 2))
    steiner = jnp.eye(3, dtype=r.dtype) * (r * r).sum(axis=1)[:, None, None] - r[:, :, None] * r[:, None, :]
    rotational = turned + mass[:, :, None] * steiner
    return jnp.concatenate([rotational.reshape(-1, 9), mass * r, mass], axis=1)


def _turn(quaternion: jax.Array, angle: jax.Array) -> jax.Array:
    """An orientation [4] after a rotation about an axis of its own frame by the length of that axis [3], rad."""
    square = (angle * angle).sum()
    length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    half = jnp.where(square > 0, length, 0.0) / 2
    w, u = quaternion[0], quaternion[1:]
    c, s = jnp.cos(half), angle / length * jnp.sin(half)
    turned = jnp.concatenate([(w * c - (u * s).sum())[None], w * s + c * u + cross(u, s)])
    return turned / jnp.sqrt((turned * turned).sum())
