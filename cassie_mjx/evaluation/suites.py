"""The suites: what is asked of every subject, the same on MuJoCo C and on MJX.

Nothing is drawn at random, and every trial starts from steady walking on the flat, up to which MuJoCo C has walked the
subject: so the same trial begins in the same state on both engines.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from cassie_mjx.envs.scenario import PUSH_S
from cassie_mjx.evaluation.scheduler import LimitSearch, Watch, conduct, fly
from cassie_mjx.evaluation.trial import AFTER_PUSH_S, EpisodeResult, Measured, NeverSteady, Subject, Trial, Walker
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.model import MJX_TESTING, ModelConfig, load_mjx_model, load_model

ENGINES = ("native", "mjx")

WALK_S, LONG_WALK_S = 10.0, 60.0
WALK_PHASES = np.arange(10) / 10
LIMIT_PHASES = np.arange(8) / 8
PUSH_STEP_N, LARGEST_PUSH_N = 10, 400
DIRECTIONS = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1)}
MAP_DIRECTIONS_DEG = np.arange(16) * 22.5
TERRAIN_STEP_M, HIGHEST_TERRAIN_M = 0.01, 0.4
LONGEST_DELAY_S = 0.02
RETURN_DELAYS_MS = (5, 10)


class Findings(NamedTuple):
    """What a suite found out."""

    figures: list[Measured]
    cells: Mapping[str, Any] | None = None
    """The single verdicts, for a suite whose cells are of interest."""


@dataclass(frozen=True)
class Setting:
    """Where and for how long a suite is walked."""

    engine: str = "native"
    """"native": MuJoCo C; "mjx". Both at 2 kHz with the referee's contacts."""
    long: bool = False
    """Whether what lasts 10 s is done for 60 s as well; those quantities end in _60s."""
    watch: Watch | None = None
    """Told of progress."""

    def physics(self, subject: Subject, scene: str = "flat", longest_delay_s: float = 0.0) -> Physics:
        """The engine, with the subject's PD law."""
        if self.engine == "mjx":
            return _mjx(round(longest_delay_s * MJX_TESTING.physics_hz), subject.damping)
        config = ModelConfig(scene=scene)
        return NativePhysics(load_model(config), round(longest_delay_s * config.physics_hz), damping=subject.damping)

    def starts(self, subject: Subject, phases: np.ndarray, longest_delay_s: float = 0.0) -> Walker:
        """The subject in steady walking at `phases` [B] of its stride."""
        return subject.start(Setting().physics(subject, longest_delay_s=longest_delay_s), phases)

    @property
    def lanes(self) -> int:
        """Robots side by side: on an accelerator as many as fit with ease, on a CPU what makes it fast."""
        if self.engine == "native":
            return 64
        return 256 if jax.default_backend() == "cpu" else 8192

    @property
    def durations(self) -> Sequence[tuple[float, str]]:
        """Durations of what lasts, s, and the suffix of their quantities."""
        return ((WALK_S, ""), (LONG_WALK_S, "_60s"))[: 1 + self.long]


@functools.cache
def _mjx(max_delay: int, damping: float) -> MjxPhysics:
    """One engine for all suites that can share it, so that they share what is compiled for it."""
    return MjxPhysics(load_mjx_model(MJX_TESTING), max_delay, damping)


Suite: TypeAlias = Callable[[Subject, Setting], Findings]


def walk(subject: Subject, setting: Setting) -> Findings:
    """Undisturbed walking on the flat from ten phases of the stride.

    Of a subject that falls before it walks steadily, the returns and a survival of 0 s are all there is.
    """
    physics = setting.physics(subject)
    figures = subject.returns(physics)
    try:
        starts = setting.starts(subject, WALK_PHASES)
    except NeverSteady:
        figures += [Measured("survived_s" + suffix, 0.0, "s", len(WALK_PHASES)) for _, suffix in setting.durations]
        return Findings(figures)
    for seconds, suffix in setting.durations:
        trials = [Trial(start, seconds) for start in range(len(WALK_PHASES))]
        figures += walking_figures(fly(subject, physics, starts, trials, setting.watch), suffix)
    return Findings(figures)


