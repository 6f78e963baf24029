"""Controller and laser of the simulators on lines that can be disturbed, the drivers at the other end, and the requests that they make."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.errors import DriverError
from abbe.drivers.laser.driver import ModbusLaser
from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, parse_url
from abbe.simulators.cnc.wire import CncRegisters
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.rtu_toxic import ToxicRtuLine
from abbe.simulators.faults.scenario import FaultScenario
from abbe.simulators.laser.wire import LaserRegisters
from abbe.simulators.modbus_wire import ModbusTcp, RegisterMap
from abbe.simulators.scenario import Scenario
from abbe.simulators.world import World
from tests.faults.contract import Observed, Record, told_of
from tests.patience import within

SPEED = 60.0
TIMEOUT_S = 0.3  # by the patient clock: a busy computer must not look like a silent device
OWNER = 0xABBE0006
TARGET = (310.0, 245.0, 205.0)
PATH = [(300.0 + i, 250.0, 200.0) for i in range(30)]
IMAGE = struct.pack(">200H", *range(200))
MOTION, COMP, ACTIVATE = 64, 230, 2
STARTS = (1, 3)


class Watched:
    """A register map that notes when it executed which command, and may show other words than it holds."""

    def __init__(self, registers: RegisterMap, acknowledge: Callable[[], tuple[int, int]]) -> None:
        self._registers, self._acknowledge = registers, acknowledge
        self.size = registers.size
        self.commands: list[tuple[float, int, int]] = []
        """Monotonic time, address and command of everything that was executed."""
        self.shown: dict[int, int] = {}
        self.reorder: Callable[[int, list[int]], list[int]] = lambda address, words: words

    def read(self, address: int, count: int) -> list[int] | None:
        words = self._registers.read(address, count)
        if words is None:
            return None
        return self.reorder(address, [self.shown.get(address + i, word) for i, word in enumerate(words)])

    def write(self, address: int, values: list[int]) -> bool:
        before = self._acknowledge()
        taken = self._registers.write(address, values)
        if taken and self._acknowledge() != before and len(values) > 1:
            self.commands.append((time.monotonic(), address, values[1]))
        return taken

    def dangerous_after(self, when_s: float) -> int:
        """Executed commands that start a motion or change the active bank, after an instant."""
        return sum(
            at > when_s and ((address == MOTION and command in STARTS) or (address == COMP and command == ACTIVATE))
            for at, address, command in self.commands
        )


@dataclass
class Rig:
    """One device, its line and its driver. ``line.play`` disturbs it."""

    world: World
    registers: Watched
    line: ModbusProxy | ToxicRtuLine
    link: ModbusLink
    device: ModbusController | ModbusLaser

    @property
    def cnc(self) -> ModbusController:
        assert isinstance(self.device, ModbusController)
        return self.device

    @property
    def laser(self) -> ModbusLaser:
        assert isinstance(self.device, ModbusLaser)
        return self.device


@dataclass(frozen=True)
class Kind:
    """A request that the drivers make.

    ``sort`` and ``at``: which of the requests of ``run`` it is; ``right``: whether the answer is true; ``repeated``: the link asks again.
    """

    device: str
    sort: str
    at: int
    run: Callable[[Rig], Awaitable[Any]]
    right: Callable[[Rig, Any], bool]
    repeated: bool = False

    def nth(self, rig: Rig) -> int:
        """Number of the request among those of its sort; on RTU every answer is followed by a read of the canary."""
        rtu = isinstance(rig.line, ToxicRtuLine)
        return 2 * self.at if rtu and self.sort == "read" else self.at


def _position(rig: Rig) -> tuple[float, ...]:
    return tuple(round(float(p), 4) for p in rig.world.controller.position_mm)


async def _moved(rig: Rig) -> Any:
    return await rig.cnc.move(TARGET, feed_mm_min=60000.0, timeout_s=20.0)


KINDS: dict[str, Kind] = {
    "identity": Kind("cnc", "read", 0, lambda r: r.cnc.identify(), lambda r, a: a.boot_id == 0xCAFE0002, repeated=True),
    "status": Kind("cnc", "read", 0, lambda r: r.cnc.status(), lambda r, a: a.position_mm == _position(r), repeated=True),
    "compensation status": Kind(
        "cnc", "read", 1, lambda r: r.cnc.comp_status(), lambda r, a: a.bank_crc == tuple(r.world.controller.comp.crcs), repeated=True
    ),
    "bank read": Kind(
        "cnc",
        "read",
        0,
        lambda r: r.cnc.read_bank(0, 200),
        lambda r, a: a == struct.pack(">100H", *r.world.controller.comp.words[0][:100]),
        repeated=True,
    ),
    "motion command": Kind("cnc", "write", 0, _moved, lambda r, a: a.position_mm == TARGET == _position(r)),
    "hold": Kind("cnc", "write", 0, lambda r: r.cnc.hold(), lambda r, a: int(r.world.controller.hold) == 1, repeated=True),
    "path points": Kind("cnc", "write", 1, lambda r: r.cnc.load_path(PATH), lambda r, a: r.world.controller.fifo_free == 8192 - len(PATH)),
    "compensation command": Kind(
        "cnc",
        "write",
        0,
        lambda r: r.cnc.lease(OWNER, 3_600_000),
        lambda r, a: r.world.controller.comp.owner(r.world.controller.now_s) == OWNER,
    ),
    "bank write": Kind(
        "cnc",
        "write",
        0,
        lambda r: r.cnc.write_bank(1, IMAGE),
        lambda r, a: struct.pack(">200H", *r.world.controller.comp.words[1][:200]) == IMAGE,
    ),
    "laser reading": Kind(
        "laser",
        "read",
        0,
        lambda r: r.laser.read(),
        lambda r, a: abs(a.displacement_tenth_nm) < 300_000 and a.status & 0b101 == 0b100,
        repeated=True,
    ),
    "laser acknowledge": Kind("laser", "read", 1, lambda r: r.laser.zero(), lambda r, a: True, repeated=True),
    "laser command": Kind("laser", "write", 0, lambda r: r.laser.zero(), lambda r, a: True),
}


@asynccontextmanager
async def opened(device: str, line: str = "tcp", *, timeout_s: float = TIMEOUT_S, heartbeat_s: float | None = None) -> AsyncIterator[Rig]:
    """A rig whose driver has identified its device; the laser has a mirror, the axes stand in the middle."""
    loop = asyncio.get_running_loop()
    world, start_s = World(Scenario()), loop.time()

    def advance() -> None:
        world.advance(SPEED * (loop.time() - start_s))

    inner: CncRegisters | LaserRegisters
    if device == "cnc":
        inner = CncRegisters(world.controller, 0xCAFE0002, advance)
        registers = Watched(inner, lambda: (inner._motion_ack, inner._comp_ack))  # type: ignore[union-attr]
    else:
        inner = LaserRegisters(world.laser, 0xBEEF0001, advance, world.tool_position)
        registers = Watched(inner, lambda: (inner._ack, 0))  # type: ignore[union-attr]
        world.laser.mount(np.array([-1.0, 0.0, 0.0]), world.tool_position())
    async with _on_line(registers, line) as carrier:
        url = parse_url(carrier.url)
        assert isinstance(url, ModbusTcpUrl | ModbusRtuUrl)
        backoff = Backoff(first_s=0.02, longest_s=0.1)
        link = await ModbusLink.connect(url, timeout_s=timeout_s, canary=Canary(), backoff=backoff, heartbeat_s=heartbeat_s)
        driver = ModbusController(link) if device == "cnc" else ModbusLaser(link)
        try:
            await driver.identify()
            if isinstance(driver, ModbusLaser):
                await driver.set_environment_compensation(True)
                await driver.zero()
            yield Rig(world, registers, carrier, link, driver)
        finally:
            await driver.close()


@asynccontextmanager
async def _on_line(registers: Watched, line: str) -> AsyncIterator[ModbusProxy | ToxicRtuLine]:
    if line == "rtu":
        rtu = ToxicRtuLine(registers)
        rtu.start()
        try:
            yield rtu
        finally:
            rtu.stop()
        return
    server = ModbusTcp(registers)
    proxy = ModbusProxy(("127.0.0.1", await server.start(0)))
    await proxy.start()
    try:
        yield proxy
    finally:
        await proxy.stop()
        await server.stop()


def records_of(link: ModbusLink) -> tuple[Record, ...]:
    """The link's account as the checker reads it."""
    return tuple(Record(e.kind, e.code, e.device, e.run, e.state) for e in link.incidents.entries)


