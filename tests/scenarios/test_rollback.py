"""The table of before, by a person's order: only what the journal knows, through the same machine, and nothing else is written.

Mutations that were seen to be caught: taking any table in force for known (`test_a_hand_set_table_...`), verdicts without a look at the
journal (`test_a_table_that_nobody_knows_...`), a journal that is not checked (`test_a_changed_journal_...`).
"""

from __future__ import annotations

import asyncio
import json
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from abbe.drivers.tables import crc32, encode
from abbe.service.cli import run
from abbe.service.compensation import rollback as workflow
from abbe.service.compensation.recover import recover
from abbe.service.compensation.rollback import rollback
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import PushNotBegun, StoreError, TableMismatch, TableRefused
from abbe.service.push.journal import StoreBook, check_chain
from abbe.service.tables.nine_tables import read_base, table_image
from tests.scenarios.test_push import active, bench, last, linear_tables, push, steep

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]


async def generation(session) -> int:
    return (await session.controller.comp_status()).gen


async def test_back_byte_for_byte_and_forward_again_and_to_the_beginning(start_sims, tmp_path):
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        c = session.controller
        first = await read_base(c)
        with pytest.raises(TableRefused, match="nothing to roll back"):
            await rollback(c, store, site)
        assert (await push(c, store, site, steep(site))).kept
        kept = await read_base(c)
        found = await rollback(c, store, site)
        assert found is not None
        assert found.how == "the table that was in force before push 1"
        now = await read_base(c)
        assert now.image == first.image
        entries = store.pushes.entries("sim")
        check_chain(entries)
        of_it = {e.state: e.doc for e in entries if e.push == 2}
        assert of_it[PushState.APPROVED]["approved_by"].endswith("rollback")
        for state, key in ((PushState.PROBED, "probe"), (PushState.VERIFIED, "verify")):
            assert (
                of_it[state][key]
                == "a person ordered the rollback, nothing was measured: byte for byte the table that was in force before push 1"
            )
        assert PushState.STAGED in of_it  # read back, twice, like any other
        with pytest.raises(TableRefused, match="was itself a rollback"):
            await rollback(c, store, site)
        assert await rollback(c, store, site, 1) is not None
        assert (await read_base(c)).image == kept.image
        before = await generation(session)
        assert await rollback(c, store, site, 1) is None
        assert await generation(session) == before
        assert await rollback(c, store, site, 0) is not None
        assert (await read_base(c)).image == first.image
        with pytest.raises(TableRefused, match="no push 99"):
            await rollback(c, store, site, 99)
        assert (await session.controller.comp_status()).lease_owner == 0


async def test_an_open_interlock_leaves_the_table_in_force(start_sims, tmp_path):
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        await push(session.controller, store, site, steep(site))
        before, gen = await active(session), await generation(session)
        sims.ask("estop", on=True)
        with pytest.raises(PushNotBegun, match="the old table is in force"):
            await rollback(session.controller, store, site)
        assert (await active(session), await generation(session), last(store)) == (before, gen, PushState.ABORTED)


async def by_hand(session, image: bytes) -> None:
    """Somebody else's table comes into force."""
    c = session.controller
    await c.lease(7, 60_000)
    other = 1 - (await c.comp_status()).active_bank
    await c.write_bank(other, image)
    await c.seal(other, 7)
    await c.activate(other, expect_crc=crc32(image), expect_gen=await generation(session), owner=7)
    await c.release(7)


async def test_a_hand_set_table_is_not_overwritten(start_sims, tmp_path):
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        await push(session.controller, store, site, steep(site))
        await by_hand(session, encode(table_image(linear_tables(site, np.full((3, 3), 2e-6)), 100, 7)))
        gen, entries = await generation(session), len(store.pushes.entries("sim"))
        for to in (None, 0, 1):
            with pytest.raises(TableMismatch, match="a table that this database did not push"):
                await rollback(session.controller, store, site, to)
        assert (await generation(session), len(store.pushes.entries("sim"))) == (gen, entries)


