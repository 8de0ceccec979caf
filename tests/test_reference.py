"""The reference motion: its algebra by hand, the shipped stride, files good and bad, and where it comes from."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.recording import make_periodic
from cassie_mjx.motion.reference import ReferenceMotion, blend_motions, nearest_sample, sample, stretch, stretch_states
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.loops import loop_error
from experiments.record_reference import foot_points

X, Y, Z = cassie.qpos_index("pelvis")[:3]
ROTATION = cassie.qpos_index("pelvis")[3:]
ACHILLES = [cassie.qpos_index(f"{side}-achilles-rod") for side in cassie.SIDES]
HALF = 11


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


def turned(angle):
    """A quaternion about the vertical."""
    return np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])


def toy(samples=4, yaw=0.0):
    """Sample k at x = 0.1 k; everything else made of small whole numbers."""
    qpos = np.tile(np.arange(cassie.NQ, dtype=float), (samples, 1))
    qpos[:, X] = 0.1 * np.arange(samples)
    for quaternion in (ROTATION, *ACHILLES):
        qpos[:, quaternion] = turned(yaw)
    return ReferenceMotion(qpos, np.full((samples, cassie.NV), 2.0), np.array(0.5))


def next_stride(motion):
    """The samples of a stride and the first of the next, as a recording has them."""
    return sample(motion, np.arange(len(motion.qpos) + 1))


def in_jax(motion):
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), motion)


def test_phase_wraps_and_carries_into_the_stride():
    phase, stride = np.array([0, 3, 4, 9, -1, 1]), np.array([0, 0, 0, 1, 2, 1000])
    qpos, qvel = sample(toy(), phase + len(toy().qpos) * stride)
    np.testing.assert_allclose(qpos[:, X], [0.0, 0.3, 0.5, 0.1 + 3 * 0.5, 0.3 + 0.5, 0.1 + 500], atol=1e-12)
    np.testing.assert_array_equal(qpos[:, 1:], np.tile(toy().qpos[0, 1:], (6, 1)))
    assert qvel.shape == (6, cassie.NV)


def test_sample_under_jit_is_sample_on_numpy(motion):
    phase, stride = np.array([0, 21, 22, -1, 50]), np.array([3, 2, 1, 0, -1])
    time = phase + len(motion.qpos) * stride
    expected = sample(motion, time)
    with jax.numpy_dtype_promotion("strict"):
        compiled = jax.jit(sample)(in_jax(motion), time)
        closed_over = jax.jit(lambda k: sample(motion, k))(time)
    for found in (compiled, closed_over):
        assert found[0].dtype == jnp.float32
        for ours, numpy in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours, numpy, atol=1e-6)


@pytest.mark.parametrize("factor", [0, 0.5, 2, 4])
def test_stretch_scales_x_alone(motion, factor):
    fast = stretch(motion, factor)
    np.testing.assert_allclose(fast.qpos[:, X], factor * motion.qpos[:, X])
    np.testing.assert_allclose(fast.qvel[:, 0], factor * motion.qvel[:, 0])
    assert fast.stride_length == pytest.approx(factor * motion.stride_length)
    np.testing.assert_array_equal(fast.qpos[:, 1:], motion.qpos[:, 1:])
    np.testing.assert_array_equal(fast.qvel[:, 1:], motion.qvel[:, 1:])


@pytest.mark.parametrize("factor", [-0.1, float("inf"), float("nan")])
def test_stretch_outside_the_papers_range(motion, factor):
    with pytest.raises(ValueError, match=f"cannot be stretched by {factor}; use a factor from 0 to 4"):
        stretch(motion, factor)


def test_states_stretch_robot_by_robot(motion):
    phase, stride, factor = np.array([0, 5, 30]), np.array([0, 2, 1]), np.array([0.0, 1.0, 2.7])
    time = phase + len(motion.qpos) * stride
    ours = stretch_states(*sample(motion, time), factor)
    for i in range(3):
        theirs = sample(stretch(motion, factor[i]), time[i : i + 1])
        for our, their in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(our[i], their[0], atol=1e-12)
    for unit, state in zip(stretch_states(motion.qpos, motion.qvel, 1.0), (motion.qpos, motion.qvel), strict=True):
        np.testing.assert_array_equal(unit, state)


def test_blend_of_two_speeds_is_the_speed_between(motion):
    mixed = blend_motions(stretch(motion, 3), stretch(motion, 1), 0.25)
    expected = stretch(motion, 1.5)
    for ours, wanted in zip(jax.tree.leaves(mixed), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-12)


def test_blend_turns_the_shorter_way_and_keeps_quaternions_unit():
    left, right = toy(yaw=0.4), toy(yaw=-0.4)
    right = right._replace(qpos=right.qpos.copy())
    right.qpos[1, ROTATION] *= -1
    middle, most = blend_motions(left, right, 0.5), blend_motions(left, right, 0.9)
    np.testing.assert_allclose(middle.qpos[:, ROTATION], np.tile(turned(0), (4, 1)), atol=1e-12)
    # Normalised linear interpolation: tan(yaw / 2) = (2 lambda - 1) tan(0.2).
    yaw = 2 * np.arctan(0.8 * np.tan(0.2))
    np.testing.assert_allclose(most.qpos[:, ACHILLES[1]], np.tile(turned(yaw), (4, 1)), atol=1e-12)
    np.testing.assert_array_equal(most.qpos[:, cassie.ACTIVE_QPOS], left.qpos[:, cassie.ACTIVE_QPOS])


def test_blend_takes_a_traced_lambda(motion):
    ours = jax.jit(blend_motions)(in_jax(stretch(motion, 2)), in_jax(motion), jnp.float32(0.5))
    assert ours.qpos.dtype == jnp.float32
    np.testing.assert_allclose(ours.qpos[:, X], 1.5 * motion.qpos[:, X], atol=1e-6)
    np.testing.assert_allclose(ours.qpos[:, ROTATION], motion.qpos[:, ROTATION], atol=1e-6)


def test_blend_of_strides_of_different_lengths():
    with pytest.raises(ValueError, match="Motions of 4 and 6 samples cannot be blended"):
        blend_motions(toy(4), toy(6), 0.5)


def test_shipped_stride_is_the_papers(motion):
    assert motion.qpos.shape == (22, cassie.NQ), "about 0.7 s"
    assert motion.stride_length == pytest.approx(0.5, abs=0.02)
    assert motion.qpos[0, X] == 0
    advance = np.diff(next_stride(motion)[0][:, X])
    np.testing.assert_allclose(advance, motion.stride_length / 22, rtol=0.2)
    # The mean of the velocities is what the stride covers in its time.
    assert motion.qvel[:, 0].mean() == pytest.approx(motion.stride_length / 0.704, rel=0.01)


def test_shipped_stride_is_its_mirror_image_half_a_stride_on(motion):
    ahead, velocity_ahead = sample(motion, np.arange(22) + HALF)
    image = cassie.mirror_qpos(motion.qpos)
    image[:, X] += motion.stride_length / 2
    np.testing.assert_allclose(ahead, image, atol=1e-14)
    np.testing.assert_array_equal(velocity_ahead, cassie.mirror_qvel(motion.qvel))


def test_shipped_stride_keeps_the_mechanism_closed(model, motion):
    assert loop_error(model, motion.qpos).max() < 1e-6
    dt = 1e-5
    moved = motion.qpos.copy()
    for qpos, qvel in zip(moved, motion.qvel, strict=True):
        mujoco.mj_integratePos(model, qpos, qvel, dt)
    # What opens after dt is of second order in qvel dt: far below the 1 m/s that an ill-fitting qvel may open.
    assert loop_error(model, moved).max() / dt < 5e-3


def test_shipped_stride_keeps_the_joint_limits_and_unit_quaternions(model, motion):
    limited = np.flatnonzero(model.jnt_limited)
    low, high = model.jnt_range[limited].T
    angles = motion.qpos[:, model.jnt_qposadr[limited]]
    assert ((angles >= low) & (angles <= high)).all()
    for quaternion in (ROTATION, *ACHILLES):
        np.testing.assert_allclose(np.linalg.norm(motion.qpos[:, quaternion], axis=1), 1, atol=1e-12)


def test_shipped_stride_walks_on_the_floor(model, motion):
    """One foot or both are down at every sample, and each foot in turn is lifted by more than 5 cm."""
    heights = foot_points(NativePhysics(model), motion.qpos)[..., 2].reshape(22, 2, 2)
    assert np.abs(heights.min(axis=(1, 2))).max() < 0.003
    np.testing.assert_array_less(0.05, heights.min(axis=2).max(axis=0))


def test_the_reference_angles_alone_fall(model, motion):
    """Why a policy is needed: zero residual, PD loop at 2 kHz, from every phase."""
    physics, phase = NativePhysics(model), np.arange(22)
    state = physics.init(*sample(motion, phase))
    up, seconds = np.ones(22, bool), np.zeros(22)
    for step in range(1, 64):
        target = sample(motion, phase + step)[0][:, cassie.ACTIVE_QPOS]
        state = physics.advance(state, target, Scenario.nominal(22), 64)
        up &= (state.qpos[:, Z] > 0.6) & (state.qpos[:, Z] < 1.2)
        seconds += 0.032 * up
    assert not up.any()
    # A robot in free fall would be down after sqrt(2 * 0.37 m / g) = 0.27 s; the README says half a second.
    assert 0.3 < seconds.min() <= seconds.max() <= 0.5


def spoiled(motion):
    """The stride as an agent might leave it: turned by 0.3 rad, beside the origin, with drift in joints and height."""
    qpos, qvel = next_stride(motion)
    share = np.linspace(-0.5, 0.5, 23)[:, None]
    drift = np.zeros(cassie.NQ)
    drift[[Z, *cassie.qpos_index("left-hip-pitch", "right-knee")]] = [0.002, 0.003, -0.004]
    qpos = qpos + share * drift
    cos, sin = np.cos(0.3), np.sin(0.3)
    turn = np.array([[cos, -sin], [sin, cos]])
    qpos[:, [X, Y]] = qpos[:, [X, Y]] @ turn.T + [5.0, -2.0]
    qvel[:, :2] = qvel[:, :2] @ turn.T
    for row in qpos:
        mujoco.mju_mulQuat(row[ROTATION[0] : ROTATION[-1] + 1], turned(0.3), row[ROTATION].copy())
    return qpos, qvel


def test_make_periodic_finds_the_stride_again(model, motion):
    mended = make_periodic(*spoiled(motion), model)
    assert mended.stride_length == pytest.approx(motion.stride_length, abs=1e-9)
    active_and_pelvis = np.r_[:7, cassie.ACTIVE_QPOS]
    np.testing.assert_allclose(mended.qpos[:, active_and_pelvis], motion.qpos[:, active_and_pelvis], atol=1e-7)
    assert loop_error(model, mended.qpos).max() < 1e-9


def test_make_periodic_is_symmetric_whatever_it_gets(model, motion):
    qpos, qvel = spoiled(motion)
    rng = np.random.default_rng(0)
    qpos[:, cassie.ACTIVE_QPOS] += rng.normal(0, 0.01, (23, 10))
    qvel += rng.normal(0, 0.1, qvel.shape)
    roll = cassie.qpos_index("left-hip-roll")[0]
    qpos[[4, 4 + HALF], roll] = 2.0
    mended = make_periodic(qpos, qvel, model)
    assert mended.qpos[:, roll].max() == model.joint("left-hip-roll").range[1], "clipped to the limit"
    image = cassie.mirror_qpos(mended.qpos[:HALF])
    image[:, X] += mended.stride_length / 2
    np.testing.assert_allclose(mended.qpos[HALF:], image, atol=1e-14)
    np.testing.assert_array_equal(mended.qvel[HALF:], cassie.mirror_qvel(mended.qvel[:HALF]))
    assert loop_error(model, mended.qpos).max() < 1e-9


def test_make_periodic_wants_two_halves(model, motion):
    qpos, qvel = next_stride(motion)
    with pytest.raises(ValueError, match="A stride of 21 samples has no two halves"):
        make_periodic(qpos[:-1], qvel[:-1], model)


def test_half_a_stride_later_is_half_the_samples_later():
    phases = np.arange(8) / 8
    assert nearest_sample(phases, 22).tolist() == [0, 3, 6, 8, 11, 14, 17, 19]
