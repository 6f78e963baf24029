"""`abbe check-config`, `schema`, `sim` and `version`: the machine file and its schema, the simulated machine, the versions."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from abbe.service.children import python_command
from abbe.service.cli.common import DEFAULT_MACHINE, JsonOption, MachineOption, answer, conclude, machine_file, print_json, print_table

SIM_SETTINGS: dict[str, Any] = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Everything after ``sim`` belongs to the simulators, ``--help`` included."""
SIMULATED_DAYS = 365
"""Days for which the certificates of simulated instruments are valid in a machine file."""


def version(as_json: JsonOption = False) -> None:
    """Print the versions of Abbe, Python and SQLite, and whether SQLite may use its write-ahead log."""
    import platform
    import sqlite3
    from importlib import metadata

    from abbe.service.storage import wal_is_safe

    log = "write-ahead log" if wal_is_safe() else "no write-ahead log: this SQLite has the WAL-reset bug"
    doc = {"abbe": metadata.version("abbe"), "python": platform.python_version(), "sqlite": sqlite3.sqlite_version, "log": log}
    answer(doc, f"abbe {doc['abbe']} (Python {doc['python']}, SQLite {doc['sqlite']}, {log})", as_json=as_json)
    conclude("abbe doctor", as_json=as_json)


def sim(
    context: typer.Context,
    file: Annotated[
        Path | None,
        typer.Option("--machine-file", metavar="FILE", help="Write a machine file for the simulated machine.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the simulated machine and its instruments until Ctrl-C.

    Prints one JSON object with the addresses. Other arguments go to the module `abbe.simulators`.
    """
    from abbe.service.errors import ConfigError

    # Its own process group: Ctrl-C reaches the child once, from here, and not again from the terminal.
    own_group: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
    arguments = list(context.args)
    if {"-h", "--help"} & set(arguments):
        typer.echo("abbe sim [--machine-file FILE] ...: FILE is a new machine file for the simulated machine; the other options:", err=True)
    if file is not None and file.exists():
        raise ConfigError(f"{file} exists", "remove it, or give another name")
    if arguments[:1] != ["truth"] and "--watch-stdin" not in arguments:
        # The child ends when this pipe closes, even if this process is killed by SIGKILL.
        arguments.append("--watch-stdin")
        own_group["stdin"] = subprocess.PIPE
    if file is not None:
        own_group["stdout"] = subprocess.PIPE
    child = subprocess.Popen(python_command("abbe.simulators", *arguments), **own_group)  # noqa: S603 - our own package

    def forward(number: int, _frame: FrameType | None) -> None:
        if child.poll() is None:
            child.send_signal(number)

    handlers = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if file is not None and child.stdout is not None:
            _write_machine_file(child.stdout.readline(), file, as_json=as_json)
        code = child.wait()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if child.poll() is None:
            child.kill()
            child.wait()
    raise typer.Exit(code if code >= 0 else 128 - code)


def _write_machine_file(line: bytes, file: Path, *, as_json: bool) -> None:
    """Write the machine file of simulators that have reported their addresses; nothing if they have ended."""
    from dataclasses import replace
    from datetime import timedelta

    from abbe.service.clock import SystemClock
    from abbe.service.demo.demo import demo_site, machine_file_of
    from abbe.service.demo.simulator_process import SimulatorProcess
    from abbe.service.files import write_page

    if not line.strip():
        return
    site, day = demo_site(SimulatorProcess.of_line(line)), SystemClock().utc().date() + timedelta(days=SIMULATED_DAYS)
    write_page(machine_file_of(replace(site, calibrated_until=dict.fromkeys(site.calibrated_until, day))), file)
    typer.echo(line.decode().rstrip())
    conclude("abbe doctor", machine=None if file == Path(DEFAULT_MACHINE) else file, as_json=as_json)


def check_config(
    machine: MachineOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check a machine file and print its effective values with their origins; exit code 2 if something cannot work."""
    from abbe.service.config import load_machine

    file = machine_file(machine)
    loaded = load_machine(file)

    from abbe.service.campaigns.plausibility import check_plausibility
    from abbe.service.clock import SystemClock
    from abbe.service.errors import ConfigError
    from abbe.service.secrets import mask_secrets, visible

    found = check_plausibility(loaded.machine, loaded.path.resolve().parent, SystemClock().utc().date())
    database = mask_secrets(loaded.database_url)
    if as_json:
        values = {key: {"value": value, "origin": origin} for key, value, origin in loaded.values()}
        result = {"good": found.good, "errors": found.errors, "warnings": found.warnings}
        print_json({"file": str(file), "database": database, "values": values} | result)
        raise typer.Exit(2 if found.errors else 0)
    rows = [(key, "-" if value is None else json.dumps(value, ensure_ascii=False), origin) for key, value, origin in loaded.values()]
    print_table(("key", "value", "from"), rows, title=f"{file} is good" if found.good else str(file))
    typer.echo(f"database: {database}")
    for line in found.warnings:
        typer.echo(f"warning: {visible(line)}", err=True)
    for line in found.errors:
        typer.echo(f"error {ConfigError.code}: {visible(line)}", err=True)
    then = "abbe check-config" if found.errors else "abbe doctor"
    conclude(then, machine=machine, verdict=f"{file}: {len(found.errors)} errors, {len(found.warnings)} warnings")
    raise typer.Exit(2 if found.errors else 0)


def schema(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to.")] = Path("docs/schemas"), as_json: JsonOption = False
) -> None:
    """Write the JSON Schemas of the machine file and of the exchange files."""
    from abbe.service.errors import ConfigError
    from abbe.service.schemas import write_schemas

    try:
        written = [str(path) for path in write_schemas(folder)]
    except FileExistsError:
        raise ConfigError(f"{folder} is a file", "give the name of a folder") from None
    except OSError as err:
        raise ConfigError(f"{folder}: cannot be written: {err.strerror}", "give a writable folder") from None
    answer({"files": written}, *written, as_json=as_json)
    conclude("abbe check-config", as_json=as_json)
