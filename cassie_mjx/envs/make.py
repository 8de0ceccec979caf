"""The walking task, ready to reset and step."""

from dataclasses import replace

from cassie_mjx.envs.command import command_range
from cassie_mjx.envs.config import WALK_PRESETS, WalkConfig
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.command import COMMANDS, speed_factors
from cassie_mjx.motion.files import load_motion
from cassie_mjx.motion.reference import stretch
from cassie_mjx.physics.make import ENGINES, check_engine, make_physics


def make_env(
    speed: str = "1x",
    robots: int = 128,
    physics: str = "native",
    physics_hz: int = 1000,
    config: WalkConfig | str = "undisturbed",
    motion: str = "walk",
    command: str = "speed",
) -> WalkEnv:
    """A batch of robots that imitate a motion: `state = env.reset(key)`, then `state = env.step(state, action, key)`.

    Args:
      speed: factor on the motion's speed, "0x" to "4x", or "any".
      robots: B, side by side.
      physics: "native", MuJoCo C, or "mjx", whose `reset` and `step` may be called under `jax.jit`.
      physics_hz: physics steps a second.
      config: the task, or the name of a preset of it.
      motion: a name that we ship, or a motion's file.
      command: "speed", or "joystick" for commands in all directions on top of speed "1x".

    Raises:
      ValueError: one of these is not known or out of its range.
    """
    config = find_config(config)
    if command not in COMMANDS:
        raise ValueError(f"command={command} is not known; choose one of {', '.join(COMMANDS)}.")
    walked = stretch(load_motion(motion), speed_factors(speed)[0])
    check_engine(physics)
    model = replace(
        ENGINES[physics].training, physics_hz=physics_hz, scene=config.scene, electronics=config.electronics
    )
    engine = make_physics(physics, model, config.delay_steps(physics_hz))
    return WalkEnv(engine, walked, config, robots, *command_range(walked, speed, command))


def find_config(config: WalkConfig | str) -> WalkConfig:
    """The task itself, or the preset of that name. Raises ValueError if there is none."""
    if isinstance(config, WalkConfig):
        return config
    if config not in WALK_PRESETS:
        raise ValueError(f"config={config!r} is not known; choose one of {', '.join(WALK_PRESETS)}.")
    return WALK_PRESETS[config]
