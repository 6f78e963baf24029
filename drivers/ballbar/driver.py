"""Conversation with a ball-bar's interface box."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from drivers.api import BarBatch, BarSample, DeviceInfo
from drivers.ballbar import frames
from drivers.ballbar.sequence import Run, SequenceRestart, SequenceTracker
from drivers.errors import BadFrame, DriverError, LinkDown, Rebooted, Refused, ReplyTimeout
from drivers.links.serial_link import ByteLink
from drivers.links.shielded import run_to_end

_ANSWER_S = 1.0
_BUFFER_S = 30.0
_READ_BYTES = 65536
_PUMP_S = 3600.0


@dataclass(slots=True)
class BarCounters:
    """What went wrong on the wire so far, for diagnostics; none of it reaches the data."""

    bad_bytes: int = 0
    duplicates: int = 0
    overflow: int = 0


class _Stream:
    """The buffer between the wire and a consumer who may be slow: bounded, and what does not fit is reported as missing."""

    def __init__(self, rate_hz: int) -> None:
        self.tracker = SequenceTracker(rate_hz)
        self._room = int(_BUFFER_S * rate_hz)
        self._batches: deque[BarBatch] = deque()
        self._lost = 0
        self._error: DriverError | None = None
        self._news = asyncio.Event()

    def put(self, host_s: float, runs: list[Run]) -> int:
        """Take what arrived; return how many samples did not fit."""
        dropped = 0
        for run in runs:
            if len(run.samples) > self._room:
                self._lost += run.missing + len(run.samples)
                dropped += len(run.samples)
                continue
            self._room -= len(run.samples)
            self._batches.append(BarBatch(host_s, run.samples, run.missing + self._lost))
            self._lost = 0
        if self._batches:
            self._news.set()
        return dropped

    def fail(self, error: DriverError) -> None:
        """End the stream after what is already buffered."""
        if self._error is None:
            self._error = error
        self._news.set()

    async def get(self, timeout_s: float) -> BarBatch:
        """Wait for the next batch; TimeoutError when none comes."""
        if not self._batches and self._error is None:
            async with asyncio.timeout(timeout_s):
                await self._news.wait()
        if self._batches:
            batch = self._batches.popleft()
            self._room += len(batch.samples)
            if not self._batches and self._error is None:
                self._news.clear()
            return batch
        assert self._error is not None
        raise self._error


class SerialBallBar:
    """A telescoping ball-bar on a serial line or a serial device server (docs/protocols/ballbar.md).

    Parameters
    ----------
    link : ByteLink
        Where the box is; opened on first use, and again after the device was lost.
    """

    def __init__(self, link: ByteLink) -> None:
        self._link = link
        self.name = link.name
        self.counters = BarCounters()
        self._pump: asyncio.Task[None] | None = None
        self._answers: dict[int, asyncio.Future[frames.Info | frames.Ack]] = {}
        self._tag = 0
        self._boot_id: int | None = None
        self._stream: _Stream | None = None
        self._streaming = False

    async def open(self) -> None:
        """Open the line; does nothing when it is open.

        Raises
        ------
        LinkDown
            The port cannot be opened.
        """
        if self._pump is not None and not self._pump.done():
            return
        await self._link.close()
        await self._link.open()
        self._pump = asyncio.get_running_loop().create_task(self._read_forever(), name=f"read {self.name}")

    async def identify(self) -> DeviceInfo:
        """Ask the box who it is, and accept its boot id as the one that counts from now on.

        Raises
        ------
        LinkDown, ReplyTimeout
            Nobody there, or no answer.
        """
        info = await self._who()
        self._boot_id = info.boot_id
        firmware = f"{info.firmware >> 8:x}.{info.firmware & 0xFF:x}"
        return DeviceInfo("ballbar", info.model, str(info.serial_no), info.boot_id, firmware)

    @asynccontextmanager
    async def stream(self, rate_hz: int) -> AsyncIterator[AsyncIterator[BarBatch]]:
        """Stream samples while the context is open; the box is told to stop when it ends, however it ends.

        Parameters
        ----------
        rate_hz : int
            Samples per second of device time; must divide 1000.

        Yields
        ------
        AsyncIterator of BarBatch
            ``missing`` counts samples that the wire lost or that a consumer more than 30 s behind let go. The iterator
            raises ``Rebooted`` when the box restarted, ``ReplyTimeout`` after max(1 s, 50 periods) of silence, ``LinkDown``.

        Raises
        ------
        Refused
            The box does not accept this rate, or is already streaming to somebody here.
        Rebooted
            The box has restarted since ``identify``.
        """
        if rate_hz <= 0 or 1000 % rate_hz:
            raise Refused(self.name, "start stream", f"{rate_hz} Hz does not divide 1000", "choose 1000, 500, 250, 200, 125, 100 ...")
        if self._streaming:
            raise Refused(self.name, "start stream", "a stream is already running", "leave it first")
        self._streaming = True
        try:
            await self._check_boot()
            # A box left streaming by a crashed program still sends: stop it, so that old samples cannot enter the new stream.
            await self._command(frames.STOP, None)
            stream = self._stream = _Stream(rate_hz)
            await self._command(frames.START, rate_hz)
            yield self._batches(stream, max(1.0, 50 / rate_hz))
        finally:
            self._stream = None
            try:
                await run_to_end(self._stop_quietly())
            finally:
                self._streaming = False

    async def close(self) -> None:
        """Close the line. Closing twice does nothing."""
        pump, self._pump = self._pump, None
        if pump is not None:
            pump.cancel()
            await asyncio.wait([pump])
        await self._link.close()

    async def _batches(self, stream: _Stream, silence_s: float) -> AsyncIterator[BarBatch]:
        while True:
            try:
                batch = await stream.get(silence_s)
            except TimeoutError:
                break
            yield batch
        # Silence: a box that restarted sits there idle. Ask, so that the user hears the true reason.
        await self._check_boot()
        raise ReplyTimeout(self.name, "read samples", f"no sample for {silence_s:g} s", "box switched off, or stopped by another program?")

    async def _stop_quietly(self) -> None:
        try:
            await self._command(frames.STOP, None)
        except DriverError:
            # The box is gone or mute: the reason already reaches the user from the stream itself, and the next stream stops it first.
            self._answers.clear()

    async def _check_boot(self) -> None:
        info = await self._who()
        if self._boot_id is None:
            self._boot_id = info.boot_id
        if info.boot_id != self._boot_id:
            raise self._rebooted(f"boot id {info.boot_id:#x} instead of {self._boot_id:#x}")

    async def _who(self) -> frames.Info:
        tag = self._next_tag()
        answer = await self._ask(tag, frames.identify_command(tag), "identify")
        if not isinstance(answer, frames.Info):
            raise BadFrame(self.name, "identify", "an ACK came instead of the INFO", "is this a ball-bar box of protocol version 1?")
        return answer

    async def _command(self, kind: int, rate_hz: int | None) -> None:
        tag = self._next_tag()
        operation = "start stream" if kind == frames.START else "stop stream"
        data = frames.stop_command(tag) if rate_hz is None else frames.start_command(tag, rate_hz)
        answer = await self._ask(tag, data, operation)
        if not isinstance(answer, frames.Ack) or answer.command != kind:
            raise BadFrame(self.name, operation, "the answer belongs to another command", "is another program talking to this box?")
        if answer.result:
            raise Refused(
                self.name, operation, frames.ACK_TEXT.get(answer.result, f"result {answer.result}"), "is the rate one the box can do?"
            )

    def _next_tag(self) -> int:
        self._tag = self._tag % 0xFFFF + 1
        return self._tag

    async def _ask(self, tag: int, data: bytes, operation: str) -> frames.Info | frames.Ack:
        await self.open()
        future: asyncio.Future[frames.Info | frames.Ack] = asyncio.get_running_loop().create_future()
        self._answers[tag] = future
        try:
            await self._link.write(data, timeout_s=_ANSWER_S)
            async with asyncio.timeout(_ANSWER_S):
                return await future
        except TimeoutError as error:
            if isinstance(error, DriverError):
                raise
            raise ReplyTimeout(self.name, operation, f"no answer within {_ANSWER_S:g} s", "box on? baud rate and port right?") from None
        finally:
            self._answers.pop(tag, None)

    async def _read_forever(self) -> None:
        decoder = frames.FrameDecoder()
        try:
            while True:
                try:
                    host_s, data = await self._link.read(_READ_BYTES, timeout_s=_PUMP_S)
                except ReplyTimeout:
                    continue  # silence is judged by those who wait for something
                self._sort(host_s, decoder.feed(data))
        except LinkDown as error:
            self._fail(error)

    def _sort(self, host_s: float, received: list[frames.Frame]) -> None:
        samples: list[BarSample] = []
        for frame in received:
            if isinstance(frame, BarSample):
                samples.append(frame)
            elif isinstance(frame, frames.Bad):
                self.counters.bad_bytes += frame.n_bytes
            else:
                self._answer(frame)
        stream = self._stream
        if stream is None or not samples:
            return
        before = stream.tracker.duplicates
        try:
            self.counters.overflow += stream.put(host_s, stream.tracker.accept(samples))
        except SequenceRestart as event:
            stream.fail(self._rebooted(str(event)))
        self.counters.duplicates += stream.tracker.duplicates - before

    def _answer(self, frame: frames.Info | frames.Ack) -> None:
        if isinstance(frame, frames.Info) and self._stream is not None and self._boot_id not in (None, frame.boot_id):
            self._stream.fail(self._rebooted(f"boot id {frame.boot_id:#x} instead of {self._boot_id:#x}"))
        future = self._answers.get(frame.tag)
        if future is not None and not future.done():
            future.set_result(frame)

    def _fail(self, error: LinkDown) -> None:
        for future in self._answers.values():
            if not future.done():
                future.set_exception(error)
        if self._stream is not None:
            self._stream.fail(error)

    def _rebooted(self, detail: str) -> Rebooted:
        return Rebooted(self.name, "stream", detail, "the box restarted: call identify, then measure this test again")
