"""A person's word is written behind the last push of a control: it does not hide how that push ended."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.drivers.tables import crc32
from abbe.service.clock import SystemClock
from abbe.service.compensation.rollback import known_images, table_after
from abbe.service.errors import TableRefused
from abbe.service.push.book import StoreBook, read_entries
from abbe.service.push.entries import JournalEntry
from abbe.service.push.states import S
from abbe.service.storage.store import Store
from abbe.service.tables.push_history import ended_as, last_kept, pushes_of
from tests.pretended_push import KEPT, TAKEN_BACK, as_if_pushed

OLD, NEW, THIRD = b"the table of May", b"the table of June", b"a third table"


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


def journal(store: Store, states: tuple[S, ...], accepted: bytes) -> list[JournalEntry]:
    """A push that ended so, and a person's word after it."""

    async def write() -> None:
        clock = SystemClock()
        await as_if_pushed(store, clock, "mill", {}, (OLD, NEW), states)
        book = await StoreBook.last(store, "mill", clock)
        assert book is not None
        await book.append(await book.entries(), S.ACCEPTED, {"accepted_bank": 0, "accepted_crc": crc32(accepted), "by": "ann"})

    asyncio.run(write())
    return read_entries(store, "mill")


@pytest.mark.parametrize("accepted", [NEW, THIRD])
def test_a_kept_push_stays_kept_after_a_word(store: Store, accepted: bytes) -> None:
    entries = journal(store, KEPT, accepted)
    assert ended_as(pushes_of(entries)[1]) is S.KEEP
    assert last_kept(entries, frozenset())[-1].push == 1
    assert table_after(entries, 1).image == NEW
    assert known_images(entries) == {OLD, NEW}


def test_a_push_that_was_taken_back_stays_so_after_a_word(store: Store) -> None:
    entries = journal(store, TAKEN_BACK, NEW)
    assert ended_as(pushes_of(entries)[1]) is S.ROLLED_BACK
    assert table_after(entries, 1).image == OLD
    assert known_images(entries) == {OLD}
    with pytest.raises(TableRefused, match="no push of this machine was kept"):
        last_kept(entries, frozenset())


def test_what_a_person_decided_is_not_made_out_of_a_word(store: Store) -> None:
    entries = journal(store, (*KEPT[:-2], S.OPERATOR), NEW)
    with pytest.raises(TableRefused, match="push 1 ended OPERATOR: the journal does not hold the table that was in force then"):
        table_after(entries, 1)