def walking_figures(result: EpisodeResult, suffix: str = "") -> list[Measured]:
    """The shortest survival and the largest drift over the trials, and means of the rest."""
    return [
        Measured(quantity + suffix, float(value), unit, len(result.fell))
        for quantity, value, unit in (
            ("survived_s", result.survived_s.min(), "s"),
            ("speed_mps", result.speed_mps.mean(), "m/s"),
            ("distance_m", result.distance_m.mean(), "m"),
            ("pelvis_height_m", result.height_m.mean(), "m"),
            ("torque_nm", result.torque_nm.mean(), "N·m"),
            ("power_w", result.power_w.mean(), "W"),
            ("drift_m", np.abs(result.drift_m).max(), "m"),
        )
    ]


def push(subject: Subject, setting: Setting) -> Findings:
    """The largest push of 0.2 s in each direction, at the worst of eight phases and in the median; at most 400 N."""
    groups = [(direction, phase) for direction in DIRECTIONS.values() for phase in range(len(LIMIT_PHASES))]

    def trial(group: int, level: int) -> Trial:
        direction, phase = groups[group]
        return pushed(phase, direction, PUSH_STEP_N * (level + 1))

    search = LimitSearch(trial, len(groups), LARGEST_PUSH_N // PUSH_STEP_N)
    starts = setting.starts(subject, LIMIT_PHASES)
    conduct(subject, setting.physics(subject), starts, search, setting.lanes, setting.watch)
    return Findings(push_figures(PUSH_STEP_N * search.limit.reshape(len(DIRECTIONS), -1), list(DIRECTIONS)))


def pushed(phase: int, direction: tuple[float, float], force: float) -> Trial:
    """The trial of a push along the unit vector `direction` (forward, left), N, at one of the starting phases."""
    forward, left = direction
    return Trial(phase, PUSH_S + AFTER_PUSH_S, push=(force * forward, force * left))


def towards(degrees: float) -> tuple[float, float]:
    """Unit vector (forward, left) at an angle from forward to the left; exact along the axes."""
    angle = np.deg2rad(degrees)
    return round(float(np.cos(angle)), 15), round(float(np.sin(angle)), 15)


def push_figures(limits: np.ndarray, names: Sequence[str]) -> list[Measured]:
    """Worst and median phase of the limits [direction, phase], N, of directions with these names."""
    worst = [(f"push_{name}_N", row.min(), len(row)) for name, row in zip(names, limits, strict=True)]
    median = [(f"push_{name}_median_N", np.median(row), len(row)) for name, row in zip(names, limits, strict=True)]
    return [Measured(name, float(value), "N", n) for name, value, n in worst + median]


def push_map(subject: Subject, setting: Setting) -> Findings:
    """Every push of 10 to 400 N in 16 directions at eight phases, none left out."""
    forces = np.arange(PUSH_STEP_N, LARGEST_PUSH_N + 1, PUSH_STEP_N)
    trials = [
        pushed(phase, towards(degrees), force)
        for degrees in MAP_DIRECTIONS_DEG
        for phase in range(len(LIMIT_PHASES))
        for force in forces.tolist()
    ]
    starts = setting.starts(subject, LIMIT_PHASES)
    result = fly(subject, setting.physics(subject), starts, trials, setting.watch, setting.lanes)
    return map_findings(~result.fell.reshape(len(MAP_DIRECTIONS_DEG), len(LIMIT_PHASES), len(forces)), forces)


def map_findings(survived: np.ndarray, forces: np.ndarray) -> Findings:
    """The limits of each direction, the share of its pushes survived, and all verdicts [direction, phase, force]."""
    # The limit is the last force before the first fall.
    limits = np.append(0, forces)[survived.cumprod(axis=2).sum(axis=2)]
    names = [f"{angle:g}deg" for angle in MAP_DIRECTIONS_DEG]
    shares = [
        Measured(f"push_{name}_survived", float(cells.mean()), "1", cells.size)
        for name, cells in zip([*names, "map"], [*survived, survived], strict=True)
    ]
    cells = {
        "directions_deg": MAP_DIRECTIONS_DEG.tolist(),
        "phases": LIMIT_PHASES.tolist(),
        "forces_N": forces.tolist(),
        "survived": [["".join(str(int(cell)) for cell in row) for row in phases] for phases in survived],
    }
    return Findings(push_figures(limits, names) + shares, cells)


def terrain(subject: Subject, setting: Setting) -> Findings:
    """The largest h, at most 0.4 m, of the terrain z = h sin x that is survived from all of eight phases."""
    levels = round(HIGHEST_TERRAIN_M / TERRAIN_STEP_M)
    lasting = _Lasting("terrain_h_m", "m", TERRAIN_STEP_M, levels, lambda level: {"terrain": TERRAIN_STEP_M * level})
    starts = setting.starts(subject, LIMIT_PHASES)
    return Findings(_limits(lasting, subject, setting.physics(subject, "terrain"), starts, setting))


def delay(subject: Subject, setting: Setting) -> Findings:
    """Walking with senses 5 and 10 ms late, and the longest delay, at most 20 ms, survived from all of ten phases."""
    physics = setting.physics(subject, longest_delay_s=LONGEST_DELAY_S)
    starts = setting.starts(subject, WALK_PHASES, LONGEST_DELAY_S)
    step_ms = 1000 * physics.model.opt.timestep
    figures = []
    for late_ms in RETURN_DELAYS_MS:
        steps = round(late_ms / step_ms)
        trials = [Trial(start, WALK_S, delay=steps) for start in range(len(WALK_PHASES))]
        survived_s = fly(subject, physics, starts, trials, setting.watch).survived_s
        late = [*subject.returns(physics, steps), Measured("survived_s", float(survived_s.min()), "s", len(trials))]
        figures += [figure._replace(quantity=f"delay_{late_ms}ms_{figure.quantity}") for figure in late]
    lasting = _Lasting("delay_max_ms", "ms", step_ms, physics.max_delay, lambda level: {"delay": level})
    return Findings(figures + _limits(lasting, subject, physics, starts, setting))


class _Lasting(NamedTuple):
    """A disturbance that lasts as long as the trial, at levels from 1 on."""

    quantity: str
    unit: str
    step: float
    """From level to level, in that unit."""
    levels: int
    disturb: Callable[[int], dict[str, Any]]
    """What a trial at a level has."""


def _limits(lasting: _Lasting, subject: Subject, physics: Physics, starts: Walker, setting: Setting) -> list[Measured]:
    """The largest level survived, with every smaller one, from all starts."""
    figures, levels, groups = [], lasting.levels, len(starts.physics.step)
    for seconds, suffix in setting.durations:

        def trial(start: int, level: int, seconds: float = seconds) -> Trial:
            return Trial(start, seconds, **lasting.disturb(level + 1))

        search = LimitSearch(trial, groups, levels, together=True)
        conduct(subject, physics, starts, search, setting.lanes, setting.watch)
        # Who falls within 10 s falls within 60 s: the longer search goes no further than the shorter one came.
        levels = int(search.limit.min())
        figures.append(Measured(lasting.quantity + suffix, round(lasting.step * levels, 9), lasting.unit, groups))
    return figures


SUITES: dict[str, Suite] = {"walk": walk, "delay": delay, "terrain": terrain, "push": push, "map": push_map}
ALL = ("walk", "delay", "terrain", "push")
"""What suite=all means: the map has every cell that `push` searches, and many more."""
