"""Driver of a ball-bar's interface box."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from abbe.drivers.api import BarBatch, BarTap, DeviceInfo
from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import BarCounters, Conversation, Framing
from abbe.drivers.ballbar.stream import SLOW, OtherPace, OtherSettings, Reads, SegmentEnd, Stream
from abbe.drivers.errors import (
    Backpressure,
    DeviceFault,
    DriverError,
    LinkDown,
    LossyLine,
    Rebooted,
    Refused,
    ReplyTimeout,
    SettingsChanged,
    WrongDevice,
    run_to_end,
)
from abbe.drivers.links.incidents import Backoff, Incidents
from abbe.drivers.links.reading import Ring
from abbe.drivers.links.serial_link import ByteLink

_ANSWER_S = 1.0
_SAMPLE_TIMEOUT_S = 1.0
_BUFFER_S = 30.0
_FRAME_BYTES = 24
_DRAIN_S = 10.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.1, 2.0
_MAX_RATE_HZ = 1000
_SETTINGS_FIRMWARE = 0x0101
_RESTORE = "set unit, range and zero of the box back, then measure this test again"


class Box:
    """Verifies that identity and settings of a box stay the same. ``serial_no``: the only accepted box; None: the first that answers."""

    def __init__(self, name: str, talk: Conversation, serial_no: int | None) -> None:
        self.boot_id: int | None = None
        self.settings: frames.BoxSettings | None = None
        self._name, self._talk, self._serial_no = name, talk, serial_no
        self._first: frames.BoxSettings | None = None
        self._max_rate_hz = 0

    @property
    def reads(self) -> Reads | None:
        """Change counter and measuring range of the settings; None if the box does not report them."""
        return None if self.settings is None else Reads(self.settings.number, self.settings.range_nm)

    async def accept(self) -> frames.Info:
        """Read identity and settings, and accept the boot id as the current one.

        Raises
        ------
        WrongDevice
            Another box answers.
        LinkDown, ReplyTimeout, BadFrame
            Communication failed.
        """
        info = await self._talk.identify()
        if self._serial_no not in (None, info.serial_no):
            detail = f"the box with serial number {info.serial_no} answers instead of {self._serial_no}"
            raise WrongDevice(self._name, "identify", detail, "plug in the right box, or configure this one as a device of its own")
        if info.firmware >= _SETTINGS_FIRMWARE:
            self.settings = await self._talk.settings()
            self._first = self._first or self.settings
        self.boot_id, self._serial_no, self._max_rate_hz = info.boot_id, info.serial_no, info.max_rate_hz
        return info

    async def peek(self) -> int:
        """Read the boot id, but do not store it as the current one; failed communication raises the errors named in `accept`."""
        return (await self._talk.identify()).boot_id

    async def check_boot(self) -> None:
        """Read identity and settings again; raises the errors of `accept`, and ``Rebooted`` if the box restarted."""
        known = self.boot_id
        info = await self.accept()
        if known not in (None, info.boot_id):
            self.boot_id = known
            raise self.rebooted(f"boot id {info.boot_id:#x} instead of {known:#x}")

    def check_settings(self) -> None:
        """Raise ``SettingsChanged`` if unit, range or zero changed since the first identification, or if the unit is inches."""
        now, first = self.settings, self._first
        if now is None or first is None:
            return
        if (now.unit, now.range_nm, now.zero_nm) != (first.unit, first.range_nm, first.zero_nm):
            detail = f"the box is set to {frames.reading_text(now)} instead of {frames.reading_text(first)}"
            raise SettingsChanged(self._name, "start stream", detail, _RESTORE)
        if now.unit != frames.NANOMETRE:
            raise SettingsChanged(
                self._name, "start stream", "the box reads in inches", "switch the box to millimetres, then connect again"
            )

    def check_can(self, rate_hz: int, range_mm: float) -> None:
        """Raise ``Refused`` if the rate or stroke exceeds a limit that the box reports."""
        if 0 < self._max_rate_hz < rate_hz:
            detail = f"{rate_hz} Hz requested, but the box sends at most {self._max_rate_hz} Hz"
            raise Refused(self._name, "check", detail, "choose a lower rate")
        if self.settings is not None and self.settings.range_nm < range_mm * 1e6:
            detail = f"its range is set to +-{self.settings.range_nm * 1e-6:g} mm, but +-{range_mm:g} mm are needed"
            raise Refused(self._name, "check", detail, "set a larger range at the box")

    async def restore(self) -> None:
        """Restore unit, range and zero of the first identification; raises the errors of `accept`, and ``Refused``."""
        first = self._first
        if first is not None:
            await self._talk.command(frames.CONFIGURE, lambda tag: frames.configure_command(tag, first.unit, first.range_nm, first.zero_nm))
        await self.accept()

    def error_of(self, end: SegmentEnd) -> DriverError:
        """Return the driver error for a stream that cannot continue."""
        if isinstance(end, OtherSettings):
            return SettingsChanged(self._name, "stream", str(end), _RESTORE)
        if isinstance(end, OtherPace):
            return DeviceFault(self._name, "stream", str(end), "end any other program that uses the box, then measure this test again")
        return self.rebooted(str(end))

    def rebooted(self, detail: str) -> Rebooted:
        """Return the error for a box that restarted."""
        return Rebooted(self._name, "stream", detail, "the box restarted: connect to it again, then measure this test again")


class SerialBallBar:
    """A telescoping ball-bar on a serial line or a serial device server (docs/protocols/ballbar.md).

    The link opens on first use, and again after a loss of the device. The driver accepts only the box with
    the serial number in the URL; if the URL has none, only the first box that answers.

    ``ring_s``: capacity of the ring buffer behind the reading thread, s at 1000 Hz.
    """

    def __init__(self, link: ByteLink, *, ring_s: float = _BUFFER_S) -> None:
        self._link = link
        self.name = link.name
        self.counters = BarCounters()
        self._ring_bytes = int(ring_s * _MAX_RATE_HZ * _FRAME_BYTES)
        self._framing: Framing | None = None
        self.incidents = Incidents()
        self._talk = Conversation(self.name, self._send, self.counters, lambda: _ANSWER_S, lambda: self.backlog)
        self._box = Box(self.name, self._talk, link.serial_no)
        self._stream: Stream | None = None
        self._streaming = False

    async def open(self) -> None:
        """Open the line if it is not open.

        Raises
        ------
        LinkDown
            The port cannot be opened or read.
        """
        if self._link.is_open and self._framing is not None and self._framing.runs:
            return
        await self._hang_up()
        await self._link.open()
        ring = Ring(self._ring_bytes)
        try:
            self._framing = Framing(self.name, ring, self.counters, self._answer, self._restarted, self._broken)
            self._link.start_reading(ring, self._fail)
        except (LinkDown, OSError, RuntimeError) as error:  # lost at once, or no more descriptors or threads
            ring.end()
            await self._hang_up()
            if isinstance(error, LinkDown):
                raise
            remedy = "end other programs, or raise the limit of open files"
            raise LinkDown(self.name, "open", f"the connection was opened but cannot be read: {error}", remedy) from error

    async def identify(self) -> DeviceInfo:
        """Read identity and settings of the box, and accept its boot id as the current one.

        Raises
        ------
        WrongDevice
            Not the same box as before, or not the one in the URL.
        LinkDown, ReplyTimeout, BadFrame
            No connection, no reply, or an invalid one.
        """
        try:
            info = await self._box.accept()
        except DriverError as error:
            self.incidents.note(error, latched=isinstance(error, _LATCHED))
            raise
        self.incidents.accepted()
        firmware = f"{info.firmware >> 8:x}.{info.firmware & 0xFF:x}"
        return DeviceInfo("ballbar", info.model, str(info.serial_no), info.boot_id, firmware)

    async def peek_boot_id(self) -> int | None:
        """Read the boot id of the box, but do not store it as the current one; None without a reply."""
        try:
            return await self._box.peek()
        except DriverError:
            return None

    async def recover(self, *, within_s: float) -> DeviceInfo:
        """Retry until the same box answers again, for example after its cable was pulled; reopen the line as often as needed.

        The waits between attempts grow from 0.1 to 2 s.

        Raises
        ------
        WrongDevice
            Another box answers: no further attempt.
        LinkDown, ReplyTimeout, BadFrame
            Error of the last attempt within ``within_s`` seconds.
        """
        clock = asyncio.get_running_loop().time
        until_s, backoff = clock() + within_s, Backoff(_FIRST_WAIT_S, _LONGEST_WAIT_S)
        while True:
            backoff.attempted()
            try:
                return await self.identify()
            except WrongDevice:
                raise
            except DriverError:
                if clock() + backoff.left_s() > until_s:
                    raise
            await self._hang_up()  # a silent line may be stuck: reopen it
            await backoff.due()

    async def make_ready(self, *, within_s: float) -> DeviceInfo:
        """Prepare a new stream: recover the same box if necessary, and restore its first settings after a restart.

        The new stream must not be joined to earlier ones.

        Raises
        ------
        Rebooted
            The box restarted and does not report its settings (firmware 1.0): a person must check them.
        WrongDevice, Refused, LinkDown, ReplyTimeout, BadFrame
            As for ``recover`` and ``restore_settings``.
        """
        known = self._box.boot_id
        info = await self.recover(within_s=within_s)
        if known in (None, info.boot_id):
            return info
        error = self._box.rebooted(f"boot id {info.boot_id:#x} instead of {known:#x}")
        self.incidents.note(error, latched=True)
        if self._box.settings is None:
            self._box.boot_id = known  # not accepted yet
            raise error
        await self.restore_settings()
        self.incidents.accepted()
        return info

    async def check(self, rate_hz: int, *, range_mm: float) -> None:
        """Check whether a stream could begin now, without starting it.

        Parameters
        ----------
        rate_hz : int
            Samples per second; 0: any.
        range_mm : float
            Needed stroke to either side, mm; not checked for firmware 1.0, which does not report its range.

        Raises
        ------
        Refused
            Rate or stroke exceed those of the box.
        SettingsChanged, Rebooted, LinkDown, ReplyTimeout, BadFrame, WrongDevice
            As for ``stream``.
        """
        await self._box.check_boot()
        self._box.check_settings()
        self._box.check_can(rate_hz, range_mm)

    async def restore_settings(self) -> None:
        """Restore the unit, range and zero that the box had at its first identification.

        Raises
        ------
        Refused
            The box refuses them.
        LinkDown, ReplyTimeout, BadFrame, WrongDevice
            As for ``identify``.
        """
        await self._box.restore()

    @asynccontextmanager
    async def stream(self, rate_hz: int, tap: BarTap | None = None) -> AsyncIterator[AsyncIterator[BarBatch]]:
        """Stream samples while the context is open; always stop the box at the end.

        Parameters
        ----------
        rate_hz : int
            Samples per second of device time; must divide 1000.
        tap : BarTap, optional
            Recorder that gets every sample until the box has stopped, before the consumer and independent of the consumer's speed.

        Yields
        ------
        AsyncIterator of BarBatch
            ``missing`` counts samples lost on the wire, or (without a tap) dropped because the consumer was more than 30 s behind. The
            iterator raises ``Rebooted`` after a restart of the box, ``SettingsChanged`` after a change of unit, range or zero,
            ``DeviceFault`` if sample numbers and device clock disagree, ``LossyLine`` after too many losses, ``ReplyTimeout`` after
            max(1 s, 50 periods) without a sample, ``LinkDown`` after a loss of the connection, and with a tap ``Backpressure`` as soon as
            the ring buffer or the consumer's buffer is 80 % full.

        Raises
        ------
        Refused
            The box does not accept this rate, or already streams to another caller in this process.
        Rebooted
            The box has restarted since ``identify``.
        SettingsChanged
            The settings differ from those at the first identification: call ``restore_settings``.
        LossyLine
            At the end: the whole stream lost more than 0.1 % of its samples.
        Backpressure
            At the end: received samples did not reach the tap within 10 s.
        """
        if rate_hz <= 0 or 1000 % rate_hz:
            raise Refused(self.name, "start stream", f"{rate_hz} Hz does not divide 1000", "choose 1000, 500, 250, 200, 125, 100 ...")
        if self._streaming:
            raise Refused(self.name, "start stream", "a stream is already running", "end the running stream first")
        self._streaming = through = True
        try:
            await self._ready()
            stream = Stream(self.name, rate_hz, _BUFFER_S, tap, self._box.boot_id or 0, reads=self._box.reads)
            bad_bytes = self.counters.bad_bytes
            self._attach(stream)
            self.incidents.good()
            await self._talk.command(frames.START, lambda tag: frames.start_command(tag, rate_hz))
            yield self._batches(stream, max(_SAMPLE_TIMEOUT_S, 50 / rate_hz))
            self._judge(stream, self.counters.bad_bytes - bad_bytes)
        except DriverError as error:
            if error.device == self.name:  # the caller may have failed at another device
                self.incidents.note(error, latched=isinstance(error, _LATCHED))
            raise
        finally:
            if self._stream is not None:
                self._stream.leave()
            try:
                await run_to_end(self._stop_quietly())
                if self._stream is not None:
                    through = await run_to_end(self._delivered())
                    await run_to_end(asyncio.to_thread(self._stream.finish))
            finally:
                self._attach(None)
                self._streaming = False
        if not through:  # another error already marks the run as incomplete
            waited = Backpressure(self.name, "end stream", f"samples are still not stored {_DRAIN_S:g} s after the box stopped", SLOW)
            self.incidents.note(waited)
            raise waited

    async def _delivered(self) -> bool:
        """Wait until the tap has all received samples. Return False if it takes too long."""
        return self._framing is None or self._stream is None or self._stream.tap is None or await self._framing.drained(_DRAIN_S)

    async def close(self) -> None:
        """Close the line. Closing twice does nothing."""
        await self._hang_up()
        self.incidents.closed()

    async def _hang_up(self) -> None:
        framing, self._framing = self._framing, None
        await self._link.close()  # reads first what the kernel still holds; all of it is framed and delivered
        if framing is not None:
            await framing.ended()

    def _attach(self, stream: Stream | None) -> None:
        self._stream = stream
        if self._framing is not None:
            self._framing.stream = stream

    @property
    def state(self) -> str:
        """``ready``, ``streaming``, ``down`` (the next call opens the line) or ``aborted: CODE`` until the next stream or identify."""
        if self.incidents.open is not None:
            return f"aborted: {self.incidents.open.code}"
        if not self._link.is_open:
            return "down"
        return "streaming" if self._streaming else "ready"

    @property
    def settings(self) -> frames.BoxSettings | None:
        """Last known settings of the box; None before `identify`, and with firmware 1.0, which reports none."""
        return self._box.settings

    @property
    def backlog(self) -> float:
        """Fill level of the ring buffer between reading and storing, 0 to 1."""
        return 0.0 if self._framing is None else self._framing.ring.fill

    async def _batches(self, stream: Stream, timeout_s: float) -> AsyncIterator[BarBatch]:
        while True:
            try:
                batch = await stream.get(timeout_s)
            except TimeoutError:
                break
            yield batch
        # Silence: a restarted box is idle. Check for that, so that the error names the true reason.
        await self._box.check_boot()
        raise ReplyTimeout(
            self.name, "read samples", f"no sample for {timeout_s:g} s", "check that the box is on, and that no other program stops it"
        )

    async def _ready(self) -> None:
        await self._box.check_boot()
        self._box.check_settings()
        # After a crash of a program the box may still stream: stop it, so that old samples cannot enter the new stream.
        await self._talk.command(frames.STOP, frames.stop_command)

    def _judge(self, stream: Stream, bad_bytes: int) -> None:
        verdict = stream.verdict(bad_bytes)
        if isinstance(verdict, LossyLine):
            raise verdict
        if verdict is not None:  # only noted: every gap is recorded
            self.incidents.note(verdict)
            self.incidents.good()

    async def _stop_quietly(self) -> None:
        if not self._link.is_open:
            return  # the next box may be another one: the next stream identifies it and stops it first
        try:
            await self._talk.command(frames.STOP, frames.stop_command)
        except DriverError:
            # The box is gone or silent: the stream itself reports the reason, and the next stream stops the box first.
            self._talk.forget()

    async def _send(self, data: bytes) -> None:
        await self.open()
        await self._link.write(data, timeout_s=_ANSWER_S)

    def _answer(self, frame: frames.Answer) -> None:
        if isinstance(frame, frames.Info) and self._stream is not None and self._box.boot_id not in (None, frame.boot_id):
            self._stream.fail(self._box.rebooted(f"boot id {frame.boot_id:#x} instead of {self._box.boot_id:#x}"))
            if self._framing is not None:
                self._framing.stream = None  # no further sample may reach the tap
        self._talk.answered(frame)

    def _restarted(self, stream: Stream, why: SegmentEnd) -> None:
        stream.fail(self._box.error_of(why))

    def _broken(self, error: Exception) -> None:
        self._fail(LinkDown(self.name, "read", f"the framing thread failed: {error!r}", "this is a defect of Abbe: report it"))

    def _fail(self, error: LinkDown) -> None:
        self.incidents.note(error)
        self._talk.fail(error)
        if self._stream is not None:
            self._stream.fail(error)


_LATCHED = (WrongDevice, Rebooted, SettingsChanged)
