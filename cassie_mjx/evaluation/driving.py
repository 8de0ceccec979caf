"""The suite `command`: how a policy follows commands, and where it gets to under them.

Every drive begins in steady walking straight ahead, and from there on commands change at the pace of training. A policy
that was trained at one speed is measured all the same: its figures say how far the bent reference alone takes it.
Velocities are those in the heading frame of the pelvis (`evaluation.track`). Errors and times are of the robots that
stay up; without any there is no such figure.
"""

import numpy as np

from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.steered import Pilot, Scheduled, SteeredAgent
from cassie_mjx.agents.types import Agent
from cassie_mjx.envs.command import steered
from cassie_mjx.evaluation import eight
from cassie_mjx.evaluation.eight import Pursuit
from cassie_mjx.evaluation.record import SPEED_WINDOW_S
from cassie_mjx.evaluation.setup import LIMIT_PHASES, LONG_WALK_S, WALK_S, EvalSetup, SuiteResult
from cassie_mjx.evaluation.standing import STAND_S, PoseRecord, standing_result
from cassie_mjx.evaluation.track import Track, TrackRecord, drive, over_strides, velocities
from cassie_mjx.evaluation.trial import Metric, NeverSteady, moved, take
from cassie_mjx.motion.command import FULL_STEERING_MPS, JOYSTICK, JOYSTICK_MPS
from cassie_mjx.motion.reference import mean_speed
from cassie_mjx.motion.schedule import CommandSchedule, constant
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S, PELVIS_POSITION

GRID_PHASES = (np.arange(4) + 0.5) / 4
COMPONENTS = {"forward_mps": "m/s", "lateral_mps": "m/s", "yaw_radps": "rad/s"}
RANDOM_ROBOTS, RANDOM_EVERY_S = 100, 2.0
TURN_S, STOP_S, SPRINT_S = 15.0, 15.0, 15.0
"""Durations of the drives, s."""
STOP_FROM_MPS, CLOSE_MPS, STAY_S = 2.0, 0.1, 2.0
EIGHT_S = 1.25 * eight.LENGTH_M / eight.SPEED_MPS
"""Time for the figure of eight, s: a quarter more than it takes at 0.7 m/s."""
EIGHT_SHOWN_STEPS = 8
"""Control steps from one place of the path driven, as results have it, to the next."""


def command(agent: Agent, setup: EvalSetup) -> SuiteResult:
    """Commands of a grid, random ones, a turn on the spot, a figure of eight, a stop, a sprint, and standing.

    Raises:
      ValueError: it is no single policy, or it steps on the spot.
    """
    if not isinstance(agent, PolicyAgent):
        raise ValueError(f"suite=command commands a single policy, which {agent.name} is not.")
    parts = (grid, random_commands, turn, figure_eight, stop, sprint, stand)
    results = [part(agent, setup) for part in parts]
    cells = {name: value for result in results for name, value in (result.cells or {}).items()}
    return SuiteResult([metric for result in results for metric in result.metrics], cells)


def command_grid() -> np.ndarray:
    """Forward velocities of -1x to 4x, lateral ones and yaw rates, [118, 3], m/s, rad/s.

    From 2.1 m/s on, neither of the latter is at its largest.
    """
    axes = [-0.7, 0.0, 0.7, 1.4, 2.1, 2.8], [-0.4, -0.2, 0.0, 0.2, 0.4], [-0.8, -0.4, 0.0, 0.4, 0.8]
    commands = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    full = (np.abs(commands[:, 1:]) == JOYSTICK).any(axis=1)
    return commands[~(full & (commands[:, 0] >= FULL_STEERING_MPS))]


