"""How time passes: the one loop for engines on the host, and the one for engines that are traced.

Both hold an agent's PD targets from one of its steps to the next, and let a record look on. On MuJoCo C the loop runs
on the host; on MJX many control steps are one compiled call.
"""

import math
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import repeat
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState, Carry, sense
from cassie_mjx.motion.command import Command
from cassie_mjx.physics.types import Physics, PhysicsState, Scenario, check_delay
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.model import steps_per_control

# Records look on at least this often, in physics steps, also between the steps of a slow agent.
SAMPLE_STEPS = 8
# Control steps in one compiled call, about a second: few calls, and yet progress to show and room for the next trials.
COMPILED_CONTROL_STEPS = 31

R = TypeVar("R", bound="Record")


class Record(Protocol):
    """What is kept of a simulation: a pytree, leaves [B], that returns the next of itself."""

    @property
    def finished(self) -> Array:
        """Robots of which nothing more is recorded, [B], bool."""
        ...

    def sample(self: R, state: PhysicsState, target: Array, scenario: Scenario, share: float) -> R:
        """The record `share` of a control step on, in which the targets [B, 10] were held."""
        ...

    def update(self: R, state: PhysicsState, scenario: Scenario) -> R:
        """The record at the end of a control step."""
        ...


class Simulation(NamedTuple):
    """B robots, the scenario of each, and what is recorded of them."""

    robots: AgentState
    scenario: Scenario
    record: Any
    command: Command | None = None
    """Their commands; None for each agent's own."""


class Moment(NamedTuple):
    """Robots as `simulate` shows them."""

    step: int
    """Physics steps since the start."""
    robots: AgentState
    target: Array
    """PD targets held until now, [B, 10], rad."""


def check_agent(agent: Agent, physics: Physics, scenario: Scenario) -> None:
    """Raise ValueError unless the engine can simulate the agent in the scenario; for the door, before any tracing."""
    check_delay(scenario, physics.max_delay)
    act_steps(agent, physics)


def act_steps(agent: Agent, physics: Physics) -> int:
    """Physics steps from one step of the agent to the next.

    Raises:
      ValueError: the agent's period does not divide the control step into whole physics steps.
    """
    hertz = 1 / physics.model.opt.timestep
    steps = round(agent.period_s * hertz)
    if steps < 1 or steps_per_control(hertz) % steps:
        raise ValueError(f"{agent.name} acts every {agent.period_s:g} s, which does not divide 0.032 s.")
    return steps


def decide(
    agent: Agent, physics: Physics, robots: AgentState, scenario: Scenario, command: Command | None
) -> tuple[Array, Carry]:
    """PD targets [B, 10], rad, of robots that sense their state as old as the scenario has it, and the next carry."""
    sensed = sense(agent, physics, robots.physics, scenario)
    target, carry = agent.step(robots.carry, sensed, command)
    # What a robot with NaN in its state wants does not matter any more.
    xp = namespace(sensed.qpos)
    return xp.nan_to_num(xp.asarray(target, dtype=sensed.qpos.dtype)), carry


def simulate(
    agent: Agent,
    physics: Physics,
    robots: AgentState,
    scenario: Scenario,
    stops: Iterable[int],
    commands: Iterable[Command | None] = repeat(None),
) -> Iterator[Moment]:
    """The loop through time on the host: robots at each of the stops.

    Args:
      agent: what walks.
      physics: the engine.
      robots: at the start, B of them.
      scenario: of each.
      stops: physics steps since the start, rising, at which to look; 0 is the start itself.
      commands: of the robots at each step of the agent, one after another.
    """
    now, steps, told = 0, act_steps(agent, physics), iter(commands)
    target: Array = np.zeros((len(robots.physics.qpos), physics.model.nu))
    for stop in stops:
        while now < stop:
            if now % steps == 0:
                target, carry = decide(agent, physics, robots, scenario, next(told))
                robots = AgentState(robots.physics, carry)
            until = min(stop, now - now % steps + steps)
            state = physics.advance(robots.physics, target, scenario, until - now)
            robots, now = AgentState(state, robots.carry), until
        yield Moment(now, robots, target)


def advance(agent: Agent, physics: Physics, simulation: Simulation) -> Simulation:
    """Let time pass for all robots: a control step on MuJoCo C; on MJX a compiled call of up to 31."""
    return (_compiled_steps if physics.traceable else _host_step)(agent, physics, simulation)


def run_to_end(agent: Agent, physics: Physics, simulation: Simulation) -> Simulation:
    """Let time pass until all robots are finished."""
    check_agent(agent, physics, simulation.scenario)
    while not np.asarray(simulation.record.finished).all():
        simulation = advance(agent, physics, simulation)
    return simulation


def _rhythm(agent: Agent, physics: Physics) -> tuple[int, int, int]:
    """Physics steps from one look of the record to the next, looks in a step of the agent, and its steps in 32 ms."""
    steps = act_steps(agent, physics)
    chunk = math.gcd(steps, SAMPLE_STEPS)
    return chunk, steps // chunk, steps_per_control(1 / physics.model.opt.timestep) // steps


def _host_step(agent: Agent, physics: Physics, simulation: Simulation) -> Simulation:
    """All robots a control step later, also those that are finished: only their record stands still."""
    robots, scenario, record, command = simulation
    chunk, looks, acts = _rhythm(agent, physics)
    stops = range(chunk, chunk * looks * acts + 1, chunk)
    for moment in simulate(agent, physics, robots, scenario, stops, repeat(command)):
        robots = moment.robots
        record = record.sample(robots.physics, moment.target, scenario, 1 / (looks * acts))
    return Simulation(robots, scenario, record.update(robots.physics, scenario), command)


@partial(jax.jit, static_argnums=(0, 1))
def _compiled_steps(agent: Agent, physics: Physics, simulation: Simulation) -> Simulation:
    """The loop through time that is traced: control steps, in each the agent's steps, in each the record's looks."""
    scenario, command = simulation.scenario, simulation.command
    chunk, looks, acts = _rhythm(agent, physics)

    def act(_: int, carry: tuple[AgentState, Any]) -> tuple[AgentState, Any]:
        robots, record = carry
        target, next_carry = decide(agent, physics, robots, scenario, command)

        def look(_: int, carry: tuple[PhysicsState, Any]) -> tuple[PhysicsState, Any]:
            state = physics.advance(carry[0], target, scenario, chunk)
            return state, carry[1].sample(state, target, scenario, 1 / (looks * acts))

        state, record = jax.lax.fori_loop(0, looks, look, (robots.physics, record))
        return AgentState(state, next_carry), record

    def control_step(carry: tuple[Array, Simulation]) -> tuple[Array, Simulation]:
        steps, (robots, _, record, _) = carry
        robots, record = jax.lax.fori_loop(0, acts, act, (robots, record))
        return steps + 1, Simulation(robots, scenario, record.update(robots.physics, scenario), command)

    def going_on(carry: tuple[Array, Simulation]) -> Array:
        steps, simulation = carry
        return (steps < COMPILED_CONTROL_STEPS) & ~simulation.record.finished.all()

    return jax.lax.while_loop(going_on, control_step, (0, simulation))[1]
