"""A verdict belongs to the table that was in force: after a rollback nothing shows the last check's verdict as the machine's.

Before, `abbe fleet` said "pass" after a rollback to a table that had failed: the check was of another table.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.tables import crc32
from abbe.service.cli import run
from abbe.service.clock import SystemClock
from abbe.service.core.board import Board
from abbe.service.domain.machine import Rules
from abbe.service.domain.push_entry import S
from abbe.service.domain.schedule import Schedule
from abbe.service.plant.gather import Gatherer, PlantFacts
from abbe.service.plant.mtconnect import Agent
from abbe.service.plant.opcua.space import picture_of
from abbe.service.push.journal import StoreBook
from abbe.service.queries.fleet import MachineStatus, machine_statuses
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import Status, StatusReader
from abbe.service.rendering.document import Document
from abbe.service.report.report import numbered_report
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from abbe.service.verification.verified_by import STRANGE_TABLE, VerifiedBy, verified_by
from abbe.service.web.page import environment, render
from abbe.service.web.pages.times import trend_screen
from tests.pretended_push import KEPT, TAKEN_BACK, as_if_pushed
from tests.system.serve_check import Result

MACHINE = {"name": "mill-7", "chain": "w-Y-X-b-Z-t", "stroke_mm": {a: [0.0, 500.0] for a in "XYZ"}}
OLD, NEW = b"the table of May", b"the table of June"


@dataclass
class World:
    """A database with checks and pushes of one machine, and every display over it."""

    url: str
    store: Store
    board: Board

    def check(self, verdict: str, table: bytes | None = None, value: float = 9.0, begun: datetime | None = None) -> int:
        """A check that ends now, with the table that its campaign says was in force. ``begun``: when it says that it began."""
        now = datetime.now(UTC)
        machine = self.store.machines.add("mill-7", MACHINE)
        name = f"quick-check {now:%H:%M:%S.%f}"
        if table is not None:
            self.store.campaigns.add(machine, name, {"table_crc": crc32(table)})
        told = Result(verdict, {"body_diagonal_um": value}, text=verdict, started_utc=begun or now, duration_s=1.0, campaign=name)
        occasion = verify.Occasion("mill-7", Schedule("weekly", "0 6 * * 1", "UTC", "quick-check"), now)
        return self.store.verifications.add_with_messages(machine, verify.check_doc(occasion, told), [])

    def push(self, base: bytes, new: bytes, states: tuple[Any, ...] = KEPT, **doc: Any) -> None:
        asyncio.run(as_if_pushed(self.store, SystemClock(), "mill-7", doc or {"proposal": 1}, (base, new), states))

    def rollback(self) -> None:
        self.push(NEW, OLD, kind="rollback", reason="worse on the gauge block")

    def accept(self, table: bytes) -> None:
        async def accepted() -> None:
            book = await StoreBook.last(self.store, "mill-7", SystemClock())
            assert book is not None
            await book.append(await book.entries(), S.ACCEPTED, {"accepted_bank": 0, "accepted_crc": crc32(table)})

        asyncio.run(accepted())

    def known(self) -> VerifiedBy:
        return verified_by(self.store, "mill-7")

    def fleet(self) -> MachineStatus:
        return machine_statuses(self.store, datetime.now(UTC))[0]

    def _view(self) -> StatusReader:
        return StatusReader(Reader(self.store, "mill-7", SystemClock()), "0", self.board, list, "")

    def status(self) -> Status:
        return asyncio.run(self._view().status())

    def home(self) -> str:
        past = asyncio.run(self._view().verifications(50))
        return render(environment(), self.status(), past)

    def facts(self) -> PlantFacts:
        return asyncio.run(Gatherer(self._view().status, self.store).facts())

    def report(self, check: int) -> Document:
        return numbered_report(self.store, "verification", check, Rules())


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        store.machines.add("mill-7", MACHINE)
        yield World(url, store, Board({}, SystemClock()))


def test_after_a_rollback_no_display_says_pass(world: World) -> None:
    world.push(OLD, NEW)
    check = world.check("pass", NEW)
    assert world.known().text.startswith(f"checked with the table in force: check {check} of ")
    assert (world.fleet().verdict, world.facts().verdict, world.report(check).verdict[1]) == ("pass", "pass", "Passed")
    assert "unverified" not in world.home()
    world.rollback()

    known = world.known()
    assert (known.state, known.why, known.number, known.crc) == ("unverified", "rollback", 2, crc32(OLD))
    assert known.text.startswith("unverified since the rollback of ")
    assert known.text.endswith("(push 2)")
    fleet = world.fleet()
    assert (fleet.verdict, fleet.figures, fleet.verified.text) == ("unverified", (), known.text)
    home = world.home()
    assert "Unverified since the rollback of" in home
    assert '<p class="verdict pass">' not in home
    assert "Last check before that," in home
    facts = world.facts()
    assert facts.verdict == "unverified"
    picture = picture_of(facts)
    assert picture["LastResult/Verdict"].value == "unverified"
    assert picture["CompensationTable/Verified"].value is False
    assert picture["CompensationTable/VerifiedText"].value == known.text
    agent = Agent(1)
    agent.update(facts)
    current = agent.current(facts, {}).decode()
    assert '<Entry key="verdict">unverified</Entry>' in current
    assert "<Warning" in current
    sign, word, text = world.report(check).verdict
    assert (sign, word) == ("open", "Unverified now")
    assert "nverified since the rollback of" in text
    assert "When this was measured: Passed" in text


def test_a_check_with_the_table_in_force_ends_it(world: World) -> None:
    world.push(OLD, NEW)
    world.check("pass", NEW)
    world.rollback()
    number = world.check("fail", OLD, 42.0)
    assert (world.known().state, world.known().why, world.known().number) == ("verified", "check", number)
    assert world.fleet().verdict == "fail"
    assert '<p class="verdict fail">' in world.home()
    assert world.facts().verdict == "fail"


def test_the_same_table_as_before_is_unverified_as_well(world: World) -> None:
    """A check of May passed with the table of May. In June it comes back: what the machine does with it now, nobody has measured."""
    world.check("pass", OLD)
    world.push(OLD, NEW)
    world.rollback()
    assert world.known().why == "rollback"
    assert world.fleet().verdict == "unverified"


def test_a_kept_push_is_verified_by_itself_and_says_so(world: World) -> None:
    world.check("fail", OLD, 42.0)
    world.push(OLD, NEW)
    world.store.verifications.add(1, None, "pass", {"text": "better", "push": 1, "figures": {}})
    known = world.known()
    assert (known.state, known.why, known.number) == ("verified", "push", 1)
    assert "measured before and after; not checked since" in known.text
    assert world.fleet().verdict == "verified"
    home = world.home()
    assert "Push 1 (" in home
    assert "push 1 kept" in home


def test_a_push_that_was_taken_back_leaves_the_verdict_as_it_was(world: World) -> None:
    """Its own verification is of a table that is not in force; it was the newest, and its "fail" was the machine's."""
    check = world.check("pass", OLD)
    world.push(OLD, NEW, TAKEN_BACK)
    world.store.verifications.add(1, None, "fail", {"text": "no improvement", "push": 1, "figures": {}})
    assert (world.known().why, world.known().number) == ("check", check)
    assert world.fleet().verdict == "pass"
    assert '<p class="verdict pass">' in world.home()
    assert "push 1 taken back" in world.home()
    assert world.facts().verdict == "pass"


