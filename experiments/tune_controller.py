"""Tune the heuristic walker: `python -m experiments.tune_controller preset=compliant seed=0 out=FILE.json`.

CMA-ES over the preset's continuous parameters. A generation walks side by side in MuJoCo C at 1 kHz, one robot a
candidate; from eight phases of each candidate's own stride, copies are then pushed and sent over terrain. The search
starts away from the shipped preset by `spread`, so that finding parameters as good again says something.
"""

import importlib.metadata
from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import cma
import jax
import numpy as np
from rich.console import Console

from cassie_mjx import cli, controller, robot
from cassie_mjx.controller import CONTROLLERS, ControllerConfig, ControllerState
from cassie_mjx.model import ModelConfig, load, standing
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Disturbance, PhysicsState

PHYSICS_HZ = 1000
WARM_UP_STRIDES = 8
PUSH_S, AFTER_PUSH_S, TERRAIN_S = 0.2, 3.0, 9.0
WORST = 9.0

# Step of the search for each parameter: added to it, or, for gains, the logarithm of the factor on it.
ADDED = {
    "speed": 0.05,
    "width": 0.03,
    "gain_x": 0.15,
    "gain_y": 0.1,
    "clearance": 0.02,
    "press": 0.02,
    "hurry": 0.1,
    "slope": 0.15,
    "swing_feedforward": 0.2,
    "lean": 0.03,
    "height": 0.015,
    "foot_gain": 10.0,
    "foot_limit": 4.0,
    "ramp": 0.01,
    "load": 0.1,
    "hold": 0.2,
    "reaction": 0.2,
}
MULTIPLIED = {"body_p": 0.3, "body_d": 0.3, "swing_p": 0.25, "swing_d": 0.25, "knee_p": 0.3, "knee_d": 0.3}
SMALLEST = {"ramp": 0.002, "load": 0.02, "hold": 0.0, "foot_limit": 0.0, "press": 0.0, "hurry": 1.0}


@dataclass(frozen=True)
class TuneConfig:
    """One search."""

    preset: str = "compliant"
    """"stiff" or "compliant". The compliant one keeps its gains, which are the published ones."""
    generations: int = 20
    """Generations of CMA-ES."""
    population: int = 12
    """Candidates in a generation."""
    spread: float = 0.5
    """Standard deviation of the start around the shipped preset, in steps of the search."""
    seed: int = 0
    """Seed of the start and of CMA-ES."""
    out: str = "controller.json"
    """Result file."""

    def __post_init__(self) -> None:
        """Raise ValueError for a search that cannot be made."""
        if self.preset not in CONTROLLERS:
            raise ValueError(f"preset={self.preset!r} is not known; choose one of {', '.join(CONTROLLERS)}.")
        for name, least in (("generations", 1), ("population", 4), ("spread", 0), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)} is too small; it must be at least {least}.")


class Demand(NamedTuple):
    """What a preset is tuned to survive: about as much as it can, so that candidates differ."""

    forward: tuple[float, float]  # N
    backward: tuple[float, float]
    left: tuple[float, float]
    terrain: float  # m


DEMANDS = {
    "stiff": Demand(forward=(210, 270), backward=(260, 330), left=(100, 150), terrain=0.40),
    "compliant": Demand(forward=(90, 130), backward=(110, 150), left=(60, 90), terrain=0.28),
}
DIRECTIONS = {"forward": (1.0, 0.0, 0.0), "backward": (-1.0, 0.0, 0.0), "left": (0.0, 1.0, 0.0)}
# Left and right are mirror images half a stride apart, so half the phases tell all of a push along the walk.
PUSH_PHASES = {"forward": range(4), "backward": range(4), "left": range(8)}


class Walker(NamedTuple):
    """A batch of robots in the middle of a walk."""

    physics: PhysicsState
    control: ControllerState


class Score(NamedTuple):
    """How a candidate did; survival is the time until a fall as a share of the trial, over all its trials."""

    cost: float
    speed: float  # m/s
    survival: dict[str, float]


_controller_step = jax.jit(controller.step)


def parameters(preset: str) -> list[str]:
    """Names of the parameters searched."""
    return [*ADDED, *(MULTIPLIED if preset == "stiff" else ())]