def grid(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """10 s under each command of the grid from four phases."""
    commands, phases = command_grid(), len(GRID_PHASES)
    pilot = Scheduled.begin(constant(*np.repeat(commands, phases, axis=0)))
    starts = np.tile(GRID_PHASES, len(commands))
    track = _drive(agent, setup, float(mean_speed(agent.motion)), starts, pilot, WALK_S)
    return grid_result(commands, track.fell.reshape(-1, phases), mean_velocity(track).reshape(-1, phases, 3))


def mean_velocity(track: TrackRecord) -> np.ndarray:
    """Mean over the last 5 s, [B, 3], m/s and rad/s."""
    return velocities(track.places)[:, -round(SPEED_WINDOW_S / CONTROL_PERIOD_S) :].mean(axis=1)


def grid_result(commands: np.ndarray, fell: np.ndarray, velocity: np.ndarray) -> SuiteResult:
    """The share that stayed up, and errors of those: the mean over phases of each command, then over commands.

    Args:
      commands: [C, 3], m/s and rad/s.
      fell: whether robots fell, [C, P].
      velocity: their mean velocity, [C, P, 3].
    """
    off = np.where(fell[..., None], 0.0, np.abs(velocity - commands[:, None]))
    up = (~fell).sum(axis=1)
    told, errors = commands[up > 0], off.sum(axis=1)[up > 0] / up[up > 0, None]
    metrics, largest = [Metric("command_survived", float((~fell).mean()), "1", fell.size)], {}
    if len(told):
        for (name, unit), error in zip(COMPONENTS.items(), errors.T, strict=True):
            metrics.append(Metric(f"command_error_{name}", float(error.mean()), unit, len(told)))
            largest[name] = {"error": float(error.max()), "command": told[error.argmax()].tolist()}
    found = iter(errors.round(4).tolist())
    cells = {
        "phases": GRID_PHASES.tolist(),
        "commands": commands.tolist(),
        "survived": ["".join(str(int(not down)) for down in row) for row in fell],
        "errors": [next(found) if number else None for number in up],
        "largest": largest,
    }
    return SuiteResult(metrics, cells)


def random_commands(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """The share of 100 robots up for 60 s under a new command of training's range every 2 s."""
    starts = LIMIT_PHASES[np.arange(RANDOM_ROBOTS) % len(LIMIT_PHASES)]
    pilot = Scheduled.begin(random_schedule())
    track = _drive(agent, setup, float(mean_speed(agent.motion)), starts, pilot, LONG_WALK_S)
    return SuiteResult([_share("command_random_survived_60s", ~track.fell)])


def random_schedule() -> CommandSchedule:
    """Of 100 robots; less steering above 2.1 m/s, as in training; drawn with seed 0."""
    times = np.arange(0, LONG_WALK_S, RANDOM_EVERY_S)
    draw, shape = np.random.default_rng(0), (RANDOM_ROBOTS, len(times))
    sides = draw.uniform(-1, 1, (2, *shape))
    return CommandSchedule.of(times, np.stack(steered(draw.uniform(*JOYSTICK_MPS, shape), JOYSTICK, *sides), axis=-1))


def turn(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """A turn to the left by 360 degrees at 0.8 rad/s, from steps on the spot."""
    track = _manoeuvre(agent, setup, 0.0, (0.0, 0.0, JOYSTICK.yaw_rate), TURN_S)
    return SuiteResult(timed("turn", turned_round(track.places), track.fell))


def turned_round(places: np.ndarray) -> np.ndarray:
    """Whether robots have turned by 360 degrees after each control step, [B, S], from `TrackRecord.places`."""
    heading = np.unwrap(places[..., 2], axis=1)
    return heading[:, 1:] - heading[:, :1] >= 2 * np.pi


def stop(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """From 2 m/s until the mean speed over a stride stays below 0.1 m/s, for 2 s at least."""
    track = _manoeuvre(agent, setup, STOP_FROM_MPS, (0.0, 0.0, 0.0), STOP_S)
    below = np.linalg.norm(_by_strides(agent, track)[..., :2], axis=-1) < CLOSE_MPS
    stays = np.flip(np.logical_and.accumulate(np.flip(below, axis=1), axis=1), axis=1)
    return SuiteResult(timed("stop", stays[:, : -round(STAY_S / CONTROL_PERIOD_S)], track.fell))


def sprint(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """From 0 until the mean forward velocity over a stride is within 0.1 m/s of 2.8 m/s."""
    fastest = JOYSTICK_MPS[1]
    track = _manoeuvre(agent, setup, 0.0, (fastest, 0.0, 0.0), SPRINT_S)
    return SuiteResult(timed("sprint", np.abs(_by_strides(agent, track)[..., 0] - fastest) < CLOSE_MPS, track.fell))


def stand(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """From 2 m/s to standing, for 60 s; against steps on the spot."""
    still = (0.0, 0.0, 0.0)
    stood = _manoeuvre(agent, setup, STOP_FROM_MPS, (*still, 1.0), STAND_S, PoseRecord)
    stepped = _manoeuvre(agent, setup, 0.0, still, WALK_S, PoseRecord)
    return standing_result(setup.physics().model, stood, stepped)


def figure_eight(agent: PolicyAgent, setup: EvalSetup) -> SuiteResult:
    """How far robots get off the figure of eight, along which `eight.Pursuit` steers them, and the paths driven."""
    pilot = Pursuit(np.zeros(len(LIMIT_PHASES), np.float32))
    return eight_result(_drive(agent, setup, eight.SPEED_MPS, LIMIT_PHASES, pilot, EIGHT_S))


def eight_result(track: TrackRecord) -> SuiteResult:
    """The largest distance from the figure of the robots that complete it, and their share, from tracks [B]."""
    places, way = track.places[..., :2], np.zeros(len(track.fell))
    for place in np.moveaxis(places, 1, 0):
        way = eight.onwards(place, way)
    completed = ~track.fell & (way >= eight.LENGTH_M)
    metrics = [_share("figure_eight_survived", completed)]
    if completed.any():
        error = eight.distance(places[completed]).max()
        metrics.append(Metric("figure_eight_error_m", float(error), "m", int(completed.sum())))
    shown = {"radius_m": eight.RADIUS_M, "paths": places[:, ::EIGHT_SHOWN_STEPS].round(3).tolist()}
    return SuiteResult(metrics, {"figure_eight": shown})


def timed(name: str, reached: np.ndarray, fell: np.ndarray) -> list[Metric]:
    """The share of robots that stay up and get there, and the longest time that one of them takes.

    Args:
      name: of the drive.
      reached: whether robots are there after each control step, [B, S].
      fell: whether they fell, [B].
    """
    done = ~fell & reached.any(axis=1)
    metrics = [_share(f"{name}_survived", done)]
    if done.any():
        longest = (reached[done].argmax(axis=1).max() + 1) * CONTROL_PERIOD_S
        metrics.append(Metric(f"{name}_s", float(longest), "s", int(done.sum())))
    return metrics


def _share(name: str, done: np.ndarray) -> Metric:
    return Metric(name, float(done.mean()), "1", len(done))


def _by_strides(agent: PolicyAgent, track: TrackRecord) -> np.ndarray:
    return over_strides(velocities(track.places), agent.stride_acts)


def _manoeuvre(
    agent: PolicyAgent,
    setup: EvalSetup,
    forward_mps: float,
    target: tuple[float, ...],
    seconds: float,
    kind: type[Track] = TrackRecord,
) -> Track:
    """Robots from eight phases that are told one command."""
    pilot = Scheduled.begin(constant(*[target] * len(LIMIT_PHASES)))
    return _drive(agent, setup, forward_mps, LIMIT_PHASES, pilot, seconds, kind)


def _drive(
    agent: PolicyAgent,
    setup: EvalSetup,
    forward_mps: float,
    phases: np.ndarray,
    pilot: Pilot,
    seconds: float,
    kind: type[Track] = TrackRecord,
) -> Track:
    """Robots that a pilot steers from the origin on, out of steady walking at a speed, at phases [B] of the stride.

    Those of a policy that falls before it walks steadily have fallen at once.
    """
    driven = SteeredAgent(agent, constant((forward_mps, 0.0, 0.0)), agent.name)
    different, index = np.unique(phases, return_inverse=True)
    try:
        starts = take(setup.starts(driven, different), index)
    except NeverSteady:
        return kind.fallen(len(phases), seconds)
    robots = moved(driven, starts, -starts.physics.qpos[:, PELVIS_POSITION] * np.array([1.0, 1.0, 0.0]))
    robots = robots._replace(carry=robots.carry._replace(pilot=pilot))
    return drive(driven, setup.physics(), robots, seconds, setup.num_envs, setup.progress, kind)
