"""A stride beside the reference's: joints by name, places of the feet by hand."""

import json

import numpy as np
import pytest

from cassie_mjx.agents.make import make_agent
from cassie_mjx.motion.files import load_motion
from cassie_mjx.robot import cassie
from experiments import stride
from experiments.stride import StrideConfig, beside, joint_angles, placements


def test_joint_angles_go_by_side_and_name():
    qpos = np.zeros((2, cassie.NQ))
    qpos[1, cassie.qpos_index("right-knee")] = -1.2
    angles = joint_angles(qpos)
    assert list(angles) == list(cassie.ACTIVE)
    assert angles["knee"] == {"left": [0, 0], "right": [0, -1.2]}


@pytest.mark.parametrize("begins_down", [False, True])
def test_places_are_means_of_whole_times_on_the_floor(begins_down):
    # One point of the foot, at y = 0.1; x and height of five times.
    path = [(0.0, 0.1), (0.4, 0.0), (0.6, 0.0), (0.8, 0.1), (1.0, 0.0)]
    path = [(-0.2, 0.0), *path] if begins_down else path
    points = np.array([[[x, 0.1, z], [x, 0.1, z]] for x, z in path])
    assert placements(points) == [[0.5, 0.1]]


def test_a_heel_on_the_floor_is_a_foot_on_the_floor():
    toe, heel = np.full((3, 3), 0.1), np.array([[0.3, 0.1, 0.1], [0.3, 0.1, 0.0], [0.3, 0.1, 0.1]])
    assert placements(np.stack([toe, heel], axis=1)) == [[0.2, 0.1]]


def test_the_reference_goes_on_from_stride_to_stride():
    motion = load_motion("walk")
    x = stride.reference(motion, 3 * len(motion.qpos))[:, 0]
    np.testing.assert_allclose(x[:: len(motion.qpos)] - x[0], motion.stride_length * np.arange(4), rtol=1e-6)


def test_both_stand_side_by_side():
    both = beside({"knee": {"left": [1]}}, {"knee": {"left": [2]}})
    assert both == {"knee": {"left": {"walked": [1], "reference": [2]}}}


def test_the_file_says_which_policy_walked(tmp_path, monkeypatch):
    monkeypatch.setattr(stride, "STRIDES", 2)
    stride.main(StrideConfig("1x", str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    assert {row["agent"] for row in content["rows"]} == {"1x"}
    assert content["provenance"]["policy"] == "1x"
    assert content["provenance"]["agent"] == make_agent("1x").provenance


def test_a_controller_has_no_reference(tmp_path):
    with pytest.raises(ValueError, match="imitates no reference; name a trained policy"):
        stride.main(StrideConfig("controller:stiff", str(tmp_path / "a.json")))
    assert not list(tmp_path.iterdir())
