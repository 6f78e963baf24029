"""The checker itself: a good case passes, and each obligation can be broken; the page of the matrix is current."""

from __future__ import annotations

import dataclasses

import pytest

from abbe.drivers.errors import ReplyTimeout
from tests.faults.catalogue import crossed, rows
from tests.faults.contract import OBLIGATIONS, Book, Observed, Record, Told, complaints, told_of
from tests.faults.page import PAGE, page

TOLD = Told("DRV-003", "no reply within 1 s", "device on?", "modbus+tcp://127.0.0.1:502?unit=1", "run 7", "no reply within 1 s")
RECORDS = (Record("detected", "DRV-003", TOLD.device, "run 7"), Record("outcome", "DRV-003", TOLD.device, "run 7", "recovered"))
GOOD = Observed("M2", "a", told=TOLD, state="up", resumed=True, records=RECORDS)
BROKEN = {
    "E nobody told": ("E", {"told": None}),
    "E no code": ("E", {"told": dataclasses.replace(TOLD, code="DRV-000")}),
    "E no remedy": ("E", {"told": dataclasses.replace(TOLD, remedy="")}),
    "E no run": ("E", {"told": dataclasses.replace(TOLD, run="")}),
    "E traceback": ("E", {"told": dataclasses.replace(TOLD, text="Traceback (most recent call last)")}),
    "N wrong value": ("N", {"wrong_values": 1}),
    "N lost": ("N", {"unaccounted": 1}),
    "S command": ("S", {"commands_after": 1}),
    "S table": ("S", {"table_verified": False}),
    "R no state": ("R", {"state": ""}),
    "R not resumed": ("R", {"resumed": False}),
    "R resumed against its word": ("R", {"resumable": False}),
    "A twice": ("A", {"records": (*RECORDS, RECORDS[0])}),
    "A no outcome": ("A", {"records": RECORDS[:1]}),
    "A outcome without state": ("A", {"records": (RECORDS[0], dataclasses.replace(RECORDS[1], state=""))}),
}


def test_a_good_case_has_no_complaint():
    assert complaints(GOOD) == {name: [] for name in OBLIGATIONS}


def test_an_absorbed_fault_needs_nobody_to_be_told():
    assert not any(complaints(dataclasses.replace(GOOD, told=None, absorbed=True)).values())


@pytest.mark.parametrize("what", BROKEN)
def test_each_obligation_can_be_broken(what):
    name, change = BROKEN[what]
    found = complaints(dataclasses.replace(GOOD, **change))
    assert {key for key, texts in found.items() if texts} == {name}


def test_an_obligation_left_out_with_a_reason_is_not_judged():
    seen = dataclasses.replace(GOOD, records=(), left_out={"A": "the parser keeps no records"})
    assert not any(complaints(seen).values())


def test_the_book_counts_a_case_once_and_broken_if_it_broke_once():
    book = Book()
    book.add(GOOD, set())
    book.add(GOOD, {"N"})
    book.add(dataclasses.replace(GOOD, case="b"), set())
    assert len(book.rows["M2"].cases) == 2
    assert book.failed("M2") == {"a"}
    assert book.rows["M2"].passed("N") == 1
    assert [word for word in book.table()[-1].split() if word.isdigit()] == ["2", "1"]


def test_what_an_exception_tells():
    told = told_of(ReplyTimeout("laser", "read", "no reply within 1 s", "device on?"), run="run 3")
    assert (told.code, told.device, told.run, told.remedy) == ("DRV-003", "laser", "run 3", "device on?")


def test_cases_are_named_by_crossing():
    assert crossed(("a", "b"), ("1", "2")) == ("a 1", "a 2", "b 1", "b 2")


def test_every_row_is_there_once_and_its_test_exists():
    found = rows()
    assert len({row.name for row in found}) == len(found)
    for row in found:
        assert (PAGE.parents[2] / "tests" / "faults" / row.test).exists(), row.name


def test_the_page_is_current():
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m tests.faults.page"
