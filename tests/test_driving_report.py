"""How policies follow commands, as the report shows it: worked by hand for four commands, two trials each."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.reporting import driving
from cassie_mjx.reporting.driving import COMPONENTS, QUANTITIES, error_map, largest_errors, quantities, read_drives
from cassie_mjx.reporting.folder import folder_page
from cassie_mjx.reporting.results import Result

ROOT = Path(__file__).parents[1]
ORIGIN = {"command": "c", "commit": "a", "date": "2026-11-28", "hardware": "h"}
COMMANDS = [[0, 0, 0], [0, 0.2, 0], [1, 0, 0], [1, 0, 0.4]]
ERRORS = [[0.01, 0.02, 0.03], [0.05, 0.01, 0.0], None, [0.02, 0.3, 0.01]]
STAYED, FELL = [[0.0, 0.0], [1.0, 0.5], [2.0, 0.5]], [[0.0, 0.0], [1.0, 0.5], [1.0, 0.5]]


def drive(seed=0, **changes):
    eight = {"radius_m": 2.0, "paths": [STAYED, FELL]}
    cells = {"commands": COMMANDS, "survived": ["11", "10", "00", "11"], "errors": ERRORS, "figure_eight": eight}
    values = {"command_survived": 0.625, "stop_s": 2.0 + seed}
    rows = [{"agent": "steered", "quantity": name, "value": value, "unit": ""} for name, value in values.items()]
    return Result(f"steered-seed{seed}.json", {"rows": rows, "command": cells | changes, "provenance": ORIGIN})


DRIVES = read_drives([drive()], Path())


def words(figure):
    return [text.get_text() for text in figure.axes[0].texts]


def test_a_map_has_the_largest_error_of_the_commands_of_a_cell():
    cells = error_map(DRIVES, component=1, sideways=1)
    np.testing.assert_array_equal(cells.forward_mps, [0, 1])
    np.testing.assert_array_equal(cells.sideways, [0, 0.2])
    np.testing.assert_array_equal(cells.errors, [[0.02, 0.01], [0.3, np.nan]])
    np.testing.assert_array_equal(cells.fell, [[0, 1], [2, 0]])
    np.testing.assert_array_equal(cells.trials, [[2, 2], [4, 0]])
    over_yaw_rates = error_map(DRIVES, component=1, sideways=2)
    np.testing.assert_array_equal(over_yaw_rates.errors, [[0.02, np.nan], [np.nan, 0.3]])
    np.testing.assert_array_equal(over_yaw_rates.trials, [[4, 0], [2, 2]])


def test_a_drawn_map_says_errors_and_falls():
    figures = [figure for figure, _ in driving.drawings("steered", DRIVES)]
    assert len(figures) == 2 * len(COMPONENTS) + 1
    lateral_over_yaw, lateral_over_lateral = figures[2:4]
    assert words(lateral_over_yaw) == ["0.02\n1 of 4 fell", "all fell", "0.30"]
    assert words(lateral_over_lateral) == ["0.02", "0.01\n1 of 2 fell", "0.30\n2 of 4 fell"]
    axis = lateral_over_yaw.axes[0]
    assert axis.get_xlim() == (2, 0), "left is on the left"
    hatched = [patch.get_xy() for patch in axis.patches if patch.get_hatch()]
    assert hatched == [(0, 0), (0, 1)]


def test_both_maps_of_a_component_have_one_scale_from_nothing_to_the_goal_at_least():
    figures = [figure for figure, _ in driving.drawings("steered", DRIVES)]
    scales = [figure.axes[0].collections[0].get_clim() for figure in figures[:-1]]
    assert scales == [(0, 0.08), (0, 0.08), (0, 0.3), (0, 0.3), (0, 0.08), (0, 0.08)]


def test_paths_are_drawn_on_the_figure_of_eight_and_falls_are_marked():
    (axis,) = driving.drawings("steered", DRIVES)[-1][0].axes
    assert sorted((circle.center, circle.radius) for circle in axis.patches) == [((-2, 0), 2), ((2, 0), 2)]
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), [[0, 0], [0.5, 1], [0.5, 2]])
    crosses = [line.get_xydata().tolist() for line in axis.lines if line.get_marker() == "x"]
    assert crosses == [[[0.5, 1]]]


def test_the_largest_errors_are_named_with_their_commands():
    assert largest_errors("steered", DRIVES) == (
        "Largest errors of `steered`: 0.05 m/s in forward velocity under `command=0,0.2,0`, "
        "0.30 m/s in lateral velocity under `command=1,0,0.4`, 0.03 rad/s in yaw rate under `command=0,0,0`; "
        "3 of 8 trials of the grid end in a fall."
    )
    nobody = read_drives([drive(errors=[None] * 4, survived=["00"] * 4)], Path())
    assert largest_errors("steered", nobody).endswith("`steered`: –; 8 of 8 trials of the grid end in a fall.")
    assert words(driving.drawings("steered", nobody)[0][0]) == ["all fell"] * 3


def test_seeds_are_a_mean_of_those_that_stayed_up():
    other = drive(1, survived=["11", "11", "10", "11"], errors=[[0.03, 0.04, 0.05], *[[0.1, 0.2, 0.3]] * 3])
    drives = read_drives([drive(), other], Path())
    np.testing.assert_allclose(drives.errors[0], [0.02, 0.03, 0.04])
    np.testing.assert_allclose(drives.errors[2], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(drives.fell.sum(axis=1), [0, 1, 3, 0])
    assert len(drives.paths) == 4


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"commands": [[0, 0, 0.1], *COMMANDS[1:]]}, "other commands than those of the first seed"),
        ({"survived": ["11"]}, r"commands of shape \(4, 3\) do not fit errors of shape \(4, 3\) and 1 of trials"),
        ({"figure_eight": {}}, "no 'radius_m'"),
    ],
)
def test_a_result_that_does_not_fit_is_named(changes, why):
    with pytest.raises(ValueError, match=f"steered-seed1.json is not a result as expected: {why}"):
        read_drives([drive(), drive(1, **changes)], Path())


def test_the_table_has_goals_and_what_was_not_measured_is_a_dash():
    table = quantities({"steered": [drive(), drive(1)]}, Path())
    rows = {row[-1]: row[1:-1] for row in table.rows}
    assert list(rows) == [quantity.name for quantity in QUANTITIES]
    assert rows["command_survived"] == ("≥ 0.99", "0.625")
    assert rows["stop_s"] == ("≤ 2", "2.5 (2.0 to 3.0)")
    assert rows["stand_foot_slip_m"] == ("≤ 0.02", "–")
    assert "over training seeds" in table.notes[1]
    assert "over training seeds" not in " ".join(quantities({"steered": [drive()]}, Path()).notes)


def test_any_folder_with_such_a_result_has_the_maps():
    page = folder_page([drive()])
    assert "<h2>Driving</h2>" in page
    assert page.count("<figure>") == 2 * len(COMPONENTS) + 1
    without = drive()
    del without.content["command"]
    assert "<h2>Driving</h2>" not in folder_page([without])


# Data lint: what pages say of the shipped policy, against its result.

PROVENANCE = NumpyPolicy.load(shipped_policies()["joystick"]).provenance
MEASURED = ROOT / f"experiments/results/command/joystick-seed{PROVENANCE['seed']}.json"


def page(name):
    return " ".join((ROOT / "docs" / f"{name}.md").read_text().split())


def test_the_result_is_of_the_policy_that_ships():
    assert json.loads(MEASURED.read_text())["provenance"]["agent"] == PROVENANCE


def test_the_table_has_all_that_was_measured():
    rows = json.loads(MEASURED.read_text())["rows"]
    assert {row["quantity"] for row in rows} <= {quantity.name for quantity in QUANTITIES}


def test_the_guide_says_how_the_policy_was_trained():
    sentence = r"`joystick` was trained \(seed (\d+), ([\d.]+) M samples; \d+ minutes [^()]* ([\d-]+)\)"
    said = re.search(sentence, page("train"))
    assert said
    samples = f"{PROVENANCE['samples'] / 1e6:.2f}"
    assert said.groups() == (str(PROVENANCE["seed"]), samples, PROVENANCE["date"])


def test_the_limits_say_how_far_the_feet_of_the_standing_policy_go():
    slip = {row["quantity"]: row["value"] for row in json.loads(MEASURED.read_text())["rows"]}["stand_foot_slip_m"]
    assert f"its feet creep or step by up to {slip:.2f} m" in page("limits")
