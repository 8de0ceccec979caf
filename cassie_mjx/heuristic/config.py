"""Parameters of the heuristic controller, and its two presets."""

import functools
from dataclasses import dataclass

import jax

from cassie_mjx.robot import cassie


@functools.partial(jax.tree_util.register_dataclass)
@dataclass(frozen=True)
class ControllerConfig:
    """Its parameters. A pytree: a leaf may be a [B] array, one value for each robot. Defaults: `STIFF`."""

    period: float = 0.001
    """Time between two calls of `step` for which the other values were tuned, s."""
    step_time: float = 0.352
    """Duration of one footstep on the clock, s; two make a stride of 22 control steps of 32 ms."""
    speed: float = 0.66
    """Velocity of the centre of mass aimed at for the end of a step, m/s; the mean speed differs from it."""
    width: float = 0.291
    """Lateral distance between the feet, m."""
    gain_x: float = 0.427
    """Share of the forward velocity error that the next foothold corrects; 1 is deadbeat."""
    gain_y: float = 0.895
    """Share of the lateral velocity error that the next foothold corrects; 1 is deadbeat."""
    line_gain: float = 0.0889
    """Lateral velocity towards the line of walking per distance from it, 1/s."""
    line_limit: float = 0.1
    """Largest lateral velocity towards the line of walking, m/s."""
    reach_x: float = 0.45
    """Longest distance of a foothold ahead of or behind the centre of mass, m."""
    reach_y: float = 0.40
    """Longest lateral distance of a foothold from the centre of mass, m."""
    min_width: float = 0.05
    """Shortest lateral distance of a foothold from the stance foot, outwards, m."""
    clearance: float = 0.14
    """Height of the swing foot in the middle of the step, m."""
    press: float = 0.0566
    """Depth below the stance sole at which the swing foot aims at the end of the step, m."""
    hurry: float = 1.287
    """Pace of the horizontal swing: it is complete after step_time / hurry."""
    slope: float = 0.5
    """Share of the slope from the last foothold to the present one that is expected at the next."""
    haste: tuple[float, float] = (0.3, 0.52)
    """What errors of the velocity at the end of the step add to the pace of the clock, forward and lateral, s/m."""
    haste_free: float = 0.24
    """As much of that is left out: more than comes up in steady walking, whose clock is exact."""
    haste_limit: float = 0.6
    """Largest addition to the pace of the clock."""
    fade: float = 0.3
    """Share of the step over which the height of lift-off fades out."""
    swing_p: tuple[float, float, float, float, float] = (216.0, 100.0, 263.6, 254.6, 50.0)
    """Position gains of the swing leg, N·m/rad."""
    swing_d: tuple[float, float, float, float, float] = (21.4, 12.4, 26.1, 25.2, 4.95)
    """Velocity gains of the swing leg, N·m·s/rad."""
    swing_feedforward: float = 0.821
    """Share of the target's own velocity that the velocity gains see."""
    body_p: tuple[float, float, float] = (184.0, 99.6, 204.0)
    """Position gains of the stance hip on the pelvis' roll, yaw, pitch, N·m/rad."""
    body_d: tuple[float, float, float] = (24.4, 8.98, 14.7)
    """Velocity gains of the stance hip on the pelvis' roll, yaw, pitch, N·m·s/rad."""
    lean: float = -0.0556
    """Pelvis pitch aimed at, nose down, rad."""
    reaction: tuple[float, float, float] = (0.216, -0.555, 1.13)
    """Shares of the swing hip's torque (roll, yaw, pitch) that the stance hip takes off the pelvis; negative adds."""
    knee_p: float = 206.0
    """Position gain of the stance knee, N·m/rad."""
    knee_d: float = 20.4
    """Velocity gain of the stance knee, N·m·s/rad."""
    height: float = 1.013
    """Height of the pelvis over the stance sole at which the stance knee aims, m, springs unloaded."""
    foot_d: float = 0.606
    """Damping of the stance foot, N·m·s/rad."""
    foot_gain: float = -35.1
    """Stance foot torque per error of the forward velocity at the end of the step, N·s; negative brakes on the toe."""
    foot_limit: float = 14.9
    """Largest such torque, N·m; at about 20 the sole would tip on its heel, and lose its grip on the body's yaw."""
    ramp: float = 0.0114
    """Time on the clock over which the stance leg takes over after the switch, s."""
    load: float = 0.0215
    """Spring deflection, as a share of that under full body weight, at which a landing leg counts as loaded."""
    hold: float = 0.0
    """Damping of the hip of a stance leg not yet loaded, as a share of `swing_d`."""


STIFF = ControllerConfig()
"""Torque control: every torque wanted, at gains above the published ones."""

COMPLIANT = ControllerConfig(
    period=0.002,
    speed=0.619,
    width=0.279,
    gain_x=0.56,
    gain_y=0.858,
    line_gain=0.116,
    min_width=0.05,
    clearance=0.136,
    press=0.0366,
    hurry=1.29,
    haste=(0.0, 0.0),
    swing_p=tuple(cassie.P_GAIN[:5].tolist()),
    swing_d=tuple(cassie.D_GAIN[:5].tolist()),
    swing_feedforward=0.786,
    body_p=(100.0, 100.0, 88.0),
    body_d=(10.0, 10.0, 8.8),
    lean=-0.08,
    reaction=(-0.095, -0.507, 1.16),
    knee_p=96.0,
    knee_d=9.6,
    height=0.988,
    foot_d=0.687,
    foot_gain=-32.9,
    foot_limit=12.9,
    ramp=0.0117,
    load=0.02,
    hold=0.257,
)
"""The published PD gains on pelvis, swing leg and knee, but for 8.8 instead of 8 N·m·s/rad on the pelvis' pitch."""

CONTROLLERS = {"stiff": STIFF, "compliant": COMPLIANT}
