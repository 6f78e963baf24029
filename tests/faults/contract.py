"""The five obligations of a fault, checked in one place on plain data: error, nothing lost, safe, resumable, accounted for.

A test injects one fault, fills an ``Observed`` from what the product told, kept and did, and calls ``assert_fault_contract``. Nothing here
knows a device: every row of the fault matrix uses the same checker, and the checker counts what it saw (``BOOK``) for the table at the
end of the test run.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

OBLIGATIONS = {
    "E": "clear error: stable code, cause, remedy, device, run",
    "N": "nothing lost, nothing wrong: every gap is explicit",
    "S": "no motion and no activation after the fault was noticed",
    "R": "a named state, and work goes on from there",
    "A": "one record of the detection, one of the outcome",
}
DETECTED, OUTCOME = "detected", "outcome"
_CODE = re.compile(r"[A-Z]{3}-\d{3}")
_BARE = ("Traceback (most recent call last)", "object at 0x")


@dataclass(frozen=True, slots=True)
class Told:
    """What a person was told. ``told_of`` makes it of an exception of the product."""

    code: str
    cause: str
    remedy: str
    device: str
    run: str
    text: str


@dataclass(frozen=True, slots=True)
class Record:
    """One entry of the product's own account. ``kind``: ``detected`` or ``outcome``; ``state``: of an outcome, how it ended."""

    kind: str
    code: str
    device: str
    run: str
    state: str = ""


@dataclass(frozen=True, slots=True)
class Observed:
    """What happened in one case.

    Parameters
    ----------
    row, case : str
        Row of the matrix (``M2``) and the case in it, unique in the row.
    told : Told or None
        What a person was told; None only with ``absorbed``.
    absorbed : bool
        The product overcame the fault within its deadline: nobody had to be told, the records still say it.
    wrong_values : int
        Values that the product delivered as good and that were not (another transaction's, corrupted, stale).
    unaccounted : int
        Durable items that are neither there nor in an explicit gap record.
    commands_after : int
        Motion or activation commands that the device executed after the fault was noticed, stopping ones not counted.
    table_verified : bool
        The controller's active table is one that was verified (True where no table is in play).
    state : str
        The name of the state that the product was left in.
    resumable : bool
        Whether that state says that work can go on once the fault is gone.
    resumed : bool or None
        Whether it did, with right values, after the fault was lifted; None where ``resumable`` is False.
    records : sequence of Record
        The product's own account of this case.
    left_out : dict of str to str
        Obligations that this case cannot have, each with the reason; shown in the table.
    """

    row: str
    case: str
    told: Told | None = None
    absorbed: bool = False
    wrong_values: int = 0
    unaccounted: int = 0
    commands_after: int = 0
    table_verified: bool = True
    state: str = ""
    resumable: bool = True
    resumed: bool | None = None
    records: Sequence[Record] = ()
    left_out: dict[str, str] = field(default_factory=dict)


def told_of(error: BaseException, *, run: str = "") -> Told:
    """What an exception tells a person; everything empty that it does not carry (which the checker then refuses).

    Parameters
    ----------
    error : BaseException
        As the product raised it.
    run : str
        The run, where the caller knows it better than the exception ("no run" is a statement too: nothing was being measured).
    """
    return Told(
        code=str(getattr(error, "code", "")),
        cause=str(getattr(error, "detail", "")),
        remedy=str(getattr(error, "remedy", "")),
        device=str(getattr(error, "device", "")),
        run=run or str(getattr(error, "run", "")),
        text=str(error),
    )


def complaints(seen: Observed) -> dict[str, list[str]]:
    """What is wrong with a case, per obligation (all five keys, empty lists where nothing is)."""
    found = {"E": _error(seen), "N": _nothing_lost(seen), "S": _safe(seen), "R": _resumable(seen), "A": _accounted(seen)}
    return {name: [] if name in seen.left_out else list(texts) for name, texts in found.items()}


def assert_fault_contract(seen: Observed) -> None:
    """Check one case against the five obligations and count it for the table.

    Raises
    ------
    AssertionError
        Names row, case and every broken obligation.
    """
    found = complaints(seen)
    BOOK.add(seen, {name for name, texts in found.items() if texts})
    if broken := [f"{name}: {text}" for name, texts in found.items() for text in texts]:
        raise AssertionError(f"{seen.row} [{seen.case}] breaks its contract:\n  " + "\n  ".join(broken))


