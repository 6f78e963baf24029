"""Faults of Modbus requests and replies on the line, from a fault scenario. Pure: proxies and lines call it.

This file also cuts MBAP (TCP) and RTU frames out of a stream, decodes and encodes them, and answers requests from a register map.

A fault hits a request and its reply. ``on`` selects the requests that count: any, read, write, or those with a certain first register
(``write 64``); ``at`` is the number of the request among them, from 0. The kinds, and the keys of a fault that they use:

==================  ========================================================================================================
drop_request        the device never sees the request
drop_reply          the device executes the request, the host gets no reply
delay_reply         the answer comes ``seconds`` later, and all later answers after it, as from a device that does one thing at a time
latency             the answer takes ``seconds`` to arrive, with a probability of ``value`` percent (0: always)
duplicate_reply     a copy of the answer follows after ``seconds``
swap_replies        the answer comes after the answer to the next request
twice               the answer and a copy of it in one segment
one_byte            every byte is a segment of its own, ``seconds`` apart
split               the answer comes in two halves, ``seconds`` apart
cut                 only the first ``value`` bytes arrive
flip                bit ``value`` of the answer is flipped
noise_before        ``data`` in front of the answer, in the same segment
noise_after         ``data`` behind the answer, in the same segment
echo                the request itself comes back first, as on a two-wire line
instead             the answer has the PDU ``data``, in a valid frame
set_unit            the answer has unit ``value``; likewise set_tid, set_pid, set_length, set_function, set_byte_count,
                    set_address, set_count
more_registers      the answer has ``value`` registers too many (below 0: too few) in an otherwise valid frame
exception           exception code ``value`` instead of the answer; the device does not see the request
exception_after     as ``exception``, but the device executes the request first
black_hole          from here on nothing passes, but the connection stays open
fin, rst            the connection is closed or reset instead of the answer; fin_before, rst_before: before the device sees the request
==================  ========================================================================================================
"""

import random
import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from abbe.simulators.faults.scenario import Fault, FaultScenario
from abbe.simulators.modbus_wire import RegisterMap

MBAP, RTU = "mbap", "rtu"
READS, WRITES = (1, 2, 3, 4), (5, 6, 15, 16)
_HEADER = 7


def crc16(data: bytes) -> bytes:
    """Return the check sum of an RTU frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


@dataclass(frozen=True, slots=True)
class Frame:
    """The fields of a frame. ``tid``, ``pid``, ``length`` exist only in MBAP frames; a ``length`` of None is computed."""

    unit: int
    pdu: bytes
    tid: int = 0
    pid: int = 0
    length: int | None = None

    def bytes(self, framing: str) -> bytes:
        """Return the frame as bytes on the wire."""
        if framing == RTU:
            body = bytes([self.unit]) + self.pdu
            return body + crc16(body)
        length = len(self.pdu) + 1 if self.length is None else self.length
        return struct.pack(">HHHB", self.tid, self.pid, length, self.unit) + self.pdu


def parts(data: bytes, framing: str) -> Frame:
    """Decode one whole frame into its fields."""
    if framing == RTU:
        return Frame(data[0], data[1:-2])
    tid, pid, length, unit = struct.unpack_from(">HHHB", data)
    return Frame(unit, data[_HEADER:], tid, pid, length)


class Cutter:
    """Cuts a stream of valid frames. ``requests``: direction of the stream, because RTU frames do not state their length."""

    def __init__(self, framing: str, *, requests: bool) -> None:
        self._framing, self._requests = framing, requests
        self._held = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and return the frames that they complete."""
        self._held += data
        frames = []
        while (size := self._size()) and len(self._held) >= size:
            frames.append(self._held[:size])
            self._held = self._held[size:]
        return frames

    def _size(self) -> int:
        """Return the length of the first frame, 0 while unknown."""
        held = self._held
        if self._framing == MBAP:
            return 6 + int.from_bytes(held[4:6], "big") if len(held) >= _HEADER else 0
        if len(held) < 3:
            return 0
        function = held[1]
        if self._requests:
            if function in (15, 16):
                return 9 + held[6] if len(held) >= 7 else 0
            return 8
        if function & 0x80:
            return 5
        return 5 + held[2] if function in READS else 8


