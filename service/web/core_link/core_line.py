"""What the web process knows of the core: the last it said, how old that is, and a way to ask it for something."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import count

from abbe.service.channel.messages import (
    Answer,
    Asked,
    DoneByHand,
    How,
    Jobs,
    LivePath,
    LiveSamples,
    PushNow,
    RollBack,
    Snapshot,
    StartJob,
    SteerJob,
    from_core,
)
from abbe.service.channel.wire import Wire
from abbe.service.clock import Clock
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.job_state import JobState
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import CoreSilent
from abbe.service.web.core_link.sample_board import MOST_EACH, MOST_LISTENERS, SampleBoard

SILENT_S = 5.0
"""The core speaks once a second. After this its last word is not shown as if it were true."""
MOST_WAITING = 32
"""Requests that wait for the core; one more is refused."""
QUEUE = 8


class CoreLine:
    """The core, as seen from here.

    Parameters
    ----------
    wire : Wire
        To the core.
    clock : Clock
        How old its last word is.
    """

    def __init__(self, wire: Wire, clock: Clock) -> None:
        self._wire, self._clock = wire, clock
        self._moment: Snapshot | None = None
        self._jobs: tuple[JobState, ...] = ()
        self._heard_s = 0.0
        self._numbers = count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}
        self._listeners: dict[asyncio.Queue[Snapshot | None], str] = {}
        self.samples = SampleBoard()
        """What the running path reads."""

    async def listen(self) -> None:
        """Hear the core until it has ended.

        Raises
        ------
        ChannelBroken
            It says what is none of its messages.
        """
        while (body := await self._wire.receive()) is not None:
            message = from_core(body)
            self._heard_s = self._clock.monotonic_s()
            match message:
                case Snapshot():
                    self._moment = message
                    for queue in self._listeners:
                        _put(queue, message)
                case Jobs(jobs=jobs):
                    self._jobs = jobs
                case LivePath():
                    self.samples.hear_path(message.path)
                case LiveSamples():
                    self.samples.hear_samples(message)
                case Answer():
                    waiting = self._waiting.pop(message.request, None)
                    if waiting is not None and not waiting.done():
                        waiting.set_result(message)

    def end(self) -> None:
        """Nobody who listens waits any longer."""
        for queue in self._listeners:
            _put(queue, None)
        self.samples.end()

    # ---- what it has said -------------------------------------------------------------------------------------------

    def moment(self) -> Snapshot:
        """How things stand.

        Raises
        ------
        CoreSilent
            It has not said so for `SILENT_S`, and what it said then may not be so any more.
        """
        if self._moment is None:
            raise CoreSilent("the core of the service has not said anything yet", "wait a few seconds")
        silent_s = self._clock.monotonic_s() - self._heard_s
        if silent_s > SILENT_S:
            raise CoreSilent(
                f"the core of the service does not answer, for {silent_s:.0f} s now", "look at the machine; then at the service's log"
            )
        return self._moment

    @property
    def devices(self) -> list[DeviceStatus]:
        """The devices, and when they were last heard of."""
        return list(self.moment().devices)

    @property
    def job(self) -> RunningCheck | None:
        """The check that runs."""
        return self.moment().check

    @property
    def changes(self) -> int:
        """Grows when more than the progress of a check has changed."""
        return self.moment().changes

    @property
    def mqtt_connected(self) -> bool:
        """Whether the broker is there."""
        return self.moment().mqtt_connected

    @property
    def mqtt_dropped(self) -> int:
        """Alarms that were dropped because too many waited for the broker."""
        return self.moment().mqtt_dropped

    @property
    def attention(self) -> list[str]:
        """What needs a person now."""
        return list(self.moment().attention)

    def next_due(self) -> list[tuple[Schedule, datetime]]:
        """What comes next of each schedule, soonest first."""
        return [(due.schedule, due.slot_utc) for due in self.moment().due]

    def jobs(self) -> tuple[JobState, ...]:
        """The latest jobs, newest first. Raises as `moment` does."""
        self.moment()
        return self._jobs

    @contextmanager
    def listener(self, who: str = "") -> Iterator[Callable[[], AsyncIterator[Snapshot]] | None]:
        """A way to hear every moment from now on; None: too many listen, or too many of this account. Who is slow hears the newest."""
        if len(self._listeners) >= MOST_LISTENERS or list(self._listeners.values()).count(who) >= MOST_EACH:
            yield None
            return
        queue: asyncio.Queue[Snapshot | None] = asyncio.Queue(QUEUE)
        if self._moment is not None:
            queue.put_nowait(self._moment)

        async def moments() -> AsyncIterator[Snapshot]:
            while (moment := await queue.get()) is not None:
                yield moment

        self._listeners[queue] = who
        try:
            yield moments
        finally:
            self._listeners.pop(queue, None)

    # ---- what it is asked -------------------------------------------------------------------------------------------

    async def start(self, recipe: str, key: str, who: str) -> Answer:
        """Ask for a job. Raises CoreSilent without an answer: whether it was started is not known then; ask again with the same key."""
        number = next(self._numbers)
        return await self._ask(StartJob("start", number, recipe, key, who))

    async def steer(self, job: str, how: How, who: str) -> Answer:
        """Ask for a running job to stop, pause or go on. Raises CoreSilent when there is no answer."""
        number = next(self._numbers)
        return await self._ask(SteerJob("steer", number, job, how, who))

    async def done_by_hand(self, job: str, prompt: int, who: str) -> Answer:
        """Say that what a job asks for is done: this prompt, and no other. Raises CoreSilent when there is no answer."""
        return await self._ask(DoneByHand("hand", next(self._numbers), job, prompt, who))

    async def roll_back(self, push: int, crc: int, reason: str, key: str, who: str) -> Answer:
        """Order that the table of a push, in force with a CRC, gives way to the one before. Raises CoreSilent as `start` does."""
        return await self._ask(RollBack("rollback", next(self._numbers), push, crc, reason, key, who))

    async def push(self, proposal: int, key: str, who: str) -> Answer:
        """Order that an approved proposal is pushed now. Raises CoreSilent as `start` does."""
        return await self._ask(PushNow("push", next(self._numbers), proposal, key, who))

    async def _ask(self, request: Asked) -> Answer:
        self.moment()
        if len(self._waiting) >= MOST_WAITING:
            raise CoreSilent("too many requests wait for the core of the service", "try again")
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request.request] = answer
        try:
            self._wire.send(request)
            with suppress(TimeoutError):
                async with asyncio.timeout(SILENT_S):
                    return await answer
        finally:
            self._waiting.pop(request.request, None)
        raise CoreSilent("the core of the service did not answer in time", "look whether it was done before you ask again")


def _put(queue: asyncio.Queue[Snapshot | None], moment: Snapshot | None) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(moment)
