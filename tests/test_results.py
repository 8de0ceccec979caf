"""Data lint: figures in the prose and hand-written tables of docs/results.md against the result files."""

import json
import re
import statistics
from pathlib import Path

import pytest

from experiments import studies

ROOT = Path(__file__).parents[1]
TEXT = " ".join((ROOT / "docs" / "results.md").read_text().split())


def read(result):
    return json.loads((ROOT / "experiments" / "results" / f"{result}.json").read_text())


def rows(result, **wanted):
    return [row for row in read(result)["rows"] if wanted.items() <= row.items()]


def loops(engine, iterations, physics_hz=2000, loops="ours"):
    return rows("solver", engine=engine, iterations=iterations, physics_hz=physics_hz, loops=loops)[0]


def rate(engine, contacts, physics_hz=1000):
    return rows("throughput", engine=engine, contacts=contacts, physics_hz=physics_hz, robots=256)[0]


def solver_lines():
    for hertz, name in ((2000, "2 kHz"), (1000, "1 kHz"), (500, "500 Hz")):
        for ours, theirs in (("2/50", "2/4"), ("4/50", "4/6")):
            native, mjx = loops("native", ours, hertz), loops("mjx", theirs, hertz)
            errors = f"{native['loop_error_max_mm']:.3f} / {mjx['loop_error_max_mm']:.3f}"
            rates = f"{round(native['steps_per_s'], -2):,} / {round(mjx['steps_per_s'], -2):,}"
            yield f"| {ours.split('/')[0]}, {name} | {errors} | {rates} |"


def quoted():
    """Pieces of the page, each with its figures filled in from a result."""
    ours, published = loops("native", "100/50"), loops("native", "100/50", loops="published")
    yield f"at most {ours['loop_error_max_mm']:.2f} mm instead of {published['loop_error_max_mm']:.1f} mm"
    yield from solver_lines()
    native, mjx, every = rate("native", "full"), rate("mjx", "walking"), rate("mjx", "published")
    yield f"| {round(native['steps_per_s'], -3):,}, {native['of_bare_loop']:.2f} times a bare loop in C |"
    faster = mjx["steps_per_s"] / every["steps_per_s"]
    yield f"| {round(mjx['steps_per_s'], -3):,}, {faster:.2f} times its own with all published contacts |"
    yield f"({round(rate('mjx', 'full')['steps_per_s'], -2):,} steps/s with full contacts)"
    yield f"{mjx['compile_s']:.0f} s, then cached"


def learned():
    """What the seeds of the walk say."""
    found = {row["quantity"]: row for row in rows("walking", variant="1x")}
    samples, runs = found["samples_to_250_plain"], read("walking")["runs"]
    yield f"{samples['n']} of {samples['runs']} seeds pass 250 of 300 by the plain reward"
    yield f"after {samples['median'] / 1e3:.0f} thousand samples in the median"
    yield f"{samples['max'] / 1e3:.0f} thousand at worst"
    for reward in ("plain", "weighted"):
        end = found[f"return_{reward}"]
        yield f"{end['iqm']:.1f} [{end['iqm_low']:.1f}, {end['iqm_high']:.1f}] {reward}"
    minutes = [run["curve"]["train_s"][-1] / 60 for run in runs]
    yield f"A whole run takes {min(minutes):.0f} to {max(minutes):.0f} min on one core"


def learned_alone():
    """How long `make train` takes."""
    (run,) = read("make_train")["runs"]
    total = run["curve"]["train_s"][-1]
    yield f"passes 250 plain after {run['train_s_to_250_plain']:.0f} s of training and takes {total:.0f} s in all"


def learned_at_other_speeds():
    """What other speeds come to."""
    for variant in ("0x", "2x", "3x", "4x"):
        found = {row["quantity"]: row for row in rows("learning_speeds", variant=variant)}
        samples = found["samples_to_250_plain"]
        assert samples["n"] == samples["runs"]
        cells = [
            str(samples["runs"]),
            span(samples, 1e3, 0),
            span(found["return_plain"]),
            span(found["return_weighted"]),
        ]
        yield f"| {' | '.join((variant, *cells))} |"