def _error(seen: Observed) -> list[str]:
    told = seen.told
    if told is None:
        return [] if seen.absorbed else ["nobody was told"]
    wrong = [] if _CODE.fullmatch(told.code) and not told.code.endswith("-000") else [f"no stable code: {told.code!r}"]
    wrong += [f"no {name} in {told.text!r}" for name in ("cause", "remedy", "device", "run") if not getattr(told, name).strip()]
    wrong += [f"a bare traceback: {told.text!r}" for mark in _BARE if mark in told.text]
    return wrong


def _nothing_lost(seen: Observed) -> list[str]:
    wrong = [f"{seen.wrong_values} wrong values were delivered as good"] if seen.wrong_values else []
    return wrong + ([f"{seen.unaccounted} items are neither kept nor in a gap record"] if seen.unaccounted else [])


def _safe(seen: Observed) -> list[str]:
    wrong = [f"{seen.commands_after} motion or activation commands after the detection"] if seen.commands_after else []
    return wrong + ([] if seen.table_verified else ["an unverified table is active"])


def _resumable(seen: Observed) -> list[str]:
    if not seen.state:
        return ["the state has no name"]
    if not seen.resumable:
        return [] if seen.resumed is None else [f"state {seen.state} says it cannot go on, and it was tried all the same"]
    return [] if seen.resumed else [f"state {seen.state} says it can go on, and it did not"]


def _accounted(seen: Observed) -> list[str]:
    wrong = []
    for kind in (DETECTED, OUTCOME):
        count = sum(record.kind == kind for record in seen.records)
        wrong += [] if count == 1 else [f"{count} records of kind {kind!r} instead of one"]
    wrong += [f"a record of unknown kind {r.kind!r}" for r in seen.records if r.kind not in (DETECTED, OUTCOME)]
    for record in seen.records:
        if not _CODE.fullmatch(record.code) or not record.device or not record.run:
            wrong.append(f"a record without code, device or run: {record}")
        if record.kind == OUTCOME and not record.state:
            wrong.append("the outcome names no state")
    return wrong


@dataclass
class RowCount:
    """What was seen of one row: cases tried, cases in which an obligation was broken, and obligations left out with their reasons."""

    cases: set[str] = field(default_factory=set)
    broken: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    left_out: dict[str, dict[str, str]] = field(default_factory=lambda: defaultdict(dict))

    def passed(self, obligation: str) -> int:
        """Cases that were judged by this obligation and kept it."""
        return len(self.cases) - len(self.broken[obligation]) - len(self.left_out[obligation])


class Book:
    """All cases of this test run. A case that is tried twice counts once, and as broken if it broke once."""

    def __init__(self) -> None:
        self.rows: dict[str, RowCount] = {}

    def add(self, seen: Observed, broken: set[str]) -> None:
        """Count a case."""
        row = self.rows.setdefault(seen.row, RowCount())
        row.cases.add(seen.case)
        for name in broken:
            row.broken[name].add(seen.case)
        for name, reason in seen.left_out.items():
            row.left_out[name][seen.case] = reason

    def failed(self, row: str) -> set[str]:
        """Cases of a row with any broken obligation."""
        return set().union(*self.rows[row].broken.values()) if row in self.rows else set()

    def table(self) -> list[str]:
        """Lines of the table: rows, cases tried and passed, and per obligation kept/judged."""
        lines = [f"{'row':5}{'cases':>7}{'passed':>8}  " + "".join(f"{name:>12}" for name in OBLIGATIONS)]
        tried = passed = 0
        for name, row in sorted(self.rows.items(), key=lambda item: _natural(item[0])):
            good = len(row.cases) - len(self.failed(name))
            tried, passed = tried + len(row.cases), passed + good
            cells = (f"{row.passed(o)}/{len(row.cases) - len(row.left_out[o])}" for o in OBLIGATIONS)
            lines.append(f"{name:5}{len(row.cases):7}{good:8}  " + "".join(f"{cell:>12}" for cell in cells))
        return [*lines, f"{'all':5}{tried:7}{passed:8}"]


def _natural(name: str) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


BOOK = Book()