def candidate(preset: str, x: np.ndarray) -> ControllerConfig:
    """The shipped preset moved by `x` steps of the search, one for each of `parameters`."""
    shipped = CONTROLLERS[preset]
    changed: dict[str, Any] = {}
    for name, steps in zip(parameters(preset), x.tolist(), strict=True):
        old = np.array(getattr(shipped, name))
        new = old + ADDED[name] * steps if name in ADDED else old * np.exp(MULTIPLIED[name] * steps)
        changed[name] = jax.tree.map(float, tuple(new)) if new.ndim else float(max(new, SMALLEST.get(name, -np.inf)))
    return replace(shipped, **changed)


def stack(configs: list[ControllerConfig], copies: int) -> ControllerConfig:
    """One configuration with leaves [len(configs) * copies]: the copies of a candidate side by side."""
    return jax.tree.map(lambda *leaves: np.repeat(np.array(leaves, np.float32), copies), *configs)


def side_by_side(walkers: list[Walker]) -> Walker:
    """The robots of all `walkers` in one batch, robot by robot, at physics step 0 and at x = 0, where terrain is 0."""
    robots = len(walkers) * len(walkers[0].control.phase)
    physics, control = jax.tree.map(
        lambda *leaves: np.stack(leaves, axis=1).reshape(robots, *leaves[0].shape[1:]), *walkers
    )
    x = physics.qpos[:, 0].copy()
    for array in (physics.qpos, control.liftoff_w, control.line_w):
        array[:, 0] -= x
    return Walker(replace(physics, step=np.zeros_like(physics.step)), control)


def advance(
    engine: NativePhysics, config: ControllerConfig, period: float, walker: Walker, push: Disturbance
) -> Walker:
    """One call of the controller and the physics until the next."""
    qpos, qvel, bodies = walker.physics.qpos, walker.physics.qvel, engine.bodies(walker.physics)
    target, control = _controller_step(config, walker.control, qpos, qvel, bodies, period)
    target = np.nan_to_num(np.asarray(target, float))
    return Walker(engine.advance(walker.physics, target, push, round(period * PHYSICS_HZ)), control)


def survival(
    engine: NativePhysics, config: ControllerConfig, period: float, walker: Walker, push: Disturbance, seconds: float
) -> np.ndarray:
    """Share of `seconds` before the fall, for each robot."""
    calls = round(seconds / period)
    up = np.ones(len(push.terrain), bool)
    calls_up = np.zeros(len(up), int)
    for _ in range(calls):
        walker = advance(engine, config, period, walker, push)
        height = walker.physics.qpos[:, 2] - push.terrain * np.sin(walker.physics.qpos[:, 0])
        up &= (height > robot.FALL_LOW_M) & (height < robot.FALL_HIGH_M)
        if not up.any():
            break
        calls_up += up
    return calls_up / calls


