"""The site: the simulated world with its devices on serial lines and TCP ports, kept in step with wall time."""

import asyncio
import secrets
from dataclasses import asdict
from pathlib import Path
from typing import Any

from abbe.simulators.ballbar.port import PtyPort, TcpPort
from abbe.simulators.ballbar.wire import BallbarWire
from abbe.simulators.cnc.log import Command, TableAccess
from abbe.simulators.cnc.wire import CncRegisters
from abbe.simulators.fixture import Fixture
from abbe.simulators.laser.wire import LaserRegisters
from abbe.simulators.modbus_wire import ModbusRtu, ModbusTcp, RegisterMap
from abbe.simulators.pseudo_serial import PseudoSerial
from abbe.simulators.scenario import Scenario
from abbe.simulators.world import LASER_CLOCK_US, World

BAUD = 115200


class RtuLine:
    """A Modbus RTU device at a path. pymodbus opens a terminal by name, so device and host each get a pseudo terminal, joined here."""

    def __init__(self, registers: RegisterMap, link: Path | None) -> None:
        self._server = ModbusRtu(registers)
        self._link = link
        self._host: PseudoSerial | None = None
        self._device: PseudoSerial | None = None

    async def start(self) -> str:
        """Open both terminals, serve the device, and return the URL."""
        host = self._host = PseudoSerial(self._to_device, self._link)
        self._device = PseudoSerial(host.send)
        await self._server.start(self._device.path, BAUD)
        return f"modbus+rtu://{host.path}?baud={BAUD}&unit=1"

    async def stop(self) -> None:
        """Hang up."""
        await self._server.stop()
        for terminal in (self._host, self._device):
            if terminal is not None:
                terminal.close()

    def _to_device(self, data: bytes) -> None:
        if self._device is not None:
            self._device.send(data)


TICK_S = 0.005
REST_S = 0.2
"""Time between two ticks while nothing streams or is buffered. This suffices because every request brings the world up to date."""
AHEAD_S, AHEAD_SAMPLES = 10.0, 2000
"""How far a world faster than real time may run ahead of a host that polls the controller: s of simulated time, samples."""
WAITS_S = 0.5
"""Longest wait for the next poll, s of wall time; after a second without samples the host would report a silent box."""
BALLBAR_LINK, LASER_LINK = "ballbar", "laser"


