"""Run the push machine: get the next operation, do it through a port, learn from its outcome. One loop for models and machines."""

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
    """Does one operation on a controller, or asks an actor. Raises nothing for what a controller or a link does."""

    async def execute(self, op: Operation, journal: Journal) -> Outcome:
        """Do the operation; ``journal`` is the push so far."""
        ...


class Book(Protocol):
    """The durable journal of one push."""

    async def entries(self) -> Journal:
        """All entries so far."""
        ...

    async def append(self, journal: Journal, state: PushState, doc: Doc) -> JournalEntry:
        """Write the next entry; on return it is on disk. Raises otherwise, or if somebody else wrote an entry meanwhile."""
        ...


@dataclass(frozen=True, slots=True)
class Ended:
    """State of a push after this run. ``state`` None: nothing was begun. Not ``settled``: recovery has to continue it."""

    state: PushState | None
    journal: Journal
    why: str

    @property
    def settled(self) -> bool:
        """Nothing is left to do, or only a person can do it."""
        return self.state is None or self.state in TERMINAL


def _never_stop() -> str:
    return ""


async def push(port: Port, book: Book, order: OperationOrder, *, stop: Callable[[], str] = _never_stop) -> Ended:
    """Push a table into a controller, from SNAPSHOT to KEEP, or roll back.

    ``stop`` is called before every operation: a reason to stop, or an empty text. A stop rolls an unverified table back.
    """
    return await _drive(port, book, (), Knowledge(mine=True), order, stop)


async def recover(port: Port, book: Book) -> Ended:
    """Finish an interrupted push from its journal and the controller's state. May be repeated at will."""
    return await _drive(port, book, await book.entries(), Knowledge(), None, _never_stop)


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
