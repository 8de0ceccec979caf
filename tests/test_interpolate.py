"""Blends of policies and references, their schedules, and the agents that walk by them."""

import jax
import numpy as np
import pytest
from seeing import FULL, observe

from cassie_mjx.agents import blending
from cassie_mjx.agents.blend import BlendAgent
from cassie_mjx.agents.blending import Progress
from cassie_mjx.agents.make import make_agent, make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import learner_policy, save_policy
from cassie_mjx.agents.types import Sensed
from cassie_mjx.control.law import LawCarry
from cassie_mjx.control.path import Path
from cassie_mjx.control.step import PolicyCarry
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import ReferenceMotion, blend_motions, sample, stretch
from cassie_mjx.ppo import learner
from cassie_mjx.ppo.config import PPO_PRESETS
from cassie_mjx.robot import cassie

PHASES = np.array([0, 7, 21, 30])
ROBOTS = len(PHASES)


@pytest.fixture(scope="module")
def walk():
    return load_motion("walk")


@pytest.fixture(scope="module")
def motions(walk):
    return [stretch(walk, factor) for factor in (1, 2, 3)]


@pytest.fixture(scope="module")
def policy_files(motions, tmp_path_factory):
    """Three policies that act, untrained, each on its own reference."""
    folder, files = tmp_path_factory.mktemp("policies"), []
    for seed, motion in enumerate(motions):
        state = learner.init(jax.random.key(seed), PPO_PRESETS["parallel"], FULL.size, cassie.NU, 1)
        actor = jax.tree.map(lambda leaf: 3 * leaf, state.policy.actor)
        files.append(folder / f"{seed + 1}x.npz")
        save_policy(files[-1], state.policy._replace(actor=actor), motion, seed + 1.0, 1.0, {})
    return files


@pytest.fixture(scope="module")
def states(walk):
    noise = np.random.default_rng(0)
    qpos, qvel = sample(walk, PHASES)
    return qpos + 0.02 * noise.normal(size=qpos.shape), qvel + 0.1 * noise.normal(size=qvel.shape)


def residuals_of(policies, motions, qpos, qvel):
    """What each policy adds to its own reference."""
    return [
        policy(observe(qpos, qvel, *sample(motion, PHASES))) for policy, motion in zip(policies, motions, strict=True)
    ]


def linear(seed):
    weights = 0.05 * np.random.default_rng(seed).normal(size=(FULL.size, cassie.NU)).astype(np.float32)
    return lambda seen: np.asarray(seen) @ weights


def single(policy, motion, phase, qpos, qvel):
    """PD targets of one policy on its own reference."""
    ahead, ahead_velocity = sample(motion, phase)
    return ahead[:, cassie.ACTIVE_QPOS] + policy(observe(qpos, qvel, ahead, ahead_velocity))


@pytest.mark.parametrize("position", [0, 1, 2])
def test_a_whole_position_is_one_policy_exactly(motions, states, position):
    policies = [linear(seed) for seed in range(3)]
    residuals = residuals_of(policies, motions, *states)
    ours = blending.pd_target(residuals, motions, np.full(ROBOTS, float(position)), PHASES)
    np.testing.assert_array_equal(ours, single(policies[position], motions[position], PHASES, *states))


def test_between_two_policies_lambda_weighs_them(motions, states):
    policies, position = [linear(seed) for seed in range(3)], np.array([0.0, 0.25, 1.25, 1.9])
    ours = blending.pd_target(residuals_of(policies, motions, *states), motions, position, PHASES)
    alone = [single(policy, motion, PHASES, *states) for policy, motion in zip(policies, motions, strict=True)]
    # The references differ in x alone, so the targets blend as the actions do.
    expected = [
        alone[0][0],
        0.75 * alone[0][1] + 0.25 * alone[1][1],
        0.75 * alone[1][2] + 0.25 * alone[2][2],
        0.1 * alone[1][3] + 0.9 * alone[2][3],
    ]
    np.testing.assert_allclose(ours, expected, atol=1e-6)


