"""A policy that learns one of the stride's two steps, and takes the other as in a mirror."""

import json
from dataclasses import replace
from functools import partial
from typing import Any

import acting
import jax
import mujoco
import numpy as np
import pytest
from seeing import FULL, canonical, in_both_steps, observe
from tiny import TINY, session

from cassie_mjx.agents.make import make_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_arrays import Mirror
from cassie_mjx.agents.policy_file import learner_policy, save_policy
from cassie_mjx.control import command as motions
from cassie_mjx.control.law import ControlLaw, second_step
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.evaluation.returns import CHOOSING_PHASES, agent_returns
from cassie_mjx.evaluation.setup import EvalSetup
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import stretch
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.ppo import learner, networks
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_model, xml_path


@pytest.fixture(scope="module")
def motion():
    return load_motion("walk")


@pytest.fixture(scope="module")
def states():
    rng = np.random.default_rng(0)
    return rng.normal(size=(2, 50, cassie.NQ)), rng.normal(size=(2, 50, cassie.NV))


@pytest.fixture(scope="module")
def policy():
    return learner.init(jax.random.key(0), PPOConfig(actor_output_scale=1.0), FULL.size, cassie.NU, 1).policy


@pytest.fixture
def path(policy, motion, tmp_path):
    save_policy(tmp_path / "policy.npz", policy, motion, 1.0, 1.0, {}, law=ControlLaw(symmetric=True))
    return tmp_path / "policy.npz"


def test_a_mirror_image_is_seen_as_the_reflection(states):
    (qpos, ahead), (qvel, ahead_velocity) = states
    seen = observe(qpos, qvel, ahead, ahead_velocity)
    images = [cassie.mirror_qpos(qpos), cassie.mirror_qvel(qvel)]
    images += [cassie.mirror_qpos(ahead), cassie.mirror_qvel(ahead_velocity)]
    np.testing.assert_array_equal(FULL.mirrored(seen), observe(*images))
    np.testing.assert_array_equal(FULL.mirrored(FULL.mirrored(seen)), seen)


@pytest.mark.parametrize("speed", [0.0, 1.0, 4.0])
def test_each_step_is_half_of_the_stride_at_any_speed(motion, speed):
    qpos = stretch(motion, speed).qpos
    hip_pitch, second = qpos[:, cassie.HIP_PITCH_QPOS], second_step(qpos)[:, 0]
    half = len(second) // 2
    np.testing.assert_array_equal(second[:half], ~second[half:])
    assert np.count_nonzero(second != np.roll(second, 1)) == 2
    assert np.abs(np.diff(hip_pitch)).min() > 0.01


def test_images_act_as_images(policy, path, states):
    (qpos, ahead), (qvel, ahead_velocity) = states
    seen: Any = np.asarray(observe(qpos, qvel, ahead, ahead_velocity))
    second = np.asarray(second_step(ahead))
    assert 10 < second.sum() < 40
    mode = partial(acting.mode, policy)
    images = cassie.mirror_qpos(ahead)
    saved = NumpyPolicy.load(path)
    for act, mirrored_act in ((in_both_steps(mode, ahead), in_both_steps(mode, images)), (saved, saved)):
        action, image = act(seen), mirrored_act(FULL.mirrored(seen))
        np.testing.assert_allclose(image, cassie.mirror_active(action), atol=1e-5)
        np.testing.assert_allclose(action[~second[:, 0]], mode(seen)[~second[:, 0]], atol=1e-5)
        assert np.abs(action - mode(seen))[second[:, 0]].max() > 0.1
    assert NumpyPolicy.load(path)(seen[0]).shape == (cassie.NU,)


def states_of(env, act, delay):
    """Of every control step the state after it, up to the second episode of those that last 5 steps."""
    state = env.reset_at(np.arange(22), Scenario.nominal(22, delay=np.int32(delay)))
    for number in range(7):
        ahead = motions.reference(env.motion, state.motion, ahead=1)[0]
        state = env.step(state, np.asarray(act(state.observation, ahead)), jax.random.key(number))
        yield state, np.asarray(motions.reference(env.motion, state.motion, ahead=1)[0])


