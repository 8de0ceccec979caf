"""How well policies keep the commanded speed: `python -m experiments.speeds out=speeds.json plot=speeds.png`.

Each policy walks at its own speed, and one that was trained at any speed at twenty, from 0x to 4x, and after a profile
that commands another speed every 2 s for a minute, to which the reference moves by 0.625x a second either way.
MuJoCo C at 2 kHz. How they learn, `experiments.learning study=learning_speeds` shows.
"""

from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cassie_mjx import cli
from cassie_mjx.agents.make import make_policy_agent
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.types import AgentState, Sensed
from cassie_mjx.configuration.values import Checked, Seed
from cassie_mjx.envs.termination import fallen
from cassie_mjx.evaluation import suites
from cassie_mjx.evaluation.setup import WALK_PHASES, EvalSetup
from cassie_mjx.evaluation.simulate import act_steps, simulate
from cassie_mjx.evaluation.trial import Metric
from cassie_mjx.motion.command import FASTEST, Command
from cassie_mjx.motion.reference import RAMP_PER_S, mean_speed, nearest_sample, sample
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_X
from cassie_mjx.robot.ground import Ground
from cassie_mjx.robot.model import ModelConfig
from experiments import learning, pictures, studies
from experiments.interpolation import STARTS, Ride

VARIANTS = {variant.name: variant for variant in (studies.DEFAULT, *studies.OTHER_SPEEDS)}
"""How the policies of one speed are trained."""
COMMANDS = np.linspace(0, FASTEST, 20)
CHANGE_S, PROFILE_S = 2.0, 60.0


@dataclass(frozen=True)
class SpeedsConfig(Checked):
    """What to measure."""

    policies: tuple[str, ...] = ("0x", "1x", "2x", "3x", "4x")
    """Policies of one speed each."""
    any_speed: str | None = "any"
    """Policy of all speeds; null for none."""
    runs: str = ""
    """Folder of the runs <policy>-seed<seed> of `experiments.learning`, study=learning_speeds and, for 1x, walking:
    their policies are measured under the policy's name and the seed; if empty, those that come with the package are."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds of those runs."""
    profile_seed: Seed = 0
    """What the speeds of the profile are drawn from."""
    out: str = "speeds.json"
    """Result file."""
    plot: str = ""
    """File for a picture; none if empty."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""

    def __post_init__(self) -> None:
        """Raise ValueError if there is nothing to measure."""
        super().__post_init__()
        if not self.policies and not self.any_speed:
            raise ValueError("policies and any_speed are empty; name at least one, such as policies=2x.")
        unknown = [name for name in self.policies if self.runs and name not in VARIANTS]
        if unknown:
            raise ValueError(f"policies={','.join(unknown)}: runs has {', '.join(VARIANTS)}; name some of them.")
        if self.runs and not self.training_seeds:
            raise ValueError("training_seeds is empty; name at least one, such as training_seeds=0.")


def single_speeds(config: SpeedsConfig) -> list[tuple[dict[str, Any], PolicyAgent]]:
    """The policies of one speed each, with what their rows say of them: whose figures they are.

    Raises:
      ValueError: one of them is not there, or its run is unfinished or was trained otherwise than the study trains it.
    """
    if not config.runs:
        return [({"agent": name}, make_policy_agent(name)) for name in config.policies]
    found = []
    for name, seed in product(config.policies, config.training_seeds):
        folder = Path(config.runs) / f"{name}-seed{seed}"
        if not folder.is_dir():
            study = "walking" if name == studies.DEFAULT.name else "learning_speeds"
            command = f"python -m experiments.learning study={study} runs={config.runs}"
            raise ValueError(f"There is no run {folder}; make it with {command}.")
        policy = make_policy_agent(str(folder))
        learning.check(folder, VARIANTS[name], seed)
        found.append(({"agent": name, "seed": seed}, policy))
    return found


def keep(policy: PolicyAgent) -> list[dict[str, Any]]:
    """Figures of ten walks of 10 s at the policy's speed, the reference's own speed among them."""
    commanded = Metric("commanded_mps", float(mean_speed(policy.motion)), "m/s", len(WALK_PHASES))
    return [figure._asdict() for figure in (commanded, *suites.walk(policy, EvalSetup()).metrics)]


def profile(seed: int) -> np.ndarray:
    """Factors on the motion's speed, one a control step: another from 0x to 4x every 2 s for 60 s."""
    factors = np.random.default_rng(seed).uniform(0, FASTEST, round(PROFILE_S / CHANGE_S))
    time = CONTROL_PERIOD_S * np.arange(round(PROFILE_S / CONTROL_PERIOD_S))
    return factors[(time / CHANGE_S).astype(int)]


