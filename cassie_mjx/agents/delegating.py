"""What an agent that walks by another one has from it."""

from collections.abc import Mapping
from typing import Any, Generic, TypeVar

import numpy as np

from cassie_mjx.agents.types import Agent
from cassie_mjx.motion.reference import ReferenceMotion

Inner = TypeVar("Inner", bound=Agent)


class Delegating(Generic[Inner]):
    """The members of `Agent` that an agent has from the one it walks by, unless it sets its own."""

    def __init__(self, name: str, inner: Inner) -> None:
        """Take a name, and the agent that it walks by."""
        self.name, self.inner = name, inner
        self.period_s, self.kd_scale, self.needs_bodies = inner.period_s, inner.kd_scale, inner.needs_bodies
        self.motion: ReferenceMotion | None = inner.motion
        self.provenance: Mapping[str, Any] = inner.provenance

    @property
    def lead(self) -> Agent:
        """See `Agent.lead`."""
        return self.inner.lead

    @property
    def stride_acts(self) -> int:
        """See `Agent.stride_acts`."""
        return self.inner.stride_acts

    def acts_before(self, stride: int) -> int:
        """See `Agent.acts_before`."""
        return self.inner.acts_before(stride)

    def initial_state(self, robots: int) -> tuple[np.ndarray, np.ndarray]:
        """See `Agent.initial_state`."""
        return self.inner.initial_state(robots)
