"""What tests need of the 80-D observation."""

import numpy as np

from cassie_mjx.control.law import canonicalize, decanonicalize, second_step
from cassie_mjx.control.observation import OBSERVATIONS, Seen

FULL = OBSERVATIONS["full"]


def observe(qpos, qvel, reference_qpos, reference_qvel):
    """Observations [B, 80]."""
    seen = Seen(qpos, qvel, reference_qpos, reference_qvel)
    return FULL.update(FULL.init(seen), seen)[0]


def canonical(observation, reference_qpos):
    """Observations as a symmetric policy gets them."""
    return canonicalize(FULL, observation, second_step(reference_qpos))


def in_both_steps(act, reference_qpos):
    """The policy of both steps that does in the second, as in a mirror, what `act` does in the first."""
    return lambda observation: np.asarray(
        decanonicalize(act(canonical(observation, reference_qpos)), second_step(reference_qpos))
    )
