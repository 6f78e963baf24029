"""The real store behind ledger and shelf."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import StoreError
from abbe.service.scheduler.retrying_store import PAUSES_S, StoreLedger, StoreShelf
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from tests.service.core.fakes import FakeClock, Result, utc

SLOT = utc(2026, 6, 1, 4)
OCCASION = verify.Occasion("mill-7", Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "verify"), SLOT)
TOPICS = ("abbe/mill-7/verification", "abbe/mill-7/alarm")


class NoWait(FakeClock):
    def __init__(self) -> None:
        super().__init__(SLOT)
        self.pauses: list[float] = []

    async def sleep(self, s: float) -> None:
        self.pauses.append(s)


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    with Store.open(url) as opened:
        yield opened


def shelf_of(store: Store, posted: list[int]) -> StoreShelf:
    return StoreShelf(store, NoWait(), ("mill-7", store.machines.add("mill-7", {})), TOPICS, lambda: posted.append(1))


async def test_slots_survive_the_process(url: str) -> None:
    with Store.open(url) as store:
        ledger = StoreLedger(store, NoWait(), "mill-7")
        assert await ledger.last_claimed("weekly") is None
        assert await ledger.claim("weekly", SLOT)
        await ledger.finish("weekly", SLOT, "missed: 3 days late")
    with Store.open(url) as store:
        ledger = StoreLedger(store, NoWait(), "mill-7")
        assert not await ledger.claim("weekly", SLOT)
        assert await ledger.last_claimed("weekly") == SLOT
        assert await StoreLedger(store, NoWait(), "mill-8").claim("weekly", SLOT)


async def test_a_time_rule_is_known_across_services_until_it_changes(url: str) -> None:
    then, later = SLOT, utc(2026, 6, 3, 4)
    with Store.open(url) as store:
        ledger = StoreLedger(store, NoWait(), "mill-7")
        assert await ledger.in_force_since({"weekly": "a", "daily": "b"}, then) == {"weekly": then, "daily": then}
        assert await StoreLedger(store, NoWait(), "mill-8").in_force_since({"weekly": "a"}, later) == {"weekly": later}
    with Store.open(url) as store:
        ledger = StoreLedger(store, NoWait(), "mill-7")
        assert await ledger.in_force_since({"weekly": "a", "daily": "c"}, later) == {"weekly": then, "daily": later}
        assert await ledger.in_force_since({"daily": "c"}, then) == {"daily": later}
        assert await ledger.in_force_since({"weekly": "a"}, later) == {"weekly": later}, "it was away meanwhile"
        assert (store.slots.counts("mill-7"), store.slots.not_run("mill-7")) == ({}, []), "no slot of the timetable"


async def test_two_processes_race_for_slots(store: Store, url: str) -> None:
    slots = [utc(2026, 6, 1 + day, hour) for day in range(5) for hour in range(20)]
    won: list[list[bool]] = [[], []]
    with Store.open(url) as other:
        threads = [
            threading.Thread(target=lambda s=s, w=w: w.extend(s.slots.claim("m/weekly", slot) for slot in slots))
            for s, w in zip((store, other), won, strict=True)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert all(a != b for a, b in zip(*won, strict=True))


async def test_a_verification_and_its_message(store: Store) -> None:
    posted: list[int] = []
    number = await shelf_of(store, posted).keep(verify.check_doc(OCCASION, Result()))
    (kept,) = store.verifications.of_machine("mill-7")
    assert (kept.id, kept.verdict, kept.campaign_id) == (number, "pass", None)
    (row,) = store.outbox.pending()
    assert row.topic == TOPICS[0]
    assert json.loads(row.payload) == {"verification": number, **kept.doc}
    assert posted == [1]
    assert store.outbox.count() == 1
    assert store.verifications.of_machine("mill-8") == []


async def test_a_verification_belongs_to_its_campaign(store: Store) -> None:
    machine = store.machines.add("mill-7", {"geometry": 1})
    campaign = store.campaigns.add(machine, "check-1", {})
    await shelf_of(store, []).keep(verify.check_doc(OCCASION, Result()))
    (kept,) = store.verifications.of_machine("mill-7")
    assert (kept.campaign_id, kept.machine_id) == (campaign, machine)


async def test_a_failed_check_brings_an_alarm(store: Store) -> None:
    doc = verify.failed_doc(OCCASION, LinkDown("tcp://127.0.0.1:5021", "connect", "refused", "switch it on"), SLOT, 0.4)
    await shelf_of(store, []).keep(doc)
    result, alarm = store.outbox.pending()
    assert json.loads(result.payload)["verdict"] == "cannot tell"
    assert alarm.topic == TOPICS[1]
    assert json.loads(alarm.payload)["code"] == "DRV-002"
    assert json.loads(alarm.payload)["machine"] == "mill-7"


async def test_result_and_message_together_or_not_at_all(store: Store) -> None:
    doc = verify.check_doc(OCCASION, Result())
    with pytest.raises(ValueError, match="JSON compliant"):
        store.verifications.add_with_messages(store.machines.add("mill-7", {}), doc, [("t", doc), ("t", {"x": float("nan")})])
    assert store.verifications.of_machine("mill-7") == []
    assert store.outbox.pending() == []


async def test_a_store_that_fails_for_a_while(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    real, failures = store.verifications.add_with_messages, [StoreError("database is locked")] * 3

    def flaky(*args: object) -> int:
        if failures:
            raise failures.pop()
        return real(*args)  # type: ignore[arg-type]

    shelf = shelf_of(store, [])
    monkeypatch.setattr(store.verifications, "add_with_messages", flaky)
    assert await shelf.keep(verify.check_doc(OCCASION, Result())) == 1


async def test_a_store_that_stays_broken_is_an_error(tmp_path: Path) -> None:
    clock = NoWait()
    store = Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}")
    with sqlite3.connect(tmp_path / "abbe.sqlite3") as raw:
        raw.execute("DROP TABLE slots")
    with pytest.raises(StoreError):
        await StoreLedger(store, clock, "m").claim("weekly", SLOT)
    assert clock.pauses == list(PAUSES_S)
    store.close()
