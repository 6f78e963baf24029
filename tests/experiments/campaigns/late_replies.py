"""Does a late, doubled or abandoned reply ever pass for the answer to another question? Counted over many trials, TCP and RTU.

Each trial disturbs one request (its reply comes after the timeout, comes twice, or the caller is cancelled while it waits) and then asks
other things with the same number of registers, the worst case. Every register holds its own address or what was last written to it, so a
reply of another transaction shows. ``--stock`` plays the same trials with the library's own client.

    python -m tests.experiments.campaigns.late_replies --trials 100000 --transport rtu
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import random
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from typing import Protocol

from pymodbus import FramerType
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from abbe.drivers.errors import DriverError
from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import Canary, ModbusLink, ModbusOperation
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl, parse_url
from abbe.simulators.faults.modbus_proxy import ModbusProxy
from abbe.simulators.faults.modbus_toxics import MBAP, Cutter, Frame, answer, parts
from abbe.simulators.faults.rtu_toxic import ToxicRtuLine
from abbe.simulators.faults.scenario import Fault, FaultScenario, scenario

KINDS = ("late", "duplicate", "cancelled")
FACTORS = (1.05, 2.0, 10.0)
FIRST, LAST = 1000, 60000
CANARY = (0x0102, 0x0304, 0x449A, 0x5000)


class AddressMap:
    """Every register holds its own address, or what was written; 0..3 hold the canary."""

    size = 65536

    def __init__(self) -> None:
        self.words = [*CANARY, *range(4, self.size)]
        self.writes: list[tuple[int, tuple[int, ...]]] = []

    def read(self, address: int, count: int) -> list[int] | None:
        return self.words[address : address + count]

    def write(self, address: int, values: list[int]) -> bool:
        self.words[address : address + len(values)] = values
        self.writes.append((address, tuple(values)))
        return True


class Client(Protocol):
    """What a trial needs of a client; every error it reports is one of ``trouble``."""

    trouble: tuple[type[BaseException], ...]

    async def read(self, address: int, count: int) -> tuple[int, ...]: ...
    async def write(self, address: int, values: list[int]) -> None: ...
    async def close(self) -> None: ...


class Ours:
    """The link of the drivers, as the registry opens it; only the waits between connections are shorter."""

    trouble = (DriverError,)

    def __init__(self, link: ModbusLink) -> None:
        self._link = link

    @classmethod
    async def connect(cls, url: str, timeout_s: float) -> Ours:
        parsed = parse_url(url)
        assert isinstance(parsed, ModbusTcpUrl | ModbusRtuUrl)
        backoff = Backoff(first_s=timeout_s / 10, longest_s=timeout_s)
        return cls(await ModbusLink.connect(parsed, timeout_s=timeout_s, canary=Canary(), backoff=backoff))

    async def read(self, address: int, count: int) -> tuple[int, ...]:
        return await self._link.read(address, count, lead=10)

    async def write(self, address: int, values: list[int]) -> None:
        await self._link.write(address, values, ModbusOperation.NUMBERED)

    async def close(self) -> None:
        await self._link.close()


class Stock:
    """The library's own client; ``retries=0``, because its repetitions would only add copies of writes."""

    trouble = (ModbusException, TimeoutError, AssertionError)

    def __init__(self, client: AsyncModbusTcpClient | AsyncModbusSerialClient) -> None:
        self._client = client

    @classmethod
    async def connect(cls, url: str, timeout_s: float) -> Stock:
        parsed = parse_url(url)
        client: AsyncModbusTcpClient | AsyncModbusSerialClient
        if isinstance(parsed, ModbusTcpUrl):
            client = AsyncModbusTcpClient(parsed.host, port=parsed.port, timeout=timeout_s, retries=0)
        else:
            assert isinstance(parsed, ModbusRtuUrl)
            client = AsyncModbusSerialClient(parsed.path, framer=FramerType.RTU, baudrate=parsed.baud, timeout=timeout_s, retries=0)
        await client.connect()
        return cls(client)

    async def read(self, address: int, count: int) -> tuple[int, ...]:
        reply = await self._client.read_holding_registers(address, count=count, device_id=1)
        assert not reply.isError()
        return tuple(reply.registers)

    async def write(self, address: int, values: list[int]) -> None:
        reply = await self._client.write_registers(address, values, device_id=1)
        assert not reply.isError()

    async def close(self) -> None:
        self._client.close()


