"""What an accelerator would run, as far as can be seen without one, and what a command chooses where there is one."""

import json
import sys
from functools import cache
from typing import Any, cast

import jax
import pytest
from jax import export
from tiny import TINY

from cassie_mjx import train
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.ppo.config import PPO_PRESETS, PPOConfig
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model
from cassie_mjx.training import devices, sentences
from cassie_mjx.training.config import TrainConfig, resolve_config
from cassie_mjx.training.trainer import Trainer
from experiments import accelerator, lowering
from experiments.accelerator import AcceleratorConfig, Part

# The one loop goes over the steps of a control step; 13 of the gathers pick from states, the others from constants.
BUDGET = {"while": 1, "gather": 80, "scatter": 0}


@cache
def lowered(platform):
    return lowering.step_text(MjxPhysics(load_mjx_model(MJX_TRAINING), scene="flat"), platform)


def test_a_physics_step_keeps_to_its_budget_on_a_gpu():
    """By `experiments.lowering`; on a TPU it is the same program but for the factorisation."""
    counts = lowering.operations(lowered("cuda"))
    assert {name: counts[name] for name in BUDGET if counts[name] > BUDGET[name]} == {}
    # A factorisation for each step of the solver, and one for the dampers.
    assert counts["custom_call"] == MJX_TRAINING.iterations + 1
    assert counts["triangular_solve"] == 2 * counts["custom_call"]


def test_no_product_of_the_physics_is_rounded_on_a_gpu():
    assert lowering.rounded_products(lowered("cuda")) == 0
    rounded = export.export(jax.jit(lambda x: x @ x), platforms=["cuda"])(jax.ShapeDtypeStruct((4, 4), "float32"))
    assert lowering.rounded_products(rounded.mlir_module()) == 1


def test_calls_count_as_often_as_they_are_made():
    module = """func.func public @main() {
  %0 = call @twice() : ()
  %1 = stablehlo.gather
} func.func private @twice() {
  %0 = func.call @once()
  %1 = call @once()
} func.func private @once() {
  %0 = stablehlo.gather
}"""
    assert lowering.operations(module) == {"gather": 3}


def test_a_whole_iteration_lowers_for_a_gpu_and_a_tpu():
    trainer = Trainer(resolve_config(TrainConfig(physics="mjx", physics_hz=500, ppo=TINY)), load_motion("walk"))
    shapes = jax.eval_shape(trainer.start)
    exported = export.export(cast(Any, trainer.iterate), platforms=["cuda", "tpu"])(shapes)
    assert exported.platforms == ("cuda", "tpu")
    assert len(exported.out_avals) == len(jax.tree.leaves(jax.eval_shape(trainer.iterate, shapes)))


def trained(monkeypatch, *arguments):
    seen = []
    monkeypatch.setattr(train, "main", seen.append)
    monkeypatch.setattr(train.main, "__module__", train.__name__, raising=False)
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    train.run()
    return seen[0]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], PPO_PRESETS["massive"]),
        (["physics=auto", "speed=2x"], PPO_PRESETS["massive"]),
        (["ppo=parallel"], PPOConfig()),
        (["physics=native"], PPOConfig()),
        (["physics=mjx"], PPOConfig()),
    ],
)
def test_an_accelerator_trains_with_large_batches_unless_a_preset_is_named(monkeypatch, capsys, arguments, expected):
    monkeypatch.setattr(devices, "accelerator", lambda: "Large Card")
    assert trained(monkeypatch, *arguments).ppo == expected
    massive = expected == PPO_PRESETS["massive"]
    assert capsys.readouterr().err == (
        "Large Card trains: physics=mjx and ppo=massive, unless you name others.\n" if massive else ""
    )


def test_single_values_go_on_top_and_a_cpu_stays_with_small_batches(monkeypatch, capsys):
    assert trained(monkeypatch).ppo == PPOConfig()
    monkeypatch.setattr(devices, "accelerator", lambda: "Large Card")
    ppo = trained(monkeypatch, "ppo.gamma=0.98").ppo
    assert (ppo.gamma, ppo.num_robots) == (0.98, PPO_PRESETS["massive"].num_robots)


