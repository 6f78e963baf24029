"""Modbus TCP and RTU behind four calls: connect, read, write, close. Decides on retries, waits and the validity of replies."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence

from abbe.drivers.errors import BadFrame, DriverError, LinkDown, ReplyTimeout
from abbe.drivers.links.incidents import Backoff, Incidents
from abbe.drivers.links.modbus import READ_HOLDING, WRITE, ModbusReply, ModbusWire, Request
from abbe.drivers.links.modbus_line import BUSY_POLL_S, BUSY_S, POLICY, Canary, ModbusLine, ModbusOperation, exception_rule, waits
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl
from abbe.drivers.links.words import RegisterBlock

MAX_READ = 125
MAX_WRITE = 123
_PATIENCE_S = 2.0


class ModbusLink:
    """One Modbus unit.

    Parameters
    ----------
    timeout_s : float
        Longest wait for one reply, and for one connection.
    canary : Canary, optional
        Of devices that have one and answer function 4 like function 3 (docs/protocols). Without it a disturbed RTU line gets silence but no
        verification, and there is no heartbeat.
    heartbeat_s : float, optional
        Read the canary after this idle time: this detects a vanished peer within the same time plus one timeout, and reconnects a lost one.
    """

    def __init__(
        self,
        url: ModbusTcpUrl | ModbusRtuUrl,
        *,
        timeout_s: float = 1.0,
        canary: Canary | None = None,
        backoff: Backoff | None = None,
        heartbeat_s: float | None = None,
    ) -> None:
        self.name = str(url)
        self.incidents = Incidents()
        self.connections = 0
        """Number of connections so far: after a change the device may have restarted."""
        self._wire = ModbusWire(url)
        self._line = ModbusLine(self._wire, timeout_s, canary)
        self._canary = canary
        self._backoff = backoff or Backoff()
        self._heartbeat_s = heartbeat_s if canary is not None else None
        self._pulse: asyncio.Task[None] | None = None
        self._lock = asyncio.Lock()
        self._task: asyncio.Task[tuple[int, ...]] | None = None
        self._on_wire = False
        self._abandoned = False
        self._closed = False
        self._asked_at = float("-inf")

    @classmethod
    async def connect(
        cls,
        url: ModbusTcpUrl | ModbusRtuUrl,
        *,
        timeout_s: float = 1.0,
        canary: Canary | None = None,
        backoff: Backoff | None = None,
        heartbeat_s: float | None = None,
    ) -> ModbusLink:
        """Open a link.

        Raises
        ------
        LinkDown
            No answer there, or the port cannot be opened.
        """
        link = cls(url, timeout_s=timeout_s, canary=canary, backoff=backoff, heartbeat_s=heartbeat_s)
        await link._ready(_PATIENCE_S)
        if link._heartbeat_s is not None:
            link._pulse = asyncio.get_running_loop().create_task(link._beat(link._heartbeat_s))
        return link

    @property
    def state(self) -> str:
        """``closed``, ``down`` (the next request connects), ``quarantine`` (the next request verifies the line first) or ``up``."""
        if self._closed:
            return "closed"
        if not self._wire.up:
            return "down"
        return "quarantine" if self._line.dirty else "up"

    @property
    def foreign_bytes(self) -> int:
        """Number of unsolicited bytes: noise, late replies, or a second master."""
        return self._line.foreign_bytes

    async def read(self, address: int, count: int, *, lead: int = 0) -> tuple[int, ...]:
        """Read ``count`` (1..125) registers with one request, with one retry over a new or verified line.

        ``lead``: registers before ``address`` that may be read, too. On RTU a varying number of them is: together with alternating
        functions 3 and 4 this makes a reply to an earlier read recognisable.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= count <= MAX_READ:
            raise ValueError(f"a Modbus read takes 1..{MAX_READ} registers, not {count}")
        return await self._transact(Request(READ_HOLDING, address, count), ModbusOperation.READ, min(lead, MAX_READ - count))

    async def read_block(self, block: RegisterBlock) -> tuple[int, ...]:
        """Read the registers of a block of a register map, in one request; errors as for ``read``."""
        return await self.read(block.base, block.count, lead=block.lead)

    async def write(self, address: int, values: Sequence[int], op: ModbusOperation = ModbusOperation.TRIGGER) -> None:
        """Write 1..123 registers (FC16); ``op`` determines whether the write may be repeated (drivers/links/modbus_line.py).

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request: the write may or may not have happened.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= len(values) <= MAX_WRITE:
            raise ValueError(f"a Modbus write takes 1..{MAX_WRITE} registers, not {len(values)}")
        await self._transact(Request(WRITE, address, len(values), tuple(values)), op)

    async def close(self) -> None:
        """Close the link; a pending request ends with ``LinkDown``. Closing twice does nothing."""
        self._closed = self._line.closing = True
        self._wire.hang_up()
        if self._pulse is not None:
            self._pulse.cancel()
        if self._task is not None and not self._on_wire:
            self._task.cancel()  # the task waits for its next attempt, or for silence
        try:
            if pending := [task for task in (self._task, self._pulse) if task is not None]:
                await asyncio.wait(pending)
        finally:
            await self._wire.drop()
            self.incidents.closed()

    async def _transact(self, request: Request, op: ModbusOperation, lead: int = 0, patience_s: float = _PATIENCE_S) -> tuple[int, ...]:
        await self._lock.acquire()
        # The exchange is a task of its own that keeps the lock: a cancelled caller returns at once, but the task still waits for the reply
        # to a request on the wire, so that the reply can never meet the next request.
        self._on_wire = self._abandoned = False
        task = asyncio.get_running_loop().create_task(self._exchange(request, op, lead, patience_s))
        self._task = task
        task.add_done_callback(self._finished)
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if self._closed and task.cancelled():
                raise LinkDown(self.name, str(request), "the link was closed", "open it again") from None
            self._abandoned = True  # wait for a request on the wire, but send nothing more for this caller
            if not self._on_wire:
                task.cancel()
            raise

    def _finished(self, task: asyncio.Task[tuple[int, ...]]) -> None:
        if not task.cancelled():
            task.exception()  # marks it as retrieved: a cancelled caller cannot
        self._task = None
        self._lock.release()

    async def _exchange(self, request: Request, op: ModbusOperation, lead: int, patience_s: float) -> tuple[int, ...]:
        repeats, clock = POLICY[op].repeats, asyncio.get_running_loop().time
        busy_until = clock() + BUSY_S
        while True:
            sent, skip = self._line.varied(request, lead)
            self._on_wire = False
            try:
                answer = await self._once(sent, patience_s)
            except (LinkDown, ReplyTimeout, BadFrame) as error:
                self.incidents.note(error)
                # Without a connection (nothing on the wire) a second attempt would only burden the device.
                if not repeats or not self._on_wire or self._closed or self._abandoned:
                    raise
                repeats -= 1
                continue
            if not answer.exception:
                self.incidents.good()
                return answer.registers[skip:]
            if not waits(op, answer.exception) or clock() >= busy_until or self._abandoned:
                raise self._refusal(request, answer.exception)
            self._on_wire = False
            await asyncio.sleep(BUSY_POLL_S)

    async def _once(self, request: Request, patience_s: float) -> ModbusReply:
        await self._ready(patience_s)
        self._on_wire = True
        try:
            answer = await self._line.ask(request)
        finally:
            self._asked_at = asyncio.get_running_loop().time()
        if not exception_rule(answer.exception).dead:
            self._backoff.succeeded()
        return answer

    def _refusal(self, request: Request, code: int) -> DriverError:
        rule = exception_rule(code)
        error = rule.error(self.name, str(request), f"exception {code}: {rule.text}", rule.remedy)
        self.incidents.note(error)
        return error

    async def _ready(self, patience_s: float) -> None:
        if self._closed:
            raise LinkDown(self.name, "connect", "the link was closed", "open it again")
        if not self._wire.up:
            await self._connect(patience_s)
        await self._line.ready()

    async def _connect(self, patience_s: float) -> None:
        left_s = self._backoff.left_s()
        if left_s > patience_s:
            detail = f"no connection; next attempt in {left_s:.1f} s"
            raise LinkDown(self.name, "connect", detail, "device on? network or cable all right? another program connected to it?")
        await self._backoff.due()
        self._backoff.attempted()
        await self._line.open()
        self.connections += 1

    async def _beat(self, every_s: float) -> None:
        clock = asyncio.get_running_loop().time
        canary = self._canary
        if canary is None:
            return
        while not self._closed:
            if (left_s := self._asked_at + every_s - clock()) > 0 or self._lock.locked():
                await asyncio.sleep(max(left_s, every_s / 10))
                continue
            self._asked_at = clock()
            if self._wire.up or not self._backoff.left_s():
                with contextlib.suppress(DriverError):  # already noted as an incident; the next request raises it, too
                    await self._transact(Request(READ_HOLDING, canary.address, len(canary.words)), ModbusOperation.READ, patience_s=0.0)
