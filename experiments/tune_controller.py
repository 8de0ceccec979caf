"""Tune the heuristic controller: `python -m experiments.tune_controller preset=compliant seed=0 out=FILE.json`.

CMA-ES over the preset's continuous parameters. A generation walks side by side in MuJoCo C at 1 kHz, one robot a
candidate; from eight phases of each candidate's own stride, copies are then pushed and sent over terrain, about as hard
as the shipped preset can bear and harder. With `spread` the search starts away from the shipped preset, so that finding
parameters as good again says something; with spread=0 it starts there, to improve on it.
"""

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Annotated, Any, ClassVar, NamedTuple

import cma
import jax
import numpy as np

from cassie_mjx import cli
from cassie_mjx.agents.heuristic import HeuristicAgent
from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation.pushes import DIRECTIONS
from cassie_mjx.evaluation.scheduler import run_trials
from cassie_mjx.evaluation.steady import begin, side_by_side, walk_on
from cassie_mjx.evaluation.trial import Push, Trial
from cassie_mjx.heuristic.config import CONTROLLERS, ControllerConfig
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.robot.ground import Ground, Terrain
from cassie_mjx.robot.model import ModelConfig, load_model

PHYSICS_HZ = 1000
WARM_UP_STRIDES = 8
# Most falls come sooner; the evaluation waits longer.
AFTER_PUSH_S, TERRAIN_S = 3.0, 6.0
WORST = 9.0

