"""Writes docs/reference/cli.md from the command line itself: ``python -m tests.project.cli_page`` (``--check``: is it current?)."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from abbe.service.cli.app import app
from tests.written_page import run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "cli.md"
_HEAD = """# Commands

`python -m tests.project.cli_page` writes this page from the command line itself; a test checks that it is current.

Exit codes: 0 done, 1 the answer is no, 2 bad input or a fault (one line with a [code](error-codes.md) says what and what to do),
129, 130, 143 closed terminal, Ctrl-C, SIGTERM.

`-m FILE` (`--machine FILE`) names the machine file; without it, it is the one that `ABBE_MACHINE` names, else `abbe.toml` in the current
folder. A command works with the database of the machine file. `--db URL` names a database directly; without a machine it is the one that
`ABBE_DB` names, else `abbe.sqlite3` in the current folder. `--json`, where `abbe COMMAND --help` lists it, prints JSON on stdout. The
tables below leave these three out.
"""
_COMMON = ("Print JSON on stdout.", "Machine file. Default:", "Database, instead of")


def page() -> str:
    """The whole page."""
    root = typer.main.get_command(app)
    return _HEAD + "".join(_section(name, command) for name, command in _commands(root, "abbe"))


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
