"""The remote fixture (docs/protocols/fixture.md): mounts bar and mirror on request, by JSON lines over TCP."""

import asyncio
import json
import math
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.cnc.log import Command, TableAccess
from abbe.simulators.scenario import AXES
from abbe.simulators.world import World

Answer = dict[str, Any]
MAX_RADIUS_MM = 2000.0


class FixtureError(ValueError):
    """An impossible request; the client gets the message."""


class Box(Protocol):
    """Access for tests only: logs of commands and samples, and the cable of the ball-bar's box."""

    def ledger(self) -> Answer:
        """Return the numbers of samples sent and dropped since the last START, and the fates of all samples."""
        ...

    def commands(self) -> list[Command]:
        """Return all commands to the controller so far."""
        ...

    def table_accesses(self) -> list[TableAccess]:
        """Return every attempt to change the controller's tables so far."""
        ...

    async def unplug(self) -> None:
        """Pull the cable."""
        ...

    async def plug(self) -> str:
        """Put the cable back and return the URL."""
        ...


class Fixture:
    """Serves requests one line at a time. ``advance`` brings the world up to date before each."""

    def __init__(self, world: World, box: Box, advance: Callable[[], None]) -> None:
        self._world, self._box, self._advance = world, box, advance
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._ops: dict[str, Callable[[Answer], Awaitable[Answer]]] = {
            "identify": self._identify,
            "mount_ballbar": self._mount_ballbar,
            "take_out_ballbar": self._take_out_ballbar,
            "change_ballbar": self._change_ballbar,
            "mount_laser": self._mount_laser,
            "mount_artefact": self._mount_artefact,
            "unmount": self._unmount,
            "estop": self._estop,
            "door": self._door,
            "beam": self._beam,
            "switch": self._switched,
            "reset": self._reset,
            "bar_out": self._bar_out,
            "commands": self._commands,
            "tables": self._tables,
            "drift": self._drift,
            "air": self._air,
            "program": self._program,
            "unplug_ballbar": self._unplug,
            "plug_ballbar": self._plug,
            "ledger": self._ledger,
            "touches": self._touches,
            "plate": self._plate,
        }

    async def start(self, port: int) -> int:
        """Listen on 127.0.0.1 and return the port."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", port)
        return int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Close the listener and its connections."""
        if self._server is not None:
            self._server.close()
        for writer in tuple(self._writers):
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            while line := await reader.readline():
                writer.write(json.dumps(await self.answer(line)).encode() + b"\n")
                await writer.drain()
        except (ConnectionError, ValueError):  # the client has gone, or its line is too long
            pass
        finally:
            self._writers.discard(writer)
            writer.close()

    async def answer(self, line: bytes) -> Answer:
        """Answer one request line."""
        request: Any = None
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise FixtureError("a JSON object is expected")
            operation = self._ops.get(str(request.get("op")))
            if operation is None:
                raise FixtureError(f"unknown op: {request.get('op')}")
            self._advance()
            extra = await operation(request)
        except (FixtureError, json.JSONDecodeError, UnicodeDecodeError) as exc:
            number = request.get("id") if isinstance(request, dict) else None
            return {"id": number, "ok": False, "error": str(exc)}
        return {"id": request.get("id"), "ok": True, "time_us": round(self._world.time_s * 1e6), **extra}

    # ---- requests for everybody ----------------------------------------------------------------------------------

    async def _identify(self, request: Answer) -> Answer:
        return {"name": "Abbe simulator"}

    async def _mount_ballbar(self, request: Answer) -> Answer:
        radius_mm = _number(request, "radius_mm")
        if not 0.0 < radius_mm <= MAX_RADIUS_MM:
            raise FixtureError("radius_mm is out of range")
        self._world.ballbar.mount(radius_mm, self._standing(), self._world.time_s)
        return {}

    async def _take_out_ballbar(self, request: Answer) -> Answer:
        self._standing()
        if not self._world.ballbar.take_out():
            raise FixtureError("no cup stands here")
        return {}

    async def _change_ballbar(self, request: Answer) -> Answer:
        radius_mm = _number(request, "radius_mm")
        if not 0.0 < radius_mm <= MAX_RADIUS_MM:
            raise FixtureError("radius_mm is out of range")
        self._standing()
        if not self._world.ballbar.change(radius_mm, self._world.time_s):
            raise FixtureError("no cup stands here")
        return {}

    async def _mount_laser(self, request: Answer) -> Answer:
        beam = request.get("beam")
        if not isinstance(beam, list) or len(beam) != 3 or not all(_is_number(v) for v in beam):
            raise FixtureError("beam: three numbers are expected")
        direction = np.array(beam, dtype=np.float64)
        if not 0.9 < float(np.linalg.norm(direction)) < 1.1:
            raise FixtureError("beam is not a unit vector")
        self._world.laser.mount(direction, self._standing())
        return {}

    async def _mount_artefact(self, request: Answer) -> Answer:
        self._standing()
        origin, matrix = _numbers(request, "origin_mm", (3,)), _numbers(request, "matrix", (3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6 or np.linalg.det(matrix) < 0.0:
            raise FixtureError("matrix is not a rotation")
        self._world.table.mount(origin, matrix, self._world.time_s)
        return {}

    async def _unmount(self, request: Answer) -> Answer:
        self._world.table.unmount()
        self._world.ballbar.unmount()
        self._world.laser.unmount()
        return {}

    def _standing(self) -> Any:
        """Return the tool position; refused while the machine moves."""
        if self._world.controller.moving:
            raise FixtureError("the machine is moving")
        return self._world.tool_position()

    # ---- for tests only ------------------------------------------------------------------------------------------

    async def _estop(self, request: Answer) -> Answer:
        self._world.controller.set_estop(pressed=_switch(request, "on"))
        return {}

    async def _door(self, request: Answer) -> Answer:
        self._world.controller.set_door(is_open=_switch(request, "on"))
        return {}

    async def _beam(self, request: Answer) -> Answer:
        self._world.laser.block(blocked=_switch(request, "blocked"))
        return {}

    async def _switched(self, request: Answer) -> Answer:
        controller, name, on = self._world.controller, request.get("name"), _switch(request, "on")
        if name == "remote":
            controller.switches.remote = on
        elif name == "program":
            controller.switches.program_running = on
        elif name == "alarm" and on:
            controller.raise_alarm()
        elif name == "drives" and not on:
            controller.drives_off()
        else:
            raise FixtureError("name: expected remote, program, alarm (only on) or drives (only off)")
        return {}

    async def _reset(self, request: Answer) -> Answer:
        """Do what the operator does at the panel: release all switches, reset the alarm, switch the drives on."""
        controller = self._world.controller
        controller.set_estop(pressed=False)
        controller.set_door(is_open=False)
        controller.switches.remote, controller.switches.program_running = True, False
        controller.reset_alarm()
        return {}

    async def _bar_out(self, request: Answer) -> Answer:
        self._world.ballbar.push(out=_switch(request, "on"))
        return {}

    async def _commands(self, request: Answer) -> Answer:
        log = self._box.commands()
        return {"commands": [[c.time_s, c.kind, list(c.args), c.moving] for c in log]}

    async def _tables(self, request: Answer) -> Answer:
        """Return the log of attempts to change banks, active table or lease, from entry ``since`` on."""
        since = request.get("since", 0)
        if not isinstance(since, int) or since < 0:
            raise FixtureError("since: 0 or the number of an entry is expected")
        found = self._box.table_accesses()[since:]
        return {"accesses": [[a.time_s, a.kind, a.bank, a.first, list(a.words), a.by, a.taken, a.owner, a.active, a.gen] for a in found]}

    async def _air(self, request: Answer) -> Answer:
        """Make the air warmer by ``plus_c`` K from now on, as an open shop gate does."""
        self._world.warm_air(_number(request, "plus_c"))
        return {}

    async def _program(self, request: Answer) -> Answer:
        """Start an NC program as the operator does: ``blocks`` of ["go", x, y, z, feed in mm/min] and ["rest", seconds]."""
        controller = self._world.controller
        here, blocks = controller.position_mm, []
        for block in request.get("blocks") or []:
            numbers = [float(v) for v in block[1:]]
            place = np.array(numbers[:3]) if block[0] == "go" else here
            seconds = float(np.linalg.norm(place - here)) / (numbers[3] / 60.0) if block[0] == "go" else numbers[0]
            blocks.append((place, seconds))
            here = place
        result = controller.run_program(blocks) if blocks else None
        if not blocks or result != 0:
            raise FixtureError(f"the program cannot be started: {result!r}")
        return {"seconds": sum(seconds for _, seconds in blocks)}

    async def _drift(self, request: Answer) -> Answer:
        axis = request.get("axis")
        if axis not in AXES:
            raise FixtureError("axis: X, Y or Z is expected")
        self._world.add_scale(AXES.index(axis), _number(request, "um_per_m") * 1e-6)
        return {}

    async def _touches(self, request: Answer) -> Answer:
        """Let the next touches go wrong: ``false`` trips in the air, ``missed`` contacts."""
        stylus = self._world.table.stylus
        stylus.false_trips, stylus.missed = int(request.get("false", 0)), int(request.get("missed", 0))
        return {"broken": stylus.broken}

    async def _plate(self, request: Answer) -> Answer:
        """Let the plate slip by ``moved_mm``, or the next mounting be wrong by so many ``quarters`` of a turn."""
        if "moved_mm" in request:
            self._world.table.move(_numbers(request, "moved_mm", (3,)))
        self._world.table.quarters = int(request.get("quarters", self._world.table.quarters))
        return {}

    async def _unplug(self, request: Answer) -> Answer:
        await self._box.unplug()
        return {}

    async def _plug(self, request: Answer) -> Answer:
        return {"ballbar": await self._box.plug()}

    async def _ledger(self, request: Answer) -> Answer:
        return {**self._box.ledger(), "sim_time_s": self._world.time_s}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(request: Answer, key: str) -> float:
    value = request.get(key)
    if not _is_number(value):
        raise FixtureError(f"{key}: a number is expected")
    return float(value)  # type: ignore[arg-type]


def _numbers(request: Answer, key: str, shape: tuple[int, ...]) -> F:
    try:
        found = np.array(request.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != shape or not np.isfinite(found).all():
        raise FixtureError(f"{key}: {' x '.join(map(str, shape))} numbers are expected")
    return found


def _switch(request: Answer, key: str) -> bool:
    value = request.get(key)
    if not isinstance(value, bool):
        raise FixtureError(f"{key}: true or false is expected")
    return value