async def observe(rig: Rig, row: str, case: str, kind: Kind, disturb: Callable[[Rig], None], **left_out: str) -> Observed:
    """Disturb the line, make the request, lift the fault, make it again: everything that the checker wants to know."""
    told, wrong = None, 0
    began_s = time.monotonic()
    disturb(rig)
    try:
        answer = await kind.run(rig)
        wrong += not kind.right(rig, answer)
    except DriverError as error:
        told = told_of(error)
    state = rig.link.state
    detected_s = next((e.host_s for e in rig.link.incidents.entries if e.host_s >= began_s and e.kind == "detected"), float("inf"))
    after = rig.registers.dangerous_after(detected_s + 0.05) if told else 0
    rig.line.play(FaultScenario())
    resumed = await _goes_on(rig, kind)
    await rig.device.close()
    records = records_of(rig.link)
    return Observed(
        row,
        case,
        told=told,
        absorbed=told is None,
        wrong_values=wrong,
        commands_after=after,
        table_verified=rig.world.controller.comp.active == 0,
        state=state,
        resumed=resumed,
        records=records,
        left_out=left_out,
    )


async def _goes_on(rig: Rig, kind: Kind) -> bool:
    """Whether the same request has a right answer now; a machine in feed hold is set free first, as a person would."""
    until_s = asyncio.get_running_loop().time() + within(10.0)
    while True:
        with contextlib.suppress(DriverError):
            if kind.device == "cnc" and int(rig.world.controller.hold):  # held, or an abort that was not finished
                await rig.cnc.abort()
            return kind.right(rig, await kind.run(rig))
        if asyncio.get_running_loop().time() > until_s:
            return False
        await asyncio.sleep(0.02)
