"""MJX against MuJoCo C from the same states, and against the deadlock of jaxlib 0.10."""

import json
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Ground, Terrain
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_mjx_model, load_model
from experiments.agreement import loop_consistent

CONVERGED = ModelConfig(physics_hz=1000, contacts="walking", iterations=50, ls_iterations=50)
BATCH = 8
DAMPING = 0.5


@pytest.fixture(scope="module")
def physics():
    return MjxPhysics(load_mjx_model(MJX_TRAINING), max_delay=8)


@pytest.fixture(scope="module")
def native():
    """MuJoCo C at the same rate and with the same contacts, converged."""
    return NativePhysics(load_model(replace(CONVERGED, iterations=100)), max_delay=8)


@pytest.fixture(scope="module")
def states(native, standing_qpos):
    """BATCH robots: one at rest, the others at walking velocities; their targets, a push, and delays of 0 to 7 ms."""
    rng = np.random.default_rng(3)
    scales = np.array([0, 0.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])
    qvel = np.stack(
        [loop_consistent(native.model, standing_qpos, scale * rng.normal(size=cassie.NV)) for scale in scales]
    )
    targets = cassie.STANDING_TARGET + 0.1 * rng.normal(size=(BATCH, cassie.NU))
    scenario = replace(
        Scenario.nominal(BATCH),
        push=rng.uniform(-80, 80, (BATCH, 1, 3)),
        push_start=np.arange(BATCH, dtype=np.int32)[:, None] * 3,
        push_stop=np.arange(BATCH, dtype=np.int32)[:, None] * 3 + 25,
        delay=np.arange(BATCH, dtype=np.int32),
    )
    return np.tile(standing_qpos, (BATCH, 1)), qvel, targets, scenario


