"""Alarms as a pure state machine: whatever the checks say, in whatever order, with acknowledgements and restarts between."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.service.domain.service_records import AlarmEntryRecord, AlarmFacts, AlarmKind, Signal
from abbe.service.verification.alarm_states import Alarm, FiredRule, after_check, folded, is_open, next_step, step_alone, step_of_order

RECIPE = "quick-check"
TOMORROW = datetime(2026, 11, 23, tzinfo=UTC)
SIGNAL = Signal("helix_rms_um", "limit", 8.8, 0.2, 7.0, "helix rms 8.8 ± 0.2 µm (U, k = 2) is above its limit of 7 µm")
BAD = FiredRule(True, "fail", (SIGNAL,))
GOOD = FiredRule(True, "pass")
UNSURE = FiredRule(True, "cannot tell")
NOT_MEASURED = FiredRule(False, "cannot tell")


def entry(number: int, seq: int, kind: AlarmKind, facts: AlarmFacts, utc: str = "2026-11-22T00:00:00Z") -> AlarmEntryRecord:
    return AlarmEntryRecord(machine="mill-7", alarm=number, seq=seq, kind=kind, facts=facts, utc=utc)


@dataclass
class Book:
    """Lines as the store keeps them, and what a check or a person adds."""

    lines: list[AlarmEntryRecord] = field(default_factory=list)

    @property
    def alarms(self) -> list[Alarm]:
        return folded(self.lines)

    @property
    def active(self) -> Alarm | None:
        return next((a for a in reversed(self.alarms) if a.active), None)

    def add(self, number: int | None, kind: AlarmKind, **facts: Any) -> None:
        number = number or max((line.alarm for line in self.lines), default=0) + 1
        seq = max((line.seq for line in self.lines if line.alarm == number), default=-1) + 1
        self.lines.append(entry(number, seq, kind, AlarmFacts(**facts), f"2026-11-22T00:00:{len(self.lines):02d}Z"))

    def check(self, found: FiredRule) -> AlarmKind | None:
        now = self.active
        kind = after_check(now, found)
        if kind is not None:
            facts = {"recipe": RECIPE, "schedule": "often", "verification": len(self.lines), "text": found.text}
            self.add(None if now is None else now.number, kind, signals=found.signals, **facts)
        return kind

    def acknowledge(self, name: str = "otto") -> None:
        self.add(self.alarms[-1].number, AlarmKind.ACKNOWLEDGED, name=name)


def test_the_life_of_an_alarm() -> None:
    book = Book()
    assert [book.check(f) for f in (GOOD, UNSURE, NOT_MEASURED)] == [None, None, None]
    assert book.check(BAD) is AlarmKind.RAISED
    assert book.alarms[0].word == "raised"
    assert book.check(NOT_MEASURED) is None
    assert book.check(UNSURE) is AlarmKind.CONTINUED  # too near to the limit to say that it is over
    book.acknowledge()
    assert book.alarms[0].word == "acknowledged"
    assert book.check(BAD) is AlarmKind.CONTINUED
    assert book.alarms[0].word == "acknowledged"
    assert book.check(GOOD) is AlarmKind.CLEARED
    assert book.alarms[0].word == "closed"
    assert not is_open(book.alarms[0])
    assert book.check(BAD) is AlarmKind.RAISED
    assert [a.number for a in book.alarms] == [1, 2]
    assert book.check(GOOD) is AlarmKind.CLEARED
    assert book.alarms[1].word == "cleared"  # it stays to be seen
    assert is_open(book.alarms[1])
    book.acknowledge("anna")
    assert (book.alarms[1].word, book.alarms[1].acknowledged_by) == ("closed", "anna")
    book.acknowledge("otto")
    assert book.alarms[1].acknowledged_by == "anna"  # who was first stays


CHECKS = st.sampled_from([BAD, GOOD, UNSURE, NOT_MEASURED])
ACTS = st.lists(st.one_of(CHECKS, st.just("ack")), max_size=40)


@given(ACTS)
def test_whatever_happens(acts: list[FiredRule | str]) -> None:
    """Beside the machine a model of three lines: is it on, has somebody seen it, how many were there."""
    book, on, seen, count = Book(), False, False, 0
    for act in acts:
        if isinstance(act, str):
            if count:
                book.acknowledge()
                seen = True
        else:
            kind = book.check(act)
            if act is BAD:
                assert kind is (AlarmKind.CONTINUED if on else AlarmKind.RAISED)
                count, seen, on = (count, seen, True) if on else (count + 1, False, True)
            elif act is NOT_MEASURED or not on:
                assert kind is None
            else:
                assert kind is (AlarmKind.CLEARED if act is GOOD else AlarmKind.CONTINUED)
                on = act is not GOOD
        alarms = book.alarms
        assert len(alarms) == count
        assert sum(a.active for a in alarms) == int(on)
        assert [a.active for a in alarms[:-1]] == [False] * max(count - 1, 0)
        if alarms:
            word = {(True, False): "raised", (True, True): "acknowledged", (False, False): "cleared", (False, True): "closed"}[on, seen]
            assert alarms[-1].word == word
            assert alarms[-1].signals or act is UNSURE or not on or isinstance(act, str) or act is NOT_MEASURED


@given(ACTS, st.integers(0, 60))
def test_a_restart_anywhere_finds_the_same(acts: list[FiredRule | str], cut: int) -> None:
    """What is read at a start follows from the lines alone: a prefix of them is what stood there then."""
    book, then = Book(), []
    for act in acts:
        if not isinstance(act, str):
            book.check(act)
        elif book.lines:
            book.acknowledge()
        then.append((len(book.lines), book.alarms))
    for length, alarms in then[:cut]:
        assert folded(book.lines[:length]) == alarms


def test_priority_comment_and_shelving(raised: Book) -> None:
    assert raised.alarms[0].priority == 1
    jump, drift = (FiredRule(True, "pass", (replace(SIGNAL, kind=kind),)) for kind in ("jump", "drift"))
    raised.check(jump)
    assert raised.alarms[0].priority == 2
    raised.check(drift)
    assert raised.alarms[0].priority == 3
    raised.check(GOOD)
    assert raised.alarms[0].priority == 1, "what is over keeps the priority that it was raised with"
    raised.add(1, AlarmKind.SHELVED, name="otto", reason="spindle is being repaired", until_utc=TOMORROW)
    raised.add(1, AlarmKind.ACKNOWLEDGED, name="otto", comment="seen")
    (one,) = raised.alarms
    assert (one.shelved_until_utc, one.comment, one.word) == (TOMORROW, "seen", "closed")


def test_lines_that_cannot_follow_are_left_out() -> None:
    stray = [
        entry(0, 0, AlarmKind.PUSHED, AlarmFacts(text="no alarm asked for it")),
        entry(7, 0, AlarmKind.CONTINUED, AlarmFacts()),
        entry(7, 1, AlarmKind.ACKNOWLEDGED, AlarmFacts()),
    ]
    assert folded(stray) == []


@pytest.fixture
def raised() -> Book:
    book = Book()
    book.check(BAD)
    return book


def test_an_investigation_goes_on_where_its_lines_end(raised: Book) -> None:
    def step() -> AlarmKind | None:
        return next_step(raised.alarms[0])

    assert step() is AlarmKind.MEASURED
    raised.add(1, AlarmKind.BEGUN, text="measuring")
    assert step() is AlarmKind.MEASURED  # interrupted: anew
    raised.add(1, AlarmKind.MEASURED, text="measured", campaign="c")
    assert step() is AlarmKind.DISCOVERED
    raised.add(1, AlarmKind.DISCOVERED, text="found")
    assert step() is AlarmKind.PROPOSED
    raised.add(1, AlarmKind.FAILED, text="the link is down")
    assert step() is None  # not at once
    raised.check(BAD)
    assert step() is AlarmKind.PROPOSED
    raised.add(1, AlarmKind.PROPOSED, text="proposal 1", proposal=1)
    assert step() is None
    assert raised.alarms[0].outcome == "proposal 1"


def test_a_cleared_alarm_asks_for_nothing(raised: Book) -> None:
    raised.check(GOOD)
    assert next_step(raised.alarms[0]) is None


def test_an_ended_investigation_is_not_begun_again(raised: Book) -> None:
    raised.add(1, AlarmKind.ENDED, text="no proposal: not enough to write")
    raised.check(BAD)
    assert next_step(raised.alarms[0]) is None


def test_an_order_goes_on_after_the_last_line_and_begins_anew_after_an_end() -> None:
    book = Book()
    book.check(BAD)
    for kind in (AlarmKind.ORDERED, AlarmKind.BEGUN, AlarmKind.MEASURED):
        book.add(1, kind)
    book.add(1, AlarmKind.FAILED)
    assert next_step(book.alarms[0]) is None, "no check has held the alarm since the failure"
    book.add(1, AlarmKind.ORDERED, name="petra")
    assert next_step(book.alarms[0]) is AlarmKind.DISCOVERED, "what is measured is not measured again"
    book.add(1, AlarmKind.DISCOVERED)
    book.add(1, AlarmKind.ENDED)
    assert next_step(book.alarms[0]) is None
    book.add(1, AlarmKind.ORDERED, name="petra")
    (alarm,) = book.alarms
    assert next_step(alarm) is AlarmKind.MEASURED
    assert [line.kind for line in alarm.work] == [AlarmKind.ORDERED]
    for _ in range(2):
        book.add(1, AlarmKind.BEGUN)
        book.add(1, AlarmKind.FAILED)
        book.check(BAD)
    assert next_step(book.alarms[0]) is None, "it has failed too often"
    book.add(1, AlarmKind.ORDERED, name="petra")
    assert next_step(book.alarms[0]) is AlarmKind.MEASURED


def test_after_two_failures_an_order_keeps_what_is_measured_and_may_fail_twice_again() -> None:
    book = Book()
    book.check(BAD)
    for kind in (AlarmKind.BEGUN, AlarmKind.MEASURED, AlarmKind.FAILED, AlarmKind.FAILED):
        book.add(1, kind, campaign="c")
    book.check(BAD)
    assert next_step(book.alarms[0]) is None
    assert step_of_order(book.alarms[0]) is AlarmKind.DISCOVERED
    book.add(1, AlarmKind.ORDERED, name="petra")
    for _ in range(2):
        book.check(BAD)
        assert next_step(book.alarms[0]) is AlarmKind.DISCOVERED
        book.add(1, AlarmKind.FAILED)
    book.check(BAD)
    assert next_step(book.alarms[0]) is None


@pytest.mark.parametrize("since", [(), (AlarmKind.BEGUN,), (AlarmKind.BEGUN, AlarmKind.FAILED)])
def test_what_a_person_has_ordered_is_measured_by_order_only(raised: Book, since: tuple[AlarmKind, ...]) -> None:
    for kind in (AlarmKind.ENDED, AlarmKind.ORDERED, *since):
        raised.add(1, kind, name="petra")
    raised.check(BAD)
    assert next_step(raised.alarms[0]) is AlarmKind.MEASURED
    assert step_alone(raised.alarms[0]) is None
    raised.add(1, AlarmKind.MEASURED, campaign="c")
    assert step_alone(raised.alarms[0]) is AlarmKind.DISCOVERED, "a search in what she measured moves nothing"
