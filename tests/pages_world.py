"""A store with something for every screen, filled by the store's own functions, and the service's page over it on a real socket."""

from __future__ import annotations

import asyncio
import json
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from abbe.drivers.api import CompStatus, TableFormat
from abbe.drivers.errors import LinkDown
from abbe.drivers.tables import crc32, encode
from abbe.models.compensation.nine_tables import nine_tables, predict_residual
from abbe.models.compensation.tables import NineTables, quantise
from abbe.service.audit.book import AuditBook
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.clock import SystemClock, utc_text
from abbe.service.compensation.proposal_doc import BaseMark, Proposed, digest_of_doc, doc_of
from abbe.service.compensation.proposals import Promise, candidate_of
from abbe.service.config import load_machine
from abbe.service.core.board import Board
from abbe.service.discovery.discover import discover, prepare
from abbe.service.discovery.discovery_store import journal_of
from abbe.service.domain.machine import Rules
from abbe.service.domain.machine_file import MachineFileSummary
from abbe.service.domain.progress import ignore_progress
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AlarmFacts, AlarmKind, Signal
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.identification.solve import Solved, solve_runs
from abbe.service.identification.solve_report import solution_doc
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.runs.exchange import import_folder
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, table_image
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.verification import verify
from abbe.service.web.api.sources import LogTail, Sources
from abbe.service.web.app import create_app
from abbe.service.web.listening import bind
from abbe.service.web.login.auth_middleware import CSRF_HEADER
from abbe.service.web.login.authentication import COOKIE, Authenticator, csrf_token
from abbe.service.web.process.serving import make_server
from tests.built_once import once_per_run
from tests.pretended_push import KEPT, TAKEN_BACK, as_if_pushed
from tests.run_documents import runs_of
from tests.scenarios.campaign_files import measured
from tests.service.discovery.discovery_bench import Search, write_case
from tests.system.serve_check import Result

PHRASE = "correct horse battery staple"
SEED = 3
GRID = (11, 9, 9)
LSB_NM = 10
PROPOSER = "petra"
USERS = {"vera": "viewer", "olga": "operator", PROPOSER: "metrologist", "anna": "approver", "adam": "admin"}


@dataclass
class Filled:
    """What is in the store. ``evil`` stands behind every name that comes from outside."""

    url: str
    machine: str
    schedules: list[Schedule]
    devices: dict[str, str]
    campaign: str
    solution: int
    proposals: list[int]
    discovery: int
    checks: int = 24


def _solved(_folder: Path) -> tuple[Solved, str]:
    site, runs = measured(SEED)
    # Four step diagonals would show every motion by itself.
    diagonals = [run for run in runs if run["test"] == "laser_diagonal"]
    solved = solve_runs(site, runs_of([run for run in runs if run not in diagonals[1:]]))
    return solved, json.dumps(solution_doc(solved))


def solved_campaign(factory: pytest.TempPathFactory, machine: str) -> tuple[Site, list[dict[str, Any]], Solved, dict[str, Any]]:
    """Seventeen simulated runs of one machine, what they say, and that as a document."""
    site, runs = measured(SEED)
    site = replace(site, name=machine, doc=site.doc | {"name": machine})
    for run in runs:
        run["machine"] = site.doc
        run["columns"]["temp_air_C"] = [20.4] * len(run["columns"]["t_s"])
    _, (solved, doc) = once_per_run(factory, "solved-campaign", _solved)
    return site, runs, solved, json.loads(doc)


def filled_once(factory: pytest.TempPathFactory) -> Filled:
    """A copy of a filled store, made once in a run of the tests."""
    made, filled = once_per_run(factory, "filled-screens", lambda folder: fill(factory, folder))
    folder = shutil.copytree(made, factory.mktemp("screens"), dirs_exist_ok=True)
    return replace(filled, url=f"sqlite:///{folder / 'abbe.sqlite3'}")