def test_a_check_with_another_table_than_the_journal_has_is_no_verdict(world: World) -> None:
    world.push(OLD, NEW)
    number = world.check("pass", b"a stranger's table")
    assert (world.known().state, world.known().why, world.known().number) == ("unverified", "other", number)
    assert world.fleet().verdict == "unverified"


def test_an_accepted_table_is_unverified(world: World) -> None:
    world.push(OLD, NEW, TAKEN_BACK)
    world.check("pass", OLD)
    world.accept(NEW)
    assert (world.known().state, world.known().why) == ("unverified", "accepted")
    assert world.known().crc == crc32(NEW)


def test_a_push_that_is_not_finished_is_unverified(world: World) -> None:
    world.check("pass", OLD)
    world.push(OLD, NEW, KEPT[:-2])
    assert (world.known().state, world.known().why) == ("unverified", "open")
    assert world.fleet().verdict == "unverified"


def test_a_table_that_somebody_else_changed_is_unverified_until_a_person_has_looked(world: World) -> None:
    """The core sees it at the controller; whoever reads the database knows it from the machine's own line."""
    world.push(OLD, NEW)
    world.check("pass", NEW)
    text = f"{STRANGE_TABLE}: the compensation in force was changed from outside"
    world.board.attention.append(text)
    assert world.status().verified.why == "changed"
    assert world.fleet().verdict == "pass"
    world.store.heartbeats.put("mill-7", {"schema": 1, "state": "waiting", "due": [], "attention": [text]})
    assert world.fleet().verdict == "unverified"
    world.accept(b"a stranger's table")
    assert world.known().why == "accepted"


