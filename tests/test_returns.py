"""The return by hand: rewards and falls are written down."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.control import path
from cassie_mjx.control.network import Network
from cassie_mjx.evaluation import returns
from cassie_mjx.evaluation.returns import CHOOSING_PHASES, ReturnRecord, walk_returns
from cassie_mjx.evaluation.setup import LIMIT_PHASES, WALK_PHASES
from cassie_mjx.motion.reference import nearest_sample, sample
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import PhysicsState, Scenario
from cassie_mjx.robot.model import ModelConfig

EVALUATIONS = Path(__file__).parents[1] / "experiments" / "results" / "evaluate"


@pytest.fixture(scope="module")
def agent():
    return make_policy_agent("1x")


@pytest.fixture(scope="module")
def physics():
    return make_physics("native", ModelConfig())


def record(agent, robots):
    zeros = np.zeros(robots)
    time = np.zeros(robots, np.int32)
    return ReturnRecord(time, time, zeros > 0, zeros, zeros, None, agent.motion, path.Path.world(robots))


def on_reference(agent, robots, time, down=()):
    qpos, qvel = (np.array(x, float) for x in sample(agent.motion, np.full(robots, time)))
    qpos[list(down), 2] = 0.5
    return PhysicsState(qpos, qvel, 0 * qvel, np.zeros(robots, np.int32), np.zeros((robots, 0, 67)))


def test_rewards_count_up_to_the_first_fall(agent):
    """On the reference a step earns 1; robot 1 falls in step 2 and gets up, robot 2 in step 3."""
    sums = record(agent, 3)
    for step, down in ((1, ()), (2, (1,)), (3, (2,)), (4, ())):
        sums = sums.update(on_reference(agent, 3, step, down), Scenario.nominal(3))
    # Lying 0.4 to 0.5 m too low, a robot earns 0.7 + 0.3 exp(-dz^2).
    lying = [0.7 + 0.3 * np.exp(-((agent.motion.qpos[k, 2] - 0.5) ** 2)) for k in (2, 3)]
    np.testing.assert_allclose(sums.plain, [4, 1 + lying[0], 2 + lying[1]], atol=1e-5)
    np.testing.assert_array_equal(sums.steps, [4, 1, 2])
    np.testing.assert_array_equal(sums.fell, [False, True, True])


def test_what_is_reported_begins_where_nothing_was_chosen(agent):
    """On the stride that we ship, of 22 control steps."""
    samples = agent.motion.qpos.shape[0]
    chosen, walked, pushed = (
        set((nearest_sample(phases, samples) % samples).tolist())
        for phases in (CHOOSING_PHASES, WALK_PHASES, LIMIT_PHASES)
    )
    assert (len(chosen), len(walked), len(pushed)) == (10, 10, 8)
    assert not chosen & walked


def test_training_starts_at_tenths_of_the_stride(agent, physics, monkeypatch):
    begun = []
    monkeypatch.setattr(returns, "run_to_end", lambda agent, physics, begin: begun.append(begin) or begin)
    walk_returns(agent, physics, delay=0)
    # round(2.2 k)
    assert begun[0].record.time.tolist() == [0, 2, 4, 7, 9, 11, 13, 15, 18, 20]
    assert begun[0].robots.carry.time.tolist() == begun[0].record.time.tolist()
    walk_returns(agent, physics, delay=4)
    assert begun[1].scenario.delay.tolist() == [4] * 10
    walk_returns(agent, physics, speeds=(0.0, 4.0))
    np.testing.assert_allclose(begun[2].command.forward, np.linspace(0, 4, 10) * 0.5 / 0.704, atol=2e-3)


def test_a_limp_robot_falls(agent, physics):
    limp = np.arctanh([0, 0, 0.99, 0.99, 0.99] * 2)
    layers = tuple((0 * np.asarray(w), 0 * np.asarray(b)) for w, b in agent.network.layers)
    network: Network = agent.network._replace(layers=(*layers[:-1], (layers[-1][0], limp)))
    found = walk_returns(type(agent)("limp", agent.law, agent.motion, network), physics)
    assert 1 < found["steps"] < 60
    assert 0 < found["return_weighted"] < found["return_plain"] < found["steps"] + 1


def test_a_network_as_an_argument_gives_what_its_own_compilation_does(agent, physics):
    from functools import partial

    from cassie_mjx.control.step import policy_step

    step = jax.jit(partial(policy_step, agent.law, agent.motion))
    other = type(agent)("1x", agent.law, agent.motion, agent.network, step=step)
    assert walk_returns(other, physics) == pytest.approx(walk_returns(agent, physics), rel=1e-4)


def recorded(name):
    """Phases and returns of a shipped policy: as its training measured it, and as its committed evaluation did."""
    policy = NumpyPolicy.load(shipped_policies()[name])
    sources = [(CHOOSING_PHASES, policy.provenance)]
    path = EVALUATIONS / f"{name}-seed{policy.provenance['seed']}.json"
    if path.is_file():
        rows = json.loads(path.read_text())["rows"]
        sources.append((WALK_PHASES, {row["quantity"]: row["value"] for row in rows}))
    return [(phases, (source["return_plain"], source["return_weighted"])) for phases, source in sources]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["0x", "1x", "1x-robust", "2x", "3x", "4x"])
def test_a_shipped_policy_still_earns_what_is_recorded(physics, name):
    expected = recorded(name)
    assert len(expected) == (2 if name in ("1x", "1x-robust", "2x") else 1)
    for phases, values in expected:
        found = walk_returns(make_policy_agent(name), physics, phases=phases)
        assert found["steps"] == 300
        # Other processors round otherwise; a wrong sign of the reference's quaternion costs 265.
        assert (found["return_plain"], found["return_weighted"]) == pytest.approx(values, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("speed", ["1x", "2x"])
def test_the_policy_of_all_speeds_still_earns_what_is_recorded(physics, speed):
    found = walk_returns(make_policy_agent("any", speed=speed), physics, phases=WALK_PHASES)
    rows = json.loads((EVALUATIONS / f"any-{speed}-seed0.json").read_text())["rows"]
    expected = {row["quantity"]: row["value"] for row in rows}
    for quantity in ("return_plain", "return_weighted"):
        assert found[quantity] == pytest.approx(expected[quantity], abs=0.5)
