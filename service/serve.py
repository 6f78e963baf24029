"""The unattended service: its parts, the order in which they start, and the order in which they stop.

This is the core process: devices, timetable, jobs, MQTT. It answers no HTTP; the page is a process of its own (`abbe.service.web.process`)
that the core starts and talks to over a channel (`abbe.service.channel`). Start: store, MQTT, timetable, page. Stop, within five seconds:
a running check is cancelled, which stops the axes, the page closes, the state "offline" is published, the store closes.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from abbe.service.audit.book import AuditBook, this_account
from abbe.service.channel.messages import PROTOCOL, Begin
from abbe.service.clock import Clock, SystemClock
from abbe.service.core.board import Board, BoardWatch, SnapshotSource, StatePublisher, VerifiedWatch
from abbe.service.core.file_changes import FileChangeContext, FileChanges
from abbe.service.core.jobs import JobRegistry
from abbe.service.core.orders import OrderActions, OrderContext, Orders, full_campaigns, may
from abbe.service.core.push_recovery import PushRecovery, push_is_open
from abbe.service.core.setup import ServiceSetup
from abbe.service.core.table_watch import TableWatch
from abbe.service.core.web_process import WebProcess
from abbe.service.domain.people import Permission
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import ConfigError
from abbe.service.mqtt.publisher import Publisher, StoreOutbox
from abbe.service.plant.gather import Gatherer
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.scheduler.alarm_manager import AlarmChannels, AlarmManager
from abbe.service.scheduler.heartbeat import Heartbeat
from abbe.service.scheduler.job import CheckJobs
from abbe.service.scheduler.loop import LoopTerms, Scheduler
from abbe.service.scheduler.ports import JobWatcher, Readiness
from abbe.service.scheduler.retrying_store import StoreLedger, StoreShelf
from abbe.service.sequences.recipes.campaigns import split_recipe_name
from abbe.service.storage.engine import database_readable_by_others, parse_url
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView
from abbe.service.verification.verified_by import verified_by
from abbe.service.web.listening import bind, check_certificate, check_exposure

if TYPE_CHECKING:
    from abbe.service.plant.opcua.server import OpcUaServer

log = structlog.get_logger("abbe.serve")

JOURNAL_S = 0.25
"""Longest time to read the push journal before a forced end, s."""
OpenPushReader = Callable[[], str]
"""Returns a sentence about the push that is still open, or an empty text if there is none."""
STOP_S = 4.5
"""Time, s, from the stop signal until the process is ended by force; the service must end within 5 s. The store survives a forced end."""
LEAVE_S = 0.3
"""Longest wait, s, for a thread that still computes after everything has closed."""
WORK_END_S = 2.5
GOODBYE_S = 1.2
FLUSH_S = 5.0
READY_AGAIN_S = 0.2
LOCAL = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = frozenset({"0.0.0.0", "::", ""})  # noqa: S104 - compared with, not listened on


class Service:
    """All parts of the running service, connected. The store is open and the port is bound before this object exists."""

    def __init__(self, setup: ServiceSetup, store: Store, listening: socket.socket, clock: Clock) -> None:
        self._setup = setup
        self._store = store
        self._clock = clock
        self._listening = listening
        self.board = Board(setup.devices, clock)
        self._publisher = self._make_publisher()
        self._presence = Heartbeat(
            setup.machine, version("abbe"), store.heartbeats, lambda: self._scheduler.next_due(), clock, self.board.attention
        )
        watchers: list[JobWatcher] = [BoardWatch(self.board, self._changed), self._presence]
        if self._publisher is not None:
            watchers.append(StatePublisher(self._publisher, clock))
        topics = (setup.topics.verification, setup.topics.alarm) if self._publisher is not None else None
        self._shelf = StoreShelf(store, clock, (setup.machine, store.machines.add(setup.machine, setup.doc)), topics, self._posted)
        book = AuditBook(store, setup.store_url)
        alarms = self._make_alarms(book)
        self._pushes_itself = alarms is not None and alarms.duties.push is not None
        checks = CheckJobs(setup.machine, setup.check(store), self._shelf, clock, alarms.checked if alarms is not None else None)
        recipes = tuple(dict.fromkeys([*setup.recipes, *(split_recipe_name(schedule.recipe)[0] for schedule in setup.schedules)]))
        self._jobs = JobRegistry(
            checks, recipes, lambda who, need: asyncio.to_thread(may, store, who, need), clock, self._changed, watchers
        )
        context = OrderContext(setup.machine, lambda who: asyncio.to_thread(may, store, who, Permission.APPROVE), book, setup.control)
        if setup.campaign is not None:
            self._jobs.full = full_campaigns(
                context,
                setup.campaigns,
                setup.campaign(store),
                lambda who: asyncio.to_thread(may, store, who, Permission.PROPOSE),
                alarms,
            )
        self.ready = setup.ready(clock)
        terms = LoopTerms(setup.maintenance, self.ready, follow_ups=alarms, run_job=self._jobs.run)
        self._scheduler = Scheduler(setup.schedules, StoreLedger(store, clock, setup.machine), self._jobs, self._shelf, clock, terms)
        snapshots = SnapshotSource(self.board, self._jobs, self._scheduler.next_due, clock)
        orders = Orders(store, clock, self._jobs, context, OrderActions() if setup.actions is None else setup.actions(store))
        begin = self._begin((*recipes, *self._jobs.full.names))
        self.following: ServiceSetup | None = None
        """The setup with which the service starts anew after `run`; None: it ends."""
        self._end = asyncio.Event()
        self._web = WebProcess(begin, listening, snapshots.now, self._jobs, clock, setup.live, orders)
        self._web.files = None if setup.source is None else FileChanges(setup.source, self._file_changes(book))
        self._opcua = self._make_opcua()
        doc = {"host": setup.web.host, "port": listening.getsockname()[1]}
        doc |= {} if setup.stated is None else {"machine_file": setup.stated.path, "sha256": setup.stated.sha256}
        book.write(AuditEvent(who=this_account(), action="abbe serve", target=setup.machine, outcome="begun", doc=doc))

    def _file_changes(self, book: AuditBook) -> FileChangeContext:
        setup, store = self._setup, self._store

        def restart(following: ServiceSetup) -> None:
            self.following = following
            self._end.set()

        return FileChangeContext(
            lambda who, need: asyncio.to_thread(may, store, who, need),
            book,
            lambda: self._jobs.claim,
            partial(push_is_open, store, setup.machine, setup.control),
            restart,
            setup.devices.get("cnc"),
        )

    def _begin(self, recipes: tuple[str, ...]) -> Begin:
        setup = self._setup
        broker = "" if setup.broker is None else str(setup.broker)
        hosts = (*LOCAL, *setup.web.names, *(() if setup.web.host in EVERYWHERE else (setup.web.host,)))
        begin = Begin(
            "begin",
            PROTOCOL,
            setup.machine,
            version("abbe"),
            setup.store_url,
            broker,
            hosts,
            setup.web.certificate,
            setup.web.key,
            recipes,
            self._listening.getsockname()[1],
            setup.web.behind_tls,
            tuple(setup.schedules),
            setup.rules,
            setup.summary,
            self._jobs.full.names,
            setup.web.memory_mb,
            setup.control,
            self._pushes_itself,
            None,
        )
        return begin if setup.stated is None else begin.stating(setup.stated)

    def _changed(self) -> None:
        self._web.changed()

    def _make_publisher(self) -> Publisher | None:
        setup, board = self._setup, self.board
        if setup.broker is None:
            return None
        outbox = StoreOutbox(self._store.outbox, setup.topics, self._clock)
        return Publisher(setup.broker, setup.topics, outbox, self._clock, board.broker, board.messages_dropped)

    def _make_opcua(self) -> OpcUaServer | None:
        setup = self._setup
        if setup.opcua is None:
            return None
        from abbe.service.plant.opcua.server import OpcUaServer  # optional dependency, slow to import

        broker = "" if setup.broker is None else str(setup.broker)
        reader = Reader(self._store, setup.machine, self._clock, setup.control)
        view = StatusReader(reader, version("abbe"), self.board, self._scheduler.next_due, broker)
        return OpcUaServer(setup.opcua, Gatherer(view.status, self._store, setup.control), self._clock, setup.machine, version("abbe"))

    def _make_alarms(self, book: AuditBook) -> AlarmManager | None:
        setup = self._setup
        if setup.duties is None:
            return None
        channels = AlarmChannels(setup.topics.alarm if self._publisher is not None else None, self._posted, book)
        return AlarmManager(self._store, self._clock, setup.machine, setup.schedules, setup.duties(self._store), channels)

    def _posted(self) -> None:
        if self._publisher is not None:
            self._publisher.wake()

    async def run(self, stop: asyncio.Event, *, once: bool) -> bool:
        """Work until ``stop`` is set, the machine file changes or, with ``once``, every recipe has run once. Return False if a check that
        ``once`` ran did not pass."""
        passed, end = True, self._end
        if self._opcua is not None:
            await self._opcua.prepare()
        async with asyncio.TaskGroup() as parts:
            mqtt = parts.create_task(self._publisher.run() if self._publisher is not None else end.wait(), name="mqtt")
            parts.create_task(self._web.run(), name="web")
            work = parts.create_task(self._once() if once else self._timetable(parts), name="scheduler")
            beat = parts.create_task(self._heartbeat(), name="heartbeat")
            opcua = parts.create_task(self._opcua.run(end) if self._opcua is not None else end.wait(), name="opcua")
            presence = parts.create_task(self._presence.run(), name="presence")
            ended = parts.create_task(end.wait(), name="end")
            stopped = parts.create_task(stop.wait(), name="stop")
            try:
                await asyncio.wait({work, stopped, ended}, return_when=asyncio.FIRST_COMPLETED)
            except asyncio.CancelledError:  # a part failed, and the group has cancelled this task and all others
                self._ask_to_end()
                raise
            if self.following is None or stop.is_set():
                notify("STOPPING=1")
            end.set()
            if work.done() and not work.cancelled() and work.exception() is None:
                passed = work.result()
            work.cancel()
            by_hand = parts.create_task(self._jobs.close(), name="jobs")
            await asyncio.wait({work, by_hand}, timeout=WORK_END_S)
            self._ask_to_end()
            await asyncio.wait({mqtt}, timeout=GOODBYE_S)
            mqtt.cancel()  # a broker that accepts connections and never answers would delay the end
            for task in (beat, stopped, ended, opcua, presence):
                task.cancel()
        return passed

    def _ask_to_end(self) -> None:
        """Ask page and publisher to end by themselves.

        A cancellation alone can get lost: ``asyncio.wait_for`` of Python 3.11 swallows a cancellation that coincides with the awaited
        result, such as the broker's acknowledgement, and the service would never end.
        """
        self._web.stop()
        if self._publisher is not None:
            self._publisher.stop()

    async def _timetable(self, parts: asyncio.TaskGroup) -> bool:
        self._jobs.open(self._scheduler, parts)
        for schedule, slot in self._scheduler.next_due():
            log.info("planned", schedule=schedule.name, next_utc=slot.isoformat())
        async with asyncio.TaskGroup() as tasks:
            if self._setup.recover is not None:
                recover, attention = self._setup.recover(self._store), self.board.attention
                is_open = partial(push_is_open, self._store, self._setup.machine, self._setup.control)
                ends = PushRecovery(recover, is_open, self._scheduler, self._shelf, attention, self._clock, self._attention_changed)
                tasks.create_task(ends.run(), name="recovery")
            if self._setup.table is not None:
                look, attention = self._setup.table(self._store), self.board.attention
                tasks.create_task(TableWatch(look, self._shelf, attention, self._clock, self._attention_changed).run(), name="table")
            known = partial(verified_by, self._store, self._setup.machine, control=self._setup.control)
            tasks.create_task(VerifiedWatch(known, self._publisher, self._clock, self._changed).run(), name="verified")
            await self._scheduler.run()
        return True

    def _attention_changed(self) -> None:
        self.board.changed()
        self._presence.attention_changed()
        self._changed()

    async def _once(self) -> bool:
        states = [await self._jobs(replace(s, name=f"{s.name} (once)"), self._clock.utc()) for s in self._setup.schedules]
        with suppress(TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                # The next start delivers what is not delivered now.
                while self.board.mqtt_connected and await asyncio.to_thread(self._store.outbox.count) > 0:
                    await self._clock.sleep(0.1)
        return all(state == "done: pass" for state in states)

    async def _heartbeat(self) -> None:
        while not notify("READY=1"):
            await self._clock.sleep(READY_AGAIN_S)  # its watchdog begins with this message
        watchdog_us = int(os.environ.get("WATCHDOG_USEC") or 0)
        while True:
            notify("WATCHDOG=1")
            # From inside the loop: if the loop hangs, the heartbeat stops, and systemd restarts the service.
            await self._clock.sleep(watchdog_us / 2e6 if watchdog_us else 3600.0)


def serve(setup: ServiceSetup, *, once: bool = False, clock: Clock | None = None) -> int:
    """Run the service until SIGTERM or Ctrl-C; return the exit code: 0, or 1 if a check run by ``once`` did not pass.

    Raises
    ------
    AbbeError
        The service cannot start: the port is in use, the store cannot be opened, or there is nothing to do.
    """
    if once and not setup.schedules:
        raise ConfigError("there is no [[schedule]] whose recipe could be run once", "add one to the machine file")
    open_push_readers: list[OpenPushReader] = []
    cut_off = threading.Timer(STOP_S, cut_off_now, [open_push_readers])
    cut_off.daemon = True
    # Selector loop, also on Windows: the MQTT client works with no other loop there.
    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        passed = runner.run(_main(setup, once, clock or SystemClock(), cut_off, open_push_readers))
        # Devices and store are closed. A thread that still solves or searches can lose nothing.
        leave = threading.Timer(LEAVE_S, leave_now, [0 if passed else 1])
        leave.daemon = True
        leave.start()
    leave.cancel()
    cut_off.cancel()
    return 0 if passed else 1


async def _main(setup: ServiceSetup, once: bool, clock: Clock, cut_off: threading.Timer, open_push_readers: list[OpenPushReader]) -> bool:
    stop = asyncio.Event()

    def on_signal(name: str) -> None:
        if not stop.is_set():
            log.info("stopping", signal=name)
            cut_off.start()
            stop.set()

    loop = asyncio.get_running_loop()

    def from_any_thread(number: int, _: object) -> None:
        loop.call_soon_threadsafe(on_signal, signal.Signals(number).name)

    for number in (signal.SIGTERM, signal.SIGINT):
        # signal.signal rather than add_signal_handler: it works on Windows too, and the loop is woken either way.
        signal.signal(number, from_any_thread)
    reach = partial(check_exposure, tls=bool(setup.web.certificate), names=setup.web.names, behind_tls=setup.web.behind_tls)
    await asyncio.to_thread(reach, setup.web.host, lambda: _admins(setup.store_url))
    check_certificate(setup.web.certificate, setup.web.key)
    listening = bind(setup.web.host, setup.web.port)
    try:
        while True:
            service, passed = await _live(setup, listening, clock, stop, open_push_readers, once=once)
            if service.following is None or stop.is_set():
                return passed
            setup = _continued(service.following, service.ready)
            log.info("starting anew with the changed machine file")
    finally:
        listening.close()


def _continued(setup: ServiceSetup, earlier: Readiness) -> ServiceSetup:
    """Return a setup that keeps the record of when the machine was at work: a machine does not cool down because its file has changed."""

    def ready(clock: Clock) -> Readiness:
        made = setup.ready(clock)
        made.continue_from(earlier)
        return made

    return replace(setup, ready=ready)


async def _live(
    setup: ServiceSetup,
    listening: socket.socket,
    clock: Clock,
    stop: asyncio.Event,
    open_push_readers: list[OpenPushReader],
    *,
    once: bool,
) -> tuple[Service, bool]:
    """Run the service until it ends or its machine file has changed; the socket stays open, so that browsers wait."""
    store = await asyncio.to_thread(Store.open, setup.store_url)
    if warning := database_readable_by_others(setup.store_url):
        log.warning("database", text=warning)
    try:
        host, port = listening.getsockname()[:2]
        scheme = "https" if setup.web.certificate else "http"
        for line in setup.warnings:
            log.warning("machine file", text=line)
        log.info("serving", machine=setup.machine, page=f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/", store=store.url)
        open_push_readers[:] = [lambda: JournalView.read(store, setup.machine, setup.control).open_push]
        service = Service(setup, store, listening, clock)
        return service, await service.run(stop, once=once)
    finally:
        await asyncio.to_thread(store.close)
        log.info("stopped")


def _admins(url: str) -> int:
    """Return how many admins may log in. A database that does not exist has none, and is not created."""
    parsed = parse_url(url)
    if parsed.drivername == "sqlite" and not Path(parsed.database or "").is_file():
        return 0
    with Store.open(url) as store:
        return store.people.active_admins()


def cut_off_now(readers: list[OpenPushReader]) -> None:
    """End the process. Nothing is lost: the axes have stopped already, and every step of a push is in the journal before it is done."""
    texts: list[str] = []
    for one in readers:  # in a thread of its own: a database that hangs must not delay the end
        reading = threading.Thread(target=lambda read=one: texts.append(read()), daemon=True)
        reading.start()
        reading.join(JOURNAL_S)
    log.error("stop timeout; ending the process", open_push=texts[0] if texts else "the journal could not be read")
    leave_now(1)


def leave_now(code: int) -> None:
    """End the process at once, after flushing its output."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def notify(state: str) -> bool:
    """Notify systemd (``sd_notify``) without waiting; return false if it does not listen now. Without systemd, do nothing."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return True
    if address.startswith("@"):
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)  # its queue may be full, and the watch over a motion runs in this loop
            channel.connect(address)
            channel.send(state.encode())
    except OSError:
        return False
    return True
