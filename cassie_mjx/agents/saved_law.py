"""What a saved policy observes and what its actions mean; NumPy alone."""

import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_arrays import Mirror
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.observation import OBSERVATIONS, Seen
from cassie_mjx.robot import cassie


def control_law(saved: NumpyPolicy) -> ControlLaw:
    """What a saved policy observes, and what its actions mean.

    Raises:
      ValueError: its observation is none of this version's, or its mirror is not this version's.
    """
    lines = list(saved.observation)
    observation = next((known for known in OBSERVATIONS.values() if known.describe() == lines), None)
    if observation is None:
        new = [line for line in lines if line not in OBSERVATIONS["full"].describe()]
        raise ValueError(
            f"The policy observes {'; '.join(new) or len(lines)}, which this version's observation has not; use the "
            "version it was trained with, named in its provenance."
        )
    law = ControlLaw(observation, saved.mirror is not None)
    if saved.mirror and not all(map(np.array_equal, saved.mirror, file_mirror(law))):
        raise ValueError(
            "The policy's mirror is not this version's; use the version it was trained with, named in its provenance."
        )
    return law


def file_mirror(law: ControlLaw) -> Mirror:
    """The mirror of a law's observations and actions, as a policy file has it."""
    permutation, sign = law.observation.mirror
    # The reference's hip pitch angles are where an observation of these numbers, and of nothing else, has them.
    probe = np.zeros((1, cassie.NQ))
    probe[:, cassie.HIP_PITCH_QPOS] = 1, 2
    nothing, still = np.zeros_like(probe), np.zeros((1, cassie.NV))
    seen = Seen(nothing, still, probe, still)
    observation, _ = law.observation.update(law.init(seen), seen)
    sides = np.array([1 + np.flatnonzero(observation[0] == value)[0] for value in (1, 2)])
    return Mirror(sign * (1 + permutation), cassie.mirror_active(1 + np.arange(cassie.NU)), sides)
