#!/usr/bin/python3
"""Put the register map of docs/protocols/cnc.md in front of a running LinuxCNC.

The bridge runs in the control's own Python, which has the modules ``linuxcnc`` and ``hal``. It needs no others, and ends with the control.
Run ``bridge.py --prepare RUNDIR`` before the control starts: this makes sure that the control finds tables to read.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import secrets
import socket
import sys
from pathlib import Path

from banks import Banks
from files import TablesAltered, TableSets
from modbus import serve
from motion import Motion
from registers import Clock, RegisterMap

BUSY_S, IDLE_S = 0.002, 0.02
START_S = 60.0


def main() -> None:
    """Parse the command line, then prepare or serve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prepare", metavar="RUNDIR", type=Path, help="make tables for the control's start, then end")
    parser.add_argument("--rundir", type=Path, default=Path.cwd(), help="where the tables and the path program lie")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; $ABBE_LISTEN_FD hands over a listening socket instead")
    parser.add_argument("--port", type=int, default=15021)
    options = parser.parse_args()
    try:
        if options.prepare:
            TableSets(options.prepare.resolve()).prepare()
        else:
            asyncio.run(run(options.rundir.resolve(), _listening(options.host, options.port)))
    except KeyboardInterrupt:
        sys.exit(0)  # the control unloads what it has not loaded with this signal
    except (TablesAltered, OSError, RuntimeError, TimeoutError) as error:
        sys.exit(f"abbe bridge: {error}")


def _listening(host: str, port: int) -> socket.socket:
    handed = os.environ.get("ABBE_LISTEN_FD")
    if handed:
        return socket.socket(fileno=int(handed))
    return socket.create_server((host, port))


async def run(rundir: Path, listening: socket.socket) -> None:
    """Wait for the control, then serve until it ends."""
    from control import ControlGone  # here, because "--prepare" has no control yet

    clock = Clock()
    control = await _control()
    motion = Motion(control, clock.microseconds, rundir / "abbe_path.ngc")
    while not motion.state.ready:  # a bridge that was started anew exchanges no table under a machine that moves
        await asyncio.sleep(IDLE_S)
        motion.tick()
    sets = TableSets(rundir)
    banks = Banks(control, sets, sets.acting(fresh_start=not control.seen()))
    server = await serve(RegisterMap(motion, banks, clock, secrets.randbits(32) | 1), listening)
    _say(f"ready on {server.sockets[0].getsockname()}")
    try:
        while True:
            motion.tick()
            for complaint in control.complaints():
                _say(f"LinuxCNC says: {complaint}")
            await asyncio.sleep(BUSY_S if motion.moving else IDLE_S)
    except ControlGone as error:
        _say(f"the control has ended: {error}")


async def _control() -> object:
    from control import Control, ControlGone

    async with asyncio.timeout(START_S):
        while True:
            try:
                return Control()
            except (ControlGone, RuntimeError) as error:
                reason = error
            await asyncio.sleep(0.1)
            _say(f"waiting for the control: {reason}")


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
