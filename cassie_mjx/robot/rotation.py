"""Quaternions w x y z and headings, for NumPy and JAX arrays alike."""

from cassie_mjx.robot.arrays import Array, namespace


def yaw(quaternion: Array) -> Array:
    """Heading of the x axis of frames with these orientations [..., 4], about the world's z, [...], rad."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    return namespace(quaternion).arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def align(quaternion: Array, reference: Array) -> Array:
    """The one of q and -q, which are the same orientation, that is nearer to a reference; both [..., 4]."""
    xp = namespace(quaternion, reference)
    opposite = (quaternion * reference).sum(axis=-1, keepdims=True) < 0
    return xp.where(opposite, -quaternion, quaternion)
