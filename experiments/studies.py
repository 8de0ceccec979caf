"""Studies of learning: their variants, and the training configuration of each run."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.training.config import PRESETS, TrainConfig, present_names
from cassie_mjx.training.run_directory import comparable


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    name: str
    """Its runs are the directories <name>-seed<seed>, in whatever study."""
    settings: Mapping[str, str]
    """Key to value of the arguments of `python -m cassie_mjx.train` besides `ENGINE`; `{runs}` stands for the folder of
    the runs and `{seed}` for the seed."""
    seeds: tuple[int, ...] = (0, 1, 2)

    def of(self, seed: int, runs: Path) -> dict[str, str]:
        """The settings of one run in the folder `runs`."""
        chosen = {key: value.format(runs=runs, seed=seed) for key, value in self.settings.items()}
        return ENGINE | chosen | {"seed": str(seed)}


ENGINE = {"physics": "native", "physics_hz": "500", "evaluate_every": "40"}
"""What every run is trained on unless its variant says otherwise, so that what is compared differs in nothing else."""

FORMER = {
    "ppo.num_steps": "32",
    "ppo.updates_per_iteration": "40",
    "ppo.iterations": "300",
    "evaluate_every": "10",
    "ppo.actor_schedule": "constant",
    "ppo.learning_rate_floor": "0.1",
    "walk.start_velocity_mps": "0.5",
}
"""What the runs under disturbances still have of the defaults until November 2026. They drew starts evenly up to 0.5
m/s, did not move them back by what they gain, and began as the 1x policy of that time: no setting does either now."""

ACTOR, CRITIC = "ppo.actor_learning_rate", "ppo.critic_learning_rate"
PAPER = {
    "ppo": "paper",
    "evaluate_every": "10",
    "walk.symmetric": "false",
    "walk.reward": "plain",
    "walk.min_reward": "0.6",
    "walk.max_position_error_m": "null",
    "walk.start_velocity_mps": "0",
    ACTOR: "1e-3",
    CRITIC: "1e-2",
}
DEFAULT = Variant("1x", {}, tuple(range(10)))
SEEDS = {"0x": (0,), "2x": (0, 1), "3x": (0, 1), "4x": (0, 1)}
OTHER_SPEEDS = tuple(Variant(speed, {"speed": speed}, seeds) for speed, seeds in SEEDS.items())
ROBUST = FORMER | {"walk": "robust", "walk.symmetric": "true", "ppo.final_action_std": "0.05"}
GENTLER = {
    "walk.scenario.push_n": "250",
    "walk.scenario.push_backward": "0.7",
    "ppo.action_std": "0.05",
    "ppo.iterations": "750",
}
ROBUST_FIRST = Variant("1x-robust-first", ROBUST | {"init": "1x", "ppo.iterations": "600"})

EARLY = {
    "ppo.iterations": "320",
    "evaluate_every": "10",
    "ppo.actor_schedule": "constant",
    "ppo.critic_schedule": "constant",
    "ppo.final_action_std": "0.11",
}
"""The beginning of a run: its noise, and steps of the size that the default holds for a third of a run."""


def changed(name: str, settings: Mapping[str, str]) -> Variant:
    """The beginning of a run with something else than the default."""
    return Variant(f"early-{name}", {**EARLY, **settings})


LATER = {"init": None, "ppo.network": "mlp", "ppo.privileged_critic": False, "ppo.final_action_std": None}
LATER |= {
    "walk.symmetric": False,
    "walk.max_position_error_m": None,
    "walk.kd_scale": 1.0,
    "walk.start_velocity_mps": 0,
    "walk.start_offset_m": 0,
}
# What means nothing to robots of one speed, as all of those runs have.
LATER |= {"walk.command_s": WalkConfig().command_s}
LATER |= {"contacts": "full", "command": "speed", "walk.observation": "full", "walk.leash_m": None}
LATER |= {"walk.dynamics": "none", "walk.electronics": False, "walk.orientation_scale": 1.0}
LATER |= {f"walk.scenario.{name}": value for name, value in vars(ScenarioConfig()).items()}
"""How runs were trained whose configuration does not name these yet."""

STUDIES = {
    "walking": (DEFAULT,),
    "make_train": (replace(DEFAULT, seeds=(0,)),),
    "learning_speeds": OTHER_SPEEDS,
    "starts": (replace(DEFAULT, seeds=(0, 1, 2)), Variant("1x-exact-starts", {"walk.start_velocity_mps": "0"})),
    # One change of the default at a time.
    "changes": (
        changed("default", {}),
        changed("both-steps", {"walk.symmetric": "false"}),
        changed("exact-starts", {"walk.start_velocity_mps": "0"}),
        changed("plain-reward", {"walk.reward": "plain"}),
        changed("1000hz", {"physics_hz": "1000"}),
        changed(
            "long-rollouts",
            {
                "ppo.num_steps": "32",
                "ppo.updates_per_iteration": "40",
                "ppo.iterations": "80",
                "evaluate_every": "3",
            },
        ),
        changed("larger-steps", {ACTOR: "6e-4"}),
        changed("larger-kl", {"ppo.target_kl": "0.1"}),
        changed("more-updates", {"ppo.updates_per_iteration": "20"}),
        changed("fewer-updates", {"ppo.updates_per_iteration": "5"}),
        changed("more-noise", {"ppo.action_std": "0.2", "ppo.final_action_std": "0.16"}),
        changed("lambda-0.9", {"ppo.gae_lambda": "0.9"}),
    ),
    "robust": (
        ROBUST_FIRST,
        Variant("1x-robust", ROBUST | GENTLER | {"init": "{runs}/1x-robust-first-seed{seed}"}),
    ),
    "symmetry": (
        ROBUST_FIRST,
        Variant("1x-robust-first-both-steps", dict(ROBUST_FIRST.settings) | {"walk.symmetric": "false"}),
    ),
    # What the paper prints, a tenth of its step sizes, and readings that differ from the printed one in a single point.
    "paper": (
        Variant("paper-printed", PAPER),
        Variant("paper-tenth", PAPER | {ACTOR: "1e-4", CRITIC: "1e-3"}),
        Variant("paper-tenth-actor", PAPER | {ACTOR: "1e-4"}, (0,)),
        Variant("paper-tenth-critic", PAPER | {CRITIC: "1e-3"}, (0,)),
        Variant("paper-no-early-end", PAPER | {"walk.min_reward": "null"}, (0,)),
        Variant("paper-normalized-advantage", PAPER | {"ppo.normalize_advantage": "true"}, (0,)),
        Variant("paper-output-scale-1", PAPER | {"ppo.actor_output_scale": "1.0"}, (0,)),
        Variant("paper-std-0.018", PAPER | {"ppo.action_std": "0.018"}, (0,)),
    ),
}
"""What can be studied."""


def expected(variant: Variant, seed: int, runs: Path) -> dict[str, Any]:
    """The configuration of a variant's run in the folder `runs`, flat, as its config.json has it."""
    settings = variant.of(seed, runs)
    presets = {key: known[settings.pop(key, preset)] for key, (preset, known) in PRESETS.items()}
    default = comparable(asdict(TrainConfig(**presets)))
    chosen = {key: OmegaConf.select(OmegaConf.from_dotlist([f"{key}={value}"]), key) for key, value in settings.items()}
    return json.loads(json.dumps(default | chosen))


def deviations(config: dict[str, Any], variant: Variant, seed: int, runs: Path) -> list[str]:
    """What a recorded configuration has otherwise than a variant's run in the folder `runs`, as key=value."""
    found = LATER | present_names(config)
    wanted = expected(variant, seed, runs)
    # How often the return is measured changes nothing that is learned, only how finely the curve is known.
    wanted.pop("evaluate_every")
    return [f"{key}={found.get(key)}" for key, value in wanted.items() if found.get(key) != value]
