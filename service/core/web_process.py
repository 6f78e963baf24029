"""The web process as the core sees it: started, informed, heard, ended; and started again when it is gone or hangs.

Nothing that happens to it may hold up or end the core: it is told without waiting, and what it says is checked before it is believed.
"""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
from base64 import b64encode
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path

import structlog

from abbe.service.capture.live import LiveFeed, Stretch
from abbe.service.channel.messages import (
    PROTOCOL,
    Answer,
    Begin,
    ConfirmPrompt,
    CoreRequest,
    Heartbeat,
    Jobs,
    LivePath,
    LiveSamples,
    PushNow,
    RollBack,
    Serving,
    Snapshot,
    StartJob,
    SteerJob,
    from_web,
)
from abbe.service.channel.wire import Wire
from abbe.service.children import python_words
from abbe.service.clock import Clock
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import Orders
from abbe.service.domain.recorded_path import RecordedPath
from abbe.service.errors import AbbeError, ChannelBroken

# Shows the web process what the running path reads, twenty times a second, and never waits for it.


FRAME_S = 0.05
"""Between two messages: 20 Hz, about 50 samples each at 1 kHz."""
NO_PATH = LivePath("path", RecordedPath())


async def show_live(wire: Wire, live: LiveFeed, clock: Clock) -> None:
    """Tell every path and what it reads, until cancelled. A web process that does not read in time misses samples, and the disk none."""
    live.stretches()  # what came in without a listener is old: it would be seconds of samples at once
    told = 0
    while True:
        await live.active.wait()
        while live.path is not None:
            if not wire.is_full:
                told = _told(wire, live, told)
                for part in live.stretches():
                    wire.send(_message(part, clock))
            await asyncio.sleep(FRAME_S)
        if told:
            wire.send(NO_PATH)
            told = 0


def _told(wire: Wire, live: LiveFeed, told: int) -> int:
    path = live.path
    if path is None or path.number == told:
        return told
    wire.send(LivePath("path", path))
    return path.number


def _message(part: Stretch, clock: Clock) -> LiveSamples:
    # The instant at which the samples came in was read off the monotonic clock; a browser knows only the calendar's.
    ago_s = clock.monotonic_s() - part.host_s
    arrived_ms = clock.utc().timestamp() * 1e3 - ago_s * 1e3
    return LiveSamples("samples", part.path, part.first, arrived_ms, b64encode(part.values_um.astype("<f4").tobytes()).decode("ascii"))


# How much memory the page's process gets: a page that grows without end must not take the process with it that moves the machine.
#
# Kept by the kernel for that process alone, from outside: the page cannot lift it. Should the whole service run into its own limit
# (``MemoryMax`` of the unit), or the computer out of memory, the kernel takes the page first.


try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


FIRST_TO_GO = 900
"""As ``/proc/PID/oom_score_adj`` has it: 0 is the core's, 1000 the most there is."""


def keep_within(pid: int, memory_mb: int) -> None:
    """Bound what a process can allocate.

    Parameters
    ----------
    pid : int
        A child of ours.
    memory_mb : int
        Writable private memory that it may ask for, MiB; beyond it gets none.
    """
    with suppress(OSError):  # not everywhere there is such a file
        Path(f"/proc/{pid}/oom_score_adj").write_text(f"{FIRST_TO_GO}\n", encoding="ascii")
    if not hasattr(resource, "prlimit"):
        return
    try:
        resource.prlimit(pid, resource.RLIMIT_DATA, (memory_mb << 20, memory_mb << 20))
    except ProcessLookupError:
        pass  # gone already, as its end will tell
    except (OSError, ValueError) as error:
        log.warning("the page's memory has no limit of its own", cause=str(error))


log = structlog.get_logger("abbe.web")

PERIOD_S, SHORTEST_S = 1.0, 0.2
"""The page hears of the core so often at least, and of its progress no more often."""
PAUSE_S, LONGEST_PAUSE_S, GOOD_LIFE_S = 0.1, 30.0, 30.0
"""Before the next start, doubled each time up to the longest; after a good life from the beginning."""
START_S, HANG_S = 60.0, 20.0
"""A process that does not serve after this, or says nothing for this long, is ended."""
GOODBYE_S = 1.2
PASSED_ON = frozenset({"ABBE_AUDIT_FOLDER"})
WITHHELD = frozenset({"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"})


