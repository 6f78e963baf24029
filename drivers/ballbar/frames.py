"""Encode and decode ball-bar frames (docs/protocols/ballbar.md), split received bytes into frames in a thread, match replies to requests.

Decoding is pure and total: any bytes give frames or counted bad bytes, never an exception. Replies are matched by tag, so that a late reply
is never taken for the reply to another request.
"""

from __future__ import annotations

import asyncio
import struct
import threading
from binascii import crc_hqx
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar.stream import SegmentEnd, Stream
from abbe.drivers.errors import BadFrame, DriverError, LinkDown, Refused, ReplyTimeout
from abbe.drivers.links.reading import Ring

SYNC = b"\xa5\x5a"
MAX_PAYLOAD = 32
SAMPLE, INFO, ACK, SETTINGS = 0x01, 0x02, 0x03, 0x04
IDENTIFY, START, STOP, READ_SETTINGS, CONFIGURE = 0x81, 0x82, 0x83, 0x84, 0x85
NANOMETRE, TENTH_MICROINCH = 0, 1

ACK_TEXT = {0: "ok", 1: "bad argument", 2: "unknown command"}

# One known length per type that the box sends: this rejects most sync patterns in noise before waiting for a payload.
_LENGTH = {SAMPLE: 18, INFO: 28, ACK: 4, SETTINGS: 12}
_OVERHEAD = 6  # sync, type, length, check sum
_SAMPLE = struct.Struct("<IQiH")
_WHOLE_SAMPLE = struct.Struct("<IIQiHH")
_SAMPLE_HEAD = int.from_bytes(bytes((*SYNC, SAMPLE, 18)), "little")
_SAMPLE_BYTES = _WHOLE_SAMPLE.size
_INFO = struct.Struct("<HIIHHH12s")
_ACK = struct.Struct("<HBB")
_COMMAND = struct.Struct("<HH")
_SETTINGS = struct.Struct("<HBBIi")


@dataclass(frozen=True, slots=True)
class Info:
    """Identity of the box. ``firmware`` is BCD (0x0102 = 1.2); ``rate_hz`` is 0 when the box is not streaming."""

    tag: int
    boot_id: int
    serial_no: int
    firmware: int
    max_rate_hz: int
    rate_hz: int
    model: str


@dataclass(frozen=True, slots=True)
class Ack:
    """Reply to the command with this tag; ``result`` 0 is ok (see ``ACK_TEXT``)."""

    tag: int
    command: int
    result: int


@dataclass(frozen=True, slots=True)
class BoxSettings:
    """Settings of the box: ``number`` counts the changes since power-on and appears in bits 8 to 15 of every sample's status.

    ``unit`` is ``NANOMETRE`` or ``TENTH_MICROINCH``; ``range_nm`` the stroke to either side; ``zero_nm`` is subtracted from every reading.
    """

    tag: int
    number: int
    unit: int
    range_nm: int
    zero_nm: int


@dataclass(frozen=True, slots=True)
class Bad:
    """``n_bytes`` bytes without a usable frame; ``reason``: ``"check sum"`` (wrong), ``"unknown type"`` (of a frame) or ``"garbage"``."""

    reason: str
    n_bytes: int


Answer = Info | Ack | BoxSettings
Frame = BarSample | Answer | Bad


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of bytes (poly 0x1021, init 0xFFFF); ``crc16(b"123456789") == 0x29B1``."""
    return crc_hqx(data, 0xFFFF)


def encode(kind: int, payload: bytes) -> bytes:
    """Wrap a payload into a frame. Raises ValueError if it has more than 32 bytes."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a payload has at most {MAX_PAYLOAD} bytes, not {len(payload)}")
    body = bytes((kind, len(payload))) + payload
    return SYNC + body + struct.pack("<H", crc16(body))


def identify_command(tag: int) -> bytes:
    """Request the identity of the box."""
    return encode(IDENTIFY, struct.pack("<H", tag))


def start_command(tag: int, rate_hz: int) -> bytes:
    """Request a stream of ``rate_hz`` samples per second."""
    return encode(START, _COMMAND.pack(tag, rate_hz))


def stop_command(tag: int) -> bytes:
    """Request the end of the stream."""
    return encode(STOP, struct.pack("<H", tag))


def read_settings_command(tag: int) -> bytes:
    """Request the settings of the box (firmware 1.1 and later)."""
    return encode(READ_SETTINGS, struct.pack("<H", tag))