def follow(policy: PolicyAgent, factors: np.ndarray, starts: int = STARTS) -> Ride:
    """Walk from `starts` phases of the stride, commanded a factor [T] on the motion's speed at every control step."""
    physics = make_physics("native", ModelConfig())
    samples, own_mps = policy.stride_acts, np.float32(mean_speed(policy.motion))
    told = own_mps * approached(factors)
    time = (nearest_sample(np.arange(starts) / starts, samples) % samples).astype(np.int32)
    qpos, qvel = sample(policy.motion, time, Command.ahead(np.full(starts, told[0], np.float32)))
    state = physics.init(np.asarray(qpos, float), np.asarray(qvel, float))
    robots = AgentState(state, policy.init(Sensed(state.qpos, state.qvel), time))
    scenario = Scenario.nominal(starts, kd_scale=np.asarray(policy.kd_scale))
    steps = act_steps(policy, physics)
    commands = (Command.ahead(np.full(starts, speed, np.float32)) for speed in told)
    stops = range(0, steps * len(told) + 1, steps)
    walk = simulate(policy, physics, robots, scenario, stops, commands)
    qpos = np.array([moment.robots.physics.qpos for moment in walk])
    fell = fallen(qpos, Ground.flat(starts)).any(axis=0)
    commanded_x = np.append(0, np.cumsum(told * CONTROL_PERIOD_S))
    return Ride.of(commanded_x.tolist(), list(qpos[..., PELVIS_X]), fell, samples)


def approached(factors: np.ndarray) -> np.ndarray:
    """Factors [T] that follow those commanded by 0.625 a second at most, from the first one on."""
    step, now, reached = RAMP_PER_S * CONTROL_PERIOD_S, factors[0], []
    for factor in factors:
        now += np.clip(factor - now, -step, step)
        reached.append(now)
    return np.array(reached, np.float32)


def draw(rows: list[dict[str, Any]], walk: Ride | None) -> Figure:
    """Tracked against commanded speed, and the profile with what became of it."""
    widths = (1,) if walk is None else (1, 2)
    figure = Figure(figsize=(3.7 * sum(widths), 3.8), layout="constrained")
    left, *rest = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    told, kept = ([row["value"] for row in rows if row["quantity"] == name] for name in ("commanded_mps", "speed_mps"))
    left.plot(told, kept, "o", ms=4)
    left.axline((0, 0), slope=1, color="black", lw=0.8, ls="--")
    left.set(xlabel="commanded, m/s", ylabel="mean over the last 5 s of 10, m/s", title="steady walking")
    if walk is not None:
        (right,) = rest
        right.plot(walk.time_s, walk.up_mps.T, color="tab:blue", lw=0.6, alpha=0.6)
        right.plot(walk.time_s, walk.commanded_mps, color="black", lw=1.2, ls="--")
        right.set(xlabel="s", ylabel="speed over a stride, m/s", title=f"{len(walk.up_mps)} of {len(walk.fell)} up")
    return figure


def main(config: SpeedsConfig) -> None:
    """Walk, write the result and draw it."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    plot = pictures.check(config.plot, config.overwrite, out) if config.plot else None
    console, rows, walk = cli.console(), [], None
    agents = single_speeds(config)
    origins = {policy.name: policy.provenance for _, policy in agents}
    if config.any_speed:
        free = make_policy_agent(config.any_speed)
        told = [make_policy_agent(config.any_speed, f"{factor:.3g}x") for factor in COMMANDS]
        agents += [({"agent": policy.name}, policy) for policy in told]
        origins[free.name] = free.provenance
        walk = follow(free, profile(config.profile_seed))
        rows += walk.rows(f"{config.any_speed} profile")
    for whose, agent in agents:
        figures = keep(agent)
        rows += [whose | figure for figure in figures]
        console.print(*whose.values(), {figure["quantity"]: round(figure["value"], 3) for figure in figures})
    provenance = cli.provenance(**asdict(config), agent=origins)
    result = {"rows": rows, "provenance": provenance}
    cli.write_result(out, result | ({"profile": walk.curve()} if walk else {}))
    if plot:
        pictures.save_figure(config.plot, plot, draw(rows, walk))


if __name__ == "__main__":
    cli.run(main, SpeedsConfig)
