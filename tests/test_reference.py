"""The reference motion: its algebra by hand, the shipped stride, files good and bad, and where it comes from."""

import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cassie_mjx import robot
from cassie_mjx.model import loop_error
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Disturbance
from cassie_mjx.reference import (
    ReferenceMotion,
    blend,
    load,
    load_trajectory,
    make_periodic,
    resolve,
    sample,
    save,
    shipped_path,
    stretch,
)
from experiments.record_reference import RecordConfig, choose, foot_points, record, slip

X, Y, Z = robot.qpos_index("pelvis")[:3]
ROTATION = robot.qpos_index("pelvis")[3:]
ACHILLES = [robot.qpos_index(f"{side}-achilles-rod") for side in robot.SIDES]
HALF = 11


@pytest.fixture(scope="module")
def motion():
    return resolve("walk")


def turned(angle):
    """A quaternion about the vertical."""
    return np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])


def toy(samples=4, yaw=0.0):
    """Sample k at x = 0.1 k; everything else made of small whole numbers."""
    qpos = np.tile(np.arange(robot.NQ, dtype=float), (samples, 1))
    qpos[:, X] = 0.1 * np.arange(samples)
    for quaternion in (ROTATION, *ACHILLES):
        qpos[:, quaternion] = turned(yaw)
    return ReferenceMotion(qpos, np.full((samples, robot.NV), 2.0), np.array(0.5))


def next_stride(motion):
    """The samples of a stride and the first of the next, as a recording has them."""
    return sample(motion, np.arange(len(motion.qpos) + 1), np.zeros(len(motion.qpos) + 1, int))


def in_jax(motion):
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), motion)


def test_phase_wraps_and_carries_into_the_stride():
    phase, stride = np.array([0, 3, 4, 9, -1, 1]), np.array([0, 0, 0, 1, 2, 1000])
    qpos, qvel = sample(toy(), phase, stride)
    np.testing.assert_allclose(qpos[:, X], [0.0, 0.3, 0.5, 0.1 + 3 * 0.5, 0.3 + 0.5, 0.1 + 500], atol=1e-12)
    np.testing.assert_array_equal(qpos[:, 1:], np.tile(toy().qpos[0, 1:], (6, 1)))
    assert qvel.shape == (6, robot.NV)


def test_sample_under_jit_is_sample_on_numpy(motion):
    phase, stride = np.array([0, 21, 22, -1, 50]), np.array([3, 2, 1, 0, -1])
    expected = sample(motion, phase, stride)
    with jax.numpy_dtype_promotion("strict"):
        compiled = jax.jit(sample)(in_jax(motion), phase, stride)
        closed_over = jax.jit(lambda k, n: sample(motion, k, n))(phase, stride)
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


@pytest.mark.parametrize("factor", [-0.1, 4.01, float("nan")])
def test_stretch_outside_the_papers_range(motion, factor):
    with pytest.raises(ValueError, match=f"cannot be stretched by {factor}; use a factor from 0 to 4"):
        stretch(motion, factor)


def test_blend_of_two_speeds_is_the_speed_between(motion):
    mixed = blend(stretch(motion, 3), stretch(motion, 1), 0.25)
    expected = stretch(motion, 1.5)
    for ours, wanted in zip(jax.tree.leaves(mixed), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-12)


def test_blend_turns_the_shorter_way_and_keeps_quaternions_unit():
    left, right = toy(yaw=0.4), toy(yaw=-0.4)
    right = replace(right, qpos=right.qpos.copy())
    right.qpos[1, ROTATION] *= -1
    middle, most = blend(left, right, 0.5), blend(left, right, 0.9)
    np.testing.assert_allclose(middle.qpos[:, ROTATION], np.tile(turned(0), (4, 1)), atol=1e-12)
    # Normalised linear interpolation: tan(yaw / 2) = (2 lambda - 1) tan(0.2).
    yaw = 2 * np.arctan(0.8 * np.tan(0.2))
    np.testing.assert_allclose(most.qpos[:, ACHILLES[1]], np.tile(turned(yaw), (4, 1)), atol=1e-12)
    np.testing.assert_array_equal(most.qpos[:, robot.ACTIVE_QPOS], left.qpos[:, robot.ACTIVE_QPOS])


