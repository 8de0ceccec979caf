"""The report: cells and curves from the files, gaps said to be gaps, a page that needs nothing else."""

import base64
import copy
import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cassie_mjx.reporting.tables import markdown
from experiments import report, tables
from experiments.pages import MARKERS, block, driving_block, readme_block, with_block
from experiments.report import ReportConfig, main, whole_page

ROOT = Path(__file__).parents[1]
PROVENANCE = {"command": "python -m made.up", "commit": "abc", "date": "2026-01-02", "hardware": "a CPU, 2 cores"}
MAP = {
    "directions_deg": [0.0, 90.0, 180.0, 270.0],
    "phases": [0.0, 0.5],
    "forces_N": [10, 20],
    "survived": [["11", "10"], ["11", "11"], ["00", "00"], ["10", "00"]],
}


def write(folder, name, rows=(), origin=None, **content):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"rows": list(rows), **content, "provenance": PROVENANCE | (origin or {})}))


def figures(agent="1x", **values):
    return [{"agent": agent, "quantity": name, "value": v, "unit": "", "n": 8} for name, v in values.items()]


def learning(variant, seed, returns):
    curve = {"samples": [1e6, 2e6], "train_s": [60 + 60 * seed, 240 - 60 * seed]}
    return {
        "variant": variant,
        "seed": seed,
        "curve": curve | dict.fromkeys(("return_plain", "return_weighted"), returns),
    }


def row_of(table, experiment):
    return next(dict(zip(table.header, row, strict=True)) for row in table.rows if row[0].startswith(experiment))


@pytest.fixture
def everything(tmp_path):
    """A folder with a result of every kind."""
    folder = tmp_path / "results"
    write(folder, "controller_stiff.json", figures(terrain_h_m=0.4, push_forward_N=220))
    for seed, force in enumerate((100, 120, 170)):
        rows = figures(return_plain=290 + seed, push_forward_N=force, push_left_N=60, push_right_N=50)
        write(folder, f"evaluate/1x-seed{seed}.json", rows)
    write(folder, "map/1x-seed0.json", map=MAP)
    levels = [{"agent": "1x", "quantity": "terrain_survived", "level": h, "value": 1 - h} for h in (0.0, 0.5)]
    levels += [{"agent": "1x", "quantity": "delay_survived", "level": ms, "value": 0.5} for ms in (0, 1)]
    write(folder, "survival/1x-seed0.json", levels)
    write(folder, "walking.json", runs=[learning("1x", 0, [100, 200]), learning("1x", 1, [200, 300])])
    angles = {"walked": [0.1, 0.2], "reference": [0.1, 0.1]}
    places = {"walked": [[0.0, 0.1]], "reference": [[0.0, 0.1], [0.5, 0.1]]}
    joints, feet = {"knee": {"left": angles, "right": angles}}, {"left": places, "right": places}
    write(folder, "stride_1x.json", time_s=[0, 0.032], joints=joints, feet=feet)
    ride = {name: [0.5, 1.0] for name in ("time_s", "commanded_mps", "mean_mps", "least_mps", "greatest_mps")}
    speeds = figures("2x", commanded_mps=1.42, speed_mps=1.401, survived_s=10, return_plain=285)
    for seed, speed, up, plain in ((0, 2.12, 10, 280), (2, 2.16, 9, 270)):
        walked = figures("3x", commanded_mps=2.13, speed_mps=speed, survived_s=up, return_plain=plain)
        speeds += [row | {"seed": seed} for row in walked]
    speeds += figures("any speed=0x", commanded_mps=0, speed_mps=-0.05, survived_s=10)
    speeds += figures("any speed=4x", commanded_mps=2.84, speed_mps=1, survived_s=8)
    write(folder, "speeds.json", speeds, profile=ride)
    up = {"agent": "blend:1x,2x schedule=ramp", "quantity": "starts_up", "value": 19, "unit": "of 20", "n": 20}
    write(folder, "interpolation.json", [up], rides={up["agent"]: ride})
    cells = {"cells": 40, "same": 39, "same_share": 0.975, "differ_at_border": 1, "differ_elsewhere": 0}
    seconds = {"seconds_native": 2.4, "seconds_mjx": 30.6}
    write(folder, "verdicts.json", [{"kind": "push"} | cells | seconds, {"kind": "all"} | cells])
    origin = {"trained_on": "native", "trained_at_hz": 500, "samples": 4096, "physics_hz": 2000}
    returns = [("a", "native", 290.04, 280), ("a", "mjx", 289.96, 279), ("b", "native", 250, 240)]
    walked = [{"policy": p, "walks_on": on, "return_plain": r, "return_weighted": w} for p, on, r, w in returns]
    write(folder, "engines.json", [origin | row for row in walked])
    return folder


