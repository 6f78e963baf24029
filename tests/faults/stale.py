"""Row M2: one request whose answer comes too late (or whose caller goes away), and the next one after it."""

from __future__ import annotations

import asyncio
import contextlib
from contextlib import AsyncExitStack
from dataclasses import dataclass

from abbe.drivers.errors import DriverError
from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import Canary, ModbusLink, ModbusOperation
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, parse_url
from abbe.simulators.faults.rtu_toxic import ToxicRtuLine
from abbe.simulators.faults.scenario import Fault, FaultScenario, scenario
from tests.experiments.campaigns.late_replies import AddressMap, _tcp_device
from tests.faults.contract import Observed, told_of
from tests.faults.modbus_rig import records_of
from tests.patience import within

COUNT = 4
TIMEOUT_S = 0.2


@dataclass(frozen=True)
class Pair:
    """A case: which line, what happens to the first request (``timeout``, ``cancel``), both operations, lateness in timeouts."""

    row: str
    case: str
    line: str
    way: str
    first: str
    second: str
    factor: float


async def pair(what: Pair) -> Observed:
    """Play a case; every register holds its address, so a reply of the other request shows."""
    async with AsyncExitStack() as stack:
        device = AddressMap()
        if what.line == "tcp":
            bench = await _tcp_device(stack, device)
        else:
            bench = ToxicRtuLine(device)
            bench.start()
            stack.callback(bench.stop)
        url = parse_url(bench.url)
        assert isinstance(url, ModbusTcpUrl | ModbusRtuUrl)
        link = await ModbusLink.connect(url, timeout_s=TIMEOUT_S, canary=Canary(), backoff=Backoff(first_s=0.02, longest_s=0.1))
        stack.push_async_callback(link.close)
        bench.play(scenario(Fault("delay_reply", seconds=what.factor * TIMEOUT_S)))
        wrong, told = 0, None
        first = asyncio.create_task(_do(link, device, what.first, 2000))
        if what.way == "cancel":
            while not bench.requests:  # noqa: ASYNC110 - a request on the wire sets no event
                await asyncio.sleep(0)
            first.cancel()
        with contextlib.suppress(DriverError, asyncio.CancelledError):
            wrong += not await first
        try:
            wrong += not await _do(link, device, what.second, 3000)
        except DriverError as error:
            told = told_of(error)
        state = link.state
        bench.play(FaultScenario())
        resumed = await _again(link, device)
        await link.close()
        records = records_of(link)
        return Observed(what.row, what.case, told, told is None, wrong, state=state, resumed=resumed, records=records)


async def _do(link: ModbusLink, device: AddressMap, operation: str, address: int) -> bool:
    """One operation; False when its result is not true."""
    if operation == "read":
        return await link.read(address, COUNT) == tuple(device.words[address : address + COUNT])
    values = [address + 7 + i for i in range(COUNT)]
    await link.write(address, values, ModbusOperation.TRIGGER if operation == "activate" else ModbusOperation.NUMBERED)
    return device.words[address : address + COUNT] == values


async def _again(link: ModbusLink, device: AddressMap) -> bool:
    until_s = asyncio.get_running_loop().time() + within(10.0)
    while asyncio.get_running_loop().time() < until_s:
        with contextlib.suppress(DriverError):
            return await _do(link, device, "read", 4000)
        await asyncio.sleep(0.02)
    return False
