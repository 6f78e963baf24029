"""The web process's end of the channel: the latest state of the core, its age, and requests to the core."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import count

from abbe.service.channel.messages import (
    Answer,
    ChangeFile,
    ConfirmPrompt,
    CoreRequest,
    Jobs,
    LiveMachine,
    LivePath,
    LiveSamples,
    PushNow,
    RollBack,
    Snapshot,
    StartJob,
    Steering,
    SteerJob,
    Wire,
    from_core,
)
from abbe.service.clock import Clock
from abbe.service.domain.machine_file import FileEdit
from abbe.service.domain.progress import DeviceStatus, JobState, RunningCheck
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import CoreUnavailable
from abbe.service.web.core_link.sample_board import MOST_EACH, MOST_LISTENERS, SampleBoard

SILENT_S = 5.0
"""The core sends a snapshot every second. A snapshot older than this is never shown as current."""
MOST_WAITING = 32
"""Largest number of requests that may wait for the core."""
QUEUE = 8


class CoreLine:
    """The core as the web process sees it: keeps its latest messages and sends it requests."""

    def __init__(self, wire: Wire, clock: Clock) -> None:
        self._wire, self._clock = wire, clock
        self._snapshot: Snapshot | None = None
        self._jobs: tuple[JobState, ...] = ()
        self._received_s = 0.0
        self._numbers = count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}
        self._listeners: dict[asyncio.Queue[Snapshot | None], str] = {}
        self.samples = SampleBoard()
        """Samples of the running path."""

    async def listen(self) -> None:
        """Receive messages until the core ends. Raises ChannelBroken for an invalid message."""
        while (body := await self._wire.receive()) is not None:
            message = from_core(body)
            self._received_s = self._clock.monotonic_s()
            match message:
                case Snapshot():
                    self._snapshot = message
                    for queue in self._listeners:
                        _put(queue, message)
                case Jobs(jobs=jobs):
                    self._jobs = jobs
                case LivePath():
                    self.samples.set_path(message.path)
                case LiveMachine():
                    self.samples.set_machine(message.machine)
                case LiveSamples():
                    self.samples.add_samples(message)
                case Answer():
                    waiting = self._waiting.pop(message.request, None)
                    if waiting is not None and not waiting.done():
                        waiting.set_result(message)

    def end(self) -> None:
        """Release all listeners."""
        for queue in self._listeners:
            _put(queue, None)
        self.samples.end()

    # ---- state of the core ------------------------------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The latest snapshot. Raises CoreUnavailable if it is older than `SILENT_S`, or there is none yet."""
        if self._snapshot is None:
            raise CoreUnavailable("the core of the service has not answered yet", "wait a few seconds")
        silent_s = self._clock.monotonic_s() - self._received_s
        if silent_s > SILENT_S:
            raise CoreUnavailable(
                f"the core of the service has not answered for {silent_s:.0f} s", "check the machine, then the service's log"
            )
        return self._snapshot

    @property
    def devices(self) -> list[DeviceStatus]:
        """The devices and the time of their last answer."""
        return list(self.snapshot().devices)

    @property
    def job(self) -> RunningCheck | None:
        """The running check."""
        return self.snapshot().check

    @property
    def changes(self) -> int:
        """Counter that grows when anything but the progress of a check changes."""
        return self.snapshot().changes

    @property
    def mqtt_connected(self) -> bool:
        """Whether the core is connected to the MQTT broker."""
        return self.snapshot().mqtt_connected

    @property
    def mqtt_dropped(self) -> int:
        """Number of alarms that were dropped because too many waited for the broker."""
        return self.snapshot().mqtt_dropped

    @property
    def attention(self) -> list[str]:
        """Sentences about everything that needs a person now."""
        return list(self.snapshot().attention)

    def next_due(self) -> list[tuple[Schedule, datetime]]:
        """The next slot of each schedule, soonest first."""
        return [(due.schedule, due.slot_utc) for due in self.snapshot().due]

    def jobs(self) -> tuple[JobState, ...]:
        """The latest jobs, newest first. Raises CoreUnavailable as `snapshot` does."""
        self.snapshot()
        return self._jobs

    @contextmanager
    def listener(self, who: str = "") -> Iterator[Callable[[], AsyncIterator[Snapshot]] | None]:
        """Subscribe to snapshots; yield None if this account or all together have too many listeners. Slow listeners skip to the newest."""
        if len(self._listeners) >= MOST_LISTENERS or list(self._listeners.values()).count(who) >= MOST_EACH:
            yield None
            return
        queue: asyncio.Queue[Snapshot | None] = asyncio.Queue(QUEUE)
        if self._snapshot is not None:
            queue.put_nowait(self._snapshot)

        async def snapshots() -> AsyncIterator[Snapshot]:
            while (snapshot := await queue.get()) is not None:
                yield snapshot

        self._listeners[queue] = who
        try:
            yield snapshots
        finally:
            self._listeners.pop(queue, None)

    # ---- requests to the core ---------------------------------------------------------------------------------------

    async def start(self, recipe: str, key: str, who: str, alarm: int = 0, resume: str = "") -> Answer:
        """Start a job; ``alarm``: the alarm whose cause a full campaign looks for; ``resume``: the interrupted campaign that it completes.

        Raises CoreUnavailable if no answer comes. Then the outcome is unknown: repeat the request with the same key.
        """
        number = next(self._numbers)
        return await self._ask(StartJob(request=number, recipe=recipe, key=key, who=who, alarm=alarm, resume=resume))

    async def steer(self, job: str, how: Steering, who: str) -> Answer:
        """Stop, abort, pause or resume a running job. Raises CoreUnavailable if no answer comes."""
        number = next(self._numbers)
        return await self._ask(SteerJob(request=number, job=job, how=how, who=who))

    async def confirm_prompt(self, job: str, prompt: int, who: str) -> Answer:
        """Confirm that a person has carried out a prompt of a job. Raises CoreUnavailable if no answer comes."""
        return await self._ask(ConfirmPrompt(request=next(self._numbers), job=job, prompt=prompt, who=who))

    async def roll_back(self, push: int, crc: int, reason: str, key: str, who: str) -> Answer:
        """Replace the table in force, given by push and CRC, by the one before it. Raises CoreUnavailable as `start` does."""
        return await self._ask(RollBack(request=next(self._numbers), push=push, crc=crc, reason=reason, key=key, who=who))

    async def push(self, proposal: int, key: str, who: str) -> Answer:
        """Push an approved proposal now. Raises CoreUnavailable as `start` does."""
        return await self._ask(PushNow(request=next(self._numbers), proposal=proposal, key=key, who=who))

    async def change_file(self, sha256: str, edits: tuple[FileEdit, ...], reason: str, who: str, *, looser: bool) -> Answer:
        """Change values of the machine file with the digest ``sha256``. Raises CoreUnavailable if no answer comes."""
        request = ChangeFile(request=next(self._numbers), sha256=sha256, edits=edits, reason=reason, looser=looser, who=who)
        return await self._ask(request)

    async def _ask(self, request: CoreRequest) -> Answer:
        self.snapshot()
        if len(self._waiting) >= MOST_WAITING:
            raise CoreUnavailable("too many requests wait for the core of the service", "try again")
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request.request] = answer
        try:
            self._wire.send(request)
            with suppress(TimeoutError):
                async with asyncio.timeout(SILENT_S):
                    return await answer
        finally:
            self._waiting.pop(request.request, None)
        raise CoreUnavailable(
            "the core of the service did not answer in time", "check whether the request was carried out before you repeat it"
        )


def _put(queue: asyncio.Queue[Snapshot | None], snapshot: Snapshot | None) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(snapshot)
