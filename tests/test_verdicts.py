"""The grid on which the engines' verdicts are compared, and the comparison by hand."""

import json

import numpy as np

from experiments import verdicts
from experiments.verdicts import VerdictsConfig


def test_the_grid_has_its_cells():
    kinds = {subset.kind: subset for subset in verdicts.subsets()}
    sizes = {kind: sum(map(len, subset.trials)) for kind, subset in kinds.items()}
    assert sizes == {"push": 8 * 4 * 12, "terrain": 8 * 8, "delay": 8 * 10}
    assert sum(sizes.values()) == 528
    assert {trial.delay for group in kinds["delay"].trials for trial in group} == set(range(4, 41, 4))
    for subset in kinds.values():
        strengths = [
            [sum(np.hypot(*push[:2]) for push in t.pushes) + t.terrain.level + t.delay for t in group]
            for group in subset.trials
        ]
        assert (np.diff(strengths, axis=1) > 0).all()


def test_a_border_is_where_the_next_level_has_another_verdict():
    native = np.array([[1, 1, 0, 0, 0], [1, 1, 1, 1, 1], [1, 0, 1, 1, 0]], bool)
    border = verdicts.at_border(native)
    np.testing.assert_array_equal(border, [[0, 1, 1, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]])
    mjx = np.array([[1, 1, 1, 0, 1], [1, 1, 1, 1, 1], [1, 0, 1, 1, 0]], bool)
    found = verdicts.row("push", native, mjx, border)
    assert (found["cells"], found["same"], found["survived_native"], found["survived_mjx"]) == (15, 13, 10, 12)
    assert (found["differ_at_border"], found["differ_elsewhere"]) == (1, 1)


def test_the_file_lists_what_differs(tmp_path, monkeypatch):
    """MJX lets one robot more fall: the first group's push of 60 N, where MuJoCo C has its border."""

    walked = set()

    def survived(agent, setting, subset):
        walked.add(agent.name)
        verdicts_of = np.ones((len(subset.trials), len(subset.trials[0])), bool)
        if subset.kind == "push":
            verdicts_of[0, 3 if setting.engine == "native" else 2 :] = False
        return verdicts_of

    monkeypatch.setattr(verdicts, "survived", survived)
    verdicts.main(VerdictsConfig(policy="1x", speed="1.5x", out=str(tmp_path / "a.json")))
    content = json.loads((tmp_path / "a.json").read_text())
    assert walked == {"1x speed=1.5x"}
    assert content["provenance"]["speed"] == "1.5x"
    assert [(row["kind"], row["cells"], row["same"]) for row in content["rows"]] == [
        *(("push", 384, 383), ("terrain", 64, 64), ("delay", 80, 80), ("all", 528, 527)),
    ]
    assert content["rows"][-1]["differ_at_border"] == 1
    (differing,) = content["differing"]
    assert (differing["survived_on"], differing["at_border"], differing["trial"]["pushes"]) == (
        "native",
        True,
        [[60, 0, 0, 0.2]],
    )