class Site:
    """All connections of one simulated world. Simulated time = speed x wall time since ``start``.

    A world that is faster than real time waits for a host that polls the controller while samples stream: `AHEAD_S` after a
    poll it stops until the next poll, or for `WAITS_S` of wall time. Otherwise, at 60 times real time, a host that gets no core for 0.4 s
    would be 24 s late.
    """

    def __init__(self, scenario: Scenario, link_dir: Path | None = None) -> None:
        self.world = World(scenario)
        self._scenario = scenario
        self._last_s = self._at_s = self._heard_s = 0.0
        self._asked_s: float | None = None
        self._ticking: asyncio.Handle | None = None
        self._resting = False
        self._links = link_dir
        port: PtyPort | TcpPort = (
            PtyPort(self._link(BALLBAR_LINK)) if scenario.ballbar.transport == "pty" else TcpPort(scenario.ballbar.port)
        )
        self._port = port
        self._plugged = False
        self.box = BallbarWire(self.world.ballbar, port, secrets.randbits(32), lambda: self.world.time_s)
        self.registers = cnc = CncRegisters(self.world.controller, scenario.boot_id or secrets.randbits(32), self._asked)
        laser = LaserRegisters(
            self.world.laser, secrets.randbits(32), self.advance, self.world.tool_position, clock_offset_us=LASER_CLOCK_US
        )
        self._cnc = ModbusTcp(cnc)
        self._laser: ModbusTcp | RtuLine = ModbusTcp(laser) if scenario.laser.transport == "tcp" else RtuLine(laser, self._link(LASER_LINK))
        self._fixture = Fixture(self.world, self, self.advance)

    def _link(self, name: str) -> Path | None:
        return None if self._links is None else self._links / name

    async def start(self) -> dict[str, Any]:
        """Open all connections and return their addresses for a host. Raises OSError if a port is in use."""
        self._last_s = asyncio.get_running_loop().time()
        scenario = self._scenario
        if self._links is not None:
            self._links.mkdir(parents=True, exist_ok=True)
        urls = {"ballbar": await self.plug()}
        if isinstance(self._laser, ModbusTcp):
            urls["laser"] = f"modbus+tcp://127.0.0.1:{await self._laser.start(scenario.laser.port)}?unit=1"
        else:
            urls["laser"] = await self._laser.start()
        urls["cnc"] = f"modbus+tcp://127.0.0.1:{await self._cnc.start(scenario.cnc.port)}?unit=1"
        urls["fixture"] = f"fixture+tcp://127.0.0.1:{await self._fixture.start(scenario.fixture.port)}"
        self._tick()
        known = self.world.table.body.document(1e-3 * scenario.artefact.u_length_um)
        return {"ready": True, **urls, "speed": scenario.speed, "machine": asdict(scenario.machine), "artefact": known}

    async def stop(self) -> None:
        """Close all lines and ports, and remove the stable paths."""
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None
        await self._port.close()
        await self._fixture.stop()
        await self._laser.stop()
        await self._cnc.stop()

    def advance(self) -> None:
        """Bring the world up to wall time. Called before every request; a tick follows at once, because the request may start a motion."""
        self._advance()
        if self._resting and self._ticking is not None:
            self._ticking.cancel()
            self._ticking = asyncio.get_running_loop().call_soon(self._tick)
            self._resting = False

    def _asked(self) -> None:
        """Bring the world up to date because the host asks the controller; note the time."""
        self.advance()
        self._asked_s, self._heard_s = self._at_s, self._last_s

    def _advance(self) -> None:
        now_s, rate_hz = asyncio.get_running_loop().time(), self.world.ballbar.rate_hz
        due_s = self._at_s + self._scenario.speed * (now_s - self._last_s)
        if not (rate_hz and self._cnc.connected):
            self._asked_s = None
        elif self._asked_s is not None and self._scenario.speed > 1.0:
            due_s = min(due_s, max(self._at_s, self._asked_s + min(AHEAD_S, AHEAD_SAMPLES / rate_hz)))
            if now_s - self._heard_s > WAITS_S:
                self._asked_s = None
        self._last_s, self._at_s = now_s, due_s
        self.world.advance(due_s)

    def _tick(self) -> None:
        """Advance the world, send the samples that are due, and schedule the next tick."""
        self._advance()
        self.box.flush()
        self._port.pump()
        self._resting = not (self.world.ballbar.rate_hz or self._port.backlog)
        self._ticking = asyncio.get_running_loop().call_later(REST_S if self._resting else TICK_S, self._tick)

    def _received(self, data: bytes) -> None:
        self.advance()
        self.box.received(data)

    # ---- the cable of the ball-bar's box -------------------------------------------------------------------------

    async def unplug(self) -> None:
        """Pull the cable: the line closes, and the box, which the cable powers, restarts."""
        if self._plugged:
            self._plugged = False
            await self._port.close()
            self.box.restart(secrets.randbits(32))

    async def plug(self) -> str:
        """Put the cable in and return the URL."""
        if not self._plugged:
            await self._port.open(self._received)
            self._plugged = True
        return self._port.url

    def commands(self) -> list[Command]:
        """Return all commands to the controller so far."""
        return self.registers.log

    def table_accesses(self) -> list[TableAccess]:
        """Return every attempt to change the controller's tables so far."""
        return self.registers.table_log

    def ledger(self) -> dict[str, Any]:
        """Return the numbers of samples sent and dropped since the last START, and the ``fates`` of all samples (see `BoxLedger`)."""
        self.box.flush()
        return {"samples_sent": self.box.samples_sent, "samples_dropped": self.box.samples_dropped, "fates": self.box.ledger.runs}