def test_a_blend_of_agents_is_that_of_their_numpy_policies(policy_files, motions, states):
    saved = [NumpyPolicy.load(path) for path in policy_files]
    position = np.array([0.0, 0.3, 1.0, 1.7])
    ours = blending.pd_target(residuals_of(saved, motions, *states), motions, position, PHASES)
    assert isinstance(ours, np.ndarray)
    agents = [make_policy_agent(str(path)) for path in policy_files]
    carries = [agent.init(Sensed(*states), PHASES - 1) for agent in agents]
    targets = [agent.step(carry, Sensed(*states), None)[0] for agent, carry in zip(agents, carries, strict=True)]
    before = position.astype(int).clip(0, 1)
    share, targets = (position - before)[:, None], np.array(targets)
    robots = np.arange(ROBOTS)
    theirs = (1 - share) * targets[before, robots] + share * targets[before + 1, robots]
    assert np.abs(ours - single(saved[0], motions[0], PHASES, *states)).max() > 0.05, "the policies differ"
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_the_reference_blends_phase_by_phase(motions):
    lam = 0.3
    qpos, qvel = blending.blended_sample(motions, np.full(ROBOTS, 1 - lam), PHASES)
    mixed = blend_motions(motions[0], motions[1], lam)
    expected = sample(mixed, PHASES)
    np.testing.assert_allclose(qpos, expected[0], atol=1e-12)
    np.testing.assert_allclose(qvel, expected[1], atol=1e-12)


def test_pelvis_x_advances_without_a_jump_while_lambda_falls(motions):
    steps = np.arange(1, 5 * 22 + 1)
    # All the way along the chain in five strides; lambda changes with every step, at the ends of strides too.
    position = np.linspace(0, 2, len(steps))
    gain = blending.advance(motions, position, steps)
    alone = np.diff(sample(motions[0], np.arange(len(steps) + 1))[0][:, 0])
    np.testing.assert_allclose(gain, (1 + position) * alone, atol=1e-12)
    constant = blending.advance(motions, np.full(22, 0.5), np.arange(22))
    assert constant.sum() == pytest.approx(1.5 * motions[0].stride_length)


def at(steps):
    return Progress(np.zeros(len(steps), np.int32), np.array(steps, np.int32), np.zeros(len(steps)))


def going(speeds):
    zero = np.zeros(len(speeds), np.int32)
    return Progress(zero, zero, np.array(speeds))


def test_ramp_at_known_times():
    # lambda = 1 - 0.625 t reaches 0 after 1.6 s, 50 control steps; it stays for 4 s, comes back, stays and goes again.
    steps = [0, 25, 50, 100, 175, 200, 225, 300, 350, 375]
    np.testing.assert_allclose(blending.ramp(at(steps), [0.7, 1.4]), [0, 0.5, 1, 1, 1, 0.5, 0, 0, 0, 0.5], atol=1e-9)
    # Four policies take three times as long: position 1.5 after 2.4 s, and back there 4.8 + 4 + 2.4 s after the start.
    np.testing.assert_allclose(blending.ramp(at([75, 200, 350]), [0, 1, 2, 3]), [1.5, 3, 1.5], atol=1e-9)


def test_adaptive_makes_up_for_half_of_the_speed_that_is_missing():
    ours = blending.adaptive(going([2.0, 0.7, 0.35, 0.0, -0.7, -2.0]), [0.7, 1.4])
    np.testing.assert_allclose(ours, [0, 0, 0.25, 0.5, 1, 1], atol=1e-12)
    np.testing.assert_allclose(blending.adaptive(going([-1.0]), [1.0, 1.5, 2.5]), [1.5])


def test_the_filter_settles_exponentially():
    speed, velocity = np.array([0.7]), np.array([1.5])
    for _ in range(11):
        speed = blending.filtered(speed, velocity)
    # 11 steps of 32 ms are one time constant: v + (v_0 - v) / e.
    np.testing.assert_allclose(speed, 1.5 - 0.8 / np.e)


NOTHING = LawCarry(np.zeros((ROBOTS, 0, FULL.size), np.float32), np.zeros((ROBOTS, 0), np.float32))


def progress(phase, step, speed):
    steps, speeds = np.full(ROBOTS, step, np.int32), np.full(ROBOTS, speed, np.float32)
    return Progress(phase, steps, speeds, (NOTHING, NOTHING))


def alone(path, phase, states):
    target, _ = make_agent(str(path)).step(PolicyCarry(phase, NOTHING, Path.world(ROBOTS)), Sensed(*states), None)
    return target


