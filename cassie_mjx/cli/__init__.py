"""Command lines, files, provenance."""

from cassie_mjx.cli.command_line import keep_compiled_programs, parse, run
from cassie_mjx.cli.files import (
    RESULT,
    Kind,
    check_output,
    check_writable,
    marked,
    read_json,
    write_json,
    write_result,
    write_text,
)
from cassie_mjx.cli.keys import Group
from cassie_mjx.cli.origin import program, provenance
from cassie_mjx.cli.process import console

__all__ = [
    "RESULT",
    "Group",
    "Kind",
    "check_output",
    "check_writable",
    "console",
    "keep_compiled_programs",
    "marked",
    "parse",
    "program",
    "provenance",
    "read_json",
    "run",
    "write_json",
    "write_result",
    "write_text",
]