def fill(factory: pytest.TempPathFactory, folder: Path, evil: str = "", checks: int = 24, days: int = 7) -> Filled:
    """Fill a new store with campaign, solution, discovery, proposals, slots and checks, ``days`` apart; they drift as in 24 weeks."""
    url = f"sqlite:///{folder / 'abbe.sqlite3'}"
    machine = f"mill-7{evil}"
    schedules = [Schedule(f"weekly{evil}", "0 6 * * 1", "Europe/Berlin", f"quick-check{evil}"),
                 Schedule("night", "30 2 * * *", "Europe/Berlin", "verify")]  # fmt: skip
    devices = {"ballbar": f"serial:///dev/serial/by-id/usb-bar{evil}", "laser": "modbus://127.0.0.1:5021"}
    with Store.open(url) as store:
        _slots(store, machine, schedules, evil)
        site, runs, solved, doc = solved_campaign(factory, machine)
        campaign = f"june{evil}"
        _import(store, folder / "in", campaign, site, runs)
        labels = [run["run_id"] for run in runs if run["test"] in {"ballbar_helix", "laser_diagonal"}]
        _checks(store, site, schedules[0], Pace(checks, days), evil, Measured(campaign, labels))
        _broken_run(store, campaign, evil)
        stored = store.campaigns.find(campaign)
        ids = [r.id for r in store.runs.all(stored.id) if r.visible_status == "complete"]
        doc |= {"campaign": campaign, "machine": site.doc, "flags": [f"run r1: look at it{evil}"]}
        doc["not_observable"] = [*doc["not_observable"], f"the colour of the machine{evil}"]
        solution = store.solutions.add(stored.id, "joint", ids, doc)
        with ThreadPoolExecutor(1) as aside:  # a test with a browser has a loop in this thread
            # Before the proposals: what is written afterwards supersedes them.
            aside.submit(lambda: asyncio.run(_pushes(store, machine, evil))).result()
        proposals = _proposals(store, site, runs, solved, campaign, solution, evil)
        add_alarms(store, machine, schedules[0], proposals[-1], evil)
        return Filled(url, machine, schedules, devices, campaign, solution, proposals, _discovery(store, folder / "c1", evil), checks)


@dataclass(frozen=True)
class Measured:
    """Runs that are stored with the last check, and with a good one before."""

    campaign: str
    labels: list[str]


@dataclass(frozen=True)
class Pace:
    """Number of checks, and the days between them."""

    count: int
    days: int


def _checks(store: Store, site: Site, schedule: Schedule, pace: Pace, evil: str, known: Measured) -> None:
    machine, count = site.name, pace.count
    now, number = datetime.now(UTC), store.machines.add(machine, site.doc)
    for k in range(count):
        at = now - timedelta(days=pace.days * (count - 1 - k), hours=3)
        occasion = verify.Occasion(machine, schedule, at)
        if k == count - 3:
            trouble = LinkDown(f"modbus+tcp://127.0.0.1:5021{evil}", "connect", f"refused{evil}", f"is the laser on?{evil}")
            store.verifications.add_with_messages(number, verify.failed_doc(occasion, trouble, at, 5.0), [])
            continue
        week = k * 23.0 / (count - 1)
        drift = 11.0 + 0.02 * week**2
        verdict = "fail" if drift - 1.1 > 20 else "pass" if drift + 1.1 <= 20 else "cannot tell"
        values = {"diagonal_ppp_um": drift - 3, "body_diagonal_um": drift, "helix_rms_um": 1.2 + 0.1 * week}
        told = Result(verdict, values, text=f"{verdict}: worst body diagonal {drift:.1f} µm{evil}", started_utc=at, duration_s=312.0,
                      campaign=f"quick-check {k}{evil}")  # fmt: skip
        if k in {count - 5, count - 1}:
            told = replace(told, campaign=known.campaign, run_labels=tuple(known.labels))
        store.verifications.add_with_messages(number, verify.check_doc(occasion, told), [])


def add_alarms(store: Store, machine: str, schedule: Schedule, proposal: int, evil: str = "") -> None:
    """One that is over and that nobody has seen, and one that is active, with a proposal."""
    check = store.verifications.latest(limit=1)[0]
    values = check.doc["values"]
    signals = [Signal("body_diagonal_um", "limit", values["body_diagonal_um"], 1.1, 20.0, f"worst body diagonal is above its limit{evil}"),
               Signal("helix_rms_um", "jump", values["helix_rms_um"], 0.2, 5.0, "helix rms differs", 2.1, 0.1)]  # fmt: skip
    head = AlarmFacts(recipe=schedule.recipe, schedule=schedule.name, verification=check.id, text=f"above its limit{evil}")
    for number, kinds in ((1, ("raised", "cleared")), (2, ("raised",))):
        for seq, kind in enumerate(kinds):
            told = tuple(signals[::-1][number - 1 :]) if kind == "raised" else ()
            store.alarms.append(machine, None if seq == 0 else number, seq, AlarmKind(kind), replace(head, signals=told))
    store.alarms.append(machine, 2, 1, AlarmKind.PROPOSED, AlarmFacts(proposal=proposal, text=f"proposal {proposal} waits{evil}"))


