"""Alarms for people: the history of one with the person behind each entry, and those of a check."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from abbe.service.domain.service_records import AlarmEntryRecord, AlarmKind
from abbe.service.queries.status import AlarmSummary, summaries
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import folded


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmLine:
    """One entry of an alarm. ``who``: the person, empty for the service; ``verification``, ``until_utc``: None if the entry has none."""

    kind: AlarmKind
    utc: datetime
    who: str
    text: str
    verification: int | None = None
    until_utc: datetime | None = None


def alarm_lines(store: Store, machine: str, number: int) -> list[AlarmLine]:
    """The entries of an alarm, newest first."""
    return [_line(one) for one in reversed(store.alarms.entries(machine)) if one.alarm == number]


def _line(one: AlarmEntryRecord) -> AlarmLine:
    facts = one.facts
    return AlarmLine(
        kind=one.kind,
        utc=datetime.fromisoformat(one.utc),
        who=facts.name,
        text=facts.text or facts.comment or facts.reason,
        verification=facts.verification,
        until_utc=facts.until_utc,
    )


def alarms_of_check(store: Store, machine: str, verification: int) -> list[AlarmSummary]:
    """The alarms that a check raised, held or cleared."""
    entries = store.alarms.entries(machine)
    numbers = {one.alarm for one in entries if one.facts.verification == verification}
    return [one for one in summaries(folded(entries), every=True) if one.alarm in numbers]
