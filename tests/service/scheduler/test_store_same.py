"""SQLite and PostgreSQL give the same answers to everything that the store is asked: each of its methods, refusals included."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from abbe.service.domain.measured import ChunkRecord, ImportedRun, Owner
from abbe.service.domain.people import TokenRecord
from abbe.service.domain.push_entry import PushEntry, PushState
from abbe.service.domain.results import NewVersion, ProposalApproval, ProposalRejection
from abbe.service.domain.service_records import AlarmFacts, AlarmKind, AuditEvent, SlotRecord
from abbe.service.errors import AbbeError
from abbe.service.storage.database import Repository
from abbe.service.storage.repositories.pages import LISTINGS
from abbe.service.storage.store import Store

START = datetime(2026, 11, 21, 3, 34, 5, 123456, tzinfo=UTC)
FACTS = AlarmFacts(text="ü'\"\n\\ 工", rms_um=1e-7, verification=2**53 + 1)
DOC: dict[str, Any] = {"µm": 0.1, "list": [None, 1e-7, -0.0], "text": "ü'\"\n\\ 工", "large": 2**53 + 1}
BYTES = bytes(range(256))
SLOTS = [f"2026-11-{day}T05:00:00Z" for day in (20, 21, 22, 23, 24)]


class Asked:
    """Asks a store, and writes down what it answered in words that do not depend on the process."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.answers: list[tuple[str, Any]] = []

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._store, name)
        return AskedPart(self, found, f"{name}.") if isinstance(found, Repository) else self.noting(found, name)

    def noting(self, method: Callable[..., Any], name: str) -> Callable[..., Any]:
        def ask(*args: Any, **named: Any) -> Any:
            try:
                answer = method(*args, **named)
            except AbbeError as refused:
                self.answers.append((name, f"refused: {in_our_words(refused)}"))
                return None
            self.answers.append((name, plain(answer)))
            return answer

        return ask


class AskedPart:
    """The same of one repository."""

    def __init__(self, asked: Asked, repository: Repository, prefix: str) -> None:
        self._asked, self._repository, self._prefix = asked, repository, prefix

    def __getattr__(self, method: str) -> Callable[..., Any]:
        return self._asked.noting(getattr(self._repository, method), self._prefix + method)


def in_our_words(refused: AbbeError) -> str:
    """Without the database's address, and without what a database adds in its own words."""
    return re.sub(r"(?s)database DATABASE .*", "by the database", re.sub(r"(sqlite|postgresql)\S*://\S+", "DATABASE", str(refused)))


def plain(value: Any) -> Any:
    if isinstance(value, Owner):
        return "owner"
    if isinstance(value, SlotRecord):
        value = replace(value, id=0)  # a server leaves out a number where a slot was claimed already
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def measured(ask: Any) -> None:
    """Machines, campaigns, runs and chunks, checkpoints."""
    for name in ("mill-7", "MILL-7", "bohrwerk ü", "Anlage_7", "mill-7"):
        ask.machines.add(name, DOC)
    ask.machines.get(1), ask.machines.get(9), ask.machines.all()
    ask.campaigns.add(1, "june", DOC), ask.campaigns.add(2, "May", DOC)
    ask.campaigns.find("june"), ask.campaigns.find(2), ask.campaigns.find("July"), ask.campaigns.all(), ask.campaigns.matching("j*")
    ask.runs.start(1, "r1", "helix", "fit", DOC)
    ask.chunks.append(1, "bar", 0, 32, "raw", BYTES, 0.1, 0.2, 2**40, 2**40 + 9)
    more = ChunkRecord(1, "bar", 1, 3, "raw", 2**32 - 1, BYTES, -1e-7, 1e300, -(2**40), 2**62)
    for given in ([more, replace(more, channel="Laser")], [more], [replace(more, n=4)], [replace(more, run_id=77)], []):
        ask.chunks.ingest(given)
    (
        ask.chunks.crcs(1),
        ask.chunks.channels(1),
        ask.chunks.sizes(1, "bar"),
        ask.chunks.between(1, "bar", 1, 5),
        ask.chunks.of_run(1),
        ask.chunks.of_run(1, "laser"),
    )
    ask.runs.finish(1, "complete", "", DOC), ask.runs.finish(1, "failed", "again", None), ask.runs.finish(1, "ended", "", None)
    ask.chunks.append(1, "bar", 2, 1, "raw", b"", 0.0, 0.0, 0, 0)
    ask.runs.start(1, "R1", "line", "verify", DOC), ask.runs.finish(2, "stopped", "by hand ü", None)
    ask.runs.import_campaign(("mill-7", DOC), ("old", DOC), [ImportedRun("r1", "helix", "fit", DOC, 3, "raw", BYTES)])
    (
        ask.runs.all(),
        ask.runs.all("june"),
        ask.runs.all(77),
        ask.runs.find("R1"),
        ask.runs.find(1),
        ask.runs.find("r1"),
        ask.runs.find("none"),
        ask.runs.numbered(1),
        ask.runs.numbered(77),
    )
    ask.runs.latest(2), ask.runs.latest(9, campaign="june", test="helix", status="complete")
    (
        ask.checkpoints.add(1, "begun", DOC),
        ask.checkpoints.add(1, "ended", DOC),
        ask.checkpoints.of_campaign(1),
        ask.checkpoints.of_campaign(77),
    )


