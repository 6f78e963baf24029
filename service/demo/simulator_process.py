"""The simulators as a child process that never outlives this process.

The product never imports the simulators: it starts them as a program, reads one line of JSON with the addresses of the devices, and talks
to them as to any other device.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from abbe.drivers.errors import run_to_end
from abbe.models.machine import Machine
from abbe.service.children import python_command
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.document import Doc, parsed, record
from abbe.service.domain.machine import DeviceUrls, machine_from_doc
from abbe.service.domain.run import Matrix
from abbe.service.errors import AbbeError

READY_S = 30.0
STOP_S = 3.0


class SimulatorError(AbbeError):
    """The simulator process did not start, failed, or gave an invalid answer."""

    code = "SIM-001"


@dataclass(frozen=True, slots=True)
class SimulatorProcess:
    """A running simulated machine; ``artefact``: description of the plate on its table."""

    machine: Machine
    urls: DeviceUrls
    artefact: ArtefactObject | None = None

    @classmethod
    def of_line(cls, line: str | bytes) -> Self:
        """Parse the line that the simulators print once they answer. Raises ValueError."""
        ready = parsed(_ReadyLine, json.loads(line))
        urls = DeviceUrls(ready.cnc, ready.ballbar, ready.laser, ready.fixture)
        plate = None if ready.artefact is None else ArtefactObject.read(ready.artefact)
        return cls(machine_from_doc(ready.machine), urls, plate)


@dataclass(frozen=True, slots=True, kw_only=True)
class _ReadyLine:
    """The keys of the line that the simulators print once they answer."""

    machine: Doc
    cnc: str
    ballbar: str
    laser: str
    fixture: str
    artefact: Doc | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenTruth:
    """The effect that a simulated machine hides; ``wild``: seed of its deviation from the formula in the catalogue, 0: none."""

    name: str
    key: str
    parameters: Mapping[str, float]
    wild: int

    @property
    def label(self) -> str:
        """Name and key."""
        return f"{self.name}:{self.key}" if self.key else self.name


@dataclass(frozen=True, slots=True, kw_only=True)
class SealedTruth:
    """True errors of a simulated machine without rigid motion, µm: vectors at the points of a grid; ``plane_rms_um``: rms in the plane
    of an artefact."""

    max_body_diagonal_um: float
    volumetric_rms_um: float
    volumetric_max_um: float
    best_nine_tables_rms_um: float
    grid_mm: Matrix
    deviation_um: Matrix
    plane_rms_um: float | None = None
    hidden: HiddenTruth | None = None


@asynccontextmanager
async def running_simulators(args: list[str]) -> AsyncIterator[SimulatorProcess]:
    """Start the simulators with these arguments and stop them at the end of the block.

    The child also ends when its standard input closes, so that it does not survive even a SIGKILL of this process.

    Raises
    ------
    SimulatorError
        The simulators did not start; the message quotes the child's last line.
    """
    process = await asyncio.create_subprocess_exec(
        *python_command("abbe.simulators", *args, "--watch-stdin"),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,  # Ctrl-C reaches only this process, which stops the axes before the simulators
    )
    try:
        yield await _ready(process)
    finally:
        await run_to_end(_end(process))


async def _ready(process: asyncio.subprocess.Process) -> SimulatorProcess:
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        async with asyncio.timeout(READY_S):
            line = await process.stdout.readline()
    except TimeoutError:
        raise SimulatorError(f"the simulators were not ready within {READY_S:g} s", "this computer may be overloaded: try again") from None
    try:
        return SimulatorProcess.of_line(line)
    except ValueError:
        errors = (await process.stderr.read(2000)).decode(errors="replace").strip().splitlines()
        why = errors[-1].removeprefix("error USE-001: ").partition(" - ")[0] if errors else "no reason given"
        raise SimulatorError(f"the simulators did not start: {why}", "check the scenario") from None


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
    # close the pipes' transports now, not at garbage collection
    transport = getattr(process, "_transport", None)
    if transport is not None:
        transport.close()


async def sealed_truth(args: list[str], bank: Path | None) -> SealedTruth:
    """Read the true errors of the simulated machine, corrected by the table in the file ``bank`` if given. For demonstrations only.

    Raises
    ------
    SimulatorError
        The command failed; the message quotes its output.
    """
    command = python_command("abbe.simulators", "truth", *args, "--arrows")
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
    return record(SealedTruth, json.loads(out), "the simulators' truth")