def _slots(store: Store, machine: str, schedules: list[Schedule], evil: str) -> None:
    for day, (state, reason) in enumerate([("done: pass", ""), ("skipped: busy", f"weekly was still running{evil}"), ("done: fail", "")]):
        at = datetime(2026, 11, 2 + 7 * day, 5, tzinfo=UTC)
        for schedule in schedules:
            store.slots.claim(f"{machine}/{schedule.name}", at)
            store.slots.finish(f"{machine}/{schedule.name}", at, state, reason)


def _import(store: Store, folder: Path, campaign: str, site: Site, runs: list[dict[str, Any]]) -> None:
    folder.mkdir()
    entries = []
    for n, run in enumerate(runs):
        (folder / f"r{n}.json").write_text(json.dumps(run | {"campaign": campaign}))
        entries.append({"run_id": run["run_id"], "test": run["test"], "role": run["role"], "file": f"r{n}.json"})
    head = {"format": "abbe-campaign/1", "campaign": campaign, "machine": site.doc, "temperature_sensors": False, "setups": {}}
    head |= {"current_model": {"includes": ["rigid21"], "errors": None}, "instruments": {"ballbar": {"resolution_mm": 1e-4}}}
    (folder / "campaign.json").write_text(json.dumps(head | {"runs": entries}))
    import_folder(store, folder)


def _broken_run(store: Store, campaign: str, evil: str) -> None:
    number = store.runs.start(store.campaigns.find(campaign).id, f"late{evil}", "ballbar_circle", "identify", {"setup": {}})
    store.runs.finish(number, "stopped", f"SEQ-003: the door was opened{evil}", None)


def _proposals(store: Store, site: Site, runs: list[dict[str, Any]], solved: Solved, campaign: str, solution: int, evil: str) -> list[int]:
    change = nine_tables(solved.joint, GRID)
    predicted = predict_residual(solved.joint, change)
    tables = quantise(change, LSB_NM * 1e-6)
    x, y, z = (np.zeros_like(c) for c in tables.correction_mm)
    image = encode(table_image(NineTables(tables.position_mm, (x, y, z), tables.u_mm), LSB_NM, 1))
    base = Base(CompStatus(7, 3, 0, (crc32(image), 0), (3, 0), 0, 0), image)
    now = datetime.now(UTC)
    ended_s = (now - timedelta(hours=2)).timestamp()
    promise = Promise(tables, change, predicted, None, ended_s, ended_s)
    candidate = candidate_of(site, promise, base, runs_of(runs), TableFormat(LSB_NM, 4096))
    one = Proposed(
        site.doc, campaign, solution, candidate, tables.u_mm, BaseMark(image, 0, 3, 7), 99, site.limits, True, PROPOSER,
        utc_text(now), (), (f"backlash of X is not in a table{evil}",),
    )  # fmt: skip
    out = []
    for proposed in (replace(one, reasons=(f"STALE: measured 80 h ago{evil}",)), replace(one, by=f"{PROPOSER}{evil}"), one):
        doc = doc_of(proposed)
        out.append(store.proposals.add(site.name, solution, doc, digest_of_doc(doc)))
    return out


class _Earlier(SystemClock):
    """The clock of before the first check, which is thereby of the table in force."""

    def utc(self) -> datetime:
        return super().utc() - timedelta(weeks=30)


async def _pushes(store: Store, machine: str, evil: str) -> None:
    """A rollback that did not hold, and a push that was kept: that one can be taken back."""
    clock = _Earlier()
    back = {"kind": "rollback", "reason": f"worse on the gauge block{evil}", "by": f"user:anna{evil}"}
    await as_if_pushed(store, clock, machine, back, (b"the table of May", b"the table of April"), TAKEN_BACK)
    await as_if_pushed(store, clock, machine, {"proposal": 99}, (b"the table of May", b"the table of June"), KEPT)


def _discovery(store: Store, folder: Path, evil: str) -> int:
    write_case(folder, f"c1{evil}")
    job = prepare(from_folder(folder), catalogue(), None)
    journal = journal_of(store, job)
    discover(job, journal, Search("named"), ignore_progress)
    assert journal.id is not None
    return journal.id


