"""Robots that differ: hand-worked numbers, what MuJoCo derives, the same on both engines, drawn in training."""

from dataclasses import fields, replace
from operator import itemgetter

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cassie_mjx.envs import privileged
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.dynamics import RANGES, draw_dynamics
from cassie_mjx.envs.make import make_env
from cassie_mjx.envs.scenario import ScenarioConfig, draw_scenario
from cassie_mjx.evaluation.dynamics import drawn_trials
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario, motor_torque, sensed
from cassie_mjx.robot import cassie
from cassie_mjx.robot.dynamics import Dynamics, set_dynamics, varied
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_mjx_model, load_model

ROBOTS, HZ = 6, 1000
MODEL = ModelConfig(physics_hz=HZ)
BODIES = len(cassie.BODIES)
POSES = cassie.STANDING_TARGET


@pytest.fixture(scope="module")
def native():
    return NativePhysics(load_model(MODEL))


@pytest.fixture(scope="module")
def late():
    """MuJoCo C with room for delays, on ground that can slope."""
    return NativePhysics(load_model(replace(MODEL, scene="terrain")), max_delay=6)


@pytest.fixture(scope="module")
def drawn():
    """Robots of the wide range, and their slopes."""
    return jax.tree.map(np.asarray, draw_dynamics(RANGES["wide"], jax.random.key(1), ROBOTS, HZ))


def of_one(robots, index):
    return jax.tree.map(itemgetter(index), robots)


def robots_of(state):
    return state.scenario.dynamics or pytest.fail("nothing was drawn")


def standing(physics, qpos, robots, height=0.0):
    start = np.tile(qpos, (robots, 1))
    start[:, cassie.PELVIS_Z] += height
    return physics.init(start, np.zeros((robots, cassie.NV)))


def velocity(qpos, qvel, dynamics):
    """Of the centre of mass of one robot, [3], m/s."""
    model = load_model(MODEL)
    data = mujoco.MjData(model)
    set_dynamics(model, dynamics, data)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data.subtree_linvel[0].copy()


def walk(physics, scenario, control_steps):
    """Robots of the reference motion's first poses under its own angles, which is a walk for a while."""
    motion, robots = load_motion("walk"), len(scenario.delay)
    kind = np.float32 if physics.traceable else np.float64
    state = physics.init(motion.qpos[:robots].astype(kind), motion.qvel[:robots].astype(kind))
    for k in range(1, control_steps + 1):
        target = motion.qpos[k : k + robots, cassie.ACTIVE_QPOS]
        state = physics.advance(state, target, scenario, round(0.032 / physics.model.opt.timestep))
    return state


# By hand


def test_a_heavier_robot_falls_as_fast_and_takes_more_force(native, standing_qpos):
    """In the air: g for all; a push changes the velocity by F t / m, 33.312 kg being the published mass."""
    dynamics = Dynamics.nominal(2, mass=np.array([[1.0], [1.3]]))
    scenario = Scenario.nominal(2, dynamics=dynamics, push=[[100.0, 0, 0]], push_stop=200)
    state = native.advance(standing(native, standing_qpos, 2, 5.0), np.tile(POSES, (2, 1)), scenario, 200)
    for robot, mass in enumerate((33.312, 1.3 * 33.312)):
        moving = velocity(state.qpos[robot], state.qvel[robot], of_one(dynamics, robot))
        np.testing.assert_allclose(moving, [100 * 0.2 / mass, 0, -9.81 * 0.2], atol=1e-3)


def test_a_leaf_spring_bends_by_its_torque_over_its_stiffness(native, standing_qpos):
    """A body held still but for its shin spring: k q = tau."""
    model = load_model(MODEL)
    data = mujoco.MjData(model)
    set_dynamics(model, Dynamics.nominal(stiffness=np.array(0.8)), data)
    shin = model.joint("left-shin")
    data.qpos[:] = standing_qpos
    data.qpos[shin.qposadr] = 0.02
    mujoco.mj_forward(model, data)
    assert data.qfrc_spring[shin.dofadr[0]] == pytest.approx(-0.8 * 1500 * 0.02)
    # Softer springs let a standing robot down.
    scenario = Scenario.nominal(2, dynamics=Dynamics.nominal(2, stiffness=np.array([1.0, 0.5])))
    state = native.advance(standing(native, standing_qpos, 2), np.tile(POSES, (2, 1)), scenario, 500)
    bent = abs(state.qpos[:, cassie.SHIN_QPOS]).mean(axis=1)
    assert bent[1] / bent[0] == pytest.approx(2, rel=0.1)


