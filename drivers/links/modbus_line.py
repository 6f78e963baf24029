"""When an answer on a Modbus line may be believed. TCP numbers its transactions; an RTU line has to prove that it is in step.

What may be asked again, and what an exception code means, are two tables.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from enum import Enum

from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Refused, ReplyTimeout
from abbe.drivers.links.modbus import READ_HOLDING, READ_INPUT, WRITE, ModbusReply, ModbusWire, Request
from abbe.drivers.links.words import CANARY_WORDS


class ModbusOperation(Enum):
    """What a request does to the device, as far as repeating it is concerned."""

    READ = "read"
    """Changes nothing."""
    LEVEL = "level"
    """Writes a state, not an event (feed hold): twice is the same as once."""
    NUMBERED = "numbered"
    """A command that the device executes only if it carries the next number, or words that are read back: what became of it is asked."""
    TRIGGER = "trigger"
    """Anything else that is written: never sent again, whatever happens."""


@dataclass(frozen=True, slots=True)
class RetryRule:
    """How one kind of request is treated.

    Parameters
    ----------
    repeats : int
        How often it is sent again, over a new or a proven line, when no valid reply came.
    after_busy : bool
        Whether it is sent again after exception 6 (busy: not accepted), for at most ``BUSY_S``.
    after_acknowledge : bool
        Whether it is sent again after exception 5 (accepted, still working on it), for at most ``BUSY_S``.
    """

    repeats: int
    after_busy: bool
    after_acknowledge: bool


POLICY = {
    ModbusOperation.READ: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    ModbusOperation.LEVEL: RetryRule(repeats=1, after_busy=True, after_acknowledge=True),
    # 6 says that nothing was executed. 5 says that something may be under way: the acknowledge register decides, never the 5 itself.
    ModbusOperation.NUMBERED: RetryRule(repeats=0, after_busy=True, after_acknowledge=False),
    ModbusOperation.TRIGGER: RetryRule(repeats=0, after_busy=False, after_acknowledge=False),
}

BUSY_S = 1.0
BUSY_POLL_S = 0.05
ACKNOWLEDGE, BUSY = 5, 6


@dataclass(frozen=True, slots=True)
class Meaning:
    """What an exception code says, which error it becomes, what a person can do. ``dead``: the far end did not answer."""

    text: str
    error: type[DriverError]
    remedy: str
    dead: bool = False


_MAP = "the register map may not fit this device: compare its map version and address with docs/protocols"
_DIAGNOSE = "look at the device's own diagnostics"
_WAIT = "it stays busy: try again in a moment, look at the device if it goes on"
_GATEWAY = "look at the gateway and at the line behind it"

EXCEPTIONS = {
    1: Meaning("illegal function", Refused, _MAP),
    2: Meaning("illegal data address (or not writable)", Refused, _MAP),
    3: Meaning("illegal data value", Refused, _MAP),
    4: Meaning("device failure", DeviceFault, _DIAGNOSE),
    5: Meaning("acknowledged, still busy with it", ReplyTimeout, _WAIT),
    6: Meaning("busy", ReplyTimeout, _WAIT),
    8: Meaning("memory parity error", DeviceFault, _DIAGNOSE),
    10: Meaning("gateway path unavailable", LinkDown, _GATEWAY, dead=True),
    11: Meaning("gateway target does not respond", LinkDown, _GATEWAY, dead=True),
}
_UNKNOWN = Meaning("unknown", DeviceFault, _DIAGNOSE)


def meaning(code: int) -> Meaning:
    """What an exception code means; codes of no standard are the device's fault."""
    return EXCEPTIONS.get(code, _UNKNOWN)


def waits(op: ModbusOperation, code: int) -> bool:
    """Whether the request is sent again after this exception code, within ``BUSY_S``."""
    rule = POLICY[op]
    return (code == BUSY and rule.after_busy) or (code == ACKNOWLEDGE and rule.after_acknowledge)


_BABBLE_LIMIT = 5
_PROOFS = 5
_CONNECT = 3
"""A TCP connection may take so many reply timeouts: a lost first packet is sent again after a second."""


