"""The machine file's timetable as the scheduler wants it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, time

from abbe.service.config_schema import MachineFile
from abbe.service.config_timetable import ScheduleEntry, WindowEntry
from abbe.service.domain.schedule import FIRST_UTC, Needs, Schedule
from abbe.service.scheduler.slots import checked
from abbe.service.scheduler.windows import Window


def schedules_of(config: MachineFile) -> tuple[Schedule, ...]:
    """Return the timetable of a machine.

    Raises
    ------
    ConfigError
        A schedule's expression or zone cannot be used.
    """
    return tuple(checked(_schedule(entry)) for entry in config.schedule)


def _schedule(entry: ScheduleEntry) -> Schedule:
    needs = entry.needs
    return Schedule(
        entry.name,
        entry.cron or "",
        entry.timezone,
        entry.recipe,
        entry.grace_s,
        every_h=entry.every_h or 0.0,
        first_utc=FIRST_UTC if entry.first is None else entry.first.astimezone(UTC),
        catch_up=entry.catch_up,
        needs=Needs(needs.idle, needs.warm_min, needs.air, needs.operator),
        on_alarm=entry.on_alarm,
    )


def windows_of(entries: Sequence[WindowEntry]) -> tuple[Window, ...]:
    """Return maintenance windows or staffed hours."""
    return tuple(
        Window(
            entry.name,
            entry.timezone,
            entry.cron or "",
            entry.hours or 0.0,
            frozenset(entry.days or ()),
            entry.start or time(0),
            entry.end or time(0),
        )
        for entry in entries
    )
