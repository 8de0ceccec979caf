"""The configuration of a training run."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import jax

from cassie_mjx import cli
from cassie_mjx.cli.keys import present_name
from cassie_mjx.cli.reading import BOOLEANS
from cassie_mjx.configuration.values import Checked, Range, Seed, label
from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.motion.command import COMMANDS, speed_factors
from cassie_mjx.physics.make import ENGINES
from cassie_mjx.ppo import learner
from cassie_mjx.ppo.config import PPO_PRESETS, PPOConfig
from cassie_mjx.robot.drawing import choose_backend
from cassie_mjx.robot.model import CONTACTS, PhysicsHz, steps_per_control
from cassie_mjx.training import devices
from cassie_mjx.training.memory import check_memory
from cassie_mjx.training.trackers import TRACKERS, check_installed

PRESETS = {"walk": ("undisturbed", WALK_PRESETS), "ppo": ("parallel", PPO_PRESETS)}
"""Presets that a command line can choose from, and which is the default."""


RENAMED = {
    "walk.disturbance.": "walk.scenario.",
    "walk.early_end_reward": "walk.min_reward",
    "walk.x_limit_m": "walk.max_position_error_m",
    "walk.damping": "walk.kd_scale",
}
"""Old to new names of keys; an old one that ends in a dot stands for all keys that begin with it."""


def present_names(config: dict[str, Any]) -> dict[str, Any]:
    """A flat configuration of an earlier version under the present names of its keys."""
    return {present_name(key, RENAMED): value for key, value in config.items()}


def flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested configuration by dotted names."""
    values = {}
    for name, value in config.items():
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return values


LOGS = ("jsonl", "tensorboard", *TRACKERS)
"""Where numbers can go."""


@dataclass(frozen=True)
class TrainConfig(Checked):
    """A training run."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {
        "command": COMMANDS,
        "physics": ("auto", *ENGINES),
        "contacts": CONTACTS,
        "log": LOGS,
    }

    speed: str = "1x"
    """Factor on the pelvis x of the reference motion, from "0x" to "4x"; "any" commands one after another."""
    command: str = "speed"
    """What robots are commanded, one command after another: "speed", what `speed` says, straight ahead; "joystick",
    -0.7 to 2.8 m/s forward, 0.4 m/s to either side and turns of 0.8 rad/s."""
    physics: str = "auto"
    """"native": MuJoCo C on CPU threads; "mjx"; "auto": MJX if there is an accelerator."""
    physics_hz: PhysicsHz | None = None
    """Physics steps a second in training; null for 500 on MuJoCo C and 1000 on MJX."""
    contacts: str = "full"
    """What can touch in training: "walking", the feet and the floor alone; "full", legs, shanks and pelvis too, as in
    every evaluation; "published", the thighs too."""
    seed: Seed = 0
    """What all random numbers of the run come from."""
    reference: str = "walk"
    """Reference motion: a name that we ship, or a file."""
    init: str | None = None
    """Policy to start from: one that we ship, a .npz file, or a run's directory (its best); null for none. Critic,
    optimiser, noise and input statistics start anew."""
    walk: WalkConfig = field(default_factory=WalkConfig)
    """The task."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """The learner: a preset (ppo=paper) and single values (ppo.gamma=0.98). Where physics=auto finds an accelerator, a
    command that names no preset has ppo=massive."""
    evaluate_every: Annotated[int, Range(1, 1_000_000)] | None = None
    """Iterations between measurements of the return, each followed by a checkpoint. null: about 30 checkpoints a run,
    each with a measurement until a policy walks for 300 steps from every start, then each tenth."""
    log: tuple[str, ...] = ("jsonl", "tensorboard")
    """Where the numbers at each checkpoint go besides the terminal: "jsonl", metrics.jsonl; "tensorboard"; "wandb" and
    "mlflow", which are extras of this package."""
    video_every: Annotated[int, Range(0, 1_000_000)] = 0
    """Evaluations from one film of the policy to the next, in films/ of the run's directory and for each tracker; 0 for
    no films."""
    run_dir: str | None = None
    """Directory of the run; null for runs/<speed>-seed<seed>, or runs/joystick-seed<seed>."""
    resume: bool = False
    """Whether to go on with the run that `run_dir` holds, if it holds one."""
    distributed: bool = False
    """Whether this is one of several processes, on one machine or many, that train together."""

    def __post_init__(self) -> None:
        """Raise ValueError for a value out of range."""
        super().__post_init__()
        factor, speeds = speed_factors(self.speed)
        if self.command == "joystick" and (factor, speeds) != (1.0, (1.0, 1.0)):
            raise ValueError(f"command=joystick commands the speed too; leave out speed={self.speed}.")
        for name in ("init", "run_dir"):
            if getattr(self, name) == "":
                raise ValueError(f"{name} is empty; name one, or null.")
        if self.physics_hz is not None:
            steps_per_control(self.physics_hz)

    @property
    def folder(self) -> Path:
        """Directory of the run."""
        name = self.speed if self.command == "speed" else self.command
        return Path(f"runs/{name}-seed{self.seed}" if self.run_dir is None else self.run_dir)

    def apart(self, swept: Mapping[str, str]) -> "TrainConfig":
        """One combination of a sweep, with a directory of its own: its name has what `run_dir` would not tell."""
        told = ("run_dir",) if self.run_dir else ("speed", "command", "seed")
        if name := label({key: value for key, value in swept.items() if key not in told}):
            return replace(self, run_dir=f"{self.folder}-{name}")
        return self


def from_arguments(arguments: Sequence[str]) -> TrainConfig:
    """The configuration that `python -m cassie_mjx.train` makes of these arguments. Raises ValueError as it would."""
    return cli.parse(TrainConfig, arguments, {key: cli.Group(*presets) for key, presets in PRESETS.items()}, RENAMED)


def complete(arguments: Sequence[str]) -> list[str]:
    """The arguments of a training, with `ppo=massive` where an accelerator trains and no preset is named.

    A line on stderr says so.
    """
    given = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    if "ppo" in given or given.get("physics", "auto") != "auto":
        return list(arguments)
    if BOOLEANS.get(given.get("distributed", "").lower()):
        # The processes cannot find each other any more once one has looked for devices.
        devices.join()
    kind = devices.accelerator()
    if kind is None:
        return list(arguments)
    if devices.is_first():
        print(f"{kind} trains: physics=mjx and ppo=massive, unless you name others.", file=sys.stderr)
    return ["ppo=massive", *arguments]


def resolve_config(config: TrainConfig) -> TrainConfig:
    """The configuration with nothing left to choose: engine, rate and directory.

    Raises:
      ValueError: the sizes do not divide among the devices or processes, or the memory is not enough.
    """
    accelerator = devices.accelerator()
    physics = ("mjx" if accelerator else "native") if config.physics == "auto" else config.physics
    learner.check_devices(config.ppo, jax.device_count() if physics == "mjx" else jax.process_count())
    physics_hz = config.physics_hz or ENGINES[physics].training.physics_hz
    check_installed(config.log)
    if config.video_every:
        choose_backend()
    check_memory(config.ppo, config.walk, physics, physics_hz)
    return replace(config, physics=physics, physics_hz=physics_hz, run_dir=str(config.folder))
