"""Requests to the box and their replies, matched by tag, so that a late reply never passes for that of another request.

`Box` keeps the known state of the box.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import BarCounters
from abbe.drivers.ballbar.stream import OtherPace, OtherSettings, Reads, SegmentEnd
from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Rebooted, Refused, ReplyTimeout, SettingsChanged, WrongDevice

_SETTINGS_FIRMWARE = 0x0101
_RESTORE = "the box's settings were changed: set them back (restore_settings), then measure this test again"


class Box:
    """Identity and settings of the box, which must not change. Accepts only ``serial_no``; None: the first box that answers."""

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
            Another box.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
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
        """Read the boot id without accepting it; errors of the wire as for `accept`."""
        return (await self._talk.identify()).boot_id

    async def check_boot(self) -> None:
        """Read identity and settings again; raises as `accept`, and ``Rebooted`` if the box restarted."""
        known = self.boot_id
        info = await self.accept()
        if known not in (None, info.boot_id):
            self.boot_id = known
            raise self.rebooted(f"boot id {info.boot_id:#x} instead of {known:#x}")

    def check_settings(self) -> None:
        """Raise ``SettingsChanged`` if unit, range or zero differ from the first ones, or the unit is inches."""
        now, first = self.settings, self._first
        if now is None or first is None:
            return
        if (now.unit, now.range_nm, now.zero_nm) != (first.unit, first.range_nm, first.zero_nm):
            detail = f"the box is set to {frames.reading_text(now)} instead of {frames.reading_text(first)}"
            raise SettingsChanged(self._name, "start stream", detail, _RESTORE)
        if now.unit != frames.NANOMETRE:
            raise SettingsChanged(self._name, "start stream", "the box shows inches", "switch it to millimetres, then open it anew")

    def check_can(self, rate_hz: int, range_mm: float) -> None:
        """Raise ``Refused`` if rate or stroke exceed the box's; limits that the box does not report are not checked."""
        if 0 < self._max_rate_hz < rate_hz:
            detail = f"{rate_hz} Hz are wanted, the box sends at most {self._max_rate_hz}"
            raise Refused(self._name, "check", detail, "choose a lower rate")
        if self.settings is not None and self.settings.range_nm < range_mm * 1e6:
            detail = f"its range is set to +-{self.settings.range_nm * 1e-6:g} mm, needed are {range_mm:g}"
            raise Refused(self._name, "check", detail, "set a larger range at the box")

    async def restore(self) -> None:
        """Restore the first unit, range and zero; raises as `accept`, and ``Refused``."""
        first = self._first
        if first is not None:
            await self._talk.command(frames.CONFIGURE, lambda tag: frames.configure_command(tag, first.unit, first.range_nm, first.zero_nm))
        await self.accept()

    def error_of(self, end: SegmentEnd) -> DriverError:
        """Return the error of a stream that cannot continue."""
        if isinstance(end, OtherSettings):
            return SettingsChanged(self._name, "stream", str(end), _RESTORE)
        if isinstance(end, OtherPace):
            return DeviceFault(self._name, "stream", str(end), "did another program set or restart the box? then measure this test again")
        return self.rebooted(str(end))

    def rebooted(self, detail: str) -> Rebooted:
        """Return the error of a box that restarted."""
        return Rebooted(self._name, "stream", detail, "the box restarted: call identify, then measure this test again")


_DRAIN_S = 10.0
_OPERATION = {frames.START: "start stream", frames.STOP: "stop stream", frames.CONFIGURE: "set range and zero"}


class Conversation:
    """Sends requests to the box, one by one or concurrently, and waits for their replies.

    Parameters
    ----------
    send : callable
        Opens the line if necessary, and sends the bytes.
    counters : BarCounters
        Of the line: whether any frame was valid distinguishes a silent box from a wrong baud rate.
    answer_s : callable
        Longest time of a reply, s.
    backlog : callable
        Fill of the ring between reading and framing: a reply may wait behind samples for a slow disk.
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
        self._open: dict[int, asyncio.Future[frames.Answer]] = {}
        self._tag = 0

    async def identify(self) -> frames.Info:
        """Read the identity of the box.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame
            No connection, no reply, or an invalid one.
        """
        answer = await self._ask(frames.identify_command, "identify")
        if not isinstance(answer, frames.Info):
            raise BadFrame(self._name, "identify", "an ACK came instead of the INFO", "is this a ball-bar box of protocol version 1?")
        return answer

    async def settings(self) -> frames.BoxSettings:
        """Read the settings of the box (firmware 1.1 and later); errors as for ``identify``."""
        answer = await self._ask(frames.read_settings_command, "read settings")
        if not isinstance(answer, frames.BoxSettings):
            raise BadFrame(self._name, "read settings", "an ACK came instead of the SETTINGS", "is the firmware really 1.1 or later?")
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
        if not isinstance(answer, frames.Ack) or answer.command != kind:
            raise BadFrame(self._name, operation, "the answer belongs to another command", "is another program talking to this box?")
        if answer.result:
            remedy = "is the rate one the box can do?" if kind == frames.START else "look at the box"
            raise Refused(self._name, operation, frames.ACK_TEXT.get(answer.result, f"result {answer.result}"), remedy)

    def answered(self, frame: frames.Answer) -> None:
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

    async def _ask(self, make: Callable[[int], bytes], operation: str) -> frames.Answer:
        self._tag = tag = self._tag % 0xFFFF + 1
        future: asyncio.Future[frames.Answer] = asyncio.get_running_loop().create_future()
        self._open[tag] = future
        understood, bad = self._counters.frames, self._counters.bad_bytes
        try:
            await self._send(make(tag))
            return await self._waited(future)
        except TimeoutError as error:
            if isinstance(error, DriverError):
                raise
            if self._counters.bad_bytes > bad and self._counters.frames == understood:
                detail = f"{self._counters.bad_bytes - bad} bytes came, but not one frame of a ball-bar box"
                raise BadFrame(self._name, operation, detail, "baud rate and parity as on the box? is it a ball-bar box at all?") from None
            detail = f"no answer within {self._answer_s():g} s"
            raise ReplyTimeout(self._name, operation, detail, "box on? baud rate and port right?") from None
        finally:
            self._open.pop(tag, None)

    async def _waited(self, future: asyncio.Future[frames.Answer]) -> frames.Answer:
        loop = asyncio.get_running_loop()
        last_s = loop.time() + _DRAIN_S
        while True:
            try:
                async with asyncio.timeout(self._answer_s()):
                    return await asyncio.shield(future)
            except TimeoutError as error:
                if isinstance(error, DriverError) or not self._backlog() or loop.time() > last_s:
                    raise
