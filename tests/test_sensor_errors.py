"""Senses that are off: by hand, and the suite that measures what agents bear of it."""

import numpy as np
import pytest

from cassie_mjx.agents.make import make_agent
from cassie_mjx.evaluation import sensors
from cassie_mjx.evaluation.sensors import MisledAgent, SensorErrors, cases
from cassie_mjx.evaluation.setup import EvalSetup
from cassie_mjx.robot import cassie
from cassie_mjx.robot.rotation import tilted

RIGHT = SensorErrors.none(2)


def upright():
    qpos = np.zeros((2, cassie.NQ))
    qpos[:, 3] = 1
    return qpos, np.zeros((2, cassie.NV))


def test_right_senses_show_what_there_is():
    rng = np.random.default_rng(0)
    qpos, qvel = rng.normal(size=(2, cassie.NQ)), rng.normal(size=(2, cassie.NV))
    seen, seen_v = RIGHT.misread(qpos, qvel)
    np.testing.assert_allclose(seen, qpos, rtol=1e-6)
    np.testing.assert_allclose(seen_v, qvel, rtol=1e-6)


def test_a_leaning_imu_by_hand():
    """0.2 rad about x, and 0.1 rad about y: half angles of 0.1 and 0.05."""
    errors = RIGHT._replace(tilt=np.array([[0.2, 0.0], [0.0, 0.1]]))
    seen, _ = errors.misread(*upright())
    expected = [[np.cos(0.1), np.sin(0.1), 0, 0], [np.cos(0.05), 0, np.sin(0.05), 0]]
    np.testing.assert_allclose(seen[:, 3:7], expected, atol=1e-7)
    # By 90 degrees about x, the IMU's -z is the pelvis' y; by 90 degrees about y, its z is the pelvis' x.
    turning = upright()[0], np.zeros((2, cassie.NV))
    turning[1][:, 3:6] = [[1.0, 2.0, 0.0], [1.0, 2.0, 0.0]]
    _, seen_v = RIGHT._replace(tilt=np.pi / 2 * np.eye(2)).misread(*turning)
    np.testing.assert_allclose(seen_v[:, 3:6], [[1, 0, -2], [0, 2, 1]], atol=1e-6)
    # A robot that looks to the left leans about its own axes: (c, 0, 0, s) (cos, 0, sin, 0) has x = -s sin.
    left = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])
    leaned = tilted(left, np.array([0.0, 0.1]))
    half = np.sqrt(0.5)
    expected = half * np.array([np.cos(0.05), -np.sin(0.05), np.sin(0.05), np.cos(0.05)])
    np.testing.assert_allclose(leaned, expected, atol=1e-12)


def test_a_heading_drifts_with_time():
    """1 and 2 rad/s for ten control steps, 0.32 s."""
    errors = RIGHT._replace(drift=np.array([1.0, 2.0]), step=np.array([10, 10], np.int32))
    seen, _ = errors.misread(*upright())
    np.testing.assert_allclose(seen[:, [3, 6]], [[np.cos(0.16), np.sin(0.16)], [np.cos(0.32), np.sin(0.32)]], atol=1e-6)


def test_noise_has_its_width_and_is_another_each_step_and_for_each_robot():
    many = SensorErrors.none(500)._replace(noise=np.full(500, 2.0))
    still = np.tile(upright()[0][:1], (500, 1)), np.zeros((500, cassie.NV))
    seen, seen_v = (np.asarray(part) for part in many.misread(*still))
    off = np.concatenate([seen - still[0], seen_v], axis=1)
    widths = np.abs(off).max(axis=0)
    measured = [*range(7), *cassie.ENCODER_QPOS, *(35 + np.arange(6)), *(35 + cassie.qvel_index(*cassie.ENCODERS))]
    expected = 2 * np.repeat([0.02, 0.01, 0.01, 0.1, 0.2, 0.2], [3, 4, 14, 3, 3, 14])
    np.testing.assert_allclose(widths[measured], expected, rtol=0.03)
    np.testing.assert_array_equal(np.delete(widths, measured), 0)
    later = np.asarray(many._replace(step=many.step + 1).misread(*still)[0])
    assert np.abs(later - seen)[:, 3].min() > 0
    again = np.asarray(many.misread(*still)[0])
    np.testing.assert_array_equal(again, seen)


def test_forty_robots_lean_in_five_directions_from_each_phase():
    found = cases()
    assert [name for name in found if "noise" in name] == [f"sensors_noise_x{k}_survived" for k in (0, 1, 2, 4)]
    errors, _, _ = found["sensors_tilt_0.05rad_survived"]
    np.testing.assert_allclose(np.linalg.norm(errors.tilt, axis=1), 0.05)
    np.testing.assert_allclose(errors.tilt.reshape(5, 8, 2).sum(axis=0), 0, atol=1e-12)
    np.testing.assert_array_equal(errors.noise, 1)
    _, offset, _ = found["sensors_offset_0.03rad_survived"]
    assert offset.shape == (40, 14)
    assert 0.029 < np.abs(offset).max() <= 0.03


def test_the_suite_says_who_stayed_up(monkeypatch):
    """Eight robots for a fifth of a second: nobody falls so soon, and an IMU that lies on its side makes all fall."""
    few, long = SensorErrors.none(8), 2.5
    lying = few._replace(tilt=np.full((8, 2), 1.2))
    monkeypatch.setattr(sensors, "ROBOTS", 8)
    monkeypatch.setattr(
        sensors, "cases", lambda: {"right": (few, np.zeros((8, 14)), 0.2), "lying": (lying, np.zeros((8, 14)), long)}
    )
    result = sensors.sensors(make_agent("1x"), EvalSetup())
    assert [(metric.quantity, metric.value, metric.n) for metric in result.metrics] == [
        ("right", 1, 8),
        ("lying", 0, 8),
    ]


def test_agents_that_see_bodies_are_refused():
    with pytest.raises(ValueError, match="suite=sensors is for policies, and controller:stiff acts on more"):
        MisledAgent(make_agent("controller:stiff"))
