"""From MJCF to compiled models: which scene, rate and contacts, for MuJoCo C and for MJX."""

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, ClassVar

import mujoco
import numpy as np

from cassie_mjx.configuration.values import Checked, Range
from cassie_mjx.robot import cassie
from cassie_mjx.robot.dynamics import Dynamics
from cassie_mjx.robot.electronics import cycles_per_step
from cassie_mjx.robot.ground import SCENES
from cassie_mjx.robot.mjcf import WALKING_PAIRS, differing, free_root, missing

CONTACTS = ("walking", "full", "published")


PhysicsHz = Annotated[int, Range(100, 20_000)]
"""Physics steps a second."""


@dataclass(frozen=True)
class ModelConfig(Checked):
    """Which Cassie to compile."""

    CHOICES: ClassVar[Mapping[str, Collection[str]]] = {"scene": SCENES, "contacts": CONTACTS}

    physics_hz: PhysicsHz = 2000
    """Physics steps a second; a whole number of them must fit in the 32 ms of a control step."""
    scene: str = "flat"
    """"flat", "terrain" (hills, slopes and steps) or "rough" (any `robot.ground.Ground`)."""
    contacts: str = "full"
    """"walking": the feet with the floor alone; "full": also shanks and pelvis with the floor, and leg with leg;
    "published": also the thighs with the floor, as in the published model."""
    iterations: Annotated[int, Range(1, 10_000)] = 100
    """Iterations of the constraint solver (Newton): MuJoCo C stops earlier when converged, MJX does them all."""
    ls_iterations: Annotated[int, Range(1, 10_000)] = 50
    """Iterations of each line search in the solver: MuJoCo C stops earlier, MJX does them all."""
    electronics: bool = False
    """Whether engines show what the robot's encoders and filters show, and give what its motors give
    (`robot.electronics`)."""

    def __post_init__(self) -> None:
        """Raise ValueError for a value that names no model."""
        super().__post_init__()
        steps_per_control(self.physics_hz)
        if self.electronics:
            cycles_per_step(self.physics_hz)


def steps_per_control(physics_hz: float) -> int:
    """Physics steps in one control step of 32 ms. Raises ValueError unless that is a whole number."""
    steps = cassie.CONTROL_PERIOD_S * physics_hz
    if physics_hz <= 0 or abs(steps - round(steps)) > 1e-9:
        raise ValueError(
            f"physics_hz={physics_hz:g} does not divide the control step of 32 ms into whole physics steps; "
            "use 500, 1000 or 2000."
        )
    return round(steps)


NATIVE_TRAINING = ModelConfig(physics_hz=500)
"""What MuJoCo C trains on: the lowest rate that training is stable at; every return is measured at 2 kHz."""
MJX_TRAINING = ModelConfig(physics_hz=1000, iterations=4, ls_iterations=2)
"""What MJX trains on. With three steps of Newton's method one of eight pushed robots is 1.1 mrad off MuJoCo C after
32 ms, more than `tests/test_physics_mjx.py` allows; with four it is not."""
MJX_TESTING = replace(MJX_TRAINING, physics_hz=2000)
"""What MJX is evaluated on: the rate of MuJoCo C there."""


def xml_path(scene: str = "flat") -> Path:
    """The MJCF of a scene, in a checkout and in an installed package alike."""
    package = Path(str(files("cassie_mjx")))
    for folder in (package / "xml", package.parent / "xml"):
        if (folder / f"scene_{scene}.xml").is_file():
            return folder / f"scene_{scene}.xml"
    raise ValueError(f"No scene_{scene}.xml beside the package in {package}; reinstall cassie-mjx.")


def load_model(config: ModelConfig, path: Path | None = None) -> mujoco.MjModel:
    """Compile the physics of a scene: no visuals, no sensors, motors as published (control in motor N·m).

    Args:
      config: scene, rate, contacts and solver.
      path: another MJCF of the same robot instead of the package's scene: names, order, loops, motors and the geoms
        that touch must be the same, figures need not; the root may be three slides and a ball.

    Raises:
      ValueError: the file cannot be compiled, or lacks something of the robot's.
    """
    spec = _read(path or xml_path(config.scene))
    if path is None:
        _strip(spec)
        _choose_pairs(spec, config.contacts)
        return _compile(spec, config)
    free_root(spec)
    _strip(spec)
    _refuse(path, missing(spec, config.scene))
    _choose_pairs(spec, config.contacts)
    model = _compile(spec, config)
    _refuse(path, differing(model))
    return model


