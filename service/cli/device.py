"""`abbe device`: test a device before it measures, and list the device files that come with Abbe."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from abbe.service.cli.common import JsonOption, answer, conclude, print_json, print_table

device = typer.Typer(no_args_is_help=True, help="Test devices and interferometers, list the device files that come with Abbe.")


@device.command("list")
def list_files(as_json: JsonOption = False) -> None:
    """List the device files that come with Abbe; `device=NAME` in a URL uses one."""
    from abbe.drivers.device_file import BUILTIN, load

    found = [(path.stem, load(path.stem)[0]) for path in sorted(BUILTIN.glob("*.toml"))]
    if as_json:
        print_json([{"name": name, "kind": file.kind, "device": file.name} for name, file in found])
        return
    print_table(("name", "kind", "device"), [(name, file.kind, file.name) for name, file in found])
    conclude("abbe doctor", verdict=f"{len(found)} device files")


@device.command("show")
def show_file(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the device file, as `abbe device list` shows it.")],
    as_json: JsonOption = False,
) -> None:
    """Print a device file, to copy and change it: `abbe device show dial-gauge --out my-gauge.toml`."""
    from abbe.drivers.device_file import find, load

    file, _ = load(name)
    wire = "modbus+tcp" if file.modbus is not None else "socket"
    answer({"name": name, "toml": (text := find(name).read_text(encoding="utf-8"))}, text.rstrip("\n"), as_json=as_json)
    conclude(f"abbe device test {quote(f'{wire}://HOST:PORT?device={name}')} --move 10", as_json=as_json)


@device.command("interferometer")
def interferometer(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Table with headings: signals, phase and radius, or position and deviation.")
    ],
    fringe: Annotated[
        float, typer.Option(metavar="NM", min=1.0, help="Displacement per period of the signals, nm; 316.4: HeNe, single pass.")
    ] = 316.4,
    as_json: JsonOption = False,
) -> None:
    """Find the cyclic error of an interferometer (periodic nonlinearity): orders 1 and 2 per fringe, with U.

    The error is found from the quadrature signals, or from a slow linear run whose position is known much better than a fringe. The
    samples must be in the order in which they were taken.
    """
    from abbe.service.instrument_files.interferometer import answer_doc, cyclic_error_of, lines_of

    found = cyclic_error_of(file, fringe)
    answer(answer_doc(found), *lines_of(found), as_json=as_json)
    conclude("abbe effects cyclic_error", as_json=as_json)


@device.command("test")
def try_device(
    url: Annotated[str, typer.Argument(metavar="URL", help="Address of the device as in [devices], with device=FILE if one describes it.")],
    role: Annotated[str, typer.Option(help="Role of a device that has its own driver: laser, ballbar or cnc.")] = "laser",
    move: Annotated[float, typer.Option(metavar="MM", help="Known motion, mm, that a person makes when asked; 0: none.")] = 0.0,
    tolerance: Annotated[float, typer.Option(metavar="MM", help="Largest error of that motion, mm.")] = 0.05,
    faults: Annotated[
        bool, typer.Option("--faults/--no-faults", help="Also simulate late, doubled, corrupted and missing replies.")
    ] = True,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="File for the report; add tested=FILE.json to the device's URL in the machine file."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Test identity, rate, freshness, noise, sign, scale, quality bits and bad replies of a device; exit code 1 if a check failed."""
    import asyncio
    import json

    from abbe.drivers.conformance.checks import Move
    from abbe.drivers.conformance.device_test import Options, device_test, summary
    from abbe.service.cli.running import person_at_console
    from abbe.service.clock import SystemClock
    from abbe.service.errors import ConfigError
    from abbe.service.files import write_page

    if move and not 0.0 < tolerance < 0.2 * abs(move):
        raise ConfigError(f"--tolerance {tolerance:g} does not fit --move {move:g}", "give more than 0 and less than a fifth of the motion")
    options = Options(role, Move(move, tolerance) if move else None, person_at_console() if move else None, faults)
    report = asyncio.run(device_test(url, options, SystemClock().utc().isoformat()))
    if out is not None:
        write_page(json.dumps(report.to_document(), indent=2) + "\n", out)
    lines = [f"{report.kind}: {report.model} {report.serial_no}".rstrip()]
    lines += [f"{one.verdict:10} {one.check}: {one.text}" for one in report.findings]
    lines += [summary(report), *([] if out is None else [f"report: {out}"])]
    answer(report.to_document(), *lines, as_json=as_json)
    again = [f"--role {role}"] if role != "laser" else []
    again += [f"--move {move:g} --tolerance {tolerance:g}"] if move else []
    again += [] if faults else ["--no-faults"]
    again += [] if out is None else [f"--out {quote(str(out))}"]
    conclude(" ".join(["abbe device test", quote(url), *again]) if report.failed else "abbe doctor", as_json=as_json)
    raise typer.Exit(1 if report.failed else 0)
