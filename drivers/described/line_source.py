"""A described device that sends lines of text, when asked or by itself, over a serial port or TCP.

A line of text has no number and seldom a check sum, but a late answer must never be taken for the next answer. So after a disturbance the
line has to be silent for a whole timeout, and unsolicited bytes are dropped before a request.
"""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress

from abbe.drivers.api import DeviceInfo
from abbe.drivers.described.source import CountSnapshot, RequestPacer
from abbe.drivers.device_file import Command, DeviceFile
from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, NotProved, ReplyTimeout, WrongDevice
from abbe.drivers.links.incidents import Incidents
from abbe.drivers.links.serial_link import ByteLink

_MOST_BYTES = 4096
_SILENCES = 5


class LineSource:
    """Lines of a described device: what polling and streaming have in common."""

    def __init__(self, file: DeviceFile, link: ByteLink) -> None:
        assert file.line is not None
        self._file, self._link, self._table = file, link, file.line
        self.name, self.incidents = link.name, Incidents()
        self._pattern = re.compile(self._table.pattern)
        self._number = 0
        self._dirty = False
        self._epoch = 0
        self._serial: str | None = None

    async def _identity(self) -> str:
        """Ask for the identity and return the serial number, if the line states one; a later answer must be the same."""
        table = self._table
        if not table.who:
            return ""
        found = await self._ask(table.who, table.answers)
        serial = (found or {}).get("serial_no", "")
        if found is None or (self._serial is not None and serial != self._serial):
            detail = "its identity is not the one in the device file" if found is None else "another device"
            error = WrongDevice(self.name, "identify", detail, "connect the device that the device file describes")
            self.incidents.note(error, latched=True)
            raise error
        self._serial = serial
        return serial

    async def command(self, command: Command, operation: str) -> None:
        """Send a command once and wait for its answer.

        Raises
        ------
        ReplyTimeout, LinkDown
            No answer, or no connection.
        DeviceFault
            The device reports an error.
        BadFrame
            The device answers something else.
        """
        await self._opened()
        if await self._ask(command.send, command.answer) is None:
            raise BadFrame(self.name, operation, "the answer does not match the device file", "check the device file")

    async def _opened(self) -> None:
        if not self._link.is_open:
            await self._link.open()
            self._dirty = False
            self._epoch += 1
            await self._identity()

    async def _ask(self, text: str, answer: str) -> dict[str, str] | None:
        """Send a question; return the groups of the answer, None if the answer does not match, {} if no answer is expected."""
        if self._dirty:
            await self._silence()
        self._link.drop_input()
        await self._link.write(text.encode("ascii"))
        if not answer:
            return {}
        self._dirty = True
        _, line = await self._line()
        self._dirty = False
        self._raise_error(line)
        found = re.fullmatch(answer, line)
        return None if found is None else {key: value for key, value in found.groupdict().items() if value is not None}

    async def _silence(self) -> None:
        """Drop incoming bytes until the line has been silent for a whole timeout."""
        for _ in range(_SILENCES):
            try:
                await self._link.read(_MOST_BYTES, timeout_s=self._table.timeout_s)
            except ReplyTimeout:
                return
        await self._link.close()
        raise LinkDown(
            self.name,
            "wait for silence",
            "the line is never silent",
            'write mode = "stream" in its device file, or check the baud rate',
        )

    async def _line(self) -> tuple[float, str]:
        """Return the arrival and the text of the next line. Raises ReplyTimeout, LinkDown, or BadFrame for bytes that are not a line."""
        ends, data, host_s = self._table.ends.encode("ascii"), b"", 0.0
        try:
            async with asyncio.timeout(self._table.timeout_s):
                while ends not in data:
                    host_s, piece = await self._link.read(_MOST_BYTES, timeout_s=2 * self._table.timeout_s)
                    data += piece
                    if len(data) > _MOST_BYTES:
                        break
        except TimeoutError:
            if not data:
                detail, remedy = (
                    f"no line within {self._table.timeout_s:g} s",
                    "check that the device is on, the cable, the baud rate and the request",
                )
                raise ReplyTimeout(self.name, "read", detail, remedy) from None
        if ends not in data:
            raise BadFrame(self.name, "read", f"bytes without an end of line: {data[:40]!r}", "check baud rate, parity and line.ends")
        return host_s, decoded(data.partition(ends)[0])

    def _raise_error(self, line: str) -> None:
        if self._table.error and (found := re.fullmatch(self._table.error, line)):
            raise DeviceFault(
                self.name, "read", f"the device reports {' '.join(found.groups()) or line!r}", "look this error up in the device's manual"
            )

    def _counts(self, line: str) -> dict[str, float]:
        """Return the values of a line. Raises DeviceFault for a line that reports an error, BadFrame for any other line."""
        self._raise_error(line)
        found = self._pattern.fullmatch(line)
        try:
            if found is not None:
                return {name: float(found[name].replace(" ", "")) for name in self._file.values}
        except (ValueError, AttributeError):  # a group is empty, or not a number
            pass
        raise BadFrame(
            self.name,
            "read",
            f"the line {line[:60]!r} does not match the device file",
            "check baud rate, parity and the device's output format",
        )

    async def close(self) -> None:
        """Close the port. Closing twice does nothing."""
        await self._link.close()
        self.incidents.closed()

    def _info(self, serial: str) -> DeviceInfo:
        self.incidents.accepted()
        return DeviceInfo(self._file.kind, self._file.name, serial, 0, "")


