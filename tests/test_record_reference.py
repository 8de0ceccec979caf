"""The recorder of the reference motion, and that the shipped file is its work."""

import json

import numpy as np
import pytest

from cassie_mjx.motion.files import load_motion, read_motion, shipped_path
from cassie_mjx.robot import cassie
from experiments.record_reference import RecordConfig, choose, record, slip


def test_the_recorder_takes_the_stride_nearest_to_half_a_metre():
    qpos = np.zeros((3, 4, cassie.NQ))
    qpos[..., 2] = 0.9
    qpos[1, 2, 2] = 0.5
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
    with pytest.raises(ValueError, match="preset=soft is not known; choose one of stiff, compliant"):
        RecordConfig(preset="soft")
    with pytest.raises(ValueError, match="strides=5 must be a whole number from 43 to 10,000"):
        RecordConfig(strides=5)
    with pytest.raises(ValueError, match="speeds is empty"):
        RecordConfig(speeds=())


def test_shipped_file_says_where_it_comes_from():
    _, provenance = read_motion(shipped_path("walk"))
    assert provenance["command"].startswith("python -m experiments.record_reference preset=compliant")
    assert provenance["period_s"] == pytest.approx(0.704)
    assert provenance["end_minus_start_qpos"] < 1e-3
    assert provenance["asymmetry_qpos"] < 2e-3
    assert provenance["simulated_loop_error_m"] < 1e-3
    assert provenance["slip_m"] < 0.01
    json.dumps(provenance)


@pytest.mark.slow
def test_shipped_file_is_what_the_recorder_makes():
    """The walk has converged onto one cycle; other processors round otherwise on the way to it."""
    _, provenance = read_motion(shipped_path("walk"))
    again, figures = record(RecordConfig(preset=provenance["preset"], strides=provenance["strides"]))
    motion = load_motion("walk")
    assert figures["controller_speed_mps"] == provenance["controller_speed_mps"]
    np.testing.assert_allclose(again.stride_length, motion.stride_length, atol=1e-3)
    np.testing.assert_allclose(again.qpos, motion.qpos, atol=2e-3)
    np.testing.assert_allclose(again.qvel, motion.qvel, atol=0.1)
