"""Command lines, files, provenance."""

from cassie_mjx.cli.command_line import keep_compiled_programs, parse, run
from cassie_mjx.cli.files import check_writable, write_json, write_text
from cassie_mjx.cli.keys import Group
from cassie_mjx.cli.origin import program, provenance

__all__ = [
    "Group",
    "check_writable",
    "keep_compiled_programs",
    "parse",
    "program",
    "provenance",
    "run",
    "write_json",
    "write_text",
]