def configure_command(tag: int, unit: int, range_nm: int, zero_nm: int) -> bytes:
    """Change the settings of the box (firmware 1.1 and later)."""
    return encode(CONFIGURE, _SETTINGS.pack(tag, 0, unit, range_nm, zero_nm))


def reading_text(settings: BoxSettings) -> str:
    """Describe unit, range and zero for error messages."""
    unit = "nm" if settings.unit == NANOMETRE else "0.1 microinch"
    return f"unit {unit}, range {settings.range_nm / 1e6:g} mm, zero {settings.zero_nm} nm"


class FrameDecoder:
    """Turns a byte stream, in pieces of any size, into frames.

    No good frame is lost by noise: if a check sum is wrong, the same bytes are searched again for a valid frame.
    """

    def __init__(self) -> None:
        self._rest = b""

    @property
    def pending(self) -> int:
        """Number of bytes kept as a possible start of a frame (always less than one frame)."""
        return len(self._rest)

    def feed(self, chunk: bytes) -> list[Frame]:
        """Take any number of bytes and return the completed frames.

        Returns
        -------
        list of BarSample, Info, Ack, BoxSettings or Bad
            In order of arrival. Every byte belongs to exactly one of them, or is counted in ``pending``.
        """
        data = self._rest + chunk if self._rest else chunk
        out: list[Frame] = []
        size, at, bad_from, reason = len(data), 0, 0, "garbage"
        while True:
            if at == bad_from:
                at = bad_from = _samples(data, at, out)
            searched_from, at = at, data.find(SYNC, at)
            if at < 0:
                at = size - 1 if data.endswith(b"\xa5", searched_from) else size
                break
            if size - at < 4:
                break
            kind, length = data[at + 2], data[at + 3]
            if length > MAX_PAYLOAD or _LENGTH.get(kind, length) != length:
                at += 2
                continue
            end = at + length + _OVERHEAD
            if end > size:
                break
            if crc_hqx(data[at + 2 : end - 2], 0xFFFF) != data[end - 2] | data[end - 1] << 8:
                at, reason = at + 2, "check sum"
                continue
            if at > bad_from:
                out.append(Bad(reason, at - bad_from))
                reason = "garbage"
            out.append(_frame(kind, data, at + 4, end - at))
            at = bad_from = end
        if at > bad_from:
            out.append(Bad(reason, at - bad_from))
        self._rest = data[at:]
        return out


def _samples(data: bytes, at: int, out: list[Frame]) -> int:
    """Append to ``out`` the SAMPLE frames that follow each other from ``at`` on; return the index after them. Fast path for a good line."""
    view = memoryview(data)
    whole = at + (len(data) - at) // _SAMPLE_BYTES * _SAMPLE_BYTES
    for head, seq, device_us, reading_nm, status, crc in _WHOLE_SAMPLE.iter_unpack(view[at:whole]):
        if head != _SAMPLE_HEAD or crc_hqx(data[at + 2 : at + _SAMPLE_BYTES - 2], 0xFFFF) != crc:
            break
        out.append(_new(BarSample, (seq, device_us, reading_nm, status)))
        at += _SAMPLE_BYTES
    return at


_new = tuple.__new__  # takes half as long as calling the class, which dominates the time of framing


def _frame(kind: int, data: bytes, payload_at: int, n_bytes: int) -> Frame:
    if kind == SAMPLE:
        return BarSample(*_SAMPLE.unpack_from(data, payload_at))
    if kind == ACK:
        return Ack(*_ACK.unpack_from(data, payload_at))
    if kind == SETTINGS:
        return BoxSettings(*_SETTINGS.unpack_from(data, payload_at))
    if kind == INFO:
        tag, boot_id, serial_no, firmware, max_rate_hz, rate_hz, model = _INFO.unpack_from(data, payload_at)
        return Info(tag, boot_id, serial_no, firmware, max_rate_hz, rate_hz, model.rstrip(b"\x00").decode("ascii", "replace"))
    return Bad("unknown type", n_bytes)


_TAKE_S = 3600.0
_STOP_S = 2.0


