"""Heuristic controllers and policies as agents, and the names they go by."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from seeing import FULL

from cassie_mjx import cli
from cassie_mjx.agents.blend import BlendAgent
from cassie_mjx.agents.heuristic import HeuristicAgent
from cassie_mjx.agents.make import AgentConfig, make_agent, make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.policy_file import save_policy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.agents.types import Sensed
from cassie_mjx.evaluation import film, returns
from cassie_mjx.evaluation.returns import agent_returns
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.setup import WALK_PHASES
from cassie_mjx.evaluation.steady import steady
from cassie_mjx.evaluation.trial import Trial
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.ppo import learner
from cassie_mjx.ppo.config import PPO_PRESETS
from cassie_mjx.robot import cassie

OLD = pytest.warns(UserWarning, match="of version 1 of its format")


def test_the_controller_starts_along_its_stride_and_walks_on(model):
    physics, agent = NativePhysics(model), HeuristicAgent("stiff")
    phases = np.array([0.0, 0.25, 0.5, 0.875])
    starts = steady(agent, physics, phases)
    np.testing.assert_allclose(starts.physics.qpos[:, 0], 0, atol=1e-12)
    # At phase 0 the clock of the right leg's step is over, and the next call gives the left leg its turn.
    memory = starts.carry.state
    off_phase = (memory.stance * 0.352 + memory.phase - 0.704 * phases + 0.1) % 0.704 - 0.1
    np.testing.assert_allclose(off_phase, 0, atol=1e-3)
    # The foot in the air, or about to leave the ground, left it within half a stride of the pelvis.
    assert (np.abs(memory.liftoff_w[:, 0]) < 0.5).all()
    result = run_trials(agent, physics, starts, [Trial(k, 3.0) for k in range(4)])
    assert not result.fell.any()
    np.testing.assert_allclose(result.distance_m / 3.0, 0.7, atol=0.07)
    moved = agent.moved(starts.carry, np.tile([1.0, 2.0, 3.0], (4, 1))).state
    np.testing.assert_allclose(moved.liftoff_w - memory.liftoff_w, np.tile([1, 2, 3], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.line_w - memory.line_w, np.tile([1, 2, 0], (4, 1)), atol=1e-6)


@pytest.mark.parametrize("name", ["stiff", "controller:soft", "runs/none"])
def test_an_unknown_policy_gets_one_sentence(name):
    known = "0x, 1x, 1x-robust, 1x-sensors, 2x, 3x, 4x, any, joystick, controller:stiff, controller:compliant"
    with pytest.raises(ValueError, match=f"policy={name} is none of {known}, nor"):
        make_agent(name)


def test_a_policy_walks_as_its_targets_say(tmp_path, model):
    """A zero residual holds the next sample of the reference: the PD targets of `step`, step after step."""
    motion = load_motion("walk")
    state = learner.init(jax.random.key(0), PPO_PRESETS["parallel"], FULL.size, cassie.NU, 1)
    zero = state.policy._replace(actor=jax.tree.map(jnp.zeros_like, state.policy.actor))
    save_policy(tmp_path / "zero.npz", zero, motion, 1.0, 0.5, {})
    agent = make_policy_agent(str(tmp_path / "zero.npz"))
    assert agent.kd_scale == 0.5
    physics = NativePhysics(model)
    sensed = Sensed(np.asarray(motion.qpos[[3, 21]]), np.asarray(motion.qvel[[3, 21]]))
    carry = agent.init(sensed, np.array([3, 21], np.int32))
    target, carry = agent.step(carry, sensed, None)
    np.testing.assert_allclose(target, np.asarray(motion.qpos)[[4, 0]][:, cassie.ACTIVE_QPOS], atol=1e-6)
    np.testing.assert_array_equal(carry.time, [4, 0])
    with pytest.raises(ValueError, match="falls before it walks steadily"):
        steady(agent, physics, np.zeros(1))


def test_a_policy_that_we_ship_goes_by_its_name():
    agent = make_agent("1x")
    assert agent.name == "1x"
    assert agent.provenance == NumpyPolicy.load(shipped_policies()["1x"]).provenance


def test_returns_are_of_senses_as_late_as_asked(model, monkeypatch):
    monkeypatch.setattr(returns, "EPISODE_STEPS", 40)
    agent, physics = make_agent("1x"), NativePhysics(model, max_delay=40)
    (prompt, *_), (late, *_) = (agent_returns(agent, physics, WALK_PHASES, delay) for delay in (0, 40))
    assert (prompt.quantity, late.quantity) == ("return_plain", "return_plain")
    # 20 ms late, robots fall within a second.
    assert prompt.value > 39
    assert late.value < 30


def test_a_command_line_names_its_subject():
    assert cli.parse(AgentConfig, []).agent().name == "1x"
    faster = cli.parse(AgentConfig, ["policy=1x", "speed=2.5x"]).agent()
    assert faster.name == "1x speed=2.5x"
    assert isinstance(faster, PolicyAgent)
    assert faster.motion.stride_length == pytest.approx(2.5 * load_motion("walk").stride_length, rel=1e-3)
    blend = cli.parse(AgentConfig, ["policy=blend:1x,1x", "schedule=ramp"]).agent()
    assert blend.name == "blend:1x,1x schedule=ramp"


def test_a_film_of_a_blend_begins_where_its_ramp_does():
    blend = AgentConfig("blend:1x,1x", schedule="ramp").agent()
    assert isinstance(blend, BlendAgent)
    _, robots = film.begin(blend, Trial(0, 1.0), phase=0.5)
    np.testing.assert_array_equal(robots.carry.step, [0])
    np.testing.assert_array_equal(blend.position(robots.carry), [0])
    np.testing.assert_array_equal(robots.carry.phase, [11])


def test_a_damaged_policy_gets_one_sentence(tmp_path):
    path = tmp_path / "policy.npz"
    path.write_bytes(shipped_policies()["1x"].read_bytes()[:-1000])
    with pytest.raises(ValueError, match="policy.npz is damaged"):
        make_agent(str(path))


def test_a_policy_of_other_gains_gets_one_sentence(tmp_path):
    with np.load(shipped_policies()["1x"]) as archive:
        content = dict(archive)
    for name in ("p_gain", "d_gain"):
        changed = content[name] * np.where(np.arange(10) == 3, 0.5, 1.0)
        np.savez(tmp_path / "policy.npz", **(content | {"version": 1, name: changed}))
        with (
            pytest.warns(UserWarning, match="of version 1"),
            pytest.raises(ValueError, match="PD gains other than the published ones with all D scaled alike"),
        ):
            make_agent(str(tmp_path / "policy.npz"))


def test_a_policy_of_another_robot_gets_one_sentence(tmp_path):
    with np.load(shipped_policies()["1x"]) as archive:
        content = dict(archive)
    np.savez(tmp_path / "policy.npz", **(content | {"version": 1, "joints": content["joints"][::-1]}))
    with (
        pytest.warns(UserWarning, match="of version 1"),
        pytest.raises(ValueError, match="drives joints that this version's robot has not, or in another order"),
    ):
        make_agent(str(tmp_path / "policy.npz"))