def test_cells_are_interquartile_mean_least_and_greatest_of_the_seeds(everything):
    table = tables.beside_the_paper(everything)
    ours = next(name for name in table.header if name.startswith("`1x`"))
    assert ours == "`1x`, interquartile mean of 3 training seeds (least to greatest)"
    push = row_of(table, "push forward, worst")
    # (100 + 120 + 170) / 3 = 130
    assert (push[ours], push["`stiff`"], push["paper: policy"]) == ("130 (100 to 170)", "220", "140")
    assert row_of(table, "undisturbed")[ours] == "291.0 (290.0 to 292.0)"
    assert row_of(table, "undisturbed")["`stiff`"] == "–"
    assert any("`1x` seed 2" in note for note in table.notes), "the best seed"


def test_sideways_is_the_weaker_side_and_needs_both(everything, tmp_path):
    ours = next(name for name in tables.beside_the_paper(everything).header if name.startswith("`1x`"))
    assert row_of(tables.beside_the_paper(everything), "push sideways, worst")[ours] == "50"
    write(tmp_path, "evaluate/1x-seed0.json", figures(push_left_N=60))
    assert tables.beside_the_paper(tmp_path).rows == []


def test_a_figure_that_some_seeds_lack_says_so(everything):
    write(everything, "evaluate/1x-seed3.json", figures(return_plain=293))
    row = row_of(tables.beside_the_paper(everything), "push forward, worst")
    assert row["`1x`, interquartile mean of 4 training seeds (least to greatest)"] == "130 (100 to 170) (3 of 4 seeds)"


def test_a_limit_at_the_highest_level_tried_says_so(everything):
    assert row_of(tables.beside_the_paper(everything), "terrain")["`stiff`"] == "0.40, the highest tried"
    for seed, h in enumerate((0.2, 0.4)):
        write(everything, f"evaluate/1x-robust-seed{seed}.json", figures(terrain_h_m=h))
    table = tables.beside_the_paper(everything)
    ours = next(name for name in table.header if name.startswith("`1x-robust`"))
    assert row_of(table, "terrain")[ours] == "0.30 (0.20 to 0.40), the highest tried by 1 of them"


def test_a_file_says_itself_up_to_which_level_it_tried(everything):
    for seed, h in enumerate((0.5, 0.8)):
        tried = {"highest": {"terrain_h_m": 0.8}}
        write(everything, f"evaluate/1x-robust-seed{seed}.json", figures(terrain_h_m=h), tried)
    table = tables.beside_the_paper(everything)
    ours = next(name for name in table.header if name.startswith("`1x-robust`"))
    assert row_of(table, "terrain")[ours] == "0.65 (0.50 to 0.80), the highest tried by 1 of them"


@pytest.mark.parametrize(
    ("origin", "complaint"),
    [
        ({"physics": "mjx"}, "physics=mjx, where physics=native"),
        ({"speed": "2x"}, "speed=2x, where speed=None"),
        ({"agent": {"seed": 7}}, "seed=7, where seed=0"),
    ],
)
def test_a_result_of_something_else_is_refused(tmp_path, origin, complaint):
    write(tmp_path, "evaluate/1x-seed0.json", figures(return_plain=290), origin)
    with pytest.raises(ValueError, match=f"1x-seed0.json is not a result as expected: it is of {complaint}"):
        tables.beside_the_paper(tmp_path)


def test_seeds_of_other_levels_are_not_averaged(everything):
    levels = [{"agent": "1x", "quantity": "terrain_survived", "level": h, "value": 1} for h in (0.0, 0.4)]
    write(everything, "survival/1x-seed1.json", levels)
    with pytest.raises(ValueError, match="1x-seed1.json .* terrain_survived at other levels"):
        whole_page(everything)
    (everything / "survival/1x-seed1.json").unlink()
    write(everything, "map/1x-seed1.json", map=MAP | {"forces_N": [20, 40]})
    with pytest.raises(ValueError, match="1x-seed1.json .* other directions or forces"):
        whole_page(everything)


def test_what_was_not_measured_is_named_and_never_shown(everything, tmp_path):
    notes = " ".join(tables.beside_the_paper(everything).notes)
    assert "Not measured yet: `compliant`; `1x-exact-starts`; `1x-robust`; speed, m/s; " in notes
    empty = tmp_path / "empty"
    empty.mkdir()
    assert tables.beside_the_paper(empty).rows == []
    assert tables.speeds_and_blends(empty) is None
    assert whole_page(empty).count("Not measured yet. ") == 18