@pytest.fixture(scope="module")
def accelerations():
    """Differences of qacc in float64 at three speeds; in its own process, for JAX mixes precisions badly."""
    program = f"""
import json, jax
jax.config.update("jax_compilation_cache_dir", {str(jax.config.jax_compilation_cache_dir)!r})
from experiments.agreement import AgreementConfig, compare_accelerations
print(json.dumps([compare_accelerations(AgreementConfig(robots=4), speed) for speed in (0.0, 1.0, 3.0)]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("case", range(3))
def test_acceleration_equals_mujoco_c_in_float64(accelerations, case):
    """To 1e-6 with the term J̇v of the loops; without it, MJX is off by far more as soon as the robot moves."""
    found = accelerations[case]
    assert found["largest_qacc"] > 100
    assert found["difference_max"] < 1e-6
    if found["speed"]:
        assert found["difference_max_without_bias"] > 0.1
    else:
        assert found["difference_max_without_bias"] < 1e-6


def test_float32_over_one_and_ten_control_steps(physics, native, states):
    """Pushed, delayed and at walking velocities: within 0.1 mm and 1 mrad after 32 ms; the same motion after 320 ms."""
    qpos, qvel, targets, scenario = states
    c = native.init(qpos, qvel)
    x = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))
    c = native.advance(c, targets, scenario, 32)
    x = physics.advance(x, targets, scenario, 32)
    np.testing.assert_allclose(x.qpos, c.qpos, atol=1e-3)
    np.testing.assert_allclose(x.qpos[:, :3], c.qpos[:, :3], atol=1e-4)
    for _ in range(9):
        c = native.advance(c, targets, scenario, 32)
        x = physics.advance(x, targets, scenario, 32)
    np.testing.assert_allclose(x.qpos[:, :3], c.qpos[:, :3], atol=5e-3)
    np.testing.assert_allclose(x.qpos[:, cassie.ACTIVE_QPOS], c.qpos[:, cassie.ACTIVE_QPOS], atol=2e-2)
    np.testing.assert_array_equal(x.step, c.step)


def test_standing_has_the_same_outcome_in_both_engines(physics, native, standing_qpos):
    qpos, qvel = np.tile(standing_qpos, (BATCH, 1)), np.zeros((BATCH, cassie.NV))
    targets = np.tile(cassie.STANDING_TARGET, (BATCH, 1))
    c = native.init(qpos, qvel)
    x = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))
    for _ in range(63):
        c = native.advance(c, targets, Scenario.nominal(BATCH), 32)
        x = physics.advance(x, targets, Scenario.nominal(BATCH), 32)
        np.testing.assert_allclose(x.qpos[:, 2], c.qpos[:, 2], atol=2e-3)
        assert loop_error(native.model, np.asarray(x.qpos)).max() < 1e-3
    np.testing.assert_allclose(x.qpos[:, 2], standing_qpos[2], atol=2e-3)


def test_terrain_agrees_with_the_height_field(physics, standing_qpos):
    """Feet on slopes and crests of several heights: tangent planes here, a height field there."""
    heights = np.linspace(0, 0.3, BATCH)
    qpos = np.tile(standing_qpos, (BATCH, 1))
    qpos[:, 0] = np.linspace(0, 2 * np.pi, BATCH)
    qpos[:, 2] += heights * np.sin(qpos[:, 0]) + 0.02 * heights / 0.3
    qvel = np.zeros((BATCH, cassie.NV))
    targets = np.tile(cassie.STANDING_TARGET, (BATCH, 1))
    scenario = replace(Scenario.nominal(BATCH), ground=Ground.of([Terrain("sine", h) for h in heights]))
    hills = NativePhysics(load_model(replace(CONVERGED, scene="terrain", iterations=100)))
    c = hills.advance(hills.init(qpos, qvel), targets, scenario, 192)
    x = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))
    for _ in range(6):
        x = physics.advance(x, targets, scenario, 32)
    flat = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))
    for _ in range(6):
        flat = physics.advance(flat, targets, Scenario.nominal(BATCH), 32)
    np.testing.assert_allclose(x.qpos[:, :3], c.qpos[:, :3], atol=6e-3)
    assert np.abs(flat.qpos[:, :3] - c.qpos[:, :3]).max() > 0.05


def test_bodies_are_those_of_mujoco_c(physics, native, states):
    qpos, qvel, _, _ = states
    ours = physics.bodies(physics.init(qpos.astype(np.float32), qvel.astype(np.float32)))
    theirs = native.bodies(native.init(qpos, qvel))
    for name in ("xpos", "xmat", "xipos", "ximat", "cvel", "com"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=2e-5, err_msg=name)


def test_advance_can_be_scanned_inside_a_jit(physics, states):
    qpos, qvel, targets, scenario = states
    state = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))

    @jax.jit
    def three_steps(state, targets):
        return jax.lax.scan(lambda s, _: (physics.advance(s, targets, scenario, 32), None), state, None, length=3)[0]

    scanned = three_steps(state, jnp.asarray(targets, jnp.float32))
    for _ in range(3):
        state = physics.advance(state, targets, scenario, 32)
    np.testing.assert_allclose(scanned.qpos, state.qpos, atol=1e-3)


def test_far_from_the_origin_a_control_step_is_the_same(physics, states):
    """170 m is 60 s at four times the speed; float32 has steps of 15 µm there."""
    qpos, qvel, targets, scenario = states
    far = qpos + 170.0 * (np.arange(cassie.NQ) == 0)
    near, moved = (
        physics.advance(physics.init(q.astype(np.float32), qvel.astype(np.float32)), targets, scenario, 32)
        for q in (qpos, far)
    )
    np.testing.assert_allclose(np.asarray(moved.qpos[:, 0], float) - 170, near.qpos[:, 0], atol=1e-3)
    np.testing.assert_allclose(moved.qpos[:, 1:], near.qpos[:, 1:], atol=1e-3)
    np.testing.assert_allclose(moved.qvel, near.qvel, atol=0.1)


def test_bad_input_gets_one_sentence(physics, states):
    qpos, qvel, targets, scenario = states
    with pytest.raises(ValueError, match=r"qvel\[0, 3\] is inf"):
        physics.init(qpos, np.where(np.arange(cassie.NV) == 3, np.inf, qvel))
    state = physics.init(qpos.astype(np.float32), qvel.astype(np.float32))
    with pytest.raises(ValueError, match=r"target has shape \(8, 9\)"):
        physics.advance(state, targets[:, 1:], scenario, 1)
    with pytest.raises(ValueError, match="delay of 9 physics steps .* 0 to 8"):
        physics.advance(state, targets, replace(scenario, delay=scenario.delay + 2), 1)


@pytest.mark.parametrize("batch", [pytest.param(64, marks=pytest.mark.slow), 256])
def test_large_batches_finish(batch):
    """jaxlib 0.10 hangs here on machines with few cores: its batched Cholesky waits for the thread pool it runs on."""
    program = f"""
import jax, numpy as np
jax.config.update("jax_compilation_cache_dir", {str(jax.config.jax_compilation_cache_dir)!r})
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model, standing
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import Scenario
physics = MjxPhysics(load_mjx_model(MJX_TRAINING))
qpos = np.tile(standing(physics.model), ({batch}, 1)).astype(np.float32)
state = physics.init(qpos, np.zeros(({batch}, 32), np.float32))
state = physics.advance(state, np.tile(cassie.STANDING_TARGET, ({batch}, 1)), Scenario.nominal({batch}), 32)
print(float(np.mean(state.qpos[:, 2])))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=240, check=True)
    assert float(done.stdout.splitlines()[-1]) == pytest.approx(0.988, abs=0.002)
