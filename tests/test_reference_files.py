"""Files of motions, ours and the published format: there and back again, and what is refused."""

from typing import Any

import jax
import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion, read_motion, read_trajectory, save_motion, shipped_path
from cassie_mjx.motion.reference import ReferenceMotion, sample
from cassie_mjx.robot import cassie

X, Z = cassie.qpos_index("pelvis")[[0, 2]]
ROTATION = cassie.qpos_index("pelvis")[3:]
ACHILLES = [cassie.qpos_index(f"{side}-achilles-rod") for side in cassie.SIDES]


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


def test_save_and_load_round_trip(tmp_path, motion):
    save_motion(tmp_path / "motion.npz", motion, {"seed": 3, "command": "none"})
    found, provenance = read_motion(tmp_path / "motion.npz")
    assert provenance == {"seed": 3, "command": "none"}
    for ours, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(motion), strict=True):
        np.testing.assert_array_equal(ours, wanted)
    assert load_motion(str(tmp_path / "motion.npz")).stride_length == motion.stride_length
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
        (lambda m: m._replace(qpos=m.qpos[:, :-1]), r"shapes \(22, 34\), \(22, 32\), \(\); a motion has \[N, 35\]"),
        (lambda m: ReferenceMotion(m.qpos[:1], m.qvel[:1], m.stride_length), "N at least 2"),
        (lambda m: spoil(m, qvel=((3, 4), np.nan)), "qvel has values that are not finite numbers"),
        (lambda m: m._replace(stride_length=np.array(np.inf)), "stride_length has values that are not finite"),
        (
            lambda m: spoil(m, qpos=((7, ROTATION), 0.9)),
            "no motion of Cassie: row 7 has a pelvis quaternion of norm 1.8",
        ),
        (lambda m: spoil(m, qpos=((2, Z), 0.2)), r"the pelvis goes from 0.2 to 0.97\d m"),
        (lambda m: spoil(m, qpos=((5, cassie.qpos_index("left-knee")), 1.0)), "row 5 has left-knee at 1 rad, limits"),
    ],
)
def test_a_saved_motion_that_is_none(tmp_path, motion, change, sentence):
    save_motion(tmp_path / "bad.npz", change(motion), {})
    with pytest.raises(ValueError, match=f"bad.npz.*{sentence}"):
        read_motion(tmp_path / "bad.npz")


def test_a_file_of_another_kind(tmp_path, motion):
    path = tmp_path / "bad.npz"
    with pytest.raises(ValueError, match=r"There is no reference motion file .*bad.npz"):
        read_motion(path)
    path.write_bytes(shipped_path("walk").read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"bad.npz is damaged"):
        read_motion(path)
    np.savez(path, qpos=motion.qpos)
    with pytest.raises(ValueError, match=r"bad.npz is not a cassie-mjx reference motion"):
        read_motion(path)
    content: dict[str, Any] = dict(np.load(shipped_path("walk")))
    content["version"] = 9
    np.savez(path, **content)
    with pytest.raises(ValueError, match=r"bad.npz has version 9; this program reads versions 1 and 2"):
        read_motion(path)
    content["qpos"] = np.array([{}])
    np.savez(path, **content)
    with pytest.raises(ValueError, match=r"bad.npz is damaged .*: qpos is no array of numbers or texts"):
        read_motion(path)
    with pytest.raises(ValueError, match="reference='wlak' is neither walk nor a file"):
        load_motion("wlak")


def trajectory(motion, duration):
    """Rows of the public format: the motion at 2 kHz, paced to last `duration` s; its velocities are left alone."""
    # A stride and the first sample of the next.
    qpos, qvel = sample(motion, np.arange(23))
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
    found = load_motion(str(path))
    for ours, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(motion), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-9)


def test_trajectory_of_the_published_duration_becomes_26_samples(tmp_path, motion):
    found = read_trajectory(write_trajectory(tmp_path / "stride.bin", trajectory(motion, 0.84)))
    assert found.qpos.shape == (26, cassie.NQ)
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
        (lambda rows: rows + 3 * (np.arange(98) == 1 + cassie.ACTIVE_QPOS[4]), "left-foot at 1.5.* rad, limits"),
        (lambda rows: rows * (np.arange(98) > 0), "time, must rise with each row"),
        (lambda rows: np.where(np.arange(98) == 0, rows * 1e9, rows), "by 0.064 to 10 s in all"),
        (lambda rows: np.vstack([rows[:-1], np.where(np.arange(98) == 0, np.inf, rows[-1])]), "by 0.064 to 10 s in"),
        (lambda rows: rows[: len(rows) // 3], "its last row must repeat the first besides x, and is off by 0.[1-9]"),
    ],
)
def test_a_trajectory_file_that_is_none(tmp_path, motion, change, sentence):
    path = write_trajectory(tmp_path / "bad.bin", change(trajectory(motion, 0.704)))
    with pytest.raises(ValueError, match=f"bad.bin.*({sentence})"):
        read_trajectory(path)


@pytest.mark.parametrize("change", [{"song": 1}, {"qvel": None}, {"periodic": 1}, {"periodic": [True]}])
def test_a_motion_without_a_digest_has_exactly_its_arrays(tmp_path, change):
    path = tmp_path / "old.npz"
    content: dict[str, Any] = dict(np.load(shipped_path("walk"))) | {"version": 1}
    np.savez(path, **content)
    with pytest.warns(UserWarning, match=r"old.npz is of version 1 of its format, whose damage can go unnoticed"):
        assert load_motion(str(path)).qpos.shape == (22, cassie.NQ)
    np.savez(path, **{name: value for name, value in (content | change).items() if value is not None})
    with pytest.raises(ValueError, match=r"old.npz is damaged: it does not have qpos, qvel, stride_length, periodic"):
        load_motion(str(path))
