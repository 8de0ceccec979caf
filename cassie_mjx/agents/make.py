"""The agent of a name: a policy, a blend, the heuristic controller."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from cassie_mjx.agents.blend import BLEND_PREFIX, BlendAgent
from cassie_mjx.agents.blending import SCHEDULES
from cassie_mjx.agents.heuristic import CONTROLLER_PREFIX, HeuristicAgent
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import PolicyAgent, saved_agent
from cassie_mjx.agents.shipped import policy_path, shipped_policies
from cassie_mjx.agents.types import Agent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.heuristic.config import CONTROLLERS


@dataclass(frozen=True)
class AgentConfig(Checked):
    """What walks: the first keys of a command that has one agent."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"schedule": tuple(SCHEDULES)}

    policy: str = "1x"
    """What walks: a policy that we ship, a policy's .npz file, a run's directory (its best policy), "controller:stiff",
    "controller:compliant", or "blend:" and two or more policies with commas between."""
    speed: str | None = None
    """Commanded speed of a policy, such as "2.5x"; null for its own, 1x if it was trained at any."""
    schedule: str | None = None
    """How a blend changes: "ramp", to its last policy and back in time, or "adaptive", against the loss of speed."""

    def agent(self) -> Agent:
        """The agent of these names; see `make_agent`."""
        return make_agent(self.policy, self.speed, self.schedule)


def make_agent(name: str, speed: str | None = None, schedule: str | None = None) -> Agent:
    """The agent of that name: a policy, a blend of policies, or a controller.

    Args:
      name: a policy that we ship, its .npz file or a training run's directory; "blend:POLICY,POLICY,...", two or
        more; "controller:NAME".
      speed: commanded, such as "2.5x"; None for the one it was trained at, 1x if at any.
      schedule: how a blend goes from its first policy to its last, one of `SCHEDULES`.

    Raises:
      ValueError: there is no such agent, or two; it takes no such speed or schedule; or its file is damaged.
    """
    if name.startswith(BLEND_PREFIX) != (schedule is not None):
        known = " or ".join(SCHEDULES)
        raise ValueError(f"policy={name} with schedule={schedule}: a blend, and nothing else, takes schedule={known}.")
    if speed is not None and name.startswith((BLEND_PREFIX, CONTROLLER_PREFIX)):
        raise ValueError(f"policy={name} with speed={speed}: a single policy takes a speed, and nothing else does.")
    if schedule is not None:
        return BlendAgent([make_policy_agent(part) for part in name.removeprefix(BLEND_PREFIX).split(",")], schedule)
    preset = name.removeprefix(CONTROLLER_PREFIX)
    if name.startswith(CONTROLLER_PREFIX) and preset in CONTROLLERS:
        return HeuristicAgent(preset)
    return make_policy_agent(name, speed)


def make_policy_agent(name: str, speed: str | None = None) -> PolicyAgent:
    """The policy of that name at the command `speed`; see `make_agent`."""
    path = policy_path(name)
    if path is None:
        known = ", ".join([*shipped_policies(), *(CONTROLLER_PREFIX + preset for preset in CONTROLLERS)])
        raise ValueError(f"policy={name} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    return saved_agent(name, NumpyPolicy.load(path), speed)
