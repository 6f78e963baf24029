"""``python -m abbe.simulators`` runs the simulated devices; ``truth`` prints the true errors, ``hidden-suite`` writes sealed cases."""

import argparse
import asyncio
import dataclasses
import json
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from abbe.simulators import scenario as scenarios
from abbe.simulators.scenario import Scenario, ScenarioError


def _complaint(text: str) -> str:
    """One line of error as every command writes it: code, what is wrong, what to do."""
    return f"error USE-001: {' '.join(text.split())} - correct this option or the scenario file; `abbe sim --help` lists the options\n"


class _Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, _complaint(f"{self.prog}: {message}"))


def _parser(prog: str, what: str) -> _Parser:
    parser = _Parser(prog=prog, description=what)
    parser.add_argument("scenario", nargs="?", type=Path, default=scenarios.DEFAULT_PATH, help="TOML file (default: the packaged vmc.toml)")
    parser.add_argument("--seed", type=int, help="seed of the machine's random errors")
    parser.add_argument("--hidden", type=int, metavar="SEED", help="let this seed choose the scenario; it may hide a physical effect")
    return parser


def _scenario(options: argparse.Namespace) -> Scenario:
    """Return the scenario that the command line names, or the one that its ``--hidden`` seed picks."""
    if options.hidden is None:
        return scenarios.load(options.scenario)
    from abbe.simulators.hidden.suite import picked

    scenario = picked(options.hidden)
    scenarios.check(scenario)
    return scenario


def main(argv: Sequence[str]) -> int:
    """Run the command line and return its exit code."""
    try:
        if argv[:1] == ["hidden-suite"]:
            from abbe.simulators.hidden.suite import main as hidden_suite

            return hidden_suite(argv[1:])
        return _truth(argv[1:]) if argv[:1] == ["truth"] else _serve(argv)
    except (ScenarioError, OSError) as exc:
        sys.stderr.write(_complaint(f"simulators: {exc}"))
        return 2


def _serve(argv: Sequence[str]) -> int:
    parser = _parser(
        "simulators", "Simulated machine tool with ball-bar, laser, controller and fixture on serial lines and TCP ports of 127.0.0.1."
    )
    parser.add_argument("--speed", type=float, help="simulated seconds per second")
    parser.add_argument("--boot-id", type=int, help="boot id of the controller (default: a new one at each start)")
    parser.add_argument("--link-dir", type=Path, help="directory for stable links to the serial lines")
    parser.add_argument("--watch-stdin", action="store_true", help="end when standard input ends")
    parser.add_argument("--ballbar", choices=("pty", "tcp"), help="transport of the ball-bar")
    parser.add_argument("--laser", choices=("tcp", "rtu"), help="transport of the laser")
    for device in ("ballbar", "laser", "cnc", "fixture"):
        parser.add_argument(f"--{device}-port", type=int, help=f"TCP port of the {device} (0 = any)")
    options = parser.parse_args(argv)
    return asyncio.run(_run(_overridden(_scenario(options), options), options.link_dir, watch=options.watch_stdin))


def _overridden(scenario: Scenario, options: argparse.Namespace) -> Scenario:
    """Return the scenario with the options of the command line applied."""
    changes: dict[str, Any] = {}
    for name in ("seed", "speed", "boot_id"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    for device in ("ballbar", "laser", "cnc", "fixture"):
        given = {"transport": getattr(options, device, None), "port": getattr(options, f"{device}_port")}
        changes[device] = dataclasses.replace(getattr(scenario, device), **{k: v for k, v in given.items() if v is not None})
    result = dataclasses.replace(scenario, **changes)
    scenarios.check(result)
    return result


async def _run(scenario: Scenario, link_dir: Path | None, *, watch: bool) -> int:
    from abbe.simulators.site import Site

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    if watch:
        threading.Thread(target=_watch_stdin, args=(loop, stop), daemon=True).start()
    site = Site(scenario, link_dir)
    try:
        sys.stdout.write(json.dumps(await site.start()) + "\n")
        sys.stdout.flush()
        await stop.wait()
    finally:
        await site.stop()
    return 0


def _watch_stdin(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    """Set ``stop`` at the end of standard input: the parent process has gone."""
    while os.read(0, 4096):
        pass
    loop.call_soon_threadsafe(stop.set)


def _truth(argv: Sequence[str]) -> int:
    from abbe.simulators.sealed import truth

    parser = _parser("simulators truth", "The machine's true volumetric errors, with or without a correction.")
    parser.add_argument("--bank", type=Path, help="compensation image (docs/protocols/cnc.md), big-endian words (default: no correction)")
    parser.add_argument("--nodes", type=int, default=9, help="grid nodes per axis")
    parser.add_argument("--arrows", action="store_true", help="add grid and deviation vectors")
    parser.add_argument("--plane", type=float, nargs=5, metavar=("X0", "X1", "Y0", "Y1", "Z"), help="add the rms in this plane, mm")
    parser.add_argument("--inside-mm", type=float, default=0.0, help="distance of the body diagonals from the stroke ends (default: 0)")
    options = parser.parse_args(argv)
    scenario = _scenario(options)
    if options.seed is not None:
        scenario = dataclasses.replace(scenario, seed=options.seed)
        scenarios.check(scenario)
    if options.nodes < 2:
        parser.error("--nodes must be at least 2")
    image = None if options.bank is None else options.bank.read_bytes()
    found = truth(scenario, image, options.nodes, arrows=options.arrows, plane=options.plane, inside_mm=options.inside_mm)
    sys.stdout.write(json.dumps(found) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