@dataclass(frozen=True, slots=True)
class Canary:
    """Registers whose content is known: what proves that a line carries this device's answers, and these in the right order.

    Parameters
    ----------
    address : int
        First register.
    words : tuple of int
        What stands there.
    readable : int
        Registers that may be read from ``address`` on in one request: reads of different lengths cannot be taken for one another.
    """

    address: int = 0
    words: tuple[int, ...] = CANARY_WORDS
    readable: int = 12


class ModbusLine:
    """A wire with a memory of what went wrong on it.

    On RTU, after whatever was not answered as it should be: silence for a whole reply timeout, then the canary, and only then the next
    request. And behind every answer the canary once more: if a stale reply passed for the answer, the true one comes now and does not fit.

    Parameters
    ----------
    wire : ModbusWire
        The connection.
    timeout_s : float
        Longest wait for one reply.
    canary : Canary or None
        Without one a disturbed RTU line is only waited silent.
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
        """The next request has to wait until the line is proven."""
        self.foreign_bytes = 0
        """Bytes that came when nothing was asked: noise, late replies, or a second master."""

    async def open(self) -> None:
        """Make a new connection; errors as of ``ModbusWire.open``."""
        self._known = None
        await self._wire.open(self._timeout_s if self._wire.rtu else _CONNECT * self._timeout_s)

    async def ready(self) -> None:
        """Come to a state in which the next answer can be believed.

        Raises
        ------
        LinkDown
            The line is never silent, or never proves itself.
        """
        await self._wire.gap()
        if self._wire.strays:
            self.foreign_bytes += self._wire.strays
            self._wire.forget()
            self.dirty = self.dirty or self._wire.rtu
        if self.dirty:
            await self._quarantine()

    def formed(self, request: Request, lead: int) -> tuple[Request, int]:
        """The request in the form that this turn has, and how many of the registers read stand before those asked for.

        With a canary: functions 3 and 4 in turn, and up to ``lead`` registers more, so that a reply to an earlier read looks different.
        """
        if self._canary is None or request.function == WRITE:
            return request, 0
        skip = self._turn // 2 % (lead + 1)
        return Request(self._function(), request.address - skip, request.count + skip), skip

    async def ask(self, request: Request) -> ModbusReply:
        """Send a request once; on RTU believe its answer only when the canary behind it is answered too. Errors as of the wire's."""
        answer = await self._asked(request)
        if self._canary is not None:
            await self._wire.gap()
            if self._wire.strays or not await self._proven(self._canary, 0):
                self.dirty = True
                detail = "an answer came, but the canary asked behind it was not answered as it must be: it may have been a stale one"
                raise BadFrame(self._name, str(request), detail, "second master on the line, line noise, or a slow device?")
        return answer

    async def _asked(self, request: Request) -> ModbusReply:
        try:
            return await self._wire.ask(request, self._timeout_s)
        except BaseException as error:
            # RTU has no transaction number: what was not answered may be answered any time. TCP: a new connection has no past.
            self.dirty = self._wire.rtu
            if not self._wire.rtu or isinstance(error, LinkDown):
                await self._wire.drop()
            raise

    async def _quarantine(self) -> None:
        """Let whatever is late come and go, then prove with the canary that answers belong to questions again."""
        for proof in range(_PROOFS):
            await self._silence()
            self._wire.forget()
            if self._canary is None or await self._proven(self._canary, proof):
                self.dirty = False
                return
            if not self._wire.up:
                break
        detail = f"the canary registers were not answered as they must be, {_PROOFS} times"
        raise LinkDown(self._name, "prove the line after a disturbance", detail, "second master on the line, or device off?")

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
        """Ask the canary. What it has to be is what it was at this connection, twice; whether it is right is for the identification."""
        words = await self._sung(canary, proof)
        if words and self._known is None:
            self._known = words if await self._sung(canary, proof + 1) == words else None
        return bool(words) and words == self._known and not self._wire.strays

    async def _sung(self, canary: Canary, proof: int) -> tuple[int, ...]:
        """What stands in the canary registers, read in another form each time; empty when no such answer came."""
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
