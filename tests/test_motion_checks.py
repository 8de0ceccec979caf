"""Motion files that are wrong in ways that people's are: refused with the likely cause; and odd ones that are right."""

import warnings

import mujoco
import numpy as np
import pytest

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.motion.checks import check_motion, foot_heights
from cassie_mjx.motion.files import load_motion, read_motion, save_motion
from cassie_mjx.motion.reference import QUATERNIONS, ReferenceMotion, aligned, blend_motions, mix_qpos, sample, stretch
from cassie_mjx.robot import cassie

X, Y, Z = cassie.PELVIS_POSITION
WALK = load_motion("walk")
LEGS = [cassie.qpos_index(*(name for name, *_ in cassie.JOINTS if name.startswith(side))) for side in cassie.SIDES]


def with_qpos(columns, change):
    """The walk with columns of qpos replaced by `change` of them."""
    qpos = WALK.qpos.copy()
    qpos[:, columns] = change(qpos[:, columns])
    return WALK._replace(qpos=qpos)


def with_qvel(columns, change):
    qvel = WALK.qvel.copy()
    qvel[:, columns] = change(qvel[:, columns])
    return WALK._replace(qvel=qvel)


def as_xyzw(names):
    return with_qpos(QUATERNIONS[names], lambda wxyz: np.roll(wxyz, -1, axis=-1))


def swapped():
    qpos = WALK.qpos.copy()
    qpos[:, np.concatenate(LEGS)] = qpos[:, np.concatenate(LEGS[::-1])]
    return WALK._replace(qpos=qpos)


def turned(angle):
    qpos, qvel = WALK.qpos.copy(), WALK.qvel.copy()
    cos, sin = np.cos(angle), np.sin(angle)
    for states in (qpos, qvel):
        states[:, :2] = states[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    for row in qpos:
        mujoco.mju_mulQuat(row[3:7], np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), row[3:7].copy())
    return WALK._replace(qpos=qpos, qvel=qvel)


def at_rate(times):
    """The walk, sampled `times` as often."""
    row = np.arange(0, 22, 1 / times)
    before, share = row.astype(int), (row % 1)[:, None]
    qpos, qvel = sample(WALK, np.arange(24))
    qvel = share * qvel[before + 1] + (1 - share) * qvel[before]
    return WALK._replace(qpos=mix_qpos(qpos[before + 1], qpos[before], share), qvel=qvel)


def shortened(motion, rows):
    """Some rows of a motion that ends."""
    qpos = motion.qpos[rows]
    return ReferenceMotion(qpos, motion.qvel[rows], qpos[-1, X] - qpos[0, X], periodic=False)


ANGLES = np.setdiff1d(np.arange(7, cassie.NQ), QUATERNIONS)
ALL_V = np.arange(cassie.NV)


@pytest.mark.parametrize(
    ("motion", "sentence"),
    [
        (
            as_xyzw([0, 1, 2]),
            "loops of the legs by 0.981 m; its quaternions look like x y z w",
        ),
        (as_xyzw([0]), "the pelvis faces 177 degrees away .*; its pelvis quaternion looks like x y z w"),
        (as_xyzw([1, 2]), "loops .*; its achilles-rod quaternions look like x y z w"),
        (swapped(), "loops of the legs by 0.0708 m; its legs look swapped"),
        (with_qpos(ANGLES, np.rad2deg), "tarsus at .* rad, limits .*; its joint angles look like degrees"),
        (with_qpos([X, Y, Z], lambda m: 1000 * m), "pelvis goes from 97. to 97. m, .*; its positions look like millim"),
        (with_qvel(ALL_V, lambda v: 100 * v), "pelvis velocities are 101 times .* look 101 times too large"),
        (with_qvel(ALL_V[3:], np.rad2deg), "angular velocities are 58.2 times .*, as degrees a second would be"),
        (with_qvel(ALL_V[6:], np.rad2deg), "joint velocities are .* times .*, as degrees a second would be"),
        (with_qvel(ALL_V, lambda v: 0.032 * v), "velocities are 0.0322 times .*, as changes per sample would be"),
        (with_qvel(ALL_V, np.zeros_like), "pelvis velocities do not follow the change of qpos"),
        (with_qvel(ALL_V[6:], lambda v: np.roll(v, 1, axis=1)), "joint velocities do not follow the change of qpos"),
        (WALK._replace(qpos=WALK.qpos[::-1]), "pelvis velocities are -1.01 times .*, as if reversed in time"),
        (at_rate(4), "or the samples 0.008 s apart instead of 0.032 s"),
        (with_qpos([X], lambda x: 3 * x), "pelvis velocities are 0.341 times .* look 2.93 times too small"),
        (
            WALK._replace(stride_length=WALK.stride_length / 2),
            "stride_length is 0.250 m, and its pelvis goes 0.500 m",
        ),
        (turned(np.pi / 2), "goes -0.000 m along x; it looks turned about the vertical: it is to go along x"),
        (turned(np.pi), "faces 180 degrees away from the x axis .*; it looks turned about the vertical"),
        (with_qpos([Z], lambda z: z + 0.15), "its lower foot is above the floor all the time, by 0.148 m or more"),
        (with_qpos([Z], lambda z: z - 0.15), "its lower foot is below the floor half the time, by 0.151 m or more"),
        (
            shortened(WALK, slice(15))._replace(periodic=True, stride_length=WALK.stride_length * 15 / 22),
            "its last row does not lead to its first, by 0.332 m or rad, as periodic=True wants",
        ),
    ],
)
def test_a_wrong_motion_is_refused_with_its_likely_cause(tmp_path, motion, sentence):
    save_motion(tmp_path / "bad.npz", motion, {})
    with pytest.raises(ValueError, match=f"bad.npz is no motion of Cassie: .*{sentence}"):
        load_motion(str(tmp_path / "bad.npz"))


