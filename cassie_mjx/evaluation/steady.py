"""Robots in steady walking, which is where trials start."""

from collections.abc import Iterator, Sequence
from itertools import islice

import jax
import numpy as np

from cassie_mjx.evaluation.trial import NeverSteady, Subject, Walker, carried, decide, fallen
from cassie_mjx.physics.types import Disturbance, Physics

WARM_UP_STRIDES = 9


def walked(
    subject: Subject, physics: Physics, walker: Walker, disturbance: Disturbance | None = None
) -> Iterator[Walker]:
    """Robots that walk on without end, as they are before each act; undisturbed by default."""
    disturbance = disturbance or Disturbance.none(len(walker.physics.qpos))
    act_steps = round(subject.period_s / physics.model.opt.timestep)
    while True:
        yield walker
        target, memory = decide(subject, physics, walker, disturbance)
        walker = Walker(physics.advance(walker.physics, target, disturbance, act_steps), memory)


def side_by_side(subject: Subject, walkers: Sequence[Walker]) -> Walker:
    """The robots of all `walkers` in one batch, the first walker's first, each carried back to x = 0."""
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *walkers)
    return carried(subject, together, -together.physics.qpos[:, :3] * np.array([1.0, 0.0, 0.0]))


def copied_along(subject: Subject, physics: Physics, walker: Walker, calls: np.ndarray) -> Walker:
    """One robot walks on, and a copy of it is taken before each of the acts `calls` [B], counted from 0, back at x = 0.

    Raises:
      NeverSteady: it falls before it walks steadily.
    """
    walk = enumerate(islice(walked(subject, physics, walker), calls.max() + 1))
    taken = {call: walker for call, walker in walk if call in calls}
    walkers = side_by_side(subject, [taken[call] for call in calls.tolist()])
    if fallen(walkers.physics.qpos, np.zeros(len(calls))).any():
        raise NeverSteady(f"{subject.name} falls before it walks steadily, so there is nothing to measure.")
    return walkers