def answer(registers: RegisterMap, pdu: bytes) -> bytes:
    """Return the answer of a device with this register map to a request PDU (functions 3, 4, 6, 16)."""
    function, address, count = struct.unpack_from(">BHH", pdu)
    if function in (3, 4):
        words = registers.read(address, count) if 1 <= count <= 125 else None
        return bytes([function | 0x80, 2]) if words is None else struct.pack(f">BB{count}H", function, 2 * count, *words)
    if function == 16:
        taken = registers.write(address, list(struct.unpack_from(f">{count}H", pdu, 6)))
    elif function == 6:
        taken = registers.write(address, [count])
    else:
        return bytes([function | 0x80, 1])
    return pdu[:5] if taken else bytes([function | 0x80, 2])


SORTS = ("any", "read", "write")
_BEFORE = ("drop_request", "exception", "fin_before", "rst_before", "black_hole")


@dataclass(frozen=True, slots=True)
class Act:
    """Bytes to send to the host ``after_s`` from now, or how to end the connection (``fin``, ``rst``)."""

    data: bytes = b""
    after_s: float = 0.0
    end: str = ""


@dataclass(slots=True)
class _Open:
    """A request passed to the device, and the faults of its reply."""

    frame: bytes
    faults: list[Fault]


@dataclass(slots=True)
class Toxics:
    """The faults of one connection between host and device.

    Parameters
    ----------
    scenario : FaultScenario
        Which faults, and when.
    framing : str
        ``mbap`` or ``rtu``.
    """

    scenario: FaultScenario
    framing: str
    free_at_s: float = float("-inf")
    """Loop time at which the device has finished its requests; the next scenario takes it over."""
    dead: bool = False
    requests: int = 0
    _seen: Counter[str] = field(default_factory=Counter)
    _open: deque[_Open] = field(default_factory=deque)
    _held: list[bytes] = field(default_factory=list)
    _draw: random.Random = field(init=False)

    def __post_init__(self) -> None:
        """Check the scenario."""
        self.scenario.check(KINDS, {*SORTS, *(fault.on for fault in self.scenario.faults if fault.on.partition(" ")[0] in SORTS)})
        self._draw = random.Random(self.scenario.seed)

    def request(self, frame: bytes) -> tuple[bytes, list[Act]]:
        """Handle a request from the host: return the bytes for the device (empty: none), and what the host gets at once."""
        faults = self._hit(frame)
        self.requests += 1
        kinds = {fault.kind: fault for fault in faults}
        if "black_hole" in kinds:
            self.dead = True
        if self.dead or "drop_request" in kinds:
            return b"", []
        for end in ("fin", "rst"):
            if f"{end}_before" in kinds:
                return b"", [Act(end=end)]
        if "exception" in kinds:
            return b"", [Act(self._exception(frame, kinds["exception"].value))]
        self._open.append(_Open(frame, faults))
        return frame, [Act(frame)] if "echo" in kinds else []

    def reply(self, frame: bytes, now_s: float) -> list[Act]:
        """Handle a reply from the device: return what the host gets, and when."""
        asked = self._open.popleft() if self._open else _Open(b"", [])
        kinds = {fault.kind: fault for fault in asked.faults}
        if self.dead or "drop_reply" in kinds:
            return []
        for end in ("fin", "rst"):
            if end in kinds:
                return [Act(end=end)]
        if "exception_after" in kinds:
            frame = self._exception(asked.frame, kinds["exception_after"].value)
        for fault in asked.faults:
            if fault.kind in _CHANGES:
                frame = _CHANGES[fault.kind](frame, fault, self.framing)
        wait_s = self._wait_s(asked.faults, now_s)
        if "swap_replies" in kinds:
            self._held.append(frame)
            return []
        acts = [Act(frame, wait_s)]
        for fault in asked.faults:
            if fault.kind in _WAYS:
                acts = _WAYS[fault.kind](acts[0], fault)
        held, self._held = self._held, []
        return acts + [Act(late, acts[-1].after_s) for late in held]

    def _hit(self, frame: bytes) -> list[Fault]:
        pdu = parts(frame, self.framing).pdu
        sort = "read" if pdu[0] in READS else "write"
        sorts = ("any", sort, f"{sort} {int.from_bytes(pdu[1:3], 'big')}")
        faults = [fault for fault in self.scenario.faults if fault.on in sorts and fault.hits(self._seen[fault.on])]
        self._seen.update(sorts)
        return faults

    def _wait_s(self, faults: list[Fault], now_s: float) -> float:
        busy_s = way_s = 0.0
        for fault in faults:
            if fault.kind == "delay_reply":
                busy_s += fault.seconds
            elif fault.kind == "latency" and not (fault.value and self._draw.random() * 100 >= fault.value):
                way_s += fault.seconds
        self.free_at_s = max(max(self.free_at_s, now_s) + busy_s, now_s + way_s)
        return self.free_at_s - now_s

    def _exception(self, request: bytes, code: int) -> bytes:
        asked = parts(request, self.framing)
        return replace(asked, pdu=bytes([asked.pdu[0] | 0x80, code]), length=None).bytes(self.framing)


