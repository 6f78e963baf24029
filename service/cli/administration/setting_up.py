"""`abbe init` writes a machine file from eight answers; `abbe doctor` examines machine and computer, and says what to do."""

from __future__ import annotations

import re
import sys
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from abbe.service.cli.common import DEFAULT_MACHINE, JsonOption, MachineOption, answer, conclude, machine_file, print_json, print_table
from abbe.service.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from abbe.service.config import LoadedMachine
    from abbe.service.jobs.doctor import Examined

SERIAL_PORTS = Path("/dev/serial/by-id")
NUMBER = r"[-+]?\d+(?:\.\d+)?"
INSTRUMENTS = ("ballbar", "laser")


def init(  # noqa: PLR0913 - one option for each question
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New machine file.")] = Path(DEFAULT_MACHINE),
    name: Annotated[str | None, typer.Option("--name", help="Name of the machine.", show_default=False)] = None,
    chain: Annotated[str | None, typer.Option("--chain", help="Carriages from workpiece to tool: w-X-Y-b-Z-t.", show_default=False)] = None,
    strokes: Annotated[
        str | None, typer.Option("--strokes", help="Strokes of X, Y and Z, mm: 0..600,0..500,0..450.", show_default=False)
    ] = None,
    tool: Annotated[
        str | None, typer.Option("--tool", help="Vector from the spindle's reference point to the ball, mm: 0,0,-120.", show_default=False)
    ] = None,
    cnc: Annotated[
        str | None, typer.Option("--cnc", metavar="URL", help="Address of the controller, or - for none.", show_default=False)
    ] = None,
    ballbar: Annotated[
        str | None, typer.Option("--ballbar", metavar="URL", help="Address of the ball-bar, or - for none.", show_default=False)
    ] = None,
    laser: Annotated[
        str | None, typer.Option("--laser", metavar="URL", help="Address of the laser, or - for none.", show_default=False)
    ] = None,
    certificates: Annotated[
        str | None,
        typer.Option(
            "--certificates",
            help="Last days of the certificates of ball-bar and laser: 2027-05-31,2027-05-31, or - for none.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a commented machine file from eight answers, given as options or at the terminal. An existing file is never overwritten.

    For the ball-bar the command offers the serial ports that are plugged in. It keeps the file only after checking it: a wrong answer
    leaves no file.
    """
    from abbe.service.config import load_machine
    from abbe.service.domain.machine import DeviceUrls
    from abbe.service.files import write_page
    from abbe.service.machine_text import machine_text

    if file.exists():
        raise ConfigError(f"{file} exists", "give the name of a new file, or edit the existing one")
    ports = sorted(str(path) for path in SERIAL_PORTS.glob("*"))
    doc: dict[str, Any] = {
        "name": _asked(name, "name of the machine", "mill-1", str, "--name"),
        "chain": _asked(chain, "carriages from the workpiece (w) over the bed (b) to the tool (t)", "w-X-Y-b-Z-t", str, "--chain"),
        "stroke_mm": _asked(strokes, "strokes of X, Y and Z in mm", "0..600,0..500,0..450", _strokes, "--strokes"),
        "tool_mm": _asked(tool, "from the spindle's reference point to the ball, mm", "0,0,-120", _point, "--tool"),
    }
    port = f"serial://{ports[0]}?baud=460800" if ports else "-"
    urls = {
        "cnc": _asked(cnc, "address of the controller, e.g. modbus+tcp://192.168.0.10:502 (none: -)", "-", _url, "--cnc"),
        "ballbar": _asked(ballbar, "address of the ball-bar, e.g. serial:///dev/ttyUSB0?baud=460800 (none: -)", port, _url, "--ballbar"),
        "laser": _asked(laser, "address of the laser, e.g. modbus+tcp://192.168.0.11:502 (none: -)", "-", _url, "--laser"),
        "fixture": "fixture+console:",
    }
    days = _asked(certificates, "last days of the certificates of ball-bar and laser (none: -)", "-", _days, "--certificates")
    text = machine_text(doc, DeviceUrls(**urls), days)
    write_page(text, file)
    try:
        load_machine(file)
    except ConfigError:
        file.unlink()
        raise
    said = f"{file} is written; its comments say what else can be in it"
    answer({"file": str(file), "serial_ports": ports}, *(f"serial port: {one}" for one in ports), said, as_json=as_json)
    conclude("abbe doctor", machine=None if file == Path(DEFAULT_MACHINE) else file, as_json=as_json)


def _asked(given: str | None, question: str, usual: str, parse: Callable[[str], Any], option: str) -> Any:
    """Return the answer given by the option, else at the terminal; without a terminal, leave out an address or a date.

    Raises
    ------
    ConfigError
        The answer cannot be parsed, or it is missing and there is no terminal.
    """
    if given is None and not sys.stdin.isatty():
        if usual != "-" and parse is not _url:
            raise ConfigError(f"{option} is missing, and standard input is not a terminal", f"add {option}, e.g. {option} {usual}")
        given = "-"
    while True:
        text = (given if given is not None else str(typer.prompt(question, default=usual, err=True))).strip()
        try:
            return parse(text)
        except ValueError as error:
            if given is not None:
                raise ConfigError(f"{option} {text!r}: {error}", f"write e.g. {option} {usual}") from None
            typer.echo(f"{error}, e.g. {usual}", err=True)


def _numbers(text: str, pattern: str, wanted: str) -> list[tuple[float, ...]]:
    parts = [re.fullmatch(pattern, part.strip()) for part in text.split(",")]
    if len(parts) != 3 or not all(parts):
        raise ValueError(f"three {wanted}, separated by commas, are expected")
    return [tuple(float(value) for value in part.groups()) for part in parts if part is not None]


def _strokes(text: str) -> dict[str, tuple[float, ...]]:
    return dict(zip("XYZ", _numbers(text, rf"({NUMBER})\.\.({NUMBER})", "strokes FROM..TO in mm"), strict=True))


def _point(text: str) -> list[float]:
    return [values[0] for values in _numbers(text, f"({NUMBER})", "numbers in mm")]


def _url(text: str) -> str | None:
    return None if text in ("", "-") else text


def _days(text: str) -> dict[str, date]:
    if text in ("", "-"):
        return {}
    parts = text.split(",")
    if len(parts) != len(INSTRUMENTS):
        raise ValueError("two days, separated by a comma, are expected (- for an instrument without a certificate)")
    return {role: date.fromisoformat(day.strip()) for role, day in zip(INSTRUMENTS, parts, strict=True) if day.strip() != "-"}


def doctor(machine: MachineOption = None, as_json: JsonOption = False) -> None:
    """Connect to every device, identify it, and check plausibility, rights, locks, clock, disk, database and certificates.

    Nothing moves. Exit code 1: something has to be done before Abbe can work.
    """
    import asyncio
    from dataclasses import asdict

    from abbe.service.config import load_machine

    loaded = load_machine(machine_file(machine))
    found = asyncio.run(_examined(loaded))
    bad, look = (sum(one.state == state for one in found) for state in ("bad", "look"))
    if as_json:
        print_json({"machine": loaded.machine.name, "ready": not bad, "examined": [asdict(one) for one in found]})
    else:
        print_table(("what", "", "found", "what to do"), [(one.what, one.state, one.text, one.remedy) for one in found])
        devices = loaded.machine.devices
        if bad:
            word, then = "is not ready", "abbe doctor"
        elif devices.cnc is not None:
            word, then = "is ready", "abbe measure --recipe quick-check"
        else:
            word, then = "has no controller in its file, so that Abbe only listens, imports and solves", "abbe import FILE"
        verdict = f"{loaded.machine.name} {word}: {len(found)} points examined, {bad} bad, {look} to look at"
        conclude(then, machine=machine, verdict=verdict)
    raise typer.Exit(1 if bad else 0)


async def _examined(loaded: LoadedMachine) -> list[Examined]:
    from abbe.service.clock import SystemClock
    from abbe.service.jobs.doctor import examine

    return [one async for one in examine(loaded, SystemClock().utc())]
