"""A policy as a file of its own: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import FORMAT, NumpyPolicy
from cassie_mjx.files import archive

POLICY = cli.Kind("a policy of ours outside a run", lambda path: archive.is_kind(path, FORMAT) and not _in_a_run(path))


@dataclass(frozen=True)
class ExportConfig:
    """What to export."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"which": ("best", "last")}

    run: str
    """Directory of a training run, or a policy's .npz file."""
    out: str
    """File to write, .npz."""
    which: str = "best"
    """"best": of the highest return by the reward it learned from, under disturbances the last; "last": the last."""
    overwrite: bool = False
    """Whether to replace a file that is no policy of ours, or belongs to a run."""

    def __post_init__(self) -> None:
        """Raise ValueError for a choice that is not known, or a file of another kind."""
        cli.check_choices(self)
        if not self.out.endswith(".npz"):
            raise ValueError(f"out={self.out} is no policy file; name one that ends in .npz.")


def _in_a_run(path: Path) -> bool:
    return (path.parent / "config.json").exists()


def main(config: ExportConfig) -> None:
    """Copy a policy to a file of its own, checked, and with its SHA-256."""
    run = Path(config.run)
    source = run if run.is_file() else run / f"{config.which}.npz"
    policy, out = NumpyPolicy.load(source), cli.check_output(config.out, POLICY, config.overwrite)
    archive.write(out, FORMAT, archive.read(source, FORMAT).arrays, policy.provenance)
    numbers = {name: value for name, value in policy.provenance.items() if isinstance(value, int | float)}
    returns = [f"{name} {value:.1f}" for name, value in numbers.items() if name.startswith("return_")]
    print(f"{config.out}: {', '.join(returns)}")


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ExportConfig)


if __name__ == "__main__":
    run()