def found(ask: Any) -> None:
    """Solutions, tables, pushes, discoveries, models, proposals and what was decided on them."""
    ask.solutions.add(1, "joint", [1, 2], DOC), ask.solutions.get(1), ask.solutions.get(77)
    ask.solutions.all(), ask.solutions.all(2), ask.solutions.latest("joint", 1), ask.solutions.latest("Joint", 1)
    (
        ask.tables.add(1, 1, BYTES, 2**32 - 1, DOC),
        ask.tables.add(1, None, b"", 0, DOC),
        ask.tables.get(1),
        ask.tables.get(77),
        ask.tables.all(),
        ask.tables.all(2),
        ask.tables.add_missing(1, {5: BYTES, 0: b"known already"}),
        ask.tables.all(1),
    )
    entry = PushEntry(machine="mill-7", push=1, seq=0, state=PushState.SNAPSHOT, doc=DOC, utc="then", prev="", digest="1" * 64)
    ask.pushes.append(entry), ask.pushes.append(entry), ask.pushes.append(replace(entry, seq=1, prev="1" * 64, digest="2" * 64))
    ask.pushes.entries("mill-7"), ask.pushes.entries("MILL-7"), ask.pushes.last("mill-7"), ask.pushes.last("none")
    whose = {"machine": "mill-8", "control": "modbus+tcp://a:502", "base_crc": 1, "crc": 2**32 - 1, "image": "00"}
    ask.pushes.append(replace(entry, machine="mill-1", doc=whose)), ask.pushes.marks(), ask.pushes.entries_of("mill-1")
    ask.pushes.chain("mill-8"), ask.pushes.chain("new", "modbus+tcp://a:502"), ask.pushes.chain("mill-1", "modbus+tcp://b:502")
    ask.discoveries.add(1, "ab" * 32, DOC), ask.discoveries.add_step(1, 0, "BEGUN", DOC)
    ask.discoveries.add_step(1, 1, "NAMED", DOC, NewVersion("mill-7", None, DOC))
    (
        ask.models.add(NewVersion("mill-7", 1, DOC), 1),
        ask.models.all(),
        ask.models.all("MILL-7"),
        ask.discoveries.all(),
        ask.discoveries.all(2),
        ask.discoveries.get(1),
    )
    ask.discoveries.get(77), ask.discoveries.steps(1)
    (
        ask.proposals.add("mill-7", 1, DOC, "d" * 64),
        ask.proposals.get(1),
        ask.proposals.get(77),
        ask.proposals.all(),
        ask.proposals.all("MILL-7"),
    )
    (
        ask.proposals.approve(ProposalApproval(proposal_id=1, name="Anna ü", login="anna", digest="d" * 64, expiry="2099-01-01T00:00:00Z")),
        ask.proposals.approvals(1),
        ask.proposals.approvals(77),
    )
    (
        ask.proposals.reject(ProposalRejection(proposal_id=1, name="Bert", login="bert", reason="too large")),
        ask.proposals.rejections(1),
        ask.proposals.rejections(77),
    )
    for digest in ("7" * 64, "7" * 64, "8" * 64):
        ask.replies.claim("anna", "order", digest)
    ask.replies.keep("anna", "order", 202, "ü"), ask.replies.claim("anna", "order", "7" * 64), ask.replies.claim("Anna", "order", "7" * 64)
    ask.replies.drop("Anna", "order"), ask.replies.claim("Anna", "order", "9" * 64)


