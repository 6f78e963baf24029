"""A person's word is written behind the last push of a control: it does not hide how that push ended."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.drivers.tables import crc32
from abbe.service.clock import SystemClock
from abbe.service.compensation.rollback import known_images, table_after
from abbe.service.domain.push_entry import S
from abbe.service.errors import TableRefused
from abbe.service.push.journal import StoreBook
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView, ended_as
from tests.pretended_push import KEPT, TAKEN_BACK, as_if_pushed

OLD, NEW, THIRD = b"the table of May", b"the table of June", b"a third table"


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


def journal(store: Store, states: tuple[S, ...], accepted: bytes) -> JournalView:
    """A push that ended so, and a person's word after it."""

    async def write() -> None:
        clock = SystemClock()
        await as_if_pushed(store, clock, "mill", {}, (OLD, NEW), states)
        book = await StoreBook.last(store, "mill", clock)
        assert book is not None
        await book.append(await book.entries(), S.ACCEPTED, {"accepted_bank": 0, "accepted_crc": crc32(accepted), "by": "ann"})

    asyncio.run(write())
    return JournalView.read(store, "mill")


@pytest.mark.parametrize("accepted", [NEW, THIRD])
def test_a_kept_push_stays_kept_after_a_word(store: Store, accepted: bytes) -> None:
    found = journal(store, KEPT, accepted)
    assert ended_as(found.pushes[1]) is S.KEEP
    assert found.last_kept()[-1].push == 1
    assert table_after(found, 1).image == NEW
    assert known_images(found) == {OLD, NEW}


def test_a_push_that_was_taken_back_stays_so_after_a_word(store: Store) -> None:
    found = journal(store, TAKEN_BACK, NEW)
    assert ended_as(found.pushes[1]) is S.ROLLED_BACK
    assert table_after(found, 1).image == OLD
    assert known_images(found) == {OLD}
    with pytest.raises(TableRefused, match="no push of this machine was kept"):
        found.last_kept()


def test_what_a_person_decided_is_not_made_out_of_a_word(store: Store) -> None:
    found = journal(store, (*KEPT[:-2], S.OPERATOR), NEW)
    with pytest.raises(TableRefused, match="push 1 ended OPERATOR: the journal does not hold the table that was in force then"):
        table_after(found, 1)