def span(row, unit=1.0, digits=1):
    """The mean of a study's row, and the least and greatest of several seeds."""
    mean, least, greatest = (f"{row[name] / unit:.{digits}f}" for name in ("mean", "min", "max"))
    return mean if least == greatest else f"{mean} ({least} to {greatest})"


def learned_under_disturbances():
    """What the robust policy takes, in samples and time."""
    runs = read("robust")["runs"]
    first, second = ([run for run in runs if run["variant"] == name] for name in ("1x-robust-first", "1x-robust"))
    samples = [{run["curve"]["samples"][-1] for run in stage} for stage in (first, second)]
    (before,), (after,) = samples
    minutes = [sum(run["curve"]["train_s"][-1] for run in pair) / 60 for pair in zip(first, second, strict=True)]
    yield f"({before / 1e6:.1f} M and {after / 1e6:.1f} M samples, {min(minutes):.0f} to {max(minutes):.0f} min"
    evaluations = [f"evaluate/1x-robust-seed{seed}" for seed in range(3)]
    for side in ("forward", "backward"):
        weakest = [rows(name, quantity=f"push_{side}_N")[0]["value"] for name in evaluations]
        yield f"{side} {min(weakest):.0f} to {max(weakest):.0f} N"


def learned_of_one_step():
    """What policies of one step bear at the worst phase, beside those of both."""
    for name, words in (
        ("1x-robust-first", "bears {} N forward, {} N backward and {} N sideways at"),
        ("1x-robust-first-both-steps", "bear {}, {} and {} N (the"),
    ):
        bears = [
            statistics.mean(
                min(rows(f"evaluate/{name}-seed{seed}", quantity=f"push_{side}_N")[0]["value"] for side in sides)
                for seed in range(3)
            )
            for sides in (("forward",), ("backward",), ("left", "right"))
        ]
        yield words.format(*(f"{force:.0f}" for force in bears))


def verdicts():
    """On how many trials the engines agree."""
    (everything,) = rows("verdicts", kind="all")
    assert everything["differ_elsewhere"] == 0
    yield f"Of {everything['cells']} trials of 1x chosen"
    yield f"{everything['same']} end alike on both engines, and the other {everything['differ_at_border']} are at a"
    content = read("verdicts")
    steep = [one for one in content["differing"] if one["trial"]["terrain"] == 0.25]
    assert {one["survived_on"] for one in steep} == {"mjx"}
    yield f"{len(steep)} of them at h = 0.25 m"


def mapped():
    """How long the push map takes, and what share of it is survived."""
    result = read("map/1x-seed0")
    (survived,) = rows("map/1x-seed0", quantity="push_map_survived")
    yield f"map of 1x, {survived['n']:,} trials, takes {result['provenance']['seconds']['map']:.0f} s on"
    yield f"{100 * survived['value']:.0f}% of them are survived"


def on_both_engines():
    """What the policies that either engine trained have on both."""
    found = {(row["trained_on"], row["walks_on"], row["physics_hz"]): row["return_plain"] for row in rows("engines")}
    on_c, on_mjx = ([found[trained, walks, 2000] for walks in ("native", "mjx")] for trained in ("native", "mjx"))
    assert f"{on_c[0]:.1f}" == f"{on_c[1]:.1f}"
    assert f"{on_mjx[0]:.1f}" == f"{on_mjx[1]:.1f}"
    yield f"has a plain return of {on_c[0]:.1f} on MuJoCo C and on MJX"
    yield f"has {on_mjx[0]:.1f} on both"


def blended():
    """What the blends come to."""
    found = {(row["agent"], row["quantity"]): row for row in rows("interpolation")}
    chain = "blend:0x,1x,2x,3x,4x schedule=ramp"
    up, fastest = found[chain, "starts_up"], found[chain, "highest_speed_mps"]
    yield f"from stepping in place to {fastest['value']:.1f} m/s"
    yield f"from {up['value']:g} of {up['n']} starting phases"
    first, second, blend = (
        found[agent, "terrain_h_m"]["value"] for agent in ("1x", "2x", "blend:1x,2x schedule=adaptive")
    )
    yield f"h = {blend:.2f} m against {first:.2f} and {second:.2f}"
    alone = [row["value"] for k in range(10) for row in rows(f"evaluate/1x-seed{k}", quantity="terrain_h_m")]
    yield f"1x alone reaches {min(alone):.2f} to {max(alone):.2f}"


