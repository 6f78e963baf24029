"""A strange table in force is told once, shown until it is gone or accepted, and a push of our own is never one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.core.table_watch import AGAIN_S, CODE, LOOK_S, REMEDY, InForce, TableWatch
from abbe.service.domain.push_entry import PushEntry, PushState
from abbe.service.tables.push_journal import JournalView
from tests.service.core.fakes import FakeClock, FakeShelf, settle, utc

OURS = InForce(0, 0xA, 0xA)
STRANGE = InForce(1, 0xB, 0xA)


class Bench:
    """What the controller says next is ``seen``: a look, or a trouble."""

    def __init__(self, seen: InForce | Exception) -> None:
        self.seen = seen
        self.clock, self.shelf = FakeClock(utc(2026, 6, 1)), FakeShelf()
        self.attention: list[str] = ["another line"]
        self.changes = 0

    async def look(self) -> InForce:
        if isinstance(self.seen, Exception):
            raise self.seen
        return self.seen

    def changed(self) -> None:
        self.changes += 1

    async def then(self, seen: InForce | Exception, s: float = LOOK_S + AGAIN_S) -> None:
        self.seen = seen
        await self.clock.pass_time(s)


@asynccontextmanager
async def watched(bench: Bench) -> AsyncIterator[None]:
    task = asyncio.create_task(TableWatch(bench.look, bench.shelf, bench.attention, bench.clock, bench.changed).run())
    await settle()
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def test_a_strange_table_is_told_once_and_shown_until_it_is_gone() -> None:
    bench = Bench(OURS)
    async with watched(bench):
        await bench.then(STRANGE)
        await bench.then(STRANGE, 100.0)
        (alarm,) = bench.shelf.alarms
        assert alarm["code"] == CODE
        assert "bank 1 has CRC 0000000B instead of 0000000A" in alarm["what"]
        assert len(bench.attention) == 2
        assert "accept-table" in bench.attention[1]
        await bench.then(replace(STRANGE, wanted=0xB), 2 * LOOK_S)  # a person has accepted it
        assert bench.attention == ["another line"]
        await bench.then(replace(STRANGE, crc=0xC, wanted=0xB))
        assert len(bench.shelf.alarms) == 2


async def test_it_is_seen_within_fifteen_seconds() -> None:
    bench = Bench(OURS)
    async with watched(bench):
        await bench.then(STRANGE, 15.0)
        assert len(bench.shelf.alarms) == 1


@pytest.mark.parametrize("silence", [LinkDown("tcp://x", "look", "gone"), replace(STRANGE, settled=False)])
async def test_no_answer_and_an_open_push_say_nothing(silence: InForce | Exception) -> None:
    bench = Bench(OURS)
    async with watched(bench):
        await bench.then(silence, 100.0)
        assert bench.shelf.alarms == []
        await bench.then(STRANGE)
        await bench.then(silence, 100.0)
        assert len(bench.attention) == 2, "what was seen is not forgotten because nobody answers"


async def test_one_look_in_the_middle_of_an_end_is_no_alarm() -> None:
    """The journal of another process may be read a moment before its last line: the second look finds both of one mind."""
    bench = Bench(OURS)
    async with watched(bench):
        await bench.then(STRANGE, LOOK_S + AGAIN_S / 2)
        await bench.then(replace(STRANGE, wanted=0xB), 100.0)
        assert bench.shelf.alarms == []


async def test_without_a_push_a_control_as_it_comes_is_what_counts() -> None:
    """A table that corrects nothing needs nobody's word; what takes its place is an alarm, and a person looks."""
    bench = Bench(InForce(0, 0xA, None))
    async with watched(bench):
        await bench.then(InForce(0, 0xA, None), 100.0)
        assert (bench.shelf.alarms, bench.attention) == ([], ["another line"])
        for strange in (0xB, 0xC):
            await bench.then(InForce(1, strange, None, strange=True), 100.0)
            assert f"{strange:08X} instead of 0000000A" in bench.attention[-1]
            assert bench.attention[1:] == [f"{CODE}: {bench.shelf.alarms[-1]['what']} - {REMEDY}"]
        assert [alarm["remedy"] for alarm in bench.shelf.alarms] == [REMEDY] * 2
        await bench.then(InForce(0, 0xA, None), 100.0)
        assert (len(bench.shelf.alarms), bench.attention) == (2, ["another line"])


