"""The outbox stays bounded: delivered messages are forgotten, alarms are dropped when too many wait, results never."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from abbe.service.mqtt.broker import Topics
from abbe.service.mqtt.publisher import DROPPED, StoreOutbox
from abbe.service.storage.store import Store
from tests.service.core.fakes import FakeClock, utc

TOPICS = Topics("abbe", "mill-7")


@pytest.fixture(params=["sqlite", "postgresql"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    make: Callable[[], str] = (
        (lambda: f"sqlite:///{tmp_path / 'abbe.sqlite3'}") if request.param == "sqlite" else request.getfixturevalue("postgres")
    )
    with Store.open(make()) as opened:
        yield opened


def outbox_of(store: Store, kept: int = 3, most: int = 10, down_to: int = 8) -> StoreOutbox:
    return StoreOutbox(store.outbox, TOPICS, FakeClock(utc(2026, 6, 1, 4)), kept, most, down_to)


def put(store: Store, topic: str, count: int) -> list[int]:
    return [store.outbox.add(topic, json.dumps({"schema": 1, "n": n})) for n in range(count)]


async def test_delivered_messages_are_forgotten_but_for_the_newest(store: Store) -> None:
    outbox = outbox_of(store)
    ids = put(store, TOPICS.verification, 12)
    for one in ids[:10]:
        await outbox.done(one)
    assert await outbox.tidy() == 0
    assert [row.id for row in await outbox.pending()] == ids[10:]
    assert store.outbox.prune(3) == 0, "already done"
    assert rows(store) == ids[7:]


async def test_a_number_is_never_used_again(store: Store) -> None:
    """SQLite gives a new row the largest number plus one: the newest row must stay, or a receiver would drop news as seen."""
    outbox = outbox_of(store, kept=0)
    ids = put(store, TOPICS.alarm, 5)
    for one in ids:
        await outbox.done(one)
    await outbox.tidy()
    assert rows(store) == ids[-1:]
    assert put(store, TOPICS.alarm, 1)[0] > ids[-1]


async def test_thousands_of_old_ones_go_in_several_transactions(store: Store) -> None:
    outbox = outbox_of(store)
    many = put(store, TOPICS.alarm, 25)
    for one in many:
        store.outbox.done(one)
    assert [store.outbox.prune(3, 10) for _ in range(4)] == [10, 10, 2, 0]
    await outbox.tidy()
    assert rows(store) == many[-3:]


async def test_too_many_alarms_drop_the_oldest_and_say_so_and_results_stay(store: Store) -> None:
    outbox = outbox_of(store)
    first = put(store, TOPICS.alarm, 9)
    results = put(store, TOPICS.verification, 40)
    others = put(store, "abbe/lathe-2/alarm", 15)
    assert await outbox.tidy() == 0, "nine are not too many"
    second = put(store, TOPICS.alarm, 3)
    assert await outbox.tidy() == 4
    left = await outbox.pending()
    assert [row.id for row in left[:-1]] == sorted([*first[4:], *results, *others, *second])
    told = json.loads(left[-1].payload)
    assert left[-1].topic == TOPICS.alarm
    assert (told["code"], told["dropped"], told["machine"], told["schema"]) == (DROPPED, 4, "mill-7", 1)
    assert "4 alarms from 20" in told["what"]
    assert await outbox.tidy() == 0, "nine again"


def rows(store: Store) -> list[int]:
    """Numbers of everything in the table."""
    with store.engine.connect() as connection:
        return [int(row[0]) for row in connection.exec_driver_sql("SELECT id FROM outbox ORDER BY id")]