def watched(ask: Any) -> None:
    """Slots, checks, alarms, stations and messages."""
    for slot, state in zip(SLOTS, ("done", "missed: computer was off", "skipped", "interrupted", "done"), strict=True):
        ask.slots.claim("mill-7/weekly", slot), ask.slots.claim("mill-7/weekly", slot), ask.slots.begin("mill-7/weekly", slot)
        ask.slots.finish("mill-7/weekly", slot, state, "because ü")
    for schedule in ("MILL-7/weekly", "mill_7/weekly", "Anlage_7/x", "AnlageX7/x"):
        ask.slots.claim(schedule, SLOTS[0]), ask.slots.finish(schedule, SLOTS[0], "missed")
    ask.slots.claim("mill-7/daily", START), ask.slots.release("mill-7/daily", START), ask.slots.claim("mill-7/daily", START)
    (
        ask.slots.adopt("mill-7/daily"),
        ask.slots.latest("mill-7/weekly"),
        ask.slots.latest("mill-7/weekly", 2),
        ask.slots.last_due("mill-7/weekly"),
    )
    ask.slots.last_due("none")
    for name in ("mill-7", "MILL-7", "Anlage_7"):
        ask.slots.not_run(name), ask.slots.not_run(name, 1), ask.slots.counts(name)
    (
        ask.verifications.add(1, 1, "pass", DOC),
        ask.verifications.add(2, None, "cannot tell", DOC),
        ask.verifications.latest(),
        ask.verifications.latest(1, 1),
    )
    for campaign in ("june", "none"):
        ask.verifications.add_with_messages(4, {"campaign": campaign, "verdict": "fail", **DOC}, [("a/alarm", DOC)])
    (
        ask.verifications.of_machine("mill-7"),
        ask.verifications.of_machine("MILL-7", 1),
        ask.verifications.counts("mill-7"),
        ask.verifications.counts("none"),
    )
    for seq in (0, 0, 1):
        ask.alarms.append("mill-7", None if seq == 0 else 1, seq, AlarmKind.RAISED, FACTS, [("a/alarm", {"code": "ALM-001"})])
    ask.alarms.entries("mill-7"), ask.alarms.entries("MILL-7")
    for name in ("mill-7", "MILL-7", "mill-7"):
        ask.heartbeats.put(name, DOC | {"name": name})
    ask.heartbeats.all(), ask.heartbeats.of_machine(name), ask.machines.names()
    ask.outbox.add_document("a/state", DOC), ask.outbox.add("a/alarm", b"\x00\xff"), ask.outbox.add("a/state", "ü"), ask.outbox.count()
    ask.outbox.done(1), ask.outbox.done(2), ask.outbox.done(77), ask.outbox.prune(1), ask.outbox.pending(2)
    ask.outbox.shed(("a/alarm",), 2, 1, lambda count, first, last: ("a/alarm", f"{count} {first} {last}".encode())), ask.outbox.pending()


def allowed(ask: Any) -> None:
    """People, sessions, tokens and the audit."""
    for name, role in (("anna", "admin"), ("anna", "viewer"), ("Anna", "operator")):
        ask.people.add(name, role, "$argon2id$x")
    ask.people.all(), ask.people.find("anna"), ask.people.find("ANNA"), ask.people.active_admins()
    (
        ask.people.add_session(1, "5" * 64),
        ask.people.add_session(1, "6" * 64, instead_of="5" * 64),
        ask.people.touch_session(2),
        ask.people.session("5" * 64),
        ask.people.session("6" * 64),
    )
    ask.people.session("none"), ask.people.end_session("6" * 64), ask.people.session("6" * 64), ask.people.add_session(1, "7" * 64)
    token = TokenRecord(user_id=1, name="scada", prefix="abbe_1", digest="6" * 64, scopes=["read"], expires_utc="2099-01-01T00:00:00Z")
    (
        ask.people.add_token(token),
        ask.people.add_token(token),
        ask.people.token("abbe_1"),
        ask.people.token("ABBE_1"),
        ask.people.revoke_token(1),
        ask.people.revoke_token(1),
        ask.people.tokens(),
    )
    ask.people.count_pin(2), ask.people.count_pin(2)
    ask.people.change(1, role="viewer", disabled_utc="then"), ask.people.session("7" * 64), ask.people.active_admins(), ask.people.all()
    said = AuditEvent(who="anna", action="table.push", target="mill-7", outcome="done", doc=DOC)
    record = replace(said, id=1, utc="then", digest="1" * 64, key="k" * 16, mac="m" * 64)
    ask.check_writable(), ask.audit.append(lambda _last, _utc: record)
    ask.audit.append(lambda last, utc: replace(record, id=2, utc=utc, prev="" if last is None else last.digest, digest="2" * 64))
    ask.audit.events(), ask.audit.events(1)


