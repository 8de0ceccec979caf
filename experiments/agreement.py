"""MJX against MuJoCo C from the same states: `python -m experiments.agreement out=FILE.json`.

Two comparisons. First, qacc of every degree of freedom in float64 with converged solvers, from rest to fast walking
velocities, with and without the bias acceleration J̇v of the loops that MJX 3.17 leaves out. Second, pelvis, joints and
loops after 1 and 10 control steps of 32 ms with the settings that MJX trains on, in float32.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked, Range, Seed
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import FLAT
from cassie_mjx.robot.loops import loop_error
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model, load_model, servo_model, standing

CONVERGED = replace(MJX_TRAINING, iterations=50, ls_iterations=50)


@dataclass(frozen=True)
class AgreementConfig(Checked):
    """What to compare."""

    out: str = "agreement.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    speeds: tuple[Annotated[float, Range(0, 100)], ...] = (0.0, 0.3, 1.0, 3.0)
    """Standard deviation of the random joint velocities, rad/s (and m/s for the pelvis); 3 is the swing of a walk."""
    robots: Annotated[int, Range(1, 10_000)] = 16
    """States for each speed."""
    seed: Seed = 0
    """Seed of the velocities and targets."""

    def __post_init__(self) -> None:
        """Raise ValueError if there is nothing to compare."""
        super().__post_init__()
        if not self.speeds:
            raise ValueError("speeds is empty; name at least one, such as speeds=1.")


def loop_consistent(model: mujoco.MjModel, qpos: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """The part of a velocity [32] that keeps the closed loops closed."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    jacobian = data.efc_J.reshape(-1, model.nv)[: data.ne]
    return velocity - np.linalg.pinv(jacobian) @ (jacobian @ velocity)


def draw(config: AgreementConfig, model: mujoco.MjModel, speed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standing robots with random velocities and PD targets: qpos, qvel, targets."""
    rng = np.random.default_rng(config.seed)
    qpos = np.tile(standing(model), (config.robots, 1))
    qvel = speed * rng.normal(size=(config.robots, cassie.NV))
    qvel = np.stack([loop_consistent(model, q, v) for q, v in zip(qpos, qvel, strict=True)])
    return qpos, qvel, cassie.STANDING_TARGET + 0.1 * rng.normal(size=(config.robots, cassie.NU))


def compare_accelerations(config: AgreementConfig, speed: float) -> dict[str, Any]:
    """Largest difference of qacc over states and degrees of freedom, with and without J̇v."""
    with jax.enable_x64(True):
        servo = servo_model(load_model(CONVERGED))
        servo.opt.tolerance = 0
        qpos, qvel, targets = draw(config, servo, speed)
        data = mujoco.MjData(servo)
        expected = []
        for q, v, target in zip(qpos, qvel, targets, strict=True):
            data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = q, v, target, 0
            mujoco.mj_forward(servo, data)
            expected.append(data.qacc.copy())
        physics = MjxPhysics(load_mjx_model(CONVERGED))
        found = {term: accelerations(physics, qpos, qvel, targets, term) for term in (True, False)}
    difference = {term: np.abs(qacc - expected) for term, qacc in found.items()}
    return {
        "comparison": "qacc, float64, converged",
        "speed": speed,
        "largest_qacc": float(np.abs(expected).max()),
        "difference_max": float(difference[True].max()),
        "difference_max_without_bias": float(difference[False].max()),
        "difference_max_of_each_dof": difference[True].max(axis=0).tolist(),
    }


def accelerations(
    physics: MjxPhysics, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray, with_bias: bool
) -> np.ndarray:
    """Qacc [B, 32] of MJX under the PD law; without the loops' bias as `mjx.forward` has it."""
    m = mjx.put_model(physics.model)

    def one(q: jax.Array, v: jax.Array, target: jax.Array) -> jax.Array:
        torque = cassie.pd_torque(target, q[cassie.ACTIVE_QPOS], v[cassie.ACTIVE_QVEL])
        d = mjx.make_data(physics.model).replace(qpos=q, qvel=v)
        if with_bias:
            return physics.dynamics(m, d, torque, jnp.zeros(3), FLAT.ground)[2].qacc
        applied = jnp.zeros(cassie.NV).at[cassie.ACTIVE_QVEL].set(torque)
        return mjx.forward(m, d.replace(qfrc_applied=applied)).qacc

    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(qpos), jnp.asarray(qvel), jnp.asarray(targets)))


def compare_motion(config: AgreementConfig, speed: float, precision: str = "highest") -> list[dict[str, Any]]:
    """Differences after 1 and 10 control steps in float32, at the rate and with the settings of training.

    `precision` is that of MJX's products, by the names of `jax.default_matmul_precision`.
    """
    c = NativePhysics(load_model(replace(MJX_TRAINING, iterations=100, ls_iterations=50)))
    x = MjxPhysics(load_mjx_model(MJX_TRAINING), precision=precision)
    qpos, qvel, targets = draw(config, c.model, speed)
    theirs = c.init(qpos, qvel)
    ours = x.init(qpos.astype(np.float32), qvel.astype(np.float32))
    rows = []
    for step in range(1, 11):
        theirs = c.advance(theirs, targets, Scenario.nominal(config.robots), 32)
        ours = x.advance(ours, targets, Scenario.nominal(config.robots), 32)
        if step in (1, 10):
            difference = np.abs(np.asarray(ours.qpos) - theirs.qpos)
            rows.append(
                {
                    "comparison": "motion, float32, training settings",
                    "speed": speed,
                    "control_steps": step,
                    "pelvis_difference_max_mm": 1000 * float(difference[:, :3].max()),
                    "joint_difference_max_mrad": 1000 * float(difference[:, cassie.ACTIVE_QPOS].max()),
                    "loop_error_max_mm": 1000 * float(loop_error(c.model, np.asarray(ours.qpos)).max()),
                    "loop_error_max_mm_mujoco_c": 1000 * float(loop_error(c.model, theirs.qpos).max()),
                }
            )
    return rows


def main(config: AgreementConfig) -> None:
    """Compare and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    rows = [compare_accelerations(config, speed) for speed in config.speeds]
    rows += [row for speed in config.speeds for row in compare_motion(config, speed)]
    for row in rows:
        cli.console().print({key: value for key, value in row.items() if key != "difference_max_of_each_dof"})
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance(seed=config.seed)})


if __name__ == "__main__":
    cli.run(main, AgreementConfig)
