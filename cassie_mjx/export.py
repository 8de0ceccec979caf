"""A policy as a file of its own: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.configuration.values import Checked


@dataclass(frozen=True)
class ExportConfig(Checked):
    """What to export."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"which": ("best", "last")}

    run: str
    """Directory of a training run."""
    out: str
    """File to write, .npz."""
    which: str = "best"
    """"best": of the highest return by the reward it learned from, under disturbances the last; "last": the last."""


def main(config: ExportConfig) -> None:
    """Copy a run's policy to a file of its own, checked."""
    out, source = cli.check_writable(config.out), Path(config.run) / f"{config.which}.npz"
    policy = NumpyPolicy.load(source)
    partial = out.with_name(out.name + ".partial")
    partial.write_bytes(source.read_bytes())
    partial.replace(out)
    returns = {name: value for name, value in policy.provenance.items() if name.startswith("return_")}
    print(f"{config.out}: " + ", ".join(f"{name} {value:.1f}" for name, value in returns.items()))


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ExportConfig)


if __name__ == "__main__":
    run()
