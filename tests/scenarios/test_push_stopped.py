"""A push that is stopped, by a person or by a full disk: what is in force is said, and nothing unverified stays."""

import asyncio

import pytest

from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.compensation.recover import recover
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import StoreError
from abbe.service.push.journal import StoreBook
from abbe.service.push.operations import VerificationResult
from abbe.service.tables.nine_tables import read_base
from tests.scenarios.test_push import active, bench, last, push, steep

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(180)]


async def test_a_disk_that_is_full_for_a_moment_takes_the_table_back_at_once(start_sims, tmp_path, monkeypatch):
    sims = start_sims("--speed", "60")
    async with bench(sims, tmp_path) as (site, store, session):
        before, failed = await active(session), []
        honest = StoreBook.append

        async def fails_once(self, journal, wanted, doc):
            if wanted is PushState.PROBED and not failed:
                failed.append(wanted)
                raise StoreError("the disk is full")
            return await honest(self, journal, wanted, doc)

        monkeypatch.setattr(StoreBook, "append", fails_once)
        with pytest.raises(StoreError) as raised:
            await push(session.controller, store, site, steep(site))
        assert raised.value.__notes__ == ["the old table is in force"]
        assert (await active(session), last(store)) == (before, PushState.ROLLED_BACK)


async def test_whoever_stops_it_hears_that_the_table_is_still_active(start_sims, tmp_path):
    sims = start_sims("--speed", "60")
    async with bench(sims, tmp_path) as (site, store, session):
        before, task = await active(session), asyncio.current_task()

        async def stopped() -> VerificationResult:
            sims.ask("estop", on=True)
            task.cancel()
            await asyncio.Event().wait()
            raise AssertionError

        with pytest.raises(asyncio.CancelledError) as raised:
            await push(session.controller, store, site, steep(site), probe=stopped)
        task.uncancel()
        assert "STILL ACTIVE" in raised.value.__notes__[0]
        assert last(store) == PushState.ROLLBACK_PENDING
        sims.ask("estop", on=False)
        await session.controller.reset_alarm()
        assert "made active again" in await recover(session.controller, store, site)

        async def just_stopped() -> VerificationResult:
            task.cancel()
            await asyncio.Event().wait()
            raise AssertionError

        with pytest.raises(asyncio.CancelledError) as raised:
            await push(session.controller, store, site, steep(site), probe=just_stopped)
        task.uncancel()
        assert raised.value.__notes__ == ["the old table is in force"]
        assert (await active(session), last(store)) == (before, PushState.ROLLED_BACK)


async def test_a_stop_that_comes_before_a_question_moves_nothing(start_sims, tmp_path):
    sims = start_sims("--speed", "60")
    async with bench(sims, tmp_path) as (site, store, session):
        task, asked = asyncio.current_task(), []

        async def never() -> VerificationResult:
            asked.append(1)
            return VerificationResult(True, "a stand-in")

        class StopsBeforeTheProbe(Pushing):
            async def _run_question(self, question):
                task.cancel()
                await asyncio.sleep(0)
                return await super()._run_question(question)

        wanted = WantedTable(steep(site), await read_base(session.controller), 100, None, {})
        with pytest.raises(asyncio.CancelledError):
            await StopsBeforeTheProbe(session.controller, store, site).bring(wanted, Questions(list, "a test", never, never))
        task.uncancel()
        assert (asked, last(store)) == ([], PushState.ROLLED_BACK)
