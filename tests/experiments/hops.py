"""How many product files a command enters: one hop less is one file less to read for whoever follows it.

    python -m tests.experiments.hops quick-check            # against a simulated machine
    python -m tests.experiments.hops solve FOLDER           # a campaign folder
    python -m tests.experiments.hops push                   # a table into a simulated control; measurements answer at once

A file is entered when a function of it is called after it was loaded (module and class bodies do not count). Prints each file with its
calls, then the sum; ``--edges`` also prints which file calls into which.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("abbe", "service", "drivers", "models")
FUNCTION = 0x1  # CO_OPTIMIZED: set for functions, not for bodies of modules and classes
SPEED = 8.0
"""Slow enough that the watchers hear of the controller in time although every call is counted."""


class Hops:
    """Counts calls from file to file in all threads of this process."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()
        self.edges: Counter[tuple[str, str]] = Counter()
        self._names: dict[CodeType, str | None] = {}
        self._entered: set[CodeType] = set()

    def _file(self, code: CodeType) -> str | None:
        """The product file of a function, relative to the repository; None: another's, or a body."""
        if code not in self._names:
            path = Path(code.co_filename).resolve() if code.co_flags & FUNCTION else ROOT
            inside = path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[:1]
            self._names[code] = str(path.relative_to(ROOT)) if inside and inside[0] in ROOMS else None
        return self._names[code]

    def _seen(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or (name := self._file(frame.f_code)) is None:
            return
        if frame.f_code not in self._entered:
            if _loading(frame):
                return
            self._entered.add(frame.f_code)
        self.calls[name] += 1
        caller = frame.f_back
        before = None if caller is None else self._file(caller.f_code)
        if before is not None and before != name:
            self.edges[before, name] += 1

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count from here to the end of the block."""
        threading.setprofile(self._seen)
        sys.setprofile(self._seen)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)  # type: ignore[arg-type]


def _loading(frame: FrameType) -> bool:
    """Whether a module is being loaded: what it calls for that is not a hop of the command."""
    up: FrameType | None = frame
    while up is not None:
        if up.f_code.co_name == "<module>" and not up.f_code.co_filename.endswith("hops.py") and up.f_globals.get("__name__") != "__main__":
            return True
        up = up.f_back
    return False


def command(*words: str) -> Hops:
    """Run a command of Abbe in this process; gives its hops.

    Raises
    ------
    SystemExit
        It failed.
    """
    from abbe.service.cli import main

    hops, before = Hops(), sys.argv
    sys.argv = ["abbe", *words]
    try:
        with hops.counting():
            main()
    except SystemExit as end:
        if end.code not in (0, None):
            raise
    finally:
        sys.argv = before
    return hops


@contextmanager
def simulated(folder: Path) -> Iterator[Path]:
    """A machine file for a simulated machine that runs beside us."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "abbe.simulators", "--speed", str(SPEED), "--watch-stdin"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        ready = json.loads(process.stdout.readline())
        machine = folder / "machine.toml"
        machine.write_text(machine_text(ready, folder))
        yield machine
    finally:
        process.stdin.close()
        process.wait(10)
        process.stdout.close()


def machine_text(ready: dict[str, Any], folder: Path) -> str:
    """The machine file of a simulated machine that says where its devices are."""
    machine = ready["machine"]
    lines = ['name = "sim"', f'chain = "{machine["chain"]}"', f"tool_mm = {list(machine['tool_mm'])}", "[stroke_mm]"]
    lines += [f"{axis} = {list(machine['stroke_mm'][axis])}" for axis in "XYZ"]
    lines += ["[devices]", *(f'{role} = "{ready[role]}"' for role in ("ballbar", "laser", "cnc", "fixture"))]
    return "\n".join([*lines, "[store]", f'url = "sqlite:///{folder / "abbe.sqlite3"}"']) + "\n"


def quick_check() -> Hops:
    """`abbe measure --recipe quick-check` against a simulated machine."""
    with tempfile.TemporaryDirectory() as folder, simulated(Path(folder)) as machine:
        return command("measure", "-m", str(machine), "--recipe", "quick-check", "--name", "hops")


def solve(folder: str) -> Hops:
    """`abbe solve FOLDER`."""
    return command("solve", folder, "--json")


def push() -> Hops:
    """A push that nobody attends, from the job's side of the push machine to the wire and back; probe and verification answer at once."""
    from abbe.models.compensation.tables import NineTables
    from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
    from abbe.service.config import load_machine
    from abbe.service.devices.session import DeviceUrls, open_session
    from abbe.service.push.operations import VerificationResult
    from abbe.service.site import site_of
    from abbe.service.storage.store import Store
    from abbe.service.tables.nine_tables import read_base

    async def yes() -> VerificationResult:
        return VerificationResult(True, "a stand-in")

    async def work(machine: Path, hops: Hops) -> None:
        site = site_of(load_machine(machine).machine)
        x, y, z = (np.linspace(*stroke, 9) for stroke in site.machine.stroke_mm)
        rising, none = np.linspace(0.0, 0.004, 9)[:, None] * np.ones(3), np.zeros((9, 3))
        tables = NineTables((x, y, z), (rising, rising, rising), (none, none, none))
        with Store.open(f"sqlite:///{machine.with_name('push.sqlite3')}") as store:
            async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
                wanted = WantedTable(tables, await read_base(session.controller), 100, None, {})
                pushing = Pushing(session.controller, store, site, level=3, attended=False)
                with hops.counting():
                    await pushing.bring(wanted, Questions(list, "an experiment", yes, yes))

    with tempfile.TemporaryDirectory() as folder, simulated(Path(folder)) as machine:
        hops = Hops()
        asyncio.run(work(machine, hops))
        return hops


PATHS: dict[str, Callable[..., Hops]] = {"quick-check": quick_check, "solve": solve, "push": push}


def main() -> None:
    """Count one command and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.experiments.hops", description=__doc__)
    parser.add_argument("path", choices=PATHS)
    parser.add_argument("words", nargs="*", help="what the command needs: the campaign folder")
    parser.add_argument("--edges", action="store_true")
    options = parser.parse_args()
    hops = PATHS[options.path](*options.words)
    out = sys.stdout
    if options.edges:
        out.writelines(f"{n:9}  {a} -> {b}\n" for (a, b), n in sorted(hops.edges.items()))
    out.writelines(f"{n:9}  {name}\n" for name, n in sorted(hops.calls.items()))
    out.write(f"{len(hops.calls)} product files, {len(hops.edges)} edges\n")


if __name__ == "__main__":
    main()
