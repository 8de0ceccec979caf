"""The report of any folder: who stands in which column."""

import json

from cassie_mjx.reporting.folder import beside_the_paper, by_agent, evaluations


def write(path, agent, value, quantity="return_plain", **provenance):
    path.parent.mkdir(exist_ok=True)
    origin = {"command": "c", "commit": "a", "date": "2026-11-25", "hardware": "h"} | provenance
    rows = [{"agent": agent, "quantity": quantity, "value": value, "unit": "of 300", "n": 10}]
    path.write_text(json.dumps({"rows": rows, "provenance": origin}))


def test_engines_stand_apart_and_seeds_together(tmp_path):
    write(tmp_path / "c0.json", "runs/mine-seed0", 290.0)
    write(tmp_path / "c1.json", "runs/mine-seed1", 280.0)
    write(tmp_path / "mjx.json", "runs/mine-seed0", 1.0, physics="mjx")
    write(tmp_path / "real.json", "runs/mine-seed0", 2.0, electronics=True)
    write(tmp_path / ".venv" / "other.json", "hidden", 5.0)
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "notes.json").write_text("{}")
    # A file without any of the paper's rows is no seed of the agent's.
    write(tmp_path / "more.json", "runs/mine-seed0", 7.0, quantity="joint_error_max_rad")
    found, skipped = evaluations(tmp_path)
    table = beside_the_paper(by_agent(found))
    assert table.header[3:-1] == ("`runs/mine`", "`runs/mine on MJX`", "`runs/mine with electronics`")
    assert table.rows[0][3:-1] == ("285.0 (280.0 to 290.0)", "1.0", "2.0")
    assert len(skipped) == 1
    assert "experiments/results" not in table.notes[0]
