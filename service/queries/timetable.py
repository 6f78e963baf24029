"""The timetable: next due slots as text, and the outcome of past slots."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, tzinfo
from zoneinfo import ZoneInfo

from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import SlotRecord
from abbe.service.queries.reader import Reader
from abbe.service.scheduler.slots import next_slot, rule_as_text

LATEST = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class NextDue:
    """Next slot of a schedule; ``rule_text``, ``due_text``: its rule and the due time in English."""

    schedule: str
    recipe: str
    due_utc: datetime
    timezone: str
    rule_text: str
    due_text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleState(Schedule):
    """One line of the timetable. ``next_due_utc`` None: the cron expression never matches again; ``latest``: slots, newest first."""

    rule_text: str
    next_due_utc: datetime | None
    latest: list[SlotRecord]


def next_due(schedule: Schedule, slot_utc: datetime, now: datetime) -> NextDue:
    """Return a future slot with its texts for people."""
    return NextDue(
        schedule=schedule.name,
        recipe=schedule.recipe,
        due_utc=slot_utc,
        timezone=schedule.timezone,
        rule_text=rule_as_text(schedule),
        due_text=due_as_text(slot_utc, now, ZoneInfo(schedule.timezone)),
    )


def schedule_state(reader: Reader, schedule: Schedule) -> ScheduleState:
    """Return a schedule with its next slot and the outcome of its latest slots."""
    return ScheduleState(
        **{name: getattr(schedule, name) for name in Schedule.__dataclass_fields__},
        rule_text=rule_as_text(schedule),
        next_due_utc=next_slot(schedule, reader.clock.utc()),
        latest=past_slots(reader, schedule.name, LATEST),
    )


def past_slots(reader: Reader, schedule: str, limit: int) -> list[SlotRecord]:
    """Return the latest slots of a schedule of this service's machine, newest first."""
    return reader.store.slots.latest(f"{reader.machine}/{schedule}", limit)


def due_as_text(due: datetime, now: datetime, zone: tzinfo) -> str:
    """Return a due time as text: ``Monday 23 November 06:00, in 2 days``."""
    left_s = (due - now).total_seconds()
    local = due.astimezone(zone)
    clock = f"{local:%H:%M}" if local.second == 0 else f"{local:%H:%M:%S}"
    day = "today" if local.date() == now.astimezone(zone).date() else f"{local:%A} {local.day} {local:%B}"
    return f"{day} {clock}, in {span(left_s)}" if left_s > 0 else f"{day} {clock}, now"


def span(seconds: float) -> str:
    """Return a duration in the largest sensible unit: ``40 s``, ``5 min``, ``3 h``, ``2 days``."""
    seconds = abs(seconds)
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 36 * 3600:
        return f"{seconds / 3600:.0f} h"
    return f"{seconds / 86400:.0f} days"