def _set(name: str) -> Callable[[bytes, Fault, str], bytes]:
    def change(frame: bytes, fault: Fault, framing: str) -> bytes:
        whole = parts(frame, framing)
        fields: dict[str, Any] = {name: fault.value}
        return replace(whole, **fields).bytes(framing)

    return change


def _put(at: int, size: int) -> Callable[[bytes, Fault, str], bytes]:
    def change(frame: bytes, fault: Fault, framing: str) -> bytes:
        whole = parts(frame, framing)
        pdu = whole.pdu[:at] + fault.value.to_bytes(size, "big") + whole.pdu[at + size :]
        return replace(whole, pdu=pdu).bytes(framing)

    return change


def _more(frame: bytes, fault: Fault, framing: str) -> bytes:
    whole = parts(frame, framing)
    data = whole.pdu[2:] + bytes(2 * max(fault.value, 0))
    data = data[: len(data) + 2 * min(fault.value, 0)]
    return Frame(whole.unit, bytes([whole.pdu[0], len(data) & 0xFF]) + data, whole.tid, whole.pid).bytes(framing)


def _instead(frame: bytes, fault: Fault, framing: str) -> bytes:
    return replace(parts(frame, framing), pdu=bytes.fromhex(fault.data), length=None).bytes(framing)


def _flip(frame: bytes, fault: Fault, _framing: str) -> bytes:
    bit = fault.value % (8 * len(frame))
    return frame[: bit // 8] + bytes([frame[bit // 8] ^ 1 << bit % 8]) + frame[bit // 8 + 1 :]


_CHANGES: dict[str, Callable[[bytes, Fault, str], bytes]] = {
    "set_unit": _set("unit"),
    "set_tid": _set("tid"),
    "set_pid": _set("pid"),
    "set_length": _set("length"),
    "set_function": _put(0, 1),
    "set_byte_count": _put(1, 1),
    "set_address": _put(1, 2),
    "set_count": _put(3, 2),
    "more_registers": _more,
    "instead": _instead,
    "flip": _flip,
    "cut": lambda frame, fault, _framing: frame[: fault.value],
    "noise_before": lambda frame, fault, _framing: bytes.fromhex(fault.data) + frame,
    "noise_after": lambda frame, fault, _framing: frame + bytes.fromhex(fault.data),
    "twice": lambda frame, _fault, _framing: 2 * frame,
    "echo": lambda frame, _fault, _framing: frame,
}


def _one_byte(act: Act, fault: Fault) -> list[Act]:
    return [Act(act.data[i : i + 1], act.after_s + i * fault.seconds) for i in range(len(act.data))]


def _split(act: Act, fault: Fault) -> list[Act]:
    half = len(act.data) // 2
    return [Act(act.data[:half], act.after_s), Act(act.data[half:], act.after_s + fault.seconds)]


_WAYS: dict[str, Callable[[Act, Fault], list[Act]]] = {
    "duplicate_reply": lambda act, fault: [act, Act(act.data, act.after_s + fault.seconds)],
    "one_byte": _one_byte,
    "split": _split,
    "swap_replies": lambda act, _fault: [act],
}
KINDS = (*_CHANGES, *_WAYS, *_BEFORE, "drop_reply", "delay_reply", "latency", "fin", "rst", "exception_after")
