"""Cassie to drive in a browser, by the policy that follows the most commands: `python -m cassie_mjx.demo`."""

from dataclasses import dataclass
from typing import Annotated

from cassie_mjx import cli, view
from cassie_mjx.configuration.values import Checked, Range

BEST = "joystick"
"""The policy."""


@dataclass(frozen=True)
class DemoConfig(Checked):
    """Where the page is served."""

    host: str = view.ViewConfig.host
    """Address that the page is served at: this computer alone, or 0.0.0.0 for all that reach it."""
    port: Annotated[int, Range(1, 65535)] = view.ViewConfig.port
    """Port that the page is served at."""


def main(config: DemoConfig) -> None:
    """Serve the page, and walk until Ctrl-C is typed."""
    view.main(view.ViewConfig(policy=BEST, web=True, host=config.host, port=config.port))


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, DemoConfig)


if __name__ == "__main__":
    run()