class Evaluator:
    """Scores a generation of candidates; keeps the engines from one to the next."""

    def __init__(self, preset: str) -> None:
        self.demand = DEMANDS[preset]
        self.period = CONTROLLERS[preset].period
        self.flat = NativePhysics(load(ModelConfig(physics_hz=PHYSICS_HZ)))
        self.terrain = NativePhysics(load(ModelConfig(physics_hz=PHYSICS_HZ, scene="terrain")))

    def __call__(self, configs: list[ControllerConfig]) -> list[Score]:
        """Walk, push and send over terrain."""
        phases, speed, unrest = self._walk(configs)
        shares = self._push(configs, phases) | {"terrain": self._cross(configs, phases)}
        # Mean and worst trial count. Half a metre in a stride of 0.704 s is 0.71 m/s; 0.03 m/s either way are free.
        falls = sum(1 - share.mean(axis=1) + 0.4 * (1 - share.min(axis=1)) for share in shares.values())
        cost = falls + 2 * (np.abs(speed - 0.71) - 0.03).clip(0) + unrest
        return [
            Score(float(total), float(v), {name: float(share[i].mean()) for name, share in shares.items()})
            for i, (total, v) in enumerate(zip(np.nan_to_num(cost, nan=WORST), speed, strict=True))
        ]

    def _walk(self, configs: list[ControllerConfig]) -> tuple[list[Walker], np.ndarray, np.ndarray]:
        """Start from standing. Returns eight phases of the last stride, its speed, and what the pelvis moved in it."""
        robots, config, none = len(configs), stack(configs, 1), Disturbance.none(len(configs))
        physics = self.flat.init(np.tile(standing(self.flat.model), (robots, 1)), np.zeros((robots, robot.NV)))
        start = controller.init(config, physics.qpos, physics.qvel, self.flat.bodies(physics))
        stride_calls = round(2 * configs[0].step_time / self.period)
        stride = deque([Walker(physics, start)], maxlen=stride_calls + 1)
        for _ in range((WARM_UP_STRIDES + 1) * stride_calls):
            stride.append(advance(self.flat, config, self.period, stride[-1], none))
        qpos = np.array([walker.physics.qpos for walker in stride])
        height, pitch = qpos[..., 2], 2 * (qpos[..., 3] * qpos[..., 5] - qpos[..., 6] * qpos[..., 4])
        unrest = 2 * np.ptp(height, axis=0) + 0.5 * np.ptp(pitch, axis=0) + 0.3 * np.abs(pitch).max(axis=0)
        upright = (height > robot.FALL_LOW_M).all(axis=0) & (height < robot.FALL_HIGH_M).all(axis=0)
        speed = (qpos[-1, :, 0] - qpos[0, :, 0]) / (stride_calls * self.period)
        return list(stride)[: -1 : stride_calls // 8], speed, np.where(upright, unrest, WORST)

    def _push(self, configs: list[ControllerConfig], phases: list[Walker]) -> dict[str, np.ndarray]:
        """Survival of the pushes, [candidate, trial], by direction."""
        trials = [(d, phase, n) for d, used in PUSH_PHASES.items() for phase in used for n in getattr(self.demand, d)]
        force = np.array([newtons * np.array(DIRECTIONS[direction]) for direction, _, newtons in trials])
        robots = len(configs) * len(trials)
        push = replace(
            Disturbance.none(robots),
            push=np.tile(force, (len(configs), 1)),
            push_stop=np.full(robots, round(PUSH_S * PHYSICS_HZ), np.int32),
        )
        walker = side_by_side([phases[phase] for _, phase, _ in trials])
        share = survival(self.flat, stack(configs, len(trials)), self.period, walker, push, PUSH_S + AFTER_PUSH_S)
        share = share.reshape(len(configs), len(trials))
        return {d: share[:, [direction == d for direction, *_ in trials]] for d in DIRECTIONS}

    def _cross(self, configs: list[ControllerConfig], phases: list[Walker]) -> np.ndarray:
        """Survival of the terrain, [candidate, trial]."""
        starts = phases[::2]
        robots = len(configs) * len(starts)
        blind = replace(Disturbance.none(robots), terrain=np.full(robots, self.demand.terrain))
        config, walker = stack(configs, len(starts)), side_by_side(starts)
        return survival(self.terrain, config, self.period, walker, blind, TERRAIN_S).reshape(len(configs), len(starts))


def main(config: TuneConfig) -> None:
    """Search, and write the best candidate with its cost beside those of the start and of the shipped preset."""
    out = cli.check_writable(config.out)
    console = Console(stderr=True)
    evaluate = Evaluator(config.preset)
    names = parameters(config.preset)
    start = np.random.default_rng(config.seed).normal(0.0, config.spread, len(names))
    # CMA-ES takes the seed 0 for "by the clock".
    search = cma.CMAEvolutionStrategy(
        start, 0.5, {"popsize": config.population, "seed": config.seed + 1, "verbose": -9}
    )
    shipped, first = evaluate([candidate(config.preset, x) for x in (np.zeros(len(names)), start)])
    console.print(f"shipped {describe(shipped)}\nstart   {describe(first)}")
    best, best_x = first, start
    for generation in range(config.generations):
        asked = search.ask()
        scores = evaluate([candidate(config.preset, x) for x in asked])
        search.tell(asked, [score.cost for score in scores])
        leader = min(range(len(scores)), key=lambda i: scores[i].cost)
        if scores[leader].cost < best.cost:
            best, best_x = scores[leader], asked[leader]
        console.print(f"{generation + 1}/{config.generations} {describe(scores[leader])}, best cost {best.cost:.3f}")
    content = {
        "preset": config.preset,
        "parameters": asdict(candidate(config.preset, best_x)),
        "scores": {name: score._asdict() for name, score in (("found", best), ("start", first), ("shipped", shipped))},
        "provenance": cli.provenance(**asdict(config), cma=importlib.metadata.version("cma")),
    }
    cli.write_json(out, content)


def describe(score: Score) -> str:
    """One line of progress."""
    shares = ", ".join(f"{name} {share:.2f}" for name, share in score.survival.items())
    return f"cost {score.cost:.3f}: {score.speed:.3f} m/s; survival {shares}"


if __name__ == "__main__":
    cli.run(main, TuneConfig)
