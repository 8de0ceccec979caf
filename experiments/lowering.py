"""What an accelerator would be given to run: `python -m experiments.lowering out=FILE.json`; no accelerator is needed.

Lowers one physics step of MJX for each platform and counts what accelerators are slow at in its StableHLO: loops, which
the host may have to steer; gathers and scatters; calls into libraries. An operation in a function that is called twice
counts twice, one in a loop's body once.
"""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.types import PhysicsState, Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.arrays import Array
from cassie_mjx.robot.model import MJX_TRAINING, load_mjx_model, standing

PLATFORMS = ("cuda", "rocm", "tpu", "cpu")
COUNTED = ("while", "gather", "scatter", "custom_call", "cholesky", "triangular_solve", "dot_general")
ROBOTS = 64


@dataclass(frozen=True)
class LoweringConfig(Checked):
    """What to count."""

    CHOICES: ClassVar[Mapping[str, Collection[str]]] = {"platforms": PLATFORMS}

    out: str = "lowering.json"
    """Result file."""
    overwrite: bool = False
    """Whether to replace a file that is no result of this experiment."""
    platforms: tuple[str, ...] = ("cuda", "tpu")
    """What to lower for."""


def step_text(physics: MjxPhysics, platform: str) -> str:
    """StableHLO of one physics step of a batch of robots."""
    qpos = np.tile(standing(physics.model), (ROBOTS, 1)).astype(np.float32)
    state = physics.init(qpos, np.zeros((ROBOTS, cassie.NV), np.float32))
    scenario = jax.tree.map(_as_jax, Scenario.nominal(ROBOTS))

    def step(state: PhysicsState, target: jax.Array, scenario: Scenario) -> PhysicsState:
        return physics.advance(state, target, scenario, 1)

    target = jnp.zeros((ROBOTS, cassie.NU), jnp.float32)
    return export.export(jax.jit(step), platforms=[platform])(state, target, scenario).mlir_module()


def _as_jax(x: Array) -> jax.Array:
    return jnp.asarray(x, jnp.float32 if x.dtype == np.float64 else x.dtype)


def operations(text: str) -> Counter[str]:
    """How often each operation of a StableHLO module would run from `main` on; the bodies of loops count once."""
    functions = {each.partition("(")[0]: each for each in re.split(r"func\.func (?:\w+ )?@", text)[1:]}
    own = {name: Counter(re.findall(r"stablehlo\.(\w+)", body)) for name, body in functions.items()}
    calls = {name: Counter(re.findall(r"\bcall @([\w.]+)", body)) for name, body in functions.items()}

    def total(name: str) -> Counter[str]:
        counts = Counter(own[name])
        for callee, times in calls[name].items():
            counts.update({operation: times * count for operation, count in total(callee).items()})
        return counts

    return total("main")


def rounded_products(text: str) -> int:
    """Products of matrices whose factors an accelerator may round, in a StableHLO module."""
    products = re.findall(r"stablehlo\.dot_general.*", text)
    return sum("precision = [HIGHEST, HIGHEST]" not in line for line in products if "xf" in line)


def main(config: LoweringConfig) -> None:
    """Lower, count and write the result."""
    out = cli.check_output(config.out, cli.RESULT, config.overwrite)
    rows: list[dict[str, Any]] = []
    for contacts in ("walking", "full"):
        physics = MjxPhysics(load_mjx_model(replace(MJX_TRAINING, contacts=contacts)), scene="flat")
        for platform in config.platforms:
            counts = operations(step_text(physics, platform))
            kinds = {name: counts[name] for name in COUNTED}
            rows.append({"contacts": contacts, "platform": platform, **kinds, "all": sum(counts.values())})
            cli.console().print(rows[-1])
    cli.write_result(out, {"rows": rows, "provenance": cli.provenance()})


if __name__ == "__main__":
    cli.run(main, LoweringConfig)