def test_motors_give_their_share_of_the_torque_and_gains_act_on_what_is_shown(standing_qpos):
    """With P = 100 N·m/rad of a hip roll that is 0.5 rad off, and its limit of 112.5 N·m."""
    hip, knee = 0, 3
    dynamics = Dynamics.nominal(
        4,
        strength=np.array([1.0, 0.5, 1.0, 1.0]),
        p_gain=np.array([1.0, 1.0, 1.2, 1.0]),
        d_gain=np.array([1.0, 1.0, 1.0, 0.7]),
        encoder_offset=np.array([[0.0], [0.0], [0.0], [0.03]]),
    )
    scenario = Scenario.nominal(4, dynamics=dynamics, kd_scale=np.asarray(0.5))
    physics = NativePhysics(load_model(MODEL))
    state = standing(physics, standing_qpos, 4)
    state.qvel[:, cassie.ACTIVE_QVEL] = 0.1
    target = state.qpos[:, cassie.ACTIVE_QPOS] + 0.5
    target[:, knee] += 10
    torque = motor_torque(state, target, scenario)
    damped = 0.5 * 10 * 0.1
    expected = [50 - damped, 0.5 * (50 - damped), 60 - damped, 100 * 0.47 - 0.7 * damped]
    np.testing.assert_allclose(torque[:, hip], expected)
    np.testing.assert_allclose(torque[:, knee], [195.2, 97.6, 195.2, 195.2])
    shown = sensed(state, scenario)[0] - state.qpos
    np.testing.assert_allclose(shown[3, cassie.ENCODER_QPOS], 0.03)
    assert np.count_nonzero(shown) == len(cassie.ENCODERS) == 14


def test_feet_slide_with_the_deceleration_of_their_friction(native, standing_qpos):
    """Along the floor a robot loses mu times the momentum that the floor gives it upwards, g t while it stands."""
    friction = np.array([0.1, 0.2])
    scenario = Scenario.nominal(2, dynamics=Dynamics.nominal(2, friction=friction))
    state = native.advance(standing(native, standing_qpos, 2), np.tile(POSES, (2, 1)), scenario, 200)
    state.qvel[:, 0] += 5.0
    after = native.advance(state, np.tile(POSES, (2, 1)), scenario, 50)
    for robot, mu in enumerate(friction.tolist()):
        before, now = (velocity(each.qpos[robot], each.qvel[robot], Dynamics.nominal()) for each in (state, after))
        (slower, _, rising) = now - before
        assert -slower == pytest.approx(mu * (9.81 * 0.05 + rising), rel=0.06)
        assert 9.81 * 0.05 + rising > 0.25


def test_dampers_and_the_pelvis_centre_of_mass():
    model = load_model(MODEL)
    changed = varied(model, Dynamics.nominal(damping=np.array(3.0), com=np.array([0.01, -0.02, 0.03])))
    np.testing.assert_allclose(changed["dof_damping"], 3 * model.dof_damping)
    moved = changed["body_ipos"] - model.body_ipos
    np.testing.assert_allclose(moved[cassie.PELVIS_BODY], [0.01, -0.02, 0.03])
    assert np.count_nonzero(moved) == 3


