"""The web process from the core's side: start it, send it updates, receive requests, end it; restart it when it has ended or hangs.

The web process can neither block nor end the core: the core sends without waiting, and checks every message that it receives.
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
    ChangeFile,
    ConfirmPrompt,
    CoreRequest,
    Jobs,
    LiveMachine,
    LivePath,
    LiveSamples,
    PushNow,
    RollBack,
    Serving,
    Snapshot,
    StartJob,
    SteerJob,
    WebHeartbeat,
    Wire,
    from_web,
)
from abbe.service.children import python_command
from abbe.service.clock import Clock
from abbe.service.core.file_changes import FileChanges
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import Orders
from abbe.service.domain.progress import RecordedPath
from abbe.service.errors import AbbeError, ChannelBroken

FRAME_S = 0.05
"""Time between two messages with samples, s: 20 messages a second, each with about 50 samples at 1 kHz."""
FRAMES_EACH = 2
"""Every second message also carries the state of the machine."""
NO_PATH = LivePath("path", RecordedPath())


async def show_live(wire: Wire, live: LiveFeed, clock: Clock) -> None:
    """Send every path and its samples, until cancelled. A web process that reads too slowly misses samples; the disk misses none."""
    live.stretches()  # discards samples that gathered while nobody listened
    sent, told, frame = 0, False, 0
    while True:
        await live.active.wait()
        while live.active.is_set():
            if not wire.is_full:
                sent = _send_path(wire, live, sent)
                for part in live.stretches():
                    wire.send(_message(part, clock))
                if live.machine is not None and frame % FRAMES_EACH == 0:
                    wire.send(LiveMachine("machine", live.machine()))
                    told = True
            frame += 1
            await asyncio.sleep(FRAME_S)
        sent = _send_path(wire, live, sent)
        if told:
            wire.send(LiveMachine("machine", None))
            told = False


def _send_path(wire: Wire, live: LiveFeed, sent: int) -> int:
    """Tell the page of a new path, or that the path has ended; return the number of the path that the page knows, 0: none."""
    path = live.path
    number = 0 if path is None else path.number
    if number != sent:
        wire.send(NO_PATH if path is None else LivePath("path", path))
    return number


def _message(part: Stretch, clock: Clock) -> LiveSamples:
    # The samples are stamped by the monotonic clock; a browser knows only the wall clock.
    ago_s = clock.monotonic_s() - part.host_s
    arrived_ms = clock.utc().timestamp() * 1e3 - ago_s * 1e3
    return LiveSamples("samples", part.path, part.first, arrived_ms, b64encode(part.values_um.astype("<f4").tobytes()).decode("ascii"))


# Memory limit of the page's process: a page that grows without bound must not take down the process that moves the machine.
#
# The kernel enforces it from outside: the page cannot lift it. If the whole service reaches its own limit (``MemoryMax`` of the unit),
# or the computer runs out of memory, the kernel kills the page first.


try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


OOM_SCORE_ADJ = 900
"""Value of ``/proc/PID/oom_score_adj``: 0 is the core's, 1000 the maximum."""


def limit_memory(pid: int, memory_mb: int) -> None:
    """Limit the memory that a child process can allocate, and have the kernel kill the child before the core if memory runs out.

    ``memory_mb``: writable private memory, MiB; beyond it allocations fail.
    """
    with suppress(OSError):  # the file does not exist everywhere
        Path(f"/proc/{pid}/oom_score_adj").write_text(f"{OOM_SCORE_ADJ}\n", encoding="ascii")
    if not hasattr(resource, "prlimit"):
        return
    try:
        resource.prlimit(pid, resource.RLIMIT_DATA, (memory_mb << 20, memory_mb << 20))
    except ProcessLookupError:
        pass  # gone already; its end is handled elsewhere
    except (OSError, ValueError) as error:
        log.warning("no memory limit could be set for the page's process", cause=str(error))


log = structlog.get_logger("abbe.web")

PERIOD_S, SHORTEST_S = 1.0, 0.2
"""Longest and shortest time between two messages to the page, s."""
PAUSE_S, LONGEST_PAUSE_S, GOOD_LIFE_S = 0.1, 30.0, 30.0
"""First and longest pause before a restart, s: it doubles with each restart, and begins anew after a process has lived `GOOD_LIFE_S`."""
START_S, HANG_S = 60.0, 20.0
"""Longest time until a web process serves, and its longest silence afterwards, s; beyond these the core ends it."""
GOODBYE_S = 1.2
PASSED_ON = frozenset({"ABBE_AUDIT_FOLDER"})
WITHHELD = frozenset({"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"})


