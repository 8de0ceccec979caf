"""What another library's learner is told, and how it is measured while it learns: as our own learner is."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.control.law import ControlLaw, LawCarry
from cassie_mjx.control.observation import Seen
from cassie_mjx.control.step import policy_step
from cassie_mjx.envs.config import WalkConfig
from cassie_mjx.evaluation.returns import walk_returns
from cassie_mjx.motion.files import load_motion
from cassie_mjx.physics.make import make_physics
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.model import ModelConfig, PhysicsHz
from cassie_mjx.training.loggers import JsonLines

METRICS = "metrics.jsonl"

Act = Callable[[Any, Array], Array]
"""`act(network, observation [B, 80]) -> action [B, 10]`, deterministic, rad; it is traced, with the network as data."""


@dataclass(frozen=True)
class PeerConfig(Checked):
    """One training of another library's learner on the walking task."""

    seed: Seed = 0
    """What its random numbers come from."""
    robots: Annotated[int, Range(1, 1_000_000)] = 128
    """Robots side by side, for a learner whose authors leave that open."""
    physics_hz: PhysicsHz = 1000
    """Physics steps a second in training."""
    samples: Annotated[int, Range(1, 10**12)] = 1_300_000
    """Control steps to learn from, at least."""
    every: Annotated[int, Range(1, 10**9)] = 40_960
    """Control steps between measurements of the return, as near as whole iterations come to it."""
    run_dir: str = "runs/peer"
    """Directory of the run; its metrics.jsonl has a line a measurement."""


@dataclass(frozen=True)
class _OtherLaw(ControlLaw):
    """The task's law with another library's network."""

    actor: Act | None = None

    def begin(self, network: Any, seen: Seen) -> LawCarry:
        return LawCarry(self.init(seen), np.zeros((len(seen.qpos), 0)))

    def act(self, network: Any, carry: LawCarry, seen: Seen) -> tuple[Array, LawCarry]:
        assert self.actor
        observation, sensing = self.observe(carry.sensing, seen)
        acted = self.actor(network, observation)
        return self.residual(seen.reference_qpos, acted), carry._replace(sensing=sensing)


class Meter:
    """Measures the return of a learner's policies, and counts the time in which it learns."""

    def __init__(self, config: PeerConfig) -> None:
        """Start the clock, and a metrics.jsonl without a line."""
        # Nothing is to be saved when the run is told to end.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        folder = Path(config.run_dir)
        folder.mkdir(parents=True, exist_ok=True)
        self._lines = JsonLines(folder / METRICS, samples=0)
        motion = load_motion("walk")
        # The law of the views that the learner trains on, mirror included.
        self._law = WalkConfig().law(motion)
        names = ("qpos", "qvel", "stride_length")
        self._motion = motion._replace(**{name: jnp.asarray(getattr(motion, name), jnp.float32) for name in names})
        self._physics = make_physics("native", ModelConfig())
        self._steps: dict[Act, Callable[..., Any]] = {}
        self._began, self._apart = time.perf_counter(), 0.0

    def measure(self, samples: int, act: Act, network: Any) -> None:
        """Write what the policy earns after `samples` control steps; the time that takes is not the learner's.

        Args:
          samples: control steps learned from.
          act: from an observation to an action; the same function at every call.
          network: what `act` is given, a pytree.
        """
        began = time.perf_counter()
        law = _OtherLaw(self._law.observation, self._law.symmetric, act)
        step = self._steps.setdefault(act, jax.jit(partial(policy_step, law, self._motion)))
        returns = walk_returns(PolicyAgent("peer", law, self._motion, network, step=step), self._physics)
        train_s = began - self._began - self._apart
        values = {"train/samples": samples, "time/train_s": train_s}
        self._lines.write(values | {f"eval/{name}": value for name, value in returns.items()})
        self._apart += time.perf_counter() - began