def test_a_blend_walks_as_its_policies_at_the_ends_of_the_ramp(policy_files, states):
    blend = make_agent(f"blend:{policy_files[0]},{policy_files[1]}", schedule="ramp")
    phase = np.array([0, 7, 21, 3], np.int32)
    for step, path in ((0, policy_files[0]), (50, policy_files[1])):
        carry = progress(phase, step, 0.7)
        ours, after = blend.step(carry, Sensed(*states), None)
        np.testing.assert_allclose(ours, alone(path, phase, states), atol=1e-5)
        np.testing.assert_array_equal(after.phase, [1, 8, 0, 4])
        np.testing.assert_array_equal(after.step, step + 1)
        compiled, _ = jax.jit(lambda carry, sensed: blend.step(carry, sensed, None))(carry, Sensed(*states))
        np.testing.assert_allclose(compiled, ours, atol=1e-5)
        np.testing.assert_allclose(after.speed, blending.filtered(carry.speed, states[1][:, 0]), rtol=1e-5)


def test_an_adaptive_blend_takes_a_faster_policy_for_slower_robots(policy_files, states):
    blend = make_agent(f"blend:{policy_files[0]},{policy_files[1]}", schedule="adaptive")
    qpos, qvel = states[0], states[1].copy()
    phase = np.zeros(ROBOTS, np.int32)
    for speed, path in ((2.0, policy_files[0]), (-0.9, policy_files[1])):
        qvel[:, 0] = speed
        ours, _ = blend.step(progress(phase, 0, speed), Sensed(qpos, qvel), None)
        np.testing.assert_allclose(ours, alone(path, phase, (qpos, qvel)), atol=1e-5)


def test_a_policy_is_told_another_speed(policy_files):
    agent = make_policy_agent(str(policy_files[1]), speed="3x")
    assert agent.motion.stride_length == pytest.approx(1.5, rel=1e-3)
    assert agent.name.endswith("2x.npz speed=3x")


def test_bad_blends_get_one_sentence(policy_files, motions, tmp_path):
    first, second = map(str, policy_files[:2])
    policy = learner_policy(NumpyPolicy.load(second))
    save_policy(tmp_path / "soft.npz", policy, motions[1], 2.0, 0.5, {})
    with pytest.raises(ValueError, match="so that no one PD law holds both"):
        make_agent(f"blend:{first},{tmp_path}/soft.npz", schedule="ramp")
    with pytest.raises(ValueError, match="two or more policies, not 1"):
        make_agent(f"blend:{first}", schedule="ramp")
    with pytest.raises(ValueError, match="schedule=sine is not known; choose one of ramp, adaptive"):
        make_agent(f"blend:{first},{second}", schedule="sine")
    with pytest.raises(ValueError, match="a blend, and nothing else, takes schedule=ramp or adaptive"):
        make_agent(f"blend:{first},{second}")
    with pytest.raises(ValueError, match="a blend, and nothing else, takes schedule=ramp or adaptive"):
        make_agent(first, schedule="ramp")
    known = "0x, 1x, 1x-robust, 1x-sensors, 2x, 3x, 4x, any, joystick, controller:stiff"
    with pytest.raises(ValueError, match=f"policy=runs/none is none of {known}"):
        make_agent(f"blend:{first},runs/none", schedule="ramp")
    with pytest.raises(ValueError, match="name its policies from the slowest to the fastest"):
        make_agent(f"blend:{second},{first}", schedule="adaptive")
    with pytest.raises(ValueError, match="a single policy takes a speed, and nothing else does"):
        make_agent("controller:stiff", speed="2x")
    with pytest.raises(ValueError, match="speed=5x is not a speed"):
        make_agent(first, speed="5x")

    policies = [make_policy_agent(path) for path in (first, second)]
    policies[1].motion = ReferenceMotion(motions[1].qpos[:20], motions[1].qvel[:20], motions[1].stride_length)
    with pytest.raises(ValueError, match="References of 22, 20 samples cannot be blended"):
        BlendAgent(policies, "ramp")


def test_a_reference_without_speed_cannot_be_given_one(policy_files, walk, tmp_path):
    saved = NumpyPolicy.load(policy_files[0])
    save_policy(tmp_path / "0x.npz", learner_policy(saved), stretch(walk, 0), 0.0, 1.0, {})
    assert make_policy_agent(str(tmp_path / "0x.npz"), speed="0x").motion.stride_length == 0
    with pytest.raises(ValueError, match="a reference at 0x has no speed to be stretched"):
        make_agent(str(tmp_path / "0x.npz"), speed="1x")