async def test_a_table_that_nobody_knows_is_refused_by_the_questions_too(start_sims, tmp_path, monkeypatch):
    """Wherever the image comes from: what the journal does not hold as a base or as kept is not written."""
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        await push(session.controller, store, site, steep(site))
        gen = await generation(session)
        image = encode(table_image(linear_tables(site, np.full((3, 3), 2e-6)), 100, 7))
        monkeypatch.setattr(workflow, "table_before_last_kept", lambda *_: workflow.KnownTable(image, "m", "a table from elsewhere"))
        with pytest.raises(TableRefused, match="UNKNOWN"):
            await rollback(session.controller, store, site)
        assert (await generation(session), last(store)) == (gen, PushState.REJECTED)


def test_an_open_push_is_finished_first_and_that_is_all(start_sims, tmp_path, monkeypatch, capsys):
    sims = start_sims("--speed", "5")
    honest = StoreBook.append

    async def dies(self, journal, wanted, doc):
        if journal and journal[-1].state is PushState.PROBED and journal[-1].push == 2:
            raise StoreError("the disk is full")
        return await honest(self, journal, wanted, doc)

    async def kept_and_open() -> tuple[int, int]:
        async with bench(sims, tmp_path) as (site, store, session):
            await push(session.controller, store, site, steep(site))
            kept = await active(session)
            with pytest.raises(StoreError):
                await push(session.controller, store, site, linear_tables(site, np.full((3, 3), 2e-6)))
            assert await active(session) != kept
            return kept

    async def now() -> tuple[tuple[int, int], list[tuple[int, PushState]]]:
        async with bench(sims, tmp_path) as (_, store, session):
            return await active(session), [(e.push, e.state) for e in store.pushes.entries("sim")]

    with monkeypatch.context() as patch:
        patch.setattr(StoreBook, "append", dies)
        kept = asyncio.run(kept_and_open())
    assert run(["comp", "rollback", "-m", str(sims.machine_file), "--yes"]) == 0
    assert "push 2 was unfinished and is ended now" in capsys.readouterr().out
    table, entries = asyncio.run(now())
    assert (table, entries[-1]) == (kept, (2, PushState.ROLLED_BACK))
    assert run(["comp", "rollback", "-m", str(sims.machine_file), "--yes", "--json"]) == 0  # ordered once more: further back
    told = json.loads(capsys.readouterr().out)
    assert told["push"] == 3
    assert "in force again (push 3" in told["text"]
    assert asyncio.run(now())[0][1] != kept[1]


async def test_a_rollback_cut_short_leaves_the_table_that_was_verified(start_sims, tmp_path, monkeypatch):
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        await push(session.controller, store, site, steep(site))
        before, honest = await active(session), StoreBook.append

        async def dies(self, journal, wanted, doc):
            if journal and journal[-1].state is PushState.PROBED:
                raise StoreError("the disk is full")
            return await honest(self, journal, wanted, doc)

        with monkeypatch.context() as patch:
            patch.setattr(StoreBook, "append", dies)
            with pytest.raises(StoreError):
                await rollback(session.controller, store, site)
        assert "made active again" in await recover(session.controller, store, site)
        assert (await active(session))[1] == before[1]
        assert await rollback(session.controller, store, site) is not None  # push 1 is still the last kept one


async def test_a_changed_journal_is_no_source_of_tables(start_sims, tmp_path):
    sims = start_sims("--speed", "5")
    async with bench(sims, tmp_path) as (site, store, session):
        await push(session.controller, store, site, steep(site))
        gen = await generation(session)
        with closing(sqlite3.connect(tmp_path / "abbe.sqlite3")) as raw:
            doc = json.loads(raw.execute("SELECT doc FROM push_entries WHERE seq = 0").fetchone()[0])
            raw.execute("UPDATE push_entries SET doc = ? WHERE seq = 0", (json.dumps(doc | {"base_image": doc["image"]}),))
            raw.commit()
        with pytest.raises(StoreError, match="was changed after it was written"):
            await rollback(session.controller, store, site)
        assert await generation(session) == gen
