"""``abbe version`` and ``abbe sim``: the versions, and the simulated machine."""

from __future__ import annotations

import os
import signal
import subprocess
from types import FrameType
from typing import Any

import typer

from abbe.service.children import python_command

SIM_SETTINGS: dict[str, Any] = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Everything after ``sim`` belongs to the simulators, ``--help`` included."""


def version() -> None:
    """Print the versions of Abbe, Python and SQLite, and whether SQLite may use its write-ahead log."""
    import platform
    import sqlite3
    from importlib import metadata

    from abbe.service.storage.engine import wal_is_safe

    log = "write-ahead log" if wal_is_safe() else "no write-ahead log: this SQLite has the WAL-reset bug"
    typer.echo(f"abbe {metadata.version('abbe')} (Python {platform.python_version()}, SQLite {sqlite3.sqlite_version}, {log})")


def sim(context: typer.Context) -> None:
    """Run the simulated machine and its instruments; arguments go to the module `abbe.simulators`."""
    # Its own process group: Ctrl-C reaches the child once, from here, and not again from the terminal.
    own_group: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
    arguments = list(context.args)
    if arguments[:1] != ["truth"] and "--watch-stdin" not in arguments:
        # The child ends when this pipe closes, even if this process is killed by SIGKILL.
        arguments.append("--watch-stdin")
        own_group["stdin"] = subprocess.PIPE
    child = subprocess.Popen(python_command("abbe.simulators", *arguments), **own_group)  # noqa: S603 - our own package

    def forward(number: int, _frame: FrameType | None) -> None:
        if child.poll() is None:
            child.send_signal(number)

    handlers = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        code = child.wait()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if child.poll() is None:
            child.kill()
            child.wait()
    raise typer.Exit(code if code >= 0 else 128 - code)