def test_a_check_measured_after_what_the_service_saw_ends_it(world: World) -> None:
    """The service is gone, and so is what it said last: a check found the journal's table in force since."""
    world.push(OLD, NEW)
    text = f"{STRANGE_TABLE}: the compensation in force was changed from outside"
    world.store.heartbeats.put("mill-7", {"schema": 1, "state": "waiting", "due": [], "attention": [text]})
    world.check("pass")
    assert world.known().why == "changed", "with which table, nobody wrote down"
    world.check("pass", b"a stranger's table")
    assert world.known().why == "changed"
    world.check("pass", NEW)
    assert (world.known().why, world.fleet().verdict) == ("check", "pass")
    world.store.heartbeats.put("mill-7", {"schema": 1, "state": "waiting", "due": [], "attention": [text]})
    assert world.known().why == "changed", "seen again"


def test_a_check_that_began_with_the_word_for_its_table_counts(world: World) -> None:
    """`abbe measure --accept-table`: the command began, the word was given, the campaign began."""
    begun = datetime.now(UTC)
    world.push(OLD, NEW, TAKEN_BACK)
    world.accept(NEW)
    assert world.known().why == "accepted"
    world.check("pass", OLD, begun=begun)
    assert world.known().why == "accepted", "another table"
    number = world.check("pass", NEW, begun=begun)
    assert (world.known().state, world.known().why, world.known().number) == ("verified", "check", number)


def test_a_changed_journal_is_no_verdict(world: World) -> None:
    world.push(OLD, NEW)
    world.check("pass", NEW)
    with world.store.engine.begin() as connection:  # as somebody with a way to the database would
        connection.exec_driver_sql("UPDATE push_entries SET utc = '2026-01-01T00:00:00Z' WHERE id = 3")
    assert (world.known().state, world.known().why) == ("unknown", "journal")
    assert world.fleet().verdict == "unknown"


def test_trends_mark_where_the_table_changed_and_begin_anew(world: World) -> None:
    for value in (9.0, 9.1, 9.2):
        world.check("pass", OLD, value)
    world.push(OLD, NEW)
    status = world.status()
    past = asyncio.run(world._view().verifications(50))
    reader = world._view().reader
    screen = trend_screen(reader, past, status, pictures=True)
    assert [line.trend.checks for line in screen.charts] == []
    assert str(screen.plots[0].picture).count('class="changed"') == 1
    assert str(screen.plots[0].picture).count('class="pass earlier"') == 3
    assert screen.plots[0].series is None, "no check of this table yet: there is no chart"
    world.check("pass", NEW, 5.0)
    past = asyncio.run(world._view().verifications(50))
    screen = trend_screen(reader, past, world.status(), pictures=True)
    assert [line.trend.checks for line in screen.charts] == [1]
    assert str(screen.plots[0].picture).count("earlier table") == 3
    series = trend_screen(reader, past, world.status(), pictures=False).plots[0].series
    assert series is not None
    assert (series["earlier"], [mark["kind"] for mark in series["marks"]]) == (3, ["table"])


def test_the_commands_say_it(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world.push(OLD, NEW)
    world.check("pass", NEW)
    world.rollback()
    file = tmp_path / "machine.toml"
    strokes = "\n".join(f"{a} = [0.0, 500.0]" for a in "XYZ")
    file.write_text(f'name = "mill-7"\nchain = "w-Y-X-b-Z-t"\n[stroke_mm]\n{strokes}\n')
    assert run(["fleet", "--db", world.url, "--json"]) == 0
    (line,) = json.loads(capsys.readouterr().out)["machines"]
    assert (line["verdict"], line["verified"]["why"], line["figures"]) == ("unverified", "rollback", [])
    assert run(["trend", "-m", str(file)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("unverified since the rollback of ")
    assert f"abbe measure -m {file} --recipe quick-check" in said
    assert run(["trend", "-m", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verified"]["state"] == "unverified"


def test_nothing_known_is_said_as_before(world: World) -> None:
    assert (world.known().state, world.known().why) == ("unknown", "never")
    assert world.fleet().verdict == ""
    assert "Not checked" not in world.home()
    began = datetime.now(UTC) - timedelta(seconds=5)
    number = world.check("cannot tell")
    assert world.known().number == number
    assert world.known().utc is not None
    assert world.known().utc > began