def test_processes_find_each_other_before_one_looks_for_devices(monkeypatch):
    order = []
    monkeypatch.setattr(devices, "join", lambda: order.append("join"))
    monkeypatch.setattr(devices, "accelerator", lambda: order.append("accelerator"))
    trained(monkeypatch, "distributed=true")
    assert order == ["join", "accelerator"]


def test_a_run_on_mjx_says_what_memory_it_takes():
    said = sentences.plan(resolve_config(TrainConfig(physics="mjx", ppo=PPO_PRESETS["massive"])))
    assert "They take about 0.7 of " in said
    assert "memory" not in sentences.plan(resolve_config(TrainConfig(physics="native")))


# experiments.accelerator


def measured(monkeypatch, tmp_path, run_part, **config):
    monkeypatch.setattr(accelerator, "run_part", run_part)
    accelerator.main(AcceleratorConfig(out=str(tmp_path / "out.json"), **config))
    return json.loads((tmp_path / "out.json").read_text())


def test_the_parts_of_an_accelerator_make_one_result(monkeypatch, tmp_path):
    def run_part(part, seconds):
        assert 0 < seconds <= part.most_s
        return [{"worked": part.work}], "broke" if "triton" in part.name else None

    found = measured(monkeypatch, tmp_path, run_part)
    assert [row["worked"] for row in found["rows"][:5]] == [
        "device",
        "throughput",
        "agreement",
        "training",
        "throughput",
    ]
    assert len(found["rows"]) == 5 + len(accelerator.FLAGS)
    assert found["skipped"] == [{"part": "flags, XLA_FLAGS=--xla_gpu_enable_triton_gemm=false", "why": "broke"}]


def test_parts_that_would_not_fit_are_named(monkeypatch, tmp_path):
    found = measured(monkeypatch, tmp_path, lambda part, seconds: ([], None), seconds=19)
    assert {each["part"] for each in found["skipped"]} == {
        part.name for part in accelerator.parts(AcceleratorConfig()) if part.least_s >= 19
    }


def test_a_part_that_fails_or_takes_too_long_keeps_its_rows(monkeypatch):
    program = "import sys, time; print('{\"a\": 1}', flush=True); "
    for ending, why in (
        ("sys.exit('no such flag')", "ended with status 1: no such flag"),
        ("time.sleep(60)", "not do"),
    ):
        popen = accelerator.subprocess.Popen
        command = [sys.executable, "-c", program + ending]
        monkeypatch.setattr(accelerator.subprocess, "Popen", lambda *_, p=popen, c=command, **options: p(c, **options))
        rows, said = accelerator.run_part(Part("a", "device", {}, 0, 1), 3)
        monkeypatch.setattr(accelerator.subprocess, "Popen", popen)
        assert rows == [{"a": 1}]
        assert said is not None
        assert said.startswith(why)


def test_goals_are_read_from_a_runs_metrics(tmp_path):
    lines = [(100, 1.0, 200.0), (200, 2.0, 260.0), (300, 3.0, 250.0)]
    names = ("train/samples", "time/train_s", "eval/return_plain")
    file = tmp_path / "metrics.jsonl"
    file.write_text(
        "".join(json.dumps({**dict(zip(names, line, strict=True)), "time/samples_per_s": 9.0}) + "\n" for line in lines)
        + '{"half'
    )
    found = accelerator.reached(accelerator.curve(file))
    assert (found["samples_to_250"], found["train_s_to_250"], found["samples_to_280"]) == (200, 2.0, None)
    assert accelerator.best(file) == 260.0
    assert accelerator.reached([])["evaluations"] == 0


@pytest.mark.slow
def test_an_accelerator_is_measured_at_toy_sizes(tmp_path):
    small = ["ppo.num_robots=4", "ppo.num_steps=8", "ppo.iterations=2", "ppo.minibatch_size=16", "evaluate_every=1"]
    small += ["ppo.updates_per_iteration=2", "ppo.hidden_sizes=16", "ppo.normalizer_samples=32"]
    config = {"robots": (2, 4), "control_steps": 1, "train": tuple(small), "seconds": 900.0}
    accelerator.main(AcceleratorConfig(out=str(tmp_path / "out.json"), **config))
    found = json.loads((tmp_path / "out.json").read_text())
    parts = {row["part"] for row in found["rows"]}
    assert {"device", "throughput, training", "agreement", "training"} <= parts
