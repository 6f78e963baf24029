"""Which table may be in force when something is about to move: only one that a push kept, a person vouched for, or no push ever brought."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from abbe.models.compensation.tables import NineTables
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.compensation.recover import accept, recover
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.push.operations import VerificationResult
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.faults.sequencer_world import Bench, bench
from tests.push.test_bad_tables_on_the_wire import kept, never, tables

OTHER = 0x00990001


async def no() -> VerificationResult:
    return VerificationResult(False, "the other way")


@dataclass
class Shop:
    """A control, its journal, and what people and programs do there."""

    b: Bench
    store: Store

    async def push(self, wanted: NineTables, questions: Questions) -> PushResult:
        base = await read_base(self.b.session.controller)
        return await Pushing(self.b.session.controller, self.store, self.b.site).bring(WantedTable(wanted, base, 100, None, {}), questions)

    async def somebody_activates_the_other_bank(self) -> None:
        control = self.b.session.controller
        await control.lease(OTHER, 60_000)
        now = await control.comp_status()
        other = 1 - now.active_bank
        await control.activate(other, expect_crc=now.bank_crc[other], expect_gen=now.gen, owner=OTHER)
        await control.release(OTHER)

    async def recover(self) -> str | None:
        return await recover(self.b.session.controller, self.store, self.b.site)


@pytest.fixture
async def shop(tmp_path: Path) -> AsyncIterator[Shop]:
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield Shop(b, store)


def questions(probe: Callable[[], object] = kept, verify: Callable[[], object] = kept, reasons: tuple[str, ...] = ()) -> Questions:
    return Questions(lambda: list(reasons), "a test", probe, verify)  # type: ignore[arg-type]


@pytest.mark.parametrize("answers", [questions(probe=no), questions(verify=no)], ids=["by the probe", "by the verification"])
async def test_a_refuted_table_is_refused_when_somebody_makes_it_the_active_one(shop: Shop, answers: Questions) -> None:
    assert not (await shop.push(tables(), answers)).kept
    assert await shop.recover() is None, "the old one is in force"
    await shop.somebody_activates_the_other_bank()
    for _ in range(2):
        with pytest.raises(TableMismatch):
            await shop.recover()


async def test_a_push_that_was_rejected_on_top_of_a_refuted_table_does_not_make_it_good(shop: Shop) -> None:
    await shop.push(tables(), questions(verify=no))
    await shop.somebody_activates_the_other_bank()
    with pytest.raises(TableRefused, match="VALUE"):
        await shop.push(tables(), questions(never, never, ("VALUE: too large",)))
    with pytest.raises(TableMismatch):
        await shop.recover()


async def test_a_kept_table_stays_good_also_after_another_was_refuted(shop: Shop) -> None:
    first = await shop.push(tables(), questions())
    assert first.kept
    assert await shop.recover() is None
    assert not (await shop.push(tables(), questions(verify=no))).kept
    now = await shop.b.session.controller.comp_status()
    assert now.bank_crc[now.active_bank] == first.crc
    assert await shop.recover() is None


async def test_a_refuted_table_that_a_person_vouches_for_is_good_from_then_on(shop: Shop) -> None:
    await shop.push(tables(), questions(verify=no))
    await shop.somebody_activates_the_other_bank()
    await accept(shop.b.session.controller, shop.store, shop.b.site)
    assert await shop.recover() is None