def opened_by_noise():
    """Rods turned by so much that the loops open as those of public strides do, by 7 mm at most."""
    rng = np.random.default_rng(0)
    qpos = WALK.qpos.copy()
    qpos[:, QUATERNIONS[1:]] += 0.004 * rng.uniform(-1, 1, (22, 2, 4))
    qpos[:, QUATERNIONS] /= np.linalg.norm(qpos[:, QUATERNIONS], axis=-1, keepdims=True)
    return WALK._replace(qpos=qpos)


@pytest.mark.parametrize(
    "motion",
    [
        *(stretch(WALK, factor) for factor in (0, 0.5, 2, 4)),
        blend_motions(stretch(WALK, 4), stretch(WALK, 0), 0.3),
        WALK._replace(qpos=cassie.mirror_qpos(WALK.qpos), qvel=cassie.mirror_qvel(WALK.qvel)),
        shortened(WALK, slice(None)),
        shortened(WALK, slice(3, 5)),
        ReferenceMotion(WALK.qpos[[4, 4]], 0 * WALK.qvel[:2], np.array(0.0)),
        opened_by_noise(),
        turned(0.2),
    ],
)
def test_an_odd_motion_that_is_right_loads_in_silence(tmp_path, motion):
    save_motion(tmp_path / "odd.npz", motion, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_motion(str(tmp_path / "odd.npz"))
    np.testing.assert_array_equal(found.qpos, motion.qpos)


def test_references_of_shipped_policies_are_motions(tmp_path):
    for path in shipped_policies().values():
        policy = NumpyPolicy.load(path)
        length = np.array(policy.reference_stride_length)
        motion = ReferenceMotion(policy.reference_qpos.astype(float), policy.reference_qvel.astype(float), length)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_motion(motion, path)
        np.testing.assert_array_equal(aligned(motion).qpos, motion.qpos)


@pytest.mark.parametrize(
    ("motion", "sentence"),
    [
        (with_qpos([Z], lambda z: z + 0.06), "its lower foot is above the floor all the time, by 0.05"),
        (turned(0.55), "the pelvis faces 31 degrees away from the x axis"),
        (stretch(WALK, 1)._replace(stride_length=WALK.stride_length + 0.05), "its stride_length is 0.550 m"),
        (
            WALK._replace(
                qpos=WALK.qpos * np.where(np.arange(cassie.NQ) == X, -1, 1),
                qvel=WALK.qvel * np.where(ALL_V == 0, -1, 1),
                stride_length=-WALK.stride_length,
            ),
            "it goes -0.475 m along x",
        ),
    ],
)
def test_an_unusual_motion_loads_with_a_warning(tmp_path, motion, sentence):
    save_motion(tmp_path / "odd.npz", motion, {})
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        load_motion(str(tmp_path / "odd.npz"))
    assert any(f"odd.npz is an unusual motion: {sentence}" in str(each.message) for each in found)
    assert found[0].filename == __file__, "the caller's line is shown"


@pytest.mark.parametrize("rows", [slice(None), slice(None, None, 2), slice(7, 12)])
@pytest.mark.parametrize("names", [[0], [0, 1, 2], [2]])
def test_quaternions_of_the_other_sign_are_the_same_motion(tmp_path, rows, names):
    motion = WALK._replace(qpos=WALK.qpos.copy())
    for name in names:
        motion.qpos[rows, QUATERNIONS[name]] *= -1
    save_motion(tmp_path / "negated.npz", motion, {})
    np.testing.assert_array_equal(load_motion(str(tmp_path / "negated.npz")).qpos, WALK.qpos)


def test_what_a_run_has_saved_is_read_as_it_is(tmp_path):
    """Its policy was trained on these signs, whatever would be refused today."""
    motion = WALK._replace(qpos=WALK.qpos * np.where(np.isin(np.arange(cassie.NQ), QUATERNIONS), -1, 1))
    for saved in (motion, with_qvel(ALL_V, lambda v: 100 * v)):
        save_motion(tmp_path / "reference.npz", saved, {})
        np.testing.assert_array_equal(read_motion(tmp_path / "reference.npz")[0].qpos, saved.qpos)


def test_feet_of_the_walk_are_on_the_floor(model):
    heights = foot_heights(model, WALK.qpos)
    assert heights.shape == (22, 4)
    assert np.abs(heights.min(axis=1)).max() < 0.003
    half = np.roll(heights, 11, axis=0)[:, [2, 3, 0, 1]]
    np.testing.assert_allclose(half, heights, atol=1e-9)
