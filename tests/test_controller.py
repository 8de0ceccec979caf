from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cassie_mjx import cli, controller, robot
from cassie_mjx.controller import COMPLIANT, CONTROLLERS, STIFF, ControllerState
from cassie_mjx.kinematics import inverse_kinematics, level_foot
from cassie_mjx.model import ModelConfig, close_loops, load
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Disturbance
from experiments.tune_controller import TuneConfig, candidate, parameters

jitted_step = jax.jit(controller.step)
STRIDE_S = 0.704


@pytest.fixture(scope="module")
def physics(model):
    return NativePhysics(model)


@pytest.fixture(scope="module")
def terrain():
    return NativePhysics(load(ModelConfig(scene="terrain")))


def perturbed(qpos, robots, seed):
    """Standing robots with a small push to every speed: pelvis 0.02 m/s and rad/s, joints 0.004 rad/s."""
    scale = np.r_[np.full(6, 0.02), np.full(robot.NV - 6, 0.004)]
    return np.tile(qpos, (robots, 1)), np.random.default_rng(seed).normal(0, scale, (robots, robot.NV))


def walk(physics, config, state, control, seconds, disturbance=None):
    """Walk on; returns the end, and qpos every 32 ms, [samples, B, 35]. A robot that falls stays in the record."""
    disturbance = disturbance or Disturbance.none(len(state.qpos))
    n_steps = round(config.period * 2000)
    samples = []
    for call in range(round(seconds / config.period)):
        if call % round(0.032 / config.period) == 0:
            samples.append(state.qpos)
        target, control = jitted_step(config, control, state.qpos, state.qvel, physics.bodies(state), config.period)
        state = physics.advance(state, np.nan_to_num(np.asarray(target)), disturbance, n_steps)
    return state, control, np.array(samples)


def start(physics, config, qpos, qvel):
    state = physics.init(qpos, qvel)
    return state, controller.init(config, qpos, qvel, physics.bodies(state))


def stayed_up(samples, height=0.0):
    z = samples[..., 2] - height * np.sin(samples[..., 0])
    return ((z > 0.6) & (z < 1.2)).all(axis=0)


@pytest.mark.parametrize("side", [0, 1])
def test_inverse_kinematics_reaches_the_ankle_in_mujoco(model, physics, standing_qpos, side):
    rng = np.random.default_rng(side)
    for _ in range(10):
        sigma = 1 - 2 * side
        ankle = np.array([rng.uniform(-0.4, 0.4), sigma * rng.uniform(0.05, 0.3), rng.uniform(-0.95, -0.7)])
        yaw = rng.uniform(-0.2, 0.2)
        angles = inverse_kinematics(jnp.array(ankle), jnp.array(yaw), jnp.array(side))
        foot = level_foot(angles[2], jnp.zeros(()))
        qpos = standing_qpos.copy()
        qpos[:3], qpos[3:7] = (0, 0, 2), (1, 0, 0, 0)
        qpos[robot.ACTIVE_QPOS.reshape(2, 5)[side]] = [*angles, foot]
        name = robot.SIDES[side]
        qpos[robot.qpos_index(f"{name}-shin", f"{name}-heel-spring")] = 0
        qpos[robot.qpos_index(f"{name}-tarsus")] = np.deg2rad(12.5) - angles[3]
        qpos[robot.qpos_index(f"{name}-foot-crank")] = foot
        qpos[robot.qpos_index(f"{name}-plantar-rod")] = -foot
        bodies = physics.bodies(physics.init(close_loops(model, qpos)[None], np.zeros((1, robot.NV))))
        body = robot.FOOT_BODIES[side]
        np.testing.assert_allclose(bodies.xpos[0, body] - [0, 0, 2], ankle, atol=5e-3)
        sole = bodies.xmat[0, body] @ (robot.TOE - robot.HEEL)
        # A level sole points to the toe along the leg's yaw; roll of the hip tips what yaw turns out of the plane.
        assert abs(sole[2]) < np.linalg.norm(sole) * np.sin(np.deg2rad(1) + abs(angles[0] * yaw))


