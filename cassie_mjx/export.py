"""A policy as a file of its own: `python -m cassie_mjx.export run=runs/1x-seed0 out=policy.npz`.

An .npz file is what this package reads and runs on NumPy; an .onnx file is for ONNX Runtime and its like; `web=FOLDER`
writes NAME.json for the page in a browser.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import FORMAT, NumpyPolicy
from cassie_mjx.agents.onnx_file import PRODUCER, save_onnx
from cassie_mjx.agents.shipped import existing_policy
from cassie_mjx.agents.web_file import FORMAT as WEB_FORMAT
from cassie_mjx.agents.web_file import save_web
from cassie_mjx.configuration.values import Checked
from cassie_mjx.files import archive

POLICY = cli.Kind("a policy of ours outside a run", lambda path: archive.is_kind(path, FORMAT) and not _in_a_run(path))
ONNX = cli.marked("a policy of ours", PRODUCER.encode())
WEB = cli.marked("a policy of ours for the page", WEB_FORMAT.encode())
KINDS = {".npz": POLICY, ".onnx": ONNX}


@dataclass(frozen=True)
class ExportConfig(Checked):
    """What to export."""

    CHOICES: ClassVar[Mapping[str, Sequence[str]]] = {"which": ("best", "last")}

    out: str | None = None
    """File to write, .npz or .onnx; either this or web must be given."""
    web: str | None = None
    """Folder to write the policy to as plain arrays, NAME.json, for the page in a browser."""
    run: str | None = None
    """Directory of a training run, or a policy's .npz file; either this or a policy must be given."""
    policy: str | None = None
    """A policy that we ship, or a policy's .npz file."""
    which: str = "best"
    """"best": of the highest return by the reward it learned from, under disturbances the last; "last": the last."""
    overwrite: bool = False
    """Whether to replace a file that is no policy of ours, or belongs to a run."""

    def __post_init__(self) -> None:
        """Raise ValueError for a choice that is not known, and for what does not go together."""
        super().__post_init__()
        if (self.run is None) == (self.policy is None):
            raise ValueError("Either run or policy must be given, as in run=runs/1x-seed0 or policy=1x.")
        if self.which != "best" and not (self.run and Path(self.run).is_dir()):
            raise ValueError(f"which={self.which} is for a run's directory; give run=DIRECTORY, or leave which out.")
        if (self.out is None) == (self.web is None):
            raise ValueError("Either out or web must be given, as in out=policy.npz or web=FOLDER.")
        if self.out is not None and Path(self.out).suffix not in KINDS:
            raise ValueError(f"out={self.out} is no policy's file; name one that ends in {' or '.join(KINDS)}.")

    @property
    def source(self) -> Path:
        """The .npz file of the policy. Raises ValueError if there is no policy of that name."""
        if self.policy is not None:
            return existing_policy(self.policy)
        run = Path(self.run or "")
        return run if run.is_file() else run / f"{self.which}.npz"

    @property
    def name(self) -> str:
        """What the page calls the policy: its own name, or that of its run."""
        source = self.source.resolve()
        return source.parent.name if _in_a_run(source) else source.stem

    @property
    def file(self) -> str:
        """The file to write."""
        return self.out if self.out is not None else str(Path(self.web or "") / f"{self.name}.json")


def _in_a_run(path: Path) -> bool:
    return (path.parent / "config.json").exists()


def main(config: ExportConfig) -> None:
    """Write a policy to a file of its own, checked."""
    policy = NumpyPolicy.load(config.source)
    kind = WEB if config.web is not None else KINDS[Path(config.file).suffix]
    out = cli.check_output(config.file, kind, config.overwrite)
    if config.web is not None:
        save_web(out, policy, config.name)
    elif Path(config.file).suffix == ".onnx":
        save_onnx(out, policy, config.policy or config.run or "")
    else:
        archive.write(out, FORMAT, archive.read(config.source, FORMAT).arrays, policy.provenance)
    numbers = {name: value for name, value in policy.provenance.items() if isinstance(value, int | float)}
    returns = [f"{name} {value:.1f}" for name, value in numbers.items() if name.startswith("return_")]
    print(f"{config.file}: {', '.join(returns)}")


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ExportConfig)


if __name__ == "__main__":
    run()
