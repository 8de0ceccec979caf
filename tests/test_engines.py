"""Policies on the other engine: which rows there are; MuJoCo C alone, for MJX compiles for long."""

import json

import jax
import pytest
from seeing import FULL

from cassie_mjx import cli
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.policy_file import save_policy
from cassie_mjx.evaluation.returns import walk_returns
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.make import make_physics
from cassie_mjx.ppo import learner
from cassie_mjx.ppo.config import PPOConfig
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import ModelConfig
from experiments import engines
from experiments.engines import EnginesConfig, main


def test_rows_are_the_returns_on_each_engine_at_each_rate(tmp_path, monkeypatch):
    run, soft = tmp_path / "run", tmp_path / "soft"
    motion = load_motion("walk")
    policy = learner.init(jax.random.key(0), PPOConfig(), FULL.size, cassie.NU, 1).policy
    for folder, kd_scale in ((run, 1.0), (soft, 0.5)):
        folder.mkdir()
        save_policy(folder / "best.npz", policy, motion, 1.0, kd_scale, {"samples": 7})
        (folder / "config.json").write_text(json.dumps({"config": {"physics": "mjx", "physics_hz": 500}}))

    both = engines.engines
    monkeypatch.setattr(engines, "engines", lambda rate: {"native": both(rate)["native"]})
    main(EnginesConfig((str(run), str(soft)), (2000, 500), str(tmp_path / "out.json")))
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert [(row["policy"], row["walks_on"], row["physics_hz"], row["trained_on"]) for row in rows] == [
        (str(folder), "native", hertz, "mjx") for hertz in (2000, 500) for folder in (run, soft)
    ]
    for row, folder in ((rows[0], run), (rows[1], soft)):
        expected = walk_returns(make_policy_agent(str(folder)), make_physics("native", ModelConfig()))
        assert {name: row[name] for name in expected} == {k: pytest.approx(v, abs=0.01) for k, v in expected.items()}


@pytest.mark.parametrize(("text", "why"), [("{}", "no 'config'"), ("[", "Expecting value"), (None, "No such file")])
def test_a_run_that_does_not_say_how_it_was_trained_is_refused_at_the_door(tmp_path, monkeypatch, text, why):
    policy = learner.init(jax.random.key(0), PPOConfig(), FULL.size, cassie.NU, 1).policy
    save_policy(tmp_path / "best.npz", policy, load_motion("walk"), 1.0, 1.0, {"samples": 7})
    if text:
        (tmp_path / "config.json").write_text(text)
    monkeypatch.setattr(engines, "engines", lambda _: pytest.fail("it went to work"))
    with pytest.raises((ValueError, OSError), match=why):
        main(EnginesConfig((str(tmp_path),), (2000,), str(tmp_path / "out.json")))


def test_a_directory_without_a_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no best.npz"):
        EnginesConfig((str(tmp_path),))


@pytest.mark.parametrize(("argument", "sentence"), [("rates=[]", "rates is empty"), ("runs=[]", "runs is empty")])
def test_nothing_to_compare_is_refused(tmp_path, argument, sentence):
    (tmp_path / "best.npz").touch()
    with pytest.raises(ValueError, match=f"{sentence}; name at least one, such as "):
        cli.parse(EnginesConfig, [f"runs={tmp_path}", argument])
    with pytest.raises(ValueError, match=r"runs is empty; name at least one, such as runs=runs/1x-seed0\."):
        cli.parse(EnginesConfig, [])