class Bench(Protocol):
    """A device whose line can be disturbed."""

    requests: int

    def play(self, scenario: FaultScenario) -> None: ...


@dataclass
class Tally:
    """What came of all operations: right, an error that was told, or wrong without a word."""

    trials: int = 0
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    seconds: float = 0.0
    examples: list[str] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        return sum(n for (_, outcome), n in self.counts.items() if outcome == "wrong")

    def lines(self) -> list[str]:
        rows = [f"{'':10}{'right':>10}{'error told':>12}{'WRONG':>8}"]
        for kind in KINDS:
            right, told, wrong = (self.counts[kind, outcome] for outcome in ("right", "told", "wrong"))
            rows.append(f"{kind:10}{right:10}{told:12}{wrong:8}")
        return [*rows, f"{self.trials} trials in {self.seconds:.0f} s, {self.wrong} wrong", *self.examples]


class Line:
    """One client and one device, and the trials between them."""

    def __init__(self, client: Client, bench: Bench, device: AddressMap, draw: random.Random, timeout_s: float, tally: Tally) -> None:
        self._client, self._bench, self._device = client, bench, device
        self._draw, self._timeout_s, self._tally = draw, timeout_s, tally

    async def trial(self) -> None:
        """One disturbed request, then two undisturbed ones."""
        draw, kind = self._draw, self._draw.choice(KINDS)
        count = draw.choice((1, 2, 10))
        operations = [draw.choice((self._read, self._read, self._write)) for _ in range(3)]
        late_s = draw.choice(FACTORS) * self._timeout_s
        if kind == "duplicate":
            late_s = draw.choice((0.0, 0.3 * self._timeout_s * draw.random(), late_s))
            fault = Fault("duplicate_reply", seconds=late_s)
        else:
            fault = Fault("delay_reply", seconds=late_s if kind == "late" else draw.uniform(0.2, 1.5) * self._timeout_s)
        self._bench.play(scenario(fault))
        if kind == "cancelled":
            await self._cancelled(operations[0], kind, count)
        else:
            await operations[0](kind, count)
        for operation in operations[1:]:
            await operation(kind, count)
        self._tally.trials += 1

    async def _cancelled(self, operation: Callable[[str, int], Awaitable[None]], kind: str, count: int) -> None:
        before = self._bench.requests
        task = asyncio.ensure_future(operation(kind, count))
        while self._bench.requests == before and not task.done():  # noqa: ASYNC110 - a request on the wire sets no event
            await asyncio.sleep(0)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    async def _read(self, kind: str, count: int) -> None:
        address = self._draw.randrange(FIRST, LAST)
        try:
            got = await self._client.read(address, count)
        except self._client.trouble:
            self._tally.counts[kind, "told"] += 1
            return
        self._judge(kind, got == tuple(self._device.words[address : address + count]), f"asked {address} x {count}, got {got}")

    async def _write(self, kind: str, count: int) -> None:
        address, values = self._draw.randrange(FIRST, LAST), [self._draw.randrange(65536) for _ in range(count)]
        try:
            await self._client.write(address, values)
        except self._client.trouble:
            self._tally.counts[kind, "told"] += 1
            return
        done = (address, tuple(values)) in self._device.writes[-4:]
        self._judge(kind, done, f"writing {address} x {count} was reported done and was not")

    def _judge(self, kind: str, right: bool, text: str) -> None:
        self._tally.counts[kind, "right" if right else "wrong"] += 1
        if not right and len(self._tally.examples) < 5:
            self._tally.examples.append(f"  {kind}: {text}")