@dataclass
class Served:
    """The running page."""

    base: str
    filled: Filled
    store: Store
    people: UserAccounts
    auth: Authenticator
    board: Board
    tail: LogTail


MACHINE_FILE = """\
name = "mill-7"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 500]
Y = [0, 400]
Z = [-300, 0]

[limits]
table_value_um = 80.0   # the line that a person has to change
[devices]
laser = "modbus+tcp://127.0.0.1:5021"
[calibration]
laser = 2027-05-31
[issuer]
laboratory = "Gauge room"
city = "Bonn"
country = "DE"
person = "A. Probst"
[[schedule]]
name = "weekly"
cron = "0 6 * * 1"
timezone = "Europe/Berlin"
recipe = "quick-check"
[mqtt]
url = "mqtt://ann:secret@127.0.0.1:1883"
"""


def _stated(filled: Filled) -> MachineFileSummary:
    """A machine file as the service has read it."""
    path = Path(filled.url.removeprefix("sqlite:///")).parent / "machine.toml"
    path.write_text(MACHINE_FILE)
    return load_machine(path).summary()


@contextmanager
def served(filled: Filled, *, users: bool = True, port: int = 0) -> Iterator[Served]:
    """The page over a filled store, on a real socket, in a thread with its own event loop."""
    clock = SystemClock()
    with Store.open(filled.url) as store:
        people = UserAccounts(store, clock, Passwords(memory_kib=64, passes=1))
        for name, role in USERS.items() if users else ():
            if store.people.find(name) is None:
                people.add(name, role, PHRASE)
        auth = Authenticator(store, people, AuditBook(store, filled.url), rate_hz=1e6, burst=1e6)
        board = Board(filled.devices, clock)
        soon = datetime.now(UTC) + timedelta(hours=30)
        view = StatusReader(Reader(store, filled.machine, clock), "0.1.0", board, lambda: [(s, soon) for s in filled.schedules], "")
        tail = LogTail()
        rules = Rules({"circularity": 20.0}, {"ballbar": (soon + timedelta(days=90)).date(), "laser": date(2026, 1, 1)})
        sources = Sources(
            reader=view.reader, schedules=filled.schedules, devices=lambda: board.devices, rules=rules, tail=tail, stated=_stated(filled)
        )
        listening = bind("127.0.0.1", port)
        server = make_server(create_app(view, version="0.1.0", auth=auth, api=sources))
        thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listening])))
        thread.start()
        try:
            yield Served(f"http://127.0.0.1:{listening.getsockname()[1]}", filled, store, people, auth, board, tail)
        finally:
            server.should_exit = True
            thread.join()
            listening.close()


def as_user(running: Served, name: str, **headers: str) -> httpx.Client:
    """A client with a session of one of `USERS`."""
    secret = running.people.begin(running.people.get(name))
    known = {"Cookie": f"{COOKIE}={secret}", CSRF_HEADER: csrf_token(secret), "Origin": running.base}
    return httpx.Client(base_url=running.base, headers=known | headers, timeout=60)


def screens(filled: Filled) -> list[str]:
    """Every address, with something on it: a helix, a diagonal, a run that was stopped; a refused and an open proposal."""
    runs = [f"/run?id={n}" for n in (1, 8, 18)]
    proposals = [f"/proposal?id={n}" for n in filled.proposals[::2]]
    found = [f"/result?id={filled.solution}", f"/discovery?id={filled.discovery}"]
    found += [f"/motions?id={filled.solution}", f"/motions?id={filled.solution}&motion=EXY", f"/motions?id={filled.solution}&motion=C0Y"]
    found += [f"/volume?id={filled.solution}", f"/volume?id={filled.solution}&motion=EYY&plane=XZ", f"/budget?id={filled.solution}"]
    found += [f"/whatif?id={filled.solution}&take=mean.C0Y&take=EYY", "/compare", "/compare?run=2&run=3"]
    plant = ["/fleet", "/devices", "/settings", "/administration"]
    first = ["/", "/new", "/runs", *runs, "/results", "/discoveries", *found]
    alarms = ["/alarms", "/alarm?id=1", "/alarm?id=2", f"/check?id={filled.checks}", f"/check?id={filled.checks - 2}"]
    return [*first, *alarms, "/proposals", *proposals, "/table", "/trends", "/schedule", "/audit", *plant]
