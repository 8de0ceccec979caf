"""Random starts around standing: what they are, and that both agents walk from them."""

import mujoco
import numpy as np
import pytest

from cassie_mjx import cli
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.loops import loop_error
from experiments import perturbed_starts
from experiments.perturbed_starts import PerturbedConfig, perturbed
from experiments.record_reference import foot_points


@pytest.fixture(scope="module")
def physics(model):
    return NativePhysics(model)


def test_starts_are_as_far_from_standing_as_asked(physics, standing_qpos):
    config = PerturbedConfig(robots=200, tilt_rad=0.04, joint_rad=0.03, drop_m=0.02, pelvis_mps=0.5, joint_radps=0.7)
    qpos, qvel = perturbed(config, physics)
    joints = np.abs(qpos - standing_qpos)[:, cassie.ACTIVE_QPOS]
    assert 0.029 < joints.max() <= 0.03
    w, x, y, z = qpos[:, 3:7].T
    # Cosine of the angle between the pelvis' axis and the vertical; two rotations of at most 0.04 rad.
    tilt = np.arccos(1 - 2 * (x**2 + y**2))
    assert 0.04 < tilt.max() < 0.04 * 2**0.5 + 1e-3
    np.testing.assert_allclose(2 * (w * z + x * y), 0, atol=2e-3)
    assert 0.49 < np.abs(qvel[:, :3]).max() <= 0.5
    assert 0.69 < np.abs(qvel[:, cassie.ACTIVE_QVEL]).max() <= 0.7
    lowest = foot_points(physics, qpos)[..., 2].min(axis=1)
    assert -1e-12 < lowest.min() < 0.001
    assert 0.019 < lowest.max() < 0.02 + 1e-12


def test_starts_keep_the_mechanism_closed_and_the_limits(physics):
    qpos, qvel = perturbed(PerturbedConfig(), physics)
    assert loop_error(physics.model, qpos).max() < 1e-9
    dt = 1e-5
    moved = qpos.copy()
    for configuration, velocity in zip(moved, qvel, strict=True):
        mujoco.mj_integratePos(physics.model, configuration, velocity, dt)
    # What opens after dt is of second order in qvel dt.
    assert loop_error(physics.model, moved).max() / dt < 5e-3
    limited = np.flatnonzero(physics.model.jnt_limited)
    low, high = physics.model.jnt_range[limited].T
    angles = qpos[:, physics.model.jnt_qposadr[limited]]
    assert ((angles > low) & (angles < high)).all()


def test_starts_follow_the_seed(physics):
    first, again, other = (perturbed(PerturbedConfig(robots=3, seed=seed), physics) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert (np.abs(first[0] - other[0]).max(axis=1) > 1e-3).all()


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("robots=0", "robots=0 must be a whole number from 1 to 100,000"),
        ("seconds=1", "seconds=1.0 must be from 5 to 3,600"),
        ("drop_m=-0.1", "drop_m=-0.1 must be from 0 to 1"),
        ("tilt_rad=nan", "tilt_rad=nan must be from 0 to 1.5"),
    ],
)
def test_starts_that_cannot_be_made(argument, sentence):
    with pytest.raises(ValueError, match=sentence):
        cli.parse(PerturbedConfig, [argument])


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_walks_a_minute_from_twenty_starts(name):
    result = perturbed_starts.walk(name, PerturbedConfig())
    assert len(result.fell) == 20
    assert not result.fell.any()
    np.testing.assert_allclose(result.speed_mps, 0.7, atol=0.1)