def paged(ask: Any) -> None:
    """Every list, whole, in pages and filtered."""
    for kind in LISTINGS:
        ask.pages.page(kind, {}, None, 100), ask.pages.page(kind, {}, 2, 1), ask.pages.row(kind, 1), ask.pages.row(kind, 77)
        ask.pages.page(kind, {"machine": "mill-7", "name": "MILL-7", "status": "complete", "verdict": "fail"}, None, 100)


def refused(ask: Any) -> None:
    """What the database itself refuses; at the end, because a server then leaves out a number."""
    ask.runs.start(1, "r3", "helix", "fit", DOC)
    for name, campaign in (("june", 1), ("of nobody", 77)):
        ask.campaigns.add(campaign, name, DOC)
    ask.runs.start(1, "r1", "helix", "fit", DOC), ask.runs.start(77, "r1", "helix", "fit", DOC)
    (open_run,) = {one.id for one in ask.runs.latest(99) if one.status in {"running", "incomplete"}}
    for _ in range(2):
        ask.chunks.append(open_run, "bar", 0, 1, "raw", b"", 0.0, 0.0, 0, 0)
    (
        ask.runs.import_campaign(("mill-7", DOC), ("old", DOC), []),
        ask.solutions.add(77, "joint", [], DOC),
        ask.tables.add(77, None, b"", 0, DOC),
    )
    ask.discoveries.add_step(1, 0, "BEGUN", DOC), ask.models.add(NewVersion("mill-7", None, DOC))
    (
        ask.alarms.append("mill-7", 1, 1, AlarmKind.CONTINUED, FACTS),
        ask.verifications.add(77, None, "pass", DOC),
        ask.checkpoints.add(77, "begun", DOC),
    )
    (
        ask.proposals.approve(ProposalApproval(proposal_id=77, name="Anna", login="anna", digest="d" * 64, expiry="then")),
        ask.discoveries.add(77, "ab" * 32, DOC),
    )


def answers(url: str) -> list[tuple[str, Any]]:
    """Everything that a store of this address answers, each second one later."""
    ticks = iter(range(10**6))
    with Store.open(url, utcnow=lambda: START + timedelta(seconds=next(ticks))) as store:
        assert len(store.database_id()) == 32
        ask = Asked(store)
        for part in (measured, found, watched, allowed, paged, refused):
            part(ask)
        return ask.answers


def every_method(url: str) -> set[str]:
    """Whatever a store can be asked, repository by repository."""
    with Store.open(url) as store:
        parts = {name: part for name, part in vars(store).items() if isinstance(part, Repository)}
    return {f"{name}.{method}" for name, part in parts.items() for method in vars(type(part)) if not method.startswith("_")}


def test_both_databases_give_the_same_answers(postgres: Callable[[], str], tmp_path: Path) -> None:
    lite, server = answers(f"sqlite:///{tmp_path / 'abbe.sqlite3'}"), answers(postgres())
    assert [method for method, _ in lite] == [method for method, _ in server]
    different = [(one, other) for one, other in zip(lite, server, strict=True) if one != other]
    assert different == []


def test_sqlite_answers_what_is_right_and_every_method_is_asked(tmp_path: Path) -> None:
    """Equal wrong answers would be equal too: a few that are known, and nothing left out."""
    given = answers(f"sqlite:///{tmp_path / 'abbe.sqlite3'}")
    # Numbers after a refused insert are a database's own: they are asked where the screens are tested.
    assert every_method("sqlite://") - {"slots.newest"} | {"check_writable"} == {method for method, _ in given}
    told = {method: [answer for name, answer in given if name == method] for method, _ in given}
    assert [len(one) for one in told["slots.not_run"]] == [3, 1, 1, 1, 1, 1]
    assert told["slots.counts"][1:] == [{"missed": 1}, {"missed": 1}]
    assert told["verifications.counts"] == [{"pass": 1, "fail": 1}, {}]
    assert [len(one) for one in told["alarms.entries"]] == [3, 0]
    assert told["people.active_admins"] == [1, 0]
    assert sum(str(answer).startswith("refused: ") for _, answer in given) >= 20