@pytest.mark.parametrize(
    ("engine", "speeds"),
    [("native", (1.0, 1.0)), ("native", (0.0, 4.0)), pytest.param("mjx", (1.0, 1.0), marks=pytest.mark.slow)],
)
def test_a_policy_does_in_both_steps_what_it_learned_in_one(motion, policy, engine, speeds):
    delay = 3 if engine == "native" else 0
    physics = make_physics(engine, replace(MJX_TRAINING, physics_hz=500), max_delay=delay)
    task, mode = WalkConfig(episode_steps=5), jax.jit(partial(acting.mode, policy))
    trained = WalkEnv(physics, motion, replace(task, symmetric=True), 22, speeds)
    deployed = WalkEnv(physics, motion, replace(task, symmetric=False), 22, speeds)
    ended = 0
    for (ours, ahead), (theirs, _) in zip(
        states_of(trained, lambda seen, _: mode(seen), delay),
        states_of(deployed, lambda seen, ahead: in_both_steps(mode, ahead)(seen), delay),
        strict=True,
    ):
        np.testing.assert_allclose(ours.physics.qpos, theirs.physics.qpos, atol=1e-6)
        np.testing.assert_allclose(ours.reward, theirs.reward, atol=1e-6)
        np.testing.assert_allclose(ours.observation, canonical(theirs.observation, ahead), atol=1e-5)
        assert not np.allclose(ours.observation, theirs.observation, atol=0.1)
        ended += int(np.sum(ours.truncated))
    assert ended


def test_a_reference_whose_steps_are_no_mirror_images_is_refused(motion):
    qpos = motion.qpos.copy()
    qpos[3, cassie.qpos_index("left-knee")] += 0.05
    physics = make_physics("native", ModelConfig(physics_hz=500))
    with pytest.raises(ValueError, match="second step mirrors its first, and this one's does not; set walk.symmetric"):
        WalkEnv(physics, motion._replace(qpos=qpos), WalkConfig(symmetric=True), 2)
    WalkEnv(physics, motion._replace(qpos=qpos), WalkConfig(), 2)


def symmetric_model(tmp_path):
    """The model without what the published figures have on one side alone: centres of mass and products of inertia."""
    spec = mujoco.MjSpec.from_file(str(xml_path("flat")))
    for name in ("cassie-pelvis", "left-hip-roll", "right-hip-roll"):
        body = spec.body(name)
        body.ipos = body.ipos * [1, 0, 1]
        # xx, yy, zz, xy, xz, yz
        body.fullinertia = body.fullinertia * [1, 1, 1, 0, 1, 0]
    for path in xml_path("flat").parent.glob("*.xml"):
        (tmp_path / path.name).write_text(path.read_text())
    (tmp_path / "symmetric.xml").write_text(spec.to_xml())
    return load_model(ModelConfig(), tmp_path / "symmetric.xml")


def test_a_mirrored_robot_under_mirrored_targets_moves_as_in_the_mirror(motion, tmp_path):
    physics, rng = NativePhysics(symmetric_model(tmp_path)), np.random.default_rng(0)
    qvel = motion.qvel + 0.1 * rng.normal(size=motion.qvel.shape)
    targets = motion.qpos[:, cassie.ACTIVE_QPOS] + 0.1 * rng.normal(size=(22, cassie.NU))
    push = rng.uniform(-80, 80, (22, 1, 3))
    robots = physics.init(motion.qpos, qvel)
    images = physics.init(cassie.mirror_qpos(motion.qpos), cassie.mirror_qvel(qvel))
    for steps in (1, 64):
        scenario = Scenario.nominal(22, push=push, push_stop=np.int32(40))
        mirrored = Scenario.nominal(22, push=push * [1, -1, 1], push_stop=np.int32(40))
        robots = physics.advance(robots, targets, scenario, steps)
        images = physics.advance(images, cassie.mirror_active(targets), mirrored, steps)
        np.testing.assert_allclose(images.qpos, cassie.mirror_qpos(robots.qpos), atol=1e-7)
        np.testing.assert_allclose(images.qvel, cassie.mirror_qvel(robots.qvel), atol=1e-5)


