"""What of their inputs the shipped policies do not see on their own tasks, in MuJoCo C."""

from dataclasses import replace

import acting
import jax
import numpy as np
import pytest

from cassie_mjx.agents.policy_file import learner_policy
from cassie_mjx.agents.saved_law import control_law
from cassie_mjx.agents.shipped import load_policy, shipped_policies
from cassie_mjx.envs.command import command_range
from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.make import make_physics
from cassie_mjx.ppo import normalizer
from cassie_mjx.robot.model import ModelConfig

STEPS, ROBOTS = 300, 20

# Bounds on the share of the samples in which the worst input of each policy is clipped. Measured: 0.02, 0, 0.03 and, of
# `1x-robust`, 25.5 % (how far aside pushes have brought it: it does not see beyond 0.64 m); `joystick` 0.9 %.
WORST = {"0x": 0.001, "1x": 0.001, "1x-robust": 0.35, "2x": 0.005, "3x": 0.02, "4x": 0.05, "any": 0.005}
WORST |= {"joystick": 0.02, "1x-sensors": 0.01}
TOO_FAST = pytest.mark.xfail(
    reason="8.8 % and 8.7 % of the right tarsus' velocity are clipped: faster than any random policy's"
)


def task(name):
    """What a policy was trained for, and under which commands."""
    robust = WALK_PRESETS["robust"]
    pushed = replace(robust, scenario=replace(robust.scenario, push_n=250.0, push_backward=0.7))
    # `any` is of before policies were symmetric.
    driven = WALK_PRESETS["joystick"]
    # Half of the pushes' range, as the curriculum left it.
    driven = replace(driven, scenario=replace(driven.scenario, push_n=250.0, push_curriculum=False))
    sensing = WalkConfig(observation="sensors", electronics=True, dynamics="moderate")
    walks = {"1x-robust": pushed, "1x-sensors": sensing, "any": WalkConfig(symmetric=False), "joystick": driven}
    asked = {"any": ("any", "speed"), "joystick": ("1x", "joystick")}.get(name, ("1x", "speed"))
    return walks.get(name, WalkConfig()), asked


def clipped_share(name):
    """Share of each input of the policy that is clipped, over whole episodes of its own task without noise, [O]."""
    saved, (walk, asked) = load_policy(name), task(name)
    motion = ReferenceMotion(saved.reference_qpos, saved.reference_qvel, saved.reference_stride_length)
    policy = learner_policy(saved)
    assert control_law(saved) == walk.law(motion)
    model = ModelConfig(physics_hz=500, scene=walk.scene, electronics=walk.electronics)
    physics = make_physics("native", model, walk.delay_steps(500))
    env = WalkEnv(physics, motion, walk, ROBOTS, *command_range(motion, *asked))
    act = jax.jit(lambda observation: acting.mode(policy, observation))
    inputs = jax.jit(lambda observation: normalizer.normalize(policy.normalizer, observation))
    key, clipped = jax.random.key(0), np.zeros(saved.mean.shape)
    state = env.reset(key)
    for step in range(STEPS):
        clipped += (np.abs(inputs(state.observation)) >= normalizer.CLIP).mean(axis=0)
        state = env.step(state, act(state.observation), jax.random.fold_in(key, step))
    return clipped / STEPS


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[TOO_FAST] if name in ("3x", "4x") else []) for name in shipped_policies()]
)
def test_shipped_policies_see_their_tasks(name):
    share = clipped_share(name)
    assert share.max() <= WORST[name], (share.argmax(), share.max())
