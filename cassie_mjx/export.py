"""A policy as a file of its own: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`.

An .npz file is what this package reads and runs on NumPy; an .onnx file is for ONNX Runtime and its like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.onnx_file import save_onnx
from cassie_mjx.agents.shipped import find_policy

ENDINGS = (".npz", ".onnx")


@dataclass(frozen=True)
class ExportConfig:
    """What to export."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"which": ("best", "last")}

    out: str
    """File to write, .npz or .onnx."""
    run: str | None = None
    """Directory of a training run; either this or a policy must be given."""
    policy: str | None = None
    """A policy that we ship, or a policy's .npz file."""
    which: str = "best"
    """"best": of the highest return by the reward it learned from, under disturbances the last; "last": the last."""

    def __post_init__(self) -> None:
        """Raise ValueError for a choice that is not known, and for what does not go together."""
        cli.check_choices(self)
        if (self.run is None) == (self.policy is None):
            raise ValueError("Either run or policy must be given, as in run=runs/1x-seed0 or policy=1x.")
        if self.policy is not None and self.which != "best":
            raise ValueError(f"which={self.which} is for a run; give run={self.policy}, or leave which out.")
        if Path(self.out).suffix not in ENDINGS:
            raise ValueError(f"out={self.out} is no policy's file; name one that ends in {' or '.join(ENDINGS)}.")

    @property
    def source(self) -> Path:
        """The .npz file of the policy. Raises ValueError if there is no policy of that name."""
        return find_policy(self.policy) if self.policy else Path(self.run or "") / f"{self.which}.npz"


def main(config: ExportConfig) -> None:
    """Write a policy to a file of its own, checked."""
    out, source = cli.check_writable(config.out), config.source
    policy = NumpyPolicy.load(source)
    if Path(config.out).suffix == ".onnx":
        save_onnx(out, policy, config.policy or config.run or "")
    else:
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
