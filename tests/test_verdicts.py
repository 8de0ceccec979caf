"""The grid on which the engines' verdicts are compared, and the comparison by hand."""

import numpy as np

from experiments import verdicts


def test_the_grid_has_its_cells():
    kinds = {subset.kind: subset for subset in verdicts.subsets()}
    sizes = {kind: sum(map(len, subset.trials)) for kind, subset in kinds.items()}
    assert sizes == {"push": 8 * 4 * 12, "terrain": 8 * 8, "delay": 8 * 10}
    assert sum(sizes.values()) == 528
    assert {trial.delay for group in kinds["delay"].trials for trial in group} == set(range(4, 41, 4))
    for subset in kinds.values():
        strengths = [[np.hypot(*t.push) + t.terrain + t.delay for t in group] for group in subset.trials]
        assert (np.diff(strengths, axis=1) > 0).all()


def test_a_border_is_where_the_next_level_has_another_verdict():
    native = np.array([[1, 1, 0, 0, 0], [1, 1, 1, 1, 1], [1, 0, 1, 1, 0]], bool)
    border = verdicts.at_border(native)
    np.testing.assert_array_equal(border, [[0, 1, 1, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]])
    mjx = np.array([[1, 1, 1, 0, 1], [1, 1, 1, 1, 1], [1, 0, 1, 1, 0]], bool)
    found = verdicts.row("push", native, mjx, border)
    assert (found["cells"], found["same"], found["survived_native"], found["survived_mjx"]) == (15, 13, 10, 12)
    assert (found["differ_at_border"], found["differ_elsewhere"]) == (1, 1)