def test_speeds_and_blends(everything):
    table = tables.speeds_and_blends(everything)
    assert table is not None
    assert [row[:3] for row in table.rows] == [
        ("any speed=0x to speed=4x", "–", "1 of 2 speeds up for 10 s, 0.05 m/s off at most"),
        ("2x", "learned in 3 to 5 h", "told 1.42 m/s: 1.40, up 10 of 10 s, return 285.0 by the plain reward"),
        (
            "3x",
            "learned in 3 to 5 h",
            "told 2.13 m/s: 2.14 (2.12 to 2.16), up at least 9 of 10 s, return 275.0 (270.0 to 280.0) by the plain "
            "reward; training seeds 0, 2",
        ),
        ("blend:1x,2x schedule=ramp", "speeds up, slows down", "19 of 20 starts up"),
    ]


def test_the_policy_of_all_speeds_stands_beside_those_of_one(everything):
    assert tables.beside_each_other(everything, tables.ALL_SPEEDS) is None
    write(everything, "evaluate/any-2x-seed0.json", figures(push_forward_N=90, terrain_h_m=0.2), {"speed": "2x"})
    table = tables.beside_each_other(everything, tables.ALL_SPEEDS)
    assert table is not None
    assert table.header[1:-1] == (
        "`1x`, interquartile mean of 3 training seeds (least to greatest)",
        "`any speed=2x`, training seed 0",
    )
    assert row_of(table, "push forward, worst")["`any speed=2x`, training seed 0"] == "90"
    assert row_of(table, "undisturbed")["`any speed=2x`, training seed 0"] == "–"
    assert markdown(table) in block(everything)


def test_policies_of_one_step_stand_beside_those_of_both(everything):
    write(everything, "evaluate/1x-robust-first-seed0.json", figures(push_backward_N=150))
    assert tables.beside_each_other(everything, tables.STEPS) is None
    write(everything, "evaluate/1x-robust-first-both-steps-seed0.json", figures(push_backward_N=90))
    table = tables.beside_each_other(everything, tables.STEPS)
    assert table is not None
    assert [row[1:3] for row in table.rows] == [("150", "90")]
    assert "for `any`" not in table.notes[0]
    assert markdown(table) in block(everything)


def test_two_engines(everything):
    (verdicts,), (engines,) = tables.find(everything, "verdicts.json"), tables.find(everything, "engines.json")
    assert [row[:-1] for row in tables.verdicts(verdicts).rows] == [
        ("push", "40", "39 (97.5%)", "1", "0", "2 s", "31 s"),
        ("all", "40", "39 (97.5%)", "1", "0", "–", "–"),
    ]
    table = tables.engines(engines)
    assert table.header[3:5] == ("plain return on MuJoCo C", "plain return on MJX")
    assert [row[:-1] for row in table.rows] == [
        ("a", "MuJoCo C at 500 Hz, 4,096 samples", "2000", "290.0", "290.0", "280.0", "279.0"),
        ("b", "MuJoCo C at 500 Hz, 4,096 samples", "2000", "250.0", "–", "240.0", "–"),
    ]


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("evaluate/1x-seed0.json", "{", "Expecting property name"),
        ("evaluate/1x-seed0.json", 9999 * "[", "recursion"),
        ("evaluate/1x-seed0.json", "[1]", "holds no JSON object"),
        ("controller_stiff.json", '{"rows": [], "provenance": {"command": "x"}}', "no 'commit'"),
        ("walking.json", json.dumps({"rows": [], "provenance": PROVENANCE}), "no 'runs'"),
        ("walking.json", json.dumps({"rows": [], "runs": [{"variant": "1x"}], "provenance": PROVENANCE}), "no 'curve'"),
        (
            "map/1x-seed0.json",
            json.dumps({"rows": [], "map": MAP | {"forces_N": [10]}, "provenance": PROVENANCE}),
            "a map of shape (4, 2, 2) does not fit its axes",
        ),
        (
            "controller_stiff.json",
            json.dumps({"rows": figures(speed_mps="fast"), "provenance": PROVENANCE}),
            "could not convert string to float: 'fast'",
        ),
        ("survival/1x-seed0.json", json.dumps({"rows": [], "provenance": PROVENANCE}), "no rows of terrain_survived"),
    ],
)
def test_a_malformed_file_is_named_in_one_sentence_and_nothing_is_written(everything, tmp_path, name, text, why):
    (everything / name).write_text(text)
    out = tmp_path / "page.html"
    out.write_text("precious")
    with pytest.raises(ValueError, match="is not a result as expected") as refused:
        main(ReportConfig(str(everything), str(out), overwrite=True))
    assert str(everything / name) in str(refused.value)
    assert why in str(refused.value)
    assert out.read_text() == "precious"


