"""Quaternions w x y z and headings, for NumPy and JAX arrays alike."""

import numpy as np

from cassie_mjx.robot.arrays import Array, namespace


def yaw(quaternion: Array) -> Array:
    """Heading of the x axis of frames with these orientations [..., 4], about the world's z, [...], rad."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    return namespace(quaternion).arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def turned(vector: Array, angle: Array) -> Array:
    """Horizontal vectors [..., 2] turned to the left by angles [...], rad; unchanged to the last bit by 0."""
    xp = namespace(vector, angle)
    x, y, cos, sin = vector[..., 0], vector[..., 1], xp.cos(angle), xp.sin(angle)
    return xp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def turned_orientation(quaternion: Array, angle: Array) -> Array:
    """Orientations [..., 4] turned to the left about the world's z by angles [...], rad; exactly the same by 0."""
    xp = namespace(quaternion, angle)
    cos, sin = xp.cos(angle / 2), xp.sin(angle / 2)
    w, x, y, z = (quaternion[..., i] for i in range(4))
    # (cos, 0, 0, sin) q
    return xp.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w], axis=-1)


def tilted(quaternion: Array, tilt: Array) -> Array:
    """Orientations [..., 4] leaned by angles [..., 2], rad, about a horizontal axis (x, y) of their own frames."""
    xp = namespace(quaternion, tilt)
    # sin(a / 2) / a, which is 1/2 at 0
    angle = xp.sqrt((tilt**2).sum(axis=-1))
    cos, half = xp.cos(angle / 2), xp.sinc(angle / (2 * xp.pi)) / 2
    b, c = half * tilt[..., 0], half * tilt[..., 1]
    w, x, y, z = (quaternion[..., i] for i in range(4))
    # q (cos, b, c, 0)
    return xp.stack(
        [cos * w - b * x - c * y, cos * x + b * w - c * z, cos * y + c * w + b * z, cos * z + c * x - b * y], axis=-1
    )


def rotated(quaternion: Array, vector: Array) -> Array:
    """Vectors in frames with these orientations [..., 4], [..., 3], in the world."""
    xp, w, u = namespace(quaternion, vector), quaternion[..., :1], quaternion[..., 1:]
    # R v = v + w t + u x t, with t = 2 u x v
    t = 2 * xp.cross(u, vector)
    return vector + w * t + xp.cross(u, t)


def in_frame(quaternion: Array, vector: Array) -> Array:
    """Vectors of the world, [..., 3], in frames with these orientations [..., 4]."""
    # R^T is the rotation of the conjugate.
    return rotated(quaternion * np.array([1, -1, -1, -1]), vector)


def up_in_body(quaternion: Array) -> Array:
    """The world's z in frames with these orientations [..., 4], [..., 3]: the last row of the rotation matrix."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    return namespace(quaternion).stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def align(quaternion: Array, reference: Array) -> Array:
    """The one of q and -q, which are the same orientation, that is nearer to a reference; both [..., 4]."""
    xp = namespace(quaternion, reference)
    opposite = (quaternion * reference).sum(axis=-1, keepdims=True) < 0
    return xp.where(opposite, -quaternion, quaternion)