def test_blend_takes_a_traced_lambda(motion):
    ours = jax.jit(blend)(in_jax(stretch(motion, 2)), in_jax(motion), jnp.float32(0.5))
    assert ours.qpos.dtype == jnp.float32
    np.testing.assert_allclose(ours.qpos[:, X], 1.5 * motion.qpos[:, X], atol=1e-6)
    np.testing.assert_allclose(ours.qpos[:, ROTATION], motion.qpos[:, ROTATION], atol=1e-6)


def test_blend_of_strides_of_different_lengths():
    with pytest.raises(ValueError, match="Motions of 4 and 6 samples cannot be blended"):
        blend(toy(4), toy(6), 0.5)


def test_shipped_stride_is_the_papers(motion):
    assert motion.qpos.shape == (22, robot.NQ), "about 0.7 s"
    assert motion.stride_length == pytest.approx(0.5, abs=0.02)
    assert motion.qpos[0, X] == 0
    advance = np.diff(next_stride(motion)[0][:, X])
    np.testing.assert_allclose(advance, motion.stride_length / 22, rtol=0.2)
    # The mean of the velocities is what the stride covers in its time.
    assert motion.qvel[:, 0].mean() == pytest.approx(motion.stride_length / 0.704, rel=0.01)


def test_shipped_stride_is_its_mirror_image_half_a_stride_on(motion):
    ahead, velocity_ahead = sample(motion, np.arange(22) + HALF, np.zeros(22, int))
    image = robot.mirror_qpos(motion.qpos)
    image[:, X] += motion.stride_length / 2
    np.testing.assert_allclose(ahead, image, atol=1e-14)
    np.testing.assert_array_equal(velocity_ahead, robot.mirror_qvel(motion.qvel))


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
    physics, phase, none = NativePhysics(model), np.arange(22), np.zeros(22, int)
    state = physics.init(*sample(motion, phase, none))
    up, seconds = np.ones(22, bool), np.zeros(22)
    for step in range(1, 64):
        target = sample(motion, phase + step, none)[0][:, robot.ACTIVE_QPOS]
        state = physics.advance(state, target, Disturbance.none(22), 64)
        up &= (state.qpos[:, Z] > 0.6) & (state.qpos[:, Z] < 1.2)
        seconds += 0.032 * up
    assert not up.any()
    # A robot in free fall would be down after sqrt(2 * 0.37 m / g) = 0.27 s.
    assert 0.3 < seconds.min() <= seconds.max() < 1.0


def spoiled(motion):
    """The stride as a walker might leave it: turned by 0.3 rad, beside the origin, with drift in joints and height."""
    qpos, qvel = next_stride(motion)
    share = np.linspace(-0.5, 0.5, 23)[:, None]
    drift = np.zeros(robot.NQ)
    drift[[Z, *robot.qpos_index("left-hip-pitch", "right-knee")]] = [0.002, 0.003, -0.004]
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
    active_and_pelvis = np.r_[:7, robot.ACTIVE_QPOS]
    np.testing.assert_allclose(mended.qpos[:, active_and_pelvis], motion.qpos[:, active_and_pelvis], atol=1e-7)
    assert loop_error(model, mended.qpos).max() < 1e-9


def test_make_periodic_is_symmetric_whatever_it_gets(model, motion):
    qpos, qvel = spoiled(motion)
    rng = np.random.default_rng(0)
    qpos[:, robot.ACTIVE_QPOS] += rng.normal(0, 0.01, (23, 10))
    qvel += rng.normal(0, 0.1, qvel.shape)
    roll = robot.qpos_index("left-hip-roll")[0]
    qpos[[4, 4 + HALF], roll] = 2.0
    mended = make_periodic(qpos, qvel, model)
    assert mended.qpos[:, roll].max() == model.joint("left-hip-roll").range[1], "clipped to the limit"
    image = robot.mirror_qpos(mended.qpos[:HALF])
    image[:, X] += mended.stride_length / 2
    np.testing.assert_allclose(mended.qpos[HALF:], image, atol=1e-14)
    np.testing.assert_array_equal(mended.qvel[HALF:], robot.mirror_qvel(mended.qvel[:HALF]))
    assert loop_error(model, mended.qpos).max() < 1e-9


def test_make_periodic_wants_two_halves(model, motion):
    qpos, qvel = next_stride(motion)
    with pytest.raises(ValueError, match="A stride of 21 samples has no two halves"):
        make_periodic(qpos[:-1], qvel[:-1], model)


