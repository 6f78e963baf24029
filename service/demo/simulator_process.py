"""The simulated outside world as a child process: started, watched, and gone when we are gone.

The product never imports the simulators: it starts them as a program, reads one line of JSON that says where the devices are, and talks to
them over the wire like to any other device.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from abbe.drivers.links.shielded import run_to_end
from abbe.service.children import python_words
from abbe.service.errors import AbbeError

READY_S = 30.0
STOP_S = 3.0


class SimulatorError(AbbeError):
    """The simulator process could not be started or answered nonsense."""

    code = "SIM-001"


@dataclass(frozen=True, slots=True)
class SimulatorProcess:
    """A running simulated machine: what its ready line said."""

    ready: dict[str, Any]
    pid: int


@asynccontextmanager
async def running_simulators(args: list[str]) -> AsyncIterator[SimulatorProcess]:
    """Start the simulators with these arguments; end them with the block, whatever ends it.

    The child also ends by itself when its standard input closes, so that not even SIGKILL of this process leaves one behind.

    Raises
    ------
    SimulatorError
        It did not start; the child's own line says why.
    """
    process = await asyncio.create_subprocess_exec(
        *python_words("abbe.simulators", *args, "--watch-stdin"),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C at the terminal is for us: we stop the machine first, then the world
    )
    try:
        yield SimulatorProcess(await _ready(process), process.pid)
    finally:
        await run_to_end(_end(process))


async def _ready(process: asyncio.subprocess.Process) -> dict[str, Any]:
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        async with asyncio.timeout(READY_S):
            line = await process.stdout.readline()
    except TimeoutError:
        raise SimulatorError(f"the simulators were not ready within {READY_S:g} s", "is the machine overloaded?") from None
    try:
        ready: dict[str, Any] = json.loads(line)
    except ValueError:
        errors = (await process.stderr.read(2000)).decode(errors="replace").strip().splitlines()
        raise SimulatorError(f"the simulators did not start: {errors[-1] if errors else 'no reason given'}", "check the scenario") from None
    return ready


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.stdin is not None:
        process.stdin.close()
    if process.returncode is None:
        process.terminate()
        try:
            async with asyncio.timeout(STOP_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
    # closes the pipes' transports here and now instead of when the garbage collector finds them
    transport = getattr(process, "_transport", None)
    if transport is not None:
        transport.close()


async def sealed_truth(args: list[str], bank: Path | None) -> dict[str, Any]:
    """Ask the simulators' own evaluation what the machine really does, without and with a table. For demonstrations only.

    Raises
    ------
    SimulatorError
        It failed; the child's own line says why.
    """
    command = python_words("abbe.simulators", "truth", *args, "--arrows")
    if bank is not None:
        command += ["--bank", str(bank)]
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, start_new_session=True
    )
    try:
        out, err = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
            await run_to_end(process.wait())
    if process.returncode != 0:
        raise SimulatorError(f"the simulators' truth command failed: {err.decode(errors='replace').strip()}")
    truth: dict[str, Any] = json.loads(out)
    return truth
