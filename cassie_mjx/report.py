"""Show evaluation files as one web page, beside the paper: `python -m cassie_mjx.report results=FOLDER`.

Any folder of files that `cassie_mjx.evaluate` has written will do. Imports neither JAX nor MuJoCo.
"""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from cassie_mjx import cli
from cassie_mjx.configuration.values import Checked
from cassie_mjx.reporting.folder import evaluations, folder_page


@dataclass(frozen=True)
class ReportConfig(Checked):
    """Where from, and where to."""

    results: str = "."
    """Folder of evaluation files; those in folders below it are shown, too."""
    out: str = "report.html"
    """The web page, which needs no other file. An earlier report is replaced, any other file is not."""


def main(config: ReportConfig) -> None:
    """Write the page, and say what was left out."""
    folder, console = Path(config.results), Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    if not folder.is_dir():
        raise ValueError(f"results={folder} is not a folder; name the one with the evaluation files.")
    out = cli.check_writable(config.out)
    if out.exists() and "<title>Cassie MJX" not in out.read_text(errors="replace")[:1000]:
        raise ValueError(f"{out} is no report of ours, and would be replaced by one; name another file.")
    found, skipped = evaluations(folder)
    if not found:
        raise ValueError(
            f"{folder} holds no evaluation file; python -m cassie_mjx.evaluate policy=1x out=FILE makes one."
        )
    cli.write_text(out, folder_page(found))
    for sentence in skipped:
        console.print(f"Skipped: {sentence}")
    console.print(f"{config.out}: {len(found)} evaluation files.")


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ReportConfig)


if __name__ == "__main__":
    run()