def test_late_torque_is_that_of_the_law_some_steps_ago(standing_qpos):
    """MuJoCo C by hand: a queue of torques, in which the first is not late."""
    physics = NativePhysics(load_model(MODEL), max_delay=5)
    late = np.array([0, 1, 5], np.int32)
    scenario = Scenario.nominal(3, dynamics=Dynamics.nominal(3, torque_delay=late))
    targets = np.stack([np.tile(POSES + each, (3, 1)) for each in (0.1, -0.1, 0.05)])
    state = standing(physics, standing_qpos, 3)
    for target in targets:
        state = physics.advance(state, target, scenario, 12)
    for robot, steps in enumerate(late.tolist()):
        data, asked = mujoco.MjData(physics.model), []
        data.qpos[:] = standing_qpos
        for now in range(36):
            q, qdot = data.qpos[cassie.ACTIVE_QPOS], data.qvel[cassie.ACTIVE_QVEL]
            asked.append(cassie.pd_torque(targets[now // 12, robot], q, qdot))
            data.ctrl[:] = asked[now - steps if now >= steps else now] / cassie.GEAR
            mujoco.mj_step(physics.model, data)
        np.testing.assert_allclose(state.qpos[robot], data.qpos, atol=1e-10)


# The engines


def test_robots_as_the_model_has_them_move_as_those_without_dynamics(native, late):
    for physics in (native, late):
        as_modelled = walk(physics, Scenario.nominal(ROBOTS, dynamics=Dynamics.nominal(ROBOTS)), 5)
        np.testing.assert_allclose(as_modelled.qpos, walk(physics, Scenario.nominal(ROBOTS), 5).qpos, atol=1e-9)


def test_servos_are_the_law_of_the_delayed_engine(native, drawn):
    """The two ways in which MuJoCo C has the PD law: in its motors, and outside."""
    robots = replace(drawn[0], torque_delay=np.zeros(ROBOTS, np.int32), strength=1.1 * drawn[0].strength)
    scenario = Scenario.nominal(ROBOTS, dynamics=robots)
    outside = NativePhysics(load_model(MODEL), max_delay=1)
    np.testing.assert_allclose(walk(outside, scenario, 5).qpos, walk(native, scenario, 5).qpos, atol=1e-7)


def test_each_robot_is_stepped_with_its_own_model(native, drawn):
    robots = replace(drawn[0], torque_delay=np.zeros(ROBOTS, np.int32))
    together = walk(native, Scenario.nominal(ROBOTS, dynamics=robots), 3).qpos
    for i in range(ROBOTS):
        same = jax.tree.map(lambda x, i=i: np.stack([x[i]] * ROBOTS), robots)
        np.testing.assert_array_equal(walk(native, Scenario.nominal(ROBOTS, dynamics=same), 3).qpos[i], together[i])


def test_mjx_derives_the_inverse_masses_that_mujoco_c_does(drawn):
    model = load_mjx_model(MJX_TRAINING)
    changes = jax.jit(jax.vmap(MjxPhysics(model)._changes))(drawn[0])
    limited = model.jnt_dofadr[np.flatnonzero(model.jnt_limited)]
    for i in range(ROBOTS):
        own = load_mjx_model(MJX_TRAINING)
        set_dynamics(own, of_one(drawn[0], i), mujoco.MjData(own))
        found = {name: np.asarray(value[i]) for name, value in changes.items()}
        np.testing.assert_allclose(found["body_invweight0"][:, 0], own.body_invweight0[:, 0], rtol=2e-3, atol=1e-6)
        np.testing.assert_allclose(found["dof_invweight0"][limited], own.dof_invweight0[limited], rtol=2e-3)
        assert abs(own.body_invweight0 / np.maximum(model.body_invweight0, 1e-9) - 1).max() > 0.05
        for name in varied(own, of_one(drawn[0], i)):
            np.testing.assert_allclose(found[name], getattr(own, name), rtol=1e-5, atol=1e-7)


def test_both_engines_walk_the_same_varied_robots(drawn):
    """Float32 on MJX, sensing 0 to 5 ms late: as near as robots that do not differ, and far from where those are."""
    scenario = Scenario.nominal(ROBOTS, dynamics=drawn[0], delay=np.arange(ROBOTS, dtype=np.int32))
    native = NativePhysics(load_model(MODEL), max_delay=6)
    c, nominal = walk(native, scenario, 4), walk(native, Scenario.nominal(ROBOTS), 4)
    assert abs(nominal.qpos - c.qpos).max(axis=1).min() > 0.01
    x = walk(MjxPhysics(load_mjx_model(MJX_TRAINING), 6, scene="flat"), scenario, 4)
    np.testing.assert_allclose(x.qpos[:, :3], c.qpos[:, :3], atol=1e-4)
    np.testing.assert_allclose(x.qpos, c.qpos, atol=1e-3)


# What is drawn


def test_draws_are_uniform_over_their_ranges():
    robots = 4000
    for span in RANGES.values():
        dynamics, slope = draw_dynamics(span, jax.random.key(0), robots, HZ)
        for name, values in {**vars(dynamics), "slope": slope}.items():
            low, high = (HZ * np.array(span.torque_delay)).round() if name == "torque_delay" else getattr(span, name)
            assert values.min() == pytest.approx(low, abs=0.01 * (high - low))
            assert values.max() == pytest.approx(high, abs=0.01 * (high - low))
            assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
        # Nothing follows from anything else.
        alone = np.stack([dynamics.friction, dynamics.damping, dynamics.mass[:, 1], dynamics.mass[:, 2], slope[:, 0]])
        np.testing.assert_allclose(np.corrcoef(alone), np.eye(5), atol=0.06)


def test_a_scaled_range_is_further_from_the_model():
    wide = RANGES["wide"].scaled(2)
    assert wide.mass == pytest.approx((0.49, 1.69))
    assert wide.friction == pytest.approx((0.09, 1.69))
    assert wide.com == pytest.approx((-0.16, 0.16))
    assert RANGES["moderate"].scaled(0.5).torque_delay == pytest.approx((0.00075, 0.00225))
    assert RANGES["wide"].scaled(1) == RANGES["wide"]


def test_what_else_is_drawn_stays_as_it_was():
    config, key = ScenarioConfig(push_n=100, delay_s=0.005, terrain_m=0.2), jax.random.key(2)
    plain, varying = (draw_scenario(config, key, 50, HZ, dynamics=span) for span in (None, RANGES["wide"]))
    assert plain.dynamics is None
    for name in ("push", "push_start", "delay", "kd_scale"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(varying, name))
    np.testing.assert_array_equal(plain.ground.sine, varying.ground.sine)
    slope = np.asarray(varying.ground.slope)
    assert not plain.ground.slope.any()
    assert 0.08 < abs(slope).max() < 0.1


def test_the_suite_draws_the_same_robots_each_time():
    these, those = (drawn_trials(RANGES["moderate"], 2000) for _ in range(2))
    assert len(these) == 200
    for one, other in zip(these[:9], those[:9], strict=True):
        jax.tree.map(np.testing.assert_array_equal, one.dynamics, other.dynamics)
        assert (one.start, one.slope) == (other.start, other.slope)
    assert {trial.start for trial in these} == set(range(8))
    assert min(int(trial.dynamics.torque_delay) for trial in these if trial.dynamics) == 3


@pytest.mark.parametrize("dynamics", ["moderate", "wide"])
def test_episodes_draw_robots_anew_and_robots_keep_theirs(dynamics):
    env = make_env(robots=8, physics_hz=500, config=WalkConfig(dynamics=dynamics, episode_steps=3, symmetric=False))
    state = env.reset(jax.random.key(0))
    assert state.privileged.shape == (8, 34)
    masses, last = [], state
    for i in range(4):
        masses.append(np.asarray(robots_of(state).mass))
        last, state = state, env.step(state, np.zeros((8, 10)), jax.random.key(i))
    over = np.asarray(last.terminated | last.truncated)
    assert over.any()
    np.testing.assert_array_equal((masses[3] != masses[2]).any(axis=1), over)
    # What is observed is what encoders show, also as an episode begins.
    angles = slice(12, 17)
    fresh = env.reset(jax.random.key(3))
    offset = np.asarray(robots_of(fresh).encoder_offset)[:, :5]
    true = np.asarray(fresh.physics.qpos)[:, cassie.ACTIVE_QPOS[:5]]
    np.testing.assert_allclose(np.asarray(fresh.observation)[:, angles], true + offset, atol=1e-6)


def test_a_step_on_mjx_keeps_the_kind_of_everything():
    """So that a loop over steps can be compiled; nothing is computed."""
    env = make_env(robots=4, physics="mjx", config=WalkConfig(dynamics="wide"))
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((4, 10), np.float32), jax.random.key(1))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert robots_of(state).torque_delay.dtype == np.int32


def test_a_critic_sees_what_robots_are_like_in_the_mirror_of_the_policy():
    offset = np.zeros((2, 14))
    offset[:, 0], offset[:, 10] = 0.02, -0.01
    robots = Dynamics.nominal(
        2, com=np.array([0.01, 0.05, 0.0]), friction=np.array([0.5, 1.2]), strength=0.9, encoder_offset=offset
    )
    robots = replace(robots, torque_delay=np.array([2, 4]))
    share = np.ones(BODIES) / BODIES
    seen = privileged.dynamics(robots, share, 0.001, jnp.array([[False], [True]]))
    # Left hip roll is minus the right one in the mirror, left shin is the right one.
    shown = np.zeros((2, 14))
    shown[0, [0, 10]], shown[1, [5, 12]] = [1, -0.5], [-1, -0.5]
    factors = [[0, -0.5, 0, 0, -0.1, 0, 0], [0, 0.2, 0, 0, -0.1, 0, 0]]
    rest = [[0.2, 1, 0, 0.4], [0.2, -1, 0, 0.8]]
    np.testing.assert_allclose(seen, np.concatenate([factors, rest, shown], axis=1), atol=1e-6)


def test_what_does_not_fit_gets_one_sentence(native, standing_qpos):
    state, target = standing(native, standing_qpos, 2), np.tile(POSES, (2, 1))
    wrong = Scenario.nominal(2, dynamics=Dynamics.nominal(3))
    with pytest.raises(ValueError, match=r"scenario.dynamics.mass has shape \(3, 26\); for 2 robots"):
        native.advance(state, target, wrong, 1)
    slow = Scenario.nominal(2, dynamics=Dynamics.nominal(2, torque_delay=np.int32(3)))
    with pytest.raises(ValueError, match="delay of 3 physics steps was asked of an engine made for 0 to 0"):
        native.advance(state, target, slow, 1)
    with pytest.raises(ValueError, match="dynamics=some is not known; choose one of none, moderate, wide"):
        WalkConfig(dynamics="some")
    assert {field.name for field in fields(Dynamics)} | {"slope"} == set(vars(RANGES["wide"]))