class WebProcess:
    """Keeps one web process running.

    Parameters
    ----------
    begin : Begin
        What it has to know.
    listening : socket
        Where it answers; it stays open here, so that a request waits while the process is started again.
    moment : callable
        How things stand, given the number of restarts.
    book : JobRegistry
        Is asked for what people want.
    clock : Clock
        Monotonic time.
    live : LiveFeed, optional
        What the running path reads.
    orders : Orders, optional
        Is asked for what people order of tables; None: nothing can be ordered.
    """

    def __init__(
        self,
        begin: Begin,
        listening: socket.socket,
        moment: Callable[[int], Snapshot],
        book: JobRegistry,
        clock: Clock,
        live: LiveFeed | None = None,
        orders: Orders | None = None,
    ) -> None:
        self._live, self._orders = live, orders
        self._begin, self._listening, self._moment, self._book, self._clock = begin, listening, moment, book, clock
        self.restarts = 0
        self._changed, self._ending = asyncio.Event(), asyncio.Event()
        self._child: asyncio.subprocess.Process | None = None
        self._up = False
        self._heard_s = 0.0

    def changed(self) -> None:
        """Send a snapshot soon: something has changed."""
        self._changed.set()

    def stop(self) -> None:
        """`run` ends now, and the process with it."""
        self._ending.set()

    async def run(self) -> None:
        """Work until `stop`."""
        pause_s = PAUSE_S
        while not self._ending.is_set():
            begun_s = self._clock.monotonic_s()
            try:
                await self._one_life()
            except (ChannelBroken, OSError) as trouble:
                log.error("the web process is ended", cause=str(trouble))
            if self._ending.is_set():
                return
            pause_s = PAUSE_S if self._clock.monotonic_s() - begun_s > GOOD_LIFE_S else pause_s
            self.restarts += 1
            log.warning("the web process ended; starting it again", code=self._child and self._child.returncode, pause_s=pause_s)
            with suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._ending.wait()
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def _one_life(self) -> None:
        ours, theirs = socket.socketpair()
        try:
            self._up, self._heard_s = False, self._clock.monotonic_s()
            self._child = await self._started(theirs)
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        wire = await Wire.over(ours)
        tasks = [asyncio.create_task(work, name=f"web {name}") for name, work in self._works(wire)]
        ending = asyncio.create_task(self._ending.wait(), name="web ending")
        try:
            wire.send(self._begin)
            await asyncio.wait({*tasks, ending}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (*tasks, ending):
                task.cancel()
            wire.close()
            await self._end(self._child)
        for task in tasks:
            if task.done() and not task.cancelled():
                task.result()

    def _works(self, wire: Wire) -> list[tuple[str, Coroutine[None, None, None]]]:
        show = [] if self._live is None else [("show", show_live(wire, self._live, self._clock))]
        return [("tell", self._tell(wire)), ("hear", self._hear(wire)), *show]

    async def _started(self, theirs: socket.socket) -> asyncio.subprocess.Process:
        # Nothing secret on the command line; and in its environment neither the broker's password nor systemd's address.
        env = {k: v for k, v in os.environ.items() if k in PASSED_ON or not (k.startswith("ABBE_") or k in WITHHELD)}
        ends = (theirs.fileno(), self._listening.fileno())
        words = python_words("abbe.service.web.process", *ends)
        child = await asyncio.create_subprocess_exec(*words, stdin=subprocess.DEVNULL, pass_fds=ends, env=env)
        keep_within(child.pid, self._begin.memory_mb)
        return child

    async def _end(self, child: asyncio.subprocess.Process) -> None:
        """It has read the end of the channel, and ends by itself; one that does not is killed. It holds nothing that could be lost."""
        if self._up:
            with suppress(TimeoutError):
                async with asyncio.timeout(GOODBYE_S):
                    await child.wait()
        if child.returncode is None:
            with suppress(ProcessLookupError):
                child.kill()
        await child.wait()

    async def _tell(self, wire: Wire) -> None:
        told: tuple[object, ...] | None = None
        while True:
            self._changed.clear()
            if not wire.is_full:
                jobs = self._book.seen()
                if jobs != told:
                    told = jobs
                    wire.send(Jobs("jobs", jobs))
                wire.send(self._moment(self.restarts))
            silent_s = self._clock.monotonic_s() - self._heard_s
            if silent_s > (HANG_S if self._up else START_S):
                raise ChannelBroken(f"the web process has said nothing for {silent_s:.0f} s")
            await asyncio.sleep(SHORTEST_S)
            with suppress(TimeoutError):
                async with asyncio.timeout(PERIOD_S - SHORTEST_S):
                    await self._changed.wait()

    async def _hear(self, wire: Wire) -> None:
        while (body := await wire.receive()) is not None:
            message = from_web(body)
            self._heard_s = self._clock.monotonic_s()
            match message:
                case Serving(protocol=protocol):
                    if protocol != PROTOCOL:
                        raise ChannelBroken(f"the web process speaks version {protocol} of the channel, the core {PROTOCOL}")
                    self._up = True
                    log.info("page up", restarts=self.restarts)
                case StartJob() | SteerJob() | ConfirmPrompt() | RollBack() | PushNow():
                    answer = await self._answered(message)
                    wire.send(Jobs("jobs", self._book.seen()))  # first: who gets the number of a job can ask for it
                    wire.send(answer)
                case Heartbeat():
                    pass

    async def _answered(self, message: CoreRequest) -> Answer:
        try:
            match message:
                case StartJob():
                    return await self._book.start(message)
                case SteerJob():
                    return await self._book.steer(message)
                case ConfirmPrompt():
                    return await self._book.done_by_hand(message)
            if self._orders is None:
                return Answer("answer", message.request, "conflict", "this service takes no orders of tables", "")
            return await (self._orders.rollback(message) if isinstance(message, RollBack) else self._orders.push(message))
        except AbbeError as error:  # the store does not answer: then no user is known
            return Answer("answer", message.request, "busy", str(error)[:1000], "")