async def _tcp_device(stack: AsyncExitStack, device: AddressMap) -> ModbusProxy:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        cutter = Cutter(MBAP, requests=True)
        with suppress(OSError, asyncio.CancelledError):
            while data := await reader.read(4096):
                for frame in cutter.feed(data):
                    asked = parts(frame, MBAP)
                    writer.write(Frame(asked.unit, answer(device, asked.pdu), asked.tid).bytes(MBAP))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    stack.callback(server.close)
    proxy = ModbusProxy(server.sockets[0].getsockname())
    await proxy.start()
    stack.push_async_callback(proxy.stop)
    return proxy


async def campaign(
    transport: str,
    trials: int,
    *,
    stock: bool = False,
    timeout_s: float = 0.05,
    lines: int = 64,
    seed: int = 1,
    show: Callable[[str], None] = lambda text: None,
) -> Tally:
    """Play ``trials`` trials over ``lines`` lines at a time.

    Parameters
    ----------
    transport : str
        ``tcp`` or ``rtu``.
    timeout_s : float
        The client's reply timeout: short, because on RTU every late reply costs several of them.
    """
    tally, start = Tally(), time.monotonic()
    lines = min(lines, trials)
    async with AsyncExitStack() as stack:
        work = []
        for number in range(lines):
            device = AddressMap()
            bench: ModbusProxy | ToxicRtuLine
            if transport == "tcp":
                bench = await _tcp_device(stack, device)
            else:
                bench = ToxicRtuLine(device)
                bench.start()
                stack.callback(bench.stop)
            client: Client = await (Stock if stock else Ours).connect(bench.url, timeout_s)
            stack.push_async_callback(client.close)
            line = Line(client, bench, device, random.Random(f"{seed}/{number}"), timeout_s, tally)
            work.append(_play(line, trials // lines + (number < trials % lines)))
        async with asyncio.TaskGroup() as group:
            watch = group.create_task(_report(tally, trials, show))
            await asyncio.gather(*work)
            watch.cancel()
    tally.seconds = time.monotonic() - start
    return tally


async def _play(line: Line, trials: int) -> None:
    for _ in range(trials):
        await line.trial()


async def _report(tally: Tally, trials: int, show: Callable[[str], None]) -> None:
    start = time.monotonic()
    while True:
        await asyncio.sleep(10)
        left_s = (trials - tally.trials) * (time.monotonic() - start) / max(tally.trials, 1)
        show(f"{tally.trials} of {trials} trials, {tally.wrong} wrong, about {left_s:.0f} s left")


def main() -> int:
    """Command line; exit code 1 when our client delivered a wrong reading."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--transport", choices=("tcp", "rtu"), action="append", help="default: both")
    parser.add_argument("--stock", action="store_true", help="the library's own client instead of ours")
    parser.add_argument("--timeout", type=float, default=0.05, help="reply timeout of the client in s")
    parser.add_argument("--lines", type=int, default=64, help="lines at a time")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    worst = 0
    for transport in options.transport or ("tcp", "rtu"):
        show = lambda text, name=transport: print(f"{name}: {text}", file=sys.stderr, flush=True)  # noqa: E731, T201
        tally = asyncio.run(
            campaign(
                transport,
                options.trials,
                stock=options.stock,
                timeout_s=options.timeout,
                lines=options.lines,
                seed=options.seed,
                show=show,
            )
        )
        name = "the library's own client" if options.stock else "our client"
        sys.stdout.write("\n".join([f"{transport}, {name}, timeout {options.timeout:g} s, {options.lines} lines", *tally.lines(), ""]))
        sys.stdout.write(json.dumps({"transport": transport, "stock": options.stock, "trials": tally.trials, "wrong": tally.wrong}) + "\n")
        worst = max(worst, tally.wrong)
    return int(bool(worst) and not options.stock)


if __name__ == "__main__":
    sys.exit(main())
