"""Jobs of the running service."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from abbe.service.domain.bounds import Number, Text, Word

JobKind = Literal["check", "campaign", "investigation", "push", "rollback"]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobState:
    """A job since the service started: a check, a full campaign, work on an alarm, or a rollback ordered by a person.

    ``state``: running, asking, pausing, paused, …; at the end ``interrupted``, or ``done: WORD``. The word is the verdict of a check;
    ``kept``, ``rolled back``, ``refused``, ``stopped``, ``failed`` or ``open`` for a push; ``proposed``, ``ended``, ``failed`` or
    ``stopped`` for a campaign or an investigation. A rollback is a push of the previous table: ``kept`` means that this table is in
    force again. While it is ``asking``, a person has to do what ``ask`` says and confirm the number ``prompt``. ``who``:
    empty if no person ordered it. ``alarm``: the alarm for which it works, None without one. ``solution``, ``proposal``: results of a
    campaign in the store.
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
    alarm: Number | None = None
    prompt: Number = 0
    ask: Word = ""
    solution: Number | None = None
    proposal: Number | None = None


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """End of a job: a word, a sentence, and the job's results in the store.

    ``word`` of a push or rollback: ``kept``: the new table is in force and verified; ``rolled back``: the old table is in force again;
    ``refused``, ``failed``, ``stopped`` (by a person): the new table was never in force; ``open``: it may be in force, unverified. Of a
    campaign: ``proposed``, ``ended`` (no proposal can be approved), ``failed``, ``stopped``. ``waits``: another process has the machine,
    nothing was begun.
    """

    word: str
    text: str
    solution: int | None = None
    proposal: int | None = None
