"""Walks blended: a chain of policies with their references, and a position along it that a schedule moves.

Between two neighbours of the chain, with lambda falling from 1 to 0 (Xie et al. 2018), phase by phase:

    reference = lambda x1 + (1 - lambda) x2,    action = lambda mu1(x, x1) + (1 - lambda) mu2(x, x2)

The position s of a robot counts policies: 0 is the first, 1 the second; at i <= s <= i + 1, lambda = 1 - (s - i)
between policies i and i + 1. Blending distributions as the paper writes it, lambda pi1 + (1 - lambda) pi2, means
drawing at every step which of the two policies acts: a mixture of two Gaussians, under which the PD targets would jump
between two walks 31 times a second. Its mean is the blend of the two means mu1 and mu2. Just as a single policy acts by
its mean when it is tested, a blend acts by that.

Every function takes NumPy and JAX arrays; axis B are robots, each at its own place of the chain.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import numpy as np

from cassie_mjx.control.law import LawCarry, target
from cassie_mjx.motion.reference import RAMP_PER_S, ReferenceMotion, mix_qpos, sample
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array, namespace
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S

HOLD_S = 4.0
"""Time that the ramp stays at either end of the chain, s: between five and six strides."""
FILTER_S = 0.352
"""Time constant of the speed's filter, s: a footstep of the reference, which damps its swing of speed to a sixth."""

KEENNESS = 0.5
"""How much faster, m/s, `adaptive` tells a robot to walk for each m/s that it is too slow."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Progress:
    """What a blended walk carries from step to step.

    Attributes:
      phase: sample of the stride, [B], int32, 0 to N - 1.
      step: control steps since the schedule began, [B], int32.
      speed: velocity of the pelvis along x, `filtered`, [B], m/s.
      laws: of each policy's observation and network.
    """

    phase: Array
    step: Array
    speed: Array
    laws: tuple[LawCarry, ...] = ()


Schedule: TypeAlias = Callable[[Progress, Sequence[float]], Array]
"""Where along the chain robots are, [B], from their progress and the mean speeds of the n references, m/s."""


def check_chain(motions: Sequence[ReferenceMotion]) -> None:
    """Raise ValueError unless these are two or more references of as many samples a stride."""
    if len(motions) < 2:
        raise ValueError(f"A blend takes two or more policies, not {len(motions)}.")
    samples = [motion.qpos.shape[0] for motion in motions]
    if len(set(samples)) > 1:
        raise ValueError(
            f"References of {', '.join(map(str, samples))} samples cannot be blended phase by phase; "
            "take policies trained on strides of the same duration."
        )


def blended_sample(motions: Sequence[ReferenceMotion], position: Array, phase: Array) -> tuple[Array, Array]:
    """The blended reference: (qpos [B, 35], qvel [B, 32]).

    Its pelvis x is that of a walk at the present position all along, so it shifts when the position does; no policy
    observes it. `advance` is what x gains in a step.

    Args:
      motions: the references, n of them, with as many samples a stride.
      position: of the robots along the chain, [B], 0 to n - 1.
      phase: control steps since a stride began, [B], integers; beyond the stride the next one follows.
    """
    states = [sample(motion, phase) for motion in motions]
    (qpos1, qpos2, lam), (qvel1, qvel2, _) = (_neighbours(values, position) for values in zip(*states, strict=True))
    # lambda x1 + (1 - lambda) x2
    return mix_qpos(qpos1, qpos2, lam), lam * qvel1 + (1 - lam) * qvel2


def advance(motions: Sequence[ReferenceMotion], position: Array, phase: Array) -> Array:
    """What the blended reference's pelvis x gains in the control step that ends at `phase` [B], [B], m.

    Summed over time it is a pelvis x without jumps, however the position moves: what a robot's x compares with.
    """
    now, before = (blended_sample(motions, position, phase - back)[0][:, cassie.PELVIS_POSITION[0]] for back in (0, 1))
    return now - before


def pd_target(residuals: Sequence[Array], motions: Sequence[ReferenceMotion], position: Array, phase: Array) -> Array:
    """PD targets of the blended walk, to be held for the control step that ends at `phase`, [B, 10], rad.

    Args:
      residuals: of each policy on its own reference, n of [B, 10], rad.
      motions: the reference of each.
      position: of the robots along the chain, [B], 0 to n - 1.
      phase: control steps since a stride began, [B], integers.
    """
    # lambda mu1(x, x1) + (1 - lambda) mu2(x, x2)
    residual1, residual2, lam = _neighbours(residuals, position)
    reference, _ = blended_sample(motions, position, phase)
    return target(reference, lam * residual1 + (1 - lam) * residual2)


def filtered(speed: Array, velocity: Array) -> Array:
    """The filtered speed [B] after a control step that ends at the velocity `velocity` [B], m/s."""
    # v_f(t + dt) = v_f(t) + (1 - exp(-dt / tau)) (v(t + dt) - v_f(t))
    return speed + (1 - math.exp(-CONTROL_PERIOD_S / FILTER_S)) * (velocity - speed)


def ramp(progress: Progress, speeds: Sequence[float]) -> Array:
    """From the first policy to the last at lambda = 1 - 0.625 t, hold, back, hold, and again."""
    xp, last = namespace(progress.step), len(speeds) - 1
    period_s = 2 * (last / RAMP_PER_S + HOLD_S)
    t = CONTROL_PERIOD_S * progress.step % period_s
    # s = r t on the way there and r (T - t_hold - t) on the way back, at most n - 1, at least 0
    return xp.clip(RAMP_PER_S * xp.minimum(t, period_s - HOLD_S - t), 0, last)


def adaptive(progress: Progress, speeds: Sequence[float]) -> Array:
    """Where the mean speed is v_1 + `KEENNESS` (v_1 - v_f), v_1 the first policy's, v_f the robot's; within the chain.

    Robots walk as the first policy does until a slope slows them down: then they are commanded to walk faster. The
    paper prints no rule. Under the opposite one, the policy of the speed that a robot has, nothing brings a lost speed
    back.
    """
    # v = v_1 + k (v_1 - v_f),  lambda = (v_2 - v) / (v_2 - v_1), clipped to 0..1
    told = speeds[0] + KEENNESS * (speeds[0] - progress.speed)
    return namespace(progress.speed).interp(told, np.array(speeds), np.arange(len(speeds), dtype=float))


SCHEDULES: dict[str, Schedule] = {"ramp": ramp, "adaptive": adaptive}
"""How a position follows from time or speed, by name."""


def _neighbours(values: Sequence[Array], position: Array) -> tuple[Array, Array, Array]:
    """Of n values [B, K], those [B, K] of the policies before and after each robot's position, and lambda [B, 1]."""
    xp = namespace(position)
    before = xp.clip(position, 0, len(values) - 2).astype(np.int32)
    stacked, robots = xp.stack(values), np.arange(len(position))
    return stacked[before, robots], stacked[before + 1, robots], (1 - (position - before))[:, None]
