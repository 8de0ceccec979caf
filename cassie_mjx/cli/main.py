"""The console script `cassie-mjx`: the commands of `python -m cassie_mjx.*` under one name."""

import ast
import importlib
import sys
from pathlib import Path

from cassie_mjx.configuration.values import did_you_mean

COMMANDS = ("train", "evaluate", "render", "view", "demo", "export", "report")


def sentence(command: str) -> str:
    """What a command does: the first line of its module, which is not imported for it."""
    source = (Path(__file__).parents[1] / f"{command}.py").read_text()
    doc = ast.get_docstring(ast.parse(source)) or ""
    return doc.splitlines()[0].split(": `")[0]


def main() -> None:
    """Run the command that the first argument names; without one, list them."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("--help", "-h"):
        print("cassie-mjx COMMAND KEY=VALUE ..., or cassie-mjx COMMAND --help\n")
        print("\n".join(f"  {command:10}{sentence(command)}." for command in COMMANDS))
        return
    command, *rest = arguments
    if command not in COMMANDS:
        hint = did_you_mean(command, COMMANDS)
        print(f"error: {command!r} is not a command; the commands are {', '.join(COMMANDS)}.{hint}", file=sys.stderr)
        sys.exit(2)
    sys.argv = [f"cassie-mjx {command}", *rest]
    importlib.import_module(f"cassie_mjx.{command}").run()
