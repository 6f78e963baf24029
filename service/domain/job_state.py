"""A job of this run of the service."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from abbe.service.domain.bounds import Number, Text, Word

JobKind = Literal["check", "campaign", "investigation", "push", "rollback"]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobState:
    """A job since the service began: a check or full campaign, what follows from an alarm, or a rollback that a person ordered.

    ``state``: running, asking, pausing, paused, …; once it has ended ``done: VERDICT`` of a check, ``done: kept``
    (``rolled back``, ``refused``, ``stopped``, ``failed``, ``open``) of a push, ``done: proposed`` (``ended``, ``failed``,
    ``stopped``) of a campaign or an investigation, or ``interrupted``. A rollback is a push of the table from before: ``kept`` means that
    this one is in force again. ``asking``: a person has to do what ``ask`` says and say so under the number ``prompt``. ``who``: empty for
    what nobody ordered. ``solution`` and ``proposal``: what a campaign has left in the store.
    """

    id: Word
    kind: JobKind
    recipe: Word
    schedule: Word
    who: Word
    state: Word
    text: Text
    begun_utc: datetime
    ended_utc: datetime | None = None
    verification: Number | None = None
    prompt: Number = 0
    ask: Word = ""
    solution: Number | None = None
    proposal: Number | None = None


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """How work ended, the sentence to it, and what it has left in the store.

    ``word`` of a push or rollback: ``kept``: the new table is in force, and was verified; ``rolled back``: it was, and the old one
    is again; ``refused``, ``failed``, ``stopped`` (by a person): the new one never was in force; ``open``: it may be in force, and
    nothing has verified it. Of a campaign: ``proposed``, ``ended`` (there is no proposal that could be approved), ``failed``,
    ``stopped``. ``waits``: another process has the machine, and nothing was begun.
    """

    word: str
    text: str
    solution: int | None = None
    proposal: int | None = None