def test_save_and_load_round_trip(tmp_path, motion):
    save(tmp_path / "motion.npz", motion, {"seed": 3, "command": "none"})
    found, provenance = load(tmp_path / "motion.npz")
    assert provenance == {"seed": 3, "command": "none"}
    for ours, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(motion), strict=True):
        np.testing.assert_array_equal(ours, wanted)
    assert resolve(str(tmp_path / "motion.npz")).stride_length == motion.stride_length
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


def spoil(motion, **changes):
    """A copy of a motion with single values of qpos or qvel replaced: name -> (index, value)."""
    motion = jax.tree.map(np.copy, motion)
    for name, (index, value) in changes.items():
        getattr(motion, name)[index] = value
    return motion


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda m: replace(m, qpos=m.qpos[:, :-1]), r"shapes \(22, 34\), \(22, 32\), \(\); a motion has \[N, 35\]"),
        (lambda m: ReferenceMotion(m.qpos[:1], m.qvel[:1], m.stride_length), "N at least 2"),
        (lambda m: spoil(m, qvel=((3, 4), np.nan)), "qvel has values that are not finite numbers"),
        (lambda m: replace(m, stride_length=np.array(np.inf)), "stride_length has values that are not finite"),
        (
            lambda m: spoil(m, qpos=((7, ROTATION), 0.9)),
            "no motion of Cassie: row 7 has a pelvis quaternion of norm 1.8",
        ),
        (lambda m: spoil(m, qpos=((2, Z), 0.2)), r"the pelvis goes from 0.2 to 0.97\d m"),
        (lambda m: spoil(m, qpos=((5, robot.qpos_index("left-knee")), 1.0)), "row 5 has left-knee at 1 rad, limits"),
    ],
)
def test_a_saved_motion_that_is_none(tmp_path, motion, change, sentence):
    save(tmp_path / "bad.npz", change(motion), {})
    with pytest.raises(ValueError, match=f"bad.npz.*{sentence}"):
        load(tmp_path / "bad.npz")


def test_a_file_of_another_kind(tmp_path, motion):
    path = tmp_path / "bad.npz"
    with pytest.raises(ValueError, match=r"bad.npz cannot be read: .*No such file"):
        load(path)
    path.write_bytes(shipped_path("walk").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"bad.npz cannot be read"):
        load(path)
    np.savez(path, qpos=motion.qpos)
    with pytest.raises(ValueError, match=r"bad.npz cannot be read: it is not a cassie-mjx reference motion"):
        load(path)
    content: dict[str, Any] = dict(np.load(shipped_path("walk")))
    content["version"] = 9
    np.savez(path, **content)
    with pytest.raises(ValueError, match=r"bad.npz has version 9 of the format; this program reads version 1"):
        load(path)
    content["qpos"] = np.array([{}])
    np.savez(path, **content)
    with pytest.raises(ValueError, match=r"bad.npz cannot be read: .*allow_pickle"):
        load(path)
    with pytest.raises(ValueError, match="reference='wlak' is neither walk nor a file"):
        resolve("wlak")


def trajectory(motion, duration):
    """Rows of the public format: the motion at 2 kHz, paced to last `duration` s; its velocities are left alone."""
    qpos, qvel = next_stride(motion)
    at = np.linspace(0, 22, round(duration * 2000) + 1)
    columns = [np.interp(at, np.arange(23), column) for column in np.hstack([qpos, qvel]).T]
    rows = np.zeros((len(at), 98))
    rows[:, 0] = np.linspace(0, duration, len(at))
    rows[:, 1:68] = np.stack(columns, axis=1)
    for quaternion in (ROTATION, *ACHILLES):
        rows[:, 1 + quaternion] /= np.linalg.norm(rows[:, 1 + quaternion], axis=1, keepdims=True)
    return rows


def write_trajectory(path, rows):
    path.write_bytes(rows.astype("<f8").tobytes())
    return path


def test_trajectory_file_round_trip(tmp_path, motion):
    path = write_trajectory(tmp_path / "stride.bin", trajectory(motion, 0.704))
    found = resolve(str(path))
    for ours, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(motion), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-9)


