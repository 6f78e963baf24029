"""Questions to the box and their answers, matched by tag: a late answer never passes for the answer to another question.

`Box` is what is known of the box that answers.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import BarCounters
from abbe.drivers.ballbar.stream import OtherPace, OtherSettings, Reads, SegmentEnd
from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, Rebooted, Refused, ReplyTimeout, SettingsChanged, WrongDevice

_TELLS_SETTINGS = 0x0101  # firmware
_RESTORE = "somebody changed the box: set it back (restore_settings), then measure this test again"


class Box:
    """What is known of the box, and must stay so.

    Parameters
    ----------
    name : str
        For errors.
    talk : Conversation
        With the box.
    serial_no : int or None
        The only box that is accepted; None: the first one that answers.
    """

    def __init__(self, name: str, talk: Conversation, serial_no: int | None) -> None:
        self.boot_id: int | None = None
        self.settings: frames.BoxSettings | None = None
        self._name, self._talk, self._serial_no = name, talk, serial_no
        self._first: frames.BoxSettings | None = None
        self._max_rate_hz = 0

    @property
    def reads(self) -> Reads | None:
        """Number of the settings and stroke, of a box that tells them."""
        return None if self.settings is None else Reads(self.settings.number, self.settings.range_nm)

    async def accept(self) -> frames.Info:
        """Ask who is there and how it reads; its boot id is the one that counts from now on.

        Raises
        ------
        WrongDevice
            Another box.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        info = await self._talk.who()
        if self._serial_no not in (None, info.serial_no):
            detail = f"the box with serial number {info.serial_no} answers instead of {self._serial_no}"
            raise WrongDevice(self._name, "identify", detail, "plug in the right box, or configure this one as a device of its own")
        if info.firmware >= _TELLS_SETTINGS:
            self.settings = await self._talk.settings()
            self._first = self._first or self.settings
        self.boot_id, self._serial_no, self._max_rate_hz = info.boot_id, info.serial_no, info.max_rate_hz
        return info

    async def peek(self) -> int:
        """Ask for its boot id, and take nothing over from the answer; errors of the wire as for `accept`."""
        return (await self._talk.who()).boot_id

    async def check_boot(self) -> None:
        """Ask again; besides the errors of `accept`, ``Rebooted`` when it was switched on anew."""
        known = self.boot_id
        info = await self.accept()
        if known not in (None, info.boot_id):
            self.boot_id = known
            raise self.rebooted(f"boot id {info.boot_id:#x} instead of {known:#x}")

    def check_settings(self) -> None:
        """Raise ``SettingsChanged`` when it reads otherwise than at first, or in inches."""
        now, first = self.settings, self._first
        if now is None or first is None:
            return
        if (now.unit, now.range_nm, now.zero_nm) != (first.unit, first.range_nm, first.zero_nm):
            detail = f"the box is set to {frames.reading_text(now)} instead of {frames.reading_text(first)}"
            raise SettingsChanged(self._name, "start stream", detail, _RESTORE)
        if now.unit != frames.NANOMETRE:
            raise SettingsChanged(self._name, "start stream", "the box shows inches", "switch it to millimetres, then open it anew")

    def check_can(self, rate_hz: int, range_mm: float) -> None:
        """Raise ``Refused`` when it cannot send so fast, or clamps readings that are wanted; what it does not tell is not judged."""
        if 0 < self._max_rate_hz < rate_hz:
            detail = f"{rate_hz} Hz are wanted, the box sends at most {self._max_rate_hz}"
            raise Refused(self._name, "check", detail, "choose a lower rate")
        if self.settings is not None and self.settings.range_nm < range_mm * 1e6:
            detail = f"its range is set to +-{self.settings.range_nm * 1e-6:g} mm, needed are {range_mm:g}"
            raise Refused(self._name, "check", detail, "set a larger range at the box")

    async def restore(self) -> None:
        """Set unit, range and zero as they were at first; errors as for `accept`, and ``Refused``."""
        first = self._first
        if first is not None:
            await self._talk.command(frames.CONFIGURE, lambda tag: frames.configure_command(tag, first.unit, first.range_nm, first.zero_nm))
        await self.accept()

    def error_of(self, end: SegmentEnd) -> DriverError:
        """The message when a stream cannot go on."""
        if isinstance(end, OtherSettings):
            return SettingsChanged(self._name, "stream", str(end), _RESTORE)
        if isinstance(end, OtherPace):
            return DeviceFault(
                self._name, "stream", str(end), "was the box set or restarted by somebody else? then measure this test again"
            )
        return self.rebooted(str(end))

    def rebooted(self, detail: str) -> Rebooted:
        """The error of a box that was switched on anew."""
        return Rebooted(self._name, "stream", detail, "the box restarted: call identify, then measure this test again")


_DRAIN_S = 10.0
_OPERATION = {frames.START: "start stream", frames.STOP: "stop stream", frames.CONFIGURE: "set range and zero"}


class Conversation:
    """Asks one thing after the other, or several at once.

    Parameters
    ----------
    name : str
        The device, for errors.
    send : callable
        Opens the line when it is not, and sends the bytes.
    counters : BarCounters
        Of the line: whether anything at all was understood tells a mute box from a wrong baud rate.
    answer_s : callable
        Seconds that an answer may take.
    backlog : callable
        How full the ring between reading and framing is: an answer may stand behind samples that wait for a slow disk.
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

    async def who(self) -> frames.Info:
        """Ask who is there.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame
            No connection, no answer, or an answer that cannot be understood.
        """
        answer = await self._ask(frames.identify_command, "identify")
        if not isinstance(answer, frames.Info):
            raise BadFrame(self._name, "identify", "an ACK came instead of the INFO", "is this a ball-bar box of protocol version 1?")
        return answer

    async def settings(self) -> frames.BoxSettings:
        """Ask how the box reads (firmware 1.1 and later); errors as for ``who``."""
        answer = await self._ask(frames.read_settings_command, "read settings")
        if not isinstance(answer, frames.BoxSettings):
            raise BadFrame(self._name, "read settings", "an ACK came instead of the SETTINGS", "is the firmware really 1.1 or later?")
        return answer

    async def command(self, kind: int, make: Callable[[int], bytes]) -> None:
        """Send a command of this type, made with its tag, and wait for its ACK.

        Raises
        ------
        Refused
            The box says no.
        LinkDown, ReplyTimeout, BadFrame
            As for ``who``.
        """
        operation = _OPERATION[kind]
        answer = await self._ask(make, operation)
        if not isinstance(answer, frames.Ack) or answer.command != kind:
            raise BadFrame(self._name, operation, "the answer belongs to another command", "is another program talking to this box?")
        if answer.result:
            remedy = "is the rate one the box can do?" if kind == frames.START else "look at the box"
            raise Refused(self._name, operation, frames.ACK_TEXT.get(answer.result, f"result {answer.result}"), remedy)

    def answered(self, frame: frames.Answer) -> None:
        """Deliver an answer; drop it when no question waits for it."""
        future = self._open.get(frame.tag)
        if future is not None and not future.done():
            future.set_result(frame)

    def fail(self, error: LinkDown) -> None:
        """No more answers will come: every waiting question fails with this reason."""
        for future in self._open.values():
            if not future.done():
                future.set_exception(error)

    def forget(self) -> None:
        """Wait for no answer any more."""
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