# Step of the search for each parameter: added to it, or, for gains, the logarithm of the factor on it.
ADDED = {
    "speed": 0.05,
    "width": 0.03,
    "gain_x": 0.15,
    "gain_y": 0.1,
    "line_gain": 0.03,
    "reach_x": 0.05,
    "min_width": 0.02,
    "clearance": 0.02,
    "press": 0.02,
    "hurry": 0.1,
    "slope": 0.15,
    "haste": 0.1,
    "haste_free": 0.05,
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
SMALLEST = {
    "line_gain": 0.0,
    "min_width": 0.02,
    "press": 0.0,
    "hurry": 1.0,
    "haste": 0.0,
    "haste_free": 0.15,
    "foot_limit": 0.0,
    "ramp": 0.002,
    "load": 0.02,
    "hold": 0.0,
}


@dataclass(frozen=True)
class TuneConfig(Checked):
    """One search."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"preset": tuple(CONTROLLERS)}

    preset: str = "compliant"
    """"stiff" or "compliant". The compliant one keeps its gains, which are the published ones."""
    generations: Annotated[int, Range(1, 1_000_000)] = 20
    """Generations of CMA-ES."""
    population: Annotated[int, Range(4, 100_000)] = 12
    """Candidates in a generation."""
    spread: Annotated[float, Range(0, 10)] = 0.5
    """Standard deviation of the start around the shipped preset, in steps of the search."""
    seed: Annotated[int, Range(0, 2**32 - 2)] = 0
    """Seed of the start and of CMA-ES."""
    out: str = "controller.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""


class Demand(NamedTuple):
    """What candidates go through: terrain at about the shipped preset's limit, pushes below and above its worst phase.

    Above, so that candidates differ; below, because who survives a push may fall from a smaller one.
    """

    forward: tuple[float, ...]  # N
    backward: tuple[float, ...]
    left: tuple[float, ...]
    terrain: tuple[float, ...]  # m


DEMANDS = {
    "stiff": Demand(forward=(200, 280, 340), backward=(150, 210, 340), left=(120, 180, 240), terrain=(0.4,)),
    "compliant": Demand(forward=(100, 150, 175), backward=(120, 170, 200), left=(50, 70, 100), terrain=(0.3,)),
}
# Eighths of the stride at which a trial starts. Left and right are mirror images half a stride apart, so half of them
# tell all of what comes along the walk, and pushes to the left all of those to the right.
PHASES = {"forward": range(4), "backward": range(4), "left": range(8), "terrain": range(4)}


class Score(NamedTuple):
    """How a candidate did; survival is the time until a fall as a share of the trial, over all its trials."""

    cost: float
    speed: float  # m/s
    survival: dict[str, float]


def parameters(preset: str) -> list[str]:
    """Names of the parameters searched: for `compliant`, whose clock never hurries, neither haste nor gains."""
    return [*ADDED, *MULTIPLIED] if preset == "stiff" else [name for name in ADDED if not name.startswith("haste")]


def candidate(preset: str, x: np.ndarray) -> ControllerConfig:
    """The shipped preset moved by `x` steps of the search, one for each of `parameters`."""
    shipped = CONTROLLERS[preset]
    changed: dict[str, Any] = {}
    for name, steps in zip(parameters(preset), x.tolist(), strict=True):
        old = np.array(getattr(shipped, name))
        new = old + ADDED[name] * steps if name in ADDED else old * np.exp(MULTIPLIED[name] * steps)
        new = np.maximum(new, SMALLEST.get(name, -np.inf)).tolist()
        changed[name] = tuple(new) if old.ndim else new
    return replace(shipped, **changed)


def trials(demand: Demand) -> list[tuple[str, Trial]]:
    """What a candidate goes through, each with its kind; a trial's start is the eighth of the stride."""
    pushes = [
        (kind, Trial(phase, PUSH_S + AFTER_PUSH_S, (Push(force * forward, force * left),)))
        for kind, (forward, left) in DIRECTIONS.items()
        if kind in PHASES
        for phase in PHASES[kind]
        for force in getattr(demand, kind)
    ]
    hills = [Terrain("sine", height) for height in demand.terrain]
    return pushes + [
        ("terrain", Trial(phase, TERRAIN_S, terrain=terrain)) for phase in PHASES["terrain"] for terrain in hills
    ]


class Evaluator:
    """Scores a generation of candidates; keeps the engines from one to the next."""

    def __init__(self, preset: str) -> None:
        self.preset = preset
        self.flat = NativePhysics(load_model(ModelConfig(physics_hz=PHYSICS_HZ)))
        self.terrain = NativePhysics(load_model(ModelConfig(physics_hz=PHYSICS_HZ, scene="terrain")))

    def __call__(self, configs: Sequence[ControllerConfig]) -> list[Score]:
        """Walk, push and send over terrain."""
        stacked = jax.tree.map(lambda *leaves: np.array(leaves, np.float32), *configs)
        agent = HeuristicAgent(self.preset, stacked)
        starts, speed, unrest = self._walk(agent, len(configs))
        shares = self._survive(agent, starts, len(configs))
        # Mean and worst trial count. Half a metre in a stride of 0.704 s is 0.71 m/s; 0.03 m/s either way are free.
        falls = sum(1 - share.mean(axis=1) + 0.4 * (1 - share.min(axis=1)) for share in shares.values())
        cost = falls + 2 * (np.abs(speed - 0.71) - 0.03).clip(0) + unrest
        return [
            Score(float(total), float(v), {kind: float(share[i].mean()) for kind, share in shares.items()})
            for i, (total, v) in enumerate(zip(np.nan_to_num(cost, nan=WORST), speed, strict=True))
        ]

    def _walk(self, agent: HeuristicAgent, robots: int) -> tuple[AgentState, np.ndarray, np.ndarray]:
        """Start from standing. Returns eight phases of a late stride, its speed, and what the pelvis moved in it."""
        first, calls = agent.acts_before(WARM_UP_STRIDES), agent.stride_acts
        walk = walk_on(agent, self.flat, begin(agent, self.flat, *agent.initial_state(robots)))
        stride = list(islice(walk, first, first + calls + 1))
        qpos = np.array([each.physics.qpos for each in stride])
        height, pitch = qpos[..., 2], 2 * (qpos[..., 3] * qpos[..., 5] - qpos[..., 6] * qpos[..., 4])
        unrest = 2 * np.ptp(height, axis=0) + 0.5 * np.ptp(pitch, axis=0) + 0.3 * np.abs(pitch).max(axis=0)
        upright = ~fallen(qpos, Ground.flat(robots)).any(axis=0)
        steady = np.all([on_time(each, agent.period_s) for each in (stride[0], stride[-1])], axis=0)
        speed = (qpos[-1, :, 0] - qpos[0, :, 0]) / (calls * agent.period_s)
        return side_by_side(agent, stride[: -1 : calls // 8]), speed, np.where(upright & steady, unrest, WORST)

    def _survive(self, agent: Agent, starts: AgentState, robots: int) -> dict[str, np.ndarray]:
        """Share of each trial before the fall, [candidate, trial], by kind; `starts` are 8 phases of the candidates."""
        kinds, each = zip(*trials(DEMANDS[self.preset]), strict=True)
        shares = np.empty((robots, len(each)))
        for physics, chosen in (
            (self.flat, [i for i, kind in enumerate(kinds) if kind != "terrain"]),
            (self.terrain, [i for i, kind in enumerate(kinds) if kind == "terrain"]),
        ):
            own = [replace(each[i], start=each[i].start * robots + k) for k in range(robots) for i in chosen]
            survived_s = run_trials(agent, physics, starts, own).survived_s
            shares[:, chosen] = (survived_s / [trial.seconds for trial in own]).reshape(robots, -1)
        return {kind: shares[:, [other == kind for other in kinds]] for kind in PHASES}


def on_time(robots: AgentState, period_s: float) -> np.ndarray:
    """Whether the clock of robots that should be at phase 0 of a stride is there, to within a call, [B].

    A clock that hurries in steady walking is not: its strides are shorter than the reference motion's.
    """
    state, step_time = robots.carry.state, robots.carry.config.step_time
    late = np.where(np.asarray(state.stance) == 1, step_time - state.phase, -np.asarray(state.phase))
    return np.abs(late) < 1.5 * period_s


def main(config: TuneConfig) -> None:
    """Search, and write the best candidate with its cost beside those of the start and of the shipped preset."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    console = cli.console()
    evaluate = Evaluator(config.preset)
    names = parameters(config.preset)
    start = np.random.default_rng(config.seed).normal(0.0, config.spread, len(names))
    # CMA-ES takes the seed 0 for "by the clock".
    search = cma.CMAEvolutionStrategy(
        start, 0.5, {"popsize": config.population, "seed": config.seed + 1, "verbose": -9}
    )
    shipped, first = evaluate([candidate(config.preset, x) for x in (np.zeros(len(names)), start)])
    console.print(f"shipped {describe(shipped)}\nstart   {describe(first)}", soft_wrap=True)
    best, best_x = first, start
    for generation in range(config.generations):
        asked = search.ask()
        scores = evaluate([candidate(config.preset, x) for x in asked])
        search.tell(asked, [score.cost for score in scores])
        leader = min(range(len(scores)), key=lambda i: scores[i].cost)
        if scores[leader].cost < best.cost:
            best, best_x = scores[leader], asked[leader]
        line = f"{generation + 1}/{config.generations} {describe(scores[leader])}, best cost {best.cost:.3f}"
        console.print(line, soft_wrap=True)
    content = {
        "preset": config.preset,
        "parameters": asdict(candidate(config.preset, best_x)),
        "scores": {name: score._asdict() for name, score in (("found", best), ("start", first), ("shipped", shipped))},
        "provenance": cli.provenance(**asdict(config), cma=importlib.metadata.version("cma")),
    }
    cli.write_result(out, content)


def describe(score: Score) -> str:
    """One line of progress."""
    shares = ", ".join(f"{name} {share:.2f}" for name, share in score.survival.items())
    return f"cost {score.cost:.3f}: {score.speed:.3f} m/s; survival {shares}"


if __name__ == "__main__":
    cli.run(main, TuneConfig)
