"""Questions to the box and their answers, matched by tag: a late answer never passes for the answer to another question."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.framing import BarCounters
from abbe.drivers.errors import BadFrame, DriverError, LinkDown, Refused, ReplyTimeout

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
            Nobody there, no answer, or nothing that can be understood.
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
        """An answer has come; one that nobody waits for is forgotten."""
        future = self._open.get(frame.tag)
        if future is not None and not future.done():
            future.set_result(frame)

    def fail(self, error: LinkDown) -> None:
        """Nothing more will come: whoever waits hears why."""
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
