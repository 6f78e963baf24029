"""Validity of replies on a Modbus line. TCP numbers its transactions; an RTU line must prove that replies match requests.

Two tables define which requests may be repeated, and the meaning of exception codes.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from enum import Enum

from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Refused, ReplyTimeout
from abbe.drivers.links.modbus import READ_HOLDING, READ_INPUT, WRITE, ModbusReply, ModbusWire, Request
from abbe.drivers.links.words import CANARY_WORDS


class ModbusOperation(Enum):
    """Effect of a request on the device, which determines whether it may be repeated."""

    READ = "read"
    """Changes nothing."""
    LEVEL = "level"
    """Writes a state, not an event (feed hold): idempotent."""
    NUMBERED = "numbered"
    """A command that the device executes only with the next number, or data that are read back: a later read shows the outcome."""
    TRIGGER = "trigger"
    """Any other write: never repeated."""


@dataclass(frozen=True, slots=True)
class RetryRule:
    """Retries of one kind of request.

    ``repeats``: number of retries, over a new or verified line, without a valid reply; ``after_busy``: retry after exception 6 (busy: not
    accepted), ``after_acknowledge``: after exception 5 (accepted, still working), both for at most ``BUSY_S``.
    """

    repeats: int
    after_busy: bool
    after_acknowledge: bool


POLICY = {
    ModbusOperation.READ: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    ModbusOperation.LEVEL: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    # 6 means that nothing was executed. 5 means that the command may still execute: only the acknowledge register decides.
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
_WAIT = "the device is busy: try again in a moment, look at the device if it persists"
_GATEWAY = "look at the gateway and at the line behind it"

EXCEPTIONS = {
    1: ExceptionRule("illegal function", Refused, _MAP),
    2: ExceptionRule("illegal data address (or not writable)", Refused, _MAP),
    3: ExceptionRule("illegal data value", Refused, _MAP),
    4: ExceptionRule("device failure", DeviceFault, _DIAGNOSE),
    5: ExceptionRule("acknowledged, still busy with it", ReplyTimeout, _WAIT),
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
"""Reply timeouts that a TCP connection may take: a lost first packet is sent again after a second."""


@dataclass(frozen=True, slots=True)
class Canary:
    """Registers with known content, which verify that replies come from this device and match their requests.

    ``words``: content from ``address`` on; ``readable``: registers that one request may read from there, because replies of different
    length cannot be confused.
    """

    address: int = 0
    words: tuple[int, ...] = CANARY_WORDS
    readable: int = 12


class ModbusLine:
    """A wire that tracks disturbances.

    On RTU a missing or wrong reply is followed by silence for a whole reply timeout and a read of the canary before the next request. The
    canary is also read after every reply: if a stale reply passed for the answer, the true one arrives now and does not match. Without a
    canary a disturbed RTU line gets only the silence. ``timeout_s``: longest wait for one reply.
    """

    def __init__(self, wire: ModbusWire, timeout_s: float, canary: Canary | None) -> None:
        self._wire, self._timeout_s = wire, timeout_s
        self._canary = canary if wire.rtu else None
        self._name = wire.name
        self._known: tuple[int, ...] | None = None
        self._turn = 0
        self.closing = False
        """Stop waiting for silence."""
        self.dirty = False
        """Whether the line must be verified before the next request."""
        self.foreign_bytes = 0
        """Number of unsolicited bytes: noise, late replies, or a second master."""

    async def open(self) -> None:
        """Make a new connection; raises as ``ModbusWire.open``."""
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
        """Return the request in its current variant, and the number of extra registers before the requested ones.

        With a canary, functions 3 and 4 alternate, with up to ``lead`` extra registers, so that a reply to an earlier read is recognised.
        """
        if self._canary is None or request.function == WRITE:
            return request, 0
        skip = self._turn // 2 % (lead + 1)
        return Request(self._function(), request.address - skip, request.count + skip), skip

    async def ask(self, request: Request) -> ModbusReply:
        """Send a request once; on RTU accept its reply only if the canary read after it is right. Raises as the wire."""
        answer = await self._asked(request)
        if self._canary is not None:
            await self._wire.gap()
            if self._wire.strays or not await self._proven(self._canary, 0):
                self.dirty = True
                detail = "a reply came, but the canary read after it was wrong: the reply may be stale"
                raise BadFrame(self._name, str(request), detail, "second master on the line, line noise, or a slow device?")
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
        detail = f"the canary registers were wrong {_PROOFS} times"
        raise LinkDown(self._name, "verify the line after a disturbance", detail, "second master on the line, or device off?")

    async def _silence(self) -> None:
        clock = asyncio.get_running_loop().time
        start = clock()
        while (left_s := max(start, self._wire.heard_at) + self._timeout_s - clock()) > 0:
            if self.closing or clock() - start > _BABBLE_LIMIT * self._timeout_s:
                await self._wire.drop()
                detail, remedy = "the line never falls silent", "second master on the line, or wrong baud rate?"
                raise LinkDown(self._name, "wait for silence", detail, remedy)
            await asyncio.sleep(left_s)

    async def _proven(self, canary: Canary, proof: int) -> bool:
        """Read the canary and compare it with two equal reads of this connection; the identification checks its content."""
        words = await self._read_canary(canary, proof)
        if words and self._known is None:
            self._known = words if await self._read_canary(canary, proof + 1) == words else None
        return bool(words) and words == self._known and not self._wire.strays

    async def _read_canary(self, canary: Canary, proof: int) -> tuple[int, ...]:
        """Read the canary registers, in another variant each time; empty without a valid reply."""
        longer = (self._turn // 2 + proof) % (canary.readable - len(canary.words) + 1)
        try:
            answer = await self._asked(Request(self._function(), canary.address, len(canary.words) + longer))
        except (ReplyTimeout, BadFrame):
            return ()
        await self._wire.gap()
        return answer.registers[: len(canary.words)]

    def _function(self) -> int:
        self._turn += 1
        return READ_INPUT if self._turn % 2 else READ_HOLDING