def test_foot_placement_ends_the_next_step_at_the_wanted_velocity():
    config = replace(STIFF, gain_x=1.0, gain_y=1.0)
    height, steps_s = 0.87, config.step_time
    omega = np.sqrt(9.81 / height)
    velocity = np.array([1.1, 0.5])
    f = np.array(
        controller.foot_placement(config, jnp.array(velocity), jnp.array(height), jnp.array(0), jnp.array(0.0))
    )
    # The pendulum x'' = omega^2 x from x = -f: v(T) = C v - omega S f.
    after = np.cosh(omega * steps_s) * velocity - omega * np.sinh(omega * steps_s) * f
    # A gait of width W is at -W/2 when a left step starts, and passes +-v_0: v_0 = omega W/2 tanh(omega T/2).
    v_0 = omega * config.width / 2 * np.tanh(omega * steps_s / 2)
    np.testing.assert_allclose(after, [config.speed, -v_0], atol=1e-5)


def test_legs_switch_after_exactly_eleven_samples_of_32_ms(physics, standing_qpos):
    state, control = start(physics, STIFF, *perturbed(standing_qpos, 1, 0))
    bodies = jax.tree.map(jnp.asarray, physics.bodies(state))
    qpos, qvel = jnp.asarray(state.qpos), jnp.asarray(state.qvel)

    def tick(control, _):
        target, control = controller.step(STIFF, control, qpos, qvel, bodies, 0.001)
        return control, (target, control.stance[0])

    _, (targets, stance) = jax.jit(lambda c: jax.lax.scan(tick, c, length=60000))(control)
    assert targets.dtype == jnp.float32
    assert targets.shape == (60000, 1, 10)
    # Half a step of 176 calls first, then every 352 calls, for a minute of float32 clock.
    np.testing.assert_array_equal(np.flatnonzero(np.diff(stance)) + 1, np.arange(176, 60000, 352))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_mirrored_robot_gets_mirrored_targets(physics, standing_qpos, name):
    config = CONTROLLERS[name]
    qpos, qvel = perturbed(standing_qpos, 2, 1)
    state, control, _ = walk(physics, config, *start(physics, config, qpos, qvel), seconds=0.3)
    mirrored = physics.init(robot.mirror_qpos(state.qpos), robot.mirror_qvel(state.qvel))
    flip = np.array([1, -1, 1])
    line_w = control.line_w * np.array([1, -1, -1])
    other = ControllerState(control.phase, 1 - control.stance, control.liftoff_w * flip, line_w)
    target, _ = jitted_step(config, control, state.qpos, state.qvel, physics.bodies(state), 0.001)
    image, _ = jitted_step(config, other, mirrored.qpos, mirrored.qvel, physics.bodies(mirrored), 0.001)
    # The published pelvis is not quite symmetric: its centre of mass is 0.3 mm off the plane.
    np.testing.assert_allclose(robot.mirror_active(np.array(target)), image, atol=0.02)


def test_parameters_of_each_robots_own(physics, standing_qpos):
    state, control = start(physics, STIFF, *perturbed(standing_qpos, 2, 2))
    arguments = (control, state.qpos, state.qvel, physics.bodies(state), 0.001)
    both = jax.tree.map(lambda a, b: np.array([a, b], np.float32), STIFF, COMPLIANT)
    own, _ = jitted_step(both, *arguments)
    expected = [np.array(jitted_step(config, *arguments)[0])[i] for i, config in enumerate((STIFF, COMPLIANT))]
    np.testing.assert_allclose(own, expected, rtol=1e-4, atol=1e-4)
    assert np.abs(expected[0] - expected[1]).max() > 0.01