def tuned():
    """What the tuner found, beside the presets."""
    for preset in ("compliant", "stiff"):
        content = read(f"tune_{preset}")
        found, shipped = (content["scores"][name]["cost"] for name in ("found", "shipped"))
        yield f"{found:.3f} against {shipped:.3f} for `{preset}` in {content['provenance']['generations']}"


def bounds():
    """Patterns of the page, each with the measured figure that the one found must bound closely."""
    converged = rows("agreement", comparison="qacc, float64, converged")
    yield r"agrees with MuJoCo C to (\S+) rad/s²", max(row["difference_max"] for row in converged)
    yield r"off by up to (\S+) rad/s²", max(row["difference_max_without_bias"] for row in converged)
    moving = rows("agreement", control_steps=10)
    yield r"pelvis is within (\S+) mm after 10 control steps", max(row["pelvis_difference_max_mm"] for row in moving)
    legs = [row for row in rows("contacts", push_N=60.0) if re.search("tarsus.*foot|foot.*tarsus", row["pair"])]
    yield r"by up to (\S+) mm: both engines", max(-row["smallest_distance_mm"] for row in legs)


PAGES = ["README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_links_to_exists(page):
    targets = re.findall(r"\]\(([^)#:]+)\)", (ROOT / page).read_text())
    assert [target for target in targets if not (ROOT / page).parent.joinpath(target).exists()] == []


@pytest.mark.parametrize(
    "piece",
    [
        *quoted(),
        *learned(),
        *learned_alone(),
        *learned_at_other_speeds(),
        *learned_under_disturbances(),
        *learned_of_one_step(),
        *verdicts(),
        *mapped(),
        *on_both_engines(),
        *blended(),
        *tuned(),
    ],
)
def test_what_the_page_quotes_is_what_was_measured(piece):
    assert piece in TEXT


@pytest.mark.parametrize(("pattern", "measured"), list(bounds()))
def test_bounds_on_the_page_hold_and_are_close(pattern, measured):
    found = re.search(pattern, TEXT)
    assert found
    assert 0.99 * measured <= float(found[1]) <= 1.1 * measured


def test_no_result_names_a_folder_of_one_machine():
    named = {path.name for path in (ROOT / "experiments/results").rglob("*.json") if "=/" in path.read_text()}
    assert not named


def test_the_guide_names_the_study_of_the_robust_policy():
    text = (ROOT / "docs" / "train.md").read_text()
    (study,) = set(re.findall(r"experiments\.learning study=(\w+)", text))
    assert studies.STUDIES[study][-1].name == "1x-robust"


def test_the_guide_has_the_figures_of_the_policy_on_sensors():
    text, found = (ROOT / "docs" / "train.md").read_text(), {}
    for suite in ("walk", "dynamics", "sensors"):
        found |= {row["quantity"]: row["value"] for row in rows(f"sensors/1x-sensors-seed0-{suite}")}
    table = text.partition("| `1x-sensors` (seed 0")[2].partition("\n\n")[0]
    cells = [line.split("|")[2].strip() for line in table.splitlines()[2:]]
    percent = {name: f"{100 * value:.0f} %" for name, value in found.items() if "survived" in name}
    assert cells == [
        f"{found['return_plain']:.1f} and {found['return_weighted']:.1f}",
        f"{found['drift_m']:.3f}",
        ", ".join(percent[f"dynamics_{name}_survived"] for name in ("moderate", "wide")),
        ", ".join(percent[f"sensors_noise_x{factor}_survived"] for factor in (1, 2, 4)),
        percent["sensors_tilt_0.1rad_survived"],
        percent["sensors_offset_0.03rad_survived"],
        percent["sensors_drift_survived_60s"],
    ]
    full = [row["value"] for seed in range(10) for row in rows(f"evaluate/1x-seed{seed}", quantity="return_plain")]
    assert found["return_plain"] > 0.97 * statistics.mean(full)
