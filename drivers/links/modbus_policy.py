"""What may be repeated, and what an exception code means: two tables, read by the link and by whoever wants to know."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from abbe.drivers.errors import DeviceFault, DriverError, LinkDown, Refused, ReplyTimeout


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
    """What an exception code says, which error it becomes, what a person can do. ``dead``: nobody at the far end answered."""

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
