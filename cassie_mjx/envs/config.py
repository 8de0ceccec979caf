"""The configuration of the walking task, and its presets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.control.observation import OBSERVATIONS
from cassie_mjx.envs import reward
from cassie_mjx.envs.dynamics import RANGES, DynamicsRange
from cassie_mjx.envs.scenario import ScenarioConfig
from cassie_mjx.motion.reference import ReferenceMotion, steps_mirror
from cassie_mjx.robot.cassie import CONTROL_PERIOD_S

CAPTURE_S = 0.32
"""sqrt(h / g) of an inverted pendulum of h = 1 m, s: how far it goes on, per m/s, until it rests over its foot
(the capture point of Pratt et al., Humanoids 2006)."""


@dataclass(frozen=True)
class WalkConfig(Checked):
    """The task's own parameters."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {
        "reward": tuple(reward.SCALES),
        "observation": tuple(OBSERVATIONS),
        "dynamics": ("none", *RANGES),
    }

    reward: str = "weighted"
    """Reward to learn from: "plain" (the paper's) or "weighted" (the later code's); both are always measured."""
    orientation_scale: Annotated[float, Range(0, 1000)] = 1.0
    """Factor on the squared error of the pelvis' orientation, in the reward learned from alone.

    With 1, as the rewards are measured, a robot that looks 0.2 rad off the path's heading loses a thousandth of the
    reward, and at 2.8 m/s it drifts to the side of that heading by 0.6 m/s."""
    min_reward: Annotated[float, Range(0, 0.999)] | None = 0.4
    """A step's reward below which an episode ends, a device of training; null for none."""
    max_position_error_m: Annotated[float, Range(0.001, 1000)] | None = 0.5
    """How far ahead of the reference motion or behind it an episode ends, m, a device of training; null for nowhere.
    Where the command steers robots, to the left and right of it, too.

    Without it robots with a fast command learn to do without the position's share of the reward."""
    leash_m: Annotated[float, Range(0.001, 1000)] | None = None
    """How far behind the reference motion robots can be before it waits for them, and how far ahead, m; null for any.

    A robot that was pushed is paid for walking on, not for making up the way that it lost. Robots that
    `scenario.undisturbed_share` leaves alone have no leash: they learn to keep the speed."""
    episode_steps: Annotated[int, Range(1, 2**30)] = 300
    """Control steps of a full episode; 300 are 9.6 s."""
    start_velocity_mps: Annotated[float, Range(0, 3)] = 1.2
    """How far from the reference's the pelvis' horizontal velocity may be as an episode begins, m/s, in any direction.

    It is drawn for each episode, small ones most often: v = v_max u^2, u uniform from 0 to 1. Robots learn from it to
    come back to their commanded speed, sooner than by losing it themselves, and to bear pushes. One that is too fast by
    v starts v sqrt(h / g) behind the reference, where it would come to rest on it; 0 starts every episode on the
    reference, as in the paper."""
    start_offset_m: Annotated[float, Range(0, 3)] = 0.0
    """How far to the left or right of the reference's line an episode may begin, m. It is drawn for each episode."""
    command_s: Annotated[float, Range(CONTROL_PERIOD_S, 3600)] | None = 4.0
    """Mean time from one command to the next, s, where there is a range of them, four times that after one to stand;
    null for one an episode."""
    kd_scale: Annotated[float, Range(0, 1)] = 1.0
    """Factor on the published D gains of the PD law; with less, robots bear to sense and act later."""
    observation: str = "full"
    """What the policy observes: "full", the 80-D state of the paper; "estimated", the same with noise; "sensors", what
    IMU and encoders tell, with noise, and leg odometry from it: neither place nor velocity of the pelvis; or
    "sensors_history", the same of the last four steps."""
    symmetric: bool | None = None
    """Whether the policy learns one of the stride's two steps and sees and acts in the other as in a mirror; null: if
    the second step of the reference motion is the mirror image of its first."""
    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    """What robots are put through besides walking."""
    dynamics: str = "none"
    """How far robots differ from the model in mass, friction, damping, springs, motors, gains and encoders, and the
    ground from level: "none", "moderate" or "wide". Each episode draws all of it anew."""
    electronics: bool = False
    """Whether robots sense what Cassie's encoders and filters show, and their torques are limited by the motors' speed
    and 3 ms late (4 ms at 500 Hz), or as late as `dynamics` has it. Below 2 kHz the filters see straight lines from
    step to step."""

    def __post_init__(self) -> None:
        """Check every value, and that no episode ends as it begins."""
        super().__post_init__()
        behind, limit = CAPTURE_S * self.start_velocity_mps, self.max_position_error_m
        if limit is not None and behind >= limit:
            raise ValueError(
                f"start_velocity_mps={self.start_velocity_mps:g} starts robots up to {behind:.2g} m behind the "
                f"reference, where max_position_error_m={limit:g} ends their episode; "
                f"it must be less than {limit / CAPTURE_S:.3g}."
            )

    @property
    def span(self) -> DynamicsRange | None:
        """The range that dynamics are drawn from, if they are."""
        return RANGES.get(self.dynamics)

    @property
    def draws(self) -> bool:
        """Whether scenarios are drawn."""
        return self.scenario.active or self.span is not None

    @property
    def scene(self) -> str:
        """The least scene that has the ground of all scenarios; a slope is a part of dynamics."""
        flat = self.scenario.scene == "flat"
        return "terrain" if flat and self.span else self.scenario.scene

    def delay_steps(self, physics_hz: float) -> int:
        """Longest delay of a scenario, physics steps."""
        torque = self.span.delay_steps(physics_hz) if self.span else 0
        return max(self.scenario.delay_steps(physics_hz), torque)

    def law(self, motion: ReferenceMotion) -> ControlLaw:
        """The law of a policy that imitates `motion`.

        Raises:
          ValueError: `symmetric` is true, and the motion's second step is not the mirror image of its first.
        """
        mirrors = steps_mirror(motion)
        if self.symmetric and not mirrors:
            raise ValueError(
                "symmetric=true needs a reference whose second step mirrors its first, and this one's does not; "
                "set walk.symmetric=false."
            )
        return ControlLaw(OBSERVATIONS[self.observation], mirrors if self.symmetric is None else self.symmetric)


WALK_PRESETS = {
    "undisturbed": WalkConfig(),
    "robust": WalkConfig(
        min_reward=None,
        max_position_error_m=None,
        start_offset_m=1.0,
        kd_scale=0.3,
        scenario=ScenarioConfig(push_n=300, push_pause_s=2, terrain_m=0.25, delay_s=0.01),
    ),
    "joystick": WalkConfig(
        orientation_scale=30,
        min_reward=None,
        leash_m=0.3,
        start_velocity_mps=1.5,
        episode_steps=1200,
        command_s=3,
        kd_scale=0.3,
        scenario=ScenarioConfig(
            push_n=500,
            push_curriculum=True,
            push_pause_s=2,
            undisturbed_share=0.4,
            terrain_m=0.5,
            slope_rad=0.3,
            steps_m=0.1,
            rough_m=0.08,
            delay_s=0.02,
        ),
    ),
}
"""The task's presets by name. In `robust` only falls end episodes early, for pushed robots stray and earn little; in
`joystick` the leash keeps the reference with them, and those that nothing disturbs are to keep the speed."""