@pytest.mark.parametrize(
    ("first", "words"),
    [
        (InForce(1, 0xC, None, strange=True), "a table that this database did not push is in force: bank 1 has CRC 0000000C"),
        (InForce(1, 0xC, 0xC, strange=True), "a table that this database did not push is in force: bank 1 has CRC 0000000C"),
        (
            InForce(1, 0xC, None, unverified="push 2 of machine 'mill'"),
            "the compensation in force is unverified: bank 1 has CRC 0000000C; it is the table of push 2 of machine 'mill', which was "
            "never verified",
        ),
        (InForce(1, 0xC, 0xC, unverified="push 2 of machine 'mill'"), "unverified: bank 1 has CRC 0000000C; it is the table of push 2"),
        (
            InForce(1, 0xC, 0xA, unverified="push 2 of machine 'mill'"),
            "instead of 0000000A; it is the table of push 2 of",
        ),
    ],
)
async def test_a_table_that_the_gate_refuses_is_an_alarm_at_the_first_look_and_never_expected(first: InForce, words: str) -> None:
    """Before, a service took whatever it found first for good."""
    bench = Bench(first)
    async with watched(bench):
        await bench.then(first, 2 * AGAIN_S)
        (alarm,) = bench.shelf.alarms
        assert words in alarm["what"]
        assert bench.attention[1:] == [f"{CODE}: {alarm['what']} - {REMEDY}"]
        await bench.then(InForce(0, 0xA, first.wanted and 0xA), 100.0)  # restored at the controller
        assert (len(bench.shelf.alarms), bench.attention) == (1, ["another line"])


def test_the_remedy_names_nothing_that_is_refused_then() -> None:
    """A rollback and a push look at the table in force first, and refuse this one."""
    assert "rollback" not in REMEDY
    assert "push" not in REMEDY
    assert "accept-table" in REMEDY


def entries(state: PushState, *docs: dict[str, int], push: int = 1) -> list[PushEntry]:
    states = [PushState.SNAPSHOT] * (len(docs) - 1) + [state]
    return [
        PushEntry(machine="", push=push, seq=k, state=one, doc=doc, utc="", prev="", digest="")
        for k, (one, doc) in enumerate(zip(states, docs, strict=True))
    ]


KEPT = entries(PushState.KEEP, {"crc": 2, "base_crc": 1}, {})
ACCEPTED = entries(PushState.ACCEPTED, {"crc": 4, "base_crc": 2}, {"accepted_crc": 3}, push=2)
ON_STRANGE = {"crc": 5, "base_crc": 9}


@pytest.mark.parametrize(
    ("journal", "wanted"),
    [
        ([], (None, True)),
        (entries(PushState.KEEP, {"crc": 2, "base_crc": 1}, {}), (2, True)),
        (entries(PushState.ROLLED_BACK, {"crc": 2, "base_crc": 1}, {}), (1, True)),
        (entries(PushState.REJECTED, {"crc": 2, "base_crc": 1}, {}), (1, True)),
        (entries(PushState.ACCEPTED, {"crc": 2, "base_crc": 1}, {"accepted_crc": 3}), (3, True)),
        (entries(PushState.PROBATION, {"crc": 2, "base_crc": 1}, {}), (None, False)),
        (entries(PushState.OPERATOR, {"crc": 2, "base_crc": 1}, {}), (None, False)),
        # a push that comes to nothing on a strange table does not make that one expected
        (KEPT + entries(PushState.ROLLED_BACK, ON_STRANGE, {}, push=2), (2, True)),
        (KEPT + entries(PushState.REJECTED, ON_STRANGE, {}, push=2) + entries(PushState.ABORTED, ON_STRANGE, {}, push=3), (2, True)),
        (KEPT + ACCEPTED + entries(PushState.ROLLED_BACK, ON_STRANGE, {}, push=3), (3, True)),
        (ACCEPTED + entries(PushState.KEEP, ON_STRANGE, {}, push=3), (5, True)),
        (entries(PushState.ABORTED, {"crc": 2, "base_crc": 1}, {}) + entries(PushState.REJECTED, ON_STRANGE, {}, push=2), (1, True)),
        (entries(PushState.ABORTED, {}, {}), (None, True)),
        (KEPT + entries(PushState.PROBATION, ON_STRANGE, {}, push=2), (None, False)),
    ],
)
def test_what_the_journal_left_in_force(journal: list[PushEntry], wanted: tuple[int | None, bool]) -> None:
    assert JournalView(tuple(journal)).wanted == wanted