@pytest.mark.parametrize("symmetric", [True, False])
def test_robots_half_a_stride_apart_live_the_same_step(motion, symmetric):
    physics = NativePhysics(load_model(ModelConfig(physics_hz=500)))
    env = WalkEnv(physics, motion, WalkConfig(symmetric=symmetric), 22)
    state = env.reset_at(np.arange(22), Scenario.nominal(22))
    for number in range(10):
        seen = np.asarray(state.observation)
        # The published pelvis is not quite symmetric: its centre of mass is 0.3 mm off the plane.
        close = np.allclose(seen[:11], seen[11:], atol=1e-6 if number == 0 else 0.2)
        assert close == symmetric
        action = np.tile(0.1 * np.random.default_rng(number).normal(size=(11, cassie.NU)), (2, 1))
        state = env.step(state, action, jax.random.key(number))
        assert not np.asarray(state.terminated).any()
    reward = np.asarray(state.metrics["weighted"])
    assert (np.abs(reward[:11] - reward[11:]).max() < 0.01) == symmetric


def test_a_run_measures_what_its_policy_file_has(tmp_path):
    session(tmp_path, walk=WalkConfig(symmetric=True)).train()
    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    agent = make_agent(str(tmp_path))
    metrics = {metric.quantity: metric.value for metric in agent_returns(agent, EvalSetup().physics(), CHOOSING_PHASES)}
    assert NumpyPolicy.load(tmp_path / "best.npz").mirror
    assert metrics["return_plain"] == pytest.approx(last["eval/return_plain"], rel=1e-5)


def test_training_goes_on_from_any_policy_that_fits(path, tmp_path):
    session(tmp_path / "first").train()
    network = replace(TINY, hidden_sizes=(256, 256))
    for source, ppo in ((tmp_path / "first" / "best.npz", TINY), (path, network)):
        begun = session(tmp_path / source.stem, init=str(source), walk=WalkConfig(symmetric=True), ppo=ppo)
        kernel, _ = networks.layers(begun.run.learner.policy.actor)[0]
        np.testing.assert_array_equal(kernel, NumpyPolicy.load(source).weights[0][0])
    with pytest.raises(ValueError, match=r"policy\.npz learned one step of the stride alone; set walk\.symmetric=true"):
        session(tmp_path / "c", init=str(path), ppo=network, walk=WalkConfig(symmetric=False))
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"mirror_action": None}, "mirror_action missing or too much"),
        ({"mirror_observation": None}, "mirror_observation missing or too much"),
        ({"mirror_observation": np.arange(1, 80)}, "mirror_observation does not have each of 1 to 80 once"),
        ({"mirror_action": np.arange(10)}, "mirror_action does not have each of 1 to 10 once"),
        ({"mirror_action": np.ones(10, int)}, "mirror_action does not have each of 1 to 10 once"),
        ({"mirror_sides": np.array([49, 81])}, "mirror_sides is not two of 1 to 80"),
        ({"mirror_sides": np.array([-54, -61])}, "mirror_sides is not two of 1 to 80"),
        ({"mirror_sides": np.array([54, 54])}, "mirror_sides is not two of 1 to 80"),
        ({"mirror_sides": np.array([54, 61, 1])}, "mirror_sides is not two of 1 to 80"),
        ({"mirror_sides": np.array([54.0, 61.0])}, "mirror_sides is not a list of integers"),
        ({"mirror_sides": np.array(54)}, "mirror_sides is not a list of integers"),
    ],
)
def test_a_mirror_that_does_not_fit_is_refused(path, change, sentence):
    with np.load(path) as archive:
        content = dict(archive) | {"version": 1} | change
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    with pytest.raises(ValueError, match=sentence):
        NumpyPolicy.load(path)


def test_another_mirror_is_refused(path):
    saved = NumpyPolicy.load(path)
    assert learner_policy(saved)
    other = Mirror(*saved.mirror)._replace(action=np.arange(1, 11)) if saved.mirror else None
    with pytest.raises(ValueError, match="mirror is not this version's"):
        learner_policy(replace(saved, mirror=other))
