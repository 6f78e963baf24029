"""The unattended service: what is wired to what, in which order it starts, and in which order it stops.

Start: store, MQTT, timetable, page. Stop, within five seconds: a running check is cancelled (the devices hold the motion), the page
closes, the broker is told "offline", the store is closed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import structlog

from service.audit.book import AuditBook, this_account
from service.audit.chain import Event
from service.clock import Clock, SystemClock
from service.errors import ConfigError
from service.events import Progress
from service.mqtt.broker import Broker
from service.mqtt.outbox import StoreOutbox
from service.mqtt.publisher import Publisher
from service.mqtt.topics import Topics
from service.scheduler.job import CheckJob
from service.scheduler.keep import StoreLedger, StoreShelf
from service.scheduler.loop import Scheduler, Terms
from service.scheduler.ports import Check, Doc, JobWatcher, Readiness
from service.scheduler.ready import AlwaysReady
from service.scheduler.slots import Schedule
from service.scheduler.store import ServiceStore
from service.scheduler.windows import Window
from service.storage.engine import parse_url
from service.users.people import People
from service.web.app import create_app
from service.web.board import Board
from service.web.door import Door
from service.web.server import bind, check_certificate, check_exposure, make_server
from service.web.view import View

log = structlog.get_logger("abbe.serve")

STOP_S = 4.5
"""Promised are 5 s from the signal to the end of the process; what hangs after this is cut off. The store survives that."""
HOLD_S = 2.5
GOODBYE_S = 1.2
FLUSH_S = 5.0
LOCAL = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = frozenset({"0.0.0.0", "::", ""})  # noqa: S104 - compared with, not listened on


@dataclass(frozen=True, slots=True)
class Setup:
    """What the service is to do, taken from the machine file.

    Parameters
    ----------
    machine : str
        Name of the machine.
    doc : dict
        Its description as the store keeps it.
    devices : mapping of str to str
        Role and URL.
    schedules : tuple of Schedule
        The timetable.
    store_url : str
        Where everything is kept.
    broker : Broker or None
        Where everything is told.
    topics : Topics
        Under which names.
    host, port : str, int
        Where the page is.
    check : callable
        Given the open store, returns ``check(recipe, progress)``.
    maintenance : tuple of Window
        Nothing starts by itself in these.
    ready : callable
        Given the clock, returns who knows the preconditions.
    names : tuple of str
        Under which other computers ask for the page.
    certificate, key : str
        PEM files of the page; empty: plain HTTP.
    """

    machine: str
    doc: dict[str, Any]
    devices: Mapping[str, str]
    schedules: tuple[Schedule, ...]
    store_url: str
    broker: Broker | None
    topics: Topics
    host: str
    port: int
    check: Callable[[ServiceStore], Check]
    maintenance: tuple[Window, ...] = ()
    ready: Callable[[Clock], Readiness] = lambda _: AlwaysReady()
    names: tuple[str, ...] = ()
    certificate: str = ""
    key: str = ""


class _StateTeller:
    """Keeps the retained state message true."""

    def __init__(self, publisher: Publisher, clock: Clock) -> None:
        self._publisher = publisher
        self._clock = clock

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        self._publisher.set_state("measuring", at_utc, schedule=schedule.name)

    def job_progress(self, progress: Progress) -> None:
        pass  # the state is retained, so every change is a write in the broker: progress is for the page

    def job_ended(self, doc: Doc | None) -> None:
        self._publisher.set_state("online", self._clock.utc())


class Service:
    """All parts of the running service, wired. The store is open and the port is taken, or this object does not exist."""

    def __init__(self, setup: Setup, store: ServiceStore, listening: socket.socket, clock: Clock) -> None:
        self._setup = setup
        self._store = store
        self._listening = listening
        self._clock = clock
        self.board = Board(setup.devices, clock)
        self._publisher = self._make_publisher()
        watchers: list[JobWatcher] = [self.board]
        if self._publisher is not None:
            watchers.append(_StateTeller(self._publisher, clock))
        topics = (setup.topics.verification, setup.topics.alarm) if self._publisher is not None else None
        shelf = StoreShelf(store, clock, (setup.machine, store.add_machine(setup.machine, setup.doc)), topics, self._posted)
        self._job = CheckJob(setup.machine, setup.check(store), shelf, watchers, clock)
        terms = Terms(setup.maintenance, setup.ready(clock))
        self._scheduler = Scheduler(setup.schedules, StoreLedger(store, clock, setup.machine), self._job, shelf, clock, terms)
        broker = "" if setup.broker is None else str(setup.broker)
        view = View(setup.machine, version("abbe"), self.board, store, self._scheduler.next_due, broker, clock)
        book = AuditBook(store, setup.store_url)
        book.write(Event(this_account(), "abbe serve", setup.machine, "begun", {"host": setup.host, "port": listening.getsockname()[1]}))
        people = People(store, clock)
        people.passwords.prepare()
        hosts = (*LOCAL, *setup.names, *(() if setup.host in EVERYWHERE else (setup.host,)))
        app = create_app(view, version=version("abbe"), hosts=hosts, door=Door(store, people, book))
        self._server = make_server(app, setup.certificate, setup.key)

    def _make_publisher(self) -> Publisher | None:
        if self._setup.broker is None:
            return None
        return Publisher(self._setup.broker, self._setup.topics, StoreOutbox(self._store), self._clock, self.board.broker)

    def _posted(self) -> None:
        if self._publisher is not None:
            self._publisher.wake()

    async def run(self, stop: asyncio.Event, *, once: bool) -> bool:
        """Work until ``stop``, or, with ``once``, until every recipe was run once; return whether all of those passed."""
        passed = True
        async with asyncio.TaskGroup() as parts:
            mqtt = parts.create_task(self._publisher.run() if self._publisher is not None else stop.wait(), name="mqtt")
            parts.create_task(self._server.serve(sockets=[self._listening]), name="web")
            work = parts.create_task(self._once() if once else self._timetable(), name="scheduler")
            beat = parts.create_task(self._heartbeat(), name="heartbeat")
            stopped = parts.create_task(stop.wait(), name="stop")
            try:
                await asyncio.wait({work, stopped}, return_when=asyncio.FIRST_COMPLETED)
            except asyncio.CancelledError:  # a part failed, and the group has cancelled us and all others
                self._ask_to_end()
                raise
            notify("STOPPING=1")
            if work.done() and not work.cancelled() and work.exception() is None:
                passed = work.result()
            work.cancel()
            await asyncio.wait({work}, timeout=HOLD_S)
            self._ask_to_end()
            await asyncio.wait({mqtt}, timeout=GOODBYE_S)
            mqtt.cancel()  # a broker that accepts connections and then says nothing would hold us up
            beat.cancel()
            stopped.cancel()
        return passed

    def _ask_to_end(self) -> None:
        """Page and broker end by themselves now.

        A cancellation alone can get lost: ``asyncio.wait_for`` of Python 3.11 swallows one that comes together with what it waits for, such
        as the broker's acknowledgement, and the service would stay half dead for ever.
        """
        self._server.should_exit = True
        if self._publisher is not None:
            self._publisher.stop()

    async def _timetable(self) -> bool:
        for schedule, slot in self._scheduler.next_due():
            log.info("planned", schedule=schedule.name, next_utc=slot.isoformat())
        await self._scheduler.run()
        return True

    async def _once(self) -> bool:
        states = [await self._job(replace(s, name=f"{s.name} (once)"), self._clock.utc()) for s in self._setup.schedules]
        with suppress(TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                # Messages that are not delivered now are delivered by the next start.
                while self.board.mqtt_connected and await asyncio.to_thread(self._store.waiting_messages) > 0:
                    await self._clock.sleep(0.1)
        return all(state == "done: pass" for state in states)

    async def _heartbeat(self) -> None:
        notify("READY=1")
        watchdog_us = int(os.environ.get("WATCHDOG_USEC") or 0)
        while True:
            notify("WATCHDOG=1")
            # From inside the loop: if the loop hangs, the beat stops, and systemd acts.
            await self._clock.sleep(watchdog_us / 2e6 if watchdog_us else 3600.0)


def serve(setup: Setup, *, once: bool = False, clock: Clock | None = None) -> int:
    """Run the service until SIGTERM or Ctrl-C; return the exit code: 0, or 1 if a check asked for by ``once`` did not pass.

    Raises
    ------
    AbbeError
        It cannot start: the port is taken, the store cannot be opened, there is nothing to do.
    """
    if once and not setup.schedules:
        raise ConfigError("there is no [[schedule]] whose recipe could be run once", "add one to the machine file")
    cut_off = threading.Timer(STOP_S, _cut_off)
    cut_off.daemon = True
    # Selector, also on Windows: the MQTT client works with no other loop there.
    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        passed = runner.run(_main(setup, once, clock or SystemClock(), cut_off))
    cut_off.cancel()
    return 0 if passed else 1


async def _main(setup: Setup, once: bool, clock: Clock, cut_off: threading.Timer) -> bool:
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
    await asyncio.to_thread(check_exposure, setup.host, lambda: _users(setup.store_url), tls=bool(setup.certificate))
    check_certificate(setup.certificate, setup.key)
    listening = bind(setup.host, setup.port)
    try:
        store = await asyncio.to_thread(ServiceStore.open, setup.store_url)
        try:
            host, port = listening.getsockname()[:2]
            scheme = "https" if setup.certificate else "http"
            log.info("serving", machine=setup.machine, page=f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/", store=store.url)
            return await Service(setup, store, listening, clock).run(stop, once=once)
        finally:
            await asyncio.to_thread(store.close)
            log.info("stopped")
    finally:
        listening.close()


def _users(url: str) -> int:
    """How many may log in; a database that is not there yet has none, and is not made for the question."""
    parsed = parse_url(url)
    if parsed.drivername == "sqlite" and not Path(parsed.database or "").is_file():
        return 0
    with ServiceStore.open(url) as store:
        return store.active_users()


def _cut_off() -> None:
    log.error("something did not stop in time; ending the process")
    os._exit(1)


def notify(state: str) -> None:
    """Tell systemd (``sd_notify``). Does nothing where nobody listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.connect(address)
        channel.send(state.encode())
