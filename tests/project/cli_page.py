"""Writes docs/reference/cli.md from the command line itself: ``python -m tests.project.cli_page`` (``--check``: is it current?)."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from abbe.service.cli import EXIT_CODES
from abbe.service.cli.app import app
from tests.service.cli.every_command import table
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "cli.md"
_HEAD = """# Commands

`python -m tests.project.cli_page` writes this page from the command line itself; a test checks that it is current.

| exit code | |
|---|---|
EXIT CODES
The codes of faults are listed in [error-codes.md](error-codes.md).

`-m FILE` (`--machine FILE`) names the machine file; without it, it is the one that `ABBE_MACHINE` names, else `abbe.toml` in the current
folder. A command works with the database of the machine file. `--db URL` names a database directly; without a machine it is the one that
`ABBE_DB` names, else `abbe.sqlite3` in the current folder. Reports are in the language that `ABBE_LANGUAGE` names (`en`, `de`, `ja`, `ko`).

The answer goes to standard output, as JSON with `--json`, and into a file with `--out FILE`; progress and the next command go to standard
error. A table is folded at a terminal's width; into a pipe it has tabs between its cells. The tables below leave out `-m`, `--db`, `--json`
and `--out` where they say nothing else.

`abbe --install-completion` makes the shell complete commands and options (bash, zsh, fish, PowerShell).
"""
_EVERY = """
## Every command at a glance

What the tests prove of each command; the next command is the last line on standard error.

"""
_COMMON = ("Print JSON on stdout.", "Machine file. Default:", "Database, instead of", "Write the answer to a file")


def page() -> str:
    """The whole page."""
    root = typer.main.get_command(app)
    head = _HEAD.replace("EXIT CODES", "".join(f"| {code} | {text} |\n" for code, text in EXIT_CODES.items()))
    return head + "".join(_section(name, command) for name, command in _commands(root, "abbe")) + _EVERY + table()


def _commands(group: Any, name: str) -> Iterator[tuple[str, Any]]:
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _commands(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


def _section(name: str, command: Any) -> str:
    with command.make_context(name, [], resilient_parsing=True) as context:
        usage = " ".join(word.strip("{}") for word in command.collect_usage_pieces(context) if word != "[OPTIONS]")
        rows = [row for row in (p.get_help_record(context) for p in command.params) if row]
    text = f"\n## {name} {usage}".rstrip() + f"\n\n{_line(command.help or '')}\n"
    rows = [(re.sub(r" <.*>", "", left), _line(right.removesuffix("[required]"))) for left, right in rows if "--help" not in left]
    rows = [(left, right) for left, right in rows if right and not right.startswith(_COMMON)]
    return text + ("\n| | |\n|---|---|\n" + "".join(f"| `{left}` | {right} |\n" for left, right in rows) if rows else "")


def _line(text: str) -> str:
    return re.sub(r"\s+", " ", text.replace("|", r"\|")).strip()


if __name__ == "__main__":
    sys.exit(run(PAGE, page, "tests.project.cli_page", __doc__))
