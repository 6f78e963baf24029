"""Whose table is in force: journals belong to controls, and the CRC is looked up over all of them, whatever a machine is called."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from abbe.drivers.tables import crc32
from abbe.models.compensation.tables import NineTables
from abbe.service.clock import SystemClock
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.compensation.recover import accept, recover
from abbe.service.core.table_watch import look_at_table
from abbe.service.domain.machine import DeviceUrls, address_of, control_of
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import TableMismatch, UnsafeToMove
from abbe.service.push.journal import NO_PUSH, StoreBook, check_chain
from abbe.service.push.operations import VerificationResult
from abbe.service.report.report_table import table_remarks
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import known_tables
from abbe.service.tables.measured_with import KIND_AT
from abbe.service.tables.nine_tables import read_base
from abbe.service.tables.push_journal import JournalView, open_pushes
from abbe.service.verification.verified_by import verified_by
from tests.faults.sequencer_world import Bench, bench
from tests.pretended_push import KEPT, TAKEN_BACK, UP_TO_ACTIVE, as_if_pushed
from tests.push.test_bad_tables_on_the_wire import tables
from tests.run_documents import runs_of

pytestmark = pytest.mark.timeout(120)
HERE, THERE = "modbus+tcp://10.0.0.6:502", "modbus+tcp://10.0.0.7:502"
OLD, NEW, THIRD = b"old table", b"new table", b"third table"
ACTING = bytes(KIND_AT.start) + b"\x00\x01" + bytes(32)


# ---- which journal --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        "modbus+tcp://Mill.local:502",
        "modbus+tcp://mill.local:502?unit=1",
        "MODBUS+TCP://mill.local:502/",
    ],
)
def test_a_control_is_its_address_without_the_query(url: str) -> None:
    assert control_of(url) == "modbus+tcp://mill.local:502"


def test_two_units_of_a_gateway_are_two_controls_behind_one_lock() -> None:
    gateway = ["modbus+tcp://mill.LOCAL:502?unit=2", "modbus+tcp://mill.local:502", "modbus+tcp://mill.local:502?unit=02&x=1"]
    second = "modbus+tcp://mill.local:502?unit=2"
    assert [control_of(url) for url in gateway] == [second, "modbus+tcp://mill.local:502", second]
    assert {address_of(url) for url in gateway} == {"modbus+tcp://mill.local:502"}


def test_a_line_and_no_control() -> None:
    assert control_of("modbus+rtu:///dev/ttyS0?baud=115200&unit=1") == "modbus+rtu:///dev/ttyS0"
    assert control_of(None) == ""


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


async def pushed(store: Store, machine: str, images: tuple[bytes, bytes], states: tuple[PushState, ...], control: str = "") -> None:
    await as_if_pushed(store, SystemClock(), machine, {}, images, states, control)


async def test_a_new_name_continues_the_history_of_its_control(store: Store) -> None:
    await pushed(store, "mill-a", (OLD, NEW), KEPT, HERE)
    await pushed(store, "mill-A", (NEW, THIRD), KEPT, HERE)
    entries = store.pushes.entries("mill-A", HERE)
    check_chain(entries)
    assert {e.push for e in entries} == {1, 2}
    assert entries == store.pushes.entries("mill-A") == store.pushes.entries("mill-a")  # also under the other name


async def test_an_open_push_of_the_control_is_finished_before_one_under_a_new_name(store: Store) -> None:
    await pushed(store, "mill-a", (OLD, NEW), UP_TO_ACTIVE, HERE)
    with pytest.raises(UnsafeToMove, match="push 1 of mill-a is in state PROBATION"):
        await StoreBook.new(store, "mill-A", SystemClock(), HERE)
    await StoreBook.new(store, "mill-B", SystemClock(), THERE)  # another control is not kept from anything


async def test_a_control_at_a_new_address_keeps_the_journal_of_its_name_unless_that_is_another_s_now(store: Store) -> None:
    await pushed(store, "mill", (OLD, NEW), KEPT, HERE)
    assert store.pushes.chain("mill", THERE) == "mill"
    await pushed(store, "mill-old", (NEW, THIRD), KEPT, HERE)
    assert store.pushes.chain("mill-old", HERE) == "mill"
    assert store.pushes.chain("mill", THERE) == f"mill ({THERE})"
    await pushed(store, "mill", (b"other base", b"other table"), KEPT, THERE)
    assert [e.push for e in store.pushes.entries("mill", THERE)[:1]] == [1]
    assert store.pushes.entries("mill") == store.pushes.entries("mill", THERE)


async def test_an_address_that_a_control_has_left_is_not_its_any_more(store: Store) -> None:
    await pushed(store, "mill", (OLD, NEW), KEPT, HERE)
    await pushed(store, "mill", (NEW, THIRD), UP_TO_ACTIVE, THERE)
    assert store.pushes.chain("lathe", HERE) == "lathe"
    assert (store.pushes.chain("mill", HERE), store.pushes.chain("lathe", THERE)) == ("mill", "mill")


async def test_a_journal_that_was_begun_under_a_name_is_not_that_of_another_control_with_the_name_now(store: Store) -> None:
    await pushed(store, "mill", (OLD, NEW), KEPT, HERE)
    await pushed(store, "mill", (b"a", b"b"), KEPT, THERE)
    await pushed(store, "other", (b"c", b"d"), KEPT, HERE)
    assert store.pushes.chain("other") == "other"
    await pushed(store, "mill-old", (b"e", b"f"), KEPT, THERE)
    await pushed(store, "mill", (b"g", b"h"), KEPT, HERE + "1")
    await pushed(store, "mill-old", (b"f", b"i"), KEPT, THERE)
    assert store.pushes.chain("mill-old") == "mill"
    assert store.pushes.chain("mill") == f"mill ({HERE}1)"  # known by its name only


async def test_what_an_older_version_wrote_belongs_to_the_name(store: Store) -> None:
    await pushed(store, "mill", (OLD, NEW), UP_TO_ACTIVE)
    assert store.pushes.entries("mill", HERE)[-1].state == PushState.PROBATION
    assert store.pushes.entries("other", HERE) == []


async def test_unverified_is_looked_up_over_all_journals_and_no_later_base_makes_it_good(store: Store) -> None:
    await pushed(store, "a", (OLD, NEW), UP_TO_ACTIVE, HERE)
    await pushed(store, "b", (NEW, THIRD), TAKEN_BACK, THERE)  # by whoever did not look: its base is the unverified table
    known = known_tables(store)
    by_push = {(p.machine, p.control, p.push, p.may_be_active) for p in known.unverified.values()}
    assert by_push == {("a", HERE, 1, True), ("b", THERE, 1, False)}
    await pushed(store, "c", (THIRD, NEW), KEPT, "modbus+tcp://10.0.0.8:502")
    assert {p.machine for p in known_tables(store).unverified.values()} == {"b"}


async def test_a_report_gives_no_verdict_on_an_unverified_table(store: Store) -> None:
    await pushed(store, "a", (OLD, NEW), UP_TO_ACTIVE, HERE)
    crc = next(iter(known_tables(store).unverified))
    said = table_remarks(store, "a", runs_of([{"table": {"crc": crc, "bank": 1, "acting": True}}]))
    sign, word, text = said.verdict(("ok", "Within limits", "By the limits."))
    assert (sign, word) == ("bad", "Unverified table")
    assert "push 1 of machine 'a'" in text
    strange = table_remarks(store, "a", runs_of([{"table": {"crc": 5, "acting": True}}, {"table": {"crc": 6, "acting": False}}]))
    assert strange.remarks == ("measured with a table that this database did not push (CRC 00000005): not accepted",)
    assert strange.verdict(("ok", "Within limits", "By the limits.")) == ("ok", "Within limits", "By the limits.")


async def test_a_report_names_a_table_that_was_verified_on_another_machine(store: Store) -> None:
    await pushed(store, "a", (OLD, ACTING), KEPT, HERE)
    used = runs_of([{"table": {"crc": crc32(ACTING), "acting": True}}])
    assert table_remarks(store, "a", used).remarks == ()
    remark = f"measured with a table (CRC {crc32(ACTING):08X}) that was verified on machine 'a' (push 1), not on this one"
    assert table_remarks(store, "b", used).remarks == (f"{remark}: not accepted",)


async def test_a_verdict_of_the_control_that_had_the_name_before_is_not_this_one_s(store: Store) -> None:
    await pushed(store, "mill", (OLD, NEW), KEPT, HERE)
    await pushed(store, "mill-old", (NEW, THIRD), KEPT, HERE)  # renamed; a new machine is called mill now
    assert verified_by(store, "mill", control=THERE).why == "never"
    assert (verified_by(store, "mill-old", control=HERE).crc, JournalView.read(store, "mill", THERE).history().pushes) == (crc32(THIRD), ())
    await pushed(store, "mill", (b"a", b"b"), TAKEN_BACK, THERE)
    await pushed(store, "mill-old", (THIRD, b"c"), KEPT, HERE)
    by_name = verified_by(store, "mill")
    assert (by_name.crc, by_name.why) == (crc32(b"a"), "never")
    assert verified_by(store, "mill-old").crc == crc32(b"c")


async def test_a_dry_run_and_an_approval_warn_of_every_table_that_may_be_in_force(store: Store) -> None:
    await pushed(store, "a", (OLD, NEW), UP_TO_ACTIVE, HERE)
    await pushed(store, "b", (OLD, THIRD), TAKEN_BACK, THERE)
    (own,) = open_pushes(store, "renamed", HERE)
    assert own.startswith("push 1 is in state PROBATION: an unverified table may be in force")
    (other,) = open_pushes(store, "b", THERE)
    assert other.startswith(f"push 1 of machine 'a' at {HERE} is in state PROBATION: its table was never verified")


# ---- before anything moves ------------------------------------------------------------------------------------------------


@dataclass
class Left:
    """A control with a new table in force, the database of a process that was killed in probation, and the base before it."""

    b: Bench
    store: Store
    base: int

    async def active(self) -> int:
        now = await self.b.session.controller.comp_status()
        return now.bank_crc[now.active_bank]

    def site(self, name: str, cnc: str | None = None) -> Site:
        urls = self.b.site.urls
        return replace(self.b.site, name=name, urls=urls if cnc is None else DeviceUrls(cnc, urls.ballbar, urls.laser, urls.fixture))


@asynccontextmanager
async def left_in_probation(folder: Path, wanted: NineTables | None = None) -> AsyncIterator[Left]:
    """The database is copied in the middle of the probation: what is open in the copy is open for ever, whoever wrote the original."""
    async with bench(folder, seed=3) as b:
        b.sim.pace(100.0)
        controller, whole, killed = b.session.controller, folder / "whole.sqlite3", folder / "killed.sqlite3"

        async def copies() -> VerificationResult:
            with closing(sqlite3.connect(whole)) as old, closing(sqlite3.connect(killed)) as new:
                old.backup(new)
            return VerificationResult(True, "a stand-in")

        async def kept() -> VerificationResult:
            return VerificationResult(True, "a stand-in")

        with Store.open(f"sqlite:///{whole}") as store:
            base = await read_base(controller)
            await Pushing(controller, store, b.site, level=3).bring(
                WantedTable(wanted or tables(), base, 100, None, {}), Questions(list, "a test", copies, kept)
            )
        with Store.open(f"sqlite:///{killed}") as store:
            yield Left(b, store, base.crc)


async def test_under_a_new_name_of_the_same_control_the_table_is_taken_back_first(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        done = await recover(left.b.session.controller, left.store, left.site("mill-A"))
        assert "push 1 was not verified" in str(done)
        assert await left.active() == left.base


async def test_at_another_address_it_is_refused_and_a_person_s_word_closes_it_under_every_name(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        controller, here = left.b.session.controller, left.b.site.urls.control
        elsewhere = left.site("mill-A", left.b.site.urls.cnc.replace("127.0.0.1", "localhost"))
        words = rf"is that of push 1 of machine 'sim' at {re.escape(here)}, which was never verified.*machine file of 'sim'"
        with pytest.raises(TableMismatch, match=words):
            await recover(controller, left.store, elsewhere)
        assert left.store.pushes.entries("sim")[-1].state == PushState.PROBATION  # only looked at
        table = await left.active()
        assert "push 1 of machine 'sim', which no measurement has verified" in await accept(controller, left.store, elsewhere, "ann")
        assert left.store.pushes.entries("sim")[-1].doc["by"] == "ann"
        for site in (elsewhere, left.b.site, left.site("third")):
            assert await recover(controller, left.store, site) is None
        assert await left.active() == table != left.base


async def test_another_machine_s_open_push_at_another_address_blocks_nothing(tmp_path: Path) -> None:
    async with bench(tmp_path, seed=3) as b:
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            await pushed(store, "other", (OLD, NEW), UP_TO_ACTIVE, THERE)
            assert await recover(b.session.controller, store, b.site) is None


@asynccontextmanager
async def another_control(folder: Path) -> AsyncIterator[Bench]:
    """As it came: the table in force is the one that was in force before the push of `left_in_probation`, too."""
    (folder / "another").mkdir()
    async with bench(folder / "another", seed=3) as b:
        b.sim.pace(100.0)
        yield b


def as_it_was(folder: Path) -> str:
    """The database of the killed process, once more."""
    fresh = folder / "fresh.sqlite3"
    with closing(sqlite3.connect(folder / "killed.sqlite3")) as old, closing(sqlite3.connect(fresh)) as new:
        old.backup(new)
    return f"sqlite:///{fresh}"


NOT_HERE = r"push 1 of machine 'sim', begun at {}, has not ended, and nothing shows that this control belongs to machine 'sim'"


async def test_a_control_of_the_same_name_at_another_address_does_not_end_the_open_push(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left, another_control(tmp_path) as other:
        now, before = await other.session.controller.comp_status(), left.store.pushes.entries("sim")
        assert (now.bank_crc[now.active_bank], other.site.name) == (left.base, left.b.site.name)
        for _ in range(2):
            with pytest.raises(TableMismatch, match=NOT_HERE.format(re.escape(left.b.site.urls.control))):
                await recover(other.session.controller, left.store, other.site)
        assert left.store.pushes.entries("sim") == before  # nothing was written
        assert await other.session.controller.comp_status() == now
        assert "push 1 was not verified" in str(await recover(left.b.session.controller, left.store, left.b.site))
        assert await left.active() == left.base
        assert await recover(other.session.controller, left.store, other.site) is None  # nothing is open any more


async def test_a_control_that_moved_and_fell_back_to_its_old_table_needs_a_person_s_word(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left, another_control(tmp_path) as moved:
        controller = moved.session.controller
        assert "is accepted by ann" in await accept(controller, left.store, moved.site, "ann")
        check_chain(left.store.pushes.entries("sim"))
        assert [e.state for e in left.store.pushes.entries("sim")][-2:] == [PushState.OPERATOR, PushState.ACCEPTED]
        assert await recover(controller, left.store, moved.site) is None
        with pytest.raises(TableMismatch, match="never verified"):  # if it was another machine after all: its table is not accepted
            await recover(left.b.session.controller, left.store, left.b.site)


async def test_a_push_that_had_activated_nothing_is_closed_by_a_person_s_word_at_a_new_address(tmp_path: Path) -> None:
    async with bench(tmp_path, seed=3) as b:
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            await pushed(store, "sim", (OLD, NEW), UP_TO_ACTIVE[:5], HERE)
            with pytest.raises(TableMismatch, match=NOT_HERE.format(re.escape(HERE))):
                await recover(b.session.controller, store, b.site)
            await accept(b.session.controller, store, b.site, "ann")
            assert [e.state for e in store.pushes.entries("sim")][-2:] == [PushState.ABORTED, PushState.ACCEPTED]
            assert await recover(b.session.controller, store, b.site) is None


async def test_a_control_that_moved_with_the_unverified_table_in_force_takes_it_back(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        moved = left.site("sim", left.b.site.urls.cnc.replace("127.0.0.1", "localhost"))
        assert "push 1 was not verified" in str(await recover(left.b.session.controller, left.store, moved))
        assert await left.active() == left.base


async def test_two_machines_of_two_names_do_not_meet_each_other_s_open_push(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left, another_control(tmp_path) as other:
        site = replace(other.site, name="lathe")
        assert await recover(other.session.controller, left.store, site) is None
        assert left.store.pushes.entries("sim")[-1].state == PushState.PROBATION
        assert left.store.pushes.entries("lathe", site.urls.control) == []


async def test_an_open_push_at_an_address_where_another_control_is_now_waits_for_a_person(tmp_path: Path) -> None:
    """A simulator that got the port of an earlier one and another name: neither the old table in force nor a third one ends the push."""
    plain = tables()
    third = replace(plain, correction_mm=tuple(-curve for curve in plain.correction_mm))
    (tmp_path / "later").mkdir()
    async with left_in_probation(tmp_path) as left, left_in_probation(tmp_path / "later", third) as later:
        controller, site = later.b.session.controller, left.site("other")
        with Store.open(as_it_was(tmp_path)) as store:
            for end in (None, later.b.site):
                if end is not None:
                    await recover(controller, later.store, end)  # as the control came: the old table is in force, too
                now = await controller.comp_status()
                with pytest.raises(TableMismatch, match=NOT_HERE.format(re.escape(site.urls.control))):
                    await recover(controller, store, site)
                assert await controller.comp_status() == now
                assert store.pushes.entries("sim")[-1].state == PushState.PROBATION
            await accept(controller, store, site)
            assert await recover(controller, store, site) is None


async def test_a_push_of_an_older_version_is_found_by_its_table(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        image = (await read_base(left.b.session.controller)).image
        with Store.open(f"sqlite:///{tmp_path / 'old.sqlite3'}") as store:
            await pushed(store, "old name", (OLD, image), UP_TO_ACTIVE)
            with pytest.raises(TableMismatch, match="that of push 1 of machine 'old name', which was never verified"):
                await recover(left.b.session.controller, store, left.b.site)


async def test_a_table_that_this_database_did_not_push_is_refused_until_a_person_s_word_which_is_kept(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        controller, site = left.b.session.controller, left.b.site
        crc = f"{await left.active():08X}"
        with Store.open(f"sqlite:///{tmp_path / 'another.sqlite3'}") as store:
            for _ in range(2):
                with pytest.raises(TableMismatch, match=rf"a table that this database did not push \(CRC {crc}\)"):
                    await recover(controller, store, site)
            assert "is accepted by ann" in str(await recover(controller, store, site, accept_by="ann"))
            for again in (site, left.site("mill-A")):
                assert await recover(controller, store, again, accept_by="bob") is None  # there is nothing left to accept
            check_chain(store.pushes.entries(site.name))
            assert [(e.push, e.state, e.doc["by"]) for e in store.pushes.entries(site.name)] == [(NO_PUSH, PushState.ACCEPTED, "ann")]
            told = JournalView.read(store, site.name).history()
            assert (told.now.how, told.pushes, f"{told.now.crc:08X}") == ("accepted", (), crc)
            await accept(controller, store, site, "eve")  # the same word by `abbe accept-table`
            used = runs_of([{"table": {"crc": int(crc, 16), "acting": True}}])
            assert "accepted by eve at " in table_remarks(store, site.name, used).remarks[0]
            assert table_remarks(store, "lathe", used).remarks == (
                f"measured with a table (CRC {crc}) that was accepted on machine 'sim', not on this one: not accepted",
            )
            assert (await StoreBook.new(store, "sim", SystemClock(), site.urls.control))._push == 1  # a word is not a push


async def test_a_table_verified_on_one_control_is_not_good_on_another_until_a_person_s_word(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        controller, site, image = left.b.session.controller, left.b.site, (await read_base(left.b.session.controller)).image
        with Store.open(f"sqlite:///{tmp_path / 'fleet.sqlite3'}") as store:
            await pushed(store, "A", (OLD, image), KEPT, HERE)
            for _ in range(2):
                with pytest.raises(TableMismatch, match=r"was verified on machine 'A' \(push 1\), not on this one"):
                    await recover(controller, store, site)
            assert store.pushes.entries(site.name, site.urls.control) == []
            told = await recover(controller, store, site, accept_by="ann")
            assert "verified on machine 'A' (push 1), not on this one (CRC" in str(told)
            assert await recover(controller, store, site) is None
            moved = left.site("mill-A", site.urls.cnc.replace("127.0.0.1", "localhost"))
            with pytest.raises(TableMismatch, match="not on this one"):  # a new name at a new address: nothing says that it is the same one
                await recover(controller, store, moved)
            await accept(controller, store, moved, "ann")
            assert await recover(controller, store, moved) is None


async def test_a_control_at_a_new_address_has_the_table_that_was_kept_under_its_name(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        image = (await read_base(left.b.session.controller)).image
        with Store.open(f"sqlite:///{tmp_path / 'moved.sqlite3'}") as store:
            await pushed(store, "sim", (OLD, image), KEPT, HERE)
            assert await recover(left.b.session.controller, store, left.b.site) is None


async def test_a_table_of_no_correction_is_everybody_s(tmp_path: Path) -> None:
    async with bench(tmp_path, seed=3) as b:
        image = (await read_base(b.session.controller)).image
        with Store.open(f"sqlite:///{tmp_path / 'fleet.sqlite3'}") as store:
            await pushed(store, "A", (OLD, image), KEPT, HERE)
            assert await recover(b.session.controller, store, b.site) is None


async def test_where_a_person_has_to_look_the_other_machine_s_file_is_no_remedy(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        image = (await read_base(left.b.session.controller)).image
        with Store.open(f"sqlite:///{tmp_path / 'fleet.sqlite3'}") as store:
            await pushed(store, "A", (OLD, image), (*UP_TO_ACTIVE, PushState.OPERATOR), HERE)
            with pytest.raises(TableMismatch, match="is that of push 1 of machine 'A'") as refused:
                await recover(left.b.session.controller, store, left.b.site)
            assert "which rolls it back" not in str(refused.value)
            assert "abbe accept-table" in str(refused.value)


async def test_what_the_gate_refuses_the_service_sees_at_its_first_look(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        elsewhere = left.site("mill-A", left.b.site.urls.cnc.replace("127.0.0.1", "localhost"))
        seen = await look_at_table(elsewhere, left.store)()
        assert (seen.unverified, seen.strange, seen.wanted) == ("push 1 of machine 'sim'", False, None)
        with Store.open(f"sqlite:///{tmp_path / 'fresh.sqlite3'}") as store:
            look = look_at_table(left.b.site, store)
            for _ in range(2):
                seen = await look()
                assert (seen.crc, seen.unverified, seen.strange) == (await left.active(), "", True)
            await recover(left.b.session.controller, store, left.b.site, accept_by="ann")
            seen = await look()
            assert (seen.wanted, seen.unverified, seen.strange) == (seen.crc, "", False)


async def test_a_control_as_it_comes_and_a_table_of_zeros_are_nothing_to_the_service(tmp_path: Path) -> None:
    plain = tables()
    zeros = replace(plain, correction_mm=tuple(0.0 * curve for curve in plain.correction_mm))
    async with left_in_probation(tmp_path, zeros) as left:
        with Store.open(f"sqlite:///{tmp_path / 'fresh.sqlite3'}") as store:
            look = look_at_table(left.b.site, store)
            for _ in range(2):
                seen = await look()
                assert (seen.crc, seen.unverified, seen.strange) == (await left.active(), "", False)
            await recover(left.b.session.controller, left.store, left.b.site)  # as it came
            seen = await look()
            assert (seen.crc, seen.strange) == (left.base, False)


async def test_an_option_does_not_accept_what_a_push_of_this_database_left_unverified(tmp_path: Path) -> None:
    async with left_in_probation(tmp_path) as left:
        elsewhere = left.site("mill-A", left.b.site.urls.cnc.replace("127.0.0.1", "localhost"))
        with pytest.raises(TableMismatch, match="never verified"):
            await recover(left.b.session.controller, left.store, elsewhere, accept_by="ann")


async def test_a_control_as_it_comes_and_a_table_of_zeros_need_nobody_s_word(tmp_path: Path) -> None:
    plain = tables()
    zeros = replace(plain, correction_mm=tuple(0.0 * curve for curve in plain.correction_mm))
    async with left_in_probation(tmp_path, zeros) as left:
        assert await left.active() != left.base
        with Store.open(f"sqlite:///{tmp_path / 'another.sqlite3'}") as store:
            assert await recover(left.b.session.controller, store, left.b.site) is None
            assert store.pushes.entries("sim") == []