@pytest.mark.parametrize("name", CONTROLLERS)
def test_walks_from_standing_at_the_reference_pace(physics, standing_qpos, name):
    config = CONTROLLERS[name]
    *_, samples = walk(physics, config, *start(physics, config, *perturbed(standing_qpos, 2, 3)), seconds=7)
    assert stayed_up(samples).all()
    stride = samples[-1, :, 0] - samples[-23, :, 0]
    np.testing.assert_allclose(stride / STRIDE_S, 0.7, atol=0.1)
    np.testing.assert_allclose(samples[-1, :, 1], 0, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_walks_a_minute_from_twenty_starts(physics, standing_qpos, name):
    config = CONTROLLERS[name]
    *_, samples = walk(physics, config, *start(physics, config, *perturbed(standing_qpos, 20, 4)), seconds=60)
    assert stayed_up(samples).all()
    np.testing.assert_allclose((samples[-1, :, 0] - samples[0, :, 0]) / 60, 0.7, atol=0.1)


def eight_phases(physics, config, qpos):
    """The walk at phases k/8 of the stride, one robot each, moved to x = 0."""
    state, control, _ = walk(
        physics, config, *start(physics, config, qpos[None], np.zeros((1, robot.NV))), seconds=7.04
    )
    moments = []
    for _ in range(8):
        moments.append((state, control))
        state, control, _ = walk(physics, config, state, control, STRIDE_S / 8)
    state, control = jax.tree.map(lambda *leaves: np.concatenate(leaves), *moments)
    x = state.qpos[:, 0].copy()
    for array in (state.qpos, control.liftoff_w, control.line_w):
        array[:, 0] -= x
    return replace(state, step=np.zeros_like(state.step)), control


# What the paper reports for its reference controller and for its learned policy: N forward, backward, sideways; m.
PAPER = {"compliant": (50, 70, 15, 0.07), "stiff": (140, 90, 50, 0.15)}


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_survives_pushes_that_the_paper_reports(physics, standing_qpos, name):
    config = CONTROLLERS[name]
    forward, backward, sideways, _ = PAPER[name]
    x, y = (1.0, 0.0), (0.0, 1.0)
    pushes = [(f, x) for f in (forward, -backward)] + [(f, y) for f in (sideways, -sideways)]
    forces = np.array([[f * along[0], f * along[1], 0.0] for f, along in pushes])
    state, control = jax.tree.map(
        lambda a: np.repeat(a, len(forces), axis=0), eight_phases(physics, config, standing_qpos)
    )
    calm = Disturbance.none(len(state.qpos))
    push = replace(calm, push=np.tile(forces, (8, 1)), push_stop=np.full(len(state.qpos), 400, np.int32))
    *_, samples = walk(physics, config, state, control, 4.2, push)
    assert stayed_up(samples).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_walks_blind_over_the_papers_terrain(physics, terrain, standing_qpos, name):
    config, height = CONTROLLERS[name], PAPER[name][3]
    state, control = eight_phases(physics, config, standing_qpos)
    sine = replace(Disturbance.none(8), terrain=np.full(8, height))
    *_, samples = walk(terrain, config, state, control, 10.0, sine)
    assert stayed_up(samples, height).all()


@pytest.mark.parametrize(
    ("preset", "wrong"), [("soft", {}), ("stiff", {"population": 2}), ("stiff", {"generations": 0})]
)
def test_tuner_refuses_what_it_cannot_search(preset, wrong):
    with pytest.raises(
        ValueError, match=r"preset='soft' is not known; choose one of stiff|too small; it must be at least"
    ):
        TuneConfig(preset=preset, **wrong)


def test_tuner_names_its_keys():
    with pytest.raises(ValueError, match="'sed' is not a key; the keys are preset, generations"):
        cli.parse(TuneConfig, ["sed=1"])


@pytest.mark.parametrize("preset", CONTROLLERS)
def test_search_starts_at_the_shipped_preset(preset):
    nowhere = np.zeros(len(parameters(preset)))
    flat = jax.tree.leaves(candidate(preset, nowhere))
    np.testing.assert_allclose(flat, jax.tree.leaves(CONTROLLERS[preset]), rtol=1e-6)
    assert candidate("compliant", np.ones(len(parameters("compliant")))).knee_p == COMPLIANT.knee_p
    assert candidate("stiff", np.ones(len(parameters("stiff")))).knee_p > STIFF.knee_p
