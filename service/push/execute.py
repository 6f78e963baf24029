"""Drive the push machine: ask what is next, do it through a port, learn from it. The only loop, for models and for machines alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from abbe.service.push.entries import Doc, Journal, JournalEntry
from abbe.service.push.learn import after_record, learn
from abbe.service.push.machine import next_operation
from abbe.service.push.operations import Knowledge, Operation, OperationKind, Outcome
from abbe.service.push.order import OperationOrder
from abbe.service.push.states import TERMINAL, PushState


class Port(Protocol):
    """Does one operation on a controller, or asks the one who has to answer. Raises nothing for what a controller or a link does."""

    async def execute(self, op: Operation, journal: Journal) -> Outcome:
        """Do it; `journal` is the push so far."""
        ...


class Book(Protocol):
    """The durable journal of one push."""

    async def entries(self) -> Journal:
        """All entries so far."""
        ...

    async def append(self, journal: Journal, state: PushState, doc: Doc) -> JournalEntry:
        """Write the next entry; on return it is on disk. Raises if it is not, or if somebody else wrote one meanwhile."""
        ...


@dataclass(frozen=True, slots=True)
class Ended:
    """Where a push, or its recovery, stands now. ``state`` None: nothing was begun. Not ``settled``: it has to be continued."""

    state: PushState | None
    journal: Journal
    why: str

    @property
    def settled(self) -> bool:
        """Nothing is left to do (or only a person can)."""
        return self.state is None or self.state in TERMINAL


def _nobody() -> str:
    return ""


async def push(port: Port, book: Book, order: OperationOrder, *, stop: Callable[[], str] = _nobody) -> Ended:
    """Bring a table into a controller, from the snapshot to KEEP, or back.

    Parameters
    ----------
    stop : callable
        Asked before every operation: a reason to end, or an empty text. What is active and not verified goes back.
    """
    return await _drive(port, book, (), Knowledge(mine=True), order, stop)


async def recover(port: Port, book: Book) -> Ended:
    """Finish what an interrupted push left, from its journal and from what the controller says. May be repeated at will."""
    return await _drive(port, book, await book.entries(), Knowledge(), None, _nobody)


async def _drive(
    port: Port, book: Book, journal: Journal, known: Knowledge, order: OperationOrder | None, stop: Callable[[], str]
) -> Ended:
    while True:
        text = stop()
        if text and not known.stop:
            known = known._replace(stop=text)
        op = next_operation(journal, known, order)
        if op.kind is OperationKind.END:
            return Ended(journal[-1].state if journal else None, journal, op.text)
        if op.kind is OperationKind.RECORD:
            assert op.state is not None
            entry = await book.append(journal, op.state, op.doc or {})
            journal, known = (*journal, entry), after_record(known, entry.state)
        else:
            known = learn(known, op, await port.execute(op, journal))