class Tags(HTMLParser):
    """All tags of a page, with their attributes, and the tags left open."""

    def __init__(self):
        super().__init__()
        self.tags, self.open = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_needs_no_other_file(everything):
    parser = Tags()
    parser.feed(whole_page(everything))
    assert parser.open == []
    assert {tag for tag, _ in parser.tags}.isdisjoint({"script", "link", "iframe"})
    addresses = [value for _, attributes in parser.tags for key, value in attributes.items() if key in {"src", "href"}]
    kind = "data:image/svg+xml;base64,"
    assert all(address.startswith(kind) for address in addresses)
    # 3 learning curves, a map, 2 survivals, a joint and the feet, 2 rides
    assert len(addresses) == 10
    assert all(b"<svg" in base64.b64decode(address.removeprefix(kind)) for address in addresses)
    assert "@import" not in whole_page(everything)


def test_the_same_results_give_the_same_page_with_their_sources(everything):
    page = whole_page(everything)
    assert page == whole_page(everything)
    for word in ("evaluate/1x-seed2.json", "python -m made.up", "a CPU, 2 cores", "2026-01-02", "commit abc", "seed 2"):
        assert word in page


def test_text_from_a_file_is_escaped(everything):
    write(everything, "speeds.json", figures("<b>2x", terrain_h_m=0.1), profile={"time_s": [], "commanded_mps": []})
    assert "&lt;b&gt;2x" in whole_page(everything)
    assert "<b>" not in whole_page(everything)


def test_a_learning_curve_is_the_mean_of_the_seeds_where_all_have_one():
    runs = [learning("1x", 0, [100, 200]), learning("1x", 1, [200, 300])]
    minutes, returns = np.array(report.plots.learning(runs, "train_s").axes[0].lines[0].get_data())
    # Seed 0 went from 100 at 1 min to 200 at 4 min, seed 1 from 200 at 2 min to 300 at 3 min.
    np.testing.assert_allclose(minutes[[0, -1]], [2, 3])
    np.testing.assert_allclose(returns[[0, -1]], [(100 + 100 / 3 + 200) / 2, (100 + 200 / 3 + 300) / 2])


def test_maps_and_survival_are_means_over_seeds(everything):
    other = copy.deepcopy(MAP)
    other["survived"][0] = ["00", "00"]
    write(everything, "map/1x-seed1.json", map=other)
    ((_, results),) = tables.agents(everything, "map")
    pushes = report.mean_map(everything, results)
    np.testing.assert_allclose(pushes.shares, [[0.5, 0.25], [1, 1], [0, 0], [0.5, 0]])
    assert pushes.farthest_n == 20
    ((_, results),) = tables.agents(everything, "survival")
    series = report.survival_series(everything, "1x", results, "terrain_survived")
    assert series == ("1x", [0.0, 0.5], [1.0, 0.5])


def test_the_block_between_the_markers_is_written_anew_and_only_it():
    text = f"before\n{MARKERS[0]}\nold\n{MARKERS[1]}\nafter\n"
    once = with_block(text, "new")
    assert once == f"before\n{MARKERS[0]}\n\nnew\n\n{MARKERS[1]}\nafter\n"
    assert with_block(once, "new") == once


@pytest.mark.parametrize("text", ["", MARKERS[0], "".join(reversed(MARKERS)), "".join(MARKERS) * 2])
def test_a_readme_without_its_markers_is_refused(text):
    with pytest.raises(ValueError, match="needs the lines"):
        with_block(text, "new")


def test_page_and_readme_are_written(everything, tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("\n".join(MARKERS))
    main(ReportConfig(str(everything), str(tmp_path / "new" / "index.html"), str(readme)))
    assert "130 (100 to 170)" in readme.read_text()
    assert "130 (100 to 170)" in (tmp_path / "new" / "index.html").read_text()


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a folder"):
        main(ReportConfig(str(tmp_path / "missing"), str(tmp_path / "page.html")))


@pytest.mark.parametrize(
    ("page", "tables_of"),
    [("README.md", readme_block), ("docs/results.md", block), ("docs/evaluate.md", driving_block)],
)
def test_pages_show_what_the_results_say(page, tables_of):
    text = (ROOT / page).read_text()
    assert text == with_block(text, tables_of(ROOT / "experiments" / "results")), "run `make report`"


def test_the_report_needs_neither_jax_nor_mujoco():
    code = "import sys, experiments.report; print({'jax', 'mujoco', 'brax'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
