"""Modbus TCP and RTU behind four calls: connect, read, write, close. Decides on retries, waits and the validity of replies.

TCP numbers its transactions; RTU does not, so `ModbusLine` verifies that replies match requests. `POLICY` defines which requests may be
repeated, `EXCEPTIONS` the meaning of exception codes.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Refused, ReplyTimeout
from abbe.drivers.links.incidents import Backoff, Incidents
from abbe.drivers.links.modbus import READ_HOLDING, READ_INPUT, WRITE, WRITES, ModbusReply, ModbusWire, Request
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl
from abbe.drivers.links.words import CANARY_WORDS, RegisterBlock


class ModbusOperation(Enum):
    """Effect of a request on the device; it determines whether the request may be repeated."""

    READ = "read"
    """Changes nothing."""
    LEVEL = "level"
    """Writes a state, not an event (feed hold): idempotent."""
    NUMBERED = "numbered"
    """A command that the device executes only if it carries the next number, or data that are read back: a later read shows the outcome."""
    TRIGGER = "trigger"
    """Any other write: never repeated."""


@dataclass(frozen=True, slots=True)
class RetryRule:
    """Retries of one kind of request.

    ``repeats``: number of retries after a missing or invalid reply, each over a new or verified line; ``after_busy``: retry after exception
    6 (busy: not accepted); ``after_acknowledge``: retry after exception 5 (accepted, still working), both for at most ``BUSY_S``.
    """

    repeats: int
    after_busy: bool
    after_acknowledge: bool


POLICY = {
    ModbusOperation.READ: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    ModbusOperation.LEVEL: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    # Exception 6: nothing was executed. Exception 5: the command may still execute, and only the acknowledge register tells.
    ModbusOperation.NUMBERED: RetryRule(repeats=0, after_busy=True, after_acknowledge=False),
    ModbusOperation.TRIGGER: RetryRule(repeats=0, after_busy=False, after_acknowledge=False),
}

BUSY_S = 1.0
BUSY_POLL_S = 0.05
ACKNOWLEDGE, BUSY = 5, 6


@dataclass(frozen=True, slots=True)
class ExceptionRule:
    """Text, error class and remedy of an exception code. ``dead``: the device behind a gateway did not answer."""

    text: str
    error: type[DriverError]
    remedy: str
    dead: bool = False


_MAP = "the register map may not fit this device: compare its map version and address with docs/protocols"
_DIAGNOSE = "look at the device's own diagnostics"
_WAIT = "the device is busy: try again in a moment; if the device stays busy, look at it"
_GATEWAY = "look at the gateway and at the line behind it"

EXCEPTIONS = {
    1: ExceptionRule("illegal function", Refused, _MAP),
    2: ExceptionRule("illegal data address (or not writable)", Refused, _MAP),
    3: ExceptionRule("illegal data value", Refused, _MAP),
    4: ExceptionRule("device failure", DeviceFault, _DIAGNOSE),
    5: ExceptionRule("accepted, but not finished yet", ReplyTimeout, _WAIT),
    6: ExceptionRule("busy", ReplyTimeout, _WAIT),
    8: ExceptionRule("memory parity error", DeviceFault, _DIAGNOSE),
    10: ExceptionRule("gateway path unavailable", LinkDown, _GATEWAY, dead=True),
    11: ExceptionRule("gateway target does not respond", LinkDown, _GATEWAY, dead=True),
}
_UNKNOWN = ExceptionRule("unknown", DeviceFault, _DIAGNOSE)


def exception_rule(code: int) -> ExceptionRule:
    """Return the rule of an exception code; non-standard codes are device faults."""
    return EXCEPTIONS.get(code, _UNKNOWN)


def waits(op: ModbusOperation, code: int) -> bool:
    """Whether to retry the request after this exception code, within ``BUSY_S``."""
    rule = POLICY[op]
    return (code == BUSY and rule.after_busy) or (code == ACKNOWLEDGE and rule.after_acknowledge)


_BABBLE_LIMIT = 5
_PROOFS = 5
_CONNECT = 3
"""Longest time for a TCP connection, in reply timeouts; it allows for a lost first packet, which is sent again only after a second."""


@dataclass(frozen=True, slots=True)
class Canary:
    """Registers with known content, which verify that replies come from this device and match their requests.

    ``words``: content from ``address`` on; ``readable``: largest number of registers that one request may read from there. The number of
    registers varies from read to read, because replies of different length cannot be confused. ``functions``: function codes that read any
    register with the same result.
    """

    address: int = 0
    words: tuple[int, ...] = CANARY_WORDS
    readable: int = 12
    functions: tuple[int, ...] = (READ_HOLDING, READ_INPUT)


class ModbusLine:
    """A Modbus wire that is verified after every disturbance.

    After a missing or wrong reply on RTU, the line waits for silence of a whole reply timeout and reads the canary before the next request.
    It also reads the canary after every reply: if that reply was stale, the true reply arrives in place of the canary and does not match.
    Without a canary, an RTU line only waits for silence. ``timeout_s``: longest wait for one reply, s.
    """

    def __init__(self, wire: ModbusWire, timeout_s: float, canary: Canary | None) -> None:
        self._wire, self._timeout_s = wire, timeout_s
        self._canary = canary if wire.rtu else None
        self._name = wire.name
        self._known: tuple[int, ...] | None = None
        self._turn = 0
        self.closing = False
        """Whether a wait for silence must end, because the link closes."""
        self.dirty = False
        """Whether the line must be verified before the next request."""
        self.foreign_bytes = 0
        """Number of unsolicited bytes: noise, late replies, or a second master."""

    async def open(self) -> None:
        """Open a new connection; raises the errors of ``ModbusWire.open``."""
        self._known = None
        await self._wire.open(self._timeout_s if self._wire.rtu else _CONNECT * self._timeout_s)

    async def ready(self) -> None:
        """Bring the line into a state in which the next reply is reliable.

        Raises
        ------
        LinkDown
            The line never falls silent, or fails its verification.
        """
        await self._wire.gap()
        if self._wire.strays:
            self.foreign_bytes += self._wire.strays
            self._wire.forget()
            self.dirty = self.dirty or self._wire.rtu
        if self.dirty:
            await self._quarantine()

    def varied(self, request: Request, lead: int) -> tuple[Request, int]:
        """Return the request to send now, and the number of extra registers that it reads before the requested ones.

        On a line with a `Canary`, successive reads differ, so that a late reply to an earlier read is recognised: reads alternate between
        functions 3 and 4 and start 0 to ``lead`` registers earlier.
        """
        if self._canary is None or request.function in WRITES:
            return request, 0
        skip = self._turn // 2 % (lead + 1)
        if len(self._canary.functions) == 1:
            return Request(request.function, request.address - skip, request.count + skip), skip
        return Request(self._function(self._canary), request.address - skip, request.count + skip), skip

    async def ask(self, request: Request) -> ModbusReply:
        """Send a request once; on RTU accept its reply only if the canary read after it is right. Raises the errors of the wire."""
        answer = await self._asked(request)
        if self._canary is not None:
            await self._wire.gap()
            if self._wire.strays or not await self._proven(self._canary, 0):
                self.dirty = True
                detail = "a reply came, but the check registers read after it were wrong: the reply may belong to an earlier request"
                raise BadFrame(self._name, str(request), detail, "look for a second Modbus master, line noise or a slow device")
        return answer

    async def _asked(self, request: Request) -> ModbusReply:
        try:
            return await self._wire.ask(request, self._timeout_s)
        except BaseException as error:
            # RTU has no transaction number: an unanswered request may be answered at any time. TCP: a new connection has no past.
            self.dirty = self._wire.rtu
            if not self._wire.rtu or isinstance(error, LinkDown):
                await self._wire.drop()
            raise

    async def _quarantine(self) -> None:
        """Let late replies pass, then verify with the canary that replies match requests again."""
        for proof in range(_PROOFS):
            await self._silence()
            self._wire.forget()
            if self._canary is None or await self._proven(self._canary, proof):
                self.dirty = False
                return
            if not self._wire.up:
                break
        detail = f"the check registers (canary) were wrong {_PROOFS} times"
        raise LinkDown(
            self._name, "verify the line after a disturbance", detail, "check that the device is on; look for a second Modbus master"
        )

    async def _silence(self) -> None:
        clock = asyncio.get_running_loop().time
        start = clock()
        while (left_s := max(start, self._wire.heard_at) + self._timeout_s - clock()) > 0:
            if self.closing or clock() - start > _BABBLE_LIMIT * self._timeout_s:
                await self._wire.drop()
                detail, remedy = "the line is never silent", "check the baud rate; look for a second Modbus master on the line"
                raise LinkDown(self._name, "wait for silence", detail, remedy)
            await asyncio.sleep(left_s)

    async def _proven(self, canary: Canary, proof: int) -> bool:
        """Whether the canary reads as it did in the first two (equal) reads of this connection. Identification checks its content."""
        words = await self._read_canary(canary, proof)
        if words and self._known is None:
            self._known = words if await self._read_canary(canary, proof + 1) == words else None
        return bool(words) and words == self._known and not self._wire.strays

    async def _read_canary(self, canary: Canary, proof: int) -> tuple[int, ...]:
        """Read the canary by a request that differs each time in function or length; empty without a valid reply."""
        longer = (self._turn // 2 + proof) % (canary.readable - len(canary.words) + 1)
        try:
            answer = await self._asked(Request(self._function(canary), canary.address, len(canary.words) + longer))
        except (ReplyTimeout, BadFrame):
            return ()
        await self._wire.gap()
        return answer.registers[: len(canary.words)]

    def _function(self, canary: Canary) -> int:
        self._turn += 1
        return canary.functions[self._turn % len(canary.functions)]


MAX_READ = 125
MAX_WRITE = 123
_PATIENCE_S = 2.0


class ModbusLink:
    """Link to one Modbus unit: sends its requests one at a time, and reconnects when necessary.

    Parameters
    ----------
    timeout_s : float
        Longest wait for one reply; a TCP connection may take three times as long.
    canary : Canary, optional
        For devices that have a canary and answer function 4 like function 3 (docs/protocols). Without a canary, a disturbed RTU line is not
        verified, and there is no heartbeat.
    heartbeat_s : float, optional
        Idle time until the canary is read (None: never). This read detects a vanished peer within ``heartbeat_s + timeout_s``.
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
        """Number of connections so far; when it changes, the device may have restarted."""
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
            No answer at the address, or the serial port cannot be opened.
        """
        link = cls(url, timeout_s=timeout_s, canary=canary, backoff=backoff, heartbeat_s=heartbeat_s)
        try:
            await link._ready(_PATIENCE_S)
        except BaseException:
            await link.close()
            raise
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

    async def read(self, address: int, count: int, *, lead: int = 0, function: int = READ_HOLDING) -> tuple[int, ...]:
        """Read ``count`` (1..125) registers with one request; retry once over a new or verified line.

        ``function``: 3 or 4; a link uses both in turn if its canary has both.

        ``lead``: registers before ``address`` that may be read, too. On RTU, the link reads a varying number of them and alternates
        functions 3 and 4, so that it recognises a reply to an earlier read.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= count <= MAX_READ:
            raise ValueError(f"a Modbus read takes 1..{MAX_READ} registers, not {count}")
        return await self._transact(Request(function, address, count), ModbusOperation.READ, min(lead, MAX_READ - count))

    async def read_block(self, block: RegisterBlock) -> tuple[int, ...]:
        """Read the registers of a block of a register map, in one request; errors as for ``read``."""
        return await self.read(block.base, block.count, lead=block.lead)

    async def write(
        self, address: int, values: Sequence[int], op: ModbusOperation = ModbusOperation.TRIGGER, *, function: int = WRITE
    ) -> None:
        """Write 1..123 registers (FC16, or one with FC6); ``op`` determines whether the write may be repeated.

        Raises
        ------
        ReplyTimeout, LinkDown, BadFrame
            No reply, no connection, or a reply that does not answer the request: the write may or may not have happened.
        Refused, DeviceFault
            The device answered with an exception code.
        """
        if not 1 <= len(values) <= MAX_WRITE:
            raise ValueError(f"a Modbus write takes 1..{MAX_WRITE} registers, not {len(values)}")
        await self._transact(Request(function, address, len(values), tuple(values)), op)

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
                raise LinkDown(self.name, str(request), "the link was closed", "open the link again") from None
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
        if self._abandoned:
            raise asyncio.CancelledError
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
            raise LinkDown(self.name, "connect", "the link was closed", "open the link again")
        if not self._wire.up:
            await self._connect(patience_s)
        await self._line.ready()

    async def _connect(self, patience_s: float) -> None:
        left_s = self._backoff.left_s()
        if left_s > patience_s:
            detail = f"no connection; next attempt in {left_s:.1f} s"
            raise LinkDown(
                self.name, "connect", detail, "check that the device is on, cable and network, and that no other program uses it"
            )
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
                    await self._transact(
                        Request(canary.functions[0], canary.address, len(canary.words)), ModbusOperation.READ, patience_s=0.0
                    )
