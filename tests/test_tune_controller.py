"""The tuner: what it searches, what it puts candidates through, and that its score tells them apart."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from cassie_mjx import cli
from cassie_mjx.heuristic.config import COMPLIANT, CONTROLLERS, STIFF
from experiments.tune_controller import DEMANDS, Evaluator, TuneConfig, candidate, on_time, parameters, trials


@pytest.mark.parametrize(
    ("preset", "wrong"), [("soft", {}), ("stiff", {"population": 2}), ("stiff", {"generations": 0})]
)
def test_tuner_refuses_what_it_cannot_search(preset, wrong):
    with pytest.raises(
        ValueError, match=r"preset=soft is not known; choose one of stiff|must be a whole number from [14] to"
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
    assert min(candidate("stiff", np.full(len(parameters("stiff")), -9.0)).haste) == 0
    assert candidate("compliant", np.ones(len(parameters("compliant")))).haste == COMPLIANT.haste
    assert candidate("compliant", np.ones(len(parameters("compliant")))).knee_p == COMPLIANT.knee_p
    assert candidate("stiff", np.ones(len(parameters("stiff")))).knee_p > STIFF.knee_p


def test_a_candidate_goes_through_every_kind_of_trial():
    listed = trials(DEMANDS["compliant"])
    forces = {trial.pushes[0][:2] for kind, trial in listed if kind == "backward"}
    assert forces == {(-120.0, 0.0), (-170.0, 0.0), (-200.0, 0.0)}
    assert {trial.start for kind, trial in listed if kind == "left"} == set(range(8))
    assert {trial.terrain.level for kind, trial in listed if kind == "terrain"} == {0.3}


def test_a_clock_that_hurries_in_steady_walking_is_told():
    """At phase 0 of a stride: the end of the right leg's step of 0.352 s, or the very start of the left leg's."""
    state = SimpleNamespace(stance=np.array([1, 1, 0, 0]), phase=np.array([0.351, 0.340, 0.001, 0.020]))
    memory = SimpleNamespace(state=state, config=SimpleNamespace(step_time=np.full(4, 0.352)))
    agent: Any = SimpleNamespace(carry=memory)
    np.testing.assert_array_equal(on_time(agent, 0.002), [True, False, True, False])


@pytest.mark.slow
def test_the_score_tells_good_from_bad_and_fallen():
    shipped, short, fallen = Evaluator("compliant")(
        [COMPLIANT, replace(COMPLIANT, reach_x=0.15, reach_y=0.2), replace(COMPLIANT, gain_y=0.0)]
    )
    assert shipped.cost + 0.3 < short.cost < fallen.cost
    assert shipped.speed == pytest.approx(0.69, abs=0.02)
    # Who takes short steps walks as well, until he is pushed.
    assert short.speed == pytest.approx(shipped.speed, abs=0.01)
    assert short.survival["forward"] + 0.3 < shipped.survival["forward"]
    assert max(fallen.survival.values()) < 0.1
