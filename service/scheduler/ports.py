"""Protocols of the services that the scheduler needs. Tests replace each with a few lines."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime
from typing import NamedTuple, Protocol, Self

from abbe.service.domain.document import Doc
from abbe.service.domain.progress import JobOutcome, Progress, ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import CheckResult
from abbe.service.sequences.control import Control

Check = Callable[[str, ProgressSink, Control], Awaitable[CheckResult]]
"""``check(recipe, progress, control)``: opens the devices, measures, closes them. Cancelling it must leave the machine held; ``control``
pauses, resumes, stops or aborts it."""


class SlotState(str):
    """Final state of a slot or a job, with its sentence, and the numbers of a solution, a proposal and a verification in the store."""

    reason: str
    solution: int | None
    proposal: int | None
    verification: int | None

    def __new__(
        cls, state: str, reason: str = "", solution: int | None = None, proposal: int | None = None, verification: int | None = None
    ) -> Self:
        """Make a state with its sentence and numbers."""
        made = super().__new__(cls, state)
        made.reason, made.solution, made.proposal, made.verification = reason, solution, proposal, verification
        return made

    @classmethod
    def of(cls, outcome: JobOutcome) -> Self:
        """Return the final state for a job's outcome."""
        return cls(f"done: {outcome.word}", outcome.text, outcome.solution, outcome.proposal)


AfterCheck = Callable[[Doc, int], Awaitable[str]]
"""``await after(doc, number)``: returns a sentence about further consequences of a stored verification; empty: none."""


class OpenSlot(NamedTuple):
    """An unfinished slot of a service that ended. ``ran``: the machine had begun to move for it."""

    slot_utc: datetime
    ran: bool


class SlotLedger(Protocol):
    """Remembers which slots were dealt with, across restarts and across processes."""

    async def claim(self, schedule: str, slot_utc: datetime) -> bool:
        """Return True to exactly one caller, ever, for each (schedule, slot)."""
        ...

    async def begin(self, schedule: str, slot_utc: datetime) -> None:
        """Note that the check of a claimed slot starts: it is never started again."""
        ...

    async def release(self, schedule: str, slot_utc: datetime) -> None:
        """Give back a claimed slot that was not started."""
        ...

    async def adopt(self, schedule: str) -> list[OpenSlot]:
        """Take over the open slots of services that are gone, in order of time. Each goes to exactly one caller."""
        ...

    async def finish(self, schedule: str, slot_utc: datetime, state: str, reason: str = "") -> None:
        """Record the outcome of a claimed slot: state (at most 30 characters) and its sentence."""
        ...

    async def in_force_since(self, rules: Mapping[str, str], now: datetime) -> dict[str, datetime]:
        """Return the time from which each schedule has its present time rule; ``now`` for a new or changed rule.

        ``rules``: the time rule of each schedule; schedules without a rule here are forgotten.
        """
        ...

    async def last_claimed(self, schedule: str) -> datetime | None:
        """Return the latest slot ever claimed for this schedule, or None if it is new."""
        ...


class Readiness(Protocol):
    """Checks whether the machine meets a schedule's preconditions."""

    async def lack(self, schedule: Schedule) -> str:
        """Return the unmet precondition as one sentence, or an empty text."""
        ...

    async def watch(self) -> None:
        """Record the machine's state forever if a precondition needs its history; otherwise return at once."""
        ...

    def continue_from(self, earlier: Readiness) -> None:
        """Take over the machine's history, which was recorded before the service started anew."""
        ...


class Shelf(Protocol):
    """Stores results, each with the message that publishes it."""

    async def keep(self, doc: Doc) -> int:
        """Store a verification and queue its message, together; return its number."""
        ...

    async def alarm(self, doc: Doc) -> None:
        """Queue an alarm."""
        ...


class JobWatcher(Protocol):
    """Follows the running job; the methods are called synchronously."""

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        """A check begins."""
        ...

    def job_progress(self, progress: Progress) -> None:
        """The check made progress."""
        ...

    def job_ended(self, doc: Doc | None) -> None:
        """The check ended with this document, or was stopped (None)."""
        ...
