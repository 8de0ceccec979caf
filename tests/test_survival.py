"""Who stays up, level by level: shares by hand, and an agent that walks on."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from points import Still, points

from cassie_mjx.agents.make import make_agent
from cassie_mjx.evaluation.setup import EvalSetup
from experiments import survival
from experiments.survival import SurvivalConfig, main, rows


class Standing(EvalSetup):
    """A setting whose engine is one of points."""

    def physics(self, scene="flat", longest_delay_s=0.0):
        return points()

    def starts(self, agent, phases, longest_delay_s=0.0):
        return agent.start(points(), phases)


def test_a_share_is_that_of_the_starts_of_a_level():
    up = np.array([True, True, True, False])
    found = rows("agent", "terrain_survived", "m", [0.0, 0.2], up)
    assert [(row["level"], row["value"], row["n"]) for row in found] == [(0.0, 1.0, 2), (0.2, 0.5, 2)]


def test_levels_from_none_on_are_walked(monkeypatch, tmp_path):
    for name, value in {
        **{
            "WALK_S": 0.5,
            "HIGHEST_TERRAIN_M": 0.4,
            "TERRAIN_STEP_M": 0.4,
            "LONGEST_DELAY_S": 0.02,
            "DELAY_STEP_MS": 20.0,
        },
        **{"LIMIT_PHASES": np.zeros(1), "WALK_PHASES": np.zeros(2)},
    }.items():
        monkeypatch.setattr(survival, name, value)
    main(SurvivalConfig("1x", "1.1x", out=str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    found, provenance = content["rows"], content["provenance"]
    assert provenance["speed"] == "1.1x"
    assert provenance["agent"] == make_agent("1x").provenance
    assert {row["agent"] for row in found} == {"1x speed=1.1x"}
    assert [(row["quantity"], row["level"], row["level_unit"], row["n"]) for row in found] == [
        *(("terrain_survived", level, "m", 1) for level in (0.0, 0.4)),
        *(("delay_survived", level, "ms", 2) for level in (0.0, 20.0)),
    ]
    assert found[0]["value"] == found[2]["value"] == 1


def test_each_level_disturbs_as_it_says(monkeypatch):
    flown = []

    def run_trials(agent, physics, starts, trials, progress, num_envs):
        flown.extend(trials)
        return SimpleNamespace(fell=np.zeros(len(trials), bool))

    monkeypatch.setattr(survival, "run_trials", run_trials)
    agent, setting = Still(), Standing()
    heights = [row["level"] for row in survival.terrain(agent, setting)]
    assert heights == [pytest.approx(k / 100) for k in range(81)]
    assert [(trial.start, trial.terrain.level) for trial in flown] == [(k, h) for h in heights for k in range(8)]
    flown.clear()
    assert [row["level"] for row in survival.delay(agent, setting)] == list(range(41))
    # 2 steps a millisecond at 2 kHz.
    assert [(trial.start, trial.delay) for trial in flown] == [(k, 2 * ms) for ms in range(41) for k in range(10)]
    assert {trial.seconds for trial in flown} == {10}