class WebProcess:
    """Keeps one web process running.

    Parameters
    ----------
    begin : Begin
        Its first message.
    listening : socket
        The bound socket; it stays open here, so that requests wait while the process restarts.
    snapshot : callable
        Returns the snapshot to send, given the number of restarts.
    jobs : JobRegistry
        Takes requests for jobs.
    clock : Clock
        Monotonic time.
    live : LiveFeed, optional
        Samples of the running path.
    orders : Orders, optional
        Takes orders for tables; None: there are none.
    """

    def __init__(
        self,
        begin: Begin,
        listening: socket.socket,
        snapshot: Callable[[int], Snapshot],
        jobs: JobRegistry,
        clock: Clock,
        live: LiveFeed | None = None,
        orders: Orders | None = None,
    ) -> None:
        self._live, self._orders = live, orders
        self.files: FileChanges | None = None
        """Changes the machine file; None: there is none."""
        self._begin, self._listening, self._snapshot, self._jobs, self._clock = begin, listening, snapshot, jobs, clock
        self.restarts = 0
        self._changed, self._ending = asyncio.Event(), asyncio.Event()
        self._child: asyncio.subprocess.Process | None = None
        self._up = False
        self._heard_s = 0.0

    def changed(self) -> None:
        """Send a snapshot soon: something has changed."""
        self._changed.set()

    def stop(self) -> None:
        """End the process and let `run` return."""
        self._ending.set()

    async def run(self) -> None:
        """Work until `stop`."""
        pause_s = PAUSE_S
        while not self._ending.is_set():
            begun_s = self._clock.monotonic_s()
            try:
                await self._run_once()
            except (ChannelBroken, OSError) as trouble:
                log.error("web process failed", cause=str(trouble))
            if self._ending.is_set():
                return
            pause_s = PAUSE_S if self._clock.monotonic_s() - begun_s > GOOD_LIFE_S else pause_s
            self.restarts += 1
            log.warning("the web process ended; starting it again", code=self._child and self._child.returncode, pause_s=pause_s)
            with suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._ending.wait()
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def _run_once(self) -> None:
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
        tasks = [asyncio.create_task(work, name=f"web {name}") for name, work in self._loops(wire)]
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

    def _loops(self, wire: Wire) -> list[tuple[str, Coroutine[None, None, None]]]:
        show = [] if self._live is None else [("show", show_live(wire, self._live, self._clock))]
        return [("send", self._send_updates(wire)), ("receive", self._receive(wire)), *show]

    async def _started(self, theirs: socket.socket) -> asyncio.subprocess.Process:
        # No secrets on the command line; in its environment neither the broker's password nor systemd's address.
        env = {k: v for k, v in os.environ.items() if k in PASSED_ON or not (k.startswith("ABBE_") or k in WITHHELD)}
        ends = (theirs.fileno(), self._listening.fileno())
        command = python_command("abbe.service.web.process", *ends)
        child = await asyncio.create_subprocess_exec(*command, stdin=subprocess.DEVNULL, pass_fds=ends, env=env)
        limit_memory(child.pid, self._begin.memory_mb)
        return child

    async def _end(self, child: asyncio.subprocess.Process) -> None:
        """Wait for the end of the process, whose channel has closed; kill it after `GOODBYE_S`: it holds nothing that could be lost."""
        if self._up:
            with suppress(TimeoutError):
                async with asyncio.timeout(GOODBYE_S):
                    await child.wait()
        if child.returncode is None:
            with suppress(ProcessLookupError):
                child.kill()
        await child.wait()

    async def _send_updates(self, wire: Wire) -> None:
        sent: tuple[object, ...] | None = None
        while True:
            self._changed.clear()
            if not wire.is_full:
                jobs = self._jobs.latest()
                if jobs != sent:
                    sent = jobs
                    wire.send(Jobs("jobs", jobs))
                wire.send(self._snapshot(self.restarts))
            silent_s = self._clock.monotonic_s() - self._heard_s
            if silent_s > (HANG_S if self._up else START_S):
                raise ChannelBroken(f"the web process has been silent for {silent_s:.0f} s")
            await asyncio.sleep(SHORTEST_S)
            with suppress(TimeoutError):
                async with asyncio.timeout(PERIOD_S - SHORTEST_S):
                    await self._changed.wait()

    async def _receive(self, wire: Wire) -> None:
        while (body := await wire.receive()) is not None:
            message = from_web(body)
            self._heard_s = self._clock.monotonic_s()
            match message:
                case Serving(protocol=protocol):
                    if protocol != PROTOCOL:
                        raise ChannelBroken(f"the web process speaks version {protocol} of the channel, the core {PROTOCOL}")
                    self._up = True
                    log.info("page up", restarts=self.restarts)
                case StartJob() | SteerJob() | ConfirmPrompt() | RollBack() | PushNow() | ChangeFile():
                    answer = await self._answered(message)
                    wire.send(Jobs("jobs", self._jobs.latest()))  # first: a client that gets a job's number can ask for it
                    wire.send(answer)
                case WebHeartbeat():
                    pass

    async def _answered(self, message: CoreRequest) -> Answer:
        try:
            match message:
                case StartJob():
                    return await self._jobs.start(message)
                case SteerJob():
                    return await self._jobs.steer(message)
                case ConfirmPrompt():
                    return await self._jobs.done_by_hand(message)
                case ChangeFile():
                    if self.files is None:
                        return Answer("answer", message.request, "conflict", "this service was started without a machine file", "")
                    return await self.files.change(message)
            if self._orders is None:
                return Answer("answer", message.request, "conflict", "this service takes no orders for tables", "")
            return await (self._orders.rollback(message) if isinstance(message, RollBack) else self._orders.push(message))
        except AbbeError as error:  # the store does not answer, so no user is known
            return Answer("answer", message.request, "busy", str(error)[:1000], "")
