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
from cassie_mjx.agents.steered import SteeredAgent
from cassie_mjx.agents.types import Agent
from cassie_mjx.configuration.values import Checked
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.motion.schedule import parse_schedule


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
    command: str | None = None
    """Commanded forward and lateral velocity, m/s, and yaw rate, rad/s, of a policy, left positive: "0.7,0,0.5", or
    "1.4" straight ahead; "0:1,0,0 5:1,0,0.5" from 0 s and from 5 s on, or a file of such lines. Not with speed."""

    def agent(self) -> Agent:
        """The agent of these names; see `make_agent`."""
        return make_agent(self.policy, self.speed, self.schedule, self.command)


def make_agent(name: str, speed: str | None = None, schedule: str | None = None, command: str | None = None) -> Agent:
    """The agent of that name: a policy, a blend of policies, or a controller.

    Args:
      name: a policy that we ship, its .npz file or a training run's directory; "blend:POLICY,POLICY,...", two or
        more; "controller:NAME".
      speed: commanded, such as "2.5x"; None for the one it was trained at, 1x if at any.
      schedule: how a blend goes from its first policy to its last, one of `SCHEDULES`.
      command: what a policy is commanded, in place of a speed; see `motion.schedule.parse_schedule`.

    Raises:
      ValueError: there is no such agent, or two; it takes no such speed, schedule or command; or its file is damaged.
    """
    if command is not None:
        return _steered(name, speed, schedule, command)
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


def _steered(name: str, speed: str | None, schedule: str | None, command: str) -> SteeredAgent:
    """The policy of that name under a command; see `make_agent`."""
    if speed is not None:
        raise ValueError(f"speed={speed} with command={command}: a command has the speed in it; leave one out.")
    if schedule is not None or name.startswith((BLEND_PREFIX, CONTROLLER_PREFIX)):
        raise ValueError(
            f"policy={name} with command={command}: a single policy takes a command, and nothing else does."
        )
    told = parse_schedule(command)
    return SteeredAgent(make_policy_agent(name), told, f"{name} command={command}")


def make_policy_agent(name: str, speed: str | None = None) -> PolicyAgent:
    """The policy of that name at the command `speed`; see `make_agent`."""
    path = policy_path(name)
    if path is None:
        known = ", ".join([*shipped_policies(), *(CONTROLLER_PREFIX + preset for preset in CONTROLLERS)])
        raise ValueError(f"policy={name} is none of {known}, nor a policy's .npz file, nor a run's directory.")
    return saved_agent(name, NumpyPolicy.load(path), speed)