def load_mjx_model(config: ModelConfig) -> mujoco.MjModel:
    """Compile the physics for MJX: as `load`, but the floor under each leg and the pelvis is a plane of its own.

    A plane of its own can follow the terrain's tangent under that leg: any height without compiling anew. So both
    scenes are one model here, and `config.scene` does not matter.
    """
    spec = _read(xml_path("flat"))
    _strip(spec)
    floor = spec.geom("floor")
    for part in ("left", "right", "pelvis"):
        spec.worldbody.add_geom(name=f"{part}-floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])
        spec.geom(f"{part}-floor").contype = spec.geom(f"{part}-floor").conaffinity = 0
    _choose_pairs(spec, config.contacts)
    for pair in spec.pairs:
        if pair.geomname1 == "floor":
            pair.geomname1 = f"{pair.geomname2.split('-')[0]}-floor"
    spec.delete(floor)
    return _compile(spec, config)


def servo_model(model: mujoco.MjModel, kd_scale: float = 1.0, dynamics: Dynamics | None = None) -> mujoco.MjModel:
    """A copy whose motors are position servos in joint units: control is the PD target in rad.

    Force = P ctrl - P q - s D qdot with s = `kd_scale`, clipped to the joint's torque limit: the PD law of
    `cassie.pd_torque`, evaluated by MuJoCo at every step. With the dynamics of one robot it is the law on what its
    encoders show, with its gains, by its motors.
    """
    servo = copy.copy(model)
    made = Dynamics.nominal() if dynamics is None else dynamics
    p_gain = cassie.P_GAIN * made.p_gain * made.strength
    d_gain = kd_scale * cassie.D_GAIN * made.d_gain * made.strength
    limit = cassie.TORQUE_LIMIT * made.strength
    servo.actuator_gear[:, 0] = 1.0
    servo.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_FIXED
    servo.actuator_gainprm[:, 0] = p_gain
    servo.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    servo.actuator_biasprm[:, 0] = -p_gain * made.encoder_offset[: cassie.NU]
    servo.actuator_biasprm[:, 1] = -p_gain
    servo.actuator_biasprm[:, 2] = -d_gain
    servo.actuator_ctrllimited[:] = 0
    servo.actuator_forcelimited[:] = 1
    servo.actuator_forcerange[:] = np.stack([-limit, limit], axis=1)
    return servo


def standing(model: mujoco.MjModel) -> np.ndarray:
    """The keyframe "standing", qpos [35], which `cassie.STANDING_TARGET` holds. Raises ValueError if there is none."""
    names = [model.key(i).name for i in range(model.nkey)]
    if "standing" not in names:
        raise ValueError(f'The model has no keyframe "standing"; it has {", ".join(names) or "none"}.')
    return model.key("standing").qpos.copy()


def _read(path: Path) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"{path} is not a model that MuJoCo reads: {error}") from error


def _refuse(path: Path, phrases: list[str]) -> None:
    if phrases:
        raise ValueError(
            f"{path} cannot be simulated here: {'; '.join(phrases)}. In a loop of your own, "
            "cassie_mjx.Controller.load(policy, model) runs a policy in any model with Cassie's joints."
        )


def _strip(spec: mujoco.MjSpec) -> None:
    """Delete what only eyes and sensors need."""
    for group in (spec.sensors, spec.cameras, spec.lights, spec.sites):
        for element in list(group):
            spec.delete(element)
    for geom in spec.geoms:
        geom.material = ""
    for looks in (spec.materials, spec.textures):
        for element in list(looks):
            spec.delete(element)
    for geom in [g for g in spec.geoms if g.name != "floor" and not g.name.endswith("-collision")]:
        spec.delete(geom)


def _choose_pairs(spec: mujoco.MjSpec, contacts: str) -> None:
    if contacts == "published":
        for side in cassie.SIDES:
            thigh = spec.add_pair(spec.find_default("floor"), name=f"floor:{side}-hip-pitch")
            thigh.geomname1, thigh.geomname2 = "floor", f"{side}-hip-pitch-collision"
    elif contacts == "walking":
        for pair in [pair for pair in spec.pairs if pair.name not in WALKING_PAIRS]:
            spec.delete(pair)


def _compile(spec: mujoco.MjSpec, config: ModelConfig) -> mujoco.MjModel:
    spec.option.timestep = 1.0 / config.physics_hz
    spec.option.iterations = config.iterations
    spec.option.ls_iterations = config.ls_iterations
    # A diverged robot keeps its NaN, for the environment to see, instead of jumping back to the start.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    try:
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot compile the model: {error}") from error
    return model