@dataclass(slots=True)
class BarCounters:
    """Diagnostic counters of the wire: valid frames, and errors, which never reach the data.

    ``bad_frames``: frames with a wrong check sum. ``strays``: impossible samples (see `abbe.drivers.ballbar.stream`). ``lost``: samples
    missing between others. ``overflow``: samples dropped because the consumer of a stream without a tap was too slow.
    """

    frames: int = 0
    bad_bytes: int = 0
    bad_frames: int = 0
    duplicates: int = 0
    strays: int = 0
    lost: int = 0
    overflow: int = 0


class Framing:
    """A thread that turns the ring's bytes into frames until the ring ends, and updates the counters.

    The thread makes these calls in the event loop: ``answered`` with each reply to a command, ``restarted`` with the stream and the reason
    when the box restarts or changes its settings during a stream, ``broken`` with a defect that ended the thread.
    """

    def __init__(
        self,
        name: str,
        ring: Ring,
        counters: BarCounters,
        answered: Callable[[Answer], None],
        restarted: Callable[[Stream, SegmentEnd], None],
        broken: Callable[[Exception], None],
    ) -> None:
        self.ring = ring
        self.stream: Stream | None = None
        """Destination of the samples; set from the event loop between STOP and START."""
        self._counters, self._answered, self._restarted, self._broken = counters, answered, restarted, broken
        self._loop = asyncio.get_running_loop()
        self._overran = False
        ring.on_mark = self._mark
        self._thread = threading.Thread(target=self._run, name=f"frame {name}", daemon=True)
        self._thread.start()

    @property
    def runs(self) -> bool:
        """Whether the thread is alive."""
        return self._thread.is_alive()

    async def drained(self, within_s: float) -> bool:
        """Wait until all bytes read so far are framed and delivered; return False if that takes longer than ``within_s`` seconds."""
        return await asyncio.to_thread(self.ring.drained, within_s) if self.runs else not self.ring.fill

    async def ended(self) -> None:
        """Wait until all bytes read are framed, for at most two seconds: a hanging disk may block the tap."""
        await asyncio.to_thread(self._thread.join, _STOP_S)

    def _run(self) -> None:
        decoder = FrameDecoder()
        try:
            while (pieces := self.ring.take(_TAKE_S)) is not None:
                for piece in pieces:
                    self._overran |= bool(piece.lost_before)
                if pieces:
                    self._sort(pieces[-1].host_s, decoder.feed(b"".join([piece.data for piece in pieces])))
        except Exception as error:  # noqa: BLE001 - a silent end of the thread would look like a silent box
            self._call_in_loop(self._broken, error)

    def _sort(self, host_s: float, received: list[Frame]) -> None:
        samples: list[BarSample] = []
        self._counters.frames += len(received)
        for frame in received:
            if type(frame) is BarSample:
                samples.append(frame)
            elif isinstance(frame, Bad):
                self._counters.bad_bytes += frame.n_bytes
                self._counters.bad_frames += frame.reason == "check sum"
                self._counters.frames -= 1
            else:
                self._give(host_s, samples)  # samples before a reply are stored before the reply is delivered
                samples = []
                self._call_in_loop(self._answered, frame)
        self._give(host_s, samples)

    def _give(self, host_s: float, samples: list[BarSample]) -> None:
        stream = self.stream
        if stream is None or not samples:
            return
        tracker, counters = stream.tracker, self._counters
        before = (tracker.duplicates, tracker.strays, tracker.lost, stream.overflow)
        try:
            stream.put(host_s, samples, overran=self._overran)
            self._overran = False
        except SegmentEnd as event:
            self._call_in_loop(self._restarted, stream, event)
            if self.stream is stream:
                self.stream = None
        counters.duplicates += tracker.duplicates - before[0]
        counters.strays += tracker.strays - before[1]
        counters.lost += tracker.lost - before[2]
        counters.overflow += stream.overflow - before[3]

    def _mark(self, mark: float) -> None:
        stream = self.stream  # the event loop may clear it at any time
        if stream is not None:
            stream.mark(mark)

    def _call_in_loop(self, call: Callable[..., None], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(call, *arguments)


_DRAIN_S = 10.0
_STALL_S = 0.05
_OPERATION = {START: "start stream", STOP: "stop stream", CONFIGURE: "set range and zero"}


class Conversation:
    """Sends requests to the box, one by one or concurrently, and waits for their replies.

    Parameters
    ----------
    send : callable
        Opens the line if necessary, and sends the bytes.
    counters : BarCounters
        Counters of the line: they distinguish a wrong baud rate (bytes without a valid frame) from a silent box (no bytes).
    answer_s : callable
        Returns the longest wait for a reply, s.
    backlog : callable
        Returns the fill (0 to 1) of the ring buffer between reading and framing: above 0, a reply may still wait behind samples.
    """

    def __init__(
        self,
        name: str,
        send: Callable[[bytes], Awaitable[None]],
        counters: BarCounters,
        answer_s: Callable[[], float],
        backlog: Callable[[], float],
    ) -> None:
        self._name, self._send, self._counters, self._answer_s, self._backlog = name, send, counters, answer_s, backlog
        self._open: dict[int, asyncio.Future[Answer]] = {}
        self._tag = 0

    async def identify(self) -> Info:
        """Read the identity of the box.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame
            No connection, no reply, or an invalid one.
        """
        answer = await self._ask(identify_command, "identify")
        if not isinstance(answer, Info):
            raise BadFrame(
                self._name,
                "identify",
                "the reply does not identify the box (ACK instead of INFO)",
                "check that the device at this port is a ball-bar box of protocol version 1",
            )
        return answer

    async def settings(self) -> BoxSettings:
        """Read the settings of the box (firmware 1.1 and later); errors as for ``identify``."""
        answer = await self._ask(read_settings_command, "read settings")
        if not isinstance(answer, BoxSettings):
            raise BadFrame(
                self._name,
                "read settings",
                "the reply does not state the settings (ACK instead of SETTINGS)",
                "update the box's firmware to 1.1 or later",
            )
        return answer

    async def command(self, kind: int, make: Callable[[int], bytes]) -> None:
        """Send a command of this type, which ``make`` builds from its tag, and wait for its ACK.

        Raises
        ------
        Refused
            The box refused the command.
        LinkDown, ReplyTimeout, BadFrame
            As for ``identify``.
        """
        operation = _OPERATION[kind]
        answer = await self._ask(make, operation)
        if not isinstance(answer, Ack) or answer.command != kind:
            raise BadFrame(self._name, operation, "the reply belongs to another command", "end every other program that uses this box")
        if answer.result:
            remedy = "choose a rate that the box supports" if kind == START else "check the settings at the box"
            raise Refused(self._name, operation, ACK_TEXT.get(answer.result, f"result {answer.result}"), remedy)

    def answered(self, frame: Answer) -> None:
        """Deliver a reply; drop it if no request waits for it."""
        future = self._open.get(frame.tag)
        if future is not None and not future.done():
            future.set_result(frame)

    def fail(self, error: LinkDown) -> None:
        """Fail all waiting requests with this error."""
        for future in self._open.values():
            if not future.done():
                future.set_exception(error)

    def forget(self) -> None:
        """Stop waiting for replies."""
        self._open.clear()

    async def _ask(self, make: Callable[[int], bytes], operation: str) -> Answer:
        self._tag = tag = self._tag % 0xFFFF + 1
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._open[tag] = future
        understood, bad = self._counters.frames, self._counters.bad_bytes
        try:
            await self._send(make(tag))
            return await self._waited(future)
        except TimeoutError as error:
            if isinstance(error, DriverError):
                raise
            if self._counters.bad_bytes > bad and self._counters.frames == understood:
                detail = f"{self._counters.bad_bytes - bad} bytes came, but no valid frame of a ball-bar box"
                raise BadFrame(
                    self._name, operation, detail, "set baud rate and parity as on the box; check that it is a ball-bar box"
                ) from None
            detail = f"no answer within {self._answer_s():g} s"
            raise ReplyTimeout(self._name, operation, detail, "switch the box on; check port and baud rate in its URL") from None
        finally:
            self._open.pop(tag, None)

    async def _waited(self, future: asyncio.Future[Answer]) -> Answer:
        loop = asyncio.get_running_loop()
        last_s, waited_longer = loop.time() + _DRAIN_S, False
        while True:
            due_s = loop.time() + self._answer_s()
            try:
                async with asyncio.timeout_at(due_s):
                    return await asyncio.shield(future)
            except TimeoutError as error:
                if isinstance(error, DriverError) or loop.time() > last_s:
                    raise
                stalled = loop.time() - due_s > _STALL_S  # the reply may lie in a buffer: the threads that read it had no core, either
                if not (future.done() or self._backlog() or (stalled and not waited_longer)):
                    raise
                waited_longer |= stalled