class PolledLines(LineSource):
    """A device that answers each question with one line."""

    def __init__(self, file: DeviceFile, link: ByteLink) -> None:
        super().__init__(file, link)
        self._pace = RequestPacer(file.limits.rate_hz)
        self._one = asyncio.Lock()

    async def identify(self) -> DeviceInfo:
        """Ask for identity and a first reading.

        Raises
        ------
        WrongDevice
            Another identity, or lines of another form.
        LinkDown, ReplyTimeout, DeviceFault
            Communication failed, or the device reports an error.
        """
        async with self._one:
            await self._link.open()
            return self._info(await self._identity())

    async def snapshot(self) -> CountSnapshot:
        """Ask for a reading.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame, DeviceFault, WrongDevice
            No connection, no answer, another form, an error of the device, or another device after a new connection.
        """
        async with self._one:
            await self._pace.turn()
            try:
                await self._opened()
                if self._dirty:
                    await self._silence()
                self._link.drop_input()
                self._dirty = True
                await self._link.write(self._table.ask.encode("ascii"))
                host_s, line = await self._line()
                counts = self._counts(line)
                self._dirty = False
            except DriverError as error:
                self.incidents.note(error)
                raise
        self.incidents.good()
        self._number += 1
        return CountSnapshot(host_s, self._number, counts, epoch=self._epoch)


class StreamedLines(LineSource):
    """A device that sends lines by itself. A task takes them as they come; a line of another form is left out and counted."""

    def __init__(self, file: DeviceFile, link: ByteLink) -> None:
        super().__init__(file, link)
        if file.line is not None and (file.line.who or file.zero or file.clear):
            detail = 'its device file has mode = "stream", but also line.who, [zero] or [clear], and a stream takes no requests'
            raise NotProved(self.name, "open", detail, 'remove these from the device file, or write mode = "poll"')
        self._task: asyncio.Task[None] | None = None
        self._news = asyncio.Condition()
        self._latest: CountSnapshot | None = None
        self._given = 0
        self._trouble: DriverError | None = None
        self.left_out = 0
        """Number of lines that were not of the form of the device file."""

    async def identify(self) -> DeviceInfo:
        """Wait for a line of the right form: such a device has no other identity. Errors as for `snapshot`."""
        await self.snapshot()
        return self._info("")

    async def snapshot(self) -> CountSnapshot:
        """Wait for a line that was not returned before.

        Raises
        ------
        LinkDown, ReplyTimeout, BadFrame, DeviceFault
            No connection, no line in time, only lines of another form, or an error of the device.
        """
        if self._task is None or self._task.done():
            await self._link.open()
            self._epoch += 1
            self._trouble = None
            self._task = asyncio.get_running_loop().create_task(self._take())
        try:
            async with asyncio.timeout(self._table.timeout_s), self._news:
                await self._news.wait_for(lambda: self._number > self._given or isinstance(self._trouble, LinkDown | DeviceFault))
        except TimeoutError:
            detail, remedy = (
                f"no line within {self._table.timeout_s:g} s",
                "check that the device is on and sends, the cable and the baud rate",
            )
            error = self._trouble or ReplyTimeout(self.name, "read", detail, remedy)
            self.incidents.note(error)
            raise error from None
        if self._number == self._given and self._trouble is not None:
            error, self._trouble = self._trouble, None
            self.incidents.note(error)
            raise error
        assert self._latest is not None
        self._given = self._number
        self.incidents.good()
        return self._latest

    async def close(self) -> None:
        """Stop taking lines and close the port. Closing twice does nothing."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        await super().close()

    async def _take(self) -> None:
        ends, data, whole = self._table.ends.encode("ascii"), b"", False
        while True:
            try:
                host_s, piece = await self._link.read(_MOST_BYTES, timeout_s=self._table.timeout_s)
            except ReplyTimeout:
                continue
            except LinkDown as error:
                await self._tell(error)
                return
            *lines, data = (data + piece).split(ends)
            data = data[-_MOST_BYTES:]
            for line in lines:
                if whole:  # the first line may have begun before
                    await self._took(host_s, line)
                whole = True

    async def _took(self, host_s: float, line: bytes) -> None:
        try:
            counts = self._counts(decoded(line))
        except (BadFrame, DeviceFault) as error:
            self.left_out += 1
            await self._tell(error)
            return
        async with self._news:
            self._number += 1
            self._trouble, self._latest = None, CountSnapshot(host_s, self._number, counts, epoch=self._epoch)
            self._news.notify_all()

    async def _tell(self, error: DriverError) -> None:
        async with self._news:
            self._trouble = error
            self._news.notify_all()


def decoded(data: bytes) -> str:
    """Return a line as text; bytes that are not ASCII become a character that no pattern for numbers accepts."""
    return data.decode("ascii", errors="replace").strip()
