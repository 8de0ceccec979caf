"""Where a suite is walked, from where, and what it returns: what all suites share."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from cassie_mjx.agents.types import Agent, AgentState
from cassie_mjx.evaluation.scheduler import Progress
from cassie_mjx.evaluation.steady import steady
from cassie_mjx.evaluation.trial import Metric
from cassie_mjx.physics.make import make_physics
from cassie_mjx.physics.types import Physics
from cassie_mjx.robot.model import MJX_TESTING, ModelConfig

WALK_S, LONG_WALK_S = 10.0, 60.0
PHASES = "(k + 1/2)/n"
"""Where trials begin, as results have it; those of before this was written begin at k/n."""
WALK_PHASES = (np.arange(10) + 0.5) / 10
"""Phases of the stride at which walks begin: others than training measures from (`returns.CHOOSING_PHASES`)."""
LIMIT_PHASES = (np.arange(8) + 0.5) / 8
"""Phases at which pushes, and walks over terrain, begin."""


class SuiteResult(NamedTuple):
    """What a suite found out."""

    metrics: list[Metric]
    cells: Mapping[str, Any] | None = None
    """The single verdicts, for a suite whose cells are of interest."""


@dataclass(frozen=True)
class EvalSetup:
    """Where and for how long a suite is walked."""

    engine: str = "native"
    """"native": MuJoCo C; "mjx". Both at 2 kHz with full contacts."""
    long: bool = False
    """Whether what lasts 10 s is done for 60 s as well; those quantities end in _60s."""
    progress: Progress | None = None
    """Told how far it is."""
    electronics: bool = False
    """Whether encoders, filters and motors are the robot's (`robot.electronics`)."""

    def physics(self, scene: str = "flat", longest_delay_s: float = 0.0) -> Physics:
        """The engine, made for delays of up to `longest_delay_s`."""
        config = MJX_TESTING if self.engine == "mjx" else ModelConfig()
        config = replace(config, scene=scene, electronics=self.electronics)
        make = _shared_engine if self.engine == "mjx" else make_physics
        return make(self.engine, config, round(longest_delay_s * config.physics_hz))

    def starts(self, agent: Agent, phases: np.ndarray, longest_delay_s: float = 0.0) -> AgentState:
        """The agent in steady walking at `phases` [B] of its stride, brought there by MuJoCo C."""
        setup = EvalSetup(electronics=self.electronics)
        return steady(agent, setup.physics(longest_delay_s=longest_delay_s), phases)

    @property
    def num_envs(self) -> int:
        """Robots side by side: on an accelerator as many as fit with ease, on a CPU what makes it fast."""
        if self.engine == "native":
            return 64
        return 256 if jax.default_backend() == "cpu" else 8192

    @property
    def durations(self) -> Sequence[tuple[float, str]]:
        """Durations of what lasts, s, and the suffix of their quantities."""
        return ((WALK_S, ""), (LONG_WALK_S, "_60s"))[: 1 + self.long]


@functools.cache
def _shared_engine(engine: str, config: ModelConfig, max_delay: int) -> Physics:
    """One engine for all suites that can share it, so that they share what is compiled for it."""
    return make_physics(engine, config, max_delay)
