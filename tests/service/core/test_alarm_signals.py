"""Which checks raise an alarm, by their figures and uncertainties; the desk's lines, messages and audit on a real store."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.audit.book import AuditBook
from abbe.service.cli import run
from abbe.service.clock import utc_text
from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.push_entry import PushEntry, PushState
from abbe.service.domain.results import VerificationRecord
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.errors import AlarmRefused, StoreError
from abbe.service.push.journal import GENESIS
from abbe.service.queries.status import alarms
from abbe.service.scheduler.alarm_manager import AlarmChannels, AlarmManager, Duties
from abbe.service.scheduler.job import CheckJobs, carry_out
from abbe.service.scheduler.retrying_store import StoreShelf
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store
from abbe.service.verification import verify
from abbe.service.verification.alarm_rules import AlarmTerms, found_in, series_begins
from abbe.service.verification.alarm_states import NO_ALARM, Alarm, Note
from abbe.service.verification.alarms import acknowledge, alarms_of
from tests.service.core.fakes import FakeClock, FakeWatcher, Result, utc

START = utc(2026, 3, 1, 5)
DAILY = Schedule("daily", "0 5 * * *", "UTC", "quick-check", on_alarm="propose")
LIMITS = {"body_diagonal_um": 20.0, "helix_rms_um": 5.0}
TOPICS = ("abbe/mill-7/verification", "abbe/mill-7/alarm")


def result(day: float, diagonal: float = 9.0, helix: float = 1.4, **more: Any) -> Result:
    given = {"started_utc": START + timedelta(days=day), "limits": LIMITS, "uncertainties": {"body_diagonal_um": 1.0, "helix_rms_um": 0.2}}
    return Result(values={"body_diagonal_um": diagonal, "helix_rms_um": helix}, **(given | more))


def records(*results: Result, recipe: str = "quick-check") -> list[VerificationRecord]:
    """Newest first, as the store gives them."""
    schedule = Schedule("daily", "0 5 * * *", "UTC", recipe)
    docs = [verify.check_doc(verify.Occasion("mill-7", schedule, r.started_utc), r) for r in results]
    return [VerificationRecord(k, 1, None, d["verdict"], d, d["started_utc"]) for k, d in enumerate(docs, 1)][::-1]


def kinds(*results: Result, **terms: Any) -> set[tuple[str, str]]:
    return {(s.figure, s.kind) for s in found_in(records(*results), AlarmTerms("quick-check", **terms)).signals}


def test_above_the_limit_by_more_than_its_uncertainty() -> None:
    assert kinds(result(0, 21.1)) == {("body_diagonal_um", "limit")}
    assert kinds(result(0, 20.9)) == set()  # U = 1: cannot tell


def test_a_jump_among_few_checks_is_more_than_uncertainty_and_worth_a_look() -> None:
    assert kinds(result(0), result(1, 15.0)) == {("body_diagonal_um", "jump")}
    assert kinds(result(0), result(1, 13.9)) == set()  # less than a quarter of the limit
    loose = {"uncertainties": {"body_diagonal_um": 4.0, "helix_rms_um": 0.2}}
    assert kinds(result(0, **loose), result(1, 15.0, **loose)) == set()  # U of the difference 5.7
    assert kinds(result(0, 15.0), result(1, 9.0)) == set()  # better
    (signal,) = found_in(records(result(0), result(1, 15.0)), AlarmTerms("quick-check")).signals
    assert signal.text == "worst body diagonal 15.0 ± 1.0 µm (U, k = 2) differs by +6.0 ± 1.4 µm from the checks before"


def test_what_jumped_does_not_become_the_habit() -> None:
    later = [result(0), *(result(d, 15.0) for d in range(1, 7))]
    assert kinds(*later) == set()  # compared with six checks of which five have jumped
    assert kinds(*later, compare={"body_diagonal_um": (9.0, 0.5)}) == {("body_diagonal_um", "jump")}


@pytest.fixture(scope="module")
def drifting() -> list[Result]:
    rng = np.random.default_rng(7)
    return [result(day, 9.0 + 0.3 * max(day - 40, 0) + 0.5 * rng.normal(), 1.4 + 0.1 * rng.normal()) for day in range(60)]


def test_a_drift_is_found_long_before_the_limit_and_warned_of_by_days(drifting: list[Result]) -> None:
    assert kinds(*drifting[:40]) == set()
    assert kinds(*drifting) == {("body_diagonal_um", "drift")}  # by the worse end of the interval 15 days or more are left
    assert kinds(*drifting, warn_days=30.0) == {("body_diagonal_um", "drift"), ("body_diagonal_um", "days")}
    found = {s.kind: s.text for s in found_in(records(*drifting), AlarmTerms("quick-check", warn_days=30.0)).signals}
    assert "drifts up since 2026-0" in found["drift"]
    assert found["days"].startswith("worst body diagonal reaches its limit of 20 µm in 1")
    assert "(95 %)" in found["days"]


def test_a_new_table_begins_a_new_series(drifting: list[Result]) -> None:
    after = [*drifting, result(60.5, 4.0)]
    assert kinds(*after, begins_utc=START + timedelta(days=60)) == set()


def test_other_recipes_and_checks_that_cannot_be_judged_say_nothing() -> None:
    verification = records(result(1, 50.0), recipe="verification")
    assert found_in(verification, AlarmTerms("quick-check")).judged is False
    hot = found_in(records(result(0), result(1, 50.0, comparable=False)), AlarmTerms("quick-check"))
    assert (hot.judged, hot.signals) == (False, ())
    assert kinds(result(0), result(1, 30.0, comparable=False), result(2)) == set()


class Bench:
    """Job, shelf and desk on a store, with a check that gives what the test wants."""

    def __init__(self, store: Store, url: str, push: bool = False) -> None:
        self.store, self.clock, self.watcher = store, FakeClock(START), FakeWatcher()
        self.machine_id = store.machines.add("mill-7", {})
        self.asked: list[Alarm] = []
        self.trouble: Exception | None = None
        self.outcome: Result | Exception = result(0)
        channels = AlarmChannels(TOPICS[1], lambda: None, AuditBook(store, url))

        async def look_into(one: Alarm, note: Note, progress: Any, control: Any) -> None:
            self.asked.append(one)
            if self.trouble is not None:
                raise self.trouble
            await note(AlarmKind.ENDED, AlarmFacts(text="no proposal: the tables promise too little"))

        async def push_one(order: Any) -> JobOutcome:
            return JobOutcome("kept", "better")

        duties = Duties(14.0, "identification", look_into, push_one if push else None)
        self.desk = AlarmManager(store, self.clock, "mill-7", [DAILY], duties, channels)
        shelf = StoreShelf(store, self.clock, ("mill-7", self.machine_id), TOPICS, lambda: None)
        self.checks = CheckJobs("mill-7", self._check, shelf, self.clock, self.desk.checked)

    async def _check(self, recipe: str, progress: Any, control: Any) -> Result:
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome

    async def check(self, outcome: Result | Exception) -> str:
        self.outcome = outcome
        state = await carry_out(self.checks(DAILY, START), START, Control())
        return state.reason

    def told(self) -> list[tuple[str, int]]:
        rows = [json.loads(m.payload) for m in self.store.outbox.pending() if m.topic == TOPICS[1]]
        return [(row["code"], row.get("alarm", 0)) for row in rows]

    async def follow_up(self) -> str:
        found = await self.desk.due()
        if found is None:
            return ""
        if found.job is not None:
            await carry_out(found.job, START, Control(), [self.watcher])
        return found.name


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path))
    return str(request.getfixturevalue("postgres")())


@pytest.fixture
def bench(url: str) -> Iterator[Bench]:
    with Store.open(url, utcnow=lambda: START + timedelta(days=1, hours=1)) as store:
        yield Bench(store, url)


async def test_raised_held_acknowledged_cleared_with_messages_and_audit(bench: Bench) -> None:
    assert await bench.check(result(0)) == ""
    assert (await bench.check(result(1, 25.0))).startswith(
        "alarm 1 raised: worst body diagonal 25.0 ± 1.0 µm (U, k = 2) is above its limit"
    )
    assert await bench.check(LinkDown("laser", "read", "gone")) == ""  # its own alarm, and none of the trend's
    assert (await bench.check(result(2, 24.0))).startswith("alarm 1 held")
    (one,) = alarms(bench.store, "mill-7")
    assert (one.state, [s.kind for s in one.signals]) == ("raised", ["limit", "jump"])
    assert acknowledge(bench.store, "mill-7", 1, "otto").word == "acknowledged"
    with pytest.raises(AlarmRefused, match="was acknowledged by otto"):
        acknowledge(bench.store, "mill-7", 1, "anna")
    assert (await bench.check(result(3, 9.1))).startswith("alarm 1 cleared")
    assert alarms(bench.store, "mill-7") == []
    assert bench.told() == [("ALM-001", 1), ("DRV-002", 0), ("ALM-002", 1)]
    assert [(r.target, r.outcome) for r in bench.store.audit.events()] == [("mill-7, alarm 1", "raised"), ("mill-7, alarm 1", "cleared")]


async def test_an_investigation_is_asked_for_once_and_a_failure_once_more(bench: Bench) -> None:
    await bench.check(result(0))
    assert await bench.follow_up() == ""
    await bench.check(result(1, 25.0))
    bench.trouble = LinkDown("laser", "read", "gone")
    assert await bench.follow_up() == "investigation of alarm 1"
    assert await bench.follow_up() == ""  # not until the next check holds the alarm
    await bench.check(result(2, 25.0))
    bench.trouble = None
    assert await bench.follow_up() == "investigation of alarm 1"
    await bench.check(result(3, 25.0))
    assert await bench.follow_up() == ""
    assert alarms_of(bench.store, "mill-7")[0].outcome == "no proposal: the tables promise too little"
    assert bench.told() == [("ALM-001", 1), ("ALM-005", 1), ("ALM-004", 1)]
    assert bench.watcher.heard == ["started investigation of alarm 1", "ended None"] * 2


async def test_a_defect_of_an_investigation_is_not_hidden(bench: Bench) -> None:
    await bench.check(result(1, 25.0))
    bench.trouble = KeyError("a defect")
    for day in (2, 3):
        with pytest.raises(KeyError):
            await bench.follow_up()
        assert await bench.follow_up() == ""  # nor does it end each service that is started after this one
        await bench.check(result(day, 25.0))
    assert await bench.follow_up() == ""


async def test_after_a_kept_push_the_check_is_made_again_and_the_series_begins_anew(bench: Bench) -> None:
    await bench.check(result(0))
    await bench.check(result(1, 25.0))
    await bench.follow_up()
    at = START + timedelta(days=1, hours=3)
    entry = PushEntry(machine="mill-7", push=1, seq=0, state=PushState.KEEP, doc={}, utc=utc_text(at), prev=GENESIS, digest="d" * 64)
    bench.store.pushes.append(entry)
    assert series_begins(bench.store, "mill-7") == at
    last = alarms_of(bench.store, "mill-7")[0].last_seq
    bench.store.alarms.append("mill-7", 1, last + 1, AlarmKind.PUSHED, AlarmFacts(word="kept", proposal=1, text="proposal 1 kept"))
    follow_up = await bench.desk.due()
    assert follow_up is not None
    assert (follow_up.name, follow_up.schedule.recipe, follow_up.job) == ("daily (after push)", "quick-check", None)
    again = await bench.desk.due()
    assert again is not None  # it could not start: it is offered until it has begun
    assert again.begun is not None
    again.begun()
    assert await bench.desk.due() is None  # whatever becomes of it, the timetable goes on from there
    assert (await bench.check(result(1.5, 14.5))).startswith("alarm 1 cleared")  # would be a jump from the old series
    assert await bench.desk.due() is None


async def test_a_push_that_the_service_did_not_survive_is_said_and_not_begun_again(url: str) -> None:
    with Store.open(url) as store:
        store.alarms.append("mill-7", NO_ALARM, 0, AlarmKind.PUSHING, AlarmFacts(proposal=7, approval=1, text="proposal 7 is being pushed"))
        bench = Bench(store, url, push=True)
        assert await bench.follow_up() == ""
        begun, ended = store.alarms.entries("mill-7")
        assert (begun.kind, ended.kind, ended.facts.word) == ("pushing", "pushed", "failed")
        assert ended.facts.text.startswith("proposal 7 failed: the service ended before anything was written")
        assert bench.told() == [("ALM-006", 0)]
        assert await bench.follow_up() == ""
        assert len(store.alarms.entries("mill-7")) == 2


def test_a_line_on_old_knowledge_is_refused(bench: Bench) -> None:
    bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, AlarmFacts())
    bench.store.alarms.append("mill-7", 1, 1, AlarmKind.CONTINUED, AlarmFacts())
    with pytest.raises(StoreError, match="another process changed alarm 1 of mill-7"):
        bench.store.alarms.append("mill-7", 1, 1, AlarmKind.CLEARED, AlarmFacts())
    assert bench.store.alarms.append("mill-7", NO_ALARM, 0, AlarmKind.PUSHING, AlarmFacts()).alarm == NO_ALARM
    assert bench.store.alarms.append("mill-7", None, 0, AlarmKind.RAISED, AlarmFacts()).alarm == 2
    assert bench.store.alarms.append("mill-8", None, 0, AlarmKind.RAISED, AlarmFacts()).alarm == 1
    assert [e.kind for e in bench.store.alarms.entries("mill-7")] == ["raised", "held", "pushing", "raised"]


FILE = """
name = "mill-7"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0.0, 600.0]
Y = [0.0, 500.0]
Z = [0.0, 450.0]
[store]
url = "sqlite:///abbe.sqlite3"
"""


async def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine, url = tmp_path / "machine.toml", f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    machine.write_text(FILE)
    with Store.open(url) as store:
        assert run(["alarm", "list", "-m", str(machine)]) == 0
        assert "no alarm of mill-7 is open" in capsys.readouterr().out
        await Bench(store, url).check(result(0, 25.0))
    assert run(["alarm", "acknowledge", "-m", str(machine), "1", "--as", "otto"]) == 0
    assert "alarm 1 is acknowledged: seen by otto" in capsys.readouterr().out
    assert run(["alarm", "acknowledge", "-m", str(machine), "1"]) == 2
    assert "was acknowledged by otto" in capsys.readouterr().err
    assert run(["alarm", "acknowledge", "-m", str(machine), "9"]) == 2
    assert "mill-7 has no alarm 9 - `abbe alarm list` shows the open ones" in capsys.readouterr().err
    assert run(["alarm", "list", "-m", str(machine), "--json"]) == 0
    (doc,) = json.loads(capsys.readouterr().out)["alarms"]
    assert (doc["alarm"], doc["state"], doc["signals"][0]["expanded"]) == (1, "acknowledged", 1.0)
