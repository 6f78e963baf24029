"""A store with one of everything, made by the store's and the workflows' own functions, and a real server over it."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from abbe.drivers.api import BarSample, CompStatus, TableFormat
from abbe.drivers.tables import TableImage, crc32, encode
from abbe.service.audit.book import AuditBook
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.compensation.proposal_doc import digest_of_doc, doc_of, load
from abbe.service.compensation.proposals import GatheredCampaign, make
from abbe.service.core.board import Board
from abbe.service.discovery.discover import discover, prepare
from abbe.service.discovery.discovery_store import journal_of
from abbe.service.domain.people import ALLOWED, Role
from abbe.service.domain.progress import ignore_progress
from abbe.service.domain.push_entry import PushState
from abbe.service.domain.schedule import Schedule
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.push.journal import StoreBook
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.runs.chunks import BAR_CODEC, JSON_CODEC, encode_bar, encode_json
from abbe.service.runs.exchange import import_folder
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import create_app
from abbe.service.web.listening import bind
from abbe.service.web.login.auth_middleware import CSRF_HEADER
from abbe.service.web.login.authentication import COOKIE, Authenticator, csrf_token
from abbe.service.web.process.serving import make_server
from tests.built_once import once_per_run
from tests.service.discovery.discovery_bench import MACHINE, Search, write_case

PHRASE = "correct horse battery staple"
NAME = "VMC-1"
RATE_HZ, PATH_US = 1000, 1_000_000
SETUP = {"setup_id": "A", "t_set_s": 3.5, "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0}
POINTS = [[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 40.0, 0.0], [30.0, 40.0, 30.0]]
SAMPLES = 1040
CHECKS = 12


@dataclass
class Hour:
    """A clock that stands, an hour after everything was measured."""

    now: datetime = field(default_factory=lambda: datetime(2026, 11, 22, 9, tzinfo=UTC))

    def utc(self) -> datetime:
        return self.now

    def monotonic_s(self) -> float:
        return self.now.timestamp()

    async def sleep(self, s: float) -> None:
        raise AssertionError("nothing sleeps here")


@dataclass
class Plant:
    """A store with content, and the application over it."""

    store: Store
    url: str
    clock: Hour
    people: UserAccounts
    book: AuditBook
    app: FastAPI
    auth: Authenticator
    approvable: list[int]
    """Proposals that can be approved."""

    def session(self, role: str) -> dict[str, str]:
        secret = self.people.begin(self.people.get(f"a-{role}"))
        return {"Cookie": f"{COOKIE}={secret}", CSRF_HEADER: csrf_token(secret)}

    def token(self, role: str) -> dict[str, str]:
        scopes = sorted(ALLOWED[Role(role)])
        title = f"t{len(self.store.people.tokens())}"
        return {"Authorization": f"Bearer {self.people.add_token(f'a-{role}', title, scopes, 5.0)}"}


def bar_samples() -> list[BarSample]:
    out = []
    for seq in range(SAMPLES):
        since_us = (seq - 20) * 1000 + 300
        out.append(BarSample(seq, 10**9 + seq * 1000, since_us, 8 if 0 <= since_us < PATH_US else 0))
    return out


def fill(store: Store, folder: Path) -> list[int]:
    """One of everything; returns the proposals that can be approved."""
    import_folder(store, write_case(folder / "c1"))
    job = prepare(from_store(store, "c1"), catalogue())
    discover(job, journal_of(store, job), Search(), ignore_progress)
    machine = store.machines.all()[0].id
    _runs(store, store.campaigns.add(machine, "c2", {}))
    store.campaigns.add(store.machines.add("other mill", {"odd": True}), "empty", {})
    _checks(store, machine)
    store.solutions.add(store.campaigns.find("c1").id, "other", [], {"old": "form"})
    made = asyncio.run(_proposals(store))
    asyncio.run(_push(store))
    return made


def _runs(store: Store, campaign: int) -> None:
    """A ball-bar run, one of the laser, one that broke off, one that was written by something else."""
    path = {"feed_mm_min": 6000.0, "direction": -1, "points_mm": POINTS}
    start = {"setup": SETUP, "machine": MACHINE, "ctrl0_us": 5_000_000, "path": path, "rate_hz": RATE_HZ}
    samples = bar_samples()
    for label, status in (("r01", "complete"), ("r02", "aborted")):
        run = store.runs.start(campaign, label, "ballbar_helix", "identify", start)
        for number, at in enumerate(range(0, SAMPLES, 100)):
            part = samples[at : at + 100]
            store.chunks.append(run, "bar", number, len(part), BAR_CODEC, encode_bar(part), 0.0, 0.0, part[0].device_us, part[-1].device_us)
        end = {"path_start_us": 8_000_000, "path_end_us": 8_000_000 + PATH_US, "gaps": [{"first": 3, "last": 4}]}
        store.runs.finish(run, status, "", end if status == "complete" else None)
    run = store.runs.start(campaign, "r03", "laser_linear", "identify", {"setup": {"setup_id": "L", "t_set_s": 0.1}, "machine": MACHINE})
    records = [{"t_s": 1.0 * k, "position_mm": [10.0 * k, 0.0, 0.0], "note": "é"} for k in range(25)]
    store.chunks.append(run, "laser", 0, 25, JSON_CODEC, encode_json(records), 0.0, 0.0, 0, 0)
    store.runs.finish(run, "failed", "SEQ-003 beam", None)
    store.runs.finish(store.runs.start(campaign, "r04 '; DROP", "ballbar_circle", "sealed", {}), "complete", "", None)


def _checks(store: Store, machine: int) -> None:
    for k in range(CHECKS):
        at = (datetime(2026, 11, 1, 6, tzinfo=UTC) + timedelta(days=k)).isoformat()
        doc = {"machine": NAME, "schedule": "daily", "recipe": "quick-check", "slot_utc": at, "started_utc": at, "duration_s": 60.0}
        doc |= {"verdict": "pass", "values": {"body_diagonal_um": 10.0 + 0.3 * k, "helix_rms_um": None}}
        doc |= {"uncertainties": {"body_diagonal_um": 1.0, "helix_rms_um": None}, "limits": {"body_diagonal_um": 20.0, "helix_rms_um": 3.0}}
        doc |= {"campaign": "c1" if k == 0 else "", "runs": [], "text": "inside", "cause": None}
        store.verifications.add_with_messages(machine, doc, [])
        store.slots.claim(f"{NAME}/daily", at)
        store.slots.finish(f"{NAME}/daily", at, "done: pass", "as planned")


async def _proposals(store: Store) -> list[int]:
    """Proposals 1 as it was made, 2 and 3 without what spoke against it, 4 for a machine that needs two people, 5 that was altered."""
    image = encode(TableImage(0, 0, 100, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0, 0, 0), ()))
    base = Base(CompStatus(0xAB, 2, 0, (crc32(image), 0), (2, 0), 0, 0), image)
    found = from_store(store, "c1")
    records = store.runs.all("c1")
    gathered = GatheredCampaign(store.campaigns.find("c1"), records, found.runs, base, TableFormat(100, 4096))
    made = await make(store, found.site, gathered, progress=ignore_progress)
    assert made.proposed.reasons, "imported circles without temperatures speak against themselves"
    free = replace(made.proposed, reasons=(), by="somebody")
    numbers = [_stored(store, free), _stored(store, free), _stored(store, replace(free, two_people=True, by="a-approver"))]
    row = store.proposals.get(numbers[0])
    store.proposals.add(row.machine, row.solution_id, row.doc | {"by": "another"}, row.digest)
    assert load(store, numbers[0]).valid_until_s > 0
    return numbers[:2]


def _stored(store: Store, proposed: Any) -> int:
    doc = doc_of(proposed)
    return store.proposals.add(NAME, proposed.solution_id, doc, digest_of_doc(doc))


async def _push(store: Store) -> None:
    """A push that was refused before anything was written."""
    image = load(store, 2).image
    base = load(store, 2).base.image
    table = store.tables.add(store.machines.all()[0].id, 1, image, crc32(image), {"proposal": 1})
    book = await StoreBook.new(store, NAME, Hour())
    known = {
        "table": table,
        "image": image.hex(),
        "base_image": base.hex(),
        "base_crc": crc32(base),
        "base_meaning": "none",
        "meaning": "m",
    }
    known |= {"base_bank": 0, "crc": crc32(image), "approved_by": "somebody", "reasons": [], "target": 1}
    for state, doc in ((PushState.SNAPSHOT, known), (PushState.REJECTED, {"why": "TEMPERATURE: the shop is too warm"})):
        await book.append(await book.entries(), state, doc)


def _filled(folder: Path) -> list[int]:
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}", utcnow=Hour().utc) as store:
        return fill(store, folder)


@contextlib.contextmanager
def open_plant(factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """A plant over a SQLite file of its own, with a user of each role."""
    made, approvable = once_per_run(factory, "filled-plant", _filled)
    folder = shutil.copytree(made, factory.mktemp("plant"), dirs_exist_ok=True)
    url, clock = f"sqlite:///{folder / 'abbe.sqlite3'}", Hour()
    with Store.open(url, utcnow=clock.utc) as store:
        yield _plant(store, url, clock, approvable)


def _plant(store: Store, url: str, clock: Hour, approvable: list[int]) -> Plant:
    people = UserAccounts(store, clock, Passwords(memory_kib=64, passes=1))
    for role in Role:
        people.add(f"a-{role}", role, PHRASE)
    book = AuditBook(store, url)
    auth = Authenticator(store, people, book, now_s=clock.monotonic_s, rate_hz=1e9, burst=1e9)
    auth.recorded_refusals._burst = 1e9
    app = app_of(store, clock, auth)
    return Plant(store, url, clock, people, book, app, auth, approvable)


def app_of(store: Store, clock: Hour, auth: Authenticator | None) -> FastAPI:
    board = Board({"cnc": "modbus://127.0.0.1:5020"}, clock)
    schedules = (Schedule("daily", "0 6 * * *", "Europe/Berlin", "quick-check"), Schedule("hours", "", "UTC", "verification", every_h=8.0))
    view = StatusReader(Reader(store, NAME, clock), "0.1.0", board, list, "")
    sources = Sources(reader=view.reader, schedules=schedules, devices=lambda: board.devices)
    return create_app(view, version="0.1.0", auth=auth, api=sources)


@contextlib.contextmanager
def served(app: FastAPI) -> Iterator[str]:
    """A real uvicorn on the loopback, in a thread of its own; gives its address."""
    listening = bind("127.0.0.1", 0)
    server = make_server(app)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listening])), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(10)
        listening.close()