def test_trajectory_of_the_published_duration_becomes_26_samples(tmp_path, motion):
    found = load_trajectory(write_trajectory(tmp_path / "stride.bin", trajectory(motion, 0.84)))
    assert found.qpos.shape == (26, robot.NQ)
    assert found.stride_length == pytest.approx(motion.stride_length)
    np.testing.assert_allclose(found.qpos[13], motion.qpos[11], atol=1e-9)
    np.testing.assert_allclose(found.qvel[13], motion.qvel[11] * 0.84 / 0.832, atol=1e-9)
    x = np.append(found.qpos[:, X], found.stride_length)
    # The mean speed over the stride's own time is what a step covers in 32 ms.
    assert np.diff(x).mean() / 0.032 == pytest.approx(motion.stride_length / 0.832)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda rows: rows.ravel()[:-50], r"\d+ bytes, no whole number of rows of 784: it is cut short"),
        (lambda rows: rows[:0], "0 bytes, no whole number of rows"),
        (lambda rows: rows.astype(">f8").view("<f8"), "no motion of Cassie|not finite"),
        (lambda rows: np.where(np.arange(98) == 9, np.nan, rows), "qpos has values that are not finite numbers"),
        (lambda rows: np.roll(rows, 1, axis=1), r"no motion of Cassie: row \d+ has a pelvis quaternion of norm"),
        (lambda rows: rows + 0.4 * (np.arange(98) == 1 + Z), "the pelvis goes from 1.37 to 1.38 m"),
        (lambda rows: rows + 3 * (np.arange(98) == 1 + robot.ACTIVE_QPOS[4]), "left-foot at 1.5.* rad, limits"),
        (lambda rows: rows * (np.arange(98) > 0), "time, must rise with each row"),
        (lambda rows: rows[: len(rows) // 3], "its last row must repeat the first besides x, and is off by 0.[1-9]"),
    ],
)
def test_a_trajectory_file_that_is_none(tmp_path, motion, change, sentence):
    path = write_trajectory(tmp_path / "bad.bin", change(trajectory(motion, 0.704)))
    with pytest.raises(ValueError, match=f"bad.bin.*({sentence})"):
        load_trajectory(path)


def test_the_recorder_takes_the_stride_nearest_to_half_a_metre():
    qpos = np.zeros((3, 4, robot.NQ))
    qpos[..., Z] = 0.9
    qpos[1, 2, Z] = 0.5
    # 0.3 and 0.4 along two axes are 0.5; the third robot falls.
    qpos[-1, :, :2] = [[0.47, 0], [0.3, 0.39], [0.5, 0], [0.52, 0]]
    assert choose(qpos) == 1
    with pytest.raises(ValueError, match=r"No speed gives a stride of 0.5 m, but 0.470 m, a fall; name other speeds"):
        choose(qpos[:, [0, 2]])


def test_slip_is_the_way_of_a_point_while_it_is_down():
    path = np.array(
        [[0, 0, 0.1], [1, 0, -0.001], [1.003, 0.004, -0.001], [1.001, 0, -0.001], [2, 0, 0.1], [3, 0, -0.001]]
    )
    assert slip(path[:, None]) == pytest.approx(0.005)


def test_a_recording_that_cannot_be_made():
    with pytest.raises(ValueError, match="preset='soft' is not known; choose one of stiff, compliant"):
        RecordConfig(preset="soft")
    with pytest.raises(ValueError, match="strides=5 is too short for the walk to settle; use 43 or more"):
        RecordConfig(strides=5)
    with pytest.raises(ValueError, match="speeds is empty"):
        RecordConfig(speeds=())


def test_shipped_file_says_where_it_comes_from():
    _, provenance = load(shipped_path("walk"))
    assert provenance["command"].startswith("python -m experiments.record_reference preset=compliant")
    assert provenance["period_s"] == pytest.approx(0.704)
    assert provenance["end_minus_start_qpos"] < 1e-3
    assert provenance["asymmetry_qpos"] < 2e-3
    assert provenance["simulated_loop_error_m"] < 1e-3
    assert provenance["slip_m"] < 0.01
    json.dumps(provenance)


@pytest.mark.slow
def test_shipped_file_is_what_the_recorder_makes(motion):
    """The walk has converged onto one cycle; other processors round otherwise on the way to it."""
    _, provenance = load(shipped_path("walk"))
    config = RecordConfig(
        preset=provenance["preset"], strides=provenance["strides"], speeds=(provenance["controller_speed_mps"],)
    )
    again, _ = record(config)
    np.testing.assert_allclose(again.stride_length, motion.stride_length, atol=1e-3)
    np.testing.assert_allclose(again.qpos, motion.qpos, atol=2e-3)
    np.testing.assert_allclose(again.qvel, motion.qvel, atol=0.1)
